"use strict";
// Time and controls: what is shown when, and what a person can press.

const SPEEDS = [0.25, 0.5, 1, 2, 4];
const KEYS = {
  " ": "play", ArrowLeft: "back", ArrowRight: "on", Home: "first", End: "last",
  1: "follow", 2: "top", 3: "free", "[": "slower", "]": "faster", t: "theme", i: "enlarge",
  r: "again", "?": "help", Escape: "close",
};

class Player {
  constructor(viewer, source) {
    this.viewer = viewer;
    this.source = source;
    this.frames = new Frames();
    this.world = new World(viewer, this.frames);
    this.views = new Views(viewer, this.world, this.frames);
    this.labels = new Labels(byId("labels"), viewer, this.world);
    this.k = 0;
    this.time = 0;
    this.speed = 1;
    this.playing = false;
    this.isReady = false;
    this.atEnd = false; // of a run that goes on: new frames are shown as they come
    this.bind();
    const render = viewer.render.bind(viewer);
    viewer.render = () => {
      this.world.beforeRender(viewer.camera);
      render();
      this.labels.draw();
    };
    requestAnimationFrame((now) => this.tick(now));
  }

  // ---- what the source tells

  setup(setup) {
    this.about = setup;
    this.isLive = this.atEnd = setup.live;
    this.frames.clear();
    this.frames.trailGapS = setup.trail_gap_s;
    this.world.setup(setup);
    document.title = `${setup.title} - DyOb-SLAM`;
    byId("title").textContent = setup.title;
    document.body.classList.toggle("live", this.isLive);
    byId("layer-truth").hidden = setup.truth.length === 0;
    this.setTheme(fromHash("theme") || setup.theme);
  }

  add(records) {
    this.frames.add(records);
    byId("slider").max = Math.max(this.frames.length - 1, 0);
    if (this.isReady && this.atEnd) this.seek(this.frames.length - 1);
    else if (this.isReady) this.showTime();
  }

  reset(records) {
    this.frames.clear();
    this.world.moved = true;
    this.frames.add(records);
    if (this.isReady) this.seek(Math.min(this.k, this.frames.length - 1));
  }

  setMap(bytes, facts) {
    this.world.setMap(bytes, facts);
    const thinned = facts.n_points < facts.n_all;
    const shown = facts.n_points.toLocaleString("en");
    const of = thinned ? ` of ${facts.n_all.toLocaleString("en")}` : "";
    byId("points").textContent = `${shown}${of} points`;
    this.showNotes();
    if (this.isReady) this.views.again();
  }

  ready() {
    this.isReady = true;
    this.layout();
    const asked = fromHash("frame");
    const k = this.frames.list.findIndex(({ index }) => String(index) === asked);
    this.seek(k >= 0 ? k : this.isLive ? this.frames.length - 1 : this.frames.poster());
    this.setView(["follow", "top", "free"].find((name) => name === fromHash("view")) || "follow");
    document.body.classList.add("ready");
  }

  ended() {
    if (!this.isLive || this.isOver) return;
    this.isOver = true;
    document.body.classList.add("over");
    byId("live").title = byId("live").textContent = "run ended";
    this.playing = false;
    this.showTime();
  }

  pictureCame(k) {
    if (k === this.k || this.isLive) this.showPicture();
  }

  // ---- time

  seek(k) {
    if (!this.frames.length) return;
    this.k = clamp(Math.round(k), 0, this.frames.length - 1);
    this.time = this.frames.list[this.k].time;
    this.show();
  }

  show() {
    const state = this.frames.state(this.k, this.time);
    this.world.show(state);
    this.views.apply(state);
    this.showTime();
    this.showPicture();
  }

  tick(now) {
    const passed = Math.min((now - (this.now || now)) / 1000, 0.25);
    this.now = now;
    if (this.playing && this.frames.length) {
      this.time = Math.min(this.time + passed * this.speed, this.frames.end);
      this.k = this.frames.at(this.time);
      if (this.time >= this.frames.end) {
        this.playing = false;
        this.atEnd = this.isLive && !this.isOver;
      }
      this.show();
    }
    requestAnimationFrame((next) => this.tick(next));
  }

  step(by) {
    this.playing = this.atEnd = false;
    this.seek(this.k + by);
  }

  play() {
    if (!this.playing && this.k >= this.frames.length - 1) this.seek(0);
    this.playing = !this.playing;
    this.atEnd = false;
    this.showTime();
  }

  setSpeed(speed) {
    this.speed = speed;
    byId("speed").value = String(speed);
  }

  // ---- what is seen

  showTime() {
    const frame = this.frames.list[this.k];
    if (!frame) return;
    byId("slider").value = this.k;
    const done = this.frames.length > 1 ? this.k / (this.frames.length - 1) : 0;
    byId("slider").style.setProperty("--done", `${100 * done}%`);
    byId("count").textContent = `frame ${frame.index}`;
    byId("of").textContent = `${this.k + 1} of ${this.frames.length}`;
    byId("clock").textContent = `${(frame.time - this.frames.start).toFixed(2)} s`;
    byId("lost").hidden = frame.tracked;
    document.body.classList.toggle("playing", this.playing);
    document.body.classList.toggle("at-end", this.atEnd && !this.isOver);
    byId("play").title = this.playing ? "pause (space)" : "play (space)";
  }

  showPicture() {
    let k = this.k;
    while (k > 0 && !this.source.picture(k)) k--; // the last one that there is
    const address = this.source.picture(k);
    const figure = byId("picture");
    const had = figure.hidden;
    figure.hidden = !address || !this.world.layers.image;
    byId("layer-image").hidden = !address;
    if (address && byId("frame").getAttribute("src") !== address) byId("frame").src = address;
    const late = address && this.k - k > 2;
    const notes = [late && `picture of frame ${this.frames.list[k].index}`, this.about.picture_note];
    byId("caption").textContent = notes.filter((note) => note).join(", ");
    if (had !== figure.hidden) this.layout();
  }

  showNotes() {
    byId("cell").textContent = this.world.cell ? `grid ${this.world.cell} m` : "";
    byId("notes").textContent = (this.about.notes || []).join(" · ");
  }

  setView(mode) {
    this.views.set(mode);
    for (const name of ["follow", "top", "free"]) {
      byId(name).setAttribute("aria-pressed", String(name === mode));
    }
  }

  setLayer(name, on) {
    if (name === "labels") this.labels.shown = on;
    else this.world.layers[name] = on;
    byId(`show-${name}`).checked = on;
    if (name === "image") this.showPicture();
    this.world.show();
  }

  setTheme(name) {
    this.theme = name in THEMES ? name : "dark";
    document.body.dataset.theme = this.theme;
    this.world.setTheme(this.theme);
  }

  layout() {
    const [width, height] = [window.innerWidth, window.innerHeight];
    this.viewer.set_3d_pane_size(width, height);
    this.world.resize(width, height);
    this.labels.resize(width, height);
    const panels = [...document.querySelectorAll(".panel")].filter((panel) => !panel.hidden);
    this.labels.reserved = panels.map((panel) => panel.getBoundingClientRect());
    if (byId("picture").classList.contains("large")) return;
    const [head, picture, controls] = ["head", "picture", "controls"].map(
      (id) => byId(id).getBoundingClientRect());
    this.views.arrange({ head, picture: picture.width > LEAST_PX ? picture : null, controls });
    this.viewer.set_dirty();
  }

  // ---- what a person does

  bind() {
    const press = {
      play: () => this.play(), back: () => this.step(-1), on: () => this.step(1),
      first: () => this.step(-Infinity), last: () => this.step(Infinity),
      follow: () => this.setView("follow"), top: () => this.setView("top"),
      free: () => this.setView("free"), again: () => this.setView(this.views.mode),
      slower: () => this.setSpeed(SPEEDS[Math.max(SPEEDS.indexOf(this.speed) - 1, 0)]),
      faster: () => this.setSpeed(SPEEDS[Math.min(SPEEDS.indexOf(this.speed) + 1, SPEEDS.length - 1)]),
      theme: () => this.setTheme(this.theme === "dark" ? "light" : "dark"),
      enlarge: () => this.enlarge(), help: () => (byId("help").hidden = !byId("help").hidden),
      close: () => { byId("help").hidden = true; this.enlarge(false); },
      live: () => { this.playing = false; this.atEnd = !this.isOver; this.seek(Infinity); },
    };
    for (const [name, act] of Object.entries(press)) {
      for (const button of document.querySelectorAll(`[data-press="${name}"]`)) {
        button.addEventListener("click", () => { act(); button.blur(); });
      }
    }
    document.addEventListener("keydown", (event) => {
      const name = KEYS[event.key];
      if (!name || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.target.tagName === "SELECT") return;
      event.preventDefault();
      press[name]();
    });
    byId("slider").addEventListener("input", ({ target }) => {
      this.playing = this.atEnd = false;
      this.seek(Number(target.value));
    });
    byId("speed").addEventListener("change", ({ target }) => this.setSpeed(Number(target.value)));
    for (const box of document.querySelectorAll("[data-layer]")) {
      box.addEventListener("change", () => { this.setLayer(box.dataset.layer, box.checked); box.blur(); });
    }
    this.world.layers.image = true;
    window.addEventListener("resize", () => this.layout());
    byId("frame").addEventListener("load", () => this.layout());
  }

  enlarge(on) {
    byId("picture").classList.toggle("large", on);
    this.layout();
  }
}

function byId(id) {
  return document.getElementById(id);
}

function fromHash(name) {
  return new URLSearchParams(window.location.hash.slice(1)).get(name);
}
