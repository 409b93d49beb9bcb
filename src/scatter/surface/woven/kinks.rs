//! Where a highlight curve has kinks: where light or camera lose sight of its fibers.

use super::highlight::{Highlight, Place};

/// Room for marks on a curve: its ends, the smoothing's and as many kinks as any pair of directions was seen to make, thrice.
pub(super) const MARKS: usize = 24;

/// A part of the curve where light and camera see the fibers.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Panel {
    pub(super) low: f64,
    pub(super) high: f64,
    /// The ends that move with the inclination, and those that move with the twist where normals turn away.
    pub(super) low_end: End,
    pub(super) high_end: End,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum End {
    /// Nothing is lost there, or the end stays.
    #[default]
    Still,
    Inclined,
    Turned,
}

/// A short list without an allocation.
pub(super) struct Few<T, const N: usize> {
    pub(super) items: [T; N],
    pub(super) count: usize,
}

impl<T: Copy + Default, const N: usize> Few<T, N> {
    pub(super) fn new() -> Self {
        Self {
            items: [T::default(); N],
            count: 0,
        }
    }

    /// Adds an item, if there is room.
    pub(super) fn push(&mut self, item: T) {
        if self.count < N {
            self.items[self.count] = item;
            self.count += 1;
        }
    }

    pub(super) fn as_slice(&self) -> &[T] {
        &self.items[..self.count]
    }
}

/// How finely kinks are looked for.
pub(super) struct Search {
    steps: usize,
    /// Of the curve's length.
    tolerance: f64,
}

pub(super) const FIT_SEARCH: Search = Search {
    steps: 6,
    tolerance: 1e-4,
};
pub(super) const REPORT_SEARCH: Search = Search {
    steps: 16,
    tolerance: 1e-8,
};

/// The kinds of kinks.
const KINKS: [fn(&Place) -> f64; 3] = [|p| p.light, |p| p.camera, |p| p.cos_v];

/// The visible parts of the curve, cut also where the smoothing begins, at inclinations of `-fades` and `fades`.
pub(super) fn visible_parts(
    highlight: &Highlight,
    search: &Search,
    fades: Option<f64>,
) -> Few<Panel, MARKS> {
    let mut marks: Few<(f64, End), MARKS> = Few::new();
    let end = |inclined: bool| match inclined {
        true => End::Inclined,
        false => End::Still,
    };
    let (lower, upper) = (highlight.lower, highlight.upper);
    marks.push((lower.at, end(lower.inclined)));
    marks.push((upper.at, end(upper.inclined)));
    if let Some(u) = fades {
        for x in [highlight.variable(-u), highlight.variable(u)] {
            if let Some(x) = x.filter(|x| (lower.at..upper.at).contains(x)) {
                marks.push((x, End::Still));
            }
        }
    }
    find_kinks(highlight, search, &mut marks);
    let count = marks.count;
    marks.items[..count].sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let mut panels = Few::new();
    for pair in marks.as_slice().windows(2) {
        let ((low, low_end), (high, high_end)) = (pair[0], pair[1]);
        if low < high && highlight.place(0.5 * (low + high)).visible() {
            panels.push(Panel {
                low,
                high,
                low_end,
                high_end,
            });
        }
    }
    panels
}

/// Marks where light or camera lose sight of the fibers.
fn find_kinks(highlight: &Highlight, search: &Search, marks: &mut Few<(f64, End), MARKS>) {
    let (low, high) = (highlight.lower.at, highlight.upper.at);
    let kinds = if highlight.turns_away() { 3 } else { 2 };
    let step = (high - low) / search.steps as f64;
    let mut before = (low, highlight.place(low));
    for k in 1..=search.steps {
        let x = if k == search.steps {
            high
        } else {
            low + step * k as f64
        };
        let place = highlight.place(x);
        for (kind, of) in KINKS.into_iter().enumerate().take(kinds) {
            let (f0, f1) = (of(&before.1), of(&place));
            if (f0 > 0.0) != (f1 > 0.0) {
                let x = root(
                    (before.0, f0),
                    (x, f1),
                    search.tolerance * (high - low),
                    |x| of(&highlight.place(x)),
                );
                marks.push((x, if kind == 2 { End::Turned } else { End::Still }));
            }
        }
        before = (x, place);
    }
}

/// A root between two points of opposite sign, by the Illinois form of the false position.
fn root(
    (mut x0, mut f0): (f64, f64),
    (mut x1, mut f1): (f64, f64),
    tolerance: f64,
    f: impl Fn(f64) -> f64,
) -> f64 {
    let mut last = x0;
    for _ in 0..40 {
        let x = x1 - f1 * (x1 - x0) / (f1 - f0);
        if (x - last).abs() <= tolerance {
            return x;
        }
        last = x;
        let value = f(x);
        if (value > 0.0) == (f1 > 0.0) {
            f0 *= 0.5;
        } else {
            (x0, f0) = (x1, f1);
        }
        (x1, f1) = (x, value);
    }
    last
}
