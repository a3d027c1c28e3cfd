//! Every operation of every instance against the standard library.
use super::*;

fn check_functions<V: Vector>() -> [f32; 4] {
    let mut worst = [0.0f32; 4];
    for i in 0..4000 {
        let x = -60.0 + 0.03 * i as f32;
        let at = |v: V| {
            let mut a = [0.0; 16];
            v.store(&mut a);
            a[V::LANES - 1]
        };
        let up = at(V::splat(x).exp2());
        worst[0] = worst[0].max((f64::from(up) / f64::from(x).exp2() - 1.0).abs() as f32);
        let y = x.exp2();
        worst[1] =
            worst[1].max((f64::from(at(V::splat(y).log2())) - f64::from(y).log2()).abs() as f32 / x.abs().max(1.0));
        worst[2] = worst[2].max((at(V::splat(y).recip()) * y - 1.0).abs());
        let v: [V; 12] = std::array::from_fn(|k| V::splat(x + k as f32));
        let mut sums = [0.0; 12];
        V::sum12(&v, &mut sums);
        for (k, s) in sums.iter().enumerate() {
            let want = (x + k as f32) * V::LANES as f32;
            worst[3] = worst[3].max((s - want).abs() / (1.0 + want.abs()));
        }
    }
    worst
}

fn run<V: Vector>(out: &mut [f32; 4]) {
    *out = check_functions::<V>();
}
dispatch!(fn run_at = run(out: &mut [f32; 4]));

#[test]
fn functions_are_accurate_at_every_level() {
    for level in SimdLevel::available() {
        let mut worst = [1.0; 4];
        run_at(level, &mut worst);
        assert!(worst.iter().all(|&w| w < 5e-6), "{}: {worst:?}", level.name());
    }
}

fn lanes<V: Vector>(x: &[f32], out: &mut Vec<f32>) {
    let mut row = [0.0; 16];
    for c in x.chunks_exact(V::LANES) {
        let v = V::load(c);
        let m = v.ge(V::splat(0.25)) & !v.ge(V::splat(0.75));
        (v * v - V::splat(1.0)).select(m, -v.sqrt()).store(&mut row);
        out.extend_from_slice(&row[..V::LANES]);
        out.push(v.max_lane());
    }
}
dispatch!(fn lanes_at = lanes(x: &[f32], out: &mut Vec<f32>));

#[test]
fn masks_select_the_right_lanes() {
    let x: Vec<f32> = (0..64).map(|i| (i as f32 * 0.618_034).fract()).collect();
    for level in SimdLevel::available() {
        let mut out = Vec::new();
        lanes_at(level, &x, &mut out);
        let width = x.len() / (out.len() - x.len());
        for (row, got) in x.chunks(width).zip(out.chunks(width + 1)) {
            assert_eq!(got[width], row.iter().copied().fold(0.0, f32::max));
        }
        for (i, &v) in x.iter().enumerate() {
            let got = out[i + i / width];
            let want = if (0.25..0.75).contains(&v) {
                v * v - 1.0
            } else {
                -v.sqrt()
            };
            assert!((got - want).abs() < 1e-6, "{} lane {i}: {got} {want}", level.name());
        }
    }
}

#[test]
fn exp2_of_extremes_is_zero_infinity_or_nan() {
    fn extremes<V: Vector>(out: &mut [f32; 3]) {
        let mut row = [0.0; 16];
        for (o, x) in out.iter_mut().zip([-1e30, 1e30, f32::NAN]) {
            V::splat(x).exp2().store(&mut row);
            *o = row[0];
        }
    }
    dispatch!(fn extremes_at = extremes(out: &mut [f32; 3]));
    for level in SimdLevel::available() {
        let mut out = [1.0; 3];
        extremes_at(level, &mut out);
        assert!(
            out[0] == 0.0 && out[1] == f32::INFINITY && out[2].is_nan(),
            "{} {out:?}",
            level.name()
        );
    }
}
