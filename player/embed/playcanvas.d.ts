import type { Script } from "playcanvas";
import type { Playback } from "./playback.js";

/**
 * Plays a .gsv file below its entity. Units are those of the stream; y is up. Fires "frame" (number) for each new frame
 * and "error" (Error) if the stream cannot be played.
 */
export class GsvScript extends Script {
  static scriptName: "gsv";
  /** Address of the .gsv file. */
  src: string;
  autoplay: boolean;
  loop: boolean;
  speed: number;
  readonly playback: Playback;
  /** Resolves when the first group of frames is decoded. */
  readonly ready: Promise<this>;
  /** Box of most Gaussians of the first frame, [x, y, z] in the axes of the entity; known when it is ready. */
  low: [number, number, number];
  high: [number, number, number];
}
