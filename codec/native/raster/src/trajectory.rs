//! Coefficients of temporal trajectories in training: their sum at one frame with rounded coefficients, as the decoder
//! has it, and one step of Adam along the gradient by that sum and by the bits of the coefficients, in one pass over
//! memory.
//!
//! An attribute has K coefficients of V values each, `[K, V]`. Bits are code lengths under a Laplace distribution for
//! each of the K, with uniform noise in place of rounding.

use rayon::prelude::*;

use crate::adam::Adam;
use crate::error::{RasterError, check_length};
use crate::ewa::exp;
use crate::simd::{MAGIC, SimdLevel, Vector, c, dispatch};

/// Values of one task.
const SHARE: usize = 1 << 12;
const LN_2: f32 = std::f32::consts::LN_2;
const LOG2_E: f32 = std::f32::consts::LOG2_E;

/// The weight of the coefficients' bits in the loss.
#[derive(Clone, Copy, Debug)]
pub struct BitPrice<'a> {
    /// Loss of one bit.
    pub weight: f32,
    /// [K], scale of the Laplace distribution of each.
    pub scales: &'a [f32],
    /// At least V + K - 1 uniform values in -0.5 .. 0.5; coefficient k takes those from k on.
    pub noise: &'a [f32],
}

/// [K, V] coefficients of one attribute, and the moments of Adam: the first [K, V], the second [V].
///
/// The gradient by coefficient k at a frame is `at[k]` times that by the sum, and the mean square of `at[k]` over the
/// frames is the same for all k of an orthonormal transform. So the K share one second moment: their mean square.
pub struct Trajectories<'a> {
    pub values: &'a mut [f32],
    pub first: &'a mut [f32],
    pub second: &'a mut [f32],
}

/// sum over k of at[k] * rounded(values[k]) -> out [V]; rounded(v) = sign(v) round(max(|v| - dead_zone, 0)).
///
/// # Errors
/// Lengths that disagree.
pub fn sum_at(
    level: SimdLevel,
    values: &[f32],
    at: &[f32],
    dead_zone: f32,
    out: &mut [f32],
) -> Result<(), RasterError> {
    let count = out.len();
    check_length("coefficients", values.len(), at.len() * count)?;
    out.par_chunks_mut(SHARE).enumerate().for_each(|(i, out)| {
        out.fill(0.0);
        for (k, &a) in at.iter().enumerate() {
            let from = k * count + i * SHARE;
            add_rounded(level, &values[from..from + out.len()], a, dead_zone, out);
        }
    });
    Ok(())
}

#[inline(always)]
fn add_rounded_lanes<V: Vector>(i: usize, values: &[f32], at: f32, dead_zone: f32, out: &mut [f32]) {
    let v = V::load(&values[i..]);
    let size = ((v.abs() - c(dead_zone)).max(c(0.0)) + c(MAGIC)) - c(MAGIC);
    let signed = (-size).select(v.lt(c(0.0)), size);
    signed.mul_add(c(at), V::load(&out[i..])).store(&mut out[i..]);
}

#[inline(always)]
fn add_rounded_kernel<V: Vector>(values: &[f32], at: f32, dead_zone: f32, out: &mut [f32]) {
    let whole = out.len() / V::LANES * V::LANES;
    for i in (0..whole).step_by(V::LANES) {
        add_rounded_lanes::<V>(i, values, at, dead_zone, out);
    }
    for i in whole..out.len() {
        add_rounded_lanes::<f32>(i, values, at, dead_zone, out);
    }
}
dispatch!(fn add_rounded = add_rounded_kernel(values: &[f32], at: f32, dead_zone: f32, out: &mut [f32]));

/// One step of Adam. `grad` [V] is the gradient by the sum at a frame; that by coefficient k is `at[k]` times it.
///
/// Returns the bits of each of the K and their derivative by the log of its scale, both unweighted; 0 without a price.
///
/// # Errors
/// Lengths that disagree.
pub fn step(
    level: SimdLevel,
    adam: Adam,
    t: Trajectories,
    at: &[f32],
    grad: &[f32],
    price: Option<BitPrice>,
) -> Result<Vec<[f64; 2]>, RasterError> {
    let count = grad.len();
    check_length("coefficients", t.values.len(), at.len() * count)?;
    check_length("first moment", t.first.len(), at.len() * count)?;
    check_length("second moment", t.second.len(), count)?;
    if let Some(p) = price {
        check_length("scales", p.scales.len(), at.len())?;
        if p.noise.len() + 1 < count + at.len() {
            check_length("noise", p.noise.len(), count + at.len() - 1)?;
        }
    }
    if count == 0 || at.is_empty() {
        return Ok(vec![[0.0; 2]; at.len()]);
    }
    let mut shares: Vec<Share> = t
        .second
        .chunks_mut(SHARE)
        .zip(grad.chunks(SHARE))
        .map(|(second, grad)| Share {
            second,
            grad,
            rows: Vec::with_capacity(at.len()),
        })
        .collect();
    for (values, first) in t.values.chunks_mut(count).zip(t.first.chunks_mut(count)) {
        for ((share, values), first) in shares
            .iter_mut()
            .zip(values.chunks_mut(SHARE))
            .zip(first.chunks_mut(SHARE))
        {
            share.rows.push((values, first));
        }
    }
    let sums: Vec<Vec<[f64; 2]>> = shares
        .into_par_iter()
        .enumerate()
        .map(|(i, share)| share.step(level, adam, at, price, i * SHARE))
        .collect();
    let add = |k: usize| sums.iter().fold([0.0; 2], |a, b| [a[0] + b[k][0], a[1] + b[k][1]]);
    Ok((0..at.len()).map(add).collect()) // in order: the same on any number of threads
}

/// A part of the V: their second moments, their gradient, and values and first moments of each coefficient.
struct Share<'a> {
    second: &'a mut [f32],
    grad: &'a [f32],
    rows: Vec<(&'a mut [f32], &'a mut [f32])>,
}

impl Share<'_> {
    /// One step of these values, which begin at `from`.
    fn step(mut self, level: SimdLevel, adam: Adam, at: &[f32], price: Option<BitPrice>, from: usize) -> Vec<[f64; 2]> {
        let count = self.grad.len();
        let mut sums = vec![[0.0; 2]; at.len()];
        let mut by_bits = vec![0.0; price.map_or(0, |_| at.len() * count)]; // weighted gradients by the bits
        let mut rate = vec![0.0; count];
        let (mut square, mut cross) = (at.iter().map(|a| a * a).sum::<f32>(), vec![]);
        if let Some(p) = price {
            cross = vec![0.0; count];
            rate.fill(0.0);
            for (k, (by, (values, _))) in by_bits.chunks_mut(count).zip(&self.rows).enumerate() {
                sums[k] = bits(level, values, &p.noise[k + from..][..count], p.scales[k], p.weight, by);
                for ((r, c), b) in rate.iter_mut().zip(&mut cross).zip(by) {
                    *r += *b * *b;
                    *c += at[k] * *b;
                }
            }
        }
        let share = 1.0 / at.len() as f32;
        square *= share;
        for (i, (v, g)) in self.second.iter_mut().zip(self.grad).enumerate() {
            let by = cross.get(i).map_or(0.0, |c| share * (rate[i] + 2.0 * c * g));
            *v = adam.betas[1] * *v + (1.0 - adam.betas[1]) * (square * g * g + by).max(0.0);
            rate[i] = adam.rate / ((*v * adam.correction).sqrt() + adam.epsilon);
        }
        for (k, (values, first)) in self.rows.iter_mut().enumerate() {
            let by = by_bits.get(k * count..(k + 1) * count);
            advance(level, adam.betas[0], at[k], self.grad, by, &rate, first, values);
        }
        sums
    }
}

#[inline(always)]
#[allow(clippy::too_many_arguments)] // a kernel over five arrays
fn advance_lanes<V: Vector>(
    i: usize,
    beta: f32,
    at: f32,
    grad: &[f32],
    by_bits: Option<&[f32]>,
    rate: &[f32],
    first: &mut [f32],
    values: &mut [f32],
) {
    let mut g = V::load(&grad[i..]) * c(at);
    if let Some(by) = by_bits {
        g = g + V::load(&by[i..]);
    }
    let m = V::load(&first[i..]);
    let m = c::<V>(1.0 - beta).mul_add(g - m, m);
    m.store(&mut first[i..]);
    V::load(&rate[i..])
        .neg_mul_add(m, V::load(&values[i..]))
        .store(&mut values[i..]);
}

/// The first moment and the values of one coefficient, `rate` [V] being the learning rate of each value.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn advance_kernel<V: Vector>(
    beta: f32,
    at: f32,
    grad: &[f32],
    by_bits: Option<&[f32]>,
    rate: &[f32],
    first: &mut [f32],
    values: &mut [f32],
) {
    let whole = values.len() / V::LANES * V::LANES;
    for i in (0..whole).step_by(V::LANES) {
        advance_lanes::<V>(i, beta, at, grad, by_bits, rate, first, values);
    }
    for i in whole..values.len() {
        advance_lanes::<f32>(i, beta, at, grad, by_bits, rate, first, values);
    }
}
dispatch!(fn advance = advance_kernel(beta: f32, at: f32, grad: &[f32], by_bits: Option<&[f32]>, rate: &[f32], first: &mut [f32], values: &mut [f32]));

/// The bits of some coefficients and their derivative by the log of the scale; `weight` times their derivative by each
/// value -> out.
#[inline(always)]
fn bits_kernel<V: Vector>(values: &[f32], noise: &[f32], scale: f32, weight: f32, out: &mut [f32]) -> [f64; 2] {
    let law = Laplace::new(scale);
    let mut sums = [0.0f64; 2];
    let whole = values.len() / V::LANES * V::LANES;
    let mut lanes = [[0.0f32; 16]; 2];
    for i in (0..whole).step_by(V::LANES) {
        let (bits, by_value, by_scale) = law.bits::<V>(V::load(&values[i..]) + V::load(&noise[i..]));
        (by_value * c(weight)).store(&mut out[i..]);
        bits.store(&mut lanes[0]);
        by_scale.store(&mut lanes[1]);
        for (sum, lanes) in sums.iter_mut().zip(&lanes) {
            *sum += f64::from(lanes[..V::LANES].iter().sum::<f32>());
        }
    }
    for i in whole..values.len() {
        let (bits, by_value, by_scale) = law.bits::<f32>(values[i] + noise[i]);
        out[i] = weight * by_value;
        sums[0] += f64::from(bits);
        sums[1] += f64::from(by_scale);
    }
    sums
}
dispatch!(fn bits = bits_kernel(values: &[f32], noise: &[f32], scale: f32, weight: f32, out: &mut [f32]) -> [f64; 2]);

/// Laplace distribution of mean 0 over unit intervals.
struct Laplace {
    rate: f32,   // 1 / scale
    beyond: f32, // 1 - exp(-rate)
    log2_beyond: f32,
}

impl Laplace {
    fn new(scale: f32) -> Laplace {
        let rate = 1.0 / scale;
        let beyond = -(-rate).exp_m1();
        Laplace {
            rate,
            beyond,
            log2_beyond: beyond.log2(),
        }
    }

    /// Bits of the unit interval around x, their derivative by x, and that by the log of the scale.
    #[inline(always)]
    fn bits<V: Vector>(&self, x: V) -> (V, V, V) {
        let (rate, half) = (c::<V>(self.rate), c::<V>(0.5));
        let a = x.abs();
        let near = a.min(half);
        let (rising, falling) = (exp((near - half) * rate), exp(-(near + half) * rate));
        let p = half.neg_mul_add(rising + falling, c(1.0)).max(c(1e-9));
        let off = (a - half) * rate;
        let inside = a.lt(half);
        let share = rate * c(0.5 * LOG2_E) / p;
        let bits = (-p.log2()).select(inside, off.mul_add(c(LOG2_E), c(1.0 - self.log2_beyond)));
        let by_x = (share * (rising - falling)).select(inside, rate * c(LOG2_E));
        let by_x = (-by_x).select(x.lt(c(0.0)), by_x);
        let tail = c::<V>(self.rate * (1.0 - self.beyond) / self.beyond / LN_2) - off * c(LOG2_E);
        let middle = share * rising.mul_add(half - near, falling * (half + near));
        (bits, by_x, middle.select(inside, tail))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_agree_and_derivatives_are_differences() {
        let (count, at) = (10_007, [0.7f32, -0.3, 0.2]);
        let values: Vec<f32> = (0..3 * count).map(|i| 4.0 * (i as f32).sin()).collect();
        let noise: Vec<f32> = (0..count + 2).map(|i| (i as f32 * 0.618).fract() - 0.5).collect();
        let grad: Vec<f32> = (0..count).map(|i| (i as f32 * 0.1).cos()).collect();
        let run = |level| {
            let mut out = vec![0.0; count];
            sum_at(level, &values, &at, 0.1, &mut out).unwrap();
            let (mut moved, mut first, mut second) = (values.clone(), vec![0.0; 3 * count], vec![0.0; count]);
            let adam = Adam {
                betas: [0.9, 0.999],
                epsilon: 1e-8,
                rate: 0.5,
                correction: 1000.0,
            };
            let t = Trajectories {
                values: &mut moved,
                first: &mut first,
                second: &mut second,
            };
            let price = BitPrice {
                weight: 0.1,
                scales: &[0.3, 1.0, 3.0],
                noise: &noise,
            };
            (out, step(level, adam, t, &at, &grad, Some(price)).unwrap(), moved)
        };
        let scalar = run(SimdLevel::SCALAR);
        for i in 0..count {
            let rounded = |v: f32| v.signum() * (v.abs() - 0.1).max(0.0).round_ties_even();
            let expected: f32 = (0..3).map(|k| at[k] * rounded(values[k * count + i])).sum();
            assert!((scalar.0[i] - expected).abs() < 1e-4);
        }
        for level in SimdLevel::available() {
            let other = run(level);
            assert!(other.0.iter().zip(&scalar.0).all(|(a, b)| (a - b).abs() < 1e-4));
            assert!(other.2.iter().zip(&scalar.2).all(|(a, b)| (a - b).abs() < 1e-2));
            for (a, b) in other.1.iter().flatten().zip(scalar.1.iter().flatten()) {
                assert!((a - b).abs() < 1e-3 * b.abs().max(1.0), "{a} {b}");
            }
        }
        let reference = |x: f64, scale: f64| {
            let below = |x: f64| {
                if x < 0.0 {
                    0.5 * (x / scale).exp()
                } else {
                    1.0 - 0.5 * (-x / scale).exp()
                }
            };
            -(below(x + 0.5) - below(x - 0.5)).log2()
        };
        for (x, scale) in [(0.2f32, 0.5f32), (-0.4, 2.0), (1.3, 0.7), (-2.6, 3.0)] {
            let (bits, by_x, by_scale) = Laplace::new(scale).bits::<f32>(x);
            let (x, s) = (f64::from(x), f64::from(scale));
            let by = [
                (reference(x + 1e-4, s) - reference(x - 1e-4, s)) / 2e-4,
                (reference(x, s * 1e-4f64.exp()) - reference(x, s * (-1e-4f64).exp())) / 2e-4,
            ];
            assert!((f64::from(bits) - reference(x, s)).abs() < 1e-4);
            assert!((f64::from(by_x) - by[0]).abs() < 1e-3 && (f64::from(by_scale) - by[1]).abs() < 1e-3);
        }
    }
}
