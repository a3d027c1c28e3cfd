//! The bitstream core: bytes <-> integer maps (container, units, entropy coding), and integers -> attributes of a frame.
//!
//! No I/O, no unsafe, no panic on input. Clause numbers in comments are those of spec/gsv.md.
#![forbid(unsafe_code)]

mod assemble;
pub mod attributes;
pub mod blend;
pub mod channels;
pub mod container;
mod crc;
pub mod curve;
mod deaths;
pub mod decode;
pub mod dequantize;
pub mod encode;
pub mod error;
pub mod evaluate;
pub mod fields;
pub mod group;
pub mod header;
pub mod inventory;
pub mod levels;
pub mod lifetimes;
pub mod map;
mod model;
pub mod morton;
pub mod neighbors;
mod node_search;
pub mod parametric;
pub mod positions;
pub mod range_coder;
pub mod rigid_blend;
pub mod symbols;
pub mod trajectories;
pub mod turns;
pub mod unit;
mod values;
