//! Hilbert layout (spec 7.2): index of a Gaussian -> cell of the W x H map in which channels are shown.
//!
//! The map is a column of W x W squares, each filled along a Hilbert curve that ends where the next square begins. So a tile,
//! a power of four of cells, is a square of the map.
//! Consecutive indices are neighbours in space (Morton order), so neighbours in space are near each other on the map.

/// The map of a layer in tiles.
pub struct HilbertLayout<'a> {
    pub width: usize,
    pub height: usize,
    tiles: &'a [u32],
    cells: usize,
    bits: u32,
}

/// log2 of the map width that spec 7.2 prescribes.
pub fn width_log2(n: usize) -> u32 {
    n.checked_ilog2().unwrap_or(0) >> 1
}

impl HilbertLayout<'_> {
    /// `tiles`: the Gaussians of each; `cells`: most of a tile.
    pub fn new(tiles: &[u32], cells: usize) -> HilbertLayout<'_> {
        let last = tiles.last().map_or(0, |n| *n as usize);
        let count = tiles.len().saturating_sub(1) * cells + last;
        let bits = width_log2(count);
        let width = 1usize << bits;
        HilbertLayout {
            width,
            height: count.div_ceil(width * width) * width,
            tiles,
            cells,
            bits,
        }
    }

    /// Column and row of each Gaussian of the layer.
    pub fn cells(&self) -> Vec<(usize, usize)> {
        let tiles = self.tiles.iter().enumerate();
        let places = tiles.flat_map(|(t, n)| (0..*n as usize).map(move |i| t * self.cells + i));
        places.map(|i| position(i, self.bits)).collect()
    }

    /// [H, W] in raster order: `value(i)` at the cell of Gaussian i of the layer, 0 in cells without one.
    pub fn arrange(&self, value: impl Fn(usize) -> i32) -> Vec<i32> {
        let mut cells = vec![0; self.width * self.height];
        for (i, (x, y)) in self.cells().into_iter().enumerate() {
            if let Some(cell) = cells.get_mut(y * self.width + x) {
                *cell = value(i);
            }
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
