//! Instruction sets: which ones this build and this machine have.

/// An instruction set that was detected on this machine. It cannot be made otherwise, so kernels may rely on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SimdLevel(Isa);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Isa {
    Scalar,
    #[cfg(not(target_family = "wasm"))]
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "aarch64")]
    Neon,
    #[cfg(all(target_arch = "wasm32", target_feature = "simd128"))]
    Wasm128,
}

impl SimdLevel {
    pub const SCALAR: SimdLevel = SimdLevel(Isa::Scalar);

    /// Fastest first.
    pub fn available() -> Vec<SimdLevel> {
        let mut found = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            let bits = is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2")
                && is_x86_feature_detected!("popcnt");
            let fma = bits && is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
            let f = is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq");
            if fma && f && is_x86_feature_detected!("avx512vl") && is_x86_feature_detected!("avx512bw") {
                found.push(SimdLevel(Isa::Avx512));
            }
            if fma {
                found.push(SimdLevel(Isa::Avx2));
            }
        }
        #[cfg(all(target_arch = "wasm32", target_feature = "simd128"))]
        found.push(SimdLevel(Isa::Wasm128));
        #[cfg(target_arch = "aarch64")]
        found.push(SimdLevel(Isa::Neon));
        #[cfg(not(target_family = "wasm"))]
        found.push(SimdLevel(Isa::Portable));
        found.push(SimdLevel::SCALAR);
        found
    }

    pub fn best() -> SimdLevel {
        SimdLevel::available().first().copied().unwrap_or(SimdLevel::SCALAR)
    }

    pub fn name(self) -> &'static str {
        match self.0 {
            Isa::Scalar => "scalar",
            #[cfg(not(target_family = "wasm"))]
            Isa::Portable => "portable",
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => "avx512",
            #[cfg(target_arch = "aarch64")]
            Isa::Neon => "neon",
            #[cfg(all(target_arch = "wasm32", target_feature = "simd128"))]
            Isa::Wasm128 => "wasm128",
        }
    }

    pub(crate) fn isa(self) -> Isa {
        self.0
    }
}
