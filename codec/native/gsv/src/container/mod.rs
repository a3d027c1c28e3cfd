//! The container (spec 2): fragmented MP4 with one fragment per group.
//!
//! `config` is the gsvC box, `write` makes boxes, `demux` finds groups in bytes that arrive in any pieces.

pub mod config;
pub mod demux;
pub mod entry;
mod isobmff;
pub mod whole;
pub mod write;
