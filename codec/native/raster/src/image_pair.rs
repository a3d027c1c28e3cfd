//! The two images that a loss compares.

/// Two images [H, W, 3].
#[derive(Clone, Copy)]
pub struct Pair<'a> {
    pub image: &'a [f32],
    pub target: &'a [f32],
    pub width: usize,
}

impl Pair<'_> {
    pub fn row_values(&self) -> usize {
        3 * self.width
    }
    pub fn rows(&self) -> usize {
        self.image.len() / self.row_values().max(1)
    }
}
