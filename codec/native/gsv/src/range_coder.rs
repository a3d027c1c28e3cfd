//! Range coder (spec 6.1): bins, bits and symbols with their probabilities <-> bytes.
//!
//! The models use the trait `Bins`, which encoder and decoder implement, so that every syntax element is described
//! once: the encoder's methods write their argument and return it, the decoder's ignore their argument and return the
//! value read. Carries are resolved with a pending byte and a run length, as in LZMA; the first byte, always 0, is left
//! out.

use crate::lanes::count;

/// One direction of the entropy coder.
pub trait Bins {
    /// True for the reading side: values passed in are placeholders.
    const DECODES: bool;
    /// One bin; `p` is the probability of 1 times 65536, in 1..=65535.
    fn bin(&mut self, bin: bool, p: u32) -> bool;
    /// False once the decoder has read more bytes beyond the end than an encoder may omit: the caller may stop.
    fn alive(&self) -> bool;

    /// One of `SYMBOLS`; `ends` are the ends of their intervals within 65536, the last end modulo 65536.
    fn symbol(&mut self, symbol: usize, ends: &Ends) -> usize;
    /// `n` bits of probability one half, at most `BITS_MAX`.
    fn few_bits(&mut self, value: u32, n: u32) -> u32;

    /// `n` bits of probability one half, most significant first.
    fn bits(&mut self, value: u64, n: u32) -> u64 {
        let (mut v, mut rest) = (0, n);
        while rest > 0 {
            let few = rest.min(BITS_MAX);
            rest -= few;
            v = v << few | u64::from(self.few_bits((value >> rest) as u32 & ((1 << few) - 1), few));
        }
        v
    }
}

/// Symbols of an alphabet.
pub const SYMBOLS: usize = 32;
/// Cumulative probabilities times 65536.
pub type Ends = [u16; SYMBOLS];
/// Most bits that are coded in one step.
const BITS_MAX: u32 = 16;

/// Start and length of the interval of a symbol.
#[inline]
fn interval(symbol: usize, ends: &Ends) -> (u32, u32) {
    let end = ends[symbol % SYMBOLS];
    let start = if symbol == 0 { 0 } else { ends[(symbol - 1) % SYMBOLS] };
    (u32::from(start), u32::from(end.wrapping_sub(start)))
}

const TOP: u32 = 1 << 24;

/// The encoder.
pub struct Encoder {
    low: u64, // 33 bits: bit 32 is a carry into the pending bytes
    range: u32,
    pending: u8,
    run: u64, // bytes 0xFF that follow `pending`
    first: bool,
    out: Vec<u8>,
}

impl Default for Encoder {
    fn default() -> Self {
        Encoder {
            low: 0,
            range: u32::MAX,
            pending: 0,
            run: 0,
            first: true,
            out: Vec::new(),
        }
    }
}

impl Encoder {
    fn shift(&mut self) {
        let carry = (self.low >> 32) as u8;
        if carry != 0 || self.low < 0xFF00_0000 {
            if !std::mem::take(&mut self.first) {
                self.out.push(self.pending.wrapping_add(carry));
            }
            let fill = 0xFFu8.wrapping_add(carry);
            self.out.extend((0..self.run).map(|_| fill));
            self.run = 0;
            self.pending = (self.low >> 24) as u8;
        } else {
            self.run += 1;
        }
        self.low = (self.low & 0x00FF_FFFF) << 8;
    }

    /// Narrows the range to `length` from `start` on.
    #[inline]
    fn take(&mut self, start: u32, length: u32) {
        self.low += u64::from(start);
        self.range = length;
        while self.range < TOP {
            self.range <<= 8;
            self.shift();
        }
    }

    /// Ends the payload with the value in the final interval that has the most trailing zero bits; at most four zero
    /// bytes are left off.
    pub fn finish(mut self) -> Vec<u8> {
        for bits in (0..=31u32).rev() {
            let mask = (1u64 << bits) - 1;
            let v = (self.low + mask) & !mask;
            if v < self.low + u64::from(self.range) {
                self.low = v;
                break;
            }
        }
        (0..5).for_each(|_| self.shift());
        let zeros = self.out.iter().rev().take(4).take_while(|b| **b == 0).count();
        self.out.truncate(self.out.len() - zeros);
        self.out
    }
}

impl Bins for Encoder {
    const DECODES: bool = false;

    #[inline]
    fn bin(&mut self, bin: bool, p: u32) -> bool {
        let bound = ((u64::from(self.range) * u64::from(p)) >> 16) as u32;
        if bin {
            self.take(0, bound);
        } else {
            self.take(bound, self.range - bound);
        }
        bin
    }

    #[inline]
    fn symbol(&mut self, symbol: usize, ends: &Ends) -> usize {
        let (unit, (start, length)) = (self.range >> 16, interval(symbol, ends));
        self.take(unit * start, unit * length);
        symbol
    }

    #[inline]
    fn few_bits(&mut self, value: u32, n: u32) -> u32 {
        let unit = self.range >> n;
        self.take(unit * value, unit);
        value
    }

    fn alive(&self) -> bool {
        true
    }
}

/// The decoder. Reading never fails: beyond the end it reads zeros, and `finish` reports that.
pub struct Decoder<'a> {
    payload: &'a [u8],
    position: usize,
    range: u32,
    code: u32,
}

impl<'a> Decoder<'a> {
    pub fn new(payload: &'a [u8]) -> Self {
        let mut d = Decoder {
            payload,
            position: 0,
            range: u32::MAX,
            code: 0,
        };
        d.code = d.coming();
        d.position = 4;
        d
    }

    /// The next four bytes, the first one on top; zeros beyond the end.
    #[inline]
    fn coming(&self) -> u32 {
        match self.payload.get(self.position..).and_then(|rest| rest.first_chunk()) {
            Some(four) => u32::from_be_bytes(*four),
            None => self.last(),
        }
    }

    #[cold]
    fn last(&self) -> u32 {
        let byte = |i: usize| self.payload.get(self.position + i).copied().unwrap_or(0);
        u32::from_be_bytes(std::array::from_fn(byte))
    }

    /// Narrows the range to `length` from `start` on. Without branches: the number of consumed bytes is unpredictable.
    #[inline]
    fn take(&mut self, start: u32, length: u32) {
        let shift = length.leading_zeros() & 24;
        let come = (u64::from(self.coming()) << shift >> 32) as u32;
        self.range = length << shift;
        self.code = self.code.wrapping_sub(start) << shift | come;
        self.position += shift as usize / 8;
    }

    /// Checks that the payload was used up exactly (spec 6.1); otherwise returns the message.
    pub fn finish(self) -> Result<(), &'static str> {
        if self.position < self.payload.len() {
            return Err("the payload to end with its last bin, found more bytes");
        }
        if self.alive() {
            Ok(())
        } else {
            Err("more payload: it ends before its last bin")
        }
    }
}

impl Bins for Decoder<'_> {
    const DECODES: bool = true;

    #[inline]
    fn bin(&mut self, _: bool, p: u32) -> bool {
        let bound = ((u64::from(self.range) * u64::from(p)) >> 16) as u32;
        let bin = self.code < bound;
        let start = std::hint::select_unpredictable(bin, 0, bound);
        let length = std::hint::select_unpredictable(bin, bound, self.range - bound);
        self.take(start, length);
        bin
    }

    #[inline]
    fn symbol(&mut self, _: usize, ends: &Ends) -> usize {
        let unit = self.range >> 16;
        let at = (self.code / unit.max(1)).min(65535) as u16;
        let (eights, _) = ends.as_chunks();
        let passed: u16 = eights.iter().map(|ends| count(*ends, at)).sum();
        let symbol = usize::from(passed.saturating_sub(1)); // the last end is 0, for 65536
        let (start, length) = interval(symbol, ends);
        self.take(unit * start, unit * length);
        symbol
    }

    #[inline]
    fn few_bits(&mut self, _: u32, n: u32) -> u32 {
        let unit = self.range >> n;
        let value = (self.code / unit.max(1)).min((1 << n) - 1);
        self.take(unit * value, unit);
        value
    }

    #[inline]
    fn alive(&self) -> bool {
        self.position <= self.payload.len().saturating_add(4)
    }
}
