// Adaptive bitrate: a Source over the representations of a DASH manifest (.mpd). Each group comes from the best
// representation that link and device sustain.
//
// Only @bandwidth and BaseURL of each Representation are read (on-demand profile: one indexed file each). The
// representation changes at sync groups only, and all files must have the same ones.

import { Source, StreamError, absolute } from "./source.js";

const SHARE = 0.7; // of the measured link that a representation may use
const BUSY = 0.8; // share of the time that decoding may take

export class AdaptiveSource extends EventTarget {
  representation = 0; // of the last group that was fetched
  link = 0; // Mbit/s, measured
  decode = new Map(); // representation -> decoding time, ms per frame
  #files = []; // {bandwidth, source, opened}, lowest bandwidth first
  #chosen = new Map(); // group -> representation

  constructor(url) {
    super();
    this.url = absolute(url);
  }

  async open(create) {
    this.create = create;
    const answer = await fetch(this.url);
    if (!answer.ok) throw new StreamError(`The manifest could not be read: the server answered ${answer.status}.`);
    const xml = new DOMParser().parseFromString(await answer.text(), "text/xml");
    for (const r of xml.querySelectorAll("Representation")) {
      const path = r.querySelector("BaseURL")?.textContent.trim();
      if (path) this.#files.push({ bandwidth: Number(r.getAttribute("bandwidth")) / 1e6, source: this.#source(new URL(path, answer.url)) });
    }
    if (!this.#files.length) throw new StreamError("The manifest names no files: expected Representation elements with BaseURL.");
    this.#files.sort((a, b) => a.bandwidth - b.bandwidth);
    await this.#open(0);
  }

  #source(url) {
    const source = new Source(url);
    for (const type of ["received", "retry", "connected", "groups"]) {
      source.addEventListener(type, ({ detail }) => this.dispatchEvent(new CustomEvent(type, { detail })));
    }
    source.addEventListener("received", ({ detail: { bytes, ms } }) => {
      if (bytes > 5000) this.link = this.link ? 0.6 * this.link + (0.4 * 8e-3 * bytes) / ms : (8e-3 * bytes) / ms;
    });
    return source;
  }

  async #open(i) {
    const r = this.#files[i];
    r.opened ??= r.source.open(this.create);
    await r.opened;
    return r.source;
  }

  // Config and groups are those of the representation with the lowest bandwidth.
  get #base() {
    return this.#files[0]?.source;
  }
  get groups() {
    return this.#base?.groups ?? [];
  }
  get native() {
    return this.#base.native;
  }
  get config() {
    return this.#base?.config ?? null;
  }
  get frameCount() {
    return this.#base?.frameCount ?? 0;
  }
  get complete() {
    return this.#base?.complete ?? false;
  }
  get settled() {
    return this.#base?.settled ?? false;
  }
  get missing() {
    return this.#base?.missing ?? 0;
  }
  get received() {
    return this.#files.reduce((n, r) => n + r.source.received, 0);
  }

  get representations() {
    return this.#files.length;
  }

  // For the statistics.
  get quality() {
    return `${this.representation + 1} of ${this.representations}`;
  }

  has(i) {
    return this.#files[this.#chosen.get(i)]?.source.has(i) ?? false;
  }

  sound(i) {
    return this.#files[this.#chosen.get(i)]?.source.sound(i);
  }

  level(i) {
    return this.#files[this.#chosen.get(i) ?? 0].source.config.level;
  }

  // Group i was decoded in `ms` per frame.
  decoded(i, ms) {
    this.decode.set(this.#chosen.get(i), ms);
  }

  // Whether link and device sustain representation k.
  #fits(k) {
    const [n, d] = this.config.fps;
    return this.#files[k].bandwidth < SHARE * this.link && ((this.decode.get(k) ?? 0) * n) / d < 1000 * BUSY;
  }

  // Whether a better representation than that of the last group is not sustained.
  get limited() {
    const better = this.representation + 1;
    return this.link > 0 && better < this.#files.length && !this.#fits(better);
  }

  // The best sustainable representation: up by one step at a time, down at once.
  #choose() {
    let best = 0;
    while (best < Math.min(this.representation + 1, this.#files.length - 1) && this.#fits(best + 1)) best++;
    return best;
  }

  // The last sync group up to group i.
  #start(i) {
    while (i > 0 && !this.groups[i].sync) i--;
    return i;
  }

  key(i) {
    return `${i} of ${this.#chosen.get(i)}`;
  }

  async payload(i, signal, layers) {
    const start = this.#start(i);
    if (this.has(i)) return this.#files[this.#chosen.get(i)].source.payload(i, signal, layers);
    const first = this.#chosen.get(start) ?? (this.#chosen.size ? this.#choose() : 0);
    const told = this.groups[i];
    for (const k of [first, 0]) {
      try {
        const source = await this.#open(k);
        const g = source.groups[i];
        if (g?.start_frame !== told.start_frame || g.frames !== told.frames) throw new StreamError("the files of the manifest are not cut alike");
        const bytes = await source.payload(i, signal, layers);
        this.#chosen.set(i, k);
        this.#chosen.set(start, k);
        this.representation = k;
        return bytes;
      } catch (e) {
        if (k === 0 || signal?.aborted) throw e;
      }
    }
  }

  close() {
    for (const r of this.#files) r.source.close();
  }
}
