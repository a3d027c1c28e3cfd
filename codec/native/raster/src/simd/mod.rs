//! SIMD: every kernel is written once, generic over `Vector`, and compiled for each instruction set.
//!
//! Instances: `f32` (the scalar reference); AVX2 + FMA and AVX-512, chosen at run time by `SimdLevel`; NEON and
//! WebAssembly simd128, chosen by the build; a portable one for all other machines. `dispatch!` makes the entry point
//! of a kernel: it compiles the instance inside a function with the target features, so that the intrinsics inline.

#[cfg(target_arch = "x86_64")]
pub mod avx2;
#[cfg(target_arch = "x86_64")]
pub mod avx512;
mod level;
#[cfg(target_arch = "aarch64")]
pub mod neon;
#[cfg(not(target_family = "wasm"))]
pub mod portable;
mod scalar;
pub mod vector;
#[cfg(all(target_arch = "wasm32", target_feature = "simd128"))]
pub mod wasm128;

pub(crate) use level::Isa;
pub use level::SimdLevel;
pub use vector::Vector;
pub(crate) use vector::{MAGIC, c, prefetch};

/// `dispatch!(pub fn name = kernel(arg: Type, ...) -> Ret)`: a function that takes a `SimdLevel` first and runs
/// `kernel::<V>` with the vector type of that level.
macro_rules! dispatch {
    ($(#[$doc:meta])* $vis:vis fn $name:ident$(<const $n:ident: $of:ty>)? = $kernel:ident($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)?) => {
        $(#[$doc])*
        #[allow(clippy::too_many_arguments)]
        $vis fn $name$(<const $n: $of>)?(level: $crate::simd::SimdLevel, $($arg: $ty),*) $(-> $ret)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,avx512f,avx512dq,avx512vl,avx512bw")]
                fn avx512$(<const $n: $of>)?($($arg: $ty),*) $(-> $ret)? {
                    $kernel::<$crate::simd::avx512::F32x16 $(, $n)?>($($arg),*)
                }
                #[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt")]
                fn avx2$(<const $n: $of>)?($($arg: $ty),*) $(-> $ret)? {
                    $kernel::<$crate::simd::avx2::F32x8 $(, $n)?>($($arg),*)
                }
                match level.isa() {
                    // SAFETY: a SimdLevel of this value exists only after run-time detection of these features.
                    $crate::simd::Isa::Avx512 => return unsafe { avx512$(::<$n>)?($($arg),*) },
                    // SAFETY: as above.
                    $crate::simd::Isa::Avx2 => return unsafe { avx2$(::<$n>)?($($arg),*) },
                    $crate::simd::Isa::Portable | $crate::simd::Isa::Scalar => {}
                }
            }
            #[cfg(all(target_arch = "wasm32", target_feature = "simd128"))]
            if level.isa() == $crate::simd::Isa::Wasm128 {
                return $kernel::<$crate::simd::wasm128::F32x4 $(, $n)?>($($arg),*);
            }
            #[cfg(target_arch = "aarch64")]
            if level.isa() == $crate::simd::Isa::Neon {
                return $kernel::<$crate::simd::neon::F32x4 $(, $n)?>($($arg),*);
            }
            #[cfg(not(target_family = "wasm"))]
            if level.isa() == $crate::simd::Isa::Portable {
                return $kernel::<$crate::simd::portable::F32x4 $(, $n)?>($($arg),*);
            }
            let _ = level;
            $kernel::<f32 $(, $n)?>($($arg),*)
        }
    };
}
pub(crate) use dispatch;

#[cfg(test)]
mod tests;
