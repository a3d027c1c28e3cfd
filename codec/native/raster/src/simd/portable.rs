//! 4 lanes in plain Rust, for machines without an instance of their own; on x86-64 it is compiled for the tests.
//!
//! The compiler turns most of the arrays into scalar instructions; four pixels at a time still skip more work than one,
//! so this is up to twice as fast as `scalar`.

use std::array::from_fn;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

use super::vector::{MAGIC, Vector, exp2_poly, exp2_polys};

const LANES: usize = 4;

#[derive(Clone, Copy)]
#[repr(align(16))]
pub struct F32x4([f32; LANES]);

/// All bits of a lane set or none.
#[derive(Clone, Copy)]
#[repr(align(16))]
pub struct Mask4([u32; LANES]);

macro_rules! binary {
    ($type:ident, $trait:ident, $method:ident, $operator:tt) => {
        impl $trait for $type {
            type Output = $type;
            #[inline(always)]
            fn $method(self, b: $type) -> $type {
                $type(from_fn(|i| self.0[i] $operator b.0[i]))
            }
        }
    };
}
binary!(F32x4, Add, add, +);
binary!(F32x4, Sub, sub, -);
binary!(F32x4, Mul, mul, *);
binary!(F32x4, Div, div, /);
binary!(Mask4, BitAnd, bitand, &);
binary!(Mask4, BitOr, bitor, |);

impl Neg for F32x4 {
    type Output = F32x4;
    #[inline(always)]
    fn neg(self) -> F32x4 {
        F32x4(self.0.map(|x| -x))
    }
}

impl Not for Mask4 {
    type Output = Mask4;
    #[inline(always)]
    fn not(self) -> Mask4 {
        Mask4(self.0.map(|m| !m))
    }
}

impl F32x4 {
    #[inline(always)]
    fn bits(self) -> [u32; LANES] {
        self.0.map(f32::to_bits)
    }
    #[inline(always)]
    fn from_bits(bits: [u32; LANES]) -> F32x4 {
        F32x4(bits.map(f32::from_bits))
    }
}

impl Vector for F32x4 {
    const LANES: usize = LANES;
    type Mask = Mask4;

    #[inline(always)]
    fn splat(x: f32) -> Self {
        F32x4([x; LANES])
    }
    #[inline(always)]
    fn load(s: &[f32]) -> Self {
        let s = &s[..LANES];
        F32x4(from_fn(|i| s[i]))
    }
    #[inline(always)]
    fn store(self, d: &mut [f32]) {
        d[..LANES].copy_from_slice(&self.0);
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        self * b + c
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        c - self * b
    }
    #[inline(always)]
    fn min(self, b: Self) -> Self {
        F32x4(from_fn(|i| if self.0[i] < b.0[i] { self.0[i] } else { b.0[i] }))
    }
    #[inline(always)]
    fn max(self, b: Self) -> Self {
        F32x4(from_fn(|i| if self.0[i] > b.0[i] { self.0[i] } else { b.0[i] }))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        F32x4(self.0.map(f32::abs))
    }
    #[inline(always)]
    fn negative(self) -> Self {
        F32x4(self.0.map(|x| -x.abs()))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        F32x4(self.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn recip(self) -> Self {
        F32x4(self.0.map(|x| 1.0 / x))
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        // the order of the comparisons lets NaN through
        let x = F32x4(self.0.map(|x| if x < -127.0 { -127.0 } else { x }));
        let x = F32x4(x.0.map(|x| if x > 128.0 { 128.0 } else { x }));
        let up = x + Self::splat(MAGIC);
        let p = exp2_poly(x - (up - Self::splat(MAGIC)));
        // 2^n from the exponent field: 0 for n = -127, infinity for n = 128
        p * F32x4::from_bits(up.bits().map(|n| n.wrapping_add(127) << 23))
    }
    #[inline(always)]
    fn exp2_near<const N: usize>(x: [Self; N]) -> [Self; N] {
        let (up, mut p) = exp2_polys(x, Self::splat(MAGIC));
        for (p, up) in p.iter_mut().zip(up) {
            let (bits, n) = (p.bits(), up.bits());
            *p = F32x4::from_bits(from_fn(|i| bits[i].wrapping_add(n[i] << 23)));
        }
        p
    }
    #[inline(always)]
    fn split_exponent(self) -> (Self, Self) {
        let bits = self.bits();
        let m = bits.map(|b| (b & 0x007f_ffff) | 0x3f80_0000);
        (
            F32x4::from_bits(m),
            F32x4(bits.map(|b| ((b >> 23) as i32 - 127) as f32)),
        )
    }
    #[inline(always)]
    fn ge(self, b: Self) -> Mask4 {
        Mask4(from_fn(|i| u32::from(self.0[i] >= b.0[i]).wrapping_neg()))
    }
    #[inline(always)]
    fn lt(self, b: Self) -> Mask4 {
        Mask4(from_fn(|i| u32::from(self.0[i] < b.0[i]).wrapping_neg()))
    }
    #[inline(always)]
    fn select(self, m: Mask4, b: Self) -> Self {
        let (a, b) = (self.bits(), b.bits());
        F32x4::from_bits(from_fn(|i| a[i] & m.0[i] | b[i] & !m.0[i]))
    }
    #[inline(always)]
    fn any(m: Mask4) -> bool {
        m.0[0] | m.0[1] | m.0[2] | m.0[3] != 0
    }
    #[inline(always)]
    fn bits(m: Mask4) -> u32 {
        m.0[0] & 1 | m.0[1] & 2 | m.0[2] & 4 | m.0[3] & 8
    }
    #[inline(always)]
    fn max_lane(self) -> f32 {
        self.0
            .into_iter()
            .fold(f32::NEG_INFINITY, |m, x| if x > m { x } else { m })
    }
    #[inline(always)]
    fn sum12(v: &[Self; 12], out: &mut [f32; 12]) {
        for (out, v) in out.iter_mut().zip(v) {
            *out = (v.0[0] + v.0[2]) + (v.0[1] + v.0[3]);
        }
    }
}
