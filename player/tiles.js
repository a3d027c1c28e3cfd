// Assigns the tiles of a group to workers, and joins the Gaussians of all in the order of the group. `index`: of the
// units of a group, see text.rs.

const [COUNT] = [0]; // indices in the description of a tile
const EACH = 4; // tiles of a worker at least: all decode the leading tiles, from which the others start

// A group whose payload is here as a whole. reference: {key, payload}, null if it is independent
export class Whole {
  constructor(native, payload, reference) {
    this.index = native.index(payload, reference?.payload);
    const before = reference && native.index(reference.payload);
    Object.assign(this, { payload, reference, before });
  }

  orders(_flags, _layers, k, n) {
    const { payload, reference, before } = this;
    if (n === 1) return [{ payload, reference, wanted: null }];
    const own = reference && { ...reference, key: `${reference.key}, ${k} of ${n}`, wanted: share(before, k, n) };
    return [{ payload, reference: own, wanted: share(this.index, k, n) }];
  }
}

// How many workers, at most `most`, share the first `layers` layers.
export function sharing(index, layers, most) {
  const tiles = index.tiles.slice(0, layers).flat().filter((tile) => tile[COUNT] > 0);
  return Math.max(1, Math.min(most, Math.floor(tiles.length / EACH)));
}

// The tiles of worker k of n, one flag each: of a predicted group those whose reference the same worker has.
export function share(index, k, n) {
  return Uint8Array.from(index.tiles.flatMap((tiles, layer) => tiles.map((_, t) => ((layer + t) % n === k ? 1 : 0))));
}

// The Gaussians of a group shared by n workers, in runs: [worker, count].
export function order(index, layers, n) {
  return index.tiles.slice(0, layers).flatMap((tiles, layer) => tiles.map((tile, t) => [(layer + t) % n, tile[COUNT]]));
}

// One answer {values} or {buffer} from those of all workers of a group: as if one worker had all of its Gaussians.
export function joined(answers, order) {
  const [first] = answers;
  if (answers.length === 1) return first;
  if (!first.values) return { ...first, buffer: inOrder(answers.map(({ buffer }) => new Uint32Array(buffer)), order).buffer };
  return { ...first, values: first.values.map((_, i) => inOrder(answers.map(({ values }) => values[i]), order)) };
}

function inOrder(parts, order) {
  const [sizes, counts] = [parts.map((p) => p.length), order.map(([, count]) => count)].map((a) => a.reduce((n, v) => n + v, 0));
  const each = counts ? sizes / counts : 0; // values of a Gaussian
  const out = new parts[0].constructor(sizes);
  const read = parts.map(() => 0);
  let at = 0;
  for (const [worker, count] of order) {
    const from = read[worker];
    out.set(parts[worker].subarray(from, (read[worker] += count * each)), at);
    at += count * each;
  }
  return out;
}
