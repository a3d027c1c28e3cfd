//! Reposing of coded groups, for Python.

use super::decoded::DecodedGroup;
use super::group_from::dense;
use super::values::{bytes_of, raise};
use gsv::decode::Decoding;
use gsv::levels::Level;
use gsv::rig::CHANNELS;
use numpy::PyUntypedArrayMethods;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

/// The payload of a group of level `level` with other poses of its joints: [K, 6, J] i32 DCT coefficients in the steps
/// of its rig. All units but that of the poses stay as they are. `reference`: the group that a predicted one refers to.
#[pyfunction]
#[pyo3(signature = (payload, level, poses, reference = None))]
pub fn repose<'py>(
    py: Python<'py>,
    payload: &Bound<'py, PyAny>,
    level: u8,
    poses: numpy::PyReadonlyArray3<'py, i32>,
    reference: Option<Py<DecodedGroup>>,
) -> PyResult<Bound<'py, PyBytes>> {
    let joints = poses.shape()[2];
    let (_, poses) = dense(poses.as_any(), "joints", CHANNELS, joints)?;
    let bytes = bytes_of(payload)?.as_slice()?.to_vec(); // ours while the GIL is released
    let reference = reference.as_ref().map(|r| r.get().group());
    let written = py.detach(|| {
        let level = Level::get(level)?;
        let how = Decoding {
            reference,
            ..Decoding::at(&level)
        };
        gsv::reposing::repose(&bytes, &how, poses)
    });
    Ok(PyBytes::new(py, &written.map_err(|e| raise(py, e))?))
}
