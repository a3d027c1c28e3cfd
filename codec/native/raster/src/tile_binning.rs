//! Tile binning: depth-sorted Gaussians -> for each 16 x 16 tile the Gaussians whose ellipse (alpha >= ALPHA_MIN) meets
//! it, in depth order.
//!
//! A counting sort. Fixed chunks of the sorted order list and count their tiles in parallel, a prefix sum gives each
//! (tile, chunk) its first place, and the chunks write their pairs in parallel; the places do not depend on the
//! threads. The chunk's list then keeps the places instead of the tiles: the backward pass gathers the gradients of a
//! Gaussian from them in a fixed order.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use crate::error::RasterError;
use crate::projected::{MANY, Projected};
use crate::simd::prefetch;
use crate::tile::BATCH;
use crate::tile_rect::{TileRect, for_tiles};

/// Chunks of the sorted order, which bound the parallelism of binning. Each chunk has a counter per tile, so few
/// Gaussians are fewer chunks, down to the minimum.
const CHUNKS: usize = 16;
const CHUNKS_MIN: usize = 4;
const CHUNK_SIZE: usize = 4096;
/// Entry of a Gaussian whose ellipse meets no tile.
const NOWHERE: u32 = u32::MAX;
/// Most entries that `append` adds for a Gaussian whose tiles are known (2 x 2).
const FEW: usize = 4;
/// An entry of `owned` is chunk << OFFSET_BITS | offset in the chunk's list.
const OFFSET_BITS: u32 = 28;
const HIDDEN: u32 = u32::MAX;
/// Prefetch distance in items.
const AHEAD: usize = 12;

#[derive(Default)]
pub struct TileBins {
    pub tiles: TileRect,
    /// [tiles + 1] first pair of each tile
    pub starts: Vec<u32>,
    /// Gaussian of each pair
    pub pairs: Vec<AtomicU32>,
    /// [N] where the entries of a Gaussian begin; HIDDEN if it is invisible
    owned: Vec<AtomicU32>,
    /// of each chunk: for each Gaussian the places of its pairs in `pairs`, << 1, with 1 added to the last one; NOWHERE
    /// if it has none
    lists: Vec<Vec<u32>>,
    cursors: Vec<u32>, // [chunks, tiles]
}

/// Makes room for `more` entries from `used` on, and a quarter of `used` besides; doubling would cost noticeable
/// memory.
#[inline(always)]
fn grow(list: &mut Vec<u32>, used: usize, more: usize) {
    if list.len() < used + more {
        list.reserve_exact(used + more + used / 4 - list.len());
        list.resize(list.capacity(), 0);
    }
}

/// Writes the entries of a Gaussian, tile << 1 | last, to the list from `used` on, and counts them per tile. Returns
/// the new end. At most FEW entries are written without branches, since the met tiles are unpredictable.
#[inline(always)]
fn append(p: &Projected, tiles: &TileRect, count: &mut [u32], list: &mut Vec<u32>, used: usize) -> usize {
    let [x0, x1, y0, y1] = p.tiles.map(usize::from);
    let inside = x0 >= tiles.columns.start && x1 < tiles.columns.end && y0 >= tiles.rows.start && y1 < tiles.rows.end;
    let mut end = used;
    if p.met != MANY && inside {
        let width = tiles.columns.len();
        let first = (y0 - tiles.rows.start) * width + x0 - tiles.columns.start;
        for (i, tile) in [first, first + 1, first + width, first + width + 1]
            .into_iter()
            .enumerate()
        {
            let met = usize::from(p.met >> i & 1);
            list[end] = (tile as u32) << 1;
            count[tile * met] += met as u32;
            end += met;
        }
    } else {
        grow(list, used, (x1 + 1 - x0.min(x1)) * (y1 + 1 - y0.min(y1)) + 1);
        for_tiles(p, tiles, |tile| {
            count[tile] += 1;
            list[end] = (tile as u32) << 1;
            end += 1;
        });
    }
    if end == used {
        list[used] = NOWHERE;
        return used + 1;
    }
    list[end - 1] |= 1;
    end
}

/// Index of the Gaussian of a key of `DepthSort`.
#[inline(always)]
fn index(key: &AtomicU64) -> usize {
    key.load(Relaxed) as u32 as usize
}

impl TileBins {
    /// Bytes of the buffers.
    pub fn memory(&self) -> usize {
        let lists = self.lists.iter().map(Vec::capacity).sum::<usize>();
        4 * (self.starts.capacity() + self.pairs.capacity() + self.owned.capacity() + self.cursors.capacity() + lists)
    }

    pub fn tile(&self, t: usize) -> std::ops::Range<usize> {
        self.starts[t] as usize..self.starts[t + 1] as usize
    }

    /// The first pair of tile `t`.
    pub fn first(&self, t: usize) -> usize {
        self.starts[t] as usize
    }

    /// First batch of tile `t`, if every tile has as many batches as its pairs need (a few places stay unused).
    pub fn batches(&self, t: usize) -> usize {
        self.first(t) / BATCH + t
    }

    /// Splits `items` of the rows of tiles from `first` on at row `middle`; `start` gives the place of a tile. Empty
    /// stays empty.
    pub fn cut<'a, T>(
        &self,
        items: &'a mut [T],
        first: usize,
        middle: usize,
        start: fn(&TileBins, usize) -> usize,
    ) -> (&'a mut [T], &'a mut [T]) {
        let columns = self.tiles.columns.len();
        let length = start(self, middle * columns) - start(self, first * columns);
        items.split_at_mut(length.min(items.len()))
    }

    /// Splits the items of tile `t` off those of the tiles from `t` on.
    pub fn cut_tile<'a, T>(
        &self,
        items: &'a mut [T],
        t: usize,
        start: fn(&TileBins, usize) -> usize,
    ) -> (&'a mut [T], &'a mut [T]) {
        let length = start(self, t + 1) - start(self, t);
        items.split_at_mut(length.min(items.len()))
    }

    /// The chunk list from the entries of a Gaussian on; empty if it is invisible.
    #[inline(always)]
    fn entries(&self, gaussian: usize) -> &[u32] {
        let Some(owned) = self.owned.get(gaussian) else {
            return &[];
        };
        let owned = owned.load(Relaxed);
        let list = self.lists.get((owned >> OFFSET_BITS) as usize);
        list.and_then(|list| list.get((owned & ((1 << OFFSET_BITS) - 1)) as usize..))
            .unwrap_or(&[])
    }

    /// Prefetches the entries that `places` reads.
    #[inline(always)]
    pub fn prefetch_places(&self, gaussian: usize) {
        prefetch(self.entries(gaussian), 0);
    }

    /// Calls `visit` with each place in `pairs` of a Gaussian; never if it is invisible.
    #[inline(always)]
    pub fn places(&self, gaussian: usize, mut visit: impl FnMut(usize)) {
        for &entry in self.entries(gaussian) {
            if entry == NOWHERE {
                return;
            }
            visit(entry as usize >> 1);
            if entry & 1 == 1 {
                return;
            }
        }
    }

    /// # Errors
    /// More than `limit` pairs in all, visible Gaussians included, or more than its share in one chunk.
    pub fn build(
        &mut self,
        projected: &[Projected],
        sorted: &[AtomicU64],
        rectangle: TileRect,
        limit: usize,
    ) -> Result<(), RasterError> {
        let tiles = rectangle.len();
        self.tiles = rectangle;
        let rectangle = &self.tiles;
        let chunks = (sorted.len() / CHUNK_SIZE).clamp(CHUNKS_MIN, CHUNKS);
        self.cursors.clear();
        self.cursors.resize(chunks * tiles, 0);
        self.lists.resize_with(chunks, Vec::new);
        self.owned.clear();
        self.owned.resize_with(projected.len(), || AtomicU32::new(HIDDEN));
        let share = sorted.len().div_ceil(chunks).max(1);
        let owned = &self.owned;
        let filled = sorted.len().div_ceil(share);
        self.lists.iter_mut().skip(filled).for_each(Vec::clear);
        let work = self
            .cursors
            .par_chunks_mut(tiles)
            .zip(&mut self.lists)
            .zip(sorted.par_chunks(share))
            .enumerate();
        work.for_each(|(chunk, ((count, list), keys))| {
            let mut used = 0;
            for (i, key) in keys.iter().enumerate() {
                grow(list, used, FEW);
                if let Some(next) = keys.get(i + AHEAD) {
                    prefetch(projected, index(next));
                }
                let g = index(key);
                owned[g].store((chunk as u32) << OFFSET_BITS | used as u32, Relaxed);
                used = append(&projected[g], rectangle, count, list, used);
                if used > limit / chunks {
                    break; // reported below
                }
            }
            list.truncate(used);
        });
        if self.lists.iter().any(|list| list.len() > limit / chunks) {
            return Err(RasterError::TooMany {
                what: "Gaussian-tile pairs",
                limit,
            });
        }
        self.prefix(tiles);
        self.fill(tiles, sorted, share);
        Ok(())
    }

    /// Prefix sum: counts -> first places; sets `starts` and the size of `pairs`.
    fn prefix(&mut self, tiles: usize) {
        self.starts.clear();
        let mut sum = 0;
        for t in 0..tiles {
            self.starts.push(sum);
            for chunk in 0..self.lists.len() {
                sum += std::mem::replace(&mut self.cursors[chunk * tiles + t], sum);
            }
        }
        self.starts.push(sum);
        self.pairs.resize_with(sum as usize, AtomicU32::default);
    }

    /// Writes the pairs, and replaces the tiles in the lists by places.
    fn fill(&mut self, tiles: usize, sorted: &[AtomicU64], share: usize) {
        let pairs = &self.pairs;
        let work = self
            .cursors
            .par_chunks_mut(tiles)
            .zip(&mut self.lists)
            .zip(sorted.par_chunks(share));
        work.for_each(|((cursor, list), keys)| {
            let mut at = 0;
            for entry in list.iter_mut() {
                if *entry != NOWHERE {
                    let place = &mut cursor[*entry as usize >> 1];
                    pairs[*place as usize].store(index(&keys[at]) as u32, Relaxed);
                    *entry = *place << 1 | (*entry & 1);
                    *place += 1;
                }
                at += *entry as usize & 1;
            }
        });
    }
}
