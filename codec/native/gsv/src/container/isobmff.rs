//! Boxes inside of header boxes (spec 2): the walk over them, the search by path, and the brands of ftyp.
//!
//! Readers skip unknown boxes. `inline(never)`: as in `fields`.

use super::entry::name;
use super::write::BRAND;
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader};

/// A box inside a header box; `offset`: of its body.
pub struct Inner<'a> {
    pub kind: [u8; 4],
    pub offset: usize,
    pub body: &'a [u8],
}

/// The boxes that fill `data`.
#[inline(never)]
pub fn boxes(data: &[u8]) -> Result<Vec<Inner<'_>>> {
    let mut r = Reader::new(data);
    let mut out = Vec::new();
    while r.rest() > 0 {
        let (mut size, mut kind) = (0, [0; 4]);
        r.u32(&mut size)?;
        r.bytes(&mut kind)?;
        r.must(size >= 8, || format!("a box of at least 8 bytes, found {size}"))?;
        let offset = r.position();
        out.push(Inner {
            kind,
            offset,
            body: r.take(size as usize - 8)?,
        });
    }
    Ok(out)
}

/// The body of the box at `path` and its offset; at each step the first box of that type.
#[inline(never)]
pub fn find<'a>(data: &'a [u8], path: &[&[u8; 4]]) -> Result<(&'a [u8], usize)> {
    let (mut data, mut base) = (data, 0);
    for kind in path {
        let found = boxes(data)
            .map_err(|e| e.at(base, ""))?
            .into_iter()
            .find(|b| &b.kind == *kind);
        let Some(b) = found else {
            return Err(Error::bitstream(base, "", format!("a {}, found none", name(kind))));
        };
        base += b.offset;
        data = b.body;
    }
    Ok((data, base))
}

/// Checks the brands in the body of ftyp.
pub fn ftyp(body: &[u8]) -> Result<()> {
    let brands = body.as_chunks::<4>().0;
    let known = brands.iter().enumerate().any(|(i, b)| i != 1 && b == BRAND); // the second word is minor_version
    if known {
        Ok(())
    } else {
        Err(Error::bitstream(
            0,
            "",
            "the brand gsv1 in ftyp: this is not a .gsv file",
        ))
    }
}
