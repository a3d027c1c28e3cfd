//! Eight 16-bit lanes of a distribution (spec 6.6) at once. Compilers vectorize the plain form on every processor but
//! wasm, which has no instruction for the upper half of a product; there it is written with intrinsics, which decode a
//! group in the page in two thirds of the time.

/// Eight cumulative probabilities times 65536.
pub type Lanes = [u16; 8];

#[cfg(not(target_arch = "wasm32"))]
pub use plain::*;
#[cfg(target_arch = "wasm32")]
pub use wasm::*;

#[cfg(not(target_arch = "wasm32"))]
mod plain {
    use super::Lanes;

    /// The upper half of a product.
    #[inline]
    fn high(a: u16, b: u16) -> u16 {
        ((u32::from(a) * u32::from(b)) >> 16) as u16
    }

    /// `ends`, moved by `rate` / 65536 towards 65535 in the lanes from `symbol` on and towards 0 before it.
    #[inline]
    pub fn learned(ends: Lanes, symbol: i16, rate: u16) -> Lanes {
        std::array::from_fn(|i| {
            let target = if i as i16 >= symbol { u16::MAX } else { 0 };
            let off = ends[i] ^ target; // distance from the target
            (off - high(off, rate)) ^ target
        })
    }

    /// Weighted mean of three distributions, less a 512th, plus `least` per symbol; lane 0 ends symbol `number` (from 1
    /// on).
    #[inline]
    pub fn mean(ends: [Lanes; 3], weights: [u16; 3], least: u16, number: u16) -> Lanes {
        std::array::from_fn(|i| {
            let mean = high(ends[0][i], weights[0]) + high(ends[1][i], weights[1]) + high(ends[2][i], weights[2]);
            mean - (mean >> 9) + least * (number + i as u16)
        })
    }

    /// How many lanes are at most `value`.
    #[inline]
    pub fn count(ends: Lanes, value: u16) -> u16 {
        ends.iter().map(|end| u16::from(*end <= value)).sum()
    }
}

#[cfg(target_arch = "wasm32")]
mod wasm {
    use super::Lanes;
    use std::arch::wasm32::*;

    #[inline]
    fn load(v: Lanes) -> v128 {
        u16x8(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7])
    }

    #[inline]
    fn store(v: v128) -> Lanes {
        let [a, b, c, d] = [
            u16x8_extract_lane::<0>(v),
            u16x8_extract_lane::<1>(v),
            u16x8_extract_lane::<2>(v),
            u16x8_extract_lane::<3>(v),
        ];
        let [e, f, g, h] = [
            u16x8_extract_lane::<4>(v),
            u16x8_extract_lane::<5>(v),
            u16x8_extract_lane::<6>(v),
            u16x8_extract_lane::<7>(v),
        ];
        [a, b, c, d, e, f, g, h]
    }

    #[inline]
    fn high(a: v128, b: v128) -> v128 {
        let (low, up) = (u32x4_extmul_low_u16x8(a, b), u32x4_extmul_high_u16x8(a, b));
        u16x8_shuffle::<1, 3, 5, 7, 9, 11, 13, 15>(low, up)
    }

    #[inline]
    pub fn learned(ends: Lanes, symbol: i16, rate: u16) -> Lanes {
        let target = i16x8_ge(i16x8(0, 1, 2, 3, 4, 5, 6, 7), i16x8_splat(symbol));
        let off = v128_xor(load(ends), target);
        store(v128_xor(u16x8_sub(off, high(off, u16x8_splat(rate))), target))
    }

    #[inline]
    pub fn mean(ends: [Lanes; 3], weights: [u16; 3], least: u16, number: u16) -> Lanes {
        let part = |k: usize| high(load(ends[k]), u16x8_splat(weights[k]));
        let mean = u16x8_add(u16x8_add(part(0), part(1)), part(2));
        let numbers = u16x8_add(u16x8(0, 1, 2, 3, 4, 5, 6, 7), u16x8_splat(number));
        store(u16x8_add(
            u16x8_sub(mean, u16x8_shr(mean, 9)),
            u16x8_mul(numbers, u16x8_splat(least)),
        ))
    }

    #[inline]
    pub fn count(ends: Lanes, value: u16) -> u16 {
        u16x8_bitmask(u16x8_le(load(ends), u16x8_splat(value))).count_ones() as u16
    }
}
