// GsvScript: a script that plays a .gsv file on an entity of a PlayCanvas scene, by its GSplat component: the frame is
// one texture, in the 16 bytes a Gaussian that the decoder packs, which the engine unpacks and sorts with all other
// splats.

import { BoundingBox, Entity, GSplatContainer, GSplatFormat, Mat4, PIXELFORMAT_RGBA32U, Quat, Script, Vec3 } from "playcanvas";
import { Playback } from "./playback.js";

// How the engine reads a Gaussian, see codec/native/bindings/src/wasm/pack.rs.
const GLSL = `
uvec4 gsv;
float gsvByte(uint word, int i) { return float((word >> uint(8 * i)) & 255u); }
vec3 getCenter() {
  gsv = loadPacked();
  return vec3(unpackHalf2x16(gsv.y), unpackHalf2x16(gsv.z).x);
}
vec4 getColor() { return vec4(gsvByte(gsv.x, 0), gsvByte(gsv.x, 1), gsvByte(gsv.x, 2), gsvByte(gsv.x, 3)) / 255.0; }
vec3 getScale() { return exp((vec3(gsvByte(gsv.w, 0), gsvByte(gsv.w, 1), gsvByte(gsv.w, 2)) - 1.0) * (21.0 / 254.0) - 12.0); }
vec4 getRotation() {
  vec2 f = vec2(gsvByte(gsv.z, 2), gsvByte(gsv.z, 3)) * (2.0 / 255.0) - 1.0;
  vec3 axis = vec3(f, 1.0 - abs(f.x) - abs(f.y));
  float t = max(-axis.z, 0.0);
  axis.xy += mix(vec2(t), vec2(-t), greaterThanEqual(axis.xy, vec2(0.0)));
  float half_angle = gsvByte(gsv.w, 3) * (3.14159265 / 510.0);
  return vec4(cos(half_angle), sin(half_angle) * normalize(axis));
}`;

const WGSL = `
var<private> gsv: vec4u;
fn gsvByte(word: u32, i: u32) -> f32 { return f32((word >> (8u * i)) & 255u); }
fn getCenter() -> vec3f {
  gsv = loadPacked();
  return vec3f(unpack2x16float(gsv.y), unpack2x16float(gsv.z).x);
}
fn getColor() -> vec4f { return vec4f(gsvByte(gsv.x, 0u), gsvByte(gsv.x, 1u), gsvByte(gsv.x, 2u), gsvByte(gsv.x, 3u)) / 255.0; }
fn getScale() -> vec3f {
  return exp((vec3f(gsvByte(gsv.w, 0u), gsvByte(gsv.w, 1u), gsvByte(gsv.w, 2u)) - 1.0) * (21.0 / 254.0) - 12.0);
}
fn getRotation() -> vec4f {
  let f = vec2f(gsvByte(gsv.z, 2u), gsvByte(gsv.z, 3u)) * (2.0 / 255.0) - 1.0;
  let z = 1.0 - abs(f.x) - abs(f.y);
  let t = max(-z, 0.0);
  let axis = vec3f(f + select(vec2f(t), vec2f(-t), f >= vec2f(0.0)), z);
  let half_angle = gsvByte(gsv.w, 3u) * (3.14159265 / 510.0);
  return vec4f(cos(half_angle), sin(half_angle) * normalize(axis));
}`;

export class GsvScript extends Script {
  static scriptName = "gsv";

  /** @attribute @type {string} */
  src = "";
  /** @attribute @type {boolean} */
  autoplay = true;
  /** @attribute @type {boolean} */
  loop = true;
  /** @attribute @type {number} */
  speed = 1;
  #splats = null; // entity with the component, turned upright

  initialize() {
    const { src, autoplay, loop, speed } = this;
    this.playback = new Playback({ src, autoplay, loop, speed }, (packed, stream) => this.#show(packed, stream));
    this.ready = this.playback.ready.then(() => this.#place());
    this.ready.catch((e) => this.fire("error", e));
    this.once("destroy", () => this.#close());
  }

  #place() {
    const { rows: [x, y, z], origin, low, high } = this.playback;
    const turn = new Mat4();
    turn.data.set([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, 0, 0, 0, 1]);
    this.#splats = new Entity("gsv");
    this.#splats.setLocalRotation(new Quat().setFromMat4(turn));
    this.#splats.setLocalPosition(...origin); // packed Gaussians are relative to it
    this.entity.addChild(this.#splats);
    return Object.assign(this, { low, high });
  }

  update() {
    Object.assign(this.playback, { loop: this.loop, speed: this.speed });
    this.playback.tick(this.#eye());
  }

  // Position of the viewer in units of the stream.
  #eye() {
    const camera = this.app.systems.camera.cameras[0]?.entity;
    if (!this.#splats || !camera) return [0, 0, 0];
    const eye = this.#splats.getWorldTransform().clone().invert().transformPoint(camera.getPosition());
    const { origin } = this.playback.stream;
    return [eye.x + origin[0], eye.y + origin[1], eye.z + origin[2]];
  }

  #show(packed, { bounds }) {
    const count = packed.length / 4;
    const container = this.#container(count, bounds);
    container.getTexture("packed").lock().set(packed);
    container.getTexture("packed").unlock();
    this.#center(packed, container.centers);
    container.update(count);
    this.fire("frame", this.playback.frame);
  }

  // A container with room for `count` Gaussians.
  #container(count, bounds) {
    const { gsplat } = this.#splats;
    if (gsplat?.resource.maxSplats >= count) return gsplat.resource;
    const device = this.app.graphicsDevice;
    const stream = { name: "packed", format: PIXELFORMAT_RGBA32U };
    const format = new GSplatFormat(device, [stream], { readGLSL: GLSL, readWGSL: WGSL });
    const container = new GSplatContainer(device, Math.ceil(1.2 * Math.max(count, 1)), format);
    const reach = [0, 1, 2].map((i) => bounds[i + 3] - bounds[i]); // twice the box of most Gaussians of the first frame
    container.aabb = new BoundingBox(new Vec3(), new Vec3(reach));
    const before = gsplat?.resource;
    if (gsplat) gsplat.resource = container;
    else this.#splats.addComponent("gsplat", { resource: container });
    before?.destroy();
    return container;
  }

  // Centres for sorting, from the half floats of the packed Gaussians.
  #center(packed, centers) {
    HALVES ??= halves();
    for (let i = 0, j = 0; i < packed.length; i += 4, j += 3) {
      centers[j] = HALVES[packed[i + 1] & 65535];
      centers[j + 1] = HALVES[packed[i + 1] >>> 16];
      centers[j + 2] = HALVES[packed[i + 2] & 65535];
    }
  }

  #close() {
    this.playback.close();
    const resource = this.#splats?.gsplat?.resource;
    this.#splats?.destroy();
    resource?.destroy();
  }
}

let HALVES = null; // value of each half float

function halves() {
  const value = (h) => {
    const [exponent, fraction] = [(h >> 10) & 31, h & 1023];
    const size = exponent ? 2 ** (exponent - 25) * (1024 + fraction) : 2 ** -24 * fraction;
    return h & 32768 ? -size : size;
  };
  return Float32Array.from({ length: 65536 }, (_, h) => value(h));
}
