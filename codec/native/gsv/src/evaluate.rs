//! Integers of a group -> f32 attributes of frame t (spec 13).
//!
//! Canonical values are dequantized once. A frame is their copy, or what the nodes make of them where there are nodes, with
//! the trajectories of those Gaussians that have any. Nothing is predicted from the result, so f32 will do.

use crate::attributes::Attribute;
use crate::blend::Blend;
use crate::dequantize::{IDENTITY, Quat, multiply, plus, values};
use crate::group::Group;
use crate::trajectories::Trajectories;
use rayon::prelude::*;

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

/// The buffers of a frame, to be filled. Lengths are those of `Frame`.
pub struct FrameMut<'a> {
    pub means: &'a mut [[f32; 3]],
    pub quats: &'a mut [[f32; 4]],
    pub log_scales: &'a mut [f32],
    pub logit_opacities: &'a mut [f32],
    pub sh0: &'a mut [f32],
    pub sh_n: &'a mut [f32],
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
    canonical: Frame, // means: from the origin of the grid
    motions: Vec<Motion>,
    blend: Blend,
    nodes: Vec<[f32; 3]>, // from the origin of the grid
}

impl Evaluator {
    pub fn new(mut group: Group) -> Evaluator {
        let h = &group.header;
        let place = |p: &[u32; 3]| p.map(|v| h.grid_step * v as i32 as f32); // below 2^21, and signed ones convert faster
        let nodes = group.node_positions.iter().map(place).collect();
        let [scales_shift, opacities_shift] = group.correction();
        let channels = |a, shift| values(h, a, group.channels_of(a).unwrap_or(&[]), shift);
        let (blend, canonical) = rayon::join(
            || Blend::new(&group.positions, &group.node_positions, usize::from(h.nodes.neighbors)),
            || Frame {
                means: group.positions.par_iter().map(place).collect(),
                quats: Vec::new(), // those of the group
                log_scales: channels(Attribute::LogScales, scales_shift),
                logit_opacities: channels(Attribute::LogitOpacities, opacities_shift),
                sh0: colours(channels(Attribute::Sh0, 0.0)),
                sh_n: colours(channels(Attribute::ShN, 0.0)),
            },
        );
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
        let rest = &self.canonical;
        frame.means.resize(rest.means.len(), [0.0; 3]);
        frame.quats.resize(rest.means.len(), [0.0; 4]);
        frame.log_scales.resize(rest.log_scales.len(), 0.0);
        frame.logit_opacities.resize(rest.logit_opacities.len(), 0.0);
        frame.sh0.resize(rest.sh0.len(), 0.0);
        frame.sh_n.resize(rest.sh_n.len(), 0.0);
        let out = FrameMut {
            means: &mut frame.means,
            quats: &mut frame.quats,
            log_scales: &mut frame.log_scales,
            logit_opacities: &mut frame.logit_opacities,
            sh0: &mut frame.sh0,
            sh_n: &mut frame.sh_n,
        };
        self.frame_into(t, out);
    }

    /// Evaluates frame `t` (clamped to the group) into buffers as long as those of `Frame`.
    pub fn frame_into(&self, t: u16, out: FrameMut) {
        let frames = self.group.header.frames;
        let basis = &basis(frames, t.min(frames - 1))[..];
        let rest = &self.canonical;
        let still = [
            (Attribute::LogScales, &rest.log_scales, out.log_scales),
            (Attribute::LogitOpacities, &rest.logit_opacities, out.logit_opacities),
            (Attribute::Sh0, &rest.sh0, out.sh0),
            (Attribute::ShN, &rest.sh_n, out.sh_n),
        ];
        let (means, quats) = (out.means, out.quats);
        rayon::join(
            || {
                self.move_with_nodes(basis, means, quats);
                let motion = |a| self.motions.iter().find(|m| m.attribute == a);
                rayon::join(
                    || motion(Attribute::Quats).map(|m| m.turn(basis, quats)),
                    || motion(Attribute::Means).map(|m| m.add(basis, means.as_flattened_mut(), 3)),
                );
            },
            || {
                still.into_par_iter().for_each(|(attribute, rest, values)| {
                    values.iter_mut().zip(rest).for_each(|(v, r)| *v = *r);
                    if let Some(m) = self.motions.iter().find(|m| m.attribute == attribute) {
                        m.add(basis, values, m.coefficients.channels);
                    }
                });
            },
        );
    }

    /// Spec 13.3.
    fn move_with_nodes(&self, basis: &[f32], means: &mut [[f32; 3]], quats: &mut [Quat]) {
        let (h, origin) = (&self.group.header.nodes, self.group.header.origin);
        let pose = |(j, n): (usize, &[f32; 3])| {
            let [rx, ry, rz, tx, ty, tz] = transform(self.group.node_trajectories.get(j), 6, basis);
            let q = from_rotation_vector([rx, ry, rz].map(|v| v * h.rotation_step));
            pose(q, *n, [tx, ty, tz].map(|v| v * h.translation_step))
        };
        let poses: Vec<Pose> = self.nodes.iter().enumerate().map(pose).collect();
        let moving = Moving {
            aligned: poses.iter().all(|p| p[4][0] > std::f32::consts::FRAC_1_SQRT_2), // each within 45 degrees of 1 (in 4D)
            origin,
            poses,
        };
        let (rest, per) = (&self.canonical, self.blend.per);
        let out = means.par_chunks_mut(RUN).zip(quats.par_chunks_mut(RUN));
        let rest = rest.means.par_chunks(RUN).zip(self.group.rotations.par_chunks(RUN));
        if per == 0 {
            out.zip(rest).for_each(|((x, q), (x0, q0))| {
                x.iter_mut().zip(x0).for_each(|(x, x0)| *x = add(origin, *x0));
                q.iter_mut().zip(q0).for_each(|(q, q0)| *q = *q0);
            });
            return;
        }
        let blend = self
            .blend
            .index
            .par_chunks(RUN * per)
            .zip(self.blend.weight.par_chunks(RUN * per));
        out.zip(rest).zip(blend).for_each(|((out, rest), (index, weight))| {
            if per == 4 {
                moving.run(
                    out,
                    rest,
                    index.as_chunks::<4>().0.iter().zip(weight.as_chunks::<4>().0),
                );
            } else {
                moving.run(out, rest, index.chunks(per).zip(weight.chunks(per)));
            }
        });
    }
}

/// Gaussians of one task.
const RUN: usize = 2048;

/// All nodes at one frame.
struct Moving {
    poses: Vec<Pose>,
    /// No two quaternions of `poses` are more than a right angle apart.
    aligned: bool,
    origin: [f32; 3],
}

impl Moving {
    /// Means and quaternions of Gaussians that rest where `rest` says, by the nodes and weights of each.
    #[inline]
    fn run<I: AsRef<[u32]>, W: AsRef<[f32]>>(
        &self,
        out: (&mut [[f32; 3]], &mut [Quat]),
        rest: (&[[f32; 3]], &[Quat]),
        blend: impl Iterator<Item = (I, W)>,
    ) {
        let (out, rest) = (out.0.iter_mut().zip(out.1), rest.0.iter().zip(rest.1));
        for (((x, q), (x0, q0)), (index, weight)) in out.zip(rest).zip(blend) {
            let (moved, turn) = self.blended(*x0, index.as_ref(), weight.as_ref());
            (*x, *q) = (add(self.origin, moved), multiply(turn, *q0));
        }
    }

    #[inline(always)]
    fn blended(&self, x: [f32; 3], index: &[u32], weight: &[f32]) -> ([f32; 3], Quat) {
        let pose = |j: &u32| self.poses.get(*j as usize).unwrap_or(&REST);
        let first = index.first().map_or(&REST, pose);
        let mut sum: Pose = [[0.0; 4]; 5];
        for (p, w) in index.iter().map(pose).zip(weight) {
            sum.iter_mut().zip(p).for_each(|(s, p)| *s = plus(*s, *w, *p));
            if !self.aligned && dot(p[4], first[4]) < 0.0 {
                sum[4] = plus(sum[4], -2.0 * w, p[4]);
            }
        }
        let [r0, r1, r2, shift, q] = sum;
        let [x, y, z, _] = plus(plus(plus(shift, x[0], r0), x[1], r1), x[2], r2);
        let length = dot(q, q).sqrt();
        if length < 1e-12 {
            return ([x, y, z], first[4]);
        }
        ([x, y, z], q.map(|v| v / length))
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
                *q = normalize(multiply(with_real_part(d.map(|v| v * self.step)), *q));
            }
        }
    }
}

/// Motion of one node at frame t, places counted from the origin of the grid: x -> R (x - n) + n + T as the columns of R and what is
/// added, and the quaternion of R. All of four numbers, so that a blend is a weighted sum of what registers hold.
type Pose = [[f32; 4]; 5];
const REST: Pose = [
    [1.0, 0.0, 0.0, 0.0],
    [0.0, 1.0, 0.0, 0.0],
    [0.0, 0.0, 1.0, 0.0],
    [0.0; 4],
    [1.0, 0.0, 0.0, 0.0],
];

fn pose(q: Quat, centre: [f32; 3], shift: [f32; 3]) -> Pose {
    let mut p = REST;
    for (a, row) in matrix(q).into_iter().enumerate() {
        (0..3).for_each(|b| p[b][a] = row[b]);
        p[3][a] = centre[a] + shift[a] - (0..3).map(|b| row[b] * centre[b]).sum::<f32>();
    }
    p[4] = q;
    p
}

fn dot(a: [f32; 4], b: [f32; 4]) -> f32 {
    (0..4).map(|i| a[i] * b[i]).sum()
}

fn add(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
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
    let mut add = |row: &[i32], b: &f32| row.iter().zip(&mut sum).for_each(|(v, s)| *s += *v as f32 * b);
    if channels == C {
        let rows = coefficients.as_chunks::<C>().0; // of a length that the compiler knows
        rows.iter().zip(basis).for_each(|(row, b)| add(row, b));
    } else {
        let rows = coefficients.chunks(channels.max(1));
        rows.zip(basis).for_each(|(row, b)| add(row, b));
    }
    sum
}

/// A unit quaternion, unless `v` is longer than 1.
fn with_real_part(v: [f32; 3]) -> Quat {
    let w = (1.0 - v.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    [w, v[0], v[1], v[2]]
}

fn normalize(q: Quat) -> Quat {
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
    if length > 0.0 {
        let scale = 1.0 / length;
        q.map(|v| scale * v)
    } else {
        IDENTITY
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
