//! Answers to the host as JSON.

use gsv::container::audio::{AudioRun, AudioTrack};
use gsv::container::config::{COLOR_SPACES, Camera, Config, UP_AXES};
use gsv::container::demux::Demuxer;
use gsv::container::entry::Entry;
use gsv::header::Header;
use gsv::tile_bounds;
use gsv::unit::{self, UnitType};
use std::fmt::Write;

/// {config, tracks, groups, pending, index, layers, complete}; config is null before moov, pending is null except after
/// a moof.
pub fn describe(d: &Demuxer, first: usize) -> String {
    let groups = list(d.groups().iter().skip(first), entry);
    let index = list(d.index().iter(), entry);
    let layers = list(d.layers().iter(), |ends| list(ends.iter(), u64::to_string));
    let pending = d.pending().map_or("null".into(), entry);
    let config = d.config().map_or("null".into(), config);
    format!(
        r#"{{"config":{config},"tracks":{},"groups":{groups},"pending":{pending},"index":{index},"layers":{layers},"complete":{}}}"#,
        d.tracks(),
        d.complete()
    )
}

pub fn header(h: &Header, gaussians: usize) -> String {
    format!(
        r#"{{"frames":{},"gaussians":{gaussians},"sh_degree":{},"layers":{}}}"#,
        h.frames,
        h.sh_degree,
        h.layers.len()
    )
}

/// {header, size, tiles, others}: bytes of the header with the eight before it, and of the payload; of each tile of
/// each layer [gaussians, leading, offset, size, low x, y, z, high x, y, z], its box in world units, null where it is
/// unbounded; of each other unit [layer, offset, size]. Offsets are from the start of the payload.
pub fn index(h: &Header, directory: &[unit::Entry], start: usize) -> String {
    let mut places: Vec<Vec<[usize; 2]>> = h.tiles.iter().map(|t| vec![[0; 2]; t.len()]).collect();
    let (mut others, mut at) = (Vec::new(), start);
    for e in directory {
        let own = places.get_mut(usize::from(e.layer));
        let own = own.and_then(|tiles| tiles.get_mut(usize::from(e.index)));
        match own.filter(|_| e.number == UnitType::Tile as u8) {
            Some(place) => *place = [at, e.size as usize],
            None => others.push(format!("[{},{at},{}]", e.layer, e.size)),
        }
        at = at.saturating_add(e.size as usize);
    }
    let layer = |(k, places): (usize, &Vec<[usize; 2]>)| {
        let leading = h.leading_tiles(k);
        let tile = |(t, [at, size]): (usize, &[usize; 2])| {
            let count = h.tiles[k][t].count;
            let corners = tile_bounds::of(h, k, t).unwrap_or_default();
            let number = |v: &f32| if v.is_finite() { v.to_string() } else { "null".into() };
            let corners = corners.as_flattened().iter().map(number).collect::<Vec<_>>().join(",");
            format!(
                "[{count},{},{at},{size},{corners}]",
                u8::from(leading.contains(&Some(t)))
            )
        };
        format!(
            "[{}]",
            places.iter().enumerate().map(tile).collect::<Vec<_>>().join(",")
        )
    };
    let tiles = places.iter().enumerate().map(layer).collect::<Vec<_>>().join(",");
    format!(
        r#"{{"header":{start},"size":{at},"tiles":[{tiles}],"others":[{}]}}"#,
        others.join(",")
    )
}

fn config(c: &Config) -> String {
    let p = &c.placement;
    let placement = format!(
        r#"{{"name":{},"hidden":{},"offset":{},"repeats":{},"keys":{}}}"#,
        string(&p.name),
        p.hidden,
        p.offset,
        p.repeats,
        p.keys.len()
    );
    let name = |names: &[&str], i: u8| string(names.get(usize::from(i)).copied().unwrap_or_default());
    format!(
        r#"{{"fps":[{},{}],"level":{},"metres_per_unit":{},"up":{},"color_space":{},"background":{},"sh_degree":{},"cameras":{},"audio":{},"placement":{placement}}}"#,
        c.timescale,
        c.frame_duration,
        c.level,
        c.metres_per_unit,
        name(&UP_AXES, c.up_axis),
        name(&COLOR_SPACES, c.color_space),
        list(c.background.iter(), f32::to_string),
        c.sh_degree,
        list(c.cameras.iter(), camera),
        c.audio.as_ref().map_or("null".into(), audio),
    )
}

fn audio(a: &AudioTrack) -> String {
    let entry = list(a.entry.iter(), u8::to_string);
    format!(
        r#"{{"timescale":{},"media_start":{},"entry":{entry}}}"#,
        a.timescale, a.media_start
    )
}

fn run(r: &AudioRun) -> String {
    let samples = list(r.samples.iter(), |(size, duration)| format!("[{size},{duration}]"));
    format!(r#"{{"offset":{},"time":{},"samples":{samples}}}"#, r.offset, r.time)
}

fn camera(c: &Camera) -> String {
    format!(
        r#"{{"name":{},"width":{},"height":{},"k":{},"viewmat":{},"near":{},"low_pass":{}}}"#,
        string(&c.name),
        c.width,
        c.height,
        list(c.k.iter(), f32::to_string),
        list(c.viewmat.iter(), f32::to_string),
        c.near,
        c.low_pass,
    )
}

fn entry(e: &Entry) -> String {
    format!(
        r#"{{"offset":{},"size":{},"start_frame":{},"frames":{},"sync":{},"audio":{}}}"#,
        e.offset,
        e.size,
        e.start_frame,
        e.frames,
        e.sync,
        e.audio.as_ref().map_or("null".into(), run)
    )
}

fn list<'a, T: 'a>(items: impl Iterator<Item = &'a T>, one: impl Fn(&T) -> String) -> String {
    format!("[{}]", items.map(one).collect::<Vec<_>>().join(","))
}

fn string(s: &str) -> String {
    let mut out = String::from('"');
    for c in s.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if c < ' ' => _ = write!(out, "\\u{:04x}", u32::from(c)),
            c => out.push(c),
        }
    }
    out.push('"');
    out
}
