//! Work on all cores; in wasm, where an instance has one, plain loops (the crate `cores`).

pub use rayon::join;
use rayon::prelude::*;

/// `f` of each item, in their order.
pub fn map<T: Sync, R: Send>(items: &[T], f: impl Fn(&T) -> R + Sync + Send) -> Vec<R> {
    items.par_iter().map(f).collect()
}
