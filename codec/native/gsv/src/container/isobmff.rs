//! Parsers of the header boxes ftyp, moov, moof, sidx and ssix (spec 2.1 to 2.6). Only the fields that a reader needs are
//! parsed; unknown boxes are skipped.

use super::config::Config;
use super::entry::{Entry, name};
use super::write::BRAND;
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader};

/// The gsv track, as moov describes it.
pub struct Track {
    id: u32,
    pub config: Config,
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
struct Inner<'a> {
    kind: [u8; 4],
    offset: usize,
    body: &'a [u8],
}

/// The boxes that fill `data`.
fn boxes(data: &[u8]) -> Result<Vec<Inner<'_>>> {
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

/// Parses the body of moov: the first track with handler volv.
pub fn moov(body: &[u8]) -> Result<Track> {
    for b in boxes(body)?.into_iter().filter(|b| &b.kind == b"trak") {
        let (hdlr, _) = find(b.body, &[b"mdia", b"hdlr"]).map_err(|e| e.at(b.offset, ""))?;
        if hdlr.get(8..12) == Some(b"volv") {
            let (id, config) = track(b.body).map_err(|e| e.at(b.offset, "gsv track"))?;
            return Ok(Track {
                id,
                config,
                defaults: extends(body, id)?,
            });
        }
    }
    Err(Error::bitstream(0, "", "a track with handler volv, found none"))
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
    let (config, at) = find(entry.body.get(40..).unwrap_or(&[]), &[b"gsvC"]).map_err(|e| e.at(base, ""))?;
    let config = Config::read(config, timescale).map_err(|e| e.at(base + at, "gsvC box"))?;
    if timescale == 0 {
        return Err(Error::bitstream(base, "", "a timescale > 0"));
    }
    Ok((id, config))
}

/// The u32 behind the two time stamps at the start of tkhd and mdhd.
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

/// Spec 2.5: first_offset and the entries of sidx; None if it is malformed.
pub fn sidx(body: &[u8]) -> Option<(u64, Vec<SidxReference>)> {
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

/// Spec 2.4: the group of a moof; None if it has none of the track. `start`: offset of the moof box.
pub fn moof(body: &[u8], track: &Track, start: u64) -> Result<Option<Entry>> {
    for b in boxes(body)?.into_iter().filter(|b| &b.kind == b"traf") {
        if let Some(group) = traf(b.body, track, start).map_err(|e| e.at(b.offset, "traf box"))? {
            return Ok(Some(group));
        }
    }
    Ok(None)
}

/// The group of a traf; None if it belongs to another track.
fn traf(body: &[u8], track: &Track, start: u64) -> Result<Option<Entry>> {
    let (tfhd, base) = find(body, &[b"tfhd"])?;
    let mut r = Reader::new(tfhd);
    let Some((data, defaults)) = header(&mut r, track, start).map_err(|e| e.at(base, ""))? else {
        return Ok(None);
    };
    let (tfdt, base) = find(body, &[b"tfdt"])?;
    let time = decode_time(&mut Reader::new(tfdt)).map_err(|e| e.at(base, ""))?;
    let (trun, base) = find(body, &[b"trun"])?;
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
    }))
}

/// tfhd: base of the data offsets and sample defaults; None for another track.
fn header(r: &mut Reader, track: &Track, start: u64) -> Result<Option<(u64, Defaults)>> {
    let (mut flags, mut id, mut base, mut d) = (0, 0, start, track.defaults);
    r.u32(&mut flags)?;
    r.u32(&mut id)?;
    if flags & 0x01 != 0 {
        r.u64(&mut base)?;
    }
    if flags & 0x02 != 0 {
        r.take(4)?; // sample description index
    }
    for (bit, field) in [(0x08, &mut d.duration), (0x10, &mut d.size), (0x20, &mut d.flags)] {
        if flags & bit != 0 {
            r.u32(field)?;
        }
    }
    Ok((id == track.id).then_some((base, d)))
}

fn decode_time(r: &mut Reader) -> Result<u64> {
    let (mut head, mut short, mut long) = (0, 0, 0);
    r.u32(&mut head)?;
    if head >> 24 == 1 {
        r.u64(&mut long)?;
        return Ok(long);
    }
    r.u32(&mut short)?;
    Ok(u64::from(short))
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
