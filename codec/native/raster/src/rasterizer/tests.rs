//! The rasterizer as a whole: its levels against each other, and its memory.

use super::*;
use crate::scene::Gradients;

/// `n` round splats of the given scale on a line that winds through the view, and a camera of size x size pixels.
fn draw(n: usize, log_scale: f32, size: usize, training: bool) -> Rasterizer {
    draw_at(SimdLevel::best(), n, log_scale, size, training).0
}

/// The same, and the gradient of the means if `training`.
fn draw_at(level: SimdLevel, n: usize, log_scale: f32, size: usize, training: bool) -> (Rasterizer, Vec<f32>) {
    let t = |i: usize| i as f32 / n as f32;
    let means: Vec<f32> = (0..n)
        .flat_map(|i| [(9.0 * t(i)).sin(), t(i) - 0.5, 3.0 + t(i)])
        .collect();
    let splats = Splats {
        means: &means,
        quats: &[1.0, 0.0, 0.0, 0.0].repeat(n),
        log_scales: &vec![log_scale; 3 * n],
        logit_opacities: &vec![-3.0; n],
        sh0: &(0..3 * n).map(|i| (i as f32).sin()).collect::<Vec<f32>>(),
        sh_n: &[],
        sh_k: 0,
        turns: &[],
    };
    let view = View {
        size: Size {
            width: size,
            height: size,
        },
        focal: [size as f32; 2],
        center: [0.5 * size as f32; 2],
        rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        translation: [0.0; 3],
        near: crate::constants::NEAR,
        low_pass: crate::constants::LOW_PASS,
    };
    let mut r = Rasterizer::new(level, 0);
    r.forward(&splats, &view, Background::new([0.1, 0.2, 0.3]), training, training)
        .unwrap();
    let mut grads = [3, 4, 3, 1, 3, 0, 1, 1].map(|d| vec![0.0; d * n]);
    if training {
        let [means, quats, log_scales, logit_opacities, sh0, sh_n, grad2d, max_weight] = &mut grads;
        let mut out = Gradients {
            add: false,
            means,
            quats,
            log_scales,
            logit_opacities,
            sh0,
            sh_n,
            grad2d,
            max_weight,
        };
        let slope: Vec<f32> = (0..3 * size * size).map(|i| (0.1 * i as f32).sin()).collect();
        let (grad_alpha, grad_depth) = (&slope[..size * size], &slope[size * size..2 * size * size]);
        r.backward(&splats, &slope, grad_alpha, grad_depth, &mut out).unwrap();
    }
    let [means, ..] = grads;
    (r, means)
}

#[test]
fn every_level_draws_and_differentiates_like_scalar() {
    let (want, slopes) = draw_at(SimdLevel::SCALAR, 300, -3.0, 90, true);
    let largest = slopes.iter().fold(0.0f32, |m, s| m.max(s.abs()));
    assert!(largest > 0.0);
    for level in SimdLevel::available() {
        let (got, other) = draw_at(level, 300, -3.0, 90, true);
        let image = got.image.iter().zip(&want.image);
        assert!(image.clone().all(|(a, b)| (a - b).abs() < 1e-4), "{}", level.name());
        let depth = got.depth.iter().zip(&want.depth);
        assert!(depth.clone().all(|(a, b)| (a - b).abs() < 4e-4), "{}", level.name());
        let near = other.iter().zip(&slopes).all(|(a, b)| (a - b).abs() < 1e-3 * largest);
        assert!(near, "{}", level.name());
    }
}

#[test]
fn splats_that_fill_the_screen_are_drawn_in_parts_of_bounded_memory() {
    let (n, size) = (600, 1000);
    let (parts, whole) = (draw(n, 1.0, size, false), draw(n, 1.0, size, true));
    assert!(whole.bins.pairs.len() > PAIRS_FREE && parts.bins.pairs.len() < PAIRS_FREE);
    assert!(parts.image == whole.image && parts.alpha == whole.alpha);
    // 8 bytes a pair, in vectors that may have grown to twice their length
    assert!(
        parts.memory() < 200 * n + 16 * size * size + 2 * 8 * PAIRS_FREE,
        "{}",
        parts.memory()
    );
}

#[test]
fn small_splats_take_less_than_200_bytes() {
    let (n, size) = (100_000, 256);
    let memory = draw(n, -6.0, size, false).memory();
    assert!(memory < 200 * n + 16 * size * size, "{memory}");
}
