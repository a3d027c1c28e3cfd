//! Errors by cause: `Bitstream` and `Limit` are faults of the bytes, `Input` is a fault of the data to be written.
//!
//! The need for more data is never an error here; it is a result of the demuxer.

use std::fmt;

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Error {
    /// The bytes break a rule of the spec.
    Bitstream {
        offset: u64,
        unit: String,
        expected: String,
    },
    /// The bytes are valid so far, but exceed the level (spec 5).
    Limit { unit: String, expected: String },
    /// The group or configuration to write is not valid.
    Input(String),
}

pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    pub fn bitstream(offset: usize, unit: impl Into<String>, expected: impl Into<String>) -> Error {
        Error::Bitstream {
            offset: offset as u64,
            unit: unit.into(),
            expected: expected.into(),
        }
    }

    pub fn limit(unit: impl Into<String>, expected: impl Into<String>) -> Error {
        Error::Limit {
            unit: unit.into(),
            expected: expected.into(),
        }
    }

    /// The same error with the offset moved by `base`; `name`: the unit, if the error has none.
    #[inline(never)]
    pub fn at(self, base: usize, name: &str) -> Error {
        match self {
            Error::Bitstream { offset, unit, expected } => {
                let unit = if unit.is_empty() { name.to_string() } else { unit };
                Error::Bitstream {
                    offset: offset + base as u64,
                    unit,
                    expected,
                }
            }
            other => other,
        }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Error::Bitstream { offset, unit, expected } => write!(f, "byte {offset}, {unit}: expected {expected}"),
            Error::Limit { unit, expected } => write!(f, "{unit}: {expected}"),
            Error::Input(message) => f.write_str(message),
        }
    }
}

impl std::error::Error for Error {}
