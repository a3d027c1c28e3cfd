//! Channels (spec 9): the canonical integers of one attribute <-> symbols, in contexts made of the neighbours'
//! integers.
//!
//! Where the mean of the neighbours is small, a value is coded relative to 0, so that the contexts learn how reliable
//! the mean is (most channels are noise around a mean of their own). Where the mean is large, the value is coded
//! relative to it.

use crate::attributes::Attribute;
use crate::neighbors::{NEAR, Near};
use crate::range_coder::{Bins, SYMBOLS};
use crate::symbols::SymbolModel;
use crate::values::{Expected, MAX_VALUE};

/// Adaptive model of the channels of one attribute.
#[derive(Clone)]
pub struct ChannelModel {
    symbols: SymbolModel,
    class: Vec<usize>, // of each channel
    second: usize,     // distance in channels to the second context value of the same Gaussian
}

impl ChannelModel {
    pub fn new(attribute: Attribute, channels: usize) -> Self {
        let bands = attribute == Attribute::ShN;
        let classes = if bands { 9 } else { channels };
        ChannelModel {
            symbols: SymbolModel::new([230, 675, 675].map(|n| n * classes), classes),
            class: (0..channels).map(|ch| if bands { sh_class(ch) } else { ch }).collect(),
            second: if bands { 3 } else { 2 },
        }
    }

    /// See `SymbolModel::settle`.
    pub fn settle(&mut self) {
        self.symbols.settle();
    }
}

/// Codes `values`, which holds the C channels of Gaussian i at `C * i..`. False if a forbidden value was read.
pub fn code<C: Bins>(c: &mut C, model: &mut ChannelModel, near: &[Near], values: &mut [i32]) -> bool {
    let channels = model.class.len();
    near.iter().enumerate().all(|(i, near)| {
        let (done, rest) = values.split_at_mut(i * channels);
        let own = rest.get_mut(..channels);
        own.is_some_and(|own| gaussian(c, model, near, done, own)) && c.alive()
    })
}

/// Codes `own`, the channels of one Gaussian; `done`: those of all before it. False if a forbidden value was read.
#[cfg_attr(target_arch = "wasm32", inline(never))] // a browser optimises a function from its next call on
fn gaussian<C: Bins>(c: &mut C, model: &mut ChannelModel, near: &Near, done: &[i32], own: &mut [i32]) -> bool {
    let ChannelModel { symbols, class, second } = model;
    for (ch, &class_of) in class.iter().enumerate() {
        let mut around = [0; NEAR];
        let mut present = 0;
        for v in near.iter().map_while(|j| done.get(*j as usize * own.len() + ch)) {
            around[present] = *v;
            present += 1;
        }
        let back = |n: usize| ch.checked_sub(n).map_or(0, |k| own[k]);
        let prev = [back(1), back(*second)];
        match value(c, symbols, class_of, own[ch], &around[..present], prev) {
            Some(v) => own[ch] = v,
            None => return false,
        }
    }
    true
}

/// Band and colour of a channel of shN.
fn sh_class(channel: usize) -> usize {
    let band = match channel / 3 {
        0..3 => 0,
        3..8 => 1,
        _ => 2,
    };
    3 * band + channel % 3
}

/// Codes `x`; `near`: the neighbours' values, nearest first; `prev`: two values of the same Gaussian. None: a forbidden
/// value.
#[inline]
fn value<C: Bins>(
    c: &mut C,
    model: &mut SymbolModel,
    class: usize,
    x: i32,
    near: &[i32],
    prev: [i32; 2],
) -> Option<i32> {
    let e = match near.first_chunk::<NEAR>() {
        Some(all) => Expected::new(all), // the usual case, a length that the compiler knows
        None => Expected::new(near),
    };
    let [p1, p2] = prev.map(fold);
    let n = fold(near.first().map_or(0, |v| v - e.centre));
    let contexts = [
        (class * 23 + e.level()) * 10 + e.spread,
        ((class * 15 + p1) * 15 + p2) * 3 + e.sign(),
        ((class * 15 + n) * 15 + p1) * 3 + [0, 0, 0, 0, 1, 1, 1, 2, 2, 2][e.spread],
    ];
    let value = e.centre + residual(c, model, x - e.centre, contexts, class)?;
    (value.abs() <= MAX_VALUE).then_some(value)
}

/// Maps `v` to one of 15 ranges, 0 to 14; ranges far from 0 are wider.
#[inline]
fn fold(v: i32) -> usize {
    const FAR: i32 = 25;
    const RANGES: [u8; 51] = {
        let mut ranges = [0; 51];
        let mut i = 0;
        while i < 51 {
            let v = i as i32 - FAR;
            let away = match v.abs() {
                0..=2 => v.abs(),
                3..=4 => 3,
                5..=8 => 4,
                9..=14 => 5,
                15..=24 => 6,
                _ => 7,
            };
            ranges[i] = (7 + away * v.signum()) as u8;
            i += 1;
        }
        ranges
    };
    usize::from(RANGES[(v.clamp(-FAR, FAR) + FAR) as usize])
}

/// Per symbol: its value of least magnitude, and the number of bits that follow. Symbol 0 is the value 0; then each
/// range of magnitudes has one symbol per sign. The last range is open, the last symbol is forbidden.
const VALUES: [(i32, u32); SYMBOLS] = {
    const RANGES: [(i32, u32); 15] = [
        (1, 0),
        (2, 0),
        (3, 0),
        (4, 0),
        (5, 0),
        (6, 0),
        (7, 0),
        (8, 0),
        (9, 1),
        (11, 1),
        (13, 2),
        (17, 3),
        (25, 4),
        (41, 5),
        (73, OPEN),
    ];
    let mut values = [(0, 0); SYMBOLS];
    let mut i = 0;
    while i < 15 {
        let (least, bits) = RANGES[i];
        values[2 * i + 1] = (least, bits);
        values[2 * i + 2] = (-least, bits);
        i += 1;
    }
    values[SYMBOLS - 1] = (0, FORBIDDEN);
    values
};
const OPEN: u32 = 32;
const FORBIDDEN: u32 = 33;
const ESCAPE_MAX: u32 = 25;

/// The symbol of `v`.
fn symbol_of(v: i32) -> usize {
    let holds = |(least, _): &(i32, u32)| least.signum() == v.signum() && least.abs() <= v.abs();
    VALUES[..SYMBOLS - 1].iter().rposition(holds).unwrap_or(0)
}

#[inline]
fn residual<C: Bins>(c: &mut C, model: &mut SymbolModel, v: i32, contexts: [usize; 3], w: usize) -> Option<i32> {
    let symbol = if C::DECODES { 0 } else { symbol_of(v) };
    let (least, bits) = VALUES[model.symbol(c, symbol, contexts, w) % SYMBOLS];
    if bits == 0 {
        return Some(least);
    }
    if bits == FORBIDDEN {
        return None;
    }
    let beyond = v.abs().wrapping_sub(least.abs()) as u32; // encoder
    let beyond = if bits == OPEN {
        let e = c.few_bits(beyond.wrapping_add(1).max(1).ilog2(), 5);
        if e > ESCAPE_MAX {
            return None;
        }
        (1 << e) - 1 + c.bits(u64::from(beyond.wrapping_add(1)) & ((1 << e) - 1), e) as i32
    } else {
        c.few_bits(beyond & ((1 << bits) - 1), bits) as i32
    };
    Some(least + beyond * least.signum())
}
