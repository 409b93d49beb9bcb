//! Promise: the suggested poses are those that shrink what is known worst, and what they are said to buy is what they buy.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "common/command.rs"]
mod command;
#[path = "common/render_scenes.rs"]
mod render_scenes;
mod toy;

use command::goniofit;
use goniofit::base::{Result, Unwatched, Watch};
use goniofit::fit::{Aim, Bounds, Knowledge, MeasuredPose, SuggestOptions, TAU, suggest};
use goniofit::math::{Random, statistics::Running};
use goniofit::render::{
    Effort, Estimate, Estimates, FiberScene, FiberSceneOptions, Request, Scene,
    relative_error_weight,
};
use goniofit::scatter::{Parameters, Parametric, Unit};
use goniofit::session::protocols::{Grid, grid, khungurn16};
use goniofit::session::{Configuration, Plan};
use render_scenes::khungurn;
use serde_json::Value;
use std::path::{Path, PathBuf};
use toy::{INSIDE, TOY, Toy, seed};

const DEG: f64 = std::f64::consts::PI / 180.0;

/// A scene whose means are formulas of directions and parameters, with noise on the derivatives when asked.
#[derive(Default)]
struct Formula {
    /// Standard deviation of a derivative's noise relative to the mean, at one path.
    noise: f64,
    /// Whether beta_r changes nothing; then the noise is on its derivatives alone.
    inert: bool,
}

impl Formula {
    fn mean(&self, v: &[f64], c: &Configuration, k: usize) -> f64 {
        let (l, o) = (c.light_in_sample(), c.camera_in_sample());
        let mut mirrored = -l.vector();
        mirrored.z = -mirrored.z;
        let off = mirrored.dot(o.vector()).clamp(-1.0, 1.0).acos();
        let lobe = |x: f64, s: f64| (-0.5 * (x / s).powi(2)).exp() * (0.2 / s).sqrt();
        let beta_r = if self.inert { 3.0 * DEG } else { v[6] };
        let cone = lobe(off, 4.0 * beta_r);
        let forward = lobe(l.theta - 0.6, 2.0 * v[7]) * lobe((l.phi - o.phi).sin(), 2.0 * v[8]);
        0.3 * v[k] * cone + 0.4 * v[3 + k] * (1.0 - v[k]) * forward + 0.04 * (1.0 + v[k] + v[3 + k])
    }

    fn derivative(&self, v: &[f64], c: &Configuration, k: usize, j: usize) -> f64 {
        let h = 1e-5 * v[j];
        let at = |d: f64| {
            let mut v = v.to_vec();
            v[j] += d;
            self.mean(&v, c, k)
        };
        (at(h) - at(-h)) / (2.0 * h)
    }
}

impl Scene for Formula {
    fn model(&self) -> &'static dyn Parametric {
        &TOY
    }

    fn estimate(&self, request: &Request<'_>, _: &dyn Watch) -> Result<Estimates> {
        let Effort::Paths(paths) = request.effort else {
            panic!("paths were expected")
        };
        let p = request.parameters;
        let sd = self.noise / (paths as f64).sqrt();
        let one = |(i, c): (usize, &Configuration)| {
            let mut random = Random::keyed(&[request.seed, request.stream, i as u64]);
            let mean: [f64; 3] = std::array::from_fn(|k| self.mean(p.values(), c, k));
            let derivative_se: Vec<[f64; 3]> = (0..p.infos().len())
                .map(|row| {
                    let sd = if self.inert && row != 2 { 0.0 } else { sd };
                    std::array::from_fn(|k| sd * mean[k] / p.values()[p.slot(row, k)])
                })
                .collect();
            let derivative = (0..p.infos().len())
                .map(|row| {
                    std::array::from_fn(|k| {
                        let exact = self.derivative(p.values(), c, k, p.slot(row, k));
                        exact + derivative_se[row][k] * random.normal()
                    })
                })
                .collect::<Vec<_>>();
            Estimate {
                config: c.id,
                mean,
                standard_error: [0.0; 3],
                derivative_se,
                derivative,
                paths,
            }
        };
        Ok(Estimates {
            configurations: request.configurations.iter().enumerate().map(one).collect(),
            cpu_s: 0.0,
            wall_s: 0.0,
        })
    }
}

fn candidates() -> Vec<Configuration> {
    let azimuths: Vec<f64> = (0..8).map(|k| 45.0 * f64::from(k)).collect();
    let thetas = vec![0.0, 25.0, 50.0, 75.0];
    let mut poses = grid(&Grid {
        light_theta_deg: thetas.clone(),
        light_phi_deg: azimuths.clone(),
        camera_theta_deg: thetas,
        camera_phi_deg: azimuths[..4].to_vec(),
    })
    .unwrap()
    .configurations;
    poses.iter_mut().for_each(|c| c.id += 100);
    poses
}

fn measured(errors: Option<[f64; 3]>) -> Vec<MeasuredPose> {
    let poses = khungurn16().unwrap().configurations;
    poses
        .into_iter()
        .map(|c| (c, errors.map(|e| e.map(Some))))
        .collect()
}

fn options(aim: Aim, shots: usize) -> SuggestOptions {
    SuggestOptions {
        shots,
        aim,
        relative_error: 0.02,
        tau: TAU,
        bounds: Bounds::default(),
        model_error: 0.0,
        paths: 1000,
        seed: seed(1),
    }
}

/// Derivative of the value by its search coordinate, times that coordinate's standard deviation when only the bounds are
/// known; written from the coordinates' definition in docs/fit.md.
fn slopes(p: &Parameters) -> Vec<f64> {
    let places = p.places();
    let of = |j: usize| {
        let (info, v) = (&p.infos()[places[j].0], p.values()[j]);
        match info.unit {
            Unit::Angle => v * (info.upper / info.lower).ln() / 12_f64.sqrt(),
            Unit::One => {
                let range = info.upper - info.lower;
                let t = (v - info.lower) / range;
                let slope = range * (t + 0.05) * (1.05 - t) / 1.1;
                slope * 2.0 * (1.05_f64 / 0.05).ln() / 12_f64.sqrt()
            }
        }
    };
    (0..places.len()).map(of).collect()
}

type Square = Vec<Vec<f64>>;

/// Inverse by Gauss and Jordan, with the determinant's logarithm.
fn inverse(m: &Square) -> (Square, f64) {
    let n = m.len();
    let mut a: Square = (0..n)
        .map(|i| {
            let unit = (0..n).map(|j| f64::from(u8::from(i == j)));
            m[i].iter().copied().chain(unit).collect()
        })
        .collect();
    let mut log = 0.0;
    for i in 0..n {
        let best = (i..n)
            .max_by(|&x, &y| a[x][i].abs().total_cmp(&a[y][i].abs()))
            .unwrap();
        a.swap(i, best);
        log += a[i][i].abs().ln();
        let pivot = a[i][i];
        a[i].iter_mut().for_each(|x| *x /= pivot);
        for r in (0..n).filter(|&r| r != i) {
            let factor = a[r][i];
            let row = a[i].clone();
            a[r].iter_mut()
                .zip(&row)
                .for_each(|(x, y)| *x -= factor * y);
        }
    }
    (a.into_iter().map(|r| r[n..].to_vec()).collect(), log)
}

/// Rows of the exact Jacobian divided by their errors, in units of what only the bounds say.
fn rows(scene: &Formula, p: &Parameters, pose: &MeasuredPose) -> Vec<Vec<f64>> {
    let slopes = slopes(p);
    let (c, se) = pose;
    let mean: [f64; 3] = std::array::from_fn(|k| scene.mean(p.values(), c, k));
    let brightness = (mean.iter().sum::<f64>() / 3.0).max(0.02);
    let se = se.unwrap_or([Some(0.02 * brightness); 3]);
    (0..3)
        .filter_map(|k| Some((k, se[k]?)))
        .map(|(k, se)| {
            (0..slopes.len())
                .map(|j| {
                    // A color of another channel changes nothing: its derivative is zero by itself.
                    scene.derivative(p.values(), c, k, j) * slopes[j] / se
                })
                .collect()
        })
        .collect()
}

fn add(information: &mut Square, rows: &[Vec<f64>]) {
    for row in rows {
        for i in 0..row.len() {
            for j in 0..row.len() {
                information[i][j] += row[i] * row[j];
            }
        }
    }
}

/// The standard deviation a criterion looks at: of place `j`, or the determinant's root.
fn looked_at(information: &Square, j: Option<usize>) -> f64 {
    let (c, log) = inverse(information);
    j.map_or((-0.5 * log / c.len() as f64).exp(), |j| c[j][j].sqrt())
}

fn shares(knowledge: &[Knowledge]) -> Vec<f64> {
    knowledge.iter().map(|k| k.share_unknown).collect()
}

#[test]
fn every_choice_is_the_best_of_all_and_buys_what_the_exact_jacobian_says() {
    let scene = Formula::default();
    let p = Toy::truth(&INSIDE);
    let (old, new) = (measured(Some([0.002; 3])), candidates());
    let names = p.flat_names();
    for aim in [Aim::Weakest, Aim::All, Aim::Parameter("beta_tt".to_owned())] {
        let found = suggest(&scene, &p, &old, &new, &options(aim.clone(), 4), &Unwatched).unwrap();
        assert_eq!(found.shots.len(), 4);
        let n = names.len();
        let mut known: Square = (0..n)
            .map(|i| (0..n).map(|j| f64::from(u8::from(i == j))).collect())
            .collect();
        for pose in &old {
            add(&mut known, &rows(&scene, &p, pose));
        }
        let mut left = new.clone();
        check_shares(&shares(&found.now), &known);
        for shot in &found.shots {
            let (c, _) = inverse(&known);
            let j = match &aim {
                Aim::All => None,
                Aim::Parameter(name) => names.iter().position(|n| n == name),
                Aim::Weakest => (0..n).max_by(|&i, &j| c[i][i].total_cmp(&c[j][j])),
            };
            assert_eq!(shot.chosen_for.as_ref(), j.map(|j| &names[j]));
            let mut outcomes: Vec<(f64, u32)> = left
                .iter()
                .map(|c| {
                    let mut with = known.clone();
                    add(&mut with, &rows(&scene, &p, &(*c, None)));
                    (looked_at(&with, j), c.id)
                })
                .collect();
            outcomes.sort_by(|a, b| a.0.total_cmp(&b.0));
            // Ties of symmetric poses apart, the choice is the best there is.
            let mine = outcomes.iter().find(|o| o.1 == shot.configuration.id);
            let (best, mine) = (outcomes[0].0, mine.unwrap().0);
            assert!(mine < best * (1.0 + 1e-9), "{aim:?}: {mine} against {best}");
            let median = outcomes[outcomes.len() / 2].0;
            assert!((shot.better_than_median / (median / mine) - 1.0).abs() < 1e-6);
            add(&mut known, &rows(&scene, &p, &(shot.configuration, None)));
            check_shares(&shares(&shot.after), &known);
            left.retain(|c| c.id != shot.configuration.id);
        }
        // A pose taken blindly buys less: otherwise there would be nothing to suggest.
        assert!(found.shots[0].better_than_median > 1.02, "{aim:?}");
    }
}

/// Reported standard deviations against those of an information; sees one part in a million.
#[test]
fn a_camera_with_one_channel_is_offered_nothing_about_the_others() {
    // Sees candidates that count as measured in all channels: then c_r.r would fall below 0.3.
    let scene = Formula::default();
    let p = Toy::truth(&INSIDE);
    let green = |(c, _): MeasuredPose| (c, Some([None, Some(0.002), None]));
    let old: Vec<MeasuredPose> = measured(None).into_iter().map(green).collect();
    let aim = options(Aim::Weakest, 3);
    let found = suggest(&scene, &p, &old, &candidates(), &aim, &Unwatched).unwrap();
    let after = |known: &[MeasuredPose], name: &str| {
        let found = suggest(&scene, &p, known, &candidates(), &aim, &Unwatched).unwrap();
        let shot = found.shots.last().unwrap();
        named(&shot.after, name).share_unknown
    };
    for unseen in ["c_r.r", "c_tt.b"] {
        assert!(after(&old, unseen) > 0.999_999, "{unseen}");
        // Negative control: poses of which no error is known are those of a camera with three.
        assert!(after(&measured(None), unseen) < 0.3, "{unseen}");
    }
    for shot in &found.shots {
        let aim = shot.chosen_for.as_deref().unwrap();
        assert!(!aim.ends_with(".r") && !aim.ends_with(".b"), "{aim}");
    }
}

fn check_shares(reported: &[f64], information: &Square) {
    let (c, _) = inverse(information);
    for (j, share) in reported.iter().enumerate() {
        let exact = c[j][j].sqrt();
        assert!(
            (share / exact - 1.0).abs() < 1e-6,
            "{j}: {share}, exact {exact}"
        );
    }
}

fn named<'a>(knowledge: &'a [Knowledge], name: &str) -> &'a Knowledge {
    knowledge.iter().find(|k| k.name == name).unwrap()
}

#[test]
fn noise_of_the_renders_is_not_taken_for_knowledge() {
    // beta_r acts nowhere; its derivatives are pure noise, twice the measurement errors in each of two renders.
    let scene = Formula {
        noise: 0.06 * 1000_f64.sqrt(),
        inert: true,
    };
    let p = Toy::truth(&INSIDE);
    let ask = |aim: Aim| {
        let options = options(aim, 4);
        suggest(
            &scene,
            &p,
            &measured(None),
            &candidates(),
            &options,
            &Unwatched,
        )
    };
    let error = ask(Aim::Parameter("beta_r".to_owned())).unwrap_err();
    assert!(
        error.report().contains("more --paths"),
        "{}",
        error.report()
    );
    // The weakest is beta_r; no pose helps, so none is chosen for it.
    let found = ask(Aim::Weakest).unwrap();
    for shot in &found.shots {
        assert_ne!(shot.chosen_for.as_deref(), Some("beta_r"));
    }
    for knowledge in std::iter::once(&found.now).chain(found.shots.iter().map(|s| &s.after)) {
        let k = named(knowledge, "beta_r");
        assert!(k.share_unknown > 0.9, "{k:?}");
        assert!(k.range_share > 0.9, "{k:?}");
    }
    // Negative control: the square of one render's derivatives would have called it known.
    let request = Request {
        configurations: &khungurn16().unwrap().configurations,
        parameters: &p,
        effort: Effort::Paths(1000),
        seed: seed(1),
        stream: 0,
    };
    let slope = slopes(&p)[6];
    let single = scene.estimate(&request, &Unwatched).unwrap();
    let information: f64 = single
        .configurations
        .iter()
        .flat_map(|e| {
            let se = 0.02 / relative_error_weight(e.mean, 0.02).sqrt();
            e.derivative[2].map(|d| (d * slope / se).powi(2))
        })
        .sum();
    let claimed = (1.0 + information).sqrt().recip();
    assert!(claimed < 0.3, "{claimed}");
}

#[test]
fn the_noise_of_a_share_is_stated() {
    // 60 seeds: the scatter of ln(share) against its stated size; the ratio of the two is known to about 10 %, so a noise
    // stated wrong by a factor of 1.6 is seen. (Stated noises come from few renders: their mean square counts.)
    let scene = Formula {
        noise: 0.1,
        inert: false,
    };
    let p = Toy::truth(&INSIDE);
    let mut logs = vec![Running::default(); 9];
    let mut stated = [0.0; 9];
    let poses = candidates();
    for k in 0..60 {
        let options = SuggestOptions {
            seed: seed(500) + k,
            paths: 4000,
            ..options(Aim::Weakest, 1)
        };
        let found = suggest(
            &scene,
            &p,
            &measured(None),
            &poses[..8],
            &options,
            &Unwatched,
        )
        .unwrap();
        for (j, k) in found.now.iter().enumerate() {
            logs[j].push(k.share_unknown.ln());
            stated[j] += k.share_unknown_noise.powi(2) / 60.0;
        }
    }
    for j in 0..9 {
        let ratio = (logs[j].variance() / stated[j]).sqrt();
        assert!((0.6..1.6).contains(&ratio), "{j}: {ratio}");
        // Negative control: a third of the noise, or three times it, would be seen.
        assert!(
            [ratio * 3.0, ratio / 3.0]
                .iter()
                .all(|r| !(0.6..1.6).contains(r))
        );
    }
}

/// An open net of thick fibers, written as a fabric file.
fn net(folder: &Path) -> PathBuf {
    let path = folder.join("net.csv");
    let mut csv =
        String::from("# tile_mm = [0.97, 0.97]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n");
    for i in 0..10 {
        let at = 0.097 * (f64::from(i) + 0.5);
        csv += &format!("0,{at},0.05,0.97,{at},0.05,0.04,1\n{at},0,-0.05,{at},0.97,-0.05,0.04,0\n");
    }
    std::fs::write(&path, csv).unwrap();
    path
}

/// The net as a scene, small enough to render in seconds; its parameters away from the bounds.
fn small_cloth() -> (FiberScene, Parameters) {
    let folder = tempfile::tempdir().unwrap();
    let fabric = goniofit::fabric::load(&net(folder.path())).unwrap();
    let scene = FiberScene::new(&fabric.tile, khungurn(), FiberSceneOptions::default()).unwrap();
    (scene, render_scenes::parameters(render_scenes::SOFT))
}

/// Mean whitened Jacobian rows of poses from long renders of their own.
fn rendered_rows(scene: &FiberScene, p: &Parameters, poses: &[Configuration]) -> Vec<Vec<f64>> {
    let poses: Vec<Configuration> = (1..)
        .zip(poses)
        .map(|(id, c)| Configuration { id, ..*c })
        .collect();
    let request = Request {
        configurations: &poses,
        parameters: p,
        effort: Effort::Paths(40_000),
        seed: seed(9000),
        stream: 0,
    };
    let slopes = slopes(p);
    let estimates = scene.estimate(&request, &Unwatched).unwrap();
    let mut rows = Vec::new();
    for e in &estimates.configurations {
        let se = 0.02 / relative_error_weight(e.mean, 0.02).sqrt();
        for k in 0..3 {
            let mut row = vec![0.0; slopes.len()];
            for (r, d) in e.derivative.iter().enumerate() {
                let j = p.slot(r, k);
                row[j] = d[k] * slopes[j] / se;
            }
            rows.push(row);
        }
    }
    rows
}

/// Standard deviation of the error of place `j` over many simulated sets of measurements: parameters drawn as the bounds
/// allow, measurements by the linear model with noise, estimated with all that is known.
fn scatter(rows: &[Vec<f64>], j: usize, key: u64) -> f64 {
    let n = rows[0].len();
    let mut information: Square = (0..n)
        .map(|i| (0..n).map(|k| f64::from(u8::from(i == k))).collect())
        .collect();
    add(&mut information, rows);
    let (covariance, _) = inverse(&information);
    let mut random = Random::keyed(&[seed(77), key]);
    let mut squares = 0.0;
    for _ in 0..REPEATS {
        let truth: Vec<f64> = (0..n).map(|_| random.normal()).collect();
        let mut right = vec![0.0; n];
        for row in rows {
            let exact: f64 = row.iter().zip(&truth).map(|(a, b)| a * b).sum();
            let measured = exact + random.normal();
            right
                .iter_mut()
                .zip(row)
                .for_each(|(r, a)| *r += a * measured);
        }
        let found: f64 = covariance[j].iter().zip(&right).map(|(a, b)| a * b).sum();
        squares += (found - truth[j]).powi(2);
    }
    (squares / f64::from(REPEATS)).sqrt()
}

/// The scatter of so many repeats is known to 1.6 %.
const REPEATS: u32 = 2000;

#[test]
fn on_a_rendered_cloth_the_scatter_shrinks_as_predicted_and_a_blind_pose_buys_less() {
    // Sees a predicted standard deviation off by 12 % beyond the stated noise of the renders.
    let (scene, p) = small_cloth();
    let (old, new) = (measured(None), candidates());
    let asked = SuggestOptions {
        paths: 3000,
        ..options(Aim::Weakest, 4)
    };
    let found = suggest(&scene, &p, &old, &new, &asked, &Unwatched).unwrap();
    let name = found.shots[0].chosen_for.clone().unwrap();
    let j = p.flat_names().iter().position(|n| *n == name).unwrap();
    let old: Vec<Configuration> = old.iter().map(|(c, _)| *c).collect();
    let with = |more: Vec<Configuration>| -> Vec<Configuration> {
        old.iter().copied().chain(more).collect()
    };
    let chosen = with(found.shots.iter().map(|s| s.configuration).collect());
    // Blind: every 89th candidate of 400.
    let blind = with(new.iter().step_by(89).take(4).copied().collect());
    let [now, then, blindly] = [&old, &chosen, &blind]
        .map(|poses| scatter(&rendered_rows(&scene, &p, poses), j, poses.len() as u64));
    let (said_now, said_then) = (&found.now[j], &found.shots[3].after[j]);
    println!(
        "{name}: share {:.4} (said {:.4} +- {:.1} %), then {:.4} (said {:.4} +- {:.1} %), blindly {:.4}",
        now,
        said_now.share_unknown,
        100.0 * said_now.share_unknown_noise,
        then,
        said_then.share_unknown,
        100.0 * said_then.share_unknown_noise,
        blindly
    );
    for (scatter, said) in [(now, said_now), (then, said_then)] {
        let off = (scatter / said.share_unknown).ln().abs();
        assert!(
            off < 0.12 + 3.0 * said.share_unknown_noise && said.share_unknown_noise < 0.1,
            "{scatter} {said:?}"
        );
    }
    assert!(
        then < 0.85 * now,
        "the shots buy something: {now} to {then}"
    );
    assert!(
        blindly > 1.1 * then,
        "a blind choice buys less: {blindly} {then}"
    );
    // Negative control: the promise of the chosen poses does not hold for the blind ones.
    assert!((blindly / said_then.share_unknown).ln() > 0.09);
}

/// Ids the rig does not reach, by `plan check`.
fn refused(plan: &str, rig: &str) -> Vec<u64> {
    let (_, out, err) = goniofit(&["plan", "check", plan, "--rig", rig, "--json"]);
    let told: Value = serde_json::from_str(&out).unwrap_or_else(|_| panic!("{err}"));
    let refused = told["refused"].as_array().unwrap();
    refused
        .iter()
        .map(|r| r["config"].as_u64().unwrap())
        .collect()
}

#[test]
fn the_command_suggests_only_poses_within_reach_and_writes_a_plan() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let fabric = net(folder.path());
    let fabric = fabric.to_str().unwrap();
    let params = path("p.json");
    let (_, p) = small_cloth();
    std::fs::write(&params, p.to_json().to_string()).unwrap();
    // Its light is fixed: most poses are out of reach.
    let rig = "rig_configs/turntable_only.toml";
    let suggest = |out: &str, more: &[&str]| {
        let mut arguments = vec![
            "plan",
            "suggest",
            "--params",
            &params,
            "--fabric",
            fabric,
            "--plan",
            "rig_configs/plans/khungurn16.toml",
            "--error",
            "1%",
            "--paths",
            "1500",
            "--shots",
            "3",
            "--json",
            "--out",
            out,
        ];
        arguments.extend(more);
        goniofit(&arguments)
    };
    let [free, bound] = ["free.toml", "bound.toml"].map(path);
    let rig_grid = ["--light-theta", "20,45", "--camera-theta", "0,20"];
    let (code, out, err) = suggest(&bound, &[&rig_grid[..], &["--rig", rig]].concat());
    assert_eq!(code, 0, "{err}");
    let told: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(told["shots"].as_array().unwrap().len(), 3, "{out}");
    assert!(told["candidates"].as_u64() < told["grid"].as_u64(), "{out}");
    let plan = Plan::read(bound.as_ref()).unwrap();
    assert_eq!(plan.configurations.len(), 19);
    assert_eq!(
        plan.configurations[..16],
        khungurn16().unwrap().configurations
    );
    let out_of_reach = refused(&bound, rig);
    assert!(out_of_reach.iter().all(|id| *id <= 16), "{out_of_reach:?}");
    // Negative control: without the rig such poses are suggested.
    let grid = [
        "--light-theta",
        "30,60",
        "--camera-theta",
        "40",
        "--camera-phi",
        "0,90",
    ];
    let (code, _, err) = suggest(&free, &grid);
    assert_eq!(code, 0, "{err}");
    let out_of_reach = refused(&free, rig);
    assert!(out_of_reach.iter().any(|id| *id > 16), "{out_of_reach:?}");
    // No silent overwriting, and an aim that means nothing is refused with those that exist.
    let (code, _, err) = suggest(&free, &[]);
    assert!(code == 2 && err.contains("--force"), "{err}");
    let (code, _, err) = suggest(&path("other.toml"), &["--aim", "shine"]);
    assert!(
        code == 2 && err.contains("no parameter 'shine'") && err.contains("beta_tt"),
        "{err}"
    );
    let (code, _, err) = goniofit(&["plan", "suggest", "--params", "P.json"]);
    assert!(code == 2 && err.contains("--fabric"), "{err}");
}
