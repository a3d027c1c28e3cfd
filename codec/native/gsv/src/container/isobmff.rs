//! Parsers of the header boxes ftyp, moov, moof, sidx and ssix (spec 2.1 to 2.7). Only the fields that a reader needs are
//! parsed; unknown boxes are skipped. `inline(never)`: as in `fields`.

use super::audio::{AudioRun, AudioTrack, ENTRY_MAX, SAMPLES_MAX};
use super::config::Config;
use super::entry::{Entry, name};
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
    defaults: Defaults,
    audio: Option<Audio>,
}

/// The audio track, as moov describes it.
pub struct Audio {
    id: u32,
    pub description: AudioTrack,
    defaults: Defaults,
}

/// Sample defaults of trex and tfhd.
#[derive(Clone, Copy, Default)]
struct Defaults {
    duration: u32,
    size: u32,
    flags: u32,
}

/// A box inside a header box; `offset`: of its body.
pub struct Inner<'a> {
    pub kind: [u8; 4],
    pub offset: usize,
    pub body: &'a [u8],
}

/// The boxes that fill `data`.
#[inline(never)]
pub fn boxes(data: &[u8]) -> Result<Vec<Inner<'_>>> {
    let mut r = Reader::new(data);
    let mut out = Vec::new();
    while r.rest() > 0 {
        let (mut size, mut kind) = (0, [0; 4]);
        r.u32(&mut size)?;
        r.bytes(&mut kind)?;
        r.must(size >= 8, || format!("a box of at least 8 bytes, found {size}"))?;
        let offset = r.position();
        out.push(Inner {
            kind,
            offset,
            body: r.take(size as usize - 8)?,
        });
    }
    Ok(out)
}

/// The body of the box at `path` and its offset; at each step the first box of that type.
#[inline(never)]
fn find<'a>(data: &'a [u8], path: &[&[u8; 4]]) -> Result<(&'a [u8], usize)> {
    let (mut data, mut base) = (data, 0);
    for kind in path {
        let found = boxes(data)
            .map_err(|e| e.at(base, ""))?
            .into_iter()
            .find(|b| &b.kind == *kind);
        let Some(b) = found else {
            return Err(Error::bitstream(base, "", format!("a {}, found none", name(kind))));
        };
        base += b.offset;
        data = b.body;
    }
    Ok((data, base))
}

/// Checks the brands in the body of ftyp.
pub fn ftyp(body: &[u8]) -> Result<()> {
    let brands = body.as_chunks::<4>().0;
    let known = brands.iter().enumerate().any(|(i, b)| i != 1 && b == BRAND); // the second word is minor_version
    if known {
        Ok(())
    } else {
        Err(Error::bitstream(
            0,
            "",
            "the brand gsv1 in ftyp: this is not a .gsv file",
        ))
    }
}

/// Parses the body of moov: the track `number` of those with handler volv, and for the first one the audio track.
pub fn moov(body: &[u8], number: usize) -> Result<Track> {
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

/// The tracks of a handler.
fn tracks<'a>(moov: &'a [u8], handler: &[u8; 4]) -> Result<Vec<Inner<'a>>> {
    let is = |b: &Inner| find(b.body, &[b"mdia", b"hdlr"]).is_ok_and(|(hdlr, _)| hdlr.get(8..12) == Some(handler));
    Ok(boxes(moov)?
        .into_iter()
        .filter(|b| &b.kind == b"trak" && is(b))
        .collect())
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

/// track_ID and description of a track of sound; None if its sample entry is another one.
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

/// An entry of sidx: bytes, duration in units of the timescale, and whether it starts with a sync sample.
pub type SidxReference = (u32, u32, bool);

/// Spec 2.5: first_offset and the entries of the sidx of track `id`; None if it is malformed, or that of another track.
pub fn sidx(body: &[u8], id: u32) -> Option<(u64, Vec<SidxReference>)> {
    if body.get(4..8)? != id.to_be_bytes() {
        return None;
    }
    let head = if body.first()? == &0 { 20 } else { 28 };
    let first_offset = match head {
        20 => u64::from(u32::from_be_bytes(body.get(16..20)?.try_into().ok()?)),
        _ => u64::from_be_bytes(body.get(20..28)?.try_into().ok()?),
    };
    let count = u16::from_be_bytes(body.get(head + 2..head + 4)?.try_into().ok()?);
    let (references, _) = body.get(head + 4..)?.as_chunks::<12>();
    let words = |r: &[u8; 12]| {
        let (w, _) = r.as_chunks::<4>();
        let [size, duration, sap] = [0, 1, 2].map(|i| w.get(i).map_or(0, |w| u32::from_be_bytes(*w)));
        (size & 0x7FFF_FFFF, duration, sap >> 31 != 0)
    };
    (references.len() == usize::from(count)).then(|| (first_offset, references.iter().map(words).collect()))
}

/// Spec 2.6: for each entry of sidx the bytes of the fragment up to the end of each layer; None if it is malformed.
pub fn ssix(body: &[u8]) -> Option<Vec<Vec<u64>>> {
    let (words, rest) = body.get(4..)?.as_chunks::<4>();
    let mut words = words.iter().map(|w| u32::from_be_bytes(*w));
    let mut all = Vec::new();
    for _ in 0..words.next()? {
        let (mut ends, mut end) = (Vec::new(), 0);
        for _ in 0..words.next()? {
            let range = words.next()?;
            end += u64::from(range & 0xFF_FFFF);
            let layer = (range >> 24) as usize;
            if layer == ends.len() {
                ends.push(end);
            } else if layer + 1 == ends.len() {
                ends[layer] = end;
            } else {
                return None;
            }
        }
        all.push(ends);
    }
    (rest.is_empty() && words.next().is_none()).then_some(all)
}

/// Spec 2.4: the group of a moof, with its sound; None if it has none of the track. `start`: offset of the moof box.
pub fn moof(body: &[u8], track: &Track, start: u64) -> Result<Option<Entry>> {
    for b in boxes(body)?.into_iter().filter(|b| &b.kind == b"traf") {
        let group = traf(b.body, track, start).map_err(|e| e.at(b.offset, "traf box"))?;
        if let Some(mut group) = group {
            if let Some(audio) = &track.audio {
                group.audio = audio_moof(body, audio, start)?;
            }
            let end = |run: &AudioRun| run.offset.checked_add(run.size());
            if group.audio.as_ref().is_some_and(|run| end(run) != Some(group.offset)) {
                return Err(Error::bitstream(
                    b.offset,
                    "traf box",
                    "the sound to end where the group starts",
                ));
            }
            return Ok(Some(group));
        }
    }
    Ok(None)
}

/// Spec 2.7: the samples of the audio track in a moof; None if it has none.
pub fn audio_moof(body: &[u8], audio: &Audio, start: u64) -> Result<Option<AudioRun>> {
    for b in boxes(body)?.into_iter().filter(|b| &b.kind == b"traf") {
        let run = audio_traf(b.body, audio, start).map_err(|e| e.at(b.offset, "traf box of the audio track"))?;
        if run.is_some() {
            return Ok(run);
        }
    }
    Ok(None)
}

/// The samples of a traf; None if it belongs to another track, or has none.
fn audio_traf(body: &[u8], audio: &Audio, start: u64) -> Result<Option<AudioRun>> {
    let Some((data, defaults)) = header(body, audio.id, audio.defaults, start)? else {
        return Ok(None);
    };
    let time = decode_time(body)?;
    let (trun, base) = only_trun(body)?;
    let (offset, samples) = audio_run(&mut Reader::new(trun), defaults).map_err(|e| e.at(base, ""))?;
    let Some(offset) = data.checked_add_signed(i64::from(offset)) else {
        return Err(Error::bitstream(base, "", "a data offset within the file"));
    };
    let run = AudioRun { offset, time, samples };
    Ok((!run.samples.is_empty()).then_some(run))
}

/// trun: data offset, and size and duration of each sample.
fn audio_run(r: &mut Reader, d: Defaults) -> Result<(i32, Vec<(u32, u32)>)> {
    let (mut flags, mut count, mut offset) = (0, 0, 0);
    r.u32(&mut flags)?;
    r.u32(&mut count)?;
    if count as usize > SAMPLES_MAX {
        return Err(Error::limit(
            "traf box of the audio track",
            format!("{count} samples, at most {SAMPLES_MAX} are allowed"),
        ));
    }
    if flags & 0x01 != 0 {
        r.u32(&mut offset)?;
    }
    if flags & 0x04 != 0 {
        r.take(4)?; // flags of the first sample
    }
    let mut samples = Vec::new();
    for _ in 0..count {
        let (mut size, mut duration) = (d.size, d.duration);
        if flags & 0x100 != 0 {
            r.u32(&mut duration)?;
        }
        if flags & 0x200 != 0 {
            r.u32(&mut size)?;
        }
        r.take(4 * (flags >> 10 & 3).count_ones() as usize)?; // flags, composition offset
        r.must(size > 0 && duration > 0, || {
            "samples of at least one byte and one unit of time".into()
        })?;
        samples.push((size, duration));
    }
    Ok((offset as i32, samples))
}

/// The group of a traf; None if it belongs to another track.
fn traf(body: &[u8], track: &Track, start: u64) -> Result<Option<Entry>> {
    let Some((data, defaults)) = header(body, track.id, track.defaults, start)? else {
        return Ok(None);
    };
    let time = decode_time(body)?;
    let (trun, base) = only_trun(body)?;
    let (offset, sample) = run(&mut Reader::new(trun), defaults).map_err(|e| e.at(base, ""))?;
    let fail = |expected: &str| Err(Error::bitstream(base, "", expected));
    let Some(offset) = data.checked_add_signed(i64::from(offset)) else {
        return fail("a data offset within the file");
    };
    let frame = track.config.frame_duration;
    let (frames, start_frame) = (sample.duration / frame, time / u64::from(frame));
    if frames == 0 || sample.duration % frame != 0 || time % u64::from(frame) != 0 {
        return fail("a time and a duration of whole frames, at least one");
    }
    Ok(Some(Entry {
        offset,
        size: u64::from(sample.size),
        start_frame,
        frames,
        sync: sample.flags >> 16 & 1 == 0,
        audio: None,
    }))
}

/// tfhd: base of the data offsets and sample defaults; None for another track.
#[inline(never)]
fn header(traf: &[u8], track: u32, mut d: Defaults, mut data: u64) -> Result<Option<(u64, Defaults)>> {
    let (tfhd, base) = find(traf, &[b"tfhd"])?;
    let mut r = Reader::new(tfhd);
    let (mut flags, mut id) = (0, 0);
    let mut read = || {
        r.u32(&mut flags)?;
        r.u32(&mut id)?;
        if flags & 0x01 != 0 {
            r.u64(&mut data)?;
        }
        if flags & 0x02 != 0 {
            r.take(4)?; // sample description index
        }
        for (bit, field) in [(0x08, &mut d.duration), (0x10, &mut d.size), (0x20, &mut d.flags)] {
            if flags & bit != 0 {
                r.u32(field)?;
            }
        }
        Ok(())
    };
    read().map_err(|e: Error| e.at(base, ""))?;
    Ok((id == track).then_some((data, d)))
}

/// tfdt: time of the first sample.
#[inline(never)]
fn decode_time(traf: &[u8]) -> Result<u64> {
    let (tfdt, base) = find(traf, &[b"tfdt"])?;
    let mut r = Reader::new(tfdt);
    let (mut head, mut short, mut long) = (0, 0, 0);
    let mut read = || {
        r.u32(&mut head)?;
        if head >> 24 == 1 {
            return r.u64(&mut long);
        }
        r.u32(&mut short)
    };
    read().map_err(|e| e.at(base, ""))?;
    Ok(long.max(u64::from(short)))
}

/// The body of the trun of a traf and its offset; a second trun is an error (spec 2.4).
#[inline(never)]
fn only_trun(traf: &[u8]) -> Result<(&[u8], usize)> {
    let second = boxes(traf)?.into_iter().filter(|b| &b.kind == b"trun").nth(1);
    match second {
        Some(b) => Err(Error::bitstream(
            b.offset,
            "",
            "one trun of a track, found a second one",
        )),
        None => find(traf, &[b"trun"]),
    }
}

/// trun: data offset and the only sample.
fn run(r: &mut Reader, mut d: Defaults) -> Result<(i32, Defaults)> {
    let (mut flags, mut count, mut offset) = (0, 0, 0);
    r.u32(&mut flags)?;
    r.u32(&mut count)?;
    r.must(count == 1, || format!("one sample, found {count}"))?;
    if flags & 0x01 != 0 {
        r.u32(&mut offset)?;
    }
    if flags & 0x04 != 0 {
        r.u32(&mut d.flags)?; // of the first sample: the flags per sample are absent then
    }
    if flags & 0x100 != 0 {
        r.u32(&mut d.duration)?;
    }
    if flags & 0x200 != 0 {
        r.u32(&mut d.size)?;
    }
    if flags & 0x400 != 0 && flags & 0x04 == 0 {
        r.u32(&mut d.flags)?;
    }
    Ok((offset as i32, d))
}
