//! Between tiles, whose pixels lie block by block, and images, whose pixels lie row by row.

use crate::backward::Adjoint;
use crate::forward::Canvas;
use crate::project::TILE;
use crate::rasterizer::Shade;
use crate::tile::{Plane, swizzle};

/// Writes a finished tile to the rows of its band.
pub fn finish(canvas: &Canvas, shade: Shade, x: usize, width: usize, image: &mut [f32], alpha: &mut [f32]) {
    let (gain, back) = (shade.gain.unwrap_or([1.0; 3]), shade.background);
    let whole = width - x >= TILE;
    for (y, (image, alpha)) in image
        .chunks_exact_mut(3 * width)
        .zip(alpha.chunks_exact_mut(width))
        .enumerate()
    {
        let mut rgb_row = [0.0; 3 * TILE];
        let mut alpha_row = [0.0; TILE];
        let four = y % 4 * 4..y % 4 * 4 + 4;
        for column in 0..4 {
            let b = (y / 4 * 4 + column) & 15;
            let t = &canvas.transmittance.0[b][four.clone()];
            let [r, g, b] = [0, 1, 2].map(|ch| &canvas.rgb[ch].0[b][four.clone()]);
            for i in 0..4 {
                let (at, t) = (4 * column + i, t[i].abs());
                rgb_row[3 * at] = gain[0] * r[i] + t * back[0];
                rgb_row[3 * at + 1] = gain[1] * g[i] + t * back[1];
                rgb_row[3 * at + 2] = gain[2] * b[i] + t * back[2];
                alpha_row[at] = 1.0 - t;
            }
        }
        let (image, alpha) = (&mut image[3 * x..], &mut alpha[x..]);
        if whole {
            image[..3 * TILE].copy_from_slice(&rgb_row);
            alpha[..TILE].copy_from_slice(&alpha_row);
        } else {
            image.copy_from_slice(&rgb_row[..image.len()]);
            alpha.copy_from_slice(&alpha_row[..alpha.len()]);
        }
    }
}

/// A tile without Gaussians.
pub fn finish_empty(shade: Shade, x: usize, width: usize, image: &mut [f32], alpha: &mut [f32]) {
    let columns = TILE.min(width - x);
    let mut row = [0.0; 3 * TILE];
    row.as_chunks_mut::<3>().0.fill(shade.background);
    for (image, alpha) in image.chunks_exact_mut(3 * width).zip(alpha.chunks_exact_mut(width)) {
        image[3 * x..3 * (x + columns)].copy_from_slice(&row[..3 * columns]);
        alpha[x..x + columns].fill(0.0);
    }
}

/// A rendered region and the gradient of the loss by it.
pub struct Pixels<'a> {
    pub image: &'a [f32],
    pub alpha: &'a [f32],
    pub grad_image: &'a [f32],
    pub grad_alpha: &'a [f32],
    pub width: usize,
}

impl Pixels<'_> {
    /// The tile at (x, y). With image = gain sum(w rgb) + T background and alpha = 1 - T, the remainder of the whole pixel,
    /// g . sum(w rgb) + T (g . background - g_alpha), is g . image - T g_alpha.
    pub fn adjoint(&self, x: usize, y: usize, shade: Shade) -> Adjoint {
        let mut a = Adjoint {
            transmittance: Plane::ZERO,
            remainder: Plane::ZERO,
            rgb: [Plane::ZERO; 3],
        };
        let (rows, gain) = (
            (self.alpha.len() / self.width - y).min(TILE),
            shade.gain.unwrap_or([1.0; 3]),
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
                        a.rgb[ch].0[b][k] = g[ch] * gain[ch];
                    }
                    a.remainder.0[b][k] = g[0] * c[0] + g[1] * c[1] + g[2] * c[2] - (1.0 - t[i]) * gt[i];
                }
            }
        }
        a
    }
}
