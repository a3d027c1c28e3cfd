//! EWA splatting: a Gaussian in the world -> its 2-D covariance and view-dependent colour, for any vector of lanes.
//!
//! Both the projection and its backward pass evaluate these functions; the backward pass computes them again instead of
//! storing them. The covariance is M M^T with M = J W R S (2x3): positive semi-definite by construction, and its
//! determinant follows from the cross product of the rows (Cauchy-Binet) without the cancellation of ac - b^2.

use crate::constants::FOV_MARGIN;
use crate::scene::View;
use crate::sh;
use crate::simd::{Vector, c};
use crate::soa::{Soa, load_rows};

/// u^2 = log2(e)/2 * (whitened distance)^2
pub const WHITEN: f32 = 0.5 * std::f32::consts::LOG2_E;

/// The view, and constants derived from it that all Gaussians need.
pub struct Lens {
    pub rotation: [[f32; 3]; 3],
    pub translation: [f32; 3],
    pub eye: [f32; 3],
    pub focal: [f32; 2],
    pub center: [f32; 2],
    pub slope_min: [f32; 2],
    pub slope_max: [f32; 2],
    pub size: [f32; 2],
    pub near: f32,
    pub low_pass: f32,
}

impl Lens {
    pub fn new(view: &View) -> Lens {
        let size = [view.size.width as f32, view.size.height as f32];
        let margin = |i: usize| FOV_MARGIN * 0.5 * size[i] / view.focal[i];
        Lens {
            rotation: view.rotation,
            translation: view.translation,
            eye: view.eye(),
            focal: view.focal,
            center: view.center,
            slope_min: std::array::from_fn(|i| -view.center[i] / view.focal[i] - margin(i)),
            slope_max: std::array::from_fn(|i| (size[i] - view.center[i]) / view.focal[i] + margin(i)),
            size,
            near: view.near,
            low_pass: view.low_pass,
        }
    }
}

/// Everything between the parameters and the 2-D covariance.
pub struct Ewa<V: Vector> {
    pub p: [V; 3], // camera space
    pub inv_z: V,
    pub free: [V::Mask; 2], // not clamped
    pub unit: [V; 4],       // normalised quaternion
    pub inv_norm: V,
    pub rot: [[V; 3]; 3],
    pub scale: [V; 3],
    pub jw: [[V; 3]; 2], // Jacobian times world-to-camera rotation
    pub m: [[V; 3]; 2],  // jw rot scale
    pub cov: [V; 3],     // xx, xy, yy with the low-pass
    pub det: V,
}

#[inline(always)]
pub fn dot3<V: Vector>(a: [V; 3], b: [V; 3]) -> V {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

#[inline(always)]
fn rotation<V: Vector>([w, x, y, z]: [V; 4]) -> [[V; 3]; 3] {
    let (one, two) = (c::<V>(1.0), c::<V>(2.0));
    [
        [
            one - two * (y * y + z * z),
            two * (x * y - w * z),
            two * (x * z + w * y),
        ],
        [
            two * (x * y + w * z),
            one - two * (x * x + z * z),
            two * (y * z - w * x),
        ],
        [
            two * (x * z - w * y),
            two * (y * z + w * x),
            one - two * (x * x + y * y),
        ],
    ]
}

/// exp(x)
#[inline(always)]
pub fn exp<V: Vector>(x: V) -> V {
    (x * c::<V>(std::f32::consts::LOG2_E)).exp2()
}

/// The lanes `at ..` of the chunk.
#[inline(always)]
pub fn ewa<V: Vector>(soa: &Soa, lens: &Lens, at: usize) -> Ewa<V> {
    let mean: [V; 3] = load_rows(&soa.means, at);
    let w = &lens.rotation;
    let mut p = mean;
    for i in 0..3 {
        p[i] = dot3([c(w[i][0]), c(w[i][1]), c(w[i][2])], mean) + c::<V>(lens.translation[i]);
    }
    let inv_z = c::<V>(1.0) / p[2];
    let q: [V; 4] = load_rows(&soa.quats, at);
    let norm = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
    let inv_norm = c::<V>(1.0) / norm;
    let unit = [q[0] * inv_norm, q[1] * inv_norm, q[2] * inv_norm, q[3] * inv_norm];
    let rot = rotation(unit);
    let log_scale: [V; 3] = load_rows(&soa.log_scales, at);
    let scale = [exp(log_scale[0]), exp(log_scale[1]), exp(log_scale[2])];

    let mut free = [p[0].finite(); 2];
    let mut jw = [[c::<V>(0.0); 3]; 2];
    let mut m = jw;
    for i in 0..2 {
        let (lo, hi) = (c::<V>(lens.slope_min[i]), c::<V>(lens.slope_max[i]));
        let s = p[i] * inv_z;
        free[i] = s.ge(lo) & !s.ge(hi);
        let slope = s.max(lo).min(hi);
        let a = c::<V>(lens.focal[i]) * inv_z;
        for j in 0..3 {
            jw[i][j] = a * slope.neg_mul_add(c(w[2][j]), c(w[i][j]));
        }
        for j in 0..3 {
            m[i][j] = dot3(jw[i], [rot[0][j], rot[1][j], rot[2][j]]) * scale[j];
        }
    }
    let low = c::<V>(lens.low_pass);
    let (xx, xy, yy) = (dot3(m[0], m[0]), dot3(m[0], m[1]), dot3(m[1], m[1]));
    let [a, b] = m;
    let cross = [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ];
    let det = low * low + low * (xx + yy) + dot3(cross, cross);
    let cov = [xx + low, xy, yy + low];
    Ewa {
        p,
        inv_z,
        free,
        unit,
        inv_norm,
        rot,
        scale,
        jw,
        m,
        cov,
        det,
    }
}

/// Unit direction from the eye to the mean, and 1 / distance.
#[inline(always)]
pub fn direction<V: Vector>(soa: &Soa, lens: &Lens, at: usize) -> ([V; 3], V) {
    let mean: [V; 3] = load_rows(&soa.means, at);
    let d = [
        mean[0] - c(lens.eye[0]),
        mean[1] - c(lens.eye[1]),
        mean[2] - c(lens.eye[2]),
    ];
    let inv = c::<V>(1.0) / dot3(d, d).sqrt();
    ([d[0] * inv, d[1] * inv, d[2] * inv], inv)
}

/// A direction in the frame of the spherical harmonics: rotated back where they are rotated.
#[inline(always)]
pub fn seen<V: Vector>(soa: &Soa, dir: [V; 3], at: usize) -> [V; 3] {
    if !soa.turned {
        return dir;
    }
    let [w, x, y, z] = load_rows(&soa.turns, at);
    turn([w, -x, -y, -z], dir)
}

/// `v`, rotated by a unit quaternion.
#[inline(always)]
pub fn turn<V: Vector>([w, x, y, z]: [V; 4], v: [V; 3]) -> [V; 3] {
    let u = [x, y, z];
    let across = cross(u, v);
    let once = [across[0] + w * v[0], across[1] + w * v[1], across[2] + w * v[2]];
    let twice = cross(u, once);
    std::array::from_fn(|i| v[i] + c::<V>(2.0) * twice[i])
}

#[inline(always)]
fn cross<V: Vector>(a: [V; 3], b: [V; 3]) -> [V; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

/// Colour before the clamp at 0.
#[inline(always)]
pub fn colour<V: Vector>(soa: &Soa, lens: &Lens, k: usize, at: usize) -> [V; 3] {
    let mut rgb: [V; 3] = load_rows(&soa.sh0, at);
    for channel in &mut rgb {
        *channel = channel.mul_add(c(sh::SH_C0), c(0.5));
    }
    if k > 0 {
        let (dir, _) = direction::<V>(soa, lens, at);
        let basis = sh::basis(k, seen(soa, dir, at));
        for i in 0..k {
            for ch in 0..3 {
                rgb[ch] = basis[i].mul_add(V::load(&soa.sh_n[i][ch][at..]), rgb[ch]);
            }
        }
    }
    rgb
}
