//! Margins of the sampled loop: how much gain, phase and delay it tolerates, and how it passes on disturbances and
//! noise. They are read from the locus of `L`, sampled more densely where it turns faster.

use std::cmp::Ordering;
use std::f64::consts::{FRAC_1_SQRT_2, PI};

use nalgebra::Complex;
use sewfast_control::Biquad;

use super::{Loop, Path, Place, States};

/// Initial points per decade.
const DENSITY: f64 = 16.0;
/// A turn of `1 + L` [rad] between two points that calls for another one between them.
const TURN: f64 = 0.3;
/// The same for `L` itself, if it is not negligible.
const OWN_TURN: f64 = 0.6;
/// Sizes of `L` that are negligible: no gain margin of this size is of interest.
const NEGLIGIBLE: f64 = 1e-4;
/// Halvings of an interval until it counts as a passage through -1.
const DEPTH: usize = 40;

/// A point of the locus.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    theta: f64,
    l: Complex<f64>,
}

/// The locus in order of frequency, and the encirclements it makes.
pub(super) struct Curve {
    pub(super) points: Vec<Point>,
    /// Closed-loop poles outside the unit circle; `None` if the locus passes through -1.
    unstable: Option<usize>,
}

impl Curve {
    pub(super) fn of(closed: &Loop<'_>) -> Self {
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
        let mut angles: Vec<f64> = (1..count)
            .map(|i| last.theta * ratio.powi(i as i32))
            .chain(turns(closed))
            .filter(|theta| *theta > last.theta && *theta < PI)
            .collect();
        angles.sort_by(f64::total_cmp);
        angles.push(PI);
        for theta in angles {
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

/// Angles at which a lightly damped filter or plant turns the locus, possibly between two points of the grid: those of
/// its poles and zeros, and neighbours.
fn turns(closed: &Loop<'_>) -> Vec<f64> {
    let sections = closed.path.biquads.sections().iter();
    let roots = sections.flat_map(|&Biquad { c0, c1, a1, a2 }| {
        let zeros = upper_root(1.0 + c0, a1 + c1 - c0, a2 - c1);
        [zeros, upper_root(1.0, a1, a2)].into_iter().flatten()
    });
    let poles = closed.plant.poles.iter().copied().filter(|p| p.im > 0.0);
    roots
        .chain(poles)
        .flat_map(|root| {
            let (theta, width) = (root.arg(), (1.0 - root.norm()).abs());
            [-3.0, -1.0, 0.0, 1.0, 3.0].map(|k| theta + k * width)
        })
        .collect()
}

/// The root of `b0 z^2 + b1 z + b2` above the real axis.
fn upper_root(b0: f64, b1: f64, b2: f64) -> Option<Complex<f64>> {
    let under = 4.0 * b0 * b2 - b1 * b1;
    (under > 0.0).then(|| Complex::new(-b1 / (2.0 * b0), under.sqrt() / (2.0 * b0.abs())))
}

/// Adds the points after `from` up to `to`; false if they cannot be brought near enough.
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

/// An angle well below every corner; with integrators so low that they alone determine the phase.
fn lowest(closed: &Loop<'_>) -> f64 {
    let (path, plant) = (closed.path, closed.plant);
    let corners = plant
        .poles
        .iter()
        .map(|p| (p - 1.0).norm())
        .filter(|c| *c >= 1e-9);
    let slowest = corners
        .chain([
            path.ts / path.gains.ti.max(path.ts),
            path.ts * path.position,
            1.0,
        ])
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

/// The turn of `1 + L` since frequency 0; undefined with integrators, and then 0.
fn from_rest(closed: &Loop<'_>, l: Complex<f64>) -> f64 {
    if integrators(closed) > 0 {
        return 0.0;
    }
    ((l + 1.0) / (closed.at(&Place::at(0.0)) + 1.0)).arg()
}

fn integrators(closed: &Loop<'_>) -> usize {
    let own = [closed.path.ki() != 0.0, closed.path.position > 0.0];
    closed.plant.integrators + own.into_iter().map(usize::from).sum::<usize>()
}

/// Unstable poles by the argument principle: over the upper half circle `1 + L` turns by `(q/2 + P - N) pi`, with `q`
/// integrators and `P` unstable poles in the open loop and `N` unstable poles in the closed one.
fn encircled(closed: &Loop<'_>, turned: f64) -> Option<usize> {
    let open = 0.5 * integrators(closed) as f64 + closed.plant.unstable as f64;
    let found = open - turned / PI;
    (found.is_finite() && (found - found.round()).abs() < 0.25)
        .then(|| found.round().max(0.0) as usize)
}

/// Halvings to locate a crossing, and narrowings to locate a peak.
const LOCATED: usize = 60;

/// Distances from instability, and peaks. Frequencies in rad/s.
#[derive(Clone, Debug, PartialEq)]
pub struct Margins {
    /// Whether every closed-loop pole lies inside the unit circle.
    pub stable: bool,
    /// The largest magnitude of a closed-loop pole; NaN with more than 250 states.
    pub largest_pole: f64,
    /// `max |S|`, and its frequency.
    pub ms: (f64, f64),
    /// `max |T|`, and its frequency.
    pub mt: (f64, f64),
    /// The factor above 1 on the loop's gain at which it becomes unstable; infinite if there is none.
    pub gain_margin: f64,
    /// The factor below 1 at which it becomes unstable; 0 if there is none.
    pub gain_reduction: f64,
    /// The least turn of `L` in either direction that makes it unstable \[deg\]; infinite if `|L|` is nowhere 1.
    pub phase_margin: f64,
    /// The least additional delay that makes it unstable \[s\].
    pub delay_margin: f64,
    /// The frequency at which `|S|` first reaches `1/sqrt(2)`: slower disturbances are attenuated by 3 dB or more.
    pub bandwidth: f64,
    /// Frequencies at which `|L| = 1`.
    pub gain_crossovers: Vec<f64>,
    /// Frequencies at which `L` is real and negative.
    pub phase_crossovers: Vec<f64>,
    /// rms of the command over rms of white noise on the measured output.
    pub noise_gain: f64,
}

/// All margins of a loop; if it is unstable, the peaks and the noise gain are infinite, the other margins NaN.
pub fn margins(closed: &Loop<'_>) -> Margins {
    let curve = &Curve::of(closed);
    let states = States::of(closed);
    let largest_pole = states.as_ref().map_or(f64::NAN, States::largest_pole);
    // NaN if there are too many states for eigenvalues
    let stable = curve.unstable == Some(0)
        && !matches!(
            largest_pole.partial_cmp(&1.0),
            Some(Ordering::Equal | Ordering::Greater)
        );
    let noise = || noise_gain(closed, states.as_ref(), curve);
    let ts = closed.path.ts;
    let gain_crossovers = crossings(closed, &curve.points, |l| l.norm_sqr() - 1.0, |_| true);
    let phase_crossovers = phase_crossings(closed, &curve.points);
    let per_second = |found: &[Point]| found.iter().map(|p| p.theta / ts).collect();
    let unless_unstable = |value: f64, otherwise: f64| if stable { value } else { otherwise };
    let peak = |size: fn(Complex<f64>) -> f64| {
        let (value, theta) = peak(closed, &curve.points, size);
        (
            unless_unstable(value, f64::INFINITY),
            unless_unstable(theta / ts, f64::NAN),
        )
    };
    let (above, below) = gain_factors(&phase_crossovers);
    Margins {
        stable,
        largest_pole,
        ms: peak(sensitivity),
        mt: peak(complementary),
        gain_margin: unless_unstable(above, f64::NAN),
        gain_reduction: unless_unstable(below, f64::NAN),
        phase_margin: unless_unstable(phase_margin(&gain_crossovers), f64::NAN),
        delay_margin: unless_unstable(ts * delay_margin(&gain_crossovers), f64::NAN),
        bandwidth: unless_unstable(reached(closed, &curve.points, FRAC_1_SQRT_2) / ts, f64::NAN),
        gain_crossovers: per_second(&gain_crossovers),
        phase_crossovers: per_second(&phase_crossovers),
        noise_gain: if stable { noise() } else { f64::INFINITY },
    }
}

/// The quantities that a search for bandwidth weighs, for a stable loop.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Weakening {
    /// `max |S|`.
    pub ms: f64,
    /// Levels that `|S|` passes, and where it first reaches each \[rad/s\]: the given level, then the height of each
    /// later peak, up to 1. With all of them a search has no jump when a peak rises above the first level.
    pub levels: Vec<(f64, f64)>,
    /// rms of the command over rms of white noise on the measured output; `None` if not requested.
    pub noise_gain: Option<f64>,
}

/// How a loop attenuates disturbances, from `level` on; `None` if it is unstable.
pub(crate) fn weakening(closed: &Loop<'_>, level: f64, noisy: bool) -> Option<Weakening> {
    let curve = Curve::of(closed);
    if curve.unstable != Some(0) {
        return None;
    }
    let per_second = |(level, theta)| (level, theta / closed.path.ts);
    let levels = passed(closed, &curve.points, level);
    Some(Weakening {
        ms: peak(closed, &curve.points, sensitivity).0,
        levels: levels.into_iter().map(per_second).collect(),
        noise_gain: noisy.then(|| noise_gain(closed, States::of(closed).as_ref(), &curve)),
    })
}

fn noise_gain(closed: &Loop<'_>, states: Option<&States>, curve: &Curve) -> f64 {
    states.map_or_else(|| noise_on(closed, &curve.points), States::noise_gain)
}

/// `max |S|`, infinite if the loop is unstable; without the other margins.
pub fn peak_sensitivity(closed: &Loop<'_>) -> f64 {
    let curve = Curve::of(closed);
    match curve.unstable {
        Some(0) => peak(closed, &curve.points, sensitivity).0,
        _ => f64::INFINITY,
    }
}

/// `max |S|` of the position loop alone, broken at its error while the speed loop is closed: `(1 + L0)/(1 + L)`, with `L0` the loop
/// without it. Infinite if either loop is unstable.
pub fn position_sensitivity(closed: &Loop<'_>) -> f64 {
    let inner = Path {
        position: 0.0,
        ..*closed.path
    };
    let inner = Loop {
        path: &inner,
        ..*closed
    };
    let curve = Curve::of(closed);
    if curve.unstable != Some(0) || Curve::of(&inner).unstable != Some(0) {
        return f64::INFINITY;
    }
    let sizes = curve.points.iter().map(|point| {
        let alone = inner.at(&Place::at(point.theta));
        ((alone + 1.0) / (point.l + 1.0)).norm()
    });
    sizes.filter(|size| size.is_finite()).fold(0.0, f64::max)
}

fn sensitivity(l: Complex<f64>) -> f64 {
    1.0 / (l + 1.0).norm()
}

fn complementary(l: Complex<f64>) -> f64 {
    l.norm() / (l + 1.0).norm()
}

/// Largest value of `size` and its angle: the best point of the locus, refined between its neighbours.
fn peak(closed: &Loop<'_>, points: &[Point], size: fn(Complex<f64>) -> f64) -> (f64, f64) {
    let values: Vec<f64> = points.iter().map(|p| size(p.l)).collect();
    let top = values.iter().copied().fold(0.0, f64::max);
    let mut best = (0.0, f64::NAN);
    for i in 0..points.len() {
        let (before, after) = (i.saturating_sub(1), (i + 1).min(points.len() - 1));
        // the points are so dense that a peak between them is at most a little higher than they are
        if values[i] >= 0.9 * top && values[i] >= values[before] && values[i] >= values[after] {
            let found = narrowed(closed, points[before].theta, points[after].theta, size);
            let own = (values[i], points[i].theta);
            let found = if found.0 > own.0 { found } else { own };
            best = if found.0 > best.0 { found } else { best };
        }
    }
    best
}

/// Where `|S|` first reaches a level: 0 if it begins above, pi if it stays below.
fn reached(closed: &Loop<'_>, points: &[Point], level: f64) -> f64 {
    let size = |theta: f64| sensitivity(closed.at(&Place::at(theta)));
    let mut below = 0.0;
    for (i, point) in points.iter().enumerate() {
        let mut above = (sensitivity(point.l) >= level).then_some(point.theta);
        // a peak between points, at most a little higher than they are
        if above.is_none() && sensitivity(point.l) >= 0.9 * level {
            above = peak_at(closed, points, i)
                .filter(|(height, theta)| *height >= level && *theta > below)
                .map(|found| found.1);
        }
        if let Some(mut high) = above {
            for _ in 0..LOCATED {
                let middle = 0.5 * (below + high);
                if size(middle) >= level {
                    high = middle
                } else {
                    below = middle
                }
            }
            return high;
        }
        below = point.theta;
    }
    PI
}

/// Height and angle of a peak of `|S|` around a point of the locus, if there is one.
fn peak_at(closed: &Loop<'_>, points: &[Point], i: usize) -> Option<(f64, f64)> {
    let value = sensitivity(points[i].l);
    let (before, after) = (points.get(i.checked_sub(1)?)?, points.get(i + 1)?);
    let peaks = value >= sensitivity(before.l) && value >= sensitivity(after.l);
    peaks.then(|| narrowed(closed, before.theta, after.theta, sensitivity))
}

fn passed(closed: &Loop<'_>, points: &[Point], level: f64) -> Vec<(f64, f64)> {
    let mut found = Vec::new();
    let mut next = Some(level);
    while let Some(level) = next.filter(|level| *level < 1.0) {
        let theta = reached(closed, points, level);
        found.push((level, theta));
        let beyond = (1..points.len() - 1).filter(|i| points[i + 1].theta > theta);
        next = beyond
            .filter_map(|i| peak_at(closed, points, i))
            .map(|(height, _)| height * (1.0 + 1e-9))
            .find(|height| *height > level);
    }
    found
}

/// Golden-section search.
fn narrowed(
    closed: &Loop<'_>,
    mut low: f64,
    mut high: f64,
    size: fn(Complex<f64>) -> f64,
) -> (f64, f64) {
    let share = 0.5 * (5.0_f64.sqrt() - 1.0);
    let value = |theta: f64| size(closed.at(&Place::at(theta)));
    let inner = |low: f64, high: f64| (high - share * (high - low), low + share * (high - low));
    let (mut left, mut right) = inner(low, high);
    let (mut at_left, mut at_right) = (value(left), value(right));
    for _ in 0..LOCATED {
        if at_left > at_right {
            (high, right, at_right) = (right, left, at_left);
            left = inner(low, high).0;
            at_left = value(left);
        } else {
            (low, left, at_left) = (left, right, at_right);
            right = inner(low, high).1;
            at_right = value(right);
        }
        if high - low < 1e-9 * high {
            break;
        }
    }
    if at_left > at_right {
        (at_left, left)
    } else {
        (at_right, right)
    }
}

/// Points at which `of(L)` changes its sign and `counts` holds.
fn crossings(
    closed: &Loop<'_>,
    points: &[Point],
    of: impl Fn(Complex<f64>) -> f64,
    counts: impl Fn(Complex<f64>) -> bool,
) -> Vec<Point> {
    let at = |theta: f64| Point {
        theta,
        l: closed.at(&Place::at(theta)),
    };
    let mut found = Vec::new();
    for pair in points.windows(2) {
        let (mut low, mut high) = (pair[0], pair[1]);
        let sign = of(low.l) > 0.0;
        if sign == (of(high.l) > 0.0) {
            continue;
        }
        for _ in 0..LOCATED {
            let middle = at(0.5 * (low.theta + high.theta));
            if (of(middle.l) > 0.0) == sign {
                low = middle
            } else {
                high = middle
            }
        }
        if counts(high.l) {
            found.push(high);
        }
    }
    found
}

/// Points with real and negative `L`, including half the sample rate and, without an integrator, frequency 0.
fn phase_crossings(closed: &Loop<'_>, points: &[Point]) -> Vec<Point> {
    let (first, last) = (points[0], points[points.len() - 1]);
    let mut found = Vec::new();
    if first.theta == 0.0 && first.l.re < 0.0 {
        found.push(first);
    }
    // at half the sample rate itself the imaginary part is rounding
    let mut inner = points.to_vec();
    if let Some(end) = inner.last_mut() {
        let theta = PI * (1.0 - 1e-7);
        *end = Point {
            theta,
            l: closed.at(&Place::at(theta)),
        };
    }
    found.extend(crossings(closed, &inner, |l| l.im, |l| l.re < 0.0));
    if last.l.re < 0.0 {
        found.push(Point {
            theta: PI,
            l: Complex::new(last.l.re, 0.0),
        });
    }
    found
}

/// The nearest factors above and below 1.
fn gain_factors(crossings: &[Point]) -> (f64, f64) {
    let factors = || crossings.iter().map(|p| -1.0 / p.l.re);
    let above = factors().filter(|f| *f > 1.0).fold(f64::INFINITY, f64::min);
    let below = factors().filter(|f| *f < 1.0).fold(0.0, f64::max);
    (above, below)
}

/// The lag that would turn `L` to -1, from 0 to below 2 pi.
fn lag_left(l: Complex<f64>) -> f64 {
    (l.arg() + PI).rem_euclid(2.0 * PI)
}

fn phase_margin(crossings: &[Point]) -> f64 {
    let either = |p: &Point| lag_left(p.l).min(2.0 * PI - lag_left(p.l));
    crossings
        .iter()
        .map(either)
        .fold(f64::INFINITY, f64::min)
        .to_degrees()
}

/// The delay margin \[samples\].
fn delay_margin(crossings: &[Point]) -> f64 {
    crossings
        .iter()
        .map(|p| lag_left(p.l) / p.theta)
        .fold(f64::INFINITY, f64::min)
}

/// Gauss-Legendre nodes and weights from -1 to 1.
const GAUSS: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_86),
    (-0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_86),
];

/// Noise gain if there are too many states: the square root of `1/pi int |R/(1 + L)|^2 dtheta`, interval by interval.
pub(super) fn noise_on(closed: &Loop<'_>, points: &[Point]) -> f64 {
    let power = |theta: f64| {
        let place = Place::at(theta);
        (closed.path.response(&place) / (closed.at(&place) + 1.0)).norm_sqr()
    };
    let over = |low: f64, high: f64| -> f64 {
        let (middle, half) = (0.5 * (low + high), 0.5 * (high - low));
        GAUSS
            .iter()
            .map(|(x, w)| w * half * power(middle + half * x))
            .sum()
    };
    let first = points
        .iter()
        .find(|p| p.theta > 0.0)
        .map_or(PI, |p| p.theta);
    let inner: f64 = points
        .windows(2)
        .map(|p| over(p[0].theta, p[1].theta))
        .sum();
    ((inner + first * power(first)) / PI).sqrt()
}
