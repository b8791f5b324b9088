// Quadrotors, the spheres around them, and their goals.

import {
  BoxGeometry, BufferAttribute, CanvasTexture, CircleGeometry, Color, CylinderGeometry, DoubleSide, Euler, Group, Mesh,
  MeshBasicMaterial, MeshStandardMaterial, ShaderMaterial, SphereGeometry, Sprite, SpriteMaterial, SRGBColorSpace,
  TorusGeometry,
} from "three";
import {mergeGeometries} from "three/addons/utils/BufferGeometryUtils.js";
import {apart, attitude, colour, contact, data, downwash, nRobots, plan, position, radii, touchingAt, toSurface} from "./data.js";
import {Obstacles} from "./obstacles.js";
import {Requests} from "./requests.js";
import {Tubes} from "./tubes.js";

export const labelHeight = i => radii[i] + 0.12; // m above its robot
export const ALARM = "#e00000", WARNING = "#ffa000";
const TRAIL = 2.5, TRAIL_POINTS = 32; // s behind a robot
const SPIN = 41; // rad/s of a propeller as it is drawn: real ones would only flicker

const arm = 0.66 * data.radius, rotor = 0.4 * data.radius, thick = 0.085 * data.radius;
const tips = [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([x, y]) => [x * arm * Math.SQRT1_2, y * arm * Math.SQRT1_2]);

// White parts take the robot's colour, dark ones stay dark.
function painted(geometry, shade) {
  const plain = geometry.index ? geometry.toNonIndexed() : geometry, count = plain.attributes.position.count;
  plain.setAttribute("color", new BufferAttribute(new Float32Array(3 * count).fill(shade), 3));
  return plain;
}

function airframe() {
  const parts = [
    painted(new SphereGeometry(0.27 * data.radius, 20, 12).scale(1.3, 0.9, 0.6), 1),
    painted(new SphereGeometry(0.09 * data.radius, 10, 8).translate(0.31 * data.radius, 0, 0), 0.03), // the camera in front
  ];
  for (const [x, y] of tips) {
    parts.push(painted(new BoxGeometry(arm, 1.3 * thick, thick).rotateZ(Math.atan2(y, x)).translate(x / 2, y / 2, 0), 0.22));
    parts.push(painted(new CylinderGeometry(1.1 * thick, 1.3 * thick, 2.4 * thick, 10).rotateX(Math.PI / 2).translate(x, y, thick), 0.22));
    // Guards around the rotors; the front ones are brighter, so that the heading shows
    parts.push(painted(new TorusGeometry(rotor, 0.55 * thick, 6, 28).translate(x, y, 1.6 * thick), x > 0 ? 1 : 0.6));
  }
  return mergeGeometries(parts);
}

function propeller() {
  const blade = new BoxGeometry(1.85 * rotor, 0.6 * thick, 0.2 * thick);
  return mergeGeometries([blade, blade.clone().rotateZ(Math.PI / 2)]);
}

const shared = {
  airframe: airframe(),
  propeller: propeller(),
  disc: new CircleGeometry(0.95 * rotor, 24),
  bubble: new SphereGeometry(data.radius, 32, 20).scale(1, 1, downwash),
  ring: new TorusGeometry(data.goal_radius, 0.018, 8, 56),
  stem: new CylinderGeometry(0.008, 0.008, 1, 6).rotateX(Math.PI / 2).translate(0, 0, 0.5),
  foot: new CircleGeometry(0.07, 20),
};

// A soap bubble: clear where it is seen from the front, coloured at its rim
const bubbleShader = {
  vertexShader: `varying float facing;
void main() {
  vec4 here = modelViewMatrix * vec4(position, 1.0);
  facing = abs(dot(normalize(normalMatrix * normal), normalize(here.xyz)));
  gl_Position = projectionMatrix * here;
}`,
  fragmentShader: `uniform vec3 tint; uniform float core, rim; varying float facing;
void main() {
  gl_FragColor = vec4(tint, core + (rim - core) * pow(1.0 - facing, 2.2));
  #include <colorspace_fragment>
}`,
};

export function textTexture(text, {colour: fill, background, weight = 700}) {
  const canvas = document.createElement("canvas"), pen = canvas.getContext("2d"), size = 64;
  canvas.width = canvas.height = size;
  if (background) {
    pen.fillStyle = background;
    pen.beginPath(); pen.arc(size / 2, size / 2, size / 2 - 2, 0, 2 * Math.PI); pen.fill();
  }
  pen.fillStyle = fill;
  pen.font = `${weight} ${text.length > 1 ? 34 : 42}px system-ui, sans-serif`;
  pen.textAlign = "center"; pen.textBaseline = "middle";
  pen.fillText(text, size / 2, size / 2 + 3);
  const texture = new CanvasTexture(canvas);
  texture.colorSpace = SRGBColorSpace;
  return texture;
}

// Black or white, whichever is read more easily on a colour
export function inkOn(hex) {
  const {r, g, b} = new Color(hex);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b > 0.18 ? "#000000" : "#ffffff";
}

class Robot {
  constructor(i) {
    this.colour = new Color(colour(i));
    this.height = labelHeight(i);
    this.group = new Group();
    this.body = new Group();
    const tinted = new MeshStandardMaterial({color: this.colour, vertexColors: true, roughness: 0.45, metalness: 0.1});
    const frame = new Mesh(shared.airframe, tinted);
    frame.castShadow = true;
    this.body.add(frame);
    this.blur = new MeshBasicMaterial({color: this.colour, transparent: true, opacity: 0.45, side: DoubleSide, depthWrite: false});
    const blades = new MeshStandardMaterial({color: this.colour.clone().multiplyScalar(0.35), roughness: 0.6});
    this.propellers = tips.map(([x, y]) => {
      const mesh = new Mesh(shared.propeller, blades), disc = new Mesh(shared.disc, this.blur);
      mesh.position.set(x, y, 2.6 * thick);
      disc.position.set(x, y, 2.6 * thick);
      mesh.castShadow = true;
      this.body.add(mesh, disc);
      return mesh;
    });
    this.bubble = new Mesh(shared.bubble, new ShaderMaterial({
      ...bubbleShader, transparent: true, depthWrite: false,
      uniforms: {tint: {value: new Color()}, core: {value: 0}, rim: {value: 0}},
    }));
    for (const part of [this.body, this.bubble]) part.scale.setScalar(radii[i] / data.radius);
    this.bubble.renderOrder = 2;
    this.label = new Sprite(new SpriteMaterial({
      map: textTexture(String(i), {colour: inkOn(colour(i)), background: colour(i)}), depthTest: false, sizeAttenuation: false, transparent: true,
    }));
    this.label.renderOrder = 4;
    this.group.add(this.body, this.bubble, this.label);
  }

  goal(place) {
    const [x, y, z] = place, goal = new Group();
    const paint = new MeshStandardMaterial({color: this.colour, roughness: 0.5, emissive: this.colour, emissiveIntensity: 0.25});
    const pale = new MeshBasicMaterial({color: this.colour, transparent: true, opacity: 0.5});
    const ring = new Mesh(shared.ring, paint), stem = new Mesh(shared.stem, pale), foot = new Mesh(shared.foot, pale);
    ring.position.set(x, y, z);
    stem.position.set(x, y, 0);
    stem.scale.set(1, 1, Math.max(z, 1e-3));
    foot.position.set(x, y, 0.004);
    goal.add(ring, stem, foot);
    return goal;
  }

  update(p, [roll, pitch, yaw], time, state, dark, labelSize) {
    this.group.position.set(...p);
    this.body.setRotationFromEuler(new Euler(roll, pitch, yaw, "ZYX"));
    this.propellers.forEach((mesh, k) => { mesh.rotation.z = (k % 2 ? -1 : 1) * SPIN * time + k; });
    const {tint, core, rim} = this.bubble.material.uniforms;
    tint.value.set(state === "collision" ? ALARM : state === "close" ? WARNING : this.colour);
    core.value = state === "collision" ? 0.4 : state === "close" ? 0.1 : 0.05;
    rim.value = state === "collision" ? 0.95 : state === "close" ? 0.9 : dark ? 0.5 : 0.45;
    this.label.position.z = this.height;
    this.label.scale.set(labelSize, labelSize, 1);
  }
}

export class Swarm {
  // :param top: see `Obstacles`
  constructor(flight, top) {
    this.flight = flight;
    this.group = new Group();
    this.obstacles = new Obstacles(flight, top);
    this.robots = Array.from({length: nRobots}, (_, i) => new Robot(i));
    this.positions = this.robots.map(() => [0, 0, 0]);
    this.plans = new Tubes(nRobots, flight.plans[0][0].length);
    this.trails = new Tubes(nRobots, TRAIL_POINTS);
    this.plans.mesh.renderOrder = this.trails.mesh.renderOrder = 1;
    this.requests = new Requests();
    this.robots.forEach((robot, i) => this.group.add(robot.group, robot.goal(flight.goals[i])));
    this.group.add(this.obstacles.group, this.plans.mesh, this.trails.mesh, this.requests.mesh);
  }

  // :param t: steps :param clock: s, of what moves although the flight stands still
  update(t, {fades, dark, labelSize, size}) {
    const {flight, positions} = this, now = Math.min(t, flight.steps);
    positions.forEach((p, i) => position(flight, i, now, p));
    const touching = touchingAt(flight, now), spin = t * data.dt;
    this.obstacles.update(now, dark);
    this.robots.forEach((robot, i) => {
      const p = positions[i];
      const close = positions.some((q, j) => j !== i && apart(p, q, i, j) < 1.1 * contact)
        || flight.obstacles.some(obstacle => toSurface(p, obstacle, now) - radii[i] < 0.1 * contact);
      const state = touching?.has(i) ? "collision" : close ? "close" : "free";
      robot.update(p, attitude(flight, i, now), spin, state, dark, labelSize);
      const ahead = plan(flight, i, now);
      ahead[0] = p;
      this.plans.set(i, ahead, robot.colour, s => 0.035 * (1 - 0.5 * s), s => (dark ? 0.8 : 0.7) * (1 - 0.75 * s));
      const begin = Math.max(0, now - TRAIL / data.dt), path = [];
      for (let m = 0; m < TRAIL_POINTS; m++) path.push(position(flight, i, begin + (now - begin) * m / (TRAIL_POINTS - 1), [0, 0, 0]));
      this.trails.set(i, path, robot.colour, s => 0.012 * s, s => 0.55 * s);
    });
    this.plans.update();
    this.trails.update();
    this.requests.uniforms.size.value.set(...size);
    this.requests.update(flight, now, data.dt, positions, fades, dark);
  }
}
