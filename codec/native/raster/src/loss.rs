//! Image loss (1 - lambda) L1 + lambda (1 - SSIM) and its gradient by the image.
//!
//! SSIM as in 3D Gaussian Splatting: 11 x 11 Gaussian window of sigma 1.5, zeros outside of the image, mean over pixels
//! and channels. Images stay interleaved: a row is 3 W values and horizontal taps are 3 apart. Pass 1 (`ssim.rs`)
//! leaves three derivative maps of the SSIM, pass 2 blurs them back. Where both images are equal for 15 pixels around
//! (the background), SSIM is 1 and its gradient 0, so both passes visit only the columns that matter to a band of rows.

use std::ops::Range;

use rayon::prelude::*;

use crate::error::{RasterError, check_length};
use crate::image_pair::Pair;
use crate::parallel::parallel_for;
use crate::simd::{SimdLevel, Vector, c, dispatch};
use crate::ssim::{derivative_rows, gradient_rows};
use crate::ssim_window::ROWS;

/// Means over the pixels and channels.
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
    /// Per row: the range of values from the first to the last that differs.
    spans: Vec<Range<usize>>,
}

impl ImageLoss {
    /// The loss, and its gradient into `grad` [H, W, 3].
    ///
    /// # Errors
    /// Lengths that disagree.
    pub fn run(
        &mut self,
        level: SimdLevel,
        pair: Pair,
        lambda: f32,
        grad: &mut [f32],
    ) -> Result<LossValue, RasterError> {
        check_length("target", pair.target.len(), pair.image.len())?;
        check_length("gradient of the image", grad.len(), pair.image.len())?;
        check_length("image", pair.image.len(), pair.rows() * pair.row_values())?;
        let mean = 1.0 / pair.image.len().max(1) as f64;
        let sums = self.derivatives(level, pair, -f64::from(lambda) * mean);
        self.gradient(level, pair, ((1.0 - f64::from(lambda)) * mean) as f32, grad);
        let [l1, mse, ssim] = sums.map(|s| s * mean);
        let loss = (1.0 - f64::from(lambda)) * l1 + f64::from(lambda) * (1.0 - ssim);
        Ok(LossValue { loss, l1, mse, ssim })
    }

    /// Pass 1: derivative maps, times `scale`. Returns the sums of |x - y|, (x - y)^2 and SSIM.
    fn derivatives(&mut self, level: SimdLevel, pair: Pair, scale: f64) -> [f64; 3] {
        let (values, rows) = (pair.row_values(), pair.rows());
        self.partial.clear();
        self.partial.resize(rows, [0.0; 3]);
        self.spans.resize(rows, 0..0);
        let rows_of = |image| <[f32]>::par_chunks_exact(image, values);
        let spans = self
            .spans
            .par_iter_mut()
            .zip(rows_of(pair.image))
            .zip(rows_of(pair.target));
        spans.for_each(|((span, x), y)| *span = differing(level, x, y));
        for m in &mut self.maps {
            m.resize(pair.image.len(), 0.0);
        }
        let spans = &self.spans;
        let [a, b, d] = &mut self.maps;
        parallel_for(
            0..rows,
            ROWS,
            ([&mut a[..], &mut b[..], &mut d[..]], &mut self.partial[..]),
            &|([a, b, d], partial), r, middle| {
                let n = middle - r.start;
                let (a, a2) = a.split_at_mut(n * values);
                let (b, b2) = b.split_at_mut(n * values);
                let (d, d2) = d.split_at_mut(n * values);
                let (partial, partial2) = partial.split_at_mut(n);
                (([a, b, d], partial), ([a2, b2, d2], partial2))
            },
            &|r, (mut maps, partial)| {
                let columns = columns(spans, &r, 15 + ROWS + 1, 64, values);
                derivative_rows(level, pair, scale as f32, r.start, &columns, &mut maps, partial);
            },
        );
        self.partial
            .iter()
            .fold([0.0; 3], |s, p| [s[0] + p[0], s[1] + p[1], s[2] + p[2]])
    }

    /// Pass 2: blurs the maps and adds the gradient of L1.
    fn gradient(&self, level: SimdLevel, pair: Pair, l1: f32, grad: &mut [f32]) {
        let values = pair.row_values();
        let maps = [&self.maps[0][..], &self.maps[1][..], &self.maps[2][..]];
        parallel_for(
            0..pair.rows(),
            ROWS,
            grad,
            &|g, r, middle| g.split_at_mut((middle - r.start) * values),
            &|r, g| {
                let columns = columns(&self.spans, &r, 10, 30, values);
                gradient_rows(level, pair, &maps, l1, r.start, &columns, g);
            },
        );
    }
}

/// The columns that a band of rows needs: those with differences in the rows nearer than `reach`, widened by `margin`
/// values and to whole vectors.
///
/// A gradient is nonzero within 10 pixels of a difference, and reads maps 5 pixels further. Pass 2 takes 10 rows and,
/// rounded up to vectors, at most 45 values; it reads 60 values and 5 rows further, which pass 1 has computed for any
/// band of such a row.
fn columns(spans: &[Range<usize>], band: &Range<usize>, reach: usize, margin: usize, values: usize) -> Range<usize> {
    let rows = band.start.saturating_sub(reach)..(band.end + reach).min(spans.len());
    let used = spans[rows].iter().filter(|s| !s.is_empty());
    let (first, last) = used.fold((usize::MAX, 0), |(a, b), s| (a.min(s.start), b.max(s.end)));
    if first >= last {
        return 0..0;
    }
    first.saturating_sub(margin) / 16 * 16..(last + margin).next_multiple_of(16).min(values)
}

#[inline(always)]
fn differ<V: Vector>(x: &[f32], y: &[f32], at: usize) -> bool {
    V::any(!c::<V>(0.0).ge((V::load(&x[at..]) - V::load(&y[at..])).abs())) // NaN differs from everything
}

/// From the first to the last value that differs, to within a vector.
#[inline(always)]
fn differing_kernel<V: Vector>(x: &[f32], y: &[f32]) -> Range<usize> {
    let n = x.len().min(y.len());
    let mut first = 0;
    while first + V::LANES <= n && !differ::<V>(x, y, first) {
        first += V::LANES;
    }
    let mut last = n;
    while last >= first + V::LANES && !differ::<V>(x, y, last - V::LANES) {
        last -= V::LANES;
    }
    first..last
}
dispatch!(fn differing = differing_kernel(x: &[f32], y: &[f32]) -> Range<usize>);
