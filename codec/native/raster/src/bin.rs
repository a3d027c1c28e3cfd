//! Depth-sorted Gaussians -> for each 16 x 16 tile the list of those whose ellipse (alpha >= ALPHA_MIN) meets it, in depth order.
//!
//! A counting sort. Fixed chunks of the sorted order list and count their tiles in parallel, a prefix sum gives each
//! (tile, chunk) its place, and the chunks fill in parallel; the places do not depend on the threads. In the chunk's list the
//! places then replace the tiles: from them the backward pass gathers the gradients of a Gaussian in a fixed order.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rayon::prelude::*;

use crate::constants::LOG2_ALPHA_MIN;
use crate::project::{Projected, SLACK, TILE};
use crate::scene::{MAX_PAIRS, RasterError, Region};
use crate::simd::prefetch;

/// Chunks of the sorted order; bounds the parallelism of binning.
const CHUNKS: usize = 16;
/// An entry of `owned` is chunk << OFFSET_BITS | offset in the chunk's list.
const OFFSET_BITS: u32 = 28;
const HIDDEN: u32 = u32::MAX;
/// Items between a prefetch and its use.
const AHEAD: usize = 12;

#[derive(Default)]
pub struct Bins {
    pub columns: usize,
    pub rows: usize,
    /// [tiles + 1] first pair of each tile
    pub starts: Vec<u32>,
    /// Gaussian of each pair
    pub pairs: Vec<AtomicU32>,
    /// [N] where a Gaussian's entry in the lists begins; HIDDEN for the invisible
    owned: Vec<AtomicU32>,
    /// of each chunk: for each Gaussian the number of its pairs, then their positions in `pairs`
    lists: Vec<Vec<u32>>,
    cursors: Vec<u32>, // [CHUNKS, tiles]
}

/// log2(alpha / ALPHA_MIN) at the centre, with the slack: the squared radius in units of u, v.
#[inline(always)]
pub fn reach(log2_opacity: f32) -> f32 {
    (log2_opacity - LOG2_ALPHA_MIN) * (1.0 + SLACK) + SLACK
}

/// Calls `visit(tile)` for the tiles that the ellipse of `p` meets at pixel centres.
#[inline(always)]
fn for_tiles(p: &Projected, columns: usize, mut visit: impl FnMut(usize)) {
    let [x0, x1, y0, y1] = p.tiles.map(usize::from);
    if x0 >= x1 || y0 >= y1 {
        for row in y0..=y1.max(y0) {
            for column in x0..=x1.max(x0) {
                visit(row * columns + column);
            }
        }
        return;
    }
    let q = reach(p.log2_opacity);
    let inv = 1.0 / p.l11;
    // y where the ellipse is widest to the right
    let peak = -p.l21 * p.l11 * p.rx / (p.l21 * p.l21 + p.l22 * p.l22);
    let tile = |v: f32| v.max(0.0) as usize / TILE;
    for row in y0..=y1 {
        let top = (row * TILE) as f32 + 0.5 - p.y;
        let bottom = top + (TILE - 1) as f32;
        let (yr, yl) = (peak.max(top).min(bottom), (-peak).max(top).min(bottom));
        let (hr, hl) = (q - p.l22 * yr * p.l22 * yr, q - p.l22 * yl * p.l22 * yl);
        if hr >= 0.0 && hl >= 0.0 {
            let right = (hr.sqrt() - p.l21 * yr) * inv + SLACK;
            let left = (-hl.sqrt() - p.l21 * yl) * inv - SLACK;
            let (first, last) = (tile(p.x + left + 0.5), tile(p.x + right - 0.5));
            for column in first.max(x0)..=last.min(x1) {
                visit(row * columns + column);
            }
        }
    }
}

impl Bins {
    pub fn tiles(&self) -> usize {
        self.columns * self.rows
    }

    pub fn tile(&self, t: usize) -> std::ops::Range<usize> {
        self.starts[t] as usize..self.starts[t + 1] as usize
    }

    /// The list entry of a visible Gaussian and what follows it.
    #[inline(always)]
    fn entry(&self, gaussian: usize) -> Option<&[u32]> {
        let entry = self.owned.get(gaussian)?.load(Relaxed);
        let list = self.lists.get((entry >> OFFSET_BITS) as usize)?;
        list.get((entry & ((1 << OFFSET_BITS) - 1)) as usize..)
    }

    /// Fetches what `places` will read.
    #[inline(always)]
    pub fn prefetch_places(&self, gaussian: usize) {
        if let Some(list) = self.entry(gaussian) {
            prefetch(list, 0);
        }
    }

    /// Positions in `pairs` of a Gaussian; none if it is invisible.
    #[inline(always)]
    pub fn places(&self, gaussian: usize) -> &[u32] {
        match self.entry(gaussian) {
            Some([n, rest @ ..]) => &rest[..*n as usize],
            _ => &[],
        }
    }

    /// # Errors
    /// More than MAX_PAIRS pairs.
    pub fn build(&mut self, projected: &[Projected], sorted: &[u64], region: Region) -> Result<(), RasterError> {
        (self.columns, self.rows) = (region.width.div_ceil(TILE), region.height.div_ceil(TILE));
        let (columns, tiles) = (self.columns, self.tiles());
        self.cursors.clear();
        self.cursors.resize(CHUNKS * tiles, 0);
        self.lists.resize_with(CHUNKS, Vec::new);
        self.owned.clear();
        self.owned.resize_with(projected.len(), || AtomicU32::new(HIDDEN));
        let share = sorted.len().div_ceil(CHUNKS).max(1);
        let owned = &self.owned;
        self.lists.iter_mut().for_each(Vec::clear);
        let work = self
            .cursors
            .par_chunks_mut(tiles)
            .zip(&mut self.lists)
            .zip(sorted.par_chunks(share))
            .enumerate();
        work.for_each(|(chunk, ((count, list), keys))| {
            for (i, &key) in keys.iter().enumerate() {
                if let Some(&next) = keys.get(i + AHEAD) {
                    prefetch(projected, next as u32 as usize);
                }
                let (g, head) = (key as u32 as usize, list.len());
                owned[g].store((chunk as u32) << OFFSET_BITS | head as u32, Relaxed);
                list.push(0);
                for_tiles(&projected[g], columns, |t| {
                    count[t] += 1;
                    list.push(t as u32);
                });
                list[head] = (list.len() - head - 1) as u32;
                if list.len() > MAX_PAIRS / CHUNKS {
                    return; // the prefix sum reports it
                }
            }
        });
        self.prefix(tiles)?;
        self.fill(tiles, sorted, share);
        Ok(())
    }

    /// Turns the counts into first places and sets `starts` and the size of `pairs`.
    fn prefix(&mut self, tiles: usize) -> Result<(), RasterError> {
        let full = |list: &Vec<u32>| list.len() > MAX_PAIRS / CHUNKS;
        if self.lists.iter().any(full) {
            return Err(RasterError::TooMany {
                what: "Gaussian-tile pairs",
                limit: MAX_PAIRS,
            });
        }
        self.starts.clear();
        let mut sum = 0;
        for t in 0..tiles {
            self.starts.push(sum);
            for chunk in 0..CHUNKS {
                sum += std::mem::replace(&mut self.cursors[chunk * tiles + t], sum);
            }
        }
        self.starts.push(sum);
        self.pairs.resize_with(sum as usize, AtomicU32::default);
        Ok(())
    }

    /// Writes the pairs; the tiles in the lists become places.
    fn fill(&mut self, tiles: usize, sorted: &[u64], share: usize) {
        let pairs = &self.pairs;
        let work = self
            .cursors
            .par_chunks_mut(tiles)
            .zip(&mut self.lists)
            .zip(sorted.par_chunks(share));
        work.for_each(|((cursor, list), keys)| {
            let mut rest = &mut list[..];
            for &key in keys {
                let Some((n, own)) = rest.split_first_mut() else { return };
                let (own, after) = own.split_at_mut(*n as usize);
                for tile in own {
                    let place = &mut cursor[*tile as usize];
                    pairs[*place as usize].store(key as u32, Relaxed);
                    *tile = *place;
                    *place += 1;
                }
                rest = after;
            }
        });
    }
}
