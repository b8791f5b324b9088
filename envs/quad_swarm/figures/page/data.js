// The flights that the page shows, and quantities derived from them at a time. Times are in steps, fractional between steps.

export const data = JSON.parse(document.getElementById("data").textContent);
export const flights = data.flights;
export const nRobots = flights[0].goals.length;
export const nPairs = nRobots * (nRobots - 1);
export const contact = data.collision_distance;
export const radii = data.radii ?? Array(nRobots).fill(data.radius); // m
export const largest = Math.max(...radii);
export const downwash = data.downwash ?? 1; // height over width of the ellipsoids that count as contact
export let last = 0;

for (const flight of flights) {
  // Requests made before each step
  flight.asked = [0];
  for (const step of flight.requests) flight.asked.push(flight.asked.at(-1) + step.length);
  flight.announces = flight.requests.some(step => step.some(pair => pair[2]));
  flight.touching = new Map();
  flight.obstacles ??= [];
  for (const obstacle of flight.obstacles) obstacle.moves = obstacle.positions.length > 1;
  derive(flight, flight.colliding.concat((flight.hitting ?? []).map(hit => hit.slice(0, 2))));
}

// :param colliding: step, and the robots that collide in it
function derive(flight, colliding) {
  flight.steps = flight.requests.length;
  last = Math.max(last, flight.steps);
  flight.closest = Math.min(...flight.separation);
  flight.closestStep = flight.separation.indexOf(flight.closest);
  if (flight.obstacle_distance) flight.closestObstacle = Math.min(...flight.obstacle_distance);
  for (const [step, ...robots] of colliding) {
    if (!flight.touching.has(step)) flight.touching.set(step, new Set());
    for (const robot of robots) flight.touching.get(step).add(robot);
  }
}

// A flight that is still under way grows by a step, see `quad_swarm.figures.live`.
export function append(flight, step) {
  flight.positions.push(step.positions);
  flight.attitudes.push(step.attitudes);
  flight.plans.push(step.plans);
  flight.requests.push(step.requests);
  flight.separation.push(step.separation);
  flight.asked.push(flight.asked.at(-1) + step.requests.length);
  flight.arrival ??= step.arrived ? flight.requests.length : null;
  const hits = (step.obstacles?.hitting ?? []).map(hit => hit.slice(0, 1)), colliding = step.colliding.concat(hits);
  flight.obstacles.forEach((obstacle, k) => { if (obstacle.moves) obstacle.positions.push(step.obstacles.positions[k]); });
  flight.obstacle_distance?.push(step.obstacles.distance);
  flight.collision ??= colliding.length ? flight.requests.length : null;
  derive(flight, colliding.map(robots => [flight.requests.length, ...robots]));
}

const capital = text => text[0].toUpperCase() + text.slice(1);
export const scenario = capital(data.scenario.replaceAll("_", " "));
export const title = `${scenario}, ${nRobots} robots`;
const source = data.source ?? `held-out episode ${data.episode} (set ${data.seed})`;
export const subtitle = [source, ...data.world].join(", ");
// A recording of robots holds what they asked for, and a lost request is not answered. In simulations each is
const asked = data.source !== undefined && !flights.some(flight => flight.announces);
export const counted = number => (asked ? number === 1 ? "request" : "requests" : number === 1 ? "plan sent" : "plans sent");
export const fileName = `${data.scenario}_${nRobots}_robots`;
export const fullName = flight => `${flight.name} (${flight.detail})`;

export const seconds = (step, digits = 1) => `${(step * data.dt).toFixed(digits)}\u00a0s`;
// With two decimals, and three where they decide on a collision
export const metres = distance => `${distance.toFixed(Math.abs(distance - contact) < 0.01 ? 3 : 2)}\u00a0m`;
export const grouped = number => String(number).replace(/\B(?=(\d{3})+$)/g, "\u202f");
export function percent(part, whole) {
  const share = 100 * part / whole;
  return `${share.toFixed(share === 0 || share >= 99.95 ? 0 : share < 0.1 ? 2 : 1)}\u00a0%`;
}

// Okabe and Ito's colours; after eight they repeat, darker and then lighter.
export function colour(i) {
  const base = data.colours[i % data.colours.length], round = Math.floor(i / data.colours.length) % 3;
  if (round === 0) return base;
  const mixed = [1, 3, 5].map(k => parseInt(base.slice(k, k + 2), 16)).map(v => round === 1 ? 0.68 * v : 0.45 * v + 140);
  return `#${mixed.map(v => Math.round(v).toString(16).padStart(2, "0")).join("")}`;
}

const lerp = (a, b, s) => a + s * (b - a);
const ends = (t, length) => {
  const k = Math.min(Math.max(Math.floor(t), 0), length - 1);
  return [k, Math.min(k + 1, length - 1), Math.min(Math.max(t - k, 0), 1)];
};

// Catmull-Rom interpolation: velocities are continuous, and positions at the steps are those that were flown.
export function position(flight, i, t, out) {
  const p = flight.positions, [k, next, s] = ends(t, p.length);
  const before = p[Math.max(k - 1, 0)][i], after = p[Math.min(next + 1, p.length - 1)][i], a = p[k][i], b = p[next][i];
  for (let x = 0; x < 3; x++) {
    out[x] = a[x] + 0.5 * s * (b[x] - before[x]
      + s * (2 * before[x] - 5 * a[x] + 4 * b[x] - after[x] + s * (3 * (a[x] - b[x]) + after[x] - before[x])));
  }
  return out;
}

// Obstacles fly straight on.
export function obstaclePosition(obstacle, t) {
  const [k, next, s] = ends(t, obstacle.positions.length);
  return obstacle.positions[k].map((x, axis) => lerp(x, obstacle.positions[next][axis], s));
}

// m from a robot's centre to the surface of an obstacle
export function toSurface(p, obstacle, t) {
  const q = obstaclePosition(obstacle, t), dz = obstacle.shape === "sphere" ? p[2] - q[2] : 0;
  return Math.hypot(p[0] - q[0], p[1] - q[1], dz) - obstacle.radius;
}

// m, where vertical parts count less with downwash, and surfaces count as if all robots had the world's radius
export const apart = (p, q, i, j) => Math.hypot(p[0] - q[0], p[1] - q[1], (p[2] - q[2]) / downwash) - (radii[i] + radii[j] - 2 * data.radius);

export function attitude(flight, i, t) {
  const [k, next, s] = ends(t, flight.attitudes.length);
  return flight.attitudes[k][i].map((angle, x) => lerp(angle, flight.attitudes[next][i][x], s));
}

// A plan begins where its robot is: between two steps it is blended with the next one.
export function plan(flight, i, t) {
  const [k, next, s] = ends(t, flight.plans.length);
  return flight.plans[k][i].map((point, m) => point.map((x, axis) => lerp(x, flight.plans[next][i][m][axis], s)));
}

export const stepAt = (flight, t) => Math.min(Math.floor(t + 1e-6), flight.steps - 1);
export const askedUntil = (flight, t) => flight.asked[stepAt(flight, t) + 1];
export const possibleUntil = (flight, t) => (stepAt(flight, t) + 1) * nPairs;
export const separationAt = (flight, t) => flight.separation[Math.min(Math.ceil(t - 1e-6), flight.steps)];
export const hasCollided = (flight, t) => flight.collision !== null && Math.ceil(t - 1e-6) >= flight.collision;
export const touchingAt = (flight, t) => flight.touching.get(Math.min(Math.ceil(t - 1e-6), flight.steps));
export const hasArrived = (flight, t) => flight.arrival !== null && t >= flight.arrival;
