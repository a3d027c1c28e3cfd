//! 4 lanes, NEON, which every 64-bit ARM processor has.
//!
//! Why `unsafe` is sound here: the target always has the feature, so the intrinsics have no precondition; only loads
//! and stores do, and they check the length of the slice first.

use std::arch::aarch64::*;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

use super::vector::{MAGIC, Vector, exp2_poly, exp2_polys};

#[derive(Clone, Copy)]
pub struct F32x4(float32x4_t);

/// All bits of a lane set or none.
#[derive(Clone, Copy)]
pub struct Mask4(uint32x4_t);

macro_rules! binary {
    ($type:ident, $trait:ident, $method:ident, $intrinsic:ident) => {
        impl $trait for $type {
            type Output = $type;
            #[inline(always)]
            fn $method(self, b: $type) -> $type {
                // SAFETY: see the head of this file.
                unsafe { $type($intrinsic(self.0, b.0)) }
            }
        }
    };
}
binary!(F32x4, Add, add, vaddq_f32);
binary!(F32x4, Sub, sub, vsubq_f32);
binary!(F32x4, Mul, mul, vmulq_f32);
binary!(F32x4, Div, div, vdivq_f32);
binary!(Mask4, BitAnd, bitand, vandq_u32);
binary!(Mask4, BitOr, bitor, vorrq_u32);

impl Neg for F32x4 {
    type Output = F32x4;
    #[inline(always)]
    fn neg(self) -> F32x4 {
        // SAFETY: see the head of this file.
        unsafe { F32x4(vnegq_f32(self.0)) }
    }
}

impl Not for Mask4 {
    type Output = Mask4;
    #[inline(always)]
    fn not(self) -> Mask4 {
        // SAFETY: see the head of this file.
        unsafe { Mask4(vmvnq_u32(self.0)) }
    }
}

impl F32x4 {
    #[inline(always)]
    fn bits(self) -> uint32x4_t {
        // SAFETY: see the head of this file.
        unsafe { vreinterpretq_u32_f32(self.0) }
    }
    #[inline(always)]
    fn from_bits(bits: uint32x4_t) -> F32x4 {
        // SAFETY: see the head of this file.
        unsafe { F32x4(vreinterpretq_f32_u32(bits)) }
    }
}

/// The sum of the four vectors' lanes, as a vector.
#[inline(always)]
fn sum4([a, b, c, d]: [F32x4; 4]) -> F32x4 {
    // SAFETY: see the head of this file.
    unsafe { F32x4(vpaddq_f32(vpaddq_f32(a.0, b.0), vpaddq_f32(c.0, d.0))) }
}

// SAFETY of every block below: see the head of this file.
impl Vector for F32x4 {
    const LANES: usize = 4;
    type Mask = Mask4;

    #[inline(always)]
    fn splat(x: f32) -> Self {
        unsafe { F32x4(vdupq_n_f32(x)) }
    }
    #[inline(always)]
    fn load(s: &[f32]) -> Self {
        assert!(s.len() >= 4);
        unsafe { F32x4(vld1q_f32(s.as_ptr())) }
    }
    #[inline(always)]
    fn store(self, d: &mut [f32]) {
        assert!(d.len() >= 4);
        unsafe { vst1q_f32(d.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        unsafe { F32x4(vfmaq_f32(c.0, self.0, b.0)) }
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        unsafe { F32x4(vfmsq_f32(c.0, self.0, b.0)) }
    }
    #[inline(always)]
    fn min(self, b: Self) -> Self {
        // not the instruction: it returns NaN where either is
        self.select(self.lt(b), b)
    }
    #[inline(always)]
    fn max(self, b: Self) -> Self {
        self.select(b.lt(self), b)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        unsafe { F32x4(vabsq_f32(self.0)) }
    }
    #[inline(always)]
    fn negative(self) -> Self {
        unsafe { F32x4::from_bits(vorrq_u32(self.bits(), vdupq_n_u32(1 << 31))) }
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        unsafe { F32x4(vsqrtq_f32(self.0)) }
    }
    #[inline(always)]
    fn recip(self) -> Self {
        F32x4::splat(1.0) / self
    }
    #[inline(always)]
    fn recip_fast(self) -> Self {
        // 8 bits from the table, one Newton step
        unsafe {
            let r = vrecpeq_f32(self.0);
            F32x4(vmulq_f32(r, vrecpsq_f32(self.0, r)))
        }
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        // the instructions return NaN where either is
        let x = unsafe { vminq_f32(vmaxq_f32(self.0, vdupq_n_f32(-127.0)), vdupq_n_f32(128.0)) };
        let (x, magic) = (F32x4(x), F32x4::splat(MAGIC));
        let up = x + magic;
        let p = exp2_poly(x - (up - magic));
        // 2^n from the exponent field: 0 for n = -127, infinity for n = 128
        unsafe { p * F32x4::from_bits(vshlq_n_u32::<23>(vaddq_u32(up.bits(), vdupq_n_u32(127)))) }
    }
    #[inline(always)]
    fn exp2_near<const N: usize>(x: [Self; N]) -> [Self; N] {
        let (up, p) = exp2_polys(x, Self::splat(MAGIC));
        std::array::from_fn(|i| unsafe { F32x4::from_bits(vaddq_u32(p[i].bits(), vshlq_n_u32::<23>(up[i].bits()))) })
    }
    #[inline(always)]
    fn split_exponent(self) -> (Self, Self) {
        unsafe {
            let bits = self.bits();
            let e = vsubq_s32(vreinterpretq_s32_u32(vshrq_n_u32::<23>(bits)), vdupq_n_s32(127));
            let m = vorrq_u32(vandq_u32(bits, vdupq_n_u32(0x007f_ffff)), vdupq_n_u32(0x3f80_0000));
            (F32x4::from_bits(m), F32x4(vcvtq_f32_s32(e)))
        }
    }
    #[inline(always)]
    fn ge(self, b: Self) -> Mask4 {
        unsafe { Mask4(vcgeq_f32(self.0, b.0)) }
    }
    #[inline(always)]
    fn lt(self, b: Self) -> Mask4 {
        unsafe { Mask4(vcltq_f32(self.0, b.0)) }
    }
    #[inline(always)]
    fn select(self, m: Mask4, b: Self) -> Self {
        unsafe { F32x4(vbslq_f32(m.0, self.0, b.0)) }
    }
    #[inline(always)]
    fn any(m: Mask4) -> bool {
        unsafe { vmaxvq_u32(m.0) != 0 }
    }
    #[inline(always)]
    fn bits(m: Mask4) -> u32 {
        unsafe {
            let place = vld1q_u32([1, 2, 4, 8].as_ptr());
            vaddvq_u32(vandq_u32(m.0, place))
        }
    }
    #[inline(always)]
    fn max_lane(self) -> f32 {
        unsafe { vmaxvq_f32(self.0) }
    }
    #[inline(always)]
    fn sum12(v: &[Self; 12], out: &mut [f32; 12]) {
        for (out, v) in out.as_chunks_mut::<4>().0.iter_mut().zip(v.as_chunks::<4>().0) {
            sum4(*v).store(out);
        }
    }
}
