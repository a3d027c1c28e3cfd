//! Gradients of one tile: every pair gets the sums over its pixels that its Gaussian's gradient is made of.
//!
//! Front to back again, with the same arithmetic as the forward pass, so transmittances agree to the bit and nothing had to be
//! stored a pixel. With g the gradient of the pixel and D_i = g . rgb_i, dL/dalpha_i = T_i D_i - R_i / (1 - alpha_i), where the
//! remainder R_i (everything behind Gaussian i, background included) starts as the whole pixel and loses w_i D_i each step.

use std::sync::atomic::AtomicU32;

use crate::constants::{ALPHA_MAX, LOG2_ALPHA_MIN, TRANSMITTANCE_STOP};
use crate::project::Projected;
use crate::simd::{Vector, c, dispatch};
use crate::tile::{BATCH, BLOCK, Batch, Hits, Local, PIXEL_X, PIXEL_Y, Plane, opacities};

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

/// Adds a Gaussian's sums over N vectors of pixels, each the lanes `at ..` of a block.
#[inline(always)]
fn block_backward<V: Vector, const N: usize>(
    s: &Local,
    b: [usize; N],
    at: usize,
    adjoint: &mut Adjoint,
    acc: &mut Accumulator<V>,
) {
    let zero = c::<V>(0.0);
    let of = |plane: &Plane| b.map(|b| V::load(&plane.0[b & 15][at..]));
    let [u, v, e, raw] = opacities([s; N], of(&PIXEL_X), of(&PIXEL_Y));
    let (t, remainder) = (of(&adjoint.transmittance), of(&adjoint.remainder));
    let [red, green, blue] = [0, 1, 2].map(|ch| of(&adjoint.rgb[ch]));
    for i in 0..N {
        let alpha = raw[i].min(c(ALPHA_MAX));
        let next = alpha.neg_mul_add(t[i], t[i]);
        let hit = e[i].ge(c(LOG2_ALPHA_MIN));
        let draw = hit & next.ge(c(TRANSMITTANCE_STOP));
        // Not a select of the old value: that would become a masked store, whose result the next load has to wait for.
        let drawn_alpha = alpha.select(draw, zero);
        let sign = c::<V>(-0.0).select(hit & !draw, zero);
        let left = drawn_alpha.neg_mul_add(t[i], t[i]).or(sign);
        left.store(&mut adjoint.transmittance.0[b[i] & 15][at..]);

        let weight = drawn_alpha * t[i];
        let g = [red[i], green[i], blue[i]];
        let d = g[0].mul_add(c(s.rgb[0]), g[1].mul_add(c(s.rgb[1]), g[2] * c(s.rgb[2])));
        let wd = weight * d;
        let rest = remainder[i] - wd;
        rest.store(&mut adjoint.remainder.0[b[i] & 15][at..]);
        let odds = alpha * (c::<V>(1.0) - alpha).recip_fast();
        // the clamp at ALPHA_MAX stops the gradient
        let free = draw & c::<V>(ALPHA_MAX).ge(raw[i]);
        let a = odds.neg_mul_add(rest, wd).select(free, zero);
        let (au, av) = (a * u[i], a * v[i]);
        let sums = &mut acc.0;
        sums[0] = sums[0] + a;
        sums[1] = sums[1] + au;
        sums[2] = sums[2] + av;
        sums[3] = au.mul_add(u[i], sums[3]);
        sums[4] = au.mul_add(v[i], sums[4]);
        sums[5] = av.mul_add(v[i], sums[5]);
        for ch in 0..3 {
            sums[6 + ch] = weight.mul_add(g[ch], sums[6 + ch]);
        }
        sums[9] = sums[9] + weight;
        acc.1 = acc.1.max(weight);
    }
}

/// On which blocks each Gaussian of the batch was drawn: bit b of entry i is Gaussian i on block b.
#[inline(always)]
fn transpose(hits: &Hits) -> [u16; BATCH] {
    let mut masks = [0; BATCH];
    for (b, &hits) in hits.iter().enumerate() {
        let mut rest = hits;
        while rest != 0 {
            masks[rest.trailing_zeros() as usize & (BATCH - 1)] |= 1 << b;
            rest &= rest - 1;
        }
    }
    masks
}

/// `hits` are those that the forward pass left for the batches of the tile; `sums` gets one row a pair.
#[inline(always)]
fn backward_kernel<V: Vector>(
    projected: &[Projected],
    pairs: &[AtomicU32],
    origin: [f32; 2],
    hits: &[Hits],
    adjoint: &mut Adjoint,
    sums: &mut [Sums],
) {
    let mut batch = Batch::new();
    for (i, (hits, sums)) in hits.iter().zip(sums.chunks_mut(BATCH)).enumerate() {
        batch.fill(projected, &pairs[i * BATCH..], sums.len(), origin);
        for ((splat, mask), out) in batch.splats.iter().zip(transpose(hits)).zip(sums) {
            if mask == 0 {
                *out = Sums::ZERO;
                continue;
            }
            let mut acc = Accumulator([c::<V>(0.0); 12], c::<V>(0.0));
            let mut rest = mask;
            while rest & (rest - 1) != 0 {
                let first = rest.trailing_zeros() as usize;
                rest &= rest - 1;
                let both = [first, rest.trailing_zeros() as usize];
                rest &= rest - 1;
                for at in (0..BLOCK).step_by(V::LANES) {
                    block_backward::<V, 2>(splat, both, at, adjoint, &mut acc);
                }
                if rest == 0 {
                    break;
                }
            }
            if rest != 0 {
                for at in (0..BLOCK).step_by(V::LANES) {
                    block_backward::<V, 1>(splat, [rest.trailing_zeros() as usize], at, adjoint, &mut acc);
                }
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
        hits: &[Hits],
        adjoint: &mut Adjoint,
        sums: &mut [Sums],
    )
);
