import type { GsvStream } from "./stream.js";

export interface PlaybackOptions {
  /** Address of the .gsv file, or a Blob. */
  src: string | URL | Blob;
  /** Default: true. */
  autoplay?: boolean;
  /** Default: true. */
  loop?: boolean;
  /** Default: 1. */
  speed?: number;
  /** Whether the stream is rotated so that its up is y, as in the scene of the program; default: true. */
  upright?: boolean;
}

export class Playback {
  /** Resolves when the first group of frames is decoded. */
  readonly ready: Promise<GsvStream>;
  /** null before that. */
  readonly stream: GsvStream | null;
  /** The frame that is due. */
  readonly frame: number;
  /** The same with a fraction; may be set. */
  position: number;
  paused: boolean;
  loop: boolean;
  speed: number;
}
