//! Alpha blending of one tile, front to back: the Gaussian-tile pairs of the tile -> colour and transmittance per
//! pixel, and depth where a loss asks for it.
//!
//! The transmittance of a finished pixel is negated: its magnitude stays the final transmittance, and every later test
//! on it fails, so no mask of finished pixels is needed.

use std::sync::atomic::AtomicU32;

use crate::constants::{ALPHA_MAX, LOG2_ALPHA_MIN, TRANSMITTANCE_STOP};
use crate::projected::{Projected, TILE};
use crate::simd::{Vector, c, dispatch};
use crate::tile::{BATCH, BLOCK, BLOCKS, Batch, Hits, PIXEL_X, PIXEL_Y, Plane, opacities, swizzle};

/// Colour, depth and transmittance of a tile during blending.
pub struct Canvas {
    pub transmittance: Plane,
    /// Red, green, blue and depth, weighted sums.
    pub channels: [Plane; 4],
    /// Blocks with unfinished pixels.
    pub live: u16,
}

impl Canvas {
    /// A tile whose first `width` x `height` pixels are inside the image.
    pub fn new(width: usize, height: usize) -> Canvas {
        let mut canvas = Canvas {
            transmittance: Plane::ZERO,
            channels: [Plane::ZERO; 4],
            live: 0,
        };
        if width >= TILE && height >= TILE {
            canvas.transmittance = Plane([[1.0; BLOCK]; BLOCKS]);
            canvas.live = u16::MAX;
            return canvas;
        }
        for y in 0..height.min(TILE) {
            for x in 0..width.min(TILE) {
                let (b, k) = swizzle(x, y);
                canvas.transmittance.0[b][k] = 1.0;
                canvas.live |= 1 << b;
            }
        }
        canvas
    }
}

/// Blends the Gaussians of the batch whose bit in `hits` is set onto one vector of pixels. Returns the bits of those
/// that were visited before all pixels were finished, and whether any pixel is unfinished. `C` = 3: colours; 4: and
/// depth.
#[inline(always)]
fn blend<V: Vector, const C: usize>(batch: &Batch, hits: u64, b: usize, at: usize, canvas: &mut Canvas) -> (u64, bool) {
    let t_row = &mut canvas.transmittance.0[b & 15][at..];
    let (px, py) = (V::load(&PIXEL_X.0[b & 15][at..]), V::load(&PIXEL_Y.0[b & 15][at..]));
    let mut t = V::load(t_row);
    let mut sums: [V; C] = std::array::from_fn(|ch| V::load(&canvas.channels[ch].0[b & 15][at..]));
    let mut rest = hits;
    while rest != 0 {
        let splats = batch.take(&mut rest);
        let [_, _, e, raw] = opacities(splats, [px; 2], [py; 2]);
        for ((s, e), raw) in splats.into_iter().zip(e).zip(raw) {
            let alpha = raw.min(c(ALPHA_MAX));
            let drawn = alpha * t;
            let next = t - drawn;
            let hit = e.ge(c(LOG2_ALPHA_MIN));
            let draw = hit & next.ge(c(TRANSMITTANCE_STOP));
            let weight = drawn.select(draw, c(0.0));
            for ch in 0..C {
                sums[ch] = weight.mul_add(c(s.channels[ch]), sums[ch]);
            }
            t = next.select(draw, t.negative().select(hit, t));
        }
        if !V::any(c::<V>(0.0).lt(t)) {
            break;
        }
    }
    t.store(t_row);
    for ch in 0..C {
        sums[ch].store(&mut canvas.channels[ch].0[b & 15][at..]);
    }
    (hits & !rest, V::any(c::<V>(0.0).lt(t)))
}

/// Blends the first `count` pairs onto the canvas. `seen` gets, for each batch, the masks of Gaussians drawn on each
/// block, for the backward pass; it is empty without one.
#[inline(always)]
fn forward_kernel<V: Vector, const C: usize>(
    projected: &[Projected],
    pairs: &[AtomicU32],
    count: usize,
    origin: [f32; 2],
    canvas: &mut Canvas,
    seen: &mut [Hits],
) {
    let mut batch = Batch::new();
    seen.fill([0; BLOCKS]);
    for first in (0..count).step_by(BATCH) {
        let n = (count - first).min(BATCH);
        batch.fill(projected, &pairs[first..], n, origin);
        let hits = batch.hits::<V>(n);
        let mut live = canvas.live;
        while live != 0 {
            let b = live.trailing_zeros() as usize;
            live &= live - 1;
            let (mut visited, mut open) = (0, false);
            for at in (0..BLOCK).step_by(V::LANES) {
                let (s, o) = blend::<V, C>(&batch, hits[b], b, at, canvas);
                visited |= s;
                open |= o;
            }
            if !open {
                canvas.live &= !(1 << b);
            }
            if let Some(seen) = seen.get_mut(first / BATCH) {
                seen[b] = visited;
            }
        }
        if canvas.live == 0 {
            return;
        }
    }
}
dispatch!(
    pub fn forward<const C: usize> = forward_kernel(
        projected: &[Projected],
        pairs: &[AtomicU32],
        count: usize,
        origin: [f32; 2],
        canvas: &mut Canvas,
        seen: &mut [Hits],
    )
);
