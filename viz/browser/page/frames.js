"use strict";
// What happened, frame by frame: poses of the camera and boxes, and what lies between two frames.

class Frames {
  constructor() {
    this.clear();
    this.trailGapS = 0.6;
  }

  clear() {
    this.list = [];
    this.paths = new Map(); // object id -> [{k, p}], the middles of its boxes
    this.moved = new Set(); // ids of objects that were ever seen moving
    this.colors = new Map();
    this.version = (this.version || 0) + 1;
  }

  get length() {
    return this.list.length;
  }

  get start() {
    return this.length ? this.list[0].time : 0;
  }

  get end() {
    return this.length ? this.list[this.length - 1].time : 0;
  }

  add(records) {
    for (const record of records) {
      const k = this.length;
      const boxes = new Map();
      for (const box of record.boxes) {
        const placed = { ...box, ...poseOf(box.pose) };
        boxes.set(box.id, placed);
        this.colors.set(box.id, box.color);
        if (!this.paths.has(box.id)) this.paths.set(box.id, []);
        this.paths.get(box.id).push({ k, p: placed.p });
        if (box.state === "moving") this.moved.add(box.id);
      }
      const { index, time, tracked } = record;
      this.list.push({ index, time, tracked, boxes, ...poseOf(record.camera) });
    }
    this.version++;
  }

  // The last frame that is not later than a time.
  at(time) {
    let low = 0, high = this.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.list[middle].time <= time + 1e-9) low = middle;
      else high = middle - 1;
    }
    return low;
  }

  // Camera and boxes at a time; between two frames they are moved evenly from one to the next.
  state(k, time) {
    const frame = this.list[k], next = this.list[k + 1];
    const share = next ? (time - frame.time) / Math.max(next.time - frame.time, 1e-9) : 0;
    const even = share > 1e-6 && next.tracked && frame.tracked;
    if (!even) return { k, frame, camera: frame, boxes: [...frame.boxes.values()] };
    const boxes = [...frame.boxes.values()].map((box) => between(box, next.boxes.get(box.id), share));
    return { k, frame, camera: between(frame, next, share), boxes };
  }

  cameraSegments() {
    const values = [];
    for (let k = 1; k < this.length; k++) {
      const [from, to] = [this.list[k - 1], this.list[k]];
      if (from.tracked && to.tracked) values.push({ k, from: from.p, to: to.p });
    }
    return values;
  }

  trailSegments(id) {
    const path = this.paths.get(id), values = [];
    for (let n = 1; n < path.length; n++) {
      const [from, to] = [path[n - 1], path[n]];
      const gap = this.list[to.k].time - this.list[from.k].time;
      if (gap <= this.trailGapS) values.push({ k: to.k, from: from.p, to: to.p });
    }
    return values;
  }

  // The frame that shows most: where most objects move, or the last one where nothing does.
  poster() {
    if (!this.moved.size) return this.length - 1;
    const moving = this.list.map(
      (frame) => [...frame.boxes.values()].filter((box) => box.state === "moving").length);
    return Math.max(0, moving.indexOf(Math.max(...moving)));
  }
}

// Position and turn of a pose of 3 x 4 numbers, row by row.
function poseOf(values) {
  const { THREE } = MeshCat;
  const matrix = new THREE.Matrix4().set(...values, 0, 0, 0, 1);
  const p = new THREE.Vector3(), q = new THREE.Quaternion();
  matrix.decompose(p, q, new THREE.Vector3());
  return { p, q };
}

function between(from, to, share) {
  if (!to) return from;
  return { ...from, p: from.p.clone().lerp(to.p, share), q: from.q.clone().slerp(to.q, share) };
}

// How many of some segments, which are in the order of time, lie before or in frame k.
function reach(segments, k) {
  let low = 0, high = segments.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (segments[middle].k <= k) low = middle + 1;
    else high = middle;
  }
  return low;
}

function flat(segments) {
  const values = new Float32Array(6 * segments.length);
  segments.forEach(({ from, to }, n) => values.set([from.x, from.y, from.z, to.x, to.y, to.z], 6 * n));
  return values;
}
