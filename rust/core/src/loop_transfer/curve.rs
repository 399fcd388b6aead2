//! The locus of `L` from low frequencies to half the sample rate, as densely as it turns.

use nalgebra::Complex;
use std::f64::consts::PI;

use super::{Loop, Place};

/// Points per decade to begin with.
const DENSITY: f64 = 16.0;
/// A turn of `1 + L` [rad] between two points that calls for one between them.
const TURN: f64 = 0.3;
/// The same of `L` itself where it is not negligible.
const OWN_TURN: f64 = 0.6;
/// What is negligible: no gain margin of this size is of interest.
const NEGLIGIBLE: f64 = 1e-4;
/// Halvings of an interval before it counts as a passage through -1.
const DEPTH: usize = 40;

/// A point of the locus.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    pub theta: f64,
    pub l: Complex<f64>,
}

/// The locus in order of frequency, and what it encircles.
pub(super) struct Curve {
    pub points: Vec<Point>,
    /// Closed-loop poles outside the unit circle; `None` where the locus runs through -1.
    pub unstable: Option<usize>,
}

impl Curve {
    pub fn of(closed: &Loop<'_>) -> Self {
        let mut points = Vec::with_capacity(512);
        let at = |theta: f64| Point {
            theta,
            l: closed.at(&Place::at(theta)),
        };
        let mut last = at(lowest(closed));
        let count = ((PI / last.theta).log10() * DENSITY).ceil().max(2.0) as usize;
        let ratio = (PI / last.theta).powf(1.0 / count as f64);
        points.push(last);
        let (mut turned, mut resolved) = (from_rest(closed, last.l), true);
        for i in 1..=count {
            let theta = if i == count {
                PI
            } else {
                points[0].theta * ratio.powi(i as i32)
            };
            let next = at(theta);
            resolved &= refine(&at, &mut points, last, next, DEPTH, &mut turned);
            last = next;
        }
        if integrators(closed) == 0 {
            points.insert(0, at(0.0));
        }
        Self {
            points,
            unstable: resolved.then(|| encircled(closed, turned)).flatten(),
        }
    }
}

/// Adds the points after `from` up to `to`; false where they cannot be brought near enough.
fn refine(
    at: &impl Fn(f64) -> Point,
    points: &mut Vec<Point>,
    from: Point,
    to: Point,
    depth: usize,
    turned: &mut f64,
) -> bool {
    let turn = ((to.l + 1.0) / (from.l + 1.0)).arg();
    let large = from.l.norm().min(to.l.norm()) > NEGLIGIBLE;
    let coarse = turn.abs() > TURN || large && (to.l / from.l).arg().abs() > OWN_TURN;
    if !coarse || depth == 0 {
        points.push(to);
        *turned += turn;
        return turn.abs() <= TURN;
    }
    let middle = at((from.theta * to.theta).sqrt());
    let first = refine(at, points, from, middle, depth - 1, turned);
    refine(at, points, middle, to, depth - 1, turned) && first
}

/// Well below every corner; with integrators low enough that they alone decide the phase.
fn lowest(closed: &Loop<'_>) -> f64 {
    let (path, plant) = (closed.path, closed.plant);
    let corners = plant
        .poles
        .iter()
        .map(|p| (p - 1.0).norm())
        .filter(|c| *c >= 1e-9);
    let slowest = corners
        .chain([path.ts / path.gains.ti.max(path.ts), 1.0])
        .filter(|c| *c > 0.0);
    let mut theta = 0.01 * slowest.fold(1.0, f64::min);
    // a closed-loop pole near 1 turns 1 + L below every corner of the open loop
    let unsettled = |theta: f64| {
        let l = closed.at(&Place::at(theta));
        match integrators(closed) {
            0 => from_rest(closed, l).abs() > TURN,
            _ => l.norm() < 30.0,
        }
    };
    while unsettled(theta) && theta > 1e-12 {
        theta *= 0.1;
    }
    theta
}

/// How far `1 + L` has turned since frequency 0; with integrators there is no such turn.
fn from_rest(closed: &Loop<'_>, l: Complex<f64>) -> f64 {
    if integrators(closed) > 0 {
        return 0.0;
    }
    ((l + 1.0) / (closed.at(&Place::at(0.0)) + 1.0)).arg()
}

fn integrators(closed: &Loop<'_>) -> usize {
    closed.plant.integrators + usize::from(closed.path.ki() != 0.0)
}

/// Unstable poles by the argument principle: over the upper half circle `1 + L` turns by `(q/2 + P - N) pi` with `q`
/// integrators and `P` unstable poles in the open loop and `N` in the closed one.
fn encircled(closed: &Loop<'_>, turned: f64) -> Option<usize> {
    let open = 0.5 * integrators(closed) as f64 + closed.plant.unstable as f64;
    let found = open - turned / PI;
    (found.is_finite() && (found - found.round()).abs() < 0.25)
        .then(|| found.round().max(0.0) as usize)
}
