// Who receives whose plan: one lane per pair, grouped by the receiving robot, in the colour of the plan's owner.

import {colour, nRobots, percent} from "./data.js";
import {add, begin, cursor, stepUnder, timeScale} from "./plots.js";
import {inkOn} from "./robots.js";

const LANE = nRobots <= 4 ? 10 : nRobots <= 6 ? 7 : nRobots <= 8 ? 5 : nRobots <= 12 ? 3 : nRobots <= 20 ? 2 : 1;
const GAP = nRobots <= 12 ? 6 : 4;
const GROUP = Math.max((nRobots - 1) * LANE, 11);
const laneTop = (i, rank) => 2 + i * (GROUP + GAP) + rank * LANE;

export function drawTimeline(svg, flight) {
  const height = laneTop(nRobots, 0), width = begin(svg, height), x = timeScale(width), thick = LANE > 2 ? LANE - 1 : LANE;
  const steps = new Map();
  flight.requests.forEach((pairs, step) => {
    for (const [i, j] of pairs) {
      const runs = steps.get(i * nRobots + j) ?? [];
      if (runs.at(-1)?.[1] === step) runs.at(-1)[1] = step + 1;
      else runs.push([step, step + 1]);
      steps.set(i * nRobots + j, runs);
    }
  });
  for (let i = 0; i < nRobots; i++) {
    const group = add(svg, "g", {role: "listitem"}), middle = laneTop(i, 0) + GROUP / 2, r = Math.min(9, GROUP / 2 + 1);
    add(group, "rect", {class: "track", x: x(0), y: laneTop(i, 0), width: x(flight.steps) - x(0), height: GROUP});
    add(group, "circle", {cx: 16, cy: middle, r, fill: colour(i)});
    add(group, "text", {class: "number", x: 16, y: middle + 3.6, "text-anchor": "middle", style: `fill: ${inkOn(colour(i))}; font-size: ${Math.min(11, 2 * r - 2)}px`}, i);
    let asked = 0, rank = 0;
    for (let j = 0; j < nRobots; j++) {
      if (j === i) continue;
      const runs = steps.get(i * nRobots + j) ?? [], y = laneTop(i, rank++);
      const count = runs.reduce((sum, [from, to]) => sum + to - from, 0);
      asked += count;
      if (count === 0) continue;
      const d = runs.map(([from, to]) => `M${x(from).toFixed(1)} ${y}H${Math.max(x(to), x(from) + 1.5).toFixed(1)}v${thick}H${x(from).toFixed(1)}Z`).join("");
      add(group, "path", {class: "lane", "data-asker": i, "data-asked": j, "data-steps": count, fill: colour(j), d});
    }
    group.setAttribute("aria-label", `robot ${i} asks ${asked} times, ${percent(asked, flight.steps * (nRobots - 1))} of what it could`);
  }
  if (steps.size === 0) add(svg, "text", {class: "nobody", x: x(flight.steps / 2), y: height / 2, "text-anchor": "middle"}, "nobody asks anybody");
  return cursor(svg, height);
}

// What lies under a place in the timeline (pixels), in words.
export function wordsAt(svg, flight, x, y) {
  const step = Math.floor(stepUnder(x, svg.clientWidth)), i = Math.floor((y - 2) / (GROUP + GAP));
  const rank = Math.floor((y - laneTop(i, 0)) / LANE);
  if (step < 0 || step >= flight.steps || i < 0 || i >= nRobots || rank < 0 || rank >= nRobots - 1) return null;
  const j = rank < i ? rank : rank + 1, asked = flight.requests[step].find(([a, b]) => a === i && b === j);
  if (asked?.[2]) return {step, text: `step ${step}: robot ${j} sends its plan to robot ${i}`};
  return {step, text: `step ${step}: robot ${i} ${asked ? "asks" : "does not ask"} robot ${j}`};
}

