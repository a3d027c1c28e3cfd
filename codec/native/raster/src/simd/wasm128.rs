//! 4 lanes, WebAssembly simd128, chosen when the target is built with it (there is no run-time detection on the web).
//!
//! Why `unsafe` is sound here: only loads and stores need it, and they check the length of the slice first.

use std::arch::wasm32::*;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

use super::vector::{MAGIC, Vector, exp2_poly, exp2_polys};

#[derive(Clone, Copy)]
pub struct F32x4(v128);

/// All bits of a lane set or none.
#[derive(Clone, Copy)]
pub struct Mask4(v128);

macro_rules! binary {
    ($type:ident, $trait:ident, $method:ident, $intrinsic:ident) => {
        impl $trait for $type {
            type Output = $type;
            #[inline(always)]
            fn $method(self, b: $type) -> $type {
                $type($intrinsic(self.0, b.0))
            }
        }
    };
}
binary!(F32x4, Add, add, f32x4_add);
binary!(F32x4, Sub, sub, f32x4_sub);
binary!(F32x4, Mul, mul, f32x4_mul);
binary!(F32x4, Div, div, f32x4_div);
binary!(Mask4, BitAnd, bitand, v128_and);
binary!(Mask4, BitOr, bitor, v128_or);

impl Neg for F32x4 {
    type Output = F32x4;
    #[inline(always)]
    fn neg(self) -> F32x4 {
        F32x4(f32x4_neg(self.0))
    }
}

impl Not for Mask4 {
    type Output = Mask4;
    #[inline(always)]
    fn not(self) -> Mask4 {
        Mask4(v128_not(self.0))
    }
}

/// The sum of the four vectors' lanes, as a vector.
#[inline(always)]
fn sum4(a: v128, b: v128, c: v128, d: v128) -> v128 {
    let ab = f32x4_add(i32x4_shuffle::<0, 4, 1, 5>(a, b), i32x4_shuffle::<2, 6, 3, 7>(a, b));
    let cd = f32x4_add(i32x4_shuffle::<0, 4, 1, 5>(c, d), i32x4_shuffle::<2, 6, 3, 7>(c, d));
    f32x4_add(i32x4_shuffle::<0, 1, 4, 5>(ab, cd), i32x4_shuffle::<2, 3, 6, 7>(ab, cd))
}

impl Vector for F32x4 {
    const LANES: usize = 4;
    type Mask = Mask4;

    #[inline(always)]
    fn splat(x: f32) -> Self {
        F32x4(f32x4_splat(x))
    }
    #[inline(always)]
    fn load(s: &[f32]) -> Self {
        assert!(s.len() >= 4);
        // SAFETY: four values are there.
        unsafe { F32x4(v128_load(s.as_ptr().cast())) }
    }
    #[inline(always)]
    fn store(self, d: &mut [f32]) {
        assert!(d.len() >= 4);
        // SAFETY: four values are there.
        unsafe { v128_store(d.as_mut_ptr().cast(), self.0) }
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
        F32x4(f32x4_pmin(b.0, self.0))
    }
    #[inline(always)]
    fn max(self, b: Self) -> Self {
        F32x4(f32x4_pmax(b.0, self.0))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        F32x4(f32x4_abs(self.0))
    }
    #[inline(always)]
    fn negative(self) -> Self {
        F32x4(v128_or(self.0, f32x4_splat(-0.0)))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        F32x4(f32x4_sqrt(self.0))
    }
    #[inline(always)]
    fn recip(self) -> Self {
        F32x4(f32x4_div(f32x4_splat(1.0), self.0))
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        // pmin and pmax return their first operand where the second is NaN or not beyond it
        let x = f32x4_pmax(self.0, f32x4_splat(-127.0));
        let x = f32x4_pmin(x, f32x4_splat(128.0));
        // engines convert to integers slowly, since they must saturate
        let z = f32x4_add(x, f32x4_splat(MAGIC));
        let p = exp2_poly(F32x4(f32x4_sub(x, f32x4_sub(z, f32x4_splat(MAGIC)))));
        // 2^n from the exponent field: 0 for n = -127, infinity for n = 128
        let e = i32x4_shl(i32x4_add(z, i32x4_splat(127)), 23);
        F32x4(f32x4_mul(p.0, e))
    }
    #[inline(always)]
    fn exp2_near<const N: usize>(x: [Self; N]) -> [Self; N] {
        let (up, p) = exp2_polys(x, Self::splat(MAGIC));
        std::array::from_fn(|i| F32x4(i32x4_add(p[i].0, i32x4_shl(up[i].0, 23))))
    }
    #[inline(always)]
    fn split_exponent(self) -> (Self, Self) {
        let e = i32x4_sub(u32x4_shr(self.0, 23), i32x4_splat(127));
        let m = v128_or(v128_and(self.0, i32x4_splat(0x007f_ffff)), i32x4_splat(0x3f80_0000));
        (F32x4(m), F32x4(f32x4_convert_i32x4(e)))
    }
    #[inline(always)]
    fn ge(self, b: Self) -> Mask4 {
        Mask4(f32x4_ge(self.0, b.0))
    }
    #[inline(always)]
    fn lt(self, b: Self) -> Mask4 {
        Mask4(f32x4_lt(self.0, b.0))
    }
    #[inline(always)]
    fn select(self, m: Mask4, b: Self) -> Self {
        // in this form the compiler sees constants
        F32x4(v128_or(v128_and(self.0, m.0), v128_andnot(b.0, m.0)))
    }
    #[inline(always)]
    fn any(m: Mask4) -> bool {
        v128_any_true(m.0)
    }
    #[inline(always)]
    fn bits(m: Mask4) -> u32 {
        u32::from(i32x4_bitmask(m.0))
    }
    #[inline(always)]
    fn max_lane(self) -> f32 {
        let m = f32x4_max(self.0, i32x4_shuffle::<2, 3, 0, 1>(self.0, self.0));
        f32x4_extract_lane::<0>(f32x4_max(m, i32x4_shuffle::<1, 0, 3, 2>(m, m)))
    }
    #[inline(always)]
    fn sum12(v: &[Self; 12], out: &mut [f32; 12]) {
        F32x4(sum4(v[0].0, v[1].0, v[2].0, v[3].0)).store(&mut out[..4]);
        F32x4(sum4(v[4].0, v[5].0, v[6].0, v[7].0)).store(&mut out[4..8]);
        F32x4(sum4(v[8].0, v[9].0, v[10].0, v[11].0)).store(&mut out[8..]);
    }
}
