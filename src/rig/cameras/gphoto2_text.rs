//! What the `gphoto2` program prints, and what it means.

use super::retry::Remedy;
use std::collections::BTreeMap;

/// A camera the program found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Found {
    /// Model in the program's words.
    pub(super) model: String,
    /// Port, e.g. `usb:001,006`; another one each time the camera is plugged in or switched on.
    pub(super) port: String,
}

/// The table of `--auto-detect`: model and port, the port being the last word of a line.
pub(super) fn parse_found(stdout: &str) -> Vec<Found> {
    stdout
        .lines()
        .skip_while(|l| !l.starts_with("---"))
        .skip(1)
        .filter_map(|line| {
            let (model, port) = line.trim_end().rsplit_once(char::is_whitespace)?;
            port.contains(':').then(|| Found {
                model: model.trim().to_owned(),
                port: port.to_owned(),
            })
        })
        .collect()
}

/// A setting, as `--get-config` shows it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Setting {
    /// Its value.
    pub(super) current: String,
    /// It cannot be changed (as long as the camera is in this mode).
    pub(super) readonly: bool,
    /// What it can be set to.
    pub(super) choices: Vec<String>,
}

/// The settings in what the program printed, in order.
pub(super) fn parse_settings(stdout: &str) -> Vec<Setting> {
    let mut settings: Vec<Setting> = Vec::new();
    for line in stdout.lines() {
        let Some((key, value)) = line.split_once(':') else {
            continue;
        };
        let value = value.trim();
        if key == "Label" {
            settings.push(Setting::default());
        }
        let Some(setting) = settings.last_mut() else {
            continue;
        };
        match key {
            "Current" => value.clone_into(&mut setting.current),
            "Readonly" => setting.readonly = value != "0",
            "Choice" => {
                let text = value.split_once(' ').map_or("", |(_, text)| text);
                setting.choices.push(text.trim().to_owned());
            }
            _ => {}
        }
    }
    settings
}

/// The names of the settings `--list-config` lists, without their sections.
pub(super) fn parse_setting_names(stdout: &str) -> Vec<&str> {
    let paths = stdout.lines().map(str::trim_end);
    paths
        .filter(|p| p.starts_with('/'))
        .filter_map(|p| p.rsplit_once('/'))
        .map(|(_, name)| name)
        .collect()
}

/// The settings asked for by name; none when the program did not answer with exactly these.
pub(super) fn named_settings(asked: &[&str], stdout: &str) -> Option<BTreeMap<String, Setting>> {
    let settings = parse_settings(stdout);
    let names = asked.iter().map(|n| (*n).to_owned());
    (settings.len() == asked.len()).then(|| names.zip(settings).collect())
}

/// Seconds of a shutter speed in any of the forms cameras have: `1/60`, `13/10`, `0.5`, `0.0166s`, `30s`, `2m`, `1.3"`.
/// None for what is no time: bulb, auto, unknown values.
pub(super) fn parse_speed(text: &str) -> Option<f64> {
    let text = text.trim();
    let (number, unit) = match text.strip_suffix(['s', '"']) {
        Some(number) => (number, 1.0),
        None => match text.strip_suffix('m') {
            Some(number) => (number, 60.0),
            None => (text, 1.0),
        },
    };
    let value = match number.split_once('/') {
        // All bits set: a camera that does not say.
        Some(("65535", _)) => return None,
        Some((above, below)) => parse_number(above)? / parse_number(below)?,
        None => parse_number(number)?,
    };
    let seconds = unit * value;
    (1e-6..=7200.0).contains(&seconds).then_some(seconds)
}

/// A plain decimal number; `inf`, `1e3` and signs are none.
fn parse_number(text: &str) -> Option<f64> {
    let plain = text.bytes().all(|b| b.is_ascii_digit() || b == b'.');
    plain.then(|| text.parse().ok()).flatten()
}

/// What is known of failures: any of these texts (lower case) in what the program said; what to do; a hint.
const FAILURES: &[(&[&str], Remedy, &str)] = &[
    (
        &[
            "could not claim the usb device",
            "(-53:",
            "could not lock the device",
            "(-60:",
        ],
        Remedy::Again,
        "another program holds the camera, on a desktop mostly its volume monitor: \
         end it with `pkill gvfs-gphoto2-volume-monitor`, and close photo programs",
    ),
    (
        &[
            "no camera found",
            "could not detect any camera",
            "(-105:",
            "could not find the requested device",
            "(-52:",
        ],
        Remedy::Reconnect,
        "check the camera's cable, its power and that it does not go to sleep (auto power off)",
    ),
    (
        &["focus"],
        Remedy::GiveUp,
        "switch the lens to manual focus",
    ),
    (
        &[
            "store full",
            "0x200c",
            "(-115:",
            "no space",
            "(-6:",
            "not found in configuration tree",
        ],
        Remedy::GiveUp,
        "check the memory card, that the camera is in mode M, and what `gphoto2 --summary` says it can do",
    ),
    (
        &["ptp device busy", "0x2019", "i/o in progress", "(-110:"],
        Remedy::Again,
        "the camera is busy: switch off long exposure noise reduction and picture review, use a fast memory card, \
         and make sure that there is a card",
    ),
    (
        &[
            "i/o problem",
            "(-7:",
            "timeout",
            "(-10:",
            "ptp session not open",
            "error reading from the port",
            "(-34:",
            "(-35:",
        ],
        Remedy::Reconnect,
        "try another cable and another USB port, without a hub",
    ),
];

/// What a failure the program told asks for, and a hint for the operator. Trying again harms nothing, so that is what
/// unknown ones get.
pub(super) fn remedy(said: &str) -> (Remedy, &'static str) {
    let said = said.to_lowercase();
    let known = FAILURES
        .iter()
        .find(|(texts, ..)| texts.iter().any(|t| said.contains(t)));
    known.map_or(
        (
            Remedy::Again,
            "see what `gphoto2 --debug --capture-image-and-download` says",
        ),
        |&(_, remedy, hint)| (remedy, hint),
    )
}

/// What the program complained about, in one line.
pub(super) fn complaint(stderr: &str) -> String {
    let lines = stderr
        .lines()
        .map(|l| l.trim().trim_matches('*').trim())
        .filter(|l| !l.is_empty() && *l != "Error");
    let mut text = lines.collect::<Vec<_>>().join("; ");
    if let Some((end, _)) = text.char_indices().nth(400) {
        text.truncate(end);
        text.push_str("...");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shutter_speeds_of_all_makers_are_read() {
        for (text, seconds) in [
            ("1/60", 1.0 / 60.0),
            ("0.5", 0.5),
            ("1.3", 1.3),
            ("30", 30.0),
            ("0.0166s", 0.0166),
            ("13/10", 1.3),
            ("30s", 30.0),
            ("2m", 120.0),
            ("1.6\"", 1.6),
            ("1/2.5", 0.4),
        ] {
            let read = parse_speed(text).unwrap_or(f64::NAN);
            assert!((read - seconds).abs() < 1e-12, "{text}: {read}");
        }
        for text in [
            "bulb",
            "Bulb",
            "auto",
            "Time",
            "x 200",
            "Unknown value 00dc",
            "65535/65535",
            "1/0",
            "0",
            "-1",
            "inf",
            "NaN",
            "1e3",
            "",
            "/",
            "1/",
            "m",
            "99999",
        ] {
            assert_eq!(parse_speed(text), None, "{text}");
        }
    }

    #[test]
    fn garbage_makes_no_settings_and_no_cameras() {
        for text in [
            "",
            "\n\n",
            "Current: 1/60\nChoice: 0 1\n",
            ":::\n----\nno port here\n",
            "\u{0}\u{fffd}",
        ] {
            assert!(parse_settings(text).is_empty(), "{text:?}");
            assert!(parse_found(text).is_empty(), "{text:?}");
            assert!(named_settings(&["iso"], text).is_none(), "{text:?}");
        }
    }
}
