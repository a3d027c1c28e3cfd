//! Damaged bytes give an error or, below the checksum, some group; never a panic, an endless loop or too much memory.

mod common;

use common::{Random, group, small};
use gsv::decode::{Decoding, decode_group, decode_units};
use gsv::encode::encode_group;
use gsv::error::Error;
use gsv::levels::Level;
use gsv::unit::{self, ALL_LAYERS};

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
            // what is left may be whole units: then one is missing, unless only the optional last one is
            Ok(g) => assert!(g.lifetimes.is_none()),
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
    g.header.layers[0].count = u32::MAX;
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
    let mut out = Vec::new();
    unit::write(&mut out, [0; 3], &[], &w.0).unwrap();
    out
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
    let mut header = unit::split(&payload, ALL_LAYERS).unwrap()[0].payload.to_vec();
    for (flags, part) in [
        (1, "refers to"),
        (3, "reserved flags"),
        (9, "reserved flags"),
        (16, "reserved flags"),
    ] {
        header[2] = flags | header[2] & 4;
        let mut bad = Vec::new();
        unit::write(&mut bad, [0; 3], &[], &header).unwrap();
        let message = decode_group(&bad, &Decoding::at(&level())).unwrap_err().to_string();
        assert!(message.contains(part), "{message}");
    }
    for (number, part) in [(7, ""), (8, "announces"), (10, ""), (255, "")] {
        let mut more = payload.clone();
        unit::write(&mut more, [number, 0, 0], &[], b"later").unwrap();
        match decode_group(&more, &Decoding::at(&level())) {
            Ok(_) => assert!(part.is_empty(), "{number}"),
            Err(e) => assert!(!part.is_empty() && e.to_string().contains(part), "{e}"),
        }
    }
}

/// Each rule on units.
#[test]
fn broken_units() {
    let payload = encode_group(&small(), None).unwrap();
    let first = unit::split(&payload, ALL_LAYERS).unwrap()[0].size;
    let with = |number, attribute, dependencies: &[u8], part: &str| {
        let mut bad = header_only(&small());
        unit::write(&mut bad, [number, 0, attribute], dependencies, b"").unwrap();
        let message = decode_group(&bad, &Decoding::at(&level())).unwrap_err().to_string();
        assert!(message.contains(part), "{message}");
    };
    with(0, 0, &[], "no other");
    with(1, 0, &[1], "earlier units");
    with(1, 0, &[0, 0], "earlier units");
    with(1, 3, &[], "attribute of");
    with(2, 2, &[], "found none");
    with(1, 0, &[], "a node_positions unit");
    let twice = [payload.as_slice(), &payload[first..]].concat();
    assert!(
        decode_group(&twice, &Decoding::at(&level()))
            .unwrap_err()
            .to_string()
            .contains("one unit of each")
    );
    assert!(decode_group(&[], &Decoding::at(&level())).is_err());
    assert!(
        decode_group(&payload[first..], &Decoding::at(&level()))
            .unwrap_err()
            .to_string()
            .contains("group header")
    );
}
