//! The sound group that fuzz/fuzz_targets/units.rs starts from.

mod common;

const PATH: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../fuzz/seed.bin");

#[test]
fn the_seed_is_sound() {
    let payload = std::fs::read(PATH).unwrap();
    gsv::decode::decode_group(&payload, &gsv::decode::Decoding::at(&gsv::levels::LEVELS[0])).unwrap();
}

#[test]
#[ignore = "writes the seed: run when the syntax changes"]
fn write_the_seed() {
    std::fs::write(PATH, gsv::encode::encode_group(&common::small(), None).unwrap()).unwrap();
}
