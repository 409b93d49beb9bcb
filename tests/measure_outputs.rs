//! Promise: every file a measurement leaves states its quantity and origin and reads back as the same numbers, by readers
//! written after the formats' published ones.
#![allow(clippy::unwrap_used, missing_docs)]

use assert_cmd::Command;
use goniofit::math::PolarDirection;
use goniofit::session::{
    Configuration, Intensity, MeasurementRecord, Measurements, SessionStamp, alta_text,
    astm_standard_errors, astm_text, brdf_tables, sha256,
};
use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::path::{Path, PathBuf};

const MOCK: &str = "mocks/khungurn16_gabardine";

fn goniofit(arguments: &[&str]) -> std::process::Output {
    Command::cargo_bin("goniofit")
        .unwrap()
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(arguments)
        .output()
        .unwrap()
}

fn intensity(id: u32, light: [f64; 2], camera: [f64; 2], rotation_deg: f64) -> Intensity {
    Intensity {
        configuration: Configuration {
            id,
            light: PolarDirection::from_degrees(light[0], light[1]),
            camera: PolarDirection::from_degrees(camera[0], camera[1]),
            rotation: f64::to_radians(rotation_deg),
        },
        mean: [0.5, 0.25, 0.125],
        standard_error: [0.015_625, 0.007_812_5, 0.003_906_25],
        present: [true; 3],
    }
}

fn two() -> Measurements {
    Measurements {
        intensities: vec![
            intensity(1, [0.0, 0.0], [60.0, 0.0], 0.0),
            intensity(2, [60.0, 180.0], [30.0, 0.0], 90.0),
        ],
    }
}

fn stamp() -> SessionStamp {
    SessionStamp {
        name: "NUM_POINTS VARS\nx".to_owned(),
        started_utc: "2026-01-02T03:04:05Z".to_owned(),
        rig: "five axes".to_owned(),
        camera: "Maker Model".to_owned(),
        ..SessionStamp::default()
    }
}

/// Reads a table as the published readers of such files do: words of the header until `VARS`, then lines of seven numbers.
fn read_astm(text: &str) -> Vec<[f64; 7]> {
    let mut points = None;
    let mut lines = text.lines();
    for line in lines.by_ref() {
        if let Some(n) = line.strip_prefix("NUM_POINTS ") {
            assert!(points.is_none());
            points = Some(n.parse::<usize>().unwrap());
        } else if let Some(names) = line.strip_prefix("VARS ") {
            assert_eq!(names, "theta_i,phi_i,theta_s,phi_s,R,G,B");
            break;
        } else {
            let mut words = line.split_whitespace();
            assert!(words.all(|w| w != "VARS" && w != "NUM_POINTS"), "{line}");
        }
    }
    let rows: Vec<[f64; 7]> = lines
        .map(|line| {
            let numbers: Vec<f64> = line.split(',').map(|x| x.parse().unwrap()).collect();
            assert!(numbers[..4].iter().all(|a| (0.0..2.0 * PI).contains(a)));
            numbers.try_into().unwrap()
        })
        .collect();
    assert_eq!(points, Some(rows.len()));
    rows
}

/// Reads a data file as the library does: `#KEY value` lines, `# ` comments, then numbers.
fn read_alta(text: &str) -> Vec<[f64; 13]> {
    let mut header: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    let mut rows = Vec::new();
    for line in text.lines() {
        if let Some(line) = line.strip_prefix('#') {
            if !line.starts_with(' ') {
                let (key, value) = line.split_once(' ').unwrap();
                header.entry(key).or_default().push(value.trim());
            }
            continue;
        }
        let numbers: Vec<f64> = line
            .split_whitespace()
            .map(|x| x.parse().unwrap())
            .collect();
        rows.push(numbers.try_into().unwrap());
    }
    assert_eq!(header["ALTA"], ["BEGIN HEADER", "END HEADER"]);
    assert_eq!(header["DIM"], ["4 3"]);
    assert_eq!(header["PARAM_IN"], ["SPHERICAL_TL_PL_TV_PV"]);
    assert_eq!(header["PARAM_OUT"], ["RGB_COLOR"]);
    assert_eq!(header["VS"], ["2"; 3]);
    rows
}

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-12 * b.abs().max(1e-3)
}

/// A direction that does not depend on how its azimuth is counted.
fn same_direction(theta: f64, phi: f64, expected: PolarDirection) -> bool {
    let found = PolarDirection::new(theta, phi).vector();
    (found - expected.vector()).length() < 1e-9
}

#[test]
fn the_astm_table_is_this_text() {
    let expected = "STANDARD after ASTM E1392-96\nSESSION points vars x\nDATE 2026-01-02T03:04:05Z\n\
        INSTRUMENT five axes\nDETECTOR Maker Model\nSOURCE synthetic, no camera saw any cloth\nQUANTITY BRDF\n\
        UNITS 1/sr, angles in radians, azimuths in the sample frame\nCHANNELS R G B of the camera\nNUM_POINTS 2\n\
        VARS theta_i,phi_i,theta_s,phi_s,R,G,B\n\
        0,0,1.0471975511965976,0,0.15915494309189535,0.07957747154594767,0.039788735772973836\n\
        1.0471975511965976,1.5707963267948966,0.5235987755982988,4.71238898038469,0.3183098861837906,0.1591549430918953,0.07957747154594765\n";
    assert_eq!(astm_text(&two(), &stamp(), true), expected);
    let errors = astm_standard_errors(&two(), &stamp(), false);
    assert!(errors.contains("SOURCE measured\nQUANTITY standard error of the BRDF"));
    let (rows, errors) = (read_astm(expected), read_astm(&errors));
    assert!(close(errors[1][4], rows[1][4] / 32.0), "{errors:?}");
}

#[test]
fn the_alta_file_is_this_text() {
    let expected = "#ALTA BEGIN HEADER\n# synthetic: no camera saw any cloth\n\
        # session NUM_POINTS VARS x, 2026-01-02T03:04:05Z, rig five axes, camera Maker Model\n\
        # BRDF, 1/sr (cosine of the light divided out); angles in radians, azimuths in the sample frame\n\
        # columns: theta_light phi_light theta_view phi_view r g b r_low r_high g_low g_high b_low b_high\n\
        # low and high: mean - and + 2 standard errors\n#DIM 4 3\n#PARAM_IN SPHERICAL_TL_PL_TV_PV\n#PARAM_OUT RGB_COLOR\n\
        #VS 2\n#VS 2\n#VS 2\n#ALTA END HEADER\n0\t0\t1.0471975511965976\t0\t0.15915494309189535";
    let text = alta_text(&two(), &stamp(), true);
    assert!(text.starts_with(expected), "{text}");
    let rows = read_alta(&text);
    for (k, m) in [0.5, 0.25, 0.125].into_iter().enumerate() {
        let f = m / PI;
        assert!(close(rows[0][4 + k], f));
        assert!(close(rows[0][7 + 2 * k], f * (1.0 - 1.0 / 16.0)));
        assert!(close(rows[0][8 + 2 * k], f * (1.0 + 1.0 / 16.0)));
    }
}

#[test]
fn brdf_tables_mark_copies_and_leave_out_those_that_were_measured() {
    let mut list = vec![
        intensity(1, [30.0, 20.0], [60.0, 0.0], 0.0),
        // The same exitant direction with the sample turned and the camera with it.
        intensity(2, [0.0, 0.0], [60.0, 45.0], 45.0),
        // At the normal, the turned pose of 3 is 4.
        intensity(3, [40.0, 10.0], [0.0, 0.0], 0.0),
        intensity(4, [40.0, 190.0], [0.0, 0.0], 0.0),
    ];
    list[1].mean = [1.0; 3];
    let measurements = Measurements { intensities: list };
    let plain = brdf_tables(&measurements, false);
    let names: Vec<String> = plain.iter().map(|t| t.name()).collect();
    assert_eq!(names, ["exitant_t60_p000", "exitant_t00_p000"]);
    assert_eq!(plain.iter().map(|t| t.len()).collect::<Vec<_>>(), [2, 2]);
    let copied = brdf_tables(&measurements, true);
    assert_eq!(copied.iter().map(|t| t.len()).collect::<Vec<_>>(), [4, 2]);
    let text = copied[0].to_csv(true);
    assert!(text.starts_with("# synthetic\n# BRDF, unit 1/sr"), "{text}");
    let rows: Vec<&str> = text.lines().filter(|l| !l.starts_with('#')).collect();
    assert_eq!(
        rows[0],
        "config,symmetry_deg,theta_i_deg,phi_i_deg,theta_e_deg,phi_e_deg,r,g,b,r_se,g_se,b_se"
    );
    assert!(rows[1].starts_with("1,0,30,20,60,0,"), "{}", rows[1]);
    assert!(rows[2].starts_with("1,180,30,200,60,180,"), "{}", rows[2]);
    let numbers = |row: &str| row.splitn(7, ',').last().unwrap().to_owned();
    assert_eq!(numbers(rows[1]), numbers(rows[2]));
    let r: f64 = numbers(rows[1]).split(',').next().unwrap().parse().unwrap();
    assert!(close(r, 0.5 / (PI * 30_f64.to_radians().cos())), "{r}");
    assert!(rows[3].starts_with("2,0,0,"), "{}", rows[3]);
}

#[test]
fn a_measured_session_reads_back_from_every_export() {
    let folder = tempfile::tempdir().unwrap();
    let stem = folder.path().join("out");
    let [stem_name] = [stem.to_str().unwrap()];
    let arguments = [
        "measure",
        "session",
        MOCK,
        "--out",
        stem_name,
        "--export",
        "all",
        "--symmetry",
        "180",
        "--json",
    ];
    let out = goniofit(&arguments);
    assert!(
        out.status.success(),
        "{}",
        String::from_utf8_lossy(&out.stderr)
    );
    let at = |ending: &str| PathBuf::from(format!("{stem_name}{ending}"));
    let text = |ending: &str| std::fs::read_to_string(at(ending)).unwrap();

    let csv = text(".csv");
    assert!(csv.starts_with("# synthetic\n# quantity: normalized_radiance, unit 1\n"));
    let (measured, synthetic) = Measurements::read_with_origin(&at(".csv")).unwrap();
    assert_eq!((measured.intensities.len(), synthetic), (16, Some(true)));
    assert_eq!(
        Measurements::read_with_origin(&at(".json")).unwrap(),
        (measured.clone(), Some(true))
    );

    let record = MeasurementRecord::from_json(&text(".json")).unwrap();
    assert_eq!(record.session.name, "khungurn16_gabardine");
    let mock = Path::new(env!("CARGO_MANIFEST_DIR")).join(MOCK);
    let journal = std::fs::read(mock.join("journal.jsonl")).unwrap();
    assert_eq!(record.session.journal_sha256, sha256(&journal));
    for c in &record.configurations {
        assert_eq!(
            (c.condition.as_str(), c.budget.contains_key("shot")),
            ("good", true)
        );
        for k in 0..3 {
            let sum: f64 = c.budget.values().map(|p| p[k].powi(2)).sum();
            assert!(
                close(sum.sqrt(), c.standard_error.unwrap()[k].unwrap()),
                "{c:?}"
            );
        }
    }

    let (astm, errors) = (read_astm(&text(".astm")), read_astm(&text("_se.astm")));
    let alta = read_alta(&text(".alta"));
    assert_eq!((astm.len(), errors.len(), alta.len()), (16, 16, 16));
    for (n, i) in measured.intensities.iter().enumerate() {
        let c = &i.configuration;
        let to_radiance = PI * c.light.theta.cos();
        for row in [&astm[n][..4], &errors[n][..4], &alta[n][..4]] {
            assert!(
                same_direction(row[0], row[1], c.light_in_sample()),
                "{row:?}"
            );
            assert!(
                same_direction(row[2], row[3], c.camera_in_sample()),
                "{row:?}"
            );
        }
        for k in 0..3 {
            assert!(close(astm[n][4 + k] * to_radiance, i.mean[k]));
            assert!(close(errors[n][4 + k] * to_radiance, i.standard_error[k]));
            assert!(close(alta[n][4 + k] * to_radiance, i.mean[k]));
            let width = alta[n][8 + 2 * k] - alta[n][7 + 2 * k];
            let se = width / 4.0 * to_radiance;
            assert!((se / i.standard_error[k] - 1.0).abs() < 1e-9);
        }
    }

    let mut tables = 0;
    let mut found: BTreeMap<u32, usize> = BTreeMap::new();
    for file in std::fs::read_dir(at("_brdf")).unwrap() {
        let text = std::fs::read_to_string(file.unwrap().path()).unwrap();
        tables += 1;
        let rows = text.lines().filter(|l| !l.starts_with('#')).skip(1);
        for row in rows {
            let cells: Vec<f64> = row.split(',').map(|x| x.parse().unwrap()).collect();
            let id = cells[0] as u32;
            *found.entry(id).or_default() += 1;
            let all = &measured.intensities;
            let i = all.iter().find(|i| i.configuration.id == id).unwrap();
            let to_radiance = PI * i.configuration.light.theta.cos();
            for k in 0..3 {
                assert!(close(cells[6 + k] * to_radiance, i.mean[k]), "{row}");
                assert!(
                    close(cells[9 + k] * to_radiance, i.standard_error[k]),
                    "{row}"
                );
            }
        }
    }
    // Camera at 80, 48, 32 and 64 degrees, the sample at 0 and 90 (80 and 64 each with one or both).
    assert_eq!((tables, found.len()), (7, 16));
    assert!(found.values().all(|n| *n == 2), "{found:?}");

    let page = text(".html");
    assert!(page.contains("SYNTHETIC") && page.contains("<strong>16 of 16</strong>"));
    for i in &measured.intensities {
        for k in 0..3 {
            let se = i.standard_error[k];
            let decimals = (1.0 - se.log10().floor()) as usize;
            let shown = format!("{:.decimals$} ± {se:.decimals$}", i.mean[k]);
            assert!(page.contains(&shown), "{shown}");
        }
    }

    // Nothing is overwritten, and nothing measured first.
    let again = goniofit(&arguments);
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&again.stderr).contains("exists already"));

    // In another quantity the file reads back as the same intensities.
    let other = folder.path().join("brdf.csv");
    let out = goniofit(&[
        "measure",
        "session",
        MOCK,
        "--out",
        other.to_str().unwrap(),
        "--as",
        "brdf",
        "--export",
        "none",
    ]);
    assert!(out.status.success());
    assert!(String::from_utf8_lossy(&out.stdout).contains("unit 1/sr"));
    assert!(!folder.path().join("brdf.html").exists());
    let brdf = std::fs::read_to_string(&other).unwrap();
    assert!(brdf.contains("# quantity: brdf, unit 1/sr\n"), "{brdf}");
    let back = Measurements::read(&other).unwrap();
    for (a, b) in back.intensities.iter().zip(&measured.intensities) {
        assert!((0..3).all(|k| close(a.mean[k], b.mean[k])));
    }
}

#[test]
fn a_fit_knows_synthetic_numbers_wherever_their_file_lies() {
    let folder = tempfile::tempdir().unwrap();
    let stem = folder.path().join("copied");
    let out = goniofit(&[
        "measure",
        "session",
        MOCK,
        "--out",
        stem.to_str().unwrap(),
        "--export",
        "none",
    ]);
    assert!(out.status.success());
    let synthetic = |file: &str| {
        let fit = folder.path().join(format!("fit_{file}"));
        let out = goniofit(&[
            "fit",
            "--measurements",
            folder.path().join(file).to_str().unwrap(),
            "--fabric",
            "fabrics/gabardine.toml",
            "--paths",
            "20000",
            "--out",
            fit.to_str().unwrap(),
            "--json",
        ]);
        let text = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.code().is_some_and(|c| c < 2), "{text}");
        let result: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
        result["synthetic"].clone()
    };
    assert_eq!(synthetic("copied.csv"), true);
    assert_eq!(synthetic("copied.json"), true);
    // A table that says nothing, far from any session, is not called synthetic.
    let text = std::fs::read_to_string(folder.path().join("copied.csv")).unwrap();
    let text = text.replace("# synthetic\n", "");
    std::fs::write(folder.path().join("plain.csv"), text).unwrap();
    assert!(synthetic("plain.csv").is_null());
}

#[test]
fn damaged_records_are_refused_with_the_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.json");
    let stem = folder.path().join("m");
    let out = goniofit(&[
        "measure",
        "session",
        MOCK,
        "--out",
        stem.to_str().unwrap(),
        "--export",
        "none",
    ]);
    assert!(out.status.success());
    let good = std::fs::read_to_string(&path).unwrap();
    let error = |from: &str, to: &str| {
        assert!(good.contains(from), "{from}");
        std::fs::write(&path, good.replace(from, to)).unwrap();
        let error = Measurements::read(&path).unwrap_err().report();
        assert!(error.contains("m.json"), "{error}");
        error
    };
    assert!(error("goniofit-measurements-1", "other-1").contains("format 'other-1'"));
    assert!(error("\"normalized_radiance\"", "\"brdf\"").contains("quantity 'brdf'"));
    assert!(error("\"config\": 2,", "\"config\": 1,").contains("configuration 1 occurs twice"));
    assert!(error("\"light_theta_deg\": 64.0", "\"light_theta_deg\": 95.0").contains("95"));
    let torn = &good[..good.len() / 2];
    std::fs::write(&path, torn).unwrap();
    assert!(
        Measurements::read(&path)
            .unwrap_err()
            .report()
            .contains("not a measurements.json")
    );
}
