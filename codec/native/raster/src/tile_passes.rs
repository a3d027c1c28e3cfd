//! The two passes over all tiles of an image: blending onto the framebuffer, and the gradient sums of the Gaussian-tile
//! pairs.
//!
//! Both run in parallel over rows of tiles. A row owns its pixels and its pairs, so results do not depend on the
//! threads.

use std::ops::Range;

use crate::adjoint::Pixels;
use crate::backward::{Sums, backward};
use crate::forward::{Canvas, forward};
use crate::framebuffer::{Surface, finish, finish_empty};
use crate::parallel::parallel_for;
use crate::projected::{Projected, TILE};
use crate::scene::Background;
use crate::simd::SimdLevel;
use crate::size::Size;
use crate::tile::Hits;
use crate::tile_binning::TileBins;

/// Blends the tiles of `bins` onto `surface` [H, W], front to back. `seen` gets the masks of Gaussians drawn on each
/// block, for `backward_tiles`: room for all batches, or empty without a backward pass.
pub fn blend_tiles(
    level: SimdLevel,
    projected: &[Projected],
    bins: &TileBins,
    size: Size,
    background: Background,
    surface: &mut Surface,
    seen: &mut [Hits],
) {
    let width = size.width;
    let (top, left) = (bins.tiles.rows.start, bins.tiles.columns.start);
    let pixels = top * TILE * width..(bins.tiles.rows.end * TILE).min(size.height) * width;
    let work = (surface.part(pixels), seen);
    let (rows, columns) = (bins.tiles.rows.len(), bins.tiles.columns.len());
    parallel_for(
        0..rows,
        1,
        work,
        &|(band, seen), rows, middle| {
            let (band, band_rest) = band.split_at((middle - rows.start) * TILE * width);
            let (seen, seen_rest) = bins.cut(seen, rows.start, middle, TileBins::batches);
            ((band, seen), (band_rest, seen_rest))
        },
        &|row, (mut band, mut seen)| {
            let mut empty = left * TILE; // start of the run of empty tiles that ends here
            for column in 0..columns {
                let t = row.start * columns + column;
                let range = bins.tile(t);
                let (own, rest) = bins.cut_tile(seen, t, TileBins::batches);
                seen = rest;
                let x = (left + column) * TILE;
                if range.is_empty() {
                    continue;
                }
                finish_empty(background, empty..x, width, &mut band);
                empty = x + TILE;
                let mut canvas = Canvas::new(width - x, band.pixels() / width);
                let origin = [x as f32, ((top + row.start) * TILE) as f32];
                let draw = if band.has_depth() { forward::<4> } else { forward::<3> };
                draw(
                    level,
                    projected,
                    &bins.pairs[range.start..],
                    range.len(),
                    origin,
                    &mut canvas,
                    own,
                );
                finish(&canvas, background, x, width, &mut band);
            }
            finish_empty(
                background,
                empty..((left + columns) * TILE).min(width),
                width,
                &mut band,
            );
        },
    );
}

/// Sums over the pixels of each pair of `bins` (`sums`: one a pair), from the image and its gradient; `seen` as
/// `blend_tiles` left it.
pub fn backward_tiles(
    level: SimdLevel,
    projected: &[Projected],
    bins: &TileBins,
    pixels: &Pixels,
    background: Background,
    seen: &[Hits],
    sums: &mut [Sums],
) {
    let cut = |sums, rows: &Range<usize>, middle| bins.cut(sums, rows.start, middle, TileBins::first);
    let (rows, columns) = (bins.tiles.rows.len(), bins.tiles.columns.len());
    parallel_for(0..rows, 1, sums, &cut, &|row, mut sums: &mut [Sums]| {
        for column in 0..columns {
            let t = row.start * columns + column;
            let (own, rest) = bins.cut_tile(sums, t, TileBins::first);
            sums = rest;
            if own.is_empty() {
                continue;
            }
            let (x, y) = (column * TILE, row.start * TILE);
            let (pairs, hits) = (&bins.pairs[bins.first(t)..], &seen[bins.batches(t)..]);
            let differentiate = if pixels.grad_depth.is_empty() {
                backward::<3>
            } else {
                backward::<4>
            };
            differentiate(level, projected, pairs, pixels, [x, y], background, hits, own);
        }
    });
}
