// Images: drawn by raster workers in bands, and shown when the last band has arrived; or by the GPU, on a canvas above.

import { Gpu, gpuName } from "./gpu.js";

const IN_FLIGHT = 2; // images in progress: one is projected while the one before is blended

export class Renderer {
  #images = new Map(); // id -> {t, view, gpu, parts, blend, gaussians}
  #next = 1;
  #shown = 0;
  gpu = null;
  #how = "cpu";
  #closed = false;

  // rasters: number of raster workers; stats: gets blend and gaussians; say(type, detail): events picture, nogpu, fatal
  constructor(canvas, { rasters, stats, say }) {
    Object.assign(this, { canvas, rasters, stats, say });
    this.context = canvas?.getContext("2d", { alpha: false });
  }

  close() {
    this.#closed = true;
    this.#leaveGpu();
  }

  // See Engine.use. `bounds`: box of the scene, 6 numbers.
  async use(how, bounds, background) {
    this.#how = how;
    if (how === "cpu" || (how === "auto" && gpuName() === null)) return this.#leaveGpu();
    if (this.gpu) return;
    const canvas = document.createElement("canvas");
    canvas.hidden = true;
    const [low, high] = [bounds.slice(0, 3), bounds.slice(3)];
    const origin = low.map((v, i) => (v + high[i]) / 2);
    const gpu = await Gpu.create(canvas, { origin, background });
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

  // Registers an image {t, view, gaussians}; what the group worker must be asked for.
  begin(image, background) {
    const id = this.#next++;
    const gpu = this.gpu;
    this.#images.set(id, { ...image, gpu, parts: [], blend: 0 });
    return gpu ? { type: "pack", origin: gpu.origin, all: gpu.head !== null, id } : { type: "draw", background, id };
  }

  // The group worker has failed to draw an image.
  drop(id) {
    this.#images.delete(id);
  }

  // The group worker has packed the Gaussians of an image for the GPU.
  async onPacked({ id, buffer }) {
    const image = this.#images.get(id);
    if (!image) return; // the renderer was switched meanwhile
    const start = performance.now();
    try {
      await image.gpu.draw(image.view, new Uint32Array(buffer));
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
