// The tracks of a scene (spec 2.8): each has an engine of its own, which decodes it; the engine of the first one draws
// them all.
//
// Frames are those of the scene, on the clock of the first track. A track that is damaged or not there is left out, and
// the others go on; the scene waits for a late track, as a single track does.

const NOTHING = [1, 0, 0, 0, 0, 0, 0, 0]; // a transform that shows nothing

// Whether a track has a placement other than the default.
export function placed({ placement: p }) {
  return Boolean(p && (p.name || p.hidden || p.offset || p.repeats !== 1 || p.keys));
}

// A point moved by a transform.
function moved([w, x, y, z, a, b, c, s], [px, py, pz]) {
  const [tx, ty, tz] = [2 * (y * pz - z * py), 2 * (z * px - x * pz), 2 * (x * py - y * px)];
  return [
    a + s * (px + w * tx + y * tz - z * ty),
    b + s * (py + w * ty + z * tx - x * tz),
    c + s * (pz + w * tz + x * ty - y * tx),
  ];
}

// A view of the scene as a view of a track before its transform: world-to-camera with the transform in front.
export function unplaced(view, pose) {
  const [origin, ...axes] = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]].map((p) => moved(pose, p));
  const own = Array.from(view);
  for (const row of [6, 10, 14]) {
    const along = (p) => p.reduce((sum, v, i) => sum + view[row + i] * v, 0);
    axes.forEach((axis, j) => (own[row + j] = along(axis) - along(origin)));
    own[row + 3] += along(origin);
  }
  if (!pose[7]) own[18] = Infinity; // nothing is nearer than that
  return own;
}

export class Scene {
  engines = []; // of all tracks, from the start
  tracks = []; // {engine, name, hidden} of those that are open
  opened = false;

  // host: the engine of the first track; create(k): that of track k
  constructor(host, create) {
    this.host = host;
    this.create = create;
  }

  // Resolves when all tracks are open, or lost. say(type, detail): events of the host.
  async open(say) {
    this.engines = [this.host, ...Array.from({ length: this.host.source.tracks - 1 }, (_, i) => this.create(i + 1))];
    const add = (engine, i) => {
      const { name, hidden } = engine.source.config.placement;
      return { engine, name: name || `Track ${i + 1}`, hidden };
    };
    const opened = this.engines.map(async (engine, i) => {
      if (!i) return add(engine, i);
      for (const type of ["damaged", "missed", "fatal", "bounds", "decoded"]) {
        engine.addEventListener(type, (e) => say(type, e.detail));
      }
      try {
        await engine.open();
        return add(engine, i);
      } catch (e) {
        engine.close();
        say("damaged", { group: `of track ${i + 1}`, frames: "of it", message: e.message });
        return null;
      }
    });
    this.tracks = (await Promise.all(opened)).filter(Boolean);
    this.opened = true;
  }

  close() {
    for (const engine of this.engines) if (engine !== this.host) engine.close();
  }

  show(layers) {
    for (const engine of this.engines) if (engine !== this.host) engine.show(layers);
  }

  // Time of frame t of the scene in units of the timescale of a track.
  #time(engine, t) {
    const [n, d] = this.host.source.config.fps;
    return (t * d * engine.source.config.fps[0]) / n;
  }

  // The frame of a track at frame t of the scene; null: it shows nothing.
  #local({ engine }, t) {
    const { source } = engine;
    const { offset, repeats } = source.config.placement;
    const n = Math.floor((this.#time(engine, t) - offset) / source.config.fps[1] + 1e-9);
    const count = source.frameCount;
    return n < 0 || !count || (repeats && n >= repeats * count) ? null : n % count;
  }

  // Frames until the last track that is shown ends; one without end counts as played once.
  get frameCount() {
    const [n, d] = this.host.source.config.fps;
    const shown = this.tracks.filter((track) => !track.hidden);
    const ends = (shown.length ? shown : this.tracks).map(({ engine: { source } }) => {
      const { offset, repeats } = source.config.placement;
      const [timescale, frame] = source.config.fps;
      return Math.ceil(((offset + Math.max(repeats, 1) * source.frameCount * frame) * n) / (timescale * d) - 1e-9);
    });
    return Math.max(0, ...ends);
  }

  // {engine, t} of each track that frame t of the scene shows and whose group is not damaged.
  #shown(t) {
    const all = this.tracks.map((track) => ({ engine: track.engine, hidden: track.hidden, t: this.#local(track, t) }));
    return all.filter((p) => !p.hidden && p.t !== null && !p.engine.failed.has(p.engine.groupOf(p.t)));
  }

  // Starts fetching and decoding the groups of frame t, and the next ones.
  want(t, loop) {
    for (const { engine, t: own, pose } of this.parts(t)) {
      engine.pose = pose;
      engine.want(engine.groupOf(own), loop || engine.source.config.placement.repeats !== 1);
    }
  }

  // {engine, t} of the tracks that frame t shows; without any a whole group, whose workers draw the background.
  #wanted(t) {
    if (!this.opened) return [{ engine: this.host, t: 0 }];
    const shown = this.#shown(t);
    return shown.length ? shown : [{ ...(this.#whole() ?? { engine: this.host, t: 0 }), pose: NOTHING }];
  }

  // {engine, t} of the first group that is not damaged.
  #whole() {
    for (const { engine } of this.tracks) {
      const group = engine.source.groups.find((_, i) => !engine.failed.has(i));
      if (group) return { engine, t: group.start_frame };
    }
    return null;
  }

  // Whether all groups of all tracks are damaged.
  get lost() {
    return this.opened && !this.#whole();
  }

  // Whether everything that frame t shows is decoded.
  ready(t) {
    return this.opened && this.#wanted(t).every(({ engine, t: own }) => engine.ready(engine.groupOf(own)));
  }

  // The tracks drawn in frame t: {engine, t, pose}.
  parts(t) {
    return this.#wanted(t).map((p) => ({ pose: this.#pose(p.engine, t), ...p }));
  }

  #pose(engine, t) {
    return engine.source.native.pose(this.#time(engine, t));
  }

  // The box of the tracks as placed in frame t, null until the boxes of all are known.
  bounds(t) {
    const engines = this.#wanted(t).map(({ engine }) => engine);
    if (!this.opened || engines.some(({ bounds }) => !bounds)) return null;
    const boxes = engines.map((engine) => {
      const [box, pose] = [engine.bounds, this.#pose(engine, t)];
      const corners = Array.from({ length: 8 }, (_, i) => [0, 1, 2].map((axis) => box[axis + 3 * ((i >> axis) & 1)]));
      const places = corners.map((p) => moved(pose, p));
      const over = (f) => [0, 1, 2].map((axis) => f(...places.map((p) => p[axis])));
      return [...over(Math.min), ...over(Math.max)];
    });
    return boxes.reduce((a, b) => a.map((v, i) => (i < 3 ? Math.min(v, b[i]) : Math.max(v, b[i]))));
  }
}
