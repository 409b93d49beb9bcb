//! Voxels on disk, read a box at a time in the file's own axes.

use super::header::{Data, Header, Packing, byte_count};
use super::sample::decode;
use super::tiff_stack::TiffStack;
use super::{Endian, SampleType, check_going_on};
use crate::base::{Context, Error, Result, Watch};
use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::FileExt;
use std::path::Path;

/// Bytes moved at a time.
const CHUNK: usize = 1 << 20;

/// Where a volume's voxels come from.
pub(super) enum Store {
    Raw(Raw),
    Slices(TiffStack),
}

/// Uncompressed voxels in a file.
pub(super) struct Raw {
    pub(super) file: File,
    pub(super) offset: u64,
    pub(super) dims: [usize; 3],
    pub(super) sample: SampleType,
    pub(super) endian: Endian,
}

impl Store {
    pub(super) fn dims(&self) -> [usize; 3] {
        match self {
            Self::Raw(raw) => raw.dims,
            Self::Slices(stack) => stack.dims,
        }
    }

    pub(super) fn sample(&self) -> SampleType {
        match self {
            Self::Raw(raw) => raw.sample,
            Self::Slices(stack) => stack.sample,
        }
    }

    /// Voxels from `low` up to but not including `high`, first axis fastest.
    pub(super) fn read(&self, low: [usize; 3], high: [usize; 3]) -> Result<Vec<f32>> {
        match self {
            Self::Raw(raw) => raw.read(low, high),
            Self::Slices(stack) => {
                let slices = stack.slices(low[2]..high[2])?;
                let [nx, ny, _] = stack.dims;
                if (low[0], low[1], high[0], high[1]) == (0, 0, nx, ny) {
                    return Ok(slices);
                }
                let rows = (0..high[2] - low[2])
                    .flat_map(|z| (low[1]..high[1]).map(move |y| (z * ny + y) * nx));
                Ok(rows
                    .flat_map(|row| &slices[row + low[0]..row + high[0]])
                    .copied()
                    .collect())
            }
        }
    }

    /// The same voxels in a nameless file in `scratch`, from which any box is read quickly; what is there already stays.
    pub(super) fn unpacked(self, scratch: &Path, watch: &dyn Watch) -> Result<Self> {
        let Self::Slices(stack) = self else {
            return Ok(self);
        };
        let dims = stack.dims;
        let mut out = BufWriter::with_capacity(CHUNK, scratch_file(scratch)?);
        for z in 0..dims[2] {
            check_going_on(watch)?;
            let bytes: Vec<u8> = stack
                .slices(z..z + 1)?
                .into_iter()
                .flat_map(f32::to_le_bytes)
                .collect();
            out.write_all(&bytes).context(|| cannot_write(scratch))?;
            watch.progress("unpacking slices", z as u64 + 1, dims[2] as u64);
        }
        let file = out
            .into_inner()
            .map_err(std::io::IntoInnerError::into_error);
        Ok(Self::Raw(Raw {
            file: file.context(|| cannot_write(scratch))?,
            offset: 0,
            dims,
            sample: SampleType::F32,
            endian: Endian::Little,
        }))
    }
}

impl Raw {
    /// Opens what a header describes; packed voxels are unpacked into a nameless file in `scratch`.
    pub(super) fn open(
        header: &Header,
        endian: Endian,
        scratch: &Path,
        watch: &dyn Watch,
    ) -> Result<Self> {
        let needed = byte_count(header.dims, header.sample)?;
        let data = &header.data;
        let mut file = File::open(&data.path)
            .context(|| format!("voxels {} cannot be read", data.path.display()))?;
        let length = file
            .metadata()
            .context(|| "the file's size cannot be read")?
            .len();
        let mut offset = data.offset;
        if data.packing != Packing::None {
            file = unpack(file, data, needed, scratch, watch)?;
            offset = 0;
        } else {
            let there = length.saturating_sub(data.offset);
            if there < needed {
                return Err(cut_off(&data.path, there, needed));
            }
            if data.at_end {
                offset = length - needed;
            }
        }
        Ok(Self {
            file,
            offset,
            dims: header.dims,
            sample: header.sample,
            endian,
        })
    }

    fn read(&self, low: [usize; 3], high: [usize; 3]) -> Result<Vec<f32>> {
        Ok(decode(&self.bytes(low, high)?, self.sample, self.endian))
    }

    fn bytes(&self, low: [usize; 3], high: [usize; 3]) -> Result<Vec<u8>> {
        let [nx, ny, _] = self.dims;
        let size = self.sample.bytes();
        let sides = [0, 1, 2].map(|k| high[k] - low[k]);
        let mut bytes = vec![0; sides.iter().product::<usize>() * size];
        // As many voxels in one go as lie together in the file.
        let run = if sides[0] < nx {
            sides[0]
        } else if sides[1] < ny {
            sides[0] * sides[1]
        } else {
            sides.iter().product()
        };
        for (k, part) in bytes.chunks_exact_mut((run * size).max(1)).enumerate() {
            let first = k * run;
            let y = low[1] + first / sides[0] % sides[1];
            let z = low[2] + first / (sides[0] * sides[1]);
            let voxel = ((z * ny + y) * nx + low[0]) as u64;
            self.file
                .read_exact_at(part, self.offset + voxel * size as u64)
                .context(|| format!("voxels at ({}, {y}, {z}) cannot be read", low[0]))?;
        }
        Ok(bytes)
    }

    /// Says so when the voxels make a much smoother picture with their bytes in the other order.
    pub(super) fn suspicion(&self) -> Result<Option<String>> {
        if self.sample.bytes() == 1 {
            return Ok(None);
        }
        let [nx, ny, nz] = self.dims;
        let rows = ny.min(256);
        let (y, z) = ((ny - rows) / 2, nz / 2);
        let bytes = self.bytes([0, y, z], [nx, y + rows, z + 1])?;
        let roughness = |endian| roughness(&decode(&bytes, self.sample, endian), nx);
        let (now, other) = (roughness(self.endian), roughness(self.endian.other()));
        let suspect = match (now, other) {
            (Some(now), Some(other)) => now > 0.5 && other < 0.6 * now,
            (None, Some(_)) => true,
            _ => false,
        };
        Ok(suspect.then(|| {
            format!(
                "read as {}-endian the values jump from voxel to voxel; as {}-endian they are smooth: is the byte order right? (--endian {})",
                self.endian,
                self.endian.other(),
                self.endian.other()
            )
        }))
    }
}

/// Mean step between neighbors in rows of `width`, in standard deviations; `None` when values are absurd, 0 when all are
/// the same.
fn roughness(values: &[f32], width: usize) -> Option<f64> {
    let absurd = |v: &f32| !v.is_finite() || v.abs() > 1e30 || (*v != 0.0 && v.abs() < 1e-30);
    if values.iter().any(absurd) {
        return None;
    }
    let n = values.len() as f64;
    let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
    let variance = values
        .iter()
        .map(|v| (f64::from(*v) - mean).powi(2))
        .sum::<f64>()
        / n;
    let rows = values.chunks(width);
    let steps = rows.flat_map(|row| row.windows(2).map(|w| f64::from((w[1] - w[0]).abs())));
    let count = (values.len() - values.len() / width).max(1) as f64;
    Some(if variance > 0.0 {
        steps.sum::<f64>() / count / variance.sqrt()
    } else {
        0.0
    })
}

fn cut_off(path: &Path, found: u64, needed: u64) -> Error {
    Error::new(format!(
        "{} is cut off: {found} bytes of voxels, its header asks for {needed}",
        path.display()
    ))
    .with_hint("copy it again; or do sizes and type in the header belong to other data?")
}

fn cannot_write(scratch: &Path) -> String {
    format!("scratch file in {} cannot be written", scratch.display())
}

fn scratch_file(folder: &Path) -> Result<File> {
    tempfile::tempfile_in(folder).context(|| cannot_write(folder))
}

/// Unpacks exactly `needed` bytes.
fn unpack(
    mut file: File,
    data: &Data,
    needed: u64,
    scratch: &Path,
    watch: &dyn Watch,
) -> Result<File> {
    let torn = || {
        format!(
            "packed voxels in {} cannot be unpacked",
            data.path.display()
        )
    };
    file.seek(SeekFrom::Start(data.offset)).context(torn)?;
    let packed = BufReader::with_capacity(CHUNK, file);
    let mut unpacked: Box<dyn Read> = match data.packing {
        Packing::Zlib => Box::new(flate2::read::ZlibDecoder::new(packed)),
        Packing::Gzip | Packing::None => Box::new(flate2::read::MultiGzDecoder::new(packed)),
    };
    let skipped = std::io::copy(&mut unpacked.by_ref().take(data.skip), &mut std::io::sink())
        .context(torn)?;
    let mut out = scratch_file(scratch)?;
    let mut buffer = vec![0; CHUNK];
    let mut done = 0;
    if skipped < data.skip {
        return Err(cut_off(&data.path, 0, needed));
    }
    loop {
        check_going_on(watch)?;
        let n = match unpacked.read(&mut buffer) {
            Ok(0) => break,
            Ok(n) => n,
            Err(e) => return Err(cut_off(&data.path, done, needed).with_source(e)),
        };
        done += n as u64;
        if done > needed {
            return Err(Error::new(format!(
                "{} unpacks to more than the {needed} bytes its header asks for",
                data.path.display()
            ))
            .with_hint("do sizes and type in the header belong to other data?"));
        }
        out.write_all(&buffer[..n])
            .context(|| cannot_write(scratch))?;
        watch.progress("unpacking", done, needed);
    }
    if done < needed {
        return Err(cut_off(&data.path, done, needed));
    }
    Ok(out)
}
