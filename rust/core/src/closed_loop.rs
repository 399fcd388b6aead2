//! A controller and a plant in closed loop, with encoder, feedback filter and limits inside the loop.

mod plants;

pub use plants::{LaggedPlant, Varied};

use sewfast_control::{Controller, Refused};

use crate::{Error, Result};

/// What a controller can be closed around: one input, one output, stepped sample by sample.
pub trait Plant {
    /// Back to rest; position back to zero.
    fn reset(&mut self);
    /// The true output at this instant, in its unit.
    fn output(&self) -> f64;
    /// The integral of the output over time [unit s]: what an encoder sees.
    fn position(&self) -> f64;
    /// Holds `u` for one sample time.
    fn advance(&mut self, u: f64);
    /// Counts of an encoder of the plant's own and counts per unit second; `None` where it has none.
    fn encoder(&self) -> Option<(f64, f64)> {
        None
    }
}

/// How the output is measured where the plant has no encoder of its own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Sensor {
    /// The output itself.
    Ideal,
    /// Differences of `floor(position * counts_per_unit + phase)`, as a drive's encoder gives them.
    Encoder {
        /// Counts per output unit and second: 1572/60 for speed in RPM and 1,572 counts per turn.
        counts_per_unit: f64,
        /// Where in a count the run starts, 0 to 1.
        phase: f64,
    },
}

impl Sensor {
    /// An encoder, or the ideal sensor where `counts_per_unit` is 0.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for counts that are negative or not finite, or a phase outside 0 to 1.
    pub fn new(counts_per_unit: f64, phase: f64) -> Result<Self> {
        if !(counts_per_unit >= 0.0 && counts_per_unit.is_finite() && (0.0..=1.0).contains(&phase))
        {
            return Err(Error::setting(format!(
                "expected counts per unit of 0 or more and a phase of 0 to 1, got {counts_per_unit} and {phase}; give \
                 0 counts for feedback without quantisation"
            )));
        }
        let encoder = Self::Encoder {
            counts_per_unit,
            phase,
        };
        Ok(if counts_per_unit == 0.0 {
            Self::Ideal
        } else {
            encoder
        })
    }

    /// Counts and counts per unit second; `None` without an encoder.
    fn counts(self, plant: &(impl Plant + ?Sized)) -> Option<(f64, f64)> {
        plant.encoder().or(match self {
            Self::Ideal => None,
            Self::Encoder {
                counts_per_unit,
                phase,
            } => Some((
                (plant.position() * counts_per_unit + phase).floor(),
                counts_per_unit,
            )),
        })
    }
}

/// How a run ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Outcome {
    /// The whole reference was run.
    #[default]
    Completed,
    /// The output left the finite numbers, or all bounds, at this sample; the record ends before it.
    Diverged(usize),
}

/// No drive's output is that large in any unit.
const RUNAWAY: f64 = 1e15;

/// The record of a run; entry `k` is what was measured and decided at sample `k`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Run {
    /// Command after the limits.
    pub u: Vec<f64>,
    /// True output.
    pub y: Vec<f64>,
    /// Measured output after the feedback filter.
    pub feedback: Vec<f64>,
    /// How the run ended.
    pub outcome: Outcome,
}

impl Run {
    /// An empty record with room for `samples`.
    pub fn with_capacity(samples: usize) -> Self {
        let room = || Vec::with_capacity(samples);
        Self {
            u: room(),
            y: room(),
            feedback: room(),
            outcome: Outcome::Completed,
        }
    }

    /// Runs the loop from rest over `reference` into this record, whose memory is used again.
    ///
    /// Order at a sample: measure, filter, control, limit, apply.
    pub fn record(
        &mut self,
        plant: &mut (impl Plant + ?Sized),
        controller: &mut Controller<f64>,
        reference: &[f64],
        sensor: Sensor,
    ) {
        self.clear();
        plant.reset();
        controller.reset();
        let ts = controller.settings().ts;
        let mut before = sensor.counts(plant);
        for (k, &r) in reference.iter().enumerate() {
            let (y, now) = (plant.output(), sensor.counts(plant));
            let measured = match (before, now) {
                (Some((before, _)), Some((now, scale))) => (now - before) / (ts * scale),
                _ => y,
            };
            before = now;
            if !(y.abs() < RUNAWAY && measured.is_finite()) {
                self.outcome = Outcome::Diverged(k);
                return;
            }
            let u = controller.step(r, measured);
            self.u.push(u);
            self.y.push(y);
            self.feedback.push(controller.filtered());
            plant.advance(u);
        }
    }

    fn clear(&mut self) {
        self.u.clear();
        self.y.clear();
        self.feedback.clear();
        self.outcome = Outcome::Completed;
    }
}

/// Runs `controller` on `plant` over `reference`, from rest.
///
/// # Errors
/// `ErrorKind::Data` for a reference that is empty or not finite. A loop that diverges is an [`Outcome`], not an error.
pub fn closed_loop(
    plant: &mut (impl Plant + ?Sized),
    controller: &mut Controller<f64>,
    reference: &[f64],
    sensor: Sensor,
) -> Result<Run> {
    check_reference(reference)?;
    let mut run = Run::with_capacity(reference.len());
    run.record(plant, controller, reference, sensor);
    Ok(run)
}

/// Refuses a reference that cannot be run.
///
/// # Errors
/// `ErrorKind::Data` for a reference that is empty or not finite.
pub fn check_reference(reference: &[f64]) -> Result<()> {
    if reference.is_empty() {
        return Err(Error::data(
            "expected a reference with samples, got an empty one",
        ));
    }
    match reference.iter().position(|r| !r.is_finite()) {
        None => Ok(()),
        Some(k) => Err(Error::data(format!(
            "expected finite values in the reference, got {} at sample {k}; fill or cut it there",
            reference[k]
        ))),
    }
}

impl From<Refused> for Error {
    fn from(refused: Refused) -> Self {
        Self::setting(format!("{refused}; change that setting"))
    }
}

#[cfg(test)]
mod tests;
