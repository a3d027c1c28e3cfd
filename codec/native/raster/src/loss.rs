//! Image loss (1 - lambda) L1 + lambda (1 - SSIM) and its gradient by the image.
//!
//! SSIM as in 3D Gaussian Splatting: 11 x 11 Gaussian window of sigma 1.5, zeros outside of the image, mean over pixels and
//! channels. Images stay interleaved: a row is 3 W values and horizontal taps are 3 apart. Only E[x], E[y], E[x^2 + y^2] and
//! E[xy] are needed, since the variances occur as their sum. Pass 1 leaves the three derivative maps of the SSIM, pass 2
//! blurs them back. Both work on strips that fit the stack: vertical taps first, then horizontal ones.

use crate::divide::divide;
use crate::scene::{RasterError, check_length};
use crate::simd::{Level, Vector, c, dispatch};

const RADIUS: usize = 5;
const TAPS: usize = 2 * RADIUS + 1;
/// exp(-d^2 / (2 1.5^2)), normalised.
const WINDOW: [f32; TAPS] = [
    0.001_028_38,
    0.007_598_758,
    0.036_000_773,
    0.109_360_69,
    0.213_005_54,
    0.266_011_72,
    0.213_005_54,
    0.109_360_69,
    0.036_000_773,
    0.007_598_758,
    0.001_028_38,
];
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;

/// Values of a strip, and with room for the taps on both sides (16, so that 3 * RADIUS fits and vectors align).
const STRIP: usize = 384;
const MARGIN: usize = 16;
const WIDE: usize = STRIP + 2 * MARGIN;
/// Rows of one task.
const ROWS: usize = 8;

type Wide = [f32; WIDE];

/// Means over the (weighted) pixels and channels.
#[derive(Clone, Copy, Default, Debug, PartialEq)]
pub struct LossValue {
    pub loss: f64,
    pub l1: f64,
    pub mse: f64,
    pub ssim: f64,
}

/// Keeps the derivative maps from call to call.
#[derive(Default)]
pub struct ImageLoss {
    maps: [Vec<f32>; 3],
    partial: Vec<[f64; 3]>,
}

/// Two images [H, W, 3] and their weights.
#[derive(Clone, Copy)]
pub struct Pair<'a> {
    pub image: &'a [f32],
    pub target: &'a [f32],
    pub width: usize,
    /// [H, W]
    pub weight: Option<&'a [f32]>,
}

impl Pair<'_> {
    fn row_values(&self) -> usize {
        3 * self.width
    }
    fn rows(&self) -> usize {
        self.image.len() / self.row_values().max(1)
    }
}

impl ImageLoss {
    /// The loss, and its gradient into `grad` [H, W, 3]. The mean is weighted by `weight` if there is one.
    ///
    /// # Errors
    /// Lengths that disagree.
    pub fn run(&mut self, level: Level, pair: Pair, lambda: f32, grad: &mut [f32]) -> Result<LossValue, RasterError> {
        check_length("target", pair.target.len(), pair.image.len())?;
        check_length("gradient of the image", grad.len(), pair.image.len())?;
        check_length("image", pair.image.len(), pair.rows() * pair.row_values())?;
        let pixels = pair.image.len() / 3;
        let total = match pair.weight {
            None => pixels as f64,
            Some(w) => {
                check_length("weight", w.len(), pixels)?;
                w.iter().map(|&v| f64::from(v)).sum()
            }
        };
        if total <= 0.0 {
            grad.fill(0.0);
            return Ok(LossValue {
                ssim: 1.0,
                ..Default::default()
            });
        }
        let mean = 1.0 / (3.0 * total);
        let sums = self.derivatives(level, pair, -f64::from(lambda) * mean);
        self.gradient(level, pair, ((1.0 - f64::from(lambda)) * mean) as f32, grad);
        let [l1, mse, ssim] = sums.map(|s| s * mean);
        let loss = (1.0 - f64::from(lambda)) * l1 + f64::from(lambda) * (1.0 - ssim);
        Ok(LossValue { loss, l1, mse, ssim })
    }

    /// Pass 1: the maps times `scale` and the weight; returns sums of |x - y|, (x - y)^2 and SSIM.
    fn derivatives(&mut self, level: Level, pair: Pair, scale: f64) -> [f64; 3] {
        let (values, rows) = (pair.row_values(), pair.rows());
        self.partial.clear();
        self.partial.resize(rows, [0.0; 3]);
        for m in &mut self.maps {
            m.resize(pair.image.len(), 0.0);
        }
        let [a, b, d] = &mut self.maps;
        let work = ([&mut a[..], &mut b[..], &mut d[..]], &mut self.partial[..]);
        divide(
            0..rows,
            ROWS,
            work,
            &|([a, b, d], partial), r, middle| {
                let n = middle - r.start;
                let (a, a2) = a.split_at_mut(n * values);
                let (b, b2) = b.split_at_mut(n * values);
                let (d, d2) = d.split_at_mut(n * values);
                let (partial, partial2) = partial.split_at_mut(n);
                (([a, b, d], partial), ([a2, b2, d2], partial2))
            },
            &|r, (mut maps, partial)| derivative_rows(level, pair, scale as f32, r.start, &mut maps, partial),
        );
        self.partial
            .iter()
            .fold([0.0; 3], |s, p| [s[0] + p[0], s[1] + p[1], s[2] + p[2]])
    }

    /// Pass 2: blurs the maps and adds the gradient of L1.
    fn gradient(&self, level: Level, pair: Pair, l1: f32, grad: &mut [f32]) {
        let values = pair.row_values();
        let maps = [&self.maps[0][..], &self.maps[1][..], &self.maps[2][..]];
        divide(
            0..pair.rows(),
            ROWS,
            grad,
            &|g, r, middle| g.split_at_mut((middle - r.start) * values),
            &|r, g| gradient_rows(level, pair, &maps, l1, r.start, g),
        );
    }
}

/// Taps of `row` that are inside of the image.
#[inline(always)]
fn taps(row: usize, rows: usize) -> std::ops::Range<usize> {
    RADIUS.saturating_sub(row)..TAPS.min(rows + RADIUS - row)
}

/// Values of the strip at `start` with their margin that exist in the row: first, and how many.
#[inline(always)]
fn extent(start: usize, values: usize) -> (usize, usize) {
    let first = start.saturating_sub(MARGIN);
    (first, (start + STRIP + MARGIN).min(values) - first)
}

/// sum_k w_k of [x, y, x^2 + y^2, xy] over the rows, for values at .. at + LANES.
#[inline(always)]
fn vertical_moments<V: Vector>(x: &[&[f32]; TAPS], y: &[&[f32]; TAPS], k: std::ops::Range<usize>, at: usize) -> [V; 4] {
    let mut m = [c::<V>(0.0); 4];
    for k in k {
        let (w, x, y) = (c::<V>(WINDOW[k]), V::load(&x[k][at..]), V::load(&y[k][at..]));
        let (wx, wy) = (w * x, w * y);
        m[0] = m[0] + wx;
        m[1] = m[1] + wy;
        m[2] = wy.mul_add(y, wx.mul_add(x, m[2]));
        m[3] = wx.mul_add(y, m[3]);
    }
    m
}

#[inline(always)]
fn vertical_maps<V: Vector>(maps: &[[&[f32]; TAPS]; 3], k: std::ops::Range<usize>, at: usize) -> [V; 3] {
    let mut m = [c::<V>(0.0); 3];
    for k in k {
        let w = c::<V>(WINDOW[k]);
        for i in 0..3 {
            m[i] = w.mul_add(V::load(&maps[i][k][at..]), m[i]);
        }
    }
    m
}

#[inline(always)]
fn horizontal<V: Vector, const N: usize>(temp: &[Wide; N], at: usize) -> [V; N] {
    let mut m = [c::<V>(0.0); N];
    for i in 0..N {
        for k in 0..TAPS {
            m[i] = V::load(&temp[i][at + MARGIN + 3 * k - 3 * RADIUS..]).mul_add(c(WINDOW[k]), m[i]);
        }
    }
    m
}

/// The rows that the taps touch, `n` values from `first` on.
#[inline(always)]
fn tap_rows(
    image: &[f32],
    values: usize,
    row: usize,
    k: std::ops::Range<usize>,
    first: usize,
    n: usize,
) -> [&[f32]; TAPS] {
    let mut out: [&[f32]; TAPS] = [&[]; TAPS];
    for k in k {
        let at = (row + k - RADIUS) * values + first;
        out[k] = &image[at..at + n];
    }
    out
}

/// SSIM of the local means, and its derivatives by E[x], E[x^2] and E[xy].
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
    maps: &mut [&mut [f32]; 3],
    partial: &mut [[f64; 3]],
) {
    let (values, rows) = (pair.row_values(), pair.rows());
    for start in (0..values).step_by(STRIP) {
        let (first, n) = extent(start, values);
        let offset = first + MARGIN - start;
        let mut temp = [[0.0; WIDE]; 4];
        for (i, sums) in partial.iter_mut().enumerate() {
            let row = first_row + i;
            let k = taps(row, rows);
            let x = tap_rows(pair.image, values, row, k.clone(), first, n);
            let y = tap_rows(pair.target, values, row, k.clone(), first, n);
            let whole = n - n % V::LANES;
            for at in (0..whole).step_by(V::LANES) {
                let m = vertical_moments::<V>(&x, &y, k.clone(), at);
                for j in 0..4 {
                    m[j].store(&mut temp[j][offset + at..]);
                }
            }
            for at in whole..n {
                let m = vertical_moments::<f32>(&x, &y, k.clone(), at);
                for j in 0..4 {
                    temp[j][offset + at] = m[j];
                }
            }
            derivative_strip::<V>(pair, scale, row, start, &temp, i * values, maps, sums);
        }
    }
}

/// Horizontal taps and SSIM of one row of a strip.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn derivative_strip<V: Vector>(
    pair: Pair,
    scale: f32,
    row: usize,
    start: usize,
    temp: &[Wide; 4],
    out_at: usize,
    maps: &mut [&mut [f32]; 3],
    sums: &mut [f64; 3],
) {
    let values = pair.row_values();
    let n = STRIP.min(values - start);
    let mut out = [[0.0; STRIP]; 4];
    for at in (0..n).step_by(V::LANES) {
        let (s, d) = ssim(horizontal::<V, 4>(temp, at));
        for j in 0..3 {
            (d[j] * c(scale)).store(&mut out[j][at..]);
        }
        s.store(&mut out[3][at..]);
    }
    let at = row * values + start;
    let (x, y) = (&pair.image[at..at + n], &pair.target[at..at + n]);
    let mut sum = [0.0f32; 3];
    let mut weighted = [0.0f64; 3];
    for i in 0..n {
        let d = x[i] - y[i];
        let terms = [d.abs(), d * d, out[3][i]];
        match pair.weight {
            None => (0..3).for_each(|j| sum[j] += terms[j]),
            Some(w) => {
                let w = w[(at + i) / 3];
                (0..3).for_each(|j| out[j][i] *= w);
                (0..3).for_each(|j| weighted[j] += f64::from(w * terms[j]));
            }
        }
    }
    for j in 0..3 {
        sums[j] += f64::from(sum[j]) + weighted[j];
        maps[j][out_at + start..out_at + start + n].copy_from_slice(&out[j][..n]);
    }
}
dispatch!(
    fn derivative_rows = derivative_kernel(
        pair: Pair,
        scale: f32,
        first_row: usize,
        maps: &mut [&mut [f32]; 3],
        partial: &mut [[f64; 3]],
    )
);

#[inline(always)]
fn gradient_kernel<V: Vector>(pair: Pair, maps: &[&[f32]; 3], l1: f32, first_row: usize, grad: &mut [f32]) {
    let (values, rows) = (pair.row_values(), pair.rows());
    for start in (0..values).step_by(STRIP) {
        let (first, n) = extent(start, values);
        let offset = first + MARGIN - start;
        let mut temp = [[0.0; WIDE]; 3];
        for (i, grad) in grad.chunks_exact_mut(values).enumerate() {
            let row = first_row + i;
            let k = taps(row, rows);
            let mut m: [[&[f32]; TAPS]; 3] = [[&[]; TAPS]; 3];
            for j in 0..3 {
                m[j] = tap_rows(maps[j], values, row, k.clone(), first, n);
            }
            let whole = n - n % V::LANES;
            for at in (0..whole).step_by(V::LANES) {
                let v = vertical_maps::<V>(&m, k.clone(), at);
                for j in 0..3 {
                    v[j].store(&mut temp[j][offset + at..]);
                }
            }
            for at in whole..n {
                let v = vertical_maps::<f32>(&m, k.clone(), at);
                for j in 0..3 {
                    temp[j][offset + at] = v[j];
                }
            }
            gradient_strip::<V>(pair, l1, row, start, &temp, grad);
        }
    }
}

#[inline(always)]
fn gradient_strip<V: Vector>(pair: Pair, l1: f32, row: usize, start: usize, temp: &[Wide; 3], grad: &mut [f32]) {
    let values = pair.row_values();
    let n = STRIP.min(values - start);
    let at = row * values + start;
    let mut out = [[0.0; STRIP]; 3];
    for i in (0..n).step_by(V::LANES) {
        let m = horizontal::<V, 3>(temp, i);
        for j in 0..3 {
            m[j].store(&mut out[j][i..]);
        }
    }
    let (x, y) = (&pair.image[at..at + n], &pair.target[at..at + n]);
    for (i, g) in grad[start..start + n].iter_mut().enumerate() {
        let d = x[i] - y[i];
        let sign = if d > 0.0 {
            l1
        } else if d < 0.0 {
            -l1
        } else {
            0.0
        };
        let w = pair.weight.map_or(1.0, |w| w[(at + i) / 3]);
        *g = out[0][i] + 2.0 * x[i] * out[1][i] + y[i] * out[2][i] + sign * w;
    }
}
dispatch!(
    fn gradient_rows = gradient_kernel(pair: Pair, maps: &[&[f32]; 3], l1: f32, first_row: usize, grad: &mut [f32])
);
