//! Bindings of the Rust core: feature `python` builds `gscodec._native`, feature `wasm` the decoder of the web player.
//!
//! Arrays in, arrays out, no algorithms.
#[cfg(feature = "python")]
mod gsv_py;
#[cfg(feature = "python")]
mod raster_py;
#[cfg(feature = "wasm")]
mod wasm;

#[cfg(feature = "python")]
#[pyo3::pymodule]
fn _native(m: &pyo3::Bound<'_, pyo3::types::PyModule>) -> pyo3::PyResult<()> {
    gsv_py::register(m)?;
    raster_py::register(m)
}
