//! The syntax of the group header (spec 4): one description reads and writes the fields, and checks them.

use super::{Header, LAYERS_MAX, LayerHeader, SHIFT_MAX, Scale, TrajectoryHeader};
use crate::attributes::Attribute;
use crate::blend::NEIGHBORS_MAX;
use crate::error::Result;
use crate::fields::{Fields, Reader};
use crate::hilbert_layout;

const FLAG_PREDICTED: u8 = 1;
const FLAG_COMPANDING: u8 = 2;
const FLAG_UNIT_SIZES: u8 = 4;
const FLAG_LAYER_SHIFTS: u8 = 8;

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

    /// The first fields of a header: the reference (groups back, 0: independent), and the sizes of the units behind the
    /// header.
    pub fn open(payload: &[u8]) -> Result<(u16, Vec<u32>)> {
        let (mut h, mut sizes) = (Header::default(), Vec::new());
        h.opening(&mut Reader::new(payload), &mut sizes)?;
        Ok((h.reference, sizes))
    }

    /// Reads or writes all fields, and checks them. `sizes`: sizes of the units behind the header; empty: not in the header.
    pub fn fields<F: Fields>(&mut self, f: &mut F, sizes: &mut Vec<u32>, reference: Option<&Header>) -> Result<()> {
        self.opening(f, sizes)?;
        if self.reference > 0 {
            let Some(r) = reference.filter(|r| r.reference == 0) else {
                return f.fail("the independent group that this predicted one refers to".into());
            };
            self.layers(f, Some(r))?;
            *self = Header {
                frames: self.frames,
                reference: self.reference,
                layers: std::mem::take(&mut self.layers),
                trajectories: std::mem::take(&mut self.trajectories),
                nodes: self.nodes,
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
        self.nodes(f)
    }

    fn opening<F: Fields>(&mut self, f: &mut F, sizes: &mut Vec<u32>) -> Result<()> {
        f.u16(&mut self.frames)?;
        f.must(self.frames > 0, || "frames >= 1, found 0".into())?;
        let mut flags = if self.reference > 0 { FLAG_PREDICTED } else { 0 };
        if !sizes.is_empty() {
            flags |= FLAG_UNIT_SIZES;
        }
        if self.reference == 0 && !self.shifts.is_empty() {
            flags |= FLAG_LAYER_SHIFTS;
        }
        if self.reference == 0 && self.companding.is_some() {
            flags |= FLAG_COMPANDING;
        }
        f.u8(&mut flags)?;
        let known = match flags & FLAG_PREDICTED {
            0 => FLAG_UNIT_SIZES | FLAG_LAYER_SHIFTS | FLAG_COMPANDING,
            _ => FLAG_UNIT_SIZES | FLAG_PREDICTED,
        };
        f.must(flags & !known == 0, || {
            format!("reserved flags to be 0, found {flags:#04x}")
        })?;
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
        if flags & FLAG_UNIT_SIZES != 0 {
            let mut count = sizes.len() as u8;
            f.u8(&mut count)?;
            sizes.resize(usize::from(count), 0);
            sizes.iter_mut().try_for_each(|size| f.u32(size))?;
        }
        Ok(())
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
            let width = hilbert_layout::width_log2(layer.count as usize) as u8;
            let mut found = width;
            f.u8(&mut found)?;
            f.must(found == width, || format!("map_width_log2 {width}, found {found}"))?;
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
}

fn coefficients<F: Fields>(f: &F, k: u16, frames: u16) -> Result<()> {
    f.must((1..=frames).contains(&k), || {
        format!("1 to {frames} coefficients, found {k}")
    })
}
