//! Writer of the container (spec 2): init segment, fragments, sidx and ssix.

use super::audio::{AudioTrack, SAMPLES_MAX};
use super::config::Config;
use super::placement::Placement;
use crate::error::{Error, Result};

pub const TRACK_ID: u32 = 1;
const AUDIO_ID: u32 = 2;
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

/// The sound in front of a group.
#[derive(Debug, Clone, Copy)]
pub struct Sound<'a> {
    /// Media time of the first sample.
    pub time: u64,
    /// Size and duration of each sample.
    pub samples: &'a [(u32, u32)],
    pub data: &'a [u8],
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

/// track_ID of a gsv track; AUDIO_ID is left out.
fn track_id(number: usize) -> u32 {
    match number {
        0 => TRACK_ID,
        _ => AUDIO_ID + number as u32,
    }
}

/// ftyp and moov, the start of every file, for one or more tracks. The sound is that of the first one.
pub fn init_segment(configs: &[Config]) -> Result<Vec<u8>> {
    let Some(first) = configs.first() else {
        return Err(Error::Input("expected at least one track".into()));
    };
    let mut out = boxed(b"ftyp", &[BRAND, &[0; 4], BRAND, b"iso6", b"cmfc"]);
    let sound = first.audio.as_ref().map(|_| AUDIO_ID);
    let others = (1..configs.len()).map(track_id);
    let ids: Vec<u32> = [TRACK_ID].into_iter().chain(sound).chain(others).collect();
    let mvhd = [
        words(&[0, 0, first.timescale, 0, 1 << 16]),
        vec![1, 0],
        vec![0; 10],
        words(&UNITY),
        vec![0; 24],
        words(&[ids.last().map_or(0, |id| id + 1)]),
    ];
    let mvhd = full(b"mvhd", 0, 0, &[&mvhd.concat()]);
    let trex: Vec<u8> = ids
        .iter()
        .flat_map(|id| full(b"trex", 0, 0, &[&words(&[*id, 1, 0, 0, 0])]))
        .collect();
    let mut traks = Vec::new();
    for (number, config) in configs.iter().enumerate() {
        traks.extend(track(config, track_id(number))?);
        if number == 0 {
            traks.extend(config.audio.as_ref().map_or(Vec::new(), audio_track));
        }
    }
    out.extend(boxed(b"moov", &[&mvhd, &traks, &boxed(b"mvex", &[&trex])]));
    Ok(out)
}

fn track(config: &Config, id: u32) -> Result<Vec<u8>> {
    let mut name = [0u8; 32];
    name[..4].copy_from_slice(&[3, b'g', b's', b'v']);
    let placed = config.placement != Placement::default();
    let placement = match placed {
        true => boxed(b"gsvT", &[&config.placement.write()?]),
        false => Vec::new(),
    };
    let config_box = boxed(b"gsvC", &[&config.write()?]);
    let entry = boxed(BRAND, &[&[0, 0, 0, 0, 0, 0, 0, 1], &name, &config_box, &placement]);
    let head = [tkhd(id, 0)];
    let media = full(b"vvhd", 0, 0, &[]);
    Ok(trak(&head, config.timescale, (b"volv", b"gsv\0"), &media, &entry))
}

/// Spec 2.7.
fn audio_track(audio: &AudioTrack) -> Vec<u8> {
    let elst = full(b"elst", 0, 0, &[&words(&[1, 0, audio.media_start, 1 << 16])]);
    let head = [tkhd(AUDIO_ID, 1 << 8), boxed(b"edts", &[&elst])];
    let media = full(b"smhd", 0, 0, &[&[0; 4]]);
    trak(&head, audio.timescale, (b"soun", b"sound\0"), &media, &audio.entry)
}

/// tkhd of a track that is enabled and in the movie; `volume`: 8.8 fixed point.
fn tkhd(id: u32, volume: u16) -> Vec<u8> {
    let volume = volume.to_be_bytes();
    let body = [
        words(&[0, 0, id, 0, 0]),
        vec![0; 12],
        volume.to_vec(),
        vec![0; 2],
        words(&UNITY),
        vec![0; 8],
    ];
    full(b"tkhd", 0, 3, &[&body.concat()])
}

/// A track whose samples are in fragments. `head`: its boxes in front of mdia, `media`: its media header.
fn trak(head: &[Vec<u8>], timescale: u32, (handler, name): (&[u8; 4], &[u8]), media: &[u8], entry: &[u8]) -> Vec<u8> {
    let mdhd = full(b"mdhd", 0, 0, &[&words(&[0, 0, timescale, 0]), &[0x55, 0xC4, 0, 0]]); // language "und"
    let hdlr = full(b"hdlr", 0, 0, &[&[0; 4], handler, &[0; 12], name]);
    let dref = full(b"dref", 0, 0, &[&words(&[1]), &full(b"url ", 0, 1, &[])]);
    let stbl = [
        full(b"stsd", 0, 0, &[&words(&[1]), entry]),
        full(b"stts", 0, 0, &[&words(&[0])]),
        full(b"stsc", 0, 0, &[&words(&[0])]),
        full(b"stsz", 0, 0, &[&words(&[0, 0])]),
        full(b"stco", 0, 0, &[&words(&[0])]),
    ];
    let minf = [media, &boxed(b"dinf", &[&dref]), &boxed(b"stbl", &[&stbl.concat()])].concat();
    let mdia = boxed(b"mdia", &[&mdhd, &hdlr, &boxed(b"minf", &[&minf])]);
    boxed(b"trak", &[&head.concat(), &mdia])
}

/// moof and mdat of one group. `sequence_number` counts from 1, `start_frame` from 0; `sound` goes in front of the
/// payload.
pub fn fragment(
    payload: &[u8],
    sequence_number: u32,
    start_frame: u64,
    frames: u32,
    sync: bool,
    config: &Config,
    sound: Option<Sound>,
) -> Result<Vec<u8>> {
    let times = start_frame
        .checked_mul(u64::from(config.frame_duration))
        .zip(frames.checked_mul(config.frame_duration));
    let data = sound.map_or(&[][..], |s| s.data);
    let size = u32::try_from(payload.len() + data.len())
        .ok()
        .filter(|s| *s <= u32::MAX - 8);
    let (Some((start, duration)), Some(size), true) = (times, size, frames > 0) else {
        return Err(Error::Input(format!(
            "a fragment of {frames} frames and {} bytes does not fit its fields",
            payload.len() + data.len()
        )));
    };
    if let Some(s) = sound {
        check(&s)?;
    }
    let flags = if sync { FLAGS_SYNC } else { FLAGS_OTHER };
    let moof = |offset: u32| {
        let own = [1, offset + data.len() as u32, duration, payload.len() as u32, flags];
        let mut parts = full(b"mfhd", 0, 0, &[&words(&[sequence_number])]);
        parts.extend(traf(track_id(config.track), start, 0x00_0701, &words(&own)));
        if let Some(s) = sound {
            let each = s.samples.iter().flat_map(|(size, duration)| [*duration, *size]);
            let run: Vec<u32> = [s.samples.len() as u32, offset].into_iter().chain(each).collect();
            parts.extend(traf(AUDIO_ID, s.time, 0x00_0301, &words(&run)));
        }
        boxed(b"moof", &[&parts])
    };
    let mut out = moof(moof(0).len() as u32 + 8);
    out.extend(words(&[size + 8]));
    out.extend(b"mdat");
    out.extend_from_slice(data);
    out.extend_from_slice(payload);
    Ok(out)
}

fn traf(id: u32, time: u64, flags: u32, run: &[u8]) -> Vec<u8> {
    let tfhd = full(b"tfhd", 0, 0x02_0000, &[&words(&[id])]);
    let tfdt = full(b"tfdt", 1, 0, &[&time.to_be_bytes()]);
    let trun = full(b"trun", 0, flags, &[run]);
    boxed(b"traf", &[&tfhd, &tfdt, &trun])
}

fn check(sound: &Sound) -> Result<()> {
    let sizes: u64 = sound.samples.iter().map(|(size, _)| u64::from(*size)).sum();
    if sound.samples.len() <= SAMPLES_MAX && sizes == sound.data.len() as u64 {
        return Ok(());
    }
    Err(Error::Input(format!(
        "expected at most {SAMPLES_MAX} samples of sound for a group, of {} bytes in all, got {} of {sizes} bytes",
        sound.data.len(),
        sound.samples.len()
    )))
}

/// The part of a finished file in front of the fragments: the init segment, and for each track a sidx (spec 2.5), with
/// a ssix (spec 2.6) where a group has more than one layer. The fragments follow, track after track.
pub fn finish(init: &[u8], tracks: &[(&Config, Vec<Reference>)]) -> Result<Vec<u8>> {
    let mut out = Vec::new(); // indexes of the tracks so far, that of the first one last
    let mut fragments = 0; // bytes of the fragments of the tracks before
    for (number, (config, groups)) in tracks.iter().enumerate() {
        let own = index(track_id(number), config, groups, out.len() as u64 + fragments)?;
        fragments += groups.iter().map(|g| g.size).sum::<u64>();
        out = [own, out].concat();
    }
    Ok([init, &out].concat())
}

/// sidx and ssix of a track; `before`: bytes between them and its first fragment.
fn index(id: u32, config: &Config, groups: &[Reference], before: u64) -> Result<Vec<u8>> {
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
        words(&[id, config.timescale]),
        vec![0; 8], // earliest presentation time
        (ssix.len() as u64 + before).to_be_bytes().to_vec(),
        vec![0; 2],
        count.to_be_bytes().to_vec(),
    ]
    .concat();
    Ok([full(b"sidx", 1, 0, &[&head, &references]), ssix].concat())
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
