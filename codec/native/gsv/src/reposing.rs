//! Reposing of a coded group with a rig: new bytes in the unit of the joint poses, new bounds of tiles in the header;
//! all other units keep their bytes.

use crate::decode::{Decoding, decode_group};
use crate::encode::joint_poses;
use crate::error::{Error, Result};
use crate::evaluate::Evaluator;
use crate::fields::Writer;
use crate::header::Header;
use crate::tile_bounds;
use crate::trajectories::Trajectories;
use crate::unit::{self, Entry, UnitType};

/// The payload with other poses ([J] of DCT coefficients in the steps of the header). `how`: decodes all of the group.
///
/// # Errors
/// As `decode_group`; `Error::Input`: the group has no rig, or poses that do not fit it.
pub fn repose(payload: &[u8], how: &Decoding, poses: Trajectories) -> Result<Vec<u8>> {
    let mut group = decode_group(payload, how)?;
    let Some(rig) = &mut group.rig else {
        return Err(Error::Input("expected a group with a rig".into()));
    };
    rig.poses = poses;
    let own = joint_poses(rig, group.header.frames);
    group.validate(how.reference)?;
    let mut evaluator = Evaluator::new(group);
    tile_bounds::set(&mut evaluator);
    let mut header = evaluator.into_group().header;

    let first = unit::first(payload)?;
    let (_, mut directory) = Header::open(first.payload).map_err(|e| e.at(first.offset, &first.label()))?;
    let (mut units, mut offset) = (Vec::new(), first.offset + first.size);
    for entry in &mut directory {
        let end = offset + entry.size as usize;
        let bytes = payload.get(offset..end).unwrap_or(&[]).to_vec();
        let poses = entry.number == UnitType::JointPoses as u8;
        if poses {
            *entry = Entry::new((UnitType::JointPoses, entry.layer, entry.index), &own)?;
        }
        units.push(if poses { own.clone() } else { bytes });
        offset = end;
    }
    let mut w = Writer::default();
    header.fields(&mut w, &mut directory, how.reference.map(|r| &r.header))?;
    unit::write(&w.0, &units)
}
