//! Gradients of one tile: every pair gets the sums over its pixels that its Gaussian's gradient is made of.
//!
//! Front to back again, with the same arithmetic as the forward pass, so transmittances agree to the bit and nothing had to be
//! stored a pixel. With g the gradient of the pixel and D_i = g . rgb_i, dL/dalpha_i = T_i D_i - R_i / (1 - alpha_i), where the
//! remainder R_i (everything behind Gaussian i, background included) starts as the whole pixel and loses w_i D_i each step.

use std::sync::atomic::AtomicU32;

use crate::constants::{ALPHA_MAX, LOG2_ALPHA_MIN, TRANSMITTANCE_STOP};
use crate::project::Projected;
use crate::simd::{Vector, c, dispatch};
use crate::tile::{BATCH, BLOCK, Batch, Local, PIXEL_X, PIXEL_Y, Plane};

/// Sums over the pixels of a pair. With a = dL/dalpha * alpha (the gradient by ln alpha) and w the blending weight:
/// a, a u, a v, a u^2, a u v, a v^2, w g (3), w, largest w, unused.
///
/// One cache line, since they are gathered in random order.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub struct Sums(pub [f32; 12]);

impl Sums {
    pub const ZERO: Sums = Sums([0.0; 12]);
}

/// State of the pixels of a tile.
pub struct Adjoint {
    /// Starts at 1 (0 outside of the image).
    pub transmittance: Plane,
    pub remainder: Plane,
    /// Gradient by the blended colours.
    pub rgb: [Plane; 3],
}

struct Accumulator<V>([V; 12], V);

#[inline(always)]
fn block_backward<V: Vector>(s: &Local, b: usize, adjoint: &mut Adjoint, acc: &mut Accumulator<V>) {
    let [red, green, blue] = &adjoint.rgb;
    let g_rows = [&red.0[b & 15], &green.0[b & 15], &blue.0[b & 15]];
    let (t_row, r_row) = (&mut adjoint.transmittance.0[b & 15], &mut adjoint.remainder.0[b & 15]);
    let (px, py) = (&PIXEL_X.0[b & 15], &PIXEL_Y.0[b & 15]);
    for at in (0..BLOCK).step_by(V::LANES) {
        let zero = c::<V>(0.0);
        let (x, y) = (V::load(&px[at..]), V::load(&py[at..]));
        let u = x.mul_add(c(s.l11), y.mul_add(c(s.l21), c(s.u0)));
        let v = y.mul_add(c(s.l22), c(s.v0));
        let e = v.neg_mul_add(v, u.neg_mul_add(u, c(s.log2_opacity)));
        let raw = e.exp2();
        let alpha = raw.min(c(ALPHA_MAX));
        let t = V::load(&t_row[at..]);
        let next = alpha.neg_mul_add(t, t);
        let hit = e.ge(c(LOG2_ALPHA_MIN));
        let draw = hit & next.ge(c(TRANSMITTANCE_STOP));
        // Not a select of the old value: that would become a masked store, whose result the next load has to wait for.
        let drawn_alpha = alpha.select(draw, zero);
        let sign = c::<V>(-0.0).select(hit & !draw, zero);
        drawn_alpha.neg_mul_add(t, t).or(sign).store(&mut t_row[at..]);

        let weight = drawn_alpha * t;
        let g = [
            V::load(&g_rows[0][at..]),
            V::load(&g_rows[1][at..]),
            V::load(&g_rows[2][at..]),
        ];
        let d = g[0].mul_add(c(s.rgb[0]), g[1].mul_add(c(s.rgb[1]), g[2] * c(s.rgb[2])));
        let wd = weight * d;
        let rest = V::load(&r_row[at..]) - wd;
        rest.store(&mut r_row[at..]);
        let odds = alpha * (c::<V>(1.0) - alpha).recip_fast();
        // the clamp at ALPHA_MAX stops the gradient
        let a = odds
            .neg_mul_add(rest, wd)
            .select(draw & c::<V>(ALPHA_MAX).ge(raw), zero);
        let (au, av) = (a * u, a * v);
        let sums = &mut acc.0;
        sums[0] = sums[0] + a;
        sums[1] = sums[1] + au;
        sums[2] = sums[2] + av;
        sums[3] = au.mul_add(u, sums[3]);
        sums[4] = au.mul_add(v, sums[4]);
        sums[5] = av.mul_add(v, sums[5]);
        sums[6] = weight.mul_add(g[0], sums[6]);
        sums[7] = weight.mul_add(g[1], sums[7]);
        sums[8] = weight.mul_add(g[2], sums[8]);
        sums[9] = sums[9] + weight;
        acc.1 = acc.1.max(weight);
    }
}

/// `masks` are those that the forward pass left for the pairs of the tile; `sums` gets one row a pair.
#[inline(always)]
fn backward_kernel<V: Vector>(
    projected: &[Projected],
    pairs: &[AtomicU32],
    origin: [f32; 2],
    masks: &[u16],
    adjoint: &mut Adjoint,
    sums: &mut [Sums],
) {
    let mut batch = Batch::new();
    for (i, (masks, sums)) in masks.chunks(BATCH).zip(sums.chunks_mut(BATCH)).enumerate() {
        batch.fill(projected, &pairs[i * BATCH..], masks.len(), origin);
        for ((splat, &mask), out) in batch.splats.iter().zip(masks).zip(sums) {
            if mask == 0 {
                *out = Sums::ZERO;
                continue;
            }
            let mut acc = Accumulator([c::<V>(0.0); 12], c::<V>(0.0));
            let mut rest = mask;
            while rest != 0 {
                block_backward::<V>(splat, rest.trailing_zeros() as usize, adjoint, &mut acc);
                rest &= rest - 1;
            }
            V::sum12(&acc.0, &mut out.0);
            out.0[10] = acc.1.max_lane();
        }
    }
}
dispatch!(
    pub fn backward = backward_kernel(
        projected: &[Projected],
        pairs: &[AtomicU32],
        origin: [f32; 2],
        masks: &[u16],
        adjoint: &mut Adjoint,
        sums: &mut [Sums],
    )
);
