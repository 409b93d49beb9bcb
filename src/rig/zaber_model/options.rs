//! Which Zaber controller is modeled, how it is set up, and what goes wrong with it.

/// One axis of the controller.
#[derive(Debug, Clone, PartialEq)]
pub struct ZaberAxis {
    /// `limit.min`, microsteps.
    pub limit_min: i64,
    /// `limit.max`, microsteps.
    pub limit_max: i64,
    /// `maxspeed`, microsteps per second.
    pub max_speed: f64,
    /// `accel`, microsteps per second squared.
    pub acceleration: f64,
    /// Where it stands at power-up, microsteps from its home sensor.
    pub stands_at: i64,
    /// Its encoder is absolute: a restart loses neither position nor reference.
    pub keeps_reference: bool,
}

impl ZaberAxis {
    /// A rotary stage of 360 degrees and 24 degrees per second, with 1 536 000 microsteps per turn.
    pub fn rotary() -> Self {
        Self {
            limit_min: 0,
            limit_max: 1_536_000,
            max_speed: 102_400.0,
            acceleration: 400_000.0,
            stands_at: 50_000,
            keeps_reference: false,
        }
    }
}

/// Something that goes wrong with the n-th accepted `move` (1 = first) after power-up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ZaberFault {
    /// Which `move` command.
    pub on_move: u32,
    /// What goes wrong.
    pub kind: ZaberFaultKind,
}

/// What can go wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ZaberFaultKind {
    /// The device disappears halfway.
    Vanish,
    /// The device restarts by itself halfway.
    Restart,
    /// The axis stalls halfway and stops: flag FS.
    Stall,
    /// The driver overheats halfway and disables itself: flag FD.
    Overheat,
    /// The reply to the move arrives with a wrong byte.
    GarbleReply,
    /// The reply to the move is lost.
    LoseReply,
    /// The move is executed; neither it nor anything later is answered.
    Mute,
    /// The axis arrives and is BUSY for ever.
    StuckBusy,
    /// The axis ends this many microsteps short of the target.
    FallShort(i64),
    /// Somebody stops the axis halfway: flag NI.
    Interrupt,
    /// Somebody turns the axis' knob halfway, this many microsteps on: flag NC while it moves.
    Knob(i64),
    /// The axis stands IDLE for this long, seconds, before it moves.
    LateStart(f64),
    /// The axis moves as far as it should in the other direction.
    WrongWay,
}

/// How a model is set up.
#[derive(Debug, Clone)]
pub struct ZaberOptions {
    /// Device number in its chain.
    pub address: u8,
    /// Firmware version.
    pub firmware: String,
    /// Its axes, 1 first.
    pub axes: Vec<ZaberAxis>,
    /// `comm.checksum` as it was left.
    pub checksum: bool,
    /// `comm.alert` as it was left.
    pub alert: bool,
    /// Seconds from power-up until it hears anything.
    pub boot: f64,
    /// Seconds from command to reply.
    pub latency: f64,
    /// What goes wrong.
    pub faults: Vec<ZaberFault>,
}

impl ZaberOptions {
    /// A controller with this many rotary stages and recent firmware, as it comes from the factory.
    pub fn rotary(axes: usize) -> Self {
        Self {
            address: 1,
            firmware: "7.38".to_owned(),
            axes: vec![ZaberAxis::rotary(); axes],
            checksum: false,
            alert: false,
            boot: 0.1,
            latency: 0.005,
            faults: Vec::new(),
        }
    }
}
