//! The bitstream core: bytes <-> integers of a group (container, units, entropy coding), and integers -> attributes of
//! a frame.
//!
//! No I/O, no unsafe, no panic on input. Clause numbers in comments are those of spec/gsv.md.
#![forbid(unsafe_code)]

mod assemble;
pub mod attributes;
pub mod blend;
mod blocks;
pub mod channels;
pub mod companding;
pub mod conformance;
pub mod container;
mod crc;
mod deaths;
pub mod decode;
pub mod dequantize;
pub mod encode;
pub mod error;
pub mod evaluate;
pub mod fields;
pub mod group;
pub mod harmonics;
pub mod header;
mod lanes;
pub mod levels;
pub mod lifetimes;
mod model;
pub mod morton;
pub mod neighbors;
mod node_search;
mod parallel;
pub mod parametric;
pub mod pose;
pub mod pose_gradient;
pub mod positions;
pub mod range_coder;
pub mod reposing;
pub mod rig;
pub mod rigid_blend;
pub mod rotation_residuals;
pub mod skinning;
pub mod symbols;
pub mod tile;
pub mod tile_bounds;
pub mod trajectories;
pub mod unit;
mod values;
