//! Differential evolution, current-to-best with binomial crossover (Storn and Price 1997; Zhang and Sanderson 2009).

use sewfast_control::{Settings, Standard};

use crate::random::Random;

/// Coordinates: `ln |Kp|`, `ln Ti`, `ln Td`, `alpha`, `beta`, `ln N`; each scaled to 0 .. 1.
const DIMENSIONS: usize = 6;
type Point = [f64; DIMENSIONS];

/// Members of the population.
const MEMBERS: usize = 24;
/// Members that mutants are drawn to: the best alone would draw all into the first good basin.
const GOOD: usize = 4;
/// Members that begin near the start; the others begin anywhere within the bounds.
const NEAR: usize = 12;
/// Spread of the members that begin near the start, in shares of the bounds.
const JITTER: f64 = 0.08;
/// Probability that a coordinate is taken from the mutant.
const CROSSOVER: f64 = 0.9;
/// The search has converged when all costs lie within this share of the best.
const TOGETHER: f64 = 1e-4;

/// The box that is searched, about a start whose other settings are kept.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    start: Settings<f64>,
    low: Point,
    high: Point,
}

impl Bounds {
    /// `Kp` from a fiftieth to fifty times the start's, `Ti` from 4 to 10,000 samples, `Td` from a twentieth of a
    /// sample to 200 samples, `N` from 1 to 50, `alpha` from -.5 to 1.2, `beta` from -8 to 1.2.
    ///
    /// A negative alpha or beta weights the reference by more than 1: feedforward that a slow feedback leaves room for.
    pub(super) fn about(start: &Settings<f64>) -> Self {
        let (kp, ts) = (start.gains.kp.abs().ln(), start.ts);
        let wide = 50.0_f64.ln();
        Self {
            start: *start,
            low: [
                kp - wide,
                (4.0 * ts).ln(),
                (0.05 * ts).ln(),
                -0.5,
                -8.0,
                0.0,
            ],
            high: [
                kp + wide,
                (1e4 * ts).ln(),
                (200.0 * ts).ln(),
                1.2,
                1.2,
                wide,
            ],
        }
    }

    /// Dimensions that are searched: `N` stays infinite where the start has no filter.
    fn searched(&self) -> usize {
        DIMENSIONS - usize::from(self.start.n.is_infinite())
    }

    /// The start, moved to the bounds where it lies outside.
    fn start(&self) -> Point {
        let Settings {
            gains,
            alpha,
            beta,
            n,
            ..
        } = self.start;
        let raw = [
            gains.kp.abs().ln(),
            gains.ti.ln(),
            gains.td.ln(),
            alpha,
            beta,
            n.ln(),
        ];
        let share = |i: usize| (raw[i] - self.low[i]) / (self.high[i] - self.low[i]);
        std::array::from_fn(|i| share(i).clamp(0.0, 1.0))
    }

    pub(super) fn settings(&self, point: &Point) -> Settings<f64> {
        let value = |i: usize| self.low[i] + point[i] * (self.high[i] - self.low[i]);
        let gains = Standard {
            kp: value(0).exp().copysign(self.start.gains.kp),
            ti: value(1).exp(),
            td: value(2).exp(),
        };
        let n = if self.searched() == DIMENSIONS {
            value(5).exp()
        } else {
            self.start.n
        };
        Settings {
            gains,
            alpha: value(3),
            beta: value(4),
            n,
            ..self.start
        }
    }
}

/// A candidate to be judged.
#[derive(Clone, Debug)]
pub(super) struct Trial {
    /// Its place among the trials and the member that it may replace.
    pub(super) index: usize,
    pub(super) settings: Settings<f64>,
    /// The cost of that member: a trial above it need not be judged to the end.
    pub(super) to_beat: f64,
    point: Point,
}

#[derive(Clone, Copy, Debug)]
struct Member {
    point: Point,
    cost: f64,
}

/// The population and its random numbers.
#[derive(Clone, Debug)]
pub(super) struct Evolution {
    bounds: Bounds,
    random: Random,
    members: Vec<Member>,
    judged: bool,
}

impl Evolution {
    pub(super) fn new(bounds: Bounds, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let start = bounds.start();
        let mut point = |member: usize| -> Point {
            std::array::from_fn(|i| match member {
                0 => start[i],
                1..NEAR => (start[i] + JITTER * random.normal()).clamp(0.0, 1.0),
                _ => random.uniform(),
            })
        };
        let member = |m| Member {
            point: point(m),
            cost: f64::INFINITY,
        };
        let members = (0..MEMBERS).map(member).collect();
        Self {
            bounds,
            random,
            members,
            judged: false,
        }
    }

    /// The next candidates, at most `limit`: first the population itself, then a mutant of each member.
    pub(super) fn trials(&mut self, limit: usize) -> Vec<Trial> {
        (0..MEMBERS.min(limit))
            .map(|index| {
                let point = if self.judged {
                    self.mutant(index)
                } else {
                    self.members[index].point
                };
                let to_beat = self.members[index].cost;
                Trial {
                    index,
                    settings: self.bounds.settings(&point),
                    to_beat,
                    point,
                }
            })
            .collect()
    }

    /// `x + F (good - x) + F (a - b)`, some coordinates of `x` kept; `good` is one of the best few.
    fn mutant(&mut self, index: usize) -> Point {
        let (x, best) = (self.members[index].point, self.good().point);
        let (a, b) = (self.other().point, self.other().point);
        let scale = self.random.between(0.4, 0.9);
        let searched = self.bounds.searched();
        let kept = (self.random.uniform() * searched as f64) as usize;
        let mut point = x;
        for i in 0..searched {
            if i == kept || self.random.uniform() < CROSSOVER {
                let moved = x[i] + scale * (best[i] - x[i]) + scale * (a[i] - b[i]);
                // Beyond a bound: half way to it.
                point[i] = if moved < 0.0 {
                    x[i] / 2.0
                } else if moved > 1.0 {
                    (1.0 + x[i]) / 2.0
                } else {
                    moved
                };
            }
        }
        point
    }

    fn good(&mut self) -> Member {
        let mut order: [usize; MEMBERS] = std::array::from_fn(|i| i);
        order.sort_by(|&a, &b| self.members[a].cost.total_cmp(&self.members[b].cost));
        self.members[order[(self.random.uniform() * GOOD as f64) as usize]]
    }

    fn other(&mut self) -> Member {
        let index = (self.random.uniform() * MEMBERS as f64) as usize;
        self.members[index]
    }

    /// Lets each trial replace its member where it is better.
    pub(super) fn select(&mut self, trials: &[Trial], costs: &[f64]) {
        self.judged = true;
        for (trial, &cost) in trials.iter().zip(costs) {
            let member = &mut self.members[trial.index];
            if cost < member.cost {
                *member = Member {
                    point: trial.point,
                    cost,
                };
            }
        }
    }

    fn best(&self) -> Member {
        let first = self.members[0];
        self.members
            .iter()
            .fold(first, |best, m| if m.cost < best.cost { *m } else { best })
    }

    pub(super) fn best_cost(&self) -> f64 {
        self.best().cost
    }

    /// The best member, or the start where that is as good.
    pub(super) fn best_or(&self, start: Settings<f64>, cost: f64) -> (Settings<f64>, f64) {
        let best = self.best();
        if best.cost < cost {
            (self.bounds.settings(&best.point), best.cost)
        } else {
            (start, cost)
        }
    }

    pub(super) fn converged(&self) -> bool {
        let worst = self
            .members
            .iter()
            .fold(0.0, |worst, m| f64::max(worst, m.cost));
        self.judged && worst - self.best_cost() <= TOGETHER * self.best_cost()
    }
}
