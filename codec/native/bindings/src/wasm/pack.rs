//! Gaussians -> the format of Spark (https://sparkjs.dev, `PackedSplats`), 16 bytes each, for the GPU renderer of the
//! player.
//!
//! r g b opacity, 8 bits each | x, y | z as half floats, rotation axis (octahedral, 8 bits each) | log scales, angle, 8
//! bits each. Half floats are relative to an origin in the middle of the scene, where they are most precise. Colours
//! are those of the view; Gaussians that the view does not show are left out, unless all are asked for (by programs
//! that move the camera).

use gsv::parametric::Frame;
use raster::Projected;
use std::f32::consts::PI;

/// Log scales that the 254 steps of Spark's encoding span.
const LOG_SCALE: [f32; 2] = [-12.0, 9.0];

/// Appends Gaussians of `frame` to `out`: those that the view shows, or `all` that are not transparent. `projected`:
/// all of them after projection.
pub fn pack(frame: &Frame, projected: &[Projected], origin: [f32; 3], all: bool, out: &mut Vec<u8>) {
    let shapes = frame.quats.iter().zip(frame.log_scales.as_chunks::<3>().0);
    for ((p, mean), (quat, log_scale)) in projected.iter().zip(&frame.means).zip(shapes) {
        if !(p.visible() || all && p.opaque()) {
            continue;
        }
        let [r, g, b] = p.rgb.map(unit);
        let [x, y, z] = std::array::from_fn(|i| half(mean[i] - origin[i]));
        let [u, v, angle] = rotation(*quat);
        let [s0, s1, s2] = log_scale.map(scale);
        let words = [
            [r, g, b, unit(p.log2_opacity.exp2())].map(u32::from),
            [x & 255, x >> 8, y & 255, y >> 8],
            [z & 255, z >> 8, u.into(), v.into()],
            [s0, s1, s2, angle].map(u32::from),
        ];
        out.extend(words.into_iter().flatten().map(|byte| byte as u8));
    }
}

fn unit(value: f32) -> u8 {
    (255.0 * value.clamp(0.0, 1.0)).round() as u8
}

fn scale(log: f32) -> u8 {
    let [low, high] = LOG_SCALE;
    (1.0 + (log - low) * 254.0 / (high - low)).round().clamp(1.0, 255.0) as u8
}

/// The nearest half float; larger values become the largest one.
fn half(value: f32) -> u32 {
    let bits = value.clamp(-65504.0, 65504.0).to_bits();
    let sign = bits >> 16 & 0x8000;
    let size = f32::from_bits(bits & 0x7fff_ffff);
    if size < 1.0 / 16384.0 {
        return sign | (size * 16_777_216.0).round() as u32; // subnormal: multiples of 2^-24
    }
    sign | ((size.to_bits() + 0xfff + (size.to_bits() >> 13 & 1)) >> 13).wrapping_sub(112 << 10)
}

/// Rotation axis on an octahedron unfolded to a square, and angle from 0 to pi.
fn rotation([w, x, y, z]: [f32; 4]) -> [u8; 3] {
    let sign = if w < 0.0 { -1.0 } else { 1.0 };
    let sum = x.abs() + y.abs() + z.abs();
    let inverse = if sum > 0.0 { sign / sum } else { 0.0 };
    let (mut u, mut v) = (x * inverse, y * inverse);
    if z * sign < 0.0 {
        (u, v) = ((1.0 - v.abs()) * 1f32.copysign(u), (1.0 - u.abs()) * 1f32.copysign(v));
    }
    let angle = 2.0 * (x * x + y * y + z * z).sqrt().atan2(w.abs());
    [unit(0.5 * u + 0.5), unit(0.5 * v + 0.5), unit(angle / PI)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_of_numbers_that_are_known() {
        let known = [
            (0.0, 0x0000),
            (1.0, 0x3c00),
            (-2.0, 0xc000),
            (0.1, 0x2e66),
            (65504.0, 0x7bff),
            (1e9, 0x7bff),
            (6e-8, 0x0001),
            (-3.0e-5, 0x81f7),
        ];
        for (value, bits) in known {
            assert_eq!(half(value), bits, "{value}");
        }
    }

    #[test]
    fn rotations_of_axes() {
        let s = 0.5f32.sqrt();
        assert_eq!(rotation([1.0, 0.0, 0.0, 0.0])[2], 0);
        assert_eq!(rotation([s, s, 0.0, 0.0]), [255, 128, 128]); // a quarter around x
        assert_eq!(rotation([-s, 0.0, s, 0.0]), [128, 0, 128]); // and around -y
        assert_eq!(rotation([0.0, 0.0, 0.0, 2.0]), [128, 128, 255]); // a half around z
    }
}
