//! Elapsed time of the same render on one thread and on two, with the numbers compared.
//!
//! `cargo bench --bench thread_scaling [-- --basic]` on `fabrics/bench_twill22.toml` with Gabardine's fibers, five rounds. Prints the
//! ratio of each round and their median. Needs two idle cores: other work on the machine shows as a ratio that is too low and as
//! processor time per elapsed second below the number of threads. Processor time that grows from one thread to two
//! is what the threads cost one another; that ratio survives other work better.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use goniofit::base::Unwatched;
use goniofit::render::{
    Effort, Estimates, FiberScene, FiberSceneOptions, Integrator, Request, Scene,
};
use goniofit::scatter::{self, Parameters};
use goniofit::session::Plan;
use std::path::Path;

fn main() {
    let basic = std::env::args().any(|a| a == "--basic");
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let plan = Plan::read(&root.join("rig_configs/plans/khungurn16.toml")).unwrap();
    let fabric = goniofit::fabric::load(&root.join("fabrics/bench_twill22.toml")).unwrap();
    let model = scatter::model("khungurn").unwrap();
    let options = FiberSceneOptions {
        integrator: if basic {
            Integrator::Basic
        } else {
            Integrator::Fast
        },
        ..FiberSceneOptions::default()
    };
    let scene = FiberScene::new(&fabric.tile, model, options).unwrap();
    let text = std::fs::read_to_string(root.join("fabrics/params/gabardine.json")).unwrap();
    let parameters = Parameters::from_json(model, &serde_json::from_str(&text).unwrap()).unwrap();
    let on = |threads: usize| -> Estimates {
        let request = Request {
            configurations: &plan.configurations,
            parameters: &parameters,
            effort: Effort::Paths(if basic { 4096 } else { 16384 }),
            seed: 1,
            stream: 0,
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let pool = pool.build().unwrap();
        pool.install(|| scene.estimate(&request, &Unwatched).unwrap())
    };
    println!("{:?}", options.integrator);
    println!("1 thread s   2 threads s   speed-up   CPU s per s on 2   CPU s 2:1   numbers");
    let mut ratios = Vec::new();
    for _ in 0..5 {
        let (one, two) = (on(1), on(2));
        let same = one.configurations == two.configurations;
        ratios.push(one.wall_s / two.wall_s);
        println!(
            "{:10.2} {:13.2} {:10.2} {:18.2} {:11.3}   {}",
            one.wall_s,
            two.wall_s,
            one.wall_s / two.wall_s,
            two.cpu_s / two.wall_s,
            two.cpu_s / one.cpu_s,
            if same { "identical" } else { "DIFFERENT" }
        );
    }
    ratios.sort_by(f64::total_cmp);
    println!("median speed-up {:.2}", ratios[2]);
}
