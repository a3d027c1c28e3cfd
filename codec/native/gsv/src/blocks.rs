//! Tables of model state in blocks; only used blocks take memory.
//!
//! A table may start from another one: it copies a block at its first use. So the memory of a model grows with the
//! contexts that its stream uses, not with all contexts: streams of few Gaussians are cheap, hostile ones included.

use std::sync::Arc;

/// A table of up to 65535 blocks.
#[derive(Clone)]
pub struct Blocks<B: 'static> {
    new: &'static B,
    places: Vec<u16>, // 1 + index in `used` of each block, or 0
    used: Vec<B>,
    base: Option<Arc<Blocks<B>>>, // initial state of the unused blocks; None: `new`
}

impl<B: Clone + 'static> Blocks<B> {
    pub fn new(count: usize, new: &'static B) -> Self {
        Blocks {
            new,
            places: vec![0; count],
            used: Vec::new(),
            base: None,
        }
    }

    /// Block `i`, mutable.
    ///
    /// `i` is computed from decoded values, never from raw input, so it is in range by construction.
    #[inline]
    pub fn get(&mut self, i: usize) -> &mut B {
        let place = usize::from(self.places[i]).wrapping_sub(1);
        if place >= self.used.len() {
            return self.start(i);
        }
        &mut self.used[place]
    }

    #[cold]
    fn start(&mut self, i: usize) -> &mut B {
        let known = self.base.as_ref().and_then(|base| base.find(i));
        self.used.push(known.unwrap_or(self.new).clone());
        self.places[i] = self.used.len() as u16;
        let last = self.used.len() - 1;
        &mut self.used[last]
    }

    fn find(&self, i: usize) -> Option<&B> {
        match usize::from(*self.places.get(i)?) {
            0 => self.base.as_ref()?.find(i),
            place => self.used.get(place - 1),
        }
    }

    /// Applies `f` to the used blocks. After that, copies of this table share these blocks and copy a block at its
    /// first use.
    pub fn settle(&mut self, f: impl FnMut(&mut B)) {
        self.used.iter_mut().for_each(f);
        let blank = Blocks::new(self.places.len(), self.new);
        let learned = std::mem::replace(self, blank);
        self.base = Some(Arc::new(learned));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_was_used_is_settled() {
        let mut blocks = Blocks::new(3, &7u32);
        *blocks.get(1) += 1;
        blocks.settle(|b| *b *= 10);
        assert_eq!([0, 1, 2].map(|i| *blocks.clone().get(i)), [7, 80, 7]);
    }

    proptest! {
        /// Tables and their copies, with `settle` in between, equal plain arrays.
        #[test]
        fn as_a_plain_table(steps in proptest::collection::vec((0..4usize, 0..40usize, 1..9u32), 0..60)) {
            let mut tables = vec![(Blocks::new(40, &7u32), [7u32; 40])];
            for (what, i, v) in steps {
                let at = i % tables.len();
                let (blocks, plain) = &mut tables[at];
                match what {
                    0 => blocks.settle(|_| ()),
                    1 => {
                        let copy = (blocks.clone(), *plain);
                        tables.push(copy);
                    }
                    _ => {
                        *blocks.get(i) += v;
                        plain[i] += v;
                    }
                }
                for (blocks, plain) in &mut tables {
                    let same = plain.iter().enumerate().all(|(i, b)| blocks.find(i).unwrap_or(&7) == b);
                    prop_assert!(same);
                }
            }
        }
    }
}
