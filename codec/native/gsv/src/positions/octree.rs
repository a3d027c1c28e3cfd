//! The nodes of one level of the octree, their children in the next level, and which nodes share a face.

/// No neighbour on this face.
const NONE: u32 = u32::MAX;

/// A cube of one level that holds `count` points.
pub struct Node {
    pub code: u64,
    pub count: u32,
    pub start: u32,      // encoder: index of its first point
    pub lower: [u32; 3], // face neighbours on the lower side of x, y, z: already split
    pub upper: [u32; 3], // face neighbours on the upper side: still to be split
}

impl Node {
    pub fn new(code: u64, count: u32, start: u32) -> Node {
        Node {
            code,
            count,
            start,
            lower: [NONE; 3],
            upper: [NONE; 3],
        }
    }

    pub fn occupied(&self) -> usize {
        self.lower.iter().chain(&self.upper).filter(|q| **q != NONE).count()
    }
}

/// The children of a node: index of the first one in the next level, and which of the eight exist.
#[derive(Clone, Copy, Default)]
pub struct Children {
    pub first: u32,
    pub mask: u8,
}

impl Children {
    pub fn find(self, k: u8) -> Option<u32> {
        let before = self.mask & ((1u8 << k) - 1);
        (self.mask >> k & 1 != 0).then(|| self.first + before.count_ones())
    }
}

/// Sets the face neighbours of the children from those of their parents.
pub fn link(level: &[Node], children: &[Children], next: &mut [Node]) {
    for (parent, mine) in level.iter().zip(children) {
        for k in 0..8u8 {
            let Some(at) = mine.find(k) else { continue };
            for axis in 0..3 {
                let bit = 4u8 >> axis;
                let across = if k & bit != 0 {
                    Some(mine)
                } else {
                    children.get(parent.lower[axis] as usize)
                };
                if let Some(q) = across.and_then(|c| c.find(k ^ bit)) {
                    next[at as usize].lower[axis] = q;
                    next[q as usize].upper[axis] = at;
                }
            }
        }
    }
}
