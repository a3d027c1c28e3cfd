// The clock of a stream in a scene of another program: which frame is due, one request at a time.

import { upVector } from "../camera.js";
import { GsvStream } from "./stream.js";

const EYE_STEPS = 50; // of the scene's size: smaller motions of the viewer keep the colours

export class Playback {
  paused = true;
  position = 0; // frames, with a fraction
  stream = null;
  #last = 0; // time of the last tick
  #busy = false;
  #shown = "";
  #closed = false;

  // show(packed, stream): takes the Gaussians of a frame (GsvStream.packed)
  constructor({ src, autoplay = true, loop = true, speed = 1, upright = true }, show) {
    Object.assign(this, { loop, speed, show });
    this.ready = GsvStream.open(src).then((stream) => {
      this.stream = stream;
      this.paused = !autoplay;
      this.#place(stream, upright ? stream.config.up : "y");
      if (this.#closed) stream.close();
      return stream;
    });
    this.ready.catch(() => {}); // callers that await `ready` get the error
  }

  // Sets rows (rotation to the axes of the scene) and, in these axes, origin of packed Gaussians, low and high corner
  // of the box of most of them.
  #place({ bounds, origin }, up) {
    this.rows = upright(up);
    const turn = (point) => this.rows.map((row) => row[0] * point[0] + row[1] * point[1] + row[2] * point[2]);
    const corners = [turn(bounds.slice(0, 3)), turn(bounds.slice(3))];
    this.origin = turn(origin);
    this.low = corners[0].map((v, i) => Math.min(v, corners[1][i]));
    this.high = corners[0].map((v, i) => Math.max(v, corners[1][i]));
  }

  get frame() {
    return Math.floor(this.position);
  }

  // For each image of the scene. eye: position of the viewer in units of the stream, for view-dependent colours.
  async tick(eye) {
    const now = performance.now();
    const passed = Math.min(now - this.#last, 250) / 1000;
    this.#last = now;
    const { stream } = this;
    if (!stream || this.#closed) return;
    if (!this.paused) this.#advance(passed * stream.fps * this.speed);
    stream.loop = this.loop;
    const due = `${this.frame} ${stream.config.sh_degree ? this.#coarse(eye) : ""}`;
    if (this.#busy || due === this.#shown) return;
    this.#busy = true;
    this.#shown = due;
    try {
      const packed = await stream.packed(this.frame, eye);
      if (!this.#closed) this.show(packed, stream);
    } catch (e) {
      if (!this.#closed) console.warn(`gscodec: ${e.message}`); // the frame before stays
    }
    this.#busy = false;
  }

  #coarse(eye) {
    const { bounds } = this.stream;
    const step = Math.hypot(...[0, 1, 2].map((i) => bounds[i + 3] - bounds[i])) / EYE_STEPS;
    return eye.map((v) => Math.round(v / step));
  }

  #advance(frames) {
    const count = this.stream.frameCount;
    const next = this.position + frames;
    if (next < count) this.position = next;
    else if (this.loop) this.position = next % count;
    else [this.position, this.paused] = [count - 1, true];
  }

  close() {
    this.#closed = true;
    this.stream?.close();
  }
}

// Rows of the rotation from axes of a stream whose up is `axis` ("y", "-z" ...) to those of a scene whose up is y.
function upright(axis) {
  const up = upVector(axis);
  const [i, s] = [up.findIndex(Boolean), up[0] + up[1] + up[2]];
  if (i === 1) return [[1, 0, 0], [0, s, 0], [0, 0, s]];
  return i === 0 ? [[0, -s, 0], up, [0, 0, 1]] : [[1, 0, 0], up, [0, -s, 0]];
}
