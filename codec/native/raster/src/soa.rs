//! Transposes arrays of Gaussians, [N, D], into rows of 16 lanes (structure of arrays) and back, and loads vectors from
//! rows.

use crate::scene::Splats;
use crate::simd::{Vector, c};

/// Gaussians in one chunk.
pub const CHUNK: usize = 16;
pub type Row = [f32; CHUNK];

/// Parameters of 16 Gaussians, one lane each. Lanes past the end hold NaN means and are culled by that.
pub struct Soa {
    pub means: [Row; 3],
    pub quats: [Row; 4],
    pub log_scales: [Row; 3],
    pub logits: [Row; 1],
    pub sh0: [Row; 3],
    pub sh_n: [[Row; 3]; 15],
    pub turns: [Row; 4],
    /// The harmonics are rotated.
    pub turned: bool,
}

impl Soa {
    pub fn new() -> Soa {
        let z = [0.0; CHUNK];
        Soa {
            means: [z; 3],
            quats: [z; 4],
            log_scales: [z; 3],
            logits: [z],
            sh0: [z; 3],
            sh_n: [[z; 3]; 15],
            turns: [z; 4],
            turned: false,
        }
    }

    /// Gaussians first .. first + 16 of `s`, fewer at the end.
    #[inline(always)] // into kernels, whose wide instructions it needs
    pub fn fill(&mut self, s: &Splats, first: usize) -> usize {
        let n = CHUNK.min(s.len() - first);
        self.means = [[f32::NAN; CHUNK]; 3];
        columns(&mut self.means, &s.means[3 * first..3 * (first + n)]);
        columns(&mut self.quats, &s.quats[4 * first..4 * (first + n)]);
        columns(&mut self.log_scales, &s.log_scales[3 * first..3 * (first + n)]);
        columns(&mut self.sh0, &s.sh0[3 * first..3 * (first + n)]);
        columns(&mut self.logits, &s.logit_opacities[first..first + n]);
        if s.sh_k > 0 {
            let own = s.sh_n[3 * s.sh_k * first..].chunks_exact(3 * s.sh_k);
            for (lane, item) in own.take(n).enumerate() {
                for (rows, rgb) in self.sh_n.iter_mut().zip(item.as_chunks::<3>().0) {
                    for ch in 0..3 {
                        rows[ch][lane] = rgb[ch];
                    }
                }
            }
        }
        self.turned = s.sh_k > 0 && !s.turns.is_empty();
        if self.turned {
            columns(&mut self.turns, &s.turns[4 * first..4 * (first + n)]);
        }
        n
    }
}

/// [n, D] -> D rows of n.
#[inline(always)]
fn columns<const D: usize>(rows: &mut [Row; D], flat: &[f32]) {
    if let ([whole], []) = flat.as_chunks::<D>().0.as_chunks::<CHUNK>() {
        for d in 0..D {
            for lane in 0..CHUNK {
                rows[d][lane] = whole[lane][d];
            }
        }
        return;
    }
    for (lane, item) in flat.chunks_exact(D).enumerate() {
        for d in 0..D {
            rows[d][lane] = item[d];
        }
    }
}

/// D rows -> [n, D], the mirror of `columns`; 0 where `seen` has no bit; `add`: adds to the present values.
#[inline(always)]
pub fn write_columns<const D: usize>(rows: &[Row; D], seen: u16, add: bool, flat: &mut [f32]) {
    if let ([whole], []) = flat.as_chunks_mut::<D>().0.as_chunks_mut::<CHUNK>()
        && seen == u16::MAX
        && !add
    {
        for lane in 0..CHUNK {
            for d in 0..D {
                whole[lane][d] = rows[d][lane];
            }
        }
        return;
    }
    for (lane, item) in flat.chunks_exact_mut(D).enumerate() {
        for d in 0..D {
            let value = if seen >> lane & 1 == 1 { rows[d][lane] } else { 0.0 };
            item[d] = if add { item[d] + value } else { value };
        }
    }
}

#[inline(always)]
pub fn load_rows<V: Vector, const D: usize>(rows: &[Row; D], at: usize) -> [V; D] {
    let mut v = [c::<V>(0.0); D];
    for d in 0..D {
        v[d] = V::load(&rows[d][at..]);
    }
    v
}
