//! Integers of a group -> f32 attributes of frame t (spec 13).
//!
//! Canonical values are dequantized once. A frame copies them and adds what moves: the nodes' blend where there are nodes,
//! and the trajectories of those Gaussians that have any. Nothing is predicted from the result, so f32 will do.

use crate::attributes::Attribute;
use crate::blend::Blend;
use crate::group::Group;
use crate::trajectories::Trajectories;
use rayon::prelude::*;

type Quat = [f32; 4]; // wxyz
const CHANNELS_MAX: usize = 45; // of shN at degree 3

/// Attributes of all N Gaussians in one frame, in the layout of `codec.gaussians.Gaussians`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Frame {
    pub means: Vec<[f32; 3]>,
    pub quats: Vec<[f32; 4]>,
    pub log_scales: Vec<f32>,      // [N, 3]
    pub logit_opacities: Vec<f32>, // [N]
    pub sh0: Vec<f32>,             // [N, 3]
    pub sh_n: Vec<f32>,            // [N, K, 3]
}

/// Trajectories of one attribute, with the Gaussians that have any.
struct Motion {
    attribute: Attribute,
    step: f32,
    coefficients: Trajectories,
    moving: Vec<u32>,
}

/// A group made ready to be evaluated at any frame.
pub struct Evaluator {
    group: Group,
    canonical: Frame,
    motions: Vec<Motion>,
    blend: Blend,
    nodes: Vec<[f32; 3]>, // from the origin of the grid
}

impl Evaluator {
    pub fn new(mut group: Group) -> Evaluator {
        let h = &group.header;
        let point = |p: &[u32; 3]| std::array::from_fn(|a| h.origin[a] + h.grid_step * p[a] as f32);
        let nodes = group
            .node_positions
            .iter()
            .map(|p| p.map(|v| h.grid_step * v as f32))
            .collect();
        let blend = Blend::new(&group.positions, &group.node_positions, usize::from(h.nodes.neighbors));
        let canonical = Frame {
            means: group.positions.iter().map(point).collect(),
            quats: dequantized(&group, Attribute::Quats)
                .as_chunks()
                .0
                .iter()
                .map(|v| unit(*v))
                .collect(),
            log_scales: shifted(dequantized(&group, Attribute::LogScales), group.correction()[0]),
            logit_opacities: shifted(dequantized(&group, Attribute::LogitOpacities), group.correction()[1]),
            sh0: colours(dequantized(&group, Attribute::Sh0)),
            sh_n: colours(dequantized(&group, Attribute::ShN)),
        };
        let motion = |(h, coefficients): (&crate::header::TrajectoryHeader, Trajectories)| Motion {
            attribute: h.attribute,
            step: h.step,
            moving: (0..coefficients.len())
                .filter(|i| !coefficients.get(*i).is_empty())
                .map(|i| i as u32)
                .collect(),
            coefficients,
        };
        let trajectories = std::mem::take(&mut group.trajectories);
        let motions = group.header.trajectories.iter().zip(trajectories).map(motion).collect();
        Evaluator {
            group,
            canonical,
            motions,
            blend,
            nodes,
        }
    }

    pub fn group(&self) -> &Group {
        &self.group
    }

    /// Trajectories in the order of the header.
    pub fn trajectories(&self) -> impl Iterator<Item = &Trajectories> {
        self.motions.iter().map(|m| &m.coefficients)
    }

    /// Which Gaussians frame `t` shows; None: all.
    pub fn visible(&self, t: u16) -> Option<Vec<bool>> {
        Some(
            self.group
                .lifetimes
                .as_ref()?
                .iter()
                .map(|[t0, t1]| (*t0..*t1).contains(&t))
                .collect(),
        )
    }

    /// Evaluates frame `t` (clamped to the group) into `frame`, whose buffers are reused.
    pub fn frame(&self, t: u16, frame: &mut Frame) {
        frame.clone_from(&self.canonical);
        let frames = self.group.header.frames;
        let basis = basis(frames, t.min(frames - 1));
        if self.blend.per > 0 {
            self.move_with_nodes(&basis, frame);
        }
        let mut values = [
            (Attribute::Means, frame.means.as_flattened_mut()),
            (Attribute::LogScales, &mut frame.log_scales),
            (Attribute::LogitOpacities, &mut frame.logit_opacities),
            (Attribute::Quats, frame.quats.as_flattened_mut()),
            (Attribute::Sh0, &mut frame.sh0),
            (Attribute::ShN, &mut frame.sh_n),
        ];
        values.par_iter_mut().for_each(|(attribute, values)| {
            let Some(m) = self.motions.iter().find(|m| m.attribute == *attribute) else {
                return;
            };
            if *attribute == Attribute::Quats {
                m.turn(&basis, values.as_chunks_mut().0);
            } else {
                m.add(&basis, values, m.coefficients.channels);
            }
        });
    }

    /// Spec 13.3.
    fn move_with_nodes(&self, basis: &[f32], frame: &mut Frame) {
        let h = &self.group.header.nodes;
        let pose = |(j, n): (usize, &[f32; 3])| {
            let [rx, ry, rz, tx, ty, tz] = transform(self.group.node_trajectories.get(j), 6, basis);
            let q = from_rotation_vector([rx, ry, rz].map(|v| v * h.rotation_step));
            pose(q, *n, [tx, ty, tz].map(|v| v * h.translation_step))
        };
        let poses: Vec<Pose> = self.nodes.iter().enumerate().map(pose).collect();
        let aligned = poses.iter().all(|p| p[12] > std::f32::consts::FRAC_1_SQRT_2); // each within 45 degrees of 1 (in 4D)
        let (per, origin, step) = (self.blend.per, self.group.header.origin, self.group.header.grid_step);
        let near = self.blend.index.par_chunks(per).zip(self.blend.weight.par_chunks(per));
        let out = frame.means.par_iter_mut().zip(&mut frame.quats);
        let rest = near.zip(&self.group.positions);
        out.zip(rest)
            .with_min_len(2048)
            .for_each(|((x, q), ((index, weight), p))| {
                let (moved, turn) = blended(p.map(|v| step * v as f32), &poses, aligned, index, weight);
                *x = std::array::from_fn(|a| origin[a] + moved[a]);
                *q = multiply(turn, *q);
            });
    }
}

impl Motion {
    /// Adds to `values`, `channels` per Gaussian; colours in their decorrelated space (spec 13.5 is linear).
    fn add(&self, basis: &[f32], values: &mut [f32], channels: usize) {
        let colour = matches!(self.attribute, Attribute::Sh0 | Attribute::ShN);
        for &i in &self.moving {
            let mut d: [f32; CHANNELS_MAX] = transform(self.coefficients.get(i as usize), channels, basis);
            if colour {
                d.as_chunks_mut()
                    .0
                    .iter_mut()
                    .take(channels / 3)
                    .for_each(|c| *c = rgb(*c));
            }
            let from = i as usize * channels;
            let own = values.get_mut(from..from + channels).unwrap_or_default();
            own.iter_mut().zip(&d).for_each(|(v, d)| *v += self.step * d);
        }
    }

    fn turn(&self, basis: &[f32], quats: &mut [Quat]) {
        for &i in &self.moving {
            let d: [f32; 3] = transform(self.coefficients.get(i as usize), 3, basis);
            if let Some(q) = quats.get_mut(i as usize) {
                *q = normalize(multiply(unit(d.map(|v| v * self.step)), *q));
            }
        }
    }
}

/// Motion of one node at frame t, places counted from the origin of the grid: three rows of four, x -> R (x - n) + n + T, then the quaternion of R. One array, so that a
/// blend is a weighted sum of arrays.
type Pose = [f32; 16];

fn pose(q: Quat, centre: [f32; 3], shift: [f32; 3]) -> Pose {
    let mut p = [0.0; 16];
    for (a, row) in matrix(q).into_iter().enumerate() {
        p[4 * a..4 * a + 3].copy_from_slice(&row);
        p[4 * a + 3] = centre[a] + shift[a] - (0..3).map(|b| row[b] * centre[b]).sum::<f32>();
    }
    p[12..].copy_from_slice(&q);
    p
}

/// `aligned`: no two quaternions of `poses` are more than a right angle apart.
#[inline]
fn blended(x: [f32; 3], poses: &[Pose], aligned: bool, index: &[u32], weight: &[f32]) -> ([f32; 3], Quat) {
    let first = index.first().and_then(|j| poses.get(*j as usize));
    let Some(first) = first else {
        return (x, [1.0, 0.0, 0.0, 0.0]);
    };
    let mut sum = [0.0; 16];
    for (p, w) in index.iter().filter_map(|j| poses.get(*j as usize)).zip(weight) {
        (0..16).for_each(|a| sum[a] += w * p[a]);
        if !aligned && (12..16).map(|a| p[a] * first[a]).sum::<f32>() < 0.0 {
            (12..16).for_each(|a| sum[a] -= 2.0 * w * p[a]);
        }
    }
    let moved =
        std::array::from_fn(|a| sum[4 * a] * x[0] + sum[4 * a + 1] * x[1] + sum[4 * a + 2] * x[2] + sum[4 * a + 3]);
    let length = (12..16).map(|a| sum[a] * sum[a]).sum::<f32>().sqrt();
    let (from, scale) = if length < 1e-12 {
        (first, 1.0)
    } else {
        (&sum, 1.0 / length)
    };
    (moved, std::array::from_fn(|a| scale * from[12 + a]))
}

/// offset + step * integer, C per Gaussian; empty if the group lacks the attribute.
fn dequantized(group: &Group, a: Attribute) -> Vec<f32> {
    let at = group.header.attributes().iter().position(|b| *b == a);
    let Some((values, scale)) = at.and_then(|k| Some((group.channels.get(k)?, group.header.scales.get(k)?))) else {
        return Vec::new();
    };
    let scales: Vec<(f32, f32)> = scale.steps.iter().copied().zip(scale.offsets.iter().copied()).collect();
    let rows = values.chunks(scales.len().max(1));
    rows.flat_map(|row| {
        row.iter()
            .zip(&scales)
            .map(|(v, (step, offset))| offset + step * *v as f32)
    })
    .collect()
}

/// Spec 10.2: makes up for the layers behind that are not there.
fn shifted(mut values: Vec<f32>, by: f32) -> Vec<f32> {
    if by != 0.0 {
        values.iter_mut().for_each(|v| *v += by);
    }
    values
}

fn colours(mut values: Vec<f32>) -> Vec<f32> {
    values.as_chunks_mut().0.iter_mut().for_each(|c| *c = rgb(*c));
    values
}

/// Y, Co, Cg -> R, G, B (spec 13.5).
fn rgb([y, co, cg]: [f32; 3]) -> [f32; 3] {
    [y + co - cg, y + cg, y - co - cg]
}

/// DCT-II basis functions at frame `t` (spec 13.1), one per frequency.
fn basis(frames: u16, t: u16) -> Vec<f32> {
    let n = f64::from(frames);
    let at = |k: u16| {
        let scale = if k == 0 { 1.0 } else { 2.0f64 };
        ((scale / n).sqrt() * (std::f64::consts::PI * f64::from(2 * u32::from(t) + 1) * f64::from(k) / (2.0 * n)).cos())
            as f32
    };
    (0..frames).map(at).collect()
}

/// Sum over frequencies, per channel; the channels that an attribute lacks are 0.
fn transform<const C: usize>(coefficients: &[i32], channels: usize, basis: &[f32]) -> [f32; C] {
    let mut sum = [0.0; C];
    for (row, b) in coefficients.chunks(channels.max(1)).zip(basis) {
        row.iter().zip(&mut sum).for_each(|(v, s)| *s += *v as f32 * b);
    }
    sum
}

fn unit(v: [f32; 3]) -> Quat {
    let w = (1.0 - v.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    normalize([w, v[0], v[1], v[2]])
}

fn normalize(q: Quat) -> Quat {
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
    if length > 0.0 {
        q.map(|v| v / length)
    } else {
        [1.0, 0.0, 0.0, 0.0]
    }
}

fn from_rotation_vector(r: [f32; 3]) -> Quat {
    let angle = r.iter().map(|v| v * v).sum::<f32>().sqrt();
    let s = if angle > 0.0 { (angle / 2.0).sin() / angle } else { 0.0 };
    [(angle / 2.0).cos(), s * r[0], s * r[1], s * r[2]]
}

fn matrix([w, x, y, z]: Quat) -> [[f32; 3]; 3] {
    [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ]
}

/// Hamilton product.
fn multiply([aw, ax, ay, az]: Quat, [bw, bx, by, bz]: Quat) -> Quat {
    [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
}
