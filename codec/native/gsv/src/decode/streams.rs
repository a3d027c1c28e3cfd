//! Streams -> integers (spec 8 to 10 and 12): positions, deaths, channels, trajectories and lifetimes.
//!
//! In: the bytes of one stream with its model. Out: its values, or an error that names the stream and its offset.
//! Trajectories count against the symbols that the level has left.

use super::GroupDecoder;
use crate::channels;
use crate::deaths;
use crate::error::{Error, Result};
use crate::lifetimes;
use crate::morton;
use crate::neighbors::{self, Near};
use crate::positions;
use crate::range_coder::Decoder;
use crate::tile::{Stream, StreamModel};
use crate::trajectories::{self, Stop, Trajectories};
use crate::values::MAX_VALUE;
use std::sync::atomic::Ordering;

/// The bytes of a stream, with its offset and label for messages.
pub struct Source<'a> {
    pub bytes: &'a [u8],
    pub offset: usize,
    pub label: String,
}

impl Source<'_> {
    pub fn fail<T>(&self, expected: impl Into<String>) -> Result<T> {
        Err(Error::bitstream(self.offset, &*self.label, expected))
    }

    /// Checks that the bytes are used up and that no forbidden value was read (`sound`).
    pub fn finish(&self, c: Decoder, sound: bool) -> Result<()> {
        let end = self.offset + self.bytes.len();
        match c.finish() {
            Err(expected) if sound || expected.starts_with("more") => {
                Err(Error::bitstream(end, &*self.label, expected))
            }
            _ if !sound => self.fail("values within the range of spec 6.5 and 10"),
            _ => Ok(()),
        }
    }
}

/// The content of a stream other than positions and deaths.
pub enum Part {
    Channels(usize, Vec<i32>),
    Trajectories(usize, Trajectories),
    Lifetimes(Vec<[u16; 2]>),
}

impl GroupDecoder<'_> {
    /// Decodes points without their lowest `shift` bits.
    pub fn points(&self, source: &Source, model: &mut StreamModel, count: u32, shift: u32) -> Result<Vec<[u32; 3]>> {
        let StreamModel::Positions(model) = model else {
            return Ok(Vec::new());
        };
        let bits = u32::from(self.header.grid_bits) - shift;
        let codes = match positions::decode(model, source.bytes, count, bits) {
            Ok(codes) => codes,
            Err(expected) => {
                let end = source.offset + source.bytes.len();
                return Err(Error::bitstream(end, &*source.label, expected));
            }
        };
        let points = codes.into_iter().map(morton::decode);
        Ok(points.map(|p| p.map(|v| v << shift)).collect())
    }

    /// Indices of the survivors among the Gaussians `range` of the reference. `source`: the stream of deaths; None: all
    /// survive.
    pub fn survivors(&self, range: std::ops::Range<usize>, source: Option<Source>, told: u32) -> Result<Vec<u32>> {
        let (Some(r), Some(source)) = (self.reference, source) else {
            return Ok((range.start as u32..range.end as u32).collect());
        };
        let positions = r.positions.get(range.clone()).unwrap_or(&[]);
        let mut c = Decoder::new(source.bytes);
        let mut dead = vec![false; positions.len()];
        let sound = deaths::code(&mut c, &neighbors::nearest(positions), &mut dead);
        source.finish(c, sound)?;
        let alive = (range.start as u32..).zip(&dead).filter(|(_, dead)| !**dead);
        let survivors: Vec<u32> = alive.map(|(i, _)| i).collect();
        if survivors.len() != told as usize {
            return source.fail(format!(
                "{told} survivors as the header says, found {}",
                survivors.len()
            ));
        }
        Ok(survivors)
    }

    /// Decodes a stream other than positions and deaths.
    pub fn part(
        &self,
        k: usize,
        stream: Stream,
        source: &Source,
        near: &[Near],
        model: &mut StreamModel,
    ) -> Result<Option<Part>> {
        let h = self.header;
        let mut c = Decoder::new(source.bytes);
        let (part, sound) = match (stream, model) {
            (Stream::Channels(i, a), StreamModel::Channels(model)) => {
                let mut values = vec![0; near.len() * a.channels(h.sh_degree)];
                let read = channels::code(&mut c, model, near, &mut values);
                let shift = h.shift(k, a);
                let fit = values.iter().all(|v| v.abs() <= MAX_VALUE >> shift);
                values.iter_mut().for_each(|v| *v <<= shift);
                (Part::Channels(i, values), read && fit)
            }
            (Stream::Lifetimes, StreamModel::Lifetimes(model)) => {
                let mut l = vec![[0; 2]; near.len()];
                let sound = lifetimes::code(&mut c, model, h.frames, near, &mut l);
                (Part::Lifetimes(l), sound)
            }
            (Stream::Trajectories(i), StreamModel::Trajectories(model)) => {
                let Some(head) = h.trajectories.get(i) else {
                    return Ok(None);
                };
                let blank = Trajectories::new(head.attribute.channels(h.sh_degree));
                let most = usize::from(head.coefficients);
                let t = trajectories::code(&mut c, model, most, near, &blank, self.budget());
                let (t, sound) = self.count(t, &source.label)?;
                (Part::Trajectories(i, t), sound)
            }
            _ => return Ok(None),
        };
        source.finish(c, sound)?;
        Ok(Some(part))
    }

    /// Symbols left for a stream. Several streams may see the same number; `count` enforces the cap.
    fn budget(&self) -> u64 {
        self.how
            .level
            .symbols
            .saturating_sub(self.symbols.load(Ordering::Relaxed))
    }

    /// Adds the symbols of decoded trajectories to the total and checks the cap. False: the stream is broken.
    fn count(&self, t: std::result::Result<Trajectories, Stop>, label: &str) -> Result<(Trajectories, bool)> {
        let symbols = match &t {
            Ok(t) => t.symbols() as u64,
            Err(Stop::Symbols) => self.how.level.symbols + 1,
            Err(Stop::Broken) => return Ok((Trajectories::default(), false)),
        };
        let before = self.symbols.fetch_add(symbols, Ordering::Relaxed);
        let sum = before.saturating_add(symbols);
        self.how.level.cap(label, "symbols", sum, self.how.level.symbols)?;
        Ok((t.unwrap_or_default(), true))
    }
}
