//! View-dependent colour: real spherical harmonics up to degree 3 in the sign convention of 3D Gaussian Splatting.
//! colour = max(0, 0.5 + Y_00 sh0 + sum_k Y_k shN_k); here the basis Y_1.. and its derivatives by direction.

use crate::simd::{Vector, c};

pub const SH_C0: f32 = 0.282_094_8;
const C1: f32 = 0.488_602_5;
const C2: [f32; 5] = [1.092_548_5, -1.092_548_5, 0.315_391_57, -1.092_548_5, 0.546_274_24];
const C3: [f32; 7] = [
    -0.590_043_6,
    2.890_611_4,
    -0.457_045_8,
    0.373_176_34,
    -0.457_045_8,
    1.445_305_7,
    -0.590_043_6,
];

/// Y_1.. of a unit direction; the first `k` of 15 are valid.
#[inline(always)]
pub fn basis<V: Vector>(k: usize, [x, y, z]: [V; 3]) -> [V; 15] {
    let mut b = [c::<V>(0.0); 15];
    if k >= 3 {
        b[0] = -(c::<V>(C1) * y);
        b[1] = c::<V>(C1) * z;
        b[2] = -(c::<V>(C1) * x);
    }
    if k >= 8 {
        b[3] = c::<V>(C2[0]) * x * y;
        b[4] = c::<V>(C2[1]) * y * z;
        b[5] = c::<V>(C2[2]) * (c::<V>(2.0) * z * z - x * x - y * y);
        b[6] = c::<V>(C2[3]) * x * z;
        b[7] = c::<V>(C2[4]) * (x * x - y * y);
    }
    if k >= 15 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        b[8] = c::<V>(C3[0]) * y * (c::<V>(3.0) * xx - yy);
        b[9] = c::<V>(C3[1]) * x * y * z;
        b[10] = c::<V>(C3[2]) * y * (c::<V>(4.0) * zz - xx - yy);
        b[11] = c::<V>(C3[3]) * z * (c::<V>(2.0) * zz - c::<V>(3.0) * xx - c::<V>(3.0) * yy);
        b[12] = c::<V>(C3[4]) * x * (c::<V>(4.0) * zz - xx - yy);
        b[13] = c::<V>(C3[5]) * z * (xx - yy);
        b[14] = c::<V>(C3[6]) * x * (xx - c::<V>(3.0) * yy);
    }
    b
}

/// sum_k g_k dY_k/d(x, y, z)
#[inline(always)]
pub fn basis_backward<V: Vector>(k: usize, [x, y, z]: [V; 3], g: &[V; 15]) -> [V; 3] {
    let mut d = [c::<V>(0.0); 3];
    if k >= 3 {
        d = [-(c::<V>(C1) * g[2]), -(c::<V>(C1) * g[0]), c::<V>(C1) * g[1]];
    }
    if k >= 8 {
        let mut a = [c::<V>(0.0); 5];
        for i in 0..5 {
            a[i] = c::<V>(C2[i]) * g[3 + i];
        }
        d[0] = d[0] + a[0] * y - c::<V>(2.0) * a[2] * x + a[3] * z + c::<V>(2.0) * a[4] * x;
        d[1] = d[1] + a[0] * x + a[1] * z - c::<V>(2.0) * a[2] * y - c::<V>(2.0) * a[4] * y;
        d[2] = d[2] + a[1] * y + c::<V>(4.0) * a[2] * z + a[3] * x;
    }
    if k >= 15 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let (xy, yz, xz) = (x * y, y * z, x * z);
        let mut a = [c::<V>(0.0); 7];
        for i in 0..7 {
            a[i] = c::<V>(C3[i]) * g[8 + i];
        }
        let ring = c::<V>(4.0) * zz - xx - yy;
        d[0] = d[0] + c::<V>(6.0) * a[0] * xy + a[1] * yz - c::<V>(2.0) * a[2] * xy - c::<V>(6.0) * a[3] * xz
            + a[4] * (ring - c::<V>(2.0) * xx)
            + c::<V>(2.0) * a[5] * xz
            + c::<V>(3.0) * a[6] * (xx - yy);
        d[1] = d[1] + c::<V>(3.0) * a[0] * (xx - yy) + a[1] * xz + a[2] * (ring - c::<V>(2.0) * yy)
            - c::<V>(6.0) * a[3] * yz
            - c::<V>(2.0) * a[4] * xy
            - c::<V>(2.0) * a[5] * yz
            - c::<V>(6.0) * a[6] * xy;
        d[2] = d[2]
            + a[1] * xy
            + c::<V>(8.0) * a[2] * yz
            + a[3] * (c::<V>(6.0) * zz - c::<V>(3.0) * xx - c::<V>(3.0) * yy)
            + c::<V>(8.0) * a[4] * xz
            + a[5] * (xx - yy);
    }
    d
}
