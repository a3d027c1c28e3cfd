//! Random groups for the tests: every optional part, and the extremes of every range.
#![allow(dead_code)] // each test uses only a part

use gsv::attributes::Attribute;
use gsv::companding::Companding;
use gsv::decode::Decoding;
use gsv::group::{BIRTH, Group};
use gsv::header::{Header, LayerHeader, NodeHeader, RigHeader, Scale, TrajectoryHeader};
use gsv::levels::LEVELS;
use gsv::morton;
use gsv::rig::{CHANNELS, Rig, WEIGHT_MAX};
use gsv::trajectories::Trajectories;
use proptest::prelude::*;

/// The parameters of a random group.
#[derive(Debug, Clone)]
pub struct Shape {
    /// Gaussians of each layer.
    pub counts: Vec<usize>,
    pub frames: u16,
    pub bits: u8,
    pub sh_degree: u8,
    pub nodes: usize,
    /// Joints of the rig, where there are nodes; 0: none.
    pub joints: usize,
    /// Bits of magnitude of channels and coefficients.
    pub magnitude: u32,
    pub lifetimes: bool,
    /// Bit a: trajectories of attribute a.
    pub moving: u8,
    pub seed: u64,
}

pub fn shape() -> impl Strategy<Value = Shape> {
    let sizes = (
        prop_oneof![
            prop_oneof![Just(0usize), Just(1), 2..700usize].prop_map(|n| vec![n]),
            proptest::collection::vec(0..60usize, 1..5),
        ],
        1..40u16,
        1..=21u8,
        0..=3u8,
    );
    let rest = (
        (prop_oneof![Just(0usize), 1..20usize], 0..6usize),
        0..=24u32,
        any::<bool>(),
        any::<u8>(),
        any::<u64>(),
    );
    (sizes, rest).prop_map(
        |((counts, frames, bits, sh_degree), ((nodes, joints), magnitude, lifetimes, moving, seed))| Shape {
            counts,
            frames,
            bits,
            sh_degree,
            nodes,
            joints,
            magnitude,
            lifetimes,
            moving,
            seed,
        },
    )
}

/// SplitMix64.
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ z >> 31
    }

    pub fn below(&mut self, n: u64) -> u64 {
        self.next() % n.max(1)
    }

    /// A value of up to `magnitude` bits; often small, sometimes an extreme.
    pub fn value(&mut self, magnitude: u32) -> i32 {
        let top = 1i64 << magnitude;
        let v = match self.below(8) {
            0 => top,
            1 => -top,
            2..=4 => (self.below(5) as i64 - 2).clamp(-top, top),
            _ => self.below(2 * top as u64 + 1) as i64 - top,
        };
        v as i32
    }
}

fn points(r: &mut Random, count: usize, bits: u8) -> Vec<[u32; 3]> {
    let side = 1u64 << bits;
    let spread = if r.below(3) == 0 { side.min(4) } else { side }; // crowded: duplicates
    let mut p: Vec<[u32; 3]> = (0..count)
        .map(|_| [0; 3].map(|_| (side - 1 - r.below(spread)) as u32))
        .collect();
    p.sort_by_key(|p| morton::encode(*p));
    p
}

fn trajectories(r: &mut Random, count: usize, channels: usize, k: u16, magnitude: u32) -> Trajectories {
    let mut t = Trajectories::new(channels);
    for _ in 0..count {
        let length = if r.below(3) == 0 {
            r.below(u64::from(k) + 1) as usize
        } else {
            0
        };
        let own: Vec<i32> = (0..length * channels).map(|_| r.value(magnitude)).collect();
        t.push(&own);
    }
    t
}

pub fn group(s: &Shape) -> Group {
    let mut r = Random(s.seed);
    let mut header = Header {
        frames: s.frames,
        origin: [-1.5, 0.25, 1e6],
        grid_step: 0.002,
        grid_bits: s.bits,
        sh_degree: s.sh_degree,
        layers: s.counts.iter().map(|n| layer(*n, *n)).collect(),
        tile_side_log2: 4,
        lifetimes: s.lifetimes,
        scale_exponents: [[0, 40, -8], [20, 0, 0], [127, -128, 3]],
        companding: (s.counts.len() > 1).then(|| std::array::from_fn(|c| companding(c as f32))),
        ..Header::default()
    };
    let count: usize = s.counts.iter().sum();
    let mut g = Group {
        positions: s.counts.iter().flat_map(|n| points(&mut r, *n, s.bits)).collect(),
        layers: header.layers.clone(),
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        corrections: s.counts.iter().map(|n| [*n as f32, 0.5 * (n % 2) as f32]).collect(),
        ..Group::default()
    };
    for a in header.attributes() {
        let c = a.channels(s.sh_degree);
        header.scales.push(Scale {
            steps: vec![0.5; c],
            offsets: vec![-1.0; c],
        });
        g.channels.push((0..c * count).map(|_| r.value(s.magnitude)).collect());
    }
    motion(&mut g, &mut header, s, &mut r);
    g.header = header;
    divide(&mut g, None, &mut r);
    g
}

/// Tiles with any bounds.
fn divide(g: &mut Group, reference: Option<&Group>, r: &mut Random) {
    g.divide(reference);
    for tile in g.header.tiles.iter_mut().flatten() {
        let (a, b) = (r.next() as u16, r.next() as u16);
        tile.bounds = [a.min(b), 0, 9, a.max(b), 0, u16::MAX];
    }
}

fn companding(low: f32) -> Companding {
    Companding {
        low,
        width: 0.5,
        slopes: [0, 255, 7, 16, 0, 3, 80, 1],
    }
}

fn layer(count: usize, births: usize) -> LayerHeader {
    LayerHeader {
        count: count as u32,
        births: births as u32,
    }
}

/// Trajectories, nodes and lifetimes, which every group has of its own.
fn motion(g: &mut Group, header: &mut Header, s: &Shape, r: &mut Random) {
    let count = g.positions.len();
    for attribute in Attribute::ALL {
        let channels = attribute.channels(s.sh_degree);
        if channels > 0 && s.moving >> attribute as u8 & 1 != 0 {
            let coefficients = 1 + r.below(u64::from(s.frames)) as u16;
            header.trajectories.push(TrajectoryHeader {
                attribute,
                coefficients,
                step: 0.01,
            });
            g.trajectories
                .push(trajectories(r, count, channels, coefficients, s.magnitude));
        }
    }
    if s.nodes > 0 {
        let coefficients = 1 + r.below(u64::from(s.frames)) as u16;
        let neighbors = 1 + r.below(8) as u8;
        header.nodes = NodeHeader {
            count: s.nodes as u32,
            neighbors,
            coefficients,
            rotation_step: 0.01,
            translation_step: 0.002,
        };
        g.node_positions = points(r, s.nodes, s.bits);
        g.node_trajectories = trajectories(r, s.nodes, 6, coefficients, s.magnitude);
        if s.joints > 0 {
            header.rig = RigHeader {
                joints: s.joints as u8,
                rotation_step: 0.02,
                translation_step: 0.004,
            };
            g.rig = Some(rig(s, r));
        }
    }
    if s.lifetimes {
        let mut life = || {
            let t0 = r.below(u64::from(s.frames)) as u16;
            [t0, t0 + 1 + r.below(u64::from(s.frames - t0)) as u16]
        };
        g.lifetimes = Some((0..count).map(|_| life()).collect());
    }
}

fn rig(s: &Shape, r: &mut Random) -> Rig {
    let values = |r: &mut Random| std::array::from_fn(|_| r.value(s.magnitude));
    let weight = |r: &mut Random| (r.below(2) * r.below(WEIGHT_MAX as u64 + 1)) as u8;
    Rig {
        joints: (0..s.joints)
            .map(|_| std::array::from_fn(|_| r.value(s.magnitude)))
            .collect(),
        parents: (0..s.joints as u64).map(|j| r.below(j + 1) as u8).collect(),
        bind: (0..s.joints).map(|_| values(r)).collect(),
        weights: (0..s.nodes * s.joints).map(|_| weight(r)).collect(),
        poses: trajectories(r, s.joints, CHANNELS, s.frames, s.magnitude),
    }
}

/// A group predicted from `reference`: some of its Gaussians survive, births follow.
pub fn predicted(reference: &Group, s: &Shape) -> Group {
    let mut r = Random(s.seed ^ 0xABCD);
    let before = &reference.header;
    let mut g = Group {
        channels: vec![Vec::new(); reference.channels.len()],
        corrections: vec![[0.0, 1.0]; before.layers.len()],
        ..Group::default()
    };
    let mut parents = Vec::new();
    for k in 0..before.layers.len() {
        let (all, births) = (r.below(2) == 0, r.below(4) as usize);
        let survivors: Vec<u32> = reference
            .range(k..k + 1)
            .map(|i| i as u32)
            .filter(|_| all || r.below(4) > 0)
            .collect();
        let own = points(&mut r, births, s.bits);
        let known = |p: &u32| reference.positions[*p as usize];
        g.positions.extend(survivors.iter().map(known).chain(own));
        for (k, values) in g.channels.iter_mut().enumerate() {
            let c = before.scales[k].steps.len();
            let rows = survivors
                .iter()
                .flat_map(|p| &reference.channels[k][*p as usize * c..][..c]);
            values.extend(rows);
            values.extend((0..births * c).map(|_| r.value(s.magnitude)));
        }
        g.layers.push(layer(survivors.len() + births, births));
        parents.extend(survivors);
        parents.extend((0..births).map(|_| BIRTH));
    }
    g.parents = Some(parents);
    let mut header = Header {
        frames: s.frames,
        reference: 1 + r.below(3) as u16,
        layers: g.layers.clone(),
        trajectories: Vec::new(),
        nodes: NodeHeader::default(),
        rig: RigHeader::default(),
        lifetimes: s.lifetimes,
        ..before.clone()
    };
    motion(&mut g, &mut header, s, &mut r);
    g.header = header;
    divide(&mut g, Some(reference), &mut r);
    g
}

/// Decoding at level 1, of a group with a reference.
pub fn with(reference: &Group) -> Decoding<'_> {
    Decoding {
        reference: Some(reference),
        ..Decoding::at(&LEVELS[0])
    }
}

/// The shape of `small`, with layers.
pub fn layered() -> Shape {
    Shape {
        counts: vec![6, 3, 5],
        frames: 5,
        bits: 6,
        sh_degree: 1,
        nodes: 3,
        joints: 2,
        magnitude: 6,
        lifetimes: true,
        moving: 0xFF,
        seed: 11,
    }
}

/// The shape of a group of several tiles in its first layer.
pub fn tiled() -> Shape {
    Shape {
        counts: vec![900, 300],
        seed: 19,
        moving: 0b110,
        ..layered()
    }
}

/// A group with every kind of unit, small enough to damage byte by byte.
pub fn small() -> Group {
    group(&Shape {
        counts: vec![12],
        frames: 5,
        bits: 6,
        sh_degree: 1,
        nodes: 3,
        joints: 2,
        magnitude: 6,
        lifetimes: true,
        moving: 0xFF,
        seed: 7,
    })
}
