//! Dequantization (spec 13.1): integers of channels -> values, and integers of quats -> quaternions.
//!
//! A rotation is coded as a residual relative to the rotation of the nearest neighbour before it, since neighbours on a
//! smooth surface have similar axes. The steps of the residual depend on the scales: a rotation displaces a long
//! Gaussian more than a short one.

use crate::attributes::Attribute;
use crate::companding::{Companding, CompandingTable};
use crate::header::{Header, SCALE_EXPONENT_UNIT};
use crate::neighbors::Near;
use rayon::prelude::*;

pub type Quat = [f32; 4]; // wxyz
pub const IDENTITY: Quat = [1.0, 0.0, 0.0, 0.0];
const RUN: usize = 2048; // Gaussians of one task
const BLOCK: usize = 512; // residuals refer to neighbours of the same block, so that f32 is precise enough

/// offset + step * integer, expanded where the channel is companded, + shift: C per Gaussian. Empty if the header lacks
/// the attribute.
///
/// `shift`: the correction for the layers that are not decoded (spec 10.2).
pub fn values(h: &Header, a: Attribute, integers: &[i32], shift: f32) -> Vec<f32> {
    let at = h.attributes().iter().position(|b| *b == a);
    let Some(scale) = at.and_then(|k| h.scales.get(k)) else {
        return Vec::new();
    };
    let scales: Vec<(f32, f32)> = scale.steps.iter().copied().zip(scale.offsets.iter().copied()).collect();
    let companding: Vec<CompandingTable> = h.companding_of(a).iter().map(Companding::table).collect();
    let mut out = vec![0.0; integers.len()];
    let channels = scales.len().max(1);
    let rows = RUN * channels;
    out.par_chunks_mut(rows)
        .zip(integers.par_chunks(rows))
        .for_each(|(out, integers)| {
            for (out, row) in out.chunks_mut(channels).zip(integers.chunks(channels)) {
                for ((out, v), (step, offset)) in out.iter_mut().zip(row).zip(&scales) {
                    *out = offset + step * *v as f32;
                }
                out.iter_mut()
                    .zip(&companding)
                    .for_each(|(v, table)| *v = table.expand(*v));
                out.iter_mut().for_each(|v| *v += shift);
            }
        });
    out
}

/// Steps of the rotation residual of a Gaussian, by its decoded log_scales; at most 1.
#[inline]
fn rotation_steps(h: &Header, own: &[f32], log_scales: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|c| {
        let fall: f32 = (0..3)
            .map(|j| f32::from(h.scale_exponents[c][j]) / SCALE_EXPONENT_UNIT * log_scales[j])
            .sum();
        (own.get(c).unwrap_or(&0.0) * (-fall).clamp(-64.0, 64.0).exp2()).min(1.0)
    })
}

/// Quaternions of the births of a layer, 3 integers each.
///
/// # Arguments
/// * `log_scales`: integers of that attribute, 3 per Gaussian.
/// * `near`: context neighbours of each Gaussian.
pub fn rotations(h: &Header, integers: &[i32], log_scales: &[i32], near: &[Near]) -> Vec<Quat> {
    let sizes = values(h, Attribute::LogScales, log_scales, 0.0);
    let at = h.attributes().iter().position(|a| *a == Attribute::Quats);
    let Some(scale) = at.and_then(|k| h.scales.get(k)) else {
        return Vec::new();
    };
    let (integers, sizes) = (integers.as_chunks::<3>().0, sizes.as_chunks::<3>().0);
    let mut out = Vec::with_capacity(near.len());
    for (i, ((k, sizes), near)) in integers.iter().zip(sizes).zip(near).enumerate() {
        let step = rotation_steps(h, &scale.steps, *sizes);
        let halves = std::array::from_fn(|c| scale.offsets.get(c).unwrap_or(&0.0) + step[c] * k[c] as f32);
        out.push(multiply(before(&out, i, near), rotation_residual(halves)));
    }
    out
}

/// The prediction of Gaussian `i`: the quaternion of its nearest neighbour, if that is in the same block, else the
/// identity. `done`: the quaternions before `i`.
#[inline]
pub fn before(done: &[Quat], i: usize, near: &Near) -> Quat {
    let j = near[0] as usize;
    let known = done.get(j).filter(|_| j >= i - i % BLOCK);
    known.copied().unwrap_or(IDENTITY)
}

/// Product of rotations about the third, then the second, then the first axis; `halves`: the sines of half their
/// angles.
#[inline]
pub fn rotation_residual(halves: [f32; 3]) -> Quat {
    let [x, y, z] = halves.map(|v| v.clamp(-1.0, 1.0));
    let [a, b, c] = [x, y, z].map(|v| (1.0 - v * v).sqrt());
    // (c, 0, 0, z) (b, 0, y, 0) (a, x, 0, 0)
    let [w, i, j, k] = [c * b, -z * y, c * y, z * b];
    [w * a - i * x, w * x + i * a, j * a + k * x, k * a - j * x]
}

/// Hamilton product.
#[inline]
pub fn multiply([aw, ax, ay, az]: Quat, [bw, bx, by, bz]: Quat) -> Quat {
    let sum = plus([0.0; 4], aw, [bw, bx, by, bz]);
    let sum = plus(sum, ax, [-bx, bw, -bz, by]);
    let sum = plus(sum, ay, [-by, bz, bw, -bx]);
    plus(sum, az, [-bz, -by, bx, bw])
}

/// a + w b
#[inline]
pub fn plus(a: [f32; 4], w: f32, b: [f32; 4]) -> [f32; 4] {
    std::array::from_fn(|i| a[i] + w * b[i])
}
