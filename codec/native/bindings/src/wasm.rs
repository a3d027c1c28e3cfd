//! The decoder and rasterizer for the web player: plain exports over numbers, no glue generator.
//!
//! An instance is one worker's: it has one demuxer, a few decoded groups, one rasterizer, and three buffers through which
//! bytes pass (`input`, `splats`, `output`). The host writes where `input` or `splats` tell it to, calls, and reads `output`,
//! `pixels` or a band; any call may move the memory, so addresses hold until the next one. Calls that can fail return
//! false and leave a message in `output`. Nothing here is unsafe: the host touches memory only from outside.

mod pack;
mod player;
mod text;

use player::Player;
use std::cell::RefCell;

thread_local! {
    static PLAYER: RefCell<Player> = RefCell::new(Player::default());
}

fn with<R>(f: impl FnOnce(&mut Player) -> R) -> R {
    PLAYER.with_borrow_mut(f)
}

/// Room for `length` bytes of input.
#[unsafe(no_mangle)]
pub extern "C" fn input(length: usize) -> *mut u8 {
    with(|p| {
        p.input.clear();
        p.input.resize(length, 0);
        p.input.as_mut_ptr()
    })
}

#[unsafe(no_mangle)]
pub extern "C" fn output() -> *const u8 {
    with(|p| p.output.as_ptr())
}

#[unsafe(no_mangle)]
pub extern "C" fn output_length() -> usize {
    with(|p| p.output.len())
}

/// Input: the next bytes of the file.
#[unsafe(no_mangle)]
pub extern "C" fn push() -> bool {
    with(Player::push)
}

/// Where the next byte that is pushed is taken to come from.
#[unsafe(no_mangle)]
pub extern "C" fn position() -> f64 {
    with(|p| p.demuxer.position() as f64)
}

/// Bytes from there that need not be pushed.
#[unsafe(no_mangle)]
pub extern "C" fn skippable() -> f64 {
    with(|p| p.demuxer.skippable() as f64)
}

#[unsafe(no_mangle)]
pub extern "C" fn skip(bytes: f64) {
    with(|p| p.demuxer.skip(bytes as u64));
}

#[unsafe(no_mangle)]
pub extern "C" fn seek(position: f64) {
    with(|p| p.demuxer.seek(position as u64));
}

/// Output: config, groups from `first` on, index, as JSON.
#[unsafe(no_mangle)]
pub extern "C" fn describe(first: usize) {
    with(|p| p.describe(first));
}

/// Input: a group's payload, or what precedes its layers behind the first `layers`. It goes to `slot`; the group that it
/// refers to, if it is a predicted one, is in the slot `reference`. Output: its header as JSON.
#[unsafe(no_mangle)]
pub extern "C" fn decode(slot: usize, level: u8, reference: usize, layers: usize) -> bool {
    with(|p| p.decode(slot, level, reference, layers))
}

/// Input: a group's payload, or the start of one. How many groups back it refers, 0: it is independent; -1: it is damaged.
#[unsafe(no_mangle)]
pub extern "C" fn reference() -> i32 {
    with(Player::reference)
}

#[unsafe(no_mangle)]
pub extern "C" fn release(slot: usize) {
    with(|p| p.release(slot));
}

/// Evaluates frame `t` of the group in `slot`.
#[unsafe(no_mangle)]
pub extern "C" fn frame(slot: usize, t: u16) -> bool {
    with(|p| p.frame(slot, t))
}

/// Output: the box from the 1st to the 99th percentile of the means of the evaluated frame, 6 f32.
#[unsafe(no_mangle)]
pub extern "C" fn bounds() {
    with(Player::bounds);
}

/// Output: an attribute of the evaluated frame as f32, in the order of `codec.gaussians.Gaussians`: for tests.
#[unsafe(no_mangle)]
pub extern "C" fn attribute(which: usize) {
    with(|p| p.attribute(which));
}

/// Projects the evaluated frame. Input: 18 f32: width, height, fx, fy, cx, cy, 12 of world-to-camera. Returns the number of
/// bands, at most `bands`, or 0.
#[unsafe(no_mangle)]
pub extern "C" fn project(bands: usize) -> usize {
    with(|p| p.project(bands))
}

#[unsafe(no_mangle)]
pub extern "C" fn band(i: usize) -> *const u8 {
    with(|p| p.band(i).map_or(std::ptr::null(), |b| b.splats.as_ptr().cast()))
}

#[unsafe(no_mangle)]
pub extern "C" fn band_splats(i: usize) -> usize {
    with(|p| p.band(i).map_or(0, |b| b.splats.len()))
}

#[unsafe(no_mangle)]
pub extern "C" fn band_first(i: usize) -> usize {
    with(|p| p.band(i).map_or(0, |b| b.first))
}

#[unsafe(no_mangle)]
pub extern "C" fn band_rows(i: usize) -> usize {
    with(|p| p.band(i).map_or(0, |b| b.rows))
}

/// Input: as for `project`. Output: what it shows of the evaluated frame as Spark takes it, relative to an origin.
#[unsafe(no_mangle)]
pub extern "C" fn pack(x: f32, y: f32, z: f32) -> bool {
    with(|p| p.pack([x, y, z]))
}

/// Bytes of one element of a band.
#[unsafe(no_mangle)]
pub extern "C" fn splat_size() -> usize {
    size_of::<raster::Projected>()
}

/// Room for a band of another instance.
#[unsafe(no_mangle)]
pub extern "C" fn splats(count: usize) -> *mut u8 {
    with(|p| p.splats(count))
}

/// Draws those over a background.
#[unsafe(no_mangle)]
pub extern "C" fn draw(width: usize, height: usize, red: f32, green: f32, blue: f32) -> bool {
    with(|p| p.draw([width, height], [red, green, blue]))
}

/// [height, width, 4] u8: what was drawn.
#[unsafe(no_mangle)]
pub extern "C" fn pixels() -> *const u8 {
    with(|p| p.pixels.as_ptr().cast())
}

/// Chooses the instruction set by its place among `raster::SimdLevel::available`; for tests and measurements.
#[unsafe(no_mangle)]
pub extern "C" fn use_level(i: usize) -> bool {
    with(|p| p.use_level(i))
}
