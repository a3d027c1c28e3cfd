//! The splits of one octree node: how many of its points lie in the lower half along x, then y, then z, each in the
//! context of the adjacent points in its face neighbours (spec 8).

use super::octree::Node;
use crate::blocks::Blocks;
use crate::model::{Counter, Mixer, WEIGHTS_NEW, Weights};
use crate::range_coder::Bins;

const BUCKETS: usize = 16; // of the number of points to split
const TREE: usize = 32; // adaptive bins of one split; later ones are bypass bins
const EVIDENCE: usize = 144; // contexts made of the face neighbours

/// Points per child (bit 2: half along x, bit 1: y, bit 0: z), clamped to 255 for the contexts: byte k is child k.
pub type Seen = u64;

/// `count` points of child `k`.
pub fn seen(k: usize, count: u32) -> Seen {
    u64::from(count.min(255)) << (8 * k)
}

const PLACES: usize = 3 * 7 * 8; // contexts made of axis, occupied face neighbours and depth

/// Adaptive state of one bin of a split.
#[derive(Clone)]
struct SplitBin {
    a: [Counter; EVIDENCE],
    b: [Counter; PLACES],
    weights: Weights,
}

/// Adaptive model of splits.
#[derive(Clone)]
pub struct SplitModel {
    bins: Blocks<SplitBin>,
    mixer: Mixer,
}

const NEW: SplitBin = SplitBin {
    a: [Counter::NEW; EVIDENCE],
    b: [Counter::NEW; PLACES],
    weights: WEIGHTS_NEW,
};

impl Default for SplitModel {
    fn default() -> Self {
        SplitModel {
            bins: Blocks::new(BUCKETS * TREE, &NEW),
            mixer: Mixer::new(),
        }
    }
}

impl SplitModel {
    /// See `Counter::settle`.
    pub fn settle(&mut self) {
        self.bins
            .settle(|bin| bin.a.iter_mut().chain(&mut bin.b).for_each(Counter::settle));
    }
}

pub struct SplitCoder<'a, C> {
    pub c: &'a mut C,
    pub model: &'a mut SplitModel,
}

/// The inputs of the contexts of the seven splits of a node.
pub struct Split {
    want: [u32; 8],   // encoder: points per child
    lower: [Seen; 3], // children of the face neighbours on the lower side
    upper: [u32; 3],  // points of the face neighbours on the upper side
    own: Seen,        // children of this node, as far as known
    count: u32,
    occupied: usize,
    depth: usize,
}

impl Split {
    pub fn new(node: &Node, level: &[Node], known: &[Seen], points: &[u64], rest: u32) -> Split {
        let mut want = [0; 8];
        let mine = points
            .get(node.start as usize..)
            .and_then(|p| p.get(..node.count as usize));
        for p in mine.unwrap_or(&[]) {
            want[(p >> (3 * (rest - 1)) & 7) as usize] += 1;
        }
        Split {
            want,
            lower: node.lower.map(|q| known.get(q as usize).copied().unwrap_or(0)),
            upper: node.upper.map(|q| level.get(q as usize).map_or(0, |n| n.count)),
            own: 0,
            count: node.count,
            occupied: node.occupied(),
            depth: (rest as usize - 1).min(7),
        }
    }

    /// Codes the number of points per child: splits along x, then y, then z.
    #[cfg_attr(target_arch = "wasm32", inline(never))] // see ../channels.rs
    pub fn children<C: Bins>(mut self, coder: &mut SplitCoder<C>) -> [u32; 8] {
        let mut counts = [0; 8];
        let [lx, ly, lz] = self.lower;
        let c = context(halves(ly, 4, 0), halves(lz, 4, 0), sum(lx, 4, 4), self.upper[0]);
        let low = self.split(coder, 4, 0, self.count, c, 0);
        for (x, n) in [(0, low), (4, self.count - low)].into_iter().filter(|(_, n)| *n > 0) {
            let sx = if x == 0 {
                halves(lx, 2, 4)
            } else {
                halves(self.own, 2, 0)
            };
            let c = context(sx, halves(lz, 2, x), sum(ly, 6, x | 2), self.upper[1]);
            let low = self.split(coder, 6, x, n, c, 1);
            for (y, n) in [(0, low), (2, n - low)].into_iter().filter(|(_, n)| *n > 0) {
                let k = x | y;
                let sx = if x == 0 {
                    halves(lx, 1, 4 | y)
                } else {
                    halves(self.own, 1, y)
                };
                let sy = if y == 0 {
                    halves(ly, 1, k | 2)
                } else {
                    halves(self.own, 1, x)
                };
                let c = context(sx, sy, sum(lz, 7, k | 1), self.upper[2]);
                let low = self.split(coder, 7, k, n, c, 2);
                (counts[k], counts[k | 1]) = (low, n - low);
                self.own |= seen(k, low) | seen(k | 1, n - low);
            }
        }
        counts
    }

    /// Codes the child of a single point, the case of most nodes. Equal to `children`, but without unpredictable
    /// branches.
    #[cfg_attr(target_arch = "wasm32", inline(never))] // see ../channels.rs
    pub fn child<C: Bins>(self, coder: &mut SplitCoder<C>) -> usize {
        let [lx, ly, lz] = self.lower;
        let c = context(halves(ly, 4, 0), halves(lz, 4, 0), sum(lx, 4, 4), self.upper[0]);
        let x = 4 * self.upper_half(coder, 4, 0, c, 0);
        let sx = halves(lx, 2, 4) * usize::from(x == 0);
        let c = context(sx, halves(lz, 2, x), sum(ly, 6, x | 2), self.upper[1]);
        let y = 2 * self.upper_half(coder, 6, x, c, 1);
        let k = x | y;
        let sx = halves(lx, 1, 4 | y) * usize::from(x == 0);
        let sy = halves(ly, 1, k | 2) * usize::from(y == 0);
        let c = context(sx, sy, sum(lz, 7, k | 1), self.upper[2]);
        k | self.upper_half(coder, 7, k, c, 2)
    }

    /// Codes in which half the only point is: 0 or 1.
    #[inline(always)]
    fn upper_half<C: Bins>(&self, coder: &mut SplitCoder<C>, mask: usize, half: usize, c: usize, axis: usize) -> usize {
        1 - self.split(coder, mask, half, 1, c, axis) as usize
    }

    /// Codes how many of `n` points lie in the lower half: in the children k with k & mask = half.
    #[inline(always)]
    fn split<C: Bins>(
        &self,
        coder: &mut SplitCoder<C>,
        mask: usize,
        half: usize,
        n: u32,
        c: usize,
        axis: usize,
    ) -> u32 {
        let want = if C::DECODES {
            0
        } else {
            (0..8).filter(|k| k & mask == half).map(|k| self.want[k]).sum()
        };
        let bucket = if n <= 8 {
            n as usize - 1
        } else {
            (4 + 32 - n.leading_zeros() as usize).min(BUCKETS - 1)
        };
        let (mut lo, mut hi, mut tree) = (0, n, 1);
        while lo < hi {
            let mid = (lo + hi) >> 1;
            let high = if tree < TREE {
                let SplitBin { a, b, weights } = coder.model.bins.get(bucket * TREE + tree);
                let place = (axis * 7 + self.occupied) * 8 + self.depth;
                let mixer = coder.model.mixer;
                mixer.bin(coder.c, want > mid, &mut a[c], &mut b[place], weights)
            } else {
                coder.c.bits(u64::from(want > mid), 1) != 0
            };
            tree = (tree * 2 + usize::from(high)).min(TREE * 2 - 1);
            (lo, hi) = if high { (mid + 1, hi) } else { (lo, mid) };
        }
        lo
    }
}

/// Mask of the bytes of the children k with k & mask = half, at index mask * 8 + half.
const CHILDREN: [u64; 64] = {
    let mut table = [0; 64];
    let mut at = 0;
    while at < 64 {
        let (mask, half, mut k) = (at / 8, at % 8, 0);
        while k < 8 {
            if k & mask == half {
                table[at] |= 0xFF << (8 * k);
            }
            k += 1;
        }
        at += 1;
    }
    table
};

/// Points of the children whose bits under `mask` are `half`.
#[inline]
fn sum(seen: Seen, mask: usize, half: usize) -> u32 {
    const EVEN: u64 = 0x00FF_00FF_00FF_00FF;
    let own = seen & CHILDREN[(mask * 8 + half) & 63];
    let pairs = (own & EVEN) + (own >> 8 & EVEN);
    (pairs.wrapping_mul(0x0001_0001_0001_0001) >> 48) as u32
}

/// Compares the halves of a neighbour along the axis `bit`, within the part given by the bits above `bit`. 0: no
/// points, 1: more on the low side, 2: more on the high side, 3: equal.
#[inline]
fn halves(seen: Seen, bit: usize, part: usize) -> usize {
    let mask = [7, 7, 6, 6, 4][bit]; // the axis and those split before it
    let (low, high) = (sum(seen, mask, part), sum(seen, mask, part | bit));
    usize::from(low + high > 0) * (usize::from(low >= high) + 2 * usize::from(low <= high))
}

#[inline]
fn context(s: usize, t: usize, low: u32, up: u32) -> usize {
    ((low.min(2) * 3 + up.min(2)) as usize * 4 + s) * 4 + t
}
