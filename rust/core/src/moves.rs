//! Known moves: the reference that makes the members of an ensemble follow a wanted one ([`plan`]), and its improvement from
//! repetitions on a machine ([`Learner`]).
//!
//! A table is a reference `r'` for the whole controller. It differs from the wanted `r` by hats, one every few samples:
//!
//! ```text
//! r'(k) = r(k) + sum_j c_j hat_j(k)            hat_j is 1 at its knot and falls to 0 at the neighbouring knots
//! ```
//!
//! The answer of a loop to a hat is a column of its lifted response. It is computed along the move itself: the loop is copied in the state
//! in which the hat begins and run on, with the hat and without it. So it is that of the model at this speed, at this
//! limit and this friction, for every kind of model and controller. It ends when nothing is left of it, so the normal equations have a band.
//!
//! Planning is Gauss and Newton's method on the mean square of `r - y` over the members, plus a small multiple of the squared change
//! of the command. Limits of the command are in the loop, and a hat that only pushes against one has no answer.
//! Learning uses the same equations with the measured error: norm-optimal iterative learning control (Bristow, Tharayil,
//! Alleyne, A survey of iterative learning control, IEEE Control Systems 26, 2006), with a zero-phase low-pass `Q`, rehearsed on
//! all members before a machine moves.

use sewfast_control::{AnyController, Controller};

use crate::banded::{Banded, Factor};
use crate::column::dot;
use crate::metrics::{rms, rmse};
use crate::model::ClonePlant;
use crate::{Error, Monitor, Result, search};

/// Samples from knot to knot.
const KNOT: usize = 4;
/// An answer has ended when it stays below this part of its peak..
const QUIET: f64 = 1e-3;
/// .. for so many samples.
const QUIET_FOR: usize = 32;
/// The longest answer in samples; what is left of a longer one is taken as none.
const HORIZON: usize = 1024;
/// The weight of the squared change of the command, over the ratio of what a hat does to the output and to that change. Of .001, .01, .1 and 1
/// the machine's error under a table is 3.9, 3.9, 3.9 and 4.2 RPM, and the change of the command 1.6, 1.5, 1.1 and .8
/// times that of the PID alone (virtual machine, grey box, trapezoid).
const SMOOTHING: f64 = 0.3;
/// A hat's size in the differences, as a part of the reference's range. Smaller ones see the jumps of dry friction at rest as slopes:
/// with 1e-4 no step gains anything on the grey box of the virtual machine, with 1e-3 to 1e-2 a few take its error from 2.4 to .7 RPM.
const PROBE: f64 = 3e-3;
/// Holds a step back in directions that do little, as a part of the mean of the diagonal: hats at rest move nothing until
/// friction lets go.
const DAMPING: f64 = 0.1;
/// Steps of a plan; those that gain less than [`ENOUGH`] of the cost end it.
const STEPS: usize = 24;
const ENOUGH: f64 = 5e-3;

/// One member of an ensemble and the controller of its loop.
pub struct Member<'a> {
    /// The plant.
    pub plant: Box<dyn ClonePlant + 'a>,
    /// The controller.
    pub controller: AnyController<f64>,
    /// Whether the output is measured by an encoder, as its mean over the last sample time.
    pub counted: bool,
}

/// A running loop.
struct Loop<'a> {
    plant: Box<dyn ClonePlant + 'a>,
    controller: AnyController<f64>,
    counted: bool,
    ts: f64,
    /// Position at the last sample.
    before: f64,
}

impl<'a> Loop<'a> {
    fn new(of: &Member<'a>) -> Self {
        let mut plant = of.plant.copied();
        plant.reset();
        let mut controller = of.controller.clone();
        controller.reset();
        let ts = controller.ts();
        Self {
            before: plant.position() - ts * plant.output(),
            counted: of.counted || plant.encoder().is_some(),
            plant,
            controller,
            ts,
        }
    }

    fn copied(&self) -> Self {
        Self {
            plant: self.plant.copied(),
            controller: self.controller.clone(),
            ..*self
        }
    }

    /// The output at this sample and the command from it on.
    // An encoder's counts are not rounded: a plan must not follow the rounding of one run.
    fn step(&mut self, r: f64) -> (f64, f64) {
        let (y, position) = (self.plant.output(), self.plant.position());
        let measured = if self.counted {
            (position - self.before) / self.ts
        } else {
            y
        };
        self.before = position;
        let u = self.controller.step(r, measured);
        self.plant.advance(u);
        (y, u)
    }
}

/// A move: its length, the preview of the controller, and the knots of the hats.
#[derive(Clone, Copy, Debug)]
struct Knots {
    samples: usize,
    preview: usize,
}

impl Knots {
    /// Earlier samples of a table reach no controller: its preview has passed them.
    fn new(samples: usize, preview: usize) -> Self {
        let preview = preview.min(samples - 1);
        Self { samples, preview }
    }

    fn count(&self) -> usize {
        (self.samples - 1 - self.preview) / KNOT + 1
    }

    /// Hat `j` at sample `k`; the first and the last one go on outwards.
    fn hat(&self, j: usize, k: usize) -> f64 {
        let knot = self.preview + j * KNOT;
        if k < knot && j == 0 || k > knot && j + 1 == self.count() {
            return 1.0;
        }
        1.0 - (k.abs_diff(knot).min(KNOT) as f64) / KNOT as f64
    }

    /// The first sample of a run that hat `j` reaches.
    fn start(&self, j: usize) -> usize {
        (j * KNOT).saturating_sub(KNOT - 1)
    }

    /// The place in a table of what the controller gets at sample `k`.
    fn early(&self, k: usize) -> usize {
        (k + self.preview).min(self.samples - 1)
    }

    /// The sum of the hats.
    fn signal(&self, c: &[f64]) -> Vec<f64> {
        let place = |k: usize| {
            let k = k.saturating_sub(self.preview);
            let (j, part) = (k / KNOT, (k % KNOT) as f64 / KNOT as f64);
            let next = c.get(j + 1).copied();
            let last = c.last().copied().unwrap_or(0.0);
            let own = c.get(j).copied().unwrap_or(last);
            own + part * (next.unwrap_or(own) - own)
        };
        (0..self.samples).map(place).collect()
    }
}

/// The answer to a hat from sample `start` on.
#[derive(Clone, Debug, Default)]
struct Column {
    start: usize,
    y: Vec<f64>,
    /// Of the command's change from sample to sample.
    du: Vec<f64>,
}

/// Sum of the products of what two columns have at the same samples.
fn together(a: (usize, &[f64]), b: (usize, &[f64])) -> f64 {
    let from = a.0.max(b.0);
    let end = (a.0 + a.1.len()).min(b.0 + b.1.len());
    if end <= from {
        return 0.0;
    }
    dot(&a.1[from - a.0..end - a.0], &b.1[from - b.0..end - b.0])
}

/// A run of one member.
#[derive(Clone, Debug)]
struct Ran {
    y: Vec<f64>,
    u: Vec<f64>,
}

impl Ran {
    /// `None` if the output leaves the finite numbers.
    fn new(member: &Member<'_>, knots: Knots, table: &[f64]) -> Option<Self> {
        let mut looped = Loop::new(member);
        let run = (0..knots.samples).map(|k| looped.step(table[knots.early(k)]));
        let (y, u): (Vec<_>, Vec<_>) = run.unzip();
        let finite = y.iter().chain(&u).all(|x| x.is_finite());
        finite.then_some(Self { y, u })
    }

    fn change(&self) -> Vec<f64> {
        let mut before = self.u[0];
        let change = self
            .u
            .iter()
            .map(|u| u - std::mem::replace(&mut before, *u));
        change.collect()
    }

    fn error(&self, reference: &[f64]) -> Vec<f64> {
        reference.iter().zip(&self.y).map(|(r, y)| r - y).collect()
    }
}

/// Applies `work` to all, over threads, in order.
pub(crate) fn each<T: Sync, R: Send>(
    all: &[T],
    threads: usize,
    work: impl Fn(&T) -> R + Sync,
) -> Vec<R> {
    search::each(&mut vec![(); threads.max(1)], all, |(), one| work(one))
}

/// Which hats there are: those around which a member moves. A shaft that stands does nothing until friction lets go, and a correction
/// there would wind up from repetition to repetition: machines with a quarter less inertia or more gain than the model then diverge.
fn moving(ran: &[Ran], knots: Knots, probe: f64) -> Vec<bool> {
    let moves = |j: usize| {
        let knot = knots.preview + j * KNOT;
        let span = knot.saturating_sub(KNOT)..(knot + 3 * KNOT).min(knots.samples);
        let off = |ran: &Ran| {
            ran.y[span.clone()]
                .iter()
                .any(|y| (y - ran.y[0]).abs() > probe)
        };
        ran.iter().any(off)
    };
    (0..knots.count()).map(moves).collect()
}

/// The answers of one member to all hats along a run; none after a stop request.
fn columns(
    member: &Member<'_>,
    knots: Knots,
    table: &[f64],
    ran: &Ran,
    (probe, moving): (f64, &[bool]),
    monitor: &Monitor,
) -> Vec<Column> {
    let mut walker = Loop::new(member);
    let (mut at, mut found) = (0, Vec::with_capacity(knots.count()));
    for (j, moves) in moving.iter().enumerate() {
        if monitor.stopped() {
            return Vec::new();
        }
        let start = knots.start(j);
        if !moves {
            found.push(Column {
                start,
                ..Column::default()
            });
            continue;
        }
        while at < start {
            walker.step(table[knots.early(at)]);
            at += 1;
        }
        found.push(column(walker.copied(), knots, table, ran, probe, j));
    }
    found
}

fn column(
    mut trial: Loop<'_>,
    knots: Knots,
    table: &[f64],
    ran: &Ran,
    probe: f64,
    j: usize,
) -> Column {
    let start = knots.start(j);
    let (mut y, mut du) = (Vec::new(), Vec::new());
    let (mut peak, mut peak_u, mut before, mut quiet) = (0.0_f64, 0.0_f64, 0.0, 0);
    for k in start..knots.samples.min(start + HORIZON) {
        let place = knots.early(k);
        let (now, u) = trial.step(table[place] + probe * knots.hat(j, place));
        let (dy, u) = ((now - ran.y[k]) / probe, (u - ran.u[k]) / probe);
        // a command has no change at the first sample of a run
        let change = if k == 0 { 0.0 } else { u - before };
        before = u;
        y.push(dy);
        du.push(change);
        (peak, peak_u) = (peak.max(dy.abs()), peak_u.max(u.abs()));
        let still = dy.abs() <= QUIET * peak && u.abs() <= QUIET * peak_u;
        quiet = if still && peak > 0.0 { quiet + 1 } else { 0 };
        if quiet >= QUIET_FOR {
            break;
        }
    }
    Column { start, y, du }
}

/// The normal equations of all members: of outputs, and of changes of the command.
fn normal(members: &[Vec<Column>], threads: usize) -> (Banded, Banded) {
    let size = members.first().map_or(0, Vec::len);
    let reach = |columns: &Vec<Column>| {
        let end = |c: &Column| c.start + c.y.len();
        let last = |i: usize| columns.partition_point(|other| other.start < end(&columns[i]));
        (0..size).map(|i| last(i).saturating_sub(i + 1)).max()
    };
    let band = members.iter().filter_map(reach).max().unwrap_or(0);
    let share = 1.0 / members.len().max(1) as f64;
    let parts = each(members, threads, |columns| {
        let (mut of_y, mut of_u) = (Banded::zeros(size, band), Banded::zeros(size, band));
        for (i, own) in columns.iter().enumerate() {
            for (j, other) in columns
                .iter()
                .enumerate()
                .take(i + 1)
                .skip(i.saturating_sub(of_y.band()))
            {
                *of_y.at(i, j) = together((own.start, &own.y), (other.start, &other.y));
                *of_u.at(i, j) = together((own.start, &own.du), (other.start, &other.du));
            }
        }
        (of_y, of_u)
    });
    let mut sums = (Banded::zeros(size, band), Banded::zeros(size, band));
    for (of_y, of_u) in &parts {
        sums.0.add(share, of_y);
        sums.1.add(share, of_u);
    }
    sums
}

/// `J'e` of a member.
fn transposed(columns: &[Column], e: &[f64]) -> Vec<f64> {
    let column = |c: &Column| dot(&c.y, &e[c.start..c.start + c.y.len()]);
    columns.iter().map(column).collect()
}

/// `J c` of a member.
fn answered(columns: &[Column], c: &[f64], samples: usize) -> Vec<f64> {
    let mut y = vec![0.0; samples];
    for (column, c) in columns.iter().zip(c) {
        for (y, own) in y[column.start..].iter_mut().zip(&column.y) {
            *y += c * own;
        }
    }
    y
}

/// Refuses what no table can be made of.
fn check(members: &[Member<'_>], reference: &[f64]) -> Result<()> {
    crate::closed_loop::check_reference(reference)?;
    if members.is_empty() {
        return Err(Error::setting(
            "expected at least one model to plan on, got none",
        ));
    }
    Ok(())
}

/// The size of a hat in the differences.
fn probe(reference: &[f64]) -> f64 {
    let (low, high) = reference
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), r| {
            (low.min(*r), high.max(*r))
        });
    let span = (high - low).max(high.abs().max(low.abs()));
    PROBE * if span > 0.0 { span } else { 1.0 }
}

fn runs(members: &[Member<'_>], knots: Knots, table: &[f64], threads: usize) -> Option<Vec<Ran>> {
    let found = each(members, threads, |member| Ran::new(member, knots, table));
    found.into_iter().collect()
}

fn diverged() -> Error {
    Error::fit(
        "expected a loop that stays finite on every model along the reference, got one that does not; tune the controller on \
         these models, or give a slower reference",
    )
}

/// A planned table.
#[derive(Clone, Debug)]
pub struct Planned {
    /// The reference for the controller \[y\].
    pub setpoint: Vec<f64>,
    /// The output that the members expect, their mean \[y\].
    pub y: Vec<f64>,
    /// The command that they expect, their mean \[u\].
    pub u: Vec<f64>,
    /// Error of each member without the table and with it, rms \[y\].
    pub errors: Vec<(f64, f64)>,
    /// Share of samples at a limit of the command, the most of any member.
    pub limited: f64,
    /// Whether a stop was requested; the table is the best so far.
    pub interrupted: bool,
}

/// The table that makes the members follow a reference best in the mean square, for a controller with this preview \[samples\].
///
/// # Errors
/// `ErrorKind::Data` for a reference that is empty or not finite, `ErrorKind::Setting` without members, `ErrorKind::Fit` for
/// a loop that diverges along the reference.
pub fn plan(
    members: &[Member<'_>],
    reference: &[f64],
    preview: usize,
    threads: usize,
    monitor: &Monitor,
) -> Result<Planned> {
    check(members, reference)?;
    let knots = Knots::new(reference.len(), preview);
    let (mut table, mut c) = (reference.to_vec(), vec![0.0; knots.count()]);
    let mut ran = runs(members, knots, &table, threads).ok_or_else(diverged)?;
    let before: Vec<f64> = ran.iter().map(|ran| rmse(reference, &ran.y)).collect();
    let share = 1.0 / members.len() as f64;
    let cost = |ran: &[Ran], weight: f64| -> f64 {
        let squares = |x: &[f64]| dot(x, x);
        let one = |ran: &Ran| squares(&ran.error(reference)) + weight * squares(&ran.change());
        share * ran.iter().map(one).sum::<f64>()
    };
    let mut equations: Option<Equations> = None;
    monitor.set_total(STEPS as u64);
    for _ in 0..STEPS {
        let fresh = equations.is_none();
        if fresh {
            let probe = probe(reference);
            equations = Equations::new(members, knots, &table, &ran, probe, threads, monitor)?;
        }
        let Some(known) = &equations else { break };
        let now = cost(&ran, known.weight);
        let step = known.step(&ran, reference);
        let mut gained = 0.0;
        for part in [1.0, 0.5, 0.25, 0.125] {
            let next: Vec<f64> = c.iter().zip(&step).map(|(c, d)| c + part * d).collect();
            let tried = added(reference, &knots.signal(&next));
            let Some(found) = runs(members, knots, &tried, threads) else {
                continue;
            };
            gained = 1.0 - cost(&found, known.weight) / now;
            if gained > 0.0 {
                (c, table, ran) = (next, tried, found);
                break;
            }
        }
        monitor.advance(1);
        monitor.report_cost((cost(&ran, 0.0) / reference.len() as f64).sqrt());
        if monitor.stopped() || (fresh && gained < ENOUGH) {
            break;
        }
        // the answers change little from step to step: new ones only when these gain less than half
        if gained < 0.5 {
            equations = None;
        }
    }
    let after = ran.iter().map(|ran| rmse(reference, &ran.y));
    let errors = before.into_iter().zip(after).collect();
    let limited = members.iter().zip(&ran).map(|(member, ran)| {
        let (low, high) = member.controller.limits();
        let at = ran.u.iter().filter(|u| !(**u > low && **u < high)).count();
        at as f64 / ran.u.len() as f64
    });
    Ok(Planned {
        limited: limited.fold(0.0, f64::max),
        y: mean(ran.iter().map(|ran| &ran.y[..])),
        u: mean(ran.iter().map(|ran| &ran.u[..])),
        errors,
        setpoint: table,
        interrupted: monitor.heard(),
    })
}

fn added(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a + b).collect()
}

fn mean<'a>(all: impl ExactSizeIterator<Item = &'a [f64]>) -> Vec<f64> {
    let share = 1.0 / all.len().max(1) as f64;
    let mut sum: Vec<f64> = Vec::new();
    for one in all {
        sum.resize(one.len(), 0.0);
        sum.iter_mut()
            .zip(one)
            .for_each(|(sum, x)| *sum += share * x);
    }
    sum
}

/// The answers along a move, and the factor of their normal equations.
struct Equations {
    members: Vec<Vec<Column>>,
    /// The hats that there are.
    moving: Vec<bool>,
    matrix: Banded,
    factor: Factor,
    /// Of the squared change of the command.
    weight: f64,
}

impl Equations {
    /// `None` after a stop request.
    fn new(
        members: &[Member<'_>],
        knots: Knots,
        table: &[f64],
        ran: &[Ran],
        probe: f64,
        threads: usize,
        monitor: &Monitor,
    ) -> Result<Option<Self>> {
        let moving = moving(ran, knots, probe);
        let pairs: Vec<_> = members.iter().zip(ran).collect();
        let members = each(&pairs, threads, |(member, ran)| {
            columns(member, knots, table, ran, (probe, &moving), monitor)
        });
        if monitor.stopped() {
            return Ok(None);
        }
        let (mut of_y, of_u) = normal(&members, threads);
        let (power, effort) = (of_y.trace(), of_u.trace());
        if !moving.contains(&true) {
            return Ok(None);
        }
        if !(power > 0.0 && power.is_finite() && effort.is_finite()) {
            return Err(Error::fit(
                "expected a loop that answers its reference, got one without any answer; check the controller's gains and limits",
            ));
        }
        let weight = if effort > 0.0 {
            SMOOTHING * power / effort
        } else {
            0.0
        };
        of_y.add(weight, &of_u);
        let count = moving.iter().filter(|moves| **moves).count();
        of_y.ridge(DAMPING * power / count.max(1) as f64);
        Ok(Some(Self {
            moving,
            factor: of_y.clone().factor()?,
            matrix: of_y,
            members,
            weight,
        }))
    }

    /// Gauss and Newton's step.
    fn step(&self, ran: &[Ran], reference: &[f64]) -> Vec<f64> {
        let share = 1.0 / self.members.len() as f64;
        let mut step = vec![0.0; self.members.first().map_or(0, Vec::len)];
        for (columns, ran) in self.members.iter().zip(ran) {
            let (error, change) = (ran.error(reference), ran.change());
            for (step, column) in step.iter_mut().zip(columns) {
                let span = column.start..column.start + column.y.len();
                *step += share
                    * (dot(&column.y, &error[span.clone()])
                        - self.weight * dot(&column.du, &change[span]));
            }
        }
        self.factor.solve(&mut step);
        step
    }
}

// --- Learning from repetitions ---

/// Repetitions on each member by which the convergence is known before a machine moves.
const REHEARSED: usize = 8;
/// A change of the correction below this part of the largest first one is none.
const SETTLED: f64 = 0.05;

/// Improves a table from the measured error of a repetition.
///
/// With the mean answer `J` of the members, `S = (mean of J_m'J_m, smoothed)^-1` and the low-pass `Q`, a repetition with
/// the error `e` changes the correction to `Q (c + S J' e)`. On a machine that answers as member `m` does, the change of `c` is multiplied
/// by `Q (I - S J' J_m)` from repetition to repetition, and learning converges monotonously if its norm is below 1.
///
/// Loops with friction have no one `J_m`: where a shaft stands, a hat does nothing until it lets go. So the members
/// rehearse: each learns for some repetitions in its own loop, with all that is not linear in it, and the norm is the largest ratio of one change to
/// the one before. The low-pass is the fastest of a ladder for which this is below 1 on all members and no error grows.
#[derive(Clone, Debug)]
pub struct Learner {
    knots: Knots,
    moving: Vec<bool>,
    mean: Vec<Column>,
    equations: Banded,
    factor: Factor,
    low_pass: Factor,
    /// Half of a swing with this period \[samples\] passes the low-pass.
    pub period: f64,
    /// The largest ratio of a change of the correction to the one before, over the members; below 1.
    pub contraction: f64,
}

impl Learner {
    /// For the repetitions of a reference with a table that was planned for it, on the loops of these members.
    ///
    /// # Errors
    /// As [`plan`]; `ErrorKind::Data` for a table of another length; `ErrorKind::Fit` if learning does not converge on a member for any low-pass
    /// that lets a swing of the move's length pass.
    pub fn new(
        members: &[Member<'_>],
        reference: &[f64],
        table: &[f64],
        preview: usize,
        threads: usize,
        monitor: &Monitor,
    ) -> Result<Self> {
        check(members, reference)?;
        check(members, table)?;
        if table.len() != reference.len() {
            return Err(Error::data(format!(
                "expected a table as long as its reference, {} samples, got {}",
                reference.len(),
                table.len()
            )));
        }
        let knots = Knots::new(table.len(), preview);
        let ran = runs(members, knots, table, threads).ok_or_else(diverged)?;
        let probe = probe(reference);
        let made = Equations::new(members, knots, table, &ran, probe, threads, monitor)?;
        let interrupted = || Error::fit("the work was interrupted");
        let stands = || {
            Error::fit(
                "expected a move, got a reference along which the models stand; there is nothing to learn",
            )
        };
        let equations = made.ok_or_else(|| match monitor.stopped() {
            true => interrupted(),
            false => stands(),
        })?;
        let mut learner = Self {
            mean: mean_columns(&equations.members),
            knots,
            moving: equations.moving,
            equations: equations.matrix,
            factor: equations.factor,
            low_pass: Banded::low_pass(knots.count(), 0.0).factor()?,
            period: 0.0,
            contraction: f64::INFINITY,
        };
        let mut period = 2.0 * KNOT as f64;
        while period <= 2.0 * table.len() as f64 {
            if monitor.stopped() {
                return Err(interrupted());
            }
            // half of a swing with this period passes
            let swing = 2.0 - 2.0 * (std::f64::consts::TAU * KNOT as f64 / period).cos();
            learner.low_pass = Banded::low_pass(knots.count(), swing.powi(-2)).factor()?;
            learner.period = period;
            let rehearsed = each(members, threads, |member| {
                learner.rehearse(member, reference, table)
            });
            learner.contraction = contraction(&rehearsed);
            if learner.contraction < 1.0 {
                return Ok(learner);
            }
            period *= std::f64::consts::SQRT_2;
        }
        Err(Error::fit(format!(
            "expected models that agree on what a change of the table does, got one on which learning grows by {:.3} a \
             repetition at any speed; record more of the machine, or plan only",
            learner.contraction
        )))
    }

    /// Errors and changes of the correction while a member learns; `None` if its loop diverges.
    fn rehearse(
        &self,
        member: &Member<'_>,
        reference: &[f64],
        table: &[f64],
    ) -> Option<Vec<(f64, f64)>> {
        let mut c = vec![0.0; self.size()];
        let mut found = Vec::with_capacity(REHEARSED);
        for _ in 0..REHEARSED {
            let played = added(table, &self.knots.signal(&c));
            let error = Ran::new(member, self.knots, &played)?.error(reference);
            let (next, _) = self.next(&c, &error, 1.0).ok()?;
            let moved: Vec<f64> = next.iter().zip(&c).map(|(n, c)| n - c).collect();
            // its answer counts, not the sum of squares: the last hats would count as much as all others
            let change = dot(&moved, &self.equations.times(&moved)).max(0.0).sqrt();
            found.push((rms(error.iter().copied()), change));
            c = next;
        }
        Some(found)
    }

    /// Numbers of a correction.
    pub fn size(&self) -> usize {
        self.knots.count()
    }

    /// The correction as samples of a table.
    ///
    /// # Errors
    /// `ErrorKind::Data` for another number of numbers.
    pub fn signal(&self, correction: &[f64]) -> Result<Vec<f64>> {
        self.check(correction)?;
        Ok(self.knots.signal(correction))
    }

    fn check(&self, correction: &[f64]) -> Result<()> {
        if correction.len() == self.size() && correction.iter().all(|c| c.is_finite()) {
            return Ok(());
        }
        Err(Error::data(format!(
            "expected a correction of {} finite numbers, got {}; take one of this learner",
            self.size(),
            correction.len()
        )))
    }

    /// The next correction after a repetition with this one and its error `r - y`, and the error that it should have. A part of the
    /// change is made with a `gain` below 1. Errors that are not finite were not measured and count as none.
    ///
    /// # Errors
    /// `ErrorKind::Data` for wrong lengths.
    pub fn next(
        &self,
        correction: &[f64],
        error: &[f64],
        gain: f64,
    ) -> Result<(Vec<f64>, Vec<f64>)> {
        self.check(correction)?;
        if error.len() != self.knots.samples {
            return Err(Error::data(format!(
                "expected an error of {} samples, got {}; measure the whole move",
                self.knots.samples,
                error.len()
            )));
        }
        let finite = |e: &f64| if e.is_finite() { *e } else { 0.0 };
        let error: Vec<f64> = error.iter().map(finite).collect();
        let mut step = transposed(&self.mean, &error);
        self.factor.solve(&mut step);
        let mut next: Vec<f64> = correction
            .iter()
            .zip(&step)
            .map(|(c, d)| c + gain * d)
            .collect();
        self.low_pass.solve(&mut next);
        for (next, moves) in next.iter_mut().zip(&self.moving) {
            *next *= f64::from(u8::from(*moves));
        }
        let moved: Vec<f64> = next.iter().zip(correction).map(|(n, c)| n - c).collect();
        let answer = answered(&self.mean, &moved, self.knots.samples);
        let left = error.iter().zip(&answer).map(|(e, y)| e - y).collect();
        Ok((next, left))
    }
}

/// The largest ratio of a change of the correction to the one before, as long as that is not none; infinite if a loop
/// diverges or an error grows beyond the largest first one.
fn contraction(rehearsed: &[Option<Vec<(f64, f64)>>]) -> f64 {
    let Some(all) = rehearsed.iter().cloned().collect::<Option<Vec<_>>>() else {
        return f64::INFINITY;
    };
    let first = all.iter().filter_map(|one| one.first());
    let (largest, whole) = first.fold((0.0_f64, 0.0_f64), |(e, d), (error, change)| {
        (e.max(*error), d.max(*change))
    });
    let ratios = all.iter().flat_map(|one| one.windows(2)).map(|pair| {
        let ((_, before), (error, change)) = (pair[0], pair[1]);
        match () {
            () if error > largest || error.is_nan() => f64::INFINITY,
            () if before.max(change) <= SETTLED * whole => 0.0,
            () => change / before,
        }
    });
    ratios.fold(0.0, f64::max)
}

/// The mean of the members' answers, over the samples that any of them covers.
fn mean_columns(members: &[Vec<Column>]) -> Vec<Column> {
    let share = 1.0 / members.len().max(1) as f64;
    let size = members.first().map_or(0, Vec::len);
    let column = |j: usize| {
        let own = members.iter().map(|columns| &columns[j]);
        let longest = own.clone().map(|c| c.y.len()).max().unwrap_or(0);
        let mut y = vec![0.0; longest];
        for column in own {
            y.iter_mut()
                .zip(&column.y)
                .for_each(|(y, x)| *y += share * x);
        }
        Column {
            start: members[0][j].start,
            y,
            du: Vec::new(),
        }
    };
    (0..size).map(column).collect()
}

#[cfg(test)]
mod tests;
