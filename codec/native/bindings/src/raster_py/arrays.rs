//! Arguments from Python for all bindings of the rasterizer: f32 arrays, the name of an instruction set; and errors on
//! the way back.

use numpy::{PyReadonlyArrayDyn, PyReadwriteArrayDyn};
use pyo3::exceptions::{PyOverflowError, PyValueError};
use pyo3::prelude::*;
use raster::{RasterError, SimdLevel};

pub type In<'py> = PyReadonlyArrayDyn<'py, f32>;
pub type InOut<'py> = PyReadwriteArrayDyn<'py, f32>;

/// ValueError for wrong arguments, OverflowError for more work than the limits allow.
pub fn usage(e: RasterError) -> PyErr {
    match e {
        RasterError::TooMany { .. } => PyOverflowError::new_err(e.to_string()),
        _ => PyValueError::new_err(e.to_string()),
    }
}

pub fn contiguous<T>(r: Result<T, impl std::fmt::Display>) -> PyResult<T> {
    r.map_err(|e| PyValueError::new_err(e.to_string()))
}

/// The instruction set `name`, "auto": the fastest one of this machine.
pub fn level(name: &str) -> PyResult<SimdLevel> {
    if name == "auto" {
        return Ok(SimdLevel::best());
    }
    let available = SimdLevel::available();
    let names: Vec<&str> = available.iter().map(|l| l.name()).collect();
    available.iter().copied().find(|l| l.name() == name).ok_or_else(|| {
        PyValueError::new_err(format!(
            "simd {name:?} is not available here, expected auto or one of {}",
            names.join(", ")
        ))
    })
}
