//! One level of the hash grid: a point -> its cell, the table rows of the 8 corners, trilinear weights and their
//! derivatives.

const PRIMES: [u32; 3] = [1, 2_654_435_761, 805_459_861]; // x is not multiplied

#[derive(Clone, Copy)]
pub struct GridLevel {
    pub cells: u32, // along a side
    pub first: usize,
    pub entries: usize,
    pub dense: bool,
}

/// The cell around a point: table rows of its 8 corners, position in the cell, and whether each coordinate is in [0,
/// 1].
pub struct Cell {
    pub rows: [u32; 8],
    pub frac: [f32; 3],
    pub inside: [bool; 3],
}

impl GridLevel {
    #[inline(always)]
    pub fn cell(&self, point: &[f32; 3]) -> Cell {
        let (mut low, mut frac, mut inside) = ([0u32; 3], [0.0; 3], [true; 3]);
        for d in 0..3 {
            inside[d] = (0.0..=1.0).contains(&point[d]);
            let x = if inside[d] { point[d] } else { f32::from(point[d] > 0.5) }; // NaN becomes 0
            let x = x * self.cells as f32;
            low[d] = (x as u32).min(self.cells - 1);
            frac[d] = x - low[d] as f32;
        }
        let side = self.cells + 1;
        let [x, y, z] = low;
        let mut rows = [0; 8];
        if self.dense {
            let first = (z * side + y) * side + x;
            for (corner, row) in rows.iter_mut().enumerate() {
                let c = corner as u32;
                *row = first + (c & 1) + (c >> 1 & 1) * side + (c >> 2) * side * side;
            }
        } else {
            let (y0, z0) = (y.wrapping_mul(PRIMES[1]), z.wrapping_mul(PRIMES[2]));
            let hx = [x, x + 1];
            let hy = [y0, y0.wrapping_add(PRIMES[1])];
            let hz = [z0, z0.wrapping_add(PRIMES[2])];
            let mask = self.entries as u32 - 1;
            for (corner, row) in rows.iter_mut().enumerate() {
                *row = (hx[corner & 1] ^ hy[corner >> 1 & 1] ^ hz[corner >> 2]) & mask;
            }
        }
        Cell { rows, frac, inside }
    }
}

impl Cell {
    /// Trilinear weights of the corners.
    #[inline(always)]
    pub fn weights(&self) -> [f32; 8] {
        let [x, y, z] = self.frac;
        let (x0, y0, z0) = (1.0 - x, 1.0 - y, 1.0 - z);
        let yz = [y0 * z0, y * z0, y0 * z, y * z];
        [
            x0 * yz[0],
            x * yz[0],
            x0 * yz[1],
            x * yz[1],
            x0 * yz[2],
            x * yz[2],
            x0 * yz[3],
            x * yz[3],
        ]
    }

    /// Derivatives of sum(weight * value) by the coordinates, in units of cells; 0 outside of [0, 1].
    #[inline(always)]
    pub fn slopes(&self, value: &[f32; 8]) -> [f32; 3] {
        let [x, y, z] = self.frac;
        let mix = |a: f32, b: f32, t: f32| a + t * (b - a);
        let face = |step: usize, i: usize, j: usize, s: f32, t: f32| {
            let rise = |at: usize| value[at + step] - value[at];
            mix(mix(rise(0), rise(i), s), mix(rise(j), rise(i + j), s), t)
        };
        let all = [face(1, 2, 4, y, z), face(2, 1, 4, x, z), face(4, 1, 2, x, y)];
        std::array::from_fn(|d| if self.inside[d] { all[d] } else { 0.0 })
    }
}
