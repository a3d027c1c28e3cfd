//! The constants of rendering. They are normative (the bitstream specification repeats them), because two players that
//! differ here show different pictures. Everything else in this crate is free to change.

/// Default low-pass of a view, px^2: added to the diagonal of the 2-D covariance (3D Gaussian Splatting).
pub const LOW_PASS: f32 = 0.3;
/// x/z and y/z inside the Jacobian are clamped to the image edge plus this share of half the field of view (1.3x in
/// all).
pub const FOV_MARGIN: f32 = 0.3;
/// Default near plane of a view, world units: Gaussians whose centre is nearer are not drawn.
pub const NEAR: f32 = 0.01;
/// A Gaussian adds nothing to a pixel where its alpha is below this.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// log2(ALPHA_MIN)
pub const LOG2_ALPHA_MIN: f32 = -7.994_353_4;
pub const ALPHA_MAX: f32 = 0.999;
/// A pixel is finished before the first Gaussian that would bring its transmittance below this.
pub const TRANSMITTANCE_STOP: f32 = 1e-4;
