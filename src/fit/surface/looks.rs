//! Where a search begins: the defaults, the optima of simpler models, and the best of many random shapes.

use super::problem::Problem;
use super::search::{End, SurfaceOptions, copies};
use crate::fit::linear::dot;
use crate::math::Random;
use crate::scatter::{Parameters, Unit};
use rayon::prelude::*;

/// The defaults and the best of random shapes.
pub(super) fn starts(problem: &Problem<'_>, options: &SurfaceOptions) -> Vec<Vec<f64>> {
    let inside = |x: &mut Vec<f64>| {
        for k in 0..x.len() {
            x[k] = x[k].clamp(problem.lower[k], problem.upper[k]);
        }
    };
    let mut first = Parameters::defaults(problem.model).values().to_vec();
    inside(&mut first);
    problem.choose_colors(&mut first);
    let mut list = vec![first.clone()];
    if problem.shape.is_empty() {
        return list;
    }
    for simpler in &options.begin {
        let mut x = carried(problem, simpler);
        inside(&mut x);
        list.extend(copies(problem, &x));
        list.push(x);
    }
    let most = options.starts.max(1) - 1;
    let best = match systems(problem) {
        Some(rows) => best_pairs(problem, options, &first, rows, most),
        None => best_looks(problem, options, &first, most),
    };
    list.extend(best);
    list
}

/// A random shape.
fn look(problem: &Problem<'_>, options: &SurfaceOptions, first: &[f64], k: usize) -> Vec<f64> {
    let mut random = Random::keyed(&[options.seed, k as u64]);
    let mut x = first.to_vec();
    for &p in &problem.shape {
        let range = problem.upper[p] - problem.lower[p];
        let share = random.uniform();
        // Widths and curvatures: more near the small ones.
        let angle = problem.model.parameters()[problem.places[p].0].unit == Unit::Angle;
        x[p] = problem.lower[p] + range * if angle { share } else { share * share };
    }
    x
}

fn best_looks(
    problem: &Problem<'_>,
    options: &SurfaceOptions,
    first: &[f64],
    most: usize,
) -> Vec<Vec<f64>> {
    let mut looks: Vec<End> = (0..options.looks)
        .into_par_iter()
        .map(|k| {
            let mut x = look(problem, options, first, k);
            let objective = problem.choose_colors(&mut x);
            End { x, objective }
        })
        .filter(|e| e.objective.is_finite())
        .collect();
    looks.sort_by(|a, b| a.objective.total_cmp(&b.objective));
    looks.into_iter().take(most).map(|e| e.x).collect()
}

/// The rows of the diffuse color and of the two yarn systems' colors, when each system has its own shape.
fn systems(problem: &Problem<'_>) -> Option<[usize; 3]> {
    let row = |name: &str| {
        problem
            .model
            .parameters()
            .iter()
            .position(|p| p.name == name)
    };
    Some([row("k_d")?, row("warp_k_s")?, row("weft_k_s")?])
}

/// Shapes of the warp from one look and of the weft from another: the BRDF is a sum, so that all pairs of n looks cost n
/// evaluations and small least squares, here for the mean of the channels.
fn best_pairs(
    problem: &Problem<'_>,
    options: &SurfaceOptions,
    first: &[f64],
    rows: [usize; 3],
    most: usize,
) -> Vec<Vec<f64>> {
    let target = problem.gray();
    let looks: Vec<(Vec<f64>, [Vec<f64>; 3])> = (0..options.looks.div_ceil(2))
        .into_par_iter()
        .filter_map(|k| {
            let x = look(problem, options, first, k);
            let parts = problem.parts(&x, rows)?;
            Some((x, parts))
        })
        .collect();
    let mut pairs: Vec<(f64, usize, usize)> = (0..looks.len())
        .into_par_iter()
        .flat_map_iter(|i| {
            let (looks, target) = (&looks, &target);
            (0..looks.len()).map(move |j| {
                let columns = [&looks[i].1[0], &looks[i].1[1], &looks[j].1[2]];
                (least(columns, target), i, j)
            })
        })
        .collect();
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Not all from one shape that happens to suit.
    let mut uses = vec![[0; 2]; looks.len()];
    let mut list = Vec::new();
    for (_, i, j) in pairs {
        if list.len() == most {
            break;
        }
        if uses[i][0] >= 2 || uses[j][1] >= 2 {
            continue;
        }
        (uses[i][0], uses[j][1]) = (uses[i][0] + 1, uses[j][1] + 1);
        let mut x = looks[i].0.clone();
        for &p in &problem.shape {
            if problem.model.parameters()[problem.places[p].0]
                .name
                .starts_with("weft_")
            {
                x[p] = looks[j].0[p];
            }
        }
        problem.choose_colors(&mut x);
        list.push(x);
    }
    list
}

/// Least of `|sum_k c_k column_k - target|^2 - |target|^2` over coefficients that are not negative, by trying every set of columns.
fn least(columns: [&Vec<f64>; 3], target: &[f64]) -> f64 {
    let g: [f64; 3] = std::array::from_fn(|a| dot(columns[a], target));
    let h: [[f64; 3]; 3] =
        std::array::from_fn(|a| std::array::from_fn(|b| dot(columns[a], columns[b])));
    let one = |a: usize| match h[a][a] > 0.0 && g[a] > 0.0 {
        true => -g[a] * g[a] / h[a][a],
        false => 0.0,
    };
    let two = |a: usize, b: usize| {
        let det = h[a][a] * h[b][b] - h[a][b] * h[a][b];
        let (x, y) = (
            g[a] * h[b][b] - g[b] * h[a][b],
            g[b] * h[a][a] - g[a] * h[a][b],
        );
        match det > 1e-12 * h[a][a] * h[b][b] && x > 0.0 && y > 0.0 {
            true => -(g[a] * x + g[b] * y) / det,
            false => 0.0,
        }
    };
    let minor = |a: usize, b: usize| {
        let [p, q] = [(a + 1) % 3, (a + 2) % 3];
        let [r, s] = [(b + 1) % 3, (b + 2) % 3];
        h[p][r] * h[q][s] - h[p][s] * h[q][r]
    };
    let det = (0..3).map(|b| h[0][b] * minor(0, b)).sum::<f64>();
    let c: [f64; 3] = std::array::from_fn(|a| (0..3).map(|b| minor(a, b) * g[b]).sum());
    if det > 1e-12 * h[0][0] * h[1][1] * h[2][2] && c.iter().all(|c| *c > 0.0) {
        return -dot(&g, &c) / det;
    }
    let pairs = [two(0, 1), two(0, 2), two(1, 2), one(0), one(1), one(2)];
    pairs.into_iter().fold(0.0, f64::min)
}

/// The parameters of a simpler model in this one; defaults where it has none.
fn carried(problem: &Problem<'_>, simpler: &Parameters) -> Vec<f64> {
    let names = simpler.flat_names();
    let defaults = Parameters::defaults(problem.model);
    let value = |(name, default): (String, &f64)| {
        let own = name.strip_prefix("warp_").or(name.strip_prefix("weft_"));
        let same = |n: &String| *n == name || own == Some(n.as_str());
        let place = names.iter().position(same);
        place.map_or(*default, |p| simpler.values()[p])
    };
    let pairs = defaults.flat_names().into_iter().zip(defaults.values());
    pairs.map(value).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against the best of a fine grid of coefficients: sees 1e-3.
    #[test]
    fn least_squares_of_three_columns_keep_their_signs() {
        let mut random = Random::keyed(&[3]);
        let mut vector =
            |shift: f64| -> Vec<f64> { (0..6).map(|_| random.uniform() - shift).collect() };
        for shift in [0.0, 0.3, 0.5] {
            let columns = [vector(0.0), vector(shift), vector(shift)];
            let target = vector(0.2);
            let found = least([&columns[0], &columns[1], &columns[2]], &target);
            let mut best = 0.0_f64;
            let at = |k: usize| 0.02 * k as f64;
            for (i, j, k) in (0..100_000).map(|n| (n % 100, n / 100 % 100, n / 10_000)) {
                for k in 10 * k..10 * k + 10 {
                    let c = [at(i), at(j), at(k)];
                    let model = |s: usize| (0..3).map(|a| c[a] * columns[a][s]).sum::<f64>();
                    let q = (0..6)
                        .map(|s| model(s) * (model(s) - 2.0 * target[s]))
                        .sum();
                    best = best.min(q);
                }
            }
            assert!(
                found <= best + 1e-12 && found > best - 1e-2,
                "{found} {best}"
            );
        }
    }
}
