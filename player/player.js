// <gsv-player src="URL"> plays a .gsv file: opening, the clock, the image, and the actions of the viewer. resolution.js
// chooses the resolution of the image, messages.js informs the viewer.
//
// Attributes: src (.gsv, or a DASH manifest .mpd); autoplay; loop; speed="0.5"; size="512x512" (else the image fills
// the element); quality="auto" or 0.1 to 1; layers="2" or "all", else as many as link and device sustain;
// renderer="cpu" or "gpu", else the GPU if it is hardware; camera="NAME", of the file; background="rrggbb";
// controls="off"; of sound: muted, volume="0.5".
// Properties: paused, frame, frameCount, fps, camera, stats. Methods: play(), pause(), show(frame). Events: ready,
// picture, ended, error.

import { Camera, viewFrom } from "./camera.js";
import { MARKUP, onDrag, onKeys } from "./controls.js";
import { Engine } from "./engine.js";
import { Messages, sentence } from "./messages.js";
import { ALL, AUTO } from "./native.js";
import { Resolution } from "./resolution.js";

const STILL = 250; // ms without camera motion until the image is sharp
const TALL = 2; // metres, height of the scene in a headset

export class GsvPlayer extends HTMLElement {
  static observedAttributes = ["src", "loop", "speed", "quality", "size", "layers", "renderer", "muted", "volume"];
  paused = true;
  speed = 1;
  quality = "auto";
  renderer = "auto";
  #position = 0; // frames, with a fraction
  #last = 0; // time of the last tick
  #moved = 0; // time of the last camera motion
  #drawn = ""; // the last request
  #begun = false;
  #messages = new Messages(this);
  #resolution = new Resolution(this);

  constructor() {
    super();
    const root = this.attachShadow({ mode: "open" });
    root.innerHTML = `<link rel="stylesheet" href="${new URL("./player.css", import.meta.url)}">${MARKUP}`;
    this.$ = (selector) => root.querySelector(selector);
    root.addEventListener("click", (e) => {
      const name = e.target.closest?.("[data-do]")?.dataset.do;
      if (name) this.#do(name, e);
    });
    root.addEventListener("change", (e) => this.#set(e.target));
    this.$(".seek input").addEventListener("input", (e) => this.#seek(Number(e.target.value)));
    onKeys(this, (name, e) => this.#do(name, e));
    const move = (f) => (...a) => {
      if (!this.camera) return;
      f(...a);
      this.#moved = performance.now();
      this.$("[data-set=view]").value = this.camera.reference ? String(this.camera.references.indexOf(this.camera.reference)) : "orbit";
    };
    onDrag(this.$(".view"), {
      orbit: move((x, y) => this.camera.orbit(x, y)),
      pan: move((x, y) => this.camera.pan(x, y)),
      zoom: move((f) => this.camera.zoom(f)),
    });
    this.$("[data-do=full]").hidden = !document.fullscreenEnabled;
    for (const way of ["vr", "ar"]) {
      navigator.xr?.isSessionSupported(`immersive-${way}`).then((yes) => (this.$(`[data-do=${way}]`).hidden = !yes), () => {});
    }
    this.$("[data-set=speed]").value = "1";
  }

  connectedCallback() {
    this.hasAttribute("tabindex") || this.setAttribute("tabindex", "-1");
    this.engine = null;
    if (this.getAttribute("src")) this.#open();
  }

  disconnectedCallback() {
    this.#close();
  }

  attributeChangedCallback(name, before, value) {
    if (name === "src" && this.engine !== undefined && this.isConnected && value !== before) this.#open();
    if (name === "loop") this.$("[data-do=loop]").setAttribute("aria-pressed", value !== null);
    if (name === "speed" && Number(value) > 0) this.speed = Number(value);
    if (name === "quality" && value) this.quality = value === "auto" ? value : Math.min(Math.max(Number(value) || 1, 0.1), 1);
    if (name === "muted" || name === "volume") this.sound?.level();
    if (name === "layers") this.engine?.show(this.#layers);
    if (name === "renderer") {
      this.renderer = ["cpu", "gpu"].includes(value) ? value : "auto";
      if (this.stats.gaussians) this.#render();
    }
    for (const set of ["speed", "quality", "renderer"]) this.$(`[data-set=${set}]`).value = String(this[set]);
  }

  get #layers() {
    const value = this.getAttribute("layers");
    return Number(value) >= 1 ? Number(value) : value === "all" ? ALL : AUTO;
  }

  get loop() {
    return this.hasAttribute("loop");
  }

  // A live stream does not loop: it waits for more.
  get #loops() {
    const { source } = this.engine;
    return this.loop && (source.complete || source.settled);
  }

  get frame() {
    return Math.floor(this.#position);
  }

  get frameCount() {
    return this.engine?.scene?.frameCount ?? this.engine?.source?.frameCount ?? 0;
  }

  get fps() {
    return this.engine.fps;
  }

  get stats() {
    const e = this.engine;
    return { ...e?.stats, fps: this.#messages.drawn, received: e?.received ?? 0 };
  }

  play() {
    if (!this.loop && this.frame >= this.frameCount - 1 && this.engine?.source?.complete) this.#position = 0;
    this.paused = false;
  }

  pause() {
    this.paused = true;
  }

  // Stops at frame t, as soon as the file is open, and resolves with {t, view} when its sharp image is on the canvas.
  async show(t) {
    if (!this.#begun) await this.#event("ready", () => true);
    if (!(Number.isInteger(t) && t >= 0 && t < this.frameCount)) {
      throw new RangeError(`There is no frame ${t}: expected 0 to ${this.frameCount - 1}.`);
    }
    this.pause();
    this.#seek(t);
    this.#drawn = "";
    this.#moved = -STILL;
    const sharp = (d) => d.t === t && d.view.join() === this.#view(true).join();
    const detail = await this.#event("picture", (d) => this.frame !== t || sharp(d));
    if (this.frame !== t) throw new Error(`Frame ${t} is not shown: the player has gone to frame ${this.frame}.`);
    return detail;
  }

  // The detail of the next event for which right(detail) is true; rejects when the player stops or cannot draw.
  #event(type, right) {
    if (!this.$(".error").hidden) return Promise.reject(new Error(this.$(".error p").textContent));
    return new Promise((resolve, reject) => {
      const stop = new AbortController();
      const on = (name, f) => this.addEventListener(name, f, { signal: stop.signal });
      on(type, ({ detail }) => right(detail) && (stop.abort(), resolve(detail)));
      for (const name of ["error", "undrawn"]) on(name, ({ detail }) => (stop.abort(), reject(new Error(detail))));
    });
  }

  // Opening and closing

  async #open() {
    const src = this.getAttribute("src");
    this.#close();
    this.$(".error").hidden = true;
    this.$(".notes").replaceChildren();
    this.$(".busy").hidden = !src;
    Object.assign(this, { camera: null, header: null, paused: true, shown: null });
    [this.#position, this.#drawn, this.#begun] = [0, "", false];
    this.#resolution.reset();
    this.#list(null);
    if (!src) return;
    try {
      this.engine = new Engine(this.$("canvas"), src);
    } catch (e) {
      return this.#messages.fail("This file cannot be played", e.message);
    }
    const { engine } = this;
    engine.layers = this.#layers;
    engine.view = () => (engine.gpu?.head ? null : this.camera ? this.#view(true) : undefined);
    const { source } = engine;
    const on = (target, type, f) => target.addEventListener(type, (e) => this.engine === engine && f(e.detail));
    on(engine, "damaged", (d) => this.#messages.damaged(d));
    on(engine, "missed", (d) => this.#messages.missed(d));
    on(engine, "undrawn", (why) => {
      this.#messages.note("draw", `The picture cannot be drawn (${why}).`, true);
      this.dispatchEvent(new CustomEvent("undrawn", { detail: why }));
    });
    on(engine, "nogpu", (why) => this.#messages.note("gpu", `The GPU cannot be used (${why}): the CPU draws.`));
    on(engine, "fatal", (message) => this.#messages.fail("The player has stopped", `${message}.`));
    on(engine, "bounds", () => this.#begin(engine));
    on(engine, "decoded", ({ header }) => {
      this.header = header;
      this.#messages.note("fetch", null);
      this.#begin(engine);
    });
    on(engine, "picture", (detail) => this.#pictured(detail));
    on(engine, "silent", (why) => this.#messages.note("sound", `The sound cannot be played (${why}).`));
    on(source, "retry", (why) => this.#messages.note("link", `Connection lost (${why}). Trying again…`, true));
    on(source, "connected", () => this.#messages.note("link", null));
    on(source, "error", (e) => this.#messages.fail("The file cannot be read on", sentence(e.message)));
    on(source, "groups", () => this.#grown());
    try {
      this.#request = requestAnimationFrame(() => this.#tick());
      await engine.open();
      if (this.engine !== engine) return;
      if (source.config.audio) this.#hear(engine);
      if (source.missing) {
        const all = this.frameCount + source.missing;
        this.#messages.note("cut", `The file is cut short: ${this.frameCount} of ${all} frames are there.`, true);
      }
      this.#grown();
      if (!this.frameCount) this.#messages.fail("Nothing to play", "The file has no whole group of frames.");
    } catch (e) {
      if (this.engine === engine) this.#messages.fail("This file cannot be played", sentence(e.message));
    }
  }

  // Called only when there is sound to play: other streams do not load sound.js.
  async #hear(engine) {
    const { Sound } = await import("./sound.js");
    if (this.engine === engine) this.sound = new Sound(this, engine);
  }

  #request = 0;

  #close() {
    cancelAnimationFrame(this.#request);
    this.sound?.close();
    this.engine?.close();
    this.sound = this.engine = null;
  }

  #grown() {
    const { source } = this.engine;
    this.$(".seek input").max = Math.max(this.frameCount - 1, 0);
    const settled = "The file has stopped growing: these are the frames it has.";
    this.#messages.note("live", source.complete ? null : source.settled ? settled : "Live: the file is still being written.");
  }

  // Begins when the content of the first frame is decoded; makes the camera when the bounds are known.
  #begin(engine) {
    const { scene } = engine;
    const { header } = this;
    if (!this.camera) this.#look(engine);
    if (this.#begun || !header || (scene && !scene.ready(this.frame))) return;
    this.#begun = true;
    this.#list(scene);
    const layers = this.$("[data-set=layers]");
    layers.hidden = header.layers < 2;
    const choices = Array.from({ length: header.layers - 1 }, (_, k) => new Option(`${k + 1} of ${header.layers} layers`, k + 1));
    layers.replaceChildren(new Option("Auto layers", "auto"), new Option("All layers", "all"), ...choices);
    layers.value = { [ALL]: "all", [AUTO]: "auto" }[this.#layers] ?? String(Math.min(this.#layers, header.layers - 1));
    if (this.hasAttribute("autoplay")) this.play();
    this.dispatchEvent(new CustomEvent("ready"));
  }

  #look(engine) {
    const { config } = engine.source;
    const bounds = engine.scene ? engine.scene.bounds(this.frame) : engine.bounds;
    if (!bounds) return;
    const color = /^#?([0-9a-f]{6})$/i.exec(this.getAttribute("background") ?? "")?.[1];
    if (color) config.background = [0, 2, 4].map((i) => parseInt(color.slice(i, i + 2), 16) / 255);
    this.camera = new Camera(bounds, config.up, config.cameras);
    this.camera.use(config.cameras.findIndex((c) => c.name === this.getAttribute("camera")));
    const select = this.$("[data-set=view]");
    select.replaceChildren(new Option("Free view", "orbit"), ...config.cameras.map((c, i) => new Option(c.name, i)));
    select.hidden = !config.cameras.length;
    select.value = this.camera.reference ? String(config.cameras.indexOf(this.camera.reference)) : "orbit";
  }

  // The clock

  #tick() {
    this.#request = requestAnimationFrame(() => this.#tick());
    if (!this.engine?.gpu?.head) this.#step();
  }

  #step() {
    const { engine } = this;
    const now = performance.now();
    const passed = this.sound?.passed() ?? Math.min(now - this.#last, 250) / 1000;
    this.#last = now;
    if (!engine?.source?.groups.length || !this.$(".error").hidden) return;
    const { scene } = engine;
    let group = engine.groupOf(this.frame);
    if (scene ? scene.lost : engine.failed.has(group)) group = this.#passOver(group);
    if (group === null) return;
    if (scene) scene.want(this.frame, this.#loops);
    else engine.want(group, this.#loops);
    if (!this.#begun) this.#begin(engine); // also when a track that it waited for is lost
    const decoded = () => (scene ? scene.ready(this.frame) : engine.ready(engine.groupOf(this.frame)));
    const ready = (scene ? decoded() : engine.ready(group)) && this.camera;
    if (ready && !this.paused) this.#advance(passed);
    this.sound?.follow(this.#position, ready && !this.paused, this.#loops);
    if (ready && decoded() && engine.renderer.free) this.#draw(now);
    this.#messages.wait(now, ready && decoded());
    this.#messages.follow(now);
  }

  #advance(passed) {
    const count = this.frameCount;
    const next = this.#position + passed * this.fps * this.speed;
    if (next < count) this.#position = next;
    else if (this.#loops) this.#position = next % count;
    else if (!this.engine.source.complete) this.#position = count - 1e-3; // live: wait for more
    else {
      this.#position = count - 1;
      this.pause();
      this.dispatchEvent(new CustomEvent("ended"));
    }
  }

  // Moves past a damaged group; null if there is no other.
  #passOver(group) {
    const { engine } = this;
    const { groups } = engine.source;
    for (let k = 1; k < groups.length; k++) {
      const i = (group + k) % groups.length;
      if (engine.failed.has(i)) continue;
      this.#position = groups[i].start_frame;
      return i;
    }
    if (!engine.source.complete) return null;
    this.#position = this.$(".seek input").value = 0;
    const [first, why] = engine.failed.entries().next().value;
    this.#messages.fail("This file is damaged", `None of its groups can be decoded (group ${first}: ${why}).`);
    return null;
  }

  #seek(t) {
    this.#position = Math.min(Math.max(t, 0), Math.max(this.frameCount - 1, 0));
  }

  // The image

  // The view; `sharp`: at full resolution.
  #view(sharp) {
    const head = this.engine.gpu?.head;
    if (head) return viewFrom(head.map((v) => this.#near(v)));
    return this.camera.view(...this.#resolution.size(sharp));
  }

  // Rounds to a hundredth of the scene: smaller motions of the head need no new Gaussians.
  #near(v) {
    const step = this.camera.radius / 50;
    return Math.round(v / step) * step;
  }

  #draw(now) {
    const view = this.#view(this.paused && now - this.#moved > STILL);
    const { engine } = this;
    const what = `${this.frame} ${view} ${engine.layers} ${engine.onGpu} ${engine.gaussians(this.frame)}`;
    if (what === this.#drawn) return;
    this.#drawn = what;
    engine.draw(this.frame, view);
  }

  #pictured(detail) {
    const now = performance.now();
    const { engine } = this;
    if (!this.shown) requestAnimationFrame(() => setTimeout(() => this.engine === engine && this.#render())); // after the first paint
    this.shown = detail;
    this.#messages.note("draw", null);
    this.#messages.pictured(now);
    this.dispatchEvent(new CustomEvent("picture", { detail }));
    if (!this.paused) this.#resolution.adapt(now);
  }

  // Switches to the renderer of the attribute.
  async #render() {
    const { engine } = this;
    this.#messages.note("gpu", null);
    try {
      await engine.use(this.renderer);
    } catch (e) {
      if (this.engine === engine) this.#messages.note("gpu", `The GPU cannot be used (${e.message}): the CPU draws.`);
    }
  }

  // Enters virtual ("vr") or augmented reality ("ar"): a scene as tall as a person, drawn on the GPU; in "ar" on the
  // floor.
  async #enter(way) {
    const { engine, camera } = this;
    try {
      const needs = way === "ar" ? { requiredFeatures: ["local-floor"] } : {};
      const session = await navigator.xr.requestSession(`immersive-${way}`, needs);
      await engine.use("gpu");
      if (!engine.gpu) return session.end();
      const how = { view: camera.level(), metres: TALL / (2 * camera.radius), foot: way === "ar" ? camera.foot : null };
      await engine.gpu.enter(session, how, () => this.#step());
      session.addEventListener("end", () => (this.#drawn = "", this.#render()));
    } catch (e) {
      this.#messages.note("gpu", `${way === "ar" ? "Augmented" : "Virtual"} reality cannot be used here (${e.message}).`);
    }
  }

  // Actions

  // The list of the tracks of a scene, which show and hide them.
  #list(scene) {
    this.$(".tracks").hidden = !(scene?.tracks.length > 1);
    this.$(".tracks").replaceChildren(...(scene?.tracks ?? []).map(({ name, hidden }, i) => {
      const [label, box] = [document.createElement("label"), document.createElement("input")];
      Object.assign(box, { type: "checkbox", checked: !hidden });
      box.dataset.track = i;
      label.append(box, name);
      return label;
    }));
  }

  #set({ dataset, value, checked }) {
    if (dataset.track) {
      this.engine.scene.tracks[dataset.track].hidden = !checked;
      [this.#drawn, this.#moved] = ["", performance.now()];
      return this.#grown();
    }
    if (dataset.set === "view") {
      if (value === "orbit") this.camera.reset();
      else this.camera.use(Number(value));
      this.#moved = performance.now();
    } else if (dataset.set) this.setAttribute(dataset.set, value);
  }

  #do(name, event) {
    const step = event.shiftKey ? 10 : 1;
    const actions = {
      play: () => (this.paused ? this.play() : this.pause()),
      back: () => (this.pause(), this.#seek(this.frame - step)),
      next: () => (this.pause(), this.#seek(this.frame + step)),
      first: () => this.#seek(0),
      last: () => this.#seek(this.frameCount - 1),
      closer: () => this.camera?.zoom(1.1),
      farther: () => this.camera?.zoom(1 / 1.1),
      loop: () => this.toggleAttribute("loop"),
      reset: () => (this.camera?.reset(), (this.$("[data-set=view]").value = "orbit")),
      stats: () => {
        const { hidden } = this.$(".stats");
        this.$(".stats").hidden = !hidden;
        this.$("[data-do=stats]").setAttribute("aria-pressed", hidden);
      },
      vr: () => this.#enter("vr"),
      ar: () => this.#enter("ar"),
      full: () => (document.fullscreenElement ? document.exitFullscreen() : this.requestFullscreen()),
      retry: () => this.#open(),
    };
    actions[name]?.();
  }
}

customElements.define("gsv-player", GsvPlayer);
