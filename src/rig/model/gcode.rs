//! One line of g-code: words, and what Grbl refuses in them.

/// The words of a line, in order.
pub(super) fn words(line: &str) -> Result<Vec<(char, f64)>, u8> {
    let bytes = line.as_bytes();
    let mut words = Vec::new();
    let mut i = 0;
    while i < bytes.len() {
        let letter = bytes[i] as char;
        if !letter.is_ascii_uppercase() {
            return Err(1);
        }
        i += 1;
        let start = i;
        if i < bytes.len() && (bytes[i] == b'-' || bytes[i] == b'+') {
            i += 1;
        }
        let mut dots = 0;
        while i < bytes.len() && (bytes[i].is_ascii_digit() || (bytes[i] == b'.' && dots == 0)) {
            dots += usize::from(bytes[i] == b'.');
            i += 1;
        }
        let value = line[start..i].parse::<f64>().map_err(|_| 2_u8)?;
        words.push((letter, value));
    }
    Ok(words)
}

/// What a line of g-code asks for, before it is checked against the machine.
#[derive(Debug, Clone, Default)]
pub(super) struct Request {
    /// 0 or 1: G0 or G1.
    pub(super) motion: Option<u8>,
    /// G90 (false) or G91 (true).
    pub(super) relative: Option<bool>,
    /// G20.
    pub(super) inches: Option<bool>,
    /// G53.
    pub(super) machine_space: bool,
    /// G4 with its P, seconds.
    pub(super) dwell: Option<f64>,
    /// M3, M4 (true) or M5 (false).
    pub(super) spindle: Option<u8>,
    pub(super) spindle_speed: Option<f64>,
    pub(super) feed: Option<f64>,
    /// Axis letter and value, as programmed.
    pub(super) axes: Vec<(char, f64)>,
}

/// Reads a line for a machine with these axis letters.
///
/// # Errors
/// The controller's error number.
#[allow(clippy::float_cmp)] // g-code numbers are compared as they were typed
pub(super) fn request(line: &str, letters: &[char]) -> Result<Request, u8> {
    let mut r = Request::default();
    let mut groups_seen = [false; 8];
    let mut once = |group: usize| {
        if std::mem::replace(&mut groups_seen[group], true) {
            Err(21)
        } else {
            Ok(())
        }
    };
    let mut is_dwell = false;
    let mut pause = None;
    for (letter, value) in words(line)? {
        match letter {
            'G' => {
                let group = match value {
                    4.0 | 53.0 => 0,
                    0.0 | 1.0 => 1,
                    17.0 => 2,
                    90.0 | 91.0 => 3,
                    20.0 | 21.0 => 4,
                    94.0 => 5,
                    54.0 => 6,
                    _ => return Err(20),
                };
                once(group)?;
                match value {
                    4.0 => is_dwell = true,
                    53.0 => r.machine_space = true,
                    0.0 | 1.0 => r.motion = Some(value as u8),
                    90.0 | 91.0 => r.relative = Some(value == 91.0),
                    20.0 | 21.0 => r.inches = Some(value == 20.0),
                    _ => {}
                }
            }
            'M' => match value {
                3.0..=5.0 if value.fract() == 0.0 => {
                    once(7)?;
                    r.spindle = Some(value as u8);
                }
                9.0 => {}
                _ => return Err(20),
            },
            'F' => r.feed = Some(value),
            'S' => r.spindle_speed = Some(value),
            'P' => pause = Some(value),
            'N' | 'T' => {}
            axis if letters.contains(&axis) => {
                if r.axes.iter().any(|a| a.0 == axis) {
                    return Err(25);
                }
                r.axes.push((axis, value));
            }
            _ => return Err(20),
        }
    }
    if is_dwell {
        r.dwell = Some(pause.ok_or(28_u8)?);
    }
    Ok(r)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_lines_get_the_numbers_a_real_controller_gave() {
        let error = |line: &str| request(line, &['X', 'Y', 'Z']).unwrap_err();
        for (line, number) in [
            ("FOO", 2),
            ("G1X", 2),
            ("G999", 20),
            ("Q1", 20),
            ("G1X1.2.3F10", 1),
            ("G91G90", 21),
        ] {
            assert_eq!(error(line), number, "{line}");
        }
        assert_eq!(request("X1Y2Z3", &['X', 'Y', 'Z']).unwrap().axes.len(), 3);
    }
}
