// GsvObject: an Object3D that plays a .gsv file in a three.js scene; Spark sorts and draws it with all other splats
// there.

import { PackedSplats, SplatMesh } from "@sparkjsdev/spark";
import { Group, Matrix4 } from "three";
import { Playback } from "./playback.js";

class Splats extends SplatMesh {
  // Spark calls it for each image.
  update(context) {
    this.seen(context.viewToWorld);
    super.update(context);
  }
}

export class GsvObject extends Group {
  #packed = new PackedSplats();
  #mesh = new Splats({ packedSplats: this.#packed });

  constructor(options) {
    super();
    this.#mesh.seen = (viewToWorld) => this.playback.tick(this.#eye(viewToWorld));
    this.add(this.#mesh);
    this.playback = new Playback(options, (packed) => this.#show(packed));
    this.ready = this.playback.ready.then(() => {
      const { rows, origin, low, high } = this.playback;
      this.#mesh.position.set(...origin); // packed Gaussians are relative to it
      this.#mesh.quaternion.setFromRotationMatrix(new Matrix4().set(...rows.flatMap((row) => [...row, 0]), 0, 0, 0, 1));
      return Object.assign(this, { low, high, lowPass: this.playback.stream.lowPass });
    });
  }

  // Position of the viewer in units of the stream.
  #eye(viewToWorld) {
    const { origin } = this.playback.stream ?? { origin: [0, 0, 0] };
    const eye = this.position.clone().setFromMatrixPosition(viewToWorld);
    return this.#mesh.worldToLocal(eye).toArray().map((v, i) => v + origin[i]);
  }

  #show(packed) {
    const n = packed.length / 4;
    this.#packed.ensureSplats(Math.max(n, 1)).set(packed);
    this.#packed.numSplats = n;
    this.#packed.needsUpdate = true;
    this.#mesh.updateVersion();
    this.dispatchEvent({ type: "frame", frame: this.playback.frame });
  }

  play() {
    this.playback.paused = false;
  }

  pause() {
    this.playback.paused = true;
  }

  dispose() {
    this.playback.close();
    this.#mesh.dispose();
    this.#packed.dispose();
  }
}
