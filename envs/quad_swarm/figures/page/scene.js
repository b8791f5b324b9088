// The three-dimensional views: a scene for each flight, drawn side by side on one canvas with one camera.

import {
  AmbientLight, Color, DirectionalLight, HemisphereLight, PCFShadowMap, PerspectiveCamera, Scene, Vector3, WebGLRenderer,
} from "three";
import {data, flights, largest, position, radii} from "./data.js";
import {Ground} from "./ground.js";
import {labelHeight, Swarm} from "./robots.js";
import {isDark} from "./theme.js";

const FOV = 32;
const PALETTES = {
  light: {background: "#e9edf2", floor: "#f8fafc", lines: "#b9c2cc", ink: "#5a6673", shadow: 0.3},
  dark: {background: "#0d1117", floor: "#171d26", lines: "#3a4654", ink: "#93a1b0", shadow: 0.55},
};

// What must be in the picture: starts, goals and paths. A robot that strays far after a collision may leave it.
const ends = flights[0].positions[0].concat(flights[0].goals);
const near = [0, 1, 2].map(k => [Math.min(...ends.map(p => p[k])) - 2 * largest, Math.max(...ends.map(p => p[k])) + 2 * largest]);
const visited = flights.flatMap(flight => flight.positions.filter((_, k) => k % 3 === 0).flat().concat(flight.goals))
  .map(p => p.map((x, k) => k < 2 ? Math.min(Math.max(x, near[k][0]), near[k][1]) : x));
// Of obstacles that stand, what is among the robots or beside them
const feet = [];
for (const {moves, radius, positions: [[x, y]]} of flights.flatMap(flight => flight.obstacles)) {
  if (moves) continue;
  const clipped = (at, k) => Math.min(Math.max(at, near[k][0] - 0.7), near[k][1] + 0.7), z = flights[0].goals[0][2];
  for (const [east, north] of [[-1, 0], [1, 0], [0, -1], [0, 1]]) feet.push([clipped(x + east * radius, 0), clipped(y + north * radius, 1), z]);
}
visited.push(...feet);
const bounds = {
  low: [0, 1, 2].map(k => Math.min(...visited.map(p => p[k])) - largest),
  high: [0, 1, 2].map(k => Math.max(...visited.map(p => p[k])) + largest),
};
const middle = new Vector3(...bounds.low.map((low, k) => (low + bounds.high[k]) / 2));

// Azimuth and elevation of the presets (rad). From the right above the figures on the floor can be read.
export const PRESETS = {
  perspective: {azimuth: -1.05, elevation: 0.5, tall: 0.85},
  top: {azimuth: -Math.PI / 2, elevation: Math.PI / 2 - 0.001},
  side: {azimuth: -Math.PI / 2, elevation: 0.06},
};

// Tall pictures are filled by looking from higher up.
const direction = ({azimuth, elevation: low, tall = low}, aspect) => {
  const elevation = tall + (low - tall) * Math.min(1, Math.max(0, (aspect - 0.8) / 0.9));
  return new Vector3(Math.cos(azimuth) * Math.cos(elevation), Math.sin(azimuth) * Math.cos(elevation), Math.sin(elevation));
};

// A camera from a direction that has the whole flight in the picture, below a head of the given share of its height.
export function framed(preset, aspect, head) {
  const away = direction(PRESETS[preset], aspect), up = new Vector3(0, 0, 1);
  const right = new Vector3().crossVectors(up, away).normalize(), above = new Vector3().crossVectors(away, right);
  const tall = Math.tan(FOV * Math.PI / 360), wide = tall * aspect;
  const points = visited.map(p => new Vector3(...p).sub(middle));
  // The shadows too, where they can be seen
  if (preset !== "side") points.push(...flights[0].goals.concat(feet).map(([x, y]) => new Vector3(x, y, 0).sub(middle)));
  const [left, bottom, top] = [0.95, -0.94, 0.94 - 2 * head];
  let distance = 12, x0 = 0, y0 = 0;
  for (let pass = 0; pass < 12; pass++) {
    let [west, east, south, north] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const p of points) {
      const depth = Math.max(distance - p.dot(away), 0.5), x = p.dot(right) - x0, y = p.dot(above) - y0, r = largest;
      west = Math.min(west, (x - r) / depth / wide); east = Math.max(east, (x + r) / depth / wide);
      south = Math.min(south, (y - r) / depth / tall); north = Math.max(north, (y + r) / depth / tall);
    }
    x0 += (east + west) / 2 * distance * wide;
    y0 += ((north + south) / 2 - (top + bottom) / 2) * distance * tall;
    distance *= Math.max((east - west) / (2 * left), (north - south) / (top - bottom));
  }
  const target = middle.clone().addScaledVector(right, x0).addScaledVector(above, y0);
  return {target, position: target.clone().addScaledVector(away, distance)};
}

export class Views {
  // :raises Error: there is no WebGL
  constructor(canvas) {
    this.renderer = new WebGLRenderer({canvas, antialias: true, powerPreference: "high-performance"});
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.renderer.autoClear = false;
    this.camera = new PerspectiveCamera(FOV, 1, 0.05, 200);
    this.camera.up.set(0, 0, 1);
    this.background = new Color();
    this.scenes = flights.map(flight => {
      const scene = new Scene(), swarm = new Swarm(flight, bounds.high[2] + 0.6), ground = new Ground(bounds), sky = new HemisphereLight();
      const sun = new DirectionalLight("#fff6e8", 2.2), reach = Math.hypot(...[0, 1, 2].map(k => bounds.high[k] - bounds.low[k])) / 2 + 0.5;
      sky.position.set(0, 0, 1);
      sun.position.set(middle.x - 2, middle.y - 2.5, 11);
      sun.target.position.set(middle.x, middle.y, 0);
      sun.castShadow = true;
      sun.shadow.mapSize.set(1024, 1024);
      sun.shadow.radius = 2.5;
      sun.shadow.bias = -0.0005;
      Object.assign(sun.shadow.camera, {left: -reach, right: reach, bottom: -reach, top: reach, near: 1, far: 25});
      scene.add(swarm.group, ground.group, sky, sun, sun.target, new AmbientLight("#ffffff", 0.35));
      return {scene, swarm, ground, sky};
    });
    this.paint();
  }

  paint() {
    this.dark = isDark();
    const palette = PALETTES[this.dark ? "dark" : "light"];
    this.background.set(palette.background);
    for (const {scene, ground, sky} of this.scenes) {
      scene.background = this.background;
      ground.paint(palette);
      sky.color.set(this.dark ? "#b8cce8" : "#ffffff");
      sky.groundColor.set(this.dark ? "#39424f" : "#b9b2a8");
      sky.intensity = this.dark ? 1.5 : 1.7;
    }
  }

  resize(width, height, ratio) {
    this.size = [width, height];
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
  }

  // :param rects: where each view is, {x, y, width, height}, CSS pixels from the upper left corner, and the size of labels
  // :param eye: (view, positions) -> {position, target}, where the camera of a view is
  draw(t, rects, eye, {fades = false, border} = {}) {
    const {renderer, camera} = this, height = this.size[1];
    renderer.setScissorTest(false);
    renderer.setClearColor(border ?? this.background, 1);
    renderer.clear();
    renderer.setScissorTest(true);
    this.scenes.forEach(({scene, swarm}, view) => {
      const rect = rects[view], box = [rect.x, height - rect.y - rect.height, rect.width, rect.height];
      if (rect.width < 1 || rect.height < 1) return;
      const labelSize = rect.label / rect.height * 2 * Math.tan(FOV * Math.PI / 360);
      swarm.update(t, {fades, dark: this.dark, labelSize, size: [rect.width, rect.height]});
      const {position: from, target} = eye(view, swarm.positions);
      // A camera inside a robot, or right behind it, would see nothing else
      swarm.robots.forEach((robot, i) => { robot.group.visible = from.distanceTo(robot.group.position) > 2 * radii[i]; });
      camera.position.copy(from);
      camera.lookAt(target);
      camera.aspect = rect.width / rect.height;
      camera.updateProjectionMatrix();
      renderer.setViewport(...box);
      renderer.setScissor(...box);
      renderer.render(scene, camera);
    });
  }

  // The robot of a view that is drawn nearest to a place in it (pixels), if that is near.
  robotAt(view, x, y, rect, {position: from, target}) {
    const {camera} = this;
    camera.position.copy(from);
    camera.lookAt(target);
    camera.aspect = rect.width / rect.height;
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
    let best = null, nearest = 28;
    this.scenes[view].swarm.positions.forEach((p, i) => {
      // Its body, or its number
      for (const above of [0, labelHeight(i)]) {
        const at = new Vector3(p[0], p[1], p[2] + above).project(camera);
        const away = Math.hypot((at.x + 1) / 2 * rect.width - x, (1 - at.y) / 2 * rect.height - y);
        if (at.z < 1 && away < nearest) [best, nearest] = [i, away];
      }
    });
    return best;
  }
}

// Behind a robot, looking where it flies; a robot that hovers is seen from where it came.
export function chasing(view, robot, t) {
  const flight = flights[view], now = Math.min(t, flight.steps), around = 0.4 / data.dt;
  const here = new Vector3(...position(flight, robot, now, [0, 0, 0]));
  const way = new Vector3();
  for (let k = -8; k <= 8; k++) {
    // Both ends of a window that slides over the flight, its middle weighing most
    const a = position(flight, robot, Math.max(0, now + (k / 4 - 0.5) * around), [0, 0, 0]);
    const b = position(flight, robot, Math.max(0, now + (k / 4 + 0.5) * around), [0, 0, 0]);
    way.addScaledVector(new Vector3(b[0] - a[0], b[1] - a[1], 0), 9 - Math.abs(k));
  }
  const goal = new Vector3(...flight.goals[robot]), start = new Vector3(...flight.positions[0][robot]);
  way.addScaledVector(goal.sub(start).setZ(0).normalize(), 0.6).normalize();
  return {
    position: here.clone().addScaledVector(way, -2.6).add(new Vector3(0, 0, 1.0)),
    target: here.clone().addScaledVector(way, 0.9),
  };
}

