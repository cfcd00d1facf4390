// The page of `gw view`: asks the server for Gaussians of the moment that is wished for, and shows them.
"use strict";
const byId = (name) => document.getElementById(name);
const token = new URLSearchParams(location.search).get("token") || "";
const KEPT_BYTES = 256 << 20; // of moments that were shown already

const gw = { ready: false, drawn: 0, wish: { wear: [], motion: 0, row: 0, betas: "" }, playing: false };

async function ask(address, options = {}) {
  const answer = await fetch(address, { ...options, headers: { "X-Token": token } });
  if (answer.ok) return answer;
  const trouble = await answer.json();
  throw new Error(`${trouble.error} ${trouble.fix}`);
}

function say(error) { byId("trouble").textContent = error ? error.message : ""; }

// ------------------------------------------------------------------ moments

const moments = new Map(); // address -> Gaussians, the latest used last
let keptBytes = 0;

async function moment(wish) {
  const address = "gaussians?" + new URLSearchParams({ ...wish, wear: wish.wear.join(",") });
  let found = moments.get(address);
  if (found) moments.delete(address);
  else {
    found = unpackGaussians(await (await ask(address)).arrayBuffer());
    found.bytes = 40 * found.count;
    keptBytes += found.bytes;
    for (const [old, { bytes }] of moments) {
      if (keptBytes <= KEPT_BYTES) break;
      moments.delete(old);
      keptBytes -= bytes;
    }
  }
  moments.set(address, found);
  return found;
}

function middle({ means, count }) {
  const total = [0, 0, 0];
  for (let i = 0; i < 3 * count; i++) total[i % 3] += means[i];
  return total.map((value) => value / Math.max(1, count));
}

let asking = false, again = false;

/** Show what is wished for; wishes that come while one is on its way are answered by the latest. */
async function update() {
  if (asking) { again = true; return; }
  asking = true;
  do {
    again = false;
    try {
      const found = await moment({ ...gw.wish });
      const here = middle(found);
      if (byId("follow").checked && gw.middle)
        for (let axis = 0; axis < 3; axis++) gw.orbit.target[axis] += here[axis] - gw.middle[axis];
      gw.middle = here;
      gw.canvas.set(found);
      showLayers(found.layers);
      say();
      redraw();
    } catch (error) { say(error); stop(); }
  } while (again);
  asking = false;
}

let waiting = false;
function redraw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    gw.canvas.draw(camera());
    gw.drawn++;
    gw.ready = Boolean(gw.canvas.gaussians);
  });
}

function camera() {
  const ratio = Math.min(devicePixelRatio || 1, 2);
  const shown = gw.orbit.camera(Math.round(innerWidth * ratio), Math.round(innerHeight * ratio));
  // The middle of what is free of the panels.
  shown.intrinsics[2] -= 0.5 * ratio * byId("side").offsetWidth;
  shown.intrinsics[3] -= 0.5 * ratio * byId("bar").offsetHeight;
  return shown;
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

function offerPieces(pieces, slots) {
  byId("wardrobe").hidden = !pieces.length;
  const choice = (title, offered, optional) => {
    const select = element("select", { name: "wear-" + title });
    if (optional) select.append(element("option", { value: "" }, "—"));
    for (const piece of offered) select.append(element("option", { value: piece.name }, piece.name));
    select.value = offered.map((piece) => piece.name).find((name) => gw.wish.wear.includes(name)) || "";
    select.addEventListener("change", () => {
      gw.wish.wear = [...byId("pieces").querySelectorAll("select")].map((one) => one.value).filter(Boolean);
      update();
    });
    return element("label", {}, element("span", {}, title), select);
  };
  const rows = [choice("body", pieces.filter((piece) => piece.kind === "body"), false)];
  for (const slot of slots) {
    const offered = pieces.filter((piece) => piece.layer === slot);
    if (offered.length) rows.push(choice(slot, offered, true));
  }
  byId("pieces").replaceChildren(...rows);
}

function offerShape(own) {
  const sliders = own.map((value, index) => {
    const slider = element("input", { type: "range", min: -4, max: 4, step: 0.1, name: `beta-${index}`, value });
    slider.addEventListener("input", () => {
      gw.wish.betas = sliders.map((one) => one.value).join(",");
      slider.nextSibling.textContent = Number(slider.value).toFixed(1);
      update();
    });
    return slider;
  });
  const reset = () => {
    sliders.forEach((slider, index) => {
      slider.value = own[index];
      slider.nextSibling.textContent = Number(own[index]).toFixed(1);
    });
  };
  byId("betas").replaceChildren(...sliders.map((slider, index) =>
    element("label", {}, element("span", {}, "β" + (index + 1)), slider, element("output", {}))));
  reset();
  byId("reshape").addEventListener("click", () => { gw.wish.betas = ""; reset(); update(); });
}

function goTo(row) {
  gw.wish.row = row;
  byId("row").value = row;
  byId("frame").textContent = row;
  return update();
}

function chooseMotion(index) {
  const motion = gw.motions[index];
  gw.wish.motion = index;
  byId("row").max = motion.frames - 1;
  byId("play").disabled = byId("row").disabled = motion.frames < 2;
  return goTo(0);
}

function stop() {
  gw.playing = false;
  byId("play").textContent = "play";
}

/** At the speed of the motion; frames that come too late are left out. */
async function play() {
  if (gw.playing) { stop(); return; }
  gw.playing = true;
  byId("play").textContent = "pause";
  const started = performance.now(), first = gw.wish.row;
  while (gw.playing) {
    const { frames, fps } = gw.motions[gw.wish.motion];
    if (frames < 2) break;
    const row = (first + Math.floor(((performance.now() - started) / 1000) * fps)) % frames;
    if (row !== gw.wish.row) await goTo(row);
    await new Promise(requestAnimationFrame);
  }
  stop();
}

/** A PNG from the server, by the renderer of `gw render`. */
async function picture(background) {
  const wished = { ...gw.wish, camera: camera(), hidden: [...gw.canvas.hidden], background };
  return (await ask("picture", { method: "POST", body: JSON.stringify(wished) })).blob();
}

async function save(background) {
  try {
    const address = URL.createObjectURL(await picture(background));
    element("a", { href: address, download: `gw-${gw.wish.wear.join("-") || "view"}-${gw.wish.row}.png` }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10000);
  } catch (error) { say(error); }
}

function paint() {
  const value = byId("background").value;
  gw.canvas.background = [1, 3, 5].map((at) => parseInt(value.slice(at, at + 2), 16) / 255).concat(1);
  redraw();
}

async function begin() {
  gw.canvas = new SplatCanvas(byId("canvas"));
  const show = await (await ask("show")).json();
  gw.motions = show.motions;
  gw.wish.wear = show.wear;
  gw.orbit = new OrbitCamera(show.start, redraw);
  gw.orbit.listen(byId("canvas"));
  offerPieces(show.pieces, show.slots);
  offerShape(show.betas);
  byId("motion").append(...show.motions.map(({ name }, index) => element("option", { value: index }, name)));
  byId("motion").addEventListener("change", (event) => chooseMotion(Number(event.target.value)));
  byId("row").addEventListener("input", (event) => { stop(); goTo(Number(event.target.value)); });
  byId("play").addEventListener("click", play);
  byId("follow").addEventListener("change", redraw);
  byId("background").addEventListener("input", paint);
  byId("picture").addEventListener("click", () => save(byId("background").value));
  byId("clear").addEventListener("click", () => save("transparent"));
  [["front", 0], ["left", 90], ["back", 180], ["right", -90]].forEach(([name, degrees]) => {
    const button = element("button", {}, name);
    button.addEventListener("click", () => {
      Object.assign(gw.orbit, { azimuth: show.start.azimuth + (degrees * Math.PI) / 180, tilt: show.start.tilt });
      redraw();
    });
    byId("sides").append(button);
  });
  addEventListener("resize", redraw);
  addEventListener("keydown", (event) => {
    if (event.code === "Space" && event.target === document.body) { event.preventDefault(); play(); }
  });
  if (show.betasAsked) gw.wish.betas = show.betasAsked;
  paint();
  await chooseMotion(0);
}

begin().catch(say);
