//! Promise: every volume format gives the voxels that are in the file, whole or in pieces, in the axes asked for; what is
//! wrong with a file is said.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/ct_files.rs"]
mod ct_files;

use ct_files::{Page, all, five_um, nrrd_f32, open, tiff, write};
use flate2::Compression;
use flate2::write::{GzEncoder, ZlibEncoder};
use goniofit::base::Unwatched;
use goniofit::fabric::ct::{Endian, SampleType, Unit, statistics};
use std::io::Write;
use std::path::{Path, PathBuf};

const DIMS: [usize; 3] = [4, 3, 5];

/// Small enough for every type, different for every voxel.
fn value(x: usize, y: usize, z: usize) -> i32 {
    (x + 4 * y + 12 * z) as i32
}

fn in_file_order() -> Vec<i32> {
    let [nx, ny, nz] = DIMS;
    let all = (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| value(x, y, z))));
    all.collect()
}

fn bytes(kind: &str, big: bool) -> Vec<u8> {
    macro_rules! encode {
        ($t:ty) => {
            in_file_order()
                .into_iter()
                .flat_map(|v| {
                    let v = v as $t;
                    if big {
                        v.to_be_bytes()
                    } else {
                        v.to_le_bytes()
                    }
                })
                .collect()
        };
    }
    match kind {
        "u8" => encode!(u8),
        "i8" => encode!(i8),
        "u16" => encode!(u16),
        "i16" => encode!(i16),
        "u32" => encode!(u32),
        "i32" => encode!(i32),
        "u64" => encode!(u64),
        "i64" => encode!(i64),
        "f32" => encode!(f32),
        _ => encode!(f64),
    }
}

const KINDS: [(&str, SampleType, &str, &str, &str); 10] = [
    ("u8", SampleType::U8, "uint8", "MET_UCHAR", "u1"),
    ("i8", SampleType::I8, "signed char", "MET_CHAR", "i1"),
    ("u16", SampleType::U16, "unsigned short", "MET_USHORT", "u2"),
    ("i16", SampleType::I16, "int16_t", "MET_SHORT", "i2"),
    ("u32", SampleType::U32, "uint", "MET_UINT", "u4"),
    ("i32", SampleType::I32, "int", "MET_INT", "i4"),
    ("u64", SampleType::U64, "uint64", "MET_ULONG_LONG", "u8"),
    ("i64", SampleType::I64, "longlong", "MET_LONG_LONG", "i8"),
    ("f32", SampleType::F32, "float", "MET_FLOAT", "f4"),
    ("f64", SampleType::F64, "double", "MET_DOUBLE", "f8"),
];

/// Whole, in single layers, and box by box the voxels are those of the file.
fn check(path: &Path, sample: SampleType, what: &str) {
    let volume = open(path, five_um).unwrap_or_else(|e| panic!("{what}: {}", e.report()));
    assert_eq!(volume.dims(), DIMS, "{what}");
    assert_eq!(volume.sample(), sample, "{what}");
    assert_eq!(volume.voxel_mm(), [0.005; 3], "{what}");
    let expected: Vec<f32> = in_file_order().into_iter().map(|v| v as f32).collect();
    assert_eq!(all(&volume), expected, "{what}");
    let mut swept = Vec::new();
    let add = |block: &goniofit::fabric::ct::Block| {
        swept.extend_from_slice(&block.values);
        Ok(())
    };
    volume.sweep(1, "", &Unwatched, add).unwrap();
    assert_eq!(swept, expected, "{what}, layer by layer");
    for (low, high) in [
        ([1, 0, 2], [4, 3, 4]),
        ([0, 1, 0], [4, 2, 5]),
        ([3, 2, 4], [4, 3, 5]),
    ] {
        let block = volume.read(low, high).unwrap();
        let mut values = block.values.iter();
        for z in low[2]..high[2] {
            for y in low[1]..high[1] {
                for x in low[0]..high[0] {
                    assert_eq!(
                        *values.next().unwrap(),
                        value(x, y, z) as f32,
                        "{what} ({x}, {y}, {z})"
                    );
                }
            }
        }
        assert_eq!(values.next(), None);
    }
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut packer = GzEncoder::new(Vec::new(), Compression::fast());
    packer.write_all(bytes).unwrap();
    packer.finish().unwrap()
}

fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut packer = ZlibEncoder::new(Vec::new(), Compression::fast());
    packer.write_all(bytes).unwrap();
    packer.finish().unwrap()
}

fn nrrd_header(kind: &str, big: bool, rest: &str) -> String {
    let endian = if big { "big" } else { "little" };
    format!(
        "NRRD0001\n# by hand\ntype: {kind}\ndimension: 3\nsizes: 4 3 5\nendian: {endian}\nnote:=a b\n{rest}"
    )
}

#[test]
fn nrrd_of_every_type_and_byte_order() {
    let folder = tempfile::tempdir().unwrap();
    for (name, sample, kind, _, _) in KINDS {
        for big in [false, true] {
            let what = format!("{name} {big}");
            let raw = bytes(name, big);
            let header = nrrd_header(kind, big, "encoding: raw\n\n");
            check(
                &write(folder.path(), "a.nrrd", &[header.as_bytes(), &raw]),
                sample,
                &what,
            );
            let header = nrrd_header(kind, big, "encoding: gz\n\n");
            check(
                &write(folder.path(), "b.nrrd", &[header.as_bytes(), &gzip(&raw)]),
                sample,
                &what,
            );
        }
    }
}

#[test]
fn nrrd_with_its_voxels_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str, rest: &str| {
        write(
            folder.path(),
            name,
            &[nrrd_header("uint16", true, rest).as_bytes()],
        )
    };
    let raw = bytes("u16", true);
    write(folder.path(), "plain.raw", &[&raw]);
    write(folder.path(), "skip.raw", &[b"one\ntwo\nabc", &raw]);
    write(
        folder.path(),
        "v.raw.gz",
        &[&gzip(&[b"abc".as_slice(), &raw].concat())],
    );
    for rest in [
        "encoding: raw\ndata file: plain.raw\n",
        "encoding: raw\r\ndatafile: skip.raw\r\nbyte skip: -1\r\n\r\n",
        "encoding: raw\nline skip: 2\nbyte skip: 3\ndata file: skip.raw\n",
        "encoding: gzip\nbyte skip: 3\ndata file: v.raw.gz\n",
    ] {
        check(&at("a.nhdr", rest), SampleType::U16, rest);
    }
    // Negative control: without the skip the voxels are others.
    let torn = open(
        &at(
            "a.nhdr",
            "encoding: raw\nbyte skip: 2\ndata file: skip.raw\n",
        ),
        five_um,
    )
    .unwrap();
    assert_ne!(all(&torn)[0], 0.0);
}

#[test]
fn nrrd_says_where_its_voxels_are() {
    let folder = tempfile::tempdir().unwrap();
    let raw = bytes("u8", false);
    let rest = "space: 3D-right-handed\nspace directions: (0,0.005,0) (0,0,-0.01) (0.002,0,0)\nspace units: \"mm\" \"mm\" \"mm\"\n\
                space origin: (1,2,3)\nencoding: raw\n\n";
    let file = write(
        folder.path(),
        "a.nrrd",
        &[nrrd_header("uchar", false, rest).as_bytes(), &raw],
    );
    let volume = open(&file, |_| ()).unwrap();
    assert_eq!(volume.axes().to_string(), "y,-z,x");
    assert_eq!(volume.dims(), [5, 4, 3]);
    assert_eq!(volume.voxel_mm(), [0.002, 0.005, 0.01]);
    // The file's second axis runs down from z = 3: its last voxel is the scene's first.
    let [x, y, z] = volume.origin_mm();
    assert_eq!([x, y], [1.0, 2.0]);
    assert!((z - 2.98).abs() < 1e-12);
    let block = volume.read([2, 1, 0], [3, 2, 1]).unwrap();
    assert_eq!(block.values, [value(1, 2, 2) as f32]);
    let oblique = rest.replace("(0,0.005,0)", "(0.003,0.004,0)");
    let file = write(
        folder.path(),
        "b.nrrd",
        &[nrrd_header("uchar", false, &oblique).as_bytes(), &raw],
    );
    let volume = open(&file, |_| ()).unwrap();
    assert!((volume.voxel_mm()[0] - 0.005).abs() < 1e-12);
    assert!(volume.notes()[0].contains("oblique"));
}

#[test]
fn metaimage_of_every_type_and_byte_order() {
    let folder = tempfile::tempdir().unwrap();
    for (name, sample, _, kind, _) in KINDS {
        for (big, msb) in [(false, "False"), (true, "True")] {
            let what = format!("{name} {big}");
            let raw = bytes(name, big);
            let header = |rest: &str| {
                format!(
                    "ObjectType = Image\nNDims = 3\nBinaryData = True\nElementByteOrderMSB = {msb}\nDimSize = 4 3 5\n\
                     ElementSpacing = 5 5 5\nElementType = {kind}\n{rest}"
                )
            };
            write(folder.path(), "v.raw", &[b"head", &raw]);
            let apart = header("HeaderSize = 4\nElementDataFile = v.raw\n");
            check(
                &write(folder.path(), "a.mhd", &[apart.as_bytes()]),
                sample,
                &what,
            );
            let apart = header("HeaderSize = -1\nElementDataFile = v.raw\n");
            check(
                &write(folder.path(), "b.mhd", &[apart.as_bytes()]),
                sample,
                &what,
            );
            let packed = zlib(&raw);
            let local = header(&format!(
                "CompressedData = True\nCompressedDataSize = {}\nElementDataFile = LOCAL\n",
                packed.len()
            ));
            check(
                &write(folder.path(), "c.mha", &[local.as_bytes(), &packed]),
                sample,
                &what,
            );
        }
    }
    let turned = "ObjectType = Image\nNDims = 3\nDimSize = 4 3 5\nTransformMatrix = 0 1 0 1 0 0 0 0 -1\nOffset = 0 0 1\n\
                  ElementSpacing = 4 5 6\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n";
    let file = write(
        folder.path(),
        "d.mha",
        &[turned.as_bytes(), &bytes("u8", false)],
    );
    let volume = open(&file, |r| r.unit = Some(Unit::Micrometer)).unwrap();
    assert_eq!(volume.axes().to_string(), "y,x,-z");
    assert_eq!(
        volume.voxel_mm().map(|v| (v * 1e6).round()),
        [5000.0, 4000.0, 6000.0]
    );
    assert_eq!(
        volume.read([2, 3, 0], [3, 4, 1]).unwrap().values,
        [value(3, 2, 4) as f32]
    );
}

#[test]
fn npy_of_every_type_order_and_version() {
    let folder = tempfile::tempdir().unwrap();
    for (name, sample, _, _, kind) in KINDS {
        for big in [false, true] {
            let order = match (name.ends_with('8') && name.len() == 2, big) {
                (true, _) => '|',
                (_, false) => '<',
                (_, true) => '>',
            };
            let stored = bytes(name, big);
            // The same array with its first index fastest in memory.
            let size = stored.len() / 60;
            let places = (0..4)
                .flat_map(|x| (0..3).flat_map(move |y| (0..5).map(move |z| x + 4 * y + 12 * z)));
            let turned = places.flat_map(|i| stored[i * size..(i + 1) * size].to_vec());
            let turned: Vec<u8> = turned.collect();
            for (fortran, data, version) in [("False", &stored, 1), ("True", &turned, 2)] {
                let text = format!(
                    "{{'descr': '{order}{kind}', 'fortran_order': {fortran}, 'shape': (5, 3, 4), }}"
                );
                let fixed = if version == 1 { 10 } else { 12 };
                let padded = format!("{text:<width$}\n", width = 127 - fixed);
                let mut head = vec![0x93];
                head.extend(b"NUMPY");
                head.extend([version, 0]);
                head.extend((padded.len() as u16).to_le_bytes());
                if version == 2 {
                    head.extend([0, 0]);
                }
                let parts: [&[u8]; 3] = [&head, padded.as_bytes(), data];
                check(
                    &write(folder.path(), "a.npy", &parts),
                    sample,
                    &format!("{name} {big} {fortran}"),
                );
            }
        }
    }
}

fn pages(kind: &str, bits: u16, format: u16, big: bool) -> Vec<Page> {
    let raw = bytes(kind, big);
    let slices = raw.chunks(raw.len() / DIMS[2]);
    slices
        .map(|s| Page::new([4, 3], bits, format, s.to_vec()))
        .collect()
}

const TIFF_KINDS: [(&str, SampleType, u16, u16); 10] = [
    ("u8", SampleType::U8, 8, 1),
    ("i8", SampleType::I8, 8, 2),
    ("u16", SampleType::U16, 16, 1),
    ("i16", SampleType::I16, 16, 2),
    ("u32", SampleType::U32, 32, 1),
    ("i32", SampleType::I32, 32, 2),
    ("u64", SampleType::U64, 64, 1),
    ("i64", SampleType::I64, 64, 2),
    ("f32", SampleType::F32, 32, 3),
    ("f64", SampleType::F64, 64, 3),
];

#[test]
fn tiff_pages_and_folders_of_every_type_and_byte_order() {
    for (name, sample, bits, format) in TIFF_KINDS {
        for big in [false, true] {
            let what = format!("{name} {big}");
            let folder = tempfile::tempdir().unwrap();
            let pages = pages(name, bits, format, big);
            let stack = write(folder.path(), "stack.tif", &[&tiff(&pages, big)]);
            check(&stack, sample, &what);
            std::fs::remove_file(stack).unwrap();
            write(folder.path(), "scan.log", &[b"anything"]);
            // 8, 9, 10, ...: order by number, not by letter.
            for (k, page) in pages.iter().enumerate() {
                write(
                    folder.path(),
                    &format!("scan_{}.tif", k + 8),
                    &[&tiff(std::slice::from_ref(page), big)],
                );
            }
            check(folder.path(), sample, &what);
        }
    }
}

#[test]
fn imagejs_voxel_size_and_huge_stacks() {
    let folder = tempfile::tempdir().unwrap();
    let mut all_pages = pages("u16", 16, 1, true);
    all_pages[0].description =
        "ImageJ=1.54f\nimages=5\nslices=5\nunit=micron\nspacing=10.0\n".to_owned();
    all_pages[0].resolution = Some([1, 5]);
    let file = write(folder.path(), "a.tif", &[&tiff(&all_pages, true)]);
    let volume = open(&file, |_| ()).unwrap();
    assert_eq!(volume.voxel_mm(), [0.005, 0.005, 0.01]);
    // Beyond 4 GB ImageJ writes one page, and all voxels one after the other.
    let mut only = all_pages[0].clone();
    only.data = bytes("u16", true);
    let mut huge = tiff(&[only], true);
    let count = huge
        .windows(4)
        .rposition(|w| w == 120u32.to_be_bytes())
        .unwrap();
    huge[count..count + 4].copy_from_slice(&24u32.to_be_bytes());
    let file = write(folder.path(), "b.tif", &[&huge]);
    check(&file, SampleType::U16, "contiguous");
    // A resolution without ImageJ's unit is what a printer would need.
    let mut dpi = pages("u16", 16, 1, true);
    dpi[0].resolution = Some([72, 1]);
    let error = open(&write(folder.path(), "c.tif", &[&tiff(&dpi, true)]), |_| ())
        .err()
        .unwrap();
    assert!(
        error.report().contains("states no voxel size"),
        "{}",
        error.report()
    );
}

#[test]
fn axes_place_every_voxel() {
    let folder = tempfile::tempdir().unwrap();
    let raw = bytes("u16", false);
    let header = nrrd_header("uint16", false, "encoding: raw\n\n");
    let file = write(folder.path(), "a.nrrd", &[header.as_bytes(), &raw]);
    let stack = write(
        folder.path(),
        "a.tif",
        &[&tiff(&pages("u16", 16, 1, false), false)],
    );
    for order in [
        [0, 1, 2],
        [0, 2, 1],
        [1, 0, 2],
        [1, 2, 0],
        [2, 0, 1],
        [2, 1, 0],
    ] {
        for signs in 0..8 {
            let backward = [0, 1, 2].map(|k| signs >> k & 1 == 1);
            let names: Vec<String> = (0..3)
                .map(|k| {
                    format!(
                        "{}{}",
                        if backward[k] { "-" } else { "" },
                        ["x", "y", "z"][order[k]]
                    )
                })
                .collect();
            for path in [&file, &stack] {
                let volume = open(path, |r| {
                    r.voxel_um = Some([4.0, 5.0, 6.0]);
                    r.axes = Some(names.join(",").parse().unwrap());
                })
                .unwrap();
                let found = all(&volume);
                let dims = volume.dims();
                for (i, v) in in_file_order().into_iter().enumerate() {
                    let at = [i % 4, i / 4 % 3, i / 12];
                    let mut place = [0; 3];
                    for k in 0..3 {
                        place[order[k]] = if backward[k] {
                            DIMS[k] - 1 - at[k]
                        } else {
                            at[k]
                        };
                    }
                    let index = (place[2] * dims[1] + place[1]) * dims[0] + place[0];
                    assert_eq!(found[index], v as f32, "{names:?} {at:?}");
                }
                assert_eq!(volume.voxel_mm()[order[2]], 0.006);
                assert_eq!(
                    volume.notes().iter().any(|n| n.contains("mirror")),
                    volume.axes().mirrors()
                );
            }
        }
    }
}

/// A smooth volume of 16 bits, with noise of a few counts.
fn smooth(big: bool) -> Vec<u8> {
    let value = |i: usize| {
        let (x, y, z) = (i % 64, i / 64 % 64, i / 4096);
        let wave = (x as f64 / 9.0).sin() + (y as f64 / 7.0).cos() + z as f64 / 8.0;
        (20_000.0 + 6000.0 * wave) as u16 + (i * 7919 % 13) as u16
    };
    (0..64 * 64 * 8)
        .flat_map(|i| {
            if big {
                value(i).to_be_bytes()
            } else {
                value(i).to_le_bytes()
            }
        })
        .collect()
}

#[test]
fn a_wrong_byte_order_is_suspected_and_a_right_one_is_not() {
    let folder = tempfile::tempdir().unwrap();
    for (stated, really, suspected) in [
        ("little", false, false),
        ("big", true, false),
        ("big", false, true),
        ("little", true, true),
    ] {
        let header = format!(
            "NRRD0004\ntype: ushort\ndimension: 3\nsizes: 64 64 8\nendian: {stated}\nencoding: raw\n\n"
        );
        let file = write(
            folder.path(),
            "a.nrrd",
            &[header.as_bytes(), &smooth(really)],
        );
        let volume = open(&file, five_um).unwrap();
        let warning = volume.byte_order_warning().unwrap();
        assert_eq!(
            warning.is_some(),
            suspected,
            "{stated} {really} {warning:?}"
        );
        if let Some(text) = warning {
            let right = if really { "big" } else { "little" };
            assert!(text.contains(&format!("--endian {right}")), "{text}");
            let right = if really { Endian::Big } else { Endian::Little };
            let volume = open(&file, |r| {
                five_um(r);
                r.endian = Some(right);
            })
            .unwrap();
            assert_eq!(volume.byte_order_warning().unwrap(), None);
        }
    }
    // Noise looks the same either way: nothing is suspected.
    let mut state = 1u64;
    let noise: Vec<u8> = (0..64 * 64 * 8 * 2)
        .map(|_| {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (state >> 56) as u8
        })
        .collect();
    let header =
        "NRRD0004\ntype: ushort\ndimension: 3\nsizes: 64 64 8\nendian: big\nencoding: raw\n\n";
    let volume = open(
        &write(folder.path(), "n.nrrd", &[header.as_bytes(), &noise]),
        five_um,
    )
    .unwrap();
    assert_eq!(volume.byte_order_warning().unwrap(), None);
}

#[test]
fn swapped_floats_are_an_error_that_names_the_cause() {
    let folder = tempfile::tempdir().unwrap();
    let mut file = nrrd_f32([8, 8, 8], [5.0; 3], |x, y, z| {
        1.0 + 0.01 * (x + y + z) as f32
    });
    let at = file
        .windows(14)
        .position(|w| w == b"endian: little")
        .unwrap();
    file.splice(at..at + 14, *b"endian: big");
    // One of the values reads as NaN the wrong way round.
    let last = file.len() - 4;
    file[last..].copy_from_slice(&[0x7f, 0xc0, 0x00, 0x3f]);
    let volume = open(&write(folder.path(), "a.nrrd", &[&file]), |_| ()).unwrap();
    assert!(
        volume
            .byte_order_warning()
            .unwrap()
            .unwrap()
            .contains("--endian little")
    );
    let error = volume.slab(0..8).unwrap_err().report();
    assert!(
        error.contains("voxel (7, 7, 7) is NaN: expected a number")
            && error.contains("byte order seems wrong"),
        "{error}"
    );
}

#[test]
fn statistics_are_those_of_the_voxels() {
    let folder = tempfile::tempdir().unwrap();
    // 75 % around 100, 25 % around 900 of 16 bits.
    let value = |i: usize| {
        if i.is_multiple_of(4) {
            900 + (i / 4 % 5) as u16
        } else {
            100 + (i % 3) as u16
        }
    };
    let raw: Vec<u8> = (0..1000).flat_map(|i| value(i).to_le_bytes()).collect();
    let header =
        "NRRD0004\ntype: ushort\ndimension: 3\nsizes: 10 10 10\nendian: little\nencoding: raw\n\n";
    let volume = open(
        &write(folder.path(), "a.nrrd", &[header.as_bytes(), &raw]),
        five_um,
    )
    .unwrap();
    let found = statistics(&volume, 1, &Unwatched).unwrap();
    assert_eq!((found.min, found.max, found.voxels), (100.0, 904.0, 1000));
    let mean = (0..1000).map(|i| f64::from(value(i))).sum::<f64>() / 1000.0;
    assert!((found.mean - mean).abs() < 1e-9);
    assert_eq!(found.quantile(0.5), Some(101.0));
    assert_eq!(found.quantile(0.999), Some(904.0));
    assert_eq!(found.quantile(0.001), Some(100.0));
    // Any border in the gap splits alike; the middle is taken.
    assert_eq!(found.otsu, 501.0);
    assert_eq!(found.nonempty, 0.25);
    assert_eq!(found, statistics(&volume, 1 << 20, &Unwatched).unwrap());
}

/// What a volume's opening, or its statistics, fail with.
fn failure(path: &Path, change: impl FnOnce(&mut goniofit::fabric::ct::Reading)) -> String {
    match open(path, change) {
        Err(e) => e.report(),
        Ok(volume) => statistics(&volume, 1 << 20, &Unwatched)
            .unwrap_err()
            .report(),
    }
}

#[test]
fn bad_headers_and_files_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let at =
        |name: &str, text: &str, more: &[u8]| write(folder.path(), name, &[text.as_bytes(), more]);
    let raw = bytes("u8", false);
    let nrrd =
        |from: &str, to: &str| nrrd_header("uchar", false, "encoding: raw\n\n").replace(from, to);
    let meta = |from: &str, to: &str| {
        "NDims = 3\nDimSize = 4 3 5\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n"
            .replace(from, to)
    };
    let npy = |text: &str| {
        let mut head = vec![0x93];
        head.extend(b"NUMPY\x01\x00");
        head.extend((text.len() as u16).to_le_bytes());
        head.extend(text.as_bytes());
        head
    };
    let cases: Vec<(PathBuf, &str)> = vec![
        (
            at("a.nrrd", &nrrd("", ""), &raw[1..]),
            "cut off: 59 bytes of voxels, its header asks for 60",
        ),
        (
            at("b.nrrd", &nrrd("4 3 5", "4 3 4000000000"), &raw),
            "at most 1048576 along each axis",
        ),
        (
            at("c.nrrd", &nrrd("4 3 5", "1000000 1000000 1000000"), &raw),
            "2^50 bytes in all",
        ),
        (at("d.nrrd", &nrrd("4 3 5", "4 0 5"), &raw), "is empty"),
        (
            at("e.nrrd", &nrrd("4 3 5", "4 3"), &raw),
            "expected three whole numbers",
        ),
        (
            at("f.nrrd", &nrrd("uchar", "block"), &raw),
            "unknown type 'block'",
        ),
        (
            at("g.nrrd", &nrrd("raw", "bzip2"), &raw),
            "encoding 'bzip2': expected raw or gzip",
        ),
        (
            at("h.nrrd", &nrrd("dimension: 3", "dimension: 4"), &raw),
            "dimension 4: expected 3",
        ),
        (
            at(
                "i.nrrd",
                &nrrd("uchar", "short").replace("endian: little\n", ""),
                &[raw.clone(), raw.clone()].concat(),
            ),
            "byte order of its i16 voxels is not stated",
        ),
        (
            at("j.nrrd", &nrrd("encoding: raw\n\n", ""), b""),
            "does not end with an empty line",
        ),
        (
            at(
                "k.nhdr",
                &nrrd(
                    "encoding: raw\n\n",
                    "encoding: raw\ndata file: LIST\na.raw\n",
                ),
                b"",
            ),
            "several files",
        ),
        (
            at(
                "l.nhdr",
                &nrrd("encoding: raw\n\n", "encoding: raw\ndata file: none.raw\n"),
                b"",
            ),
            "none.raw cannot be read",
        ),
        (
            at("m.nrrd", &nrrd("raw", "gzip"), &gzip(&raw)[..20]),
            "is cut off",
        ),
        (
            at("n.nrrd", &nrrd("raw", "gzip"), &gzip(&raw[1..])),
            "cut off: 59 bytes of voxels",
        ),
        (
            at(
                "o.nrrd",
                &nrrd("raw", "gzip"),
                &gzip(&[raw.clone(), vec![1]].concat()),
            ),
            "unpacks to more than the 60 bytes",
        ),
        (
            at("p.nrrd", &nrrd("", ""), &[7; 60]),
            "every voxel is 7: the volume is empty",
        ),
        (at("q.mha", &meta("", ""), &raw[1..]), "cut off: 59 bytes"),
        (
            at("r.mha", &meta("MET_UCHAR", "MET_LONG"), &raw),
            "four or eight bytes",
        ),
        (
            at("s.mha", &meta("MET_UCHAR", "MET_STRING"), &raw),
            "unknown type MET_STRING",
        ),
        (
            at("t.mha", &meta("NDims = 3", "NDims = 2"), &raw),
            "NDims = 2: expected 3 dimensions",
        ),
        (
            at(
                "u.mha",
                &meta("NDims", "ElementNumberOfChannels = 3\nNDims"),
                &raw,
            ),
            "expected one number per voxel",
        ),
        (at("v.mhd", "NDims = 3\n", b""), "lacks ElementDataFile"),
        (
            write(
                folder.path(),
                "w.npy",
                &[
                    &npy("{'descr': '<f2', 'fortran_order': False, 'shape': (5, 3, 4), }\n"),
                    &raw,
                ],
            ),
            "unknown type '<f2'",
        ),
        (
            write(
                folder.path(),
                "x.npy",
                &[
                    &npy("{'descr': '|u1', 'fortran_order': False, 'shape': (15, 4), }\n"),
                    &raw,
                ],
            ),
            "expected three axes",
        ),
        (
            write(
                folder.path(),
                "y.npy",
                &[
                    &npy(
                        "{'descr': [('a', '<u2')], 'fortran_order': False, 'shape': (5, 3, 4), }\n",
                    ),
                    &raw,
                ],
            ),
            "unknown type [('a', '<u2')",
        ),
        (
            write(
                folder.path(),
                "z.npy",
                &[
                    &npy("{'descr': '|u1', 'fortran_order': False, 'shape': (5, 3, 4), }\n"),
                    &raw[2..],
                ],
            ),
            "cut off: 58 bytes",
        ),
        (
            write(folder.path(), "volume.raw", &[&raw]),
            "its kind is unknown",
        ),
        (folder.path().join("nothing.nrrd"), "cannot be opened"),
    ];
    for (path, message) in cases {
        let report = failure(&path, five_um);
        assert!(report.contains(message), "{}: {report}", path.display());
    }
}

#[test]
fn voxel_sizes_must_be_known_and_sensible() {
    let folder = tempfile::tempdir().unwrap();
    let raw = bytes("u8", false);
    let file = |name: &str, rest: &str| {
        let header = nrrd_header("uchar", false, &format!("{rest}encoding: raw\n\n"));
        write(folder.path(), name, &[header.as_bytes(), &raw])
    };
    let none = failure(&file("a.nrrd", ""), |_| ());
    assert!(
        none.contains("the file states no voxel size\nhint: give it in micrometers: --voxel-um 5"),
        "{none}"
    );
    let unitless = file("b.nrrd", "spacings: 5 5 10\n");
    let report = failure(&unitless, |_| ());
    assert!(
        report.contains("5 x 5 x 10 without a unit\nhint: --unit um"),
        "{report}"
    );
    let volume = open(&unitless, |r| r.unit = Some(Unit::Micrometer)).unwrap();
    assert_eq!(volume.voxel_mm(), [0.005, 0.005, 0.01]);
    let error = volume.cubic_voxel_mm().unwrap_err().report();
    assert!(
        error.contains("anisotropic voxels of 5 x 5 x 10 um") && error.contains("ct prepare"),
        "{error}"
    );
    let report = failure(&unitless, |r| r.unit = Some(Unit::Meter));
    assert!(
        report.contains("voxels of 5000000 x 5000000 x 10000000 um: expected 0.001 to 10000"),
        "{report}"
    );
    let report = failure(&file("c.nrrd", "spacings: 5 5 nan\n"), |_| ());
    assert!(
        report.contains("spacings '5 5 nan': expected 3 numbers"),
        "{report}"
    );
}

#[test]
fn bad_slices_are_named() {
    let page = |size, bits: u16| {
        Page::new(
            size,
            bits,
            1,
            vec![1; (size[0] * size[1] * u32::from(bits) / 8) as usize],
        )
    };
    let fails = |files: &[(&str, Vec<u8>)]| {
        let folder = tempfile::tempdir().unwrap();
        for (name, bytes) in files {
            write(folder.path(), name, &[bytes]);
        }
        failure(folder.path(), five_um)
    };
    let plain = || tiff(&[page([4, 3], 8)], false);
    let report = fails(&[
        ("s1.tif", plain()),
        ("s2.tif", tiff(&[page([4, 4], 8)], false)),
    ]);
    assert!(
        report.contains("slices differ: s1.tif is 4 x 3 u8, s2.tif is 4 x 4 u8"),
        "{report}"
    );
    let report = fails(&[
        ("s1.tif", plain()),
        ("s2.tif", tiff(&[page([4, 3], 16)], false)),
    ]);
    assert!(report.contains("s2.tif is 4 x 3 u16"), "{report}");
    let report = fails(&[("s1.tif", plain()), ("s3.tif", plain())]);
    assert!(
        report.contains("slice 2 is missing between s1.tif and s3.tif"),
        "{report}"
    );
    let report = fails(&[
        ("s1.tif", plain()),
        ("s2.tif", tiff(&[page([4, 3], 8), page([4, 3], 8)], false)),
    ]);
    assert!(report.contains("s2.tif has several pages"), "{report}");
    let report = fails(&[("readme.txt", plain())]);
    assert!(report.contains("no TIFF slices in"), "{report}");
    let mut negative = page([4, 3], 8);
    negative.photometric = 0;
    let report = fails(&[
        ("s1.tif", tiff(&[negative.clone()], false)),
        ("s2.tif", plain()),
    ]);
    assert!(
        report.contains("a negative, whose white is zero"),
        "{report}"
    );
    // Its directory tells of more bytes than there are.
    let mut torn = plain();
    let at = torn
        .windows(2)
        .position(|w| w == 279u16.to_le_bytes())
        .unwrap();
    torn[at + 8..at + 12].copy_from_slice(&5000u32.to_le_bytes());
    let message = format!(
        "s2.tif is cut off: it has {} bytes, its voxels reach to byte 5008",
        torn.len()
    );
    let report = fails(&[("s1.tif", plain()), ("s2.tif", torn)]);
    assert!(report.contains(&message), "{report}");
}

/// Every byte of every small file in turn damaged in three ways: an answer or an error, never a panic.
#[test]
fn damaged_files_are_answered() {
    let folder = tempfile::tempdir().unwrap();
    let raw = bytes("u16", false);
    let nrrd = |encoding: &str| {
        nrrd_header(
            "uint16",
            false,
            &format!("spacings: 5 5 5\nencoding: {encoding}\n\n"),
        )
    };
    let meta = |more: &str| {
        format!(
            "NDims = 3\nDimSize = 4 3 5\nElementSpacing = 5 5 5\nElementType = MET_USHORT\n{more}ElementDataFile = LOCAL\n"
        )
    };
    let mut npy = b"\x93NUMPY\x01\x00\x46\x00".to_vec();
    npy.extend(
        format!(
            "{:<69}\n",
            "{'descr': '<u2', 'fortran_order': False, 'shape': (5, 3, 4), }"
        )
        .bytes(),
    );
    let mut stack = pages("u16", 16, 1, false);
    stack.truncate(2);
    stack[0].description = "ImageJ=1\nimages=2\nunit=um\n".to_owned();
    let files = [
        ("a.nrrd", [nrrd("raw").as_bytes(), &raw].concat()),
        ("b.nrrd", [nrrd("gzip").as_bytes(), &gzip(&raw)].concat()),
        ("c.mha", [meta("").as_bytes(), &raw].concat()),
        (
            "d.mha",
            [meta("CompressedData = True\n").as_bytes(), &zlib(&raw)].concat(),
        ),
        ("e.npy", [npy, raw.clone()].concat()),
        ("f.tif", tiff(&stack, false)),
    ];
    let (mut answers, mut errors) = (0, 0);
    for (name, whole) in files {
        let path = write(folder.path(), name, &[&whole]);
        let found = open(&path, five_um).unwrap_or_else(|e| panic!("{name}: {}", e.report()));
        assert_eq!(all(&found)[7], 7.0, "{name}");
        for at in 0..whole.len() {
            for damage in [0xff, 0x39, whole[at] ^ 1] {
                let mut torn = whole.clone();
                torn[at] = damage;
                // Files made anew are not flushed to disk, files cut short are.
                std::fs::remove_file(&path).unwrap();
                write(folder.path(), name, &[&torn]);
                match open(&path, five_um).and_then(|v| v.slab(0..1)) {
                    Ok(_) => answers += 1,
                    Err(e) => {
                        assert!(!e.report().is_empty());
                        errors += 1;
                    }
                }
            }
        }
    }
    assert!(
        answers > 1000 && errors > 1000,
        "{answers} answers, {errors} errors"
    );
}
