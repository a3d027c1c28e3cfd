//! The entropy decoders below the checksum: any bytes as the payload of one unit of a sound group, then a frame of it.
//! The groups: an independent one, one with layers, and one that is predicted from that.
#![no_main]

use gsv::decode::{Decoding, decode_units};
use gsv::evaluate::Evaluator;
use gsv::parametric::Frame;
use gsv::group::Group;
use gsv::levels::LEVELS;
use gsv::unit::{self, ALL_LAYERS};
use libfuzzer_sys::fuzz_target;
use std::sync::LazyLock;

/// Written by `cargo test -p gsv --test seed -- --ignored`.
const SEEDS: [&[u8]; 3] = [
    include_bytes!("../seed.bin"),
    include_bytes!("../layered.bin"),
    include_bytes!("../predicted.bin"),
];
static REFERENCE: LazyLock<Group> = LazyLock::new(|| {
    let units = unit::split(SEEDS[1], ALL_LAYERS).expect("the seed is sound");
    decode_units(&units, &Decoding::at(&LEVELS[0])).expect("a group")
});

fuzz_target!(|input: (u8, u8, &[u8])| {
    let (seed, layers) = (usize::from(input.0) % 3, 1 + usize::from(input.0) / 3 % 3);
    let how = Decoding {
        reference: (seed == 2).then(|| &*REFERENCE),
        layers,
        ..Decoding::at(&LEVELS[0])
    };
    let mut units = unit::split(SEEDS[seed], layers).expect("the seed is sound");
    let victim = usize::from(input.1) % units.len();
    units[victim].payload = input.2;
    if let Ok(group) = decode_units(&units, &how) {
        group.validate(how.reference).expect("a group");
        Evaluator::new(group).frame(1, &mut Frame::default());
    }
});
