// A worker of the player, in one of two roles.
//
// group:  decodes and keeps groups; frame t + view -> projected Gaussians of each band of rows, to the worker of the band, or
//         the visible ones packed for the GPU, or the attributes of all, to the page.
// raster: projected Gaussians of a band -> its pixels, to the page.
//
// Two group workers alternate: one shows its group while the other decodes the next, so decoded groups are never copied. Each
// keeps the last reference, since more predicted groups will follow.

import { NONE, Native } from "./native.js";

const roles = { group: groupWorker, raster: rasterWorker };

self.onmessage = async ({ data }) => {
  const native = await Native.create(data.module);
  roles[data.role](native, data);
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
  function keep({ key, payload }, level, layers) {
    if (kept.key !== key) {
      if (kept.slot !== NONE) native.x.release(kept.slot);
      kept = { slot: NONE };
      const slot = spareSlot();
      native.decode(slot, payload, level, NONE, layers);
      kept = { key, slot };
    }
    return kept.slot;
  }

  function decode({ group, payload, level, bounds, layers, reference }) {
    const start = performance.now();
    const from = reference ? keep(reference, level, layers) : NONE;
    const slot = spareSlot();
    const header = native.decode(slot, payload, level, from, layers);
    slots.set(group, slot);
    shown = "";
    if (bounds) {
      native.frame(slot, 0);
      header.bounds = native.bounds();
      shown = `${group} 0`;
    }
    return { type: "decoded", group, header, ms: performance.now() - start };
  }

  function evaluate(group, t) {
    if (shown === `${group} ${t}`) return;
    native.frame(slots.get(group), t);
    shown = `${group} ${t}`;
  }

  function draw({ id, group, t, view, background }) {
    const start = performance.now();
    evaluate(group, t);
    const bands = native.project(view, ports.length, ({ i, bands, first, rows, splats }) => {
      let buffer = spare[i].pop();
      if (!buffer || buffer.byteLength < splats.length) buffer = new ArrayBuffer(Math.ceil(splats.length * 1.2));
      new Uint8Array(buffer, 0, splats.length).set(splats);
      ports[i].postMessage({ id, bands, first, rows, width: view[0], length: splats.length, background, buffer }, [buffer]);
    });
    return { type: "projected", id, bands, ms: performance.now() - start };
  }

  function pack({ id, group, t, view, origin, all }) {
    const start = performance.now();
    evaluate(group, t);
    const { buffer } = native.pack(view, origin, all).slice();
    self.postMessage({ type: "packed", id, buffer, ms: performance.now() - start }, [buffer]);
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

function rasterWorker(native, { ports }) {
  const spare = [];
  const draw = (port, { id, bands, first, rows, width, length, background, buffer }) => {
    const start = performance.now();
    const drawn = native.draw(new Uint8Array(buffer, 0, length), width, rows, background);
    port.postMessage(buffer, [buffer]);
    let pixels = spare.pop();
    if (pixels?.byteLength !== drawn.length) pixels = new ArrayBuffer(drawn.length);
    new Uint8Array(pixels).set(drawn);
    self.postMessage({ type: "band", id, bands, first, rows, width, pixels, ms: performance.now() - start }, [pixels]);
  };
  for (const port of ports) {
    port.onmessage = ({ data }) => {
      try {
        draw(port, data);
      } catch (e) {
        self.postMessage({ type: "failed", id: data.id, message: e.message, fatal: true });
      }
    };
  }
  self.onmessage = ({ data }) => spare.length < 3 && spare.push(data);
}
