// Who asks whom: arcs with an arrowhead at the one who is asked. A light runs along in the asker's colour, and back in
// that of the one who is asked: its plan. An announced plan is a dashed arc, along which a light runs one way, from its owner
// and in its colour. All arcs of a view are one instanced mesh, bent by the vertex shader.

import {
  BufferAttribute, Color, DynamicDrawUsage, InstancedBufferAttribute, InstancedBufferGeometry, Mesh, ShaderMaterial, Vector2,
} from "three";
import {colour, nPairs, nRobots, stepAt} from "./data.js";

const SAMPLES = 26;
const FADE = 0.25; // s in which an arc fades after the last step with its request
const PERIOD = 0.9; // s that the light takes there and back

const vertexShader = `
attribute vec2 place; // along the arc 0..1, of which the last tenth is the head; and the side, -1 or 1
attribute vec3 from, to, asker, asked;
attribute float strength, phase, announced;
uniform vec2 size;
uniform float width;
varying vec3 near, far;
varying float along, shown, began, side, dashed;

vec3 bent(float u) {
  vec3 chord = to - from;
  float reach = length(chord);
  vec3 aside = normalize(vec3(chord.y, -chord.x, 0.0) + vec3(1e-6, 0.0, 0.0));
  vec3 top = 0.5 * (from + to) + vec3(0.0, 0.0, 0.22 * reach + 0.1) + 0.12 * reach * aside;
  float begin = min(0.3, 0.16 / reach), end = 1.0 - min(0.3, 0.3 / reach);
  float w = mix(begin, end, u);
  return mix(mix(from, top, w), mix(top, to, w), w);
}

void main() {
  vec4 start = projectionMatrix * viewMatrix * vec4(bent(0.0), 1.0);
  vec4 end = projectionMatrix * viewMatrix * vec4(bent(1.0), 1.0);
  float pixels = max(length((end.xy / end.w - start.xy / start.w) * size * 0.5), 1.0);
  float head = clamp((5.0 + 3.0 * width) / pixels, 0.03, 0.4);
  bool inHead = place.x > 0.9;
  float u = inHead ? mix(1.0 - head, 1.0, (place.x - 0.91) / 0.09) : place.x / 0.9 * (1.0 - head);
  vec4 here = projectionMatrix * viewMatrix * vec4(bent(u), 1.0);
  vec4 ahead = projectionMatrix * viewMatrix * vec4(bent(u + 0.01), 1.0);
  vec2 way = (ahead.xy / ahead.w - here.xy / here.w) * size;
  way = length(way) > 1e-4 ? normalize(way) : vec2(1.0, 0.0);
  float half_width = inHead ? (1.0 - (place.x - 0.91) / 0.09) * (1.6 + 1.5 * width) : 0.5 * width;
  here.xy += place.y * half_width * vec2(-way.y, way.x) / size * 2.0 * here.w;
  gl_Position = here;
  near = asker; far = asked; along = u; shown = strength; began = phase; side = place.y; dashed = announced;
}`;

const fragmentShader = `
#define DASHES 8.0
uniform float time, base, glow;
varying vec3 near, far;
varying float along, shown, began, side, dashed;

void main() {
  bool oneWay = dashed > 0.5;
  if (oneWay && along < 0.85 && fract(along * DASHES) > 0.55) discard;
  float beat = fract(time + began);
  bool back = beat > 0.5 && !oneWay;
  float at = back ? 2.0 - 2.0 * beat : fract(2.0 * beat);
  float light = smoothstep(0.13, 0.0, abs(along - at));
  vec3 lit = mix(back ? far : near, vec3(1.0), glow * light);
  gl_FragColor = vec4(mix(near, lit, light), shown * min(1.0, base + light * (0.3 + 0.5 * base)));
  #include <colorspace_fragment>
}`;

export class Requests {
  constructor() {
    const places = new Float32Array(4 * SAMPLES + 8), index = [];
    for (let s = 0; s < SAMPLES + 2; s++) {
      const u = s < SAMPLES ? 0.9 * s / (SAMPLES - 1) : s === SAMPLES ? 0.91 : 1;
      places.set([u, -1, u, 1], 4 * s);
      if (s <= SAMPLES) index.push(2 * s, 2 * s + 1, 2 * s + 2, 2 * s + 1, 2 * s + 3, 2 * s + 2);
    }
    const geometry = this.geometry = new InstancedBufferGeometry();
    geometry.setAttribute("place", new BufferAttribute(places, 2));
    geometry.setIndex(index);
    for (const [name, size] of [["from", 3], ["to", 3], ["asker", 3], ["asked", 3], ["strength", 1], ["phase", 1], ["announced", 1]]) {
      const attribute = new InstancedBufferAttribute(new Float32Array(size * nPairs), size).setUsage(DynamicDrawUsage);
      geometry.setAttribute(name, attribute);
    }
    this.uniforms = {size: {value: new Vector2()}, width: {value: 2}, time: {value: 0}, base: {value: 0.8}, glow: {value: 0.3}};
    const material = new ShaderMaterial({
      vertexShader, fragmentShader, uniforms: this.uniforms, transparent: true, depthWrite: false, depthTest: false, side: 2,
    });
    this.mesh = new Mesh(geometry, material);
    this.mesh.frustumCulled = false;
    this.mesh.renderOrder = 3;
    this.colours = Array.from({length: nRobots}, (_, i) => new Color(colour(i)));
  }

  // A paused picture shows the requests of its step alone; a moving one lets them fade.
  update(flight, t, dt, positions, fades, dark) {
    const step = stepAt(flight, t), strengths = new Map(), reach = fades ? Math.ceil(FADE / dt) : 0;
    for (let k = Math.max(0, step - reach); k <= step; k++) {
      const left = k === step ? 1 : 1 - (t - k - 1) * dt / FADE;
      if (left > 0) for (const [i, j, announced] of flight.requests[k]) strengths.set(i * nRobots + j, [left, announced]);
    }
    const {from, to, asker, asked, strength, phase, announced: unasked} = this.geometry.attributes;
    let count = 0;
    for (const [pair, [left, announced]] of strengths) {
      const gets = Math.floor(pair / nRobots), gives = pair % nRobots, [i, j] = announced ? [gives, gets] : [gets, gives];
      from.setXYZ(count, ...positions[i]);
      to.setXYZ(count, ...positions[j]);
      asker.setXYZ(count, this.colours[i].r, this.colours[i].g, this.colours[i].b);
      asked.setXYZ(count, this.colours[gives].r, this.colours[gives].g, this.colours[gives].b);
      strength.setX(count, left);
      phase.setX(count, 0.618 * pair % 1);
      unasked.setX(count, announced ? 1 : 0);
      count++;
    }
    for (const attribute of [from, to, asker, asked, strength, phase, unasked]) attribute.needsUpdate = true;
    this.geometry.instanceCount = count;
    this.mesh.visible = count > 0;
    // With full communication, single arcs cannot be followed anyway. They are thin and pale, so that robots stay visible
    const crowd = Math.min(1, Math.max(0, (Math.max(...[step, step - 1].map(k => flight.requests[k]?.length ?? 0)) - 6) / 40));
    this.uniforms.width.value = 2.6 - 1.6 * crowd;
    this.uniforms.base.value = (dark ? 0.9 : 0.95) - 0.7 * crowd;
    this.uniforms.glow.value = dark ? 0.55 : 0.15;
    this.uniforms.time.value = t * dt / PERIOD;
  }
}
