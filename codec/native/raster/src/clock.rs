//! A stopwatch in milliseconds. Bare WebAssembly has no clock: all times are 0 there.

#[cfg(not(target_family = "wasm"))]
#[derive(Clone, Copy)]
pub struct Clock(std::time::Instant);

#[cfg(not(target_family = "wasm"))]
impl Clock {
    pub fn start() -> Clock {
        Clock(std::time::Instant::now())
    }

    pub fn ms(self) -> f64 {
        self.0.elapsed().as_secs_f64() * 1e3
    }
}

#[cfg(target_family = "wasm")]
#[derive(Clone, Copy)]
pub struct Clock;

#[cfg(target_family = "wasm")]
impl Clock {
    pub fn start() -> Clock {
        Clock
    }

    pub fn ms(self) -> f64 {
        0.0
    }
}
