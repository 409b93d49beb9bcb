//! Promise: what is wrong with a volume's file is said, and no damage makes the program panic.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/ct_files.rs"]
mod ct_files;

use ct_files::{Page, all, bytes, five_um, gzip, nrrd_header, open, pages, tiff, write, zlib};
use goniofit::base::Unwatched;
use goniofit::fabric::ct::{Unit, statistics};
use std::path::{Path, PathBuf};

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
