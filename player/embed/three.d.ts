import type { Group, Object3DEventMap } from "three";
import type { Playback, PlaybackOptions } from "./playback.js";

export interface GsvObjectEventMap extends Object3DEventMap {
  /** A new frame is shown. */
  frame: { frame: number };
}

/**
 * Plays a .gsv file in a three.js scene that has a SparkRenderer. Units are those of the stream; y is up. Give the
 * SparkRenderer `preBlurAmount: lowPass, blurAmount: 0` to get the image that gscodec draws.
 */
export class GsvObject extends Group<GsvObjectEventMap> {
  constructor(options: PlaybackOptions);
  readonly playback: Playback;
  /** Resolves when the first group of frames is decoded; rejects if the stream cannot be played. */
  readonly ready: Promise<this>;
  /** Box of most Gaussians of the first frame, [x, y, z] in the axes of this object; known when it is ready. */
  low: [number, number, number];
  high: [number, number, number];
  /** Variance of the low-pass filter that the stream asks for, pixels^2; known when it is ready. */
  lowPass: number;
  play(): void;
  pause(): void;
  /** Ends its workers and frees its memory. */
  dispose(): void;
}
