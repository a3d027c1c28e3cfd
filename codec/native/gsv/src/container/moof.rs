//! The body of moof (spec 2.4 and 2.7) -> the place of a group in the file, and the samples of its sound.
//!
//! Only the fields that a reader needs are parsed. `inline(never)`: as in `fields`.

use super::audio::{AudioRun, SAMPLES_MAX};
use super::entry::Entry;
use super::isobmff::{boxes, find};
use super::moov::{Audio, Defaults, Track};
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader};

/// Spec 2.4: the group of a moof, with its sound; None if the moof has no group of the track. `start`: offset of the
/// moof box.
pub fn read(body: &[u8], track: &Track, start: u64) -> Result<Option<Entry>> {
    for b in boxes(body)?.into_iter().filter(|b| &b.kind == b"traf") {
        let group = traf(b.body, track, start).map_err(|e| e.at(b.offset, "traf box"))?;
        if let Some(mut group) = group {
            if let Some(audio) = &track.audio {
                group.audio = read_audio(body, audio, start)?;
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

/// Spec 2.7: the samples of the audio track in a moof; None if it has none.
pub fn read_audio(body: &[u8], audio: &Audio, start: u64) -> Result<Option<AudioRun>> {
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
