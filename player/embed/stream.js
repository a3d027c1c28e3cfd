// GsvStream: the frames of a .gsv file for other programs, as arrays, packed for GPU renderers, or drawn on a canvas.
// The engine of the page decodes; requests are answered one after another.

import { Camera, lowPassOf, viewFrom } from "../camera.js";
import { Engine } from "../engine.js";
import { ALL, AUTO } from "../native.js";

export { Camera };

export class GsvStream {
  loop = true; // whether the first group is decoded again while the last one plays
  #engine;
  #url = null; // of a Blob
  #turn = Promise.resolve(); // of the last request

  // source: an address or a Blob; canvas: for `draw`; layers: number of layers of each group, "auto" or "all"
  static async open(source, { canvas = null, layers = "all" } = {}) {
    if (typeof Worker === "undefined") throw new Error("GsvStream needs web workers: use it in a browser.");
    const stream = new GsvStream();
    if (source instanceof Blob) stream.#url = URL.createObjectURL(source);
    stream.#engine = new Engine(canvas, stream.#url ?? String(source), { alone: true });
    stream.#engine.layers = { auto: AUTO, all: ALL }[layers] ?? layers;
    try {
      await stream.#race(stream.#engine.open());
      if (!stream.frameCount) throw new Error("The file has no whole group of frames.");
      await stream.#ready(0);
    } catch (e) {
      stream.close();
      throw e;
    }
    return stream;
  }

  get frameCount() {
    return this.#engine.source.frameCount;
  }

  get fps() {
    return this.#engine.fps;
  }

  get config() {
    return this.#engine.source.config;
  }

  get bounds() {
    return this.#engine.bounds;
  }

  get origin() {
    const { bounds } = this;
    return [0, 1, 2].map((i) => (bounds[i] + bounds[i + 3]) / 2);
  }

  get lowPass() {
    return lowPassOf(this.config.cameras);
  }

  // A camera that orbits the scene, as in the page.
  camera() {
    return new Camera(this.bounds, this.config.up, this.config.cameras);
  }

  async frame(t) {
    const { values } = await this.#ask(t, { type: "attributes" });
    const [means, quats, logScales, logitOpacities, sh0, shN] = values;
    return { count: logitOpacities.length, means, quats, logScales, logitOpacities, sh0, shN };
  }

  async packed(t, eye = this.origin) {
    const { buffer } = await this.#ask(t, { type: "pack", all: true, origin: this.origin, view: viewFrom(eye) });
    return new Uint32Array(buffer);
  }

  draw(t, view) {
    if (!this.#engine.renderer.canvas) {
      return Promise.reject(new Error("There is no canvas to draw on: open the stream with { canvas }."));
    }
    return this.#next(t, () => {
      const picture = this.#event("picture");
      this.#engine.draw(t, view);
      return picture;
    });
  }

  close() {
    this.#engine.close();
    this.#engine.dispatchEvent(new CustomEvent("fatal", { detail: "the stream was closed" }));
    if (this.#url) URL.revokeObjectURL(this.#url);
  }

  #ask(t, message) {
    return this.#next(t, () => this.#engine.ask(t, message));
  }

  // Runs a request about frame t after those before it.
  #next(t, request) {
    if (!(Number.isInteger(t) && t >= 0 && t < this.frameCount)) {
      return Promise.reject(new RangeError(`There is no frame ${t}: expected 0 to ${this.frameCount - 1}.`));
    }
    const answer = this.#turn.then(() => this.#ready(t)).then(request);
    this.#turn = answer.catch(() => {});
    return answer;
  }

  // Resolves when the group of frame t is decoded; the next one is decoded meanwhile.
  async #ready(t) {
    const engine = this.#engine;
    const group = engine.groupOf(t);
    engine.missed.delete(group); // each request tries once
    for (;;) {
      if (engine.closed) throw new Error("The stream is closed.");
      if (engine.failed.has(group)) throw new Error(`Frame ${t} is damaged: ${engine.failed.get(group)}.`);
      const missed = engine.missed.get(group);
      if (missed) throw new Error(`Frame ${t} cannot be fetched: ${missed.message}`);
      engine.want(group, this.loop);
      if (engine.ready(group)) return;
      await Promise.race(["decoded", "damaged", "missed"].map((type) => this.#event(type)));
    }
  }

  // Rejects when the engine has stopped, or cannot draw a picture.
  #event(type) {
    const engine = this.#engine;
    return new Promise((resolve, reject) => {
      const stop = new AbortController();
      const on = (name, settle) => {
        engine.addEventListener(name, (e) => (stop.abort(), settle(e.detail)), { signal: stop.signal });
      };
      on(type, resolve);
      for (const name of ["fatal", "undrawn"]) on(name, (message) => reject(new Error(message)));
    });
  }

  #race(promise) {
    return Promise.race([promise, this.#event("fatal")]);
  }
}
