//! Context neighbours (spec 7.3): grid points in Morton order -> for each point the nearest among the points just before it.
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
    (0..points.len())
        .into_par_iter()
        .with_min_len(4096)
        .map(|i| nearest_before(points, i))
        .collect()
}

/// Neighbours in a layer: of all its Gaussians, and of its births among themselves.
pub struct Contexts {
    pub all: Vec<Near>,
    births: Option<Vec<Near>>,
}

impl Contexts {
    /// `positions` of a layer, of which the first `survivors` are those of the reference.
    pub fn new(positions: &[[u32; 3]], survivors: usize) -> Contexts {
        let births = positions.get(survivors..).unwrap_or(&[]);
        Contexts {
            all: nearest(positions),
            births: (survivors > 0).then(|| nearest(births)),
        }
    }

    pub fn births(&self) -> &[Near] {
        self.births.as_ref().unwrap_or(&self.all)
    }
}

fn nearest_before(points: &[[u32; 3]], i: usize) -> Near {
    let from = i.saturating_sub(WINDOW);
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
