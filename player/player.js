// <gsv-player src="URL"> plays a .gsv file: the clock, the resolution, and the messages to the viewer.
//
// Attributes: src (.gsv, or a DASH manifest .mpd); autoplay; loop; speed="0.5"; size="512x512" (else the image fills the
// element); quality="auto" or 0.1 to 1; layers="2" or "all", else as many as link and device sustain; renderer="cpu" or "gpu",
// else the GPU if it is hardware; camera="NAME", of the file; background="rrggbb"; controls="off"; of sound: muted,
// volume="0.5".
// Properties: paused, frame, frameCount, fps, camera, stats. Methods: play(), pause(), show(frame). Events: ready, picture,
// ended, error.

import { Camera, viewFrom } from "./camera.js";
import { MARKUP, clock, onDrag, onKeys, setIcon } from "./controls.js";
import { Engine } from "./engine.js";
import { ALL, AUTO } from "./native.js";

const PIXELS_MAX = 4e6; // of a still image
const PIXELS_START = 420_000; // of a moving one, before any measurement
const PIXELS_MIN = 180_000; // fewer save little: the cost of the Gaussians stays
const STILL = 250; // ms without camera motion until the image is sharp
const TALL = 2; // metres, height of the scene in a headset
const STALL = 300; // ms without an image until the busy sign appears

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
  #scale = null; // of a moving image per side, measured
  #adapted = 0;
  #times = []; // of the images of the last second
  #busySince = 0;

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
    return { ...e?.stats, fps: this.#times.length, received: e?.source?.received ?? 0 };
  }

  play() {
    if (!this.loop && this.frame >= this.frameCount - 1 && this.engine?.source?.complete) this.#position = 0;
    this.paused = false;
  }

  pause() {
    this.paused = true;
  }

  // Stops at frame t and resolves with {t, view} when its sharp image is on the canvas.
  show(t) {
    this.pause();
    this.#seek(t);
    this.#drawn = "";
    this.#moved = -STILL;
    return new Promise((resolve, reject) => {
      const seen = ({ detail }) => {
        if (detail.t !== t || detail.view.join() !== this.#view(true).join()) return;
        this.removeEventListener("picture", seen);
        resolve(detail);
      };
      this.addEventListener("picture", seen);
      this.addEventListener("error", (e) => reject(new Error(e.detail)), { once: true });
    });
  }

  // Opening and closing

  async #open() {
    this.#close();
    this.$(".error").hidden = true;
    this.$(".notes").replaceChildren();
    this.$(".busy").hidden = false;
    Object.assign(this, { camera: null, header: null, paused: true, shown: null });
    [this.#position, this.#scale, this.#drawn, this.#begun] = [0, null, "", false];
    const engine = (this.engine = new Engine(this.$("canvas"), this.getAttribute("src")));
    engine.layers = this.#layers;
    engine.view = () => (engine.gpu?.head ? null : this.camera ? this.#view(true) : undefined);
    const { source } = engine;
    const on = (target, type, f) => target.addEventListener(type, (e) => this.engine === engine && f(e.detail));
    on(engine, "damaged", (d) => this.#damaged(d));
    on(engine, "nogpu", (why) => this.#note("gpu", `The GPU cannot be used (${why}): the CPU draws.`));
    on(engine, "fatal", (message) => this.#fail("The player has stopped", `${message}.`));
    on(engine, "bounds", () => this.#begin(engine));
    on(engine, "decoded", ({ header }) => ((this.header = header), this.#begin(engine)));
    on(engine, "picture", (detail) => this.#pictured(detail));
    on(engine, "silent", (why) => this.#note("sound", `The sound cannot be played (${why}).`));
    on(source, "retry", (why) => this.#note("link", `Connection lost (${why}). Trying again…`, true));
    on(source, "connected", () => this.#note("link", null));
    on(source, "error", (e) => this.#fail("The file cannot be read on", sentence(e.message)));
    on(source, "groups", () => this.#grown());
    try {
      this.#request = requestAnimationFrame(() => this.#tick());
      await engine.open();
      if (this.engine !== engine) return;
      if (source.config.audio) this.#hear(engine);
      if (source.missing) {
        const all = this.frameCount + source.missing;
        this.#note("cut", `The file is cut short: ${this.frameCount} of ${all} frames are there.`, true);
      }
      this.#grown();
      if (!this.frameCount) this.#fail("Nothing to play", "The file has no whole group of frames.");
    } catch (e) {
      if (this.engine === engine) this.#fail("This file cannot be played", sentence(e.message));
    }
  }

  // Not before there is sound to play: others do not load it.
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
    const unfinished = source.settled ? "The file is unfinished: these are the frames it has." : "Live: the file is still being written.";
    this.#note("live", source.complete ? null : unfinished);
  }

  // Begins when what the first frame shows is decoded, and looks at it when its size is known.
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
    if (!scene && engine.failed.has(group)) group = this.#passOver(group);
    if (group === null) return;
    if (scene) scene.want(this.frame, this.#loops);
    else engine.want(group, this.#loops);
    if (!this.#begun) this.#begin(engine); // also when a track that it waited for is lost
    const decoded = () => (scene ? scene.ready(this.frame) : engine.ready(engine.groupOf(this.frame)));
    const ready = (scene ? decoded() : engine.ready(group)) && this.camera;
    if (ready && !this.paused) this.#advance(passed);
    this.sound?.follow(this.#position, ready && !this.paused, this.#loops);
    if (ready && decoded() && engine.renderer.free) this.#draw(now);
    this.#wait(now, ready && decoded());
    this.#follow(now);
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
    this.#fail("This file is damaged", `None of its groups can be decoded (group ${first}: ${why}).`);
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
    const fixed = /^(\d+)x(\d+)$/.exec(this.getAttribute("size") ?? "");
    if (fixed) return this.camera.view(Number(fixed[1]), Number(fixed[2]));
    const stage = this.$(".stage");
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const [w, h] = [stage.clientWidth * ratio, stage.clientHeight * ratio].map((v) => Math.max(v, 16));
    const most = Math.min(1, Math.sqrt(PIXELS_MAX / (w * h)));
    this.#scale ??= Math.min(1, Math.sqrt(PIXELS_START / (w * h)));
    const scale = this.quality === "auto" ? (sharp ? most : Math.min(this.#scale, most)) : this.quality * most;
    return this.camera.view(Math.round(w * scale), Math.round(h * scale));
  }

  // Rounds to a hundredth of the scene: smaller motions of the head need no other Gaussians.
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
    this.#times.push(now);
    this.#busySince = 0;
    this.dispatchEvent(new CustomEvent("picture", { detail }));
    if (!this.paused) this.#adapt(now);
  }

  // Switches to the renderer of the attribute.
  async #render() {
    const { engine } = this;
    this.#note("gpu", null);
    try {
      await engine.use(this.renderer);
    } catch (e) {
      if (this.engine === engine) this.#note("gpu", `The GPU cannot be used (${e.message}): the CPU draws.`);
    }
  }

  // Enters virtual ("vr") or augmented reality ("ar"): a scene as tall as a person, drawn on the GPU; in "ar" on the floor.
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
      this.#note("gpu", `${way === "ar" ? "Augmented" : "Virtual"} reality cannot be used here (${e.message}).`);
    }
  }

  // Adapts the resolution and the layers to the time of the slowest stage.
  #adapt(now) {
    if (now - this.#adapted < 500) return;
    this.#adapted = now;
    const { blend, project, decode } = this.engine.stats;
    const each = Math.min(this.fps * this.speed, 60) / 1000;
    const share = Math.max(blend, project) * each;
    const { clientWidth, clientHeight } = this.$(".stage");
    const least = Math.min(1, Math.sqrt(PIXELS_MIN / Math.max(clientWidth * clientHeight, 1)));
    const coarser = this.quality === "auto" && !this.hasAttribute("size") && this.#scale > least;
    if (share > 0.95) this.#scale = Math.max(least, this.#scale * 0.85);
    else if (share < 0.5) this.#scale = Math.min(1, this.#scale * 1.08);
    const load = Math.max(coarser ? 0 : share, (decode * this.fps * this.speed) / 1000);
    this.engine.choice.look(load, this.header.layers, now);
  }

  // Messages

  #wait(now, ready) {
    if (ready) this.#busySince = 0;
    else this.#busySince ||= now;
    this.$(".busy").hidden = !this.#busySince || now - this.#busySince < STALL;
  }

  #follow(now) {
    while (this.#times.length && this.#times[0] < now - 1000) this.#times.shift();
    const bar = this.$(".seek input");
    if (!bar.matches(":active")) bar.value = this.frame;
    setIcon(this.$("[data-do=play]"), this.paused ? "play" : "pause");
    if (now - (this.toldAt ?? 0) < 100) return;
    this.toldAt = now;
    const seconds = (n) => clock(n / this.fps);
    this.$(".time").innerHTML = `${seconds(this.frame)} <small>/ ${seconds(this.frameCount)}</small>`;
    bar.setAttribute("aria-valuetext", `frame ${this.frame} of ${this.frameCount}`);
    this.#track();
    this.#slow();
    if (!this.$(".stats").hidden) this.$(".stats").textContent = this.#figures();
  }

  // Colours the time bar: fetched, not fetched, damaged.
  #track() {
    const { source, failed } = this.engine;
    const at = (t) => `${((100 * t) / Math.max(this.frameCount, 1)).toFixed(2)}%`;
    const parts = source.groups.map((g, i) => {
      const color = failed.has(i) ? "#a4503f" : source.has(i) ? "#8a909c" : "#4a4d55";
      return `${color} ${at(g.start_frame)} ${at(g.start_frame + g.frames)}`;
    });
    const track = parts.length ? `linear-gradient(90deg, ${parts.join()})` : "";
    if (track !== this.track) this.$(".seek").style.setProperty("--track", track);
    this.track = track;
  }

  #slow() {
    const wanted = Math.min(this.fps * this.speed, 60);
    const drawn = this.#times.length;
    this.slow = this.paused || drawn > 0.8 * wanted || !this.$(".busy").hidden ? 0 : (this.slow ?? 0) + 1;
    const text = `This device draws ${drawn} of ${Math.round(wanted)} frames a second.`;
    this.#note("slow", this.slow > 20 ? text : null);
    const { source, layers, choice, groups } = this.engine;
    const shown = groups.get(this.engine.groupOf(this.frame));
    const fewer = layers === AUTO && choice.reason && shown?.layers < shown?.header?.layers;
    this.#note("layers", fewer ? `${shown.layers} of ${shown.header.layers} layers: ${choice.reason} no more just now.` : null);
    const lower = source.quality && source.representation < source.representations - 1;
    this.#note("quality", lower ? `Quality ${source.quality}: the link or this device carries no more just now.` : null);
  }

  #figures() {
    const { source } = this.engine;
    const [s, [width, height]] = [this.stats, this.shown?.view ?? [0, 0]];
    const group = source.groups[this.engine.groupOf(this.frame)];
    const rate = group ? (8e-6 * group.size * this.fps) / group.frames : 0;
    return [
      ["fps", `${s.fps} of ${this.fps.toFixed(1)}`],
      ["frame", `${this.frame} of ${this.frameCount}`],
      ["picture", `${width} x ${height}`],
      ["drawn by", this.engine.renderer.name],
      ["Gaussians", s.gaussians.toLocaleString("en")],
      ["decode", `${s.decode.toFixed(1)} ms/frame`],
      ["project", `${s.project.toFixed(1)} ms`],
      ["blend", `${s.blend.toFixed(1)} ms`],
      ["stream", `${rate.toFixed(2)} Mbit/s`],
      ["link", s.link ? `${s.link.toFixed(1)} Mbit/s` : "–"],
      ...(source.quality ? [["quality", source.quality]] : []),
      ["received", `${(s.received / 1e6).toFixed(2)} MB`],
    ].map(([name, value]) => `${name.padEnd(10)}${value}`).join("\n");
  }

  // A line in the corner; null removes it.
  #note(id, text, warn = false) {
    const notes = this.$(".notes");
    let note = notes.querySelector(`[data-id="${id}"]`);
    if (!text) return note?.remove();
    if (!note) {
      note = document.createElement("div");
      note.dataset.id = id;
      notes.append(note);
    }
    note.className = warn ? "note warn" : "note";
    if (note.textContent !== text) note.textContent = text;
  }

  #damaged({ group, frames, message }) {
    this.#note("damage", `Frames ${frames} are damaged and left out (group ${group}: ${message}).`, true);
  }

  #fail(title, message) {
    if (!this.$(".error").hidden) return;
    this.pause();
    this.$(".busy").hidden = true;
    this.$(".notes").replaceChildren();
    this.$(".error h2").textContent = title;
    this.$(".error p").textContent = message;
    this.$(".error").hidden = false;
    this.dispatchEvent(new CustomEvent("error", { detail: `${title}: ${message}` }));
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

function sentence(text) {
  const s = text.charAt(0).toUpperCase() + text.slice(1);
  return /[.!?]$/.test(s) ? s : `${s}.`;
}

customElements.define("gsv-player", GsvPlayer);
