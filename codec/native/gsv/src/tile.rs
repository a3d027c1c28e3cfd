//! A tile (spec 7): up to 128 x 128 cells of the maps of a layer <-> its streams, one for each kind of content.
//!
//! A tile holds survivors of one tile of the reference, or births. Its contexts come from its own Gaussians only. Its
//! models start from the final models of the first tile of the layer with such a stream, so tiles can be decoded in any
//! order.

use crate::attributes::Attribute;
use crate::channels::ChannelModel;
use crate::fields::{Fields, Reader};
use crate::header::Header;
use crate::lifetimes;
use crate::model::Model;
use crate::positions::SplitModel;
use crate::trajectories::{Kind, TrajectoryModel};

/// The content of one stream; trajectories and channels by their index in the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stream {
    Deaths,
    Positions,
    Channels(usize, Attribute),
    Trajectories(usize),
    Lifetimes,
}

impl Stream {
    /// The streams of tile `t` of layer `k`, in order.
    pub fn of(h: &Header, k: usize, t: usize, reference: Option<&Header>) -> Vec<Stream> {
        let mut out = Vec::new();
        if t >= h.survivor_tiles(k) {
            out.push(Stream::Positions);
            out.extend(h.attributes().iter().enumerate().map(|(i, a)| Stream::Channels(i, *a)));
        } else if h.candidates(k, t, reference) > 0 {
            out.push(Stream::Deaths);
        }
        out.extend((0..h.trajectories.len()).map(Stream::Trajectories));
        out.extend(h.lifetimes.then_some(Stream::Lifetimes));
        out
    }

    /// For messages: "channels of sh0".
    pub fn name(self, h: &Header) -> String {
        match self {
            Stream::Deaths => "deaths".into(),
            Stream::Positions => "positions".into(),
            Stream::Channels(_, a) => format!("channels of {}", a.name()),
            Stream::Trajectories(i) => {
                let a = h.trajectories.get(i).map_or("", |t| t.attribute.name());
                format!("trajectories of {a}")
            }
            Stream::Lifetimes => "lifetimes".into(),
        }
    }

    /// Name and attribute, for reports.
    pub fn kind(self, h: &Header) -> (&'static str, Option<Attribute>) {
        match self {
            Stream::Deaths => ("deaths", None),
            Stream::Positions => ("positions", None),
            Stream::Channels(_, a) => ("channels", Some(a)),
            Stream::Trajectories(i) => ("trajectories", h.trajectories.get(i).map(|t| t.attribute)),
            Stream::Lifetimes => ("lifetimes", None),
        }
    }
}

/// Joins streams to the payload of a tile: the sizes of all but the last one, then the streams.
pub fn join(streams: &[Vec<u8>]) -> Vec<u8> {
    let mut out = Vec::new();
    for s in streams.split_last().map_or(&[][..], |(_, others)| others) {
        let groups = (0..5).rev().map(|i| s.len() as u64 >> (7 * i)).skip_while(|v| *v == 0);
        let mut bytes: Vec<u8> = groups.map(|v| v as u8 | 0x80).collect();
        match bytes.last_mut() {
            Some(last) => *last &= 0x7F,
            None => bytes.push(0),
        }
        out.extend(bytes);
    }
    streams.iter().for_each(|s| out.extend_from_slice(s));
    out
}

/// The streams of a tile with their offsets in its payload.
pub type Parts<'a> = Vec<(usize, &'a [u8])>;

/// Splits the payload of a tile into `count` streams; an error has the offset and the expected content.
pub fn split(payload: &[u8], count: usize) -> Result<Parts<'_>, (usize, String)> {
    let mut r = Reader::new(payload);
    let mut sizes = Vec::with_capacity(count);
    for _ in 1..count {
        let size =
            varint(&mut r).ok_or_else(|| (r.position(), "the size of a stream, of at most 5 bytes".to_string()))?;
        sizes.push(size);
    }
    let mut out = Vec::with_capacity(count);
    for i in 0..count {
        let (at, rest) = (r.position(), r.rest());
        let size = sizes.get(i).map_or(rest, |size| *size as usize);
        let missing = || (at, format!("{size} more bytes of a stream, found {rest}"));
        out.push((at, r.take(size).map_err(|_| missing())?));
    }
    match r.rest() {
        0 => Ok(out),
        rest => Err((r.position(), format!("the end of the tile, found {rest} more bytes"))),
    }
}

/// A number of at most 32 bits, in groups of seven, the most significant first.
fn varint(r: &mut Reader) -> Option<u32> {
    let mut v = 0u64;
    for _ in 0..5 {
        let mut byte = 0;
        r.u8(&mut byte).ok()?;
        v = v << 7 | u64::from(byte & 0x7F);
        if byte & 0x80 == 0 {
            return u32::try_from(v).ok();
        }
    }
    None
}

/// The models of the streams of a layer; None: new ones.
#[derive(Clone, Default)]
pub struct Models {
    positions: Option<SplitModel>,
    channels: Vec<Option<ChannelModel>>,
    trajectories: Vec<Option<TrajectoryModel>>,
    lifetimes: Option<Model>,
}

/// The model of one stream.
pub enum StreamModel {
    None,
    Positions(SplitModel),
    Lifetimes(Model),
    Channels(ChannelModel),
    Trajectories(TrajectoryModel),
}

impl Models {
    /// A copy of the model from which a stream starts.
    pub fn of(&self, stream: Stream, h: &Header) -> StreamModel {
        match stream {
            Stream::Deaths => StreamModel::None,
            Stream::Positions => StreamModel::Positions(self.positions.clone().unwrap_or_default()),
            Stream::Lifetimes => StreamModel::Lifetimes(self.lifetimes.clone().unwrap_or_else(lifetimes::model)),
            Stream::Channels(i, a) => {
                let known = self.channels.get(i).cloned().flatten();
                StreamModel::Channels(known.unwrap_or_else(|| ChannelModel::new(a, a.channels(h.sh_degree))))
            }
            Stream::Trajectories(i) => {
                let known = self.trajectories.get(i).cloned().flatten();
                StreamModel::Trajectories(known.unwrap_or_else(|| TrajectoryModel::new(Kind::Gaussians)))
            }
        }
    }

    /// Keeps the final model of a stream, if it is the first of its kind.
    pub fn learn(&mut self, stream: Stream, model: StreamModel) {
        match (stream, model) {
            (_, StreamModel::Positions(mut m)) if self.positions.is_none() => {
                m.settle();
                self.positions = Some(m);
            }
            (_, StreamModel::Lifetimes(mut m)) if self.lifetimes.is_none() => {
                m.settle();
                self.lifetimes = Some(m);
            }
            (Stream::Channels(i, _), StreamModel::Channels(mut m)) => {
                m.settle();
                place(&mut self.channels, i, m);
            }
            (Stream::Trajectories(i), StreamModel::Trajectories(mut m)) => {
                m.settle();
                place(&mut self.trajectories, i, m);
            }
            _ => {}
        }
    }
}

fn place<M: Clone>(models: &mut Vec<Option<M>>, i: usize, model: M) {
    if models.len() <= i {
        models.resize(i + 1, None);
    }
    if let Some(slot) = models.get_mut(i) {
        slot.get_or_insert(model);
    }
}
