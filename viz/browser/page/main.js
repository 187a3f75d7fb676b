"use strict";
// Starts the page. `window.dyob` is a small door for scripts, such as the tests.

(() => {
  const sources = { embedded: EmbeddedSource, fetched: FetchedSource, live: LiveSource };
  const source = new sources[document.body.dataset.source]();
  const player = new Player(new MeshCat.Viewer(byId("scene")), source);
  window.dyob = {
    player,
    get ready() {
      return player.isReady;
    },
    get frame() {
      return player.k;
    },
    get length() {
      return player.frames.length;
    },
    seek: (k) => player.step(k - player.k),
    view: (mode) => player.setView(mode),
    // Boxes as they lie in meshcat's tree now: world positions in m, and pixels of the screen.
    boxes: () => {
      player.viewer.render(); // which is what turns the view's camera
      const shown = [...player.world.boxes.entries()].filter(([, { group }]) => group.visible);
      return shown.map(([id, { group }]) => {
        const at = player.labels.project(group.position);
        return { id, position: group.position.toArray(), pixel: at && at.slice(0, 2) };
      });
    },
    labels: () => player.labels.placed.map(({ box, spot }) => ({ words: box.words, ...spot })),
  };
  Promise.resolve(source.start(player)).catch((error) => {
    byId("title").textContent = "The scene could not be read";
    byId("notes").textContent = String(error.message || error);
    throw error;
  });
})();
