//! The way of a reference through ramp and feedforward, taken before a loop: no loop around a plant has to know of it.

use sewfast_control::{AnyController, PidController};

use super::Signals;

/// What a controller with feedforward makes of a reference, and the rest of the controller.
#[derive(Clone, Debug)]
pub(crate) struct Lead {
    setpoint: Vec<f64>,
    feedforward: Vec<f64>,
    /// The controller without ramp and feedforward.
    pub rest: PidController<f64>,
}

impl Lead {
    /// `None` for a controller without feedforward. `first` gives the measurement at which a ramp begins.
    pub fn of(
        controller: &AnyController<f64>,
        signals: Signals<'_>,
        first: impl FnOnce() -> f64,
    ) -> Option<Self> {
        let pid = controller.pid().filter(|pid| Self::has_feedforward(pid))?;
        let rest = PidController::new(pid.without_lead()).ok()?;
        let (preview, r) = (pid.design().feedforward.preview(), signals.reference);
        let mut way = PidController::new(*pid.design()).ok()?;
        let filtered = way.first_filtered(first());
        let (mut setpoint, mut feedforward) =
            (Vec::with_capacity(r.len()), Vec::with_capacity(r.len()));
        for k in 0..r.len() {
            let (expected, own) = way.lead(r[(k + preview).min(r.len() - 1)], filtered);
            let own = own.unwrap_or(0.0);
            setpoint.push(expected);
            feedforward.push(signals.feedforward_at(k).map_or(own, |added| added + own));
        }
        Some(Self {
            setpoint,
            feedforward,
            rest,
        })
    }

    /// The signals of the loop that is left.
    pub fn signals<'a>(&'a self, of: Signals<'a>) -> Signals<'a> {
        Signals {
            setpoint: Some(&self.setpoint),
            feedforward: Some(&self.feedforward),
            ..of
        }
    }

    /// Whether a controller has feedforward.
    pub fn has_feedforward(pid: &PidController<f64>) -> bool {
        !pid.design().feedforward.is_none()
    }

    /// Whether two controllers make the same of every reference, whatever is measured.
    pub fn is_shared(one: &PidController<f64>, other: &PidController<f64>) -> bool {
        let (one, other) = (one.design(), other.design());
        // a ramp begins at the first measurement, which has noise
        one.feedforward == other.feedforward
            && (one.r_rate, other.r_rate) == (f64::INFINITY, f64::INFINITY)
            && one.filter_samples == other.filter_samples
            && (one.filter_time, one.observer_time) == (other.filter_time, other.observer_time)
    }
}
