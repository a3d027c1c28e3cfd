//! gsvT (spec 2.8): the name of a track, and where and when it is shown in the scene.

use crate::error::Result;
use crate::fields::{Fields, Reader, Writer};
use crate::pose::Pose;

/// The transform of a track at a time.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Key {
    /// Time of the scene, units of the track's timescale.
    pub time: i32,
    pub pose: Pose,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Placement {
    pub hidden: bool,
    pub name: String,
    /// Time of the scene at which frame 0 is shown, units of the track's timescale.
    pub offset: i32,
    /// How often the track is played; 0: without end.
    pub repeats: u32,
    /// In order of time.
    pub keys: Vec<Key>,
}

impl Default for Placement {
    fn default() -> Placement {
        Placement {
            hidden: false,
            name: String::new(),
            offset: 0,
            repeats: 1,
            keys: Vec::new(),
        }
    }
}

impl Placement {
    /// Parses the body of gsvT.
    pub fn read(body: &[u8]) -> Result<Placement> {
        let mut placement = Placement::default();
        placement.fields(&mut Reader::new(body))?;
        Ok(placement)
    }

    /// The body of gsvT.
    pub fn write(&self) -> Result<Vec<u8>> {
        let mut w = Writer::default();
        self.clone().fields(&mut w)?;
        Ok(w.0)
    }

    fn fields<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        let mut flags = u8::from(self.hidden);
        f.u8(&mut flags)?;
        self.hidden = flags & 1 != 0;
        f.text(&mut self.name, "track names")?;
        let mut offset = self.offset as u32;
        f.u32(&mut offset)?;
        self.offset = offset as i32;
        f.u32(&mut self.repeats)?;
        let mut count = self.keys.len() as u16;
        f.must(usize::from(count) == self.keys.len(), || "at most 65535 keys".into())?;
        f.u16(&mut count)?;
        let mut last = None;
        for i in 0..usize::from(count) {
            // one at a time: a false count fails at the end of the bytes, before it takes memory
            if i == self.keys.len() {
                self.keys.push(Key::default());
            }
            key(f, &mut self.keys[i])?;
            let time = Some(self.keys[i].time);
            f.must(time > last, || "keys in the order of their times".into())?;
            last = time;
        }
        Ok(())
    }

    /// The transform at time `u` of the scene, in units of the track's timescale.
    pub fn pose(&self, u: f64) -> Pose {
        let behind = self.keys.partition_point(|k| f64::from(k.time) <= u);
        let before = behind.checked_sub(1).and_then(|i| self.keys.get(i));
        match (before, self.keys.get(behind)) {
            (Some(a), Some(b)) => {
                let (from, to) = (f64::from(a.time), f64::from(b.time));
                Pose::between(&a.pose, &b.pose, ((u - from) / (to - from)) as f32)
            }
            (Some(k), None) | (None, Some(k)) => k.pose,
            (None, None) => Pose::default(),
        }
    }
}

fn key<F: Fields>(f: &mut F, key: &mut Key) -> Result<()> {
    let mut time = key.time as u32;
    f.u32(&mut time)?;
    key.time = time as i32;
    for v in &mut key.pose.rotation {
        f.f32(v, "rotation")?;
    }
    let length: f32 = key.pose.rotation.iter().map(|v| v * v).sum();
    f.must((0.998..=1.002).contains(&length), || {
        format!("a rotation whose squared length is 0.998 to 1.002, found {length}")
    })?;
    for v in &mut key.pose.translation {
        f.f32(v, "translation")?;
    }
    f.step(&mut key.pose.scale, "scale")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn placed() -> Placement {
        let pose = |angle: f32, x: f32, scale| Pose {
            rotation: [(angle / 2.0).cos(), 0.0, 0.0, (angle / 2.0).sin()],
            translation: [x, 1.0, 0.0],
            scale,
        };
        Placement {
            hidden: true,
            name: "männlein".into(),
            offset: -7,
            repeats: 0,
            keys: vec![
                Key {
                    time: -10,
                    pose: pose(0.0, 2.0, 1.0),
                },
                Key {
                    time: 30,
                    pose: pose(1.0, 4.0, 3.0),
                },
            ],
        }
    }

    #[test]
    fn everything_comes_back_and_nothing_else_does() {
        let body = placed().write().unwrap();
        assert_eq!(Placement::read(&body).unwrap(), placed());
        for n in 0..body.len() {
            assert!(Placement::read(&body[..n]).is_err(), "{n}");
        }
        let mut unordered = placed();
        unordered.keys[1].time = -10;
        assert!(unordered.write().is_err());
    }

    #[test]
    fn between_keys_it_is_interpolated() {
        let p = placed();
        assert_eq!(p.pose(-99.0), p.keys[0].pose);
        assert_eq!(p.pose(30.0), p.keys[1].pose);
        let half = p.pose(10.0);
        assert!((half.rotation[3] - 0.25f32.sin()).abs() < 1e-6);
        assert_eq!((half.translation, half.scale), ([3.0, 1.0, 0.0], 2.0));
        assert_eq!(Placement::default().pose(5.0), Pose::default());
    }
}
