// Pillars and spheres: bodies without a colour of their own. A pillar is as high as the world, so it fades out above the robots.

import {BufferAttribute, CircleGeometry, CylinderGeometry, Group, Mesh, MeshStandardMaterial, SphereGeometry} from "three";
import {obstaclePosition} from "./data.js";

const PAINT = {light: "#b9bec6", dark: "#66717e"};
const BARE = 0.55; // of a pillar, below the part that fades

const upright = (radius, low, high) => new CylinderGeometry(radius, radius, high - low, 40, 1, true).rotateX(Math.PI / 2).translate(0, 0, (low + high) / 2);

function fading(radius, low, high) {
  const geometry = upright(radius, low, high), {position} = geometry.attributes, shown = new Float32Array(4 * position.count).fill(1);
  for (let v = 0; v < position.count; v++) shown[4 * v + 3] = position.getZ(v) > (low + high) / 2 ? 0 : 1;
  geometry.setAttribute("color", new BufferAttribute(shown, 4));
  return geometry;
}

export class Obstacles {
  // :param top: where pillars have faded out (m)
  constructor(flight, top) {
    this.flight = flight;
    this.group = new Group();
    const rest = {roughness: 0.95, transparent: true, opacity: 0.85};
    this.paints = [new MeshStandardMaterial(rest), new MeshStandardMaterial({...rest, vertexColors: true, depthWrite: false})];
    this.bodies = flight.obstacles.map(({shape, radius}) => {
      const body = new Group(), whole = shape === "sphere" ? new SphereGeometry(radius, 40, 24) : upright(radius, 0, BARE * top);
      const mesh = new Mesh(whole, this.paints[0]);
      mesh.castShadow = true;
      body.add(mesh);
      // From above, one looks down to its foot
      if (shape !== "sphere") body.add(new Mesh(fading(radius, BARE * top, top), this.paints[1]), new Mesh(new CircleGeometry(radius, 40).translate(0, 0, 0.005), this.paints[0]));
      this.group.add(body);
      return body;
    });
  }

  update(t, dark) {
    for (const paint of this.paints) paint.color.set(PAINT[dark ? "dark" : "light"]);
    this.flight.obstacles.forEach((obstacle, k) => {
      const [x, y, z] = obstaclePosition(obstacle, t);
      this.bodies[k].position.set(x, y, obstacle.shape === "sphere" ? z : 0);
    });
  }
}
