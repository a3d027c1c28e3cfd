//! The clock of the timings. wasm32-unknown-unknown has none (`std::time::Instant` panics there); its host measures.

#[cfg(not(target_arch = "wasm32"))]
pub use std::time::Instant;

#[cfg(target_arch = "wasm32")]
#[derive(Clone, Copy)]
pub struct Instant;

#[cfg(target_arch = "wasm32")]
impl Instant {
    pub fn now() -> Instant {
        Instant
    }

    pub fn elapsed(self) -> std::time::Duration {
        std::time::Duration::ZERO
    }
}
