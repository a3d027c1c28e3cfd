//! Deaths (spec 10.1): flags of the Gaussians of the reference that are missing in a predicted group <-> bins, in
//! contexts made of the neighbours' flags.

use crate::model::Model;
use crate::neighbors::Near;
use crate::range_coder::Bins;

/// Codes `dead`, one flag per Gaussian of the layer of the reference; `near`: their neighbours. False if the payload is
/// over.
pub fn code<C: Bins>(c: &mut C, near: &[Near], dead: &mut [bool]) -> bool {
    let mut model = Model::new(4, 5, 1);
    for (i, near) in near.iter().enumerate() {
        let (done, rest) = dead.split_at_mut(i);
        let Some(own) = rest.first_mut() else { return false };
        let d = near.map(|j| usize::from(done.get(j as usize).is_some_and(|d| *d)));
        *own = model.bin(c, *own, 2 * d[0] + d[1], d.iter().sum(), 0);
        if !c.alive() {
            return false;
        }
    }
    true
}
