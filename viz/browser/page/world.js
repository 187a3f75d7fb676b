"use strict";
// The scene in meshcat's tree: map, grid, camera, boxes, trails and truth, and how they look.

const THEMES = {
  dark: { ground: "#14171c", grid: "#3a414d", shade: 1.0, path: "#5ab4ff" },
  light: { ground: "#ffffff", grid: "#c9cdd3", shade: 0.82, path: "#0064be" },
};

// How the state of an object looks: what moves stands out.
const LOOKS = {
  moving: { faces: 0.3, edges: { width: 2.4, opacity: 1 } },
  stopped: { faces: 0.1, edges: { width: 1.3, opacity: 0.6 } },
  coasting: { faces: 0.05, edges: { width: 1.6, opacity: 0.8, dash: 5 } },
};

const POINT_VERTEX = `
  attribute vec3 color;
  uniform float radius;  // m
  uniform float scale;  // px a metre at a depth of one metre
  uniform vec2 limits;  // px
  varying vec3 ink;
  void main() {
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    gl_Position = projectionMatrix * seen;
    gl_PointSize = clamp(2.0 * radius * scale / -seen.z, limits.x, limits.y);
    ink = color;
  }`;

const POINT_FRAGMENT = `
  uniform float shade;
  varying vec3 ink;
  void main() {
    if (length(gl_PointCoord - 0.5) > 0.5) discard;
    gl_FragColor = vec4(ink * shade, 1.0);
  }`;

class World {
  constructor(viewer, frames) {
    this.viewer = viewer;
    this.frames = frames;
    this.boxes = new Map();
    this.trails = new Map();
    this.facts = { scale_m: 10, ground_m: -1.5, extent_m: [] };
    this.layers = { map: true, camera: true, objects: true, trails: true, truth: false };
    viewer.gui.domElement.style.display = "none";
    for (const name of ["Axes", "Grid"]) viewer.set_property([name], "visible", false);
    this.points = this.pointMaterial();
  }

  // up and forward are unit vectors of the world; meshcat's up is its z.
  turn({ up, forward }) {
    const { THREE } = MeshCat;
    const [f, u] = [new THREE.Vector3(...forward), new THREE.Vector3(...up)];
    const r = new THREE.Vector3().crossVectors(f, u);
    this.axes = { right: r, forward: f, up: u };
    const turned = new THREE.Matrix4().set(
      r.x, r.y, r.z, 0, f.x, f.y, f.z, 0, u.x, u.y, u.z, 0, 0, 0, 0, 1);
    this.viewer.set_transform(["dyob"], turned.toArray());
  }

  setup({ up, forward, camera, truth, palette }) {
    const { THREE } = MeshCat;
    this.turn({ up, forward });
    this.aperture = camera;
    this.path = this.put(["camera", "path"], new FatLines("#5ab4ff", 3));
    this.frustum = this.put(["camera", "frustum"], new FatLines(palette.frustum, 2));
    this.truth = this.put(["truth"], new FatLines(palette.truth.dark, 1.8, { dash: 7 }));
    this.truthColors = palette.truth;
    const pieces = truth.flatMap((line) => line.slice(1).map(
      (to, n) => ({ k: 0, from: new THREE.Vector3(...line[n]), to: new THREE.Vector3(...to) })));
    this.truth.setSegments(flat(pieces));
    this.grid = this.put(["grid"], new FatLines("#3a414d", 1, { opacity: 0.55 }));
    this.drawFrustum();
  }

  put(path, object) {
    this.viewer.set_object(["dyob", ...path], object);
    return object;
  }

  node(...path) {
    return this.viewer.scene_tree.find(["dyob", ...path]).object;
  }

  // World coordinates to three's, whose up is y.
  toThree(point) {
    const { right, forward, up } = this.axes;
    return new MeshCat.THREE.Vector3(point.dot(right), point.dot(up), -point.dot(forward));
  }

  setMap(bytes, facts) {
    this.facts = facts;
    this.turn(facts);
    if (this.cloud) this.cloud.material = null; // meshcat disposes of what it replaces
    this.viewer.handle_command_bytearray(bytes);
    this.cloud = this.viewer.scene_tree.find(["dyob", "map", "<object>"]).object;
    this.cloud.material = this.points;
    this.cloud.frustumCulled = false;
    this.cloud.castShadow = this.cloud.receiveShadow = false;
    this.points.uniforms.radius.value = 0.0068 * facts.scale_m;
    this.drawFrustum();
    this.drawGrid();
    this.show();
  }

  // Points of the map without its outskirts, at most so many, in three's coordinates.
  mapPoints(most) {
    const [low, high] = this.facts.extent_m, found = [];
    if (!this.cloud || !low) return found;
    const { array } = this.cloud.geometry.attributes.position, { Vector3 } = MeshCat.THREE;
    const step = 3 * Math.ceil(array.length / (3 * most));
    for (let n = 0; n < array.length; n += step) {
      const point = this.toThree(new Vector3(array[n], array[n + 1], array[n + 2]));
      const placed = [point.x, -point.z, point.y];
      if (placed.every((value, axis) => low[axis] <= value && value <= high[axis])) found.push(point);
    }
    return found;
  }

  pointMaterial() {
    const { THREE } = MeshCat;
    return new THREE.ShaderMaterial({
      vertexShader: POINT_VERTEX,
      fragmentShader: POINT_FRAGMENT,
      uniforms: {
        radius: { value: 0.05 }, scale: { value: 500 }, shade: { value: 1 },
        limits: { value: new THREE.Vector2(2, 8) },
      },
    });
  }

  drawFrustum() {
    const { left, right, top, bottom } = this.aperture, z = 0.19 * this.facts.scale_m;
    const at = (x, y) => [x * z, y * z, z];
    const corners = [at(left, top), at(right, top), at(right, bottom), at(left, bottom)];
    const values = [];
    corners.forEach((corner, n) => {
      values.push(0, 0, 0, ...corner, ...corner, ...corners[(n + 1) % 4]);
    });
    this.frustum.setSegments(new Float32Array(values));
  }

  // Lines on the ground about the path, as many metres apart as are easy to count with.
  drawGrid() {
    if (!this.frames.length) return;
    const { cell, low, high } = this.gridSpan();
    const { right, forward, up } = this.axes, height = this.facts.ground_m;
    const at = (x, z) => {
      const point = right.clone().multiplyScalar(x).addScaledVector(forward, z);
      return point.addScaledVector(up, height);
    };
    const segments = [];
    for (let x = low.x; x <= high.x + 1e-6; x += cell) {
      segments.push({ from: at(x, low.z), to: at(x, high.z) });
    }
    for (let z = low.z; z <= high.z + 1e-6; z += cell) {
      segments.push({ from: at(low.x, z), to: at(high.x, z) });
    }
    this.grid.setSegments(flat(segments));
    this.cell = cell;
  }

  gridSpan() {
    const { right, forward } = this.axes, margin = 4 * this.facts.scale_m;
    const low = { x: Infinity, z: Infinity }, high = { x: -Infinity, z: -Infinity };
    const widen = (x, z, by) => {
      for (const [axis, value] of [["x", x], ["z", z]]) {
        low[axis] = Math.min(low[axis], value - by);
        high[axis] = Math.max(high[axis], value + by);
      }
    };
    for (const { p } of this.frames.list) widen(p.dot(right), p.dot(forward), margin);
    for (const [x, z] of this.facts.extent_m) widen(x, z, 0);
    const span = Math.max(high.x - low.x, high.z - low.z);
    const cell = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200].find((c) => span / c <= 40) || 500;
    for (const axis of ["x", "z"]) {
      low[axis] = cell * Math.floor(low[axis] / cell);
      high[axis] = cell * Math.ceil(high[axis] / cell);
    }
    return { cell, low, high };
  }

  // Bring everything to where it is at a time.
  show(state = this.shown) {
    if (!state || !this.frames.length) return;
    this.shown = state;
    if (this.version !== this.frames.version) this.renewLines();
    const { camera, k } = state;
    this.viewer.set_transform(["dyob", "camera", "frustum"], matrixOf(camera).toArray());
    this.path.show(reach(this.pathSegments, k));
    for (const { line, segments } of this.trails.values()) line.show(reach(segments, k));
    for (const { group } of this.boxes.values()) group.visible = false;
    for (const box of state.boxes) this.showBox(box);
    this.showLayers();
    this.viewer.set_dirty();
  }

  renewLines() {
    this.version = this.frames.version;
    this.pathSegments = this.frames.cameraSegments();
    this.path.setSegments(flat(this.pathSegments));
    for (const id of this.trails.keys()) if (!this.frames.moved.has(id)) this.trails.get(id).line.show(0);
    for (const id of this.frames.moved) {
      if (!this.trails.has(id)) {
        const line = new FatLines(this.frames.colors.get(id), 2.6, { opacity: 0.9 });
        this.trails.set(id, { line: this.put(["trails", String(id)], line), segments: [] });
      }
      const trail = this.trails.get(id);
      const segments = this.frames.trailSegments(id);
      if (segments.length !== trail.segments.length || this.moved) trail.line.setSegments(flat(segments));
      trail.segments = segments;
    }
    this.moved = false;
    this.drawGrid();
  }

  showBox(box) {
    if (!this.boxes.has(box.id)) this.boxes.set(box.id, this.makeBox(box));
    const { group, faces, edges } = this.boxes.get(box.id);
    const look = LOOKS[box.state] || LOOKS.stopped;
    faces.material.opacity = look.faces;
    edges.setLook({ color: box.color, ...look.edges });
    const sized = matrixOf(box).scale(new MeshCat.THREE.Vector3(...box.size));
    this.viewer.set_transform(["dyob", "objects", String(box.id)], sized.toArray());
    group.visible = true;
  }

  makeBox({ id, color }) {
    const { THREE } = MeshCat, path = ["objects", String(id)];
    const glass = new THREE.MeshBasicMaterial({
      color, transparent: true, depthWrite: false, side: THREE.DoubleSide,
    });
    const faces = this.put([...path, "faces"], new THREE.Mesh(new THREE.BoxGeometry(1, 1, 1), glass));
    const edges = this.put([...path, "edges"], new FatLines(color, 2));
    edges.setSegments(new Float32Array(CUBE_EDGES));
    return { group: this.node(...path), faces, edges };
  }

  showLayers() {
    for (const [name, on] of Object.entries(this.layers)) this.node(name).visible = on;
  }

  setTheme(name) {
    const theme = THEMES[name];
    const rgb = new MeshCat.THREE.Color(theme.ground).toArray();
    for (const end of ["top_color", "bottom_color"]) this.viewer.set_property(["Background"], end, rgb);
    this.points.uniforms.shade.value = theme.shade;
    if (this.grid) this.grid.setLook({ color: theme.grid, opacity: 0.55 });
    if (this.path) this.path.setLook({ color: theme.path });
    if (this.truth) this.truth.setLook({ color: this.truthColors[name], dash: 7 });
    this.viewer.set_dirty();
  }

  resize(width, height) {
    RESOLUTION.value.set(width, height);
    this.height = height;
  }

  beforeRender(camera) {
    const ratio = this.viewer.renderer.getPixelRatio();
    const scale = (0.5 * this.height) / Math.tan((camera.fov * Math.PI) / 360);
    this.points.uniforms.scale.value = scale * ratio;
    this.points.uniforms.limits.value.set(2 * ratio, 7 * ratio);
  }
}

function matrixOf({ p, q }) {
  return new MeshCat.THREE.Matrix4().compose(p, q, new MeshCat.THREE.Vector3(1, 1, 1));
}
