//! A load behind play: two bodies that meet without rebound.

use super::stepper::Moving;
use super::{Dual, Equations, Turn};

/// Part of the play from which a load touches.
pub(super) const TOUCHES: f64 = 1.0 - 1e-9;

/// A load with parts of inertia and friction, all forces from outside, and a position of its own within the play.
#[derive(Clone, Debug)]
pub(super) struct Play<const N: usize> {
    /// Half of the play.
    pub half: Dual<N>,
    /// The motor without the load.
    pub alone: Equations<N>,
    pub turn: Turn<N>,
    /// The load's acceleration per force, and by its friction.
    pub per_load: Dual<N>,
    pub rub: Dual<N>,
    /// Parts of the inertia: the load's, and the motor's.
    pub share: Dual<N>,
    pub rest: Dual<N>,
}

impl<const N: usize> Play<N> {
    pub fn new(equations: &Equations<N>, [half, share, rub]: [Dual<N>; 3]) -> Self {
        let (turn, one) = (equations.at(0.0, 0.0), Dual::constant(1.0));
        let (rest, held) = (one.plus(-1.0, &share), one.plus(-1.0, &rub));
        let per_load = turn.per_inertia.times(&share.inverse());
        Self {
            half,
            alone: Equations {
                k_s: equations.k_s.times(&held),
                k_t: equations.k_t.times(&held),
                ..equations.clone()
            },
            turn: Turn {
                per_inertia: turn.per_inertia.times(&rest.inverse()),
                load: Dual::ZERO,
                ..turn
            },
            rub: equations.k_s.times(&rub).times(&per_load),
            per_load,
            share,
            rest,
        }
    }

    /// The load's speed after a time of its own.
    #[inline(always)]
    fn loose(&self, v: &Dual<N>, load: &Dual<N>, time: f64) -> Dual<N> {
        let free = v.plus(-time, &load.times(&self.per_load));
        let most = self.rub.scaled(time);
        if free.value.abs() <= most.value {
            return Dual::ZERO;
        }
        free.plus(-side_of(&free), &most)
    }

    /// Advances by a step. A load that touches a flank goes with the motor unless it goes ahead of it; one that meets a flank
    /// goes on at the common speed (perfectly inelastic impact).
    #[inline(always)]
    pub fn step(
        &self,
        together: &Equations<N>,
        turn: &Turn<N>,
        at: &mut Moving<N>,
        command: &Dual<N>,
    ) {
        let step = together.step;
        let goes = |q: &Dual<N>, from: &Dual<N>, to: &Dual<N>| {
            q.plus(0.5 * step, from).plus(0.5 * step, to)
        };
        let loose = self.loose(&at.v, &turn.load, step);
        let ahead = at.q.plus(-1.0, &at.shown);
        if ahead.value.abs() >= TOUCHES * self.half.value {
            let side = side_of(&ahead);
            let (drive, speed) = together.advanced(turn, &at.x, &at.w, &at.shown, command);
            if side * (loose.value - speed.value) <= 0.0 {
                at.q = goes(&at.q, &at.w, &speed);
                at.shown = at.q.plus(-side, &self.half);
                (at.x, at.w, at.v) = (drive, speed, speed);
                return;
            }
        }
        let (drive, speed) = self
            .alone
            .advanced(&self.turn, &at.x, &at.w, &at.shown, command);
        at.q = goes(&at.q, &at.w, &speed);
        at.shown = goes(&at.shown, &at.v, &loose);
        (at.x, at.w, at.v) = (drive, speed, loose);
        let ahead = at.q.plus(-1.0, &at.shown);
        if ahead.value.abs() > self.half.value {
            let common = speed.times(&self.rest).plus(1.0, &loose.times(&self.share));
            at.shown = at.q.plus(-side_of(&ahead), &self.half);
            (at.w, at.v) = (common, common);
        }
    }
}

/// -1 or 1, with 1 for either zero.
#[inline(always)]
pub(super) fn side_of<const N: usize>(dual: &Dual<N>) -> f64 {
    if dual.value < 0.0 { -1.0 } else { 1.0 }
}
