//! Gaussians in the world -> `Projected` ellipses on the image, 16 at a time (EWA splatting, see `ewa`).
//!
//! The inverse covariance is kept as its Cholesky factor, scaled so that the exponent in base 2 is
//! log2(alpha) = log2_opacity - u^2 - v^2 with u = l11 dx + l21 dy, v = l22 dy. That costs as little per pixel as the
//! quadratic form, and rounding never makes the exponent positive.

use crate::constants::LOG2_ALPHA_MIN;
use crate::ellipse::{Ellipse, reach};
use crate::ewa::{Lens, WHITEN, colour, ewa, exp};
use crate::projected::{MANY, Projected, SLACK, TILE};
use crate::scene::Splats;
use crate::simd::{MAGIC, Vector, c, dispatch};
use crate::soa::{CHUNK, Row, Soa, load_rows};

/// The fields of `Projected` of 16 Gaussians, as rows. The last five hold integers: MAGIC is added, so that they are in
/// the low bits.
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
    let front = e.p[2].ge(c(lens.near)) & range.ge(c(0.0)) & logit.finite();
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
    let tiles = tile_range(lens, [x, y], [rx + c(SLACK), ry + c(SLACK)]);
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

/// First and last column, first and last row of the tiles that the box around (x, y) meets, + MAGIC: the tile of the
/// first pixel centre at or after an edge, and of the last one at or before it. `meet` rejects excess tiles.
#[inline(always)]
fn tile_range<V: Vector>(lens: &Lens, [x, y]: [V; 2], [wide, high]: [V; 2]) -> [V; 4] {
    let half = c::<V>(0.5);
    let tile = |edge: V, axis: usize| {
        let pixel = edge.max(c(0.0)).min(c(lens.size[axis] - 1.0));
        pixel.mul_add(c(1.0 / TILE as f32), c(-0.5)) + c(MAGIC)
    };
    let half_on = c::<V>(0.25); // so that the last pixel of an image is not rounded down
    [
        tile(x - wide + half, 0),
        tile(x + wide - half + half_on, 0),
        tile(y - high + half, 1),
        tile(y + high - half + half_on, 1),
    ]
}

/// `Projected::met` of the ellipse around the point, + MAGIC, by a test at the pixel centres of 2 x 2 tiles.
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
