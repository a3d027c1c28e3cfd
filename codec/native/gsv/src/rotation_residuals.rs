//! Quantization of rotation residuals (spec 13.1): quaternions -> the integers of quats, by rate-distortion cost. The
//! mirror of `dequantize::rotations`.
//!
//! Each residual refers to the decoded quaternion of the neighbour, so errors do not accumulate. A Gaussian with sorted
//! axes has four equivalent quaternions (forms); the one with the smallest residual is coded.

use crate::dequantize::{Quat, before, multiply, rotation_residual};
use crate::neighbors::Near;
use crate::values::NEAR_WEIGHT;

/// Integers and contexts beyond +-RANGE share their statistics.
pub const RANGE: i32 = 15;
/// Integers with a code length of their own.
pub const SIDE: usize = 2 * RANGE as usize + 1;

/// The births of a layer, to be quantized.
pub struct RotationResiduals<'a> {
    pub quats: &'a [Quat],
    /// Steps of the three integers of each Gaussian.
    pub steps: &'a [[f32; 3]],
    /// Cost in bits of an error of one step; an error of x steps costs x^2 times as much.
    pub error_bits: &'a [[f32; 3]],
    /// Code lengths in bits: [3, SIDE, SIDE] by channel, context, integer. Empty: all integers cost the same.
    pub lengths: &'a [f32],
}

/// The residual of one Gaussian.
pub struct QuantizedRotation {
    pub integers: [i32; 3],
    /// The form: 0 to 3, the quaternion was multiplied from the right by the inverse of 1, i, j or k.
    pub form: u8,
}

impl RotationResiduals<'_> {
    /// Quantizes all residuals in order. `near`: context neighbours of each Gaussian.
    pub fn quantize(&self, near: &[Near]) -> Vec<QuantizedRotation> {
        let mut out: Vec<QuantizedRotation> = Vec::with_capacity(self.quats.len());
        let mut decoded = Vec::with_capacity(self.quats.len());
        for (i, (q, near)) in self.quats.iter().zip(near).enumerate() {
            let before = before(&decoded, i, near);
            let (form, q) = least(multiply(inverse(before), *q));
            let v = halves(q);
            let step = self.steps[i];
            let integers = std::array::from_fn(|c| {
                let around = near.iter().zip(NEAR_WEIGHT);
                let (mut sum, mut weight) = (0, 0);
                for (own, w) in around.filter_map(|(j, w)| Some((out.get(*j as usize)?, w))) {
                    sum += w * own.integers[c];
                    weight += w;
                }
                let context = (sum as f32 / weight.max(1) as f32).round_ties_even() as i32;
                self.choose(c, v[c] / step[c], self.error_bits[i][c], context.clamp(-RANGE, RANGE))
            });
            let rounded = std::array::from_fn(|c| step[c] * integers[c] as f32);
            decoded.push(multiply(before, rotation_residual(rounded)));
            out.push(QuantizedRotation { integers, form });
        }
        out
    }

    /// The integer for `x` (in steps) of channel `c` with the least cost: error plus code length.
    fn choose(&self, c: usize, x: f32, error_bits: f32, context: i32) -> i32 {
        let nearest = x.round_ties_even() as i32;
        let row = (c * SIDE + (context + RANGE) as usize) * SIDE;
        let Some(lengths) = self.lengths.get(row..row + SIDE) else {
            return nearest;
        };
        let cost = |k: &i32| {
            let off = x - *k as f32;
            let beyond = (k.abs() - RANGE).max(0) as f32;
            error_bits * off * off + lengths[(k.clamp(&-RANGE, &RANGE) + RANGE) as usize] + 2.0 * (1.0 + beyond).log2()
        };
        let toward = nearest + (context - nearest).signum();
        let candidates = [nearest, toward, nearest - nearest.signum(), context, 0];
        let least = candidates.into_iter().min_by(|a, b| cost(a).total_cmp(&cost(b)));
        least.unwrap_or(nearest)
    }
}

/// The mirror of `rotation_residual`: the sines of half the three angles.
fn halves([w, x, y, z]: Quat) -> [f32; 3] {
    let first = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
    let second = (2.0 * (w * y - z * x)).clamp(-1.0, 1.0).asin();
    let third = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    [first, second, third].map(|angle| (angle / 2.0).sin())
}

fn inverse([w, x, y, z]: Quat) -> Quat {
    [w, -x, -y, -z]
}

/// The form of `q` with the largest real part, which is the smallest rotation: its number and quaternion.
fn least(q: Quat) -> (u8, Quat) {
    let form = (0..4).max_by(|a, b| q[*a].abs().total_cmp(&q[*b].abs())).unwrap_or(0);
    let mut unit = [0.0; 4];
    unit[form] = 1.0;
    let turned = multiply(q, inverse(unit));
    let sign = 1f32.copysign(turned[0]);
    (form as u8, turned.map(|v| sign * v))
}
