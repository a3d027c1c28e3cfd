//! Parallel loop over pieces that own the memory they write. The range, and the buffers that belong to it, are halved
//! until a piece has at most `grain` items. Pieces depend on the range only, never on the threads, and nothing is
//! allocated.

use std::ops::Range;

/// Calls `run(piece, buffers)` for pieces of `range` of at most `grain` items. `cut(work, range, middle)` splits the
/// buffers of `range` at item `middle`.
pub fn parallel_for<W: Send>(
    range: Range<usize>,
    grain: usize,
    work: W,
    cut: &(impl Fn(W, &Range<usize>, usize) -> (W, W) + Sync),
    run: &(impl Fn(Range<usize>, W) + Sync),
) {
    if range.len() <= grain {
        if !range.is_empty() {
            run(range, work);
        }
        return;
    }
    let middle = range.start + (range.len() / 2).next_multiple_of(grain);
    let (left, right) = cut(work, &range, middle);
    let (first, last) = (range.start..middle, middle..range.end);
    join(
        || parallel_for(first, grain, left, cut, run),
        || parallel_for(last, grain, right, cut, run),
    );
}

/// Both at the same time; in wasm, where there is one core, one after the other, which takes less code.
fn join(a: impl FnOnce() + Send, b: impl FnOnce() + Send) {
    if cfg!(target_arch = "wasm32") {
        a();
        b();
    } else {
        rayon::join(a, b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_are_aligned_and_cover_the_range() {
        for n in [0, 1, 15, 16, 17, 1000] {
            let mut seen = vec![0usize; n];
            parallel_for(
                0..n,
                16,
                &mut seen[..],
                &|w, r, middle| w.split_at_mut(middle - r.start),
                &|r, w| {
                    assert!(r.start % 16 == 0 && r.len() <= 16 && r.len() == w.len());
                    w.iter_mut().zip(r).for_each(|(v, i)| *v += i + 1);
                },
            );
            assert!(seen.iter().enumerate().all(|(i, &v)| v == i + 1));
        }
    }
}
