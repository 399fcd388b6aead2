//! Positions: what a run in progress steps, and the commands POSITION, ANGLE and TRAVEL.

use super::command::{Gains, Refusal};
use super::identity::{Limits, Travel};
use super::wire::Fields;
use crate::{AnyController, Controller, FARTHEST, PositionDesign, RATES, Rate, Rates, Turning};

/// Whether the device can run a position loop: without it none of its code is linked.
pub(super) const HAS: bool = cfg!(feature = "positions");

/// The kinds of its commands.
pub(super) const POSITION: u8 = 0x0F;
pub(super) const ANGLE: u8 = 0x10;
pub(super) const TRAVEL: u8 = 0x11;

/// What a run steps at every sample.
#[derive(Clone, Debug)]
#[cfg_attr(
    feature = "positions",
    expect(
        clippy::large_enum_variant,
        reason = "there is no heap to box it on, and one run lives at a time"
    )
)]
pub(super) enum Law {
    Speed(AnyController<f32>),
    #[cfg(feature = "positions")]
    Position(Turning),
}

impl Law {
    /// From reference and counts since the last sample to the command; `unit` are the counts of a sample at a feedback of 1.
    #[inline]
    pub(super) fn step(&mut self, reference: f32, moved: i32, unit: f32) -> f32 {
        match self {
            Self::Speed(controller) => controller.step(reference, moved as f32 / unit),
            #[cfg(feature = "positions")]
            Self::Position(turning) => turning.step(reference, moved),
        }
    }

    /// Least and largest command.
    pub(super) fn limits(&self) -> (f32, f32) {
        match self {
            Self::Speed(controller) => controller.limits(),
            #[cfg(feature = "positions")]
            Self::Position(turning) => turning.limits(),
        }
    }

    /// The feedback after its filter.
    pub(super) fn filtered(&self) -> f32 {
        match self {
            Self::Speed(controller) => controller.filtered(),
            #[cfg(feature = "positions")]
            Self::Position(turning) => turning.filtered(),
        }
    }

    /// The position loop; `None` for a controller without one.
    pub(super) fn position(&mut self) -> Option<&mut Turning> {
        match self {
            #[cfg(feature = "positions")]
            Self::Position(turning) => Some(turning),
            Self::Speed(_) => None,
        }
    }
}

impl Gains {
    /// Makes what a run steps, in its place, if all settings are within their ranges: goals follow in mode 3, elsewhere references
    /// are speeds.
    pub(super) fn begin(&self, law: &mut Option<Law>, volt: f32, ts: f32, mode: u8) {
        #[cfg(not(feature = "positions"))]
        let _ = mode;
        *law = match (self.position, self.controller(volt, ts)) {
            #[cfg(feature = "positions")]
            (Some(design), Ok(AnyController::Pid(speed))) => {
                if design.check().is_err() {
                    return;
                }
                let law = crate::PositionLoop::checked(design, speed);
                Some(Law::Position(Turning::new(law)))
            }
            (_, Ok(speed)) => Some(Law::Speed(speed)),
            _ => None,
        };
        #[cfg(feature = "positions")]
        if let (3, Some(Law::Position(turning))) = (mode, law) {
            turning.follow();
        }
    }

    /// A position loop from the next start on; GAINS has none.
    pub(super) fn set_position(&mut self, position: PositionDesign<f32>) {
        self.position = Some(PositionDesign {
            counts_per_unit: self.counts_per_unit,
            ..position
        });
    }

    /// Whether the moves of a position loop keep within the limits of speed and acceleration.
    pub(super) fn moves_within(
        &self,
        design: &PositionDesign<f32>,
        limits: &Limits,
        counts_per_rev: f32,
    ) -> bool {
        // what single precision loses of the unit is no excess
        let per_unit = 1.000_001 * counts_per_rev / (60.0 * self.counts_per_unit);
        let (most, rate) = (limits.speed * per_unit, limits.acceleration * per_unit);
        let mut rows = design.rates.rows().iter();
        design.speed <= most && rows.all(|row| row.up <= rate && row.down <= rate)
    }
}

/// A command of positions with its fields, of the right length but otherwise unchecked.
pub(super) enum Wish {
    /// The position loop if it is valid, but without its counts per unit.
    Position(Result<PositionDesign<f32>, Refusal>),
    Angle(Result<Asked, Refusal>),
    Travel(Travel),
}

impl Wish {
    /// # Errors
    /// An unknown kind, a body of the wrong length.
    pub(super) fn of(kind: u8, body: &[u8]) -> Result<Self, Refusal> {
        let mut fields = Fields::new(body);
        let wish = match kind {
            POSITION => design(&mut fields).map(Self::Position),
            ANGLE => angle(&mut fields).map(Self::Angle),
            TRAVEL => travel(&mut fields).map(Self::Travel),
            _ => return Err(Refusal::unknown(kind)),
        };
        let whole = wish.filter(|_| fields.is_empty());
        whole.ok_or(Refusal::length(body))
    }
}

/// The body of POSITION, without the counts per unit, which are those of the gains; `None` if it is too short.
fn design(fields: &mut Fields<'_>) -> Option<Result<PositionDesign<f32>, Refusal>> {
    let (gain, speed) = (fields.f32()?, fields.f32()?);
    let (landing, creep) = (fields.f32()?, fields.f32()?);
    let (smoothing, releases) = (fields.u8()?, fields.u8()?);
    let count = usize::from(fields.u8()?);
    let none = Rate {
        speed: 0.0,
        up: 0.0,
        down: 0.0,
    };
    // room for one row too many, which is refused like any larger number
    let mut rows = [none; RATES + 1];
    for place in rows.iter_mut().take(count) {
        *place = Rate {
            speed: fields.f32()?,
            up: fields.f32()?,
            down: fields.f32()?,
        };
    }
    fields.take(12 * count.saturating_sub(rows.len()))?;
    let made = Rates::new(rows.get(..count).unwrap_or(&rows)).and_then(|rates| {
        let design = PositionDesign {
            gain,
            counts_per_unit: 1.0,
            speed,
            rates,
            smoothing: smoothing.into(),
            landing,
            creep,
            releases: releases == 1,
        };
        design.check().map(|()| design)
    });
    let known = Refusal::value(0).unless(releases <= 1);
    Some(known.and(made.map_err(|_| Refusal::value(0))))
}

/// A stop at an angle that a host has asked for and that has not begun.
#[derive(Clone, Copy, Debug)]
pub(super) struct Asked {
    /// The sample with which it begins; 0 for the next one.
    pub(super) at: u32,
    pub(super) angle: f32,
    pub(super) onward: bool,
}

/// The body of ANGLE; `None` if it is too short.
fn angle(fields: &mut Fields<'_>) -> Option<Result<Asked, Refusal>> {
    let (at, angle, way) = (fields.u32()?, fields.f32()?, fields.u8()?);
    let asked = Asked {
        at,
        angle,
        onward: way == 0,
    };
    let near = Refusal::value(1).unless(angle.abs() <= FARTHEST);
    Some(near.and(Refusal::value(2).unless(way <= 1)).map(|()| asked))
}

/// The body of TRAVEL; `None` if it is too short.
fn travel(fields: &mut Fields<'_>) -> Option<Travel> {
    Some(Travel {
        low: fields.i32()?,
        high: fields.i32()?,
    })
}

impl Travel {
    /// Both 0 asks for the one in force.
    pub(super) const ASK: Self = Self { low: 0, high: 0 };

    /// # Errors
    /// Limits that leave no room, or that are beyond the device's `own`.
    pub(super) fn check(&self, own: &Self) -> Result<(), Refusal> {
        Refusal::value(1).unless(self.low < self.high)?;
        Refusal::limit(0).unless(self.low >= own.low)?;
        Refusal::limit(1).unless(self.high <= own.high)
    }
}
