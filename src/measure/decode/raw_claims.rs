//! What a camera's file claims to hold, against its size, before the decoder believes it.
//!
//! The decoder catches its own panics, but it takes memory for as many pixels as a header names, and follows directories
//! inside directories, ten deep, as often as they are named. Both are looked into here for files built like TIFF (DNG,
//! CR2, NEF, ARW, ORF, RW2, PEF, ...). Sizes in the headers of other kinds (CRW, MRW, RAF, X3F,
//! ARRIRAW) are the decoder's own affair.

use crate::base::{Error, Result};

/// More directories than any camera writes.
const MOST_DIRECTORIES: usize = 200;
/// How deep the decoder follows them.
const DEEPEST: usize = 10;
/// The tightest lossless compression: a bit per value.
const PIXELS_PER_BYTE: u64 = 8;

const WIDTHS: [u16; 2] = [256, 2];
const HEIGHTS: [u16; 2] = [257, 3];
const TILE: [u16; 2] = [322, 323];
/// Sub-directories, EXIF, and those of Fujifilm and Kodak.
const NESTED: [u16; 5] = [330, 34665, 0xf000, 0x8290, 0xfe00];

const MAKER_NOTE: u16 = 0x927c;
/// Bytes per value of types 1 to 13, as a power of two.
const SIZE_BITS: [u32; 13] = [0, 0, 1, 2, 3, 0, 0, 1, 2, 3, 2, 3, 2];

/// Refuses a file that claims more than it can hold.
///
/// # Errors
/// A directory names more pixels than there are bits in the file, or there are too many directories.
pub(super) fn check(bytes: &[u8]) -> Result<()> {
    let big_endian = match bytes.get(..2) {
        Some(b"II") => false,
        Some(b"MM") => true,
        _ => return Ok(()),
    };
    let file = File { bytes, big_endian };
    let mut left = MOST_DIRECTORIES;
    let mut next = file.u32(4);
    // The decoder reads a hundred directories in a row at most, even if they go round in circles.
    for _ in 0..100 {
        let Some(at) = next.filter(|at| *at != 0) else {
            break;
        };
        next = file.directory(at, 0, &mut left)?;
    }
    Ok(())
}

struct File<'a> {
    bytes: &'a [u8],
    big_endian: bool,
}

impl File<'_> {
    fn u16(&self, at: usize) -> Option<u16> {
        let b = self.bytes.get(at..at.checked_add(2)?)?.try_into().ok()?;
        Some(if self.big_endian {
            u16::from_be_bytes(b)
        } else {
            u16::from_le_bytes(b)
        })
    }

    fn u32(&self, at: usize) -> Option<usize> {
        let b = self.bytes.get(at..at.checked_add(4)?)?.try_into().ok()?;
        let value = if self.big_endian {
            u32::from_be_bytes(b)
        } else {
            u32::from_le_bytes(b)
        };
        Some(value as usize)
    }

    /// Looks through one directory and those it names; where the next one lies. What is torn ends the look: the decoder
    /// will say so.
    fn directory(&self, at: usize, depth: usize, left: &mut usize) -> Result<Option<usize>> {
        let Some(rest) = left.checked_sub(1) else {
            return Err(Error::new(format!(
                "the file names more than {MOST_DIRECTORIES} directories"
            ))
            .with_hint("the file is damaged; copy it again or take the shot again"));
        };
        *left = rest;
        let count = usize::from(self.u16(at).unwrap_or(0));
        let (mut width, mut height, mut tile) = (0, 0, [0; 2]);
        for entry in (0..count).map(|i| at + 2 + 12 * i) {
            let (Some(tag), Some(kind), Some(n)) =
                (self.u16(entry), self.u16(entry + 2), self.u32(entry + 4))
            else {
                return Ok(None);
            };
            // The decoder takes unknown types for bytes.
            let kind = if (1..=13).contains(&kind) { kind } else { 1 };
            let size = n << SIZE_BITS[usize::from(kind) - 1];
            let values = if size <= 4 {
                Some(entry + 8)
            } else {
                self.u32(entry + 8)
            };
            let Some(values) = values else {
                return Ok(None);
            };
            let value = |i: usize| match kind {
                1 if i < size => self.bytes.get(values + i).map(|b| usize::from(*b)),
                3 | 8 if 2 * i + 1 < size => self.u16(values + 2 * i).map(usize::from),
                4 | 7 | 9 | 13 if 4 * i + 3 < size => self.u32(values + 4 * i),
                _ => None,
            };
            let first = value(0).unwrap_or(0) as u64;
            if WIDTHS.contains(&tag) {
                width = width.max(first);
            } else if HEIGHTS.contains(&tag) {
                height = height.max(first);
            } else if let Some(k) = TILE.iter().position(|t| *t == tag) {
                tile[k] = first;
            } else if NESTED.contains(&tag) && depth < DEEPEST {
                // As many as there can be: a torn list ends it.
                for child in (0..n).map_while(value) {
                    self.directory(child, depth + 1, left)?;
                }
            } else if tag == MAKER_NOTE && depth < DEEPEST {
                self.maker_note(values, depth + 1, left)?;
            }
        }
        self.check_size(width, height)?;
        self.check_size(tile[0], tile[1])?;
        Ok(self.u32(at + 2 + 12 * count))
    }

    /// A maker note is a directory too, behind the maker's name; some count from their own beginning.
    fn maker_note(&self, at: usize, depth: usize, left: &mut usize) -> Result<()> {
        let Some(note) = self.bytes.get(at..) else {
            return Ok(());
        };
        // These count from behind their name; their byte order stands there.
        let apart = |order: usize, from: usize, first: usize, left: &mut usize| {
            let file = File {
                bytes: note.get(from..).unwrap_or_default(),
                big_endian: note.get(order..order + 2) != Some(b"II"),
            };
            file.directory(first, depth, left).map(drop)
        };
        let skip = match note {
            n if n.starts_with(b"PENTAX") => return apart(8, 0, 10, left),
            n if n.starts_with(b"Nikon\0\x02") => return apart(10, 10, 8, left),
            n if n.starts_with(b"OLYMPUS") => 12,
            n if n.starts_with(b"OLYMP") || n.starts_with(b"EPSON") => 8,
            n if n.starts_with(b"AOC\0") => 4,
            _ => 0,
        };
        let (skip, big_endian) = match note.get(skip..skip + 2) {
            Some(b"II") => (skip + 2, false),
            Some(b"MM") => (skip + 2, true),
            _ => (skip, self.big_endian),
        };
        let file = File {
            bytes: self.bytes,
            big_endian,
        };
        file.directory(at + skip, depth, left).map(drop)
    }

    fn check_size(&self, width: u64, height: u64) -> Result<()> {
        let most = PIXELS_PER_BYTE * self.bytes.len() as u64;
        if width.saturating_mul(height) <= most {
            return Ok(());
        }
        Err(Error::new(format!(
            "the file names {width} x {height} pixels, which cannot lie in {} bytes",
            self.bytes.len()
        ))
        .with_hint("the file is torn or damaged; copy it again or take the shot again"))
    }
}
