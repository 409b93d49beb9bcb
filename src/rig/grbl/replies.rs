//! What one line from a controller is.

use super::status::Status;

/// One line from the controller, classified.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Reply {
    /// `ok`
    Ok,
    /// `error:n`
    Error(u8),
    /// `ALARM:n`
    Alarm(u8),
    /// `<...>`
    Status(Status),
    /// `Grbl 1.1h ['$' for help]` and the like: the controller has just started.
    Banner(String),
    /// `[...]`, `$n=v`, the echo of a start-up line: messages and listings, as they were said.
    Listing(String),
    /// An empty line.
    Nothing,
    /// Anything else.
    Garbled(Vec<u8>),
}

impl Reply {
    /// Classifies a line without its line end.
    pub(super) fn of(line: &[u8]) -> Self {
        Self::of_text(line).unwrap_or_else(|| Self::Garbled(line.to_vec()))
    }

    fn of_text(line: &[u8]) -> Option<Self> {
        let text = std::str::from_utf8(line).ok()?;
        if text.is_empty() {
            return Some(Self::Nothing);
        }
        if text == "ok" {
            return Some(Self::Ok);
        }
        if let Some(number) = text.strip_prefix("error:") {
            return number.parse().ok().map(Self::Error);
        }
        if let Some(number) = text.strip_prefix("ALARM:") {
            return number.parse().ok().map(Self::Alarm);
        }
        if text.starts_with("Grbl") {
            return Some(Self::Banner(text.to_owned()));
        }
        if let Some(inside) = text.strip_prefix('<').and_then(|t| t.strip_suffix('>')) {
            return Status::parse(inside).map(Self::Status);
        }
        let listed = (text.starts_with('[') && text.ends_with(']'))
            || (text.starts_with('$') && text.contains('='))
            // The echo of a start-up line: ">G20G54:ok".
            || text.starts_with('>');
        listed.then(|| Self::Listing(text.to_owned()))
    }
}

/// Number and value of a line `$n=v`; none for start-up blocks (`$N0=`) and values that are not numbers.
pub(super) fn setting(line: &str) -> Option<(u16, f64)> {
    let (number, value) = line.strip_prefix('$')?.split_once('=')?;
    let value: f64 = value.parse().ok()?;
    Some((number.parse().ok()?, value)).filter(|_| value.is_finite())
}

/// What stands in the line `[key...]` of a listing.
pub(super) fn listed<'t>(listing: &'t [String], key: &str) -> Option<&'t str> {
    listing
        .iter()
        .find_map(|l| l.strip_prefix('[')?.strip_suffix(']')?.strip_prefix(key))
}

/// True when a damaged line may have been a banner or an alarm: such a line is never taken for mere noise.
pub(super) fn may_hide_a_stop(bytes: &[u8]) -> bool {
    let lower = bytes.to_ascii_lowercase();
    [&b"grblhal"[..], b"alarm:", b"for help]"]
        .iter()
        .flat_map(|w| w.windows(3))
        .any(|piece| lower.windows(3).any(|w| w == piece))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_line_is_told_apart() {
        assert_eq!(Reply::of(b"ok"), Reply::Ok);
        assert_eq!(Reply::of(b"error:9"), Reply::Error(9));
        assert_eq!(Reply::of(b"ALARM:11"), Reply::Alarm(11));
        assert_eq!(Reply::of(b""), Reply::Nothing);
        assert!(matches!(Reply::of(b"$30=1000.000"), Reply::Listing(_)));
        assert_eq!(setting("$30=1000.000"), Some((30, 1000.0)));
        assert!(matches!(
            Reply::of(b"GrblHAL 1.1f ['$' or '$HELP' for help]"),
            Reply::Banner(_)
        ));
        assert!(matches!(Reply::of(b"$N0="), Reply::Listing(_)));
        assert_eq!((setting("$N0="), setting("$22=nan")), (None, None));
        assert!(matches!(Reply::of(b"<Idle|MPos:0,0,0>"), Reply::Status(_)));
    }

    #[test]
    fn damaged_replies_are_garbled_and_never_ok() {
        for line in [
            &b"o"[..],
            b"k",
            b"ok\xfe",
            b"okok",
            b"error:",
            b"<Idle|MPos:0,0",
            b"rbl 1.1h",
        ] {
            assert!(matches!(Reply::of(line), Reply::Garbled(_)), "{line:?}");
        }
    }
    #[test]
    fn a_damaged_banner_or_alarm_is_not_mere_noise() {
        for line in [
            &b"Gr\xffl 1.1h ['$' for h\x00lp]"[..],
            b"AL\xfeRM:1",
            b"rbl 1.1h",
        ] {
            assert!(may_hide_a_stop(line), "{line:?}");
        }
        for line in [&b"o\xfek"[..], b"okok", b"<Idle|MPos:0,0", b"$11x=0.010"] {
            assert!(!may_hide_a_stop(line), "{line:?}");
        }
    }
}
