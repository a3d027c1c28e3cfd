//! Context neighbours (spec 7.3): grid points in Morton order -> for each point the nearest among the points just
//! before it.
//!
//! They give the contexts of all units of a layer. The search is brute force over a window: exact, cheap and easy to
//! reproduce.

use rayon::prelude::*;

const WINDOW: usize = 32;
/// Neighbours per index.
pub const NEAR: usize = 4;

/// Up to four indices, nearest first; index i has min(i, 4).
pub type Near = [u32; NEAR];

/// Squared distance in grid units.
#[inline]
pub fn distance(p: [u32; 3], q: [u32; 3]) -> u64 {
    let d = |a: usize| u64::from(p[a].abs_diff(q[a]));
    d(0) * d(0) + d(1) * d(1) + d(2) * d(2)
}

/// For each point the four nearest within the window before it; of equal distances the most recent.
pub fn nearest(points: &[[u32; 3]]) -> Vec<Near> {
    (0..points.len()).map(|i| nearest_before(points, i, 0)).collect()
}

/// As `nearest`, for points in tiles of `cells` points: neighbours are in the same tile.
pub fn nearest_in_tiles(points: &[[u32; 3]], cells: usize) -> Vec<Near> {
    let start = |i: usize| i - i % cells.max(1);
    let all = (0..points.len()).into_par_iter().with_min_len(4096);
    all.map(|i| nearest_before(points, i, start(i))).collect()
}

/// `first`: the first point that may be a neighbour.
fn nearest_before(points: &[[u32; 3]], i: usize, first: usize) -> Near {
    let from = i.saturating_sub(WINDOW).max(first);
    let mut best = [u64::MAX; NEAR]; // distance << 5 | how far back, less one
    for (back, q) in points[from..i].iter().rev().enumerate() {
        let mut key = distance(points[i], *q) << 5 | back as u64;
        if key < best[NEAR - 1] {
            for b in &mut best {
                if key < *b {
                    std::mem::swap(&mut key, b);
                }
            }
        }
    }
    best.map(|k| {
        if k == u64::MAX {
            u32::MAX
        } else {
            (i - 1 - (k & 31) as usize) as u32
        }
    })
}
