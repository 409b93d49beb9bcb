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
    /// `[...]`: messages and listings.
    Message(String),
    /// `$n=v`
    Setting(u16, f64),
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
        if text.starts_with('[') && text.ends_with(']') {
            return Some(Self::Message(text.to_owned()));
        }
        if let Some((number, value)) = text.strip_prefix('$').and_then(|t| t.split_once('=')) {
            // Start-up blocks ($N0=) and settings that are not numbers are listings like any other.
            return match (number.parse(), value.parse()) {
                (Ok(n), Ok(v)) if f64::is_finite(v) => Some(Self::Setting(n, v)),
                _ => Some(Self::Message(text.to_owned())),
            };
        }
        // The echo of a start-up line: ">G20G54:ok".
        text.starts_with('>')
            .then(|| Self::Message(text.to_owned()))
    }
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
        assert_eq!(Reply::of(b"$30=1000.000"), Reply::Setting(30, 1000.0));
        assert!(matches!(
            Reply::of(b"GrblHAL 1.1f ['$' or '$HELP' for help]"),
            Reply::Banner(_)
        ));
        assert!(matches!(Reply::of(b"$N0="), Reply::Message(_)));
        assert!(matches!(Reply::of(b"$22=nan"), Reply::Message(_)));
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
}
