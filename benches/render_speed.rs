//! CPU seconds to 1 % weighted rms over Khungurn's 16 configurations, and paths per second, with the error beside them.
//!
//! `cargo bench --bench render_speed [-- --quick] [--json]` on `fabrics/bench_twill22.toml` with the published fiber
//! parameters (Khungurn 2015 Table IV). CPU seconds to 1 % scale the CPU time of the final round and its pilots by the
//! square of the error reached. The processor and load of the machine decide absolute numbers: compare within one run.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use goniofit::base::Unwatched;
use goniofit::render::{Effort, FiberScene, FiberSceneOptions, Request, Scene};
use goniofit::scatter::{self, Parameters};
use goniofit::session::Plan;
use std::path::Path;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let has = |flag: &str| arguments.iter().any(|a| a == flag);
    let accuracy = if has("--quick") { 0.05 } else { 0.02 };
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let plan = Plan::read(&root.join("rig_configs/plans/khungurn16.toml")).unwrap();
    let fabric = goniofit::fabric::load(&root.join("fabrics/bench_twill22.toml")).unwrap();
    let model = scatter::model("khungurn").unwrap();
    let scene = FiberScene::new(&fabric.tile, model, FiberSceneOptions::default()).unwrap();
    if !has("--json") {
        println!(
            "{} segments; accuracy asked {:.0} %",
            fabric.tile.segments.len(),
            100.0 * accuracy
        );
        println!("parameters    error %   CPU s   CPU s for 1 %   CPU us/path (7 views)");
    }
    for name in ["fleece", "gabardine", "silk", "cotton"] {
        let text =
            std::fs::read_to_string(root.join(format!("fabrics/params/{name}.json"))).unwrap();
        let parameters =
            Parameters::from_json(model, &serde_json::from_str(&text).unwrap()).unwrap();
        let ask = |effort: Effort| {
            let configurations = &plan.configurations;
            let request = Request {
                configurations,
                parameters: &parameters,
                effort,
                seed: 1,
                stream: 0,
            };
            scene.estimate(&request, &Unwatched).unwrap()
        };
        let paths = 8192;
        let fixed = ask(Effort::Paths(paths));
        // 7 groups share the camera paths of the 16 configurations; the pilot adds a sixteenth.
        let per_path = fixed.cpu_s / (7.0 * paths as f64 * 17.0 / 16.0);
        let reached = ask(Effort::Accuracy(accuracy));
        let error = reached.weighted_rms_error();
        let for_one_percent = reached.cpu_s * (error / 0.01).powi(2);
        if has("--json") {
            println!(
                "{}",
                serde_json::json!({
                    "parameters": name, "error": error, "cpu_s": reached.cpu_s,
                    "cpu_s_for_1pct": for_one_percent, "paths_per_cpu_s": 1.0 / per_path,
                })
            );
        } else {
            println!(
                "{name:<12} {:8.2} {:7.1} {for_one_percent:15.0} {:12.1}",
                100.0 * error,
                reached.cpu_s,
                1e6 * per_path
            );
        }
    }
}
