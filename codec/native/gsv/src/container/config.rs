//! gsvC (spec 2.3) and the frame rate: the configuration of the whole file.

use super::audio::AudioTrack;
use super::placement::Placement;
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader, Writer};
use crate::levels::Level;

/// Names of `up_axis` values.
pub const UP_AXES: [&str; 6] = ["x", "y", "z", "-x", "-y", "-z"];
/// Names of `color_space` values.
pub const COLOR_SPACES: [&str; 1] = ["srgb"];
/// Default near plane of a camera, where the file gives none, world units.
pub const NEAR: f32 = 0.01;
/// Default low-pass of a camera, where the file gives none, px^2: the value of 3D Gaussian Splatting.
pub const LOW_PASS: f32 = 0.3;

/// A reference camera: OpenCV axes, pixel centres at half-integers.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    pub name: String,
    pub width: u32,
    pub height: u32,
    /// fx, skew, cx, fy, cy.
    pub k: [f32; 5],
    /// The upper three rows of world-to-camera.
    pub viewmat: [f32; 12],
    /// Gaussians whose centre is nearer than this are not drawn, world units.
    pub near: f32,
    /// Variance of the low-pass filter of rendering, px^2.
    pub low_pass: f32,
}

impl Default for Camera {
    fn default() -> Camera {
        Camera {
            name: String::new(),
            width: 0,
            height: 0,
            k: [0.0; 5],
            viewmat: [0.0; 12],
            near: NEAR,
            low_pass: LOW_PASS,
        }
    }
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct Config {
    /// Units a second (mdhd); a frame lasts `frame_duration` units.
    pub timescale: u32,
    pub frame_duration: u32,
    pub level: u8,
    pub metres_per_unit: f32,
    pub up_axis: u8,
    pub color_space: u8,
    pub background: [f32; 3],
    pub sh_degree: u8,
    pub cameras: Vec<Camera>,
    /// Not in gsvC: a track of its own (spec 2.7).
    pub audio: Option<AudioTrack>,
    /// Index of the track among the gsv tracks of the file. Not in gsvC.
    pub track: usize,
    /// gsvT.
    pub placement: Placement,
}

impl Config {
    /// Parses the body of gsvC; the timescale is that of mdhd.
    pub fn read(body: &[u8], timescale: u32) -> Result<Config> {
        let mut config = Config {
            timescale,
            ..Config::default()
        };
        config.fields(&mut Reader::new(body))?;
        Ok(config)
    }

    /// The body of gsvC.
    pub fn write(&self) -> Result<Vec<u8>> {
        let mut w = Writer::default();
        self.clone().fields(&mut w)?;
        w.must(self.timescale > 0, || "a timescale > 0".into())?;
        Ok(w.0)
    }

    fn fields<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        let mut version = 4;
        f.u8(&mut version)?;
        f.must(version == 4, || format!("configuration_version 4, found {version}"))?;
        f.u8(&mut self.level)?;
        Level::get(self.level)?;
        f.u32(&mut self.frame_duration)?;
        f.must(self.frame_duration > 0, || "frame_duration > 0, found 0".into())?;
        f.step(&mut self.metres_per_unit, "metres_per_unit")?;
        choice(f, &mut self.up_axis, UP_AXES.len(), "up_axis")?;
        choice(f, &mut self.color_space, COLOR_SPACES.len(), "color_space")?;
        for v in &mut self.background {
            f.f32(v, "background")?;
            let value = *v;
            f.must((0.0..=1.0).contains(&value), || {
                format!("background of 0 to 1, found {value}")
            })?;
        }
        choice(f, &mut self.sh_degree, 4, "sh_degree")?;
        choice(f, &mut 0, 2, "reserved")?; // sh_frame in drafts 1 to 11, which no decoder followed
        let mut count = self.cameras.len() as u16;
        f.must(usize::from(count) == self.cameras.len(), || {
            "at most 65535 cameras".into()
        })?;
        f.u16(&mut count)?;
        for i in 0..usize::from(count) {
            // one at a time: a false count fails at the end of the bytes, before it takes memory
            if i == self.cameras.len() {
                self.cameras.push(Camera::default());
            }
            camera(f, &mut self.cameras[i])?;
        }
        if f.more() {
            for c in &mut self.cameras {
                f.step(&mut c.near, "near")?;
            }
        }
        if f.more() {
            for c in &mut self.cameras {
                f.step(&mut c.low_pass, "low_pass")?;
            }
        }
        Ok(())
    }
}

fn choice<F: Fields>(f: &mut F, v: &mut u8, count: usize, what: &str) -> Result<()> {
    f.u8(v)?;
    let value = *v;
    f.must(usize::from(value) < count, || {
        format!("{what} of 0 to {}, found {value}", count - 1)
    })
}

fn camera<F: Fields>(f: &mut F, c: &mut Camera) -> Result<()> {
    f.text(&mut c.name, "camera names")?;
    f.u32(&mut c.width)?;
    f.u32(&mut c.height)?;
    f.must(c.width > 0 && c.height > 0, || "cameras of at least one pixel".into())?;
    for v in c.k.iter_mut().chain(&mut c.viewmat) {
        f.f32(v, "camera matrices")?;
    }
    Ok(())
}

/// Frames a second as (timescale, frame_duration): exact for whole numbers and for n * 1000/1001 (29.97), else within
/// 1e-6.
pub fn rate(fps: f64) -> Result<(u32, u32)> {
    if !(1e-3..=1e5).contains(&fps) {
        return Err(Error::Input(format!("expected fps of 0.001 to 100000, got {fps}")));
    }
    let whole = fps.round();
    if (whole - fps).abs() < fps * 1e-9 {
        return Ok((whole as u32, 1));
    }
    let ntsc = (fps * 1.001).round() * 1000.0;
    if (ntsc / 1001.0 - fps).abs() < fps * 5e-5 {
        return Ok((ntsc as u32, 1001));
    }
    let duration = if fps > 1000.0 { 10_000 } else { 1_000_000 };
    Ok(((fps * f64::from(duration)).round() as u32, duration))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_planes_and_low_passes_may_be_missing() {
        let camera = Camera {
            width: 1,
            height: 1,
            near: 0.75,
            low_pass: 0.1,
            ..Camera::default()
        };
        let config = Config {
            timescale: 30,
            frame_duration: 1,
            level: 1,
            metres_per_unit: 1.0,
            cameras: vec![camera.clone(), camera],
            ..Config::default()
        };
        let body = config.write().unwrap();
        assert_eq!(Config::read(&body, 30).unwrap(), config);
        let cut = |bytes: usize| Config::read(&body[..body.len() - bytes], 30);
        let [draft_12, older] = [8, 16].map(|bytes| cut(bytes).unwrap().cameras);
        assert!(draft_12.iter().all(|c| (c.near, c.low_pass) == (0.75, LOW_PASS)));
        assert!(older.iter().all(|c| (c.near, c.low_pass) == (NEAR, LOW_PASS)));
        assert!(cut(4).is_err() && cut(12).is_err());
    }
}
