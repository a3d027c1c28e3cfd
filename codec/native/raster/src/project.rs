//! Gaussians in the world -> `Projected` ellipses on the image (EWA splatting), 16 at a time.
//!
//! The covariance is kept as M M^T with M = J W R S (2x3): positive semi-definite by construction, and its determinant follows
//! from the cross product of the rows (Cauchy-Binet) without the cancellation of ac - b^2. The inverse covariance is kept as
//! its Cholesky factor, scaled so that the exponent in base 2 is log2(alpha) = log2_opacity - u^2 - v^2 with
//! u = l11 dx + l21 dy, v = l22 dy: as cheap per pixel as the quadratic form and never positive by rounding.

use crate::constants::{FOV_MARGIN, LOG2_ALPHA_MIN, LOW_PASS, NEAR};
use crate::scene::{Splats, View};
use crate::sh;
use crate::simd::{MAGIC, Vector, c, dispatch};
use crate::soa::{CHUNK, Row, Soa, load_rows};
use crate::tile::{Ellipse, reach};

/// Side of a tile in pixels.
pub const TILE: usize = 16;
/// Widens the box and the ellipse a little, so that rounding never loses a pixel that the blending would have drawn.
pub const SLACK: f32 = 1e-3;

/// A Gaussian on the image; x and y in pixels of the region.
///
/// One cache line: tiles fetch them in depth order, which is random in memory.
#[derive(Clone, Copy, Default, Debug)]
#[repr(C, align(64))]
pub struct Projected {
    pub x: f32,
    pub y: f32,
    pub l11: f32,
    pub l21: f32,
    pub l22: f32,
    pub log2_opacity: f32,
    pub rgb: [f32; 3],
    pub depth: f32,
    /// Half width and height of the box around the pixels where alpha >= ALPHA_MIN; rx < 0: not visible.
    pub rx: f32,
    pub ry: f32,
    /// Tiles that the box meets: first and last column, first and last row.
    pub tiles: [u16; 4],
    /// Which of them the ellipse meets if they are at most 2 x 2: bit 2 row + column, from the first ones. Else `MANY`.
    pub met: u16,
}

/// `met` of a box of more tiles than that.
pub const MANY: u16 = 1 << 4;

impl Projected {
    pub fn visible(&self) -> bool {
        self.rx >= 0.0
    }

    /// Larger half side of the box in pixels, 0 for the invisible.
    pub fn radius(&self) -> f32 {
        if self.visible() { self.rx.max(self.ry) } else { 0.0 }
    }
}

/// u^2 = log2(e)/2 * (whitened distance)^2
pub const WHITEN: f32 = 0.5 * std::f32::consts::LOG2_E;

/// The view with what all Gaussians need of it.
pub struct Lens {
    pub rotation: [[f32; 3]; 3],
    pub translation: [f32; 3],
    pub eye: [f32; 3],
    pub focal: [f32; 2],
    pub center: [f32; 2],
    pub slope_min: [f32; 2],
    pub slope_max: [f32; 2],
    pub size: [f32; 2], // of the region
    pub full: [f32; 2], // of the image
}

impl Lens {
    pub fn new(view: &View) -> Lens {
        let full = [view.width as f32, view.height as f32];
        let origin = [view.region.x as f32, view.region.y as f32];
        let margin = |i: usize| FOV_MARGIN * 0.5 * full[i] / view.focal[i];
        Lens {
            rotation: view.rotation,
            translation: view.translation,
            eye: view.eye(),
            focal: view.focal,
            center: [view.center[0] - origin[0], view.center[1] - origin[1]],
            slope_min: std::array::from_fn(|i| -view.center[i] / view.focal[i] - margin(i)),
            slope_max: std::array::from_fn(|i| (full[i] - view.center[i]) / view.focal[i] + margin(i)),
            size: [view.region.width as f32, view.region.height as f32],
            full,
        }
    }
}

/// Everything between the parameters and the 2-D covariance; the backward pass computes it again.
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
    let low = c::<V>(LOW_PASS);
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

/// Colour before the clamp at 0.
#[inline(always)]
pub fn colour<V: Vector>(soa: &Soa, lens: &Lens, k: usize, at: usize) -> [V; 3] {
    let mut rgb: [V; 3] = load_rows(&soa.sh0, at);
    for channel in &mut rgb {
        *channel = channel.mul_add(c(sh::SH_C0), c(0.5));
    }
    if k > 0 {
        let (dir, _) = direction::<V>(soa, lens, at);
        let basis = sh::basis(k, dir);
        for i in 0..k {
            for ch in 0..3 {
                rgb[ch] = basis[i].mul_add(V::load(&soa.sh_n[i][ch][at..]), rgb[ch]);
            }
        }
    }
    rgb
}

/// The fields of `Projected` of 16 Gaussians, as rows; MAGIC is added to the last five, so that they are in the low bits.
struct Out([Row; 17]);

#[inline(always)]
fn project_lanes<V: Vector>(soa: &Soa, lens: &Lens, k: usize, at: usize, out: &mut Out) {
    let e = ewa::<V>(soa, lens, at);
    let x = e.p[0].mul_add(e.inv_z * c(lens.focal[0]), c(lens.center[0]));
    let y = e.p[1].mul_add(e.inv_z * c(lens.focal[1]), c(lens.center[1]));
    let r = (c::<V>(WHITEN) / (e.cov[2] * e.det)).sqrt();
    let (l11, l21, l22) = (e.cov[2] * r, -(e.cov[1] * r), (c::<V>(WHITEN) / e.cov[2]).sqrt());
    // log2(sigmoid(logit)); the clamp keeps exp finite, an opacity of 2^-80 is culled below
    let logit = V::load(&soa.logits[0][at..]);
    let log2_opacity = -(c::<V>(1.0) + exp(-logit.max(c(-55.0)))).log2();
    let range = log2_opacity - c(LOG2_ALPHA_MIN);
    let rx = (range * e.cov[0] * c(1.0 / WHITEN)).sqrt();
    let ry = (range * e.cov[2] * c(1.0 / WHITEN)).sqrt();
    let rgb = colour::<V>(soa, lens, k, at);

    let half = c::<V>(0.5);
    let in_x = (x + rx).ge(half) & (c::<V>(lens.size[0]) - half).ge(x - rx);
    let in_y = (y + ry).ge(half) & (c::<V>(lens.size[1]) - half).ge(y - ry);
    let front = e.p[2].ge(c(NEAR)) & range.ge(c(0.0)) & logit.finite();
    let shape = x.finite() & y.finite() & l11.finite() & l21.finite() & l22.finite() & rx.finite() & ry.finite();
    let scales: [V; 3] = load_rows(&soa.log_scales, at);
    let front = front & scales[0].finite() & scales[1].finite() & scales[2].finite();
    let positive = c::<V>(0.0).lt(l11) & c::<V>(0.0).lt(l22);
    let seen = in_x & in_y & front & shape & positive & rgb[0].finite() & rgb[1].finite() & rgb[2].finite();
    let fields = [
        x,
        y,
        l11,
        l21,
        l22,
        log2_opacity,
        rgb[0].max(c(0.0)),
        rgb[1].max(c(0.0)),
        rgb[2].max(c(0.0)),
        e.p[2],
    ];
    for (i, v) in fields.into_iter().enumerate() {
        v.store(&mut out.0[i][at..]);
    }
    rx.select(seen, c(-1.0)).store(&mut out.0[10][at..]);
    ry.store(&mut out.0[11][at..]);
    let (wide, high) = (rx + c(SLACK), ry + c(SLACK));
    // the first pixel centre at or after an edge, the last one at or before it; a tile too many is found out by `meet`
    let tile = |edge: V, axis: usize| {
        let pixel = edge.max(c(0.0)).min(c(lens.size[axis] - 1.0));
        pixel.mul_add(c(1.0 / TILE as f32), c(-0.5)) + c(MAGIC)
    };
    let half_on = c::<V>(0.25); // so that the last pixel of a picture is not rounded down
    let tiles = [
        tile(x - wide + half, 0),
        tile(x + wide - half + half_on, 0),
        tile(y - high + half, 1),
        tile(y + high - half + half_on, 1),
    ];
    for (i, tile) in tiles.into_iter().enumerate() {
        tile.store(&mut out.0[12 + i][at..]);
    }
    let ellipse = Ellipse {
        l11,
        l21,
        l22,
        reach: reach(log2_opacity),
    };
    meet(&ellipse, [x, y], tiles.map(|tile| tile - c(MAGIC))).store(&mut out.0[16][at..]);
}

/// `met` of the ellipse around the point, + MAGIC, by a test at the pixel centres of 2 x 2 tiles.
#[inline(always)]
fn meet<V: Vector>(ellipse: &Ellipse<V>, [x, y]: [V; 2], [x0, x1, y0, y1]: [V; 4]) -> V {
    let side = TILE as f32;
    let (left, top) = (x0.mul_add(c(side), -x), y0.mul_add(c(side), -y));
    let peak = ellipse.peak();
    let (columns, rows) = (x1 - x0, y1 - y0);
    let mut bits = c::<V>(MAGIC);
    for i in 0..2 {
        let first = top + c(i as f32 * side + 0.5);
        let (some, from, to) = ellipse.span(peak, first, first + c(side - 1.0));
        let some = some & rows.ge(c(i as f32));
        for j in 0..2 {
            let west = left + c(j as f32 * side + 0.5);
            let hit = some
                & columns.ge(c(j as f32))
                & to.ge(west * ellipse.l11)
                & ((west + c(side - 1.0)) * ellipse.l11).ge(from);
            bits = bits + c::<V>((1 << (2 * i + j)) as f32).select(hit, c(0.0));
        }
    }
    let many = columns.ge(c(2.0)) | rows.ge(c(2.0));
    c::<V>(MAGIC + f32::from(MANY)).select(many, bits)
}

#[inline(always)]
fn project_kernel<V: Vector>(splats: &Splats, lens: &Lens, first: usize, out: &mut [Projected]) {
    let mut soa = Soa::new();
    let mut rows = Out([[0.0; CHUNK]; 17]);
    for (i, block) in out.chunks_mut(CHUNK).enumerate() {
        soa.fill(splats, first + i * CHUNK);
        for at in (0..CHUNK).step_by(V::LANES) {
            project_lanes::<V>(&soa, lens, splats.sh_k, at, &mut rows);
        }
        let f = &rows.0;
        for (lane, g) in block.iter_mut().enumerate() {
            *g = Projected {
                x: f[0][lane],
                y: f[1][lane],
                l11: f[2][lane],
                l21: f[3][lane],
                l22: f[4][lane],
                log2_opacity: f[5][lane],
                rgb: [f[6][lane], f[7][lane], f[8][lane]],
                depth: f[9][lane],
                rx: f[10][lane],
                ry: f[11][lane],
                tiles: [12, 13, 14, 15].map(|i| f[i][lane].to_bits() as u16),
                met: f[16][lane].to_bits() as u16,
            };
        }
    }
}
dispatch!(
    /// Projects Gaussians first .. first + out.len().
    pub fn project = project_kernel(splats: &Splats, lens: &Lens, first: usize, out: &mut [Projected])
);
