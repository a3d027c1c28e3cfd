//! `gscodec.bitstream.quantized_group.QuantizedGroup` (planar arrays) -> `gsv::group::Group` (interleaved).

use super::rig::rig_from;
use super::values::{array, invalid, item, optional, points, value};
use gsv::attributes::{Attribute, sh_coefficients};
use gsv::companding::{Companding, PIECES};
use gsv::group::{BIRTH, Group};
use gsv::header::{Header, LayerHeader, NodeHeader, Scale, TILE_SIDES, TrajectoryHeader};
use gsv::rig::CHANNELS;
use gsv::trajectories::Trajectories;
use numpy::{PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;

pub fn group_from(d: &Bound<PyAny>, reference: Option<&Group>) -> PyResult<Group> {
    let positions = points(d, "positions")?;
    let channels: Bound<PyDict> = value(d, "channels")?;
    let mut header = Header {
        frames: value(d, "frames")?,
        origin: value(d, "origin")?,
        grid_step: value(d, "grid_step")?,
        grid_bits: value(d, "grid_bits")?,
        sh_degree: sh_degree(&channels)?,
        turned: value(d, "turned_harmonics")?,
        tile_side_log2: value(d, "tile_side_log2")?,
        ..Header::default()
    };
    let mut group = Group {
        positions,
        ..Group::default()
    };
    layers_from(d, &mut header, &mut group)?;
    channels_from(&channels, &mut header, &mut group)?;
    header.scale_exponents = value(d, "scale_exponents")?;
    header.shifts = shifts_from(d, &header)?;
    header.companding = companding_from(&channels)?;
    motion_from(&value(d, "trajectories")?, &mut header, &mut group)?;
    if let Some(n) = optional(d, "nodes")? {
        nodes_from(&n, &mut header, &mut group)?;
    }
    group.lifetimes = lifetimes_from(d)?;
    header.lifetimes = group.lifetimes.is_some();
    if header.reference > 0 && !reference.is_some_and(|r| same_parameters(&r.header, &header)) {
        return invalid(
            "a predicted group: expected its reference, with the same grid, steps, offsets, companding, exponents and \
             turned_harmonics"
                .into(),
        );
    }
    if !TILE_SIDES.contains(&header.tile_side_log2) {
        return invalid(format!(
            "tile_side_log2: expected 4 to 7, got {}",
            header.tile_side_log2
        ));
    }
    group.header = header;
    group.divide(reference);
    Ok(group)
}

/// Integers, steps and offsets of each attribute.
fn channels_from(channels: &Bound<PyDict>, header: &mut Header, group: &mut Group) -> PyResult<()> {
    for a in header.attributes() {
        let c = entry(channels, a.name())?;
        let width = a.channels(header.sh_degree);
        let values = array(&c, "values", "int32")?;
        group
            .channels
            .push(planar(&values, a.name(), width, group.positions.len())?);
        let (steps, offsets): (Vec<f32>, Vec<f32>) = (value(&c, "steps")?, value(&c, "offsets")?);
        if steps.len() != width || offsets.len() != width {
            return invalid(format!("{}: expected {width} steps and offsets", a.name()));
        }
        header.scales.push(Scale { steps, offsets });
    }
    Ok(())
}

fn lifetimes_from(d: &Bound<PyAny>) -> PyResult<Option<Vec<[u16; 2]>>> {
    if optional(d, "lifetimes")?.is_none() {
        return Ok(None);
    }
    let a = array(d, "lifetimes", "uint16")?;
    let Ok(a) = a.extract::<PyReadonlyArray2<u16>>() else {
        return invalid("lifetimes: expected shape [N, 2]".into());
    };
    if a.shape()[1] != 2 {
        return invalid(format!("lifetimes: expected shape [N, 2], got {:?}", a.shape()));
    }
    Ok(Some(a.as_array().outer_iter().map(|r| [r[0], r[1]]).collect()))
}

/// Whether a predicted group of header `own` has the parameters of its reference.
fn same_parameters(reference: &Header, own: &Header) -> bool {
    let (r, h) = (reference, own);
    (r.origin, r.grid_step, r.grid_bits, r.tile_side_log2) == (h.origin, h.grid_step, h.grid_bits, h.tile_side_log2)
        && (&r.scales, &r.scale_exponents) == (&h.scales, &h.scale_exponents)
        && (&r.shifts, &r.companding, r.turned) == (&h.shifts, &h.companding, h.turned)
}

/// Fields `layers`, `corrections`, and of a predicted group `reference` and `parents`.
fn layers_from(d: &Bound<PyAny>, header: &mut Header, group: &mut Group) -> PyResult<()> {
    let n = group.positions.len();
    let counts: Vec<u32> = match optional(d, "layers")? {
        Some(_) => value(d, "layers")?,
        None => vec![n as u32],
    };
    if counts.iter().map(|c| *c as usize).sum::<usize>() != n {
        return invalid(format!("layers: expected counts that sum up to {n}, got {counts:?}"));
    }
    group.corrections = match optional(d, "corrections")? {
        Some(_) => value(d, "corrections")?,
        None => vec![[0.0; 2]; counts.len()],
    };
    header.reference = value(d, "reference")?;
    if optional(d, "parents")?.is_some() {
        let parents = array(d, "parents", "int32")?;
        let Ok(parents) = parents.extract::<PyReadonlyArray1<i32>>() else {
            return invalid("parents: expected shape [N]".into());
        };
        let known = |p: &i32| u32::try_from(*p).unwrap_or(BIRTH);
        group.parents = Some(parents.as_array().iter().map(known).collect());
    }
    let mut first = 0;
    for count in counts {
        let last = first + count as usize;
        let born = |p: &[u32]| p.iter().filter(|p| **p == BIRTH).count() as u32;
        let births = group
            .parents
            .as_ref()
            .map_or(count, |p| p.get(first..last).map_or(0, born));
        header.layers.push(LayerHeader { count, births });
        first = last;
    }
    group.layers = header.layers.clone();
    Ok(())
}

/// `shifts`: for each layer those of positions and of each attribute.
fn shifts_from(d: &Bound<PyAny>, header: &Header) -> PyResult<Vec<[u8; 6]>> {
    if optional(d, "shifts")?.is_none() {
        return Ok(Vec::new());
    }
    let (found, kinds): (Vec<Vec<u8>>, _) = (value(d, "shifts")?, 1 + header.attributes().len());
    if found.len() != header.layers.len() || found.iter().any(|s| s.len() != kinds) {
        return invalid(format!(
            "shifts: expected {kinds} numbers for each of {} layers",
            header.layers.len()
        ));
    }
    let own = |s: &Vec<u8>| std::array::from_fn(|i| s.get(i).copied().unwrap_or(0));
    Ok(found.iter().map(own).collect())
}

/// `companding` of log_scales and logit_opacities: for each channel low, width, and the slopes.
fn companding_from(channels: &Bound<PyDict>) -> PyResult<Option<[Companding; 4]>> {
    let mut found = Vec::new();
    for a in [Attribute::LogScales, Attribute::LogitOpacities] {
        let c = entry(channels, a.name())?;
        if optional(&c, "companding")?.is_some() {
            let rows: Vec<[f32; 2 + PIECES]> = value(&c, "companding")?;
            found.extend(rows.into_iter().map(|[low, width, slopes @ ..]| Companding {
                low,
                width,
                slopes: slopes.map(|s| s as u8),
            }));
        }
    }
    match found.len() {
        0 => Ok(None),
        n => match found.try_into() {
            Ok(curves) => Ok(Some(curves)),
            Err(_) => invalid(format!(
                "companding: expected 3 rows of log_scales and 1 of logit_opacities, or none, got {n}"
            )),
        },
    }
}

/// The channels of an attribute.
fn entry<'py>(channels: &Bound<'py, PyDict>, name: &str) -> PyResult<Bound<'py, PyAny>> {
    match channels.get_item(name)? {
        Some(c) => Ok(c),
        None => invalid(format!("channels: expected the attribute '{name}'")),
    }
}

fn sh_degree(channels: &Bound<PyDict>) -> PyResult<u8> {
    for key in channels.keys().iter() {
        let name: String = key.extract()?;
        if !Attribute::canonical(3).iter().any(|a| a.name() == name) {
            return invalid(format!("channels: unknown attribute '{name}'"));
        }
    }
    let Some(sh) = channels.get_item("shN")? else {
        return Ok(0);
    };
    let width: usize = item(&sh, "values")?.len()?;
    match (0..=3u8).find(|d| 3 * sh_coefficients(*d) == width) {
        Some(d) => Ok(d),
        None => invalid(format!("shN: expected 0, 9, 24 or 45 channels, got {width}")),
    }
}

/// [C, N] -> C per Gaussian.
fn planar(a: &Bound<PyAny>, name: &str, channels: usize, count: usize) -> PyResult<Vec<i32>> {
    let Ok(a) = a.extract::<PyReadonlyArray2<i32>>() else {
        return invalid(format!("{name}: expected shape [C, N]"));
    };
    if a.shape() != [channels, count] {
        return invalid(format!(
            "{name}: expected shape [{channels}, {count}], got {:?}",
            a.shape()
        ));
    }
    Ok(a.as_array().t().iter().copied().collect())
}

fn motion_from(t: &Bound<PyDict>, header: &mut Header, group: &mut Group) -> PyResult<()> {
    for key in t.keys().iter() {
        let name: String = key.extract()?;
        if !Attribute::ALL.iter().any(|a| a.name() == name) {
            return invalid(format!("trajectories: unknown attribute '{name}'"));
        }
    }
    for attribute in Attribute::ALL {
        let Some(a) = t.get_item(attribute.name())? else {
            continue;
        };
        let channels = attribute.channels(header.sh_degree);
        let (coefficients, out) = coefficients(&a, attribute.name(), channels, group.positions.len())?;
        header.trajectories.push(TrajectoryHeader {
            attribute,
            coefficients,
            step: value(&a, "step")?,
        });
        group.trajectories.push(out);
    }
    Ok(())
}

/// `coefficients` [K, C, N] -> K and sparse trajectories.
fn coefficients(d: &Bound<PyAny>, name: &str, channels: usize, count: usize) -> PyResult<(u16, Trajectories)> {
    dense(&array(d, "coefficients", "int32")?, name, channels, count)
}

/// [K, C, N] i32 -> K and sparse trajectories.
pub fn dense(a: &Bound<PyAny>, name: &str, channels: usize, count: usize) -> PyResult<(u16, Trajectories)> {
    let Ok(a) = a.extract::<PyReadonlyArray3<i32>>() else {
        return invalid(format!("trajectories of {name}: expected shape [K, C, N]"));
    };
    let &[k, c, n] = a.shape() else {
        return invalid(format!("trajectories of {name}: expected shape [K, C, N]"));
    };
    if (c, n) != (channels, count) || k == 0 || k > usize::from(u16::MAX) {
        return invalid(format!(
            "trajectories of {name}: expected shape [K, {channels}, {count}], got {:?}",
            a.shape()
        ));
    }
    let view = a.as_array();
    let flat: Vec<i32> = view.permuted_axes([2, 0, 1]).iter().copied().collect();
    let mut out = Trajectories::new(channels);
    (0..n).for_each(|i| out.push(flat.get(i * k * c..(i + 1) * k * c).unwrap_or(&[])));
    Ok((k as u16, out))
}

fn nodes_from(d: &Bound<PyAny>, header: &mut Header, group: &mut Group) -> PyResult<()> {
    group.node_positions = points(d, "positions")?;
    if group.node_positions.is_empty() {
        return Ok(());
    }
    let (k, t) = coefficients(d, "nodes", 6, group.node_positions.len())?;
    group.node_trajectories = t;
    header.nodes = NodeHeader {
        count: group.node_positions.len() as u32,
        neighbors: value(d, "neighbors")?,
        coefficients: k,
        rotation_step: value(d, "rotation_step")?,
        translation_step: value(d, "translation_step")?,
    };
    if let Some(r) = optional(d, "rig")? {
        let (own, mut rig) = rig_from(&r, group.node_positions.len())?;
        let (_, poses) = dense(&array(&r, "poses", "int32")?, "joints", CHANNELS, rig.joints.len())?;
        (header.rig, rig.poses) = (own, poses);
        group.rig = Some(rig);
    }
    Ok(())
}
