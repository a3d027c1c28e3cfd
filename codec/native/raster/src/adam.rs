//! One step of Adam (Kingma and Ba 2015) over an attribute: moments and parameter in one pass over memory.

use rayon::prelude::*;

use crate::error::{RasterError, check_length};
use crate::simd::{SimdLevel, Vector, c, dispatch};

/// Values of one task.
const SHARE: usize = 1 << 14;

/// Parameters of one step, the same for all values of an attribute.
#[derive(Clone, Copy, Debug)]
pub struct Adam {
    pub betas: [f32; 2],
    pub epsilon: f32,
    /// Learning rate over the bias correction of the first moment, 1 - beta1^step.
    pub rate: f32,
    /// 1 / (1 - beta2^step)
    pub correction: f32,
}

impl Adam {
    /// # Errors
    /// Lengths that disagree.
    pub fn step(
        self,
        level: SimdLevel,
        param: &mut [f32],
        grad: &[f32],
        first: &mut [f32],
        second: &mut [f32],
    ) -> Result<(), RasterError> {
        check_length("gradient", grad.len(), param.len())?;
        check_length("first moment", first.len(), param.len())?;
        check_length("second moment", second.len(), param.len())?;
        let moments = first.par_chunks_mut(SHARE).zip(second.par_chunks_mut(SHARE));
        let values = param.par_chunks_mut(SHARE).zip(grad.par_chunks(SHARE));
        values
            .zip(moments)
            .for_each(|((param, grad), (first, second))| adam_values(level, self, param, grad, first, second));
        Ok(())
    }
}

#[inline(always)]
fn values<V: Vector>(a: Adam, at: usize, param: &mut [f32], grad: &[f32], first: &mut [f32], second: &mut [f32]) {
    let g = V::load(&grad[at..]);
    let m = V::load(&first[at..]);
    let m = c::<V>(1.0 - a.betas[0]).mul_add(g - m, m);
    let v = c::<V>(a.betas[1]).mul_add(V::load(&second[at..]), c::<V>(1.0 - a.betas[1]) * g * g);
    let step = c::<V>(a.rate) * m / ((v * c(a.correction)).sqrt() + c(a.epsilon));
    (V::load(&param[at..]) - step).store(&mut param[at..]);
    m.store(&mut first[at..]);
    v.store(&mut second[at..]);
}

#[inline(always)]
fn adam_kernel<V: Vector>(a: Adam, param: &mut [f32], grad: &[f32], first: &mut [f32], second: &mut [f32]) {
    let whole = param.len() / V::LANES * V::LANES;
    for at in (0..whole).step_by(V::LANES) {
        values::<V>(a, at, param, grad, first, second);
    }
    for at in whole..param.len() {
        values::<f32>(a, at, param, grad, first, second);
    }
}
dispatch!(pub fn adam_values = adam_kernel(a: Adam, param: &mut [f32], grad: &[f32], first: &mut [f32], second: &mut [f32]));
