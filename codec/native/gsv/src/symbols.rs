//! Adaptive symbol models (spec 6.6): one of 32 symbols in three contexts <-> the range coder, in integers only.
//!
//! Each context has a distribution that adapts to its symbols; the mean of three, with weights that adapt too, is
//! coded. One symbol replaces about eight bins; the 16-bit lanes vectorize on every processor (lanes.rs).

use crate::blocks::Blocks;
use crate::lanes::{learned, mean};
use crate::range_coder::{Bins, Ends, SYMBOLS};
use std::sync::LazyLock;

/// A distribution that has seen this many symbols adapts no slower.
const SEEN_MAX: u8 = 126;
/// Cap on the number of symbols seen in a distribution that another tile starts from.
const SEEN_SETTLED: u8 = 30;
/// Least probability of a symbol, times 65536.
const LEAST: u16 = 4;
/// Weights adapt by 1 / 128 and have 7 extra fractional bits.
const RATE_BITS: u32 = 7;

/// A distribution: cumulative probabilities times 65536, 65535 for 1. One cache line.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct Distribution(Ends);

/// The uniform distribution.
const NEW: Distribution = {
    let mut ends = [0; SYMBOLS];
    let mut i = 0;
    while i < SYMBOLS {
        ends[i] = (2048 * (i as u32 + 1) - 1) as u16;
        i += 1;
    }
    Distribution(ends)
};

impl Distribution {
    /// Half of the probability of `symbol`, times 65536; at least 1.
    #[inline]
    fn half(&self, symbol: usize) -> u32 {
        let start = if symbol == 0 { 0 } else { self.0[(symbol - 1) % SYMBOLS] };
        u32::from(self.0[symbol % SYMBOLS].saturating_sub(start) / 2) + 1
    }

    /// Moves towards `symbol` by `rate` / 65536.
    #[inline]
    fn learn(&mut self, symbol: usize, rate: u16) {
        for (first, ends) in (0..).step_by(8).zip(self.0.as_chunks_mut().0) {
            *ends = learned(*ends, symbol as i16 - first, rate);
        }
    }
}

/// The distributions of one kind of context, and how many symbols each has seen.
#[derive(Clone)]
struct Table {
    distributions: Blocks<Distribution>,
    seen: Vec<u8>,
}

impl Table {
    fn new(contexts: usize) -> Table {
        Table {
            distributions: Blocks::new(contexts, &NEW),
            seen: vec![0; contexts],
        }
    }
}

/// For a distribution that has seen n symbols: its rate 1 / (n + 1.5) in 1/65536, and its age, 0 to 3.
static SEEN: LazyLock<[(u16, u8); 256]> = LazyLock::new(|| {
    std::array::from_fn(|n| {
        let age = match n {
            0..=3 => 0,
            4..=15 => 1,
            16..=63 => 2,
            _ => 3,
        };
        ((131_072 / (2 * n + 3)) as u16, age)
    })
});

/// Adaptive model of symbols.
#[derive(Clone)]
pub struct SymbolModel {
    tables: [Table; 3],
    weights: Vec<[u32; 2]>, // of the first two distributions, in 1/65536, times 2^RATE_BITS
    seen: &'static [(u16, u8); 256],
}

impl SymbolModel {
    /// `contexts` of each of the three kinds, `sets` weight sets.
    pub fn new(contexts: [usize; 3], sets: usize) -> Self {
        SymbolModel {
            tables: contexts.map(Table::new),
            weights: vec![[21845 << RATE_BITS; 2]; sets * 64],
            seen: &SEEN,
        }
    }

    /// Prepares the model for the other tiles of a layer: the statistics of the first tile count less.
    pub fn settle(&mut self) {
        for t in &mut self.tables {
            t.distributions.settle(|_| ());
            t.seen.iter_mut().for_each(|n| *n = (*n).min(SEEN_SETTLED));
        }
    }

    /// Codes one symbol in three contexts, mixed with weight set `w`.
    ///
    /// Contexts are computed from decoded values, never from raw input, so they are in range by construction.
    #[inline]
    pub fn symbol<C: Bins>(&mut self, c: &mut C, symbol: usize, contexts: [usize; 3], w: usize) -> usize {
        let [a, b, d] = &mut self.tables;
        let [ia, ib, id] = contexts;
        let (sa, sb, sd) = (&mut a.seen[ia], &mut b.seen[ib], &mut d.seen[id]);
        let [(ra, ga), (rb, gb), (rd, gd)] = [*sa, *sb, *sd].map(|n| self.seen[usize::from(n)]);
        let weights = &mut self.weights[64 * w + usize::from(16 * ga + 4 * gb + gd)];
        let [wa, wb] = weights.map(|v| v >> RATE_BITS);
        let wd = 65536 - wa - wb;
        let (a, b, d) = (
            a.distributions.get(ia),
            b.distributions.get(ib),
            d.distributions.get(id),
        );
        let mut ends = [0; SYMBOLS];
        let shares = [wa, wb, wd].map(|w| w as u16);
        let eights = a.0.as_chunks().0.iter().zip(b.0.as_chunks().0).zip(d.0.as_chunks().0);
        for (k, (end, ((a, b), d))) in (0..).zip(ends.as_chunks_mut().0.iter_mut().zip(eights)) {
            *end = mean([*a, *b, *d], shares, LEAST, 8 * k + 1);
        }
        ends[SYMBOLS - 1] = 0; // 65536
        let symbol = c.symbol(symbol, &ends);
        // Each weight moves towards the share of its distribution in the mixed probability, and a little towards an
        // equal share.
        let [fa, fb, fd] = [wa * a.half(symbol), wb * b.half(symbol), wd * d.half(symbol)];
        let unit = ((fa + fb + fd) >> 16) + 1;
        for (v, f) in weights.iter_mut().zip([fa, fb]) {
            let share = f / unit;
            *v = *v - v.div_ceil(1 << RATE_BITS) + share - (share >> 5) + 682;
        }
        a.learn(symbol, ra);
        b.learn(symbol, rb);
        d.learn(symbol, rd);
        for n in [sa, sb, sd] {
            *n = (*n + 1).min(SEEN_MAX);
        }
        symbol
    }
}
