//! The errors of this crate: arguments that do not fit together, or more work than the limits allow.

use std::fmt;

use crate::size::Size;

/// Why a call was refused; nothing was drawn or written then.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RasterError {
    Shape {
        name: &'static str,
        expected: usize,
        got: usize,
    },
    Empty(Size),
    TooMany {
        what: &'static str,
        limit: usize,
    },
    Near,
    LowPass,
    NothingRendered,
}

impl fmt::Display for RasterError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            RasterError::Shape { name, expected, got } => write!(f, "{name} has {got} values, expected {expected}"),
            RasterError::Empty(size) => write!(f, "an image of {} x {} pixels is empty", size.width, size.height),
            RasterError::TooMany { what, limit } => write!(f, "more than {limit} {what}"),
            RasterError::Near => f.write_str("the near plane is not in front of the camera"),
            RasterError::LowPass => f.write_str("the low-pass of the view is not above 0"),
            RasterError::NothingRendered => {
                write!(f, "backward without a forward pass of these Gaussians and this view")
            }
        }
    }
}

impl std::error::Error for RasterError {}

/// `Shape` unless the slice `name` has `expected` values.
pub(crate) fn check_length(name: &'static str, got: usize, expected: usize) -> Result<(), RasterError> {
    if got == expected {
        Ok(())
    } else {
        Err(RasterError::Shape { name, expected, got })
    }
}
