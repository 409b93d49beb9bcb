//! The visible yarn segments of a draft: where a yarn comes up, until it goes down again.

use super::Draft;

/// A run of crossings at which one yarn is on top, in units of crossings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VisibleSegment {
    /// 0: warp, along y; 1: weft, along x.
    pub system: usize,
    /// Middle of the run in x (columns) and y (rows); inside the repeat or up to half a repeat over its edge.
    pub center: [f64; 2],
    /// How many crossings it is long; it is one wide.
    pub length: usize,
}

impl Draft {
    /// The visible segments of one repeat. Each crossing belongs to exactly one.
    pub fn visible_segments(&self) -> Vec<VisibleSegment> {
        let warp = (0..self.columns()).flat_map(|column| {
            runs(&self.warp_cells(column))
                .into_iter()
                .map(move |(first, length)| VisibleSegment {
                    system: 0,
                    center: [column as f64 + 0.5, first as f64 + 0.5 * length as f64],
                    length,
                })
        });
        let weft = (0..self.rows()).flat_map(|row| {
            runs(&self.weft_cells(row))
                .into_iter()
                .map(move |(first, length)| VisibleSegment {
                    system: 1,
                    center: [first as f64 + 0.5 * length as f64, row as f64 + 0.5],
                    length,
                })
        });
        warp.chain(weft).collect()
    }
}

/// The runs of `true` in a ring that has both values: (first, length).
fn runs(ring: &[bool]) -> Vec<(usize, usize)> {
    let n = ring.len();
    let starts = (0..n).filter(|&k| ring[k] && !ring[(k + n - 1) % n]);
    starts
        .map(|first| {
            let length = (0..n).take_while(|d| ring[(first + d) % n]).count();
            (first, length)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_cover_every_crossing_once_with_the_yarn_on_top() {
        for name in [
            "plain",
            "2/1 twill",
            "2/2 twill",
            "5-end satin",
            "8-end sateen",
        ] {
            let draft = Draft::named(name).unwrap();
            let mut seen = vec![0; draft.rows() * draft.columns()];
            for s in draft.visible_segments() {
                for k in 0..s.length {
                    let along = k as f64 + 0.5 - 0.5 * s.length as f64;
                    let [x, y] = match s.system {
                        0 => [s.center[0], s.center[1] + along],
                        _ => [s.center[0] + along, s.center[1]],
                    };
                    let (row, column) = (y as usize % draft.rows(), x as usize % draft.columns());
                    assert_eq!(
                        draft.warp_on_top(row, column),
                        s.system == 0,
                        "{name} {s:?}"
                    );
                    seen[row * draft.columns() + column] += 1;
                }
            }
            assert!(seen.iter().all(|&n| n == 1), "{name}: {seen:?}");
        }
        let lengths = |name: &str, system: usize| -> Vec<usize> {
            let draft = Draft::named(name).unwrap();
            let all = draft.visible_segments().into_iter();
            all.filter(|s| s.system == system)
                .map(|s| s.length)
                .collect()
        };
        assert_eq!(lengths("3/1 twill", 0), [3; 4]);
        assert_eq!(lengths("3/1 twill", 1), [1; 4]);
        assert_eq!(lengths("5-end satin", 0), [4; 5]);
    }
}
