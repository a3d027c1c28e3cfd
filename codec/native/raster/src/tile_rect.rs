//! A rectangle of tiles, and which of them the ellipse of a Gaussian meets.

use std::ops::Range;

use crate::ellipse::{Ellipse, reach};
use crate::projected::{MANY, Projected, SLACK, TILE};
use crate::size::Size;

/// A rectangle of tiles.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TileRect {
    pub columns: Range<usize>,
    pub rows: Range<usize>,
}

impl TileRect {
    /// The tiles that cover an image.
    pub fn of(size: Size) -> TileRect {
        TileRect {
            columns: 0..size.width.div_ceil(TILE),
            rows: 0..size.height.div_ceil(TILE),
        }
    }

    pub fn len(&self) -> usize {
        self.columns.len() * self.rows.len()
    }

    /// Two halves; None for a single tile.
    pub fn halves(&self) -> Option<[TileRect; 2]> {
        let half = |r: &Range<usize>| (r.start..r.start + r.len() / 2, r.start + r.len() / 2..r.end);
        let (columns, rows) = (self.columns.clone(), self.rows.clone());
        if rows.len() > 1 {
            let (top, bottom) = half(&rows);
            let left = columns.clone();
            Some([
                TileRect {
                    columns: left,
                    rows: top,
                },
                TileRect { columns, rows: bottom },
            ])
        } else if columns.len() > 1 {
            let (left, right) = half(&columns);
            let all = rows.clone();
            Some([
                TileRect {
                    columns: left,
                    rows: all,
                },
                TileRect { columns: right, rows },
            ])
        } else {
            None
        }
    }
}

/// Calls `visit(tile)` for each of the tiles in which the ellipse of `p` meets a pixel centre.
#[inline(always)]
pub fn for_tiles(p: &Projected, tiles: &TileRect, mut visit: impl FnMut(usize)) {
    let [x0, x1, y0, y1] = p.tiles.map(usize::from);
    let (x0, y0) = (x0.max(tiles.columns.start), y0.max(tiles.rows.start));
    let (x1, y1) = (x1.min(tiles.columns.end - 1), y1.min(tiles.rows.end - 1));
    let start = |row: usize| (row - tiles.rows.start) * tiles.columns.len();
    if p.met != MANY {
        let first = [usize::from(p.tiles[0]), usize::from(p.tiles[2])];
        for row in y0..=y1 {
            for column in x0..=x1 {
                if p.met >> (2 * (row - first[1]) + column - first[0]) & 1 == 1 {
                    visit(start(row) + column - tiles.columns.start);
                }
            }
        }
        return;
    }
    let ellipse = Ellipse {
        l11: p.l11,
        l21: p.l21,
        l22: p.l22,
        reach: reach(p.log2_opacity),
    };
    let peak = ellipse.peak();
    let tile = |v: f32| v.max(0.0) as usize / TILE;
    for row in y0..=y1 {
        let top = (row * TILE) as f32 + 0.5 - p.y;
        let (met, left, right) = ellipse.span(peak, top, top + (TILE - 1) as f32);
        if met {
            let first = tile(p.x + left / p.l11 - SLACK + 0.5);
            let last = tile(p.x + right / p.l11 + SLACK - 0.5);
            for column in first.max(x0)..=last.min(x1) {
                visit(start(row) + column - tiles.columns.start);
            }
        }
    }
}
