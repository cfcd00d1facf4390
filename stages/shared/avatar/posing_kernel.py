"""The compiled loop of `posing.py`: one texel after the other, from its numbers to a posed Gaussian."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from stages.shared.splat.kernels.memory import next_item

# mypy: ignore-errors
# (compiled and type-checked by numba)

BLOCK = 256
"""Texels that a thread takes at a time; bases are stored by such blocks."""

_inlined = njit(error_model="numpy", inline="always")
_ONE = np.float32(1.0)


@_inlined
def _sigmoid(value):
    return _ONE / (_ONE + math.exp(-value))


@_inlined
def _normalise(quaternion):
    """As `unit_quaternions`: (nearly) zero becomes the identity."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    squared = w * w + x * x + y * y + z * z
    if squared > np.float32(1e-12):
        scale = _ONE / math.sqrt(squared)
        quaternion[0], quaternion[1], quaternion[2], quaternion[3] = (
            w * scale,
            x * scale,
            y * scale,
            z * scale,
        )
    else:
        quaternion[0], quaternion[1], quaternion[2], quaternion[3] = _ONE, 0.0, 0.0, 0.0


@_inlined
def _turn_towards(start, end, share):
    """As `slerp` of the swap: along the shorter arc, in place."""
    cosine = start[0] * end[0] + start[1] * end[1] + start[2] * end[2] + start[3] * end[3]
    sign = -_ONE if cosine < 0 else _ONE
    angle = math.acos(min(abs(cosine), _ONE))
    sine = math.sin(angle)
    if sine < np.float32(1e-4):
        first, second = _ONE - share, share
    else:
        first, second = math.sin((_ONE - share) * angle) / sine, math.sin(share * angle) / sine
    for k in range(4):
        start[k] = first * start[k] + sign * second * end[k]
    _normalise(start)


@_inlined
def _shape(quaternion, scales, matrix, spread):
    """matrix (3, 4)'s linear part times rotation times scales -> spread (3, 3)."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    two = np.float32(2.0)
    r00, r01, r02 = _ONE - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)
    r10, r11, r12 = two * (x * y + w * z), _ONE - two * (x * x + z * z), two * (y * z - w * x)
    r20, r21, r22 = two * (x * z - w * y), two * (y * z + w * x), _ONE - two * (x * x + y * y)
    for i in range(3):
        a, b, c = matrix[i, 0], matrix[i, 1], matrix[i, 2]
        spread[i, 0] = (a * r00 + b * r10 + c * r20) * scales[0]
        spread[i, 1] = (a * r01 + b * r11 + c * r21) * scales[1]
        spread[i, 2] = (a * r02 + b * r12 + c * r22) * scales[2]


@_inlined
def _add_bases(bases, block, coefficients, first, channels, residual):
    """residual (14, BLOCK) += Σ_k c_k basis_k, for the channels of a group."""
    for k in range(bases.shape[1]):
        coefficient = coefficients[first + k]
        for place in range(bases.shape[2]):
            channel = channels[place]
            for i in range(BLOCK):
                residual[channel, i] += coefficient * bases[block, k, place, i]
    return first + bases.shape[1]


@_inlined
def _carry(
    n, point, quaternion, scales, first, bones, weights, matrices, matrix, spread, means, covariances
):  # fmt: skip
    """Skin one Gaussian: its centre and its covariance."""
    matrix[:] = 0.0
    for entry in range(first[n], first[n + 1]):
        bone, weight = bones[entry], weights[entry]
        for row in range(3):
            for column in range(4):
                matrix[row, column] += weight * matrices[bone, row, column]
    x, y, z = point[0], point[1], point[2]
    for row in range(3):
        means[n, row] = matrix[row, 0] * x + matrix[row, 1] * y + matrix[row, 2] * z + matrix[row, 3]
    _shape(quaternion, scales, matrix, spread)
    for row in range(3):
        for column in range(row, 3):
            value = np.float32(0.0)
            for k in range(3):
                value += spread[row, k] * spread[column, k]
            covariances[n, row, column] = value
            covariances[n, column, row] = value


@njit(nogil=True, cache=True, error_model="numpy")
def carry_texels(
    counter, points, quaternions, scales, first, bones, weights, matrices, means, covariances
):  # fmt: skip
    """What is left of `pose_texels` for a layer that no pose changes: skinning."""
    count = points.shape[0]
    matrix, spread = np.empty((3, 4), np.float32), np.empty((3, 3), np.float32)
    while True:
        start = next_item(counter) * BLOCK
        if start >= count:
            return
        for n in range(start, min(start + BLOCK, count)):
            _carry(
                n, points[n], quaternions[n], scales[n], first, bones, weights, matrices, matrix, spread,
                means, covariances,
            )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy")
def pose_texels(
    counter, given, coefficients, offset_bases, color_bases, form_bases, channels,
    base, limits, bounded, rest,
    first, bones, weights, matrices,
    swap_weights, swap_offsets, swap_quaternions, swap_looks, paints,
    means, covariances, opacities, colors, points, quaternions, kept_scales,
):  # fmt: skip
    """See `PosedLayer.pose`. given: residual (N, 14), to which coefficients times bases are added.

    limits: offset scale, least and greatest log scale; bounded: sigmoid colours; paints: whether a
    replacement has looks. points (N, 3), quaternions (N, 4), kept_scales (N, 3): what skinning began with,
    for `carry_texels`; not kept where they are empty.
    """
    count, keeping, point = rest.shape[0], points.shape[0] > 0, np.empty(3, np.float32)
    matrix, spread = np.empty((3, 4), np.float32), np.empty((3, 3), np.float32)
    offset, scales, quaternion = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(4, np.float32)
    residual = np.empty((14, BLOCK), np.float32)
    while True:
        block = next_item(counter)
        start = block * BLOCK
        if start >= count:
            return
        stop = min(start + BLOCK, count)
        for i in range(stop - start):
            for k in range(14):
                residual[k, i] = given[start + i, k]
        done = _add_bases(offset_bases, block, coefficients, 0, channels[0:3], residual)
        done = _add_bases(color_bases, block, coefficients, done, channels[3:6], residual)
        _add_bases(form_bases, block, coefficients, done, channels[6:14], residual)
        for i in range(stop - start):
            n = start + i
            for k in range(3):
                offset[k] = base[n, k] + limits[0] * residual[k, i]
                scales[k] = math.exp(min(max(base[n, 8 + k] + residual[8 + k, i], limits[1]), limits[2]))
                color = base[n, 11 + k] + residual[11 + k, i]
                colors[n, k] = _sigmoid(color) if bounded else color
            opacities[n] = _sigmoid(base[n, 7] + residual[7, i])
            for k in range(4):
                quaternion[k] = base[n, 3 + k] + residual[3 + k, i]
            _normalise(quaternion)
            for r in range(swap_weights.shape[0]):
                share = swap_weights[r, n]
                if share > 0:
                    for k in range(3):
                        offset[k] += share * (swap_offsets[r, n, k] - offset[k])
                        if paints[r]:
                            colors[n, k] += share * (swap_looks[r, n, k] - colors[n, k])
                            scales[k] += share * (swap_looks[r, n, 3 + k] - scales[k])
                    if paints[r]:
                        opacities[n] += share * (swap_looks[r, n, 6] - opacities[n])
                    _turn_towards(quaternion, swap_quaternions[r, n], share)
            for k in range(3):
                point[k] = rest[n, k] + offset[k]
                if keeping:
                    points[n, k], kept_scales[n, k] = point[k], scales[k]
            if keeping:
                quaternions[n, :] = quaternion
            _carry(
                n,
                point,
                quaternion,
                scales,
                first,
                bones,
                weights,
                matrices,
                matrix,
                spread,
                means,
                covariances,
            )
