//! The numbers a volume's file holds, and their bytes.

use crate::base::{Error, Result};
use serde::Serialize;
use std::fmt;
use std::str::FromStr;

/// How one voxel is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SampleType {
    /// Unsigned, 8 bits.
    U8,
    /// Signed, 8 bits.
    I8,
    /// Unsigned, 16 bits.
    U16,
    /// Signed, 16 bits.
    I16,
    /// Unsigned, 32 bits.
    U32,
    /// Signed, 32 bits.
    I32,
    /// Unsigned, 64 bits.
    U64,
    /// Signed, 64 bits.
    I64,
    /// Floating point, 32 bits.
    F32,
    /// Floating point, 64 bits.
    F64,
}

impl SampleType {
    /// Bytes per voxel.
    pub fn bytes(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    /// True for numbers that can be other than whole.
    pub fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }
}

impl fmt::Display for SampleType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&format!("{self:?}").to_lowercase())
    }
}

/// Order of the bytes of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Endian {
    /// Lowest byte first.
    Little,
    /// Highest byte first.
    Big,
}

impl Endian {
    /// The other order.
    pub fn other(self) -> Self {
        match self {
            Self::Little => Self::Big,
            Self::Big => Self::Little,
        }
    }
}

impl fmt::Display for Endian {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&format!("{self:?}").to_lowercase())
    }
}

/// Decodes voxels to single precision; whole numbers beyond 2^24 are rounded to 24 bits.
///
/// `bytes` holds a whole number of voxels.
pub(super) fn decode(bytes: &[u8], sample: SampleType, endian: Endian) -> Vec<f32> {
    macro_rules! numbers {
        ($kind:ty) => {{
            const SIZE: usize = size_of::<$kind>();
            let read = |bytes: &[u8]| {
                let mut array = [0; SIZE];
                array.copy_from_slice(bytes);
                match endian {
                    Endian::Little => <$kind>::from_le_bytes(array) as f32,
                    Endian::Big => <$kind>::from_be_bytes(array) as f32,
                }
            };
            bytes.chunks_exact(SIZE).map(read).collect()
        }};
    }
    match sample {
        SampleType::U8 => numbers!(u8),
        SampleType::I8 => numbers!(i8),
        SampleType::U16 => numbers!(u16),
        SampleType::I16 => numbers!(i16),
        SampleType::U32 => numbers!(u32),
        SampleType::I32 => numbers!(i32),
        SampleType::U64 => numbers!(u64),
        SampleType::I64 => numbers!(i64),
        SampleType::F32 => numbers!(f32),
        SampleType::F64 => numbers!(f64),
    }
}

/// A unit of length in which a file states its voxel size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// Nanometers.
    Nanometer,
    /// Micrometers.
    Micrometer,
    /// Millimeters.
    Millimeter,
    /// Centimeters.
    Centimeter,
    /// Meters.
    Meter,
}

impl Unit {
    /// Millimeters in one of it.
    pub fn millimeters(self) -> f64 {
        match self {
            Self::Nanometer => 1e-6,
            Self::Micrometer => 1e-3,
            Self::Millimeter => 1.0,
            Self::Centimeter => 10.0,
            Self::Meter => 1e3,
        }
    }
}

impl FromStr for Unit {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        match text.trim().to_lowercase().trim_end_matches('s') {
            "nm" | "nanometer" => Ok(Self::Nanometer),
            "um" | "\u{b5}m" | "\u{3bc}m" | "\\u00b5m" | "micron" | "micrometer" => {
                Ok(Self::Micrometer)
            }
            "mm" | "millimeter" => Ok(Self::Millimeter),
            "cm" | "centimeter" => Ok(Self::Centimeter),
            "m" | "meter" => Ok(Self::Meter),
            _ => Err(Error::new(format!(
                "unit of length '{text}': expected nm, um, mm, cm or m"
            ))),
        }
    }
}
