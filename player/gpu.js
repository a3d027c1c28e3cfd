// Draws images on the GPU with Spark (three.js), with the constants of the spec (clause 14). spark.js is larger than
// the rest of the player, so it is loaded only when it is used; without it or without a GPU the CPU draws.

const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i; // slower than the wasm rasterizer
const ALPHA_MIN = 1 / 255;
const AHEAD = 2; // metres from the viewer to a scene that stands on the floor
const REACH = 20; // metres that a tap reaches
const FAR = 1e6; // of the depth buffer, which nothing else uses

// The name of the GPU behind WebGL2; null where there is none, or one that is software.
export function gpuName() {
  const gl = new OffscreenCanvas(1, 1).getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  if (!gl) return null;
  const name = nameOf(gl);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return SOFTWARE.test(name) ? null : name;
}

function nameOf(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  return /^ANGLE \([^,]*, (.*?)(?: \(0x|,|$)/.exec(name)?.[1] ?? name; // of "ANGLE (maker, name (0x..) .., driver)"
}

// Where a ray (column-major 4 x 4, along -z) meets the floor: x and z; null if it does not.
function onFloor(m) {
  const t = m && m[13] / m[9]; // height over fall
  return t > 0 && t < REACH ? [m[12] - t * m[8], m[14] - t * m[10]] : null;
}

export class Gpu {
  #busy = Promise.resolve();
  #spark;
  #renderer;
  #scene;
  #camera;
  #sorter;
  #splats;
  #mesh;
  #world;
  #head = null; // the camera of a session

  // origin: middle of the scene, which packed Gaussians are relative to; background: 3 numbers; lowPass: px^2
  static async create(canvas, { origin, background, lowPass }) {
    const spark = await import("./spark.js");
    if (!canvas.getContext("webgl2", { antialias: false, alpha: false })) throw new Error("this browser has no WebGL2 here");
    return new Gpu(spark, canvas, origin, background, lowPass);
  }

  constructor(spark, canvas, origin, background, lowPass) {
    this.#spark = spark;
    spark.ColorManagement.enabled = false; // colours are blended as they are
    this.#renderer = new spark.WebGLRenderer({ canvas, antialias: false, alpha: false });
    this.#renderer.setPixelRatio(1);
    this.#renderer.setClearColor(new spark.Color(...background), 1);
    this.name = nameOf(this.#renderer.getContext());
    this.#camera = new spark.PerspectiveCamera();
    Object.assign(this.#camera, { matrixAutoUpdate: false, far: FAR });
    this.#sorter = new spark.SparkRenderer({
      renderer: this.#renderer,
      autoUpdate: false,
      preBlurAmount: lowPass, // without compensation of the opacity
      blurAmount: 0,
      minAlpha: ALPHA_MIN,
      maxStdDev: Math.sqrt(-2 * Math.log(ALPHA_MIN)),
      maxPixelRadius: 1e4,
      sortRadial: false,
      enableLod: false,
    });
    this.#splats = new spark.PackedSplats();
    this.#mesh = new spark.SplatMesh({ packedSplats: this.#splats });
    this.#mesh.position.set(...origin);
    this.#world = new spark.Group(); // a session places it before the viewer
    this.#world.matrixAutoUpdate = false;
    this.#world.add(this.#mesh);
    this.#scene = new spark.Scene();
    this.#scene.add(this.#sorter, this.#world);
  }

  // Shows the scene in a headset until the session ends: seen as by the view (20 numbers), `metres` for a unit of it.
  // With `foot`, a point of the scene, it stands on the floor of the room (augmented reality), and a tap moves it
  // there. Calls tick() for each image of the session: meanwhile the window's own clock may stand still.
  async enter(session, { view, metres, foot }, tick) {
    const { xr } = this.#renderer;
    xr.enabled = true;
    xr.setReferenceSpaceType(foot ? "local-floor" : "local"); // origin: the head at the start, or the floor below it
    await xr.setSession(session);
    this.#head = new this.#spark.PerspectiveCamera();
    const { Matrix4 } = this.#spark;
    const upright = this.#toCamera(view).premultiply(new Matrix4().makeScale(metres, metres, metres));
    const stand = (x, z) => {
      const [fx, fy, fz] = this.#mesh.position.clone().set(...foot).applyMatrix4(upright);
      this.#place(upright.clone().premultiply(new Matrix4().makeTranslation(x - fx, -fy, z - fz)));
    };
    if (foot) {
      stand(0, -AHEAD);
      session.addEventListener("select", (e) => {
        const at = onFloor(e.frame.getPose(e.inputSource.targetRaySpace, xr.getReferenceSpace())?.transform.matrix);
        if (at) stand(...at);
      });
    } else this.#place(upright);
    this.#sorter.autoUpdate = true;
    this.#renderer.setAnimationLoop(() => {
      tick();
      this.#renderer.render(this.#scene, this.#head);
    });
    session.addEventListener("end", () => {
      this.#renderer.setAnimationLoop(null);
      this.#place(new Matrix4());
      this.#sorter.autoUpdate = xr.enabled = false;
      this.#head = null;
    });
  }

  #place(matrix) {
    this.#world.matrix.copy(matrix);
    this.#scene.updateMatrixWorld(true); // Spark reads it before the next rendering updates it
  }

  // Position of the head, in units of the scene; null outside of a session.
  get head() {
    if (!this.#head) return null;
    const { position } = this.#head;
    return position.clone().applyMatrix4(this.#world.matrix.clone().invert()).toArray();
  }

  // Shows Gaussians that `Native.pack` made for the view (20 numbers); resolves when they are on the canvas, in order.
  draw(view, packed) {
    this.#busy = this.#busy.then(() => this.#draw(view, packed));
    return this.#busy;
  }

  async #draw(view, packed) {
    const n = packed.length / 4;
    this.#splats.ensureSplats(Math.max(n, 1)).set(packed);
    this.#splats.numSplats = n;
    this.#splats.needsUpdate = true;
    this.#mesh.updateVersion();
    if (this.#head) return; // the session draws, and sorts meanwhile
    this.#look(view);
    await this.#sorter.update({ scene: this.#scene, camera: this.#camera });
    if (this.#head) return;
    const [width, height] = view;
    this.#renderer.setSize(width, height, false);
    this.#renderer.render(this.#scene, this.#camera);
  }

  // A pinhole camera with OpenCV axes -> OpenGL.
  #look(view) {
    const [w, h, fx, fy, cx, cy] = view;
    const near = view[18];
    const { projectionMatrix, projectionMatrixInverse, matrix } = this.#camera;
    const depth = [-(FAR + near) / (FAR - near), (-2 * FAR * near) / (FAR - near)];
    projectionMatrix.set((2 * fx) / w, 0, 1 - (2 * cx) / w, 0, 0, (2 * fy) / h, (2 * cy) / h - 1, 0, 0, 0, ...depth, 0, 0, -1, 0);
    projectionMatrixInverse.copy(projectionMatrix).invert();
    matrix.copy(this.#toCamera(view)).invert();
    this.#camera.updateMatrixWorld(true);
  }

  #toCamera(view) {
    const { Matrix4 } = this.#spark;
    const m = view.slice(6, 18);
    return new Matrix4().set(...m, 0, 0, 0, 1).premultiply(new Matrix4().makeScale(1, -1, -1));
  }

  close() {
    this.#splats.dispose();
    this.#sorter.dispose();
    this.#renderer.dispose();
    this.#renderer.forceContextLoss();
  }
}
