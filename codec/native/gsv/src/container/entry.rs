//! The place of a group in the file, as given by its fragment or by an index.

use super::audio::AudioRun;

/// The place and the time of a group.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Entry {
    /// File offset of the first byte of its sample.
    pub offset: u64,
    pub size: u64,
    pub start_frame: u64,
    pub frames: u32,
    pub sync: bool,
    /// The sound in front of its sample; none if the place is from an index.
    pub audio: Option<AudioRun>,
}

/// A box type for messages: "moov box".
pub fn name(kind: &[u8; 4]) -> String {
    format!("{} box", kind.escape_ascii())
}
