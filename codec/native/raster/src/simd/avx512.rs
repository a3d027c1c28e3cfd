//! 16 lanes, AVX-512 F/DQ/VL/BW.
//!
//! Why `unsafe` is sound here: every function is `#[inline(always)]` and reached only through `dispatch!`, that is
//! inside a function that has these target features and that is called only after they were detected. Loads and stores
//! check the length of the slice first; the intrinsics have no other precondition.

use std::arch::x86_64::*;
use std::ops::{Add, Div, Mul, Neg, Sub};

use super::vector::{MAGIC, Vector, exp2_poly, exp2_polys};

#[derive(Clone, Copy)]
pub struct F32x16(__m512);

macro_rules! binary {
    ($trait:ident, $method:ident, $intrinsic:ident) => {
        impl $trait for F32x16 {
            type Output = F32x16;
            #[inline(always)]
            fn $method(self, b: F32x16) -> F32x16 {
                // SAFETY: see the head of this file.
                unsafe { F32x16($intrinsic(self.0, b.0)) }
            }
        }
    };
}
binary!(Add, add, _mm512_add_ps);
binary!(Sub, sub, _mm512_sub_ps);
binary!(Mul, mul, _mm512_mul_ps);
binary!(Div, div, _mm512_div_ps);

impl Neg for F32x16 {
    type Output = F32x16;
    #[inline(always)]
    fn neg(self) -> F32x16 {
        // SAFETY: see the head of this file.
        unsafe { F32x16(_mm512_xor_ps(self.0, _mm512_set1_ps(-0.0))) }
    }
}

/// Per 128-bit lane [sum a, sum b, sum c, sum d] of that lane's four floats.
#[inline(always)]
fn sum4(a: F32x16, b: F32x16, c: F32x16, d: F32x16) -> __m512 {
    // SAFETY: see the head of this file.
    unsafe {
        let ab = _mm512_add_ps(_mm512_unpacklo_ps(a.0, b.0), _mm512_unpackhi_ps(a.0, b.0));
        let cd = _mm512_add_ps(_mm512_unpacklo_ps(c.0, d.0), _mm512_unpackhi_ps(c.0, d.0));
        let (ab, cd) = (_mm512_castps_pd(ab), _mm512_castps_pd(cd));
        _mm512_add_ps(
            _mm512_castpd_ps(_mm512_unpacklo_pd(ab, cd)),
            _mm512_castpd_ps(_mm512_unpackhi_pd(ab, cd)),
        )
    }
}

// SAFETY of every block below: see the head of this file.
impl Vector for F32x16 {
    const LANES: usize = 16;
    type Mask = __mmask16;

    #[inline(always)]
    fn splat(x: f32) -> Self {
        unsafe { F32x16(_mm512_set1_ps(x)) }
    }
    #[inline(always)]
    fn load(s: &[f32]) -> Self {
        assert!(s.len() >= 16);
        unsafe { F32x16(_mm512_loadu_ps(s.as_ptr())) }
    }
    #[inline(always)]
    fn store(self, d: &mut [f32]) {
        assert!(d.len() >= 16);
        unsafe { _mm512_storeu_ps(d.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        unsafe { F32x16(_mm512_fmadd_ps(self.0, b.0, c.0)) }
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        unsafe { F32x16(_mm512_fnmadd_ps(self.0, b.0, c.0)) }
    }
    #[inline(always)]
    fn min(self, b: Self) -> Self {
        unsafe { F32x16(_mm512_min_ps(self.0, b.0)) }
    }
    #[inline(always)]
    fn max(self, b: Self) -> Self {
        unsafe { F32x16(_mm512_max_ps(self.0, b.0)) }
    }
    #[inline(always)]
    fn abs(self) -> Self {
        unsafe { F32x16(_mm512_abs_ps(self.0)) }
    }
    #[inline(always)]
    fn negative(self) -> Self {
        unsafe { F32x16(_mm512_or_ps(self.0, _mm512_set1_ps(-0.0))) }
    }
    #[inline(always)]
    fn recip_fast(self) -> Self {
        unsafe { F32x16(_mm512_rcp14_ps(self.0)) }
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        unsafe { F32x16(_mm512_sqrt_ps(self.0)) }
    }
    #[inline(always)]
    fn recip(self) -> Self {
        // 14 bits from the table, one Newton step
        let r = unsafe { F32x16(_mm512_rcp14_ps(self.0)) };
        r * self.neg_mul_add(r, F32x16::splat(2.0))
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        unsafe {
            let n = _mm512_roundscale_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(self.0);
            let p = exp2_poly(self - F32x16(n));
            F32x16(_mm512_scalef_ps(p.0, n))
        }
    }
    #[inline(always)]
    fn exp2_near<const N: usize>(x: [Self; N]) -> [Self; N] {
        let (up, mut p) = exp2_polys(x, Self::splat(MAGIC));
        for (p, up) in p.iter_mut().zip(up) {
            // SAFETY: see the head of this file.
            unsafe {
                let n = _mm512_slli_epi32::<23>(_mm512_castps_si512(up.0));
                p.0 = _mm512_castsi512_ps(_mm512_add_epi32(_mm512_castps_si512(p.0), n));
            }
        }
        p
    }
    #[inline(always)]
    fn split_exponent(self) -> (Self, Self) {
        unsafe {
            let m = _mm512_getmant_ps::<_MM_MANT_NORM_1_2, _MM_MANT_SIGN_SRC>(self.0);
            (F32x16(m), F32x16(_mm512_getexp_ps(self.0)))
        }
    }
    #[inline(always)]
    fn ge(self, b: Self) -> __mmask16 {
        unsafe { _mm512_cmp_ps_mask::<_CMP_GE_OQ>(self.0, b.0) }
    }
    #[inline(always)]
    fn lt(self, b: Self) -> __mmask16 {
        unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, b.0) }
    }
    #[inline(always)]
    fn select(self, m: __mmask16, b: Self) -> Self {
        unsafe { F32x16(_mm512_mask_blend_ps(m, b.0, self.0)) }
    }
    #[inline(always)]
    fn any(m: __mmask16) -> bool {
        m != 0
    }
    #[inline(always)]
    fn bits(m: __mmask16) -> u32 {
        m.into()
    }
    #[inline(always)]
    fn max_lane(self) -> f32 {
        unsafe { _mm512_reduce_max_ps(self.0) }
    }
    #[inline(always)]
    fn sum12(v: &[Self; 12], out: &mut [f32; 12]) {
        let x = sum4(v[0], v[1], v[2], v[3]);
        let y = sum4(v[4], v[5], v[6], v[7]);
        let z = sum4(v[8], v[9], v[10], v[11]);
        unsafe {
            // lanes of 128 bits: [x0+x2, x1+x3, y0+y2, y1+y3], then [x, y, z, z]
            let xy = _mm512_add_ps(_mm512_shuffle_f32x4::<0x44>(x, y), _mm512_shuffle_f32x4::<0xee>(x, y));
            let zz = _mm512_add_ps(_mm512_shuffle_f32x4::<0x44>(z, z), _mm512_shuffle_f32x4::<0xee>(z, z));
            let s = _mm512_add_ps(
                _mm512_shuffle_f32x4::<0x88>(xy, zz),
                _mm512_shuffle_f32x4::<0xdd>(xy, zz),
            );
            _mm512_mask_storeu_ps(out.as_mut_ptr(), 0x0fff, s);
        }
    }
}
