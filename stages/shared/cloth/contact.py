"""Contact of cloth vertices with moving surfaces, with Coulomb friction relative to the surface."""

from __future__ import annotations

import numpy as np

from stages.shared.cloth.compiling import inlined

ACROSS = 0.7  # an open surface touches only what lies across it: |normal distance| over distance
ACROSS_BODY = 0.3  # the same for a body, which is cut off at the head and the fingers
DEEPEST_BENEATH_CLOTH = 0.025  # metres; deeper beneath a garment is another place, not a contact
LARGEST_PUSH = 0.01  # metres a vertex is moved out in one step
SAME_WAY = 0.5  # cosine between the normals of cloth and of the garment beneath that it may touch
_MOST_STEPS = 6  # faces that a vertex may walk over within a substep
_ALERT_SPEED = 2.0  # m/s by which cloth and surface may speed up while a far vertex is not looked at
_LONGEST_WAIT = 8  # substeps for which a far vertex is not looked at


@inlined
def push_out(positions, previous, velocities, facing, inverse_mass, surfaces, s, wait, begin, end, step):  # type: ignore[no-untyped-def]
    """Keep the cloth outside surface `s`; slow down its sliding by friction.

    Arguments:
        positions, previous: (V, 3) at the end and at the start of the substep; both change.
        velocities: (V, 3) at the start of the substep.
        facing: (V, 3) unit normals of the cloth at the start of the frame.
        surfaces: Surfaces; begin, end: where the substep lies within the frame, 0 to 1.
        wait: (S, V) substeps for which a vertex is too far away to arrive.
        step: seconds.
    """
    friction, closed = surfaces.friction[s], surfaces.closed[s]
    for i in range(len(positions)):
        face = surfaces.seeds[s, i]
        if face < 0 or inverse_mass[i] == 0.0:
            continue
        if wait[s, i] > 0:
            wait[s, i] -= 1
            continue
        px, py, pz = positions[i, 0], positions[i, 1], positions[i, 2]
        face, u, v, w, squared = _follow(px, py, pz, surfaces, face, end)
        surfaces.seeds[s, i] = face
        a, b, c = surfaces.faces[face, 0], surfaces.faces[face, 1], surfaces.faces[face, 2]
        x0, y0, z0 = _weighted(surfaces.before, a, b, c, u, v, w)
        x1, y1, z1 = _weighted(surfaces.after, a, b, c, u, v, w)
        nx, ny, nz = _weighted(surfaces.normals_before, a, b, c, u, v, w)
        mx, my, mz = _weighted(surfaces.normals_after, a, b, c, u, v, w)
        nx, ny, nz = nx + end * (mx - nx), ny + end * (my - ny), nz + end * (mz - nz)
        scale = 1.0 / (np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-20)
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
        depth = (px - x0 - end * dx) * nx + (py - y0 - end * dy) * ny + (pz - z0 - end * dz) * nz
        margin = surfaces.margins[s, i]
        distance = np.sqrt(squared)
        if depth >= margin:
            speed = np.sqrt(velocities[i, 0] ** 2 + velocities[i, 1] ** 2 + velocities[i, 2] ** 2)
            speed += np.sqrt(dx * dx + dy * dy + dz * dz) / (step * _substeps(begin, end)) + _ALERT_SPEED
            wait[s, i] = min(int((distance - margin) / (speed * step)), _LONGEST_WAIT)
            continue
        if distance > margin and abs(depth) < (ACROSS_BODY if closed else ACROSS) * distance:
            continue
        if not closed:
            if depth < -DEEPEST_BENEATH_CLOTH:
                continue
            # The underside of a fold faces the wrong way: it would pull the cloth into the fold.
            if facing[i, 0] * nx + facing[i, 1] * ny + facing[i, 2] * nz < SAME_WAY:
                continue
        push = min(margin - depth, LARGEST_PUSH)
        part = end - begin
        _respond(positions, previous, i, push, friction, nx, ny, nz, part * dx, part * dy, part * dz)


@inlined
def _substeps(begin, end):  # type: ignore[no-untyped-def]
    return 1.0 / (end - begin)


@inlined
def _respond(positions, previous, i, push, friction, nx, ny, nz, sx, sy, sz):  # type: ignore[no-untyped-def]
    """Move vertex i out by `push` along the normal, without bounce; the surface moved by s."""
    x = positions[i, 0] + push * nx
    y = positions[i, 1] + push * ny
    z = positions[i, 2] + push * nz
    rx, ry, rz = x - previous[i, 0] - sx, y - previous[i, 1] - sy, z - previous[i, 2] - sz
    along = rx * nx + ry * ny + rz * nz
    tx, ty, tz = rx - along * nx, ry - along * ny, rz - along * nz
    slide = np.sqrt(tx * tx + ty * ty + tz * tz)
    if slide > 1e-12:
        share = min(1.0, friction * push / slide)
        x -= share * tx
        y -= share * ty
        z -= share * tz
    positions[i, 0], positions[i, 1], positions[i, 2] = x, y, z
    if along > 0.0:  # leaving the surface faster than it moves is a bounce
        previous[i, 0] += along * nx
        previous[i, 1] += along * ny
        previous[i, 2] += along * nz


@inlined
def _follow(px, py, pz, surfaces, face, end):  # type: ignore[no-untyped-def]
    """The face, weights and squared distance of the nearest point, walking over neighbouring faces."""
    u, v, w, squared = _closest(px, py, pz, surfaces, face, end)
    for _ in range(_MOST_STEPS):
        if u > 0.0 and v > 0.0 and w > 0.0:
            break  # the foot of the perpendicular lies inside: no neighbour is nearer
        corner = surfaces.faces[face, 0]
        if v >= u and v >= w:
            corner = surfaces.faces[face, 1]
        elif w >= u and w >= v:
            corner = surfaces.faces[face, 2]
        best = face
        for slot in range(surfaces.first[corner], surfaces.first[corner + 1]):
            other = surfaces.incident[slot]
            if other == face:
                continue
            ou, ov, ow, far = _closest(px, py, pz, surfaces, other, end)
            if far < squared:
                best, u, v, w, squared = other, ou, ov, ow, far
        if best == face:
            break
        face = best
    return face, u, v, w, squared


@inlined
def _weighted(values, a, b, c, u, v, w):  # type: ignore[no-untyped-def]
    return (
        u * values[a, 0] + v * values[b, 0] + w * values[c, 0],
        u * values[a, 1] + v * values[b, 1] + w * values[c, 1],
        u * values[a, 2] + v * values[b, 2] + w * values[c, 2],
    )


@inlined
def _corner(surfaces, vertex, end):  # type: ignore[no-untyped-def]
    x, y, z = surfaces.before[vertex, 0], surfaces.before[vertex, 1], surfaces.before[vertex, 2]
    return (
        x + end * (surfaces.after[vertex, 0] - x),
        y + end * (surfaces.after[vertex, 1] - y),
        z + end * (surfaces.after[vertex, 2] - z),
    )


@inlined
def _closest(px, py, pz, surfaces, face, end):  # type: ignore[no-untyped-def]
    """Weights of the point of a triangle nearest to p, and the squared distance (Ericson 2005, 5.1.5)."""
    ax, ay, az = _corner(surfaces, surfaces.faces[face, 0], end)
    bx, by, bz = _corner(surfaces, surfaces.faces[face, 1], end)
    cx, cy, cz = _corner(surfaces, surfaces.faces[face, 2], end)
    abx, aby, abz = bx - ax, by - ay, bz - az
    acx, acy, acz = cx - ax, cy - ay, cz - az
    d1 = abx * (px - ax) + aby * (py - ay) + abz * (pz - az)
    d2 = acx * (px - ax) + acy * (py - ay) + acz * (pz - az)
    d3 = abx * (px - bx) + aby * (py - by) + abz * (pz - bz)
    d4 = acx * (px - bx) + acy * (py - by) + acz * (pz - bz)
    d5 = abx * (px - cx) + aby * (py - cy) + abz * (pz - cz)
    d6 = acx * (px - cx) + acy * (py - cy) + acz * (pz - cz)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = d1 / (d1 - d3 + 1e-30), 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, d2 / (d2 - d6 + 1e-30)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6) + 1e-30)
        v = 1.0 - w
    else:
        scale = 1.0 / (va + vb + vc + 1e-30)
        v, w = vb * scale, vc * scale
    u = 1.0 - v - w
    x = px - ax - v * abx - w * acx
    y = py - ay - v * aby - w * acy
    z = pz - az - v * abz - w * acz
    return u, v, w, x * x + y * y + z * z
