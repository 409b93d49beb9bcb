//! The structure of TIFF files: directories of tags. Which image to take, and what its tags mean, is for others.

use crate::base::{Error, Result};

pub(super) const NEW_SUBFILE_TYPE: u16 = 254;
pub(super) const WIDTH: u16 = 256;
pub(super) const HEIGHT: u16 = 257;
pub(super) const BITS: u16 = 258;
pub(super) const COMPRESSION: u16 = 259;
pub(super) const PHOTOMETRIC: u16 = 262;
pub(super) const STRIP_OFFSETS: u16 = 273;
pub(super) const MAKE: u16 = 271;
pub(super) const MODEL: u16 = 272;
pub(super) const SAMPLES: u16 = 277;
pub(super) const STRIP_BYTES: u16 = 279;
pub(super) const PLANAR: u16 = 284;
pub(super) const TILE_OFFSETS: u16 = 324;
pub(super) const TILE_BYTES: u16 = 325;
pub(super) const SUB_DIRECTORIES: u16 = 330;
pub(super) const DNG_VERSION: u16 = 50706;
pub(super) const BLACK_LEVEL: u16 = 50714;
pub(super) const WHITE_LEVEL: u16 = 50717;

/// A TIFF file: byte order and bytes.
pub(super) struct Tiff<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) big_endian: bool,
}

/// One image file directory: tag, type, count and where the values lie.
pub(super) struct Directory {
    entries: Vec<(u16, u16, usize, usize)>,
}

impl Directory {
    pub(super) fn find(&self, tag: u16) -> Option<(u16, usize, usize)> {
        let entry = self.entries.iter().find(|e| e.0 == tag)?;
        Some((entry.1, entry.2, entry.3))
    }
}

/// What a file that ends too early is told.
pub(super) fn torn(what: &str) -> Error {
    Error::new(format!("the file ends inside {what}"))
        .with_hint("the file is torn; copy it again or take the shot again")
}

impl<'a> Tiff<'a> {
    /// None when the bytes are no TIFF file.
    pub(super) fn open(bytes: &'a [u8]) -> Option<Self> {
        let big_endian = match bytes.get(..4)? {
            b"II\x2a\0" => false,
            b"MM\0\x2a" => true,
            _ => return None,
        };
        Some(Self { bytes, big_endian })
    }

    fn u16(&self, at: usize) -> Option<usize> {
        let b: [u8; 2] = self.bytes.get(at..at.checked_add(2)?)?.try_into().ok()?;
        let value = if self.big_endian {
            u16::from_be_bytes(b)
        } else {
            u16::from_le_bytes(b)
        };
        Some(usize::from(value))
    }

    fn u32(&self, at: usize) -> Option<usize> {
        let b: [u8; 4] = self.bytes.get(at..at.checked_add(4)?)?.try_into().ok()?;
        let value = if self.big_endian {
            u32::from_be_bytes(b)
        } else {
            u32::from_le_bytes(b)
        };
        Some(value as usize)
    }

    fn directory(&self, at: usize) -> Result<(Directory, usize)> {
        let lost = || torn("an image directory");
        let count = self.u16(at).ok_or_else(lost)?;
        let mut entries = Vec::with_capacity(count);
        for i in 0..count {
            let entry = at + 2 + 12 * i;
            let tag = self.u16(entry).ok_or_else(lost)? as u16;
            let kind = self.u16(entry + 2).ok_or_else(lost)? as u16;
            let n = self.u32(entry + 4).ok_or_else(lost)?;
            let size = n.saturating_mul(type_size(kind));
            let value = if size <= 4 {
                entry + 8
            } else {
                self.u32(entry + 8).ok_or_else(lost)?
            };
            entries.push((tag, kind, n, value));
        }
        let next = self.u32(at + 2 + 12 * count).ok_or_else(lost)?;
        Ok((Directory { entries }, next))
    }

    /// All directories and their sub-directories, in the order the decoder visits them.
    pub(super) fn directories(&self) -> Result<Vec<Directory>> {
        let mut found = Vec::new();
        let mut next = self.u32(4).ok_or_else(|| torn("the header"))?;
        while next != 0 && found.len() < 100 {
            let (directory, after) = self.directory(next)?;
            let children = self.values(&directory, SUB_DIRECTORIES).unwrap_or_default();
            found.push(directory);
            for child in children.into_iter().take(32) {
                found.push(self.directory(child as usize)?.0);
            }
            next = after;
        }
        Ok(found)
    }

    /// The numbers of an entry; none when it is missing, torn or of another type.
    pub(super) fn values(&self, directory: &Directory, tag: u16) -> Option<Vec<f64>> {
        let (kind, count, at) = directory.find(tag)?;
        let size = type_size(kind);
        if at.checked_add(count.checked_mul(size)?)? > self.bytes.len() {
            return None;
        }
        (0..count)
            .map(|i| {
                let at = at + i * size;
                match kind {
                    1 => Some(f64::from(*self.bytes.get(at)?)),
                    3 => Some(self.u16(at)? as f64),
                    4 | 13 => Some(self.u32(at)? as f64),
                    5 => Some(self.u32(at)? as f64 / self.u32(at + 4)? as f64),
                    10 => {
                        let signed = |at| Some(f64::from(self.u32(at)? as u32 as i32));
                        Some(signed(at)? / signed(at + 4)?)
                    }
                    _ => None,
                }
            })
            .collect()
    }

    /// The bytes of an entry of one-byte values; none when it is missing or torn.
    pub(super) fn bytes_of(&self, directory: &Directory, tag: u16) -> Option<&'a [u8]> {
        let (kind, count, at) = directory.find(tag)?;
        (type_size(kind) == 1)
            .then(|| self.bytes.get(at..at.checked_add(count)?))
            .flatten()
    }

    /// The text of an entry; empty when it is missing.
    pub(super) fn text(&self, directory: &Directory, tag: u16) -> String {
        let bytes = self.bytes_of(directory, tag).unwrap_or_default();
        let text = String::from_utf8_lossy(bytes);
        text.trim_matches(|c: char| c == '\0' || c.is_whitespace())
            .to_owned()
    }

    /// The first of an entry's numbers, as a whole one.
    pub(super) fn value(&self, directory: &Directory, tag: u16) -> Option<usize> {
        let first = *self.values(directory, tag)?.first()?;
        Some(first as usize)
    }

    /// Fails when a strip or tile of the image lies beyond the end of the file.
    pub(super) fn check_whole(&self, directory: &Directory) -> Result<()> {
        for (offsets, sizes) in [(STRIP_OFFSETS, STRIP_BYTES), (TILE_OFFSETS, TILE_BYTES)] {
            if directory.find(offsets).is_none() || directory.find(sizes).is_none() {
                continue;
            }
            let lost = || torn("the table of image strips");
            let offsets = self.values(directory, offsets).ok_or_else(lost)?;
            let sizes = self.values(directory, sizes).ok_or_else(lost)?;
            let end = offsets
                .iter()
                .zip(&sizes)
                .map(|(o, s)| o + s)
                .fold(0.0, f64::max);
            if end > self.bytes.len() as f64 {
                return Err(torn(&format!(
                    "the image data ({} bytes where {end} were expected)",
                    self.bytes.len()
                )));
            }
        }
        Ok(())
    }
}

fn type_size(kind: u16) -> usize {
    match kind {
        3 | 8 => 2,
        4 | 9 | 11 | 13 => 4,
        5 | 10 | 12 => 8,
        _ => 1,
    }
}
