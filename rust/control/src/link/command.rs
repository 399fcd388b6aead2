//! The commands of a host, read from the bodies of its frames.

use super::Fields;
use super::device::State;
use super::identity::Limits;
use super::positions;
use crate::{
    AnyController, AnyDesign, BIQUADS, Biquad, Cascade, Design, Feedforward, LEVELS, Level, POINTS,
    Point, PositionDesign, Refused, Schedule, Settings, Standard, TAPS,
};

/// Shortest and longest time of a watchdog \[us\].
const WATCHDOG: core::ops::RangeInclusive<u32> = 1_000..=10_000_000;
/// Counts in a period that no 32-bit counter exceeds.
const MOST_COUNTS: f32 = 2_147_483_648.0;
/// The longest body of ECHO.
const MAX_ECHO: usize = 200;
/// The kind of HELLO, the only one that needs neither tag nor session.
pub(super) const HELLO: u8 = 0x01;
/// The kind of the command that is executed for any sequence number.
pub(super) const STOP: u8 = 0x06;

/// Why a command was refused: result and detail of its reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Refusal {
    pub(super) result: u8,
    pub(super) detail: u32,
}

impl Refusal {
    const fn new(result: u8, detail: u32) -> Self {
        Self { result, detail }
    }
    pub(super) const fn unknown(kind: u8) -> Self {
        Self::new(1, kind as u32)
    }
    pub(super) const fn length(body: &[u8]) -> Self {
        Self::new(2, body.len() as u32)
    }
    pub(super) const fn value(index: u32) -> Self {
        Self::new(3, index)
    }
    pub(super) const fn state(state: State) -> Self {
        Self::new(4, state as u32)
    }
    pub(super) const fn tag(tag: u16) -> Self {
        Self::new(5, tag as u32)
    }
    pub(super) const fn limit(index: u32) -> Self {
        Self::new(6, index)
    }
    pub(super) const fn room(fits: u32) -> Self {
        Self::new(7, fits)
    }
    pub(super) const fn unsupported(index: u32) -> Self {
        Self::new(8, index)
    }
    pub(super) const fn order(offset: u32) -> Self {
        Self::new(9, offset)
    }
    pub(super) const fn version(version: u8) -> Self {
        Self::new(10, version as u32)
    }
    pub(super) const MOVING: Self = Self::new(11, 0);
    pub(super) const NO_LIMITS: Self = Self::new(12, 0);
    pub(super) const KEY: Self = Self::new(13, 0);

    /// `Ok` if `holds`.
    pub(super) fn unless(self, holds: bool) -> Result<(), Self> {
        if holds { Ok(()) } else { Err(self) }
    }
}

/// Values to be appended to the profile.
#[derive(Clone, Copy, Debug)]
pub(super) struct Upload<'a> {
    pub(super) table: u8,
    pub(super) offset: u32,
    /// As received: i16 or f32, depending on the table.
    pub(super) values: &'a [u8],
}

/// Gains and filter of the controller, and the unit of its feedback.
#[derive(Clone, Copy, Debug)]
pub(super) struct Gains {
    /// Without its sample time, which is the device's.
    design: AnyDesign<f32>,
    /// A schedule was received but is not valid.
    garbled: bool,
    /// The body has the fields for devices with observer, ramp and schedule.
    pub(super) long: bool,
    /// Counts per second of one unit of feedback.
    pub(super) counts_per_unit: f32,
    /// A position loop over the PID.
    pub(super) position: Option<PositionDesign<f32>>,
}

impl Gains {
    /// The controller. The volt limit narrows its own limits, so that its integral takes that limit into account.
    ///
    /// # Errors
    /// The first setting that is outside its range.
    pub(super) fn controller(&self, volt: f32, ts: f32) -> Result<AnyController<f32>, Refused> {
        let mut design = self.design;
        design.bound(volt, ts);
        design.controller()
    }

    /// Biquads from the next start on; GAINS has none.
    pub(super) fn set_biquads(&mut self, biquads: Cascade<f32>) {
        if let Some(design) = self.design.pid_mut() {
            design.biquads = biquads;
        }
    }

    /// Feedforward from the next start on; GAINS has none.
    pub(super) fn set_feedforward(&mut self, feedforward: Feedforward<f32>) {
        if let Some(design) = self.design.pid_mut() {
            design.feedforward = feedforward;
        }
    }

    /// Whether the settings are a PID's, which every device with mode 1 can run.
    pub(super) fn are_pid(&self) -> bool {
        self.design.pid().is_some()
    }

    /// # Errors
    /// The field that is outside its range, or beyond the volt limit.
    pub(super) fn check(&self, volt: f32, ts: f32) -> Result<(), Refusal> {
        let refused = |volt| {
            let name = self.refused(volt, ts)?.name;
            // for another kind, its number and the counts per unit precede the numbers
            let place = self.design.place_of(name).map(|place| place + 2);
            Some(place.unwrap_or_else(|| index_of(name)))
        };
        Refusal::value(SCHEDULE).unless(!self.garbled)?;
        if let Some(field) = refused(f32::INFINITY) {
            return Err(Refusal::value(field));
        }
        let unit = self.counts_per_unit * ts;
        // with a feedback that is not finite the controller would be blind
        let holds = unit > 0.0 && unit.is_finite() && (MOST_COUNTS / unit).is_finite();
        Refusal::value(if self.are_pid() { 11 } else { 1 }).unless(holds)?;
        refused(volt).map_or(Ok(()), |field| Err(Refusal::limit(field)))
    }

    /// The reason why no controller can be made; a separate function, as the controller's parts fill much of a stack.
    #[inline(never)]
    pub(super) fn refused(&self, volt: f32, ts: f32) -> Option<Refused> {
        let mut design = self.design;
        design.bound(volt, ts);
        design.check().err()
    }
}

/// The index of the number of points; it represents all points.
const SCHEDULE: u32 = 15;

/// The index of a setting among the fields of GAINS.
fn index_of(name: &str) -> u32 {
    match name {
        "Kp" => 0,
        "Ti" => 1,
        "Td" => 2,
        "alpha" => 3,
        "beta" => 4,
        "N" => 5,
        "Tt" => 6,
        "u_min" => 7,
        "u_max" => 8,
        "slew" => 9,
        "filter_time" => 10,
        "observer_time" => 13,
        "r_rate" => 14,
        "schedule" => SCHEDULE,
        _ => 12,
    }
}

/// How a run goes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Start {
    pub(super) mode: u8,
    pub(super) watchdog: u32,
    pub(super) at: u64,
    pub(super) length: u32,
    pub(super) mask: u16,
    pub(super) batch: u8,
}

/// A command with its fields, of the right length but otherwise unchecked.
#[derive(Clone, Copy, Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "there is no heap to box it on, and one command lives at a time"
)]
pub(super) enum Command<'a> {
    Hello {
        from: u8,
        to: u8,
        session: u32,
    },
    Describe {
        channel: u8,
    },
    Status,
    Limits(Limits),
    Arm {
        watchdog: u32,
        key: u32,
    },
    Stop,
    Clear,
    Upload(Upload<'a>),
    Gains(Gains),
    Start(Start),
    Echo(&'a [u8]),
    /// The number of sections and, if valid, the sections.
    Biquads(Result<Cascade<f32>, Refusal>),
    /// The feedforward if it is valid.
    Feedforward(Result<Feedforward<f32>, Refusal>),
    /// A command of positions, which only a device that has them reads.
    Positions {
        kind: u8,
        body: &'a [u8],
    },
}

impl<'a> Command<'a> {
    /// # Errors
    /// An unknown kind, a body of the wrong length.
    pub(super) fn of(kind: u8, body: &'a [u8]) -> Result<Self, Refusal> {
        let mut fields = Fields::new(body);
        let command = match kind {
            HELLO => hello(&mut fields),
            0x02 => fields.u8().map(|channel| Self::Describe { channel }),
            0x03 => Some(Self::Status),
            0x04 => limits(&mut fields),
            0x05 => arm(&mut fields),
            STOP => Some(Self::Stop),
            0x07 => Some(Self::Clear),
            0x08 => upload(&mut fields),
            0x09 => gains(&mut fields),
            0x0A => start(&mut fields),
            0x0B => Some(Self::Echo(fields.rest())).filter(|_| body.len() <= MAX_ECHO),
            0x0C => biquads(&mut fields).map(Self::Biquads),
            0x0D => controller(&mut fields)?,
            0x0E => feedforward(&mut fields).map(Self::Feedforward),
            positions::POSITION | positions::ANGLE | positions::TRAVEL => Some(Self::Positions {
                kind,
                body: fields.rest(),
            }),
            _ => return Err(Refusal::unknown(kind)),
        };
        let whole = command.filter(|_| fields.is_empty());
        whole.ok_or(Refusal::length(body))
    }
}

fn hello<'a>(fields: &mut Fields<'a>) -> Option<Command<'a>> {
    Some(Command::Hello {
        from: fields.u8()?,
        to: fields.u8()?,
        session: fields.u32()?,
    })
}

fn arm<'a>(fields: &mut Fields<'a>) -> Option<Command<'a>> {
    Some(Command::Arm {
        watchdog: fields.u32()?,
        key: fields.u32()?,
    })
}

fn limits<'a>(fields: &mut Fields<'a>) -> Option<Command<'a>> {
    Some(Command::Limits(Limits {
        volt: fields.f32()?,
        speed: fields.f32()?,
        acceleration: fields.f32()?,
        current: fields.f32()?,
    }))
}

fn upload<'a>(fields: &mut Fields<'a>) -> Option<Command<'a>> {
    let (table, offset) = (fields.u8()?, fields.u32()?);
    let values = fields.rest();
    // an unknown table is refused for that reason
    let width = if table == 0 { 2 } else { 4 };
    let whole = values.len() & (width - 1) == 0;
    whole.then_some(Command::Upload(Upload {
        table,
        offset,
        values,
    }))
}

fn gains<'a>(fields: &mut Fields<'a>) -> Option<Command<'a>> {
    let gains = standard(fields)?;
    let settings = Settings {
        gains,
        alpha: fields.f32()?,
        beta: fields.f32()?,
        n: fields.f32()?,
        tt: fields.f32()?,
        u_min: fields.f32()?,
        u_max: fields.f32()?,
        slew: fields.f32()?,
        ts: 0.0,
    };
    let (filter_time, counts_per_unit) = (fields.f32()?, fields.f32()?);
    let mut design = Design {
        filter_time,
        filter_samples: fields.u8()?.into(),
        ..Design::new(settings)
    };
    let (mut garbled, long) = (false, !fields.is_empty());
    if long {
        design.observer_time = fields.f32()?;
        design.r_rate = fields.f32()?;
        match schedule(fields)? {
            Ok(schedule) => design.schedule = schedule,
            Err(_) => garbled = true,
        }
    }
    Some(Command::Gains(Gains {
        design: design.into(),
        garbled,
        long,
        counts_per_unit,
        position: None,
    }))
}

fn standard(fields: &mut Fields<'_>) -> Option<Standard<f32>> {
    Some(Standard {
        kp: fields.f32()?,
        ti: fields.f32()?,
        td: fields.f32()?,
    })
}

/// A controller of another kind replaces the PID's gains.
fn controller<'a>(fields: &mut Fields<'a>) -> Result<Option<Command<'a>>, Refusal> {
    let (Some(kind), Some(counts_per_unit)) = (fields.u8(), fields.f32()) else {
        return Ok(None);
    };
    let whole = fields.len();
    let design = AnyDesign::from_numbers(kind, || fields.f32());
    // an unknown kind: nothing of it was read
    Refusal::value(0).unless(design.is_some() || whole == 0 || fields.len() < whole)?;
    Ok(design.map(|design| {
        Command::Gains(Gains {
            design,
            garbled: false,
            long: false,
            counts_per_unit,
            position: None,
        })
    }))
}

/// `None` if the body is too short for its points.
fn schedule(fields: &mut Fields<'_>) -> Option<Result<Schedule<f32>, Refused>> {
    let count = usize::from(fields.u8()?);
    let blank = Point {
        speed: 0.0,
        gains: Standard {
            kp: 0.0,
            ti: 0.0,
            td: 0.0,
        },
    };
    // room for one point too many, which is refused like any larger number
    let mut points = [blank; POINTS + 1];
    for place in points.iter_mut().take(count) {
        *place = Point {
            speed: fields.f32()?,
            gains: standard(fields)?,
        };
    }
    fields.take(16 * count.saturating_sub(points.len()))?;
    let named = points.get(..count).unwrap_or(&points);
    Some(Schedule::new(named))
}

/// `None` if the body is too short for its sections.
fn biquads(fields: &mut Fields<'_>) -> Option<Result<Cascade<f32>, Refusal>> {
    let count = usize::from(fields.u8()?);
    let mut sections = [Biquad::NONE; BIQUADS];
    let Some(named) = sections.get_mut(..count) else {
        fields.take(16 * count)?;
        return Some(Err(Refusal::value(0)));
    };
    let mut good = Ok(());
    for (index, section) in (0u32..).zip(&mut *named) {
        *section = Biquad {
            c0: fields.f32()?,
            c1: fields.f32()?,
            a1: fields.f32()?,
            a2: fields.f32()?,
        };
        let alone = Cascade::new(core::slice::from_ref(section));
        good = good.and(alone.map(drop).map_err(|_| Refusal::value(1 + 4 * index)));
    }
    let whole = Cascade::new(named).map_err(|_| Refusal::value(0));
    Some(good.and(whole))
}

/// `None` if the body is too short for its levels and taps.
fn feedforward(fields: &mut Fields<'_>) -> Option<Result<Feedforward<f32>, Refusal>> {
    let (preview, late) = (fields.u8()?, fields.f32()?);
    // room for one too many of each, which is refused like any larger number
    let mut levels = [Level { y: 0.0, u: 0.0 }; LEVELS + 1];
    let level_count = usize::from(fields.u8()?);
    for place in levels.iter_mut().take(level_count) {
        *place = Level {
            y: fields.f32()?,
            u: fields.f32()?,
        };
    }
    fields.take(8 * level_count.saturating_sub(levels.len()))?;
    let mut taps = [0.0; TAPS + 1];
    let tap_count = usize::from(fields.u8()?);
    for place in taps.iter_mut().take(tap_count) {
        *place = fields.f32()?;
    }
    fields.take(4 * tap_count.saturating_sub(taps.len()))?;
    if level_count == 0 && tap_count == 0 {
        return Some(Ok(Feedforward::NONE));
    }
    let made = Feedforward::new(
        preview.into(),
        late,
        levels.get(..level_count).unwrap_or(&levels),
        taps.get(..tap_count).unwrap_or(&taps),
    );
    Some(made.map_err(|_| Refusal::value(0)))
}

fn start<'a>(fields: &mut Fields<'a>) -> Option<Command<'a>> {
    Some(Command::Start(Start {
        mode: fields.u8()?,
        watchdog: fields.u32()?,
        at: fields.u64()?,
        length: fields.u32()?,
        mask: fields.u16()?,
        batch: fields.u8()?,
    }))
}

/// # Errors
/// A time out of its range, with the index of its field.
pub(super) fn check_watchdog(time: u32, index: u32) -> Result<(), Refusal> {
    Refusal::value(index).unless(WATCHDOG.contains(&time))
}

/// What a heartbeat adds to its watchdog time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Beat {
    Keep,
    Drive(f32),
    Credit(u64),
}

/// A heartbeat: how long the device may go on, and what else.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Heartbeat {
    pub(super) watchdog: u32,
    pub(super) beat: Beat,
}

impl Heartbeat {
    /// `None` if kind, length or a value is wrong.
    pub(super) fn of(kind: u8, body: &[u8]) -> Option<Self> {
        let mut fields = Fields::new(body);
        let watchdog = fields.u32().filter(|time| WATCHDOG.contains(time))?;
        let beat = match kind {
            0x20 => Beat::Keep,
            0x21 => Beat::Drive(fields.f32().filter(|u| u.is_finite())?),
            0x22 => Beat::Credit(fields.u64()?),
            _ => return None,
        };
        fields.end()?;
        Some(Self { watchdog, beat })
    }
}
