//! Writer of the container (spec 2): init segment, fragments, sidx and ssix.

use super::config::Config;
use crate::error::{Error, Result};

pub const TRACK_ID: u32 = 1;
pub const BRAND: &[u8; 4] = b"gsv1";
const FLAGS_SYNC: u32 = 0x0200_0000; // sample_depends_on = 2: on no other
const FLAGS_OTHER: u32 = 0x0101_0000; // depends on others, is not a sync sample
/// Most bytes of a range in ssix.
const RANGE_MAX: u64 = (1 << 24) - 1;
const UNITY: [u32; 9] = [1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30];

/// A fragment for the index.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reference {
    /// Bytes of the fragment: moof and mdat.
    pub size: u64,
    pub frames: u32,
    pub sync: bool,
    /// Bytes of the fragment up to the end of each layer; empty if unknown.
    pub layers: Vec<u64>,
}

/// A box around `parts`.
fn boxed(kind: &[u8; 4], parts: &[&[u8]]) -> Vec<u8> {
    let size = 8 + parts.iter().map(|p| p.len()).sum::<usize>();
    [&(size as u32).to_be_bytes(), kind.as_slice()]
        .into_iter()
        .chain(parts.iter().copied())
        .flatten()
        .copied()
        .collect()
}

/// A FullBox.
fn full(kind: &[u8; 4], version: u8, flags: u32, parts: &[&[u8]]) -> Vec<u8> {
    let head = (u32::from(version) << 24 | flags).to_be_bytes();
    let parts: Vec<&[u8]> = std::iter::once(head.as_slice()).chain(parts.iter().copied()).collect();
    boxed(kind, &parts)
}

fn words(v: &[u32]) -> Vec<u8> {
    v.iter().flat_map(|w| w.to_be_bytes()).collect()
}

/// ftyp and moov, which start every file.
pub fn init_segment(config: &Config) -> Result<Vec<u8>> {
    let mut out = boxed(b"ftyp", &[BRAND, &[0; 4], BRAND, b"iso6", b"cmfc"]);
    let mvhd = [
        words(&[0, 0, config.timescale, 0, 1 << 16]),
        vec![1, 0],
        vec![0; 10],
        words(&UNITY),
        vec![0; 24],
        words(&[TRACK_ID + 1]),
    ];
    let mvhd = full(b"mvhd", 0, 0, &[&mvhd.concat()]);
    let trex = full(b"trex", 0, 0, &[&words(&[TRACK_ID, 1, 0, 0, 0])]);
    out.extend(boxed(b"moov", &[&mvhd, &track(config)?, &boxed(b"mvex", &[&trex])]));
    Ok(out)
}

fn track(config: &Config) -> Result<Vec<u8>> {
    let tkhd = [words(&[0, 0, TRACK_ID, 0, 0]), vec![0; 16], words(&UNITY), vec![0; 8]].concat();
    let tkhd = full(b"tkhd", 0, 3, &[&tkhd]); // enabled, in the movie
    let mdhd = full(
        b"mdhd",
        0,
        0,
        &[&words(&[0, 0, config.timescale, 0]), &[0x55, 0xC4, 0, 0]],
    ); // language "und"
    let hdlr = full(b"hdlr", 0, 0, &[&[0; 4], b"volv", &[0; 12], b"gsv\0"]);
    let dref = full(b"dref", 0, 0, &[&words(&[1]), &full(b"url ", 0, 1, &[])]);
    let mut name = [0u8; 32];
    name[..4].copy_from_slice(&[3, b'g', b's', b'v']);
    let entry = boxed(
        BRAND,
        &[&[0, 0, 0, 0, 0, 0, 0, 1], &name, &boxed(b"gsvC", &[&config.write()?])],
    );
    let stbl = [
        full(b"stsd", 0, 0, &[&words(&[1]), &entry]),
        full(b"stts", 0, 0, &[&words(&[0])]),
        full(b"stsc", 0, 0, &[&words(&[0])]),
        full(b"stsz", 0, 0, &[&words(&[0, 0])]),
        full(b"stco", 0, 0, &[&words(&[0])]),
    ];
    let minf = [
        full(b"vvhd", 0, 0, &[]),
        boxed(b"dinf", &[&dref]),
        boxed(b"stbl", &[&stbl.concat()]),
    ]
    .concat();
    Ok(boxed(
        b"trak",
        &[&tkhd, &boxed(b"mdia", &[&mdhd, &hdlr, &boxed(b"minf", &[&minf])])],
    ))
}

/// moof and mdat of one group. `sequence_number` counts from 1, `start_frame` from 0.
pub fn fragment(
    payload: &[u8],
    sequence_number: u32,
    start_frame: u64,
    frames: u32,
    sync: bool,
    config: &Config,
) -> Result<Vec<u8>> {
    let times = start_frame
        .checked_mul(u64::from(config.frame_duration))
        .zip(frames.checked_mul(config.frame_duration));
    let size = u32::try_from(payload.len()).ok().filter(|s| *s <= u32::MAX - 8);
    let (Some((start, duration)), Some(size), true) = (times, size, frames > 0) else {
        return Err(Error::Input(format!(
            "a fragment of {frames} frames and {} bytes does not fit its fields",
            payload.len()
        )));
    };
    let flags = if sync { FLAGS_SYNC } else { FLAGS_OTHER };
    let moof = |offset: u32| {
        let tfhd = full(b"tfhd", 0, 0x02_0000, &[&words(&[TRACK_ID])]);
        let tfdt = full(b"tfdt", 1, 0, &[&start.to_be_bytes()]);
        let trun = full(b"trun", 0, 0x00_0701, &[&words(&[1, offset, duration, size, flags])]);
        let mfhd = full(b"mfhd", 0, 0, &[&words(&[sequence_number])]);
        boxed(b"moof", &[&mfhd, &boxed(b"traf", &[&tfhd, &tfdt, &trun])])
    };
    let mut out = moof(moof(0).len() as u32 + 8);
    out.extend(words(&[size + 8]));
    out.extend(b"mdat");
    out.extend_from_slice(payload);
    Ok(out)
}

/// What precedes the fragments in a finished file: the init segment, a sidx (spec 2.5), and where a group has more than one
/// layer a ssix (spec 2.6).
pub fn finish(init: &[u8], config: &Config, groups: &[Reference]) -> Result<Vec<u8>> {
    let per = groups.len().div_ceil(usize::from(u16::MAX)).max(1); // groups per reference
    let mut references = Vec::new();
    for run in groups.chunks(per) {
        let size: u64 = run.iter().map(|g| g.size).sum();
        let duration = run.iter().map(|g| u64::from(g.frames)).sum::<u64>() * u64::from(config.frame_duration);
        let (true, Ok(duration)) = (size < 1 << 31, u32::try_from(duration)) else {
            return Err(Error::Input(format!(
                "an index entry of {size} bytes and {duration} time units does not fit its fields"
            )));
        };
        let sap = if run.first().is_some_and(|g| g.sync) {
            0x9000_0000
        } else {
            0
        };
        references.extend(words(&[size as u32, duration, sap]));
    }
    let layered = per == 1 && groups.iter().any(|g| g.layers.len() > 1);
    let ssix = if layered { layer_index(groups) } else { Vec::new() };
    let count = (references.len() / 12) as u16;
    let head = [
        words(&[TRACK_ID, config.timescale]),
        vec![0; 8], // earliest presentation time
        (ssix.len() as u64).to_be_bytes().to_vec(),
        vec![0; 2],
        count.to_be_bytes().to_vec(),
    ]
    .concat();
    Ok([init, &full(b"sidx", 1, 0, &[&head, &references]), &ssix].concat())
}

/// ssix (spec 2.6).
fn layer_index(groups: &[Reference]) -> Vec<u8> {
    let mut body = words(&[groups.len() as u32]);
    for g in groups {
        let whole = [g.size];
        let ends = if g.layers.is_empty() { &whole[..] } else { &g.layers };
        let mut ranges = Vec::new();
        let mut from = 0;
        for (k, end) in ends.iter().enumerate() {
            loop {
                let size = end.saturating_sub(from).min(RANGE_MAX); // 0 for a layer without units
                ranges.push((k as u32) << 24 | size as u32);
                from += size;
                if from >= *end {
                    break;
                }
            }
        }
        body.extend(words(&[ranges.len() as u32]));
        body.extend(words(&ranges));
    }
    full(b"ssix", 0, 0, &[&body])
}
