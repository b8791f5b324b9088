// What belongs to each flight on the page: its view with counters, and its timeline and plots.

import {
  askedUntil, contact, counted, data, downwash, flights, fullName, grouped, hasArrived, hasCollided, largest, metres, nPairs, nRobots, percent, possibleUntil, radii, seconds, separationAt,
} from "./data.js";
import {drawRequests, drawSeparation, stepUnder, timeScale, top} from "./plots.js";
import {drawTimeline, wordsAt} from "./timeline.js";

const cell = `<div class="head"><div><h2></h2><p class="detail"></p></div>
<p class="count"><b class="asked"></b> <span>${counted()}<br><span class="share"></span> of all<span class="long"> possible</span></span></p>
<p class="apart"></p></div><p class="badge" role="status" hidden></p>`;

const details = `<h2></h2><p class="summary"></p>
<figure><figcaption></figcaption><svg class="asks" role="list"></svg></figure>
<figure><figcaption></figcaption><svg class="separation" role="img"></svg></figure>
<figure><figcaption></figcaption><svg class="requests" role="img"></svg></figure>`;

function summary(flight) {
  const asked = flight.asked.at(-1), possible = flight.steps * nPairs;
  const parts = [
    `${flight.steps} steps (${seconds(flight.steps)})`,
    `${grouped(asked)} of ${grouped(possible)} ${counted(possible)} (${percent(asked, possible)})`,
    `closest ${metres(flight.closest)}`,
    ...(flight.closestObstacle === undefined ? [] : [`to an obstacle ${flight.closestObstacle.toFixed(2)}\u00a0m`]),
    flight.collision === null ? "no collision" : `collision at step ${flight.collision}`,
    flight.arrival === null ? "not all arrived" : `all arrived after ${seconds(flight.arrival)}`,
  ];
  return parts.join(", ");
}

export class Panel {
  // :param seek: called with the step that the user points at
  constructor(flight, stage, column, tooltip, seek) {
    this.flight = flight;
    this.cell = document.createElement("section");
    this.cell.className = "cell";
    this.cell.innerHTML = cell;
    this.cell.setAttribute("aria-label", fullName(flight));
    this.details = document.createElement("article");
    this.details.innerHTML = details;
    const find = name => this.cell.querySelector(name);
    find("h2").textContent = this.details.querySelector("h2").textContent = flight.name;
    find(".detail").textContent = flight.detail;
    this.details.querySelector("h2").append(Object.assign(document.createElement("small"), {textContent: flight.detail}));
    const captions = [
      this.flight.announces
        ? "Who receives whose plan, requested or announced: one lane per pair, one block per receiving robot, in the colour of the robot whose plan it is"
        : "Who asks whom: one lane per pair, one block per asking robot, in the colour of the robot that is asked",
      `Closest two robots (m)${Math.max(...flight.separation) > top ? `; dashed where it is more than ${top.toFixed(1)} m` : ""}`,
      `${counted()[0].toUpperCase()}${counted().slice(1)} so far`,
    ];
    this.details.querySelectorAll("figcaption").forEach((node, k) => { node.textContent = captions[k]; });
    [this.asked, this.share, this.apart, this.badge] = [".asked", ".share", ".apart", ".badge"].map(find);
    this.svgs = [...this.details.querySelectorAll("svg")];
    stage.append(this.cell);
    column.append(this.details);
    for (const svg of this.svgs) this.listen(svg, tooltip, seek);
  }

  listen(svg, tooltip, seek) {
    const step = event => Math.round(stepUnder(event.clientX - svg.getBoundingClientRect().left, svg.clientWidth));
    svg.addEventListener("pointerdown", event => { svg.setPointerCapture(event.pointerId); seek(step(event)); });
    svg.addEventListener("pointermove", event => {
      if (event.buttons) seek(step(event));
      const box = svg.getBoundingClientRect(), k = Math.min(Math.max(step(event), 0), this.flight.steps);
      const words = svg.classList.contains("asks") ? wordsAt(svg, this.flight, event.clientX - box.left, event.clientY - box.top)?.text
        : svg.classList.contains("separation") ? `step ${k}: ${metres(this.flight.separation[k])}`
        : `step ${k}: ${grouped(this.flight.asked[k])} ${counted(this.flight.asked[k])}`;
      tooltip(words, event.clientX, event.clientY);
    });
    for (const name of ["pointerleave", "pointercancel"]) svg.addEventListener(name, () => tooltip());
  }

  // Draws timeline and plots anew, at the width that they have.
  draw() {
    const [asks, separation, requests] = this.svgs;
    set(this.details.querySelector(".summary"), summary(this.flight));
    this.cursors = [drawTimeline(asks, this.flight), drawSeparation(separation, this.flight), drawRequests(requests, this.flight)];
  }

  show(t) {
    const {flight} = this, asked = askedUntil(flight, t), collided = hasCollided(flight, t), arrived = hasArrived(flight, t);
    set(this.asked, grouped(asked));
    set(this.share, percent(asked, possibleUntil(flight, t)));
    set(this.apart, `closest two ${metres(separationAt(flight, t))} apart`);
    this.badge.hidden = !collided && !arrived;
    this.badge.classList.toggle("alarm", collided);
    set(this.badge, collided ? `collision at step ${flight.collision}` : arrived ? `all arrived after ${seconds(flight.arrival)}` : "");
    this.cursors?.forEach((line, k) => {
      const at = timeScale(Math.max(this.svgs[k].clientWidth, 200))(t);
      line.setAttribute("x1", at);
      line.setAttribute("x2", at);
    });
  }
}

function set(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

const alike = radii.every(radius => radius === data.radius), obstacles = flights.flatMap(flight => flight.obstacles);

const stages = flights[0].plans[0][0].length - 1; // 0 of recordings without plans

export const legend = [
  ["arc", "request: from the robot that asks to the one it asks; a light runs there and returns with the plan"],
  ...(flights.some(flight => flight.announces) ? [["arc announced", "announced plan, sent unasked: from the robot whose plan it is; a light runs there"]] : []),
  ...(stages ? [["tube", `plan for the next ${seconds(stages * data.plan_stride)}`]] : []),
  ["goal", "goal of the robot of this colour"],
  ["bubble", `safety bubble, radius ${alike ? data.radius : `${Math.min(...radii)} to ${largest}`} m${downwash === 1 ? "" : `, ${downwash} times as high as wide`}: two that touch are a collision`],
  ...(obstacles.length ? [["body", `obstacle${obstacles.some(one => one.moves) ? ", some fly straight on" : ""}: a robot ${alike ? `closer than ${data.radius} m` : "whose bubble it touches"} collides`]] : []),
  ["bubble close", alike
    ? `closer than ${(1.1 * contact).toFixed(2)} m to another${obstacles.length ? `, or ${(data.radius + 0.1 * contact).toFixed(2)} m to an obstacle` : ""}`
    : `bubble closer than ${(0.1 * contact).toFixed(2)} m to another${obstacles.length ? " or to an obstacle" : ""}`],
  ["bubble alarm", "collision"],
];

const predicting = flights.filter(flight => flight.predicts).length;
const expected = predicting === flights.length ? "it expects what a small network predicts" : predicting === 0
  ? "it expects that they fly straight on"
  : "it expects that they fly straight on, or what a small network predicts (\u201cothers predicted\u201d)";

export const about = `${nRobots} quadrotors fly from where they start to the rings of their colours. Each plans its own path every ` +
  `${seconds(1, 2)} and may ask others for their plans; of those it does not ask, ${expected}. ` +
  `${flights.length > 1 ? "All policies fly the same episode, synchronised. " : ""}A plan is sent in answer to each request that arrives` +
  `${flights.some(flight => flight.announces) ? ", or announced without one" : ""}.` +
  (obstacles.length ? " All know the obstacles: where they are, how large, and how fast." : "") +
  (alike ? "" : ` Distances between robots count from surface to surface, plus ${contact.toFixed(2)} m.`) +
  (downwash === 1 ? "" : ` They keep out of the air that others blow down: vertical parts of distances count 1 / ${downwash}.`);
