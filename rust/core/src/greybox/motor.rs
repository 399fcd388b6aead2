//! The motor's equations without derivatives, for one motor or eight side by side: [`Equations`] operation by operation, with selections
//! in place of branches. Read `step` first.

use super::play::TOUCHES;
use super::stepper::Stepper;
use super::{NEWTON, NEWTON_TOLERANCE};
use crate::neural::Meanwhile;
use crate::simd::{Arithmetic, F64x8, LANES};

/// The numbers of a motor and its network; names as in [`Equations`](super::Equations).
#[derive(Clone, Debug)]
pub(crate) struct Motor {
    k_e: f64,
    k_b: f64,
    per_inertia: f64,
    load: f64,
    k_s: f64,
    k_t: f64,
    per_w_s: f64,
    drop: f64,
    ripple: f64,
    share: f64,
    memory: f64,
    bend: f64,
    limit: Option<f64>,
    uneven: Option<f64>,
    sag: Option<f64>,
    k_l: Option<f64>,
    directional: Option<[f64; 3]>,
    /// `keep` and `gain` over half a step and a whole one.
    soft: Option<[[f64; 2]; 2]>,
    exponent: Option<f64>,
    inner: Option<Inner>,
    /// Loads over the angle: `order`, `c` and `s`.
    by_angle: Vec<[f64; 3]>,
    rate: Option<f64>,
    play: Option<Box<Play>>,
    /// Whether a controller knows the position of the load, not of the motor.
    shows_load: bool,
    network: Vec<[f64; 4]>,
    /// Integration steps per sample, and their length \[s\].
    steps: usize,
    time: f64,
    /// Fraction of a sample in the command's delay, and its whole samples.
    part: f64,
    whole: usize,
    /// Whether the output is the position, or the mean speed over a sample.
    position: bool,
    mean: bool,
    sample_time: f64,
    unit: f64,
    command_scale: f64,
    // inverses: in the loop each would be a division at every sample
    per_share: f64,
    per_steps: f64,
    per_unit: f64,
    per_speed: f64,
    per_command: f64,
}

/// A load behind play; names as in [`Play`](super::play::Play).
#[derive(Clone, Debug)]
struct Play {
    half: f64,
    alone: Motor,
    per_load: f64,
    rub: f64,
    share: f64,
    rest: f64,
}

/// The drive's own controller; names as in [`Inner`](super::Inner), infinite where it has no limit.
#[derive(Clone, Copy, Debug)]
struct Inner {
    k_q: f64,
    damping: f64,
    dead_band: f64,
    reach: f64,
}

/// What one motor, or each of eight, remembers; all 0 at rest.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Moving<A> {
    /// Speed \[rad/s\], drive, the command of the last sample, and the position \[rad\] if it is the output.
    pub w: A,
    pub x: A,
    pub before: A,
    pub q: A,
    /// What the controller goes for, with a limit of its rate; position and speed of a load behind play.
    pub setpoint: A,
    pub shown: A,
    pub v: A,
}

impl<A: Arithmetic> Moving<A> {
    pub fn at_rest() -> Self {
        let zero = A::splat(0.0);
        Self {
            w: zero,
            x: zero,
            before: zero,
            q: zero,
            setpoint: zero,
            shown: zero,
            v: zero,
        }
    }
}

impl Motor {
    /// The motor of a stepper, whose command is late by `whole` samples and a fraction.
    pub(super) fn of(stepper: &Stepper<0>, whole: usize) -> Self {
        let mut motor = Self::plain(stepper, whole);
        motor.play = stepper.play.as_ref().map(|play| {
            let mut alone = motor.clone();
            alone.k_s = play.alone.k_s.value;
            alone.k_t = play.alone.k_t.value;
            alone.per_inertia = play.turn.per_inertia.value;
            alone.shows_load = true;
            motor.shows_load = true;
            Box::new(Play {
                half: play.half.value,
                alone,
                per_load: play.per_load.value,
                rub: play.rub.value,
                share: play.share.value,
                rest: play.rest.value,
            })
        });
        motor
    }

    fn plain(stepper: &Stepper<0>, whole: usize) -> Self {
        let (is, frame) = (&stepper.equations, &stepper.frame);
        Self {
            k_e: is.k_e.value,
            k_b: is.k_b.value,
            per_inertia: stepper.turn.per_inertia.value,
            load: stepper.turn.load.value,
            k_s: is.k_s.value,
            k_t: is.k_t.value,
            per_w_s: is.per_w_s.value,
            drop: is.drop.value,
            ripple: is.ripple.value,
            share: is.share.value,
            memory: is.memory.value,
            bend: is.bend.value,
            limit: is.limit.map(|limit| limit.value),
            uneven: is.uneven.map(|uneven| uneven.value),
            sag: is.sag.map(|sag| sag.value),
            k_l: is.k_l.map(|k_l| k_l.value),
            directional: is.directional.map(|both| both.map(|one| one.value)),
            soft: is
                .soft
                .map(|both| both.map(|soft| [soft.keep.value, soft.gain.value])),
            exponent: is.exponent.map(|exponent| exponent.value),
            inner: is.inner.map(|inner| Inner {
                k_q: inner.k_q.value,
                damping: inner.damping.value,
                dead_band: inner.dead_band.map_or(0.0, |band| band.value),
                reach: inner.reach.map_or(f64::INFINITY, |reach| reach.value),
            }),
            by_angle: stepper
                .by_angle
                .iter()
                .map(|wave| [wave.order, wave.c, wave.s].map(|one| one.value))
                .collect(),
            rate: stepper.rate.map(|rate| rate.value),
            play: None,
            shows_load: false,
            network: stepper
                .network
                .iter()
                .map(|unit| unit.map(|weight| weight.value))
                .collect(),
            steps: frame.steps,
            time: is.step,
            part: stepper.part,
            whole,
            position: frame.position,
            mean: frame.mean,
            sample_time: frame.sample_time,
            unit: frame.unit,
            command_scale: frame.command_scale,
            per_share: 1.0 / is.share.value,
            per_steps: 1.0 / frame.steps as f64,
            per_unit: 1.0 / frame.unit,
            per_speed: 1.0 / frame.speed_scale,
            per_command: 1.0 / frame.command_scale,
        }
    }

    /// Whole samples of the command's delay beyond the one of every loop.
    pub fn whole(&self) -> usize {
        self.whole
    }

    /// Advances by a sample in which `now` comes to act; returns the output that follows, and by how much the position moves. `meanwhile`
    /// is other work, done while the results of this step are waited for.
    #[inline(always)]
    pub fn step<A: Arithmetic>(
        &self,
        at: &mut Moving<A>,
        now: A,
        tanh: impl Fn(A) -> A,
        meanwhile: &mut impl Meanwhile,
    ) -> (A, A) {
        let all = A::splat;
        let mut load = all(self.load);
        if !self.network.is_empty() {
            load = load.add(self.residual(at.w, at.x, tanh));
        }
        let mut mean = all(0.0);
        for j in 0..self.steps {
            let old = (self.part * self.steps as f64 - j as f64).clamp(0.0, 1.0);
            let (mut held, mut given) = (at.before, now);
            if let Some(rate) = self.rate {
                let before = old * self.time;
                let (mean, end) = ramped(rate * before, at.setpoint, held);
                held = mean;
                (given, at.setpoint) = ramped(rate * (self.time - before), end, given);
            }
            let command = given.mul(all(1.0 - old)).add(all(old).mul(held));
            let load = self.with_angle(load, at);
            if let Some(play) = &self.play {
                self.step_with_play(play, load, at, command, meanwhile);
                continue;
            }
            let (drive, speed) = self.advanced(load, at, command, meanwhile);
            if self.position {
                let half = all(0.5 * self.time);
                at.q = at.q.add(half.mul(at.w)).add(half.mul(speed));
            } else {
                mean = mean.add(all(0.5).mul(at.w)).add(all(0.5).mul(speed));
            }
            (at.x, at.w) = (drive, speed);
        }
        at.before = now;
        if self.position {
            // only a speed is measured by counts of its position
            let q = if self.play.is_some() { at.shown } else { at.q };
            let output = q.mul(all(self.per_unit));
            return (output, all(0.0));
        }
        let mean = mean.mul(all(self.per_steps));
        let output = if self.mean { mean } else { at.w };
        let moved = all(self.sample_time).mul(mean).div(all(self.unit));
        (output.mul(all(self.per_unit)), moved)
    }

    /// A step with a load behind play: both ways, of which each lane takes its own.
    #[inline(always)]
    fn step_with_play<A: Arithmetic>(
        &self,
        play: &Play,
        load: A,
        at: &mut Moving<A>,
        command: A,
        meanwhile: &mut impl Meanwhile,
    ) {
        let all = A::splat;
        let side_of = |x: A, size: f64| x.if_less(all(0.0), all(-size), all(size));
        let half = all(0.5 * self.time);
        let goes = |q: A, from: A, to: A| q.add(half.mul(from)).add(half.mul(to));
        let free = at.v.add(all(-self.time).mul(load.mul(all(play.per_load))));
        let most = play.rub * self.time;
        let slides = free.sub(side_of(free, most));
        let loose = all(most).if_less(free.abs(), slides, all(0.0));

        let ahead = at.q.sub(at.shown);
        let (drive, speed) = self.advanced(load, at, command, meanwhile);
        let leaves = side_of(ahead, 1.0).mul(loose.sub(speed));
        let apart = all(0.0).if_less(leaves, all(1.0), all(0.0));
        let apart = ahead
            .abs()
            .if_less(all(TOUCHES * play.half), all(1.0), apart);
        let q = goes(at.q, at.w, speed);
        let shown = q.sub(side_of(ahead, play.half));

        let (own_drive, own) = play.alone.advanced(all(0.0), at, command, meanwhile);
        let (own_q, own_shown) = (goes(at.q, at.w, own), goes(at.shown, at.v, loose));
        let ahead = own_q.sub(own_shown);
        let common = own.mul(all(play.rest)).add(loose.mul(all(play.share)));
        let hits = |then: A, none: A| all(play.half).if_less(ahead.abs(), then, none);

        let either = |apart_: A, together: A| all(0.5).if_less(apart, apart_, together);
        at.x = either(own_drive, drive);
        at.w = either(hits(common, own), speed);
        at.v = either(hits(common, loose), speed);
        at.q = either(own_q, q);
        at.shown = either(hits(own_q.sub(side_of(ahead, play.half)), own_shown), shown);
    }

    /// The load with gravity and cogging in the middle of a step.
    #[inline(always)]
    fn with_angle<A: Arithmetic>(&self, mut load: A, at: &Moving<A>) -> A {
        let all = A::splat;
        for &[order, c, s] in &self.by_angle {
            let angle = all(order).mul(at.q.add(all(0.5 * self.time).mul(at.w)));
            load = load
                .add(all(c).mul(angle.each(f64::cos)))
                .add(all(s).mul(angle.each(f64::sin)));
        }
        load
    }

    /// The output of the drive's own controller, and how it changes over a step at this speed.
    #[inline(always)]
    fn controlled<A: Arithmetic>(&self, inner: &Inner, u: A, q: A, w: A) -> (A, A) {
        let all = A::splat;
        let error = u.sub(all(inner.k_q).mul(q));
        let change = all(inner.k_q).mul(w).mul(all(-self.time));
        let side = error.if_less(all(0.0), all(-inner.dead_band), all(inner.dead_band));
        let acts = all(inner.dead_band);
        let left = acts.if_less(error.abs(), error.sub(side), all(0.0));
        let (error, change) = if inner.dead_band > 0.0 {
            (left, acts.if_less(error.abs(), change, all(0.0)))
        } else {
            (error, change)
        };
        let output = error.sub(all(inner.damping).mul(w));
        let reach = all(inner.reach);
        let most = output.if_less(all(0.0), all(-inner.reach), reach);
        (
            reach.if_less(output.abs(), most, output),
            reach.if_less(output.abs(), all(0.0), change),
        )
    }

    /// The network's load, in units of the command.
    #[inline(always)]
    fn residual<A: Arithmetic>(&self, w: A, x: A, tanh: impl Fn(A) -> A) -> A {
        let all = A::splat;
        let speed = w.mul(all(self.per_speed));
        let drive = x.mul(all(self.per_command));
        let mut sum = all(0.0);
        for &[b, p, q, c] in &self.network {
            let argument = all(b).add(all(p).mul(speed)).add(all(q).mul(drive));
            sum = sum.add(all(c).mul(tanh(argument)));
        }
        sum.mul(all(self.command_scale))
    }

    /// Drive and speed after a step at this command.
    #[inline(always)]
    fn advanced<A: Arithmetic>(
        &self,
        load: A,
        at: &Moving<A>,
        u: A,
        meanwhile: &mut impl Meanwhile,
    ) -> (A, A) {
        let all = A::splat;
        let (w, x) = (at.w, at.x);
        let middle = self.moved(load, w, x, w, 0.5 * self.time);
        let mut change = all(self.k_e).mul(w.sub(middle)).mul(all(2.0));
        let mut voltage = u;
        if let Some(inner) = &self.inner {
            let quarter = all(0.25 * self.time);
            // a controller knows the position that shows
            let q = if self.shows_load { at.shown } else { at.q };
            let half = q.add(quarter.mul(w)).add(quarter.mul(middle));
            let (output, by) = self.controlled(inner, u, half, middle);
            (voltage, change) = (output, change.add(by));
        }
        if let Some(sag) = self.sag {
            voltage = voltage.sub(all(sag).mul(x).mul(u.mul(u)));
        }
        let goal = voltage.sub(all(self.k_e).mul(middle));
        let (after, mean) = self.driven(x, goal, change, meanwhile);
        (after, self.moved(load, w, mean, middle, self.time))
    }

    /// The speed after `time` under a drive; terms that depend on the speed are taken at `middle`.
    #[inline(always)]
    fn moved<A: Arithmetic>(&self, load: A, from: A, drive: A, middle: A, time: f64) -> A {
        let all = A::splat;
        let smooth = drive.sub(load).sub(all(self.k_b).mul(middle));
        let free = from.add(all(time).mul(smooth.mul(all(self.per_inertia))));
        let direction = free.if_less(all(0.0), all(-1.0), all(1.0));
        let mut dry = self.dry(middle, direction);
        if let Some(k_l) = self.k_l {
            dry = dry.add(all(k_l).mul(drive.add(load)).abs());
        }
        if let Some([k_m, k_g, k_mm]) = self.directional {
            dry = dry
                .add(all(k_m).mul(drive).abs())
                .add(all(k_g).mul(load).abs())
                .add(all(k_mm).mul(drive.mul(drive)));
        }
        let most = dry.mul(all(self.per_inertia)).mul(all(time));
        if let Some([half, whole]) = self.soft {
            let [keep, gain] = if time < self.time { half } else { whole };
            let held = from.mul(all(keep)).add(free.sub(from).mul(all(gain)));
            let taken = free.sub(held);
            let side = taken.if_less(all(0.0), all(-1.0), all(1.0));
            return most.if_less(taken.abs(), free.sub(side.mul(most)), held);
        }
        let moved = free.sub(direction.mul(most));
        // friction that could take more than all of the speed stops the shaft; NaN is neither less nor equal, and stays
        let stopped = free.abs().if_less(most, all(0.0), moved);
        free.abs().if_equal(most, all(0.0), stopped)
    }

    /// The magnitude of dry friction against a motion in this direction.
    #[inline(always)]
    fn dry<A: Arithmetic>(&self, speed: A, direction: A) -> A {
        let all = A::splat;
        if self.k_t == 0.0 && self.uneven.is_none() {
            return all(self.k_s);
        }
        let bump = match self.uneven {
            Some(k_d) => all(self.k_t).add(direction.mul(all(k_d))),
            None => all(self.k_t),
        };
        let ratio = speed.mul(all(self.per_w_s));
        let shape = match self.exponent {
            Some(exponent) => ratio.each(|r| (-r.abs().powf(exponent)).exp()),
            None => all(1.0).div(ratio.mul(ratio).add(all(1.0))),
        };
        all(self.k_s).add(bump.mul(shape))
    }

    /// The drive after a step towards `goal`, which changes by `change` during the step, and the drive's mean.
    #[inline(always)]
    fn driven<A: Arithmetic>(
        &self,
        from: A,
        goal: A,
        change: A,
        meanwhile: &mut impl Meanwhile,
    ) -> (A, A) {
        let all = A::splat;
        let aim = from
            .add(all(self.share).mul(goal.sub(from)))
            .add(all(self.bend).mul(change));
        meanwhile.go();
        let (mut after, mut steady) = (aim, goal);
        if self.drop != 0.0 {
            let x = self.newton(from, aim, meanwhile);
            let root = x.mul(x).add(all(self.ripple * self.ripple)).sqrt();
            let taken_at = all(self.drop).mul(x.div(root));
            let cube = root.mul(root).mul(root);
            let least = self.share * self.drop * self.ripple * self.ripple;
            let slope = all(1.0).add(all(least).div(cube));
            let per_slope = all(1.0).div(slope.at_least_each(all(0.1)));
            let left = aim.sub(x).sub(all(self.share).mul(taken_at));
            after = x.add(per_slope.mul(left));
            let taken = aim.sub(after).mul(all(self.per_share));
            steady = goal.sub(taken);
        }
        let mean = steady.add(all(self.memory).mul(from.sub(steady)));
        (self.limited(after), self.limited(mean))
    }

    /// The drive before the last step of Newton's method, from the drive before.
    #[inline(always)]
    fn newton<A: Arithmetic>(&self, from: A, aim: A, meanwhile: &mut impl Meanwhile) -> A {
        let all = A::splat;
        let (most, square) = (self.share * self.drop, self.ripple * self.ripple);
        let close = all(NEWTON_TOLERANCE * self.ripple);
        let (mut x, mut last) = (from, close);
        for _ in 0..NEWTON {
            let per_root = all(1.0).div(x.mul(x).add(all(square)).sqrt());
            let cube = per_root.mul(per_root).mul(per_root);
            let slope = all(1.0).add(all(most * square).mul(cube));
            let off = x.add(all(most).mul(x).mul(per_root)).sub(aim);
            let by = off.div(slope.at_least_each(all(0.1)));
            // a lane that has converged waits for the others
            x = last.if_less(close, x, x.sub(by));
            last = last.if_less(close, last, by.abs());
            meanwhile.go();
            if last.are_less(close) == A::ALL {
                break;
            }
        }
        x
    }

    #[inline(always)]
    fn limited<A: Arithmetic>(&self, drive: A) -> A {
        let Some(limit) = self.limit else {
            return drive;
        };
        let all = A::splat;
        let side = drive.if_less(all(0.0), all(-limit), all(limit));
        all(limit).if_less(drive.abs(), side, drive)
    }
}

/// A setpoint's mean and end, which goes for a command by `most` at most.
#[inline(always)]
fn ramped<A: Arithmetic>(most: f64, from: A, command: A) -> (A, A) {
    let all = A::splat;
    let left = command.sub(from);
    let change = left.if_less(all(0.0), all(-most), all(most));
    let limited = |value: A| all(most).if_less(left.abs(), value, command);
    (
        limited(from.add(all(0.5).mul(change))),
        limited(from.add(change)),
    )
}

/// `tanh` of one number as a lane computes it.
#[inline(always)]
pub(crate) fn tanh_of_one<V: F64x8>(x: f64) -> f64 {
    let mut lanes = [0.0; LANES];
    V::splat(x).tanh().store(&mut lanes);
    lanes[0]
}
