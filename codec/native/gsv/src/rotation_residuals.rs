//! Quaternions -> the integers of quats (spec 13.1), by what they and their bits are worth. The mirror of `dequantize::rotations`.
//!
//! Each turn is taken from the decoded quaternion of the neighbour, so errors do not add up. Of the four forms of a Gaussian
//! whose axes are sorted, the one that turns least is coded.

use crate::dequantize::{Quat, before, multiply, turn};
use crate::neighbors::Near;
use crate::values::NEAR_WEIGHT;

/// Integers and contexts beyond are counted together.
pub const RANGE: i32 = 15;
/// Integers that code lengths tell apart.
pub const SIDE: usize = 2 * RANGE as usize + 1;

/// Gaussians to be coded: of each its quaternion, the steps of its three integers, and what an error of a step is worth, in bits,
/// squared.
pub struct RotationResiduals<'a> {
    pub quats: &'a [Quat],
    pub steps: &'a [[f32; 3]],
    pub worth: &'a [[f32; 3]],
    /// Bits of an integer (last) in a context, for each channel: 3 * SIDE * SIDE. Empty: all cost the same.
    pub lengths: &'a [f32],
}

/// A Gaussian as it is coded.
pub struct QuantizedRotation {
    pub integers: [i32; 3],
    /// Of 1, i, j, k the one whose inverse the quaternion was multiplied by from the right.
    pub form: u8,
}

impl RotationResiduals<'_> {
    /// What each Gaussian is coded as. `near`: neighbours of each.
    pub fn code(&self, near: &[Near]) -> Vec<QuantizedRotation> {
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
                self.choose(c, v[c] / step[c], self.worth[i][c], context.clamp(-RANGE, RANGE))
            });
            let rounded = std::array::from_fn(|c| step[c] * integers[c] as f32);
            decoded.push(multiply(before, turn(rounded)));
            out.push(QuantizedRotation { integers, form });
        }
        out
    }

    /// The integer for `x` of channel `c` that costs least: error and bits.
    fn choose(&self, c: usize, x: f32, worth: f32, context: i32) -> i32 {
        let nearest = x.round_ties_even() as i32;
        let row = (c * SIDE + (context + RANGE) as usize) * SIDE;
        let Some(lengths) = self.lengths.get(row..row + SIDE) else {
            return nearest;
        };
        let cost = |k: &i32| {
            let off = x - *k as f32;
            let beyond = (k.abs() - RANGE).max(0) as f32;
            worth * off * off + lengths[(k.clamp(&-RANGE, &RANGE) + RANGE) as usize] + 2.0 * (1.0 + beyond).log2()
        };
        let toward = nearest + (context - nearest).signum();
        let candidates = [nearest, toward, nearest - nearest.signum(), context, 0];
        let least = candidates.into_iter().min_by(|a, b| cost(a).total_cmp(&cost(b)));
        least.unwrap_or(nearest)
    }
}

/// What `turn` makes `q` of.
fn halves([w, x, y, z]: Quat) -> [f32; 3] {
    let first = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
    let second = (2.0 * (w * y - z * x)).clamp(-1.0, 1.0).asin();
    let third = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    [first, second, third].map(|angle| (angle / 2.0).sin())
}

fn inverse([w, x, y, z]: Quat) -> Quat {
    [w, -x, -y, -z]
}

/// The form of `q` with the largest real part, and which it is.
fn least(q: Quat) -> (u8, Quat) {
    let form = (0..4).max_by(|a, b| q[*a].abs().total_cmp(&q[*b].abs())).unwrap_or(0);
    let mut unit = [0.0; 4];
    unit[form] = 1.0;
    let turned = multiply(q, inverse(unit));
    let sign = 1f32.copysign(turned[0]);
    (form as u8, turned.map(|v| sign * v))
}
