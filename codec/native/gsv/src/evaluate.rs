//! Integers of a decoded group -> f32 attributes of frame t (spec 13).
//!
//! Canonical values and the weights of the nodes are computed once; a frame is then evaluated from them
//! (parametric.rs).

use crate::attributes::Attribute;
use crate::blend::Blend;
use crate::dequantize::{self, Quat, values};
use crate::error::Result;
use crate::group::Group;
use crate::header::Header;
use crate::neighbors;
use crate::parallel::join;
use crate::parametric::{AttributeMotion, Frame, FrameMut, Parametric, RigMotion, rgb};
use crate::rig::Rig;
use crate::skinning::Skinning;
use crate::trajectories::Trajectories;
use rayon::prelude::*;

/// A group made ready to be evaluated at any frame.
pub struct Evaluator {
    group: Group,
    canonical: Frame, // means: relative to the origin of the grid; quaternions: those of the group
    motions: Vec<AttributeMotion<i32>>,
    blend: Blend,
    nodes: Vec<[f32; 3]>, // relative to the origin of the grid
    skinning: Option<Skinning>,
}

impl Evaluator {
    pub fn new(mut group: Group) -> Evaluator {
        let h = &group.header;
        let place = |p: &[u32; 3]| p.map(|v| h.grid_step * v as i32 as f32); // below 2^21, signed ones convert faster
        let nodes = group.node_positions.iter().map(place).collect();
        let [scales_shift, opacities_shift] = group.correction();
        let channels = |a, shift| values(h, a, group.channels_of(a).unwrap_or(&[]), shift);
        let (blend, canonical) = join(
            || Blend::new(&group.positions, &group.node_positions, usize::from(h.nodes.neighbors)),
            || Frame {
                means: group.positions.par_iter().map(place).collect(),
                quats: Vec::new(),
                log_scales: channels(Attribute::LogScales, scales_shift),
                logit_opacities: channels(Attribute::LogitOpacities, opacities_shift),
                sh0: colours(channels(Attribute::Sh0, 0.0)),
                sh_n: colours(channels(Attribute::ShN, 0.0)),
            },
        );
        let trajectories = std::mem::take(&mut group.trajectories);
        let heads = group.header.trajectories.iter();
        let motions = heads
            .zip(trajectories)
            .map(|(h, t)| AttributeMotion::new(h.attribute, h.step, true, t))
            .collect();
        let skinning = group.rig.as_ref().map(|rig| skinning(rig, &group.header));
        Evaluator {
            group,
            canonical,
            motions,
            blend,
            nodes,
            skinning,
        }
    }

    /// For a group that has not been coded: computes its quaternions as a decoder does, without bytes.
    ///
    /// # Errors
    /// `Error::Input`: the group breaks an invariant.
    pub fn reconstruct(mut group: Group, reference: Option<&Group>) -> Result<Evaluator> {
        group.validate(reference)?;
        group.rotations = rotations_of(&group, reference);
        Ok(Evaluator::new(group))
    }

    pub fn group(&self) -> &Group {
        &self.group
    }

    /// The group as it was given, with its rotations.
    pub fn into_group(self) -> Group {
        let trajectories = self.motions.into_iter().map(|m| m.coefficients).collect();
        Group {
            trajectories,
            ..self.group
        }
    }

    pub fn header_mut(&mut self) -> &mut Header {
        &mut self.group.header
    }

    /// Trajectories in the order of the header.
    pub fn trajectories(&self) -> impl Iterator<Item = &Trajectories> {
        self.motions.iter().map(|m| &m.coefficients)
    }

    /// Neighbours and weights of the nodes that carry each Gaussian.
    pub fn blend(&self) -> &Blend {
        &self.blend
    }

    /// Which Gaussians frame `t` shows; None: all.
    pub fn visible(&self, t: u16) -> Option<Vec<bool>> {
        let lifetimes = self.group.lifetimes.as_ref()?.iter();
        Some(lifetimes.map(|[t0, t1]| (*t0..*t1).contains(&t)).collect())
    }

    /// The group as it is evaluated.
    pub fn parametric(&self) -> Parametric<'_, i32> {
        let h = &self.group.header;
        Parametric {
            frames: h.frames,
            origin: h.origin,
            rest: &self.canonical,
            rotations: &self.group.rotations,
            blend: &self.blend,
            nodes: &self.nodes,
            node_motion: &self.group.node_trajectories,
            node_steps: [h.nodes.rotation_step, h.nodes.translation_step],
            rig: self.rig(),
            motions: &self.motions,
            turned: h.turned,
        }
    }

    fn rig(&self) -> Option<RigMotion<'_>> {
        let (h, rig) = (&self.group.header.rig, self.group.rig.as_ref()?);
        Some(RigMotion {
            skinning: self.skinning.as_ref()?,
            poses: &rig.poses,
            steps: [h.rotation_step, h.translation_step],
        })
    }

    /// Evaluates frame `t` (clamped to the group) into `frame`, whose buffers are reused.
    pub fn frame(&self, t: u16, frame: &mut Frame) {
        frame.resize_as(&self.canonical);
        self.frame_into(t, &mut frame.as_mut());
    }

    /// As `frame`, but spherical harmonics are not rotated (`Parametric::frame_at_rest`).
    pub fn frame_at_rest(&self, t: u16, frame: &mut Frame) -> Vec<Quat> {
        frame.resize_as(&self.canonical);
        self.parametric().frame_at_rest(t, &mut frame.as_mut())
    }

    /// Evaluates frame `t` (clamped to the group) into buffers as long as those of `Frame`.
    pub fn frame_into(&self, t: u16, out: &mut FrameMut) {
        self.parametric().frame_into(t, out);
    }
}

/// [N] quaternions: survivors have those of the reference, births follow from their integers.
fn rotations_of(group: &Group, reference: Option<&Group>) -> Vec<Quat> {
    let h = &group.header;
    let mut out = Vec::with_capacity(group.positions.len());
    for (k, layer) in group.layers.iter().enumerate() {
        let range = group.range(k..k + 1);
        let born = range.start + layer.survivors() as usize;
        let parents = group
            .parents
            .iter()
            .flatten()
            .skip(range.start)
            .take(born - range.start);
        let known = reference.map_or(&[][..], |r| &r.rotations);
        out.extend(parents.filter_map(|p| known.get(*p as usize)));
        let own = |a| {
            group
                .channels_of(a)
                .and_then(|v| v.get(3 * born..3 * range.end))
                .unwrap_or(&[])
        };
        let births = group.positions.get(born..range.end).unwrap_or(&[]);
        let near = neighbors::nearest_in_tiles(births, h.tile_cells() as usize);
        out.extend(dequantize::rotations(
            h,
            own(Attribute::Quats),
            own(Attribute::LogScales),
            &near,
        ));
    }
    out
}

/// The rig of a group in floats, relative to the origin of the grid.
fn skinning(rig: &Rig, h: &Header) -> Skinning {
    let place = |p: &[i32; 3]| p.map(|v| h.grid_step * v as f32);
    let steps = [h.rig.rotation_step, h.rig.translation_step];
    let bind = |b: &[i32; 6]| std::array::from_fn(|c| steps[c / 3] * b[c] as f32);
    let bind: Vec<[f32; 6]> = rig.bind.iter().map(bind).collect();
    let joints = rig.joints.iter().map(place).collect();
    Skinning::new(joints, rig.parents.clone(), &bind, &rig.weights)
}

fn colours(mut values: Vec<f32>) -> Vec<f32> {
    values.as_chunks_mut().0.iter_mut().for_each(|c| *c = rgb(*c));
    values
}
