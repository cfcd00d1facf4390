"""The compiled frame of one garment: substeps of one Gauss-Seidel iteration each.

Extended position-based dynamics with small steps (Macklin et al. 2016, 2019). `reference` has the same steps
in plain NumPy. Nothing is summed across threads: the result depends on the inputs alone.
"""

from __future__ import annotations

import numpy as np

from stages.shared.cloth.compiling import inlined, kernel
from stages.shared.cloth.contact import push_out


@kernel
def advance_frame(  # type: ignore[no-untyped-def]
    positions,
    velocities,
    cloth,
    surfaces,
    pairs,
    pins,
    pins_before,
    pins_after,
    gravity,
    seconds,
    substeps,
    edge_stiffness,
    bending,
    bending_damping,
    drag,
    repulsion,
    strain_limit,
):
    """Advance a garment by one frame, in place.

    Arguments:
        positions, velocities: (V, 3) metres, m/s.
        cloth: Constraints; surfaces: Surfaces (their seeds change).
        pairs: (P, 2) vertices that `repulsion` keeps apart.
        pins: (K,) pinned vertices; pins_before, pins_after: (K, 3) where the body has them.
        gravity: (3,) m/s²; seconds: length of the frame; substeps: ≥ 1.
        others: as in Material.
    """
    step = seconds / substeps
    previous = np.empty_like(positions)
    normals = np.empty_like(positions)
    facing = np.empty_like(positions)
    _face_normals(positions, cloth.faces, facing)
    wait = np.zeros(surfaces.seeds.shape, dtype=np.int32)
    for number in range(substeps):
        begin, end = number / substeps, (number + 1) / substeps
        _predict(positions, previous, velocities, cloth.inverse_mass, gravity, step, drag)
        for k in range(len(pins)):
            for c in range(3):
                positions[pins[k], c] = pins_before[k, c] + end * (pins_after[k, c] - pins_before[k, c])
        _solve_edges(positions, cloth, 1.0 / (edge_stiffness * step * step), strain_limit)
        if bending > 0.0:
            _face_normals(positions, cloth.faces, normals)
            _solve_bending(positions, previous, normals, cloth, bending, bending_damping, step)
        if repulsion > 0.0:
            _repel(positions, previous, pairs, cloth.inverse_mass, repulsion)
        for s in range(len(surfaces.closed)):
            push_out(
                positions,
                previous,
                velocities,
                facing,
                cloth.inverse_mass,
                surfaces,
                s,
                wait,
                begin,
                end,
                step,
            )
        for i in range(len(positions)):
            for c in range(3):
                velocities[i, c] = (positions[i, c] - previous[i, c]) / step


@kernel
def limit_strain(positions, cloth, limit, sweeps):  # type: ignore[no-untyped-def]
    """Shorten edges that are longer than `limit` times their rest length; returns how many are left."""
    left = 0
    count = len(cloth.edges)
    for sweep in range(sweeps):
        left = 0
        for turn in range(count):
            e = turn if sweep % 2 == 0 else count - 1 - turn
            a, b = cloth.edges[e, 0], cloth.edges[e, 1]
            total = cloth.inverse_mass[a] + cloth.inverse_mass[b]
            length = _distance(positions, a, b)
            most = limit * cloth.edge_rest[e]
            if length <= most * (1.0 + 1e-9) or total == 0.0:
                continue
            left += 1
            share = (length - most) / (length * total)
            for c in range(3):
                part = share * (positions[a, c] - positions[b, c])
                positions[a, c] -= cloth.inverse_mass[a] * part
                positions[b, c] += cloth.inverse_mass[b] * part
        if left == 0:
            break
    return left


@inlined
def _predict(positions, previous, velocities, inverse_mass, gravity, step, drag):  # type: ignore[no-untyped-def]
    """Move every free vertex by its velocity, gravity and the drag of still air."""
    remaining = np.exp(-drag * step)
    for i in range(len(positions)):
        for c in range(3):
            previous[i, c] = positions[i, c]
            if inverse_mass[i] > 0.0:
                positions[i, c] += step * (velocities[i, c] * remaining + step * gravity[c])


@inlined
def _distance(positions, a, b):  # type: ignore[no-untyped-def]
    x = positions[a, 0] - positions[b, 0]
    y = positions[a, 1] - positions[b, 1]
    z = positions[a, 2] - positions[b, 2]
    return np.sqrt(x * x + y * y + z * z)


@inlined
def _solve_edges(positions, cloth, softness, strain_limit):  # type: ignore[no-untyped-def]
    """Bring every edge towards its rest length, and never beyond the strain limit."""
    for e in range(len(cloth.edges)):
        a, b = cloth.edges[e, 0], cloth.edges[e, 1]
        wa, wb = cloth.inverse_mass[a], cloth.inverse_mass[b]
        total = wa + wb
        if total == 0.0:
            continue
        x = positions[a, 0] - positions[b, 0]
        y = positions[a, 1] - positions[b, 1]
        z = positions[a, 2] - positions[b, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if length < 1e-9:
            continue
        rest = cloth.edge_rest[e]
        change = (length - rest) * total / (total + softness)
        change = max(change, length - strain_limit * rest)
        share = change / (length * total)
        positions[a, 0] -= wa * share * x
        positions[a, 1] -= wa * share * y
        positions[a, 2] -= wa * share * z
        positions[b, 0] += wb * share * x
        positions[b, 1] += wb * share * y
        positions[b, 2] += wb * share * z


@inlined
def _face_normals(positions, faces, normals):  # type: ignore[no-untyped-def]
    """Unit vertex normals, weighted by area, written to normals (V, 3)."""
    normals[:] = 0.0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux = positions[b, 0] - positions[a, 0]
        uy = positions[b, 1] - positions[a, 1]
        uz = positions[b, 2] - positions[a, 2]
        vx = positions[c, 0] - positions[a, 0]
        vy = positions[c, 1] - positions[a, 1]
        vz = positions[c, 2] - positions[a, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for corner in range(3):
            i = faces[f, corner]
            normals[i, 0] += nx
            normals[i, 1] += ny
            normals[i, 2] += nz
    for i in range(len(normals)):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        scale = 1.0 / (np.sqrt(x * x + y * y + z * z) + 1e-20)
        normals[i, 0] = x * scale
        normals[i, 1] = y * scale
        normals[i, 2] = z * scale


@inlined
def _solve_bending(positions, previous, normals, cloth, bending, damping, step):  # type: ignore[no-untyped-def]
    """Bring the curvature along the normal towards its rest value, with damping."""
    damped = damping / step
    for b in range(len(cloth.bend_vertex)):
        i = cloth.bend_vertex[b]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        mx, my, mz = positions[i, 0], positions[i, 1], positions[i, 2]
        px, py, pz = previous[i, 0], previous[i, 1], previous[i, 2]
        value, motion, total, gradient = -cloth.bend_rest[b], 0.0, 0.0, 0.0
        for slot in range(cloth.bend_start[b], cloth.bend_start[b + 1]):
            j, weight = cloth.bend_ring[slot], cloth.bend_weight[slot]
            dx, dy, dz = positions[j, 0] - mx, positions[j, 1] - my, positions[j, 2] - mz
            now = dx * nx + dy * ny + dz * nz
            earlier = (previous[j, 0] - px) * nx + (previous[j, 1] - py) * ny + (previous[j, 2] - pz) * nz
            value += weight * now
            motion += weight * (now - earlier)
            total += weight
            gradient += weight * weight * cloth.inverse_mass[j]
        gradient += total * total * cloth.inverse_mass[i]
        softness = cloth.bend_area[b] / (bending * step * step)
        multiplier = -(value + damped * motion) / ((1.0 + damped) * gradient + softness)
        for slot in range(cloth.bend_start[b], cloth.bend_start[b + 1]):
            j = cloth.bend_ring[slot]
            move = multiplier * cloth.bend_weight[slot] * cloth.inverse_mass[j]
            positions[j, 0] += move * nx
            positions[j, 1] += move * ny
            positions[j, 2] += move * nz
        move = -multiplier * total * cloth.inverse_mass[i]
        positions[i, 0] += move * nx
        positions[i, 1] += move * ny
        positions[i, 2] += move * nz


@inlined
def _repel(positions, previous, pairs, inverse_mass, least):  # type: ignore[no-untyped-def]
    """Move pairs of vertices apart that are closer than `least`, without giving them speed."""
    for p in range(len(pairs)):
        a, b = pairs[p, 0], pairs[p, 1]
        wa, wb = inverse_mass[a], inverse_mass[b]
        total = wa + wb
        length = _distance(positions, a, b)
        if length >= least or length < 1e-9 or total == 0.0:
            continue
        share = (least - length) / (length * total)
        for c in range(3):
            part = share * (positions[a, c] - positions[b, c])
            positions[a, c] += wa * part
            positions[b, c] -= wb * part
            previous[a, c] += wa * part
            previous[b, c] -= wb * part
