//! Blending of one tile, front to back. A pixel's transmittance turns negative when the pixel is finished: its magnitude stays
//! the final transmittance and every later test on it fails, so that "finished" needs no mask of its own.

use std::sync::atomic::AtomicU32;

use crate::bin::TILE;
use crate::constants::{ALPHA_MAX, LOG2_ALPHA_MIN, TRANSMITTANCE_STOP};
use crate::project::{CHUNK, Projected};
use crate::simd::{Vector, c, dispatch};
use crate::tile::{BLOCK, Batch, PIXEL_X, PIXEL_Y, Plane, swizzle};

/// A tile while it is drawn.
pub struct Canvas {
    pub transmittance: Plane,
    pub rgb: [Plane; 3],
    /// Blocks with unfinished pixels.
    pub live: u16,
}

impl Canvas {
    /// A tile of which width x height pixels are inside of the image.
    pub fn new(width: usize, height: usize) -> Canvas {
        let mut canvas = Canvas {
            transmittance: Plane::ZERO,
            rgb: [Plane::ZERO; 3],
            live: 0,
        };
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

/// Adds one Gaussian to one block; false: all pixels of the block are finished.
#[inline(always)]
fn blend_block<V: Vector>(s: &Projected, b: usize, canvas: &mut Canvas) -> bool {
    let [red, green, blue] = &mut canvas.rgb;
    let (t_row, px, py) = (
        &mut canvas.transmittance.0[b & 15],
        &PIXEL_X.0[b & 15],
        &PIXEL_Y.0[b & 15],
    );
    let rows = [&mut red.0[b & 15], &mut green.0[b & 15], &mut blue.0[b & 15]];
    let mut open = false;
    for at in (0..BLOCK).step_by(V::LANES) {
        let dx = V::load(&px[at..]) - c(s.x);
        let dy = V::load(&py[at..]) - c(s.y);
        let u = dx.mul_add(c(s.l11), dy * c(s.l21));
        let v = dy * c(s.l22);
        let e = v.neg_mul_add(v, u.neg_mul_add(u, c(s.log2_opacity)));
        let alpha = e.exp2().min(c(ALPHA_MAX));
        let t = V::load(&t_row[at..]);
        let next = alpha.neg_mul_add(t, t);
        let hit = e.ge(c(LOG2_ALPHA_MIN));
        let draw = hit & next.ge(c(TRANSMITTANCE_STOP));
        let weight = (alpha * t).select(draw, c(0.0));
        for ch in 0..3 {
            weight
                .mul_add(c(s.rgb[ch]), V::load(&rows[ch][at..]))
                .store(&mut rows[ch][at..]);
        }
        let t = next.select(draw, t.min(-t).select(hit, t));
        t.store(&mut t_row[at..]);
        open |= V::any(c::<V>(0.0).lt(t));
    }
    open
}

/// Draws the pairs onto the canvas and leaves in `masks` the blocks that each Gaussian was drawn on, for the backward pass.
#[inline(always)]
fn forward_kernel<V: Vector>(
    projected: &[Projected],
    pairs: &[AtomicU32],
    origin: [f32; 2],
    canvas: &mut Canvas,
    masks: &mut [u16],
) {
    let mut batch = Batch::new();
    let mut hits = [0u16; CHUNK];
    masks.fill(0);
    for (i, chunk) in pairs.chunks(CHUNK).enumerate() {
        batch.fill(projected, chunk, origin);
        batch.masks::<V>(&mut hits);
        for (lane, splat) in batch.splats[..chunk.len()].iter().enumerate() {
            let drawn = hits[lane] & canvas.live;
            let mut rest = drawn;
            while rest != 0 {
                let b = rest.trailing_zeros();
                rest &= rest - 1;
                if !blend_block::<V>(splat, b as usize, canvas) {
                    canvas.live &= !(1 << b);
                }
            }
            if let Some(mask) = masks.get_mut(i * CHUNK + lane) {
                *mask = drawn;
            }
        }
        if canvas.live == 0 {
            return;
        }
    }
}
dispatch!(
    pub fn forward = forward_kernel(
        projected: &[Projected],
        pairs: &[AtomicU32],
        origin: [f32; 2],
        canvas: &mut Canvas,
        masks: &mut [u16],
    )
);
