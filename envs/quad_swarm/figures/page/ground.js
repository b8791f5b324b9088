// The floor: a grid of metres that fades into the background, numbers along two of its sides, and shadows.

import {
  CanvasTexture, Color, Group, Mesh, MeshBasicMaterial, PlaneGeometry, ShaderMaterial, ShadowMaterial, SRGBColorSpace, Vector2,
} from "three";

const vertexShader = `varying vec2 place;
void main() { place = (modelMatrix * vec4(position, 1.0)).xy; gl_Position = projectionMatrix * viewMatrix * vec4(place, 0.0, 1.0); }`;

const fragmentShader = `uniform vec3 lines, floor_; uniform vec2 middle; uniform float reach; varying vec2 place;
float grid(float size, float width) {
  vec2 unit = place / size, wide = fwidth(unit);
  vec2 away = abs(fract(unit - 0.5) - 0.5) / max(wide, 1e-6);
  return (1.0 - clamp(min(away.x, away.y) - width, 0.0, 1.0)) * (1.0 - smoothstep(0.25, 0.6, max(wide.x, wide.y)));
}
void main() {
  float fade = 1.0 - smoothstep(0.55, 1.0, length(place - middle) / reach);
  float line = max(0.55 * grid(1.0, 0.1), 1.0 * grid(5.0, 0.5));
  gl_FragColor = vec4(mix(floor_, lines, line), fade);
  #include <colorspace_fragment>
}`;

export class Ground {
  constructor({low, high}) {
    this.group = new Group();
    const middle = [0, 1].map(k => (low[k] + high[k]) / 2), reach = 1.35 * Math.hypot(high[0] - low[0], high[1] - low[1]) / 2 + 2.2;
    const plane = new PlaneGeometry(2 * reach, 2 * reach);
    this.uniforms = {lines: {value: new Color()}, floor_: {value: new Color()}, middle: {value: new Vector2(...middle)}, reach: {value: reach}};
    const floor = new Mesh(plane, new ShaderMaterial({vertexShader, fragmentShader, uniforms: this.uniforms, transparent: true, depthWrite: false}));
    this.shade = new ShadowMaterial({opacity: 0.25, depthWrite: false});
    const shadows = new Mesh(plane, this.shade);
    shadows.receiveShadow = true;
    floor.renderOrder = -3;
    shadows.renderOrder = -2;
    for (const mesh of [floor, shadows]) {
      mesh.position.set(...middle, 0);
      this.group.add(mesh);
    }
    this.figures = [];
    const corner = [Math.floor(low[0] - 0.2), Math.floor(low[1] - 0.2)];
    for (const axis of [0, 1]) {
      for (let m = corner[axis] + 1; m <= Math.ceil(high[axis]); m++) {
        const place = [...corner, 0];
        place[axis] = m;
        place[1 - axis] -= 0.28;
        this.figures.push(this.figure(m === Math.ceil(high[axis]) ? `${m} m` : String(m).replace("-", "\u2212"), place));
      }
    }
  }

  figure(text, place) {
    const mesh = new Mesh(new PlaneGeometry(0.8, 0.4), new MeshBasicMaterial({transparent: true, depthWrite: false}));
    mesh.position.set(...place.slice(0, 2), 0.002);
    mesh.renderOrder = -1;
    this.group.add(mesh);
    return {mesh, text};
  }

  paint({lines, floor, ink, shadow}) {
    this.uniforms.lines.value.set(lines);
    this.uniforms.floor_.value.set(floor);
    this.shade.opacity = shadow;
    for (const {mesh, text} of this.figures) {
      const canvas = document.createElement("canvas"), pen = canvas.getContext("2d");
      [canvas.width, canvas.height] = [128, 64];
      pen.fillStyle = ink;
      pen.font = "500 38px system-ui, sans-serif";
      pen.textAlign = "center"; pen.textBaseline = "middle";
      pen.fillText(text, 64, 34);
      mesh.material.map?.dispose();
      mesh.material.map = new CanvasTexture(canvas);
      mesh.material.map.colorSpace = SRGBColorSpace;
      mesh.material.map.anisotropy = 8;
      mesh.material.needsUpdate = true;
    }
  }
}
