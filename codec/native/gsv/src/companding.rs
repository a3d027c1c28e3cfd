//! Companding (spec 13.1): dequantized value of a channel -> expanded value, by an increasing piecewise linear
//! function.
//!
//! In: `offset + step * integer` of log_scales and logit_opacities; out: the value that is rendered. A steep piece
//! makes the quantization coarser where errors are less visible, for instance in the scales of Gaussians smaller than a
//! pixel.

use crate::error::Result;
use crate::fields::Fields;

/// Pieces of the function.
pub const PIECES: usize = 8;

/// The syntax elements of one channel. The first piece extends below `low`, the last one above the end.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Companding {
    /// Where the first piece starts; the expanded value there is `low` too.
    pub low: f32,
    /// Width of each piece before expansion, > 0.
    pub width: f32,
    /// Piece j has slope 2^(slopes[j] / 16).
    pub slopes: [u8; PIECES],
}

/// `Companding` prepared for evaluation.
pub struct CompandingTable {
    low: f32,
    width: f32,
    /// Per piece: start before expansion, start after it, slope.
    pieces: [[f32; 3]; PIECES],
}

impl Companding {
    /// Reads or writes the syntax elements (spec 4).
    pub fn fields<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        f.f32(&mut self.low, "companding low")?;
        f.step(&mut self.width, "companding width")?;
        f.bytes(&mut self.slopes)
    }

    pub fn table(&self) -> CompandingTable {
        let mut value = self.low;
        let piece = |j: usize| {
            let (start, slope) = (value, (f32::from(self.slopes[j]) / 16.0).exp2());
            value += slope * self.width;
            [self.low + j as f32 * self.width, start, slope]
        };
        CompandingTable {
            low: self.low,
            width: self.width,
            pieces: std::array::from_fn(piece),
        }
    }
}

impl CompandingTable {
    /// The expanded value (`expand` of spec 13.1).
    #[inline]
    pub fn expand(&self, coded: f32) -> f32 {
        let piece = ((coded - self.low) / self.width) as usize; // saturates at 0 below `low`
        let [start, value, slope] = self.pieces[piece.min(PIECES - 1)];
        value + slope * (coded - start)
    }
}
