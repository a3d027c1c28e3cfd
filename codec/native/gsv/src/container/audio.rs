//! The audio track (spec 2.7): its description in moov, and its samples in front of a group.

/// Most samples in front of a group.
pub const SAMPLES_MAX: usize = 1 << 16;
/// Largest sample entry, bytes.
pub const ENTRY_MAX: usize = 4096;

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AudioTrack {
    /// mdhd: units a second.
    pub timescale: u32,
    /// The media time that is heard at the start of the first frame (elst).
    pub media_start: u32,
    /// The sample entry mp4a or Opus, a whole box.
    pub entry: Vec<u8>,
}

/// Consecutive samples.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AudioRun {
    /// File offset of the first byte.
    pub offset: u64,
    /// Media time of the first sample.
    pub time: u64,
    /// Size in bytes and duration in units of the timescale, both > 0.
    pub samples: Vec<(u32, u32)>,
}

impl AudioRun {
    /// Bytes of all samples.
    pub fn size(&self) -> u64 {
        self.samples.iter().map(|(size, _)| u64::from(*size)).sum()
    }
}
