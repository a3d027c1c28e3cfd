//! Rotation of real spherical harmonics of bands 1 to 3, in the signs of clause 14.
//!
//! A function of band l is a sum of 2 l + 1 zonal lobes about fixed axes; the rotated function is the same sum of lobes
//! about the rotated axes. The coefficients of the lobe about an axis are the values of the harmonics there. (Lessig et
//! al., "Efficient and accurate rotation of finite spherical harmonics expansions", 2012; Nowrouzezahrai et al.,
//! "Sparse zonal harmonic factorization", 2012.) One Gaussian takes some 400 operations, most of them on its three
//! colours at once.

use crate::dequantize::Quat;
use crate::rigid_blend::matrix;
use rayon::prelude::*;
use std::sync::LazyLock;

/// Axes of the lobes, not of unit length: the first 3, 5 and 7 are those of bands 1 to 3, far from linear dependence.
const AXES: [[f32; 3]; 7] = [
    [-3.0, -1.0, 3.0],
    [-3.0, 3.0, -1.0],
    [0.0, 0.0, 3.0],
    [2.0, -1.0, -2.0],
    [3.0, 0.0, 3.0],
    [-2.0, 2.0, -3.0],
    [-2.0, -2.0, -2.0],
];
/// Below this squared sine of half the angle (0.01 degrees) a rotation leaves the harmonics unchanged.
const STILL: f32 = 1e-8;
/// Gaussians of one task.
const RUN: usize = 1024;

/// Red, green, blue, and a lane that is not used.
type Colour = [f32; 4];

/// The axes, of unit length, and for each band the matrix from coefficients to weights of the lobes.
struct Factors {
    axes: [[f32; 3]; 7],
    one: [[f32; 3]; 3],
    two: [[f32; 5]; 5],
    three: [[f32; 7]; 7],
}

static FACTORS: LazyLock<Factors> = LazyLock::new(|| {
    let axes = AXES.map(unit);
    let lobes = axes.map(basis);
    Factors {
        axes,
        one: inverse(std::array::from_fn(|m| std::array::from_fn(|k| lobes[k][m]))),
        two: inverse(std::array::from_fn(|m| std::array::from_fn(|k| lobes[k][3 + m]))),
        three: inverse(std::array::from_fn(|m| std::array::from_fn(|k| lobes[k][8 + m]))),
    }
});

/// The rotation by a unit quaternion.
pub struct Turn {
    /// Coefficients of the rotated lobes, of all bands.
    lobes: [[f32; 15]; 7],
}

impl Turn {
    pub fn new(q: Quat) -> Turn {
        let (rows, axes) = (matrix(q), &FACTORS.axes);
        Turn {
            lobes: axes.map(|a| basis(rows.map(|row| row[0] * a[0] + row[1] * a[1] + row[2] * a[2]))),
        }
    }

    /// Rotates `own`, K x 3 coefficients of one Gaussian.
    pub fn apply(&self, own: &mut [f32]) {
        let factors = &*FACTORS;
        self.band(&factors.one, own, 0);
        self.band(&factors.two, own, 3);
        self.band(&factors.three, own, 8);
    }

    fn band<const C: usize>(&self, factors: &[[f32; C]; C], own: &mut [f32], first: usize) {
        let Some(own) = own.get_mut(3 * first..3 * (first + C)) else {
            return; // a lower degree
        };
        let own = own.as_chunks_mut::<3>().0;
        let mut turned: [Colour; C] = [[0.0; 4]; C];
        for (row, lobe) in factors.iter().zip(&self.lobes) {
            let mut weight: Colour = [0.0; 4];
            for (f, c) in row.iter().zip(&*own) {
                add(&mut weight, *f, [c[0], c[1], c[2], 0.0]);
            }
            for (t, y) in turned.iter_mut().zip(lobe.iter().skip(first)) {
                add(t, *y, weight);
            }
        }
        for (c, [r, g, b, _]) in own.iter_mut().zip(turned) {
            *c = [r, g, b];
        }
    }
}

/// Rotates the harmonics [N, K, 3] of each Gaussian by its unit quaternion (wxyz).
pub fn turn(sh: &mut [f32], rotations: &[Quat]) {
    let per = sh.len().checked_div(rotations.len()).unwrap_or(0);
    if per == 0 {
        return;
    }
    let runs = sh.par_chunks_mut(RUN * per).zip(rotations.par_chunks(RUN));
    runs.for_each(|(own, rotations)| {
        for (own, q) in own.chunks_exact_mut(per).zip(rotations) {
            let [_, x, y, z] = *q;
            if x * x + y * y + z * z > STILL {
                Turn::new(*q).apply(own);
            }
        }
    });
}

#[inline(always)]
fn add(sum: &mut Colour, factor: f32, values: Colour) {
    sum.iter_mut().zip(values).for_each(|(s, v)| *s += factor * v);
}

fn unit(a: [f32; 3]) -> [f32; 3] {
    let length = a.iter().map(|v| v * v).sum::<f32>().sqrt();
    a.map(|v| v / length)
}

/// The harmonics of bands 1 to 3 at a unit vector (clause 14).
fn basis([x, y, z]: [f32; 3]) -> [f32; 15] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        -0.488_602_5 * y,
        0.488_602_5 * z,
        -0.488_602_5 * x,
        1.092_548_4 * x * y,
        -1.092_548_4 * y * z,
        0.315_391_57 * (2.0 * zz - xx - yy),
        -1.092_548_4 * x * z,
        0.546_274_2 * (xx - yy),
        -0.590_043_6 * y * (3.0 * xx - yy),
        2.890_611_4 * x * y * z,
        -0.457_045_8 * y * (4.0 * zz - xx - yy),
        0.373_176_34 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_8 * x * (4.0 * zz - xx - yy),
        1.445_305_7 * z * (xx - yy),
        -0.590_043_6 * x * (xx - 3.0 * yy),
    ]
}

/// Inverse of a matrix by Gauss-Jordan elimination with pivots, in f64.
fn inverse<const C: usize>(matrix: [[f32; C]; C]) -> [[f32; C]; C] {
    let mut left = matrix.map(|row| row.map(f64::from));
    let mut right: [[f64; C]; C] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    for i in 0..C {
        let pivot = (i..C)
            .max_by(|a, b| left[*a][i].abs().total_cmp(&left[*b][i].abs()))
            .unwrap_or(i);
        left.swap(i, pivot);
        right.swap(i, pivot);
        let scale = 1.0 / left[i][i];
        left[i] = left[i].map(|v| v * scale);
        right[i] = right[i].map(|v| v * scale);
        let (own_left, own_right) = (left[i], right[i]);
        for k in (0..C).filter(|k| *k != i) {
            let factor = left[k][i];
            (0..C).for_each(|j| left[k][j] -= factor * own_left[j]);
            (0..C).for_each(|j| right[k][j] -= factor * own_right[j]);
        }
    }
    right.map(|row| row.map(|v| v as f32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::skinning::rotate;

    #[test]
    fn turned_harmonics_are_those_of_the_direction_turned_back() {
        let q = [0.3f32, -0.5, 0.7, 0.2];
        let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
        let q = q.map(|v| v / length);
        let back = [q[0], -q[1], -q[2], -q[3]];
        let coefficients: Vec<f32> = (0..45).map(|i| ((37 * i + 11) % 23) as f32 / 11.0 - 1.0).collect();
        for k in [3, 8, 15] {
            let mut sh = [&coefficients[..3 * k], &coefficients[..3 * k]].concat();
            turn(&mut sh, &[q, [1.0, 0.0, 0.0, 0.0]]);
            assert_eq!(sh[3 * k..], coefficients[..3 * k]); // the identity changes nothing
            for d in [[0.48, -0.6, 0.64], [0.0, 0.0, 1.0], [-0.8, 0.6, 0.0]] {
                let value = |sh: &[f32], d| -> f32 { basis(d).iter().zip(sh.chunks(3)).map(|(y, c)| y * c[1]).sum() };
                let (turned, expected) = (value(&sh[..3 * k], d), value(&coefficients[..3 * k], rotate(back, d)));
                assert!((turned - expected).abs() < 1e-5, "{k}: {turned} {expected}");
            }
        }
    }
}
