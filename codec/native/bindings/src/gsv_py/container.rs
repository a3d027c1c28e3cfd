//! Config dicts <-> the container: init segment, fragments, index, demuxer.

use super::placement::{placement_from, placement_into};
use super::values::{bytes_of, invalid, item, optional, raise, value};
use gsv::container::audio::AudioTrack;
use gsv::container::config::{COLOR_SPACES, Camera, Config, LOW_PASS, NEAR, UP_AXES, rate};
use gsv::container::demux::Demuxer;
use gsv::container::whole;
use gsv::container::write::{self, Reference, Sound};
use gsv::levels::Level;
use numpy::{IntoPyArray, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyList};

fn config_from(py: Python, d: &Bound<PyDict>) -> PyResult<Config> {
    let fps = item(d, "fps")?;
    let (timescale, frame_duration) = match fps.extract::<(u32, u32)>() {
        Ok((n, d)) if n > 0 && d > 0 => (n, d),
        Ok(_) => return invalid(format!("fps: expected a positive rational, got {fps}")),
        Err(_) => rate(value(d, "fps")?).map_err(|e| raise(py, e))?,
    };
    let choice = |key: &str, names: &[&str]| -> PyResult<u8> {
        let v: String = value(d, key)?;
        match names.iter().position(|n| *n == v) {
            Some(i) => Ok(i as u8),
            None => invalid(format!("{key}: expected one of {}, got '{v}'", names.join(", "))),
        }
    };
    let mut config = Config {
        timescale,
        frame_duration,
        level: value(d, "level")?,
        metres_per_unit: value(d, "metres_per_unit")?,
        up_axis: choice("up", &UP_AXES)?,
        color_space: choice("color_space", &COLOR_SPACES)?,
        background: value(d, "background")?,
        sh_degree: value(d, "sh_degree")?,
        cameras: Vec::new(),
        audio: optional(d, "audio")?.map(|a| audio_from(&a.extract()?)).transpose()?,
        track: optional(d, "track")?.map_or(Ok(0), |v| v.extract())?,
        placement: placement_from(optional(d, "placement")?)?,
    };
    Level::get(config.level).map_err(|e| PyValueError::new_err(e.to_string()))?;
    if let Some(cameras) = optional(d, "cameras")? {
        for c in cameras.try_iter()? {
            config.cameras.push(camera_from(&c?.extract()?)?);
        }
    }
    Ok(config)
}

fn audio_from(d: &Bound<PyDict>) -> PyResult<AudioTrack> {
    Ok(AudioTrack {
        timescale: value(d, "timescale")?,
        media_start: value(d, "media_start")?,
        entry: value(d, "entry")?,
    })
}

fn audio_into<'py>(py: Python<'py>, a: &AudioTrack) -> PyResult<Bound<'py, PyDict>> {
    let d = PyDict::new(py);
    d.set_item("timescale", a.timescale)?;
    d.set_item("media_start", a.media_start)?;
    d.set_item("entry", PyBytes::new(py, &a.entry))?;
    Ok(d)
}

fn camera_from(d: &Bound<PyDict>) -> PyResult<Camera> {
    let np = d.py().import("numpy")?;
    let matrix = |key: &str, n: usize| -> PyResult<Vec<f64>> {
        let a = np.call_method1("asarray", (item(d, key)?, "float64"))?;
        if a.getattr("shape")?.extract::<Vec<usize>>()? != [n, n] {
            return invalid(format!("camera {key}: expected shape [{n}, {n}]"));
        }
        a.call_method0("ravel")?.call_method0("tolist")?.extract()
    };
    let (k, v) = (matrix("K", 3)?, matrix("viewmat", 4)?);
    if [k[3], k[6], k[7], k[8]] != [0.0, 0.0, 0.0, 1.0] {
        return invalid("camera K: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]]".into());
    }
    if v[12..] != [0.0, 0.0, 0.0, 1.0] {
        return invalid("camera viewmat: expected a last row of 0, 0, 0, 1".into());
    }
    Ok(Camera {
        name: value(d, "name")?,
        width: value(d, "width")?,
        height: value(d, "height")?,
        k: [k[0], k[1], k[2], k[4], k[5]].map(|v| v as f32),
        viewmat: std::array::from_fn(|i| v[i] as f32),
        near: optional(d, "near")?.map_or(Ok(NEAR), |v| v.extract())?,
        low_pass: optional(d, "low_pass")?.map_or(Ok(LOW_PASS), |v| v.extract())?,
    })
}

fn config_into<'py>(py: Python<'py>, c: &Config) -> PyResult<Bound<'py, PyDict>> {
    let name = |names: &[&'static str], i: u8| names.get(usize::from(i)).copied();
    let d = PyDict::new(py);
    d.set_item("fps", (c.timescale, c.frame_duration))?;
    d.set_item("level", c.level)?;
    d.set_item("metres_per_unit", c.metres_per_unit)?;
    d.set_item("up", name(&UP_AXES, c.up_axis))?;
    d.set_item("color_space", name(&COLOR_SPACES, c.color_space))?;
    d.set_item("background", c.background.to_vec())?;
    d.set_item("sh_degree", c.sh_degree)?;
    let cameras = PyList::empty(py);
    for c in &c.cameras {
        let [fx, skew, cx, fy, cy] = c.k.map(f64::from);
        let mut v: Vec<f64> = c.viewmat.iter().map(|v| f64::from(*v)).collect();
        v.extend([0.0, 0.0, 0.0, 1.0]);
        let one = PyDict::new(py);
        one.set_item("name", &c.name)?;
        one.set_item(
            "K",
            vec![fx, skew, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
                .into_pyarray(py)
                .reshape([3, 3])?,
        )?;
        one.set_item("viewmat", v.into_pyarray(py).reshape([4, 4])?)?;
        one.set_item("near", f64::from(c.near))?;
        one.set_item("low_pass", f64::from(c.low_pass))?;
        one.set_item("width", c.width)?;
        one.set_item("height", c.height)?;
        cameras.append(one)?;
    }
    d.set_item("cameras", cameras)?;
    if let Some(audio) = &c.audio {
        d.set_item("audio", audio_into(py, audio)?)?;
    }
    d.set_item("track", c.track)?;
    d.set_item("placement", placement_into(py, &c.placement)?)?;
    Ok(d)
}

/// ftyp and moov, the start of a file. `config`: of its first track; `others`: of its other tracks.
#[pyfunction]
#[pyo3(signature = (config, others = Vec::new()))]
pub fn init_segment<'py>(
    py: Python<'py>,
    config: Bound<'py, PyDict>,
    others: Vec<Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyBytes>> {
    let all = std::iter::once(config).chain(others);
    let configs: Vec<Config> = all.map(|d| config_from(py, &d)).collect::<PyResult<_>>()?;
    let out = write::init_segment(&configs).map_err(|e| raise(py, e))?;
    Ok(PyBytes::new(py, &out))
}

/// moof and mdat of one group; sequence numbers count from 1, frames from 0. `audio`: time, (size, duration) of each
/// sample, and their bytes.
#[pyfunction]
#[pyo3(signature = (payload, sequence_number, start_frame, frames, sync, config, audio = None))]
#[allow(clippy::too_many_arguments, clippy::type_complexity)]
pub fn fragment<'py>(
    py: Python<'py>,
    payload: &Bound<'py, PyAny>,
    sequence_number: u32,
    start_frame: u64,
    frames: u32,
    sync: bool,
    config: &Bound<'py, PyDict>,
    audio: Option<(u64, Vec<(u32, u32)>, Vec<u8>)>,
) -> PyResult<Bound<'py, PyBytes>> {
    let config = config_from(py, config)?;
    let sound = audio.as_ref().map(|(time, samples, data)| Sound {
        time: *time,
        samples,
        data,
    });
    let out = write::fragment(
        bytes_of(payload)?.as_slice()?,
        sequence_number,
        start_frame,
        frames,
        sync,
        &config,
        sound,
    )
    .map_err(|e| raise(py, e))?;
    Ok(PyBytes::new(py, &out))
}

/// An index entry: fragment size, frames, sync, and bytes of the fragment that end with each layer.
type IndexEntry = (u64, u32, bool, Vec<u64>);

/// The part of a finished file in front of the fragments: `init` and an index of each track.
#[pyfunction]
pub fn finish<'py>(
    py: Python<'py>,
    init: &Bound<'py, PyAny>,
    tracks: Vec<Vec<IndexEntry>>,
) -> PyResult<Bound<'py, PyBytes>> {
    let init = bytes_of(init)?;
    let init = init.as_slice()?;
    let mut demuxers = Vec::new();
    for number in 0..tracks.len() {
        let mut demuxer = Demuxer::of_track(number);
        demuxer.push(init).map_err(|e| raise(py, e))?;
        demuxers.push(demuxer);
    }
    let reference = |(size, frames, sync, layers)| Reference {
        size,
        frames,
        sync,
        layers,
    };
    let indexed: Vec<_> = demuxers
        .iter()
        .zip(tracks)
        .filter_map(|(d, index)| Some((d.config()?, index.into_iter().map(reference).collect())))
        .collect();
    if indexed.len() != demuxers.len() {
        return invalid("expected an init segment".into());
    }
    let out = write::finish(init, &indexed).map_err(|e| raise(py, e))?;
    Ok(PyBytes::new(py, &out))
}

/// How many gsv tracks a file has; only moov is read.
#[pyfunction]
pub fn track_count(py: Python, buffer: &Bound<PyAny>) -> PyResult<usize> {
    whole::tracks(bytes_of(buffer)?.as_slice()?).map_err(|e| raise(py, e))
}

/// Config and groups of a track of a file, given as any object with the buffer protocol; only headers are read. Not
/// strict: an index recovers groups behind damaged headers; `damage` lists group and message.
#[pyfunction]
#[pyo3(signature = (buffer, strict = true, track = 0))]
pub fn demux<'py>(
    py: Python<'py>,
    buffer: &Bound<'py, PyAny>,
    strict: bool,
    track: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let data = bytes_of(buffer)?;
    let (demuxer, damage) = whole::read(data.as_slice()?, strict, track).map_err(|e| raise(py, e))?;
    let Some(config) = demuxer.config() else {
        return invalid("expected a config".into());
    };
    let d = PyDict::new(py);
    d.set_item("config", config_into(py, config)?)?;
    let groups = PyList::empty(py);
    for g in demuxer.groups() {
        let one = PyDict::new(py);
        one.set_item("offset", g.offset)?;
        one.set_item("size", g.size)?;
        one.set_item("start_frame", g.start_frame)?;
        one.set_item("frames", g.frames)?;
        one.set_item("sync", g.sync)?;
        if let Some(run) = &g.audio {
            one.set_item("audio", (run.offset, run.time, run.samples.clone()))?;
        }
        groups.append(one)?;
    }
    d.set_item("groups", groups)?;
    d.set_item("complete", demuxer.complete())?;
    let damage: Vec<(usize, String)> = damage.into_iter().map(|(i, e)| (i, e.to_string())).collect();
    d.set_item("damage", damage)?;
    Ok(d)
}

/// The audio track of a fragmented MP4 of sound alone: timescale, media_start, entry, and samples as (offset, size,
/// duration).
#[pyfunction]
pub fn read_audio<'py>(py: Python<'py>, buffer: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyDict>> {
    let data = bytes_of(buffer)?;
    let (track, runs) = whole::read_audio(data.as_slice()?).map_err(|e| raise(py, e))?;
    let mut samples = Vec::new();
    for run in runs {
        let mut at = run.offset;
        for (size, duration) in run.samples {
            samples.push((at, size, duration));
            at += u64::from(size);
        }
    }
    let d = audio_into(py, &track)?;
    d.set_item("samples", samples)?;
    Ok(d)
}
