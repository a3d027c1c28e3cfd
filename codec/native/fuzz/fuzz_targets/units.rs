//! The entropy decoders below the checksum: any bytes as the payload of one unit of a sound group, then a frame of it.
#![no_main]

use gsv::decode::decode_units;
use gsv::evaluate::{Evaluator, Frame};
use gsv::levels::LEVELS;
use gsv::unit;
use libfuzzer_sys::fuzz_target;

/// Written by `cargo test -p gsv --test seed -- --ignored`.
const SEED: &[u8] = include_bytes!("../seed.bin");

fuzz_target!(|input: (u8, &[u8])| {
    let mut units = unit::split(SEED).expect("the seed is sound");
    let victim = usize::from(input.0) % units.len();
    units[victim].payload = input.1;
    if let Ok(group) = decode_units(&units, &LEVELS[0]) {
        group.validate().expect("a group");
        Evaluator::new(group).frame(1, &mut Frame::default());
    }
});
