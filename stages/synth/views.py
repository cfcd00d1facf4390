"""Pictures of a dressed person: ray casting with several rays per pixel, patterns evaluated at each hit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.shared.capture import Camera
from stages.shared.layers import NO_LABEL
from stages.shared.meshes import RayScene, vertex_normals
from stages.shared.pictures.srgb import srgb_from_linear
from stages.synth.dressed import Look
from stages.synth.textures import fabric_color

Doubles = NDArray[np.float64]
Image = NDArray[np.uint8]

# Towards the light, and its strength: a key light, a fill, a light from behind; the rest is sky.
LIGHTS = np.array(
    [[0.45, 0.65, 0.62, 0.62], [-0.80, 0.35, 0.48, 0.26], [-0.15, 0.45, -0.88, 0.42]], dtype=np.float64
)
SKY, GROUND = 0.42, 0.20
RADIUS = 3.3
LOOK_AT = np.array([0.0, 1.06, 0.0])
FOCAL = 1.28  # focal length over image size


@dataclass(frozen=True, eq=False)
class View:
    """One picture: image (H, W, 3) u8 sRGB on black, mask (H, W) u8 coverage, labels (H, W) u8 ids."""

    image: Image
    mask: Image
    labels: Image


def camera_ring(count: int, size: int) -> tuple[list[Camera], str]:
    """`count` training cameras around the person at two heights, and one held out; its name comes second."""
    cameras = []
    for index in range(count):
        height = 1.0 if index % 2 == 0 else 1.65
        cameras.append(_camera(f"cam{index + 1:02d}", 2 * np.pi * index / count, height, size))
    held_out = f"cam{count + 1:02d}"
    cameras.append(_camera(held_out, np.pi / count, 1.3, size))
    return cameras, held_out


def _camera(name: str, azimuth: float, height: float, size: int) -> Camera:
    centre = np.array([RADIUS * np.sin(azimuth), height, RADIUS * np.cos(azimuth)])
    forward = LOOK_AT - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ centre
    intrinsics = np.array([[FOCAL * size, 0, size / 2], [0, FOCAL * size, size / 2], [0, 0, 1.0]])
    return Camera(name, size, size, intrinsics, camera_from_world)


class Scene:
    """A dressed person in one frame, ready to be looked at from anywhere."""

    def __init__(self, look: Look, vertices: Doubles, ambient_rays: int, seed: int) -> None:
        self.look = look
        self.vertices = vertices
        self._rays = RayScene(vertices, look.faces)
        self.normals = vertex_normals(vertices, look.faces).astype(np.float64)
        self.openness = self._openness(ambient_rays, seed)

    def picture(self, camera: Camera, supersample: int) -> View:
        """What the camera sees; `supersample` rays per pixel along each side."""
        size = (camera.height, camera.width)
        image, mask = np.zeros((*size, 3), np.uint8), np.zeros(size, np.uint8)
        labels = np.full(size, NO_LABEL, np.uint8)
        pixels = camera.project(self.vertices)[0]
        left, top = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
        right, bottom = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 1, size[::-1])
        if right <= left or bottom <= top:
            return View(image, mask, labels)
        part = camera.crop((int(left), int(top), int(right), int(bottom)))
        light, alpha, ids = self._shade(part, supersample)
        window = (slice(top, bottom), slice(left, right))
        image[window] = np.round(255 * srgb_from_linear(light))
        mask[window] = np.round(255 * alpha)
        labels[window] = ids
        return View(image, mask, labels)

    def _shade(self, camera: Camera, supersample: int) -> tuple[Doubles, Doubles, Image]:
        """Premultiplied linear light (H, W, 3), coverage (H, W), label of the visible layer (H, W)."""
        fine = camera.scaled(supersample)
        origin, directions = fine.rays()
        hits = self._rays.first_hits(origin, directions)
        light = np.zeros((camera.height, camera.width, 3))
        alpha = np.zeros((camera.height, camera.width))
        labels = np.full((camera.height, camera.width), NO_LABEL, np.uint8)
        look = self.look
        _shade_hits(
            hits.face, hits.barycentric, directions, look.faces,
            look.face_label, look.face_fabric, look.corner_uv, look.vertex_colors, look.fabrics,
            self.normals, self.openness, LIGHTS, supersample, light, alpha, labels,
        )  # fmt: skip
        return light, alpha, labels

    def _openness(self, rays_per_vertex: int, seed: int) -> Doubles:
        """(V,) share of the light from above and around that reaches each vertex (1 without rays)."""
        if rays_per_vertex <= 0:
            return np.ones(len(self.vertices))
        directions = _sphere(rays_per_vertex, seed)
        strength = 0.55 + 0.45 * directions[:, 1]
        facing = np.maximum(self.normals @ directions.T, 0.0) * strength  # (V, R)
        vertex, ray = np.nonzero(facing > 0.02)
        starts = self.vertices[vertex] + 0.004 * self.normals[vertex]
        blocked = self._rays.first_hits(starts, directions[ray]).hit
        weight = facing[vertex, ray]
        total = np.bincount(vertex, weight, len(self.vertices))
        unblocked = np.bincount(vertex, weight * ~blocked, len(self.vertices))
        return np.where(total > 0, unblocked / np.maximum(total, 1e-9), 1.0)


def _sphere(count: int, seed: int) -> Doubles:
    """(count, 3) even directions (a Fibonacci spiral, turned by the seed)."""
    index = np.arange(count) + 0.5
    y = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index + float(np.random.default_rng(seed).uniform(0, 2 * np.pi))
    radius = np.sqrt(1 - y * y)
    return np.stack([radius * np.cos(angle), y, radius * np.sin(angle)], axis=-1)


@njit(cache=True, nogil=True)
def _shade_hits(  # type: ignore[no-untyped-def]
    face_ids,
    barycentric,
    directions,
    faces,
    face_label,
    face_fabric,
    corner_uv,
    vertex_colors,
    fabrics,
    normals,
    openness,
    lights,
    supersample,
    light,
    alpha,
    labels,
):
    """Average the rays of each pixel; label by majority, none where less than half is covered."""
    rays_per_pixel = supersample * supersample
    albedo, normal, votes = np.zeros(3), np.zeros(3), np.zeros(256, np.int64)
    for row in range(light.shape[0]):
        for column in range(light.shape[1]):
            covered = 0
            votes[:8] = 0
            for sub in range(rays_per_pixel):
                y = row * supersample + sub // supersample
                x = column * supersample + sub % supersample
                face = face_ids[y, x]
                if face < 0:
                    continue
                covered += 1
                votes[face_label[face]] += 1
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                wa, wb, wc = barycentric[y, x, 0], barycentric[y, x, 1], barycentric[y, x, 2]
                facing, size = 0.0, 1e-20
                for k in range(3):
                    normal[k] = wa * normals[a, k] + wb * normals[b, k] + wc * normals[c, k]
                    facing += normal[k] * directions[y, x, k]
                    size += normal[k] * normal[k]
                side = -1.0 if facing > 0.0 else 1.0  # cloth is seen from both sides
                size = side / np.sqrt(size)
                for k in range(3):
                    normal[k] *= size
                if face_fabric[face] == 0:
                    for k in range(3):
                        albedo[k] = (
                            wa * vertex_colors[a, k] + wb * vertex_colors[b, k] + wc * vertex_colors[c, k]
                        )
                else:
                    u = wa * corner_uv[face, 0, 0] + wb * corner_uv[face, 1, 0] + wc * corner_uv[face, 2, 0]
                    v = wa * corner_uv[face, 0, 1] + wb * corner_uv[face, 1, 1] + wc * corner_uv[face, 2, 1]
                    fabric_color(fabrics[face_fabric[face]], u, v, albedo)
                open_share = wa * openness[a] + wb * openness[b] + wc * openness[c]
                strength = (GROUND + (SKY - GROUND) * 0.5 * (1.0 + normal[1])) * open_share
                for one in range(lights.shape[0]):
                    cosine = (
                        normal[0] * lights[one, 0] + normal[1] * lights[one, 1] + normal[2] * lights[one, 2]
                    )
                    strength += max(cosine, 0.0) * lights[one, 3] * (0.35 + 0.65 * open_share)
                if side < 0.0:
                    strength *= 0.6  # the inside of a garment lies in its own shadow
                for k in range(3):
                    light[row, column, k] += albedo[k] * strength
            if covered > 0:
                alpha[row, column] = covered / rays_per_pixel
                for k in range(3):
                    light[row, column, k] /= rays_per_pixel
                if 2 * covered >= rays_per_pixel:
                    winner = 0
                    for candidate in range(1, 8):
                        if votes[candidate] > votes[winner]:
                            winner = candidate
                    labels[row, column] = winner
