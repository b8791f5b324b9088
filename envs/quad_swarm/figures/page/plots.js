// What is drawn below the views: closest two robots and requests so far, over time.

import {contact, data, flights, grouped, last, metres as inMetres, nPairs, percent, seconds} from "./data.js";

const LEFT = 46, RIGHT = 10;
export const top = 2 * contact; // m, where the axis of separation ends: 2 cm must be seen beside the contact distance
const mostAsked = () => Math.max(1, ...flights.map(flight => flight.asked.at(-1)));

export const timeScale = width => step => LEFT + (width - LEFT - RIGHT) * step / Math.max(last, 1);
export const stepUnder = (x, width) => (x - LEFT) / (width - LEFT - RIGHT) * Math.max(last, 1);

export function add(parent, name, attributes, text) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const key in attributes) node.setAttribute(key, attributes[key]);
  if (text !== undefined) node.textContent = text;
  parent.append(node);
  return node;
}

export function begin(svg, height) {
  const width = Math.max(svg.clientWidth, 200);
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.style.height = `${height}px`;
  return width;
}

export const cursor = (svg, height) => add(svg, "line", {class: "cursor", y1: 0, y2: height});

function timeAxis(svg, x, y, width) {
  const total = last * data.dt, unit = [0.5, 1, 2, 5, 10, 20, 50].find(one => total / one <= width / 70) ?? 100;
  for (let time = 0; time <= total + 1e-9; time += unit) {
    const at = x(time / data.dt);
    add(svg, "line", {class: "tick", x1: at, x2: at, y1: y, y2: y + 4});
    add(svg, "text", {x: at, y: y + 16, "text-anchor": "middle"}, `${Number(time.toFixed(1))} s`);
  }
}

export function drawSeparation(svg, flight) {
  const height = 204, low = 178, high = 12, width = begin(svg, height), x = timeScale(width);
  const y = metres => low - (low - high) * Math.min(metres, top) / top;
  const unit = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5].find(one => top / one <= 7) ?? 10;
  add(svg, "rect", {class: "forbidden", x: LEFT, y: y(contact), width: width - LEFT - RIGHT, height: low - y(contact)});
  for (let metres = 0; metres <= top + 1e-9; metres += unit) {
    add(svg, "line", {class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(metres), y2: y(metres)});
    add(svg, "text", {x: LEFT - 6, y: y(metres) + 4, "text-anchor": "end"}, `${metres.toFixed(unit < 0.1 ? 2 : 1)}`);
  }
  add(svg, "line", {class: "contact", x1: LEFT, x2: width - RIGHT, y1: y(contact), y2: y(contact)});
  const inside = [], clipped = [];
  flight.separation.forEach((metres, k) => {
    const before = flight.separation[k - 1];
    if (k === 0) return;
    // Where a piece crosses the end of the axis both parts are drawn up to there
    const cut = (top - before) / (metres - before), at = k - 1 + cut;
    if (before <= top && metres <= top) inside.push(`M${x(k - 1)} ${y(before)}L${x(k)} ${y(metres)}`);
    else if (before > top && metres > top) clipped.push(`M${x(k - 1)} ${y(top)}H${x(k)}`);
    else if (before > top) { clipped.push(`M${x(k - 1)} ${y(top)}H${x(at)}`); inside.push(`M${x(at)} ${y(top)}L${x(k)} ${y(metres)}`); }
    else { inside.push(`M${x(k - 1)} ${y(before)}L${x(at)} ${y(top)}`); clipped.push(`M${x(at)} ${y(top)}H${x(k)}`); }
  });
  add(svg, "path", {class: "curve", d: inside.join("")});
  if (clipped.length) add(svg, "path", {class: "clipped", d: clipped.join("")});
  const {closest, closestStep} = flight, at = x(closestStep), low_ = closest < 0.16 * top;
  add(svg, "circle", {class: flight.collision === null ? "minimum" : "minimum collided", cx: at, cy: y(closest), r: 4.5});
  const [end, side] = at < width / 2 ? [width - RIGHT - 6, "end"] : [LEFT + 6, "start"];
  add(svg, "text", {class: "contact-label", x: end, y: y(contact) + 15, "text-anchor": side}, `contact ${contact.toFixed(2)}\u00a0m`);
  // Below the dot, where the curve is not; beside it, where there is no room below
  const aside = at > width - 130 ? [at - 10, "end"] : [at + 10, "start"];
  const [left, anchor] = low_ ? aside : [Math.min(Math.max(at, LEFT + 60), width - RIGHT - 60), "middle"];
  add(svg, "text", {class: "minimum-label", x: left, y: y(closest) + (low_ ? -4 : 19), "text-anchor": anchor},
    `minimum ${inMetres(closest)}${closest > top ? ", above the axis" : ""}`);
  timeAxis(svg, x, low, width);
  svg.setAttribute("aria-label", `Distance of the closest two robots over time: at least ${closest.toFixed(2)} metres, ` +
    `at ${seconds(closestStep, 2)}. Contact is at ${contact.toFixed(2)} metres.`);
  return cursor(svg, low);
}

export function drawRequests(svg, flight) {
  const height = 116, low = 90, high = 14, width = begin(svg, height), x = timeScale(width), most = mostAsked();
  const y = count => low - (low - high) * count / most, total = flight.asked.at(-1);
  for (const count of [0, most]) {
    add(svg, "line", {class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(count), y2: y(count)});
    add(svg, "text", {x: LEFT - 6, y: y(count) + 4, "text-anchor": "end"}, grouped(count));
  }
  const steps = flight.asked.map((count, k) => `${k ? "L" : "M"}${x(k)} ${y(count)}`).join("");
  add(svg, "path", {class: "area", d: `${steps}L${x(flight.steps)} ${y(0)}L${x(0)} ${y(0)}Z`});
  add(svg, "path", {class: "curve", d: steps});
  const share = `${grouped(total)} (${percent(total, flight.steps * nPairs)})`, right = x(flight.steps) > width - 110;
  add(svg, "text", {class: "minimum-label", x: x(flight.steps) + (right ? -4 : 8), y: y(total) + (!right ? 4 : y(total) > 40 ? -6 : 16), "text-anchor": right ? "end" : "start"}, share);
  timeAxis(svg, x, low, width);
  svg.setAttribute("aria-label", `Requests so far over time: ${total} at the end.`);
  return cursor(svg, low);
}
