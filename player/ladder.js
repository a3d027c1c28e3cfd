// Several qualities of one capture behind a DASH manifest (.mpd): a Source whose groups come from the file that the link and
// the device can carry just now.
//
// Read of the manifest: Representation with @bandwidth and BaseURL, as in the on-demand profile, where each representation
// is one indexed file. The quality may change at every sync group that all files cut alike: predicted groups stay with theirs.

import { Source, StreamError } from "./source.js";

const SHARE = 0.7; // of the measured link that a quality may take
const BUSY = 0.8; // of the time that may go into decoding

export class Ladder extends EventTarget {
  rung = 0; // of the last group that was fetched
  link = 0; // Mbit/s, measured
  decode = new Map(); // rung -> ms a frame
  #rungs = []; // {bandwidth, source, opened}, cheapest first
  #chosen = new Map(); // group -> rung

  constructor(url) {
    super();
    this.url = new URL(url, document.baseURI).href;
  }

  async open(create) {
    this.create = create;
    const answer = await fetch(this.url);
    if (!answer.ok) throw new StreamError(`The manifest could not be read: the server answered ${answer.status}.`);
    const xml = new DOMParser().parseFromString(await answer.text(), "text/xml");
    for (const r of xml.querySelectorAll("Representation")) {
      const path = r.querySelector("BaseURL")?.textContent.trim();
      if (path) this.#rungs.push({ bandwidth: Number(r.getAttribute("bandwidth")) / 1e6, source: this.#source(new URL(path, answer.url)) });
    }
    if (!this.#rungs.length) throw new StreamError("The manifest names no files: expected Representation elements with BaseURL.");
    this.#rungs.sort((a, b) => a.bandwidth - b.bandwidth);
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
    const r = this.#rungs[i];
    r.opened ??= r.source.open(this.create);
    await r.opened;
    return r.source;
  }

  // What the cheapest file says holds for all.
  get #base() {
    return this.#rungs[0]?.source;
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
    return this.#rungs.reduce((n, r) => n + r.source.received, 0);
  }

  get rungs() {
    return this.#rungs.length;
  }

  // For people.
  get quality() {
    return `${this.rung + 1} of ${this.rungs}`;
  }

  has(i) {
    return this.#rungs[this.#chosen.get(i)]?.source.has(i) ?? false;
  }

  level(i) {
    return this.#rungs[this.#chosen.get(i) ?? 0].source.config.level;
  }

  // ms a frame that the decoding of group i took.
  decoded(i, ms) {
    this.decode.set(this.#chosen.get(i), ms);
  }

  // The best rung that link and device carry; one step up at a time, down at once.
  #choose() {
    const [n, d] = this.config.fps;
    const fits = (k) => this.#rungs[k].bandwidth < SHARE * this.link && ((this.decode.get(k) ?? 0) * n) / d < 1000 * BUSY;
    let best = 0;
    while (best < Math.min(this.rung + 1, this.#rungs.length - 1) && fits(best + 1)) best++;
    return best;
  }

  // The sync group that group i is, or that those before it start with.
  #start(i) {
    while (i > 0 && !this.groups[i].sync) i--;
    return i;
  }

  key(i) {
    return `${i} of ${this.#chosen.get(i)}`;
  }

  async payload(i, signal, layers) {
    const start = this.#start(i);
    if (this.has(i)) return this.#rungs[this.#chosen.get(i)].source.payload(i, signal, layers);
    const rung = this.#chosen.get(start) ?? (this.#chosen.size ? this.#choose() : 0);
    const told = this.groups[i];
    for (const k of [rung, 0]) {
      try {
        const source = await this.#open(k);
        const g = source.groups[i];
        if (g?.start_frame !== told.start_frame || g.frames !== told.frames) throw new StreamError("the files of the manifest are not cut alike");
        const bytes = await source.payload(i, signal, layers);
        this.#chosen.set(i, k);
        this.#chosen.set(start, k);
        this.rung = k;
        return bytes;
      } catch (e) {
        if (k === 0 || signal?.aborted) throw e;
      }
    }
  }

  close() {
    for (const r of this.#rungs) r.source.close();
  }
}
