//! The bodies of sidx and ssix (spec 2.5 and 2.6) -> the positions of the fragments of a track, and the ends of the
//! layers in each fragment. A malformed box gives None, since a reader does not need an index.

/// An entry of sidx: bytes, duration in units of the timescale, and whether it starts with a sync sample.
pub type SidxReference = (u32, u32, bool);

/// Spec 2.5: first_offset and the entries of the sidx of track `id`; None if it is malformed, or belongs to another
/// track.
pub fn sidx(body: &[u8], id: u32) -> Option<(u64, Vec<SidxReference>)> {
    if body.get(4..8)? != id.to_be_bytes() {
        return None;
    }
    let head = if body.first()? == &0 { 20 } else { 28 };
    let first_offset = match head {
        20 => u64::from(u32::from_be_bytes(body.get(16..20)?.try_into().ok()?)),
        _ => u64::from_be_bytes(body.get(20..28)?.try_into().ok()?),
    };
    let count = u16::from_be_bytes(body.get(head + 2..head + 4)?.try_into().ok()?);
    let (references, _) = body.get(head + 4..)?.as_chunks::<12>();
    let words = |r: &[u8; 12]| {
        let (w, _) = r.as_chunks::<4>();
        let [size, duration, sap] = [0, 1, 2].map(|i| w.get(i).map_or(0, |w| u32::from_be_bytes(*w)));
        (size & 0x7FFF_FFFF, duration, sap >> 31 != 0)
    };
    (references.len() == usize::from(count)).then(|| (first_offset, references.iter().map(words).collect()))
}

/// Spec 2.6: for each entry of sidx the bytes of the fragment up to the end of each layer; None if it is malformed.
pub fn ssix(body: &[u8]) -> Option<Vec<Vec<u64>>> {
    let (words, rest) = body.get(4..)?.as_chunks::<4>();
    let mut words = words.iter().map(|w| u32::from_be_bytes(*w));
    let mut all = Vec::new();
    for _ in 0..words.next()? {
        let (mut ends, mut end) = (Vec::new(), 0);
        for _ in 0..words.next()? {
            let range = words.next()?;
            end += u64::from(range & 0xFF_FFFF);
            let layer = (range >> 24) as usize;
            if layer == ends.len() {
                ends.push(end);
            } else if layer + 1 == ends.len() {
                ends[layer] = end;
            } else {
                return None;
            }
        }
        all.push(ends);
    }
    (rest.is_empty() && words.next().is_none()).then_some(all)
}
