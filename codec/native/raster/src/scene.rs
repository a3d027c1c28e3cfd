//! Inputs and outputs of the rasterizer: Gaussians, a view, the background, gradients; flat slices in the layout of the
//! Python arrays.

use crate::error::{RasterError, check_length};
use crate::size::Size;

/// N Gaussians, parameters before activation (exp, sigmoid and normalisation happen inside).
#[derive(Clone, Copy, Default)]
pub struct Splats<'a> {
    pub means: &'a [f32],           // [N, 3]
    pub quats: &'a [f32],           // [N, 4] wxyz, any length but zero
    pub log_scales: &'a [f32],      // [N, 3]
    pub logit_opacities: &'a [f32], // [N]
    pub sh0: &'a [f32],             // [N, 3]
    pub sh_n: &'a [f32],            // [N, K, 3]
    pub sh_k: usize,                // K = 0, 3, 8 or 15
    pub turns: &'a [f32],           // [N, 4] wxyz, unit, rotations of the harmonics; empty: none
}

impl Splats<'_> {
    pub fn len(&self) -> usize {
        self.logit_opacities.len()
    }

    pub fn is_empty(&self) -> bool {
        self.logit_opacities.is_empty()
    }

    /// # Errors
    /// A length that does not belong to N Gaussians; a K that is no SH degree.
    pub fn check(&self) -> Result<(), RasterError> {
        let n = self.len();
        let k = self.sh_k;
        if !matches!(k, 0 | 3 | 8 | 15) {
            return Err(RasterError::Shape {
                name: "shN",
                expected: 15,
                got: k,
            });
        }
        if n > MAX_GAUSSIANS {
            return Err(RasterError::TooMany {
                what: "Gaussians",
                limit: MAX_GAUSSIANS,
            });
        }
        check_length("means", self.means.len(), 3 * n)?;
        check_length("quats", self.quats.len(), 4 * n)?;
        check_length("log_scales", self.log_scales.len(), 3 * n)?;
        check_length("sh0", self.sh0.len(), 3 * n)?;
        if !self.turns.is_empty() {
            check_length("turns", self.turns.len(), 4 * n)?;
        }
        check_length("shN", self.sh_n.len(), 3 * k * n)
    }
}

/// Gradients, same shapes as `Splats`.
pub struct Gradients<'a> {
    /// If true, gradients are added to the present values (of `max_weight` the larger is kept); else they overwrite
    /// them.
    pub add: bool,
    pub means: &'a mut [f32],
    pub quats: &'a mut [f32],
    pub log_scales: &'a mut [f32],
    pub logit_opacities: &'a mut [f32],
    pub sh0: &'a mut [f32],
    pub sh_n: &'a mut [f32],
    /// [N] norm of the gradient of the projected mean, in units of half the image (3DGS's densification measure).
    pub grad2d: &'a mut [f32],
    /// [N] largest blending weight alpha * transmittance over the pixels.
    pub max_weight: &'a mut [f32],
}

impl<'a> Gradients<'a> {
    pub fn reborrow(&mut self) -> Gradients<'_> {
        Gradients {
            add: self.add,
            means: self.means,
            quats: self.quats,
            log_scales: self.log_scales,
            logit_opacities: self.logit_opacities,
            sh0: self.sh0,
            sh_n: self.sh_n,
            grad2d: self.grad2d,
            max_weight: self.max_weight,
        }
    }

    /// Splits after the first `n` Gaussians.
    pub fn split_at(self, n: usize, sh_k: usize) -> (Gradients<'a>, Gradients<'a>) {
        let (means, means2) = self.means.split_at_mut(3 * n);
        let (quats, quats2) = self.quats.split_at_mut(4 * n);
        let (log_scales, log_scales2) = self.log_scales.split_at_mut(3 * n);
        let (logit_opacities, logit_opacities2) = self.logit_opacities.split_at_mut(n);
        let (sh0, sh02) = self.sh0.split_at_mut(3 * n);
        let (sh_n, sh_n2) = self.sh_n.split_at_mut(3 * sh_k * n);
        let (grad2d, grad2d2) = self.grad2d.split_at_mut(n);
        let (max_weight, max_weight2) = self.max_weight.split_at_mut(n);
        (
            Gradients {
                add: self.add,
                means,
                quats,
                log_scales,
                logit_opacities,
                sh0,
                sh_n,
                grad2d,
                max_weight,
            },
            Gradients {
                add: self.add,
                means: means2,
                quats: quats2,
                log_scales: log_scales2,
                logit_opacities: logit_opacities2,
                sh0: sh02,
                sh_n: sh_n2,
                grad2d: grad2d2,
                max_weight: max_weight2,
            },
        )
    }

    /// # Errors
    /// A length that differs from that of the parameter.
    pub fn check(&self, splats: &Splats) -> Result<(), RasterError> {
        let n = splats.len();
        check_length("gradient of means", self.means.len(), 3 * n)?;
        check_length("gradient of quats", self.quats.len(), 4 * n)?;
        check_length("gradient of log_scales", self.log_scales.len(), 3 * n)?;
        check_length("gradient of logit_opacities", self.logit_opacities.len(), n)?;
        check_length("gradient of sh0", self.sh0.len(), 3 * n)?;
        check_length("gradient of shN", self.sh_n.len(), splats.sh_n.len())?;
        check_length("grad2d", self.grad2d.len(), n)?;
        check_length("max_weight", self.max_weight.len(), n)
    }
}

/// A pinhole camera (OpenCV axes, pixel centres at half-integers).
#[derive(Clone, Copy, Debug)]
pub struct View {
    pub size: Size,
    pub focal: [f32; 2],
    pub center: [f32; 2],
    pub rotation: [[f32; 3]; 3], // world to camera
    pub translation: [f32; 3],
    pub near: f32,     // world units; Gaussians whose centre is nearer are not drawn
    pub low_pass: f32, // px^2, added to the diagonal of the 2-D covariance
}

impl View {
    /// # Errors
    /// An empty or too large image; a near plane that is not in front; a low-pass that is not above 0.
    pub fn check(&self) -> Result<(), RasterError> {
        if !(self.near > 0.0 && self.near.is_finite()) {
            return Err(RasterError::Near);
        }
        if !(self.low_pass > 0.0 && self.low_pass.is_finite()) {
            return Err(RasterError::LowPass);
        }
        check_size(self.size)
    }

    /// Position of the camera in the world.
    pub fn eye(&self) -> [f32; 3] {
        let (r, t) = (&self.rotation, &self.translation);
        std::array::from_fn(|j| -(r[0][j] * t[0] + r[1][j] * t[1] + r[2][j] * t[2]))
    }
}

/// The background colour under the Gaussians, and the exposure by which the Gaussians are multiplied.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Background {
    pub rgb: [f32; 3],
    /// Per-camera exposure: multiplies the light of the Gaussians, not the background. None: 1.
    pub gain: Option<[f32; 3]>,
}

impl Background {
    /// The colour without an exposure.
    pub fn new(rgb: [f32; 3]) -> Background {
        Background { rgb, gain: None }
    }
}

pub const MAX_SIDE: usize = 16384;
pub const MAX_GAUSSIANS: usize = 1 << 26;
/// Gaussian-tile pairs of one image; 2^28 of them take 16 GB in training.
pub const MAX_PAIRS: usize = 1 << 28;

/// See `View::check`.
pub(crate) fn check_size(size: Size) -> Result<(), RasterError> {
    if size.width == 0 || size.height == 0 {
        return Err(RasterError::Empty(size));
    }
    if size.width > MAX_SIDE || size.height > MAX_SIDE {
        return Err(RasterError::TooMany {
            what: "pixels on a side",
            limit: MAX_SIDE,
        });
    }
    Ok(())
}
