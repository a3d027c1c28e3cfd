//! Rigid motions of nodes, blended over the Gaussians that they carry (spec 13.3), and the gradient of the blend.
//!
//! In: poses of the nodes at one frame, neighbours and weights. Out: carried position and rotation of each Gaussian.
//! The player, the encoder's reconstruction and training share this code; only training needs the gradient.

use crate::blend::Blend;
use crate::dequantize::{Quat, plus};
use rayon::prelude::*;

/// Motion of one node: x -> R x + s as the columns of R and s, then the quaternion of R. Each row has four numbers, so
/// that a blend is a weighted sum of registers.
pub type Pose = [[f32; 4]; 5];
pub const REST: Pose = [
    [1.0, 0.0, 0.0, 0.0],
    [0.0, 1.0, 0.0, 0.0],
    [0.0, 0.0, 1.0, 0.0],
    [0.0; 4],
    [1.0, 0.0, 0.0, 0.0],
];
/// Gaussians of one task.
const RUN: usize = 2048;
/// Below this length a blended quaternion has no direction.
const LEAST_LENGTH: f32 = 1e-12;

/// The pose that rotates by `q` about `centre` and then moves by `shift`.
pub fn pose(q: Quat, centre: [f32; 3], shift: [f32; 3]) -> Pose {
    let mut p = REST;
    for (a, row) in matrix(q).into_iter().enumerate() {
        (0..3).for_each(|b| p[b][a] = row[b]);
        p[3][a] = centre[a] + shift[a] - (0..3).map(|b| row[b] * centre[b]).sum::<f32>();
    }
    p[4] = q;
    p
}

/// The poses of all nodes at one frame.
pub struct RigidBlend {
    poses: Vec<Pose>,
    /// No two quaternions of `poses` are more than a right angle apart.
    aligned: bool,
}

impl RigidBlend {
    pub fn new(poses: Vec<Pose>) -> RigidBlend {
        let near = |p: &Pose| p[4][0] > std::f32::consts::FRAC_1_SQRT_2; // within 45 degrees of 1 (in 4D)
        let aligned = poses.iter().all(near);
        RigidBlend { poses, aligned }
    }

    /// Carries Gaussians: writes the results of `finish(index, carried position, rotation)`.
    ///
    /// # Arguments
    /// * `rest`: rest positions; `out`: means and rotations; `blend` has one row for each.
    pub fn carry(
        &self,
        blend: &Blend,
        rest: &[[f32; 3]],
        out: (&mut [[f32; 3]], &mut [Quat]),
        finish: impl Fn(usize, [f32; 3], Quat) -> ([f32; 3], Quat) + Sync,
    ) {
        let per = blend.per.max(1);
        let rows = blend
            .index
            .par_chunks(RUN * per)
            .zip(blend.weight.par_chunks(RUN * per));
        let out = out.0.par_chunks_mut(RUN).zip(out.1.par_chunks_mut(RUN));
        let runs = out.zip(rest.par_chunks(RUN)).zip(rows).enumerate();
        runs.for_each(|(run, (((means, quats), rest), (index, weight)))| {
            let out = means.iter_mut().zip(quats).zip(rest).zip(run * RUN..);
            if per == 4 {
                let rows = index.as_chunks::<4>().0.iter().zip(weight.as_chunks::<4>().0);
                for ((((m, q), x), i), (index, weight)) in out.zip(rows) {
                    let (moved, rotation) = self.blended(*x, index, weight);
                    (*m, *q) = finish(i, moved, rotation);
                }
            } else {
                let rows = index.chunks(per).zip(weight.chunks(per));
                for ((((m, q), x), i), (index, weight)) in out.zip(rows) {
                    let (moved, rotation) = self.blended(*x, index, weight);
                    (*m, *q) = finish(i, moved, rotation);
                }
            }
        });
    }

    #[inline(always)]
    fn sum(&self, index: &[u32], weight: &[f32]) -> Pose {
        let pose = |j: &u32| self.poses.get(*j as usize).unwrap_or(&REST);
        let first = index.first().map_or(&REST, pose);
        let mut sum: Pose = [[0.0; 4]; 5];
        for (p, w) in index.iter().map(pose).zip(weight) {
            sum.iter_mut().zip(p).for_each(|(s, p)| *s = plus(*s, *w, *p));
            if !self.aligned && dot(p[4], first[4]) < 0.0 {
                sum[4] = plus(sum[4], -2.0 * w, p[4]);
            }
        }
        sum
    }

    /// Carried position of one point, and its rotation. `index`, `weight`: a row of a blend.
    #[inline(never)]
    pub fn carry_one(&self, x: [f32; 3], index: &[u32], weight: &[f32]) -> ([f32; 3], Quat) {
        self.blended(x, index, weight)
    }

    #[inline(always)]
    fn blended(&self, x: [f32; 3], index: &[u32], weight: &[f32]) -> ([f32; 3], Quat) {
        let [r0, r1, r2, shift, q] = self.sum(index, weight);
        let [x, y, z, _] = plus(plus(plus(shift, x[0], r0), x[1], r1), x[2], r2);
        let length = dot(q, q).sqrt();
        if length < LEAST_LENGTH {
            let first = index.first().and_then(|j| self.poses.get(*j as usize)).unwrap_or(&REST);
            return ([x, y, z], first[4]);
        }
        ([x, y, z], q.map(|v| v / length))
    }

    /// The gradient of a loss by the poses, from its gradients by the outputs of `carry`.
    ///
    /// # Arguments
    /// * `rest`: [N] as in `carry`; `by_means`, `by_rotations`: [N] gradients by carried position and rotation.
    pub fn backward(
        &self,
        blend: &Blend,
        rest: &[[f32; 3]],
        by_means: &[[f32; 3]],
        by_rotations: &[Quat],
    ) -> Vec<Pose> {
        let per = blend.per.max(1);
        let none = || vec![[[0.0f32; 4]; 5]; self.poses.len()];
        let rows = blend
            .index
            .par_chunks(RUN * per)
            .zip(blend.weight.par_chunks(RUN * per));
        let grads = rest
            .par_chunks(RUN)
            .zip(by_means.par_chunks(RUN))
            .zip(by_rotations.par_chunks(RUN));
        let parts: Vec<Vec<Pose>> = rows
            .zip(grads)
            .map(|((index, weight), ((rest, by_means), by_rotations))| {
                let mut part = none();
                let rows = index.chunks(per).zip(weight.chunks(per));
                let grads = rest.iter().zip(by_means).zip(by_rotations);
                for ((index, weight), ((x, g), h)) in rows.zip(grads) {
                    self.add_gradient(&mut part, (index, weight), (*x, *g, *h));
                }
                part
            })
            .collect();
        // In their order, so that the sum does not depend on the number of threads.
        parts.into_iter().fold(none(), |mut sum, part| {
            for (s, p) in sum.iter_mut().zip(&part) {
                s.iter_mut().zip(p).for_each(|(s, p)| *s = plus(*s, 1.0, *p));
            }
            sum
        })
    }

    fn add_gradient(&self, out: &mut [Pose], row: (&[u32], &[f32]), at: ([f32; 3], [f32; 3], Quat)) {
        let ((index, weight), (x, g, h)) = (row, at);
        let q = self.sum(index, weight)[4];
        let length = dot(q, q).sqrt().max(LEAST_LENGTH);
        let unit = q.map(|v| v / length);
        let along = dot(h, unit);
        let by_q: Quat = std::array::from_fn(|i| (h[i] - along * unit[i]) / length);
        let first = index
            .first()
            .and_then(|j| self.poses.get(*j as usize))
            .map_or(REST[4], |p| p[4]);
        for (j, w) in index.iter().zip(weight) {
            let (Some(o), Some(p)) = (out.get_mut(*j as usize), self.poses.get(*j as usize)) else {
                continue;
            };
            let g = [w * g[0], w * g[1], w * g[2], 0.0];
            (0..3).for_each(|b| o[b] = plus(o[b], x[b], g));
            o[3] = plus(o[3], 1.0, g);
            let sign = if !self.aligned && dot(p[4], first) < 0.0 {
                -w
            } else {
                *w
            };
            o[4] = plus(o[4], sign, by_q);
        }
    }
}

/// The quaternion of a rotation vector in radians.
pub fn from_rotation_vector(r: [f32; 3]) -> Quat {
    let angle = r.iter().map(|v| v * v).sum::<f32>().sqrt();
    let s = if angle > 0.0 { (angle / 2.0).sin() / angle } else { 0.0 };
    [(angle / 2.0).cos(), s * r[0], s * r[1], s * r[2]]
}

fn dot(a: [f32; 4], b: [f32; 4]) -> f32 {
    (0..4).map(|i| a[i] * b[i]).sum()
}

/// The rotation matrix of a unit quaternion, row by row.
pub fn matrix([w, x, y, z]: Quat) -> [[f32; 3]; 3] {
    [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ]
}
