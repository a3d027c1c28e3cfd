//! The two passes over rows of an image pair: derivative maps of the SSIM, and their blur back to a gradient.
//!
//! Both work on strips of columns (`ssim_window`), row by row, and write only the columns that they are given.

use std::ops::Range;

use crate::image_pair::Pair;
use crate::simd::{Vector, c, dispatch};
use crate::ssim_window::{Narrow, STRIP, Strip, Wide, horizontal, moments, tap_rows, taps, vertical};

const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;

/// 1 for the values of a strip of n, 0 past its end: read from STRIP - n on.
static INSIDE: [f32; 2 * STRIP] = {
    let mut inside = [0.0; 2 * STRIP];
    let mut i = 0;
    while i < STRIP {
        inside[i] = 1.0;
        i += 1;
    }
    inside
};

/// SSIM of the local means, and its derivatives with respect to E[x], E[x^2] and E[xy].
#[inline(always)]
fn ssim<V: Vector>([x, y, squares, xy]: [V; 4]) -> (V, [V; 3]) {
    let two = c::<V>(2.0);
    let (mxy, mm) = (x * y, x * x + y * y);
    let (a1, a2) = (two * mxy + c(C1), two * (xy - mxy) + c(C2));
    let (b1, b2) = (mm + c(C1), squares - mm + c(C2));
    let inv = c::<V>(1.0) / (b1 * b2);
    let s = a1 * a2 * inv;
    let d_xy = two * a1 * inv;
    let d_xx = -(s * b1 * inv);
    let d_x = two * y * a2 * inv - two * x * s * b2 * inv - d_xy * y - two * d_xx * x;
    (s, [d_x, d_xx, d_xy])
}

#[inline(always)]
fn derivative_kernel<V: Vector>(
    pair: Pair,
    scale: f32,
    first_row: usize,
    columns: &Range<usize>,
    maps: &mut [&mut [f32]; 3],
    partial: &mut [[f64; 3]],
) {
    let (values, rows) = (pair.row_values(), pair.rows());
    for sums in partial.iter_mut() {
        sums[2] = (values - columns.len()) as f64; // outside of the columns the images are equal and SSIM is 1
    }
    for start in columns.clone().step_by(STRIP) {
        let strip = Strip::new(start, columns.end, values);
        let (offset, n) = (strip.offset(), strip.reach.len());
        let mut temp = [Wide::ZERO; 4];
        for (i, sums) in partial.iter_mut().enumerate() {
            let row = first_row + i;
            let k = taps(row, rows);
            let x = tap_rows(pair.image, values, row, k.clone(), &strip.reach);
            let y = tap_rows(pair.target, values, row, k.clone(), &strip.reach);
            let mut at = 0;
            while at + 4 * V::LANES <= n {
                moments::<V, 4>(&x, &y, k.clone(), at, offset, &mut temp);
                at += 4 * V::LANES;
            }
            while at + V::LANES <= n {
                moments::<V, 1>(&x, &y, k.clone(), at, offset, &mut temp);
                at += V::LANES;
            }
            for at in at..n {
                moments::<f32, 1>(&x, &y, k.clone(), at, offset, &mut temp);
            }
            let out = maps
                .each_mut()
                .map(|m| &mut m[i * values + start..i * values + start + strip.n]);
            derivative_strip::<V>(pair, scale, row, &strip, &temp, out, sums);
        }
    }
}

/// Horizontal taps and SSIM of one row of a strip.
#[inline(always)]
fn derivative_strip<V: Vector>(
    pair: Pair,
    scale: f32,
    row: usize,
    strip: &Strip,
    temp: &[Wide; 4],
    maps: [&mut [f32]; 3],
    sums: &mut [f64; 3],
) {
    let at = row * pair.row_values() + strip.start;
    let mut local = [Narrow::ZERO; 3];
    local[0].copy(&pair.image[at..at + strip.n]);
    local[1].copy(&pair.target[at..at + strip.n]);
    let inside = &INSIDE[STRIP - strip.n..];
    let mut sum = [c::<V>(0.0); 3];
    for i in (0..strip.n).step_by(V::LANES) {
        let (x, y) = (V::load(&local[0].0[i..]), V::load(&local[1].0[i..]));
        let (s, d) = ssim(horizontal::<V, 4>(temp, i));
        let difference = (x - y).abs();
        sum[0] = sum[0] + difference;
        sum[1] = difference.mul_add(difference, sum[1]);
        sum[2] = s.mul_add(V::load(&inside[i..]), sum[2]);
        for j in 0..3 {
            (d[j] * c(scale)).store(&mut local[j].0[i..]);
        }
    }
    for j in 0..3 {
        let mut lanes = [0.0f32; 16];
        sum[j].store(&mut lanes);
        sums[j] += lanes.iter().map(|&v| f64::from(v)).sum::<f64>();
        maps[j].copy_from_slice(&local[j].0[..strip.n]);
    }
}
dispatch!(
    /// Writes the derivative maps of the columns, times `scale`, and the sums of |x - y|, (x - y)^2 and SSIM.
    pub fn derivative_rows = derivative_kernel(
        pair: Pair,
        scale: f32,
        first_row: usize,
        columns: &Range<usize>,
        maps: &mut [&mut [f32]; 3],
        partial: &mut [[f64; 3]],
    )
);

#[inline(always)]
fn gradient_kernel<V: Vector>(
    pair: Pair,
    maps: &[&[f32]; 3],
    l1: f32,
    first_row: usize,
    columns: &Range<usize>,
    grad: &mut [f32],
) {
    let (values, rows) = (pair.row_values(), pair.rows());
    for row in grad.chunks_exact_mut(values) {
        row[..columns.start].fill(0.0);
        row[columns.end..].fill(0.0);
    }
    for start in columns.clone().step_by(STRIP) {
        let strip = Strip::new(start, columns.end, values);
        let (offset, n) = (strip.offset(), strip.reach.len());
        let mut temp = [Wide::ZERO; 3];
        for (i, grad) in grad.chunks_exact_mut(values).enumerate() {
            let row = first_row + i;
            let k = taps(row, rows);
            for (map, temp) in maps.iter().zip(&mut temp) {
                let map = tap_rows(map, values, row, k.clone(), &strip.reach);
                let mut at = 0;
                while at + 8 * V::LANES <= n {
                    vertical::<V, 8>(&map, k.clone(), at, offset, temp);
                    at += 8 * V::LANES;
                }
                while at + V::LANES <= n {
                    vertical::<V, 1>(&map, k.clone(), at, offset, temp);
                    at += V::LANES;
                }
                for at in at..n {
                    vertical::<f32, 1>(&map, k.clone(), at, offset, temp);
                }
            }
            gradient_strip::<V>(pair, l1, row, &strip, &temp, &mut grad[start..start + strip.n]);
        }
    }
}

#[inline(always)]
fn gradient_strip<V: Vector>(pair: Pair, l1: f32, row: usize, strip: &Strip, temp: &[Wide; 3], grad: &mut [f32]) {
    let at = row * pair.row_values() + strip.start;
    let mut local = [Narrow::ZERO; 2];
    local[0].copy(&pair.image[at..at + strip.n]);
    local[1].copy(&pair.target[at..at + strip.n]);
    let zero = c::<V>(0.0);
    for i in (0..strip.n).step_by(V::LANES) {
        let (x, y) = (V::load(&local[0].0[i..]), V::load(&local[1].0[i..]));
        let [d_x, d_xx, d_xy] = horizontal::<V, 3>(temp, i);
        let sign = c::<V>(l1).select(y.lt(x), zero) - c::<V>(l1).select(x.lt(y), zero);
        let g = y.mul_add(d_xy, (x + x).mul_add(d_xx, d_x + sign));
        g.store(&mut local[0].0[i..]);
    }
    grad.copy_from_slice(&local[0].0[..strip.n]);
}
dispatch!(
    /// Writes whole rows of the gradient, 0 outside of the columns.
    pub fn gradient_rows = gradient_kernel(
        pair: Pair,
        maps: &[&[f32]; 3],
        l1: f32,
        first_row: usize,
        columns: &Range<usize>,
        grad: &mut [f32],
    )
);
