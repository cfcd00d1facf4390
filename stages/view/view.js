// The page of `gw view`. A worker fetches, unpacks and sorts Gaussians; this thread draws and handles the controls.
"use strict";
const byId = (name) => document.getElementById(name);
const token = new URLSearchParams(location.search).get("token") || "";

const gw = { ready: false, drawn: 0, request: { wear: [], motion: 0, row: 0, betas: "" }, playing: 0, rate: 0, detail: 1 };

// ------------------------------------------------------------------ worker

/** Runs in the worker, after viewer.js. Its messages: frames with their order, orders, and trouble. */
function frameWorker(token) {
  const CACHE_BYTES = 256 << 20, AHEAD = 6;
  const cache = new Map(); // address -> Gaussians, the latest used last
  let cached = 0, current = null, looking = null, playing = 0, queue = [], waiting = null;

  async function ask(address) {
    const answer = await fetch(address, { headers: { "X-Token": token } });
    if (answer.ok) return answer;
    const trouble = await answer.json();
    throw new Error(`${trouble.error} ${trouble.fix}`);
  }

  function give(gaussians, id) {
    current = gaussians;
    const order = sortGaussians(gaussians, looking.view, new Set(looking.hidden));
    postMessage({ frame: gaussians, order, id }, [order.buffer]);
  }

  async function show({ address, id }) {
    let gaussians = cache.get(address);
    if (gaussians) cache.delete(address);
    else {
      gaussians = unpackGaussians(await (await ask(address)).arrayBuffer());
      cached += gaussians.texels.byteLength;
      for (const [old, { texels }] of cache) {
        if (cached <= CACHE_BYTES) break;
        cache.delete(old);
        cached -= texels.byteLength;
      }
    }
    cache.set(address, gaussians);
    give(gaussians, id);
  }

  /** Read frames in advance while `id` plays; the server waits while nothing is read. */
  async function play({ address, id }) {
    playing = id;
    queue = [];
    const reader = (await ask(address)).body.getReader();
    let parts = [], held = 0;
    while (playing === id) {
      const { value, done } = await reader.read();
      if (done) break;
      parts.push(value);
      held += value.length;
      while (held >= 4) {
        if (parts[0].length < 4) parts = [joined(parts, held)];
        const length = new DataView(parts[0].buffer, parts[0].byteOffset).getUint32(0, true);
        if (held < 4 + length) break;
        const all = joined(parts, held);
        queue.push(unpackGaussians(all.slice(4, 4 + length).buffer));
        parts = [all.subarray(4 + length)];
        held -= 4 + length;
        while (queue.length >= AHEAD && playing === id) await new Promise((go) => { waiting = go; });
      }
    }
    reader.cancel();
  }

  function joined(parts, size) {
    if (parts.length === 1) return parts[0];
    const whole = new Uint8Array(size);
    let at = 0;
    for (const part of parts) { whole.set(part, at); at += part.length; }
    return whole;
  }

  /** The latest frame that is due; null where none is there yet. */
  function pull({ due, id }) {
    while (queue.length > 1 && queue[1].info.place <= due) queue.shift();
    const next = queue.length && queue[0].info.place <= due ? queue.shift() : null;
    if (waiting) { waiting(); waiting = null; }
    if (next && id === playing) give(next, id);
    else postMessage({ idle: true, id, started: queue.length > 0 });
  }

  onmessage = async ({ data }) => {
    if (data.looking) looking = data.looking;
    try {
      if (data.show) await show(data.show);
      else if (data.play) await play(data.play);
      else if (data.pull) pull(data.pull);
      else if (data.stop) { playing = 0; queue = []; if (waiting) { waiting(); waiting = null; } }
      else if (data.sort && current) {
        const order = sortGaussians(current, looking.view, new Set(looking.hidden));
        postMessage({ order }, [order.buffer]);
      }
    } catch (error) {
      postMessage({ trouble: error.message, id: (data.show || data.play || {}).id });
    }
  };
}

function startWorker() {
  const code = `${byId("viewer").textContent}\n(${frameWorker})(${JSON.stringify(token)});`;
  gw.worker = new Worker(URL.createObjectURL(new Blob([code], { type: "text/javascript" })));
  gw.worker.onmessage = ({ data }) => {
    if (data.trouble) { say(new Error(data.trouble)); stop(); settle(); return; }
    if (data.order && !data.frame) { sorting = false; gw.canvas.setOrder(data.order); draw(); if (sortAgain) resort(); return; }
    if (data.frame) accept(data);
    if (gw.playing && data.id === gw.playing) pulled(data);
    else if (data.frame && data.id === asked) settle();
  };
}

const address = (kind, request) =>
  new URL(`${kind}?` + new URLSearchParams({ ...request, wear: request.wear.join(",") }), location.href).href;

function lookingNow() {
  return { view: camera().cameraFromWorld, hidden: [...gw.canvas.hidden] };
}

// ------------------------------------------------------------------ frames

let asking = false, again = false, asked = 0, ids = 0, settle = () => {};

function say(error) { byId("trouble").textContent = error ? error.message : ""; }

async function ask(path, options = {}) {
  const answer = await fetch(path, { ...options, headers: { "X-Token": token } });
  if (answer.ok) return answer;
  const trouble = await answer.json();
  throw new Error(`${trouble.error} ${trouble.fix}`);
}

/** Take a frame with its order: follow the person, show its layers, and draw. */
function accept({ frame, order }) {
  const middle = frame.middle;
  if (byId("follow").checked && gw.middle)
    for (let axis = 0; axis < 3; axis++) gw.orbit.target[axis] += middle[axis] - gw.middle[axis];
  gw.middle = middle;
  gw.canvas.set(frame, order);
  showLayers(frame.layers);
  if (frame.info.row !== undefined) showRow(frame.info.row);
  say();
  if (gw.unfitted) fit();
  gw.ready = true;
  draw();
}

/** Show what is requested; requests that come while one is on its way are answered by the latest. */
async function update() {
  if (asking) { again = true; return; }
  asking = true;
  do {
    again = false;
    asked = ++ids;
    const done = new Promise((go) => { settle = go; });
    gw.worker.postMessage({ show: { address: address("gaussians", gw.request), id: asked }, looking: lookingNow() });
    await done;
  } while (again);
  asking = false;
  remember();
}

let waiting = false;
function draw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    gw.canvas.draw(camera());
    gw.drawn++;
  });
}

let sorting = false, sortAgain = false;

/** Draw from another place: the worker sorts again, and its order is drawn when it arrives. */
function resort() {
  sortAgain = sorting;
  if (sorting) return;
  sorting = true;
  gw.worker.postMessage({ sort: true, looking: lookingNow() });
}

function redraw() {
  if (!gw.canvas.gaussians) return;
  resort();
  draw();
  remember();
}

function free() {
  const side = byId("side"), bar = byId("bar"), sheet = getComputedStyle(side).left === "0px";
  return {
    right: sheet ? 0 : side.offsetWidth,
    bottom: bar.offsetHeight + (sheet ? side.offsetHeight : 0),
  };
}

/** detail: share of the screen's resolution, less than 1 where a browser draws too slowly to play. */
function camera(detail = gw.detail) {
  const scale = detail * Math.min(devicePixelRatio || 1, 2), covered = free();
  const shown = gw.orbit.camera(Math.round(innerWidth * scale), Math.round(innerHeight * scale));
  shown.intrinsics[2] -= 0.5 * scale * covered.right; // the middle of what is free of panels
  shown.intrinsics[3] -= 0.5 * scale * covered.bottom;
  return shown;
}

/** Stand so that the whole person is in the free part of the window. */
function fit() {
  const covered = free();
  gw.unfitted = false;
  gw.fitted = true;
  gw.orbit.fit(boxOf(gw.canvas.gaussians), { width: innerWidth - covered.right, height: innerHeight - covered.bottom },
    innerWidth, innerHeight);
}

// ------------------------------------------------------------------ playing

const SLOW = 12, LEAST_DETAIL = 0.4; // fps below which the resolution is lowered, and how far it may fall

function stop() {
  if (gw.playing) gw.worker.postMessage({ stop: true });
  gw.playing = 0;
  if (gw.detail < 1) { gw.detail = 1; draw(); }
  byId("play").textContent = "Play";
  byId("rate").textContent = "";
  remember();
}

/** At the speed of the motion; frames that come too late are left out. */
function play() {
  if (gw.playing) { stop(); return; }
  if (gw.motions[gw.request.motion].frames < 2) return;
  gw.playing = ++ids;
  gw.clock = null;
  gw.times = [];
  byId("play").textContent = "Pause";
  gw.worker.postMessage({ play: { address: address("stream", gw.request), id: gw.playing }, looking: lookingNow() });
  pull();
}

function pull() {
  const { fps } = gw.motions[gw.request.motion];
  const due = gw.clock === null ? 0 : Math.floor(((performance.now() - gw.clock) / 1000) * fps);
  gw.worker.postMessage({ pull: { due, id: gw.playing }, looking: lookingNow() });
}

function pulled(data) {
  if (data.frame) {
    const now = performance.now();
    if (gw.clock === null) gw.clock = now;
    gw.times.push(now);
    while (now - gw.times[0] > 2000) gw.times.shift();
    const span = (now - gw.times[0]) / 1000;
    gw.rate = span > 0.5 ? (gw.times.length - 1) / span : 0;
    byId("rate").textContent = gw.rate ? `${gw.rate.toFixed(0)} fps` : "";
    if (gw.rate && gw.rate < SLOW && gw.detail > LEAST_DETAIL) {
      gw.detail = Math.max(LEAST_DETAIL, 0.7 * gw.detail);
      gw.times = [now];
    }
  }
  requestAnimationFrame(() => { if (gw.playing) pull(); });
}

/** Change what is requested; what is played goes on with it. */
function change(part) {
  const playing = gw.playing;
  if (playing) stop();
  Object.assign(gw.request, part);
  const shown = update();
  return playing ? shown.then(play) : shown;
}

// ------------------------------------------------------------------ controls

function element(kind, attributes, ...children) {
  const made = Object.assign(document.createElement(kind), attributes);
  made.append(...children);
  return made;
}

function showLayers(layers) {
  const names = layers.map((layer) => layer.name).join();
  if (byId("layers").dataset.names === names) return;
  byId("layers").dataset.names = names;
  byId("layers").replaceChildren(...layers.map(({ name }) => {
    const box = element("input", { type: "checkbox", name: "layer-" + name, checked: !gw.canvas.hidden.has(name) });
    box.addEventListener("change", () => { gw.canvas.hidden[box.checked ? "delete" : "add"](name); redraw(); });
    return element("label", {}, box, name);
  }));
}

const thumbnails = new Map(); // name of a bundle -> address of its picture

async function showThumbnail(image, name) {
  if (!thumbnails.has(name)) {
    const picture = ask("preview?" + new URLSearchParams({ name })).then((answer) => answer.blob());
    thumbnails.set(name, picture.then((blob) => URL.createObjectURL(blob)));
  }
  image.src = await thumbnails.get(name);
}

/** A tile of the wardrobe: a radio button with the picture and the name of a bundle; "" is nothing. */
function tile(slot, name, checked) {
  const radio = element("input", { type: "radio", name: "wear-" + slot, value: name, checked });
  radio.addEventListener("change", wearChosen);
  if (!name) return element("label", { className: "tile" }, radio, element("span", {}, "none"));
  const image = element("img", { alt: "" });
  showThumbnail(image, name).catch(say);
  return element("label", { className: "tile", title: name }, radio, image, element("span", {}, name));
}

const chosenBody = () => document.querySelector("[name=wear-body]:checked")?.value || "";

function wearChosen() {
  const other = chosenBody() !== gw.body;
  gw.body = chosenBody();
  const wear = [...byId("pieces").querySelectorAll(":checked")].map(({ value }) => value).filter(Boolean);
  change(other ? { wear, betas: "" } : { wear });
  if (other) showShape().catch(say);
}

function offerPieces(pieces, slots) {
  byId("wardrobe").hidden = !pieces.length;
  const groups = [["body", pieces.filter(({ kind }) => kind === "body")]];
  for (const slot of slots) groups.push([slot, pieces.filter(({ layer }) => layer === slot)]);
  byId("pieces").replaceChildren(...groups.filter(([, offered]) => offered.length).map(([slot, offered]) => {
    const names = offered.map(({ name }) => name), worn = names.find((name) => gw.request.wear.includes(name)) || "";
    const tiles = element("div", { className: "tiles" });
    tiles.append(...(slot === "body" ? names : ["", ...names]).map((name) => tile(slot, name, name === worn)));
    return element("fieldset", {}, element("legend", {}, slot), tiles);
  }));
  gw.body = chosenBody();
}

const SHAPE_NAMES = ["Height", "Girth"];

/** The sliders follow the body that is worn. */
async function showShape() {
  const request = { ...gw.request };
  const body = await (await ask(address("body", request))).json();
  byId("measures").textContent = `${body.height_cm.toFixed(0)} cm tall, ${body.girth_cm.toFixed(0)} cm around the waist`;
  const values = request.betas ? request.betas.split(",") : body.betas;
  body.betas.forEach((own, index) => {
    const slider = byId("betas").querySelector(`[name=beta-${index}]`);
    if (document.activeElement !== slider) slider.value = values[index] ?? own;
    slider.nextSibling.textContent = Number(slider.value).toFixed(1);
  });
}

function offerShape(count) {
  const sliders = [...Array(count).keys()].map((index) => {
    const slider = element("input", { type: "range", min: -4, max: 4, step: 0.1, name: `beta-${index}`, value: 0 });
    slider.addEventListener("input", () => {
      slider.nextSibling.textContent = Number(slider.value).toFixed(1);
      change({ betas: sliders.map((one) => one.value).join(",") });
      showShape().catch(say);
    });
    return slider;
  });
  byId("betas").replaceChildren(...sliders.map((slider, index) =>
    element("label", {}, element("span", {}, SHAPE_NAMES[index] || `Shape ${index + 1}`), slider, element("output", {}))));
  byId("reshape").addEventListener("click", () => { change({ betas: "" }); showShape().catch(say); });
}

function showRow(row) {
  gw.request.row = row;
  byId("row").value = row;
  byId("frame").textContent = row;
}

function goTo(row) {
  if (gw.playing) stop();
  showRow(row);
  return update();
}

function chooseMotion(index, row = 0) {
  const motion = gw.motions[index];
  gw.request.motion = index;
  byId("motion").value = index;
  byId("row").max = motion.frames - 1;
  byId("play").disabled = byId("row").disabled = motion.frames < 2;
  return goTo(Math.min(row, motion.frames - 1));
}

/** A PNG from the server, by the renderer of `gw render`. */
async function picture(background) {
  const request = { ...gw.request, camera: camera(1), hidden: [...gw.canvas.hidden], background };
  return (await ask("picture", { method: "POST", body: JSON.stringify(request) })).blob();
}

async function save(background) {
  try {
    const href = URL.createObjectURL(await picture(background));
    element("a", { href, download: `gw-${gw.request.wear.join("-") || "view"}-${gw.request.row}.png` }).click();
    setTimeout(() => URL.revokeObjectURL(href), 10000);
  } catch (error) { say(error); }
}

function paint() {
  const value = byId("background").value;
  gw.canvas.background = [1, 3, 5].map((at) => parseInt(value.slice(at, at + 2), 16) / 255).concat(1);
  draw();
  remember();
}

/** Wear bundles that were dropped on the page. */
async function wearFiles(files) {
  try {
    for (const file of files) {
      const added = await (await ask("bundle?" + new URLSearchParams({ name: file.name }), { method: "POST", body: file })).json();
      const piece = added.pieces.find(({ name }) => name === added.name);
      const taken = new Map(added.pieces.map((one) => [one.name, one]));
      const rest = gw.request.wear.filter((name) => taken.get(name).layer !== piece.layer
        && !taken.get(name).slots.some((slot) => piece.slots.includes(slot)));
      gw.request.wear = [...rest, added.name];
      offerPieces(added.pieces, gw.slots);
      if (piece.kind === "body") gw.request.betas = "";
    }
    change({});
    await showShape();
  } catch (error) { say(error); }
}

// ------------------------------------------------------------------ address

let remembering = 0;

/** Keep what is shown in the address, so that it can be sent and reloaded. */
function remember() {
  clearTimeout(remembering);
  remembering = setTimeout(() => {
    const { wear, motion, row, betas } = gw.request, { target, azimuth, tilt, distance } = gw.orbit;
    const state = { wear: wear.join(","), motion, row, background: byId("background").value,
      camera: [...target, azimuth, tilt, distance].map((value) => value.toFixed(3)).join(",") };
    if (betas) state.betas = betas;
    if (gw.canvas.hidden.size) state.hidden = [...gw.canvas.hidden].join(",");
    history.replaceState(null, "", "#" + new URLSearchParams(state));
  }, 200);
}

function recall() {
  const state = new URLSearchParams(location.hash.slice(1)), known = new Set(gw.pieces.map(({ name }) => name));
  const wear = (state.get("wear") || "").split(",").filter((name) => known.has(name));
  if (wear.length) gw.request.wear = wear;
  if (state.get("betas")) gw.request.betas = state.get("betas");
  if (/^#[0-9a-f]{6}$/.test(state.get("background") || "")) byId("background").value = state.get("background");
  for (const name of (state.get("hidden") || "").split(",").filter(Boolean)) gw.canvas.hidden.add(name);
  const place = (state.get("camera") || "").split(",").map(Number);
  gw.unfitted = place.length !== 6 || !place.every(Number.isFinite);
  if (!gw.unfitted) Object.assign(gw.orbit, { target: place.slice(0, 3), azimuth: place[3], tilt: place[4], distance: place[5] });
  const motion = Number(state.get("motion") || 0), row = Number(state.get("row") || 0);
  return [gw.motions[motion] ? motion : 0, row >= 0 ? Math.floor(row) : 0];
}

// ------------------------------------------------------------------ start

function listen(start) {
  byId("motion").addEventListener("change", (event) => chooseMotion(Number(event.target.value)));
  byId("row").addEventListener("input", (event) => goTo(Number(event.target.value)));
  byId("play").addEventListener("click", play);
  byId("background").addEventListener("input", paint);
  byId("picture").addEventListener("click", () => save(byId("background").value));
  byId("clear").addEventListener("click", () => save("transparent"));
  byId("sheet").addEventListener("click", () => {
    byId("sheet").setAttribute("aria-expanded", document.body.classList.toggle("sheet"));
    fit();
  });
  [["front", 0], ["left", 90], ["back", 180], ["right", -90]].forEach(([name, degrees]) => {
    const button = element("button", {}, name);
    button.addEventListener("click", () => {
      Object.assign(gw.orbit, { azimuth: start.azimuth + (degrees * Math.PI) / 180, tilt: start.tilt });
      fit();
    });
    byId("sides").append(button);
  });
  byId("canvas").addEventListener("pointerdown", () => { gw.fitted = false; });
  addEventListener("resize", () => { if (gw.fitted) fit(); else redraw(); });
  addEventListener("keydown", (event) => {
    if (event.target !== document.body && event.target !== byId("canvas")) return;
    const frames = gw.motions[gw.request.motion].frames;
    if (event.code === "Space") play();
    else if (event.key === ",") goTo((gw.request.row + frames - 1) % frames);
    else if (event.key === ".") goTo((gw.request.row + 1) % frames);
    else return;
    event.preventDefault();
  });
  addEventListener("dragover", (event) => { event.preventDefault(); document.body.classList.add("drop"); });
  addEventListener("dragleave", (event) => { if (!event.relatedTarget) document.body.classList.remove("drop"); });
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("drop");
    wearFiles([...event.dataTransfer.files]);
  });
}

async function begin() {
  gw.canvas = new SplatCanvas(byId("canvas"));
  const show = await (await ask("show")).json();
  Object.assign(gw, { motions: show.motions, pieces: show.pieces, slots: show.slots });
  gw.request.wear = show.wear;
  gw.request.betas = show.betasAsked;
  gw.orbit = new OrbitCamera(show.start, redraw);
  startWorker();
  gw.orbit.listen(byId("canvas"));
  byId("motion").append(...show.motions.map(({ name }, index) => element("option", { value: index }, name)));
  const [motion, row] = recall();
  offerPieces(show.pieces, show.slots);
  offerShape(10);
  listen(show.start);
  paint();
  await Promise.all([chooseMotion(motion, row), showShape()]);
}

begin().catch(say);
