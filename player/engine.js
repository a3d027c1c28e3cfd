// The groups of a stream: which are fetched, decoded and kept, and by which worker.
//
//   source --payload--> group workers (decode, evaluate, project) --Gaussians of a band--> raster worker --pixels--> canvas
//                                                                 \--visible Gaussians--> GPU, on a canvas above
//                                                                 \--an answer--> `ask`, for scenes of other programs
//
// A group of many tiles is shared by the workers of a set: each decodes and keeps its tiles alone, and nothing is copied.

import { AdaptiveSource } from "./abr.js";
import { ALL, AUTO, Native, load } from "./native.js";
import { LayerChoice } from "./layers.js";
import { Renderer } from "./renderer.js";
import { Source } from "./source.js";
import { Scene, placed } from "./tracks.js";
import { joined, order, share, sharing } from "./tiles.js";

const AHEAD = 10; // seconds of payloads to fetch ahead
const SETS = 2; // of group workers
const SHARES_MAX = 4; // workers of a set; the others start when a group has tiles for them
const RASTER_WORKERS_MAX = 8;

// A script from another origin cannot be a worker, but a worker may import it. Bundlers know a worker by these words, and
// are to leave `script` alone.
function start(script = "./worker.js") {
  if (new URL(import.meta.url).origin === location.origin) {
    return new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
  }
  const url = new URL(script, import.meta.url);
  const blob = new Blob([`import ${JSON.stringify(url.href)};`], { type: "text/javascript" });
  return new Worker(URL.createObjectURL(blob), { type: "module" });
}

export class Engine extends EventTarget {
  groups = new Map(); // group -> {state: fetching | decoding | ready, set, pieces, left, header, layers, abort}
  // set: workers that hold it; pieces: how many of them do; left: how many of these still decode; order: see tiles.js
  failed = new Map(); // group -> message
  layers = AUTO; // number of layers of each group to fetch and draw
  choice = new LayerChoice();
  #chosen = new Map(); // sync group -> number of layers, of it and of the groups predicted from it
  stats = { decode: 0, project: 0, blend: 0, gaussians: 0, link: 0 };
  #sets = Array.from({ length: SETS }, () => []); // of group workers
  #rasters = [];
  #asked = new Map(); // id -> {resolve, reject} of a request
  #requests = 0;

  scene = null; // of the tracks of a file that has several, or a placed one

  // canvas: null if nothing is to be drawn; track: which one of the file; host: the engine of the first one, which draws this
  // one, too
  constructor(canvas, src, { track = 0, host = null } = {}) {
    super();
    this.host = host;
    this.source = /\.mpd($|[?#])/.test(src) ? new AdaptiveSource(src) : new Source(src, track);
    this.source.addEventListener("received", ({ detail: { bytes, ms } }) => {
      if (bytes > 20_000) this.stats.link = (8e-3 * bytes) / ms;
    });
    const cores = navigator.hardwareConcurrency || 2;
    const count = canvas ? Math.min(Math.max(cores - 1, 2), RASTER_WORKERS_MAX) : 0;
    this.#rasters = host ? host.#rasters : Array.from({ length: count }, () => start());
    this.shares = Math.min(cores, SHARES_MAX);
    this.#sets.forEach((set) => set.push(start()));
    const divide = (load) => this.source.native.divide(load, count);
    const say = (type, detail) => this.#say(type, detail);
    this.renderer = host?.renderer ?? new Renderer(canvas, { rasters: count, stats: this.stats, divide, say });
  }

  #say(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  // Resolves when the config and the first groups are known.
  async open() {
    this.loading = this.host?.loading ?? load(new URL("./native.wasm.gz", import.meta.url)); // while the first bytes of the file are on their way
    this.loading.then((m) => this.closed || this.#connect(m), () => {});
    await this.source.open(async () => Native.create(await this.loading));
    if (this.#rasters.length && !this.host && (this.source.tracks > 1 || placed(this.source.config))) {
      this.scene = new Scene(this, (track) => new Engine(null, this.source.url, { track, host: this }));
      await this.scene.open((type, detail) => this.#say(type, detail));
    }
  }

  #connect(module) {
    this.#module = module;
    (this.host ? [] : this.#rasters).forEach((worker) => {
      worker.onmessage = ({ data }) => this.renderer.onRaster(worker, data);
      worker.onerror = (e) => this.#dead(e);
      worker.postMessage({ role: "raster", module });
    });
    for (const [worker] of this.#sets) this.#join(worker);
  }

  #module = null;

  // Connects a group worker with the raster workers.
  #join(worker) {
    const own = this.#rasters.map((raster) => {
      const { port1, port2 } = new MessageChannel();
      raster.postMessage({ port: port2 }, [port2]);
      return port1;
    });
    worker.onmessage = ({ data }) => this.#onGroup(worker, data);
    worker.onerror = (e) => this.#dead(e);
    worker.postMessage({ role: "group", module: this.#module, ports: own }, own);
  }

  close() {
    this.closed = true;
    this.source.close();
    for (const g of this.groups.values()) g.abort?.abort();
    for (const w of [...this.#sets.flat(), ...(this.host ? [] : this.#rasters)]) w.terminate();
    for (const { reject } of this.#asked.values()) reject(new Error("the stream was closed"));
    if (this.host) return;
    this.scene?.close();
    this.renderer.close();
  }

  // Who draws from now on: "cpu", "gpu", or "auto", the GPU if it is hardware. Rejects if the GPU cannot be used.
  use(how) {
    return this.renderer.use(how, this.bounds, this.source.config.background);
  }

  get gpu() {
    return this.renderer.gpu;
  }

  get onGpu() {
    return this.gpu !== null;
  }

  // Requests the image of frame t, whose group is decoded.
  draw(t, view) {
    const parts = this.scene?.parts(t) ?? [{ engine: this, t }];
    const shown = parts.map((part) => part.engine.groups.get(part.engine.groupOf(part.t)));
    const pieces = shown.reduce((n, group) => n + group.pieces, 0);
    const gaussians = shown.reduce((n, group) => n + group.header.gaussians, 0);
    const how = this.renderer.begin({ t, view, gaussians, pieces }, this.source.config.background);
    let first = 0;
    parts.forEach(({ engine, t: own, pose }, i) => {
      const from = first;
      engine.#post(own, (piece) => ({ ...how, view, pose, piece: from + piece, pieces }));
      first += shown[i].pieces;
    });
  }

  // Resolves with the answer of the workers that have the group of frame t, which is decoded.
  async ask(t, message) {
    const { order } = this.groups.get(this.groupOf(t));
    const answers = [];
    this.#post(t, () => {
      const id = `ask ${++this.#requests}`;
      answers.push(new Promise((resolve, reject) => this.#asked.set(id, { resolve, reject })));
      return { ...message, id };
    });
    return joined(await Promise.all(answers), order);
  }

  // Sends message(piece) to each worker that has tiles of the group of frame t.
  #post(t, message) {
    const group = this.groupOf(t);
    const { set, pieces } = this.groups.get(group);
    const local = t - this.source.groups[group].start_frame;
    set.slice(0, pieces).forEach((worker, piece) => worker.postMessage({ ...message(piece), group, t: local }));
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

  // Starts decoding group i, then the next one, then fetching those after it; releases all others.
  want(i, loop) {
    const { groups } = this.source;
    if (!groups.length) return;
    const decoded = [i];
    const next = this.#after(i, loop);
    if (next !== null) decoded.push(next);
    for (const [k, g] of this.groups) {
      if (!decoded.includes(k)) this.#release(k, g);
    }
    const busy = [...this.groups.values()].filter((g) => g.state !== "ready").length;
    if (!this.groups.has(i)) {
      if (busy < SETS) this.#decode(i); // else later: fast seeking must not queue up decoders
    } else if (this.ready(i) && next !== null && !this.groups.has(next)) this.#decode(next);
    else if (next !== null && this.ready(next)) this.#prefetch(next, loop);
  }

  // Switches to the first `layers` layers of each group.
  show(layers) {
    if (layers === this.layers) return;
    this.layers = layers;
    this.scene?.show(layers);
    this.forget();
  }

  // Gives up all groups that are not being decoded.
  forget() {
    for (const [k, g] of this.groups) this.#release(k, g);
  }

  // Gives a group up, unless it is being decoded.
  #release(k, g) {
    if (g.state === "decoding") return;
    g.abort?.abort(new DOMException("not needed any more", "AbortError"));
    g.set?.forEach((worker) => worker.postMessage({ type: "release", group: k }));
    this.groups.delete(k);
  }

  // Number of layers of group i. It is chosen anew at sync groups, since the others depend on the layers of theirs.
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

  // The group that plays after i, without the damaged ones.
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
      // the idle set, else the one that holds fewer groups
      const held = (set) => [...this.groups.values()].reduce((n, g) => n + (g.set !== set ? 0 : g.state === "ready" ? 1 : 9), 0);
      entry.set = this.#sets.reduce((a, b) => (held(b) < held(a) ? b : a));
      entry.state = "decoding";
      this.#share(i, entry, payload, reference);
    } catch (e) {
      if (this.groups.get(i) !== entry || abort.signal.aborted) return;
      this.#fail(i, e.message);
    }
  }

  // Gives the tiles of group i to the workers of its set.
  #share(i, entry, payload, reference) {
    const { native } = this.source;
    const { set, layers } = entry;
    const index = native.index(payload, reference?.payload);
    const n = (entry.pieces = entry.left = sharing(index, layers, this.shares));
    entry.order = order(index, layers, n);
    const before = reference && n > 1 ? native.index(reference.payload) : null;
    const [level, bounds] = [this.source.level(i), !this.bounds];
    for (let k = 0; k < n; k++) {
      if (!set[k]) this.#join((set[k] = start()));
      const wanted = n > 1 ? share(index, k, n) : null;
      const own = before ? { ...reference, key: `${reference.key}, ${k} of ${n}`, wanted: share(before, k, n) } : reference;
      set[k].postMessage({ type: "decode", group: i, payload, level, layers, reference: own, wanted, bounds });
    }
  }

  // {key, payload} of the reference of a predicted group; null if group i is independent.
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
      // `#decode` reports the error when the group is needed
    }
    this.prefetching = false;
  }

  #fail(i, message) {
    if (this.failed.has(i)) return; // another worker has told already
    const entry = this.groups.get(i);
    if (entry) this.#release(i, { ...entry, state: "failed" });
    this.failed.set(i, message);
    const g = this.source.groups[i];
    const frames = `${g.start_frame}–${g.start_frame + g.frames - 1}`;
    this.#say("damaged", { group: i, frames, message });
  }

  #dead(e) {
    this.#say("fatal", e.message || "a worker could not be started");
  }

  // A worker has decoded its tiles of a group.
  #onDecoded(entry, m) {
    const { header, group } = m;
    entry.ms = Math.max(entry.ms ?? 0, m.ms);
    (entry.means ??= []).push(header.means);
    entry.header = { ...header, gaussians: header.gaussians + (entry.header?.gaussians ?? 0), means: undefined };
    if (--entry.left) return;
    this.stats.decode = entry.ms / header.frames;
    this.source.decoded?.(group, this.stats.decode);
    this.bounds ??= this.source.native.bounds(...entry.means);
    entry.means = null;
    entry.state = "ready";
    this.#say("decoded", { group, header: entry.header });
  }

  #onGroup(worker, m) {
    const asked = this.#asked.get(m.id);
    this.#asked.delete(m.id);
    if (asked && m.type !== "failed") return asked.resolve(m);
    asked?.reject(new Error(m.message));
    const entry = this.groups.get(m.group);
    if (m.type === "decoded") {
      if (!entry?.left) return worker.postMessage({ type: "release", group: m.group });
      this.#onDecoded(entry, m);
    } else if (m.type === "projected") {
      this.renderer.onProjected(m);
    } else if (m.type === "packed") {
      this.renderer.onPacked(m);
    } else if (m.type === "failed") {
      if (m.id !== undefined) this.renderer.drop(m.id);
      if (m.fatal) return this.#dead(m);
      this.#fail(m.group, m.message);
    }
  }
}
