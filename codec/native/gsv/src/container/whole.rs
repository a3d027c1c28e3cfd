//! A whole file in memory -> the groups of a track. Wraps the demuxer, and recovers the groups behind damaged boxes.
//!
//! Damaged boxes of a fragment end the walk from box to box. With an index (spec 2.5) that agrees with the groups so
//! far, the walk continues at the next fragment.

use super::audio::{AudioRun, AudioTrack};
use super::demux::Demuxer;
use super::entry::Entry;
use super::isobmff;
use super::moof;
use super::moov;
use crate::error::{Error, Result};

/// Most groups taken from the index; it bounds the number of walks.
const LOST_MAX: usize = 64;
/// Bytes pushed to the demuxer at a time between skipped boxes.
const LOOK: usize = 4096;

/// Reads the headers of a file, for the gsv track `track`. Strict: damage is an error. Otherwise groups that only the
/// index lists are returned with the bytes of their fragment, and each error with the number of its group.
///
/// # Errors
/// There is no moov; boxes are damaged and no index helps.
pub fn read(data: &[u8], strict: bool, track: usize) -> Result<(Demuxer, Vec<(usize, Error)>)> {
    let mut demuxer = Demuxer::of_track(track);
    let (mut at, mut tried, mut damage) = (0, None, Vec::new());
    loop {
        let walked = walk(&mut demuxer, data, at);
        if !strict {
            demuxer.drop_strays();
        }
        if demuxer.config().is_none() {
            return Err(walked.err().unwrap_or_else(|| no_moov(data)));
        }
        let short = walked.is_err() || demuxer.groups().len() < demuxer.index().len();
        let whole = !demuxer.index().is_empty() && demuxer.groups().len() >= demuxer.index().len();
        match (walked, missing(&demuxer, data.len()).filter(|_| short && !strict)) {
            (Err(_), None) if whole && !strict => return Ok((demuxer, damage)), // the damage is in another, later track
            (walked, None) => return walked.map(|()| (demuxer, damage)),
            (walked, Some(_)) if damage.len() >= LOST_MAX => return walked.map(|()| (demuxer, damage)),
            (walked, Some((next, _))) if tried == Some(next) => {
                let lost = || Error::bitstream(at, format!("group {next}"), "the fragment that the index tells of");
                damage.push((next, walked.err().unwrap_or_else(lost)));
                demuxer.replace_by_index(next);
            }
            (_, Some((next, _))) => demuxer.forget(next),
        }
        let Some((next, entry)) = missing(&demuxer, data.len()) else {
            return Ok((demuxer, damage));
        };
        tried = Some(next);
        at = entry.offset as usize;
        demuxer.seek(entry.offset);
    }
}

/// The first group that differs from the index, and its fragment; None if the data does not hold that fragment.
fn missing(demuxer: &Demuxer, size: usize) -> Option<(usize, Entry)> {
    let differ = |(a, b): (&Entry, &Entry)| (a.start_frame, a.frames) != (b.start_frame, b.frames);
    let groups = demuxer.groups();
    let next = groups
        .iter()
        .zip(demuxer.index())
        .position(differ)
        .unwrap_or(groups.len());
    let entry = demuxer.index().get(next)?;
    (entry.offset.saturating_add(entry.size) <= size as u64).then(|| (next, entry.clone()))
}

fn walk(demuxer: &mut Demuxer, data: &[u8], mut at: usize) -> Result<()> {
    while at < data.len() {
        at = step(demuxer, data, at)?;
    }
    Ok(())
}

/// Pushes or skips the next bytes of `data`; returns where they end.
fn step(demuxer: &mut Demuxer, data: &[u8], at: usize) -> Result<usize> {
    let left = data.len() - at;
    let skip = usize::try_from(demuxer.skippable()).unwrap_or(usize::MAX).min(left);
    if skip > 0 {
        demuxer.skip(skip as u64);
        return Ok(at + skip);
    }
    let to = at + left.min(LOOK);
    demuxer.push(&data[at..to])?;
    Ok(to)
}

/// How many gsv tracks a file has; only moov is read.
///
/// # Errors
/// There is no moov, or it breaks a rule.
pub fn tracks(data: &[u8]) -> Result<usize> {
    let (mut demuxer, mut at) = (Demuxer::default(), 0);
    while demuxer.tracks() == 0 && at < data.len() {
        at = match step(&mut demuxer, data, at) {
            Err(e) if demuxer.tracks() == 0 => return Err(e),
            walked => walked.unwrap_or(data.len()),
        };
    }
    match demuxer.tracks() {
        0 => Err(no_moov(data)),
        count => Ok(count),
    }
}

fn no_moov(data: &[u8]) -> Error {
    Error::bitstream(data.len(), "file", "a moov box, found the end of the data")
}

/// A fragmented MP4 with sound only, as a multiplexer writes it -> its first mp4a or Opus track, and the samples.
///
/// # Errors
/// There is no such track; its boxes break a rule of spec 2.7.
pub fn read_audio(data: &[u8]) -> Result<(AudioTrack, Vec<AudioRun>)> {
    let (mut track, mut runs) = (None, Vec::new());
    for b in isobmff::boxes(data)? {
        let at = |e: Error| e.at(b.offset, "audio file");
        match (&b.kind, &track) {
            (b"moov", None) => track = moov::audio_track(b.body).map_err(at)?,
            (b"moof", Some(t)) => runs.extend(moof::read_audio(b.body, t, b.offset as u64 - 8).map_err(at)?),
            _ => {}
        }
    }
    let Some(track) = track else {
        return Err(Error::bitstream(0, "audio file", "an audio track of AAC or Opus"));
    };
    Ok((track.description, runs))
}
