//! TIFF slices: a folder of files, or the pages of one.
//!
//! Gray values of 8 to 64 bits, whole or floating point. Does not read color, palettes, values whose white is zero, or
//! stacks with channels or points in time. Resolution tags are not believed (72 dpi is what programs write that know
//! nothing); what ImageJ writes of unit and spacing is.

use super::header::Geometry;
use super::numbering::{name, series};
use super::{Endian, SampleType};
use crate::base::{Context, Error, Result};
use std::fs::File;
use std::io::BufReader;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use tiff::ColorType;
use tiff::decoder::{Decoder, DecodingResult, DecodingSampleType, Limits};
use tiff::tags::{ByteOrder, Tag};

type Reader = Decoder<BufReader<File>>;

const EXPORT: &str = "export slices as gray values, 8, 16 or 32 bits";
/// The largest slice decoded, bytes.
const LARGEST_SLICE: usize = 1 << 32;

/// Slices that are decoded when asked for.
pub(super) struct TiffStack {
    pages: Pages,
    pub(super) dims: [usize; 3],
    pub(super) sample: SampleType,
    pub(super) geometry: Geometry,
}

enum Pages {
    Files(Vec<PathBuf>),
    OfOne(PathBuf, Box<Mutex<Reader>>),
}

/// A stack too large for TIFF's offsets, as ImageJ writes it: the first page's voxels, then all others without a directory.
pub(super) struct Contiguous {
    pub(super) dims: [usize; 3],
    pub(super) sample: SampleType,
    pub(super) endian: Endian,
    pub(super) offset: u64,
    pub(super) geometry: Geometry,
}

/// What [`open_file`] finds.
pub(super) enum Stack {
    Pages(TiffStack),
    Contiguous(Contiguous),
}

/// No packing of TIFF makes an image smaller than by this.
const RATIO: u64 = 2000;

#[derive(Clone, Copy, PartialEq)]
struct Page {
    size: [usize; 2],
    sample: SampleType,
}

impl Page {
    fn in_words(self) -> String {
        format!("{} x {} {}", self.size[0], self.size[1], self.sample)
    }
}

/// Opens a folder of slices; files of other kinds are passed over.
pub(super) fn open_folder(folder: &Path) -> Result<TiffStack> {
    let what = || format!("folder {} cannot be read", folder.display());
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).context(what)? {
        let path = entry.context(what)?.path();
        let hidden = name(&path).starts_with('.');
        if is_tiff(&path) && !hidden {
            files.push(path);
        }
    }
    if files.is_empty() {
        return Err(Error::new(format!("no TIFF slices in {}", folder.display()))
            .with_hint("slices are files named .tif or .tiff; NRRD, MetaImage and NPY volumes are given as files"));
    }
    let files = series(files)?;
    if files.len() == 1 {
        return Err(Error::new(format!(
            "a single TIFF file, {}, in the folder: expected one for each slice",
            name(&files[0])
        ))
        .with_hint("give the file itself when it holds all slices as pages"));
    }
    let mut first: Option<(Page, Geometry)> = None;
    for file in &files {
        let (page, more, geometry) = inspect_file(file)?;
        if more {
            return Err(Error::new(format!("{} has several pages", name(file)))
                .with_hint("give the file itself when it holds all slices"));
        }
        let (expected, _) = first.get_or_insert((page, geometry));
        if *expected != page {
            return Err(Error::new(format!(
                "slices differ: {} is {}, {} is {}",
                name(&files[0]),
                expected.in_words(),
                name(file),
                page.in_words()
            ))
            .with_hint("all slices of a volume have one size and type"));
        }
    }
    let Some((page, geometry)) = first else {
        return Err(Error::new("no slices"));
    };
    Ok(TiffStack {
        dims: [page.size[0], page.size[1], files.len()],
        sample: page.sample,
        geometry,
        pages: Pages::Files(files),
    })
}

/// Opens a file whose pages are slices.
pub(super) fn open_file(path: &Path) -> Result<Stack> {
    let mut decoder = decoder(path)?;
    let first = inspect(&mut decoder, path)?;
    let description = description(&mut decoder);
    let geometry = description.geometry(&mut decoder);
    let mut count = 1;
    while decoder.more_images() {
        decoder.next_image().context(|| page_name(path, count))?;
        let page = inspect(&mut decoder, path).context(|| page_name(path, count))?;
        if page != first {
            return Err(Error::new(format!(
                "slices differ: page 1 is {}, page {} is {}",
                first.in_words(),
                count + 1,
                page.in_words()
            )));
        }
        count += 1;
    }
    let stated = description.images;
    if count == 1 && stated > 1 {
        let offset = contiguous_offset(&mut decoder)?;
        let endian = match decoder.byte_order() {
            ByteOrder::LittleEndian => Endian::Little,
            ByteOrder::BigEndian => Endian::Big,
        };
        return Ok(Stack::Contiguous(Contiguous {
            dims: [first.size[0], first.size[1], stated],
            sample: first.sample,
            endian,
            offset,
            geometry,
        }));
    }
    Ok(Stack::Pages(TiffStack {
        pages: Pages::OfOne(path.to_owned(), Box::new(Mutex::new(decoder))),
        dims: [first.size[0], first.size[1], count],
        sample: first.sample,
        geometry,
    }))
}

/// True for the names of TIFF files.
pub(super) fn is_tiff(path: &Path) -> bool {
    path.extension()
        .and_then(|e| e.to_str())
        .is_some_and(|e| e.eq_ignore_ascii_case("tif") || e.eq_ignore_ascii_case("tiff"))
}

impl TiffStack {
    /// Decodes slices; x fastest.
    pub(super) fn slices(&self, range: Range<usize>) -> Result<Vec<f32>> {
        let voxels = self.dims[0] * self.dims[1];
        let mut values = Vec::with_capacity(voxels * range.len());
        for z in range {
            let (slice, shown) = match &self.pages {
                Pages::Files(files) => {
                    let shown = name(&files[z]);
                    (
                        decode(&mut decoder(&files[z])?)
                            .context(|| format!("slice {shown} cannot be decoded"))?,
                        shown,
                    )
                }
                Pages::OfOne(path, decoder) => {
                    let shown = page_name(path, z);
                    let mut decoder = decoder
                        .lock()
                        .map_err(|_| Error::new(format!("{shown}: an earlier page failed")))?;
                    decoder.seek_to_image(z).context(|| shown.clone())?;
                    (decode(&mut decoder).context(|| shown.clone())?, shown)
                }
            };
            if slice.len() != voxels {
                return Err(Error::new(format!(
                    "{shown}: {} voxels, expected {voxels}",
                    slice.len()
                ))
                .with_hint("did the file change while it was read?"));
            }
            values.extend(slice);
        }
        Ok(values)
    }
}

fn page_name(path: &Path, z: usize) -> String {
    format!("{}, page {}", name(path), z + 1)
}

fn decoder(path: &Path) -> Result<Reader> {
    let what = || format!("{} cannot be read", path.display());
    let file = BufReader::new(File::open(path).context(what)?);
    let mut limits = Limits::default();
    limits.decoding_buffer_size = LARGEST_SLICE;
    Ok(Decoder::new(file).context(what)?.with_limits(limits))
}

fn inspect_file(path: &Path) -> Result<(Page, bool, Geometry)> {
    let mut decoder = decoder(path)?;
    let page = inspect(&mut decoder, path)?;
    let geometry = description(&mut decoder).geometry(&mut decoder);
    Ok((page, decoder.more_images(), geometry))
}

/// Size and type of the current page, its data known to be there.
fn inspect(decoder: &mut Reader, path: &Path) -> Result<Page> {
    let what = || format!("{} cannot be used", name(path));
    let color = decoder.colortype().context(what)?;
    if !matches!(color, ColorType::Gray(_)) {
        return Err(
            Error::new(format!("{}: {color:?} values, expected gray", name(path)))
                .with_hint(EXPORT),
        );
    }
    let photometric = decoder
        .find_tag_unsigned::<u16>(Tag::PhotometricInterpretation)
        .context(what)?;
    if photometric == Some(0) {
        return Err(
            Error::new(format!("{}: a negative, whose white is zero", name(path)))
                .with_hint(EXPORT),
        );
    }
    let (width, height) = decoder.dimensions().context(what)?;
    let layout = decoder.image_buffer_layout().context(what)?;
    let color_bits = color.bit_depth();
    let sample = sample(layout.sample_type, color_bits).ok_or_else(|| {
        Error::new(format!(
            "{}: unknown type, {color_bits} bits of {:?}",
            name(path),
            layout.sample_format
        ))
        .with_hint(EXPORT)
    })?;
    let page = Page {
        size: [width as usize, height as usize],
        sample,
    };
    check_whole(decoder, path, page)?;
    Ok(page)
}

fn sample(found: Option<DecodingSampleType>, bits: u8) -> Option<SampleType> {
    let sample = match found? {
        DecodingSampleType::U8 => SampleType::U8,
        DecodingSampleType::I8 => SampleType::I8,
        DecodingSampleType::U16 => SampleType::U16,
        DecodingSampleType::I16 => SampleType::I16,
        DecodingSampleType::U32 => SampleType::U32,
        DecodingSampleType::I32 => SampleType::I32,
        DecodingSampleType::U64 => SampleType::U64,
        DecodingSampleType::I64 => SampleType::I64,
        DecodingSampleType::F32 => SampleType::F32,
        DecodingSampleType::F64 => SampleType::F64,
        DecodingSampleType::F16 => return None,
    };
    (usize::from(bits) == 8 * sample.bytes()).then_some(sample)
}

/// Fails when a page's data reach beyond the end of the file, or are too few for its size.
fn check_whole(decoder: &mut Reader, path: &Path, page: Page) -> Result<()> {
    let what = || format!("{} cannot be used", name(path));
    let mut list = |tags: [Tag; 2]| -> Result<Vec<u64>> {
        for tag in tags {
            if let Some(found) = decoder.find_tag_unsigned_vec(tag).context(what)? {
                return Ok(found);
            }
        }
        Ok(Vec::new())
    };
    let offsets = list([Tag::StripOffsets, Tag::TileOffsets])?;
    let counts = list([Tag::StripByteCounts, Tag::TileByteCounts])?;
    let ends = offsets
        .iter()
        .zip(&counts)
        .map(|(a, n)| a.saturating_add(*n));
    let needed = ends.max().unwrap_or(0);
    let found = std::fs::metadata(path).context(what)?.len();
    if needed > found {
        return Err(Error::new(format!(
            "{} is cut off: it has {found} bytes, its voxels reach to byte {needed}",
            name(path)
        ))
        .with_hint("copy it again"));
    }
    let compression = decoder
        .find_tag_unsigned::<u16>(Tag::Compression)
        .context(what)?;
    let ratio = if compression.unwrap_or(1) == 1 {
        1
    } else {
        RATIO
    };
    let held = counts.iter().fold(0u64, |a, n| a.saturating_add(*n));
    let [width, height] = page.size.map(|s| s as u64);
    let size = width
        .saturating_mul(height)
        .saturating_mul(page.sample.bytes() as u64);
    if held.saturating_mul(ratio) < size {
        return Err(Error::new(format!(
            "{} is damaged: {held} bytes for {} voxels",
            name(path),
            page.in_words()
        )));
    }
    Ok(())
}

/// Where an uncompressed stack without directories begins.
fn contiguous_offset(decoder: &mut Reader) -> Result<u64> {
    let what = || "the stack cannot be used";
    let compression = decoder
        .find_tag_unsigned::<u16>(Tag::Compression)
        .context(what)?;
    let offsets = decoder
        .find_tag_unsigned_vec::<u64>(Tag::StripOffsets)
        .context(what)?;
    match (compression.unwrap_or(1), offsets.as_deref()) {
        (1, Some([first, ..])) => Ok(*first),
        _ => Err(
            Error::new("the description tells of several images, the file has one page")
                .with_hint("save the stack again, as BigTIFF when it is larger than 4 GB"),
        ),
    }
}

/// What ImageJ's description says, key=value line by line.
struct Description {
    images: usize,
    spacing: Option<f64>,
    unit: Option<super::Unit>,
}

fn description(decoder: &mut Reader) -> Description {
    let text = decoder
        .get_tag_ascii_string(Tag::ImageDescription)
        .unwrap_or_default();
    let by_imagej = text.starts_with("ImageJ");
    let field = |key: &str| {
        let line = text.lines().find_map(|l| {
            l.trim_end_matches('\0')
                .strip_prefix(key)?
                .strip_prefix('=')
        });
        line.filter(|_| by_imagej)
    };
    Description {
        images: field("images").and_then(|v| v.parse().ok()).unwrap_or(1),
        spacing: field("spacing")
            .and_then(|v| v.parse().ok())
            .filter(|v: &f64| v.is_finite()),
        unit: field("unit").and_then(|v| v.parse().ok()),
    }
}

impl Description {
    /// Voxel size, where ImageJ's unit says that it was set.
    fn geometry(&self, decoder: &mut Reader) -> Geometry {
        let mut per_unit = |tag| match decoder.find_tag(tag) {
            Ok(Some(tiff::decoder::ifd::Value::Rational(n, d))) if n > 0 && d > 0 => {
                Some(f64::from(d) / f64::from(n))
            }
            _ => None,
        };
        let (x, y) = (per_unit(Tag::XResolution), per_unit(Tag::YResolution));
        let (Some(unit), Some(x), Some(y)) = (self.unit, x, y) else {
            return Geometry::default();
        };
        Geometry {
            spacing: Some([x, y, self.spacing.unwrap_or(x)]),
            unit: Some(unit),
            ..Geometry::default()
        }
    }
}

fn decode(decoder: &mut Reader) -> Result<Vec<f32>> {
    macro_rules! single {
        ($values:ident) => {
            Ok($values.into_iter().map(|v| v as f32).collect())
        };
    }
    match decoder.read_image().context(|| "its data are damaged")? {
        DecodingResult::U8(v) => single!(v),
        DecodingResult::I8(v) => single!(v),
        DecodingResult::U16(v) => single!(v),
        DecodingResult::I16(v) => single!(v),
        DecodingResult::U32(v) => single!(v),
        DecodingResult::I32(v) => single!(v),
        DecodingResult::U64(v) => single!(v),
        DecodingResult::I64(v) => single!(v),
        DecodingResult::F32(v) => Ok(v),
        DecodingResult::F64(v) => single!(v),
        DecodingResult::F16(_) => {
            Err(Error::new("unknown type: 16 bits of floating point").with_hint(EXPORT))
        }
    }
}
