//! The vector interface that the kernels are generic over, and the functions that its instances share.

use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

/// LANES floats. `Mask` has one truth value a lane.
pub trait Vector:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + Send
    + Sync
    + 'static
{
    const LANES: usize;
    type Mask: Copy + BitAnd<Output = Self::Mask> + BitOr<Output = Self::Mask> + Not<Output = Self::Mask>;

    fn splat(x: f32) -> Self;
    /// Loads the first LANES values of `s`, which must have as many.
    fn load(s: &[f32]) -> Self;
    fn store(self, d: &mut [f32]);
    /// self * b + c
    fn mul_add(self, b: Self, c: Self) -> Self;
    /// c - self * b
    fn neg_mul_add(self, b: Self, c: Self) -> Self;
    /// The smaller one; `b` where either is NaN.
    fn min(self, b: Self) -> Self;
    /// The larger one; `b` where either is NaN.
    fn max(self, b: Self) -> Self;
    fn abs(self) -> Self;
    fn sqrt(self) -> Self;
    /// 1/x within 1e-6
    fn recip(self) -> Self;
    /// 1/x within 1e-4, good enough for gradients.
    #[inline(always)]
    fn recip_fast(self) -> Self {
        self.recip()
    }
    /// -|x|
    fn negative(self) -> Self;
    /// 2^x, relative error below 5e-6 for -126 <= x <= 126; 0 or infinity far outside.
    fn exp2(self) -> Self;
    /// 2^x as `exp2` of several independent vectors, for -126 <= x <= 126 only; anything for other x.
    #[inline(always)]
    fn exp2_near<const N: usize>(x: [Self; N]) -> [Self; N] {
        x.map(Self::exp2)
    }
    /// (m, e) with x = m 2^e, m in [1, 2), for positive normal x.
    fn split_exponent(self) -> (Self, Self);
    fn ge(self, b: Self) -> Self::Mask;
    fn lt(self, b: Self) -> Self::Mask;
    /// `self` where the mask is set, `b` elsewhere.
    fn select(self, m: Self::Mask, b: Self) -> Self;
    fn any(m: Self::Mask) -> bool;
    /// Bit i is lane i.
    fn bits(m: Self::Mask) -> u32;
    fn max_lane(self) -> f32;
    /// The sum over the lanes of each of 12 vectors.
    fn sum12(v: &[Self; 12], out: &mut [f32; 12]);

    /// log2(x) for positive normal x, absolute error below 2e-7 (+ rounding of the exponent).
    #[inline(always)]
    fn log2(self) -> Self {
        let (m, e) = self.split_exponent();
        let high = m.ge(Self::splat(std::f32::consts::SQRT_2));
        let m = (m * Self::splat(0.5)).select(high, m);
        let e = (e + Self::splat(1.0)).select(high, e);
        let one = Self::splat(1.0);
        let t = (m - one) / (m + one);
        let t2 = t * t;
        let p = t2.mul_add(Self::splat(1.0 / 9.0), Self::splat(1.0 / 7.0));
        let p = t2.mul_add(p, Self::splat(1.0 / 5.0));
        let p = t2.mul_add(p, Self::splat(1.0 / 3.0));
        let p = t2.mul_add(p, one);
        (t * p).mul_add(Self::splat(2.0 * std::f32::consts::LOG2_E), e)
    }

    #[inline(always)]
    fn finite(self) -> Self::Mask {
        self.abs().lt(Self::splat(f32::INFINITY))
    }
}

/// A constant in every lane. (Not a closure in the kernels: closures are compiled without the target features.)
#[inline(always)]
pub(crate) fn c<V: Vector>(x: f32) -> V {
    V::splat(x)
}

/// Prefetches `items[index]` into the cache.
#[inline(always)]
pub(crate) fn prefetch<T>(items: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    if let Some(item) = items.get(index) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: SSE is part of x86_64, and the address is that of an item.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(item).cast()) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (items, index);
}

/// 1.5 * 2^23: adding it rounds to an integer, which is then in the low bits.
pub(crate) const MAGIC: f32 = 12_582_912.0;

/// Minimax polynomial of 2^f on [-0.5, 0.5], degree 4, relative error 2.6e-6.
#[inline(always)]
pub(crate) fn exp2_poly<V: Vector>(f: V) -> V {
    let p = f.mul_add(c(9.570_097e-3), c(5.591_786e-2));
    let p = f.mul_add(p, c(2.402_474_5e-1));
    let p = f.mul_add(p, c(6.931_218e-1));
    f.mul_add(p, c(9.999_992e-1))
}

/// x + magic, and 2^(x - x rounded); the N vectors are interleaved, which hides the latency.
#[inline(always)]
pub(crate) fn exp2_polys<V: Vector, const N: usize>(x: [V; N], magic: V) -> ([V; N], [V; N]) {
    let up = x.map(|x| x + magic);
    let mut f = x;
    for i in 0..N {
        f[i] = x[i] - (up[i] - magic);
    }
    let mut p = [c::<V>(9.570_097e-3); N];
    for k in [5.591_786e-2, 2.402_474_5e-1, 6.931_218e-1, 9.999_992e-1] {
        for i in 0..N {
            p[i] = f[i].mul_add(p[i], c(k));
        }
    }
    (up, p)
}
