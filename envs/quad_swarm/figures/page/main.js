// The page: playback, controls, and what they change.

import {Camera, presets} from "./camera.js";
import {append, data, fileName, flights, last, nRobots, seconds, subtitle, title} from "./data.js";
import {about, legend, Panel} from "./panels.js";
import {download, Picture, record} from "./picture.js";
import {framed, Views} from "./scene.js";
import {onTheme, setTheme, toggleTheme} from "./theme.js";

const HOLD = 1.5; // s at the end before a loop begins anew
const BEHIND = 0.3; // s that a flight under way is shown late, so that it moves evenly
const PLOTS = 500; // ms between two drawings of the plots of a flight under way
const element = id => document.getElementById(id);
const hash = new URLSearchParams(location.hash.slice(1));
const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;

const state = {now: 0, playing: false, looping: false, held: 0, before: null, queued: false, slow: 1};
let views = null, camera = null, messageTimer;

function tooltip(text, x, y) {
  const node = element("tooltip");
  node.hidden = !text;
  if (!text) return;
  node.textContent = text;
  node.style.left = `${Math.min(Math.max(x - node.offsetWidth / 2, 4), innerWidth - node.offsetWidth - 4)}px`;
  node.style.top = `${Math.max(y - node.offsetHeight - 14, 4)}px`;
}

function say(text, seconds_ = 8) {
  clearTimeout(messageTimer);
  element("message").textContent = text;
  element("message").hidden = !text;
  if (text && seconds_) messageTimer = setTimeout(() => say(""), 1000 * seconds_);
}

const panels = flights.map(flight => new Panel(flight, element("stage"), element("details"), tooltip, step => { pause(); seek(step); }));

// The cells of the stage in the form that the canvas behind them needs
function rects() {
  const stage = element("stage").getBoundingClientRect();
  return panels.map(({cell}) => {
    const box = cell.getBoundingClientRect();
    const label = Math.min(1, box.width / 420) * (nRobots > 8 ? 14 : 17);
    return {x: box.left - stage.left, y: box.top - stage.top, width: box.width, height: box.height, label};
  });
}

function layout() {
  const {width, height} = rects()[0];
  return {aspect: width / height, head: Math.min(0.9 * element("stage").querySelector(".head").offsetHeight / height, 0.35)};
}

function redraw() {
  if (state.queued) return;
  state.queued = true;
  requestAnimationFrame(frame);
}

function frame(time) {
  state.queued = false;
  if (state.playing) advance(Math.min((time - (state.before ?? time)) / 1000, 0.5));
  state.before = state.playing ? time : null;
  draw();
  if (state.playing) redraw();
}

function advance(elapsed) {
  adapt(elapsed);
  if (state.live) {
    state.now = Math.min(last, Math.max(state.now + elapsed / data.dt, last - BEHIND / data.dt));
  } else if (state.now >= last) {
    state.held += elapsed;
    if (!state.looping) pause();
    else if (state.held >= HOLD) [state.now, state.held] = [0, 0];
  } else {
    state.now = Math.min(last, state.now + elapsed / data.dt * Number(element("speed").value));
  }
}

// While playing, slow machines render at a lower resolution.
function adapt(elapsed) {
  if (!elapsed) return;
  state.pace = 0.9 * (state.pace ?? 1 / 60) + 0.1 * elapsed;
  const slow = state.pace > 1 / 28 ? Math.max(0.5, state.slow - 0.25) : state.slow;
  if (slow === state.slow) return;
  state.slow = slow;
  state.pace = 1 / 45;
  resize();
}

function draw() {
  const step = Math.floor(state.now + 1e-6);
  views?.draw(state.now, rects(), view => camera.eye(view, state.now), {fades: state.playing, border: getComputedStyle(document.body).backgroundColor});
  for (const panel of panels) panel.show(state.now);
  element("time").value = step;
  element("time").setAttribute("aria-valuetext", `step ${step}, ${seconds(step)}`);
  const text = `step ${step} of ${last}, ${seconds(step)}`;
  if (element("clock").textContent !== text) element("clock").textContent = text;
  document.body.dataset.drawn = state.now.toFixed(3);
}

function resize() {
  const stage = element("stage");
  views?.resize(stage.clientWidth, stage.clientHeight, Math.min(devicePixelRatio, 2) * (state.playing ? state.slow : 1));
  camera?.frame();
}

function remember() {
  const parts = [`step=${Math.floor(state.now + 1e-6)}`];
  if (camera?.preset && camera.preset !== "perspective") parts.push(`view=${camera.preset}`);
  if (camera && camera.robot !== null) parts.push(`follow=${camera.robot}`);
  history.replaceState(null, "", `#${parts.join("&")}`);
}

function seek(step) {
  state.now = Math.min(last, Math.max(0, step));
  state.held = 0;
  element("time").value = Math.floor(state.now + 1e-6);
  if (!state.playing) remember();
  redraw();
}

function play() {
  if (state.now >= last && !state.live) state.now = 0;
  [state.playing, state.held, state.before] = [true, 0, null];
  label();
  resize();
  redraw();
}

function pause() {
  if (!state.playing) return;
  state.playing = false;
  label();
  resize();
  remember();
  redraw();
}

function label() {
  element("play").textContent = state.playing ? "❚❚" : "▶";
  element("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
}

const step = by => { pause(); seek(by > 0 ? Math.floor(state.now + 1e-6) + 1 : Math.ceil(state.now - 1e-6) - 1); };

function choose(view, robot) {
  if (!camera) return;
  if (robot !== undefined) camera.follow(robot);
  if (view !== undefined) camera.show(view);
  mark();
  if (!state.playing) remember();
}

// Shows the state of the camera in the lists
function mark() {
  element("view").value = camera.preset ?? "";
  element("follow").value = camera.robot ?? "";
}

function fill(select, options) {
  for (const [value, text, hidden] of options) select.append(Object.assign(document.createElement("option"), {value, textContent: text, hidden: Boolean(hidden)}));
}

function begin3D() {
  const canvas = element("canvas");
  try {
    // Checked on a separate canvas first, because three.js would fill the console with errors
    if (!document.createElement("canvas").getContext("webgl2")) throw new Error("no WebGL");
    views = new Views(canvas);
  } catch {
    element("stage").classList.add("flat");
    canvas.replaceWith(Object.assign(document.createElement("p"), {
      id: "no-webgl",
      textContent: "The view in three dimensions needs WebGL, which this browser does not offer. Timeline, plots and counters work without it.",
    }));
    for (const id of ["view", "follow", "png", "webm"]) element(id).disabled = true;
    return;
  }
  const stage = element("stage");
  views.resize(stage.clientWidth, stage.clientHeight, Math.min(devicePixelRatio, 2));
  camera = new Camera(canvas, layout, redraw);
  camera.orbit.addEventListener("start", mark);
  camera.orbit.addEventListener("end", () => { mark(); if (!state.playing) remember(); });
  let pressed = null;
  canvas.addEventListener("pointerdown", event => { pressed = [event.clientX, event.clientY, camera.preset]; });
  canvas.addEventListener("pointerup", event => {
    if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 5) return;
    const box = canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    const all = rects(), view = all.findIndex(r => x >= r.x && x < r.x + r.width && y >= r.y && y < r.y + r.height);
    if (view < 0) return;
    const robot = views.robotAt(view, x - all[view].x, y - all[view].y, all[view], camera.eye(view, state.now));
    // A click does not turn the camera
    if (camera.preset === null) camera.preset = pressed[2];
    if (robot === null) mark();
    else choose(undefined, robot === camera.robot ? null : robot);
  });
  fill(element("view"), [["", "Free camera", true], ["perspective", "Overview"], ["top", "From above"], ["side", "From the side"], ["chase", "Chase"]]);
  fill(element("follow"), [["", "All robots"], ...flights[0].goals.map((_, i) => [i, `Robot ${i}`])]);
  choose(presets.includes(hash.get("view")) ? hash.get("view") : "perspective");
  const robot = Number(hash.get("follow"));
  if (hash.has("follow") && Number.isInteger(robot) && robot >= 0 && robot < nRobots) choose(undefined, robot);
}

// Exports draw on a separate canvas, so that the page does not change.
async function withPicture(width, height, ratio, action) {
  const own = new Views(document.createElement("canvas"));
  try {
    return await action(new Picture(own, width, height, ratio));
  } finally {
    own.renderer.dispose();
    own.renderer.forceContextLoss();
  }
}

function eyeOf(picture) {
  if (camera.preset === null || camera.robot !== null || camera.preset === "chase") return (view, t) => camera.eye(view, t);
  const still = framed(camera.preset, picture.layout.aspect, picture.layout.head);
  return () => still;
}

const pictureSize = () => [Math.max(900, 560 * Math.min(flights.length, 3)), 620];

async function savePicture() {
  const step_ = Math.floor(state.now + 1e-6);
  const blob = await withPicture(...pictureSize(), 2, picture => {
    const eye = eyeOf(picture);
    const canvas = picture.draw(state.now, view => eye(view, state.now), false);
    return new Promise(resolve => canvas.toBlob(resolve, "image/png"));
  });
  save(blob, `${fileName}_step${step_}.png`);
}

async function saveVideo() {
  pause();
  element("webm").disabled = true;
  const rate = Number(element("speed").value) / data.dt;
  try {
    await withPicture(...pictureSize(), 1, async picture => {
      const eye = eyeOf(picture), draw_ = t => picture.draw(t, view => eye(view, t));
      draw_(0);
      const {blob, extension} = await record(picture.canvas, () => new Promise(resolve => {
        let started = null;
        const next = time => {
          started ??= time;
          const t = (time - started) / 1000 * rate;
          draw_(Math.min(t, last));
          say(`Recording: ${Math.min(100, Math.round(100 * t / last))} %`, 0);
          if (t < last + HOLD * rate / Number(element("speed").value)) requestAnimationFrame(next);
          else resolve();
        };
        requestAnimationFrame(next);
      }), () => draw_(last));
      save(blob, `${fileName}.${extension}`);
    });
    say("");
  } catch (error) {
    say(`${error.message} “Picture” saves a still image.`);
  } finally {
    element("webm").disabled = false;
  }
}

function save(blob, name) {
  const url = URL.createObjectURL(blob);
  download(url, name);
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

// For scripts: `prepare` returns how long the animation is (s), `renderFrame` the picture at a time (s) as a data URL,
// which depends on the time only.
function beginHero() {
  document.body.className = "hero";
  let picture = null, still = null;
  window.prepare = ({width, height, ratio, theme}) => {
    setTheme(theme);
    views ??= new Views(document.createElement("canvas"));
    views.paint();
    picture = new Picture(views, width, height, ratio);
    still = framed("perspective", picture.layout.aspect, picture.layout.head);
    element("stage").replaceChildren(picture.canvas);
    // Until shortly after the last arrival without a collision, or to the end where there is none
    const arrivals = flights.filter(flight => flight.arrival !== null && flight.collision === null).map(flight => flight.arrival);
    return Math.min(last, (arrivals.length ? Math.max(...arrivals) : last) + 0.5 / data.dt) * data.dt;
  };
  window.renderFrame = time => {
    picture.draw(Math.min(time / data.dt, last), () => still);
    return picture.canvas.toDataURL("image/png");
  };
}

function beginPage() {
  const heading = element("title");
  heading.textContent = data.preset ? `${title}, world ` : title;
  if (data.preset) heading.append(Object.assign(document.createElement("code"), {textContent: data.preset}));
  document.title = `${title}${data.preset ? `, world ${data.preset}` : ""}: replay`;
  element("subtitle").textContent = subtitle;
  element("about-text").textContent = about;
  for (const [kind, text] of legend) {
    const item = document.createElement("li");
    item.append(Object.assign(document.createElement("i"), {className: kind}), text);
    element("legend").append(item);
  }
  const columns = flights.length === 4 ? 2 : Math.min(flights.length, 3), style = document.documentElement.style;
  style.setProperty("--columns", columns);
  style.setProperty("--rows", Math.ceil(flights.length / columns));
  style.setProperty("--flights", flights.length);
  element("time").max = last;
  begin3D();

  element("play").addEventListener("click", () => state.playing ? pause() : play());
  element("back").addEventListener("click", () => step(-1));
  element("forward").addEventListener("click", () => step(1));
  element("time").addEventListener("input", event => { pause(); seek(Number(event.target.value)); });
  element("view").addEventListener("change", event => choose(event.target.value));
  element("follow").addEventListener("change", event => choose(undefined, event.target.value === "" ? null : Number(event.target.value)));
  element("loop").addEventListener("click", () => {
    state.looping = !state.looping;
    element("loop").setAttribute("aria-pressed", state.looping);
  });
  element("png").addEventListener("click", savePicture);
  element("webm").addEventListener("click", saveVideo);
  element("theme").addEventListener("click", toggleTheme);
  element("help").addEventListener("click", () => element("about").showModal());
  element("more").addEventListener("click", () => {
    const open = element("controls").classList.toggle("open");
    element("more").setAttribute("aria-expanded", open);
  });
  document.addEventListener("keydown", onKey);
  onTheme(() => { views?.paint(); redraw(); });
  new ResizeObserver(() => { resize(); for (const panel of panels) panel.draw(); redraw(); }).observe(element("stage"));
  window.addEventListener("hashchange", () => {
    const wanted = new URLSearchParams(location.hash.slice(1)).get("step");
    if (wanted !== null) { pause(); seek(Number(wanted) || 0); }
  });
  if (data.live) beginLive();
  else if (hash.has("step")) seek(Math.floor(Number(hash.get("step"))) || 0);
  else if (!calm) play();
  redraw();
}

// A flight that is still under way: its steps come from the server that the page came from.
function beginLive() {
  state.live = true;
  let drawn = 0;
  const subtitle_ = element("subtitle"), source = new EventSource(`events?flight=${data.live}&from=${last}`);
  const tell = text => { subtitle_.textContent = `${subtitle}, ${text}`; document.body.dataset.live = text; };
  const plots = () => { for (const panel of panels) panel.draw(); };
  source.addEventListener("open", () => tell("live"));
  source.addEventListener("message", event => {
    append(flights[0], JSON.parse(event.data));
    element("time").max = last;
    if (performance.now() - drawn > PLOTS) {
      drawn = performance.now();
      plots();
    }
    redraw();
  });
  source.addEventListener("end", () => { tell("landed"); state.live = false; plots(); redraw(); });
  source.addEventListener("begin", () => location.reload());
  source.addEventListener("error", () => { if (state.live) tell("no connection"); });
  if (!state.playing) play();
}

function onKey(event) {
  const {key, target} = event, kind = target.tagName, about_ = element("about");
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (key === "?") {
    event.preventDefault();
    if (about_.open) about_.close();
    else about_.showModal();
  }
  if (about_.open) return;
  if (key === "Escape") choose(undefined, null);
  if (kind === "SELECT") return;
  if (kind === "BUTTON" && (key === " " || key === "Enter")) return;
  if (kind === "INPUT" && !event.shiftKey && key !== " " && !/^[a-z0-9+=-]$/i.test(key)) return;
  if (camera?.key(event)) { mark(); event.preventDefault(); return; }
  const actions = {
    " ": () => state.playing ? pause() : play(), ArrowLeft: () => step(-1), ArrowRight: () => step(1),
    Home: () => { pause(); seek(0); }, End: () => { pause(); seek(last); },
    1: () => choose(presets[0]), 2: () => choose(presets[1]), 3: () => choose(presets[2]), 4: () => choose(presets[3]),
  };
  if (!actions[key]) return;
  event.preventDefault();
  actions[key]();
}

if (hash.has("hero")) beginHero();
else beginPage();

