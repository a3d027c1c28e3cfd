//! Writes the valid groups that the fuzz targets start from.

mod common;

use common::{group, layered, predicted, small, with};
use gsv::decode::{Decoding, decode_group};
use gsv::encode::encode_group;
use gsv::levels::LEVELS;

fn read(name: &str) -> Vec<u8> {
    std::fs::read(format!("{}/../fuzz/{name}.bin", env!("CARGO_MANIFEST_DIR"))).unwrap()
}

#[test]
fn the_seeds_are_sound() {
    let how = Decoding::at(&LEVELS[0]);
    decode_group(&read("seed"), &how).unwrap();
    let reference = decode_group(&read("layered"), &how).unwrap();
    decode_group(&read("predicted"), &with(&reference)).unwrap();
}

#[test]
#[ignore = "writes the seeds: run when the syntax changes"]
fn write_the_seeds() {
    let reference = group(&layered());
    let later = predicted(&reference, &layered());
    for (name, group, reference) in [
        ("seed", &small(), None),
        ("layered", &reference, None),
        ("predicted", &later, Some(&reference)),
    ] {
        let path = format!("{}/../fuzz/{name}.bin", env!("CARGO_MANIFEST_DIR"));
        std::fs::write(path, encode_group(group, reference).unwrap()).unwrap();
    }
}
