//! Fields of headers. A header is declared once, as a function over `Fields`: with `Reader` it reads and checks, with
//! `Writer` it writes.
//!
//! The writer takes each value from the variable that the reader stores it to. Readers are never inlined: headers take
//! no time, and each copy would cost bytes of the page.

use crate::error::{Error, Result};

pub trait Fields {
    fn bytes(&mut self, v: &mut [u8]) -> Result<()>;
    /// The error of a field that breaks a rule.
    fn fail<T>(&self, expected: String) -> Result<T>;

    /// Whether an optional field at the end is there: always when writing.
    fn more(&self) -> bool;

    #[inline(never)]
    fn u8(&mut self, v: &mut u8) -> Result<()> {
        let mut b = [*v];
        self.bytes(&mut b)?;
        *v = b[0];
        Ok(())
    }

    #[inline(never)]
    fn u16(&mut self, v: &mut u16) -> Result<()> {
        let mut b = v.to_be_bytes();
        self.bytes(&mut b)?;
        *v = u16::from_be_bytes(b);
        Ok(())
    }

    #[inline(never)]
    fn u32(&mut self, v: &mut u32) -> Result<()> {
        let mut b = v.to_be_bytes();
        self.bytes(&mut b)?;
        *v = u32::from_be_bytes(b);
        Ok(())
    }

    #[inline(never)]
    fn u64(&mut self, v: &mut u64) -> Result<()> {
        let mut b = v.to_be_bytes();
        self.bytes(&mut b)?;
        *v = u64::from_be_bytes(b);
        Ok(())
    }

    /// A finite f32.
    #[inline(never)]
    fn f32(&mut self, v: &mut f32, what: &str) -> Result<()> {
        let mut b = v.to_be_bytes();
        self.bytes(&mut b)?;
        *v = f32::from_be_bytes(b);
        self.must(v.is_finite(), || format!("{what} to be finite"))
    }

    /// A finite f32 above zero.
    #[inline(never)]
    fn step(&mut self, v: &mut f32, what: &str) -> Result<()> {
        self.f32(v, what)?;
        let value = *v;
        self.must(value > 0.0, || format!("{what} > 0, found {value}"))
    }

    /// Text of at most 255 bytes; `what` names it in messages.
    fn text(&mut self, v: &mut String, what: &str) -> Result<()> {
        let mut bytes = std::mem::take(v).into_bytes();
        let mut length = bytes.len() as u8;
        self.must(usize::from(length) == bytes.len(), || {
            format!("{what} of at most 255 bytes")
        })?;
        self.u8(&mut length)?;
        bytes.resize(usize::from(length), 0);
        self.bytes(&mut bytes)?;
        match String::from_utf8(bytes) {
            Ok(text) => *v = text,
            Err(_) => return self.fail(format!("{what} in UTF-8")),
        }
        Ok(())
    }

    fn must(&self, holds: bool, expected: impl FnOnce() -> String) -> Result<()> {
        if holds { Ok(()) } else { self.fail(expected()) }
    }
}

/// Appends fields to a buffer.
#[derive(Default)]
pub struct Writer(pub Vec<u8>);

impl Fields for Writer {
    fn more(&self) -> bool {
        true
    }

    fn bytes(&mut self, v: &mut [u8]) -> Result<()> {
        self.0.extend_from_slice(v);
        Ok(())
    }

    fn fail<T>(&self, expected: String) -> Result<T> {
        Err(Error::Input(format!("expected {expected}")))
    }
}

/// Takes fields from a slice; offsets in errors count from its start.
pub struct Reader<'a> {
    data: &'a [u8],
    position: usize,
}

impl<'a> Reader<'a> {
    pub fn new(data: &'a [u8]) -> Self {
        Reader { data, position: 0 }
    }

    pub fn position(&self) -> usize {
        self.position
    }

    pub fn rest(&self) -> usize {
        self.data.len() - self.position
    }

    /// The next `n` bytes, without a copy.
    #[inline(never)]
    pub fn take(&mut self, n: usize) -> Result<&'a [u8]> {
        match self.data.get(self.position..).and_then(|d| d.get(..n)) {
            Some(d) => {
                self.position += n;
                Ok(d)
            }
            None => self.fail(format!("{n} more bytes, found {}", self.rest())),
        }
    }
}

impl Fields for Reader<'_> {
    fn more(&self) -> bool {
        self.rest() > 0
    }

    fn bytes(&mut self, v: &mut [u8]) -> Result<()> {
        v.copy_from_slice(self.take(v.len())?);
        Ok(())
    }

    fn fail<T>(&self, expected: String) -> Result<T> {
        Err(Error::bitstream(self.position, "", expected))
    }
}
