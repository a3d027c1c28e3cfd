// The sound of a stream, and while it runs the clock of the page.
//
// The samples of a group go, in an MP4 of their own, to decodeAudioData, and start at their time on the clock of an
// AudioContext: at once, exactly at loops and seeks, and without https, which WebCodecs needs. Decoders differ in the
// samples that they drop at the start of a file, not at its end: a chunk is placed by its end. `delay`: measured time
// from when a picture is due until it appears.

const AHEAD = 1; // seconds that are scheduled ahead
const OFF = 0.01; // seconds from the position of the page above which sound starts anew: a seek, a stall
const DELAY_OFF = 0.02; // change of `delay` in seconds above which sound starts anew
const SETTLE = 4; // samples of the group before, for the decoder to settle
const KEPT = 40; // decoded chunks
const AGAIN = 3000; // ms until a group that could not be fetched is fetched again

const u32 = (...words) => words.flatMap((v) => [24, 16, 8, 0].map((n) => (v >>> n) & 255));
const text = (s) => [...s].map((c) => c.charCodeAt());
const zeros = (n) => Array(n).fill(0);
const box = (kind, ...parts) => [...u32(parts.flat().length + 8), ...text(kind), ...parts.flat()];
const sum = (numbers) => numbers.reduce((a, b) => a + b, 0);
const UNITY = u32(1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30);
const FTYP = box("ftyp", text("isom"), u32(0), text("isom"));

// A plain MP4 of samples [size, duration], whose bytes are `parts`.
function mp4({ entry, timescale }, samples, parts) {
  const [n, sizes, times] = [samples.length, samples.map((s) => s[0]), samples.map((s) => s[1])];
  const length = [timescale, sum(times)];
  const stbl = box("stbl", box("stsd", u32(0, 1), entry), box("stts", u32(0, n, ...times.flatMap((d) => [1, d]))),
    box("stsc", u32(0, 1, 1, n, 1)), box("stsz", u32(0, 0, n, ...sizes)), box("stco", u32(0, 1, FTYP.length + 8)));
  const minf = box("minf", box("smhd", zeros(8)), box("dinf", box("dref", u32(0, 1), box("url ", u32(1)))), stbl);
  const mdia = box("mdia", box("mdhd", u32(0, 0, 0, ...length, 0x55c40000)), box("hdlr", zeros(8), text("soun"), zeros(13)), minf);
  const trak = box("trak", box("tkhd", u32(3, 0, 0, 1, 0, length[1], 0, 0, 0, 1 << 24), UNITY, zeros(8)), mdia);
  const moov = box("moov", box("mvhd", u32(0, 0, 0, ...length, 1 << 16, 1 << 24, 0, 0), UNITY, zeros(24), u32(2)), trak);
  const head = [...FTYP, ...u32(sum(sizes) + 8), ...text("mdat")];
  return new Blob([Uint8Array.from(head), ...parts, Uint8Array.from(moov)]).arrayBuffer();
}

export class Sound {
  delay = 0.015; // seconds
  #at = null; // running sound: second t of the video was due at context time heard; next, base: the group that follows
  #last = null; // time of the context at the last `passed`
  #nodes = new Set();
  #chunks = new Map(); // group -> promise of the result of #decode
  #fetching = false; // a group that no picture needs
  #closing = new AbortController();

  // player: its bar, and its attributes `muted` and `volume`
  constructor(player, engine) {
    Object.assign(this, { player, engine });
    const { timescale } = engine.source.config.audio;
    this.context = new AudioContext(timescale >= 8000 && timescale <= 96_000 ? { sampleRate: timescale } : {});
    this.gain = new GainNode(this.context);
    this.gain.connect(this.context.destination);
    player.$(".gap").insertAdjacentHTML("afterend", `<span class="sound"><button title="Sound (M)" aria-label="Sound"><svg viewBox="0 0 24 24"><path d="M4 9v6h4l5 5V4L8 9zm11-.5a5 5 0 0 1 0 7z"/></svg></button><input type="range" max="1" step="0.05" aria-label="Volume"></span>`);
    this.part = player.$(".sound");
    [this.button, this.range] = this.part.children;
    const on = (target, type, f) => target.addEventListener(type, f, { signal: this.#closing.signal });
    on(this.range, "input", () => (player.removeAttribute("muted"), player.setAttribute("volume", this.range.value)));
    // browsers let no sound start before the viewer touches the page
    on(player, "click", (e) => this.#touched(e.composedPath().includes(this.button)));
    on(player, "keydown", (e) => this.#touched(e.key === "m" && !e.ctrlKey && !e.metaKey));
    on(document, "visibilitychange", () => this.#stop()); // a hidden page has no pictures
    on(engine, "picture", ({ detail }) => this.#seen(detail.t / engine.fps));
    this.context.onstatechange = () => this.level();
    this.level();
  }

  close() {
    this.#closing.abort();
    this.#stop();
    this.part.remove();
    this.context.close();
  }

  #touched(mute) {
    if (this.context.state !== "running") this.context.resume();
    else if (mute) this.player.toggleAttribute("muted");
  }

  // The attributes have changed.
  level() {
    this.range.value = this.player.getAttribute("volume") ?? 1;
    this.gain.gain.value = this.player.hasAttribute("muted") ? 0 : this.range.value;
    this.button.setAttribute("aria-pressed", this.gain.gain.value > 0 && this.context.state === "running");
  }

  // Time of the context that is heard now.
  get heard() {
    const { contextTime, performanceTime } = this.context.getOutputTimestamp();
    return contextTime > 0 ? contextTime + (performance.now() - performanceTime) / 1000 : this.context.currentTime;
  }

  // Seconds since the last call, by the clock of the sound; null while that stands still.
  passed() {
    const before = this.#last;
    this.#last = this.context.state === "running" && this.context.currentTime > 0 ? this.heard : null;
    return before === null || this.#last === null ? null : Math.min(Math.max(this.#last - before, 0), 0.25);
  }

  // Seconds until a loop starts anew.
  get #length() {
    return (this.engine.scene ?? this.engine.source).frameCount / this.engine.fps;
  }

  // Seconds by which the sound, at a time of the context, is ahead of second `t` of the video.
  #before(t, heard) {
    const off = this.#at.t + (heard - this.#at.heard) * this.#at.speed - t;
    return this.#at.loops ? off - this.#length * Math.round(off / this.#length) : off;
  }

  // Follows the page, which was at `frame` (with a fraction) at the last `passed`; plays: whether it plays.
  follow(frame, plays, loops) {
    if (!plays || this.#last === null) return this.#stop();
    const { source, fps } = this.engine;
    const [t, heard, speed, delay] = [frame / fps, this.#last, this.player.speed, this.delay];
    const at = this.#at;
    if (at && (speed !== at.speed || loops !== at.loops || Math.abs(delay - at.delay) > DELAY_OFF || Math.abs(this.#before(t, heard)) > OFF)) this.#stop();
    this.#at ??= { t, heard, speed, loops, delay, next: this.engine.groupOf(Math.floor(frame)), base: 0 };
    this.#schedule(this.#at, source, fps);
  }

  #schedule(at, { groups }, fps) {
    const until = at.t + (this.#last - at.heard + AHEAD) * at.speed;
    while (at.next < groups.length && groups[at.next].start_frame / fps + at.base < until) {
      if (!this.engine.source.has(at.next)) return this.#fetch(at.next);
      if (this.engine.source.sound(at.next)) this.#play(at, at.next, at.base);
      if (++at.next === groups.length && at.loops) [at.next, at.base] = [0, at.base + this.#length];
    }
  }

  // Fetches group i for its sound, where the first track of a scene is not shown.
  async #fetch(i) {
    const { scene, source, groups } = this.engine;
    if (!scene || groups.has(i) || this.#fetching) return;
    this.#fetching = true;
    await source.payload(i, this.#closing.signal, 1).catch(() => new Promise((done) => setTimeout(done, AGAIN)));
    this.#fetching = false;
  }

  #seen(t) {
    const late = this.#at && this.#before(t, this.heard) / this.#at.speed;
    if (late > 0 && late < 1) this.delay += 0.1 * (Math.min(late, 0.25) - this.delay);
  }

  #stop() {
    for (const node of this.#nodes) node.stop();
    this.#nodes.clear();
    this.#at = null;
  }

  // Starts the sound of group i, `base` seconds (the loops before) later than in the file.
  async #play(at, i, base) {
    if (!this.#chunks.has(i)) this.#chunks.set(i, this.#decode(i).catch((e) => this.#fail(e)));
    if (this.#chunks.size > KEPT) this.#chunks.delete(this.#chunks.keys().next().value);
    const chunk = await this.#chunks.get(i);
    if (!chunk || this.#at !== at) return;
    const { buffer, start, lead } = chunk;
    const when = at.heard + at.delay + (start + base - at.t) / at.speed;
    const late = Math.max(this.context.currentTime - when, 0);
    const from = lead + late * at.speed;
    if (from >= buffer.duration) return;
    const node = new AudioBufferSourceNode(this.context, { buffer, playbackRate: at.speed });
    node.connect(this.gain);
    node.start(when + late, from);
    node.onended = () => this.#nodes.delete(node);
    this.#nodes.add(node);
  }

  // {buffer; start: second of the video; lead: seconds of the buffer that are before it}
  async #decode(i) {
    const { source } = this.engine;
    const [{ audio }, { time, samples, bytes }, before] = [source.config, source.sound(i), source.sound(i - 1)];
    const tail = before?.samples.slice(-SETTLE) ?? [];
    const parts = before ? [before.bytes.slice(before.bytes.length - sum(tail.map((s) => s[0]))), bytes] : [bytes];
    const buffer = await this.context.decodeAudioData(await mp4(audio, [...tail, ...samples], parts));
    const lead = buffer.duration - sum(samples.map((s) => s[1])) / audio.timescale;
    return { buffer, lead: Math.max(lead, 0), start: (time - audio.media_start) / audio.timescale - Math.min(lead, 0) };
  }

  #fail(e) {
    if (!this.#closing.signal.aborted) this.engine.dispatchEvent(new CustomEvent("silent", { detail: e.message }));
  }
}
