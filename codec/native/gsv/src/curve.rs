//! Curves (spec 13.1): a channel's coded value -> its value, along a line of pieces that always rises.
//!
//! Where values matter less, as the size of what is smaller than a pixel does, a step of the integer is a larger one of the value.

use crate::error::Result;
use crate::fields::Fields;

/// Pieces of a curve.
pub const PIECES: usize = 8;

/// Pieces as wide as `width` from the coded value `low` on, where the value is `low` too; the first and the last go on.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Curve {
    pub low: f32,
    pub width: f32,
    /// A piece rises by 2^(slope / 16).
    pub slopes: [u8; PIECES],
}

/// A curve made ready: where each piece starts, coded and as a value, and how it rises.
pub struct Pieces {
    low: f32,
    width: f32,
    starts: [[f32; 3]; PIECES],
}

impl Curve {
    pub fn fields<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        f.f32(&mut self.low, "low of a curve")?;
        f.step(&mut self.width, "width of a curve")?;
        f.bytes(&mut self.slopes)
    }

    pub fn pieces(&self) -> Pieces {
        let mut value = self.low;
        let start = |j: usize| {
            let (from, rise) = (value, (f32::from(self.slopes[j]) / 16.0).exp2());
            value += rise * self.width;
            [self.low + j as f32 * self.width, from, rise]
        };
        Pieces {
            low: self.low,
            width: self.width,
            starts: std::array::from_fn(start),
        }
    }
}

impl Pieces {
    #[inline]
    pub fn value(&self, coded: f32) -> f32 {
        let piece = ((coded - self.low) / self.width) as usize; // 0 below
        let [start, value, rise] = self.starts[piece.min(PIECES - 1)];
        value + rise * (coded - start)
    }
}
