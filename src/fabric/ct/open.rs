//! From a path to a volume: which reader, and what its file leaves unsaid.

use super::header::{Geometry, Header};
use super::store::{Raw, Store};
use super::{
    Axes, Endian, SampleType, Unit, Volume, header, metaimage, npy, nrrd, sides_um, tiff_stack,
};
use crate::base::{Context, Error, Result, Watch};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// How to read a volume where its file says too little, or wrong.
#[derive(Debug, Clone)]
pub struct Reading {
    /// Voxel size in micrometers along each axis of the file, fastest first; instead of what the file states.
    pub voxel_um: Option<[f64; 3]>,
    /// Unit of the voxel size in the file, where the file states none.
    pub unit: Option<Unit>,
    /// Scene axes of the file's axes; instead of what the file states.
    pub axes: Option<Axes>,
    /// Byte order; instead of what the file states.
    pub endian: Option<Endian>,
    /// Existing folder for nameless files that hold unpacked voxels.
    pub scratch: PathBuf,
}

impl Reading {
    /// Believes the file; unpacks in `scratch`.
    pub fn new(scratch: impl Into<PathBuf>) -> Self {
        Self {
            voxel_um: None,
            unit: None,
            axes: None,
            endian: None,
            scratch: scratch.into(),
        }
    }
}

pub(super) fn open(path: &Path, reading: &Reading, watch: &dyn Watch) -> Result<Volume> {
    if path.is_dir() {
        let stack = tiff_stack::open_folder(path)?;
        return from_slices("folder of TIFF slices", stack, reading, watch);
    }
    let mut start = [0; 8];
    let mut file = File::open(path).context(|| "it cannot be opened")?;
    let read = file.read(&mut start).context(|| "it cannot be read")?;
    let start = &start[..read];
    let extension = path
        .extension()
        .and_then(|e| e.to_str())
        .unwrap_or_default();
    if start.starts_with(nrrd::MAGIC) {
        from_raw("NRRD", &nrrd::header(path)?, reading, watch)
    } else if start.starts_with(npy::MAGIC) {
        from_raw("NPY", &npy::header(path)?, reading, watch)
    } else if ["mhd", "mha"].contains(&extension.to_lowercase().as_str()) {
        from_raw("MetaImage", &metaimage::header(path)?, reading, watch)
    } else if [b"II".as_slice(), b"MM"]
        .iter()
        .any(|m| start.starts_with(m))
    {
        match tiff_stack::open_file(path)? {
            tiff_stack::Stack::Pages(stack) => from_slices("TIFF pages", stack, reading, watch),
            tiff_stack::Stack::Contiguous(found) => from_contiguous(path, found, reading, watch),
        }
    } else {
        Err(Error::new("its kind is unknown").with_hint(
            "volumes are: a folder of .tif slices, .tif of several pages, .nrrd or .nhdr, .mhd or .mha, .npy; name the header, not the .raw file",
        ))
    }
}

fn from_slices(
    format: &'static str,
    stack: tiff_stack::TiffStack,
    reading: &Reading,
    watch: &dyn Watch,
) -> Result<Volume> {
    header::byte_count(stack.dims, stack.sample)?;
    let (sample, geometry) = (stack.sample, stack.geometry.clone());
    let volume = assemble(format, Store::Slices(stack), sample, geometry, reading)?;
    // Layers of z that are not slices would decode every slice for each.
    if volume.stored.file_axis(2).0 == 2 {
        Ok(volume)
    } else {
        volume.unpacked(&reading.scratch, watch)
    }
}

fn from_contiguous(
    path: &Path,
    found: tiff_stack::Contiguous,
    reading: &Reading,
    watch: &dyn Watch,
) -> Result<Volume> {
    let header = Header {
        dims: found.dims,
        sample: found.sample,
        endian: Some(found.endian),
        geometry: found.geometry,
        data: header::Data {
            path: path.to_owned(),
            offset: found.offset,
            at_end: false,
            skip: 0,
            packing: header::Packing::None,
        },
    };
    from_raw("TIFF stack of ImageJ", &header, reading, watch)
}

fn from_raw(
    format: &'static str,
    header: &Header,
    reading: &Reading,
    watch: &dyn Watch,
) -> Result<Volume> {
    let one_byte = (header.sample.bytes() == 1).then_some(Endian::Little);
    let endian = reading
        .endian
        .or(header.endian)
        .or(one_byte)
        .ok_or_else(|| {
            Error::new(format!(
                "the byte order of its {} voxels is not stated",
                header.sample
            ))
            .with_hint("--endian little is what nearly all programs write")
        })?;
    // Whether the voxel size is known is said before anything is unpacked.
    voxel_size(&header.geometry, reading)?;
    let raw = Raw::open(header, endian, &reading.scratch, watch)?;
    assemble(
        format,
        Store::Raw(raw),
        header.sample,
        header.geometry.clone(),
        reading,
    )
}

/// Voxel size per file axis in millimeters.
fn voxel_size(geometry: &Geometry, reading: &Reading) -> Result<[f64; 3]> {
    let voxel = match (reading.voxel_um, geometry.spacing) {
        (Some(um), _) => geometry.counted(um).map(|v| v * 1e-3),
        (None, Some(spacing)) => {
            let unit = geometry.unit.or(reading.unit).ok_or_else(|| {
                let [x, y, z] = spacing;
                Error::new(format!(
                    "the file states a voxel size of {x} x {y} x {z} without a unit"
                ))
                .with_hint("--unit um or --unit mm says which; or give the size: --voxel-um 5")
            })?;
            spacing.map(|s| s * unit.millimeters())
        }
        (None, None) => {
            return Err(Error::new("the file states no voxel size").with_hint(
                "give it in micrometers: --voxel-um 5, or --voxel-um 5,5,10 (fastest axis first)",
            ));
        }
    };
    if voxel.iter().all(|v| (1e-6..=10.0).contains(v)) {
        return Ok(voxel);
    }
    Err(Error::new(format!(
        "voxels of {} um: expected 0.001 to 10000 um along each axis",
        sides_um(voxel)
    ))
    .with_hint("is the unit right? --voxel-um gives the size in micrometers"))
}

fn assemble(
    format: &'static str,
    store: Store,
    sample: SampleType,
    geometry: Geometry,
    reading: &Reading,
) -> Result<Volume> {
    let voxel = voxel_size(&geometry, reading)?;
    let axes = reading.axes.or(geometry.axes).unwrap_or(Axes::SAME);
    let stored = axes.stored(&geometry);
    let mut notes = geometry.notes;
    if axes.mirrors() {
        notes.push(format!(
            "axes {axes} make a mirror image of the file as it is indexed: right if its own axes are left-handed, else yarn twists the wrong way"
        ));
    }
    let unit = geometry.unit.or(reading.unit);
    // A place in the file's space means nothing in axes that a person chose, or for voxels of another size.
    let kept = reading.axes.is_none() && reading.voxel_um.is_none();
    let stated = geometry.origin.zip(unit).filter(|_| kept);
    let dims = stored.to_scene(store.dims());
    let scene_voxel = stored.to_scene(voxel);
    let origin = stated.map_or([0.0; 3], |(origin, unit)| {
        [0, 1, 2].map(|k| {
            let back = if stored.file_axis(k).1 {
                (dims[k] - 1) as f64 * scene_voxel[k]
            } else {
                0.0
            };
            origin[k] * unit.millimeters() - back
        })
    });
    Ok(Volume {
        store,
        axes,
        stored,
        format,
        sample,
        voxel: scene_voxel,
        origin,
        notes,
    })
}
