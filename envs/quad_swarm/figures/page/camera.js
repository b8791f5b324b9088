// One camera for all views: presets, following a robot, and turning it by mouse, fingers and keys.

import {MOUSE, PerspectiveCamera, TOUCH, Vector3} from "three";
import {OrbitControls} from "three/addons/controls/OrbitControls.js";
import {flights, position} from "./data.js";
import {chasing, framed} from "./scene.js";

const TURN = 0.12, ZOOM = 1.12; // rad and ratio of a key
const GLIDE = 450; // ms from one preset to another
const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;

export class Camera {
  // :param layout: () -> {aspect, head} of a view :param changed: called whenever the picture must be redrawn
  constructor(canvas, layout, changed) {
    this.layout = layout;
    this.changed = changed;
    this.preset = "perspective";
    this.robot = null;
    this.free = new PerspectiveCamera();
    this.free.up.set(0, 0, 1);
    this.orbit = new OrbitControls(this.free, canvas);
    Object.assign(this.orbit, {minDistance: 0.8, maxDistance: 60, zoomToCursor: false, screenSpacePanning: true});
    this.orbit.mouseButtons = {LEFT: MOUSE.ROTATE, MIDDLE: MOUSE.DOLLY, RIGHT: MOUSE.PAN};
    this.orbit.touches = {ONE: TOUCH.ROTATE, TWO: TOUCH.DOLLY_PAN};
    this.orbit.addEventListener("start", () => this.release());
    this.orbit.addEventListener("change", () => changed());
    this.frame();
  }

  // Until the user turns the camera, the presets' directions depend on the size of the window.
  frame() {
    if (this.preset === null || this.preset === "chase") return;
    const {aspect, head} = this.layout(), {position: from, target} = framed(this.preset, aspect, head);
    if (this.robot !== null) {
      const at = this.place(0);
      from.sub(target).setLength(5);
      target.copy(at);
      from.add(at);
    }
    this.free.position.copy(from);
    this.orbit.target.copy(target);
    this.orbit.update();
  }

  show(preset) {
    this.glide();
    this.preset = preset;
    if (preset === "chase" && this.robot === null) this.robot = 0;
    this.frame();
    this.changed();
  }

  follow(robot) {
    this.glide();
    this.robot = robot;
    if (robot === null && this.preset === "chase") this.preset = "perspective";
    this.preset ??= "perspective";
    this.frame();
    this.changed();
  }

  // Moves smoothly to the next view.
  glide() {
    if (calm || this.time === undefined) return;
    const from = flights.map((_, view) => {
      const {position: at, target} = this.eye(view, this.time);
      return {position: at.clone(), target: target.clone()};
    });
    this.gliding = {from, begin: performance.now()};
  }

  // From now on, only the user moves the camera.
  release() {
    this.gliding = null;
    if (this.preset === "chase") {
      const {position: from, target} = chasing(0, this.robot, this.time);
      const at = this.place(0);
      this.free.position.copy(from).sub(target).add(at);
      this.orbit.target.copy(at);
    }
    this.preset = null;
  }

  place(view) {
    return new Vector3(...position(flights[view], this.robot, Math.min(this.time ?? 0, flights[view].steps), [0, 0, 0]));
  }

  // The camera of a view at a time. If a robot is followed, it is around this robot in the view's own flight.
  eye(view, t) {
    this.time = t;
    const there = this.aim(view, t), {from, begin} = this.gliding ?? {};
    if (!from) return there;
    const share = (performance.now() - begin) / GLIDE, eased = share * share * (3 - 2 * share);
    if (share >= 1) {
      this.gliding = null;
      return there;
    }
    this.changed();
    const between = name => from[view][name].clone().lerp(there[name], eased);
    return {position: between("position"), target: between("target")};
  }

  aim(view, t) {
    if (this.preset === "chase") return chasing(view, this.robot, t);
    if (this.robot === null) return {position: this.free.position, target: this.orbit.target};
    const target = this.place(view);
    return {position: this.free.position.clone().sub(this.orbit.target).add(target), target};
  }

  turn(across, up, zoom = 1) {
    this.release();
    const away = this.free.position.clone().sub(this.orbit.target), radius = away.length() * zoom;
    const azimuth = Math.atan2(away.y, away.x) + across * TURN;
    const elevation = Math.min(1.57, Math.max(-0.1, Math.asin(away.z / away.length()) + up * TURN));
    away.set(Math.cos(azimuth) * Math.cos(elevation), Math.sin(azimuth) * Math.cos(elevation), Math.sin(elevation));
    this.free.position.copy(this.orbit.target).addScaledVector(away, Math.min(60, Math.max(0.8, radius)));
    this.orbit.update();
    this.changed();
  }

  key(event) {
    const keys = {a: [-1, 0], d: [1, 0], w: [0, 1], s: [0, -1], "+": [0, 0, 1 / ZOOM], "=": [0, 0, 1 / ZOOM], "-": [0, 0, ZOOM]};
    const arrows = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]};
    const move = event.shiftKey && arrows[event.key] || keys[event.key.toLowerCase()];
    if (move) this.turn(...move);
    return Boolean(move);
  }
}

export const presets = ["perspective", "top", "side", "chase"];
