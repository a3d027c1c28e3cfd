//! Rayon; in wasm, where an instance has one core, plain loops under the same names, since rayon would be a fifth of
//! the code. The crates that use it call it rayon.
#![forbid(unsafe_code)]

#[cfg(not(target_arch = "wasm32"))]
pub use rayon::*;

#[cfg(target_arch = "wasm32")]
mod sequential;
#[cfg(target_arch = "wasm32")]
pub use sequential::*;
