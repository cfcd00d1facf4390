// Plays a motion of skinned Gaussians: the page blends bones and offsets for every frame itself.
"use strict";

/** What stages/render/clip.py wrote, ready to be posed: `pose(frame)` fills one frame's texels. */
class Clip {
  constructor(buffer) {
    const { info, take } = openPacked(buffer, 0x43575347);
    const n = info.count;
    this.frames = info.frames;
    this.rate = info.rate;
    this.info = info;
    this.places = take(Uint16Array, 3 * n);
    const halves = take(Uint16Array, 6 * n);
    this.tints = take(Uint32Array, n);
    this.joints = take(Uint8Array, 4 * n);
    this.weights = take(Uint8Array, 4 * n);
    this.bones = take(Float32Array, info.frames * info.joints * 12);
    this.offsets = take(Int8Array, info.keys.length * 3 * n);
    this.covariances = Float32Array.from(halves, fromHalf);
    this.rest = new Float32Array(3 * n);
    for (let axis = 0; axis < 3; axis++) {
      const [low, high] = info.places[axis], step = (high - low) / 65535;
      for (let i = 0; i < n; i++) this.rest[3 * i + axis] = low + step * this.places[3 * i + axis];
    }
    this.units = new Float32Array(n);
    for (const layer of info.layers) this.units.fill(layer.offset_unit, layer.start, layer.start + layer.count);
    this.gaussians = { count: n, layers: info.layers, unit: info.unit, ...newTexels(n) };
    for (let i = 0; i < n; i++) this.gaussians.texels[8 * i + 3] = this.tints[i];
  }

  /** The Gaussians of a frame: mean = A (rest + offset) + b, covariance = A S Aᵀ. */
  pose(frame) {
    const { count: n, texels, floats } = this.gaussians, keys = this.info.keys;
    const { rest, units, joints, weights, bones, offsets, covariances } = this;
    let key = 0;
    while (key + 1 < keys.length - 1 && keys[key + 1] <= frame) key++;
    const next = Math.min(key + 1, keys.length - 1), span = keys[next] - keys[key];
    const share = span ? Math.min(1, Math.max(0, (frame - keys[key]) / span)) : 0;
    const first = 3 * n * key, second = 3 * n * next, bone0 = frame * this.info.joints * 12;
    const m = new Float32Array(12);
    for (let i = 0; i < n; i++) {
      m.fill(0);
      for (let k = 4 * i; k < 4 * i + 4; k++) {
        const weight = weights[k] / 255;
        if (!weight) continue;
        const bone = bone0 + 12 * joints[k];
        for (let e = 0; e < 12; e++) m[e] += weight * bones[bone + e];
      }
      const at = 3 * i, before = units[i] * (1 - share), after = units[i] * share;
      const x = rest[at] + before * offsets[first + at] + after * offsets[second + at];
      const y = rest[at + 1] + before * offsets[first + at + 1] + after * offsets[second + at + 1];
      const z = rest[at + 2] + before * offsets[first + at + 2] + after * offsets[second + at + 2];
      const to = 8 * i, c = 6 * i;
      floats[to] = m[0] * x + m[1] * y + m[2] * z + m[3];
      floats[to + 1] = m[4] * x + m[5] * y + m[6] * z + m[7];
      floats[to + 2] = m[8] * x + m[9] * y + m[10] * z + m[11];
      const xx = covariances[c], xy = covariances[c + 1], xz = covariances[c + 2];
      const yy = covariances[c + 3], yz = covariances[c + 4], zz = covariances[c + 5];
      const ax = m[0] * xx + m[1] * xy + m[2] * xz, ay = m[0] * xy + m[1] * yy + m[2] * yz, az = m[0] * xz + m[1] * yz + m[2] * zz;
      const bx = m[4] * xx + m[5] * xy + m[6] * xz, by = m[4] * xy + m[5] * yy + m[6] * yz, bz = m[4] * xz + m[5] * yz + m[6] * zz;
      const cx = m[8] * xx + m[9] * xy + m[10] * xz, cy = m[8] * xy + m[9] * yy + m[10] * yz, cz = m[8] * xz + m[9] * yz + m[10] * zz;
      texels[to + 4] = toHalf(ax * m[0] + ay * m[1] + az * m[2]) | (toHalf(ax * m[4] + ay * m[5] + az * m[6]) << 16);
      texels[to + 5] = toHalf(ax * m[8] + ay * m[9] + az * m[10]) | (toHalf(bx * m[4] + by * m[5] + bz * m[6]) << 16);
      texels[to + 6] = toHalf(bx * m[8] + by * m[9] + bz * m[10]) | (toHalf(cx * m[8] + cy * m[9] + cz * m[10]) << 16);
    }
    return this.gaussians;
  }
}

const oneFloat = new Float32Array(1), itsBits = new Uint32Array(oneFloat.buffer);

/** Bits of the half float nearest to a number; what is too small becomes 0. */
function toHalf(value) {
  oneFloat[0] = value;
  const bits = itsBits[0] + 0x1000, sign = (bits >>> 16) & 0x8000, exponent = ((bits >>> 23) & 255) - 112;
  if (exponent <= 0) return sign;
  return exponent > 30 ? sign | 0x7bff : sign | (exponent << 10) | ((bits >>> 13) & 0x3ff);
}

function fromHalf(bits) {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >>> 10) & 31, rest = bits & 0x3ff;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + rest / 1024) : 2 ** -24 * rest);
}
