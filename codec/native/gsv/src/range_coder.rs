//! Binary range coder (spec 6.1): bins and their probabilities -> bytes, and back.
//!
//! `Bins` is what the models see. Encoder and decoder both implement it, so that every syntax element is described
//! once: the encoder's `bin` writes its argument and returns it, the decoder's ignores its argument and returns what
//! it read. Carries are resolved with a pending byte and a run length, as in LZMA; the first byte, always 0, is left out.

/// One direction of the entropy coder.
pub trait Bins {
    /// True for the reading side: values passed in are placeholders.
    const DECODES: bool;
    /// One bin; `p` is the probability of 1 times 65536, in 1..=65535.
    fn bin(&mut self, bin: bool, p: u32) -> bool;
    /// False once the payload has been overrun beyond what an encoder may leave off: the caller may stop.
    fn alive(&self) -> bool;

    /// `n` bins of probability one half, most significant first.
    fn bits(&mut self, value: u64, n: u32) -> u64 {
        (0..n)
            .rev()
            .fold(0, |v, i| v << 1 | u64::from(self.bin(value >> i & 1 != 0, 1 << 15)))
    }
}

const TOP: u32 = 1 << 24;

/// The writing side.
pub struct Encoder {
    low: u64, // 33 bits: bit 32 is a carry into what is pending
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

    /// The payload: the value with the most trailing zero bits in the final interval, at most four zero bytes left off.
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
            self.range = bound;
        } else {
            self.low += u64::from(bound);
            self.range -= bound;
        }
        while self.range < TOP {
            self.range <<= 8;
            self.shift();
        }
        bin
    }

    fn alive(&self) -> bool {
        true
    }
}

/// The reading side. Never fails while reading: beyond the end it reads zeros, and `finish` tells.
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
        (0..4).for_each(|_| d.code = d.code << 8 | d.byte());
        d
    }

    #[inline]
    fn byte(&mut self) -> u32 {
        let b = self.payload.get(self.position).copied().unwrap_or(0);
        self.position += 1;
        u32::from(b)
    }

    /// Checks that the payload was used up exactly (spec 6.1); otherwise what is wrong with it.
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
        let (range, code) = (self.range - bound, self.code.wrapping_sub(bound));
        self.range = std::hint::select_unpredictable(bin, bound, range);
        self.code = std::hint::select_unpredictable(bin, self.code, code);
        while self.range < TOP {
            self.range <<= 8;
            self.code = self.code << 8 | self.byte();
        }
        bin
    }

    #[inline]
    fn alive(&self) -> bool {
        self.position <= self.payload.len().saturating_add(4)
    }
}
