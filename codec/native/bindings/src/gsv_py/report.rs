//! Report of a payload: each unit, and each stream of a tile.

use gsv::error::Result;
use gsv::group::Group;
use gsv::header::Header;
use gsv::tile::{self, Stream};
use gsv::tile_bounds;
use gsv::unit::{self, UnitType};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

/// A unit, or a stream of a tile.
pub struct UnitReport {
    unit: usize,
    kind: &'static str,
    attribute: Option<&'static str>,
    layer: u8,
    tile: Option<u16>,
    offset: usize,
    bytes: usize,
}

/// The units of a payload. A tile is reported as its streams and, as `tile`, the bytes of their size fields.
pub fn units(payload: &[u8], h: &Header, reference: Option<&Header>, layers: usize) -> Result<Vec<UnitReport>> {
    let mut out = Vec::new();
    for u in unit::scan(payload, layers, false, |_, _| true)? {
        let tile = (u.kind == Some(UnitType::Tile)).then_some(u.index);
        let streams = tile.map_or(Vec::new(), |t| {
            Stream::of(h, usize::from(u.layer), usize::from(t), reference)
        });
        let parts = tile::split(u.payload, streams.len()).unwrap_or_default();
        let own = u.size - parts.iter().map(|(_, bytes)| bytes.len()).sum::<usize>();
        let head = if u.number == 0 { u.offset } else { 0 }; // length and checksum
        let report = |kind, attribute, at, bytes| UnitReport {
            unit: u.number,
            kind,
            attribute,
            layer: u.layer,
            tile,
            offset: u.offset + at - head,
            bytes: bytes + head,
        };
        out.push(report(u.kind.map_or("unknown", |k| k.name()), None, 0, own));
        for (stream, (at, bytes)) in streams.iter().zip(parts) {
            let (kind, attribute) = stream.kind(h);
            out.push(report(kind, attribute.map(|a| a.name()), at, bytes.len()));
        }
    }
    Ok(out)
}

pub fn units_into<'py>(py: Python<'py>, units: &[UnitReport]) -> PyResult<Bound<'py, PyList>> {
    let list = PyList::empty(py);
    for u in units {
        let d = PyDict::new(py);
        d.set_item("unit", u.unit)?;
        d.set_item("type", u.kind)?;
        d.set_item("attribute", u.attribute)?;
        d.set_item("layer", u.layer)?;
        d.set_item("tile", u.tile)?;
        d.set_item("offset", u.offset)?;
        d.set_item("bytes", u.bytes)?;
        list.append(d)?;
    }
    Ok(list)
}

pub fn tiles<'py>(py: Python<'py>, group: &Group) -> PyResult<Bound<'py, PyList>> {
    let list = PyList::empty(py);
    for (k, counts) in group.tiles.iter().enumerate() {
        let own = PyList::empty(py);
        for (t, n) in counts.iter().enumerate() {
            let d = PyDict::new(py);
            let [low, high] = tile_bounds::of(&group.header, k, t).unwrap_or_default();
            d.set_item("gaussians", n)?;
            d.set_item("low", low)?;
            d.set_item("high", high)?;
            own.append(d)?;
        }
        list.append(own)?;
    }
    Ok(list)
}
