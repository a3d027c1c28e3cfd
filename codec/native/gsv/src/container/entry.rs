//! The place of a group in the file, as given by its fragment or by an index.

/// The place and the time of a group.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Entry {
    /// Of the first byte of its sample, from the start of the file.
    pub offset: u64,
    pub size: u64,
    pub start_frame: u64,
    pub frames: u32,
    pub sync: bool,
}

/// A box type for messages: "moov box".
pub fn name(kind: &[u8; 4]) -> String {
    format!("{} box", kind.escape_ascii())
}
