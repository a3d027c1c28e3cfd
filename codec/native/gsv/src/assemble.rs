//! Decoded units of each layer -> one group: the layers in order, and in each the survivors before the births.

use crate::attributes::Attribute;
use crate::dequantize;
use crate::group::{BIRTH, Group};
use crate::header::{Header, LayerHeader};
use crate::neighbors::{Contexts, Near};
use crate::trajectories::Trajectories;

/// A decoded unit other than points.
pub enum Part {
    Channels(Vec<i32>),
    Lifetimes(Vec<[u16; 2]>),
    Trajectories(Trajectories),
    Correction(f32),
}

/// The positions of a layer, decoded before its other units.
pub struct LayerPoints {
    pub header: LayerHeader,
    /// The numbers of Gaussians are those of the header: neither the layer nor that of the reference is damaged.
    pub whole: bool,
    /// Indices in the reference.
    pub survivors: Vec<u32>,
    pub positions: Vec<[u32; 3]>,
    pub contexts: Contexts,
}

/// The other units of a layer.
pub struct Slot {
    channels: Vec<Vec<i32>>, // of births
    trajectories: Vec<Option<Trajectories>>,
    lifetimes: Option<Vec<[u16; 2]>>,
    correction: [f32; 2],
}

impl Slot {
    pub fn new(h: &Header) -> Slot {
        Slot {
            channels: vec![Vec::new(); h.attributes().len()],
            trajectories: vec![None; h.trajectories.len()],
            lifetimes: None,
            correction: [0.0; 2],
        }
    }

    /// Quaternions of the births; `near`: their context neighbours.
    fn rotations(&self, h: &Header, near: &[Near]) -> Vec<[f32; 4]> {
        let integers = |a| {
            let at = h.attributes().iter().position(|b| *b == a);
            at.and_then(|k| self.channels.get(k)).map_or(&[][..], Vec::as_slice)
        };
        dequantize::rotations(h, integers(Attribute::Quats), integers(Attribute::LogScales), near)
    }

    pub fn place(&mut self, h: &Header, attribute: Option<Attribute>, part: Part) {
        match part {
            Part::Lifetimes(l) => self.lifetimes = Some(l),
            Part::Correction(v) => self.correction[usize::from(attribute == Some(Attribute::LogitOpacities))] = v,
            Part::Channels(v) => {
                let at = h.attributes().iter().position(|a| Some(*a) == attribute);
                if let Some(slot) = at.and_then(|k| self.channels.get_mut(k)) {
                    *slot = v;
                }
            }
            Part::Trajectories(t) => {
                let at = h.trajectories.iter().position(|h| Some(h.attribute) == attribute);
                if let Some(slot) = at.and_then(|k| self.trajectories.get_mut(k)) {
                    *slot = Some(t);
                }
            }
        }
    }
}

/// Concatenates the layers; damaged units are replaced by 0, or by no motion.
pub fn assemble(layers: Vec<LayerPoints>, slots: Vec<Slot>, reference: Option<&Group>, h: &Header) -> Group {
    let mut group = Group {
        channels: vec![Vec::new(); h.scales.len()],
        trajectories: vec![Trajectories::default(); h.trajectories.len()],
        parents: reference.map(|_| Vec::new()),
        ..Group::default()
    };
    let cut = slots.iter().any(|s| s.lifetimes.is_some());
    let mut lifetimes = Vec::new();
    for (layer, mut slot) in layers.into_iter().zip(slots) {
        let (n, births) = (layer.positions.len(), layer.header.births as usize);
        for (values, scale) in slot.channels.iter_mut().zip(&h.scales) {
            values.resize(births * scale.steps.len(), 0);
        }
        let before = reference.map_or(&[][..], |r| &r.rotations);
        let known = layer.survivors.iter().filter_map(|p| before.get(*p as usize)).copied();
        group.rotations.extend(known);
        append(&mut group.rotations, slot.rotations(h, layer.contexts.births()));
        for (k, (own, values)) in group.channels.iter_mut().zip(slot.channels).enumerate() {
            let c = h.scales.get(k).map_or(0, |s| s.steps.len());
            let before = reference.and_then(|r| r.channels.get(k)).map_or(&[][..], Vec::as_slice);
            let rows = layer.survivors.iter().map(|p| *p as usize);
            own.extend(rows.flat_map(|p| before.get(p * c..(p + 1) * c).unwrap_or(&[])));
            append(own, values);
        }
        for ((own, head), t) in group
            .trajectories
            .iter_mut()
            .zip(&h.trajectories)
            .zip(slot.trajectories)
        {
            let none = || Trajectories::still(head.attribute.channels(h.sh_degree), n);
            own.append(t.unwrap_or_else(none));
        }
        if let Some(parents) = &mut group.parents {
            parents.extend(&layer.survivors);
            parents.extend((0..births).map(|_| BIRTH));
        }
        if cut {
            lifetimes.extend(slot.lifetimes.unwrap_or_else(|| vec![[0, h.frames]; n]));
        }
        append(&mut group.positions, layer.positions);
        group.corrections.push(slot.correction);
        group.layers.push(layer.header);
    }
    group.lifetimes = cut.then_some(lifetimes);
    group
}

/// Appends `b` to `a` without a copy where `a` is empty.
pub fn append<T>(to: &mut Vec<T>, more: Vec<T>) {
    if to.is_empty() { *to = more } else { to.extend(more) }
}
