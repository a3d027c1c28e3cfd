//! Backward pass of the projection: sums over the pixels of each Gaussian -> gradients of its parameters, 16 Gaussians
//! at a time.
//!
//! The mirror of project.rs.

use std::ops::Range;

use crate::backward::{LARGEST, Sums};
use crate::ewa::{Ewa, Lens, WHITEN, colour, direction, dot3, ewa, seen, turn};
use crate::scene::{Gradients, Splats};
use crate::sh;
use crate::simd::{Vector, c, dispatch, prefetch};
use crate::soa::{CHUNK, Row, Soa, load_rows, write_columns};
use crate::tile_binning::TileBins;

/// Gradients of a chunk as rows.
struct GradientRows {
    means: [Row; 3],
    quats: [Row; 4],
    log_scales: [Row; 3],
    logits: [Row; 1],
    sh0: [Row; 3],
    sh_n: [[Row; 3]; 15],
    grad2d: [Row; 1],
}

impl GradientRows {
    fn new() -> GradientRows {
        let z = [0.0; CHUNK];
        GradientRows {
            means: [z; 3],
            quats: [z; 4],
            log_scales: [z; 3],
            logits: [z],
            sh0: [z; 3],
            sh_n: [[z; 3]; 15],
            grad2d: [z],
        }
    }

    /// Writes the gradients of `n` Gaussians from `at` on to `out`; 0 for those without a bit in `seen`.
    #[inline(always)]
    fn write(&self, n: usize, seen: u16, sums: &[Row; 12], at: usize, k: usize, out: &mut Gradients) {
        let (to, add) = (at + n, out.add);
        write_columns(&self.means, seen, add, &mut out.means[3 * at..3 * to]);
        write_columns(&self.quats, seen, add, &mut out.quats[4 * at..4 * to]);
        write_columns(&self.log_scales, seen, add, &mut out.log_scales[3 * at..3 * to]);
        write_columns(&self.logits, seen, add, &mut out.logit_opacities[at..to]);
        write_columns(&self.sh0, seen, add, &mut out.sh0[3 * at..3 * to]);
        write_columns(&self.grad2d, seen, add, &mut out.grad2d[at..to]);
        let largest = out.max_weight[at..to].iter_mut();
        for (lane, (old, &new)) in largest.zip(&sums[LARGEST]).enumerate() {
            let new = if seen >> lane & 1 == 1 { new } else { 0.0 };
            *old = if add { old.max(new) } else { new };
        }
        if k == 0 {
            return;
        }
        for (lane, out) in out.sh_n[3 * k * at..3 * k * to].chunks_exact_mut(3 * k).enumerate() {
            if seen >> lane & 1 == 0 {
                if !add {
                    out.fill(0.0);
                }
                continue;
            }
            for (out, rows) in out.as_chunks_mut::<3>().0.iter_mut().zip(&self.sh_n) {
                let new = [rows[0][lane], rows[1][lane], rows[2][lane]];
                *out = if add {
                    std::array::from_fn(|ch| out[ch] + new[ch])
                } else {
                    new
                };
            }
        }
    }
}

/// Prefetch distance in Gaussians: sums are fetched this far ahead, their places twice as far.
const AHEAD: usize = 24;

/// Adds up the pairs of `n` Gaussians, in the order of their tiles. Bit i of the mask is set if Gaussian first + i has
/// any.
#[inline(always)] // into the kernel, whose wide instructions it needs
fn gather(bins: &TileBins, sums: &[Sums], first: usize, n: usize, rows: &mut [Row; 12]) -> u16 {
    let mut seen = 0;
    for lane in 0..n {
        let g = first + lane;
        bins.prefetch_places(g + 2 * AHEAD);
        bins.places(g + AHEAD, |place| prefetch(sums, place));
        let mut total = Sums::ZERO.0;
        bins.places(g, |place| {
            let s = &sums[place].0;
            for k in 0..LARGEST {
                total[k] += s[k];
            }
            total[LARGEST] = total[LARGEST].max(s[LARGEST]);
            seen |= 1 << lane;
        });
        for (row, v) in rows.iter_mut().zip(total) {
            row[lane] = v;
        }
    }
    seen
}

/// Gradients by the projected mean and by the 2-D covariance.
struct Screen<V> {
    mean2d: [V; 2],
    cov: [V; 3], // xx, xy (both halves together), yy
}

/// dL/dmean2d = C sum(a d), dL/dcov = C sum(a d d^T) C / 2, with C = 2 ln2 L L^T the inverse covariance and (u, v) =
/// L^T d.
#[inline(always)]
fn screen<V: Vector>(e: &Ewa<V>, sums: &[Row; 12], at: usize) -> Screen<V> {
    let r = (c::<V>(WHITEN) / (e.cov[2] * e.det)).sqrt();
    let (l11, l21, l22) = (e.cov[2] * r, -(e.cov[1] * r), (c::<V>(WHITEN) / e.cov[2]).sqrt());
    let k = c::<V>(2.0 * std::f32::consts::LN_2);
    let (au, av) = (V::load(&sums[1][at..]), V::load(&sums[2][at..]));
    let mean2d = [k * l11 * au, k * (l21 * au + l22 * av)];
    let (uu, uv, vv) = (
        V::load(&sums[3][at..]),
        V::load(&sums[4][at..]),
        V::load(&sums[5][at..]),
    );
    let half = c::<V>(0.5) * k * k;
    // rows of L S: [l11 uu, l11 uv], [l21 uu + l22 uv, l21 uv + l22 vv]
    let (p, q) = (l21 * uu + l22 * uv, l21 * uv + l22 * vv);
    let cov = [
        half * l11 * l11 * uu,
        c::<V>(2.0) * half * l11 * p,
        half * (p * l21 + q * l22),
    ];
    Screen { mean2d, cov }
}

/// Gradient by the quaternion before normalisation, from that by the rotation matrix.
#[inline(always)]
fn quat_backward<V: Vector>(e: &Ewa<V>, d: &[[V; 3]; 3]) -> [V; 4] {
    let [w, x, y, z] = e.unit;
    let two = c::<V>(2.0);
    let dw = two * (x * (d[2][1] - d[1][2]) + y * (d[0][2] - d[2][0]) + z * (d[1][0] - d[0][1]));
    let dx = two
        * (y * (d[0][1] + d[1][0]) + z * (d[0][2] + d[2][0]) + w * (d[2][1] - d[1][2]) - two * x * (d[1][1] + d[2][2]));
    let dy = two
        * (x * (d[0][1] + d[1][0]) + z * (d[1][2] + d[2][1]) + w * (d[0][2] - d[2][0]) - two * y * (d[0][0] + d[2][2]));
    let dz = two
        * (x * (d[0][2] + d[2][0]) + y * (d[1][2] + d[2][1]) + w * (d[1][0] - d[0][1]) - two * z * (d[0][0] + d[1][1]));
    let along = w * dw + x * dx + y * dy + z * dz;
    let n = e.inv_norm;
    [
        n * (dw - w * along),
        n * (dx - x * along),
        n * (dy - y * along),
        n * (dz - z * along),
    ]
}

/// Writes means, quats and log_scales except the part of means that comes from colour. `depth`: gradient by depth.
#[inline(always)]
fn geometry<V: Vector>(e: &Ewa<V>, lens: &Lens, s: &Screen<V>, depth: V, at: usize, out: &mut GradientRows) {
    let (two, w) = (c::<V>(2.0), &lens.rotation);
    let mut dm = [[c::<V>(0.0); 3]; 2];
    let mut drot = [[c::<V>(0.0); 3]; 3];
    for j in 0..3 {
        dm[0][j] = two * s.cov[0] * e.m[0][j] + s.cov[1] * e.m[1][j];
        dm[1][j] = two * s.cov[2] * e.m[1][j] + s.cov[1] * e.m[0][j];
        (dm[0][j] * e.m[0][j] + dm[1][j] * e.m[1][j]).store(&mut out.log_scales[j][at..]);
        dm[0][j] = dm[0][j] * e.scale[j];
        dm[1][j] = dm[1][j] * e.scale[j];
        for i in 0..3 {
            drot[i][j] = e.jw[0][i] * dm[0][j] + e.jw[1][i] * dm[1][j];
        }
    }
    for (i, v) in quat_backward(e, &drot).into_iter().enumerate() {
        v.store(&mut out.quats[i][at..]);
    }
    let mut dp = [c(0.0), c(0.0), depth];
    for i in 0..2 {
        let a = c::<V>(lens.focal[i]) * e.inv_z;
        let djw = [dot3(dm[i], e.rot[0]), dot3(dm[i], e.rot[1]), dot3(dm[i], e.rot[2])];
        let dslope = -(a * dot3(djw, [c(w[2][0]), c(w[2][1]), c(w[2][2])]));
        let dslope = dslope.select(e.free[i], c(0.0));
        dp[i] = a * s.mean2d[i] + dslope * e.inv_z;
        // through a = f/z, the slope and the projected mean
        let x = e.p[i] * e.inv_z;
        dp[2] = dp[2] - e.inv_z * (dot3(djw, e.jw[i]) + dslope * x) - a * x * s.mean2d[i];
    }
    for j in 0..3 {
        dot3([c(w[0][j]), c(w[1][j]), c(w[2][j])], dp).store(&mut out.means[j][at..]);
    }
}

/// Writes the gradients of sh0 and shN and adds the part of means that comes through the direction.
#[inline(always)]
fn colour_backward<V: Vector>(soa: &Soa, lens: &Lens, k: usize, sums: &[Row; 12], at: usize, out: &mut GradientRows) {
    let rgb = colour::<V>(soa, lens, k, at);
    let mut d = rgb;
    for ch in 0..3 {
        d[ch] = V::load(&sums[6 + ch][at..]).select(c::<V>(0.0).lt(rgb[ch]), c(0.0));
        (d[ch] * c(sh::SH_C0)).store(&mut out.sh0[ch][at..]);
    }
    if k == 0 {
        return;
    }
    let (dir, inv) = direction::<V>(soa, lens, at);
    let own = seen(soa, dir, at);
    let basis = sh::basis(k, own);
    let mut dbasis = [c::<V>(0.0); 15];
    for i in 0..k {
        for ch in 0..3 {
            (basis[i] * d[ch]).store(&mut out.sh_n[i][ch][at..]);
            dbasis[i] = d[ch].mul_add(V::load(&soa.sh_n[i][ch][at..]), dbasis[i]);
        }
    }
    let mut ddir = sh::basis_backward(k, own, &dbasis);
    if soa.turned {
        ddir = turn(load_rows(&soa.turns, at), ddir);
    }
    let along = dot3(ddir, dir);
    for j in 0..3 {
        let mean = V::load(&out.means[j][at..]) + inv * (ddir[j] - dir[j] * along);
        mean.store(&mut out.means[j][at..]);
    }
}

/// Gradients of 16 Gaussians from their sums; lanes that are not visible hold garbage.
#[inline(always)]
fn chunk<V: Vector>(soa: &Soa, lens: &Lens, k: usize, sums: &[Row; 12], out: &mut GradientRows) {
    for at in (0..CHUNK).step_by(V::LANES) {
        let e = ewa::<V>(soa, lens, at);
        let s = screen(&e, sums, at);
        geometry(&e, lens, &s, V::load(&sums[9][at..]), at, out);
        colour_backward::<V>(soa, lens, k, sums, at, out);
        // d ln(sigmoid(x)) / dx = 1 - sigmoid(x)
        let logit = V::load(&soa.logits[0][at..]).max(c(-55.0));
        let up = crate::ewa::exp(-logit);
        (V::load(&sums[0][at..]) * up / (c::<V>(1.0) + up)).store(&mut out.logits[0][at..]);
        let gx = s.mean2d[0] * c(0.5 * lens.size[0]);
        let gy = s.mean2d[1] * c(0.5 * lens.size[1]);
        gx.mul_add(gx, gy * gy).sqrt().store(&mut out.grad2d[0][at..]);
    }
}

#[inline(always)]
fn project_backward_kernel<V: Vector>(
    splats: &Splats,
    lens: &Lens,
    bins: &TileBins,
    sums: &[Sums],
    range: Range<usize>,
    out: &mut Gradients,
) {
    let (mut soa, mut rows, mut totals) = (Soa::new(), GradientRows::new(), [[0.0; CHUNK]; 12]);
    for first in range.clone().step_by(CHUNK) {
        let n = CHUNK.min(range.end - first);
        let seen = gather(bins, sums, first, n, &mut totals);
        soa.fill(splats, first);
        chunk::<V>(&soa, lens, splats.sh_k, &totals, &mut rows);
        rows.write(n, seen, &totals, first - range.start, splats.sh_k, out);
    }
}
dispatch!(
    /// Gradients of the Gaussians in `range` from the sums of all pairs; `out` is theirs.
    pub fn project_backward = project_backward_kernel(
        splats: &Splats,
        lens: &Lens,
        bins: &TileBins,
        sums: &[Sums],
        range: Range<usize>,
        out: &mut Gradients,
    )
);
