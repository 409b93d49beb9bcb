//! Several pictures of one size side by side.

use crate::base::{Error, Result};

/// Pixels between pictures.
const GAP: usize = 4;

/// Arranges pictures of `size` pixels row by row on a `ground`, as many columns as make it nearly square. Returns the size
/// of the whole and its pixels; one picture stays as it is.
///
/// # Errors
/// There is no picture, or one has another number of pixels.
pub fn arrange<T: Copy>(
    [width, height]: [usize; 2],
    pictures: &[Vec<T>],
    ground: T,
) -> Result<([usize; 2], Vec<T>)> {
    if pictures.is_empty() || pictures.iter().any(|p| p.len() != width * height) {
        return Err(Error::new(format!(
            "a sheet of {} pictures of {width} x {height} pixels, with {:?} values",
            pictures.len(),
            pictures.iter().map(Vec::len).collect::<Vec<_>>()
        )));
    }
    let columns = (pictures.len() as f64).sqrt().ceil() as usize;
    let rows = pictures.len().div_ceil(columns);
    let side = |n: usize, length: usize| n * (length + GAP) - GAP;
    let size = [side(columns, width), side(rows, height)];
    let mut all = vec![ground; size[0] * size[1]];
    for (i, picture) in pictures.iter().enumerate() {
        let (left, top) = (i % columns * (width + GAP), i / columns * (height + GAP));
        for (y, row) in picture.chunks(width).enumerate() {
            let start = (top + y) * size[0] + left;
            all[start..start + width].copy_from_slice(row);
        }
    }
    Ok((size, all))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_stand_in_reading_order() {
        let pictures: Vec<Vec<i32>> = (1..=3).map(|k| vec![k; 6]).collect();
        let (size, all) = arrange([3, 2], &pictures, 0).unwrap();
        assert_eq!(size, [6 + GAP, 4 + GAP]);
        assert_eq!(all[..size[0]], [1, 1, 1, 0, 0, 0, 0, 2, 2, 2]);
        assert_eq!(all[(2 + GAP) * size[0]..][..4], [3, 3, 3, 0]);
        assert_eq!(all.iter().filter(|v| **v == 3).count(), 6);
        assert_eq!(arrange([3, 2], &pictures[..1], 0).unwrap().0, [3, 2]);
        let sixteen = vec![vec![0_u8; 4]; 16];
        assert_eq!(arrange([2, 2], &sixteen, 0).unwrap().0, [8 + 3 * GAP; 2]);
    }

    #[test]
    fn what_is_no_sheet_is_refused() {
        assert!(arrange::<u8>([1, 1], &[], 0).is_err());
        assert!(arrange([1, 1], &[vec![0, 0]], 0).is_err());
    }
}
