//! Promise: every volume format gives the voxels that are in the file, whole or in pieces, in the axes asked for.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/ct_files.rs"]
mod ct_files;

use ct_files::{
    DIMS, all, bytes, five_um, gzip, in_file_order, nrrd_f32, nrrd_header, open, pages, tiff,
    value, write, zlib,
};
use goniofit::base::Unwatched;
use goniofit::fabric::ct::{Endian, SampleType, Unit, statistics};
use std::path::Path;

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
