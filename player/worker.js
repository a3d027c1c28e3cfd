// A worker of the player, in one of two roles.
//
// group:  decodes and keeps groups, or its tiles of them; frame t + view -> projected Gaussians of each band of rows,
//         to the worker of the band, or the visible ones packed for the GPU, or the attributes of all, to the page.
// raster: projected Gaussians of a band, a piece from each group worker that has tiles of the group -> its pixels, to
//         the page.
//
// Two sets of group workers alternate: one shows its group while the other decodes the next, so decoded groups are
// never copied. Each worker keeps its tiles of the last reference, since more predicted groups will follow.

import { NONE, Native } from "./native.js";

const LOST = 8; // newer images after which an image with missing pieces is dropped: a group worker has failed

const roles = { group: groupWorker, raster: rasterWorker };

self.onmessage = async ({ data }) => {
  const early = []; // messages that arrive before the instance is ready
  self.onmessage = (e) => early.push(e);
  const native = await Native.create(data.module);
  roles[data.role](native, data);
  for (const e of early) self.onmessage(e);
};

function groupWorker(native, { ports }) {
  const groups = new Map(); // group -> slots of its pieces
  const spare = ports.map(() => []); // buffers that came back
  ports.forEach((port, i) => (port.onmessage = ({ data }) => spare[i].length < 3 && spare[i].push(data)));

  let kept = { slot: NONE }; // {key, slot} of the last reference

  function spareSlot() {
    const used = new Set([kept.slot, ...[...groups.values()].flat()]);
    let slot = 0;
    while (used.has(slot)) slot++;
    return slot;
  }

  // The slot of a reference, decoded if it is not the last one.
  function keep({ key, payload, wanted, packed }, level, layers) {
    if (kept.key !== key) {
      if (kept.slot !== NONE) native.x.release(kept.slot);
      kept = { slot: NONE };
      const slot = spareSlot();
      native.decode(slot, payload, level, { layers, wanted, packed });
      kept = { key, slot };
    }
    return kept.slot;
  }

  // A group, or a piece of one that comes in pieces.
  function decode({ group, payload, level, bounds, layers, reference: before, wanted, packed }) {
    const start = performance.now();
    const reference = before ? keep(before, level, layers) : NONE;
    const slot = spareSlot();
    const header = native.decode(slot, payload, level, { reference, layers, wanted, keepLeading: false, packed });
    groups.set(group, [...(groups.get(group) ?? []), slot]);
    if (bounds) {
      native.frame(slot, 0);
      header.means = native.attribute(0);
    }
    const buffers = header.means ? [header.means.buffer] : [];
    self.postMessage({ type: "decoded", group, header, ms: performance.now() - start }, buffers);
  }

  // Appends bytes to the buffer of band i.
  function append(band, i, bytes) {
    const length = band.length + bytes.length;
    let buffer = band.buffer ?? spare[i].pop();
    if (!buffer || buffer.byteLength < length) {
      const before = band.length && new Uint8Array(buffer, 0, band.length);
      buffer = new ArrayBuffer(Math.ceil(length * 1.2));
      if (before) new Uint8Array(buffer).set(before);
    }
    new Uint8Array(buffer, band.length).set(bytes);
    Object.assign(band, { length, buffer });
  }

  // pose: of the track, see tracks.js.
  function draw({ id, group, t, pose, view, background, ends, piece, pieces }) {
    const start = performance.now();
    const places = [];
    let load = null;
    for (const slot of groups.get(group)) {
      native.frame(slot, t, pose);
      const drawn = native.project(view, ports.length, ({ i, bands, first, rows, splats }) => {
        places[i] ??= { bands, first, rows, own: { piece, pieces, length: 0, buffer: null } };
        append(places[i].own, i, splats);
      }, ends);
      load = load ? load.map((v, i) => v + drawn.load[i]) : drawn.load;
    }
    places.forEach((place, i) => {
      ports[i].postMessage({ id, ...place, width: view[0], background }, [place.own.buffer]);
    });
    self.postMessage({ type: "projected", id, load, ms: performance.now() - start }, [load.buffer]);
  }

  function pack({ id, group, t, pose, view, origin, all, piece }) {
    const start = performance.now();
    const parts = groups.get(group).map((slot) => (native.frame(slot, t, pose), native.pack(view, origin, all).slice()));
    const { buffer } = parts.length === 1 ? parts[0] : joined(parts);
    self.postMessage({ type: "packed", id, piece, buffer, ms: performance.now() - start }, [buffer]);
  }

  // Only for groups in one piece: an engine that is asked for attributes has no `view`, so it decodes groups whole.
  function attributes({ id, group, t }) {
    native.frame(groups.get(group)[0], t);
    const values = [0, 1, 2, 3, 4, 5].map((which) => native.attribute(which));
    self.postMessage({ type: "attributes", id, values }, values.map((v) => v.buffer));
  }

  self.onmessage = ({ data }) => {
    try {
      if (data.type === "decode") decode(data);
      else if (data.type === "draw") draw(data);
      else if (data.type === "pack") pack(data);
      else if (data.type === "attributes") attributes(data);
      else if (data.type === "release") {
        groups.get(data.group)?.forEach((slot) => native.x.release(slot));
        groups.delete(data.group);
      }
    } catch (e) {
      // a trap leaves the instance in an unknown state
      const fatal = e instanceof WebAssembly.RuntimeError || e instanceof RangeError;
      self.postMessage({ type: "failed", group: data.group, id: data.id, message: e.message, fatal });
    }
  };
}

function joined(parts) {
  const out = new Uint8Array(parts.reduce((n, part) => n + part.length, 0));
  parts.reduce((at, part) => (out.set(part, at), at + part.length), 0);
  return out;
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
