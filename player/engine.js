// The groups of a stream: which are fetched, decoded and kept, and by which worker.
//
//   source --payload--> group workers (decode, evaluate, project) --Gaussians of a band--> raster worker --pixels--> canvas
//                                                                 \--visible Gaussians--> GPU, on a canvas above
//                                                                 \--an answer--> `ask`, for scenes of other programs
//
// A group of many tiles is shared by the workers of a set: each decodes and keeps only its tiles, and nothing is
// copied. Of a large group only the tiles in view are fetched and decoded, and others when the view comes to them
// (parts.js).

import { AdaptiveSource } from "./abr.js";
import { lowPassOf } from "./camera.js";
import { ALL, AUTO, Native, load } from "./native.js";
import { LayerChoice } from "./layers.js";
import { Renderer } from "./renderer.js";
import { LinkError, Source } from "./source.js";
import { Whole, joined, order, sharing } from "./tiles.js";
import { Scene, placed, unplaced } from "./tracks.js";

const AHEAD = 10; // seconds of payloads to fetch ahead
const SETS = 2; // of group workers
const SHARES_MAX = 4; // workers of a set; the others start when a group has tiles for them
const RASTER_WORKERS_MAX = 8;
const AGAIN = 3000; // ms after which a group that could not be fetched is fetched again
const PIECES_MAX = 100; // of a group in a worker, see SLOTS of player.rs

// A script from another origin cannot be a worker, but a worker may import it. Bundlers detect a worker by this
// expression, and must leave `script` alone.
function start(script = "./worker.js") {
  if (new URL(import.meta.url).origin === location.origin) {
    return new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
  }
  const url = new URL(script, import.meta.url);
  const blob = new Blob([`import ${JSON.stringify(url.href)};`], { type: "text/javascript" });
  return new Worker(URL.createObjectURL(blob), { type: "module" });
}

export class Engine extends EventTarget {
  // bytes of a group, or of the one that it is predicted from, above which only its tiles in view are fetched and
  // decoded
  static partly = 1 << 20;
  groups = new Map(); // group -> {state: fetching | decoding | ready, header, layers, abort, and the fields below}
  // asked: `layers` of the engine at its start
  // set: workers that hold it; pieces: number of workers that hold tiles of it; left: orders still to be decoded;
  // order: see tiles.js; content: a Whole or Parts; flags: requested tiles of Parts; orders: number of orders so far;
  // waiting: orders of each worker
  view = null; // () => view of the renderer; null: all tiles; undefined: not known yet. Without it
  // large groups are decoded whole, too; in a scene of several tracks only the host has it
  pose = null; // transform of the track in a scene, see tracks.js
  failed = new Map(); // damaged group -> message
  missed = new Map(); // group that could not be fetched -> {message, again: time of the next try}
  layers; // number of layers of each group to fetch and draw
  choice = new LayerChoice();
  #chosen = new Map(); // sync group -> number of layers, of it and of the groups predicted from it
  stats = { decode: 0, project: 0, blend: 0, gaussians: 0, link: 0 };
  #sets = Array.from({ length: SETS }, () => []); // of group workers
  #rasters = [];
  #asked = new Map(); // id -> {resolve, reject} of a request
  #requests = 0;

  scene = null; // the tracks of a file that has several tracks, or a placed one

  // canvas: null if nothing is to be drawn; track: its index in the file; host: the engine of the first track, which
  // draws this one, too; alone: reads one track only, without its placement
  constructor(canvas, src, { track = 0, host = null, alone = false } = {}) {
    super();
    Object.assign(this, { host, alone, layers: host?.layers ?? AUTO });
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
    this.loading = this.host?.loading ?? load(new URL("./native.wasm.gz", import.meta.url)); // while the file opens
    this.loading.then((m) => this.closed || this.#connect(m), () => {});
    await this.source.open(async () => Native.create(await this.loading));
    const several = this.source.tracks > 1 || placed(this.source.config);
    if (several && this.#rasters.length && !this.host && !this.alone && !this.closed) {
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

  // The renderer from now on: "cpu", "gpu", or "auto", the GPU if it is hardware. Rejects if the GPU cannot be used.
  use(how) {
    const { background, cameras } = this.source.config;
    return this.renderer.use(how, this.bounds, background, lowPassOf(cameras));
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
    const image = { t, view, gaussians: this.gaussians(t), pieces, divided: pieces > 1 || shown[0].flags !== null };
    const how = this.renderer.begin(image, this.source.config.background);
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

  // Bytes of all tracks.
  get received() {
    return (this.scene?.engines ?? [this]).reduce((n, { source }) => n + source.received, 0);
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

  // Number of decoded Gaussians in the groups of frame t.
  gaussians(t) {
    const parts = this.scene?.parts(t) ?? [{ engine: this, t }];
    return parts.reduce((n, part) => n + (part.engine.groups.get(part.engine.groupOf(part.t))?.header?.gaussians ?? 0), 0);
  }

  // `view()` as a view of this track before its transform.
  sight() {
    const view = (this.host ?? this).view();
    return view && this.pose ? unplaced(view, this.pose) : view;
  }

  // Flags of the tiles of a group in view, as soon as the view is known.
  async #seen(content, layers, signal) {
    while (this.sight() === undefined && !this.closed) {
      await new Promise(requestAnimationFrame);
      signal?.throwIfAborted();
    }
    return content.seen(this.sight(), layers);
  }

  // Starts decoding group i, then the next one, then fetching those after it; releases all others.
  want(i, loop) {
    const { groups } = this.source;
    if (!groups.length) return;
    const decoded = [i];
    const next = this.#after(i, loop);
    if (next !== null) decoded.push(next);
    for (const [k, g] of this.groups) {
      if (!decoded.includes(k) || g.asked !== this.layers) this.#release(k, g);
      else if (g.flags && g.state === "ready" && !g.left) this.#grow(k, g);
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

  // Releases all groups that are not being decoded.
  forget() {
    for (const [k, g] of this.groups) this.#release(k, g);
  }

  // Releases a group, unless it is being decoded.
  #release(k, g) {
    if (g.state === "decoding" || g.left > 0) return;
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
    if (this.failed.has(i) || this.#pauses(i)) return;
    const abort = new AbortController();
    const layers = this.#layersOf(i);
    const entry = { state: "fetching", asked: this.layers, layers, abort, left: 0, waiting: [], flags: null };
    this.groups.set(i, entry);
    try {
      const content = (entry.content = await this.#fetch(i, layers, abort.signal));
      if (content.seen) {
        if (!this.bounds) this.#say("bounds", (this.bounds = content.bounds)); // its listener makes the view
        entry.flags = await this.#seen(content, layers, abort.signal);
        await content.fetch(entry.flags, layers, abort.signal);
      }
      if (this.groups.get(i) !== entry) return;
      // the idle set, else the one that holds fewer groups
      const held = (set) => [...this.groups.values()].reduce((n, g) => n + (g.set !== set ? 0 : g.state === "ready" ? 1 : 9), 0);
      entry.set = this.#sets.reduce((a, b) => (held(b) < held(a) ? b : a));
      entry.state = "decoding";
      entry.pieces = sharing(content.index, layers, this.shares);
      entry.order = order(content.index, layers, entry.pieces);
      this.#share(i, entry, entry.flags);
    } catch (e) {
      if (this.groups.get(i) !== entry || abort.signal.aborted) return;
      this.#lose(i, e);
    }
  }

  // Gives the tiles of group i with flags, all if null, to the workers of its set; more: in addition to tiles that they
  // have already.
  #share(i, entry, flags, more = false) {
    const { set, layers, content, pieces: n } = entry;
    for (let k = 0; k < n; k++) {
      if (!set[k]) this.#join((set[k] = start()));
      entry.waiting[k] = content.orders(flags, layers, k, n, more);
      entry.left += entry.waiting[k].length;
      this.#next(i, entry, k);
    }
    entry.orders = (entry.orders ?? 0) + entry.left;
  }

  // Sends worker k of a set its next order for group i: one order at a time, so that it can draw in between.
  #next(i, { set, layers, waiting }, k) {
    const order = waiting[k]?.shift();
    if (order) set[k].postMessage({ type: "decode", group: i, level: this.source.level(i), layers, bounds: !this.bounds, ...order });
  }

  // Fetches and decodes the tiles that have come into view.
  async #grow(i, entry) {
    const { content, flags, layers, abort } = entry;
    if (entry.growing || this.#pauses(i)) return;
    const more = content.seen(this.sight(), layers).map((seen, j) => seen & ~flags[j]);
    if (!more.includes(1)) return;
    if (entry.orders > PIECES_MAX * entry.pieces) return this.#release(i, entry); // decoded anew, in one piece
    entry.growing = true;
    try {
      await content.fetch(more, layers, abort.signal);
      if (this.groups.get(i) !== entry) return;
      more.forEach((flag, j) => (flags[j] |= flag));
      this.#share(i, entry, more, true);
    } catch (e) {
      if (this.groups.get(i) === entry && !abort.signal.aborted) this.#lose(i, e);
    }
    entry.growing = false;
  }

  // Group i and its reference: whole, or described, to be fetched by parts.
  async #fetch(i, layers, signal) {
    const { source } = this;
    const { native } = source;
    const partly = (this.host ?? this).view && source.ranged && this.#bytes(i, layers) > Engine.partly;
    const one = (k) => (partly ? source.parts(k, signal) : source.payload(k, signal, layers));
    const own = await one(i);
    const back = native.reference(own.head ?? own);
    if (back && (back > i || source.groups[i].sync)) throw new Error("it refers to a group that is not in the file");
    const before = back ? await one(i - back) : null;
    const key = `${source.key(i - back)}, ${layers} layers`;
    if (!partly) return new Whole(native, own, before && { key, payload: before });
    own.describe(native, before, key);
    return own;
  }

  // Bytes of the layers of group i, or of the sync group before it, if they are more.
  #bytes(i, layers) {
    const { groups } = this.source;
    let start = i;
    while (start > 0 && !groups[start].sync) start--;
    return Math.max(...[i, start].map((k) => groups[k].ends?.[layers - 1] ?? groups[k].size));
  }

  // Payloads of the next seconds, one at a time.
  async #prefetch(i, loop) {
    if (this.prefetching) return;
    this.prefetching = true;
    try {
      let seconds = 0;
      for (let k = this.#after(i, loop); k !== null && k > i && seconds < AHEAD; k = this.#after(k, false)) {
        const layers = this.#layersOf(k);
        const content = await this.#fetch(k, layers);
        await content.fetch?.(await this.#seen(content, layers), layers);
        seconds += this.source.groups[k].frames / this.fps;
      }
    } catch {
      await new Promise((done) => setTimeout(done, AGAIN)); // `#decode` reports the error when the group is needed
    }
    this.prefetching = false;
  }

  // Group i could not be decoded: it is damaged, or its bytes have not come, which is tried again.
  #lose(i, e) {
    if (!(e instanceof LinkError)) return this.#fail(i, e.message);
    if (!this.ready(i)) this.groups.delete(i);
    this.missed.set(i, { message: e.message, again: performance.now() + AGAIN });
    this.#say("missed", { frames: this.#frames(i), message: e.message });
  }

  #pauses(i) {
    return performance.now() < this.missed.get(i)?.again;
  }

  #frames(i) {
    const g = this.source.groups[i];
    return `${g.start_frame}–${g.start_frame + g.frames - 1}`;
  }

  #fail(i, message) {
    if (this.failed.has(i)) return; // another worker has reported it
    const entry = this.groups.get(i);
    if (entry) this.#release(i, { ...entry, state: "failed", left: 0 });
    this.failed.set(i, message);
    this.#say("damaged", { group: i, frames: this.#frames(i), message });
  }

  #dead(e) {
    this.#say("fatal", e.message || "a worker could not be started");
  }

  // A worker has decoded its tiles of a group.
  #onDecoded(entry, m) {
    const { header, group } = m;
    entry.ms = Math.max(entry.ms ?? 0, m.ms);
    if (header.means) (entry.means ??= []).push(header.means);
    entry.header = { ...header, gaussians: header.gaussians + (entry.header?.gaussians ?? 0), means: undefined };
    if (--entry.left || entry.state === "ready") return;
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
      this.#next(m.group, entry, entry.set.indexOf(worker));
      this.#onDecoded(entry, m);
    } else if (m.type === "projected") {
      this.renderer.onProjected(m);
    } else if (m.type === "packed") {
      this.renderer.onPacked(m);
    } else if (m.type === "failed") {
      if (m.fatal) return this.#dead(m);
      if (m.id === undefined) this.#fail(m.group, m.message); // else a picture or a request: the group is not damaged
      else this.renderer.drop(m.id, m.message);
    }
  }
}
