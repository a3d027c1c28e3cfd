//! Backward pass of one tile: for every Gaussian-tile pair, sums over its pixels, from which the gradient of the
//! Gaussian follows.
//!
//! Front to back, with the arithmetic of the forward pass, so that transmittances agree to the bit and nothing per
//! pixel has to be stored. With g the gradient of the pixel and D_i = g . rgb_i, dL/dalpha_i = T_i D_i - R_i / (1 -
//! alpha_i). The remainder R_i (everything behind Gaussian i, background included) starts as the whole pixel and loses
//! w_i D_i at each step.

use std::sync::atomic::AtomicU32;

use crate::adjoint::{Adjoint, Pixels};
use crate::constants::{ALPHA_MAX, LOG2_ALPHA_MIN, TRANSMITTANCE_STOP};
use crate::projected::Projected;
use crate::scene::Background;
use crate::simd::{Vector, c, dispatch};
use crate::tile::{BATCH, BLOCK, BLOCKS, Batch, Hits, Local, PIXEL_X, PIXEL_Y, Plane, opacities};

/// Sums over the pixels of a pair. With a = dL/dalpha * alpha (the gradient with respect to ln alpha) and w the
/// blending weight: a, a u, a v, a u^2, a u v, a v^2, w g (3), w times the gradient of depth; and the largest w.
///
/// One cache line, since they are gathered in random order.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub struct Sums(pub [f32; 12]);

/// Index of the largest weight, behind the sums; the last value is not used.
pub const LARGEST: usize = 10;

impl Sums {
    pub const ZERO: Sums = Sums([0.0; 12]);
}

/// A visit is one Gaussian on one block. Visits prepared together, not counting those of the last Gaussian.
const VISITS: usize = 64;
/// Visits whose exponentials are interleaved, which hides their latency.
const TOGETHER: usize = 4;
const ROOM: usize = VISITS + BLOCKS + TOGETHER;

/// Visits of consecutive Gaussians, front to back, and u, v and alpha on their pixels (0 where the Gaussian is not
/// drawn).
struct Visits {
    count: usize,
    splat: [u8; ROOM],
    block: [u8; ROOM],
    u: [[f32; BLOCK]; ROOM],
    v: [[f32; BLOCK]; ROOM],
    alpha: [[f32; BLOCK]; ROOM],
}

/// Set bits of a byte, lowest first.
static BITS: [[u8; 8]; 256] = {
    let mut table = [[0; 8]; 256];
    let mut i = 0;
    while i < 256 {
        let (mut n, mut bit) = (0, 0);
        while bit < 8 {
            if i >> bit & 1 == 1 {
                table[i][n] = bit;
                n += 1;
            }
            bit += 1;
        }
        i += 1;
    }
    table
};

impl Visits {
    fn new() -> Visits {
        let rows = [[0.0; BLOCK]; ROOM];
        Visits {
            count: 0,
            splat: [0; ROOM],
            block: [0; ROOM],
            u: rows,
            v: rows,
            alpha: rows,
        }
    }

    /// Appends the visits of a Gaussian, without branches: the number of blocks is unpredictable.
    #[inline(always)]
    fn push(&mut self, splat: usize, mask: u16) {
        let [low, high] = mask.to_le_bytes();
        let at = self.count.min(VISITS);
        let middle = at + low.count_ones() as usize;
        self.splat[at..at + BLOCKS].fill(splat as u8);
        self.block[at..at + 8].copy_from_slice(&BITS[usize::from(low)]);
        let high_blocks = u64::from_le_bytes(BITS[usize::from(high)]) + 0x0808_0808_0808_0808;
        self.block[middle..middle + 8].copy_from_slice(&high_blocks.to_le_bytes());
        self.count = middle + high.count_ones() as usize;
    }

    #[inline(always)]
    fn prepare<V: Vector>(&mut self, splats: &[Local; BATCH]) {
        let zero = c::<V>(0.0);
        for first in (0..self.count.min(ROOM - TOGETHER)).step_by(TOGETHER) {
            let four: [usize; TOGETHER] = std::array::from_fn(|i| first + i);
            let s = four.map(|i| &splats[usize::from(self.splat[i]) & (BATCH - 1)]);
            let b = four.map(|i| usize::from(self.block[i]) & (BLOCKS - 1));
            for at in (0..BLOCK).step_by(V::LANES) {
                let of = |plane: &Plane| b.map(|b| V::load(&plane.0[b][at..]));
                let [u, v, e, raw] = opacities(s, of(&PIXEL_X), of(&PIXEL_Y));
                for i in 0..TOGETHER {
                    u[i].store(&mut self.u[first + i][at..]);
                    v[i].store(&mut self.v[first + i][at..]);
                    let alpha = raw[i].min(c(ALPHA_MAX)).select(e[i].ge(c(LOG2_ALPHA_MIN)), zero);
                    alpha.store(&mut self.alpha[first + i][at..]);
                }
            }
        }
    }
}

struct Accumulator<V>([V; 12], V);

/// Adds one visit to the sums of its Gaussian.
#[inline(always)]
fn visit<V: Vector, const C: usize>(
    visits: &Visits,
    k: usize,
    at: usize,
    s: &Local,
    adjoint: &mut Adjoint,
    acc: &mut Accumulator<V>,
) {
    let zero = c::<V>(0.0);
    let b = usize::from(visits.block[k]) & (BLOCKS - 1);
    let t = V::load(&adjoint.transmittance.0[b][at..]);
    let remainder = V::load(&adjoint.remainder.0[b][at..]);
    let g: [V; C] = std::array::from_fn(|ch| V::load(&adjoint.channels[ch].0[b][at..]));
    let [u, v, alpha] = [&visits.u, &visits.v, &visits.alpha].map(|rows| V::load(&rows[k][at..]));
    let drawn = alpha * t;
    let next = t - drawn;
    let draw = next.ge(c(TRANSMITTANCE_STOP));
    let weight = drawn.select(draw, zero);
    // where `draw` is false, the pixel is finished now or was finished before
    next.select(draw, t.negative())
        .store(&mut adjoint.transmittance.0[b][at..]);
    let mut d = g[C - 1] * c(s.channels[C - 1]);
    for ch in (0..C - 1).rev() {
        d = g[ch].mul_add(c(s.channels[ch]), d);
    }
    let wd = weight * d;
    let rest = remainder - wd;
    rest.store(&mut adjoint.remainder.0[b][at..]);
    let odds = alpha * (c::<V>(1.0) - alpha).recip_fast();
    // the clamp at ALPHA_MAX stops the gradient
    let free = draw & alpha.lt(c(ALPHA_MAX));
    let a = odds.neg_mul_add(rest, wd).select(free, zero);
    let (au, av) = (a * u, a * v);
    let sums = &mut acc.0;
    sums[0] = sums[0] + a;
    sums[1] = sums[1] + au;
    sums[2] = sums[2] + av;
    sums[3] = au.mul_add(u, sums[3]);
    sums[4] = au.mul_add(v, sums[4]);
    sums[5] = av.mul_add(v, sums[5]);
    for ch in 0..3 {
        sums[6 + ch] = weight.mul_add(g[ch], sums[6 + ch]);
    }
    if C > 3 {
        sums[9] = weight.mul_add(g[3], sums[9]);
    }
    acc.1 = acc.1.max(weight);
}

/// Blocks on which each Gaussian of the batch was drawn: bit b of entry i is Gaussian i on block b.
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

/// `hits`: the `seen` masks of the forward pass for the batches of the tile; `sums` gets one row per pair. `C` as in
/// `blend`.
#[inline(always)]
fn backward_kernel<V: Vector, const C: usize>(
    projected: &[Projected],
    pairs: &[AtomicU32],
    pixels: &Pixels,
    at: [usize; 2],
    background: Background,
    hits: &[Hits],
    sums: &mut [Sums],
) {
    let (adjoint, origin) = (&mut pixels.adjoint(at, background), at.map(|v| v as f32));
    let mut batch = Batch::new();
    let mut visits = Visits::new();
    for (i, (hits, sums)) in hits.iter().zip(sums.chunks_mut(BATCH)).enumerate() {
        if hits.iter().all(|&h| h == 0) {
            sums.fill(Sums::ZERO);
            continue;
        }
        batch.fill(projected, &pairs[i * BATCH..], sums.len(), origin);
        let masks = transpose(hits);
        let mut first = 0;
        while first < sums.len() {
            visits.count = 0;
            let mut end = first;
            while end < sums.len() && visits.count <= VISITS {
                visits.push(end, masks[end]);
                end += 1;
            }
            visits.prepare::<V>(&batch.splats);
            let mut k = 0;
            for (j, out) in (first..end).zip(&mut sums[first..end]) {
                let mut acc = Accumulator([c::<V>(0.0); 12], c::<V>(0.0));
                let last = k + masks[j].count_ones() as usize;
                for k in k..last.min(ROOM) {
                    for at in (0..BLOCK).step_by(V::LANES) {
                        visit::<V, C>(&visits, k, at, &batch.splats[j], adjoint, &mut acc);
                    }
                }
                k = last;
                V::sum12(&acc.0, &mut out.0);
                out.0[LARGEST] = acc.1.max_lane();
            }
            first = end;
        }
    }
}
dispatch!(
    pub fn backward<const C: usize> = backward_kernel(
        projected: &[Projected],
        pairs: &[AtomicU32],
        pixels: &Pixels,
        at: [usize; 2],
        background: Background,
        hits: &[Hits],
        sums: &mut [Sums],
    )
);
