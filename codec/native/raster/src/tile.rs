//! Layout and batches that the forward and backward tile kernels share.
//!
//! A tile is 16 blocks of 4 x 4 pixels, stored block by block, so that a small ellipse touches few vectors. Gaussians
//! are processed in batches of 64; for each batch a mask tells which Gaussians meet which block.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use crate::ellipse::{Ellipse, reach};
use crate::projected::{Projected, TILE};
use crate::simd::{Vector, c, prefetch};

pub const BLOCKS: usize = 16;
pub const BLOCK: usize = 16;
/// Gaussians of one batch, the bits of a mask.
pub const BATCH: usize = 64;
/// Pairs between a prefetch and its use.
const AHEAD: usize = 16;

/// Which Gaussians of a batch meet each block: bit i of entry b is Gaussian i on block b.
pub type Hits = [u64; BLOCKS];

/// One value per pixel, [block][pixel of the block].
#[derive(Clone, Copy)]
#[repr(align(64))]
pub struct Plane(pub [[f32; BLOCK]; BLOCKS]);

impl Plane {
    pub const ZERO: Plane = Plane([[0.0; BLOCK]; BLOCKS]);
}

/// Pixel centres in pixels from the corner of the tile.
pub static PIXEL_X: Plane = pixel_centres(true);
pub static PIXEL_Y: Plane = pixel_centres(false);

const fn pixel_centres(x: bool) -> Plane {
    let mut p = [[0.0; BLOCK]; BLOCKS];
    let mut i = 0;
    while i < TILE * TILE {
        let (b, k) = (i / BLOCK, i % BLOCK);
        let v = if x { b % 4 * 4 + k % 4 } else { b / 4 * 4 + k / 4 };
        p[b][k] = v as f32 + 0.5;
        i += 1;
    }
    Plane(p)
}

/// Block, and pixel of the block, of pixel (x, y) of the tile.
#[inline(always)]
pub fn swizzle(x: usize, y: usize) -> (usize, usize) {
    ((y / 4 * 4 + x / 4) & 15, (y % 4 * 4 + x % 4) & 15)
}

/// A Gaussian relative to one tile: u = l11 x + l21 y + u0, v = l22 y + v0 with x, y in pixels from the corner of the
/// tile.
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
pub struct Local {
    pub l11: f32,
    pub l21: f32,
    pub u0: f32,
    pub l22: f32,
    pub v0: f32,
    pub log2_opacity: f32,
    /// Red, green, blue and depth.
    pub channels: [f32; 4],
    x: f32,
    y: f32,
}

impl Local {
    /// A Gaussian that meets no pixel.
    const NOWHERE: Local = Local {
        l11: 0.0,
        l21: 0.0,
        u0: 0.0,
        l22: 0.0,
        v0: 0.0,
        log2_opacity: -100.0,
        channels: [0.0; 4],
        x: 0.0,
        y: 0.0,
    };
}

/// u, v, log2(alpha) and alpha before the clamp of N Gaussians on a vector of pixels each. The N exponentials are
/// independent and interleaved, since a processor does not look far enough ahead to interleave them itself.
#[inline(always)]
pub fn opacities<V: Vector, const N: usize>(s: [&Local; N], x: [V; N], y: [V; N]) -> [[V; N]; 4] {
    let (mut u, mut v, mut e) = (x, y, x);
    for i in 0..N {
        u[i] = x[i].mul_add(c(s[i].l11), y[i].mul_add(c(s[i].l21), c(s[i].u0)));
        v[i] = y[i].mul_add(c(s[i].l22), c(s[i].v0));
    }
    for i in 0..N {
        e[i] = v[i].neg_mul_add(v[i], u[i].neg_mul_add(u[i], c(s[i].log2_opacity)));
    }
    [u, v, e, V::exp2_near(e)]
}

/// Up to 64 Gaussians of the tile, copied to consecutive memory.
pub struct Batch {
    pub splats: [Local; BATCH],
    rows: [[f32; BATCH]; 6], // x y l11 l21 l22 reach
}

impl Batch {
    pub fn new() -> Batch {
        Batch {
            splats: [Local::default(); BATCH],
            rows: [[0.0; BATCH]; 6],
        }
    }

    /// Copies the Gaussians of the first `n` pairs.
    #[inline(always)]
    pub fn fill(&mut self, projected: &[Projected], pairs: &[AtomicU32], n: usize, origin: [f32; 2]) {
        for (i, (s, pair)) in self.splats[..n].iter_mut().zip(pairs).enumerate() {
            if let Some(next) = pairs.get(i + AHEAD) {
                prefetch(projected, next.load(Relaxed) as usize);
            }
            let p = &projected[pair.load(Relaxed) as usize];
            let (x, y) = (p.x - origin[0], p.y - origin[1]);
            *s = Local {
                l11: p.l11,
                l21: p.l21,
                u0: -(p.l11 * x) - p.l21 * y,
                l22: p.l22,
                v0: -(p.l22 * y),
                log2_opacity: p.log2_opacity,
                channels: [p.rgb[0], p.rgb[1], p.rgb[2], p.depth],
                x,
                y,
            };
        }
    }

    /// Removes the next two Gaussians from `hits`; missing ones are replaced by one that meets no pixel.
    #[inline(always)]
    pub fn take(&self, hits: &mut u64) -> [&Local; 2] {
        let mut next = [&Local::NOWHERE; 2];
        for s in &mut next {
            if *hits != 0 {
                *s = &self.splats[hits.trailing_zeros() as usize & (BATCH - 1)];
                *hits &= *hits - 1;
            }
        }
        next
    }

    /// Exact test of each ellipse against the pixel centres of each block.
    #[inline(always)]
    pub fn hits<V: Vector>(&mut self, n: usize) -> Hits {
        for (lane, s) in self.splats[..n].iter().enumerate() {
            let fields = [s.x, s.y, s.l11, s.l21, s.l22, reach(s.log2_opacity)];
            for (row, v) in self.rows.iter_mut().zip(fields) {
                row[lane] = v;
            }
        }
        let mut hits = [0; BLOCKS];
        for at in (0..n).step_by(V::LANES) {
            self.hit_lanes::<V>(at, &mut hits);
        }
        let valid = if n == BATCH { u64::MAX } else { (1 << n) - 1 };
        hits.map(|h| h & valid)
    }

    #[inline(always)]
    fn hit_lanes<V: Vector>(&self, at: usize, hits: &mut Hits) {
        let r = &self.rows;
        let (x, y) = (V::load(&r[0][at..]), V::load(&r[1][at..]));
        let l11 = V::load(&r[2][at..]);
        let ellipse = Ellipse {
            l11,
            l21: V::load(&r[3][at..]),
            l22: V::load(&r[4][at..]),
            reach: V::load(&r[5][at..]),
        };
        let peak = ellipse.peak();
        for row in 0..4 {
            let top = c::<V>(4.0 * row as f32 + 0.5) - y;
            let (met, left, right) = ellipse.span(peak, top, top + c(3.0));
            for column in 0..4 {
                let first = (c::<V>(4.0 * column as f32 + 0.5) - x) * l11;
                let last = (c::<V>(4.0 * column as f32 + 3.5) - x) * l11;
                let hit = met & right.ge(first) & last.ge(left);
                hits[4 * row + column] |= u64::from(V::bits(hit)) << at;
            }
        }
    }
}
