//! Runs of a position loop on a plant: a speed and then a stop at an angle, or goals one after the other; and what a search
//! for its gain asks of such runs.

use std::thread::available_parallelism;

use sewfast_control::{
    AnyDesign, PidController, PositionDesign, PositionLoop, RATES, Rate, Rates, Refused,
};

use crate::closed_loop::{Plant, check_reference, counts};
use crate::model::ClonePlant;
use crate::moves::each;
use crate::profile::Reach;
use crate::speed::Encoder;
use crate::{Error, Monitor, Result};

/// No drive's output is that large in any unit.
const RUNAWAY: f64 = 1e15;
/// Samples between two checks for a stop request.
const WATCHED: usize = 2048;

/// A stop at an angle, in counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stop {
    /// Samples of speed before it.
    pub after: usize,
    /// The angle.
    pub angle: f64,
    /// Counts of a turn.
    pub turn: f64,
    /// Whether the shaft must not turn back.
    pub onward: bool,
}

/// A position loop with what it is to do, sample by sample, on a model, a simulated machine or a real one.
#[derive(Clone, Debug)]
pub struct Scripted {
    law: PositionLoop<f64>,
    stop: Option<Stop>,
    k: usize,
}

impl Scripted {
    /// A loop that goes from goal to goal or, with a stop, runs at a speed and then stops.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for the first setting that is outside its range, or a speed loop that is no PID.
    pub fn new(
        design: PositionDesign<f64>,
        speed: &AnyDesign<f64>,
        stop: Option<Stop>,
    ) -> Result<Self> {
        let pid = speed.pid().ok_or_else(|| {
            Error::setting("expected a PID as speed loop, got another kind; tune a PID")
        })?;
        let law = PositionLoop::new(design, PidController::new(*pid)?)?;
        let mut made = Self { law, stop, k: 0 };
        made.reset();
        Ok(made)
    }

    /// Back to before the first sample.
    pub fn reset(&mut self) {
        self.law.reset();
        self.k = 0;
        if self.stop.is_none() {
            self.law.follow();
        }
    }

    /// From the reference of this sample, a speed \[y\] or a goal \[counts\], both early, and the counts since the last one to
    /// the command.
    ///
    /// # Errors
    /// `ErrorKind::Setting` if the stop is refused at this speed, `ErrorKind::Data` for counts that were lost: nobody knows where
    /// the shaft is then.
    pub fn step(&mut self, reference: f64, moved: f64) -> Result<f64> {
        if !moved.is_finite() {
            return Err(Error::data(format!(
                "expected counts at every sample, got none at sample {}; the position is lost: find the reference mark again",
                self.k
            )));
        }
        if let Some(stop) = self.stop
            && stop.after == self.k
        {
            self.law.stop(stop.angle, stop.turn, stop.onward)?;
        }
        self.k += 1;
        Ok(self.law.step(reference, moved))
    }

    /// The stop that it makes.
    pub fn stop(&self) -> Option<Stop> {
        self.stop
    }

    /// The loop itself.
    pub fn law(&self) -> &PositionLoop<f64> {
        &self.law
    }
}

/// The record of a run; entry `k` is the sample `k`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PositionRun {
    /// Command after the limits \[u\].
    pub u: Vec<f64>,
    /// True output \[y\].
    pub y: Vec<f64>,
    /// Measured output after the feedback filter \[y\].
    pub feedback: Vec<f64>,
    /// The encoder's counts.
    pub counts: Vec<f64>,
    /// True position \[counts\].
    pub position: Vec<f64>,
    /// What the loop compares the counts with \[counts\]; NaN while it is a speed loop.
    pub place: Vec<f64>,
    /// The goal \[counts\]; NaN while it is a speed loop.
    pub goal: Vec<f64>,
}

/// Runs a loop from rest over references that are not yet early; `disturbance` is a command added after the limits.
///
/// # Errors
/// `ErrorKind::Data` for a reference that is empty or not finite, `ErrorKind::Setting` for a plant without an encoder or a stop
/// that is refused, `ErrorKind::Fit` for a loop that diverges or is interrupted.
pub fn run(
    plant: &mut (impl Plant + ?Sized),
    scripted: &mut Scripted,
    reference: &[f64],
    encoder: Option<&Encoder>,
    disturbance: Option<&[f64]>,
    monitor: &Monitor,
) -> Result<PositionRun> {
    check_reference(reference)?;
    let early = early(scripted, reference);
    plant.reset();
    scripted.reset();
    let design = *scripted.law().design();
    let ts = scripted.law().speed().settings().ts;
    let mut found = PositionRun::default();
    let read = |plant: &_, since| {
        counts(plant, encoder, since).ok_or_else(|| {
            Error::setting("expected an encoder in the loop, got none; give counts_per_rev")
        })
    };
    let (first, mut before) = (read(plant, 0.0)?, read(plant, -ts)?);
    for (k, &r) in early.iter().enumerate() {
        let (y, now) = (plant.output(), read(plant, 0.0)?);
        if !(y.abs() < RUNAWAY && now.is_finite()) {
            return Err(Error::fit(format!(
                "expected a loop that stays finite, got one that diverged at {:.4} s; take a smaller position gain",
                k as f64 * ts
            )));
        }
        if k % WATCHED == 0 && monitor.stopped() {
            return Err(Error::fit("the run was interrupted"));
        }
        let u = scripted.step(r, now - before)?;
        before = now;
        let law = scripted.law();
        let is_speed = scripted.stop.is_some_and(|stop| k < stop.after);
        let told = |value: f64| if is_speed { f64::NAN } else { value };
        found.u.push(u);
        found.y.push(y);
        found.feedback.push(law.filtered());
        found.counts.push(now - first);
        found
            .position
            .push(plant.position() * design.counts_per_unit);
        found.place.push(told(law.place()));
        found.goal.push(told(law.goal()));
        plant.advance(disturbance.map_or(u, |added| u + added.get(k).copied().unwrap_or(0.0)));
    }
    Ok(found)
}

/// The reference as a step takes it: early by the preview of the speed loop or of the position; the last value stays.
pub fn early(scripted: &Scripted, reference: &[f64]) -> Vec<f64> {
    let law = scripted.law();
    let ahead = match scripted.stop {
        Some(_) => law.speed().design().feedforward.preview(),
        None => law.early(),
    };
    let last = reference.len().saturating_sub(1);
    // goals before the move began are that of its first sample
    (0..reference.len())
        .map(|k| reference[(k + ahead).min(last)])
        .collect()
}

/// The rates of a reach from rest on, over speeds in either direction: the least of each interval of speeds. Where the models know
/// one direction only, it stands for both.
///
/// # Errors
/// `ErrorKind::Fit` for a reach that moves nowhere.
pub fn rates(reach: &Reach) -> Result<(Rates<f64>, f64)> {
    let top = reach.high.max(-reach.low);
    let width = top / RATES as f64;
    let mut rows = Vec::with_capacity(RATES);
    for i in 0..RATES {
        let (from, to) = (i as f64 * width, (i + 1) as f64 * width);
        let (mut up, mut down) = (f64::INFINITY, f64::INFINITY);
        for side in [1.0, -1.0] {
            let end = if side > 0.0 { reach.high } else { -reach.low };
            if end <= from {
                continue;
            }
            let inside = reach.levels.iter().map(|level| side * level);
            for at in inside.filter(|v| (from..=to).contains(v)).chain([from, to]) {
                let (more, less) = reach.at(side * at.min(end));
                let (away, back) = if side > 0.0 {
                    (more, less)
                } else {
                    (less, more)
                };
                (up, down) = (up.min(away), down.min(back));
            }
        }
        rows.push(Rate {
            speed: from,
            up,
            down,
        });
    }
    let refused = |e: Refused| {
        Error::fit(format!(
            "expected models that come to a speed and back to rest within their limits, got {}; give wider limits",
            e.received
        ))
    };
    Ok((Rates::new(&rows).map_err(refused)?, top))
}

/// A reference that comes up to a speed at the rates and holds it for so many samples \[y\].
pub fn approach(rates: &Rates<f64>, speed: f64, hold: usize, ts: f64) -> Vec<f64> {
    let (mut r, mut v) = (vec![0.0], 0.0_f64);
    while v < speed.abs() {
        let mut rows = rates.rows().iter().filter(|row| row.speed <= v);
        let up = rows.next_back().map_or(f64::INFINITY, |row| row.up);
        v = (v + up * ts).min(speed.abs());
        r.push(v.copysign(speed));
    }
    r.extend(std::iter::repeat_n(speed, hold));
    r
}

/// What runs that end with a stop show, over all plants; in counts.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Judged {
    /// Error of the position after the profile, rms over the stops and the worst of all plants; infinite for a loop that diverges.
    pub error: f64,
    /// How far the goal that a stop began with was passed, at most: by a turn if it went on to a later one.
    pub past: f64,
    /// How far from the goal a shaft rests, at most.
    pub off: f64,
    /// Peak to peak over the last quarter of a stop, at most.
    pub swing: f64,
    /// Deviation under the load while the loop holds a position, rms, of the plant that gives way most.
    pub yields: f64,
}

/// The stops of a search: from these speeds \[y\] to this angle, held for so many samples before and followed for so many after.
#[derive(Clone, Debug, PartialEq)]
pub struct Stops {
    /// Speeds \[y\].
    pub speeds: Vec<f64>,
    /// See [`Stop`].
    pub turn: f64,
    /// Samples at the speed.
    pub before: usize,
    /// Samples from the stop on.
    pub after: usize,
    /// A command that is added after the limits while the loop holds a position \[u\].
    pub load: f64,
}

/// Stops of each design on all plants.
///
/// # Errors
/// As [`run`], but for a loop that diverges.
pub fn judge(
    plants: &[Box<dyn ClonePlant + '_>],
    designs: &[PositionDesign<f64>],
    speed: &AnyDesign<f64>,
    stops: &Stops,
    encoder: Option<&Encoder>,
    monitor: &Monitor,
) -> Result<Vec<Judged>> {
    let threads = available_parallelism().map_or(1, usize::from);
    let jobs: Vec<(usize, usize)> = (0..designs.len())
        .flat_map(|i| (0..plants.len()).map(move |j| (i, j)))
        .collect();
    let found = each(&jobs, threads, |&(i, j)| {
        stopped(&*plants[j], designs[i], speed, stops, encoder, monitor)
    });
    let mut judged = vec![Judged::default(); designs.len()];
    for (&(i, _), one) in jobs.iter().zip(found) {
        let (all, one) = (&mut judged[i], one?);
        all.error = all.error.max(one.error);
        all.past = all.past.max(one.past);
        all.off = all.off.max(one.off);
        all.swing = all.swing.max(one.swing);
        all.yields = all.yields.max(one.yields);
    }
    Ok(judged)
}

/// The stops of one design on one plant.
fn stopped(
    plant: &dyn ClonePlant,
    design: PositionDesign<f64>,
    speed: &AnyDesign<f64>,
    stops: &Stops,
    encoder: Option<&Encoder>,
    monitor: &Monitor,
) -> Result<Judged> {
    let (mut judged, mut squares, mut samples) = (Judged::default(), 0.0, 0);
    for (i, &from) in stops.speeds.iter().enumerate() {
        let mut reference = approach(&design.rates, from, stops.before, speed.ts());
        let stop = Stop {
            after: reference.len(),
            // another part of the turn each time
            angle: stops.turn * i as f64 / stops.speeds.len() as f64,
            turn: stops.turn,
            onward: true,
        };
        reference.resize(stop.after + stops.after, from);
        let mut scripted = Scripted::new(design, speed, Some(stop))?;
        let mut own = plant.copied();
        let run = run(&mut *own, &mut scripted, &reference, encoder, None, monitor);
        if monitor.stopped() {
            return Err(Error::fit("the search was interrupted"));
        }
        let Ok(run) = run else {
            judged.error = f64::INFINITY;
            return Ok(judged);
        };
        let from = stop.after;
        let goal = run.goal[from];
        let way = (goal - run.position[from]).signum();
        let last = run.position.len() - stops.after.div_ceil(4);
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for (k, position) in run.position.iter().enumerate().skip(from) {
            squares += (run.place[k] - position).powi(2);
            samples += 1;
            judged.past = judged.past.max(way * (position - goal));
            if k >= last {
                (low, high) = (low.min(*position), high.max(*position));
            }
        }
        judged.swing = judged.swing.max(high - low);
        judged.off = judged.off.max((low - goal).abs()).max((high - goal).abs());
    }
    judged.error = (squares / samples.max(1) as f64).sqrt();
    let (mut scripted, mut own) = (Scripted::new(design, speed, None)?, plant.copied());
    let (still, load) = (vec![0.0; stops.after], vec![stops.load; stops.after]);
    let held = run(
        &mut *own,
        &mut scripted,
        &still,
        encoder,
        Some(&load),
        monitor,
    );
    judged.yields = held.map_or(f64::INFINITY, |held| {
        let sum: f64 = held.position.iter().map(|p| p * p).sum();
        (sum / held.position.len() as f64).sqrt()
    });
    Ok(judged)
}

#[cfg(test)]
mod tests {
    use sewfast_control::{Design, Feedforward, Level, Rate, Settings, Standard};

    use super::*;
    use crate::machine::{Machine, Parameters};

    fn speed_loop() -> AnyDesign<f64> {
        let gains = Standard {
            kp: 0.02,
            ti: 0.06,
            td: 0.0,
        };
        let limits = Settings {
            u_min: -20.0,
            u_max: 20.0,
            ..Settings::new(gains, 1e-3)
        };
        let levels = [-3000.0, -1.0, 0.0, 1.0, 3000.0].map(|y: f64| Level {
            y,
            u: y / 490.0 + 0.3 * y.clamp(-1.0, 1.0),
        });
        let taps = [0.05; 8];
        Design {
            filter_samples: 8,
            feedforward: Feedforward::new(8, 0.5, &levels, &taps).unwrap(),
            ..Design::new(limits)
        }
        .into()
    }

    fn design() -> PositionDesign<f64> {
        let rates = Rates::new(&[Rate {
            speed: 0.0,
            up: 15e3,
            down: 15e3,
        }]);
        PositionDesign {
            gain: 20.0,
            counts_per_unit: 1572.0 / 60.0,
            speed: 4000.0,
            rates: rates.unwrap(),
            smoothing: 4,
            landing: 10.0,
            creep: 15.0,
            releases: false,
        }
    }

    #[test]
    fn the_virtual_machine_stops_at_an_angle_and_goes_to_goals() {
        let mut machine = Machine::new(Parameters::default()).unwrap();
        let mut reference = approach(&design().rates, 2000.0, 300, 1e-3);
        let stop = Stop {
            after: reference.len(),
            angle: 393.0,
            turn: 1572.0,
            onward: true,
        };
        reference.resize(stop.after + 1500, 2000.0);
        let monitor = Monitor::default();
        let mut scripted = Scripted::new(design(), &speed_loop(), Some(stop)).unwrap();
        let found = run(
            &mut machine,
            &mut scripted,
            &reference,
            None,
            None,
            &monitor,
        )
        .unwrap();
        let last = found.counts.len() - 1;
        let goal = found.goal[last];
        assert_eq!((goal - 393.0).rem_euclid(1572.0), 0.0);
        assert!(
            (found.counts[last] - goal).abs() <= 2.0,
            "{} {goal}",
            found.counts[last]
        );
        assert!(found.place[0].is_nan() && found.place[last] == goal);
        // goals: the place at the last sample is the last goal
        let mut scripted = Scripted::new(design(), &speed_loop(), None).unwrap();
        let goals: Vec<f64> = (0..3000)
            .map(|k| if k < 100 { 0.0 } else { 786.0 })
            .collect();
        let found = run(&mut machine, &mut scripted, &goals, None, None, &monitor).unwrap();
        assert!(
            (found.counts[2999] - 786.0).abs() <= 2.0,
            "{}",
            found.counts[2999]
        );
    }

    #[test]
    fn a_search_sees_that_rates_beyond_the_drive_pass_the_angle() {
        let machine = Machine::new(Parameters::default()).unwrap();
        let plants: Vec<Box<dyn ClonePlant>> = vec![Box::new(machine)];
        let steep = PositionDesign {
            rates: Rates::new(&[Rate {
                speed: 0.0,
                up: 15e3,
                down: 60e3,
            }])
            .unwrap(),
            ..design()
        };
        let stops = Stops {
            speeds: vec![1000.0, 2000.0],
            turn: 1572.0,
            before: 200,
            after: 800,
            load: 3.0,
        };
        let monitor = Monitor::default();
        let judged = judge(
            &plants,
            &[design(), steep],
            &speed_loop(),
            &stops,
            None,
            &monitor,
        );
        let [calm, steep] = judged.unwrap()[..] else {
            panic!("two designs")
        };
        assert!(
            calm.past < 100.0 && steep.past > 2.0 * calm.past,
            "{calm:?} {steep:?}"
        );
        assert!(calm.error.is_finite() && calm.yields > 0.0 && calm.yields.is_finite());
    }
}
