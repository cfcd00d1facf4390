"""The matrices of riding texels in one pass; `riding.ridden` is the plain version."""

from __future__ import annotations

import numpy as np

from stages.shared.cloth.compiling import inlined, kernel


@kernel
def texel_matrices(  # type: ignore[no-untyped-def]
    vertices, faces, texel_faces, texel_weights, texel_offsets, from_rest, canonical, matrices
):
    """Write posed_from_canonical of every texel into matrices (N, 3, 4).

    Arguments:
        vertices: (V, 3) f32 m, the mesh now. faces: (F, 3).
        texel_faces, texel_weights, texel_offsets: as in `Riding`.
        from_rest: (N, 3, 3) from canonical directions to the texel's frame at rest.
        canonical: (N, 3) m where the texels are in the canonical pose.
    """
    normals = np.zeros((len(vertices), 3))
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = _difference(vertices, b, a)
        vx, vy, vz = _difference(vertices, c, a)
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for corner in range(3):
            i = faces[f, corner]
            normals[i, 0] += nx
            normals[i, 1] += ny
            normals[i, 2] += nz
    for i in range(len(vertices)):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        scale = 1.0 / (np.sqrt(x * x + y * y + z * z) + 1e-20)
        normals[i, 0], normals[i, 1], normals[i, 2] = x * scale, y * scale, z * scale
    frame = np.empty((3, 3))
    for n in range(len(texel_faces)):
        f = texel_faces[n]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        u, v, w = texel_weights[n, 0], texel_weights[n, 1], texel_weights[n, 2]
        ex, ey, ez = _difference(vertices, b, a)
        nx = u * normals[a, 0] + v * normals[b, 0] + w * normals[c, 0]
        ny = u * normals[a, 1] + v * normals[b, 1] + w * normals[c, 1]
        nz = u * normals[a, 2] + v * normals[b, 2] + w * normals[c, 2]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length < 0.1:
            vx, vy, vz = _difference(vertices, c, a)
            nx, ny, nz = ey * vz - ez * vy, ez * vx - ex * vz, ex * vy - ey * vx
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
        scale = 1.0 / (length + 1e-20)
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        along = ex * nx + ey * ny + ez * nz
        ex, ey, ez = ex - along * nx, ey - along * ny, ez - along * nz
        scale = 1.0 / (np.sqrt(ex * ex + ey * ey + ez * ez) + 1e-20)
        ex, ey, ez = ex * scale, ey * scale, ez * scale
        frame[0, 0], frame[1, 0], frame[2, 0] = ex, ey, ez
        frame[0, 1], frame[1, 1], frame[2, 1] = ny * ez - nz * ey, nz * ex - nx * ez, nx * ey - ny * ex
        frame[0, 2], frame[1, 2], frame[2, 2] = nx, ny, nz
        for i in range(3):
            place = u * vertices[a, i] + v * vertices[b, i] + w * vertices[c, i]
            for j in range(3):
                place += frame[i, j] * texel_offsets[n, j]
                value = 0.0
                for k in range(3):
                    value += frame[i, k] * from_rest[n, k, j]
                matrices[n, i, j] = value
                place -= value * canonical[n, j]
            matrices[n, i, 3] = place


@inlined
def _difference(vertices, end, start):  # type: ignore[no-untyped-def]
    return (
        np.float64(vertices[end, 0]) - vertices[start, 0],
        np.float64(vertices[end, 1]) - vertices[start, 1],
        np.float64(vertices[end, 2]) - vertices[start, 2],
    )
