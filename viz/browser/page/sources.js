"use strict";
// Where the frames come from: the page itself, the server of a result, or a run that goes on.

const SECRET = window.location.search; // "?token=..." where the server asks for one

class EmbeddedSource {
  // Everything is in the page.
  start(player) {
    const data = JSON.parse(document.getElementById("dyob-data").textContent);
    this.pictures = data.pictures;
    player.setup(data.setup);
    player.add(data.frames);
    player.setMap(fromBase64(document.getElementById("dyob-map").textContent), data.map);
    player.ready();
  }

  picture(k) {
    return this.pictures[k];
  }
}

class FetchedSource {
  // A server has everything; pictures are asked for when they are shown.
  async start(player) {
    const [data, map] = await Promise.all(["data", "map"].map(fetched));
    const { setup, frames, map: facts, pictures } = await data.json();
    this.pictures = pictures;
    player.setup(setup);
    player.add(frames);
    player.setMap(new Uint8Array(await map.arrayBuffer()), facts);
    player.ready();
  }

  picture(k) {
    return this.pictures[k] ? `picture/${k}${SECRET}` : null;
  }
}

class LiveSource {
  // A run sends what it has and then what comes; this page keeps it when the run is over.
  start(player) {
    this.player = player;
    this.pictures = [];
    this.facts = null;
    const address = new URL(`live${SECRET}`, window.location.href);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => (typeof data === "string" ? this.tell(JSON.parse(data)) : this.take(data));
    socket.onclose = () => player.ended();
  }

  tell(message) {
    const { player } = this;
    if (message.type === "setup") player.setup(message.setup);
    else if (message.type === "frames") player.add(message.frames);
    else if (message.type === "reset") player.reset(message.frames);
    else if (message.type === "map") this.facts = message.facts;
    else if (message.type === "ready") player.ready();
    else if (message.type === "end") player.ended();
  }

  // A map, which its facts went before, or the picture of a frame; the first four bytes say which.
  take(buffer) {
    const kind = new DataView(buffer).getInt32(0, true);
    const rest = new Uint8Array(buffer, 4);
    if (kind < 0) {
      this.player.setMap(rest, this.facts);
      return;
    }
    this.pictures[kind] = URL.createObjectURL(new Blob([rest], { type: "image/jpeg" }));
    this.player.pictureCame(kind);
  }

  picture(k) {
    return this.pictures[k];
  }
}

async function fetched(name) {
  const answer = await fetch(name + SECRET);
  if (!answer.ok) throw new Error(`${name}: the server answered ${answer.status}`);
  return answer;
}

function fromBase64(text) {
  const bytes = atob(text.trim());
  const values = new Uint8Array(bytes.length);
  for (let n = 0; n < bytes.length; n++) values[n] = bytes.charCodeAt(n);
  return values;
}
