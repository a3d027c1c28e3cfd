//! The ellipse of a Gaussian on the image, alpha >= ALPHA_MIN, and its exact extent within a band of rows.
//!
//! Projection, binning and blending share it, so that all of them agree which tiles and blocks a Gaussian meets.

use crate::constants::LOG2_ALPHA_MIN;
use crate::projected::SLACK;
use crate::simd::{Vector, c};

/// log2(alpha / ALPHA_MIN) at the centre, with the slack: the squared radius in units of u, v.
#[inline(always)]
pub fn reach<V: Vector>(log2_opacity: V) -> V {
    (log2_opacity - c(LOG2_ALPHA_MIN)).mul_add(c(1.0 + SLACK), c(SLACK))
}

/// u^2 + v^2 <= reach around the origin.
pub struct Ellipse<V> {
    pub l11: V,
    pub l21: V,
    pub l22: V,
    pub reach: V,
}

impl<V: Vector> Ellipse<V> {
    /// y where it is widest to the right: -l21 sqrt(reach) / (l22 sqrt(l21^2 + l22^2))
    #[inline(always)]
    pub fn peak(&self) -> V {
        let norm = self.l21.mul_add(self.l21, self.l22 * self.l22);
        -(self.l21 * (self.reach / norm).sqrt() / self.l22)
    }

    /// Whether it meets the rows from `top` to `bottom`, and its ends there, times l11.
    #[inline(always)]
    pub fn span(&self, peak: V, top: V, bottom: V) -> (V::Mask, V, V) {
        let zero = c(0.0);
        let (yr, yl) = (peak.max(top).min(bottom), (-peak).max(top).min(bottom));
        let (vr, vl) = (self.l22 * yr, self.l22 * yl);
        let (hr, hl) = (vr.neg_mul_add(vr, self.reach), vl.neg_mul_add(vl, self.reach));
        let right = self.l21.neg_mul_add(yr, hr.max(zero).sqrt());
        let left = self.l21.neg_mul_add(yl, -hl.max(zero).sqrt());
        (hr.ge(zero) & hl.ge(zero), left, right)
    }
}
