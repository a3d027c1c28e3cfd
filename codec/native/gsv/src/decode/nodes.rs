//! The nodes of a group (spec 11): their positions and trajectories, and the rig with the poses of its joints.
//!
//! In: the units that a group has once. Out: the integers of nodes and rig, which do not depend on the Gaussians.

use super::GroupDecoder;
use super::streams::Source;
use crate::error::Result;
use crate::neighbors::{self, Near};
use crate::positions::SplitModel;
use crate::range_coder::Decoder;
use crate::rig::{self, Rig};
use crate::tile::StreamModel;
use crate::trajectories::{self, Kind, Trajectories, TrajectoryModel};
use crate::unit::UnitType;

/// Positions of nodes, their trajectories, and the rig.
type Nodes = (Vec<[u32; 3]>, Trajectories, Option<Rig>);

impl GroupDecoder<'_> {
    /// Nodes, their trajectories and the rig, which do not depend on the Gaussians.
    pub fn nodes(&self) -> Result<Nodes> {
        let h = &self.header.nodes;
        let Some(own) = self.source(UnitType::NodePositions) else {
            return Ok(Default::default());
        };
        let positions = self.points(&own, &mut StreamModel::Positions(SplitModel::default()), h.count, 0)?;
        let near = neighbors::nearest(&positions);
        let (motion, rig) = (self.node_trajectories(&near)?, self.rig(&near)?);
        Ok((positions, motion, rig))
    }

    /// A unit that a group has once.
    fn source(&self, kind: UnitType) -> Option<Source<'_>> {
        let unit = self.sound.get((kind, 0, 0))?;
        let (bytes, offset, label) = (unit.payload, unit.offset, unit.label());
        Some(Source { bytes, offset, label })
    }

    /// `near`: the neighbours of each node.
    fn node_trajectories(&self, near: &[Near]) -> Result<Trajectories> {
        let Some(motion) = self.source(UnitType::NodeTrajectories) else {
            return Ok(Trajectories::default());
        };
        let k = usize::from(self.header.nodes.coefficients);
        let mut c = Decoder::new(motion.bytes);
        let mut model = TrajectoryModel::new(Kind::Node);
        let t = trajectories::code(&mut c, &mut model, k, near, &Trajectories::new(6), u64::MAX); // counted from the header
        motion.finish(c, t.is_ok())?;
        Ok(t.unwrap_or_default())
    }

    /// The rig with the poses of its joints; None if one of the two is missing. `near`: the neighbours of each node.
    fn rig(&self, near: &[Near]) -> Result<Option<Rig>> {
        let (Some(own), Some(poses)) = (self.source(UnitType::Rig), self.source(UnitType::JointPoses)) else {
            return Ok(None);
        };
        let mut c = Decoder::new(own.bytes);
        let rig = rig::code(&mut c, usize::from(self.header.rig.joints), near, &Rig::default());
        own.finish(c, rig.is_some())?;
        let mut rig = rig.unwrap_or_default();
        let (mut c, blank) = (Decoder::new(poses.bytes), Trajectories::new(rig::CHANNELS));
        let t = rig::code_poses(&mut c, &rig.parents, self.header.frames, &blank);
        poses.finish(c, t.is_ok())?;
        rig.poses = t.unwrap_or_default();
        Ok(Some(rig))
    }
}
