// The wasm decoder and rasterizer: one instance per worker, and one on the page for the container. The exports are
// those of codec/native/bindings/src/wasm.rs; addresses are valid until the next call, so data is copied here.

// A module whose only function uses i8x16.splat: does this browser have simd128?
const SIMD = [0, 97, 115, 109, 1, 0, 0, 0, 1, 5, 1, 96, 0, 1, 123, 3, 2, 1, 0, 10, 10, 1, 8, 0, 65, 0, 253, 15, 253, 98, 11];

const HEADER_MAX = 1 << 22; // bytes of the header of a group: more than the maximum of 65,535 units and tiles takes
export const NONE = 255; // no slot
export const ALL = 255; // layers
export const AUTO = 0; // as many layers as link and device sustain

export async function load(url) {
  if (typeof WebAssembly !== "object" || !WebAssembly.validate(new Uint8Array(SIMD))) {
    throw new Error("This browser has no WebAssembly SIMD, which the player needs. Any browser of 2023 or later has it.");
  }
  const response = await fetch(url);
  if (!response.ok) throw new Error(`The decoder could not be loaded: ${url} answered ${response.status}.`);
  const module = await plain(response.body);
  return WebAssembly.compileStreaming(new Response(module, { headers: { "Content-Type": "application/wasm" } }));
}

// Unpacks a stream of gzip; unchanged where the server declared Content-Encoding, which the browser has undone.
async function plain(stream) {
  const [look, all] = stream.tee();
  const reader = look.getReader();
  const { value } = await reader.read();
  reader.cancel();
  return value?.[0] === 0x1f ? all.pipeThrough(new DecompressionStream("gzip")) : all;
}

export class Native {
  constructor(instance) {
    this.x = instance.exports;
  }

  static async create(module) {
    return new Native(await WebAssembly.instantiate(module, {}));
  }

  bytes(address, length) {
    return new Uint8Array(this.x.memory.buffer, address, length);
  }

  put(data) {
    this.bytes(this.x.input(data.length), data.length).set(data);
  }

  output() {
    return this.bytes(this.x.output(), this.x.output_length()).slice();
  }

  text() {
    return new TextDecoder().decode(this.output());
  }

  check(good) {
    if (!good) throw new Error(this.text());
  }

  // Container

  push(data) {
    this.put(data);
    this.check(this.x.push());
  }

  describe(first = 0) {
    this.x.describe(first);
    return JSON.parse(this.text());
  }

  // Reads track `number` of the file from now on.
  track(number) {
    this.x.track(number);
  }

  // The transform of the track at time u of the scene, in units of its timescale: rotation (wxyz), translation, scale.
  pose(u) {
    this.x.pose(u);
    return Array.from(this.floats());
  }

  // Groups

  // reference: the slot of the reference of a predicted group; layers: number to decode; wanted: flags of the tiles to
  // decode, all if null; keepLeading: whether leading tiles, from which they start, stay when they are not wanted;
  // packed: the payload omits the bytes of other tiles.
  decode(slot, payload, level, { reference = NONE, layers = ALL, wanted = null, keepLeading = true, packed = false } = {}) {
    this.put(payload);
    if (wanted) this.bytes(this.x.wanted(wanted.length), wanted.length).set(wanted);
    this.check(this.x.decode(slot, level, reference, layers, keepLeading, packed));
    return JSON.parse(this.text());
  }

  // How many groups back a payload refers; 0: it is independent.
  reference(payload) {
    this.put(payload.subarray(0, headerSize(payload)));
    const back = this.x.reference();
    this.check(back >= 0);
    return back;
  }

  // The tiles and units of a payload, see text.rs; before: the payload of its reference, if it is predicted.
  index(payload, before = null) {
    const head = (bytes) => bytes.subarray(0, headerSize(bytes));
    const [own, other] = [head(payload), before ? head(before) : new Uint8Array(0)];
    const both = new Uint8Array(other.length + own.length);
    both.set(other);
    both.set(own, other.length);
    this.put(both);
    this.check(this.x.index(other.length));
    return JSON.parse(this.text());
  }

  // pose: the transform that places the frame, with a scale of 0 nothing is shown; empty: the frame is not moved.
  frame(slot, t, pose = []) {
    this.#floats(pose);
    this.check(this.x.frame(slot, t));
  }

  // An attribute of the evaluated frame: 0 means, 1 quats, 2 log scales, 3 logit opacities, 4 sh0, 5 shN.
  attribute(which) {
    this.x.attribute(which);
    return this.floats();
  }

  floats() {
    return new Float32Array(this.output().buffer);
  }

  // The box of most means, from the 1st to the 99th percentile. means: a Float32Array of each worker.
  bounds(...means) {
    this.#floats(...means);
    this.x.bounds();
    return Array.from(this.floats());
  }

  #floats(...arrays) {
    const all = new Float32Array(arrays.reduce((n, a) => n + a.length, 0));
    arrays.reduce((at, a) => (all.set(a, at), at + a.length), 0);
    this.put(new Uint8Array(all.buffer));
  }

  // Image

  // view: 20 floats, see wasm.rs; ends: of bands, where other workers project for them, too, see `divide`. Calls
  // take(band) for each band; `splats` is a view into the memory of the instance. Returns the number of bands, and the
  // load of each row of tiles.
  project(view, count, take, ends = []) {
    this.#floats(view, ends);
    const bands = this.x.project(count);
    if (!bands) throw new Error(this.text());
    const load = this.floats();
    for (let i = 0; i < bands; i++) {
      const size = this.x.band_splats(i) * this.x.splat_size();
      take({ i, bands, first: this.x.band_first(i), rows: this.x.band_rows(i), splats: this.bytes(this.x.band(i), size) });
    }
    return { bands, load };
  }

  // The rows of tiles where at most `count` bands of about the same load end.
  divide(load, count) {
    this.#floats(load);
    this.x.divide(count);
    return Array.from(this.floats());
  }

  // The visible Gaussians, or all, for Spark (see pack.rs), relative to an origin: a view into the memory of the
  // instance.
  pack(view, origin, all) {
    this.put(new Uint8Array(view.buffer, view.byteOffset, view.byteLength));
    this.check(this.x.pack(...origin, all));
    return this.bytes(this.x.output(), this.x.output_length());
  }

  // Draws the Gaussians of a band; pieces: one array from each worker that projected some. Returns [rows, width, 4], a
  // view into the memory of the instance.
  draw(pieces, width, rows, background) {
    const size = pieces.reduce((n, piece) => n + piece.length, 0);
    const to = this.bytes(this.x.splats(size / this.x.splat_size()), size);
    pieces.reduce((at, piece) => (to.set(piece, at), at + piece.length), 0);
    this.check(this.x.draw(width, rows, ...background));
    return this.bytes(this.x.pixels(), width * rows * 4);
  }
}

// Bytes of the header of a group with the eight bytes before it, the first four of which hold its length.
export function headerSize(payload) {
  const size = payload.length < 8 ? 0 : new DataView(payload.buffer, payload.byteOffset).getUint32(0);
  if (size > HEADER_MAX) throw new Error(`the header of a group has ${size} bytes, expected at most ${HEADER_MAX}`);
  return 8 + size;
}
