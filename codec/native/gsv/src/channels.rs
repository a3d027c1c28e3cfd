//! Channels (spec 9): the canonical integers of one attribute <-> bins.

use crate::attributes::Attribute;
use crate::neighbors::{NEAR, Near};
use crate::range_coder::Bins;
use crate::values::ValueModel;

/// Codes `values`, which holds the C channels of Gaussian i at `C * i..`. False if a forbidden value was read.
pub fn code<C: Bins>(c: &mut C, attribute: Attribute, channels: usize, near: &[Near], values: &mut [i32]) -> bool {
    let (classes, second) = if attribute == Attribute::ShN {
        (9, 3)
    } else {
        (channels, 2)
    };
    let class: Vec<usize> = (0..channels)
        .map(|ch| if classes == 9 { sh_class(ch) } else { ch })
        .collect();
    let mut model = ValueModel::new(classes);
    for (i, near) in near.iter().enumerate() {
        let (done, rest) = values.split_at_mut(i * channels);
        let Some(own) = rest.get_mut(..channels) else {
            return false;
        };
        for (ch, &class) in class.iter().enumerate() {
            let mut around = [0; NEAR];
            let mut present = 0;
            for v in near.iter().map_while(|j| done.get(*j as usize * channels + ch)) {
                around[present] = *v;
                present += 1;
            }
            let back = |n: usize| ch.checked_sub(n).map_or(0, |k| own[k]);
            own[ch] = model.value(c, class, own[ch], &around[..present], [back(1), back(second)]);
        }
        if model.broken || !c.alive() {
            return false;
        }
    }
    true
}

/// Band and colour of a channel of shN.
fn sh_class(channel: usize) -> usize {
    let band = match channel / 3 {
        0..3 => 0,
        3..8 => 1,
        _ => 2,
    };
    3 * band + channel % 3
}
