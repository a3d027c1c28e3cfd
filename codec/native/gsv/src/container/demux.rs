//! Push parser of the container (spec 2): bytes in pieces of any size -> config and groups of one gsv track.
//!
//! No I/O inside, so it serves files, HTTP ranges and growing files alike. Media data is never copied: a caller that
//! can seek asks `skippable` and omits those bytes. Waiting for more bytes is a state, not an error.

use super::config::Config;
use super::entry::{Entry, name};
use super::index;
use super::isobmff;
use super::moof;
use super::moov::{self, Track};
use crate::error::{Error, Result};

/// Largest body of a header box.
const HEADER_BOX_MAX: u64 = 16 << 20;

enum State {
    /// Collecting the header of a box.
    Head,
    /// Collecting the body of a header box.
    Body {
        kind: [u8; 4],
        start: u64,
        head: u64,
        size: usize,
    },
    /// Skipping a body. `media`: the body of an mdat, the only box that may hold samples (spec 2.4).
    Skip { left: u64, media: bool },
}

pub struct Demuxer {
    /// Index of the gsv track.
    number: usize,
    state: State,
    buffer: Vec<u8>,
    position: u64,
    first: bool,
    track: Option<Track>,
    pending: Option<Entry>,
    groups: Vec<Entry>,
    /// End of the fragments according to sidx.
    end: Option<u64>,
    index: Vec<Entry>,
    layers: Vec<Vec<u64>>,
    /// True if the last sidx is of this track; then a ssix behind it is, too.
    indexed: bool,
}

impl Default for Demuxer {
    fn default() -> Self {
        Demuxer {
            number: 0,
            state: State::Head,
            buffer: Vec::new(),
            position: 0,
            first: true,
            track: None,
            pending: None,
            groups: Vec::new(),
            end: None,
            index: Vec::new(),
            layers: Vec::new(),
            indexed: false,
        }
    }
}

impl Demuxer {
    /// For the gsv track `number`, from 0 on; by default it is the first one.
    pub fn of_track(number: usize) -> Demuxer {
        Demuxer {
            number,
            ..Demuxer::default()
        }
    }

    /// How many gsv tracks the file has; 0 before moov.
    pub fn tracks(&self) -> usize {
        self.track.as_ref().map_or(0, |t| t.of)
    }

    /// None before moov.
    pub fn config(&self) -> Option<&Config> {
        self.track.as_ref().map(|t| &t.config)
    }

    /// Groups whose bytes have all passed.
    pub fn groups(&self) -> &[Entry] {
        &self.groups
    }

    /// The group whose moof has passed, but not all of its bytes.
    pub fn pending(&self) -> Option<&Entry> {
        self.pending.as_ref()
    }

    /// Bytes consumed so far: the offset of the next byte to `push`.
    pub fn position(&self) -> u64 {
        self.position
    }

    /// True if all fragments of sidx have passed.
    pub fn complete(&self) -> bool {
        self.pending.is_none() && matches!(self.state, State::Head) && self.end.is_some_and(|end| self.position >= end)
    }

    /// Number of bytes from `position` on that need not be pushed.
    pub fn skippable(&self) -> u64 {
        if let State::Skip { left, .. } = self.state {
            left
        } else {
            0
        }
    }

    /// Skips `n` bytes, at most `skippable`.
    pub fn skip(&mut self, n: u64) {
        let State::Skip { left, media } = &mut self.state else {
            return;
        };
        let media = *media;
        let n = n.min(*left);
        self.position = self.position.saturating_add(n);
        *left -= n;
        if *left == 0 {
            self.state = State::Head;
        }
        let whole = |g: &mut Entry| media && g.offset.saturating_add(g.size) <= self.position;
        if let Some(group) = self.pending.take_if(whole) {
            self.groups.push(group);
        }
    }

    /// The groups according to sidx, for players that fetch only the groups that they show. `offset` and `size` are
    /// those of the fragments, moof and mdat. The fragments may differ (spec 2.5).
    pub fn index(&self) -> &[Entry] {
        &self.index
    }

    /// For each entry of `index` the bytes of the fragment up to the end of each layer; empty without ssix.
    pub fn layers(&self) -> &[Vec<u64>] {
        &self.layers
    }

    /// Takes group `i` from the index: `offset` and `size` of its fragment, since those of its sample are unknown.
    pub fn replace_by_index(&mut self, i: usize) {
        self.forget(i);
        self.groups.extend(self.index.get(i).cloned());
    }

    /// Drops the groups from the i-th on.
    pub fn forget(&mut self, i: usize) {
        self.groups.truncate(i);
    }

    /// Drops groups that claim to be of the track but lie among the fragments of other tracks.
    pub fn drop_strays(&mut self) {
        if let (Some(first), Some(end), 2..) = (self.index.first(), self.end, self.tracks()) {
            self.groups.retain(|g| (first.offset..end).contains(&g.offset));
        }
    }

    /// Continues at the fragment that starts at `position`, the offset of the next byte to `push`.
    pub fn seek(&mut self, position: u64) {
        self.state = State::Head;
        self.buffer.clear();
        self.pending = None;
        self.first = false;
        self.position = position;
    }

    /// Parses the next bytes of the file.
    pub fn push(&mut self, mut data: &[u8]) -> Result<()> {
        while !data.is_empty() {
            if let State::Skip { left, .. } = self.state {
                let n = left.min(data.len() as u64);
                self.skip(n);
                data = &data[n as usize..];
                continue;
            }
            let want = match self.state {
                State::Body { size, .. } => size,
                _ if self.buffer.starts_with(&[0, 0, 0, 1]) => 16, // largesize
                _ => 8,
            };
            let n = (want - self.buffer.len()).min(data.len());
            self.buffer.extend_from_slice(&data[..n]);
            self.position += n as u64;
            data = &data[n..];
            self.advance()?;
        }
        Ok(())
    }

    /// Handles the buffer once it holds a whole header or body.
    fn advance(&mut self) -> Result<()> {
        match self.state {
            State::Head => self.head(),
            State::Body {
                kind,
                start,
                head,
                size,
            } if self.buffer.len() == size => {
                let body = std::mem::take(&mut self.buffer);
                self.state = State::Head;
                self.body(&kind, start, &body)
                    .map_err(|e| e.at((start + head) as usize, &name(&kind)))
            }
            _ => Ok(()),
        }
    }

    /// Parses the header of a box and chooses the next state.
    fn head(&mut self) -> Result<()> {
        let Some(([size @ .., a, b, c, d], large)) = self.buffer.split_first_chunk::<8>() else {
            return Ok(());
        };
        let (kind, size) = ([*a, *b, *c, *d], u64::from(u32::from_be_bytes(*size)));
        let (head, size) = match (size, large.first_chunk::<8>()) {
            (1, Some(large)) => (16, u64::from_be_bytes(*large)),
            (1, None) => return Ok(()),
            (size, _) => (8, size),
        };
        let start = self.position - head;
        let fail = |expected: &str| Err(Error::bitstream(start as usize, name(&kind), expected));
        if std::mem::take(&mut self.first) && &kind != b"ftyp" {
            return Err(Error::bitstream(
                start as usize,
                "file",
                "a .gsv file, which starts with an ftyp box",
            ));
        }
        let body = match size {
            0 if &kind == b"mdat" => u64::MAX,
            _ if size >= head && start.checked_add(size).is_some() => size - head,
            _ => return fail("a box size that covers the header of the box"),
        };
        self.buffer.clear();
        let media = &kind == b"mdat";
        if media {
            self.sample_within(body)
                .map_err(|expected| Error::bitstream(start as usize, "mdat box", expected))?;
        }
        if !matches!(&kind, b"ftyp" | b"moov" | b"moof" | b"sidx" | b"ssix") {
            self.state = State::Skip { left: body, media };
            self.skip(0);
        } else if body > HEADER_BOX_MAX {
            return Err(Error::limit(
                name(&kind),
                format!("{body} bytes, at most {HEADER_BOX_MAX} are allowed"),
            ));
        } else {
            self.state = State::Body {
                kind,
                start,
                head,
                size: body as usize,
            };
            self.advance()?;
        }
        Ok(())
    }

    /// Spec 2.4: checks that the sample of a moof, and the sound in front of it, lie in the next mdat.
    fn sample_within(&self, body: u64) -> std::result::Result<(), &'static str> {
        let Some(g) = &self.pending else { return Ok(()) };
        let end = g.offset.checked_add(g.size);
        let start = g.audio.as_ref().map_or(g.offset, |run| run.offset);
        let inside = start >= self.position && end.is_some_and(|e| e <= self.position.saturating_add(body));
        if inside {
            Ok(())
        } else {
            Err("the sample of the moof before to lie within it")
        }
    }

    fn body(&mut self, kind: &[u8; 4], start: u64, body: &[u8]) -> Result<()> {
        match kind {
            b"ftyp" => isobmff::ftyp(body),
            b"moov" if self.track.is_some() => Err(Error::bitstream(0, "", "one moov box")),
            b"moov" => {
                self.track = Some(moov::read(body, self.number)?);
                Ok(())
            }
            b"sidx" => {
                self.indexed = self.announced(body);
                Ok(())
            }
            b"ssix" if !self.indexed => Ok(()),
            b"ssix" => {
                let told = index::ssix(body).filter(|l| l.len() == self.index.len());
                self.layers = told.unwrap_or_default();
                Ok(())
            }
            _ => self.fragment(start, body),
        }
    }

    /// Stores the groups of sidx (spec 2.5), if it belongs to the track.
    fn announced(&mut self, sidx: &[u8]) -> bool {
        let Some(track) = &self.track else { return false };
        let Some((first, references)) = index::sidx(sidx, track.id) else {
            return false;
        };
        let frame = u64::from(track.config.frame_duration);
        let (mut offset, mut time) = (self.position.saturating_add(first), 0u64);
        self.index.clear();
        for (size, duration, sync) in references {
            self.index.push(Entry {
                offset,
                size: u64::from(size),
                start_frame: time / frame,
                frames: duration / track.config.frame_duration,
                sync,
                audio: None,
            });
            offset = offset.saturating_add(u64::from(size));
            time += u64::from(duration);
        }
        self.end = Some(offset);
        true
    }

    fn fragment(&mut self, start: u64, body: &[u8]) -> Result<()> {
        let Some(track) = &self.track else {
            return Err(Error::bitstream(0, "", "a moov box before the first moof"));
        };
        if self.pending.is_some() {
            return Err(Error::bitstream(0, "", "the mdat box of the moof before"));
        }
        self.pending = moof::read(body, track, start)?;
        Ok(())
    }
}
