//! Which controller is modeled, how it is set up, and what goes wrong with it.

/// Which firmware is modeled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flavor {
    /// Grbl 1.1h, axes X Y Z.
    Grbl,
    /// grblHAL 1.1f, axes X Y Z A B.
    GrblHal,
}

impl Flavor {
    /// The axis letters.
    pub fn letters(self) -> &'static [char] {
        match self {
            Self::Grbl => &['X', 'Y', 'Z'],
            Self::GrblHal => &['X', 'Y', 'Z', 'A', 'B'],
        }
    }
}

/// Something that goes wrong in the middle of the n-th motion line (1 = first) after power-up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fault {
    /// Which motion line.
    pub on_move: u32,
    /// What goes wrong.
    pub kind: FaultKind,
}

/// What can go wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FaultKind {
    /// The board restarts by itself halfway.
    Reset,
    /// An alarm with this number halfway.
    Alarm(u8),
    /// The line's `ok` arrives as `o\xfek`.
    Garble,
    /// The line is executed and never acknowledged; nor is any later one.
    NeverOk,
    /// The device disappears halfway.
    Vanish,
    /// The first axis ends this many units short of the target, and says so.
    FallShort(f64),
    /// Somebody presses the hold button halfway.
    Hold,
    /// The line's `ok` arrives twice.
    DoubleOk,
    /// The byte at this place of the line is lost on its way to the board; beyond the last one: the line's end.
    DropByte(usize),
    /// The first digit of the line's first axis word arrives as this one, and the line is executed so.
    CorruptDigit(char),
    /// The axes stop halfway and the board says `Run` until it is reset.
    StuckBusy,
}

/// How a model is set up.
#[derive(Debug, Clone)]
pub struct ModelOptions {
    /// Which firmware.
    pub flavor: Flavor,
    /// Changed `$` settings; unknown numbers are ignored.
    pub settings: Vec<(u16, f64)>,
    /// A blank EEPROM: complaints and (Grbl) a settings dump before the banner.
    pub blank_eeprom: bool,
    /// Seconds from power-up to the banner; what arrives earlier is lost.
    pub boot: f64,
    /// Seconds from cause to reply.
    pub latency: f64,
    /// Limit switch and button letters reported in every status (`Pn:`).
    pub pins: String,
    /// What goes wrong.
    pub faults: Vec<Fault>,
}

impl ModelOptions {
    /// A controller as it comes from the factory: homing and soft limits off, slow.
    pub fn factory(flavor: Flavor) -> Self {
        Self {
            flavor,
            settings: Vec::new(),
            blank_eeprom: true,
            boot: 1.0,
            latency: 0.004,
            pins: String::new(),
            faults: Vec::new(),
        }
    }

    /// A controller set up for a rig in degrees: homing with lock and soft limits on, 360 units of travel, 100 units/s.
    pub fn rig(flavor: Flavor) -> Self {
        let homing = if flavor == Flavor::Grbl { 1.0 } else { 5.0 };
        let mut settings = vec![(22, homing), (20, 1.0)];
        for axis in 0..flavor.letters().len() as u16 {
            settings.extend([
                (110 + axis, 6000.0),
                (120 + axis, 500.0),
                (130 + axis, 360.0),
            ]);
        }
        Self {
            settings,
            blank_eeprom: false,
            ..Self::factory(flavor)
        }
    }
}
