//! The body of moov (spec 2.2, 2.3, 2.7 and 2.8) -> a gsv track with its config, and the audio track.
//!
//! Only the fields that a reader needs are parsed. `inline(never)`: as in `fields`.

use super::audio::{AudioTrack, ENTRY_MAX};
use super::config::Config;
use super::entry::name;
use super::isobmff::{Inner, boxes, find};
use super::placement::Placement;
use super::write::BRAND;
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader};

/// Most gsv tracks of a file.
const TRACKS_MAX: usize = 64;

/// A gsv track, as moov describes it.
pub struct Track {
    pub id: u32,
    pub config: Config,
    /// How many gsv tracks the file has.
    pub of: usize,
    pub defaults: Defaults,
    pub audio: Option<Audio>,
}

/// The audio track, as moov describes it.
pub struct Audio {
    pub id: u32,
    pub description: AudioTrack,
    pub defaults: Defaults,
}

/// Sample defaults of trex and tfhd.
#[derive(Clone, Copy, Default)]
pub struct Defaults {
    pub duration: u32,
    pub size: u32,
    pub flags: u32,
}

/// Parses the body of moov: gsv track `number` (handler volv), and for number 0 also the audio track.
pub fn read(body: &[u8], number: usize) -> Result<Track> {
    let all = tracks(body, b"volv")?;
    if all.len() > TRACKS_MAX {
        let told = format!("{} tracks, at most {TRACKS_MAX} are allowed", all.len());
        return Err(Error::limit("moov box", told));
    }
    let Some(b) = all.get(number) else {
        let told = match number {
            0 => "a track with handler volv, found none".into(),
            _ => format!("a track {number} with handler volv, found {}", all.len()),
        };
        return Err(Error::bitstream(0, "", told));
    };
    let (id, mut config) = track(b.body).map_err(|e| e.at(b.offset, "gsv track"))?;
    let mut others = all.iter().filter(|other| other.offset != b.offset);
    if others.any(|other| after_times(other.body, &[b"tkhd"]).is_ok_and(|own| own == id)) {
        return Err(Error::bitstream(
            b.offset,
            "tkhd box",
            "a track_ID that no other track has",
        ));
    }
    let audio = if number == 0 { audio_track(body)? } else { None };
    config.audio = audio.as_ref().map(|a| a.description.clone());
    config.track = number;
    Ok(Track {
        id,
        config,
        of: all.len(),
        defaults: extends(body, id)?,
        audio,
    })
}

/// The tracks with a handler type.
fn tracks<'a>(moov: &'a [u8], handler: &[u8; 4]) -> Result<Vec<Inner<'a>>> {
    let is = |b: &Inner| find(b.body, &[b"mdia", b"hdlr"]).is_ok_and(|(hdlr, _)| hdlr.get(8..12) == Some(handler));
    Ok(boxes(moov)?
        .into_iter()
        .filter(|b| &b.kind == b"trak" && is(b))
        .collect())
}

/// track_ID and config.
fn track(body: &[u8]) -> Result<(u32, Config)> {
    let id = after_times(body, &[b"tkhd"])?;
    let timescale = after_times(body, &[b"mdia", b"mdhd"])?;
    let (stsd, base) = find(body, &[b"mdia", b"minf", b"stbl", b"stsd"])?;
    let entries = stsd.get(8..).unwrap_or(&[]);
    let entry = boxes(entries)
        .map_err(|e| e.at(base + 8, ""))?
        .into_iter()
        .find(|b| &b.kind == BRAND);
    let Some(entry) = entry else {
        return Err(Error::bitstream(base, "", "a sample entry gsv1, found none"));
    };
    let base = base + 8 + entry.offset + 40; // SampleEntry and compressor_name
    let inside = entry.body.get(40..).unwrap_or(&[]);
    let (config, at) = find(inside, &[b"gsvC"]).map_err(|e| e.at(base, ""))?;
    let mut config = Config::read(config, timescale).map_err(|e| e.at(base + at, "gsvC box"))?;
    if let Ok((placement, at)) = find(inside, &[b"gsvT"]) {
        config.placement = Placement::read(placement).map_err(|e| e.at(base + at, "gsvT box"))?;
    }
    if timescale == 0 {
        return Err(Error::bitstream(base, "", "a timescale > 0"));
    }
    Ok((id, config))
}

/// Spec 2.7: the first track with handler soun whose sample entry is mp4a or Opus.
pub fn audio_track(moov: &[u8]) -> Result<Option<Audio>> {
    for b in tracks(moov, b"soun")? {
        if let Some((id, description)) = audio(b.body).map_err(|e| e.at(b.offset, "audio track"))? {
            let defaults = extends(moov, id)?;
            return Ok(Some(Audio {
                id,
                description,
                defaults,
            }));
        }
    }
    Ok(None)
}

/// track_ID and description of a track of sound; None if its sample entry is neither mp4a nor Opus.
fn audio(body: &[u8]) -> Result<Option<(u32, AudioTrack)>> {
    let Ok((stsd, base)) = find(body, &[b"mdia", b"minf", b"stbl", b"stsd"]) else {
        return Ok(None);
    };
    let entries = stsd.get(8..).unwrap_or(&[]);
    let entry = boxes(entries).map_err(|e| e.at(base + 8, ""))?.into_iter().next();
    let decoder = entry.as_ref().and_then(|e| match &e.kind {
        b"mp4a" => Some((e, b"esds")),
        b"Opus" => Some((e, b"dOps")),
        _ => None,
    });
    let Some((entry, decoder)) = decoder else {
        return Ok(None);
    };
    let base = base + 8 + entry.offset;
    if entry.body.len() + 8 > ENTRY_MAX {
        return Err(Error::limit(
            name(&entry.kind),
            format!("{} bytes, at most {ENTRY_MAX} are allowed", entry.body.len() + 8),
        ));
    }
    find(entry.body.get(28..).unwrap_or(&[]), &[decoder]).map_err(|e| e.at(base + 28, ""))?;
    let timescale = after_times(body, &[b"mdia", b"mdhd"])?;
    if timescale == 0 {
        return Err(Error::bitstream(base, "", "a timescale > 0"));
    }
    let media_start = match find(body, &[b"edts"]) {
        Ok((edts, base)) => edits(edts).map_err(|e| e.at(base, "edts box"))?,
        Err(_) => 0,
    };
    let entry = entries[entry.offset - 8..entry.offset + entry.body.len()].to_vec();
    let id = after_times(body, &[b"tkhd"])?;
    Ok(Some((
        id,
        AudioTrack {
            timescale,
            media_start,
            entry,
        },
    )))
}

/// edts: media_time of the only edit, 0 without elst.
fn edits(edts: &[u8]) -> Result<u32> {
    let inner = boxes(edts)?;
    let elst = inner.iter().find(|b| &b.kind == b"elst");
    elst.map_or(Ok(0), |b| {
        edit(&mut Reader::new(b.body)).map_err(|e| e.at(b.offset, "elst box"))
    })
}

/// elst: media_time of the only edit.
fn edit(r: &mut Reader) -> Result<u32> {
    let (mut head, mut count, mut high, mut time) = (0, 0, 0, 0);
    r.u32(&mut head)?;
    r.u32(&mut count)?;
    let long = head >> 24 == 1;
    r.take(if long { 8 } else { 4 })?; // segment_duration
    if long {
        r.u32(&mut high)?;
    }
    r.u32(&mut time)?;
    r.must(count == 1 && high == 0 && time < 1 << 31, || {
        format!("one edit with a media time of 0 to 2^31 - 1, found {count}")
    })?;
    Ok(time)
}

/// The u32 behind the two time stamps at the start of tkhd and mdhd.
#[inline(never)]
fn after_times(body: &[u8], path: &[&[u8; 4]]) -> Result<u32> {
    let (body, base) = find(body, path)?;
    let mut r = Reader::new(body);
    let mut head = 0;
    let mut value = 0;
    let mut read = || {
        r.u32(&mut head)?;
        r.take(if head >> 24 == 1 { 16 } else { 8 })?;
        r.u32(&mut value)
    };
    read().map_err(|e| e.at(base, ""))?;
    Ok(value)
}

/// The sample defaults in trex.
#[inline(never)]
fn extends(moov: &[u8], id: u32) -> Result<Defaults> {
    let Ok((mvex, base)) = find(moov, &[b"mvex"]) else {
        return Ok(Defaults::default());
    };
    for b in boxes(mvex)
        .map_err(|e| e.at(base, ""))?
        .iter()
        .filter(|b| &b.kind == b"trex")
    {
        let mut w = [0; 6]; // FullBox, track_ID, description index, duration, size, flags
        let mut r = Reader::new(b.body);
        w.iter_mut()
            .try_for_each(|w| r.u32(w))
            .map_err(|e| e.at(base + b.offset, "trex box"))?;
        if w[1] == id {
            return Ok(Defaults {
                duration: w[3],
                size: w[4],
                flags: w[5],
            });
        }
    }
    Ok(Defaults::default())
}
