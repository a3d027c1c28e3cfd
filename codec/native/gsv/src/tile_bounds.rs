//! Bounds of tiles (spec 4): box of the visible extent of a tile's Gaussians over all frames of the group, in parts of
//! the grid.

use crate::evaluate::Evaluator;
use crate::header::Header;
use crate::parametric::Frame;
use crate::rigid_blend;

/// Corners of a box, world units.
pub type Bounds = [[f32; 3]; 2];

/// Parts of the grid along an axis; half as many lie on each side of the grid.
const PARTS: f32 = 32768.0;
const FIRST: f32 = 16384.0; // the first part of the grid
const MOST: f32 = 65535.0;
/// The box holds the extent of a Gaussian with this alpha or more.
const ALPHA: f32 = 16.0 / 255.0;

/// Side of a part, world units.
fn part(h: &Header) -> f32 {
    h.grid_step * (1u32 << h.grid_bits.min(21)) as f32 / PARTS
}

/// Sets the bounds of all tiles of a group that is coded whole.
pub fn set(e: &mut Evaluator) {
    let mut found: Vec<Vec<Bounds>> = e.group().tiles.iter().map(|t| vec![EMPTY; t.len()]).collect();
    let mut frame = Frame::default();
    for t in 0..e.group().header.frames {
        e.frame(t, &mut frame);
        let mut i = 0;
        for (k, tiles) in found.iter_mut().enumerate() {
            for (t, bounds) in tiles.iter_mut().enumerate() {
                let n = e.group().tiles[k][t] as usize;
                (i..i + n).for_each(|i| extend(bounds, &frame, i));
                i += n;
            }
        }
    }
    let h = e.header_mut();
    let (origin, part) = (h.origin, part(h));
    for (tiles, found) in h.tiles.iter_mut().zip(found) {
        for (tile, [low, high]) in tiles.iter_mut().zip(found) {
            let place = |v: f32, a: usize| ((v - origin[a]) / part + FIRST).floor().clamp(0.0, MOST) as u16;
            let (lower, upper) = (|a: usize| place(low[a], a), |a: usize| place(high[a], a));
            tile.bounds = [lower(0), lower(1), lower(2), upper(0), upper(1), upper(2)];
            if low[0] > high[0] {
                tile.bounds = [0; 6]; // no Gaussians
            }
        }
    }
}

const EMPTY: Bounds = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];

/// Extends the box by Gaussian `i`: along each axis by its standard deviation times a factor that follows from its
/// opacity.
fn extend([low, high]: &mut Bounds, f: &Frame, i: usize) {
    let opacity = 1.0 / (1.0 + (-f.logit_opacities[i]).exp());
    let reach = (2.0 * (opacity / ALPHA).ln()).max(0.0).sqrt();
    for (a, row) in rigid_blend::matrix(f.quats[i]).iter().enumerate() {
        let axis = |c: usize| row[c] * f.log_scales[3 * i + c].exp();
        let deviation = (axis(0).powi(2) + axis(1).powi(2) + axis(2).powi(2)).sqrt();
        low[a] = low[a].min(f.means[i][a] - reach * deviation);
        high[a] = high[a].max(f.means[i][a] + reach * deviation);
    }
}

/// The box of tile `t` of layer `k`; infinite where it is unbounded.
pub fn of(h: &Header, k: usize, t: usize) -> Option<Bounds> {
    let tile = h.tiles.get(k)?.get(t)?;
    let [a, b, c, d, e, f] = tile.bounds;
    let place = |axis: usize, v: f32| h.origin[axis] + part(h) * (v - FIRST);
    let lower = |axis, v: u16| {
        if v == 0 {
            f32::NEG_INFINITY
        } else {
            place(axis, f32::from(v))
        }
    };
    let upper = |axis, v: u16| {
        if v == u16::MAX {
            f32::INFINITY
        } else {
            place(axis, f32::from(v) + 1.0)
        }
    };
    Some([
        [lower(0, a), lower(1, b), lower(2, c)],
        [upper(0, d), upper(1, e), upper(2, f)],
    ])
}
