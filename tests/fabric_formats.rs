//! Promise: fibers survive the trip through every file format, and torn or senseless files are refused with their place.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::fabric::{FabricReport, FiberTile, Format, NO_SEGMENT, curves, export, import, load};
use std::path::Path;

fn tile() -> FiberTile {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("f.toml");
    let system = "pitch_mm = 0.31\nfibers = 4\nfiber_radius_um = 9.7\nyarn_radius_mm = 0.06\ncrown_mm = 0.06\n\
                  twist_per_tile = 2\nmigration_depth = 0.5\n";
    let text = format!(
        "name = \"t\"\n[weave]\npattern = \"plain\"\n[warp]\n{system}[weft]\n{system}[segments]\nlength_mm = 0.02\n"
    );
    std::fs::write(&path, text).unwrap();
    load(&path).unwrap().tile
}

/// Writes bytes and reads them back as a tile.
fn read(bytes: &[u8], format: Format, size: Option<[f64; 2]>) -> Result<FiberTile, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("fibers");
    std::fs::write(&path, bytes).unwrap();
    import(&path, format, size).map_err(|e| e.report())
}

/// A tile with a closed fiber, an open one, one of varying radius, and one kept in two pieces.
fn mixed() -> FiberTile {
    let text = "# tile_mm = [1, 0.5]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n\
                0.1,0.1,0,0.6,0.1,0.1,0.01,1\n0.6,0.1,0.1,1.1,0.1,0,0.01,1\n\
                0.2,0.3,0,0.5,0.3,0.1,0.02,0\n0.5,0.3,0.1,0.7,0.4,0.1,0.03,0\n\
                0.9,0.2,0,1,0.25,0,0.004,0\n0.5,0.5,0.5,0.6,0.6,0.6,0.01,0\n0,0.25,0,0.3,0.3,0,0.004,0\n";
    read(text.as_bytes(), Format::Csv, None).unwrap()
}

#[test]
fn csv_keeps_everything() {
    for original in [tile(), mixed()] {
        let bytes = export(&original, Format::Csv).unwrap();
        assert_eq!(read(&bytes, Format::Csv, None).unwrap(), original);
    }
    let links: Vec<(u32, u32)> = mixed()
        .segments
        .iter()
        .map(|s| (s.previous, s.next))
        .collect();
    let no = NO_SEGMENT;
    let expected = [(1, 1), (0, 0), (no, 3), (2, no), (no, 6), (no, no), (4, no)];
    assert_eq!(links, expected);
}

#[test]
fn mitsuba_text_keeps_all_but_the_yarn_system() {
    let mut original = tile();
    let bytes = export(&original, Format::Mitsuba).unwrap();
    for s in &mut original.segments {
        s.yarn_system = 0;
    }
    assert_eq!(
        read(&bytes, Format::Mitsuba, Some(original.size)).unwrap(),
        original
    );
    // The file is what Mitsuba's reader takes: four numbers a line, one blank line between curves, none at the ends.
    let text = String::from_utf8(bytes).unwrap();
    let blocks: Vec<&str> = text.trim_end_matches('\n').split("\n\n").collect();
    assert_eq!(blocks.len(), curves(&original).len());
    for line in blocks.iter().flat_map(|b| b.lines()) {
        assert_eq!(
            line.split(' ').filter(|w| w.parse::<f64>().is_ok()).count(),
            4,
            "{line}"
        );
    }
}

#[test]
fn hair_keeps_all_but_the_yarn_system_to_single_precision() {
    for original in [tile(), mixed()] {
        let bytes = export(&original, Format::Hair).unwrap();
        assert!(bytes.starts_with(b"HAIR"));
        let info = String::from_utf8_lossy(&bytes[40..128]).into_owned();
        assert!(info.contains("millimeters"), "{info}");
        let found = read(&bytes, Format::Hair, Some(original.size)).unwrap();
        assert_eq!(found.segments.len(), original.segments.len());
        // Fibers stored in one piece come back in the same order; a fiber in two pieces becomes one strand.
        let (a, b) = (curves(&original), curves(&found));
        assert_eq!(a.len(), b.len());
        for (a, b) in a.iter().zip(&b) {
            assert_eq!(a.points.len(), b.points.len());
            for (p, q) in a.points.iter().zip(&b.points) {
                assert!(p.distance(*q) < 3e-7, "{p} {q}");
            }
            for (p, q) in a.radii.iter().zip(&b.radii) {
                assert!((p / q - 1.0).abs() < 1e-6);
            }
        }
    }
}

#[test]
fn long_fibers_are_cut_into_strands_and_joined_again() {
    let n = 70_000;
    let mut text = String::from("# tile_mm = [1, 1]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n");
    let x = |k: usize| k as f64 / n as f64;
    for k in 0..n {
        text.push_str(&format!("{},0,0,{},0,0,0.01,0\n", x(k), x(k + 1)));
    }
    let original = read(text.as_bytes(), Format::Csv, None).unwrap();
    let bytes = export(&original, Format::Hair).unwrap();
    assert_eq!(u32::from_le_bytes(bytes[4..8].try_into().unwrap()), 2);
    let found = read(&bytes, Format::Hair, Some([1.0, 1.0])).unwrap();
    assert_eq!(curves(&found).len(), 1);
    assert!(found.segments.iter().all(|s| s.next != NO_SEGMENT));
}

#[test]
fn fibers_10_nm_apart_are_one_and_farther_are_two() {
    let joined = |gap: f64| {
        let text = format!(
            "# tile_mm = [1, 1]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n\
             0.1,0.1,0,0.2,0.1,0,0.01,0\n0.5,0.5,0,0.6,0.5,0,0.01,0\n{},0.1,0,0.3,0.1,0,0.01,0\n",
            0.2 + gap
        );
        read(text.as_bytes(), Format::Csv, None).unwrap().segments[0].next == 2
    };
    assert!(joined(0.0) && joined(9e-6) && joined(-9e-6));
    assert!(!joined(1.1e-5) && !joined(1e-4));
}

#[test]
fn malformed_text_is_refused_with_the_line() {
    let head = "# tile_mm = [1, 1]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n";
    let row = "0,0,0,1,0,0,0.01,0\n";
    let csv = |text: String, expected: &str| {
        let message = read(text.as_bytes(), Format::Csv, None).unwrap_err();
        assert!(message.contains(expected), "{message}");
    };
    csv(
        format!("{head}{row}0,0,0,1,0\n"),
        "line 4: expected 8 columns",
    );
    csv(
        format!("{head}{row}0,0,0,1,0,0,0.0"),
        "line 4: expected 8 columns",
    );
    csv(
        format!("{head}{row}0,0,0,1,0,0,0.01,0"),
        "line 4: the last line has no line end",
    );
    csv(
        format!("{head}0,0,0,NaN,0,0,0.01,0\n"),
        "line 3: expected finite",
    );
    csv(
        format!("{head}0,0,0,1,x,0,0.01,0\n"),
        "line 3: expected a number, found 'x'",
    );
    csv(
        format!("{head}0,0,0,1,0,0,-0.01,0\n"),
        "line 3: expected a fiber radius",
    );
    csv(
        format!("{head}0,0,0,1,0,0,nan,0\n"),
        "line 3: expected a fiber radius",
    );
    csv(
        format!("{head}0,0,0,0,0,0,0.01,0\n"),
        "line 3: the segment has no length",
    );
    csv(
        format!("{head}0,0,0,1,0,0,0.01,300\n"),
        "line 3: expected a yarn_system",
    );
    csv(head.to_owned(), "the fabric is empty");
    csv(String::new(), "the tile size is missing");
    csv(
        format!("{}{row}", head.replace("[1, 1]", "[1, -1]")),
        "line 1: tile size 1 x -1",
    );
    csv(
        format!("# tile_mm = [1, 1]\n{row}"),
        "line 2: expected the header",
    );
    let clash = read(
        format!("{head}{row}").as_bytes(),
        Format::Csv,
        Some([2.0, 1.0]),
    );
    assert!(clash.unwrap_err().contains("the file says"));

    let mitsuba = |text: &str, expected: &str| {
        let message = read(text.as_bytes(), Format::Mitsuba, Some([1.0, 1.0])).unwrap_err();
        assert!(message.contains(expected), "{message}");
    };
    mitsuba(
        "0 0 0 1\n\n",
        "line 2: the curve that ends here has one point",
    );
    mitsuba(
        "0 0 0 1\n1 0 0\n",
        "line 2: expected 'x y z radius', found 3",
    );
    mitsuba("0 0 0 1\n1 0 inf 1\n", "line 2: expected a finite number");
    mitsuba("0 0 0 1\n1 0 0 0\n", "line 2: expected a positive radius");
    mitsuba("0 0 0 1\n0 0 0 1\n", "line 2: the segment has no length");
    mitsuba("0 0 0 1\n1 0 0 1", "the last line has no line end");
    mitsuba("", "the fabric is empty");
    let no_tile = read(b"0 0 0 1\n1 0 0 1\n", Format::Mitsuba, None).unwrap_err();
    assert!(
        no_tile.contains("hint: give it in millimeters"),
        "{no_tile}"
    );
}

#[test]
fn torn_hair_files_are_refused_at_every_length() {
    let bytes = export(&mixed(), Format::Hair).unwrap();
    for length in 0..bytes.len() {
        let result = read(&bytes[..length], Format::Hair, Some([1.0, 0.5]));
        assert!(result.is_err(), "{length} of {} bytes", bytes.len());
    }
    let mut huge = bytes.clone();
    huge[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(
        read(&huge, Format::Hair, Some([1.0, 0.5]))
            .unwrap_err()
            .contains("at most")
    );
    let mut nan = bytes;
    let first_point = 128 + 2 * curves(&mixed()).len();
    nan[first_point..first_point + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    let message = read(&nan, Format::Hair, Some([1.0, 0.5])).unwrap_err();
    assert!(
        message.contains("strand 1, segment 1: expected finite"),
        "{message}"
    );
}

#[test]
fn a_description_can_point_to_a_fiber_file() {
    let folder = tempfile::tempdir().unwrap();
    let original = tile();
    for (format, name, tile_key) in [
        (Format::Csv, "a.csv", false),
        (Format::Mitsuba, "a.txt", true),
        (Format::Hair, "a.hair", true),
    ] {
        std::fs::write(folder.path().join(name), export(&original, format).unwrap()).unwrap();
        let size = original.size;
        let key = if tile_key {
            format!("tile_mm = [{}, {}]\n", size[0], size[1])
        } else {
            String::new()
        };
        let text = format!("name = \"lab\"\nfibers = \"{name}\"\ndensity_g_cm3 = 1.3\n{key}");
        let path = folder.path().join("lab.toml");
        std::fs::write(&path, text).unwrap();
        let fabric = load(&path).unwrap();
        let report: &FabricReport = &fabric.report;
        assert_eq!(report.fibers, 16);
        assert_eq!(report.closed_fibers, 16);
        assert!(report.mass_g_per_m2.is_some() && report.systems.is_empty());
    }
    assert_eq!(load(&folder.path().join("a.csv")).unwrap().tile, original);
    assert!(load(Path::new("fabrics/none.csv")).is_err());
}
