// Many round tubes in one mesh, rebuilt in place each frame: plans and trails.

import {BufferAttribute, BufferGeometry, DynamicDrawUsage, Mesh, MeshLambertMaterial} from "three";

const SIDES = 6;
const ROUND = Array.from({length: SIDES}, (_, s) => [Math.cos(2 * Math.PI * s / SIDES), Math.sin(2 * Math.PI * s / SIDES)]);

export class Tubes {
  // `points` is the most that a tube may have; unused ones fold into its last.
  constructor(count, points) {
    this.points = points;
    const vertices = count * points * SIDES, index = [];
    for (let tube = 0; tube < count; tube++) {
      for (let p = 0; p + 1 < points; p++) {
        for (let s = 0; s < SIDES; s++) {
          const a = (tube * points + p) * SIDES + s, b = (tube * points + p) * SIDES + (s + 1) % SIDES;
          index.push(a, b, a + SIDES, b, b + SIDES, a + SIDES);
        }
      }
    }
    const geometry = new BufferGeometry();
    this.attributes = ["position", "normal", "color"].map((name, k) => {
      const attribute = new BufferAttribute(new Float32Array(vertices * (k === 2 ? 4 : 3)), k === 2 ? 4 : 3);
      attribute.setUsage(DynamicDrawUsage);
      geometry.setAttribute(name, attribute);
      return attribute;
    });
    geometry.setIndex(index);
    const material = new MeshLambertMaterial({vertexColors: true, transparent: true, depthWrite: false});
    this.mesh = new Mesh(geometry, material);
    this.mesh.frustumCulled = false;
  }

  // `alpha` and `radius` are functions of the place along the tube, 0 to 1.
  set(tube, path, colour, radius, alpha) {
    const [position, normal, color] = this.attributes.map(attribute => attribute.array), final = path.length - 1;
    let [nx, ny, nz] = [0, 0, 1];
    for (let p = 0; p < this.points; p++) {
      const m = Math.min(p, final), here = path[m], before = path[Math.max(m - 1, 0)], after = path[Math.min(m + 1, final)];
      let tx = after[0] - before[0], ty = after[1] - before[1], tz = after[2] - before[2];
      const speed = Math.hypot(tx, ty, tz) || 1;
      tx /= speed; ty /= speed; tz /= speed;
      // The frame is carried along: it turns as little as the path does
      const along = nx * tx + ny * ty + nz * tz;
      nx -= along * tx; ny -= along * ty; nz -= along * tz;
      const norm = Math.hypot(nx, ny, nz);
      if (norm < 1e-6) [nx, ny, nz] = Math.abs(tz) < 0.9 ? [-ty, tx, 0] : [0, -tz, ty];
      const scale = 1 / Math.hypot(nx, ny, nz);
      nx *= scale; ny *= scale; nz *= scale;
      const bx = ty * nz - tz * ny, by = tz * nx - tx * nz, bz = tx * ny - ty * nx;
      const place = final ? m / final : 0, r = p > final ? 0 : radius(place), a = alpha(place);
      for (let s = 0; s < SIDES; s++) {
        const [c, d] = ROUND[s], v = 3 * ((tube * this.points + p) * SIDES + s), w = v / 3 * 4;
        position[v] = here[0] + r * (normal[v] = c * nx + d * bx);
        position[v + 1] = here[1] + r * (normal[v + 1] = c * ny + d * by);
        position[v + 2] = here[2] + r * (normal[v + 2] = c * nz + d * bz);
        color[w] = colour.r; color[w + 1] = colour.g; color[w + 2] = colour.b; color[w + 3] = a;
      }
    }
  }

  update() {
    for (const attribute of this.attributes) attribute.needsUpdate = true;
  }
}
