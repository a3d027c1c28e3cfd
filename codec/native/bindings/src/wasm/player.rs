//! The state of an instance, and the bodies of its exports.

use super::{pack, text};
use gsv::attributes::sh_coefficients;
use gsv::container::demux::Demuxer;
use gsv::decode::{Decoding, decode_group, read_header, reference_of};
use gsv::error::Error;
use gsv::evaluate::Evaluator;
use gsv::group::Group;
use gsv::harmonics;
use gsv::header::Header;
use gsv::levels::{LEVELS, Level};
use gsv::parametric::Frame;
use gsv::pose::Pose;
use gsv::unit;
use raster::{Background, Band, Bands, Projected, Rasterizer, SimdLevel, Size, Splats, Surface, View, band_ends};
use std::fmt::Display;

/// Most pixels of an image, 4096 x 4096: a failed allocation would end the instance.
const MAX_PIXELS: usize = 1 << 24;
/// Slots for decoded groups and parts of them.
const SLOTS: usize = 255;

/// A group, and the frame of it that was evaluated last.
struct Slot {
    group: Evaluator,
    frame: Frame,
    turns: Vec<[f32; 4]>,        // rotations still to be applied to its harmonics; empty: none
    at: Option<(u16, Vec<f32>)>, // frame number and transform of `frame`
}

impl Slot {
    /// Rotates the harmonics of the frame; the rasterizer can rotate them itself at lower cost.
    fn turn_harmonics(&mut self) {
        harmonics::turn(&mut self.frame.sh_n, &self.turns);
        self.turns.clear();
    }
}

pub struct Player {
    pub demuxer: Demuxer,
    pub input: Vec<u8>,
    /// Which tiles `decode` decodes, one byte each, layer by layer; empty: all.
    pub wanted: Vec<u8>,
    pub output: Vec<u8>,
    groups: Vec<Option<Slot>>,
    shown: usize, // slot of the evaluated frame
    raster: Rasterizer,
    bands: Bands,
    splats: Vec<Projected>,
    pub pixels: Vec<[u8; 4]>,
}

impl Default for Player {
    fn default() -> Self {
        Player {
            demuxer: Demuxer::default(),
            input: Vec::new(),
            wanted: Vec::new(),
            output: Vec::new(),
            groups: (0..SLOTS).map(|_| None).collect(),
            shown: 0,
            raster: Rasterizer::new(SimdLevel::best(), 0),
            bands: Bands::default(),
            splats: Vec::new(),
            pixels: Vec::new(),
        }
    }
}

impl Player {
    /// Returns true, or false with the message in `output`.
    fn done<T>(&mut self, result: Result<T, impl Display>) -> bool {
        if let Err(e) = &result {
            self.output = e.to_string().into_bytes();
        }
        result.is_ok()
    }

    pub fn push(&mut self) -> bool {
        let result = self.demuxer.push(&self.input);
        self.done(result)
    }

    pub fn describe(&mut self, first: usize) {
        self.output = text::describe(&self.demuxer, first).into_bytes();
    }

    /// Decodes the input to `slot`. The reference of a predicted group is in the slot `reference`. `keep_leading`,
    /// `packed`: as in `Decoding`.
    pub fn decode(&mut self, slot: usize, how: [u8; 3], keep_leading: bool, packed: bool) -> bool {
        let [level, reference, layers] = how;
        let wanted = std::mem::take(&mut self.wanted);
        let decoded = Level::get(level).and_then(|caps| {
            let mut how = Decoding {
                level: &caps,
                reference: self
                    .groups
                    .get(usize::from(reference))
                    .and_then(Option::as_ref)
                    .map(|slot| slot.group.group()),
                layers: usize::from(layers),
                tiles: None,
                keep_leading,
                packed,
            };
            if wanted.is_empty() {
                return decode_group(&self.input, &how);
            }
            let tiles = by_layer(&wanted, &read_header(&self.input, &how)?);
            how.tiles = Some(&tiles);
            decode_group(&self.input, &how)
        });
        self.input = Vec::new();
        self.release(slot);
        let Some(place) = self.groups.get_mut(slot) else {
            return self.done(Err::<(), _>(format!("expected a slot below {SLOTS}")));
        };
        match decoded {
            Err(e) => self.done(Err::<(), _>(e)),
            Ok(group) => {
                self.output = text::header(&group.header, group.positions.len()).into_bytes();
                *place = Some(Slot {
                    group: Evaluator::new(group),
                    frame: Frame::default(),
                    turns: Vec::new(),
                    at: None,
                });
                true
            }
        }
    }

    /// How many groups back the group in the input refers; -1 with the message in `output` if that is unknown.
    pub fn reference(&mut self) -> i32 {
        let result = reference_of(&self.input);
        let back = result.as_ref().map_or(-1, |back| i32::from(*back));
        self.done(result);
        back
    }

    /// Describes the units of a group. Input: the header of its reference in the first `first` bytes, if it is
    /// predicted, then its own.
    pub fn index(&mut self, first: usize) -> bool {
        let (before, own) = self.input.split_at(first.min(self.input.len()));
        match describe_units(before, own) {
            Ok(text) => self.output = text.into_bytes(),
            Err(e) => return self.done(Err::<(), _>(e)),
        }
        true
    }

    pub fn release(&mut self, slot: usize) {
        if let Some(place) = self.groups.get_mut(slot) {
            *place = None;
        }
    }

    pub fn frame(&mut self, slot: usize, t: u16) -> bool {
        let Some(Some(own)) = self.groups.get_mut(slot) else {
            self.output = b"no group in this slot".to_vec();
            return false;
        };
        self.shown = slot;
        let now = (t, numbers(&self.input));
        if own.at.as_ref() == Some(&now) {
            return true;
        }
        own.turns = own.group.frame_at_rest(t, &mut own.frame);
        let visible = own.group.visible(t).into_iter().flatten();
        for (logit, shown) in own.frame.logit_opacities.iter_mut().zip(visible) {
            if !shown {
                *logit = f32::NEG_INFINITY; // the projection leaves it out
            }
        }
        if let Some(transform) = now.1.first_chunk() {
            own.turn_harmonics();
            place(&mut own.frame, *transform);
        }
        own.at = Some(now);
        true
    }

    pub fn pose(&mut self, u: f64) {
        let pose = self.demuxer.config().map_or(Pose::default(), |c| c.placement.pose(u));
        let ([w, x, y, z], [a, b, c]) = (pose.rotation, pose.translation);
        self.output = floats(&[w, x, y, z, a, b, c, pose.scale]);
    }

    pub fn bounds(&mut self) {
        let means = numbers(&self.input);
        let mut out = [0.0f32; 6];
        for axis in 0..3 {
            let mut values: Vec<f32> = means.iter().skip(axis).step_by(3).copied().collect();
            if values.is_empty() {
                values.extend([0.0, 1.0]);
            }
            let last = values.len() - 1;
            for (i, share) in [0.01, 0.99].into_iter().enumerate() {
                let at = (last as f64 * share).round() as usize;
                out[3 * i + axis] = *values.select_nth_unstable_by(at, f32::total_cmp).1;
            }
        }
        self.output = floats(&out);
    }

    pub fn attribute(&mut self, which: usize) {
        let Some(Some(own)) = self.groups.get_mut(self.shown) else {
            return self.output.clear();
        };
        if which > 4 {
            own.turn_harmonics();
        }
        let f = &own.frame;
        self.output = floats(match which {
            0 => f.means.as_flattened(),
            1 => f.quats.as_flattened(),
            2 => &f.log_scales,
            3 => &f.logit_opacities,
            4 => &f.sh0,
            _ => &f.sh_n,
        });
    }

    pub fn project(&mut self, bands: usize) -> usize {
        let input = numbers(&self.input);
        let (view, shown) = (view(&input), self.groups.get(self.shown));
        let given: Vec<usize> = input.iter().skip(VIEW).map(|v| *v as usize).collect();
        let size = view.size;
        let drawn = self.raster.project(&splats(shown), &view);
        let drawn = drawn.map(|projected| match given.is_empty() {
            true => self.bands.split(projected, size, bands).len(),
            false => self.bands.split_at(projected, size, &given).len(),
        });
        let count = *drawn.as_ref().unwrap_or(&0);
        self.output = floats(self.bands.load());
        self.done(drawn);
        count
    }

    /// Input: the load of each row of tiles. Output: the ends of `count` bands.
    pub fn divide(&mut self, count: usize) {
        let ends = band_ends(&numbers(&self.input), count);
        self.output = floats(&ends.iter().map(|end| *end as f32).collect::<Vec<_>>());
    }

    pub fn pack(&mut self, origin: [f32; 3], all: bool) -> bool {
        let shown = self.groups.get(self.shown);
        self.output.clear();
        let drawn = self.raster.project(&splats(shown), &view(&numbers(&self.input)));
        let packed = drawn.map(|projected| {
            if let Some(Some(slot)) = shown {
                pack::pack(&slot.frame, projected, origin, all, &mut self.output);
            }
        });
        self.done(packed)
    }

    pub fn band(&self, i: usize) -> Option<&Band> {
        self.bands.bands.get(i)
    }

    pub fn splats(&mut self, count: usize) -> *mut u8 {
        self.splats.resize(count, Projected::default());
        self.splats.as_mut_ptr().cast()
    }

    pub fn draw(&mut self, size: Size, background: [f32; 3]) -> bool {
        let (background, splats) = (Background::new(background), &mut self.splats);
        self.pixels
            .resize(size.width.saturating_mul(size.height).min(MAX_PIXELS), [255; 4]);
        let surface = Surface::Rgba(&mut self.pixels);
        let drawn = self
            .raster
            .draw(surface, size, background, |p| std::mem::swap(p, splats));
        self.done(drawn)
    }

    pub fn use_level(&mut self, i: usize) -> bool {
        let level = SimdLevel::available().get(i).copied();
        if let Some(level) = level {
            self.raster = Rasterizer::new(level, 0);
        }
        level.is_some()
    }
}

/// `text::index` of a header; `before`: the header of its reference, or nothing.
fn describe_units(before: &[u8], own: &[u8]) -> Result<String, Error> {
    let mut how = Decoding::at(&LEVELS[LEVELS.len() - 1]);
    let mut reference = Group::default();
    if !before.is_empty() {
        reference.header = read_header(before, &how)?;
        how.reference = Some(&reference);
    }
    let first = unit::first(own)?;
    let (_, directory) = Header::open(first.payload)?;
    Ok(text::index(
        &read_header(own, &how)?,
        &directory,
        first.offset + first.size,
    ))
}

/// The frame of a slot; none without one.
fn splats(slot: Option<&Option<Slot>>) -> Splats<'_> {
    let Some(Some(Slot {
        frame: f, group, turns, ..
    })) = slot
    else {
        return Splats::default();
    };
    let sh_k = sh_coefficients(group.group().header.sh_degree);
    Splats {
        means: f.means.as_flattened(),
        quats: f.quats.as_flattened(),
        log_scales: &f.log_scales,
        logit_opacities: &f.logit_opacities,
        sh0: &f.sh0,
        sh_n: &f.sh_n,
        sh_k,
        turns: turns.as_flattened(),
    }
}

/// Places a frame by a transform as in `Player::pose`.
fn place(frame: &mut Frame, [w, x, y, z, a, b, c, scale]: [f32; 8]) {
    if scale > 0.0 {
        let pose = Pose {
            rotation: [w, x, y, z],
            translation: [a, b, c],
            scale,
        };
        pose.apply(frame.as_mut());
    } else {
        frame.logit_opacities.fill(f32::NEG_INFINITY); // the projection leaves them out
    }
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn numbers(bytes: &[u8]) -> Vec<f32> {
    bytes
        .as_chunks::<4>()
        .0
        .iter()
        .map(|b| f32::from_le_bytes(*b))
        .collect()
}

/// Flags of tiles, layer by layer; missing ones are false.
fn by_layer(wanted: &[u8], h: &Header) -> Vec<Vec<bool>> {
    let mut flags = wanted.iter().map(|v| *v != 0);
    let layer = |tiles: &Vec<_>| tiles.iter().map(|_| flags.next().unwrap_or(false)).collect();
    h.tiles.iter().map(layer).collect()
}

/// Numbers of a view.
const VIEW: usize = 20;

/// A view from its first numbers; missing ones are 0, which the rasterizer refuses.
fn view(numbers: &[f32]) -> View {
    let mut v = [0.0f32; VIEW];
    v.iter_mut().zip(numbers).for_each(|(v, number)| *v = *number);
    let (width, height) = (v[0] as usize, v[1] as usize);
    let m = |i: usize, j: usize| v[6 + 4 * i + j];
    View {
        size: Size { width, height },
        focal: [v[2], v[3]],
        center: [v[4], v[5]],
        rotation: std::array::from_fn(|i| std::array::from_fn(|j| m(i, j))),
        translation: std::array::from_fn(|i| m(i, 3)),
        near: v[18],
        low_pass: v[19],
    }
}
