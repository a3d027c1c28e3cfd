//! Hilbert layout (spec 7.2): index of a Gaussian -> cell of the W x H map in which channels are shown.
//!
//! The map is a column of W x W squares, each filled along a Hilbert curve that ends where the next square begins.
//! Consecutive indices are neighbours in space (Morton order), so neighbours in space are near each other on the map.

/// The map of N indices.
pub struct HilbertLayout {
    pub width: usize,
    pub height: usize,
    count: usize,
    bits: u32,
}

/// log2 of the map width that spec 7.2 prescribes.
pub fn width_log2(n: usize) -> u32 {
    n.checked_ilog2().unwrap_or(0) >> 1
}

impl HilbertLayout {
    pub fn new(count: usize) -> HilbertLayout {
        let bits = width_log2(count);
        let width = 1usize << bits;
        HilbertLayout {
            width,
            height: count.div_ceil(width * width) * width,
            count,
            bits,
        }
    }

    /// [H, W] in raster order: `value(i)` at the cell of index i, 0 in cells without one.
    pub fn arrange(&self, value: impl Fn(usize) -> i32) -> Vec<i32> {
        let mut cells = vec![0; self.width * self.height];
        for i in 0..self.count {
            let (x, y) = position(i, self.bits);
            cells[y * self.width + x] = value(i);
        }
        cells
    }
}

/// Column and row of index `i` on a map `2^bits` wide.
pub fn position(i: usize, bits: u32) -> (usize, usize) {
    let (block, mut t) = (i >> (2 * bits), i & ((1 << (2 * bits)) - 1));
    let (mut x, mut y) = (0, 0);
    for j in 0..bits {
        let s = 1usize << j;
        let ry = 1 & (t >> 1);
        let rx = 1 & (t ^ ry);
        if rx == 0 {
            if ry == 1 {
                (x, y) = (s - 1 - x, s - 1 - y);
            }
            (x, y) = (y, x);
        }
        x += s * rx;
        y += s * ry;
        t >>= 2;
    }
    (x, y + (block << bits))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn consecutive_indices_touch() {
        for bits in 0..5 {
            let cells: Vec<_> = (0..3usize << (2 * bits)).map(|i| position(i, bits)).collect();
            assert_eq!(cells[0], (0, 0));
            for w in cells.windows(2) {
                assert_eq!(w[0].0.abs_diff(w[1].0) + w[0].1.abs_diff(w[1].1), 1);
            }
        }
    }
}
