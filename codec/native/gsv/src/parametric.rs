//! Canonical Gaussians, nodes and trajectories -> f32 attributes of frame t (spec 13).
//!
//! The only evaluation in the product: for decoded groups (coefficients are integers times a step) and for trained or
//! fitted groups (coefficients are floats). Decoding of integers does not depend on its result, so f32 is enough.

use crate::attributes::Attribute;
use crate::blend::Blend;
use crate::dequantize::{IDENTITY, Quat, multiply};
use crate::harmonics;
use crate::parallel::join;
use crate::rig::CHANNELS;
use crate::rigid_blend::{RigidBlend, from_rotation_vector, pose};
use crate::skinning::{Skinning, rotate};
use crate::trajectories::Trajectories;
use rayon::prelude::*;

const CHANNELS_MAX: usize = 45; // of shN at degree 3
/// Gaussians of one task.
const RUN: usize = 2048;

/// Attributes of all N Gaussians in one frame, in the layout of `codec.model.gaussians.Gaussians`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Frame {
    pub means: Vec<[f32; 3]>,
    pub quats: Vec<[f32; 4]>,
    pub log_scales: Vec<f32>,      // [N, 3]
    pub logit_opacities: Vec<f32>, // [N]
    pub sh0: Vec<f32>,             // [N, 3]
    pub sh_n: Vec<f32>,            // [N, K, 3]
}

impl Frame {
    /// Makes room for as many Gaussians as `other` has.
    pub fn resize_as(&mut self, other: &Frame) {
        self.means.resize(other.means.len(), [0.0; 3]);
        self.quats.resize(other.means.len(), [0.0; 4]);
        self.log_scales.resize(other.log_scales.len(), 0.0);
        self.logit_opacities.resize(other.logit_opacities.len(), 0.0);
        self.sh0.resize(other.sh0.len(), 0.0);
        self.sh_n.resize(other.sh_n.len(), 0.0);
    }

    /// Its buffers, to be filled.
    pub fn as_mut(&mut self) -> FrameMut<'_> {
        FrameMut {
            means: &mut self.means,
            quats: &mut self.quats,
            log_scales: &mut self.log_scales,
            logit_opacities: &mut self.logit_opacities,
            sh0: &mut self.sh0,
            sh_n: &mut self.sh_n,
        }
    }
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

/// A coefficient of a trajectory, in units of its step.
pub trait Coefficient: Copy + Default + PartialEq + Send + Sync {
    fn to_f32(self) -> f32;
}

impl Coefficient for i32 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self as f32
    }
}

impl Coefficient for f32 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self
    }
}

/// Trajectories of one attribute, with the Gaussians that have any.
pub struct AttributeMotion<V> {
    attribute: Attribute,
    step: f32,
    /// Colours are Y, Co, Cg (spec 13.5).
    decorrelated: bool,
    pub coefficients: Trajectories<V>,
    moving: Vec<u32>,
}

impl<V: Coefficient> AttributeMotion<V> {
    pub fn new(attribute: Attribute, step: f32, decorrelated: bool, coefficients: Trajectories<V>) -> Self {
        let moving = (0..coefficients.len()).filter(|i| !coefficients.get(*i).is_empty());
        AttributeMotion {
            attribute,
            step,
            decorrelated: decorrelated && matches!(attribute, Attribute::Sh0 | Attribute::ShN),
            moving: moving.map(|i| i as u32).collect(),
            coefficients,
        }
    }

    /// Adds the trajectories at one frame to `values`, `channels` per Gaussian. `basis`: DCT basis at the frame.
    fn add(&self, basis: &[f32], values: &mut [f32], channels: usize) {
        for &i in &self.moving {
            let mut d: [f32; CHANNELS_MAX] = transform(self.coefficients.get(i as usize), channels, basis);
            if self.decorrelated {
                let colours = d.as_chunks_mut().0.iter_mut().take(channels / 3);
                colours.for_each(|c| *c = rgb(*c)); // linear, so it can be applied to the difference
            }
            let from = i as usize * channels;
            let own = values.get_mut(from..from + channels).unwrap_or_default();
            own.iter_mut().zip(&d).for_each(|(v, d)| *v += self.step * d);
        }
    }

    fn rotate(&self, basis: &[f32], quats: &mut [Quat]) {
        for &i in &self.moving {
            let d: [f32; 3] = transform(self.coefficients.get(i as usize), 3, basis);
            if let Some(q) = quats.get_mut(i as usize) {
                *q = normalize(multiply(with_real_part(d.map(|v| v * self.step)), *q));
            }
        }
    }
}

/// A rig, and the poses of its joints.
pub struct RigMotion<'a> {
    pub skinning: &'a Skinning,
    /// [J] of rotation vector and translation.
    pub poses: &'a Trajectories,
    /// Radians and world units.
    pub steps: [f32; 2],
}

/// The channels of a rotation vector and a translation in units of their steps.
fn scaled([a, b, c, x, y, z]: [f32; 6], [rotation, translation]: [f32; 2]) -> [f32; 6] {
    let [a, b, c] = [a, b, c].map(|v| v * rotation);
    let [x, y, z] = [x, y, z].map(|v| v * translation);
    [a, b, c, x, y, z]
}

impl RigMotion<'_> {
    /// Positions of `nodes` as the rig carries them, and their rotations.
    fn carry(&self, basis: &[f32], nodes: &[[f32; 3]]) -> (Vec<[f32; 3]>, Vec<Quat>) {
        let at = |j| scaled(transform(self.poses.get(j), CHANNELS, basis), self.steps);
        let poses: Vec<[f32; CHANNELS]> = (0..self.poses.len()).map(at).collect();
        self.skinning.carry(&poses, nodes)
    }
}

/// All inputs of the evaluation of a frame.
pub struct Parametric<'a, V> {
    pub frames: u16,
    /// Added to all means.
    pub origin: [f32; 3],
    /// Canonical attributes; means relative to the origin; its quats are not read.
    pub rest: &'a Frame,
    pub rotations: &'a [Quat],
    pub blend: &'a Blend,
    /// [M] rest positions, relative to the origin.
    pub nodes: &'a [[f32; 3]],
    /// [M] of 6 channels: rotation vector, translation; the residual of the motion that the rig predicts.
    pub node_motion: &'a Trajectories<V>,
    /// Radians and world units.
    pub node_steps: [f32; 2],
    pub rig: Option<RigMotion<'a>>,
    pub motions: &'a [AttributeMotion<V>],
    /// Spherical harmonics rotate with the nodes.
    pub turned: bool,
}

impl<V: Coefficient> Parametric<'_, V> {
    /// Evaluates frame `t` (clamped to the group) into buffers as long as those of `Frame`.
    pub fn frame_into(&self, t: u16, out: &mut FrameMut) {
        let turns = self.frame_at_rest(t, out);
        harmonics::turn(out.sh_n, &turns);
    }

    /// As `frame_into`, but spherical harmonics are not rotated: returns the rotations to apply to them; empty: none.
    pub fn frame_at_rest(&self, t: u16, out: &mut FrameMut) -> Vec<Quat> {
        let basis = &basis(self.frames, t.min(self.frames.saturating_sub(1)))[..];
        let rest = self.rest;
        let still = [
            (Attribute::LogScales, &rest.log_scales, &mut *out.log_scales),
            (
                Attribute::LogitOpacities,
                &rest.logit_opacities,
                &mut *out.logit_opacities,
            ),
            (Attribute::Sh0, &rest.sh0, &mut *out.sh0),
            (Attribute::ShN, &rest.sh_n, &mut *out.sh_n),
        ];
        let (means, quats) = (&mut *out.means, &mut *out.quats);
        join(
            || self.carry_at(basis, means, quats),
            || {
                still.into_par_iter().for_each(|(attribute, rest, values)| {
                    values.iter_mut().zip(rest).for_each(|(v, r)| *v = *r);
                    if let Some(m) = self.motion(attribute) {
                        m.add(basis, values, m.coefficients.channels);
                    }
                });
            },
        );
        let mut turns = Vec::new();
        if self.turned && self.blend.per > 0 && !out.sh_n.is_empty() {
            let by_nodes = |(q, own): (&Quat, &Quat)| multiply(*q, [own[0], -own[1], -own[2], -own[3]]);
            turns.extend(out.quats.iter().zip(self.rotations).map(by_nodes));
        }
        self.add_residuals(basis, out.means, out.quats);
        turns
    }

    /// Means and quaternions alone, of frame `t`.
    pub fn moved_into(&self, t: u16, means: &mut [[f32; 3]], quats: &mut [Quat]) {
        let basis = &basis(self.frames, t.min(self.frames.saturating_sub(1)))[..];
        self.carry_at(basis, means, quats);
        self.add_residuals(basis, means, quats);
    }

    fn motion(&self, attribute: Attribute) -> Option<&AttributeMotion<V>> {
        self.motions.iter().find(|m| m.attribute == attribute)
    }

    fn carry_at(&self, basis: &[f32], means: &mut [[f32; 3]], quats: &mut [Quat]) {
        let own = |i: usize| self.rotations.get(i).copied().unwrap_or(IDENTITY);
        self.carry(basis, (means, quats), |i, q| multiply(q, own(i)));
    }

    fn add_residuals(&self, basis: &[f32], means: &mut [[f32; 3]], quats: &mut [Quat]) {
        join(
            || self.motion(Attribute::Quats).map(|m| m.rotate(basis, quats)),
            || {
                self.motion(Attribute::Means)
                    .map(|m| m.add(basis, means.as_flattened_mut(), 3))
            },
        );
    }

    /// Motion by the nodes alone at frame `t`: carried position and rotation of each Gaussian.
    pub fn carried_into(&self, t: u16, means: &mut [[f32; 3]], rotations: &mut [Quat]) {
        let basis = &basis(self.frames, t.min(self.frames.saturating_sub(1)))[..];
        self.carry(basis, (means, rotations), |_, q| q);
    }

    /// Spec 13.3. `turned`: index of a Gaussian and the rotation by which it is carried -> the quaternion to be
    /// written.
    fn carry(&self, basis: &[f32], out: (&mut [[f32; 3]], &mut [Quat]), turned: impl Fn(usize, Quat) -> Quat + Sync) {
        let (origin, rest) = (self.origin, &self.rest.means[..]);
        if self.blend.per == 0 {
            let out = out.0.par_chunks_mut(RUN).zip(out.1.par_chunks_mut(RUN));
            out.zip(rest.par_chunks(RUN))
                .enumerate()
                .for_each(|(run, ((x, q), x0))| {
                    x.iter_mut().zip(x0).for_each(|(x, x0)| *x = add(origin, *x0));
                    q.iter_mut()
                        .zip(run * RUN..)
                        .for_each(|(q, i)| *q = turned(i, IDENTITY));
                });
            return;
        }
        let predicted = self.rig.as_ref().map(|rig| rig.carry(basis, self.nodes));
        let pose = |(j, n): (usize, &[f32; 3])| {
            let [rx, ry, rz, tx, ty, tz] = scaled(transform(self.node_motion.get(j), 6, basis), self.node_steps);
            let (q, shift) = (from_rotation_vector([rx, ry, rz]), [tx, ty, tz]);
            let known = predicted.as_ref().and_then(|(x, r)| x.get(j).zip(r.get(j)));
            known.map_or_else(
                || pose(q, *n, shift),
                |(x, r)| {
                    let shift = rotate(*r, shift);
                    pose(multiply(*r, q), *n, std::array::from_fn(|a| x[a] - n[a] + shift[a]))
                },
            )
        };
        let poses = RigidBlend::new(self.nodes.iter().enumerate().map(pose).collect());
        poses.carry(self.blend, rest, out, |i, x, q| (add(origin, x), turned(i, q)));
    }
}

fn add(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// Y, Co, Cg -> R, G, B (spec 13.5).
pub fn rgb([y, co, cg]: [f32; 3]) -> [f32; 3] {
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
fn transform<const C: usize, V: Coefficient>(coefficients: &[V], channels: usize, basis: &[f32]) -> [f32; C] {
    let mut sum = [0.0; C];
    let mut add = |row: &[V], b: &f32| row.iter().zip(&mut sum).for_each(|(v, s)| *s += v.to_f32() * b);
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
