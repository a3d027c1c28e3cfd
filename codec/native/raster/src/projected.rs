//! A Gaussian after projection, and the tile grid that it refers to. Binning, blending and gradients read it.

use crate::constants::LOG2_ALPHA_MIN;

/// Side of a tile in pixels.
pub const TILE: usize = 16;
/// Relative and absolute margin of the box and the ellipse, so that rounding never loses a pixel that blending would
/// draw.
pub const SLACK: f32 = 1e-3;

/// A Gaussian on the image; x and y in pixels.
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
    /// Mask of the tiles that the ellipse meets, if the box meets at most 2 x 2: bit 2 row + column, relative to the
    /// first tile. Else `MANY`.
    pub met: u16,
}

/// `met` where the box covers more than 2 x 2 tiles.
pub const MANY: u16 = 1 << 4;

impl Projected {
    pub fn visible(&self) -> bool {
        self.rx >= 0.0
    }

    /// Whether the opacity reaches ALPHA_MIN, so that some view can show it.
    pub fn opaque(&self) -> bool {
        self.log2_opacity >= LOG2_ALPHA_MIN
    }

    /// Larger half side of the box in pixels, 0 if invisible.
    pub fn radius(&self) -> f32 {
        if self.visible() { self.rx.max(self.ry) } else { 0.0 }
    }
}
