//! Bytes <-> integer maps.
#![forbid(unsafe_code)]
