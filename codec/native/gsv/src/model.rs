//! Adaptive binary models (spec 6.2 to 6.4): a bin in two contexts -> its probability, in integers only.
//!
//! Two counters, each chosen by its own context, are mixed in the logistic domain with weights that adapt too (as in PAQ by
//! Mahoney). Two separate contexts learn faster than one joint context, which would spread the same bins over more counters.

use crate::range_coder::Bins;
use std::sync::LazyLock;

/// 65536 / (1 + exp(-x/2)), x = 0..=24: knots of the logistic curve at half units (spec 6.3).
#[rustfmt::skip]
const KNOTS: [i32; 25] = [
    32768, 40793, 47911, 53581, 57724, 60565, 62428, 63615, 64357, 64816, 65097, 65269, 65374, 65438, 65476, 65500,
    65514, 65523, 65528, 65531, 65533, 65534, 65535, 65535, 65536,
];
/// The logistic domain: units of 1/256, -12 to 12 exclusive.
const STRETCH_MAX: i32 = 12 * 256 - 1;
/// Probabilities of mixed bins, times 65536, stay in `P_MIN..=65536 - P_MIN`.
const P_MIN: i32 = 16;
/// Bins after which a counter stops slowing down.
const AGE_MAX: u32 = 255;
/// The same in a model that another tile starts from.
const AGE_SETTLED: u32 = 20;
/// Initial weight of each counter, 0.4, and the range of weights, in 1/65536.
const WEIGHT_NEW: i32 = 26214;
const WEIGHT_MAX: i32 = 4 << 16;

/// Logistic domain -> probability times 65536, 0 to 65536.
fn curve(x: i32) -> i32 {
    let x = x.clamp(-STRETCH_MAX, STRETCH_MAX);
    let (i, f) = ((x.unsigned_abs() >> 7) as usize, x.abs() & 127);
    let p = (KNOTS[i] * (128 - f) + KNOTS[i + 1] * f + 64) >> 7;
    if x < 0 { 65536 - p } else { p }
}

/// The logistic curve from -`STRETCH_MAX` on, clamped: the probability that a mixed bin is coded with (squash of spec 6.3).
static SQUASH: LazyLock<[u16; 2 * STRETCH_MAX as usize + 1]> =
    LazyLock::new(|| std::array::from_fn(|i| curve(i as i32 - STRETCH_MAX).clamp(P_MIN, 65536 - P_MIN) as u16));

/// Probability in 4096ths -> logistic domain (spec 6.3).
static STRETCH: LazyLock<[i16; 4096]> = LazyLock::new(|| {
    let mut x = -STRETCH_MAX;
    std::array::from_fn(|i| {
        while x < STRETCH_MAX && curve(x) < 16 * i as i32 + 8 {
            x += 1;
        }
        x as i16
    })
});

/// Of a counter that has seen n bins: its step 1 / (n + 1.5) in 1/65536, and its low bits after one more bin.
type Steps = [(u32, u32); 256];
static STEPS: LazyLock<Steps> = LazyLock::new(|| {
    std::array::from_fn(|n| {
        let next = (n as u32 + 1).min(AGE_MAX);
        (131_072 / (2 * n as u32 + 3), age(next) << 8 | next)
    })
});

/// Age of a counter that has seen `n` bins, 0 to 3; it selects the mixing weights.
fn age(n: u32) -> u32 {
    match n {
        0..=3 => 0,
        4..=15 => 1,
        16..=63 => 2,
        _ => 3,
    }
}

/// A counter: probability of 1 (22 bits), age (2 bits), number of bins seen (8 bits). Tables store it xor `NEW`, so that a
/// new table is all zeros and its untouched pages take no memory.
#[derive(Clone, Copy)]
struct Counter(u32);

const NEW: u32 = 1 << 31;

impl Counter {
    #[inline]
    fn updated(self, bin: bool, steps: &Steps) -> u32 {
        let p = i64::from(self.0 >> 10);
        let (rate, low) = steps[(self.0 & 255) as usize];
        let target = if bin { (1 << 22) - 1 } else { 0 };
        let p = p + (((target - p) * i64::from(rate)) >> 16);
        ((p as u32) << 10 | low) ^ NEW
    }

    #[inline]
    fn age(self) -> usize {
        (self.0 >> 8 & 3) as usize
    }
}

/// Counters and mixing weights for the syntax elements of one kind.
#[derive(Clone)]
pub struct Model {
    a: Vec<u32>,
    b: Vec<u32>,
    weights: Vec<[i32; 2]>, // less WEIGHT_NEW
    stretch: &'static [i16; 4096],
    squash: &'static [u16; 2 * STRETCH_MAX as usize + 1],
    steps: &'static Steps,
}

impl Model {
    /// A model with `a` and `b` contexts and `sets` weight sets.
    pub fn new(a: usize, b: usize, sets: usize) -> Self {
        Model {
            a: vec![0; a],
            b: vec![0; b],
            weights: vec![[0; 2]; sets * 16],
            stretch: &STRETCH,
            squash: &SQUASH,
            steps: &STEPS,
        }
    }

    /// Prepares the model for the other tiles of a layer: what it has learned from the first one counts less.
    pub fn settle(&mut self) {
        for v in self.a.iter_mut().chain(&mut self.b) {
            let n = (*v & 255).min(AGE_SETTLED);
            *v = *v >> 10 << 10 | age(n) << 8 | n;
        }
    }

    /// Codes one bin in contexts `a` and `b`, mixed with weight set `w` (spec 6.4).
    ///
    /// Contexts are computed from decoded counts, never from raw input, so they are in range by construction.
    #[inline]
    pub fn bin<C: Bins>(&mut self, c: &mut C, bin: bool, a: usize, b: usize, w: usize) -> bool {
        let (slot_a, slot_b) = (&mut self.a[a], &mut self.b[b]);
        let (ca, cb) = (Counter(*slot_a ^ NEW), Counter(*slot_b ^ NEW));
        let sa = i32::from(self.stretch[(ca.0 >> 20) as usize]);
        let sb = i32::from(self.stretch[(cb.0 >> 20) as usize]);
        let slot = &mut self.weights[16 * w + 4 * ca.age() + cb.age()];
        let weight = slot.map(|v| v + WEIGHT_NEW);
        let x = ((weight[0] * sa + weight[1] * sb) >> 16).clamp(-STRETCH_MAX, STRETCH_MAX);
        let p = i32::from(self.squash[(x + STRETCH_MAX) as usize]);
        let bin = c.bin(bin, p as u32);
        let err = if bin { 65536 - p } else { -p };
        let learned = |w: i32, s: i32| (w + ((s * err + 16384) >> 15)).clamp(-WEIGHT_MAX, WEIGHT_MAX) - WEIGHT_NEW;
        *slot = [learned(weight[0], sa), learned(weight[1], sb)];
        *slot_a = ca.updated(bin, self.steps);
        *slot_b = cb.updated(bin, self.steps);
        bin
    }
}
