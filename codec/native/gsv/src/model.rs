//! Adaptive binary models (spec 6.2 to 6.4): a bin in two contexts -> its probability, in integers only.
//!
//! Two counters, each chosen by its own context, are mixed in the logistic domain with weights that adapt too (as in
//! PAQ by Mahoney). Two separate contexts learn faster than one joint context, which would spread the same bins over
//! more counters.

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
/// Cap on the number of bins seen in a counter that another tile starts from.
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

/// The logistic curve from -`STRETCH_MAX` on, clamped: the probability that a mixed bin is coded with (squash of spec
/// 6.3).
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

/// For a counter that has seen n bins: its step 1 / (n + 1.5) in 1/65536, and its low bits after one more bin.
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

/// A counter: probability of 1 (22 bits), age (2 bits), number of bins seen (8 bits).
#[derive(Clone, Copy)]
pub struct Counter(u32);

impl Counter {
    pub const NEW: Counter = Counter(1 << 31);

    #[inline]
    fn updated(self, bin: bool, steps: &Steps) -> Counter {
        let p = i64::from(self.0 >> 10);
        let (rate, low) = steps[(self.0 & 255) as usize];
        let target = if bin { (1 << 22) - 1 } else { 0 };
        let p = p + (((target - p) * i64::from(rate)) >> 16);
        Counter((p as u32) << 10 | low)
    }

    #[inline]
    fn age(self) -> usize {
        (self.0 >> 8 & 3) as usize
    }

    /// Prepares a counter for the other tiles of a layer: the statistics of the first tile count less.
    pub fn settle(&mut self) {
        let n = (self.0 & 255).min(AGE_SETTLED);
        self.0 = self.0 >> 10 << 10 | age(n) << 8 | n;
    }
}

/// A weight set: the weights of two counters, by the ages of both.
pub type Weights = [[i32; 2]; 16];
pub const WEIGHTS_NEW: Weights = [[WEIGHT_NEW; 2]; 16];

/// Mixes counters; the tables are those of spec 6.3 and 6.2.
#[derive(Clone, Copy)]
pub struct Mixer {
    stretch: &'static [i16; 4096],
    squash: &'static [u16; 2 * STRETCH_MAX as usize + 1],
    steps: &'static Steps,
}

impl Mixer {
    pub fn new() -> Mixer {
        Mixer {
            stretch: &STRETCH,
            squash: &SQUASH,
            steps: &STEPS,
        }
    }

    /// Codes one bin with two counters and a weight set (spec 6.4).
    #[inline]
    pub fn bin<C: Bins>(&self, c: &mut C, bin: bool, a: &mut Counter, b: &mut Counter, set: &mut Weights) -> bool {
        let sa = i32::from(self.stretch[(a.0 >> 20) as usize]);
        let sb = i32::from(self.stretch[(b.0 >> 20) as usize]);
        let weight = &mut set[4 * a.age() + b.age()];
        let x = ((weight[0] * sa + weight[1] * sb) >> 16).clamp(-STRETCH_MAX, STRETCH_MAX);
        let p = i32::from(self.squash[(x + STRETCH_MAX) as usize]);
        let bin = c.bin(bin, p as u32);
        let err = if bin { 65536 - p } else { -p };
        for (w, s) in weight.iter_mut().zip([sa, sb]) {
            *w = (*w + ((s * err + 16384) >> 15)).clamp(-WEIGHT_MAX, WEIGHT_MAX);
        }
        *a = a.updated(bin, self.steps);
        *b = b.updated(bin, self.steps);
        bin
    }
}

/// Counters and weight sets for the syntax elements of one kind, where there are few contexts.
#[derive(Clone)]
pub struct Model {
    a: Vec<Counter>,
    b: Vec<Counter>,
    weights: Vec<Weights>,
    mixer: Mixer,
}

impl Model {
    /// A model with `a` and `b` contexts and `sets` weight sets.
    pub fn new(a: usize, b: usize, sets: usize) -> Self {
        Model {
            a: vec![Counter::NEW; a],
            b: vec![Counter::NEW; b],
            weights: vec![WEIGHTS_NEW; sets],
            mixer: Mixer::new(),
        }
    }

    /// See `Counter::settle`.
    pub fn settle(&mut self) {
        self.a.iter_mut().chain(&mut self.b).for_each(Counter::settle);
    }

    /// Codes one bin in contexts `a` and `b`, mixed with weight set `w`.
    ///
    /// Contexts are computed from decoded counts, never from raw input, so they are in range by construction.
    #[inline]
    pub fn bin<C: Bins>(&mut self, c: &mut C, bin: bool, a: usize, b: usize, w: usize) -> bool {
        self.mixer
            .bin(c, bin, &mut self.a[a], &mut self.b[b], &mut self.weights[w])
    }
}
