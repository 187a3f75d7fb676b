"use strict";
// Lines of constant width on the screen, smooth or dashed: WebGL's own are one pixel wide.

const LINE_VERTEX = `
  attribute vec2 corner;  // x: which end, y: which side
  attribute vec3 a;
  attribute vec3 b;
  uniform vec2 resolution;
  uniform float width;
  varying vec2 along;
  void main() {
    vec4 va = modelViewMatrix * vec4(a, 1.0);
    vec4 vb = modelViewMatrix * vec4(b, 1.0);
    const float near = 1e-3;
    if (va.z > -near && vb.z < -near) va = mix(vb, va, (vb.z + near) / (vb.z - va.z));
    if (vb.z > -near && va.z < -near) vb = mix(va, vb, (va.z + near) / (va.z - vb.z));
    vec4 ca = projectionMatrix * va;
    vec4 cb = projectionMatrix * vb;
    vec2 sa = 0.5 * resolution * ca.xy / ca.w;
    vec2 sb = 0.5 * resolution * cb.xy / cb.w;
    float span = length(sb - sa);
    vec2 dir = span > 1e-4 ? (sb - sa) / span : vec2(1.0, 0.0);
    vec2 shift = 0.5 * width * (corner.y * vec2(-dir.y, dir.x) + (2.0 * corner.x - 1.0) * dir);
    vec4 clip = corner.x > 0.5 ? cb : ca;
    along = vec2(corner.x * span, 1.0) * clip.w;  // undone below: no perspective on the screen
    clip.xy += 2.0 * shift / resolution * clip.w;
    gl_Position = clip;
  }`;

const LINE_FRAGMENT = `
  uniform vec3 color;
  uniform float opacity;
  uniform float dash;
  varying vec2 along;
  void main() {
    if (dash > 0.0 && mod(along.x / along.y, 2.0 * dash) > dash) discard;
    gl_FragColor = vec4(color, opacity);
  }`;

const RESOLUTION = { value: new MeshCat.THREE.Vector2(1, 1) }; // CSS pixels, shared by all lines

class FatLines extends MeshCat.THREE.Mesh {
  // Segments in one colour, of which the first some are shown.
  constructor(color, width, { opacity = 1, dash = 0 } = {}) {
    const material = new MeshCat.THREE.ShaderMaterial({
      vertexShader: LINE_VERTEX,
      fragmentShader: LINE_FRAGMENT,
      transparent: opacity < 1,
      side: MeshCat.THREE.DoubleSide,
      uniforms: {
        color: { value: new MeshCat.THREE.Color(color) },
        opacity: { value: opacity },
        width: { value: width },
        dash: { value: dash },
        resolution: RESOLUTION,
      },
    });
    super(new MeshCat.THREE.BufferGeometry(), material);
    this.frustumCulled = false;
    this.capacity = 0;
  }

  setLook({ color, width, opacity = 1, dash = 0 }) {
    const { uniforms } = this.material;
    if (color !== undefined) uniforms.color.value.set(color);
    if (width !== undefined) uniforms.width.value = width;
    uniforms.opacity.value = opacity;
    uniforms.dash.value = dash;
    this.material.transparent = opacity < 1;
  }

  // values: six numbers a segment, from a to b.
  setSegments(values) {
    const n = values.length / 6;
    if (n > this.capacity || this.capacity === 0) {
      this.geometry.dispose();
      this.capacity = Math.max(16, 2 * n);
      this.geometry = this.makeGeometry();
    }
    this.buffer.array.set(values);
    this.buffer.needsUpdate = true;
    this.show(n);
  }

  show(n) {
    this.geometry.instanceCount = n;
    this.visible = n > 0;
  }

  makeGeometry() {
    const { THREE } = MeshCat;
    const geometry = new THREE.InstancedBufferGeometry();
    const corners = new Float32Array([0, -1, 1, -1, 1, 1, 0, 1]);
    geometry.setAttribute("corner", new THREE.BufferAttribute(corners, 2));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    this.buffer = new THREE.InstancedInterleavedBuffer(new Float32Array(6 * this.capacity), 6, 1);
    geometry.setAttribute("a", new THREE.InterleavedBufferAttribute(this.buffer, 3, 0));
    geometry.setAttribute("b", new THREE.InterleavedBufferAttribute(this.buffer, 3, 3));
    return geometry;
  }
}

// The twelve edges of the cube of side one about the origin.
const CUBE_EDGES = (() => {
  const values = [];
  for (let corner = 0; corner < 8; corner++) {
    for (const bit of [1, 2, 4]) {
      if (corner & bit) continue;
      for (const end of [corner, corner | bit]) {
        values.push((end & 1) - 0.5, ((end >> 1) & 1) - 0.5, ((end >> 2) & 1) - 0.5);
      }
    }
  }
  return values;
})();
