//! How sharp the cloth is, by differences between neighbors along a row, which a tilted view does not foreshorten; noise
//! is taken off their squares. Thirds of one square are compared by fine energy over the squared mean: cloth and light are
//! the same. Poses are compared by fine energy over that of differences at five to thirteen times the distance, because
//! contrast changes with the light.

use super::Picture;
use super::evenness::square_box;
use super::planes::{Grown, Plane};
use super::{CheckOptions, Focus};

/// Cells between the two of a coarse difference; several, as a weave repeats.
const COARSE: [usize; 3] = [5, 8, 13];
/// Fewer fine differences than this say nothing.
const ENOUGH: f64 = 300.0;
/// Of larger planes not every row is looked at: about this many cells in all.
const PLENTY: usize = 100_000;
/// The noise itself is known to this fraction.
const NOISE_KNOWN: f64 = 0.2;

/// Energy of differences, and how much of it noise explains.
#[derive(Debug, Clone, Copy, Default)]
struct Energy {
    square: f64,
    noise: f64,
    count: f64,
}

impl Energy {
    fn add(&mut self, difference: f32, variance: f32) {
        self.square += f64::from(difference * difference);
        self.noise += f64::from(variance);
        self.count += 1.0;
    }

    fn plus(self, other: Self) -> Self {
        Self {
            square: self.square + other.square,
            noise: self.noise + other.noise,
            count: self.count + other.count,
        }
    }

    fn signal(&self) -> f64 {
        self.square - self.noise
    }

    /// True when there is more than noise can be.
    fn seen(&self) -> bool {
        // Squares of Gaussian differences scatter by sqrt(2), neighbors share a value.
        let chance = self.noise * (3.0 / self.count.max(1.0)).sqrt();
        self.signal() > 5.0 * chance && self.signal() > NOISE_KNOWN * self.noise
    }
}

/// Fine and coarse.
type Bands = [Energy; 2];

/// Sharpness of the square and its thirds.
pub(super) fn focus(picture: &Picture, planes: &[Plane], options: &CheckOptions) -> Focus {
    let (first, size) = square_box(picture);
    let mut thirds = [Bands::default(); 3];
    for plane in planes {
        let mean = plane.mean() as f32;
        if mean <= 0.0 {
            continue;
        }
        let skip = (plane.width * plane.height).div_ceil(PLENTY).max(1);
        for y in (0..plane.height).step_by(skip) {
            let at = plane.pixel(0, y)[1];
            if (first[1]..first[1] + size[1]).contains(&at) {
                let third = (at - first[1]) * 3 / size[1];
                add_row(&mut thirds[third], plane, y, mean);
            }
        }
    }
    let whole = thirds
        .iter()
        .fold(Bands::default(), |a, b| [a[0].plus(b[0]), a[1].plus(b[1])]);
    let sharpest = thirds
        .iter()
        .filter(|t| t[0].seen())
        .filter_map(contrast)
        .reduce(f64::max);
    let Some(sharpest) = sharpest else {
        return Focus::default();
    };
    let sharpness = thirds.map(|t| contrast(&t));
    let much_blunter =
        |k: &usize| sharpness[*k].is_some_and(|s| s < options.blunt_limit * sharpest);
    let value = |k: &usize| sharpness[*k].unwrap_or(f64::INFINITY);
    let blunt = (0..3)
        .filter(much_blunter)
        .min_by(|a, b| value(a).total_cmp(&value(b)));
    let region = blunt.and_then(|third| {
        let mut region = Grown::empty();
        let row = |third: usize| first[1] + (third * size[1]).div_ceil(3);
        region.add([first[0], row(third)], 1);
        region.add([first[0] + size[0] - 1, row(third + 1) - 1], 1);
        region.crop(picture)
    });
    Focus {
        sharpness: ratio(&whole),
        thirds: sharpness,
        blunt,
        region,
    }
}

/// Fine over coarse energy per difference; none where noise hides either. Blur may leave no fine structure at all: that is
/// told when noise would have let a tenth of the coarse one be seen.
fn ratio([fine, coarse]: &Bands) -> Option<f64> {
    if fine.count < ENOUGH || !coarse.seen() {
        return None;
    }
    let coarse = coarse.signal() / coarse.count;
    let told = fine.seen() || NOISE_KNOWN * fine.noise / fine.count < 0.1 * coarse;
    told.then(|| fine.signal() / fine.count / coarse)
}

/// Fine energy per difference; none where there are too few.
fn contrast([fine, _]: &Bands) -> Option<f64> {
    (fine.count >= ENOUGH).then(|| fine.signal() / fine.count)
}

fn add_row([fine, coarse]: &mut Bands, plane: &Plane, y: usize, mean: f32) {
    let row = y * plane.width..(y + 1) * plane.width;
    let (values, noise) = (&plane.values[row.clone()], &plane.noise[row.clone()]);
    let weight = &plane.weight[row];
    let add = |energy: &mut Energy, apart: usize| {
        for x in apart..values.len() {
            if weight[x - apart] > 0.5 && weight[x] > 0.5 {
                let difference = (values[x] - values[x - apart]) / mean;
                let variance = noise[x].powi(2) + noise[x - apart].powi(2);
                energy.add(difference, variance / (mean * mean));
            }
        }
    };
    add(fine, 1);
    COARSE.iter().for_each(|apart| add(coarse, *apart));
}
