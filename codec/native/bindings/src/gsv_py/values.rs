//! Checked access to values from Python: fields of dataclasses, arrays of one dtype and shape, bytes; and errors on the
//! way back.

use gsv::error::Error;
use numpy::{PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// The exception of gscodec.errors for an error.
pub fn raise(py: Python, e: Error) -> PyErr {
    let class = match &e {
        Error::Bitstream { .. } => "BitstreamError",
        Error::Limit { .. } => "LimitError",
        Error::Input(message) => return PyValueError::new_err(message.clone()),
    };
    let found = py
        .import("gscodec.errors")
        .and_then(|m| m.getattr(class))
        .and_then(|c| c.call1((e.to_string(),)));
    match found {
        Ok(exception) => PyErr::from_value(exception),
        Err(failed) => failed,
    }
}

pub fn invalid<T>(message: String) -> PyResult<T> {
    Err(PyValueError::new_err(message))
}

/// The bytes of any object with the buffer protocol, without a copy (the stable ABI of Python 3.10 has no buffers,
/// numpy has).
pub fn bytes_of<'py>(data: &Bound<'py, PyAny>) -> PyResult<PyReadonlyArray1<'py, u8>> {
    let a = data.py().import("numpy")?.call_method1("frombuffer", (data, "uint8"))?;
    a.extract()
}

/// An entry of a dict or a field of a dataclass, which must not be None.
pub fn item<'py>(d: &Bound<'py, PyAny>, name: &str) -> PyResult<Bound<'py, PyAny>> {
    match optional(d, name)? {
        Some(v) => Ok(v),
        None => invalid(format!("expected '{name}', there is none")),
    }
}

/// An entry of a dict or a field of a dataclass; None where it is missing.
pub fn optional<'py>(d: &Bound<'py, PyAny>, name: &str) -> PyResult<Option<Bound<'py, PyAny>>> {
    let found = match d.cast::<PyDict>() {
        Ok(d) => d.get_item(name)?,
        Err(_) => Some(d.getattr(name)?),
    };
    Ok(found.filter(|v| !v.is_none()))
}

pub fn value<'py, T: for<'a> FromPyObject<'a, 'py>>(d: &Bound<'py, PyAny>, name: &str) -> PyResult<T> {
    let v = item(d, name)?;
    v.extract()
        .or_else(|_| invalid(format!("'{name}': unexpected value {v}")))
}

/// The field converted to a contiguous array of `dtype`, if that changes no value.
pub fn array<'py>(d: &Bound<'py, PyAny>, name: &str, dtype: &str) -> PyResult<Bound<'py, PyAny>> {
    let np = d.py().import("numpy")?;
    let v = np.call_method1("asarray", (item(d, name)?,))?;
    let out = np.call_method1("ascontiguousarray", (&v, dtype))?;
    if !np.call_method1("array_equal", (&v, &out))?.extract::<bool>()? {
        return invalid(format!("'{name}': expected integers that fit {dtype}"));
    }
    Ok(out)
}

pub fn points(d: &Bound<PyAny>, name: &str) -> PyResult<Vec<[u32; 3]>> {
    let a = array(d, name, "uint32")?;
    let Ok(a) = a.extract::<PyReadonlyArray2<u32>>() else {
        return invalid(format!("'{name}': expected shape [N, 3]"));
    };
    rows(&a, name)
}

pub fn rows(a: &PyReadonlyArray2<u32>, key: &str) -> PyResult<Vec<[u32; 3]>> {
    if a.shape()[1] != 3 {
        return invalid(format!("{key}: expected shape [N, 3], got {:?}", a.shape()));
    }
    Ok(a.as_array().outer_iter().map(|r| [r[0], r[1], r[2]]).collect())
}
