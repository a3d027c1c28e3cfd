// A group of which only the tiles in view are fetched and decoded.
//
//   first bytes --header--> index of tiles, with boxes --view--> flags of tiles --ranges--> units --packed--> worker
//
// A tile needs the leading tiles of its layer, from whose models it starts; a tile of survivors also needs the tile of
// the reference with its number, and the leading tiles there. `index`: see text.rs.

import { headerSize } from "./native.js";

export const FIRST = 1 << 14; // bytes to fetch first: the header of a group of a million Gaussians is shorter
const GAP = 1 << 11; // bytes between two units up to which they are fetched at once
const [STILL, MOVING] = [0.01, 0.3]; // margin around the image, in shares of its sides
const BATCH = 4; // tiles that a worker decodes at once while it draws
const EDGE = 0.05; // share of the Gaussians outside of the bounds on each side, at most
const [COUNT, LEADING, OFFSET, SIZE, BOX] = [0, 1, 2, 3, 4]; // indices in the description of a tile

export class Parts {
  before = null; // Parts of the reference
  #read;
  #first;
  #held = new Map(); // offset -> bytes of a unit
  #view = "";

  // read(start, end, signal): bytes of the payload; first: its first bytes
  static async open(read, first, signal) {
    const parts = new Parts();
    if (first.length < 8) first = await read(0, FIRST, signal); // the sound in front of it fills them
    const size = headerSize(first);
    if (first.length < size) first = await read(0, size, signal);
    Object.assign(parts, { head: first.subarray(0, size) });
    [parts.#read, parts.#first] = [read, first];
    return parts;
  }

  // before: Parts of the reference, if the group is predicted
  describe(native, before, key) {
    before?.describe(native, null);
    this.index ??= native.index(this.head, before?.head);
    Object.assign(this, { before, key });
  }

  // Number of bytes held.
  get length() {
    return [...this.#held.values()].reduce((n, unit) => n + unit.length, this.head.length);
  }

  // Low and high corner of the boxes of most tiles.
  get bounds() {
    const tiles = this.index.tiles.flat();
    const side = (axis, sign) => {
      const ends = tiles.map((tile) => [tile[BOX + axis + (sign > 0 ? 3 : 0)], tile[COUNT]]).filter(([end]) => end !== null);
      ends.sort(([a], [b]) => sign * (b - a));
      let left = EDGE * ends.reduce((n, [, count]) => n + count, 0);
      return (ends.find(([, count]) => (left -= count) < 0) ?? [sign > 0 ? 1 : 0])[0];
    };
    return [-1, 1].flatMap((sign) => [0, 1, 2].map((axis) => side(axis, sign)));
  }

  // Flags of the tiles of the first `layers` layers whose boxes touch the view, all if it is null; with a larger margin
  // while it moves.
  seen(view, layers) {
    const moving = this.#view && `${view}` !== this.#view;
    this.#view = `${view}`;
    const planes = view ? frustum(view, moving ? MOVING : STILL) : [];
    const flag = (tile, k) => Number(k < layers && tile[COUNT] > 0 && planes.every((plane) => touches(tile, plane)));
    return Uint8Array.from(this.index.tiles.flatMap((tiles, k) => tiles.map((tile) => flag(tile, k))));
  }

  // Fetches the units that the tiles with flags need, also those of the reference.
  async fetch(flags, layers, signal) {
    await Promise.all([this.#fetch(flags, layers, false, signal), this.before?.#fetch(this.#survivors(flags), layers, true, signal)]);
  }

  async #fetch(flags, layers, leading, signal) {
    const runs = [];
    for (const [start, size] of this.#units(flags, layers, leading)) {
      if (this.#held.has(start)) continue;
      const last = runs.at(-1);
      if (last && start - last.end <= GAP) last.end = start + size;
      else runs.push({ start, end: start + size, units: [] });
      runs.at(-1).units.push([start, size]);
    }
    const take = async ({ start, end, units }) => {
      const bytes = end <= this.#first.length ? this.#first.subarray(start, end) : await this.#read(start, end, signal);
      if (bytes.length < end - start) throw new Error("the file ends within them");
      for (const [at, size] of units) this.#held.set(at, bytes.subarray(at - start, at - start + size));
    };
    await Promise.all(runs.map(take));
  }

  // [offset, size] of the units that a decoder of the tiles with flags reads, in order; leading: it keeps all leading
  // tiles.
  #units(flags, layers, leading) {
    let at = 0;
    const own = this.index.tiles.flatMap((tiles, k) => {
      const asked = flags.subarray(at, (at += tiles.length));
      const lead = k < layers && (leading || asked.includes(1));
      return tiles.filter((tile, t) => asked[t] || (lead && tile[LEADING])).map((tile) => [tile[OFFSET], tile[SIZE]]);
    });
    const others = this.index.others.filter(([layer]) => layer < layers).map(([, offset, size]) => [offset, size]);
    return [...own, ...others].filter(([, size]) => size > 0).sort(([a], [b]) => a - b);
  }

  // Flags of the tiles of the reference that the tiles with flags refer to.
  #survivors(flags) {
    const [own, known] = [this.index.tiles, this.before.index.tiles].map((layers) => layers.map((tiles) => tiles.length));
    const starts = own.map((_, k) => own.slice(0, k).reduce((n, v) => n + v, 0));
    return Uint8Array.from(known.flatMap((n, k) => Array.from({ length: n }, (_, t) => flags[starts[k] + t])));
  }

  // Orders of worker k of n: its part of the tiles with flags; more: in pieces of a few tiles each.
  orders(flags, layers, k, n, more) {
    let count = 0; // the same number of tiles for each worker
    const own = flags.map((flag) => Number(flag && count++ % n === k));
    return (more ? batches(own) : [own]).map((wanted) => {
      const before = this.before && this.#survivors(wanted);
      const key = `${this.key}, tiles ${before}`;
      const reference = before && { key, payload: this.before.#pack(before, layers, true), wanted: before, packed: true };
      return { payload: this.#pack(wanted, layers, false), wanted, packed: true, reference };
    });
  }

  #pack(flags, layers, leading) {
    const pieces = [this.head, ...this.#units(flags, layers, leading).map(([at]) => this.#held.get(at))];
    const out = new Uint8Array(pieces.reduce((n, piece) => n + piece.length, 0));
    pieces.reduce((at, piece) => (out.set(piece, at), at + piece.length), 0);
    return out;
  }
}

// Flags in several sets of a few tiles each.
function batches(flags) {
  const tiles = [...flags.keys()].filter((j) => flags[j]);
  const set = (_, i) => flags.map((_, j) => Number(tiles.slice(BATCH * i, BATCH * (i + 1)).includes(j)));
  return Array.from({ length: Math.ceil(tiles.length / BATCH) }, set);
}

// Planes [x, y, z, d] of a view with a margin: a point p is inside if x p.x + y p.y + z p.z + d >= 0 for all of them.
function frustum([width, height, fx, fy, cx, cy, ...rest], margin) {
  const [m, near] = [rest.slice(0, 12), rest[12]];
  const [x, y] = [margin * width, margin * height];
  const inside = [[fx, 0, cx + x, 0], [-fx, 0, width + x - cx, 0], [0, fy, cy + y, 0], [0, -fy, height + y - cy, 0], [0, 0, 1, -near]];
  const world = ([a, b, c, d], j) => a * m[j] + b * m[4 + j] + c * m[8 + j] + (j === 3 ? d : 0);
  return inside.map((plane) => [0, 1, 2, 3].map((j) => world(plane, j)));
}

// Whether the box of a tile is not wholly outside of a plane; null is infinite.
function touches(tile, plane) {
  let sum = plane[3];
  for (let i = 0; i < 3; i++) {
    if (plane[i]) sum += plane[i] * (tile[BOX + i + (plane[i] > 0 ? 3 : 0)] ?? Math.sign(plane[i]) * Infinity);
  }
  return sum >= 0;
}
