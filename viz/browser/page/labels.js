"use strict";
// Words beside boxes, on a canvas over the scene, each where it finds room.

const ROWS = 5; // how far above its box a label may look for room, in its own heights

class Labels {
  constructor(canvas, viewer, world) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.viewer = viewer;
    this.world = world;
    this.shown = true;
    this.reserved = []; // rectangles that controls and the picture cover
    this.placed = [];
  }

  resize(width, height) {
    const ratio = window.devicePixelRatio || 1;
    [this.width, this.height] = [width, height];
    [this.canvas.width, this.canvas.height] = [width * ratio, height * ratio];
    this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  }

  draw() {
    this.pen.clearRect(0, 0, this.width, this.height);
    this.placed = [];
    const { shown, layers } = this.world;
    if (!this.shown || !layers.objects || !shown) return;
    const seen = shown.boxes.map((box) => this.look(box)).filter((label) => label);
    seen.sort((a, b) => a.rank - b.rank || a.depth - b.depth);
    for (const label of seen) this.place(label);
    // What is near lies above what is far.
    for (const label of [...this.placed].sort((a, b) => b.depth - a.depth)) this.drawOne(label);
  }

  // Where the top of a box lies on the screen (CSS pixels), and how its label looks.
  look(box) {
    const { THREE } = MeshCat, { axes } = this.world;
    const corners = [];
    for (let n = 0; n < 8; n++) {
      const local = new THREE.Vector3((n & 1) - 0.5, ((n >> 1) & 1) - 0.5, ((n >> 2) & 1) - 0.5);
      corners.push(local.multiply(new THREE.Vector3(...box.size)).applyQuaternion(box.q));
    }
    const top = Math.max(...corners.map((corner) => corner.dot(axes.up)));
    const anchor = this.project(box.p.clone().addScaledVector(axes.up, top));
    const middle = this.project(box.p);
    if (!anchor || !middle) return null;
    const [x, y] = anchor;
    if (x < 0 || y < 0 || x > this.width || y > this.height) return null;
    const moves = box.state === "moving";
    const tall = Math.abs(middle[1] - y);
    if (box.state === "stopped" && tall < 3 && this.viewer.camera.fov > 30) return null;
    const size = moves ? 13 : 12;
    this.pen.font = this.font(size, moves);
    const width = this.pen.measureText(box.words).width + (moves ? 14 : 18);
    return { box, x, y, size, moves, width, height: size + 8, depth: anchor[2], rank: moves ? 0 : 1 };
  }

  project(point) {
    const at = this.world.toThree(point).project(this.viewer.camera);
    if (at.z > 1 || at.z < -1) return null;
    return [(0.5 + 0.5 * at.x) * this.width, (0.5 - 0.5 * at.y) * this.height, at.z];
  }

  place(label) {
    const { x, y, width, height } = label;
    for (let row = 0; row <= ROWS; row++) {
      for (const side of [0, 0.42, -0.42]) {
        const left = clamp(x + (side - 0.5) * width, 4, this.width - width - 4);
        const top = y - 9 - height - row * (height + 3);
        const spot = { left, top, right: left + width, bottom: top + height };
        const taken = [...this.placed.map(({ spot: other }) => other), ...this.reserved];
        if (top < 4 || taken.some((other) => overlaps(spot, other))) continue;
        this.placed.push({ ...label, spot });
        return;
      }
      if (!label.moves && row === 1) return; // what stands still does not push its way up
    }
  }

  drawOne({ box, x, y, size, moves, spot }) {
    const { pen } = this;
    const coasting = box.state === "coasting";
    pen.strokeStyle = box.color;
    pen.lineWidth = 1.5;
    pen.globalAlpha = moves ? 1 : 0.8;
    pen.beginPath();
    pen.moveTo(clamp(x, spot.left + 6, spot.right - 6), spot.bottom);
    pen.lineTo(x, y);
    pen.stroke();
    pen.globalAlpha = 1;
    pen.fillStyle = moves ? box.color : "rgba(14, 16, 20, 0.82)";
    rounded(pen, spot, 5);
    pen.fill();
    if (!moves) {
      pen.setLineDash(coasting ? [4, 3] : []);
      pen.lineWidth = coasting ? 1.5 : 1;
      pen.stroke();
      pen.setLineDash([]);
    }
    pen.font = this.font(size, moves);
    pen.fillStyle = moves ? inkOn(box.color) : "#e2e2e6";
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillText(box.words, 0.5 * (spot.left + spot.right), 0.5 * (spot.top + spot.bottom) + 0.5);
  }

  font(size, strong) {
    return `${strong ? 600 : 400} ${size}px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif`;
  }
}

function overlaps(a, b) {
  return a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), Math.max(low, high));
}

function rounded(pen, { left, top, right, bottom }, radius) {
  pen.beginPath();
  pen.moveTo(left + radius, top);
  pen.arcTo(right, top, right, bottom, radius);
  pen.arcTo(right, bottom, left, bottom, radius);
  pen.arcTo(left, bottom, left, top, radius);
  pen.arcTo(left, top, right, top, radius);
  pen.closePath();
}

// White or dark ink, whichever is the more legible on a colour "#rrggbb".
function inkOn(color) {
  const [r, g, b] = [1, 3, 5].map((n) => parseInt(color.slice(n, n + 2), 16));
  return 0.299 * r + 0.587 * g + 0.114 * b > 125 ? "#26262a" : "#ffffff";
}
