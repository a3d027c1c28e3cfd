//! Work on all cores; in wasm, where there is one, plain loops, which take less code.

#[cfg(not(target_arch = "wasm32"))]
mod cores {
    use rayon::prelude::*;

    /// `f` of each item, in their order.
    pub fn map<T: Sync, R: Send>(items: &[T], f: impl Fn(&T) -> R + Sync + Send) -> Vec<R> {
        items.par_iter().map(f).collect()
    }

    /// Both at the same time.
    pub fn join<A: Send, B: Send>(a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
        rayon::join(a, b)
    }
}

#[cfg(target_arch = "wasm32")]
mod cores {
    pub fn map<T, R>(items: &[T], f: impl Fn(&T) -> R) -> Vec<R> {
        items.iter().map(f).collect()
    }

    pub fn join<A, B>(a: impl FnOnce() -> A, b: impl FnOnce() -> B) -> (A, B) {
        (a(), b())
    }
}

pub use cores::{join, map};
