// A worker of the player, in one of two roles.
//
// group:  decodes and keeps groups, or its tiles of them; frame t + view -> projected Gaussians of each band of rows, to the
//         worker of the band, or the visible ones packed for the GPU, or the attributes of all, to the page.
// raster: projected Gaussians of a band, a piece from each group worker that has tiles of the group -> its pixels, to the page.
//
// Two sets of group workers alternate: one shows its group while the other decodes the next, so decoded groups are never copied.
// Each worker keeps its tiles of the last reference, since more predicted groups will follow.

import { NONE, Native } from "./native.js";

const LOST = 8; // images after one of which pieces are missing, since a group worker has failed

const roles = { group: groupWorker, raster: rasterWorker };

self.onmessage = async ({ data }) => {
  const early = []; // what comes before the instance is there
  self.onmessage = (e) => early.push(e);
  const native = await Native.create(data.module);
  roles[data.role](native, data);
  for (const e of early) self.onmessage(e);
};

function groupWorker(native, { ports }) {
  const slots = new Map(); // group -> slot
  const spare = ports.map(() => []); // buffers that came back
  ports.forEach((port, i) => (port.onmessage = ({ data }) => spare[i].length < 3 && spare[i].push(data)));
  let shown = "";

  let kept = { slot: NONE }; // {key, slot} of the last reference

  function spareSlot() {
    let slot = 0;
    while (slot === kept.slot || [...slots.values()].includes(slot)) slot++;
    return slot;
  }

  // The slot of a reference, decoded if it is not the last one.
  function keep({ key, payload, wanted }, level, layers) {
    if (kept.key !== key) {
      if (kept.slot !== NONE) native.x.release(kept.slot);
      kept = { slot: NONE };
      const slot = spareSlot();
      native.decode(slot, payload, level, NONE, layers, wanted);
      kept = { key, slot };
    }
    return kept.slot;
  }

  function decode({ group, payload, level, bounds, layers, reference, wanted }) {
    const start = performance.now();
    const from = reference ? keep(reference, level, layers) : NONE;
    const slot = spareSlot();
    const header = native.decode(slot, payload, level, from, layers, wanted, false);
    slots.set(group, slot);
    shown = "";
    if (bounds) {
      evaluate(group, 0);
      header.means = native.attribute(0);
    }
    return { type: "decoded", group, header, ms: performance.now() - start };
  }

  // pose: of the track, see tracks.js; without one it is where it was made.
  function evaluate(group, t, pose) {
    const what = `${group} ${t} ${pose}`;
    if (shown === what) return;
    native.frame(slots.get(group), t);
    if (pose) native.place(pose);
    shown = what;
  }

  function draw({ id, group, t, pose, view, background, ends, piece, pieces }) {
    const start = performance.now();
    evaluate(group, t, pose);
    const { bands, load } = native.project(view, ports.length, ({ i, bands, first, rows, splats }) => {
      let buffer = spare[i].pop();
      if (!buffer || buffer.byteLength < splats.length) buffer = new ArrayBuffer(Math.ceil(splats.length * 1.2));
      new Uint8Array(buffer, 0, splats.length).set(splats);
      const own = { piece, pieces, length: splats.length, buffer };
      ports[i].postMessage({ id, bands, first, rows, width: view[0], background, own }, [buffer]);
    }, ends);
    return { type: "projected", id, bands, load, ms: performance.now() - start };
  }

  function pack({ id, group, t, pose, view, origin, all, piece }) {
    const start = performance.now();
    evaluate(group, t, pose);
    const { buffer } = native.pack(view, origin, all).slice();
    self.postMessage({ type: "packed", id, piece, buffer, ms: performance.now() - start }, [buffer]);
  }

  function attributes({ id, group, t }) {
    evaluate(group, t);
    const values = [0, 1, 2, 3, 4, 5].map((which) => native.attribute(which));
    self.postMessage({ type: "attributes", id, values }, values.map((v) => v.buffer));
  }

  self.onmessage = ({ data }) => {
    try {
      if (data.type === "decode") self.postMessage(decode(data));
      else if (data.type === "draw") self.postMessage(draw(data));
      else if (data.type === "pack") pack(data);
      else if (data.type === "attributes") attributes(data);
      else if (data.type === "release" && slots.has(data.group)) {
        native.x.release(slots.get(data.group));
        slots.delete(data.group);
        shown = "";
      }
    } catch (e) {
      // a trap leaves the instance in an unknown state
      const fatal = e instanceof WebAssembly.RuntimeError || e instanceof RangeError;
      self.postMessage({ type: "failed", group: data.group, id: data.id, message: e.message, fatal });
    }
  };
}

function rasterWorker(native) {
  const spare = [];
  const waiting = new Map(); // id -> pieces of an image that have arrived, with their ports
  const draw = ({ id, bands, first, rows, width, background }, pieces) => {
    const start = performance.now();
    const drawn = native.draw(pieces.map(({ own }) => new Uint8Array(own.buffer, 0, own.length)), width, rows, background);
    for (const { port, own } of pieces) port.postMessage(own.buffer, [own.buffer]);
    let pixels = spare.pop();
    if (pixels?.byteLength !== drawn.length) pixels = new ArrayBuffer(drawn.length);
    new Uint8Array(pixels).set(drawn);
    self.postMessage({ type: "band", id, bands, first, rows, width, pixels, ms: performance.now() - start }, [pixels]);
  };
  const take = (port, data) => {
    const { id, own } = data;
    const all = waiting.get(id) ?? [];
    all.push({ port, own });
    waiting.set(id, all);
    if (all.length < own.pieces) return;
    for (const k of waiting.keys()) if (k === id || k < id - LOST) waiting.delete(k);
    draw(data, all.sort((a, b) => a.own.piece - b.own.piece));
  };
  const listen = (port) => {
    port.onmessage = ({ data }) => {
      try {
        take(port, data);
      } catch (e) {
        self.postMessage({ type: "failed", id: data.id, message: e.message, fatal: true });
      }
    };
  };
  self.onmessage = ({ data }) => {
    if (data.port) listen(data.port); // of a group worker
    else if (spare.length < 3) spare.push(data);
  };
}
