import type { Camera } from "./embed/stream.js";

/**
 * `<gsv-player src="movie.gsv" autoplay loop>`: the player with its controls. Attributes are listed in player.js.
 * Events: ready, picture, ended, error.
 */
export class GsvPlayer extends HTMLElement {
  paused: boolean;
  speed: number;
  readonly loop: boolean;
  readonly frame: number;
  readonly frameCount: number;
  readonly fps: number;
  camera: Camera | null;
  play(): void;
  pause(): void;
  /** Stops at frame `t`; resolves when its sharp image is on the canvas. */
  show(t: number): Promise<{ t: number; view: Float32Array }>;
}

declare global {
  interface HTMLElementTagNameMap {
    "gsv-player": GsvPlayer;
  }
}
