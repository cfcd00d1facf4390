// Draws 3D Gaussians with WebGL 2, as the CPU renderer of gw does: the same projection, blur and cut-offs,
// blended front to back in half floats. No library, and no request to another server.
"use strict";

const BLUR = 0.3; // px², added to both axes of every projected Gaussian
const ALPHA_MIN = 1 / 255; // below this a Gaussian is left out of a pixel
const ALPHA_MAX = 0.999;
const NEAR = 0.01; // m
const TEXTURE_WIDTH = 2048; // texels; two of them hold a Gaussian: place and tint, then covariance in halves
const DEPTH_BINS = 65536;

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
uniform highp usampler2D gaussians;
uniform mat4 cameraFromWorld;
uniform vec4 intrinsics; // fx, fy, cx, cy in px
uniform vec2 size;       // px
uniform float unit;      // m² of one in a covariance
uniform highp usampler2D order; // numbers of the Gaussians, nearest first
flat out vec4 tint;
flat out vec3 conic;
out vec2 offset;
const vec2 CORNERS[6] = vec2[6](vec2(-1, -1), vec2(1, -1), vec2(-1, 1), vec2(-1, 1), vec2(1, -1), vec2(1, 1));

void main() {
  gl_Position = vec4(0, 0, 2, 1); // outside, unless everything below is fine
  int turn = gl_VertexID / 6; // two triangles a Gaussian: software renderers are slow at small instances
  int at = 2 * int(texelFetch(order, ivec2(turn % ${TEXTURE_WIDTH}, turn / ${TEXTURE_WIDTH}), 0).r);
  ivec2 place = ivec2(at % ${TEXTURE_WIDTH}, at / ${TEXTURE_WIDTH});
  uvec4 first = texelFetch(gaussians, place, 0);
  uvec4 halves = texelFetch(gaussians, place + ivec2(1, 0), 0);
  vec2 a = unit * unpackHalf2x16(halves.x), b = unit * unpackHalf2x16(halves.y), c = unit * unpackHalf2x16(halves.z);

  vec3 point = (cameraFromWorld * vec4(uintBitsToFloat(first.xyz), 1)).xyz;
  if (point.z < ${NEAR}) return;
  vec2 focal = intrinsics.xy, centre = intrinsics.zw;
  vec2 margin = 0.15 * size / focal;
  vec2 slope = clamp(point.xy / point.z, -centre / focal - margin, (size - centre) / focal + margin);
  mat3 covariance = mat3(a.x, a.y, b.x, a.y, b.y, c.x, b.x, c.x, c.y);
  mat3 rotation = mat3(cameraFromWorld);
  vec3 rowX = vec3(focal.x / point.z, 0, -focal.x * slope.x / point.z) * rotation;
  vec3 rowY = vec3(0, focal.y / point.z, -focal.y * slope.y / point.z) * rotation;
  float xx = dot(rowX, covariance * rowX) + ${BLUR};
  float xy = dot(rowX, covariance * rowY);
  float yy = dot(rowY, covariance * rowY) + ${BLUR};
  float determinant = xx * yy - xy * xy;
  if (determinant <= 0.0) return;
  conic = vec3(yy, -xy, xx) / determinant;

  tint = vec4(first.w & 255u, (first.w >> 8) & 255u, (first.w >> 16) & 255u, first.w >> 24) / 255.0;
  float reach = 2.0 * log(tint.a * 255.0); // squared distance at which alpha falls to 1/255
  if (reach <= 0.0) return;
  float middle = 0.5 * (xx + yy), spread = length(vec2(0.5 * (xx - yy), xy));
  vec2 axis = abs(xy) > 1e-9 ? normalize(vec2(xy, middle + spread - xx)) : xx >= yy ? vec2(1, 0) : vec2(0, 1);
  vec2 corner = CORNERS[gl_VertexID % 6];
  offset = axis * sqrt((middle + spread) * reach) * corner.x
    + vec2(-axis.y, axis.x) * sqrt(max(middle - spread, 0.0) * reach) * corner.y;
  vec2 pixel = focal * point.xy / point.z + centre + offset;
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0, 1);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
flat in vec4 tint;
flat in vec3 conic;
in vec2 offset;
out vec4 color;
void main() {
  float falloff = exp(-0.5 * (conic.x * offset.x * offset.x + conic.z * offset.y * offset.y) - conic.y * offset.x * offset.y);
  float alpha = min(${ALPHA_MAX}, tint.a * falloff);
  if (alpha < ${ALPHA_MIN}) discard;
  color = vec4(tint.rgb * alpha, alpha);
}`;

const SHOW_VERTEX = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`;

const SHOW_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D picture;
uniform vec4 background;
out vec4 color;
void main() {
  vec4 seen = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
  color = seen + (1.0 - seen.a) * vec4(background.rgb * background.a, background.a);
}`;

/** JSON text and columns of what stages/shared/web/pack.py wrote: {info, take(kind, count)}. */
function openPacked(buffer, magic) {
  const view = new DataView(buffer);
  if (view.getUint32(0, true) !== magic) throw new Error("these are no packed Gaussians");
  const length = view.getUint32(4, true);
  const info = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  let at = 8 + length + ((4 - (length % 4)) % 4);
  const take = (kind, count) => {
    const array = new kind(buffer, at, count);
    at += Math.ceil((count * kind.BYTES_PER_ELEMENT) / 4) * 4;
    return array;
  };
  return { info, take };
}

/** Room for n Gaussians in a texture: {texels, floats}, two views of the same memory. */
function newTexels(n) {
  const texels = new Uint32Array(Math.max(1, Math.ceil((2 * n) / TEXTURE_WIDTH)) * TEXTURE_WIDTH * 4);
  return { texels, floats: new Float32Array(texels.buffer) };
}

/** The Gaussians of one frame as texels of a texture: {count, layers, unit, texels, floats, middle, info}. */
function unpackGaussians(buffer) {
  const { info, take } = openPacked(buffer, 0x32575347);
  const n = info.count, { texels, floats } = newTexels(n);
  const places = take(Uint16Array, 3 * n), covariances = take(Uint16Array, 6 * n), tints = take(Uint32Array, n);
  const middle = [0, 0, 0];
  for (let axis = 0; axis < 3; axis++) {
    const [low, high] = info.places[axis], step = (high - low) / 65535;
    let total = 0;
    for (let i = 0; i < n; i++) total += floats[8 * i + axis] = low + step * places[3 * i + axis];
    middle[axis] = total / Math.max(1, n);
  }
  const pairs = new Uint32Array(covariances.buffer, covariances.byteOffset, 3 * n);
  for (let i = 0; i < n; i++) {
    texels[8 * i + 3] = tints[i];
    texels[8 * i + 4] = pairs[3 * i];
    texels[8 * i + 5] = pairs[3 * i + 1];
    texels[8 * i + 6] = pairs[3 * i + 2];
  }
  return { count: n, layers: info.layers, unit: info.unit, texels, floats, middle, info };
}

/** Indices of the visible Gaussians, nearest first, by counting. hidden: names of layers that are off. */
function sortGaussians({ floats, layers, count }, view, hidden) {
  const depths = new Float32Array(count), shown = new Uint32Array(count);
  let drawn = 0, low = Infinity, high = -Infinity;
  for (const layer of layers) {
    if (hidden.has(layer.name)) continue;
    for (let i = layer.start; i < layer.start + layer.count; i++) {
      const depth = view[8] * floats[8 * i] + view[9] * floats[8 * i + 1] + view[10] * floats[8 * i + 2] + view[11];
      if (depth < NEAR) continue;
      depths[drawn] = depth;
      shown[drawn++] = i;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
    }
  }
  const scale = high > low ? (DEPTH_BINS - 1) / (high - low) : 0;
  const starts = new Uint32Array(DEPTH_BINS + 1), bins = new Uint16Array(drawn);
  for (let k = 0; k < drawn; k++) {
    bins[k] = (depths[k] - low) * scale;
    starts[bins[k] + 1]++;
  }
  for (let bin = 0; bin < DEPTH_BINS; bin++) starts[bin + 1] += starts[bin];
  const sorted = new Uint32Array(drawn);
  for (let k = 0; k < drawn; k++) sorted[starts[bins[k]]++] = shown[k];
  return sorted;
}

/** Box around the Gaussians without the outermost hundredth: {low, high}. */
function boxOf({ floats, count }) {
  const box = { low: [0, 0, 0], high: [0, 0, 0] };
  for (let axis = 0; axis < 3; axis++) {
    const values = new Float32Array(count);
    for (let i = 0; i < count; i++) values[i] = floats[8 * i + axis];
    values.sort();
    box.low[axis] = values[Math.floor(0.002 * count)] || 0;
    box.high[axis] = values[Math.ceil(0.998 * (count - 1))] || 0;
  }
  return box;
}

/** A canvas that shows Gaussians; cameras are as in gw (x right, y down, z forward). */
class SplatCanvas {
  constructor(canvas) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { alpha: true, premultipliedAlpha: true, antialias: false,
      preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    this.gl = gl;
    this.halfFloat = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    this.background = [1, 1, 1, 1];
    this.hidden = new Set();
    this.gaussians = null;
    this.splats = this._program(SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.show = this._program(SHOW_VERTEX, SHOW_FRAGMENT);
    this.texture = gl.createTexture();
    this.target = gl.createTexture();
    this.framebuffer = gl.createFramebuffer();
    this.order = gl.createTexture();
    this.orderRows = 0;
  }

  /** Take the Gaussians of another frame or outfit. order: their indices when someone else sorts them. */
  set(gaussians, order) {
    const gl = this.gl, rows = gaussians.texels.length / (4 * TEXTURE_WIDTH);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    if (this.rows === rows)
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, gaussians.texels);
    else {
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, TEXTURE_WIDTH, rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, gaussians.texels);
      this._nearest();
      this.rows = rows;
    }
    this.gaussians = gaussians;
    this.setOrder(order);
  }

  /** Take another order of the same Gaussians; without one they are sorted when they are drawn. */
  setOrder(order) {
    this.sorted = order;
    if (order) this._upload(order);
  }

  /** Draw. camera: {width, height, intrinsics: [fx, fy, cx, cy], cameraFromWorld: 16 numbers, row by row}. */
  draw(camera) {
    const gl = this.gl;
    this._resize(camera.width, camera.height);
    if (this.gaussians && !this.sorted) this._upload(sortGaussians(this.gaussians, camera.cameraFromWorld, this.hidden));
    const drawn = this.gaussians ? this.drawn : 0;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.viewport(0, 0, camera.width, camera.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.splats);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE); // front to back
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.activeTexture(gl.TEXTURE0);
    gl.uniform1i(gl.getUniformLocation(this.splats, "order"), 1);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.splats, "cameraFromWorld"), true, camera.cameraFromWorld);
    gl.uniform4fv(gl.getUniformLocation(this.splats, "intrinsics"), camera.intrinsics);
    gl.uniform2f(gl.getUniformLocation(this.splats, "size"), camera.width, camera.height);
    gl.uniform1f(gl.getUniformLocation(this.splats, "unit"), this.gaussians ? this.gaussians.unit : 1);
    if (drawn) gl.drawArrays(gl.TRIANGLES, 0, 6 * drawn);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(this.show);
    gl.bindTexture(gl.TEXTURE_2D, this.target);
    gl.uniform4fv(gl.getUniformLocation(this.show, "background"), this.background);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  _upload(order) {
    const gl = this.gl, count = order.length, full = Math.floor(count / TEXTURE_WIDTH), rest = count % TEXTURE_WIDTH;
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    if (this.orderRows < full + 1) {
      this.orderRows = full + 1;
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32UI, TEXTURE_WIDTH, full + 1, 0, gl.RED_INTEGER, gl.UNSIGNED_INT, null);
      this._nearest();
    }
    const write = (row, width, height, part) =>
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, height, gl.RED_INTEGER, gl.UNSIGNED_INT, part);
    if (full) write(0, TEXTURE_WIDTH, full, order.subarray(0, full * TEXTURE_WIDTH));
    if (rest) write(full, rest, 1, order.subarray(full * TEXTURE_WIDTH));
    this.drawn = count;
  }

  _resize(width, height) {
    const gl = this.gl;
    if (this.width === width && this.height === height) return;
    [this.width, this.height, this.canvas.width, this.canvas.height] = [width, height, width, height];
    gl.bindTexture(gl.TEXTURE_2D, this.target);
    if (this.halfFloat) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    this._nearest();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.target, 0);
  }

  _nearest() {
    const gl = this.gl;
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  }

  _program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }
}

/** A camera on a sphere around a point: drag turns, shift-drag or two fingers move, wheel and pinch come nearer. */
class OrbitCamera {
  constructor(start, changed) {
    this.changed = changed;
    this.home = { target: [...start.target], azimuth: start.azimuth, tilt: start.tilt, distance: start.distance,
      fieldOfView: start.fieldOfView };
    this.reset();
  }

  reset() {
    Object.assign(this, this.home, { target: [...this.home.target] });
    this.changed();
  }

  /** fieldOfView (degrees) is that of the longer side. */
  camera(width, height) {
    const away = [Math.cos(this.tilt) * Math.sin(this.azimuth), Math.sin(this.tilt), Math.cos(this.tilt) * Math.cos(this.azimuth)];
    const forward = away.map((value) => -value);
    const right = [Math.cos(this.azimuth), 0, -Math.sin(this.azimuth)];
    const down = [forward[1] * right[2] - forward[2] * right[1], forward[2] * right[0] - forward[0] * right[2],
      forward[0] * right[1] - forward[1] * right[0]];
    const eye = this.target.map((value, axis) => value + this.distance * away[axis]);
    const rows = [right, down, forward].flatMap((row) => [...row, -(row[0] * eye[0] + row[1] * eye[1] + row[2] * eye[2])]);
    const focal = (0.5 * Math.max(width, height)) / Math.tan((this.fieldOfView * Math.PI) / 360);
    return { width, height, intrinsics: [focal, focal, width / 2, height / 2], cameraFromWorld: [...rows, 0, 0, 0, 1] };
  }

  /** Stand so that a box {low, high} fits into `free` (width, height in px) of a picture of this size. */
  fit(box, free, width, height) {
    const focal = (0.5 * Math.max(width, height)) / Math.tan((this.fieldOfView * Math.PI) / 360);
    const half = box.high.map((high, axis) => (high - box.low[axis]) / 2);
    const across = Math.abs(half[0] * Math.cos(this.azimuth)) + Math.abs(half[2] * Math.sin(this.azimuth));
    const along = Math.abs(half[2] * Math.cos(this.azimuth)) + Math.abs(half[0] * Math.sin(this.azimuth));
    this.target = box.high.map((high, axis) => (high + box.low[axis]) / 2);
    this.distance = along + focal * Math.max(half[1] / (0.45 * free.height), across / (0.45 * free.width));
    Object.assign(this.home, { target: [...this.target], distance: this.distance });
    this.changed();
  }

  turn(dx, dy) {
    this.azimuth -= 0.008 * dx;
    this.tilt = Math.min(1.5, Math.max(-1.5, this.tilt + 0.008 * dy));
    this.changed();
  }

  move(dx, dy, height) {
    const view = this.camera(height, height).cameraFromWorld;
    const metres = (2 * this.distance * Math.tan((this.fieldOfView * Math.PI) / 360)) / height;
    for (let axis = 0; axis < 3; axis++) this.target[axis] -= metres * (dx * view[axis] + dy * view[4 + axis]);
    this.changed();
  }

  approach(factor) {
    this.distance = Math.min(50, Math.max(0.1, this.distance * factor));
    this.changed();
  }

  listen(element) {
    const fingers = new Map();
    element.style.touchAction = "none";
    const keys = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, -12], ArrowDown: [0, 12] };
    addEventListener("keydown", (event) => {
      if (event.target !== document.body && event.target !== element) return;
      if (keys[event.key] && event.shiftKey) this.move(...keys[event.key], element.clientHeight);
      else if (keys[event.key]) this.turn(...keys[event.key]);
      else if (event.key === "+" || event.key === "-") this.approach(event.key === "+" ? 0.9 : 1 / 0.9);
      else if (event.key === "Home") this.reset();
      else return;
      event.preventDefault();
    });
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    element.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
      if (fingers.size === 1 && !event.shiftKey && event.buttons !== 2) this.turn(dx, dy);
      else if (fingers.size < 2) this.move(dx, dy, element.clientHeight);
      else {
        const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
        const apart = (place) => Math.hypot(place[0] - other[0], place[1] - other[1]);
        this.approach(apart(before) / Math.max(1, apart([event.clientX, event.clientY])));
        this.move(dx / 2, dy / 2, element.clientHeight);
      }
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const name of ["pointerup", "pointercancel"])
      element.addEventListener(name, (event) => fingers.delete(event.pointerId));
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener("dblclick", () => this.reset());
    element.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.approach(Math.exp(0.001 * event.deltaY));
    }, { passive: false });
  }
}
