//! 8 lanes, AVX2 + FMA.
//!
//! Why `unsafe` is sound here: every function is `#[inline(always)]` and reached only through `dispatch!`, that is
//! inside a function that has these target features and that is called only after they were detected. Loads and stores
//! check the length of the slice first; the intrinsics have no other precondition.

use std::arch::x86_64::*;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

use super::vector::{MAGIC, Vector, exp2_poly, exp2_polys};

#[derive(Clone, Copy)]
pub struct F32x8(__m256);

/// All bits of a lane set or none.
#[derive(Clone, Copy)]
pub struct Mask8(__m256);

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
binary!(F32x8, Add, add, _mm256_add_ps);
binary!(F32x8, Sub, sub, _mm256_sub_ps);
binary!(F32x8, Mul, mul, _mm256_mul_ps);
binary!(F32x8, Div, div, _mm256_div_ps);
binary!(Mask8, BitAnd, bitand, _mm256_and_ps);
binary!(Mask8, BitOr, bitor, _mm256_or_ps);

impl Neg for F32x8 {
    type Output = F32x8;
    #[inline(always)]
    fn neg(self) -> F32x8 {
        // SAFETY: see the head of this file.
        unsafe { F32x8(_mm256_xor_ps(self.0, _mm256_set1_ps(-0.0))) }
    }
}

impl Not for Mask8 {
    type Output = Mask8;
    #[inline(always)]
    fn not(self) -> Mask8 {
        // SAFETY: see the head of this file.
        unsafe { Mask8(_mm256_xor_ps(self.0, _mm256_castsi256_ps(_mm256_set1_epi32(-1)))) }
    }
}

/// Sums over the lanes of four vectors.
#[inline(always)]
fn sum4(a: F32x8, b: F32x8, c: F32x8, d: F32x8) -> __m128 {
    // SAFETY: see the head of this file.
    unsafe {
        let s = _mm256_hadd_ps(_mm256_hadd_ps(a.0, b.0), _mm256_hadd_ps(c.0, d.0));
        _mm_add_ps(_mm256_castps256_ps128(s), _mm256_extractf128_ps::<1>(s))
    }
}

// SAFETY of every block below: see the head of this file.
impl Vector for F32x8 {
    const LANES: usize = 8;
    type Mask = Mask8;

    #[inline(always)]
    fn splat(x: f32) -> Self {
        unsafe { F32x8(_mm256_set1_ps(x)) }
    }
    #[inline(always)]
    fn load(s: &[f32]) -> Self {
        assert!(s.len() >= 8);
        unsafe { F32x8(_mm256_loadu_ps(s.as_ptr())) }
    }
    #[inline(always)]
    fn store(self, d: &mut [f32]) {
        assert!(d.len() >= 8);
        unsafe { _mm256_storeu_ps(d.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        unsafe { F32x8(_mm256_fmadd_ps(self.0, b.0, c.0)) }
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        unsafe { F32x8(_mm256_fnmadd_ps(self.0, b.0, c.0)) }
    }
    #[inline(always)]
    fn min(self, b: Self) -> Self {
        unsafe { F32x8(_mm256_min_ps(self.0, b.0)) }
    }
    #[inline(always)]
    fn max(self, b: Self) -> Self {
        unsafe { F32x8(_mm256_max_ps(self.0, b.0)) }
    }
    #[inline(always)]
    fn abs(self) -> Self {
        unsafe { F32x8(_mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0)) }
    }
    #[inline(always)]
    fn negative(self) -> Self {
        unsafe { F32x8(_mm256_or_ps(self.0, _mm256_set1_ps(-0.0))) }
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        unsafe { F32x8(_mm256_sqrt_ps(self.0)) }
    }
    #[inline(always)]
    fn recip(self) -> Self {
        // 12 bits from the table, one Newton step
        let r = unsafe { F32x8(_mm256_rcp_ps(self.0)) };
        r * self.neg_mul_add(r, F32x8::splat(2.0))
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        unsafe {
            // the operand order of max/min lets NaN through
            let lo = _mm256_max_ps(_mm256_set1_ps(-127.0), self.0);
            let x = _mm256_min_ps(_mm256_set1_ps(128.0), lo);
            let n = _mm256_round_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(x);
            let p = exp2_poly(F32x8(_mm256_sub_ps(x, n)));
            // 2^n from the exponent field: 0 for n = -127, infinity for n = 128
            let e = _mm256_slli_epi32::<23>(_mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127)));
            F32x8(_mm256_mul_ps(p.0, _mm256_castsi256_ps(e)))
        }
    }
    #[inline(always)]
    fn exp2_near<const N: usize>(x: [Self; N]) -> [Self; N] {
        let (up, mut p) = exp2_polys(x, Self::splat(MAGIC));
        for (p, up) in p.iter_mut().zip(up) {
            // SAFETY: see the head of this file.
            unsafe {
                let n = _mm256_slli_epi32::<23>(_mm256_castps_si256(up.0));
                p.0 = _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p.0), n));
            }
        }
        p
    }
    #[inline(always)]
    fn split_exponent(self) -> (Self, Self) {
        unsafe {
            let bits = _mm256_castps_si256(self.0);
            let e = _mm256_sub_epi32(_mm256_srli_epi32::<23>(bits), _mm256_set1_epi32(127));
            let m = _mm256_and_si256(bits, _mm256_set1_epi32(0x007f_ffff));
            let m = _mm256_or_si256(m, _mm256_set1_epi32(0x3f80_0000));
            (F32x8(_mm256_castsi256_ps(m)), F32x8(_mm256_cvtepi32_ps(e)))
        }
    }
    #[inline(always)]
    fn ge(self, b: Self) -> Mask8 {
        unsafe { Mask8(_mm256_cmp_ps::<_CMP_GE_OQ>(self.0, b.0)) }
    }
    #[inline(always)]
    fn lt(self, b: Self) -> Mask8 {
        unsafe { Mask8(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, b.0)) }
    }
    #[inline(always)]
    fn select(self, m: Mask8, b: Self) -> Self {
        unsafe { F32x8(_mm256_blendv_ps(b.0, self.0, m.0)) }
    }
    #[inline(always)]
    fn any(m: Mask8) -> bool {
        unsafe { _mm256_movemask_ps(m.0) != 0 }
    }
    #[inline(always)]
    fn bits(m: Mask8) -> u32 {
        unsafe { _mm256_movemask_ps(m.0) as u32 }
    }
    #[inline(always)]
    fn max_lane(self) -> f32 {
        let mut a = [0.0; 8];
        self.store(&mut a);
        a.iter().fold(f32::NEG_INFINITY, |m, &x| if x > m { x } else { m })
    }
    #[inline(always)]
    fn sum12(v: &[Self; 12], out: &mut [f32; 12]) {
        unsafe {
            _mm_storeu_ps(out.as_mut_ptr(), sum4(v[0], v[1], v[2], v[3]));
            _mm_storeu_ps(out.as_mut_ptr().add(4), sum4(v[4], v[5], v[6], v[7]));
            _mm_storeu_ps(out.as_mut_ptr().add(8), sum4(v[8], v[9], v[10], v[11]));
        }
    }
}
