//! What a file says about itself before it is decoded: refuses what the decoder would read wrongly or not at all.
//!
//! Only TIFF-based files are looked into, and of those only DNG and CR2 are checked for completeness; other makers'
//! files are left to the decoder, which may return zeros for the missing end of a torn one.

use crate::base::{Error, Result};

/// What the file's own structure says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Container {
    /// A DNG file whose raw image the decoder reads as it is meant.
    Dng(DngFacts),
    /// Anything else.
    Other,
}

/// What a DNG says about its mosaic. Both patterns begin at the top left corner of the active area.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DngFacts {
    /// Channel of each place of the 2x2 block, row by row.
    pub(super) cfa: [usize; 4],
    /// Black level of each place, with its fraction.
    pub(super) black: [f64; 4],
}

const CONVERT: &str = "convert to uncompressed DNG";

/// Looks at the structure of a file.
///
/// # Errors
/// When it is torn, or of a kind the decoder does not read or reads wrongly.
pub(super) fn inspect(bytes: &[u8]) -> Result<Container> {
    if bytes.get(4..8) == Some(b"ftyp") {
        return Err(Error::new(
            "a Canon CR3 or other ISO media file, which the decoder does not read",
        )
        .with_hint(CONVERT));
    }
    let Some(tiff) = Tiff::open(bytes) else {
        return Ok(Container::Other);
    };
    if bytes.get(8..10) == Some(b"CR") {
        for directory in tiff.directories().unwrap_or_default() {
            tiff.check_whole(&directory)?;
        }
        return Ok(Container::Other);
    }
    let is_dng = tiff.directories().map_or_else(
        |_| tiff.first_tags().contains(&DNG_VERSION),
        |all| all.iter().any(|d| d.find(DNG_VERSION).is_some()),
    );
    if !is_dng {
        return Ok(Container::Other);
    }
    let directories = tiff.directories()?;
    Ok(Container::Dng(tiff.check_dng(&directories)?))
}

const NEW_SUBFILE_TYPE: u16 = 254;
const WIDTH: u16 = 256;
const HEIGHT: u16 = 257;
const BITS: u16 = 258;
const COMPRESSION: u16 = 259;
const PHOTOMETRIC: u16 = 262;
const STRIP_OFFSETS: u16 = 273;
const STRIP_BYTES: u16 = 279;
const TILE_OFFSETS: u16 = 324;
const TILE_BYTES: u16 = 325;
const SUB_DIRECTORIES: u16 = 330;
const CFA_PATTERN: u16 = 33422;
const DNG_VERSION: u16 = 50706;
const LINEARIZATION_TABLE: u16 = 50712;
const BLACK_REPEAT: u16 = 50713;
const BLACK_LEVEL: u16 = 50714;
const ACTIVE_AREA: u16 = 50829;

/// A TIFF file: byte order and bytes.
struct Tiff<'a> {
    bytes: &'a [u8],
    big_endian: bool,
}

/// One image file directory: tag, type, count and where the values lie.
struct Directory {
    entries: Vec<(u16, u16, usize, usize)>,
}

impl Directory {
    fn find(&self, tag: u16) -> Option<(u16, usize, usize)> {
        let entry = self.entries.iter().find(|e| e.0 == tag)?;
        Some((entry.1, entry.2, entry.3))
    }
}

fn torn(what: &str) -> Error {
    Error::new(format!("the file ends inside {what}"))
        .with_hint("the file is torn; copy it again or take the shot again")
}

impl<'a> Tiff<'a> {
    fn open(bytes: &'a [u8]) -> Option<Self> {
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

    /// The tags of the first directory, as far as they are there.
    fn first_tags(&self) -> Vec<u16> {
        let Some(at) = self.u32(4) else {
            return Vec::new();
        };
        let count = self.u16(at).unwrap_or(0);
        (0..count)
            .map_while(|i| self.u16(at + 2 + 12 * i))
            .map(|t| t as u16)
            .collect()
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
    fn directories(&self) -> Result<Vec<Directory>> {
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
    fn values(&self, directory: &Directory, tag: u16) -> Option<Vec<f64>> {
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

    fn value(&self, directory: &Directory, tag: u16) -> Option<usize> {
        let first = *self.values(directory, tag)?.first()?;
        Some(first as usize)
    }

    /// Fails when a strip or tile of the image lies beyond the end of the file.
    fn check_whole(&self, directory: &Directory) -> Result<()> {
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

    fn check_dng(&self, directories: &[Directory]) -> Result<DngFacts> {
        let full_size = |d: &&Directory| {
            d.find(COMPRESSION).is_some() && self.value(d, NEW_SUBFILE_TYPE).unwrap_or(0) & 1 == 0
        };
        // The decoder takes the first full-size image with a compression it knows of.
        let known = |d: &&Directory| matches!(self.value(d, COMPRESSION), Some(1 | 7 | 0x884c));
        let main = directories.iter().find(full_size);
        let Some(raw) = directories.iter().filter(full_size).find(known) else {
            let compression = main.and_then(|d| self.value(d, COMPRESSION));
            return Err(match compression {
                Some(c) => {
                    Error::new(format!("DNG compression {c} is not read")).with_hint(CONVERT)
                }
                None => Error::new("the DNG file holds no full-size image"),
            });
        };
        if self.value(raw, PHOTOMETRIC) != Some(32803) {
            return Err(Error::new(
                "the DNG file holds no color filter mosaic (linear or demosaiced image)",
            )
            .with_hint("measuring needs the camera's raw mosaic; convert without demosaicing"));
        }
        if raw.find(LINEARIZATION_TABLE).is_some() {
            return Err(Error::new(
                "the DNG file's values need a linearization table, which the decoder does not apply",
            )
            .with_hint("convert to uncompressed linear 16-bit DNG"));
        }
        self.check_whole(raw)?;
        match self.value(raw, COMPRESSION) {
            Some(1) => self.check_uncompressed(raw)?,
            Some(0x884c) => {
                return Err(Error::new("a DNG file with lossy compression").with_hint(CONVERT));
            }
            _ => {}
        }
        self.check_active_area(raw)?;
        Ok(DngFacts {
            cfa: self.cfa(raw)?,
            black: self.black(raw)?,
        })
    }

    fn check_uncompressed(&self, raw: &Directory) -> Result<()> {
        let missing = || Error::new("the DNG file does not state the size or place of its image");
        let width = self.value(raw, WIDTH).ok_or_else(missing)?;
        let height = self.value(raw, HEIGHT).ok_or_else(missing)?;
        let bits = self.value(raw, BITS).ok_or_else(missing)?;
        let row_bytes = match bits {
            16 if self.big_endian => {
                return Err(Error::new(
                    "a big-endian 16-bit DNG file, which the decoder reads wrongly",
                )
                .with_hint("convert to little-endian uncompressed DNG"));
            }
            16 => width * 2,
            12 if width % 2 == 1 => {
                return Err(Error::new(
                    "a 12-bit DNG file of odd width, which the decoder reads wrongly",
                )
                .with_hint("convert to 16-bit uncompressed DNG"));
            }
            12 => width / 2 * 3,
            _ => {
                return Err(Error::new(format!(
                    "{bits} bits per sample in an uncompressed DNG file, expected 12 or 16"
                ))
                .with_hint("convert to 16-bit uncompressed DNG"));
            }
        };
        let offsets = self.values(raw, STRIP_OFFSETS).ok_or_else(missing)?;
        let sizes = self.values(raw, STRIP_BYTES).ok_or_else(missing)?;
        let contiguous = offsets
            .windows(2)
            .zip(&sizes)
            .all(|(pair, size)| (pair[0] + size - pair[1]).abs() < 0.5);
        if !contiguous || offsets.len() != sizes.len() {
            return Err(
                Error::new("the strips of the DNG file do not follow one another")
                    .with_hint("convert to uncompressed DNG with one strip"),
            );
        }
        let total: f64 = sizes.iter().sum();
        let expected = row_bytes as f64 * height as f64;
        if total < expected {
            return Err(torn(&format!(
                "its image: {total} bytes where {width} x {height} pixels of {bits} bits need {expected}"
            )));
        }
        Ok(())
    }

    fn check_active_area(&self, raw: &Directory) -> Result<()> {
        if raw.find(ACTIVE_AREA).is_none() {
            return Ok(());
        }
        let area = self.values(raw, ACTIVE_AREA).unwrap_or_default();
        let width = self.value(raw, WIDTH).unwrap_or(0) as f64;
        let height = self.value(raw, HEIGHT).unwrap_or(0) as f64;
        match area[..] {
            [top, left, bottom, right]
                if top < bottom && bottom <= height && left < right && right <= width =>
            {
                Ok(())
            }
            _ => Err(Error::new(format!(
                "active area {area:?} does not fit a DNG image of {width} x {height} pixels"
            ))),
        }
    }

    fn cfa(&self, raw: &Directory) -> Result<[usize; 4]> {
        let pattern = self.values(raw, CFA_PATTERN).unwrap_or_default();
        match pattern[..] {
            [a, b, c, d] => Ok([a, b, c, d].map(|v| v as usize)),
            _ => Err(Error::new(format!(
                "a color filter array of {} places, expected 2 x 2",
                pattern.len()
            ))),
        }
    }

    /// Black level by place in the 2x2 block (default 0, one value for all, or a repeating pattern).
    fn black(&self, raw: &Directory) -> Result<[f64; 4]> {
        let levels = self.values(raw, BLACK_LEVEL).unwrap_or(vec![0.0]);
        let repeat = self.values(raw, BLACK_REPEAT).unwrap_or(vec![1.0, 1.0]);
        let (rows, columns) = match repeat[..] {
            [r, c] if (1.0..=2.0).contains(&r) && (1.0..=2.0).contains(&c) => {
                (r as usize, c as usize)
            }
            _ => {
                return Err(Error::new(format!(
                    "black levels repeat every {repeat:?} pixels, expected 1 or 2"
                )));
            }
        };
        let mut black = [0.0; 4];
        for (place, value) in black.iter_mut().enumerate() {
            let index = (place / 2 % rows) * columns + place % 2 % columns;
            match levels.get(index) {
                Some(level) if (0.0..65536.0).contains(level) => *value = *level,
                _ => {
                    return Err(Error::new(format!(
                        "black levels {levels:?} of the DNG file"
                    )));
                }
            }
        }
        Ok(black)
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
