//! Visible Gaussians front to back: a stable least-significant-digit radix sort of (depth, index).
//!
//! Depths of one picture span few exponents, so the keys are taken relative to the smallest and two passes usually do.
//! Ties keep the order of the indices, which makes the picture independent of everything but its input.

use crate::project::Projected;

const DIGIT: u32 = 11;
const BUCKETS: usize = 1 << DIGIT;

#[derive(Default)]
pub struct DepthSort {
    keys: Vec<u64>, // depth bits << 32 | index
    swap: Vec<u64>,
}

impl DepthSort {
    /// Indices of the visible Gaussians, nearest first, as the low halves of the result.
    pub fn sort(&mut self, projected: &[Projected]) -> &[u64] {
        self.keys.clear();
        let (mut low, mut high) = (u32::MAX, 0);
        for (i, p) in projected.iter().enumerate() {
            if p.visible() {
                let bits = p.depth.to_bits(); // positive floats sort like their bits
                low = low.min(bits);
                high = high.max(bits);
                self.keys.push(u64::from(bits) << 32 | i as u64);
            }
        }
        self.swap.resize(self.keys.len(), 0);
        let significant = 32 - high.saturating_sub(low).leading_zeros();
        for pass in 0..significant.div_ceil(DIGIT) {
            self.pass(low, 32 + pass * DIGIT);
        }
        &self.keys
    }

    fn pass(&mut self, low: u32, shift: u32) {
        let base = u64::from(low) << 32;
        let digit = |key: u64| ((key - base) >> shift) as usize & (BUCKETS - 1);
        let mut next = [0u32; BUCKETS];
        for &key in &self.keys {
            next[digit(key)] += 1;
        }
        let mut sum = 0;
        for n in &mut next {
            sum += std::mem::replace(n, sum);
        }
        for &key in &self.keys {
            let slot = &mut next[digit(key)];
            self.swap[*slot as usize] = key;
            *slot += 1;
        }
        std::mem::swap(&mut self.keys, &mut self.swap);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sorts_by_depth_then_index_and_drops_the_invisible() {
        let depth = |i: usize| [2.5, 1e-2, 7e20, 2.5, 1.0, 2.500_001][i % 6];
        let p: Vec<Projected> = (0..600)
            .map(|i| Projected {
                depth: depth(i),
                rx: if i % 5 == 0 { -1.0 } else { 1.0 },
                ..Default::default()
            })
            .collect();
        let mut want: Vec<usize> = (0..600).filter(|i| i % 5 != 0).collect();
        want.sort_by(|&a, &b| depth(a).total_cmp(&depth(b)));
        let mut sort = DepthSort::default();
        let got: Vec<usize> = sort.sort(&p).iter().map(|k| *k as u32 as usize).collect();
        assert_eq!(got, want);
    }
}
