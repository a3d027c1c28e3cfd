//! Finished tiles, stored block by block -> rows of an image, as floats or as 8-bit colour.

use std::ops::Range;

use crate::error::{RasterError, check_length};
use crate::forward::Canvas;
use crate::projected::TILE;
use crate::scene::Background;
use crate::size::Size;
use crate::tile::swizzle;

/// The pixels of an image, in rows. Viewers draw straight to bytes, without a float image in between.
pub enum Surface<'a> {
    /// [H, W, 3], [H, W], and [H, W] sums of weight times depth, or nothing where depth is not asked for.
    Floats {
        image: &'a mut [f32],
        alpha: &'a mut [f32],
        depth: &'a mut [f32],
    },
    Rgb(&'a mut [[u8; 3]]),
    /// Alpha is 255.
    Rgba(&'a mut [[u8; 4]]),
}

impl<'a> Surface<'a> {
    /// # Errors
    /// A length other than that of the image.
    pub fn check(&self, size: Size) -> Result<(), RasterError> {
        let pixels = size.pixels();
        match self {
            Surface::Floats { image, alpha, depth } => {
                check_length("image", image.len(), 3 * pixels)?;
                check_length("alpha", alpha.len(), pixels)?;
                check_length("depth", depth.len(), if depth.is_empty() { 0 } else { pixels })
            }
            Surface::Rgb(p) => check_length("8-bit image", p.len(), pixels),
            Surface::Rgba(p) => check_length("8-bit image", p.len(), pixels),
        }
    }

    pub fn pixels(&self) -> usize {
        match self {
            Surface::Floats { alpha, .. } => alpha.len(),
            Surface::Rgb(p) => p.len(),
            Surface::Rgba(p) => p.len(),
        }
    }

    /// The pixels of `range`.
    pub fn part(&mut self, range: Range<usize>) -> Surface<'_> {
        match self {
            Surface::Floats { image, alpha, depth } => Surface::Floats {
                image: &mut image[3 * range.start..3 * range.end],
                alpha: &mut alpha[range.clone()],
                depth: if depth.is_empty() { depth } else { &mut depth[range] },
            },
            Surface::Rgb(p) => Surface::Rgb(&mut p[range]),
            Surface::Rgba(p) => Surface::Rgba(&mut p[range]),
        }
    }

    /// The first `n` pixels, and the others.
    pub fn split_at(self, n: usize) -> (Surface<'a>, Surface<'a>) {
        match self {
            Surface::Floats { image, alpha, depth } => {
                let (image, image_rest) = image.split_at_mut(3 * n);
                let (alpha, alpha_rest) = alpha.split_at_mut(n);
                let (depth, depth_rest) = depth.split_at_mut(n.min(depth.len()));
                let rest = Surface::Floats {
                    image: image_rest,
                    alpha: alpha_rest,
                    depth: depth_rest,
                };
                (Surface::Floats { image, alpha, depth }, rest)
            }
            Surface::Rgb(p) => {
                let (a, b) = p.split_at_mut(n);
                (Surface::Rgb(a), Surface::Rgb(b))
            }
            Surface::Rgba(p) => {
                let (a, b) = p.split_at_mut(n);
                (Surface::Rgba(a), Surface::Rgba(b))
            }
        }
    }

    /// Whether depth is asked for.
    pub fn has_depth(&self) -> bool {
        matches!(self, Surface::Floats { depth, .. } if !depth.is_empty())
    }

    /// Writes `columns` pixels from index `at` on.
    #[inline(always)]
    fn put(&mut self, at: usize, columns: usize, rgb: &[[f32; 3]; TILE], opacity: &[f32; TILE]) {
        let (rgb, opacity) = (&rgb[..columns], &opacity[..columns]);
        match self {
            Surface::Floats { image, alpha, .. } => {
                image[3 * at..3 * (at + columns)].copy_from_slice(rgb.as_flattened());
                alpha[at..at + columns].copy_from_slice(opacity);
            }
            Surface::Rgb(p) => {
                for (p, c) in p[at..at + columns].iter_mut().zip(rgb) {
                    *p = c.map(byte);
                }
            }
            Surface::Rgba(p) => {
                for (p, c) in p[at..at + columns].iter_mut().zip(rgb) {
                    *p = [byte(c[0]), byte(c[1]), byte(c[2]), 255];
                }
            }
        }
    }
}

/// 0 to 1 -> 0 to 255, rounded. Adding 2^23 leaves the integer in the low bits, which is faster than a conversion in
/// WebAssembly engines.
#[inline(always)]
fn byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0 + 8_388_608.0).to_bits() as u8
}

/// Writes a finished tile at column `x` to its rows of pixels.
pub fn finish(canvas: &Canvas, background: Background, x: usize, width: usize, band: &mut Surface) {
    let (gain, back) = (background.gain.unwrap_or([1.0; 3]), background.rgb);
    let columns = TILE.min(width - x);
    for y in 0..band.pixels() / width {
        let mut rgb_row = [[0.0; 3]; TILE];
        let mut alpha_row = [0.0; TILE];
        let four = y % 4 * 4..y % 4 * 4 + 4;
        for column in 0..4 {
            let b = (y / 4 * 4 + column) & 15;
            let t = &canvas.transmittance.0[b][four.clone()];
            let [r, g, b] = [0, 1, 2].map(|ch| &canvas.channels[ch].0[b][four.clone()]);
            for i in 0..4 {
                let (at, t) = (4 * column + i, t[i].abs());
                rgb_row[at] = [
                    gain[0] * r[i] + t * back[0],
                    gain[1] * g[i] + t * back[1],
                    gain[2] * b[i] + t * back[2],
                ];
                alpha_row[at] = 1.0 - t;
            }
        }
        band.put(y * width + x, columns, &rgb_row, &alpha_row);
        if let Surface::Floats { depth, .. } = band
            && let Some(row) = depth.get_mut(y * width + x..y * width + x + columns)
        {
            for (i, d) in row.iter_mut().enumerate() {
                let (b, k) = swizzle(i, y);
                *d = canvas.channels[3].0[b][k];
            }
        }
    }
}

/// Fills columns that no Gaussian meets with the background: whole stretches of rows, which is faster than tile after
/// tile.
pub fn finish_empty(background: Background, columns: Range<usize>, width: usize, band: &mut Surface) {
    if columns.is_empty() {
        return;
    }
    let colour = background.rgb;
    for y in 0..band.pixels() / width {
        let row = y * width + columns.start..y * width + columns.end;
        match band {
            Surface::Floats { image, alpha, depth } => {
                alpha[row.clone()].fill(0.0);
                if let Some(depth) = depth.get_mut(row.clone()) {
                    depth.fill(0.0);
                }
                image.as_chunks_mut::<3>().0[row].fill(colour);
            }
            Surface::Rgb(p) => p[row].fill(colour.map(byte)),
            Surface::Rgba(p) => {
                let [r, g, b] = colour.map(byte);
                p[row].fill([r, g, b, 255]);
            }
        }
    }
}
