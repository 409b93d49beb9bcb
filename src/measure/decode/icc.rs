//! Whether a color profile says that values are linear (ICC.1:2022, sections 7 and 10.6, 10.18).

use crate::base::{Error, Result};

/// The tone curves of a profile: of gray, red, green and blue.
const CURVES: [&[u8; 4]; 4] = [b"kTRC", b"rTRC", b"gTRC", b"bTRC"];

/// Passes profiles all of whose tone curves are the identity.
///
/// # Errors
/// When a curve is another, cannot be read, or there is none (profiles of tables).
pub(super) fn check_linear(profile: &[u8]) -> Result<()> {
    let curves = CURVES.iter().filter_map(|name| find(profile, name));
    let linear: Vec<bool> = curves.map(|c| is_identity(c) == Some(true)).collect();
    if !linear.is_empty() && linear.iter().all(|l| *l) {
        return Ok(());
    }
    Err(
        Error::new("the image's color profile does not say that its values are linear")
            .with_hint("export linear values, with a linear profile or without any"),
    )
}

/// The data of a tag.
fn find<'a>(profile: &'a [u8], name: &[u8; 4]) -> Option<&'a [u8]> {
    let number = |at: usize| -> Option<usize> {
        let bytes: [u8; 4] = profile.get(at..at + 4)?.try_into().ok()?;
        Some(u32::from_be_bytes(bytes) as usize)
    };
    let count = number(128)?.min(1000);
    let entry = (0..count)
        .map(|i| 132 + 12 * i)
        .find(|&at| profile.get(at..at + 4) == Some(&name[..]))?;
    let (at, size) = (number(entry + 4)?, number(entry + 8)?);
    profile.get(at..at.checked_add(size)?)
}

/// True for a `curv` without entries or with gamma 1, and for a `para` whose gamma is 1 (function 0).
fn is_identity(curve: &[u8]) -> Option<bool> {
    match curve.get(..4)? {
        b"curv" => match curve.get(8..12)? {
            [0, 0, 0, 0] => Some(true),
            // One entry: gamma in units of 1/256.
            [0, 0, 0, 1] => Some(curve.get(12..14)? == [1, 0]),
            _ => Some(false),
        },
        b"para" => Some(curve.get(8..10)? == [0, 0] && curve.get(12..16)? == [0, 1, 0, 0]),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A profile with these curves, laid out after the tag table.
    fn profile(curves: &[(&[u8; 4], &[u8])]) -> Vec<u8> {
        let mut bytes = vec![0; 128];
        bytes.extend_from_slice(&(curves.len() as u32).to_be_bytes());
        let mut at = bytes.len() + 12 * curves.len();
        for (name, curve) in curves {
            bytes.extend_from_slice(*name);
            bytes.extend_from_slice(&(at as u32).to_be_bytes());
            bytes.extend_from_slice(&(curve.len() as u32).to_be_bytes());
            at += curve.len();
        }
        for (_, curve) in curves {
            bytes.extend_from_slice(curve);
        }
        bytes
    }

    #[test]
    fn only_profiles_with_straight_curves_pass() {
        let identity = b"curv\0\0\0\0\0\0\0\0";
        let one = b"curv\0\0\0\0\0\0\0\x01\x01\x00";
        let gamma = b"curv\0\0\0\0\0\0\0\x01\x02\x33";
        let straight = b"para\0\0\0\0\0\0\0\0\0\x01\0\0";
        let srgb = b"para\0\0\0\0\0\x03\0\0\0\x02\x66\x66";
        let passes = |curves: &[(&[u8; 4], &[u8])]| check_linear(&profile(curves)).is_ok();
        assert!(passes(&[(b"kTRC", identity)]) && passes(&[(b"kTRC", straight)]));
        assert!(passes(&[
            (b"rTRC", one),
            (b"gTRC", identity),
            (b"bTRC", straight)
        ]));
        assert!(!passes(&[(b"rTRC", one), (b"gTRC", gamma), (b"bTRC", one)]));
        assert!(!passes(&[(b"kTRC", srgb)]));
        assert!(!passes(&[]) && !passes(&[(b"A2B0", identity)]));
        let whole = profile(&[(b"kTRC", one)]);
        for cut in 0..whole.len() {
            assert!(check_linear(&whole[..cut]).is_err(), "cut at {cut}");
        }
    }
}
