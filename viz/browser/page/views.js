"use strict";
// From where one looks: behind the moving camera, from above, or freely.

const SMOOTH_FRAMES = 6; // to each side, over which the heading is averaged
const MUCH_NEARER = 0.85; // what a view must gain in distance to be taken in place of one before it
const LEAST_PX = 160; // a part of the screen that is smaller is no room for a view
const MOST_POINTS = 2000; // of the paths and of the map that are looked at to choose a view
const MOVED_PX = 30; // a panel that moved by less, as for one more line, leaves the view alone

class Views {
  constructor(viewer, world, frames) {
    this.viewer = viewer;
    this.world = world;
    this.frames = frames;
    this.mode = "follow";
    this.touched = false; // whether a person has turned the view since it was chosen
    this.rooms = [];
    viewer.controls.enableKeys = false;
    viewer.controls.addEventListener("start", () => (this.touched = true));
  }

  set(mode) {
    this.mode = mode;
    this.touched = false;
    this.rig = this.middle = null;
    if (mode === "top") this.top();
    else if (mode === "free") this.overview();
    this.apply(this.world.shown);
  }

  // After each change of time; the view that follows keeps how a person has turned it.
  apply(state) {
    if (!state || this.mode !== "follow") return;
    const { camera } = this.viewer, { target } = this.viewer.controls;
    const rig = this.rigAt(state);
    if (this.rig) {
      const moved = rig.clone().multiply(this.rig.clone().invert());
      camera.position.applyMatrix4(moved);
      target.applyMatrix4(moved);
    } else {
      const s = this.world.facts.scale_m;
      this.lens(55);
      camera.position.set(0, 0.72 * s, 1.2 * s).applyMatrix4(rig);
      target.set(0, -0.08 * s, -1.15 * s).applyMatrix4(rig);
      this.shift();
    }
    this.rig = rig;
    this.viewer.set_dirty();
  }

  // An upright frame at the camera, turned as it heads on the average of some frames.
  rigAt({ k, camera }) {
    const { THREE } = MeshCat;
    const heading = new THREE.Vector3();
    for (let n = k - SMOOTH_FRAMES; n <= k + SMOOTH_FRAMES; n++) {
      const frame = this.frames.list[Math.min(Math.max(n, 0), this.frames.length - 1)];
      heading.add(this.world.toThree(new THREE.Vector3(0, 0, 1).applyQuaternion(frame.q)));
    }
    heading.y = 0;
    if (heading.length() < 1e-3) heading.set(0, 0, -1);
    const turn = new THREE.Matrix4().makeRotationY(Math.atan2(-heading.x, -heading.z));
    return turn.setPosition(this.world.toThree(camera.p));
  }

  // What the camera and moving objects pass and most of the map, in three's coordinates.
  spread() {
    const { THREE } = MeshCat, { world, frames } = this;
    const passed = [frames.list, ...[...frames.moved].map((id) => frames.paths.get(id))].flat();
    const step = Math.ceil(passed.length / MOST_POINTS);
    const points = passed.filter((_, n) => n % step === 0).map(({ p }) => world.toThree(p));
    const margin = 0.3 * world.facts.scale_m, box = new THREE.Box3().setFromPoints(points);
    if (box.isEmpty()) box.expandByPoint(new THREE.Vector3());
    points.push(box.min.subScalar(margin), box.max.addScalar(margin));
    return points.concat(world.mapPoints(MOST_POINTS));
  }

  top() {
    const { THREE } = MeshCat, tilt = 1e-3; // a view straight down has no upright
    this.lens(25);
    this.fill([
      { ahead: new THREE.Vector3(0, -1, -tilt), right: new THREE.Vector3(1, 0, 0) },
      { ahead: new THREE.Vector3(-tilt, -1, 0), right: new THREE.Vector3(0, 0, -1) }, // turned
    ]);
  }

  overview() {
    this.lens(50);
    const ahead = new MeshCat.THREE.Vector3(0.55, -0.62, -0.75);
    this.fill([{ ahead, right: new MeshCat.THREE.Vector3(0.75, 0, 0.55) }]);
  }

  // Look along one of some directions into one of the free rooms, the first that shows it large.
  fill(directions) {
    const { camera, controls } = this.viewer;
    let best = null;
    for (const room of this.rooms) {
      for (const { ahead, right } of directions) {
        const stand = this.stand(ahead.normalize(), right.normalize(), room);
        if (!best || stand.away < MUCH_NEARER * best.away) best = { ...stand, room };
      }
    }
    camera.position.copy(best.eye);
    controls.target.copy(best.target);
    this.middle = [0.5 * (best.room.left + best.room.right), 0.5 * (best.room.top + best.room.bottom)];
    this.shift();
  }

  // Where to stand so that all there is just fills a part of the screen.
  stand(ahead, right, room) {
    const above = right.clone().cross(ahead);
    const focal = (0.5 * window.innerHeight) / Math.tan((this.viewer.camera.fov * Math.PI) / 360);
    const local = this.spread().map((p) => [p.dot(right), p.dot(above), p.dot(ahead)]);
    const half = [0.48 * (room.right - room.left), 0.48 * (room.bottom - room.top)];
    const span = (values) => [Math.min(...values), Math.max(...values)];
    const mean = ([low, high]) => 0.5 * (low + high);
    const center = [0, 1, 2].map((axis) => mean(span(local.map((p) => p[axis]))));
    let back = 0;
    for (let n = 0; n < 4; n++) { // center and distance depend on each other; this settles quickly
      back = Math.max(...local.map((p) => Math.max(
        ...[0, 1].map((axis) => (Math.abs(p[axis] - center[axis]) * focal) / half[axis] - p[2]))));
      for (const axis of [0, 1]) {
        const seen = local.map((p) => (p[axis] - center[axis]) / Math.max(p[2] + back, 1e-6));
        center[axis] += mean(span(seen)) * (center[2] + back);
      }
    }
    const eye = right.clone().multiplyScalar(center[0]);
    eye.addScaledVector(above, center[1]).addScaledVector(ahead, -back);
    const away = center[2] + back;
    return { eye, target: eye.clone().addScaledVector(ahead, away), away };
  }

  // The parts of the screen that no panel covers, the first of them over its whole width.
  arrange({ head, picture, controls }) {
    const [width, height] = [window.innerWidth, window.innerHeight];
    const bottom = controls.top || height;
    const room = (left, top, right) => ({ left, right, top, bottom });
    const rooms = [room(0, Math.max(head.bottom, picture ? picture.bottom : 0), width)];
    if (picture) rooms.push(room(0, head.bottom, picture.left));
    const wide = rooms.filter((r) => r.right - r.left > LEAST_PX && r.bottom - r.top > LEAST_PX);
    const before = this.rooms;
    this.rooms = wide.length ? wide : [room(0, 0, width)];
    const moved = (r, n) => !before[n] || ["left", "right", "top", "bottom"].some(
      (side) => Math.abs(r[side] - before[n][side]) > MOVED_PX);
    if (before.length !== this.rooms.length || this.rooms.some(moved)) this.again();
    else this.rooms = before;
    this.shift();
  }

  // Choose the view anew where a person has not turned it: there is more to see, or other room.
  again() {
    if (!this.touched && this.world.shown) this.set(this.mode);
  }

  // The middle of the view lies in the middle of its room, also when a person turns it.
  shift() {
    const [width, height] = [window.innerWidth, window.innerHeight];
    const [x, y] = this.middle || [0.5 * width, 0.5 * height];
    this.viewer.camera.setViewOffset(width, height, 0.5 * width - x, 0.5 * height - y, width, height);
    this.viewer.set_dirty();
  }

  lens(fov) {
    const { camera } = this.viewer, s = this.world.facts.scale_m;
    camera.fov = fov;
    camera.near = 0.01 * s;
    const { min, max } = new MeshCat.THREE.Box3().setFromPoints(this.spread());
    camera.far = 20 * min.distanceTo(max) + 100 * s;
    camera.updateProjectionMatrix();
  }
}
