//! Promise: a chart of known patches gives the matrix from the camera's colors to a stated space with honest standard
//! errors, and says so when it cannot.
#![allow(clippy::unwrap_used, missing_docs)]

mod drawn;

use drawn::{BLACK, CFA, Drawn, folder, manifest, record, seed, verdict};
use goniofit::base::{Result, Unwatched};
use goniofit::math::{PolarDirection, Random};
use goniofit::measure::calibrate::{Calibrated, ColorOptions, ColorReport, color};
use goniofit::measure::calibration::{
    Calibrations, ColorMatrix, Dated, Header, Kind, Linearity, PhotonTransfer,
};
use goniofit::session::{
    CameraFacts, CfaPattern, Configuration, FrameKind, Projection, SessionFolder,
};
use std::path::Path;

const MATRIX: [[f64; 3]; 3] = [
    [1.62, -0.51, -0.09],
    [-0.21, 1.47, -0.29],
    [0.03, -0.42, 1.44],
];
/// Raw values per normalized radiance and millisecond.
const RESPONSIVITY: [f64; 3] = [160.0, 240.0, 190.0];
const PATCHES: usize = 12;

/// How a chart session is made.
#[derive(Clone)]
struct Setup {
    seed: u64,
    /// Only gray patches.
    gray: bool,
    with_white: bool,
    /// One more patch than these has another color than its reference.
    wrong_patch: bool,
    /// Raw values fall short of proportionality by this times their part of full scale.
    bend: f64,
    in_xyz: bool,
}

impl Setup {
    fn new(seed: u64) -> Self {
        Self {
            seed,
            gray: false,
            with_white: true,
            wrong_patch: false,
            bend: 0.0,
            in_xyz: false,
        }
    }

    /// What the camera sees of each patch, over cos(theta_light).
    fn seen(&self) -> Vec<[f64; 3]> {
        let patch = |k: usize| {
            // Levels 0.05 to 0.8, the channels in another order each.
            let level =
                |c: usize| 0.05 + 0.75 * ((k * [1, 5, 7][c] + 3 * c) % PATCHES) as f64 / 11.0;
            if self.gray {
                [level(0); 3]
            } else {
                [level(0), level(1), level(2)]
            }
        };
        (0..PATCHES).map(patch).collect()
    }

    fn reference(&self) -> Vec<[f64; 3]> {
        let mut reference: Vec<[f64; 3]> = self
            .seen()
            .iter()
            .map(|s| MATRIX.map(|row| row[0] * s[0] + row[1] * s[1] + row[2] * s[2]))
            .collect();
        if self.wrong_patch {
            reference[4][1] += 0.3;
        }
        reference
    }

    fn middle(k: usize) -> [f64; 2] {
        [1.9 * ((k % 4) as f64 - 1.5), 1.9 * ((k / 4) as f64 - 1.0)]
    }

    fn chart(&self) -> String {
        let mut text = "patch,x_mm,y_mm,width_mm,height_mm,r,g,b\n".to_owned();
        if self.in_xyz {
            text = text.replace("r,g,b", "X,Y,Z");
        }
        for (k, [r, g, b]) in self.reference().into_iter().enumerate() {
            let [x, y] = Self::middle(k);
            let color = match self.in_xyz {
                // IEC 61966-2-1.
                true => [
                    0.4124 * r + 0.3576 * g + 0.1805 * b,
                    0.2126 * r + 0.7152 * g + 0.0722 * b,
                    0.0193 * r + 0.1192 * g + 0.9505 * b,
                ],
                false => [r, g, b],
            };
            text += &format!(
                "p{k},{x},{y},1.4,1.4,{},{},{}\n",
                color[0], color[1], color[2]
            );
        }
        text
    }

    fn camera() -> CameraFacts {
        CameraFacts {
            name: "test camera".to_owned(),
            width: 190,
            height: 190,
            pixel_mm: 0.05,
            center_px: [95.2, 94.1],
            lens: Default::default(),
        }
    }

    fn pose() -> Configuration {
        Configuration {
            id: 3,
            light: PolarDirection::from_degrees(45.0, 180.0),
            camera: PolarDirection::from_degrees(20.0, 0.0),
            rotation: 30f64.to_radians(),
        }
    }

    /// Raw values of a picture of normalized radiance.
    fn frame(
        &self,
        ms: f64,
        picture: impl Fn(usize, usize) -> [f64; 3],
        random: &mut Random,
    ) -> Vec<u16> {
        let camera = Self::camera();
        let raw = (0..camera.width * camera.height).map(|i| {
            let (x, y) = (i % camera.width, i / camera.width);
            let c = CFA.channel(y, x);
            let signal = RESPONSIVITY[c] * picture(x, y)[c] * ms;
            let bent = signal * (1.0 - self.bend * signal / 4000.0);
            let noise = (4.0 + 0.3 * signal).sqrt() * random.normal();
            let value = BLACK[CfaPattern::position(y, x)] + bent + noise;
            value.round().clamp(0.0, 4095.0) as u16
        });
        raw.collect()
    }

    /// Records the session as `s`, and the chart's file as `chart.csv`.
    fn record(&self, folder: &Path) -> SessionFolder {
        let (camera, pose) = (Self::camera(), Self::pose());
        let white = Configuration { id: 0, ..pose };
        let manifest = manifest(camera.clone(), white);
        let mut random = Random::keyed(&[self.seed, 3]);
        let projection = Projection::new(&camera, &pose);
        let seen = self.seen();
        let chart = |x: usize, y: usize| {
            let p = projection.to_sample([x as f64 + 0.5, y as f64 + 0.5]);
            let near = |k: &usize| {
                let m = Self::middle(*k);
                (p[0] - m[0]).abs() < 0.85 && (p[1] - m[1]).abs() < 0.85
            };
            let color = (0..PATCHES).find(near).map_or([0.02; 3], |k| seen[k]);
            color.map(|v| v * pose.light.theta.cos())
        };
        let factor = manifest.white.reflectance_factor;
        let panel = |_: usize, _: usize| factor.map(|f| f * pose.light.theta.cos());
        let mut frames = Vec::new();
        let mut shoot = |kind, config, exposure_ms, data| {
            frames.push(Drawn {
                kind,
                config,
                exposure_ms,
                data,
            });
        };
        for ms in [5.0, 15.0, 80.0] {
            for _ in 0..4 {
                let data = self.frame(ms, |_, _| [0.0; 3], &mut random);
                shoot(FrameKind::Dark, None, ms, data);
            }
            let data = self.frame(ms, chart, &mut random);
            shoot(FrameKind::Chart, Some(3), ms, data);
            if self.with_white && ms < 80.0 {
                for _ in 0..2 {
                    let data = self.frame(ms, panel, &mut random);
                    shoot(FrameKind::White, None, ms, data);
                }
            }
        }
        let session = record(&folder.join("s"), &manifest, &[pose], &frames);
        std::fs::write(folder.join("chart.csv"), self.chart()).unwrap();
        session
    }

    fn run(&self, known: &Calibrations) -> Result<(Calibrated<ColorMatrix>, ColorReport)> {
        let folder = folder();
        let session = self.record(folder.path());
        let options = ColorOptions {
            chart: folder.path().join("chart.csv"),
            space: "srgb".to_owned(),
        };
        color(&session, known, &options, &Unwatched)
    }
}

fn pulls(found: &ColorMatrix) -> Vec<f64> {
    let cells = (0..9).map(|k| (k / 3, k % 3));
    cells
        .map(|(r, c)| (found.matrix[r][c] - MATRIX[r][c]) / found.covariance[r][c][c].sqrt())
        .collect()
}

#[test]
fn the_matrix_is_found_within_its_standard_errors() {
    let seed = seed(20_251_122);
    let all: Vec<Vec<f64>> = (0..60)
        .map(|i| {
            let (made, report) = Setup::new(seed + i).run(&Calibrations::default()).unwrap();
            let found = &made.dated.value;
            assert_eq!(found.patches, PATCHES);
            assert!(made.faults.is_empty(), "{:?}", made.faults);
            assert!(report.delta_e.unwrap()[1] < 1.0, "{report:?}");
            assert!(found.residual.iter().all(|r| *r < 0.01), "{found:?}");
            pulls(found)
        })
        .collect();
    println!("{}", verdict(&all).unwrap());
    // The control: a matrix that is off by 1 %.
    let wrong: Vec<Vec<f64>> = all
        .iter()
        .map(|p| p.iter().map(|p| p + 8.0).collect())
        .collect();
    assert!(verdict(&wrong).is_err());
}

#[test]
fn xyz_references_and_neutral_patches_do_as_well() {
    let mut setup = Setup::new(seed(7));
    setup.in_xyz = true;
    let (made, _) = setup.run(&Calibrations::default()).unwrap();
    for (row, truth) in made.dated.value.matrix.iter().zip(&MATRIX) {
        for (found, truth) in row.iter().zip(truth) {
            // The standard's two matrices agree to 3e-4.
            assert!(
                (found - truth).abs() < 0.02,
                "{:?}",
                made.dated.value.matrix
            );
        }
    }
    setup.with_white = false;
    let error = setup.run(&Calibrations::default()).unwrap_err().report();
    assert!(
        error.contains("no neutral patch") && error.contains("hint:"),
        "{error}"
    );
}

#[test]
fn a_wrong_patch_and_a_bent_response_are_told() {
    let mut setup = Setup::new(seed(8));
    setup.wrong_patch = true;
    let (made, report) = setup.run(&Calibrations::default()).unwrap();
    assert!(
        made.faults.iter().any(|f| f.contains("green")),
        "{:?}",
        made.faults
    );
    assert!(report.delta_e.unwrap()[1] > 10.0);
    // A response bent by 12 % at full scale: the matrix is off by many standard errors unless the curve is known.
    let mut setup = Setup::new(seed(9));
    setup.bend = 0.12;
    let (bent, _) = setup.run(&Calibrations::default()).unwrap();
    let residual = bent.dated.value.residual;
    let (mended, _) = setup.run(&curve(0.12)).unwrap();
    let better = mended.dated.value.residual;
    assert!(
        (0..3).all(|c| better[c] < 0.5 * residual[c]),
        "{residual:?} {better:?}"
    );
}

/// The linearity calibration of `signal - bend signal^2 / 4000`, to third order.
fn curve(bend: f64) -> Calibrations {
    let value = Linearity {
        coefficients: vec![bend, 2.0 * bend * bend, 5.0 * bend.powi(3)],
        covariance: vec![vec![0.0; 3]; 3],
        full_scale: 4000.0,
        bias: BLACK,
        usable: [0.0, 0.95],
        points: Vec::new(),
        transfer: PhotonTransfer {
            variance_per_signal: [0.3; 3],
            variance_per_signal_se: [0.01; 3],
            read_noise: 2.0,
            read_noise_se: 0.1,
            points: Vec::new(),
        },
    };
    Calibrations {
        linearity: Some(Dated {
            header: Header {
                format: Header::FORMAT.to_owned(),
                kind: Kind::Linearity,
                rig: "virtual".to_owned(),
                camera: "test camera".to_owned(),
                size_px: [190, 190],
                date_utc: "2024-02-28T12:00:00Z".to_owned(),
                sessions: Vec::new(),
                synthetic: true,
                program: "test".to_owned(),
            },
            value,
        }),
        ..Calibrations::default()
    }
}

#[test]
fn charts_that_make_no_matrix_are_refused() {
    let mut setup = Setup::new(seed(10));
    setup.gray = true;
    let error = setup.run(&Calibrations::default()).unwrap_err().report();
    assert!(
        error.contains("too much alike") && error.contains("hint:"),
        "{error}"
    );

    let folder = folder();
    let pose = Setup::pose();
    let manifest = manifest(Setup::camera(), pose);
    let session = record(&folder.path().join("s"), &manifest, &[pose], &[]);
    let error = |chart: &str| {
        let path = folder.path().join("chart.csv");
        std::fs::write(&path, chart).unwrap();
        let options = ColorOptions {
            chart: path,
            space: "srgb".to_owned(),
        };
        let made = color(&session, &Calibrations::default(), &options, &Unwatched);
        made.unwrap_err().report()
    };
    let text = Setup::new(1).chart();
    let few: String = text.lines().take(5).map(|l| format!("{l}\n")).collect();
    assert!(
        error(&few).contains("4 patches, expected 6"),
        "{}",
        error(&few)
    );
    let percent = text
        .replacen("1.4,1.4,", "1.4,1.4,9", 1)
        .replacen("1.4,1.4,9-", "1.4,1.4,9", 1);
    assert!(
        error(&percent).contains("divide values in percent by 100"),
        "{}",
        error(&percent)
    );
    assert!(error(&text.replace("width_mm", "size")).contains("columns:"));
    assert!(error(&text).contains("no chart frames"), "{}", error(&text));
}

#[test]
fn the_command_writes_a_file_that_reads_back() {
    let folder = folder();
    Setup::new(seed(11)).record(folder.path());
    let run = assert_cmd::Command::cargo_bin("goniofit")
        .unwrap()
        .current_dir(folder.path())
        .args(["calibrate", "color", "s", "--chart", "chart.csv"])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&run.stdout);
    assert_eq!(
        run.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&run.stderr)
    );
    assert!(
        text.contains("color difference") && text.contains("p11"),
        "{text}"
    );
    let found = Calibrations::read(&folder.path().join("calibration/virtual")).unwrap();
    let found = found.color.unwrap().value;
    assert!(
        (found.matrix[0][0] - MATRIX[0][0]).abs() < 0.05,
        "{found:?}"
    );
}
