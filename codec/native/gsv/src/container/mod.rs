//! The container (spec 2): fragmented MP4 with one fragment per group.
//!
//! `config` is the gsvC box, `placement` the gsvT box, `audio` the audio track, `write` writes boxes. `isobmff` walks
//! the boxes inside of header boxes, of which `moov`, `moof` and `index` (sidx and ssix) are parsed; `demux` finds the
//! groups of one track in a stream of bytes, `whole` reads a file in memory and recovers from damage.

pub mod audio;
pub mod config;
pub mod demux;
pub mod entry;
mod index;
mod isobmff;
mod moof;
mod moov;
pub mod placement;
pub mod whole;
pub mod write;
