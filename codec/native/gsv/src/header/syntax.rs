//! The syntax of the group header (spec 4): one description reads and writes the fields, and checks them.

use super::{Header, LAYERS_MAX, LayerHeader, SHIFT_MAX, Scale, TILE_SIDES, TileHeader, TrajectoryHeader};
use crate::attributes::Attribute;
use crate::blend::NEIGHBORS_MAX;
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader};
use crate::levels::LEVELS;
use crate::unit::Entry;

const FLAG_PREDICTED: u8 = 1;
const FLAG_COMPANDING: u8 = 2;
const FLAG_LAYER_SHIFTS: u8 = 8;
const FLAG_LIFETIMES: u8 = 16;
const FLAG_RIG: u8 = 32;
const FLAG_TURNED: u8 = 64;

impl Header {
    /// Parses the payload of unit 0. `reference`: the header of the group that a predicted one refers to.
    pub fn read(payload: &[u8], reference: Option<&Header>) -> Result<Header> {
        let mut h = Header::default();
        let mut r = Reader::new(payload);
        h.fields(&mut r, &mut Vec::new(), reference)?;
        let rest = r.rest();
        r.must(rest == 0, || {
            format!("the end of the group header, found {rest} more bytes")
        })?;
        Ok(h)
    }

    /// The first fields of a header: the reference (groups back, 0: independent), and the directory of the units.
    pub fn open(payload: &[u8]) -> Result<(u16, Vec<Entry>)> {
        let (mut h, mut units) = (Header::default(), Vec::new());
        h.opening(&mut Reader::new(payload), &mut units)?;
        Ok((h.reference, units))
    }

    /// Reads or writes all fields, and checks them. `units`: the directory.
    pub fn fields<F: Fields>(&mut self, f: &mut F, units: &mut Vec<Entry>, reference: Option<&Header>) -> Result<()> {
        self.opening(f, units)?;
        if self.reference > 0 {
            let Some(r) = reference.filter(|r| r.reference == 0) else {
                return f.fail("the independent group that this predicted one refers to".into());
            };
            self.layers(f, Some(r))?;
            *self = Header {
                frames: self.frames,
                reference: self.reference,
                lifetimes: self.lifetimes,
                layers: std::mem::take(&mut self.layers),
                tiles: std::mem::take(&mut self.tiles),
                trajectories: std::mem::take(&mut self.trajectories),
                nodes: self.nodes,
                rig: self.rig,
                ..r.clone()
            };
        } else {
            self.grid(f)?;
            self.layers(f, None)?;
            self.scales(f)?;
            for exponent in self.scale_exponents.as_flattened_mut() {
                let mut byte = exponent.to_be_bytes();
                f.bytes(&mut byte)?;
                *exponent = i8::from_be_bytes(byte);
            }
            self.shifts(f)?;
            if let Some(companding) = &mut self.companding {
                companding.iter_mut().try_for_each(|c| c.fields(f))?;
            }
        }
        self.trajectories(f)?;
        self.nodes(f)?;
        self.rig(f)?;
        self.tiles(f, reference)
    }

    fn opening<F: Fields>(&mut self, f: &mut F, units: &mut Vec<Entry>) -> Result<()> {
        f.u16(&mut self.frames)?;
        f.must(self.frames > 0, || "frames >= 1, found 0".into())?;
        let mut flags = if self.reference > 0 { FLAG_PREDICTED } else { 0 };
        if self.lifetimes {
            flags |= FLAG_LIFETIMES;
        }
        if self.rig.joints > 0 {
            flags |= FLAG_RIG;
        }
        if self.reference == 0 && !self.shifts.is_empty() {
            flags |= FLAG_LAYER_SHIFTS;
        }
        if self.reference == 0 && self.companding.is_some() {
            flags |= FLAG_COMPANDING;
        }
        if self.reference == 0 && self.turned {
            flags |= FLAG_TURNED;
        }
        f.u8(&mut flags)?;
        let known = match flags & FLAG_PREDICTED {
            0 => FLAG_LIFETIMES | FLAG_RIG | FLAG_LAYER_SHIFTS | FLAG_COMPANDING | FLAG_TURNED,
            _ => FLAG_LIFETIMES | FLAG_RIG | FLAG_PREDICTED,
        };
        f.must(flags & !known == 0, || {
            format!("reserved flags to be 0, found {flags:#04x}")
        })?;
        self.lifetimes = flags & FLAG_LIFETIMES != 0;
        self.turned = flags & FLAG_TURNED != 0;
        if flags & FLAG_RIG != 0 {
            self.rig.joints = self.rig.joints.max(1); // their number follows
        }
        if flags & FLAG_LAYER_SHIFTS != 0 {
            self.shifts.resize(self.layers.len().max(1), Default::default());
        }
        if flags & FLAG_COMPANDING != 0 {
            self.companding.get_or_insert_default();
        }
        if flags & FLAG_PREDICTED != 0 {
            f.u16(&mut self.reference)?;
            f.must(self.reference > 0, || "a reference >= 1, found 0".into())?;
        }
        let mut count = units.len().min(usize::from(u16::MAX)) as u16;
        f.u16(&mut count)?;
        units.resize(usize::from(count), Entry::default());
        units.iter_mut().try_for_each(|unit| unit.fields(f))
    }

    fn grid<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        for v in &mut self.origin {
            f.f32(v, "origin")?;
        }
        f.step(&mut self.grid_step, "grid_step")?;
        f.u8(&mut self.grid_bits)?;
        f.must((1..=21).contains(&self.grid_bits), || "grid_bits of 1 to 21".into())?;
        f.u8(&mut self.sh_degree)?;
        f.must(self.sh_degree <= 3, || "sh_degree of 0 to 3".into())
    }

    fn layers<F: Fields>(&mut self, f: &mut F, reference: Option<&Header>) -> Result<()> {
        let mut n = self.layers.len().min(255) as u8;
        f.u8(&mut n)?;
        f.must((1..=LAYERS_MAX).contains(&usize::from(n)), || {
            format!("1 to {LAYERS_MAX} layers, found {n}")
        })?;
        if let Some(r) = reference {
            f.must(usize::from(n) == r.layers.len(), || {
                format!("the {} layers of the reference, found {n}", r.layers.len())
            })?;
        }
        self.layers.resize(usize::from(n), LayerHeader::default());
        for (k, layer) in self.layers.iter_mut().enumerate() {
            f.u32(&mut layer.count)?;
            let Some(before) = reference.and_then(|r| r.layers.get(k)) else {
                layer.births = layer.count;
                continue;
            };
            f.u32(&mut layer.births)?;
            let LayerHeader { count, births } = *layer;
            f.must(births <= count && count - births <= before.count, || {
                format!(
                    "at most {count} births, and at most {} survivors of the reference, found {births} births",
                    before.count
                )
            })?;
        }
        if reference.is_none() {
            f.u8(&mut self.tile_side_log2)?;
            let (found, sides) = (self.tile_side_log2, TILE_SIDES);
            f.must(sides.contains(&found), || {
                format!("tile_side_log2 of {} to {}, found {found}", sides.start(), sides.end())
            })?;
        }
        Ok(())
    }

    /// The index of tiles, whose length follows from the layers and the reference.
    fn tiles<F: Fields>(&mut self, f: &mut F, reference: Option<&Header>) -> Result<()> {
        let most = LEVELS[LEVELS.len() - 1].gaussians;
        if self.count() > u64::from(most) {
            let found = format!("{} Gaussians, no level allows more than {most}", self.count());
            return Err(Error::limit("group header", found));
        }
        let cells = self.tile_cells();
        self.tiles.resize(self.layers.len(), Vec::new());
        for (k, (tiles, layer)) in self.tiles.iter_mut().zip(&self.layers).enumerate() {
            let before = reference.and_then(|r| r.tiles.get(k)).map_or(&[][..], Vec::as_slice);
            let mut survivors = layer.survivors();
            for (t, known) in before.iter().enumerate() {
                let tile = slot(tiles, t);
                f.u32(&mut tile.count)?;
                let (count, most) = (tile.count, known.count.min(survivors));
                f.must(count <= most, || {
                    format!("at most {most} survivors in tile {t}, found {count}")
                })?;
                survivors -= count;
                tile.bounds(f)?;
            }
            f.must(survivors == 0, || {
                format!("{survivors} more survivors in the tiles of layer {k}")
            })?;
            let mut births = layer.births;
            let mut t = before.len();
            while births > 0 {
                let tile = slot(tiles, t);
                tile.count = births.min(cells);
                births -= tile.count;
                tile.bounds(f)?;
                t += 1;
            }
            tiles.truncate(t);
        }
        Ok(())
    }

    fn scales<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        let attributes = self.attributes();
        let mut n = attributes.len() as u8;
        f.u8(&mut n)?;
        f.must(usize::from(n) == attributes.len(), || {
            format!("{} attributes, found {n}", attributes.len())
        })?;
        self.scales.resize(attributes.len(), Scale::default());
        for (a, scale) in attributes.iter().zip(&mut self.scales) {
            let mut number = *a as u8;
            f.u8(&mut number)?;
            f.must(number == *a as u8, || format!("attribute {}, found {number}", a.name()))?;
            let channels = a.channels(self.sh_degree);
            scale.steps.resize(channels, 0.0);
            scale.offsets.resize(channels, 0.0);
            for (step, offset) in scale.steps.iter_mut().zip(&mut scale.offsets) {
                f.step(step, "step")?;
                f.f32(offset, "offset")?;
            }
        }
        Ok(())
    }

    /// layer_shifts, if the opening announces them.
    fn shifts<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        if self.shifts.is_empty() {
            return Ok(());
        }
        let (kinds, bits) = (1 + self.attributes().len(), self.grid_bits);
        self.shifts.resize(self.layers.len(), Default::default());
        for own in &mut self.shifts {
            for (i, shift) in own.iter_mut().take(kinds).enumerate() {
                f.u8(shift)?;
                let (found, most) = (*shift, if i == 0 { SHIFT_MAX.min(bits - 1) } else { SHIFT_MAX });
                f.must(found <= most, || format!("a shift of 0 to {most}, found {found}"))?;
            }
        }
        Ok(())
    }

    fn trajectories<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        let mut n = self.trajectories.len() as u8;
        f.u8(&mut n)?;
        f.must(n <= 6, || format!("at most 6 attributes with trajectories, found {n}"))?;
        let blank = TrajectoryHeader {
            attribute: Attribute::Means,
            coefficients: 0,
            step: 0.0,
        };
        self.trajectories.resize(usize::from(n), blank);
        let mut last = 0;
        for t in &mut self.trajectories {
            let mut number = t.attribute as u8;
            f.u8(&mut number)?;
            let known = Attribute::from_number(number).filter(|a| number > last && a.channels(self.sh_degree) > 0);
            let Some(attribute) = known else {
                return f.fail(format!(
                    "attributes of trajectories in increasing order, found {number}"
                ));
            };
            (t.attribute, last) = (attribute, number);
            f.u16(&mut t.coefficients)?;
            coefficients(f, t.coefficients, self.frames)?;
            f.step(&mut t.step, "step of a trajectory")?;
        }
        Ok(())
    }

    fn nodes<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        let n = &mut self.nodes;
        f.u32(&mut n.count)?;
        if n.count == 0 {
            return Ok(());
        }
        f.u8(&mut n.neighbors)?;
        f.must((1..=NEIGHBORS_MAX as u8).contains(&n.neighbors), || {
            "1 to 8 neighbors of a Gaussian".into()
        })?;
        f.u16(&mut n.coefficients)?;
        coefficients(f, n.coefficients, self.frames)?;
        f.step(&mut n.rotation_step, "rotation_step")?;
        f.step(&mut n.translation_step, "translation_step")
    }

    /// The rig, if the opening announces it.
    fn rig<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        let r = &mut self.rig;
        if r.joints == 0 {
            return Ok(());
        }
        f.must(self.nodes.count > 0, || {
            "nodes in a group with a rig, found none".into()
        })?;
        f.u8(&mut r.joints)?;
        f.must(r.joints > 0, || "at least one joint, found 0".into())?;
        f.step(&mut r.rotation_step, "rotation_step of joints")?;
        f.step(&mut r.translation_step, "translation_step of joints")
    }
}

/// Tile `t`, added if it is the next one.
fn slot(tiles: &mut Vec<TileHeader>, t: usize) -> &mut TileHeader {
    if t >= tiles.len() {
        tiles.push(TileHeader::default());
    }
    let last = tiles.len() - 1;
    &mut tiles[t.min(last)]
}

impl TileHeader {
    fn bounds<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        self.bounds.iter_mut().try_for_each(|v| f.u16(v))?;
        let [a, b, c, d, e, g] = self.bounds;
        f.must(a <= d && b <= e && c <= g, || {
            format!("bounds whose lower corner is below, found {:?}", [a, b, c, d, e, g])
        })
    }
}

fn coefficients<F: Fields>(f: &F, k: u16, frames: u16) -> Result<()> {
    f.must((1..=frames).contains(&k), || {
        format!("1 to {frames} coefficients, found {k}")
    })
}
