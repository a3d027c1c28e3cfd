// A .gsv file behind a URL: the positions of its groups, and their bytes by HTTP Range, sound included. With an index
// of layers (ssix) only the requested layers are fetched, and of groups in parts only the requested units (parts.js).
//
// A finished file has an index (sidx), so one small request finds all groups; without it the headers of the fragments
// are walked, and a growing file is polled. A server that ignores Range sends the whole file, which is then kept. All
// request headers work without a CORS preflight, so any static host will do. A broken connection is resumed where it
// broke.

import { ALL } from "./native.js";

const HEAD = 1 << 16; // first request
const SMALL = 1 << 18; // bytes of a file that is fetched as a whole
const STEP = 1 << 12; // a moof and the header of its mdat
const CACHE = 48 << 20; // bytes of payloads that are kept
const SILENCE = 15_000; // ms without a byte after which a connection counts as broken
const PATIENCE = 60_000; // ms of retries before the connection counts as lost
const SETTLE = 8000; // ms without growth after which a file counts as unfinished
const POLL = [500, 5000]; // ms between looks at a growing file: first, longest

const sleep = (ms, signal) =>
  new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, ms);
    signal?.addEventListener("abort", () => (clearTimeout(timer), reject(signal.reason)), { once: true });
  });

export class StreamError extends Error {}

// The bytes do not come: the file itself may be whole.
export class LinkError extends StreamError {}

// An address in the page as an absolute one.
export function absolute(url) {
  try {
    return new URL(url, document.baseURI).href;
  } catch {
    throw new StreamError(`"${url}" is not an address: expected one such as https://host/movie.gsv.`);
  }
}

export class Source extends EventTarget {
  groups = []; // {start_frame, frames, sync, offset, size, indexed, ends}: of the payload, of the fragment if `indexed`
  // ends: bytes of it that end with each layer, if that is known
  config = null;
  total = null; // bytes of the file, null if unknown
  complete = false; // no more groups will come
  settled = false; // not complete, but it has not grown for a while
  received = 0;
  #cache = new Map(); // group -> {bytes, size, sound} or {parts, sound}
  #head = new Uint8Array(); // first bytes of a finished file
  #whole = null; // all bytes so far, from a server without Range
  #closing = new AbortController();

  tracks = 1; // number of tracks of the file

  // track: index of the track to read
  constructor(url, track = 0) {
    super();
    this.track = track;
    this.url = absolute(url);
  }

  get frameCount() {
    const last = this.groups.at(-1);
    return last ? last.start_frame + last.frames : 0;
  }

  // Frames of the index that the file does not have.
  missing = 0;

  // Resolves when the first group is known.
  async open(create) {
    const [native, head] = await Promise.all([create(), this.#start()]);
    this.native = native; // whose demuxer is used
    native.track(this.track);
    if (!head.length) throw new StreamError("The file is empty.");
    this.total ??= await this.#size();
    this.native.push(head);
    let d = this.native.describe();
    while (!d.config && (await this.#more())) d = this.native.describe();
    if (!d.config) throw new StreamError("The file ends before its header does.");
    [this.config, this.tracks] = [d.config, d.tracks];
    const [told, first] = [d.index[0], d.groups[0] ?? d.pending]; // the fragment, if it is in the bytes so far
    const agrees = !first || (first.start_frame === told?.start_frame && first.frames === told.frames);
    if (told && agrees && !this.#whole) {
      this.#head = head;
      this.#useIndex(d.index, d.layers);
    } else {
      this.#list();
      this.#walk().catch((e) => this.#say("error", e));
      while (!this.groups.length && !this.complete) await new Promise((done) => this.addEventListener("groups", done, { once: true }));
    }
  }

  // The first bytes of the file, read before the decoder is loaded.
  async #start() {
    const head = await this.#read(0, HEAD);
    return this.total > HEAD && this.total <= SMALL && !this.#whole ? this.#read(0, this.total, undefined, head) : head;
  }

  level() {
    return this.config.level;
  }

  has(i) {
    return this.#cache.has(i);
  }

  close() {
    this.#closing.abort(new StreamError("closed"));
  }

  // A name for the bytes of group i.
  key(i) {
    return String(i);
  }

  // Bytes of group i, or of its first layers.
  async payload(i, signal, layers = ALL) {
    const g = this.groups[i];
    const size = g.ends?.[layers - 1] ?? g.size;
    const kept = this.#cache.get(i);
    if (kept && kept.size >= size) {
      this.#keep(i, kept);
      return kept.bytes;
    }
    const at = g.audio?.offset ?? g.offset;
    let bytes = await this.#read(at, g.offset + size, signal);
    if (bytes.length < g.offset + size - at) throw new StreamError("the file ends within them");
    const { audio, offset, size: all } = g.indexed ? this.#inside(g, bytes) : g;
    const sound = audio && { ...audio, bytes: bytes.slice(audio.offset - at, offset - at) };
    if (offset > at) bytes = bytes.slice(offset - at, offset - at + all);
    this.#keep(i, { bytes, size, sound });
    return bytes;
  }

  // Whether the server answers ranges.
  get ranged() {
    return !this.#whole;
  }

  // Group i, of which parts are fetched.
  async parts(i, signal) {
    const g = this.groups[i];
    let { parts, sound } = this.#cache.get(i) ?? {};
    if (!parts) {
      const { FIRST, Parts } = await import("./parts.js");
      const bytes = await this.#read(g.offset, g.offset + Math.min(FIRST, g.size), signal);
      const { audio, offset } = g.indexed ? this.#inside(g, bytes) : g;
      sound = audio && { ...audio, bytes: await this.#read(audio.offset, offset, signal) };
      const read = (start, end, until) => this.#read(offset + start, offset + end, until);
      parts = await Parts.open(read, bytes.subarray(offset - g.offset), signal);
    }
    this.#keep(i, { parts, sound });
    return parts;
  }

  // {time, samples: [size, duration] of each, bytes}: the sound that came with group i.
  sound(i) {
    return this.#cache.get(i)?.sound;
  }

  #say(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  // Least recently used groups are dropped first.
  #keep(i, entry) {
    this.#cache.delete(i);
    this.#cache.set(i, entry);
    const held = ({ bytes, parts }) => (bytes ?? parts).length;
    let size = 0;
    for (const entry of this.#cache.values()) size += held(entry);
    for (const [k, entry] of this.#cache) {
      if (size <= CACHE || k === i) break;
      this.#cache.delete(k);
      size -= held(entry);
    }
  }

  #useIndex(index, layers) {
    const end = this.total ?? Infinity;
    const whole = index.filter((g) => g.offset + g.size <= end);
    this.missing = index.slice(whole.length).reduce((n, g) => n + g.frames, 0);
    this.groups = whole.map((g, i) => ({ ...g, indexed: true, ends: layers[i] }));
    this.complete = true;
    this.#say("groups");
  }

  // The entry of the group in a fragment of the index, or in its first bytes.
  #inside(g, fragment) {
    const known = this.native.describe().groups.length;
    this.native.x.seek(g.offset);
    this.native.push(fragment);
    const { groups, pending } = this.native.describe(known);
    const [found, more] = fragment.length < g.size ? [pending] : groups;
    if (!found || more || found.start_frame !== g.start_frame || found.frames !== g.frames) {
      throw new StreamError("the index of the file disagrees with its fragments");
    }
    return found;
  }

  // Groups that the demuxer has passed.
  #list() {
    const d = this.native.describe(this.groups.length);
    for (const g of d.groups) this.groups.push(g);
    this.complete = d.complete;
    if (d.groups.length || d.complete) this.#say("groups");
  }

  // One step along the file; false at its end.
  async #more() {
    const { x } = this.native;
    const left = x.skippable();
    if (left > 0 && x.position() + left <= (this.total ?? 0)) {
      x.skip(left);
      return true;
    }
    const at = x.position() + left;
    const bytes = await this.#read(left > 0 ? at - 1 : at, at + STEP); // its last byte shows that a body is complete
    if (left > 0 && bytes.length) x.skip(left);
    const rest = left > 0 ? bytes.subarray(1) : bytes;
    if (rest.length) this.native.push(rest);
    return bytes.length > 0;
  }

  // Walks a file without an index, and polls it while it grows.
  async #walk() {
    let [wait, since] = [POLL[0], performance.now()];
    for (let seen = -1; !this.complete; ) {
      const moved = await this.#more();
      this.#list();
      const { x } = this.native;
      if (moved && x.position() !== seen) {
        [seen, wait, since] = [x.position(), POLL[0], performance.now()];
        this.settled = false;
        continue;
      }
      if (this.#whole) {
        this.complete = true; // the server has sent all of it
        this.#say("groups");
        return;
      }
      if (!this.settled && performance.now() - since > SETTLE) {
        this.settled = true;
        this.#say("groups");
      }
      await sleep(wait, this.#closing.signal);
      wait = Math.min(wait * 1.5, POLL[1]);
    }
  }

  // Bytes start .. end of the file, fewer where it ends; head: its first bytes.
  async #read(start, end, signal, head = this.#head) {
    if (this.#whole) return this.#whole.subarray(start, end);
    const parts = [head.subarray(start, end)];
    let [at, since, wait] = [start + parts[0].length, performance.now(), 250];
    while (at < end && (this.total === null || at < this.total || start >= this.total)) {
      const before = at;
      try {
        const done = await this.#request(at, end, (part) => {
          parts.push(part);
          at += part.length;
        }, signal);
        if (this.#whole) return this.#whole.subarray(start, end);
        if (done) break;
      } catch (e) {
        if (signal?.aborted || this.#closing.signal.aborted) throw e;
        if (e instanceof StreamError) throw e;
        if (at > before) [since, wait] = [performance.now(), 250];
        if (performance.now() - since > PATIENCE) throw new LinkError(`The connection is lost: ${e.message}.`);
        this.#say("retry", e.message);
        await sleep(wait, signal);
        wait = Math.min(2 * wait, 4000);
      }
    }
    this.#say("connected");
    const out = new Uint8Array(at - start);
    parts.reduce((to, part) => (out.set(part, to), to + part.length), 0);
    return out;
  }

  // The size, if no answer to a range has had it; null if unknown.
  async #size() {
    const response = await fetch(this.url, { method: "HEAD", signal: this.#closing.signal, cache: "no-store" }).catch(() => null);
    return (response?.ok && Number(response.headers.get("content-length"))) || null;
  }

  // One request; `take` gets the bytes as they come. True if the file has no more.
  async #request(start, end, take, signal) {
    const watch = new AbortController();
    const stop = (e) => watch.abort(e.target.reason);
    for (const s of [signal, this.#closing.signal]) {
      if (s?.aborted) throw s.reason;
      s?.addEventListener("abort", stop, { once: true });
    }
    let timer;
    const alive = () => {
      clearTimeout(timer);
      timer = setTimeout(() => watch.abort(new Error("no answer")), SILENCE);
    };
    try {
      alive();
      const began = performance.now();
      const response = await fetch(this.url, {
        headers: { Range: `bytes=${start}-${end - 1}` },
        signal: watch.signal,
        cache: "no-store",
      });
      return await this.#body(response, { start, end, began, alive, take });
    } finally {
      clearTimeout(timer);
      for (const s of [signal, this.#closing.signal]) s?.removeEventListener("abort", stop);
    }
  }

  async #body(response, { start, end, began, alive, take }) {
    const { status } = response;
    if (status === 416) {
      const size = /\/(\d+)$/.exec(response.headers.get("content-range") ?? "");
      if (size) this.total = Number(size[1]);
      return true;
    }
    if (status >= 500 || status === 408 || status === 429) throw new Error(`the server answered ${status}`);
    if (status !== 200 && status !== 206) {
      throw new LinkError(status === 404 ? "The file was not found on the server." : `The server answered ${status} ${response.statusText}.`);
    }
    const range = /bytes (\d+)-(\d+)\/(\d+|\*)/.exec(response.headers.get("content-range") ?? "");
    if (range && range[3] !== "*") this.total = Number(range[3]);
    const [chunks, before] = [[], this.received];
    const reader = response.body.getReader();
    for (;;) {
      const { done, value } = await reader.read();
      if (done) break;
      alive();
      this.received += value.length;
      if (status === 206) take(value);
      else chunks.push(value);
    }
    const bytes = Number(response.headers.get("content-length") ?? 0);
    this.#say("received", { bytes: this.received - before, ms: performance.now() - began }); // with parallel requests
    // another origin hides Content-Range, but not Content-Length
    if (status === 206 && !range && bytes && bytes < end - start) {
      this.total = start + bytes;
      return true;
    }
    if (status === 200) {
      this.#whole = new Uint8Array(await new Blob(chunks).arrayBuffer());
      this.total = this.#whole.length;
      return true;
    }
    return range !== null && Number(range[2]) + 1 < end; // fewer bytes than requested: the file ends there
  }
}
