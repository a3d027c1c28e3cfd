//! Depth sort of the visible Gaussians, nearest first: a stable least-significant-digit radix sort of (depth, index).
//!
//! The depths of an image span few exponents, so two digits usually suffice: the low bits, and the others relative to
//! those of the smallest depth. Ties keep the order of the indices, so the image depends on its input only. A pass
//! counts (the first one while the keys are made) and moves fixed chunks in parallel; a prefix sum over (digit, chunk)
//! gives each chunk its places.

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use crate::projected::Projected;

const DIGIT: u32 = 11;
const BUCKETS: usize = 1 << DIGIT;
/// Chunks, which bound the parallelism of sorting.
const CHUNKS: usize = 4;

#[derive(Default)]
pub struct DepthSort {
    keys: Vec<AtomicU64>, // depth bits << 32 | index
    swap: Vec<AtomicU64>,
    places: Vec<u32>, // [CHUNKS, BUCKETS]
    visible: usize,
}

impl DepthSort {
    /// Keys of the visible Gaussians of the last `sort`, nearest first; the low half of a key is the index.
    pub fn keys(&self) -> &[AtomicU64] {
        &self.keys[..self.visible]
    }

    /// Bytes of the buffers.
    pub fn memory(&self) -> usize {
        8 * (self.keys.capacity() + self.swap.capacity()) + 4 * self.places.capacity()
    }

    pub fn sort(&mut self, projected: &[Projected]) {
        let share = projected.len().div_ceil(CHUNKS).max(1);
        self.keys.resize_with(projected.len(), AtomicU64::default);
        self.swap.resize_with(projected.len(), AtomicU64::default);
        self.places.resize(CHUNKS * BUCKETS, 0);
        let used = projected.len().div_ceil(share);
        self.places[used * BUCKETS..].fill(0); // small scenes fill fewer chunks than the one before
        // per chunk: the number of visible Gaussians, the smallest and the largest depth
        let mut found = [(0, u32::MAX, 0); CHUNKS];
        let chunks = projected.par_chunks(share).zip(self.keys.par_chunks_mut(share));
        let places = self.places.par_chunks_exact_mut(BUCKETS);
        chunks
            .zip(places.zip(&mut found[..]))
            .enumerate()
            .for_each(|(chunk, ((projected, keys), (places, found)))| {
                let (mut n, mut low, mut high) = *found;
                places.fill(0);
                for (i, p) in projected.iter().enumerate() {
                    if p.visible() {
                        let bits = p.depth.to_bits(); // positive floats sort like their bits
                        low = bits.min(low);
                        high = bits.max(high);
                        places[bits as usize & (BUCKETS - 1)] += 1;
                        keys[n] = AtomicU64::new(u64::from(bits) << 32 | (chunk * share + i) as u64);
                        n += 1;
                    }
                }
                *found = (n, low, high);
            });
        let total = found.iter().map(|f| f.0).sum::<usize>();
        let low = found.iter().fold(u32::MAX, |low, f| low.min(f.1));
        let high = found.iter().fold(0, |high, f| high.max(f.2));
        let rest = (high >> DIGIT).saturating_sub(low >> DIGIT);
        let mut parts = std::array::from_fn(|i| {
            let first = (i * share).min(projected.len());
            first..first + found[i].0
        });
        // also closes the gaps between the chunks
        self.move_all(&parts, |key| (key >> 32) as usize & (BUCKETS - 1));
        let share = total.div_ceil(CHUNKS);
        parts = std::array::from_fn(|i| (i * share).min(total)..((i + 1) * share).min(total));
        for pass in 0..(32 - rest.leading_zeros()).div_ceil(DIGIT) {
            let (base, shift) = (u64::from(low >> DIGIT), pass * DIGIT);
            let digit = |key: u64| (((key >> (32 + DIGIT)) - base) >> shift) as usize & (BUCKETS - 1);
            self.count(&parts, digit);
            self.move_all(&parts, digit);
        }
        self.visible = total;
    }

    /// Counts into `places` how often each digit occurs in each chunk.
    fn count(&mut self, parts: &[Range<usize>; CHUNKS], digit: impl Fn(u64) -> usize + Sync) {
        let keys = &self.keys;
        let places = self.places.par_chunks_exact_mut(BUCKETS).zip(parts);
        places.for_each(|(places, part)| {
            places.fill(0);
            for key in &keys[part.clone()] {
                places[digit(key.load(Relaxed))] += 1;
            }
        });
    }

    /// Moves the keys by a digit whose counts are in `places`.
    fn move_all(&mut self, parts: &[Range<usize>; CHUNKS], digit: impl Fn(u64) -> usize + Sync) {
        let mut sum = 0;
        for bucket in 0..BUCKETS {
            for chunk in 0..CHUNKS {
                sum += std::mem::replace(&mut self.places[chunk * BUCKETS + bucket], sum);
            }
        }
        let (keys, swap) = (&self.keys, &self.swap);
        let places = self.places.par_chunks_exact_mut(BUCKETS).zip(parts);
        places.for_each(|(places, part)| {
            for key in &keys[part.clone()] {
                let key = key.load(Relaxed);
                let place = &mut places[digit(key)];
                swap[*place as usize].store(key, Relaxed);
                *place += 1;
            }
        });
        std::mem::swap(&mut self.keys, &mut self.swap);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sorts_by_depth_then_index_and_drops_the_invisible() {
        let depth = |i: usize| [2.5, 1e-2, 7e20, 2.5, 1.0, 2.500_001][i % 6];
        let mut sort = DepthSort::default();
        for n in [600, 9, 5, 2, 1, 0, 600] {
            let p: Vec<Projected> = (0..n)
                .map(|i| Projected {
                    depth: depth(i),
                    rx: if i % 5 == 0 { -1.0 } else { 1.0 },
                    ..Default::default()
                })
                .collect();
            let mut want: Vec<usize> = (0..n).filter(|i| i % 5 != 0).collect();
            want.sort_by(|&a, &b| depth(a).total_cmp(&depth(b)));
            sort.sort(&p);
            let got: Vec<usize> = sort.keys().iter().map(|k| k.load(Relaxed) as u32 as usize).collect();
            assert_eq!(got, want, "{n} Gaussians");
        }
    }
}
