// Views: an orbit around a target, or a reference camera of the file; OpenCV axes, as codec/model/camera.py.

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const length = (a) => Math.hypot(...a);
const clamp = (v, low, high) => Math.min(Math.max(v, low), high);

const FIELD_OF_VIEW = (40 * Math.PI) / 180; // as `gscodec render`
const PITCH_MAX = 1.5;
const [NEAR, LOW_PASS] = [0.01, 0.3]; // spec 14

export function upVector(axis) {
  const v = [0, 0, 0];
  v["xyz".indexOf(axis.at(-1))] = axis[0] === "-" ? -1 : 1;
  return v;
}

// A view from `eye` to pack all Gaussians: its direction and lens do not matter.
export const viewFrom = ([x, y, z]) => new Float32Array([16, 16, 8, 8, 8, 8, 1, 0, 0, -x, 0, 1, 0, -y, 0, 0, 1, -z, NEAR, LOW_PASS]);

// Low-pass of views from other places than the cameras of a config, px^2.
export const lowPassOf = (cameras) => cameras[0]?.low_pass ?? LOW_PASS;

export class Camera {
  // bounds: 1 to 99 % box of the first frame, 6 numbers; references: cameras of the config
  constructor(bounds, up, references = []) {
    const [low, high] = [bounds.slice(0, 3), bounds.slice(3)];
    Object.assign(this, { low, high });
    this.center = scale(add(low, high), 0.5);
    this.radius = Math.max(length(add(high, low, -1)) / 2, 1e-6);
    this.up = upVector(up);
    this.side = [this.up[2], this.up[0], this.up[1]];
    this.ahead = cross(this.up, this.side);
    this.references = references;
    this.lowPass = lowPassOf(references);
    this.nearest = Math.min(...references.map((c) => c.near), references.length ? Infinity : NEAR);
    this.reset();
  }

  reset() {
    this.target = this.center;
    this.distance = this.radius / Math.sin(FIELD_OF_VIEW / 2);
    this.yaw = 0;
    this.pitch = Math.atan(0.2);
    this.tangent = Math.tan(FIELD_OF_VIEW / 2); // of half the field of view, along the shorter side
    this.reference = null;
  }

  // Looks through reference camera i exactly.
  use(i) {
    this.reference = this.references[i] ?? null;
  }

  // From a reference camera to the nearest orbit.
  #leave() {
    const c = this.reference;
    if (!c) return;
    this.reference = null;
    const row = (i) => c.viewmat.slice(4 * i, 4 * i + 3);
    const t = [c.viewmat[3], c.viewmat[7], c.viewmat[11]];
    const eye = scale([0, 1, 2].map((j) => row(0)[j] * t[0] + row(1)[j] * t[1] + row(2)[j] * t[2]), -1);
    const forward = row(2);
    this.distance = Math.max(dot(add(this.center, eye, -1), forward), 0.2 * this.radius);
    this.target = add(eye, forward, this.distance);
    const back = scale(forward, -1);
    this.pitch = clamp(Math.asin(clamp(dot(back, this.up), -1, 1)), -PITCH_MAX, PITCH_MAX);
    this.yaw = Math.atan2(dot(back, this.ahead), dot(back, this.side));
    this.tangent = Math.min(c.width / c.k[0], c.height / c.k[3]) / 2;
  }

  #back() {
    const around = add(scale(this.side, Math.cos(this.yaw)), this.ahead, Math.sin(this.yaw));
    return add(scale(around, Math.cos(this.pitch)), this.up, Math.sin(this.pitch));
  }

  #axes() {
    const z = scale(this.#back(), -1);
    let x = cross(z, this.up);
    x = scale(x, 1 / length(x));
    return [x, cross(z, x), z];
  }

  // Drags, in shares of the shorter side of the image.
  orbit(dx, dy) {
    this.#leave();
    this.yaw -= 4 * dx;
    this.pitch = clamp(this.pitch + 4 * dy, -PITCH_MAX, PITCH_MAX);
  }

  pan(dx, dy) {
    this.#leave();
    const [x, y] = this.#axes();
    const unit = 2 * this.tangent * this.distance;
    this.target = add(add(this.target, x, -dx * unit), y, -dy * unit);
  }

  zoom(factor) {
    this.#leave();
    this.distance = clamp(this.distance / factor, 0.02 * this.radius, 50 * this.radius);
  }

  // The view from the same side, level.
  level() {
    this.#leave();
    const { pitch } = this;
    this.pitch = 0;
    const view = this.view(1000, 1000);
    this.pitch = pitch;
    return view;
  }

  // Foot of the scene: the lowest point below its middle.
  get foot() {
    return this.center.map((v, i) => (this.up[i] ? (this.up[i] > 0 ? this.low : this.high)[i] : v));
  }

  // width, height, fx, fy, cx, cy, 12 of world-to-camera, near, low-pass: the input of the rasterizer.
  view(width, height) {
    const c = this.reference;
    if (c) {
      const s = Math.min(width / c.width, height / c.height);
      const [cx, cy] = [s * (c.k[2] - c.width / 2) + width / 2, s * (c.k[4] - c.height / 2) + height / 2];
      return new Float32Array([width, height, s * c.k[0], s * c.k[3], cx, cy, ...c.viewmat, c.near, c.low_pass]);
    }
    const f = Math.min(width, height) / 2 / this.tangent;
    const eye = add(this.target, this.#back(), this.distance);
    const rows = this.#axes().flatMap((axis) => [...axis, -dot(axis, eye)]);
    const near = Math.min(this.nearest, this.distance / 2);
    return new Float32Array([width, height, f, f, width / 2, height / 2, ...rows, near, this.lowPass]);
  }
}
