// The views with titles and counters as one picture, for export and for animations made by a script.

import {
  askedUntil, counted as words, flights, grouped, hasArrived, hasCollided, metres, nRobots, percent, possibleUntil, seconds, separationAt, title,
} from "./data.js";
import {css, isDark} from "./theme.js";

const FONT = "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif";

// :param views: a `Views` of its own: its size changes with the picture
export class Picture {
  constructor(views, width, height, ratio = 1) {
    this.views = views;
    [this.width, this.height, this.ratio] = [width, height, ratio];
    this.canvas = document.createElement("canvas");
    [this.canvas.width, this.canvas.height] = [width * ratio, height * ratio];
    this.pen = this.canvas.getContext("2d");
    const columns = flights.length <= 3 || width > 1500 ? flights.length : Math.ceil(flights.length / 2);
    const rows = Math.ceil(flights.length / columns), gap = 6, head = this.head = 34;
    const w = (width - gap * (columns - 1)) / columns, h = (height - head - gap * (rows - 1)) / rows;
    this.rects = flights.map((_, k) => ({
      x: (k % columns) * (w + gap), y: head + Math.floor(k / columns) * (h + gap), width: w, height: h, label: nRobots > 8 ? 13 : 16,
    }));
    this.banner = Math.min(104, 0.3 * h);
  }

  get layout() {
    const {width, height} = this.rects[0];
    return {aspect: width / height, head: this.banner / height};
  }

  draw(t, eye, fades = true) {
    const {pen, views, width, height, ratio} = this, dark = isDark();
    views.resize(width, height, ratio);
    views.draw(t, this.rects, eye, {fades, border: dark ? "#05070a" : "#ffffff"});
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.drawImage(views.renderer.domElement, 0, 0);
    pen.scale(ratio, ratio);
    const ink = css("--ink"), faint = css("--faint");
    this.text(title, 10, 23, `600 17px ${FONT}`, ink);
    this.text(seconds(t), width - 10, 23, `600 17px ${FONT}`, ink, "right");
    flights.forEach((flight, k) => {
      const {x, y, width: wide} = this.rects[k], left = x + 12, counted = askedUntil(flight, t);
      const veil = pen.createLinearGradient(0, y, 0, y + this.banner + 20);
      veil.addColorStop(0.3, css("--view"));
      veil.addColorStop(1, `${css("--view")}00`);
      pen.fillStyle = veil;
      pen.fillRect(x, y, wide, this.banner + 20);
      this.text(flight.name, left, y + 25, `700 19px ${FONT}`, ink, "left", wide - 24);
      this.text(flight.detail, left, y + 43, `400 13px ${FONT}`, faint, "left", wide - 24);
      const number = grouped(counted), used = this.text(number, left, y + 79, `700 30px ${FONT}`, ink);
      this.text(words(counted), left + used + 7, y + 67, `400 13px ${FONT}`, faint);
      this.text(`${percent(counted, possibleUntil(flight, t))} of all possible`, left + used + 7, y + 82, `400 13px ${FONT}`, faint);
      if (hasCollided(flight, t)) this.badge(`Collision at ${seconds(flight.collision)}`, left, y + 92, css("--alarm-fill"), "#ffffff");
      else if (hasArrived(flight, t)) this.badge(`All arrived at ${seconds(flight.arrival)}`, left, y + 92, css("--good-fill"), "#ffffff");
      else this.text(`closest two ${metres(separationAt(flight, t))} apart`, left, y + 108, `400 13px ${FONT}`, faint);
    });
    return this.canvas;
  }

  text(words, x, y, font, fill, align = "left", most) {
    Object.assign(this.pen, {font, fillStyle: fill, textAlign: align});
    let shown = words;
    if (most) while (shown.length > 4 && this.pen.measureText(shown).width > most) shown = `${shown.slice(0, -2)}…`;
    this.pen.fillText(shown, x, y);
    return this.pen.measureText(shown).width;
  }

  badge(words, x, y, fill, ink) {
    const {pen} = this;
    pen.font = `700 14px ${FONT}`;
    const wide = pen.measureText(words).width + 20;
    pen.fillStyle = fill;
    pen.beginPath(); pen.roundRect(x - 2, y, wide, 25, 12.5); pen.fill();
    this.text(words, x + 8, y + 17.5, pen.font, ink);
  }
}

export function download(url, name) {
  const link = document.createElement("a");
  [link.href, link.download] = [url, name];
  document.body.append(link);
  link.click();
  link.remove();
}

const MINIMUM = 2000, PATIENCE = 10; // bytes of a video that holds a picture; s that a slow encoder is given

// Records a canvas while `play` draws on it. `draw` draws the end once more. :raises Error: this browser cannot
export async function record(canvas, play, draw) {
  if (!canvas.captureStream || !window.MediaRecorder) throw new Error("This browser cannot record videos.");
  const type = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm", "video/mp4"].find(one => MediaRecorder.isTypeSupported(one));
  if (!type) throw new Error("This browser cannot write WebM videos.");
  const recorder = new MediaRecorder(canvas.captureStream(30), {mimeType: type, videoBitsPerSecond: 8e6}), parts = [];
  recorder.addEventListener("dataavailable", event => parts.push(event.data));
  const stopped = new Promise((resolve, reject) => {
    recorder.addEventListener("stop", resolve);
    recorder.addEventListener("error", event => reject(event.error));
  });
  const size = () => parts.reduce((sum, part) => sum + part.size, 0);
  recorder.start(250);
  try {
    await play();
    for (let waited = 0; size() < MINIMUM && waited < PATIENCE; waited += 0.1) {
      draw();
      await new Promise(done => setTimeout(done, 100));
    }
  } finally {
    recorder.stop();
  }
  await stopped;
  if (size() < MINIMUM) throw new Error("This browser recorded no picture.");
  return {blob: new Blob(parts, {type}), extension: type.startsWith("video/mp4") ? "mp4" : "webm"};
}

