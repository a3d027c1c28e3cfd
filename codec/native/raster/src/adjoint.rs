//! A rendered image and its gradient, row by row -> the adjoint state of one tile, block by block, for the backward
//! pass.

use crate::projected::TILE;
use crate::scene::Background;
use crate::tile::{Plane, swizzle};

/// Per-pixel state of the backward pass over one tile.
pub struct Adjoint {
    /// Starts at 1 (0 outside of the image).
    pub transmittance: Plane,
    pub remainder: Plane,
    /// Gradient with respect to the blended colours and depth.
    pub channels: [Plane; 4],
}

/// A rendered image and the gradient of the loss with respect to it.
pub struct Pixels<'a> {
    pub image: &'a [f32],
    pub alpha: &'a [f32],
    /// [H, W] sums of weight times depth, and dL/d(sum); empty without a depth loss.
    pub depth: &'a [f32],
    pub grad_depth: &'a [f32],
    pub grad_image: &'a [f32],
    pub grad_alpha: &'a [f32],
    pub width: usize,
}

impl Pixels<'_> {
    /// The tile at (x, y). With image = gain sum(w rgb) + T background and alpha = 1 - T, the remainder of the whole
    /// pixel, g . sum(w rgb) + T (g . background - g_alpha), is g . image - T g_alpha.
    #[inline(always)] // into the kernel, whose wide instructions it needs
    pub fn adjoint(&self, [x, y]: [usize; 2], background: Background) -> Adjoint {
        let mut a = Adjoint {
            transmittance: Plane::ZERO,
            remainder: Plane::ZERO,
            channels: [Plane::ZERO; 4],
        };
        let (rows, gain) = (
            (self.alpha.len() / self.width - y).min(TILE),
            background.gain.unwrap_or([1.0; 3]),
        );
        let columns = TILE.min(self.width - x);
        for j in 0..rows {
            let at = (y + j) * self.width + x;
            let image = &self.image[3 * at..3 * (at + columns)];
            let grad = &self.grad_image[3 * at..3 * (at + columns)];
            let (alpha, grad_alpha) = (&self.alpha[at..at + columns], &self.grad_alpha[at..at + columns]);
            let four = grad
                .chunks(12)
                .zip(image.chunks(12))
                .zip(alpha.chunks(4).zip(grad_alpha.chunks(4)));
            for (column, ((g, c), (t, gt))) in four.enumerate() {
                let (b, first) = swizzle(4 * column, j);
                for (i, (g, c)) in g.as_chunks::<3>().0.iter().zip(c.as_chunks::<3>().0).enumerate() {
                    let k = (first + i) & 15;
                    a.transmittance.0[b][k] = 1.0;
                    for ch in 0..3 {
                        a.channels[ch].0[b][k] = g[ch] * gain[ch];
                    }
                    a.remainder.0[b][k] = g[0] * c[0] + g[1] * c[1] + g[2] * c[2] - (1.0 - t[i]) * gt[i];
                }
            }
            if let (Some(depth), Some(grad)) = (self.depth.get(at..at + columns), self.grad_depth.get(at..at + columns))
            {
                for (i, (depth, grad)) in depth.iter().zip(grad).enumerate() {
                    let (b, k) = swizzle(i, j);
                    a.channels[3].0[b][k] = *grad;
                    a.remainder.0[b][k] += grad * depth;
                }
            }
        }
        a
    }
}
