// The resolution of the image: a still one is sharp, a moving one as fine as the device draws in time.
//
// In: the size of the element and the times of the stages. Out: width and height of the image in pixels, and the load
// for the choice of layers.

const PIXELS_MAX = 4e6; // of a still image
const PIXELS_START = 420_000; // of a moving one, before any measurement
const PIXELS_MIN = 180_000; // fewer save little: the cost of the Gaussians stays

export class Resolution {
  #scale = null; // of a moving image per side, measured
  #adapted = 0;

  constructor(player) {
    this.player = player;
  }

  // For another stream.
  reset() {
    this.#scale = null;
  }

  // [width, height]; `sharp`: at full resolution.
  size(sharp) {
    const { player } = this;
    const fixed = /^0*([1-9]\d*)x0*([1-9]\d*)$/.exec(player.getAttribute("size") ?? "");
    if (fixed) return [Number(fixed[1]), Number(fixed[2])];
    const stage = player.$(".stage");
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const [w, h] = [stage.clientWidth * ratio, stage.clientHeight * ratio].map((v) => Math.max(v, 16));
    const most = Math.min(1, Math.sqrt(PIXELS_MAX / (w * h)));
    this.#scale ??= Math.min(1, Math.sqrt(PIXELS_START / (w * h)));
    const scale = player.quality === "auto" ? (sharp ? most : Math.min(this.#scale, most)) : player.quality * most;
    return [Math.round(w * scale), Math.round(h * scale)];
  }

  // Adapts the resolution and the layers to the time of the slowest stage.
  adapt(now) {
    if (now - this.#adapted < 500) return;
    this.#adapted = now;
    const { player } = this;
    const { blend, project, decode } = player.engine.stats;
    const each = Math.min(player.fps * player.speed, 60) / 1000;
    const share = Math.max(blend, project) * each;
    const { clientWidth, clientHeight } = player.$(".stage");
    const least = Math.min(1, Math.sqrt(PIXELS_MIN / Math.max(clientWidth * clientHeight, 1)));
    const coarser = player.quality === "auto" && !player.hasAttribute("size") && this.#scale > least;
    if (share > 0.95) this.#scale = Math.max(least, this.#scale * 0.85);
    else if (share < 0.5) this.#scale = Math.min(1, this.#scale * 1.08);
    const load = Math.max(coarser ? 0 : share, (decode * player.fps * player.speed) / 1000);
    player.engine.choice.look(load, player.header.layers, now);
  }
}
