//! The 11 x 11 window of SSIM as separable taps over rows of interleaved images: vertical sums into a strip, then
//! horizontal.
//!
//! A strip is a stretch of columns whose sums live on the stack. Only E[x], E[y], E[x^2 + y^2] and E[xy] are summed,
//! since SSIM needs the variances only as their sum. Horizontal taps are 3 values apart, one pixel.

use std::ops::Range;

use crate::simd::{Vector, c};

pub const RADIUS: usize = 5;
pub const TAPS: usize = 2 * RADIUS + 1;
/// exp(-d^2 / (2 1.5^2)), normalised.
#[rustfmt::skip]
pub const WINDOW: [f32; TAPS] = [
    0.001_028_38, 0.007_598_758, 0.036_000_773, 0.109_360_69, 0.213_005_54, 0.266_011_72,
    0.213_005_54, 0.109_360_69, 0.036_000_773, 0.007_598_758, 0.001_028_38,
];

/// Values of a strip, and its width with room for the taps on both sides (16, so that 3 * RADIUS fits and vectors
/// align).
pub const STRIP: usize = 384;
pub const MARGIN: usize = 16;
pub const WIDE: usize = STRIP + 2 * MARGIN;
/// Rows of one task.
pub const ROWS: usize = 8;

#[repr(align(64))]
pub struct Wide(pub [f32; WIDE]);
#[repr(align(64))]
pub struct Narrow(pub [f32; STRIP]);

impl Wide {
    pub const ZERO: Wide = Wide([0.0; WIDE]);
}

impl Narrow {
    pub const ZERO: Narrow = Narrow([0.0; STRIP]);

    /// `source`, then zeros.
    pub fn copy(&mut self, source: &[f32]) {
        self.0[..source.len()].copy_from_slice(source);
        self.0[source.len()..].fill(0.0);
    }
}

/// A strip: `n` values from `start`; `reach`: the columns of the image that its taps read.
pub struct Strip {
    pub start: usize,
    pub n: usize,
    pub reach: Range<usize>,
}

impl Strip {
    pub fn new(start: usize, end: usize, values: usize) -> Strip {
        let n = STRIP.min(end - start);
        Strip {
            start,
            n,
            reach: start.saturating_sub(MARGIN)..(start + n + MARGIN).min(values),
        }
    }

    /// Index in the wide strip of the first value of `reach`.
    pub fn offset(&self) -> usize {
        self.reach.start + MARGIN - self.start
    }
}

/// Rows that the taps of `row` read, the columns `reach` of each; `k`: the taps that are inside the image.
pub fn tap_rows<'a>(
    image: &'a [f32],
    values: usize,
    row: usize,
    k: Range<usize>,
    reach: &Range<usize>,
) -> [&'a [f32]; TAPS] {
    let mut out: [&[f32]; TAPS] = [&[]; TAPS];
    for k in k {
        let at = (row + k - RADIUS) * values;
        out[k] = &image[at + reach.start..at + reach.end];
    }
    out
}

/// The taps of `row` that are inside the image.
pub fn taps(row: usize, rows: usize) -> Range<usize> {
    RADIUS.saturating_sub(row)..TAPS.min(rows + RADIUS - row)
}

/// sum_k w_k of [x, y, x^2 + y^2, xy] over the rows, U vectors from `at` on.
#[inline(always)]
pub fn moments<V: Vector, const U: usize>(
    x: &[&[f32]; TAPS],
    y: &[&[f32]; TAPS],
    k: Range<usize>,
    at: usize,
    offset: usize,
    temp: &mut [Wide; 4],
) {
    let mut m = [[c::<V>(0.0); U]; 4];
    for k in k {
        let (w, x, y) = (
            c::<V>(WINDOW[k]),
            &x[k][at..at + U * V::LANES],
            &y[k][at..at + U * V::LANES],
        );
        for u in 0..U {
            let (x, y) = (V::load(&x[u * V::LANES..]), V::load(&y[u * V::LANES..]));
            let (wx, wy) = (w * x, w * y);
            m[0][u] = m[0][u] + wx;
            m[1][u] = m[1][u] + wy;
            m[2][u] = wy.mul_add(y, wx.mul_add(x, m[2][u]));
            m[3][u] = wx.mul_add(y, m[3][u]);
        }
    }
    for (temp, m) in temp.iter_mut().zip(m) {
        let temp = &mut temp.0[offset + at..offset + at + U * V::LANES];
        for u in 0..U {
            m[u].store(&mut temp[u * V::LANES..]);
        }
    }
}

/// sum_k w_k of one map over the rows.
#[inline(always)]
pub fn vertical<V: Vector, const U: usize>(
    rows: &[&[f32]; TAPS],
    k: Range<usize>,
    at: usize,
    offset: usize,
    temp: &mut Wide,
) {
    let mut m = [c::<V>(0.0); U];
    for k in k {
        let (w, row) = (c::<V>(WINDOW[k]), &rows[k][at..at + U * V::LANES]);
        for u in 0..U {
            m[u] = w.mul_add(V::load(&row[u * V::LANES..]), m[u]);
        }
    }
    let temp = &mut temp.0[offset + at..offset + at + U * V::LANES];
    for u in 0..U {
        m[u].store(&mut temp[u * V::LANES..]);
    }
}

#[inline(always)]
pub fn horizontal<V: Vector, const N: usize>(temp: &[Wide; N], at: usize) -> [V; N] {
    let mut m = [c::<V>(0.0); N];
    for i in 0..N {
        let row = &temp[i].0[at + MARGIN - 3 * RADIUS..at + MARGIN + 3 * RADIUS + V::LANES];
        for k in 0..TAPS {
            m[i] = V::load(&row[3 * k..]).mul_add(c(WINDOW[k]), m[i]);
        }
    }
    m
}
