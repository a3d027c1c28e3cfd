//! Damaged bytes give an error or, below the checksum, some group; never a panic, an endless loop or too much memory.

mod common;

use common::{Random, group, small};
use gsv::decode::{Decoding, decode_group, decode_units};
use gsv::encode::encode_group;
use gsv::error::Error;
use gsv::header::Header;
use gsv::levels::Level;
use gsv::unit::UnitType::Tile;
use gsv::unit::{self, ALL_LAYERS, Entry};

fn level() -> Level {
    Level::get(1).unwrap()
}

#[test]
fn any_flipped_bit_is_noticed() {
    let payload = encode_group(&small(), None).unwrap();
    for i in 0..payload.len() {
        for bit in 0..8 {
            let mut bad = payload.clone();
            bad[i] ^= 1 << bit;
            assert!(
                decode_group(&bad, &Decoding::at(&level())).is_err(),
                "byte {i}, bit {bit}"
            );
        }
    }
}

#[test]
fn any_truncation_is_noticed() {
    let payload = encode_group(&small(), None).unwrap();
    for n in 0..payload.len() {
        match decode_group(&payload[..n], &Decoding::at(&level())) {
            Ok(_) => panic!("{n} bytes are a group"),
            Err(Error::Bitstream { offset, .. }) => assert!(offset <= n as u64),
            Err(e) => panic!("{e}"),
        }
    }
}

/// Mutates unit payloads and repairs the checksums, as a hostile writer would, to test the entropy decoders.
#[test]
fn mutated_units_never_panic() {
    let mut r = Random(99);
    let started = std::time::Instant::now();
    let (mut rounds, mut accepted) = (0, 0);
    while started.elapsed().as_secs() < 3 {
        let shape = common::Shape {
            seed: r.next(),
            counts: vec![r.below(80) as usize],
            ..small_shape()
        };
        let payload = encode_group(&group(&shape), None).unwrap();
        for _ in 0..16 {
            let mut units = unit::split(&payload, ALL_LAYERS).unwrap();
            let mut copies: Vec<Vec<u8>> = units.iter().map(|u| u.payload.to_vec()).collect();
            let victim = r.below(copies.len() as u64) as usize;
            mutate(&mut copies[victim], &mut r);
            for (u, copy) in units.iter_mut().zip(&copies) {
                u.payload = copy;
            }
            accepted += u64::from(decode_units(&units, &Decoding::at(&level())).is_ok());
            rounds += 1;
        }
    }
    assert!(rounds >= 16 && accepted < rounds);
}

fn small_shape() -> common::Shape {
    common::Shape {
        counts: vec![0],
        frames: 9,
        bits: 8,
        sh_degree: 0,
        nodes: 4,
        joints: 0,
        magnitude: 5,
        lifetimes: true,
        moving: 0b11110,
        seed: 0,
    }
}

fn mutate(bytes: &mut Vec<u8>, r: &mut Random) {
    for _ in 0..1 + r.below(4) {
        let n = bytes.len() as u64;
        match r.below(5) {
            0 => bytes.truncate(r.below(n + 1) as usize),
            1 => bytes.extend((0..r.below(9)).map(|_| r.next() as u8)),
            2 if n > 0 => bytes.fill(r.next() as u8),
            _ if n > 0 => bytes[r.below(n) as usize] = r.next() as u8,
            _ => {}
        }
    }
}

/// A header of a hundred bytes that announces the largest group must not allocate its memory.
#[test]
fn limits_come_before_memory() {
    let mut g = small();
    let over = |g: &gsv::group::Group, part: &str| {
        let payload = header_only(g);
        match decode_group(&payload, &Decoding::at(&level())) {
            Err(Error::Limit { expected, .. }) => assert!(expected.contains(part), "{expected}"),
            other => panic!("{part}: {other:?}"),
        }
    };
    g.header.layers[0].count = 65_537;
    over(&g, "Gaussians");
    g = small();
    g.header.frames = 65;
    over(&g, "frames");
    g = small();
    g.header.nodes.count = 1025;
    over(&g, "nodes");
    assert!(matches!(Level::get(9), Err(Error::Limit { .. })));
}

fn header_only(g: &gsv::group::Group) -> Vec<u8> {
    let mut w = gsv::fields::Writer::default();
    g.header.clone().fields(&mut w, &mut Vec::new(), None).unwrap();
    unit::write(&w.0, &[]).unwrap()
}

/// Many trajectories from a few bytes: the cap on symbols is enforced during decoding.
#[test]
fn symbols_are_counted_while_they_grow() {
    let mut g = small();
    let mut level = level();
    level.symbols = g.header.check(&level, None).unwrap();
    let payload = encode_group(&g, None).unwrap();
    assert!(matches!(
        decode_group(&payload, &Decoding::at(&level)),
        Err(Error::Limit { .. })
    ));
    g.header.trajectories.clear();
    g.trajectories.clear();
    let payload = encode_group(&g, None).unwrap();
    assert!(decode_group(&payload, &Decoding::at(&level)).is_ok());
}

/// Reserved flags are refused; unknown unit types are skipped.
#[test]
fn later_versions() {
    let payload = encode_group(&small(), None).unwrap();
    let header = unit::split(&payload, ALL_LAYERS).unwrap()[0].payload.to_vec();
    for (flags, part) in [
        (3, "reserved flags"),
        (9, "reserved flags"),
        (4, "reserved flags"),
        (65, "reserved flags"), // a predicted group has the setting of its reference
        (128, "reserved flags"),
    ] {
        let mut header = header.clone();
        header[2] = flags;
        let bad = unit::write(&header, &[]).unwrap();
        let message = decode_group(&bad, &Decoding::at(&level())).unwrap_err().to_string();
        assert!(message.contains(part), "{message}");
    }
    let later = |number: u8, layer: u8, index: u16| Entry {
        number,
        layer,
        index,
        ..Entry::new((Tile, 0, 0), b"").unwrap()
    };
    for (entry, part) in [
        (later(7, 0, 9), ""),
        (later(5, 0, 1), "index of 0"),
        (later(6, 0, 0), "one unit of each"),
        (later(255, 3, 0), ""),
        (later(0, 0, 0), "no second"),
        (later(1, 0, 9), "announces"),
        (later(1, 0, 0), "one unit of each"),
        (later(2, 0, 1), "index of 0"),
        (later(4, 0, 3), "attribute 2 or 4"),
    ] {
        match decode_group(&with_directory(|units| units.push(entry)), &Decoding::at(&level())) {
            Ok(_) => assert!(part.is_empty(), "{entry:?}"),
            Err(e) => assert!(!part.is_empty() && e.to_string().contains(part), "{e}"),
        }
    }
}

/// The small group with another directory.
fn with_directory(edit: impl Fn(&mut Vec<Entry>)) -> Vec<u8> {
    let payload = encode_group(&small(), None).unwrap();
    let units = unit::split(&payload, ALL_LAYERS).unwrap();
    let (_, mut directory) = Header::open(units[0].payload).unwrap();
    edit(&mut directory);
    let mut w = gsv::fields::Writer::default();
    small().header.fields(&mut w, &mut directory, None).unwrap();
    let bodies: Vec<Vec<u8>> = units[1..].iter().map(|u| u.payload.to_vec()).collect();
    unit::write(&w.0, &bodies).unwrap()
}

/// Each rule on units.
#[test]
fn broken_units() {
    let fails = |payload: &[u8], part: &str| {
        let message = decode_group(payload, &Decoding::at(&level())).unwrap_err().to_string();
        assert!(message.contains(part), "{message}");
    };
    fails(
        &with_directory(|units| units[0].layer = 1),
        "layers in increasing order",
    );
    fails(&with_directory(|units| units[1].size += 1), "CRC-32");
    fails(&with_directory(|units| _ = units.pop()), "the end of the group");
    fails(
        &with_directory(|units| units.last_mut().unwrap().size += 1),
        "more bytes",
    );
    fails(
        &with_directory(|units| units[0].number = 77),
        "a unit tile 0, found none",
    );
    fails(&[], "4 more bytes");
    fails(&[0; 8], "2 more bytes");
    fails(&[1; 8], "more bytes");
}

/// Each rule on the streams of a tile.
#[test]
fn broken_tiles() {
    let fails = |edit: fn(&mut Vec<u8>), part: &str| {
        let payload = encode_group(&small(), None).unwrap();
        let mut units = unit::split(&payload, ALL_LAYERS).unwrap();
        let mut tile = units[1].payload.to_vec();
        edit(&mut tile);
        units[1].payload = &tile;
        let message = decode_units(&units, &Decoding::at(&level())).unwrap_err().to_string();
        assert!(message.contains(part) && message.contains("tile 0"), "{message}");
    };
    fails(|t| t.clear(), "the size of a stream");
    fails(|t| t[..6].fill(0xFF), "of at most 5 bytes");
    fails(|t| t[0] = 0x7F, "found");
    fails(|t| t.extend([1; 8]), "lifetimes: expected the payload to end");
}
