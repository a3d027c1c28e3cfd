//! Values (spec 6.5): an integer of a trajectory <-> bins, in contexts made of the neighbours' integers; and the
//! contexts of channels.
//!
//! Where the mean of the neighbours is small, a value is coded relative to 0, so that the contexts learn how reliable
//! the mean is (most channels are noise around a mean of their own). Where the mean is large, the value is coded
//! relative to it.

use crate::blocks::Blocks;
use crate::model::{Counter, Mixer, WEIGHTS_NEW, Weights};
use crate::neighbors::NEAR;
use crate::range_coder::Bins;

/// Integers stay within +-MAX_VALUE, which f32 holds exactly.
pub const MAX_VALUE: i32 = 1 << 24;

/// Contexts of one value: zero, sign, 16 magnitudes of each sign, escape. Their order differs from spec 6.5, so that
/// those of small values of both signs share a cache line.
const SLOTS: usize = 64;
const UNARY: i32 = 16;
const NEAR_UNARY: usize = 7; // magnitudes of either sign in the first cache line
const ESCAPE_SLOT: usize = 34;
const ESCAPE_MAX: u32 = 25;
/// Weights of the neighbours in the mean, nearest first.
pub const NEAR_WEIGHT: [i32; NEAR] = [4, 3, 2, 2];

/// Adaptive model of the values of trajectories.
#[derive(Clone)]
pub struct ValueModel {
    a: Blocks<[Counter; SLOTS]>,
    b: Blocks<[Counter; SLOTS]>,
    weights: Blocks<[Weights; SLOTS]>, // of each class
    mixer: Mixer,
    /// A value that the spec forbids was read.
    pub broken: bool,
}

fn spread_bucket(s: i32) -> usize {
    const FAR: i32 = 41;
    const BUCKETS: [u8; 42] = {
        let mut buckets = [0; 42];
        let mut s = 0;
        while s <= FAR {
            buckets[s as usize] = match s {
                0..=2 => s as u8,
                3..=4 => 3,
                5..=6 => 4,
                7..=9 => 5,
                10..=14 => 6,
                15..=24 => 7,
                25..=40 => 8,
                _ => 9,
            };
            s += 1;
        }
        buckets
    };
    usize::from(BUCKETS[s.clamp(0, FAR) as usize])
}

/// Statistics of the neighbours' values.
pub struct Expected {
    mean: i32,
    /// The value is coded relative to this.
    pub centre: i32,
    /// 0 to 9: the spread of the neighbours' values.
    pub spread: usize,
}

impl Expected {
    /// `near`: the neighbours' values, nearest first.
    #[inline]
    pub fn new(near: &[i32]) -> Expected {
        let (s, g) = near
            .iter()
            .zip(NEAR_WEIGHT)
            .fold((0, 0), |(s, g), (v, w)| (s + w * v, g + w));
        let mean = match g {
            0 => 0,
            11 => (2 * s + 11).div_euclid(22), // the usual case, a division by a constant
            _ => (2 * s + g).div_euclid(2 * g),
        };
        Expected {
            mean,
            centre: mean - mean.clamp(-7, 7),
            spread: spread_bucket(near.iter().map(|v| (v - mean).abs()).sum()),
        }
    }

    /// 0 to 22: the range of the mean; ranges far from 0 are wider.
    #[inline]
    pub fn level(&self) -> usize {
        const FAR: i32 = 23;
        const LEVELS: [u8; 47] = {
            let mut levels = [0; 47];
            let mut i = 0;
            while i < 47 {
                let mean = i as i32 - FAR;
                let away = mean.abs();
                let m = if away <= 6 { away } else { 7 + (away - 7) / 4 };
                levels[i] = (11 + m * mean.signum()) as u8;
                i += 1;
            }
            levels
        };
        usize::from(LEVELS[(self.mean.clamp(-FAR, FAR) + FAR) as usize])
    }

    /// Sign of the mean: 0, 1 or 2.
    #[inline]
    pub fn sign(&self) -> usize {
        (self.mean.clamp(-1, 1) + 1) as usize
    }
}

impl ValueModel {
    /// See `Counter::settle`.
    pub fn settle(&mut self) {
        self.a.settle(|block| block.iter_mut().for_each(Counter::settle));
        self.b.settle(|block| block.iter_mut().for_each(Counter::settle));
        self.weights.settle(|_| ());
    }

    pub fn new(classes: usize) -> Self {
        ValueModel {
            a: Blocks::new(classes * 230, &[Counter::NEW; SLOTS]),
            b: Blocks::new(classes * 675, &[Counter::NEW; SLOTS]),
            weights: Blocks::new(classes, &[WEIGHTS_NEW; SLOTS]),
            mixer: Mixer::new(),
            broken: false,
        }
    }

    /// Codes `x`; `near`: the neighbours' values, nearest first; `prev`: two values of the same Gaussian.
    #[inline]
    pub fn value<C: Bins>(&mut self, c: &mut C, class: usize, x: i32, near: &[i32], prev: [i32; 2]) -> i32 {
        let e = Expected::new(near);
        let a = (class * 23 + e.level()) * 10 + e.spread;
        let [p1, p2] = prev.map(|v| (v.clamp(-7, 7) + 7) as usize);
        let b = ((class * 15 + p1) * 15 + p2) * 3 + e.sign();
        let centre = e.centre;
        let v = self.residual(c, x - centre, [a, b, class]);
        let value = centre + v;
        if value.abs() > MAX_VALUE {
            self.broken = true;
            return 0;
        }
        value
    }

    #[inline]
    fn residual<C: Bins>(&mut self, c: &mut C, v: i32, [a, b, w]: [usize; 3]) -> i32 {
        let (a, b, w, mixer) = (self.a.get(a), self.b.get(b), self.weights.get(w), self.mixer);
        let mut bin = |c: &mut C, j: usize, bin: bool| {
            let j = j % SLOTS; // in range as it is, which the compiler does not see
            mixer.bin(c, bin, &mut a[j], &mut b[j], &mut w[j])
        };
        if !bin(c, 0, v != 0) {
            return 0;
        }
        let negative = bin(c, 1, v < 0);
        let (first, rest) = if negative {
            (2 + NEAR_UNARY, 16 + UNARY as usize - 2 * NEAR_UNARY)
        } else {
            (2, 16 - NEAR_UNARY)
        };
        let slot = |v: i32| v as usize + if (v as usize) < NEAR_UNARY { first } else { rest };
        let want = v.abs() - 1;
        let mut got = 0;
        while got < UNARY && bin(c, slot(got), want > got) {
            got += 1;
        }
        if got == UNARY {
            let rest = (want - UNARY + 1).max(1) as u32; // Exp-Golomb of rest - 1
            let mut e = 0;
            while bin(c, ESCAPE_SLOT + e as usize, rest.ilog2() > e) {
                e += 1;
                if e > ESCAPE_MAX {
                    self.broken = true;
                    return 0;
                }
            }
            let mantissa = c.bits(u64::from(rest) & ((1 << e) - 1), e) as i32;
            got = UNARY + (1 << e) + mantissa - 1;
        }
        if negative { -got - 1 } else { got + 1 }
    }
}
