//! The same seed gives the same numbers on 1, 2 and 3 threads, by either integrator and for every kind of effort.
//! Exact comparison, nothing is timed.
#![allow(clippy::unwrap_used, missing_docs)]

#[path = "common/render_scenes.rs"]
mod render_scenes;

use goniofit::render::{Effort, FiberSceneOptions, Integrator, Plate};
use render_scenes::{GABARDINE, Subject, felt, parameters, pose};

#[test]
fn numbers_do_not_depend_on_the_number_of_threads() {
    let tile = felt(40, 0.2);
    let subject = Subject {
        tile: &tile,
        options: FiberSceneOptions {
            plate: Plate::Diffuse([0.5; 3]),
            ..FiberSceneOptions::default()
        },
        parameters: parameters(GABARDINE),
    };
    let poses = [
        pose(1, [32.0, 180.0], [32.0, 0.0]),
        pose(2, [64.0, 90.0], [32.0, 0.0]),
        pose(3, [50.0, 90.0], [60.0, 0.0]),
    ];
    let efforts = [
        Effort::Paths(3000),
        Effort::Accuracy(0.3),
        Effort::Total {
            paths: 5000,
            shares: vec![1.0, 2.0, 0.5],
        },
    ];
    let mut of_integrators = Vec::new();
    for integrator in [Integrator::Fast, Integrator::Basic] {
        for effort in &efforts {
            let ask = |threads: usize, seed: u64| {
                let pool = rayon::ThreadPoolBuilder::new()
                    .num_threads(threads)
                    .build()
                    .unwrap();
                pool.install(|| subject.render(integrator, &poses, effort.clone(), seed))
            };
            let one = ask(1, 5);
            for threads in [2, 3] {
                assert_eq!(one, ask(threads, 5), "{integrator:?} {effort:?}");
            }
            // Negative control: another seed gives other numbers.
            assert_ne!(one, ask(2, 6), "{integrator:?} {effort:?}");
            of_integrators.push(one);
        }
    }
    // The option is honored: the two share no random number.
    let (fast, basic) = of_integrators.split_at(efforts.len());
    for (fast, basic) in fast.iter().zip(basic) {
        assert_ne!(fast[0], basic[0]);
    }
}
