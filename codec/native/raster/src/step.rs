//! The image side of a training step in one call: render, compare with an 8-bit target image, differentiate.
//!
//! Target: unassociated 8-bit colour and optional alpha, composited on the same background as the Gaussians. Loss: the
//! image loss, plus mask_lambda * mean |alpha - target alpha|, plus depth_lambda * mean |D - alpha d| / d, with D the
//! sum of weight times depth and d the target depth, where that is known. No buffer with a value per pixel passes
//! through the caller.

use rayon::prelude::*;

use crate::clock::Clock;
use crate::error::{RasterError, check_length};
use crate::image_pair::Pair;
use crate::loss::{ImageLoss, LossValue};
use crate::rasterizer::Rasterizer;
use crate::scene::{Background, Gradients, Splats, View};

/// The target of a view: rgb [H, W, 3], alpha and depth [H, W].
#[derive(Clone, Copy)]
pub struct TargetImage<'a> {
    pub rgb: &'a [u8],
    pub alpha: Option<&'a [u8]>,
    /// World units along the optical axis; 0: unknown.
    pub depth: Option<&'a [f32]>,
    /// Offset that the camera adds to all light of the Gaussians; the loss compares the images without it.
    pub offset: [f32; 3],
}

#[derive(Clone, Copy)]
pub struct Lambdas {
    pub ssim: f32,
    pub mask: f32,
    pub depth: f32,
}

#[derive(Clone, Copy, Default, Debug)]
pub struct StepValue {
    pub image: LossValue,
    pub mask: f64,
    pub depth: f64,
    pub loss: f64,
    /// Gradient with respect to the gain of `Background`.
    pub gain: [f64; 3],
    /// Gradient with respect to the offset of the target.
    pub offset: [f64; 3],
}

/// v / 255
static BYTE: [f32; 256] = {
    let mut table = [0.0; 256];
    let mut v = 0;
    while v < 256 {
        table[v] = v as f32 / 255.0;
        v += 1;
    }
    table
};

/// Buffers of a step, [H, W, ...].
#[derive(Default)]
pub struct Step {
    loss: ImageLoss,
    target: Vec<f32>,
    grad_image: Vec<f32>,
    grad_alpha: Vec<f32>,
    grad_depth: Vec<f32>, // empty without a target depth
    rows: Vec<[f64; 8]>,  // mask, gain, offset and depth sums of each image row
}

impl Step {
    /// `out`: None: the loss alone, without gradients by the Gaussians.
    ///
    /// # Errors
    /// Wrong lengths, an empty or too large view, too many Gaussian-tile pairs.
    #[allow(clippy::too_many_arguments)] // one training step has these inputs
    pub fn run(
        &mut self,
        rasterizer: &mut Rasterizer,
        splats: &Splats,
        view: &View,
        background: Background,
        target: TargetImage,
        lambdas: Lambdas,
        out: Option<&mut Gradients>,
    ) -> Result<StepValue, RasterError> {
        splats.check()?;
        view.check()?;
        let pixels = view.size.pixels();
        check_length("target rgb", target.rgb.len(), 3 * pixels)?;
        check_length("target alpha", target.alpha.map_or(pixels, <[u8]>::len), pixels)?;
        check_length("target depth", target.depth.map_or(pixels, <[f32]>::len), pixels)?;
        // gain sum(w rgb) + (1 - T) offset + T background - offset = gain sum(w rgb) + T (background - offset)
        let less = std::array::from_fn(|ch| background.rgb[ch] - target.offset[ch]);
        let shifted = Background {
            rgb: less,
            ..background
        };
        rasterizer.run(|r| {
            r.forward_here(splats, view, shifted, out.is_some(), target.depth.is_some())?;
            let start = Clock::start();
            let value = self.photometric_loss(r, view, background, target, lambdas)?;
            r.timings.loss = start.ms();
            if let Some(out) = out {
                r.backward_here(splats, &self.grad_image, &self.grad_alpha, &self.grad_depth, out)?;
            }
            Ok(value)
        })
    }

    fn photometric_loss(
        &mut self,
        r: &Rasterizer,
        view: &View,
        background: Background,
        target: TargetImage,
        lambdas: Lambdas,
    ) -> Result<StepValue, RasterError> {
        let n = view.size.pixels();
        self.target.resize(3 * n, 0.0);
        self.grad_image.resize(3 * n, 0.0);
        self.grad_alpha.resize(n, 0.0);
        self.rows.resize(view.size.height, [0.0; 8]);
        self.composite(r, view, background, target, lambdas.mask);
        let depth = self.depth_loss(r, view, target.depth, lambdas.depth);
        let pair = Pair {
            image: r.image(),
            target: &self.target,
            width: view.size.width,
        };
        let image = self.loss.run(r.level(), pair, lambdas.ssim, &mut self.grad_image)?;
        let mask = self.rows.iter().map(|s| s[0]).sum::<f64>() / n as f64;
        let (gain, offset) = self.exposure_gradient(r, view.size.width, background, target.offset);
        Ok(StepValue {
            image,
            mask,
            depth,
            loss: image.loss + f64::from(lambdas.mask) * mask + f64::from(lambdas.depth) * depth,
            gain,
            offset,
        })
    }

    /// Composites the target, and writes the gradient and the sums of the mask loss.
    fn composite(
        &mut self,
        r: &Rasterizer,
        view: &View,
        background: Background,
        target: TargetImage,
        mask_lambda: f32,
    ) {
        let width = view.size.width;
        let slope = mask_lambda / view.size.pixels() as f32;
        let rows = self
            .target
            .par_chunks_mut(3 * width)
            .zip(self.grad_alpha.par_chunks_mut(width));
        let rows = rows.zip(r.alpha().par_chunks(width)).zip(&mut self.rows).enumerate();
        rows.for_each(|(y, (((out, grad), drawn), sums))| {
            let at = y * width;
            let rgb = &target.rgb[3 * at..3 * (at + width)];
            let Some(alpha) = target.alpha.map(|a| &a[at..at + width]) else {
                for (o, v) in out.as_chunks_mut::<3>().0.iter_mut().zip(rgb.as_chunks::<3>().0) {
                    *o = [0, 1, 2].map(|ch| BYTE[usize::from(v[ch])] - target.offset[ch]);
                }
                grad.fill(0.0);
                sums[0] = 0.0;
                return;
            };
            let mut sum = 0.0;
            let pixels = out
                .as_chunks_mut::<3>()
                .0
                .iter_mut()
                .zip(rgb.as_chunks::<3>().0)
                .zip(alpha);
            for (((out, rgb), &a), (grad, drawn)) in pixels.zip(grad.iter_mut().zip(drawn)) {
                *out = match a {
                    0 => background.rgb,
                    255 => rgb.map(|v| BYTE[usize::from(v)]),
                    _ => {
                        let a = BYTE[usize::from(a)];
                        [0, 1, 2].map(|ch| BYTE[usize::from(rgb[ch])] * a + (1.0 - a) * background.rgb[ch])
                    }
                };
                *out = [0, 1, 2].map(|ch| out[ch] - target.offset[ch]);
                let d = drawn - BYTE[usize::from(a)];
                sum += d.abs();
                *grad = slope * (f32::from(d > 0.0) - f32::from(d < 0.0));
            }
            sums[0] = f64::from(sum);
        });
    }

    /// The depth loss, a mean over all pixels. Writes its gradient by the depth sums, and adds its gradient by alpha.
    fn depth_loss(&mut self, r: &Rasterizer, view: &View, target: Option<&[f32]>, lambda: f32) -> f64 {
        self.grad_depth.clear();
        let Some(target) = target else {
            return 0.0;
        };
        let (width, pixels) = (view.size.width, view.size.pixels());
        self.grad_depth.resize(pixels, 0.0);
        let slope = lambda / pixels as f32;
        let grads = self
            .grad_depth
            .par_chunks_mut(width)
            .zip(self.grad_alpha.par_chunks_mut(width));
        let drawn = r.depth().par_chunks(width).zip(r.alpha().par_chunks(width));
        let rows = grads.zip(drawn).zip(target.par_chunks(width)).zip(&mut self.rows);
        rows.for_each(|(((grads, drawn), target), sums)| {
            let ((grad, grad_alpha), (drawn, alpha)) = (grads, drawn);
            let mut sum = 0.0;
            for (x, &d) in target.iter().enumerate() {
                if !(d > 0.0 && d.is_finite()) {
                    continue;
                }
                let off = drawn[x] / d - alpha[x];
                let sign = slope * (f32::from(off > 0.0) - f32::from(off < 0.0));
                grad[x] = sign / d;
                grad_alpha[x] -= sign;
                sum += off.abs();
            }
            sums[7] = f64::from(sum);
        });
        self.rows.iter().map(|s| s[7]).sum::<f64>() / pixels as f64
    }

    /// Gradient by the gain: sum over pixels of g . (image - T background) / gain; by the offset: sum of g (1 - T).
    fn exposure_gradient(
        &mut self,
        r: &Rasterizer,
        width: usize,
        background: Background,
        offset: [f32; 3],
    ) -> ([f64; 3], [f64; 3]) {
        let Some(gain) = background.gain else {
            return ([0.0; 3], [0.0; 3]);
        };
        let grads = self.grad_image.par_chunks(3 * width);
        let drawn = r.image().par_chunks(3 * width).zip(r.alpha().par_chunks(width));
        grads
            .zip(drawn)
            .zip(&mut self.rows)
            .for_each(|((g, (image, alpha)), sums)| {
                let mut s = [0.0f64; 6];
                for (x, a) in alpha.iter().enumerate() {
                    for ch in 0..3 {
                        let own = image[3 * x + ch] - (1.0 - a) * (background.rgb[ch] - offset[ch]);
                        s[ch] += f64::from(g[3 * x + ch] * own);
                        s[3 + ch] += f64::from(g[3 * x + ch] * a);
                    }
                }
                sums[1..7].copy_from_slice(&s);
            });
        let sum = |i: usize| self.rows.iter().map(|s| s[1 + i]).sum::<f64>();
        let by_gain = |ch: usize| {
            if gain[ch] == 0.0 {
                0.0
            } else {
                sum(ch) / f64::from(gain[ch])
            }
        };
        (std::array::from_fn(by_gain), std::array::from_fn(|ch| sum(3 + ch)))
    }
}
