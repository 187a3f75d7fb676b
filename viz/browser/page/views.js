"use strict";
// From where one looks: behind the moving camera, from above, or freely.

const SMOOTH_FRAMES = 6; // to each side, over which the heading is averaged

class Views {
  constructor(viewer, world, frames) {
    this.viewer = viewer;
    this.world = world;
    this.frames = frames;
    this.mode = "follow";
    this.touched = false; // whether a person has turned the view since it was chosen
    viewer.controls.enableKeys = false;
    viewer.controls.addEventListener("start", () => (this.touched = true));
  }

  set(mode) {
    this.mode = mode;
    this.touched = false;
    this.rig = null;
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
  span() {
    const { THREE } = MeshCat, box = new THREE.Box3();
    for (const { p } of this.frames.list) box.expandByPoint(this.world.toThree(p));
    for (const id of this.frames.moved) {
      for (const { p } of this.frames.paths.get(id)) box.expandByPoint(this.world.toThree(p));
    }
    for (const [right, forward, up] of this.world.facts.extent_m) {
      box.expandByPoint(new THREE.Vector3(right, up, -forward));
    }
    if (box.isEmpty()) box.expandByPoint(new THREE.Vector3());
    return box.expandByScalar(0.3 * this.world.facts.scale_m);
  }

  top() {
    const { camera, controls } = this.viewer, box = this.span();
    const size = box.getSize(new MeshCat.THREE.Vector3());
    this.lens(25);
    const upright = camera.aspect < 1; // a phone's screen, whose upper part the picture takes
    // The map's length lies along the screen's; turned, what is ahead is to the right.
    const turned = upright ? size.x > 1.2 * size.z : size.z > 1.2 * size.x;
    const [wide, deep] = turned ? [size.z, size.x] : [size.x, size.z];
    const half = Math.tan((camera.fov * Math.PI) / 360);
    const room = upright ? 0.48 : 0.76; // of the screen's height: the rest is taken by the controls
    const away = 0.5 * Math.max(deep / room, wide / (0.96 * camera.aspect)) / half + size.y;
    box.getCenter(controls.target);
    const tilt = 1e-3 * away; // a view straight down has no upright
    camera.position.copy(controls.target);
    camera.position.add(new MeshCat.THREE.Vector3(turned ? tilt : 0, away, turned ? 0 : tilt));
    const down = upright ? 0 : 0.12 * half * away; // the middle of what the controls leave free
    const shift = turned ? [down, 0, 0] : [0, 0, down];
    camera.position.add(new MeshCat.THREE.Vector3(...shift));
    controls.target.add(new MeshCat.THREE.Vector3(...shift));
    this.viewer.set_dirty();
  }

  overview() {
    const { camera, controls } = this.viewer, box = this.span();
    const radius = 0.5 * box.getSize(new MeshCat.THREE.Vector3()).length();
    this.lens(50);
    box.getCenter(controls.target);
    const away = new MeshCat.THREE.Vector3(-0.55, 0.62, 0.75).normalize();
    const fit = Math.min(1, camera.aspect / 1.5);
    controls.target.y -= 0.12 * radius; // the controls take the lowest part of the screen
    camera.position.copy(controls.target).addScaledVector(away, (1.35 * radius) / fit);
    this.viewer.set_dirty();
  }

  lens(fov) {
    const { camera } = this.viewer, s = this.world.facts.scale_m;
    camera.fov = fov;
    camera.near = 0.01 * s;
    camera.far = 20 * this.span().getSize(new MeshCat.THREE.Vector3()).length() + 100 * s;
    camera.updateProjectionMatrix();
  }
}
