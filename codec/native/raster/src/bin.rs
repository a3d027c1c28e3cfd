//! Depth-sorted Gaussians -> for each 16 x 16 tile the list of those whose ellipse (alpha >= ALPHA_MIN) meets it, in depth order.
//!
//! A counting sort: fixed chunks of the sorted order count their tiles in parallel, a prefix sum gives each (tile, chunk) its
//! place, and the chunks fill in parallel. The places do not depend on the threads. For the backward pass each Gaussian
//! also learns the places of its pairs, so that gradients are gathered in a fixed order instead of added atomically.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rayon::prelude::*;

use crate::constants::LOG2_ALPHA_MIN;
use crate::project::Projected;
use crate::scene::{MAX_PAIRS, RasterError, Region};

pub const TILE: usize = 16;
/// Chunks of the sorted order; bounds the parallelism of binning.
const CHUNKS: usize = 16;
/// Widens the ellipse a little, so that rounding never loses a pixel that the blending would have drawn.
const SLACK: f32 = 1e-3;

#[derive(Default)]
pub struct Bins {
    pub columns: usize,
    pub rows: usize,
    /// [tiles + 1] first pair of each tile
    pub starts: Vec<u32>,
    /// Gaussian of each pair
    pub pairs: Vec<AtomicU32>,
    /// [N + 1] first of a Gaussian's entries in `places`
    pub owned: Vec<u32>,
    /// pairs of each Gaussian, as positions in `pairs`
    pub places: Vec<AtomicU32>,
    cursors: Vec<u32>, // [CHUNKS, tiles]
}

/// log2(alpha / ALPHA_MIN) at the centre, with the slack: the squared radius in units of u, v.
#[inline(always)]
pub fn reach(log2_opacity: f32) -> f32 {
    (log2_opacity - LOG2_ALPHA_MIN) * (1.0 + SLACK) + SLACK
}

/// Calls `visit(tile)` for the tiles that the ellipse of `p` meets at pixel centres.
#[inline(always)]
fn for_tiles(p: &Projected, columns: usize, rows: usize, mut visit: impl FnMut(usize)) {
    let tile = |v: f32, n: usize| ((v.max(0.0) as usize) / TILE).min(n - 1);
    let (rx, ry) = (p.rx + SLACK, p.ry + SLACK);
    let (x0, x1) = (tile(p.x - rx + 0.5, columns), tile(p.x + rx - 0.5, columns));
    let (y0, y1) = (tile(p.y - ry + 0.5, rows), tile(p.y + ry - 0.5, rows));
    if x0 >= x1 || y0 >= y1 {
        for row in y0..=y1.max(y0) {
            for column in x0..=x1.max(x0) {
                visit(row * columns + column);
            }
        }
        return;
    }
    let q = reach(p.log2_opacity);
    // y where the ellipse is widest to the right
    let peak = -p.l21 * p.l11 * rx / (p.l21 * p.l21 + p.l22 * p.l22);
    for row in y0..=y1 {
        let top = (row * TILE) as f32 + 0.5 - p.y;
        let bottom = top + (TILE - 1) as f32;
        let (right, left) = (
            end(p, q, peak.max(top).min(bottom), 1.0),
            end(p, q, (-peak).max(top).min(bottom), -1.0),
        );
        if left <= right {
            let (first, last) = (tile(p.x + left + 0.5, columns), tile(p.x + right - 0.5, columns));
            for column in first.max(x0)..=last.min(x1) {
                visit(row * columns + column);
            }
        }
    }
}

/// Right (sign 1) or left end of the ellipse u^2 + v^2 <= q on the line y, relative to the centre; empty: the other side.
#[inline(always)]
fn end(p: &Projected, q: f32, y: f32, sign: f32) -> f32 {
    let v = p.l22 * y;
    let h = q - v * v;
    if h < 0.0 {
        -sign * f32::INFINITY
    } else {
        (sign * h.sqrt() - p.l21 * y) / p.l11 + sign * SLACK
    }
}

impl Bins {
    pub fn tiles(&self) -> usize {
        self.columns * self.rows
    }

    pub fn tile(&self, t: usize) -> std::ops::Range<usize> {
        self.starts[t] as usize..self.starts[t + 1] as usize
    }

    /// # Errors
    /// More than MAX_PAIRS pairs.
    pub fn build(
        &mut self,
        projected: &[Projected],
        sorted: &[u64],
        region: Region,
        training: bool,
    ) -> Result<(), RasterError> {
        (self.columns, self.rows) = (region.width.div_ceil(TILE), region.height.div_ceil(TILE));
        let (columns, rows, tiles) = (self.columns, self.rows, self.tiles());
        self.cursors.clear();
        self.cursors.resize(CHUNKS * tiles, 0);
        let share = sorted.len().div_ceil(CHUNKS).max(1);
        self.cursors
            .par_chunks_mut(tiles)
            .zip(sorted.par_chunks(share))
            .for_each(|(count, chunk)| {
                for key in chunk {
                    for_tiles(&projected[*key as u32 as usize], columns, rows, |t| count[t] += 1);
                }
            });
        let total = self.prefix(tiles)?;
        self.pairs.resize_with(total, AtomicU32::default);
        if training {
            self.count_owned(projected, total);
        }
        let (pairs, owned, places) = (&self.pairs, &self.owned, &self.places);
        self.cursors
            .par_chunks_mut(tiles)
            .zip(sorted.par_chunks(share))
            .for_each(|(cursor, chunk)| {
                for key in chunk {
                    let g = *key as u32;
                    let mut own = if training { owned[g as usize] as usize } else { 0 };
                    for_tiles(&projected[g as usize], columns, rows, |t| {
                        pairs[cursor[t] as usize].store(g, Relaxed);
                        if training {
                            places[own].store(cursor[t], Relaxed);
                            own += 1;
                        }
                        cursor[t] += 1;
                    });
                }
            });
        Ok(())
    }

    /// Turns the counts into first places and sets `starts`.
    fn prefix(&mut self, tiles: usize) -> Result<usize, RasterError> {
        self.starts.clear();
        let mut sum = 0usize;
        for t in 0..tiles {
            self.starts.push(sum as u32);
            for chunk in 0..CHUNKS {
                let n = std::mem::replace(&mut self.cursors[chunk * tiles + t], sum as u32);
                sum += n as usize;
            }
            if sum > MAX_PAIRS {
                return Err(RasterError::TooMany {
                    what: "Gaussian-tile pairs",
                    limit: MAX_PAIRS,
                });
            }
        }
        self.starts.push(sum as u32);
        Ok(sum)
    }

    fn count_owned(&mut self, projected: &[Projected], total: usize) {
        let (columns, rows) = (self.columns, self.rows);
        self.owned.resize(projected.len() + 1, 0);
        self.owned[1..]
            .par_chunks_mut(1024)
            .zip(projected.par_chunks(1024))
            .for_each(|(n, p)| {
                for (n, p) in n.iter_mut().zip(p) {
                    *n = 0;
                    if p.visible() {
                        for_tiles(p, columns, rows, |_| *n += 1);
                    }
                }
            });
        let mut sum = 0;
        for n in &mut self.owned {
            sum += *n;
            *n = sum;
        }
        self.places.resize_with(total, AtomicU32::default);
    }
}
