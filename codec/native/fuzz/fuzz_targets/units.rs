//! The entropy decoders below the checksum: a valid group with other bytes in the payload of one unit, then a frame of
//! it. The groups: an independent one, one with layers, and one predicted from the layered one. The payload is any
//! bytes, or its own bytes with a piece replaced. The level is low: a changed header announces little, so that inputs
//! stay fast.
#![no_main]

use gsv::decode::{Decoding, decode_units};
use gsv::evaluate::Evaluator;
use gsv::parametric::Frame;
use gsv::group::Group;
use gsv::levels::{LEVELS, Level};
use gsv::unit::{self, ALL_LAYERS};
use libfuzzer_sys::fuzz_target;
use std::sync::LazyLock;

/// Written by `cargo test -p gsv --test seed -- --ignored`.
const SEEDS: [&[u8]; 3] = [
    include_bytes!("../seed.bin"),
    include_bytes!("../layered.bin"),
    include_bytes!("../predicted.bin"),
];
const LOW: Level = Level {
    gaussians: 1 << 11,
    nodes: 1 << 6,
    pairs: 1 << 15,
    symbols: 1 << 15,
    ..LEVELS[0]
};
static REFERENCE: LazyLock<Group> = LazyLock::new(|| {
    let units = unit::split(SEEDS[1], ALL_LAYERS).expect("the seed is sound");
    decode_units(&units, &Decoding::at(&LOW)).expect("a group")
});

fuzz_target!(init: fuzz::one_thread(), |input: (u8, u8, Option<u16>, &[u8])| {
    let (how, victim, at, data) = input;
    let (seed, layers) = (usize::from(how) % 3, 1 + usize::from(how) / 3 % 3);
    let how = Decoding {
        reference: (seed == 2).then(|| &*REFERENCE),
        layers,
        ..Decoding::at(&LOW)
    };
    let mut units = unit::split(SEEDS[seed], layers).expect("the seed is sound");
    let victim = usize::from(victim) % units.len();
    let mut payload = units[victim].payload.to_vec();
    let start = at.map_or(0, |at| usize::from(at) % (payload.len() + 1));
    let end = at.map_or(payload.len(), |_| payload.len().min(start + data.len()));
    payload.splice(start..end, data.iter().copied());
    units[victim].payload = &payload;
    if let Ok(group) = decode_units(&units, &how) {
        group.validate(how.reference).expect("a group");
        Evaluator::new(group).frame(1, &mut Frame::default());
    }
});
