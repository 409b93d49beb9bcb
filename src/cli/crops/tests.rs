use super::*;
use crate::math::PolarDirection;
use crate::session::CfaPattern;

fn picture(size: [usize; 2], layout: Layout) -> Picture {
    let n = size[0] * size[1] * layout.values_per_pixel();
    Picture {
        origin: [10, 20],
        size,
        layout,
        values: (0..n).map(|i| 1.0 + i as f32).collect(),
        noise: (0..n).map(|i| 0.1 * (1.0 + i as f32)).collect(),
        kept: vec![true; n],
        covered: vec![0.5; size[0] * size[1]],
        corners: vec![[11.0, 21.0], [13.0, 21.0], [13.0, 23.0]],
    }
}

fn configuration() -> Configuration {
    Configuration {
        id: 7,
        light: PolarDirection::from_degrees(30.0, 180.0),
        camera: PolarDirection::from_degrees(20.0, 0.0),
        rotation: 0.0,
    }
}

fn camera(width: usize, height: usize) -> CameraFacts {
    CameraFacts {
        name: "test".to_owned(),
        width,
        height,
        pixel_mm: 0.1,
        center_px: [0.5 * width as f64, 0.5 * height as f64],
        lens: Default::default(),
    }
}

fn gallery(pictures: bool, exr_folder: Option<PathBuf>, frames: &[FrameRecord]) -> Gallery {
    let wanted = Wanted {
        camera: camera(40, 40),
        crop: crate::measure::CropRule::Square,
        sample_square_mm: 1.0,
        configurations: vec![configuration()],
        usable_fraction: 0.92,
        pictures,
        exr_folder,
        attributes: vec![("session", "s".to_owned())],
    };
    Gallery::new(wanted, frames)
}

fn frame_record(file: &str, exposure_ms: f64) -> FrameRecord {
    FrameRecord {
        file: file.to_owned(),
        kind: FrameKind::Sample,
        config: Some(7),
        exposure_ms,
        requested_ms: None,
        repeat: 0,
        visit: 0,
        filter: None,
        exposed: None,
        utc: None,
        axes_deg: BTreeMap::new(),
        sha256: String::new(),
    }
}

#[test]
fn a_mosaic_becomes_blocks_of_red_mean_green_and_blue() {
    // 1 2 3 4 5
    // 6 7 8 9 10  the odd last row and column have no whole block
    // 11 ...
    let mut p = picture([5, 3], Layout::Bayer(CfaPattern::Rggb));
    p.kept[7] = false;
    let planes = Planes::of(&p).unwrap();
    assert_eq!(planes.size, [2, 1]);
    let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
    assert!(close(&planes.values[0], &[1.0, 3.0]), "{:?}", planes.values);
    // Greens 2 and 6; 4 alone, because 8 is left out.
    assert!(close(&planes.values[1], &[4.0, 4.0]));
    assert!(close(&planes.values[2], &[7.0, 9.0]));
    let two = (0.2_f32.powi(2) + 0.6_f32.powi(2)).sqrt() / 2.0;
    assert!(close(&planes.noise[1], &[two, 0.4]));
    assert!(close(&planes.covered, &[0.5, 0.5]) && close(&planes.kept, &[1.0, 1.0]));
    p.kept[2] = false;
    let planes = Planes::of(&p).unwrap();
    assert!(close(&planes.kept, &[1.0, 0.0]) && close(&planes.values[0], &[1.0, 0.0]));
}

#[test]
fn other_layouts_keep_their_size_and_bad_pictures_are_refused() {
    let rgb = Planes::of(&picture([2, 1], Layout::Rgb)).unwrap();
    assert_eq!((rgb.size, &rgb.values[1]), ([2, 1], &vec![2.0, 5.0]));
    let mono = Planes::of(&picture([2, 1], Layout::Mono)).unwrap();
    assert_eq!((mono.size, mono.values), ([2, 1], vec![vec![1.0, 2.0]]));
    let mut torn = picture([4, 4], Layout::Mono);
    torn.noise.pop();
    assert!(Planes::of(&torn).is_err());
    assert!(Planes::of(&picture([1, 4], Layout::Bayer(CfaPattern::Rggb))).is_err());
}

#[test]
fn crops_become_exr_files_and_pictures_from_any_thread() {
    let folder = tempfile::tempdir().unwrap();
    let gallery = gallery(true, Some(folder.path().to_owned()), &[]);
    let p = picture([4, 4], Layout::Bayer(CfaPattern::Rggb));
    std::thread::scope(|scope| {
        scope.spawn(|| gallery.crop(&configuration(), &p).unwrap());
        let other = Configuration {
            id: 12,
            ..configuration()
        };
        let p = &p;
        let gallery = &gallery;
        scope.spawn(move || gallery.crop(&other, p).unwrap());
    });
    for name in ["config_07.exr", "config_12.exr"] {
        let bytes = std::fs::read(folder.path().join(name)).unwrap();
        assert!(bytes.starts_with(&[0x76, 0x2f, 0x31, 0x01]), "{name}");
    }
    let channels = Planes::of(&p).unwrap().channels();
    let names: Vec<&str> = channels.iter().map(|c| c.0).collect();
    let expected = [
        "R", "noise.R", "G", "noise.G", "B", "noise.B", "covered", "kept",
    ];
    assert_eq!(names, expected);
    let attributes = attributes(&configuration());
    for (name, value) in [
        ("config", "7"),
        ("light_theta_deg", "30.000000"),
        ("unit", "1"),
    ] {
        assert!(
            attributes.contains(&(name, value.to_owned())),
            "{attributes:?}"
        );
    }
    let looks = gallery.looks([1.0; 3]).unwrap();
    let look = &looks.crops[&7];
    assert_eq!((look.size, looks.crops.len()), ([4.0, 4.0], 2));
    assert_eq!(look.outline, [[1.0, 1.0], [3.0, 1.0], [3.0, 3.0]]);
}

#[test]
fn the_middle_exposure_is_shown_with_its_histogram() {
    let records = [
        frame_record("long", 64.0),
        frame_record("short", 4.0),
        frame_record("middle", 16.0),
    ];
    let gallery = gallery(true, None, &records);
    let mut data = vec![200_u16; 40 * 40];
    // One pixel inside the square is bright: the middle of the image, a blue place of the mosaic.
    data[21 * 40 + 21] = 1000;
    let frame = RawFrame {
        make: String::new(),
        model: String::new(),
        width: 40,
        height: 40,
        margins: [0; 4],
        layout: Layout::Bayer(CfaPattern::Rggb),
        black: [100.0, 110.0, 130.0, 140.0],
        white: 1023,
        data,
        exposure_ms: None,
        aperture: None,
        iso: None,
        date_time: None,
    };
    for record in &records {
        gallery.frame(record, &frame).unwrap();
    }
    let looks = gallery.looks([2.0, 1.0, 1.5]).unwrap();
    let (look, h) = (&looks.frames[&7], &looks.histograms[&7]);
    assert!(
        look.caption.starts_with("middle, 16 ms"),
        "{}",
        look.caption
    );
    assert_eq!((look.size, look.outline.len()), ([40.0, 40.0], 4));
    let close = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9);
    assert!(close(h.black, [100.0, 120.0, 140.0]), "{:?}", h.black);
    assert!((h.clip - 0.92 * 1023.0).abs() < 1e-9);
    // 200 of 1024 is in bin 12, 1000 in bin 62.
    assert_eq!(h.counts[62], [0, 0, 1]);
    let total: u64 = h.counts.iter().flatten().sum();
    assert_eq!(total, h.counts[12].iter().sum::<u64>() + 1);
    // The square is 10 pixels wide and foreshortened to 9.4.
    assert!((90..=100).contains(&total), "{total}");
}
