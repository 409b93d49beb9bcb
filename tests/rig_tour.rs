//! Promise: up to 16 poses are visited in the best order; above, how far from the best is told truthfully.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::math::Random;
use goniofit::rig::{AxisAngles, EXACT_UP_TO, RigDescription, tour};
use goniofit::session::Plan;
use std::path::PathBuf;

struct Costs {
    between: Vec<Vec<f64>>,
    start: Vec<f64>,
    end: Vec<f64>,
}

impl Costs {
    /// Seconds between random places, a little dearer one way than the other.
    fn random(n: usize, random: &mut Random) -> Self {
        let places: Vec<[f64; 3]> = (0..n + 2)
            .map(|_| std::array::from_fn(|_| 60.0 * random.uniform()))
            .collect();
        let mut cost = |a: usize, b: usize| {
            let way = (0..3)
                .map(|k| (places[a][k] - places[b][k]).abs())
                .fold(0.0, f64::max);
            1.0 + way + random.uniform()
        };
        Self {
            between: (0..n)
                .map(|a| (0..n).map(|b| cost(a, b)).collect())
                .collect(),
            start: (0..n).map(|b| cost(n, b)).collect(),
            end: (0..n).map(|a| cost(a, n + 1)).collect(),
        }
    }

    fn seconds(&self, order: &[usize]) -> f64 {
        let inner: f64 = order.windows(2).map(|w| self.between[w[0]][w[1]]).sum();
        self.start[order[0]] + inner + self.end[*order.last().unwrap()]
    }

    /// The cheapest of all orders.
    fn brute_force(&self) -> f64 {
        fn visit(costs: &Costs, order: &mut Vec<usize>, best: &mut f64) {
            let n = costs.between.len();
            if order.len() == n {
                *best = best.min(costs.seconds(order));
                return;
            }
            for k in 0..n {
                if !order.contains(&k) {
                    order.push(k);
                    visit(costs, order, best);
                    order.pop();
                }
            }
        }
        let mut best = f64::INFINITY;
        visit(self, &mut Vec::new(), &mut best);
        best
    }
}

fn is_a_permutation(order: &[usize], n: usize) -> bool {
    let mut sorted = order.to_vec();
    sorted.sort_unstable();
    sorted == (0..n).collect::<Vec<_>>()
}

#[test]
fn up_to_eight_poses_no_order_is_better() {
    let mut random = Random::keyed(&[2015, 91]);
    let mut plan_order_is_worse = 0;
    for case in 0..80 {
        let n = 1 + case % 8;
        let costs = Costs::random(n, &mut random);
        let found = tour(&costs.between, &costs.start, &costs.end).unwrap();
        assert!(is_a_permutation(&found.order, n), "{found:?}");
        assert!(
            (costs.seconds(&found.order) - found.seconds).abs() < 1e-9,
            "{found:?}"
        );
        let best = costs.brute_force();
        assert!(
            (found.seconds - best).abs() < 1e-9,
            "{found:?}, best {best}"
        );
        assert_eq!(found.lower_bound, found.seconds);
        // The control: visiting in the order given is as a rule not the best.
        let given: Vec<usize> = (0..n).collect();
        plan_order_is_worse += usize::from(costs.seconds(&given) > best + 1e-9);
    }
    assert!(plan_order_is_worse > 50, "{plan_order_is_worse}");
}

#[test]
fn many_poses_are_ordered_within_a_stated_distance_of_the_best() {
    let mut random = Random::keyed(&[2015, 92]);
    for n in [EXACT_UP_TO + 1, 40, 90] {
        let costs = Costs::random(n, &mut random);
        let found = tour(&costs.between, &costs.start, &costs.end).unwrap();
        assert!(is_a_permutation(&found.order, n), "{found:?}");
        assert!((costs.seconds(&found.order) - found.seconds).abs() < 1e-9);
        let ratio = found.seconds / found.lower_bound;
        println!(
            "{n} poses: {:.1} s, at most {:.1} % above the best",
            found.seconds,
            100.0 * (ratio - 1.0)
        );
        assert!((1.0..1.2).contains(&ratio), "{n}: {ratio}");
        let given: Vec<usize> = (0..n).collect();
        assert!(costs.seconds(&given) > 1.5 * found.lower_bound);
        assert_eq!(
            tour(&costs.between, &costs.start, &costs.end).unwrap(),
            found
        );
    }
}

#[test]
fn barred_ways_are_avoided_and_senseless_costs_refused() {
    const BARRED: f64 = f64::INFINITY;
    // Only 1, 0, 2 is open.
    let between = vec![
        vec![0.0, BARRED, 5.0],
        vec![7.0, 0.0, BARRED],
        vec![BARRED, BARRED, 0.0],
    ];
    let found = tour(&between, &[1.0, 1.0, 1.0], &[0.0; 3]).unwrap();
    assert_eq!((found.order, found.seconds), (vec![1, 0, 2], 13.0));
    let shut = tour(&between, &[1.0, BARRED, 1.0], &[0.0; 3]).unwrap();
    assert_eq!(shut.seconds, BARRED);
    let none = tour(&[], &[], &[]).unwrap();
    assert_eq!(
        (none.order.len(), none.seconds, none.lower_bound),
        (0, 0.0, 0.0)
    );
    for (between, start) in [
        (vec![vec![0.0, 1.0], vec![1.0]], vec![1.0, 1.0]),
        (vec![vec![0.0]], vec![]),
        (vec![vec![0.0]], vec![f64::NAN]),
        (vec![vec![0.0]], vec![-1.0]),
    ] {
        let end = vec![0.0; between.len()];
        let error = tour(&between, &start, &end).unwrap_err().report();
        assert!(error.contains("tour"), "{error}");
    }
}

#[test]
fn the_plan_of_sixteen_is_ordered_by_the_ways_it_takes() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let plan = Plan::read(&root.join("rig_configs/plans/khungurn16.toml")).unwrap();
    for name in ["five_axis_grblhal", "two_board_grbl"] {
        let rig = RigDescription::read(&root.join(format!("rig_configs/{name}.toml"))).unwrap();
        let poses = rig.plan_angles(&plan).unwrap();
        let start = rig.angles(&rig.white.configuration(0)).unwrap();
        let cost = |from: &AxisAngles, to: &AxisAngles| {
            rig.path_seconds(from, to).unwrap() + rig.settle_ms_of(from, to).unwrap() / 1000.0
        };
        let along = |order: &[usize], end: Option<&AxisAngles>| {
            let visited: Vec<AxisAngles> = std::iter::once(start)
                .chain(order.iter().map(|i| poses[*i]))
                .chain(end.copied())
                .collect();
            visited.windows(2).map(|w| cost(&w[0], &w[1])).sum::<f64>()
        };
        for end in [None, Some(&start)] {
            let found = rig.order(&poses, &start, end).unwrap();
            assert!(is_a_permutation(&found.order, 16));
            assert!(
                (along(&found.order, end) - found.seconds).abs() < 1e-9,
                "{found:?}"
            );
            let as_planned = along(&(0..16).collect::<Vec<_>>(), end);
            println!(
                "{name}: {:.1} s, in the plan's order {as_planned:.1} s",
                found.seconds
            );
            assert!(found.seconds < as_planned, "{found:?} {as_planned}");
            assert_eq!(found.lower_bound, found.seconds);
        }
        let mut bad = poses.clone();
        bad[3].0[0] = f64::NAN;
        assert!(rig.order(&bad, &start, None).is_err());
    }
}
