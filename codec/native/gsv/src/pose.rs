//! The transform of a track (spec 2.8): rotation, translation and uniform scale, applied to the Gaussians of a frame,
//! with the rotation of their spherical harmonics.

use crate::dequantize::{Quat, multiply};
use crate::harmonics::Turn;
use crate::parametric::FrameMut;
use crate::rigid_blend::matrix;

/// Cosine of half the angle between rotations above which slerp is linear.
const NEAR: f32 = 0.9995;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// wxyz.
    pub rotation: Quat,
    pub translation: [f32; 3],
    /// > 0.
    pub scale: f32,
}

impl Default for Pose {
    fn default() -> Pose {
        Pose {
            rotation: [1.0, 0.0, 0.0, 0.0],
            translation: [0.0; 3],
            scale: 1.0,
        }
    }
}

impl Pose {
    /// The pose at the fraction `f` of the way from `a` to `b`.
    pub fn between(a: &Pose, b: &Pose, f: f32) -> Pose {
        let mix = |p: f32, q: f32| p + f * (q - p);
        let (p, q) = (normalized(a.rotation), normalized(b.rotation));
        let dot: f32 = p.iter().zip(q).map(|(p, q)| p * q).sum();
        let q = if dot < 0.0 { q.map(|v| -v) } else { q };
        let half = dot.abs().min(1.0).acos();
        let [from, to] = if dot.abs() > NEAR {
            [1.0 - f, f]
        } else {
            [((1.0 - f) * half).sin(), (f * half).sin()]
        };
        Pose {
            rotation: normalized(std::array::from_fn(|i| from * p[i] + to * q[i])),
            translation: std::array::from_fn(|i| mix(a.translation[i], b.translation[i])),
            scale: mix(a.scale, b.scale),
        }
    }

    /// Places the Gaussians of a frame.
    pub fn apply(&self, frame: FrameMut) {
        if *self == Pose::default() {
            return;
        }
        let q = normalized(self.rotation);
        let r = matrix(q);
        for x in &mut *frame.means {
            let old = *x;
            *x = std::array::from_fn(|i| {
                let turned: f32 = r[i].iter().zip(old).map(|(r, v)| r * v).sum();
                self.scale * turned + self.translation[i]
            });
        }
        for own in frame.quats {
            *own = multiply(q, *own);
        }
        let larger = self.scale.ln();
        frame.log_scales.iter_mut().for_each(|v| *v += larger);
        if !frame.means.is_empty() && q != Pose::default().rotation {
            let (turn, per) = (Turn::new(q), frame.sh_n.len() / frame.means.len());
            frame.sh_n.chunks_exact_mut(per.max(1)).for_each(|own| turn.apply(own));
        }
    }
}

fn normalized(q: Quat) -> Quat {
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
    q.map(|v| v / length)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shorter_way_is_taken() {
        let turn = |angle: f32| Pose {
            rotation: [(angle / 2.0).cos(), (angle / 2.0).sin(), 0.0, 0.0],
            ..Pose::default()
        };
        let half = Pose::between(&turn(3.0), &turn(-3.0), 0.5).rotation;
        assert!(half[0].abs() < 1e-5, "{half:?}"); // halfway is a rotation by pi, not by 0
    }
}
