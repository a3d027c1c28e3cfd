// Images: drawn by raster workers in bands, and shown when the last band has arrived; or by the GPU, on a canvas above.

const IN_FLIGHT = 2; // images in progress: one is projected while the one before is blended
const TILE = 16; // rows of a tile of the rasterizer

export class Renderer {
  #images = new Map(); // id -> {t, view, gpu, pieces, packed, parts, blend, gaussians}
  #projected = new Map(); // id -> {left, load, ms} of images that several workers project
  #load = new Float32Array(0); // of each row of tiles of the last image that several workers have projected
  #next = 1;
  #shown = 0;
  gpu = null;
  #how = "cpu";
  #closed = false;

  // rasters: number of raster workers; stats: gets project, blend and gaussians; divide(load): ends of bands of about
  // the same load; say(type, detail): events picture, undrawn, nogpu, fatal
  constructor(canvas, { rasters, stats, divide, say }) {
    Object.assign(this, { canvas, rasters, stats, divide, say });
    this.context = canvas?.getContext("2d", { alpha: false });
  }

  close() {
    this.#closed = true;
    this.#leaveGpu();
  }

  // See Engine.use. `bounds`: box of the scene, 6 numbers; `lowPass`: px^2.
  async use(how, bounds, background, lowPass) {
    this.#how = how;
    if (how === "cpu") return this.#leaveGpu();
    const { Gpu, gpuName } = await import("./gpu.js"); // after the first picture
    if (how === "auto" && gpuName() === null) return this.#leaveGpu();
    if (this.gpu || this.#closed || this.#how !== how) return;
    const canvas = document.createElement("canvas");
    canvas.hidden = true;
    const [low, high] = [bounds.slice(0, 3), bounds.slice(3)];
    const origin = low.map((v, i) => (v + high[i]) / 2);
    const gpu = await Gpu.create(canvas, { origin, background, lowPass });
    if (this.#closed || this.gpu || this.#how !== how) return gpu.close();
    this.canvas.after(canvas);
    canvas.addEventListener("webglcontextlost", () => this.#loseGpu("its context was lost"));
    this.gpu = Object.assign(gpu, { canvas, origin });
  }

  #leaveGpu() {
    const gpu = this.gpu;
    this.gpu = null;
    gpu?.canvas.remove();
    gpu?.close();
    for (const [id, image] of this.#images) if (image.gpu) this.#images.delete(id);
    if (this.canvas) this.canvas.hidden = false;
  }

  #loseGpu(why) {
    if (!this.gpu) return;
    this.#leaveGpu();
    this.say("nogpu", why);
  }

  get name() {
    return this.gpu?.name ?? `CPU, ${this.rasters} workers`;
  }

  // True if another image may be requested.
  get free() {
    return this.#images.size < IN_FLIGHT;
  }

  // Registers an image {t, view, gaussians, pieces, divided}: `pieces` group workers project it; divided: in several
  // pieces. Returns the request to send to them.
  begin(image, background) {
    const id = this.#next++;
    const gpu = this.gpu;
    this.#images.set(id, { ...image, gpu, packed: [], parts: [], blend: 0 });
    this.#projected.set(id, { left: image.pieces, load: null, ms: 0 });
    if (gpu) return { type: "pack", origin: gpu.origin, all: gpu.head !== null, id };
    return { type: "draw", background, id, ends: image.divided ? this.#ends(image.view[1]) : [] };
  }

  // Pieces of an image must agree on its bands; they follow from the load of the image before.
  #ends(height) {
    const rows = Math.ceil(height / TILE);
    return this.divide(this.#load.length === rows ? this.#load : new Float32Array(rows).fill(1));
  }

  // A group worker has projected its part of an image.
  onProjected({ id, load, ms }) {
    const sum = this.#projected.get(id);
    if (!sum) return;
    sum.ms = Math.max(sum.ms, ms);
    sum.load = sum.load ? sum.load.map((v, i) => v + load[i]) : load;
    if (--sum.left) return;
    for (const k of this.#projected.keys()) if (k <= id) this.#projected.delete(k);
    this.stats.project = sum.ms;
    this.#load = sum.load;
  }

  // A group worker has failed to draw an image.
  drop(id, why) {
    if (this.#images.delete(id)) this.say("undrawn", why);
  }

  // A group worker has packed its Gaussians of an image for the GPU.
  async onPacked({ id, piece, buffer, ms }) {
    this.onProjected({ id, load: new Float32Array(0), ms });
    const image = this.#images.get(id);
    if (!image) return; // the renderer was switched meanwhile
    image.packed[piece] = new Uint8Array(buffer);
    if (Object.keys(image.packed).length < image.pieces) return;
    const packed = new Uint8Array(image.packed.reduce((n, p) => n + p.length, 0));
    image.packed.reduce((at, p) => (packed.set(p, at), at + p.length), 0);
    const start = performance.now();
    try {
      await image.gpu.draw(image.view, new Uint32Array(packed.buffer));
    } catch (e) {
      if (this.gpu === image.gpu) this.#loseGpu(e?.message ?? "it stopped");
      return;
    }
    if (!this.#images.delete(id)) return;
    image.blend = performance.now() - start;
    [this.canvas.hidden, image.gpu.canvas.hidden] = [true, false];
    this.#tell(id, image);
  }

  // A raster worker has drawn a band.
  onRaster(worker, m) {
    if (m.type === "failed") return this.say("fatal", m.message || "a worker could not be started");
    const image = this.#images.get(m.id);
    if (!image) return;
    image.parts.push({ ...m, worker });
    image.blend = Math.max(image.blend, m.ms);
    if (image.parts.length < m.bands) return;
    this.#images.delete(m.id);
    if (m.id > this.#shown) this.#show(m.id, image);
    for (const { worker, pixels } of image.parts) worker.postMessage(pixels, [pixels]);
  }

  #show(id, image) {
    const { parts, view } = image;
    const [width, height] = view;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    for (const { pixels, first, rows } of parts) {
      this.context.putImageData(new ImageData(new Uint8ClampedArray(pixels), width, rows), 0, first);
    }
    this.#tell(id, image);
  }

  #tell(id, { t, view, blend, gaussians }) {
    this.#shown = id;
    Object.assign(this.stats, { blend, gaussians });
    this.say("picture", { id, t, view });
  }
}
