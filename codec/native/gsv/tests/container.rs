//! The demuxer: the result does not depend on how the input is split, a truncated file keeps its whole groups, and
//! nothing panics.

mod common;

use common::Random;
use gsv::container::audio::{AudioRun, AudioTrack};
use gsv::container::config::{Camera, Config, rate};
use gsv::container::demux::Demuxer;
use gsv::container::entry::Entry;
use gsv::container::placement::{Key, Placement};
use gsv::container::whole;
use gsv::container::write::{Reference, Sound, finish, fragment, init_segment};
use gsv::pose::Pose;
use proptest::prelude::*;

fn config() -> Config {
    let camera = Camera {
        name: "cam é".into(),
        width: 1920,
        height: 1080,
        k: [1.0; 5],
        viewmat: [0.5; 12],
        near: 0.5,
        low_pass: 0.1,
    };
    Config {
        timescale: 30_000,
        frame_duration: 1001,
        level: 2,
        metres_per_unit: 1.0,
        up_axis: 4,
        color_space: 0,
        background: [0.0, 0.5, 1.0],
        sh_degree: 3,
        cameras: vec![camera.clone(), camera],
        audio: None,
        ..Config::default()
    }
}

/// A finished file of three groups, and the entries of its samples.
fn file() -> (Vec<u8>, Vec<Entry>) {
    let config = config();
    let init = init_segment(std::slice::from_ref(&config)).unwrap();
    let groups = [
        (vec![1u8; 100], 20, true),
        (vec![2; 0], 1, false),
        (vec![3; 5000], 7, true),
    ];
    let (mut fragments, mut index, mut start) = (Vec::new(), Vec::new(), 0);
    for ((payload, frames, sync), number) in groups.iter().zip(1..) {
        let f = fragment(payload, number, start, *frames, *sync, &config, None).unwrap();
        index.push(Reference {
            size: f.len() as u64,
            frames: *frames,
            sync: *sync,
            layers: Vec::new(),
        });
        fragments.extend(f);
        start += u64::from(*frames);
    }
    let mut out = finish(&init, &[(&config, index.clone())]).unwrap();
    let (mut end, mut start, mut entries) = (out.len() as u64, 0, Vec::new());
    for ((payload, frames, sync), r) in groups.iter().zip(&index) {
        end += r.size;
        let size = payload.len() as u64;
        entries.push(Entry {
            offset: end - size,
            size,
            start_frame: start,
            frames: *frames,
            sync: *sync,
            audio: None,
        });
        start += u64::from(*frames);
    }
    out.extend(fragments);
    (out, entries)
}

fn parsed(pieces: &[&[u8]]) -> Demuxer {
    let mut d = Demuxer::default();
    pieces.iter().for_each(|p| d.push(p).unwrap());
    d
}

#[test]
fn everything_comes_back() {
    let (bytes, entries) = file();
    let d = parsed(&[&bytes]);
    assert_eq!(d.config(), Some(&config()));
    assert_eq!(d.groups(), entries);
    assert!(d.complete() && d.pending().is_none());
}

#[test]
fn byte_by_byte_and_by_skipping() {
    let (bytes, entries) = file();
    let d = parsed(&bytes.chunks(1).collect::<Vec<_>>());
    assert_eq!((d.groups(), d.complete()), (entries.as_slice(), true));
    let mut d = Demuxer::default();
    let mut seen = 0;
    while (d.position() as usize) < bytes.len() {
        let skip = d.skippable();
        if skip > 0 {
            d.skip(skip);
        } else {
            let at = d.position() as usize;
            d.push(&bytes[at..at + 1]).unwrap();
            seen += 1;
        }
    }
    assert_eq!((d.groups(), d.complete()), (entries.as_slice(), true));
    assert!(seen < 2500, "{seen} bytes of headers");
}

#[test]
fn a_cut_file_keeps_its_whole_groups() {
    let (bytes, entries) = file();
    for n in 0..bytes.len() {
        let d = parsed(&[&bytes[..n]]);
        let whole: Vec<Entry> = entries
            .iter()
            .filter(|e| (e.offset + e.size) as usize <= n)
            .cloned()
            .collect();
        assert_eq!(d.groups(), whole, "{n}");
        assert!(!d.complete());
    }
}

#[test]
fn a_growing_file_has_no_index() {
    let config = config();
    let init = init_segment(std::slice::from_ref(&config)).unwrap();
    let f = fragment(b"group", 1, 40, 20, true, &config, None).unwrap();
    let d = parsed(&[&init, &f]);
    assert_eq!(d.groups().len(), 1);
    assert_eq!(d.groups()[0].start_frame, 40);
    assert!(!d.complete());
}

#[test]
fn unknown_boxes_are_skipped() {
    let (bytes, entries) = file();
    let free = [0u8, 0, 0, 12, b'f', b'r', b'e', b'e', 1, 2, 3, 4];
    let large = [&[0u8, 0, 0, 1][..], b"wxyz", &20u64.to_be_bytes(), &[9; 4]].concat();
    let ftyp = 28;
    let d = parsed(&[&bytes[..ftyp], &free, &large, &bytes[ftyp..], &free]);
    let moved: Vec<Entry> = entries
        .iter()
        .map(|e| Entry {
            offset: e.offset + 32,
            ..e.clone()
        })
        .collect();
    assert_eq!(d.groups(), moved);
    assert!(d.complete());
}

#[test]
fn other_files_are_named() {
    let message = |bytes: &[u8]| Demuxer::default().push(bytes).unwrap_err().to_string();
    assert!(message(b"\x89PNG\r\n\x1a\n").contains("starts with an ftyp box"));
    let mut mp4 = file().0;
    mp4[8..12].copy_from_slice(b"isom");
    mp4[16..20].copy_from_slice(b"isom");
    assert!(message(&mp4).contains("gsv1"));
    let (bytes, _) = file();
    let init = init_segment(&[config()]).unwrap();
    assert!(message(&[&bytes[..28], &bytes[init.len()..]].concat()).contains("moov"));
}

proptest! {
    #[test]
    fn any_split_gives_the_same(seed in any::<u64>()) {
        let (bytes, entries) = file();
        let mut r = Random(seed);
        let mut d = Demuxer::default();
        let mut rest = bytes.as_slice();
        while !rest.is_empty() {
            let (a, b) = rest.split_at(1 + r.below(rest.len().min(300) as u64) as usize);
            d.push(a).unwrap();
            rest = b;
        }
        prop_assert_eq!(d.groups(), entries);
        prop_assert!(d.complete());
    }

    #[test]
    fn damage_never_panics(seed in any::<u64>()) {
        let (mut bytes, _) = file();
        let mut r = Random(seed);
        for _ in 0..1 + r.below(6) {
            let i = r.below(900.min(bytes.len() as u64)) as usize;
            bytes[i] = r.next() as u8;
        }
        let mut d = Demuxer::default();
        if d.push(&bytes).is_ok() {
            for g in d.groups() {
                prop_assert!(g.offset + g.size <= bytes.len() as u64);
            }
        }
    }
}

#[test]
fn frame_rates() {
    assert_eq!(rate(30.0).unwrap(), (30, 1));
    assert_eq!(rate(29.97).unwrap(), (30_000, 1001));
    assert_eq!(rate(30_000.0 / 1001.0).unwrap(), (30_000, 1001));
    assert_eq!(rate(23.976).unwrap(), (24_000, 1001));
    assert_eq!(rate(12.5).unwrap(), (12_500_000, 1_000_000));
    let (n, d) = rate(0.1234567).unwrap();
    assert!((f64::from(n) / f64::from(d) - 0.1234567).abs() < 1e-6);
    assert!(rate(f64::NAN).is_err() && rate(0.0).is_err());
}

/// Spec 2.4: the sample of a moof must lie in the next mdat.
#[test]
fn a_sample_needs_its_mdat() {
    let config = config();
    let init = init_segment(std::slice::from_ref(&config)).unwrap();
    let sound = fragment(&[7; 50], 1, 0, 20, true, &config, None).unwrap();
    let mut other = sound.clone();
    let mdat = other.len() - 54;
    other[mdat..mdat + 4].copy_from_slice(b"what");
    let mut d = parsed(&[&init, &other]);
    assert!(d.groups().is_empty() && d.pending().is_some());
    let message = d.push(&sound).unwrap_err().to_string();
    assert!(message.contains("mdat"), "{message}");
    let empty = fragment(&[], 1, 0, 20, true, &config, None).unwrap();
    assert!(parsed(&[&init, &empty[..empty.len() - 8]]).groups().is_empty());
    assert_eq!(parsed(&[&init, &empty]).groups().len(), 1);
}

/// The ends of the layers in ssix (spec 2.6); a ssix that does not match is ignored.
#[test]
fn layers_can_be_found() {
    let config = config();
    let init = init_segment(std::slice::from_ref(&config)).unwrap();
    let group = |size: u64, layers: &[u64]| Reference {
        size,
        frames: 1,
        sync: true,
        layers: layers.to_vec(),
    };
    let large = (1 << 25) + 5;
    let groups = [group(900, &[300, 300, 900]), group(50, &[]), group(large, &[7, large])];
    let head = finish(&init, &[(&config, groups.to_vec())]).unwrap();
    let read = |head: &[u8]| {
        let mut d = Demuxer::default();
        d.push(head).unwrap();
        d.layers().to_vec()
    };
    let mut d = Demuxer::default();
    d.push(&head).unwrap();
    assert_eq!(d.index()[0].offset, head.len() as u64);
    assert_eq!(read(&head), [vec![300, 300, 900], vec![50], vec![7, large]]);
    let at = head.windows(4).position(|w| w == b"ssix").unwrap();
    for (offset, byte) in [(8, 1), (11, 9), (15, 200), (19, 3)] {
        let mut bad = head.clone();
        bad[at + offset] = byte;
        let mut d = Demuxer::default();
        d.push(&bad).unwrap();
        assert_eq!(d.index().len(), 3);
    }
    let plain = finish(&init, &[(&config, groups[1..2].to_vec())]).unwrap();
    assert!(!plain.windows(4).any(|w| w == b"ssix"));
}

const ENTRY: &[u8] =
    b"\0\0\0\x30Opus\0\0\0\0\0\0\0\x01\0\0\0\0\0\0\0\0\0\x02\0\x10\0\0\0\0\xbb\x80\0\0\0\0\0\x0cdOps\0\x02\x01\x38";

/// Two groups, the first one with sound; and the sound.
fn sounding() -> (Vec<u8>, AudioRun) {
    let track = AudioTrack {
        timescale: 48_000,
        media_start: 312,
        entry: ENTRY.to_vec(),
    };
    let config = Config {
        audio: Some(track),
        ..config()
    };
    let samples = [(3, 960), (5, 960)];
    let sound = Sound {
        time: 960,
        samples: &samples,
        data: b"abcdefgh",
    };
    let init = init_segment(std::slice::from_ref(&config)).unwrap();
    let first = fragment(&[1; 40], 1, 0, 20, true, &config, Some(sound)).unwrap();
    let second = fragment(&[2; 10], 2, 20, 1, true, &config, None).unwrap();
    let run = AudioRun {
        offset: (init.len() + first.len() - 48) as u64,
        time: 960,
        samples: samples.to_vec(),
    };
    assert!(
        fragment(
            &[],
            1,
            0,
            1,
            true,
            &config,
            Some(Sound {
                data: b"short",
                ..sound
            })
        )
        .is_err()
    );
    ([init, first, second].concat(), run)
}

/// Spec 2.7, for any split of the bytes; `read_audio` returns the same samples.
#[test]
fn sound_lies_in_front_of_its_group() {
    let (bytes, run) = sounding();
    for d in [parsed(&[&bytes]), parsed(&bytes.chunks(1).collect::<Vec<_>>())] {
        assert_eq!(d.config().unwrap().audio.as_ref().unwrap().entry, ENTRY);
        assert_eq!(d.groups()[0].audio.as_ref(), Some(&run));
        assert_eq!(d.groups()[0].offset, run.offset + 8);
        assert_eq!(d.groups()[1].audio, None);
    }
    let (track, runs) = whole::read_audio(&bytes).unwrap();
    assert_eq!((track.media_start, runs), (312, vec![run]));
}

/// No byte of the headers makes a panic, or a sample outside of the file.
#[test]
fn damaged_sound_is_named() {
    let (bytes, run) = sounding();
    for at in 0..run.offset as usize {
        for flip in [1, 0x80, 0xff] {
            let mut bad = bytes.clone();
            bad[at] ^= flip;
            let mut d = Demuxer::default();
            if d.push(&bad).is_ok() {
                for run in d.groups().iter().filter_map(|g| g.audio.as_ref()) {
                    assert!(run.offset + run.size() <= bytes.len() as u64);
                }
            }
        }
    }
}

/// Three tracks of two groups each, the second one placed; and the number of bytes in front of the fragments.
fn scene() -> (Vec<u8>, usize) {
    let pose = Pose {
        rotation: [0.8, 0.0, 0.6, 0.0],
        translation: [1.0, 2.0, 3.0],
        scale: 0.5,
    };
    let placement = Placement {
        name: "männlein".into(),
        offset: -40,
        repeats: 3,
        keys: vec![Key { time: -7, pose }, Key { time: 9, pose }],
        ..Placement::default()
    };
    let configs: Vec<Config> = (0..3)
        .map(|track| Config {
            track,
            placement: if track == 1 {
                placement.clone()
            } else {
                Placement::default()
            },
            ..config()
        })
        .collect();
    let (mut fragments, mut tracks) = (Vec::new(), Vec::new());
    for config in &configs {
        let mut index = Vec::new();
        for i in 0..2 {
            let f = fragment(&[7; 60], 1, 20 * i, 20, i == 0, config, None).unwrap();
            index.push(Reference {
                size: f.len() as u64,
                frames: 20,
                sync: i == 0,
                layers: vec![f.len() as u64 - 5, f.len() as u64],
            });
            fragments.extend(f);
        }
        tracks.push((config, index));
    }
    let head = finish(&init_segment(&configs).unwrap(), &tracks).unwrap();
    ([head.as_slice(), &fragments].concat(), head.len())
}

/// Spec 2.2, 2.5 and 2.8: each track has its own groups, index, layers and placement, for any split of the bytes.
#[test]
fn tracks_are_found_apart() {
    let (bytes, head) = scene();
    assert_eq!(whole::tracks(&bytes[..head]).unwrap(), 3);
    for track in 0..3 {
        for piece in [1, bytes.len()] {
            let mut d = Demuxer::of_track(track);
            bytes.chunks(piece).for_each(|b| d.push(b).unwrap());
            let fragments: Vec<u64> = d.index().iter().map(|e| e.offset + e.size).collect();
            let ends: Vec<u64> = d.groups().iter().map(|g| g.offset + g.size).collect();
            assert_eq!(ends, fragments);
            assert_eq!((d.layers().len(), d.tracks(), d.complete()), (2, 3, true));
            let placement = &d.config().unwrap().placement;
            assert_eq!(
                (placement.keys.len(), placement.repeats),
                if track == 1 { (2, 3) } else { (0, 1) }
            );
        }
    }
    assert!(Demuxer::of_track(3).push(&bytes).is_err());
}

proptest! {
    /// Damage behind the index costs only the track whose bytes are damaged.
    #[test]
    fn damage_stays_in_its_track(seed in any::<u64>()) {
        let (bytes, head) = scene();
        let mut r = Random(seed);
        let mut bad = bytes.clone();
        let at = head + r.below((bytes.len() - head) as u64) as usize;
        bad[at] ^= 1 + r.below(255) as u8;
        let mut hurt = 0;
        for track in 0..3 {
            let (whole, _) = whole::read(&bytes, true, track).unwrap();
            let (saved, damage) = whole::read(&bad, false, track).unwrap();
            let last = whole.groups().last().unwrap();
            let first = whole.index()[0].offset as usize;
            if !(first..(last.offset + last.size) as usize).contains(&at) {
                prop_assert_eq!(saved.groups(), whole.groups());
                prop_assert!(damage.is_empty());
            } else {
                hurt += 1;
            }
        }
        prop_assert_eq!(hurt, 1);
    }

    /// No byte of moov or of an index makes a panic, for any track.
    #[test]
    fn damaged_heads_never_panic(seed in any::<u64>()) {
        let (mut bytes, head) = scene();
        let mut r = Random(seed);
        for _ in 0..1 + r.below(4) {
            let at = r.below(head as u64) as usize;
            bytes[at] = r.next() as u8;
        }
        for track in 0..3 {
            if let Ok((d, _)) = whole::read(&bytes, false, track) {
                let pose = d.config().map_or(Pose::default(), |c| c.placement.pose(r.below(99) as f64 - 50.0));
                prop_assert!(pose.scale > 0.0 && pose.rotation.iter().all(|v| v.is_finite()));
            }
        }
    }
}
