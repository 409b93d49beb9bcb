//! Lines of the Zaber ASCII protocol, version 2: `/1 2 07 get pos:96`, `@01 2 07 OK IDLE -- 1200:C5`.

/// The sum that makes all bytes together 0 modulo 256.
fn checksum(text: &[u8]) -> u8 {
    text.iter()
        .fold(0_u8, |sum, byte| sum.wrapping_add(*byte))
        .wrapping_neg()
}

/// A command to one axis of a device (0 = all), with its message ID, checksum and line end.
pub(super) fn command(address: u8, axis: u8, id: u8, text: &str) -> Vec<u8> {
    let body = format!("{address} {axis} {id:02} {text}");
    format!("/{body}:{:02X}\n", checksum(body.as_bytes())).into_bytes()
}

/// The answer to a command.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Reply {
    pub(super) address: u8,
    pub(super) axis: u8,
    pub(super) id: Option<u8>,
    /// `OK` and not `RJ`.
    pub(super) accepted: bool,
    /// `BUSY` and not `IDLE`.
    pub(super) busy: bool,
    /// The gravest warning flag; none for `--`.
    pub(super) flag: Option<String>,
    /// Values, or the reason of a rejection.
    pub(super) data: String,
}

/// A line from the device.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Message {
    Reply(Reply),
    /// Unasked: an axis came to rest, or is in trouble.
    Alert {
        address: u8,
        axis: u8,
        flag: Option<String>,
    },
    /// Text for people.
    Info,
    /// None of these, or damaged.
    Garbled,
}

impl Message {
    /// Reads a line without its end. A line without checksum counts only when `plain` lines are allowed.
    pub(super) fn of(line: &[u8], plain: bool) -> Self {
        std::str::from_utf8(line)
            .ok()
            .and_then(|text| Self::parse(text, plain))
            .unwrap_or(Self::Garbled)
    }

    fn parse(text: &str, plain: bool) -> Option<Self> {
        let kind = text.get(..1)?;
        let body = match text.rsplit_once(':') {
            Some((body, sum)) => {
                let digits = sum.len() == 2 && sum.bytes().all(|b| b.is_ascii_hexdigit());
                let sum = u8::from_str_radix(sum, 16).ok().filter(|_| digits)?;
                (checksum(body.get(1..)?.as_bytes()) == sum).then_some(&body[1..])?
            }
            None => text.get(1..).filter(|_| plain)?,
        };
        if !body.bytes().all(|b| b.is_ascii_graphic() || b == b' ') {
            return None;
        }
        let mut fields = body.split(' ');
        let address = two_digits(fields.next()?)?;
        let axis = fields.next()?.parse().ok().filter(|axis| *axis < 10)?;
        match kind {
            "@" => Self::reply(address, axis, fields),
            "!" => {
                let next = fields.next()?;
                busy(next)?;
                let flag = flag(fields.next()?)?;
                Some(Self::Alert {
                    address,
                    axis,
                    flag,
                })
            }
            "#" => Some(Self::Info),
            _ => None,
        }
    }

    fn reply<'a>(address: u8, axis: u8, fields: impl Iterator<Item = &'a str>) -> Option<Self> {
        let mut fields = fields.peekable();
        let id = fields.peek().and_then(|field| two_digits(field));
        if id.is_some() {
            fields.next();
        }
        let accepted = match fields.next()? {
            "OK" => true,
            "RJ" => false,
            _ => return None,
        };
        let busy = busy(fields.next()?)?;
        let flag = flag(fields.next()?)?;
        let data: Vec<&str> = fields.collect();
        Some(Self::Reply(Reply {
            address,
            axis,
            id,
            accepted,
            busy,
            flag,
            data: data.join(" "),
        }))
    }
}

fn two_digits(field: &str) -> Option<u8> {
    let digits = field.len() == 2 && field.bytes().all(|b| b.is_ascii_digit());
    field.parse().ok().filter(|_| digits)
}

fn busy(field: &str) -> Option<bool> {
    match field {
        "BUSY" => Some(true),
        "IDLE" => Some(false),
        _ => None,
    }
}

fn flag(field: &str) -> Option<Option<String>> {
    match field.as_bytes() {
        b"--" => Some(None),
        [a, b] if a.is_ascii_uppercase() && b.is_ascii_alphanumeric() => {
            Some(Some(field.to_owned()))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_are_the_published_ones() {
        // The example of the protocol's own description.
        assert_eq!(checksum(b"01 tools echo"), 0x8f);
        assert_eq!(
            command(1, 1, 12, "move abs 10000"),
            b"/1 1 12 move abs 10000:BD\n"
        );
    }

    #[test]
    fn replies_are_read_and_any_single_damaged_byte_is_seen() {
        let line = b"@01 1 12 OK IDLE -- 0:09";
        let Message::Reply(reply) = Message::of(line, false) else {
            panic!("no reply");
        };
        assert!(reply.accepted && !reply.busy && reply.flag.is_none());
        assert_eq!((reply.address, reply.axis, reply.id), (1, 1, Some(12)));
        for i in 0..line.len() {
            for bit in 0..8 {
                let mut damaged = line.to_vec();
                damaged[i] ^= 1 << bit;
                let read = Message::of(&damaged, false);
                // Only the case of a hexadecimal digit may differ.
                assert!(
                    read == Message::Garbled || damaged.eq_ignore_ascii_case(line),
                    "{}",
                    String::from_utf8_lossy(&damaged)
                );
            }
            assert_eq!(Message::of(&line[..i], false), Message::Garbled);
        }
    }

    #[test]
    fn alerts_and_infos_are_no_replies_and_plain_lines_count_only_where_allowed() {
        let alert = Message::of(b"!01 2 IDLE FS", true);
        let flag = Some("FS".to_owned());
        assert_eq!(
            alert,
            Message::Alert {
                address: 1,
                axis: 2,
                flag
            }
        );
        assert_eq!(Message::of(b"#01 0 hello", true), Message::Info);
        assert_eq!(Message::of(b"!01 2 IDLE FS", false), Message::Garbled);
    }
}
