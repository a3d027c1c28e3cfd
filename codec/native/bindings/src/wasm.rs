//! The decoder and rasterizer for the web player: plain exports over numbers, without a glue generator.
//!
//! Each worker has one instance: a demuxer, a few decoded groups, a rasterizer, and the buffers `input`, `splats` and
//! `output`. The host writes to the address that `input` or `splats` returns, calls an export, and reads `output`,
//! `pixels` or a band. Any call may move the memory, so an address is valid until the next call. Exports that can fail
//! return false and leave a message in `output`. Nothing here is unsafe: only the host accesses the memory.

mod pack;
mod player;
mod text;

use gsv::container::demux::Demuxer;
use player::Player;
use raster::Size;
use std::cell::RefCell;

thread_local! {
    static PLAYER: RefCell<Player> = RefCell::new(Player::default());
}

fn with<R>(f: impl FnOnce(&mut Player) -> R) -> R {
    PLAYER.with_borrow_mut(f)
}

/// Allocates room for `length` bytes of input.
#[unsafe(no_mangle)]
pub extern "C" fn input(length: usize) -> *mut u8 {
    with(|p| {
        p.input.clear();
        p.input.resize(length, 0);
        p.input.as_mut_ptr()
    })
}

/// Allocates room for flags of `count` tiles, layer by layer: whether the next `decode` decodes the tile. Without
/// flags: all.
#[unsafe(no_mangle)]
pub extern "C" fn wanted(count: usize) -> *mut u8 {
    with(|p| {
        p.wanted = vec![0; count];
        p.wanted.as_mut_ptr()
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

/// Reads the gsv track `number` of the file, from 0 on; called before the first `push`.
#[unsafe(no_mangle)]
pub extern "C" fn track(number: usize) {
    with(|p| p.demuxer = Demuxer::of_track(number));
}

/// Output: the transform of the track at time `u` of the scene, in units of its timescale: rotation (wxyz),
/// translation, scale, f32.
#[unsafe(no_mangle)]
pub extern "C" fn pose(u: f64) {
    with(|p| p.pose(u));
}

/// File offset of the next byte to push.
#[unsafe(no_mangle)]
pub extern "C" fn position() -> f64 {
    with(|p| p.demuxer.position() as f64)
}

/// Number of bytes from that offset on that need not be pushed.
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

/// Input: the payload of a group, or its start up to the end of the first `layers` layers. The group goes to `slot`;
/// the reference of a predicted group is in the slot `reference`. `keep_leading`: leading tiles that were decoded only
/// for their models stay. `packed`: the payload omits the bytes of tiles that are not decoded. Output: its header as
/// JSON.
#[unsafe(no_mangle)]
pub extern "C" fn decode(slot: usize, level: u8, reference: u8, layers: u8, keep_leading: bool, packed: bool) -> bool {
    with(|p| p.decode(slot, [level, reference, layers], keep_leading, packed))
}

/// Input: the header of its reference in the first `first` bytes, if the group is predicted, then the header of a group
/// with the eight bytes before it. Output: its tiles and the positions of its units as JSON.
#[unsafe(no_mangle)]
pub extern "C" fn index(first: usize) -> bool {
    with(|p| p.index(first))
}

/// Input: the payload of a group, or its start. Returns how many groups back it refers; 0: independent; -1: damaged.
#[unsafe(no_mangle)]
pub extern "C" fn reference() -> i32 {
    with(Player::reference)
}

#[unsafe(no_mangle)]
pub extern "C" fn release(slot: usize) {
    with(|p| p.release(slot));
}

/// Evaluates frame `t` of the group in `slot`, unless it is the last evaluated frame of the group. Input: a transform
/// that places it, as in `pose`, or nothing; with a scale of 0 nothing is shown.
#[unsafe(no_mangle)]
pub extern "C" fn frame(slot: usize, t: u16) -> bool {
    with(|p| p.frame(slot, t))
}

/// Input: means as f32. Output: their box from the 1st to the 99th percentile, 6 f32.
#[unsafe(no_mangle)]
pub extern "C" fn bounds() {
    with(Player::bounds);
}

/// Output: an attribute of the evaluated frame as f32, in the order of `codec.model.gaussians.Gaussians`.
#[unsafe(no_mangle)]
pub extern "C" fn attribute(which: usize) {
    with(|p| p.attribute(which));
}

/// Projects the evaluated frame. Input: 20 f32: width, height, fx, fy, cx, cy, 12 of world-to-camera, near plane,
/// low-pass; then the ends of the bands as `divide` gives them, or nothing. Returns the number of bands, at most
/// `bands`, or 0. Output: the load of each row of tiles.
#[unsafe(no_mangle)]
pub extern "C" fn project(bands: usize) -> usize {
    with(|p| p.project(bands))
}

/// Input: the load of each row of tiles, f32, summed over all instances that project parts of an image. Output: the
/// ends of at most `bands` bands of about the same load, f32.
#[unsafe(no_mangle)]
pub extern "C" fn divide(bands: usize) {
    with(|p| p.divide(bands));
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

/// Input: as for `project`. Output: the visible Gaussians of the evaluated frame, or all that are not transparent, in
/// the format of Spark, relative to an origin; their colours are those of the view.
#[unsafe(no_mangle)]
pub extern "C" fn pack(x: f32, y: f32, z: f32, all: bool) -> bool {
    with(|p| p.pack([x, y, z], all))
}

/// Bytes of one element of a band.
#[unsafe(no_mangle)]
pub extern "C" fn splat_size() -> usize {
    size_of::<raster::Projected>()
}

/// Allocates room for a band of another instance.
#[unsafe(no_mangle)]
pub extern "C" fn splats(count: usize) -> *mut u8 {
    with(|p| p.splats(count))
}

/// Draws the Gaussians in `splats` over a background.
#[unsafe(no_mangle)]
pub extern "C" fn draw(width: usize, height: usize, red: f32, green: f32, blue: f32) -> bool {
    with(|p| p.draw(Size { width, height }, [red, green, blue]))
}

/// [height, width, 4] u8: the drawn image.
#[unsafe(no_mangle)]
pub extern "C" fn pixels() -> *const u8 {
    with(|p| p.pixels.as_ptr().cast())
}

/// Chooses the instruction set by its index in `raster::SimdLevel::available`; for tests and measurements.
#[unsafe(no_mangle)]
pub extern "C" fn use_level(i: usize) -> bool {
    with(|p| p.use_level(i))
}
