//! The part of an image that is rendered.

/// A rectangle of pixels of the view.
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
