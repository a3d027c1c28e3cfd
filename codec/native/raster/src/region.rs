//! The part of an image that is rendered.

/// A pixel rectangle of the view; what is rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Region {
    pub x: usize,
    pub y: usize,
    pub width: usize,
    pub height: usize,
}

impl Region {
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }
}
