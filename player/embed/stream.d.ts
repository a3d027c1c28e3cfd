/**
 * The Gaussians of one frame, N = `count`. Units are those of the stream, axes those of its cameras (see `Config.up`).
 */
export interface Gaussians {
  count: number;
  /** [N, 3] */
  means: Float32Array;
  /** [N, 4], w x y z, unit length. */
  quats: Float32Array;
  /** [N, 3], natural logarithms of the standard deviations. */
  logScales: Float32Array;
  /** [N]; -Infinity for Gaussians that this frame does not show. */
  logitOpacities: Float32Array;
  /** [N, 3]; colour = 0.5 + 0.28209479 * sh0 + the higher bands, sRGB. */
  sh0: Float32Array;
  /** [N, K, 3], the higher bands of the spherical harmonics; K = 0, 3, 8 or 15 for degree 0 to 3. */
  shN: Float32Array;
}

/** A pinhole camera of the stream: axes x right, y down, z ahead. */
export interface ReferenceCamera {
  name: string;
  width: number;
  height: number;
  /** fx, skew, cx, fy, cy in pixels. */
  k: number[];
  /** [3, 4], world to camera, row by row. */
  viewmat: number[];
  /** Gaussians whose centre is nearer than this are not drawn. */
  near: number;
  /** Variance of the low-pass filter of rendering, pixels^2. */
  low_pass: number;
}

export interface Config {
  /** Frames per second as a fraction. */
  fps: [number, number];
  metres_per_unit: number;
  /** Which axis points up: "x", "-x", "y", "-y", "z" or "-z". */
  up: string;
  /** Colour behind the scene, 3 numbers from 0 to 1. */
  background: number[];
  sh_degree: number;
  cameras: ReferenceCamera[];
}

/**
 * 20 numbers: width, height, fx, fy, cx, cy in pixels; the 12 of world to camera, [3, 4] row by row, axes x right, y
 * down, z ahead; near plane; low-pass.
 */
export type View = Float32Array;

/** A camera that orbits the scene, or looks through a camera of the stream. */
export class Camera {
  constructor(bounds: ArrayLike<number>, up: string, references?: ReferenceCamera[]);
  /** The view of an image of `width` x `height` pixels. */
  view(width: number, height: number): View;
  /** Looks through camera `i` of the stream, until the next motion. */
  use(i: number): void;
  /** Turns by shares of the shorter side of the image; `pan` takes the same unit. */
  orbit(dx: number, dy: number): void;
  pan(dx: number, dy: number): void;
  /** Goes closer by a factor. */
  zoom(factor: number): void;
  reset(): void;
}

/** A .gsv file, decoded by web workers. Requests are answered one after another. */
export class GsvStream {
  /**
   * Resolves when the first group of frames is decoded. Rejects if there is no stream, it is damaged, or the browser
   * cannot play it.
   *
   * source: an address (HTTP Range is used where the host knows it), or a Blob or File; canvas: where `draw` draws;
   * layers: how many of each group are fetched, "auto": as many as the link carries.
   */
  static open(
    source: string | URL | Blob,
    options?: { canvas?: HTMLCanvasElement | null; layers?: number | "auto" | "all" },
  ): Promise<GsvStream>;
  readonly frameCount: number;
  /** Frames per second. */
  readonly fps: number;
  readonly config: Config;
  /** Box of most Gaussians (1 to 99 %) of the first frame: x, y, z of its low and of its high corner. */
  readonly bounds: number[];
  /** Middle of the box; packed Gaussians are relative to it. */
  readonly origin: number[];
  /** Variance of the low-pass filter of rendering from any place, pixels^2: that of the first camera. */
  readonly lowPass: number;
  /** Whether the first group is decoded again while the last one plays; true at first. */
  loop: boolean;
  /** A new camera that looks at the scene. */
  camera(): Camera;
  /** The Gaussians of frame `t`. Rejects with RangeError if there is no such frame. */
  frame(t: number): Promise<Gaussians>;
  /**
   * The Gaussians of frame `t` that are not transparent as [N, 4] words, 16 bytes each, Spark's PackedSplats, relative
   * to `origin`; with colours as seen from `eye`.
   */
  packed(t: number, eye?: ArrayLike<number>): Promise<Uint32Array>;
  /**
   * Draws frame `t` on the canvas, which becomes as large as the view; resolves when the image is there. Rejects if it
   * cannot be drawn, or there is no canvas.
   */
  draw(t: number, view: View): Promise<void>;
  /** Ends its workers and requests. */
  close(): void;
}
