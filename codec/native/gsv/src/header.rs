//! Group header (spec 4): what a group holds and how to dequantize it, and the caps it must keep (spec 5).

use crate::attributes::Attribute;
use crate::blend::NEIGHBORS_MAX;
use crate::error::Result;
use crate::fields::{Fields, Reader};
use crate::levels::Level;
use crate::map;

const FLAG_PREDICTED: u8 = 1;
const FLAG_STEP_CLASSES: u8 = 2;

/// Dequantization of the channels of one attribute: value = offset + step * integer.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Scale {
    pub steps: Vec<f32>,
    pub offsets: Vec<f32>,
}

/// Trajectories of one attribute.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrajectoryHeader {
    pub attribute: Attribute,
    pub coefficients: u16,
    pub step: f32,
}

/// Coarse motion of the group.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct NodeHeader {
    pub count: u32,
    pub neighbors: u8,
    pub coefficients: u16,
    pub rotation_step: f32,
    pub translation_step: f32,
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct Header {
    pub frames: u16,
    pub origin: [f32; 3],
    pub grid_step: f32,
    pub grid_bits: u8,
    pub sh_degree: u8,
    pub count: u32,
    /// In the order of `Attribute::canonical(sh_degree)`.
    pub scales: Vec<Scale>,
    pub trajectories: Vec<TrajectoryHeader>,
    /// `count` 0: none.
    pub nodes: NodeHeader,
}

impl Header {
    pub fn attributes(&self) -> &'static [Attribute] {
        Attribute::canonical(self.sh_degree)
    }

    pub fn read(payload: &[u8]) -> Result<Header> {
        let mut h = Header::default();
        let mut r = Reader::new(payload);
        h.fields(&mut r)?;
        let rest = r.rest();
        r.must(rest == 0, || {
            format!("the end of the group header, found {rest} more bytes")
        })?;
        Ok(h)
    }

    /// Reads or writes all fields, and checks them.
    pub fn fields<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        f.u16(&mut self.frames)?;
        f.must(self.frames > 0, || "frames >= 1, found 0".into())?;
        flags(f)?;
        for v in &mut self.origin {
            f.f32(v, "origin")?;
        }
        f.step(&mut self.grid_step, "grid_step")?;
        f.u8(&mut self.grid_bits)?;
        f.must((1..=21).contains(&self.grid_bits), || "grid_bits of 1 to 21".into())?;
        f.u8(&mut self.sh_degree)?;
        f.must(self.sh_degree <= 3, || "sh_degree of 0 to 3".into())?;
        self.layer(f)?;
        self.scales(f)?;
        self.trajectories(f)?;
        self.nodes(f)
    }

    fn layer<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        let mut layers = 1;
        f.u8(&mut layers)?;
        f.must(layers == 1, || {
            format!("one layer, found {layers}: not yet supported by this version")
        })?;
        f.u32(&mut self.count)?;
        let width = map::width_log2(self.count as usize) as u8;
        let mut found = width;
        f.u8(&mut found)?;
        f.must(found == width, || format!("map_width_log2 {width}, found {found}"))
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

    /// Symbols known from the header (spec 5), after all caps were found to be kept.
    pub fn check(&self, level: &Level) -> Result<u64> {
        let unit = "group header";
        level.cap(unit, "Gaussians", u64::from(self.count), u64::from(level.gaussians))?;
        level.cap(unit, "frames", u64::from(self.frames), u64::from(level.frames))?;
        level.cap(unit, "nodes", u64::from(self.nodes.count), u64::from(level.nodes))?;
        let channels: usize = self.scales.iter().map(|s| s.steps.len()).sum();
        let per_gaussian = 3 + channels as u64 + self.trajectories.len() as u64;
        let nodes = u64::from(self.nodes.count) * (3 + 6 * u64::from(self.nodes.coefficients));
        let symbols = u64::from(self.count) * per_gaussian + nodes;
        level.cap(unit, "symbols", symbols, level.symbols)?;
        Ok(symbols)
    }
}

fn flags<F: Fields>(f: &mut F) -> Result<()> {
    let mut flags = 0;
    f.u8(&mut flags)?;
    let unsupported = |tool: &str| format!("a group without {tool}: not yet supported by this version");
    f.must(flags & FLAG_PREDICTED == 0, || {
        unsupported("prediction from an earlier group")
    })?;
    f.must(flags & FLAG_STEP_CLASSES == 0, || unsupported("step classes"))?;
    f.must(flags == 0, || format!("reserved flags to be 0, found {flags:#04x}"))
}

fn coefficients<F: Fields>(f: &F, k: u16, frames: u16) -> Result<()> {
    f.must((1..=frames).contains(&k), || {
        format!("1 to {frames} coefficients, found {k}")
    })
}
