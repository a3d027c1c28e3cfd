//! The transform of a track (spec 2.8): rotation, translation and uniform scale, applied to the Gaussians of a frame, with the
//! rotation of their spherical harmonics.

use crate::dequantize::{Quat, multiply};
use crate::parametric::FrameMut;

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
    /// The pose at the share `f` of the way from `a` to `b`.
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
            rotate_sh(&r, frame.sh_n.len() / frame.means.len(), frame.sh_n);
        }
    }
}

fn normalized(q: Quat) -> Quat {
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
    q.map(|v| v / length)
}

/// Rows of the rotation matrix of a unit quaternion.
fn matrix([w, x, y, z]: Quat) -> [[f32; 3]; 3] {
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

/// Rotates spherical harmonics [N, K, 3], `per` = 3 K numbers a Gaussian, by a rotation matrix.
fn rotate_sh(r: &[[f32; 3]; 3], per: usize, sh: &mut [f32]) {
    let bands = sh_bands(r);
    for own in sh.chunks_exact_mut(per.max(1)) {
        let mut first = 0;
        for band in &bands {
            let count = band.len();
            let Some(coefficients) = own.get_mut(3 * first..3 * (first + count)) else {
                break; // a lower degree
            };
            let mut turned = [0.0f32; 21];
            for (row, out) in band.iter().zip(turned.as_chunks_mut::<3>().0) {
                for (m, c) in row.iter().zip(coefficients.as_chunks::<3>().0) {
                    (0..3).for_each(|i| out[i] += m * c[i]);
                }
            }
            coefficients.copy_from_slice(&turned[..3 * count]);
            first += count;
        }
    }
}

/// For the bands 1 to 3 the matrix [2 l + 1, 2 l + 1] by which a rotation of the function acts on its coefficients, by the
/// recursion of Ivanic and Ruedenberg (1996, with the corrections of 1998), in the signs of clause 14.
fn sh_bands(r: &[[f32; 3]; 3]) -> [Vec<Vec<f32>>; 3] {
    const AXES: [usize; 3] = [1, 2, 0]; // m = -1, 0, 1 are y, z, x
    let one: Vec<Vec<f32>> = AXES.map(|i| AXES.map(|j| r[i][j]).to_vec()).to_vec();
    let two = next_band(&one, &one);
    let three = next_band(&one, &two);
    let mut bands = [one, two, three];
    for band in &mut bands {
        for (i, row) in band.iter_mut().enumerate() {
            for (j, v) in row.iter_mut().enumerate() {
                *v *= if (i + j) % 2 == 1 { -1.0 } else { 1.0 }; // odd m have the other sign there
            }
        }
    }
    bands
}

/// The matrix of band l from those of bands 1 and l - 1.
fn next_band(one: &[Vec<f32>], before: &[Vec<f32>]) -> Vec<Vec<f32>> {
    let l = (before.len() / 2 + 1) as i32;
    let p = |i: i32, mu: i32, n: i32| {
        let r = |j: i32| one[(i + 1) as usize][(j + 1) as usize];
        let m = |b: i32| before[(mu + l - 1) as usize][(b + l - 1) as usize];
        match n {
            n if n == l => r(1) * m(l - 1) - r(-1) * m(1 - l),
            n if n == -l => r(1) * m(1 - l) + r(-1) * m(l - 1),
            n => r(0) * m(n),
        }
    };
    let element = |m: i32, n: i32| {
        let same = |a: i32, b: i32| f32::from(a == b);
        let d = same(m, 0);
        let below = if n.abs() == l {
            2 * l * (2 * l - 1)
        } else {
            (l + n) * (l - n)
        } as f32;
        let a = m.abs();
        let u = (((l + m) * (l - m)) as f32 / below).sqrt();
        let v = 0.5 * ((1.0 + d) * ((l + a - 1) * (l + a)) as f32 / below).sqrt() * (1.0 - 2.0 * d);
        let w = -0.5 * (((l - a - 1) * (l - a)) as f32 / below).sqrt() * (1.0 - d);
        let of_v = || match m {
            0 => p(1, 1, n) + p(-1, -1, n),
            m if m > 0 => p(1, m - 1, n) * (1.0 + same(m, 1)).sqrt() - if m == 1 { 0.0 } else { p(-1, 1 - m, n) },
            m => (if m == -1 { 0.0 } else { p(1, m + 1, n) }) + p(-1, -m - 1, n) * (1.0 + same(m, -1)).sqrt(),
        };
        let of_w = || match m {
            m if m > 0 => p(1, m + 1, n) + p(-1, -m - 1, n),
            m => p(1, m - 1, n) - p(-1, 1 - m, n),
        };
        let term = |factor: f32, value: &dyn Fn() -> f32| if factor == 0.0 { 0.0 } else { factor * value() };
        term(u, &|| p(0, m, n)) + term(v, &of_v) + term(w, &of_w)
    };
    (-l..=l).map(|m| (-l..=l).map(|n| element(m, n)).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The polynomials of clause 14 without their common signs and factors do as well: orthonormal ones, here of band 2.
    fn band_two([x, y, z]: [f32; 3]) -> [f32; 5] {
        let c = 1.092_548_4;
        [
            c * x * y,
            -c * y * z,
            0.315_391_57 * (2.0 * z * z - x * x - y * y),
            -c * x * z,
            0.546_274_2 * (x * x - y * y),
        ]
    }

    #[test]
    fn turned_harmonics_are_those_of_the_direction_turned_back() {
        let q = normalized([0.3, -0.5, 0.7, 0.2]);
        let (r, d) = (matrix(q), [0.48, -0.6, 0.64]);
        let back: [f32; 3] = std::array::from_fn(|i| (0..3).map(|j| r[j][i] * d[j]).sum());
        let f = [0.3, -1.0, 0.7, 0.2, 0.9];
        let mut sh = vec![0.0; 24];
        (0..5).for_each(|k| sh[3 * (3 + k)] = f[k]);
        rotate_sh(&r, 24, &mut sh);
        let value = |c: &dyn Fn(usize) -> f32, d| (0..5).map(|k| c(k) * band_two(d)[k]).sum::<f32>();
        let (turned, expected) = (value(&|k| sh[3 * (3 + k)], d), value(&|k| f[k], back));
        assert!((turned - expected).abs() < 1e-5, "{turned} {expected}");
    }

    #[test]
    fn the_shorter_way_is_taken() {
        let turn = |angle: f32| Pose {
            rotation: [(angle / 2.0).cos(), (angle / 2.0).sin(), 0.0, 0.0],
            ..Pose::default()
        };
        let half = Pose::between(&turn(3.0), &turn(-3.0), 0.5).rotation;
        assert!(half[0].abs() < 1e-5, "{half:?}"); // by pi, not by 0
    }
}
