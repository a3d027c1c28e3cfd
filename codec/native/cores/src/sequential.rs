//! The part of rayon that the codec uses, as plain loops.

pub fn join<A, B>(a: impl FnOnce() -> A, b: impl FnOnce() -> B) -> (A, B) {
    (a(), b())
}

pub fn current_num_threads() -> usize {
    1
}

/// Runs a closure at once, on the calling thread.
pub struct ThreadPool;

impl ThreadPool {
    pub fn install<R>(&self, f: impl FnOnce() -> R) -> R {
        f()
    }
}

#[derive(Default)]
pub struct ThreadPoolBuilder;

impl ThreadPoolBuilder {
    pub fn new() -> Self {
        ThreadPoolBuilder
    }

    pub fn num_threads(self, _: usize) -> Self {
        self
    }

    pub fn build(self) -> Result<ThreadPool, std::convert::Infallible> {
        Ok(ThreadPool)
    }
}

pub mod prelude {
    use std::slice::{Chunks, ChunksExact, ChunksExactMut, ChunksMut, Iter, IterMut};

    pub trait ParallelSlice<T> {
        fn slice(&self) -> &[T];

        fn par_iter(&self) -> Iter<'_, T> {
            self.slice().iter()
        }

        fn par_chunks(&self, size: usize) -> Chunks<'_, T> {
            self.slice().chunks(size)
        }

        fn par_chunks_exact(&self, size: usize) -> ChunksExact<'_, T> {
            self.slice().chunks_exact(size)
        }
    }

    impl<T> ParallelSlice<T> for [T] {
        fn slice(&self) -> &[T] {
            self
        }
    }

    pub trait ParallelSliceMut<T> {
        fn slice_mut(&mut self) -> &mut [T];

        fn par_iter_mut(&mut self) -> IterMut<'_, T> {
            self.slice_mut().iter_mut()
        }

        fn par_chunks_mut(&mut self, size: usize) -> ChunksMut<'_, T> {
            self.slice_mut().chunks_mut(size)
        }

        fn par_chunks_exact_mut(&mut self, size: usize) -> ChunksExactMut<'_, T> {
            self.slice_mut().chunks_exact_mut(size)
        }

        fn par_sort_unstable(&mut self)
        where
            T: Ord,
        {
            self.slice_mut().sort_unstable();
        }
    }

    impl<T> ParallelSliceMut<T> for [T] {
        fn slice_mut(&mut self) -> &mut [T] {
            self
        }
    }

    pub trait IntoParallelIterator: IntoIterator + Sized {
        fn into_par_iter(self) -> Self::IntoIter {
            self.into_iter()
        }
    }

    impl<I: IntoIterator> IntoParallelIterator for I {}

    pub trait IndexedParallelIterator: Iterator + Sized {
        fn with_min_len(self, _: usize) -> Self {
            self
        }
    }

    impl<I: Iterator> IndexedParallelIterator for I {}

    pub trait ParallelExtend<T>: Extend<T> {
        fn par_extend(&mut self, items: impl IntoIterator<Item = T>) {
            self.extend(items);
        }
    }

    impl<T, E: Extend<T>> ParallelExtend<T> for E {}
}
