// From groups to pictures: which groups are fetched, decoded and held, which worker does what, and when a picture is whole.
//
//   source --payload--> group worker (decode, evaluate, project) --ellipses of a band--> raster worker --pixels--> canvas
//                                                                \--what the view shows--> GPU, on a canvas above

import { Gpu, gpuName } from "./gpu.js";
import { ALL, AUTO, Native, load } from "./native.js";
import { Ladder } from "./ladder.js";
import { LayerChoice } from "./layers.js";
import { Source } from "./source.js";

const IN_FLIGHT = 2; // pictures at work: one is projected while the one before is blended
const AHEAD = 10; // seconds of payloads to fetch ahead
const GROUP_WORKERS = 2;
const RASTER_WORKERS_MAX = 8;

// A script from another origin cannot be a worker, but a worker may import it.
function start(url) {
  if (url.origin === location.origin) return new Worker(url, { type: "module" });
  const blob = new Blob([`import ${JSON.stringify(url.href)};`], { type: "text/javascript" });
  return new Worker(URL.createObjectURL(blob), { type: "module" });
}

export class Engine extends EventTarget {
  groups = new Map(); // group -> {state: fetching | decoding | ready | failed, worker, header, layers, abort}
  failed = new Map(); // group -> message
  layers = AUTO; // of each group that are fetched and drawn
  choice = new LayerChoice();
  #chosen = new Map(); // sync group -> layers of it and of those predicted from it
  stats = { decode: 0, project: 0, blend: 0, gaussians: 0, link: 0 };
  #workers = [];
  #rasters = [];
  #pictures = new Map(); // id -> {bands, parts, ...}
  #next = 1;
  #shown = 0;
  #gpu = null;
  #how = "cpu";

  constructor(canvas, base, src) {
    super();
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.base = base;
    this.source = /\.mpd($|[?#])/.test(src) ? new Ladder(src) : new Source(src);
    this.source.addEventListener("received", ({ detail: { bytes, ms } }) => {
      if (bytes > 20_000) this.stats.link = (8e-3 * bytes) / ms;
    });
    const cores = navigator.hardwareConcurrency || 2;
    const count = Math.min(Math.max(cores - 1, 2), RASTER_WORKERS_MAX);
    this.#rasters = Array.from({ length: count }, () => start(new URL("worker.js", base)));
    this.#workers = Array.from({ length: GROUP_WORKERS }, () => start(new URL("worker.js", base)));
  }

  // Resolves when the file is known.
  async open() {
    const module = load(new URL("native.wasm", this.base)); // while the first bytes of the file are on their way
    module.then((m) => this.closed || this.#connect(m), () => {});
    await this.source.open(async () => Native.create(await module));
  }

  #connect(module) {
    const ports = this.#rasters.map(() => []);
    this.#workers.forEach((worker) => {
      const own = this.#rasters.map((_, i) => {
        const { port1, port2 } = new MessageChannel();
        ports[i].push(port2);
        return port1;
      });
      worker.onmessage = ({ data }) => this.#onGroup(worker, data);
      worker.onerror = (e) => this.#dead(e);
      worker.postMessage({ role: "group", module, ports: own }, own);
    });
    this.#rasters.forEach((worker, i) => {
      worker.onmessage = ({ data }) => this.#onRaster(worker, data);
      worker.onerror = (e) => this.#dead(e);
      worker.postMessage({ role: "raster", module, ports: ports[i] }, ports[i]);
    });
  }

  close() {
    this.closed = true;
    this.source.close();
    for (const g of this.groups.values()) g.abort?.abort();
    for (const w of [...this.#workers, ...this.#rasters]) w.terminate();
    this.#leaveGpu();
  }

  // Who draws from now on: "cpu", "gpu", or "auto", the GPU if there is a real one. Rejects if the GPU cannot be used.
  async use(how) {
    this.#how = how;
    if (how === "cpu" || (how === "auto" && gpuName() === null)) return this.#leaveGpu();
    if (this.#gpu) return;
    const canvas = document.createElement("canvas");
    canvas.hidden = true;
    const [low, high] = [this.bounds.slice(0, 3), this.bounds.slice(3)];
    const origin = low.map((v, i) => (v + high[i]) / 2);
    const gpu = await Gpu.create(canvas, this.base, { origin, background: this.source.config.background });
    if (this.closed || this.#gpu || this.#how !== how) return gpu.close();
    this.canvas.after(canvas);
    canvas.addEventListener("webglcontextlost", () => this.#loseGpu("its context was lost"));
    this.#gpu = Object.assign(gpu, { canvas, origin });
  }

  #leaveGpu() {
    const gpu = this.#gpu;
    this.#gpu = null;
    gpu?.canvas.remove();
    gpu?.close();
    for (const [id, picture] of this.#pictures) if (picture.gpu) this.#pictures.delete(id);
    this.canvas.hidden = false;
  }

  #loseGpu(why) {
    if (!this.#gpu) return;
    this.#leaveGpu();
    this.dispatchEvent(new CustomEvent("nogpu", { detail: why }));
  }

  // For people.
  get drawnBy() {
    return this.#gpu?.name ?? `CPU, ${this.#rasters.length} workers`;
  }

  get gpu() {
    return this.#gpu;
  }

  get onGpu() {
    return this.#gpu !== null;
  }

  get fps() {
    const [n, d] = this.source.config.fps;
    return n / d;
  }

  // The group of frame t.
  groupOf(t) {
    const { groups } = this.source;
    let [low, high] = [0, groups.length - 1];
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (groups[middle].start_frame <= t) low = middle;
      else high = middle - 1;
    }
    return low;
  }

  ready(i) {
    return this.groups.get(i)?.state === "ready";
  }

  // Sees to it that group i is decoded, the next one too, and that those after it are fetched; lets go of others.
  want(i, loop) {
    const { groups } = this.source;
    if (!groups.length) return;
    const decoded = [i];
    const next = this.#after(i, loop);
    if (next !== null) decoded.push(next);
    for (const [k, g] of this.groups) {
      if (decoded.includes(k) || g.state === "decoding") continue;
      g.abort?.abort(new DOMException("not needed any more", "AbortError"));
      g.worker?.postMessage({ type: "release", group: k });
      this.groups.delete(k);
    }
    const busy = [...this.groups.values()].filter((g) => g.state !== "ready").length;
    if (!this.groups.has(i)) {
      if (busy < GROUP_WORKERS) this.#decode(i); // else later: who scrubs fast must not queue up decoders
    } else if (this.ready(i) && next !== null && !this.groups.has(next)) this.#decode(next);
    else if (next !== null && this.ready(next)) this.#prefetch(next, loop);
  }

  // From now on the first `layers` layers of each group.
  show(layers) {
    if (layers === this.layers) return;
    this.layers = layers;
    for (const [k, g] of this.groups) {
      if (g.state === "decoding") continue;
      g.abort?.abort(new DOMException("not needed any more", "AbortError"));
      g.worker?.postMessage({ type: "release", group: k });
      this.groups.delete(k);
    }
  }

  // How many layers of group i are wanted; chosen anew where nothing before is needed for more of them.
  #layersOf(i) {
    if (this.layers !== AUTO) return this.layers;
    const { groups } = this.source;
    let start = i;
    while (start > 0 && !groups[start].sync) start--;
    if (start === i || !this.#chosen.has(start)) {
      const { ends, size, frames } = groups[i];
      const rates = (ends ?? [size]).map((bytes) => (8e-6 * bytes * this.fps) / frames);
      this.#chosen.set(start, ends ? this.choice.choose(rates, this.stats.link) : ALL);
    }
    return this.#chosen.get(start);
  }

  // The group that plays after i; damaged ones are passed over.
  #after(i, loop) {
    const n = this.source.groups.length;
    for (let k = 1; k < n; k++) {
      const at = i + k;
      if (at >= n && !loop) return null;
      if (!this.failed.has(at % n)) return at % n;
    }
    return null;
  }

  async #decode(i) {
    if (this.failed.has(i)) return;
    const abort = new AbortController();
    const layers = this.#layersOf(i);
    const entry = { state: "fetching", layers, abort };
    this.groups.set(i, entry);
    try {
      const payload = await this.source.payload(i, abort.signal, layers);
      const reference = await this.#reference(i, payload, abort.signal, layers);
      if (this.groups.get(i) !== entry) return;
      // the idle worker, else the one that holds less
      const held = (w) => [...this.groups.values()].reduce((n, g) => n + (g.worker !== w ? 0 : g.state === "ready" ? 1 : 9), 0);
      entry.worker = this.#workers.reduce((a, b) => (held(b) < held(a) ? b : a));
      entry.state = "decoding";
      const level = this.source.level(i);
      entry.worker.postMessage({ type: "decode", group: i, payload, level, layers, reference, bounds: !this.bounds });
    } catch (e) {
      if (this.groups.get(i) !== entry || abort.signal.aborted) return;
      this.#fail(i, e.message);
    }
  }

  // {key, payload} of the group that a predicted one refers to.
  async #reference(i, payload, signal, layers) {
    const back = this.source.native.reference(payload);
    if (!back) return null;
    const r = i - back;
    if (r < 0 || this.source.groups[i].sync) throw new Error("it refers to a group that is not in the file");
    const bytes = await this.source.payload(r, signal, layers);
    return { key: `${this.source.key(r)}, ${layers} layers`, payload: bytes };
  }

  // Payloads of the next seconds, one at a time.
  async #prefetch(i, loop) {
    if (this.prefetching) return;
    this.prefetching = true;
    try {
      let seconds = 0;
      for (let k = this.#after(i, loop); k !== null && k > i && seconds < AHEAD; k = this.#after(k, false)) {
        await this.source.payload(k, undefined, this.#layersOf(k));
        seconds += this.source.groups[k].frames / this.fps;
      }
    } catch {
      // whoever needs the group will be told
    }
    this.prefetching = false;
  }

  #fail(i, message) {
    this.groups.delete(i);
    this.failed.set(i, message);
    const g = this.source.groups[i];
    const frames = `${g.start_frame}–${g.start_frame + g.frames - 1}`;
    this.dispatchEvent(new CustomEvent("damaged", { detail: { group: i, frames, message } }));
  }

  #dead(e) {
    this.dispatchEvent(new CustomEvent("fatal", { detail: e.message || "a worker could not be started" }));
  }

  #onGroup(worker, m) {
    const entry = this.groups.get(m.group);
    if (m.type === "decoded") {
      this.stats.decode = m.ms / m.header.frames;
      this.source.decoded?.(m.group, this.stats.decode);
      this.bounds ??= m.header.bounds;
      if (!entry) return worker.postMessage({ type: "release", group: m.group });
      entry.state = "ready";
      entry.header = m.header;
      this.dispatchEvent(new CustomEvent("decoded", { detail: m }));
    } else if (m.type === "projected") {
      this.stats.project = m.ms;
      const picture = this.#pictures.get(m.id);
      if (picture) picture.bands = m.bands;
    } else if (m.type === "packed") {
      this.stats.project = m.ms;
      this.#paint(m);
    } else if (m.type === "failed") {
      if (m.id !== undefined) this.#pictures.delete(m.id);
      if (m.fatal) return this.#dead(m);
      this.#fail(m.group, m.message);
    }
  }

  // True if a picture may be asked for.
  get free() {
    return this.#pictures.size < IN_FLIGHT;
  }

  draw(t, view) {
    const group = this.groupOf(t);
    const entry = this.groups.get(group);
    const id = this.#next++;
    const gpu = this.#gpu;
    this.#pictures.set(id, { t, view, gpu, parts: [], blend: 0, gaussians: entry.header.gaussians });
    const local = t - this.source.groups[group].start_frame;
    const how = gpu ? { type: "pack", origin: gpu.origin } : { type: "draw", background: this.source.config.background };
    entry.worker.postMessage({ ...how, id, group, t: local, view });
    return id;
  }

  async #paint({ id, buffer }) {
    const picture = this.#pictures.get(id);
    if (!picture) return; // the GPU was left meanwhile
    const start = performance.now();
    try {
      await picture.gpu.draw(picture.view, new Uint32Array(buffer));
    } catch (e) {
      if (this.#gpu === picture.gpu) this.#loseGpu(e?.message ?? "it stopped");
      return;
    }
    if (!this.#pictures.delete(id)) return;
    picture.blend = performance.now() - start;
    [this.canvas.hidden, picture.gpu.canvas.hidden] = [true, false];
    this.#tell(id, picture);
  }

  #onRaster(worker, m) {
    if (m.type === "failed") return this.#dead(m);
    if (m.type !== "band") return;
    const picture = this.#pictures.get(m.id);
    if (!picture) return;
    picture.parts.push({ ...m, worker });
    picture.blend = Math.max(picture.blend, m.ms);
    if (picture.parts.length < m.bands) return;
    this.#pictures.delete(m.id);
    if (m.id > this.#shown) this.#show(m.id, picture);
    for (const { worker, pixels } of picture.parts) worker.postMessage(pixels, [pixels]);
  }

  #show(id, picture) {
    const { parts, view } = picture;
    const [width, height] = view;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    for (const { pixels, first, rows } of parts) {
      this.context.putImageData(new ImageData(new Uint8ClampedArray(pixels), width, rows), 0, first);
    }
    this.#tell(id, picture);
  }

  #tell(id, { t, view, blend, gaussians }) {
    this.#shown = id;
    Object.assign(this.stats, { blend, gaussians });
    this.dispatchEvent(new CustomEvent("picture", { detail: { id, t, view } }));
  }
}
