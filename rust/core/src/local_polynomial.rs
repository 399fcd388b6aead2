//! The frequency response of any record by local polynomials, without window or periods.
//!
//! The spectra of a finite record are related, at the line k of its transform, by `Y(k) = G(k) U(k) + T(k) + V(k)`. T is leakage: the
//! transient at the beginning of the record minus the one at its end. It is as smooth over the frequency as G, so over a few lines both are
//! parabolas, found by least squares; the residuals are noise, and give the variance (Pintelon and Schoukens, *System Identification: A
//! Frequency Domain Approach*, 2012, section 7.2). A window only reduces the leakage, and smears resonances. The leakage expected in an
//! interval is learned from all the others.
//!
//! The remaining question is the number of lines. The lines are divided into intervals: starting from wide ones, an interval is halved, and
//! its halves again, if Akaike's criterion, corrected for few lines, prefers two parabolas to one (Hurvich and Tsai, *Biometrika* 76, 1989).
//! Around a resonance the intervals become narrow; where the response is smooth they stay wide, and average more. Each is read at the three
//! Gauss points, where a parabola's error from a smooth curve is least; under even power the three errors are independent.

use nalgebra::{Complex, DMatrix};

use crate::column::{median, moments};
use crate::fourier;

type C64 = Complex<f64>;

/// Least lines of an interval: seven more than the coefficients of the two parabolas.
const LINES: usize = 13;
/// Largest width of an interval, relative to its first frequency.
const WIDEST: f64 = 0.25;
/// Width, relative to its frequency, below which an interval is not halved: fine enough for a damping of .003, while the time for long
/// records stays that of their transform.
const NARROWEST: f64 = 0.006;
/// Diagonal element of R, relative to the largest, below which a column adds nothing.
const RANK: f64 = 1e-9;
/// Magnitude, relative to the largest line, below which a line counts as empty.
const ROUNDING: f64 = 1e-13;
/// Mean square of the residual that cannot be distinguished from rounding.
const FLOOR: f64 = 1e-24;
/// The Gauss points: the middle, and as far to either side, sqrt(3/5).
const GAUSS: [f64; 3] = [-0.774_596_669_241_483_4, 0.0, 0.774_596_669_241_483_4];
/// Coefficients of a parabola, and of both.
const PARABOLA: usize = 3;
const BOTH: usize = 6;
/// Level of the test of a reference, and standard deviations above chance by which it must be visible in the input.
const LEVEL: f64 = 0.95;
const CHANCE: f64 = 3.0;
const TINY: f64 = 1e-300;

/// A response at its places.
#[derive(Clone, Debug, Default)]
pub struct Response {
    /// Numbers of the lines, in general between two.
    pub lines: Vec<f64>,
    /// Output over input.
    pub value: Vec<C64>,
    /// Variance of the value.
    pub variance: Vec<f64>,
    /// Share of the output that the input explains.
    pub coherence: Vec<f64>,
    /// Independent values that were averaged.
    pub blocks: Vec<f64>,
    /// Whether the reference, if there is one, is visible in the input beyond chance.
    pub is_related: bool,
}

/// The response of `y` to `u`, by a reference `r` in a closed loop: output and input are each related to it, and their quotient is the
/// plant. All have one length; none if the input, or the reference, has power at fewer than three frequencies.
pub fn response(u: &[f64], y: &[f64], r: Option<&[f64]>) -> Option<Response> {
    let top = |s: &[f64]| s.iter().fold(TINY, |most, v| v.abs().max(most));
    let (source, outputs) = match r {
        None => (spectrum(u, top(u)), vec![spectrum(y, top(y))]),
        Some(r) => (
            spectrum(r, top(r)),
            vec![spectrum(y, top(y)), spectrum(u, top(u))],
        ),
    };
    let lines = Lines {
        outputs: DMatrix::from_fn(source.len(), outputs.len(), |k, i| outputs[i][k]),
        source,
    };
    let pieces = lines.divided();
    if pieces.is_empty() {
        return None;
    }
    let mut found = Response {
        is_related: r.is_none() || is_related(&pieces),
        ..Response::default()
    };
    let leakage = leakage(&pieces);
    let scale = top(y) / top(u);
    for piece in pieces {
        let piece = lines.shrunk(piece, leakage);
        for (value, place, variance, coherence) in piece.response() {
            let (value, variance) = (value * scale, variance * scale * scale);
            if value.is_finite() && variance.is_finite() {
                found.lines.push(place);
                found.value.push(value);
                found.variance.push(variance.max(TINY));
                found.coherence.push(coherence);
                found.blocks.push(piece.freedom() + 1.0);
            }
        }
    }
    Some(found)
}

/// The lines above 0 and below half the sampling frequency; those at the level of rounding have no power.
fn spectrum(signal: &[f64], top: f64) -> Vec<C64> {
    let (middle, _) = moments(signal.iter().copied());
    let scaled: Vec<f64> = signal.iter().map(|v| (v - middle) / top).collect();
    let mut lines = fourier::lines(&scaled);
    lines.truncate(signal.len().div_ceil(2));
    lines.remove(0);
    let largest = lines.iter().map(|l| l.norm()).fold(0.0, f64::max);
    let empty = |l: &&mut C64| l.norm() < ROUNDING * largest;
    lines
        .iter_mut()
        .filter(empty)
        .for_each(|l| *l = C64::default());
    lines
}

/// The spectra: of what drives, and of the outputs, a column each.
struct Lines {
    source: Vec<C64>,
    outputs: DMatrix<C64>,
}

/// Two parabolas over the lines from index `start` to before `stop`.
#[derive(Clone)]
struct Piece {
    start: usize,
    stop: usize,
    /// What the source is divided by.
    scale: f64,
    /// Coefficients for each output: of the response to the scaled source, then of the leakage.
    solution: DMatrix<C64>,
    /// Inverse of the triangular factor R of the regressors.
    inverse: DMatrix<C64>,
    /// Sums of `conj(e_i) e_j` over the residuals of the outputs.
    products: DMatrix<C64>,
    /// Mean squared magnitude of the input, and of each output.
    power: f64,
    output: Vec<f64>,
}

impl Piece {
    fn lines(&self) -> usize {
        self.stop - self.start
    }

    /// Complex degrees of freedom that are left.
    fn freedom(&self) -> f64 {
        (self.lines() - BOTH) as f64
    }

    /// Variance of the noise over the power, for each output.
    fn ratio(&self) -> impl Iterator<Item = f64> {
        let of = |(i, power): (usize, &f64)| self.products[(i, i)].re / self.freedom() / power;
        self.output.iter().enumerate().map(of)
    }

    /// Akaike's corrected criterion; real and imaginary part of a line are two observations. Outputs count as independent: in a loop they
    /// share one noise, with a determinant of 0.
    fn criterion(&self) -> f64 {
        let (n, k) = (
            (2 * self.lines()) as f64,
            (2 * self.solution.nrows()) as f64,
        );
        let size = |i: usize| (2.0 * self.products[(i, i)].re / n + FLOOR).ln();
        let outputs = self.output.len();
        n * (0..outputs).map(size).sum::<f64>() + outputs as f64 * n * (n + k) / (n - k - 2.0)
    }

    /// Gains of the outputs at the Gauss points, a row each, and their variance under unit noise.
    fn gains(&self) -> (DMatrix<C64>, Vec<f64>) {
        let powers = DMatrix::from_fn(PARABOLA, PARABOLA, |i, j| {
            C64::from(GAUSS[i].powi(j as i32))
        });
        let gains = &powers * self.solution.rows(0, PARABOLA) / C64::from(self.scale);
        let spread = powers * self.inverse.rows(0, PARABOLA);
        let squares = spread
            .row_iter()
            .map(|row| row.norm_squared() / self.scale.powi(2));
        (gains, squares.collect())
    }

    /// Output over input, number of the line, variance, coherence.
    fn response(&self) -> impl Iterator<Item = (C64, f64, f64, f64)> {
        let (gains, spread) = self.gains();
        let c = &self.products / C64::from(self.freedom());
        let loops = self.output.len() == 2;
        (0..PARABOLA).map(move |i| {
            let (mut value, mut per, mut noise) = (gains[(i, 0)], 1.0, c[(0, 0)].re);
            if loops {
                // residual of the output minus the response times that of the input: the loop's noise
                value /= gains[(i, 1)];
                per = gains[(i, 1)].norm_sqr();
                noise += value.norm_sqr() * c[(1, 1)].re - 2.0 * (value * c[(0, 1)]).re;
                noise = noise.max(0.0);
            }
            let variance = noise * spread[i] / per;
            // an uncertain response must not appear large: subtract the contribution of its error
            let explained = (value.norm_sqr() - variance).max(0.0) * self.power;
            let share = explained / (explained + noise).max(TINY);
            let middle = 0.5 * (1.0 + GAUSS[i]) * (self.lines() - 1) as f64;
            (value, 1.0 + self.start as f64 + middle, variance, share)
        })
    }
}

impl Lines {
    /// The intervals, from the lowest line upwards.
    fn divided(&self) -> Vec<Piece> {
        let (mut found, mut start, lines) = (Vec::new(), 0, self.source.len());
        while lines - start >= LINES {
            let mut width = LINES.max((WIDEST * (start + 1) as f64) as usize);
            let mut piece = None;
            // a sparse multisine has no power in a few lines
            while piece.is_none() && width < 2 * lines {
                let stop = (start + width).min(lines);
                let stop = if lines - stop < LINES { lines } else { stop };
                piece = self.piece(start, stop);
                width *= 2;
            }
            let Some(piece) = piece else { break };
            start = piece.stop;
            found.extend(self.best(piece).1);
        }
        found
    }

    /// The piece itself, or the best of its halves if these have the lower criterion.
    fn best(&self, piece: Piece) -> (f64, Vec<Piece>) {
        let (length, own) = (piece.lines(), piece.criterion());
        let middle = piece.start + length / 2;
        let is_wide = length >= 2 * LINES && length as f64 >= NARROWEST * piece.start as f64;
        let halves = || {
            Some([
                self.piece(piece.start, middle)?,
                self.piece(middle, piece.stop)?,
            ])
        };
        if is_wide && let Some(halves) = halves() {
            let [(first, mut parts), (second, others)] = halves.map(|half| self.best(half));
            if first + second < own {
                parts.extend(others);
                return (first + second, parts);
            }
        }
        (own, vec![piece])
    }

    /// Fits one interval; none if the source has too little power there.
    fn piece(&self, start: usize, stop: usize) -> Option<Piece> {
        let seen = self.outputs.rows(start, stop - start);
        let scale = self.source[start..stop]
            .iter()
            .map(|l| l.norm())
            .fold(0.0, f64::max);
        if scale == 0.0 {
            return None;
        }
        let factor = self.regressors(start, stop, scale).qr();
        let (q, r) = (factor.q(), factor.r());
        let diagonal: Vec<f64> = r.diagonal().iter().map(|d| d.norm()).collect();
        let largest = diagonal.iter().copied().fold(0.0, f64::max);
        let k = diagonal.iter().take_while(|d| **d > RANK * largest).count();
        if k < PARABOLA {
            return None;
        }
        let (q, inverse) = (
            q.columns(0, k),
            inverse(&r.view((0, 0), (k, k)).into_owned())?,
        );
        let turned = q.ad_mul(&seen);
        let left = seen - q * &turned;
        let power = |i: usize| seen.column(i).norm_squared() / (stop - start) as f64;
        let own = self.source[start..stop].iter().map(|l| l.norm_sqr());
        Some(Piece {
            start,
            stop,
            scale,
            solution: &inverse * turned,
            inverse,
            products: left.ad_mul(&left),
            power: if seen.ncols() == 1 {
                own.sum::<f64>() / (stop - start) as f64
            } else {
                power(1)
            },
            output: (0..seen.ncols()).map(power).collect(),
        })
    }

    /// Parabolas times the source, and parabolas.
    fn regressors(&self, start: usize, stop: usize, scale: f64) -> DMatrix<C64> {
        let last = (stop - start - 1) as f64;
        DMatrix::from_fn(stop - start, BOTH, |k, j| {
            let x = 2.0 * k as f64 / last - 1.0;
            let power = x.powi((j % PARABOLA) as i32);
            let of = if j < PARABOLA {
                self.source[start + k] / scale
            } else {
                C64::from(1.0)
            };
            of * power
        })
    }

    /// The piece refitted with a prior on its leakage, from its size in other intervals.
    ///
    /// The prior adds three observations of 0 with that variance. If the command's own spectrum is smooth, as that of a chirp near its
    /// start, response and leakage cannot be separated otherwise.
    fn shrunk(&self, piece: Piece, leakage: [f64; PARABOLA]) -> Piece {
        let kept: Vec<usize> = (0..PARABOLA).filter(|i| leakage[*i] > 0.0).collect();
        let columns: Vec<usize> = (0..PARABOLA)
            .chain(kept.iter().map(|i| PARABOLA + i))
            .collect();
        let ratio = piece.ratio().fold(f64::INFINITY, f64::min);
        let lines = piece.lines();
        let regressors = self.regressors(piece.start, piece.stop, piece.scale);
        let all = DMatrix::from_fn(lines + kept.len(), columns.len(), |k, j| {
            match k.checked_sub(lines) {
                None => regressors[(k, columns[j])],
                Some(i) if j == PARABOLA + i => C64::from((ratio / leakage[kept[i]]).sqrt()),
                Some(_) => C64::default(),
            }
        });
        let factor = all.qr();
        let Some(inverse) = inverse(&factor.r()) else {
            return piece;
        };
        let seen = self.outputs.rows(piece.start, lines);
        let turned = factor.q().rows(0, lines).ad_mul(&seen);
        Piece {
            solution: &inverse * turned,
            inverse,
            ..piece
        }
    }
}

fn inverse(r: &DMatrix<C64>) -> Option<DMatrix<C64>> {
    r.solve_upper_triangular(&DMatrix::identity(r.nrows(), r.nrows()))
}

/// Mean squares of the leakage's three coefficients over the outputs' power, from the half of the intervals that determine them best.
fn leakage(pieces: &[Piece]) -> [f64; PARABOLA] {
    let full: Vec<&Piece> = pieces
        .iter()
        .filter(|p| p.solution.nrows() == BOTH)
        .collect();
    std::array::from_fn(|i| {
        let share = |p: &&Piece| {
            let row = p.solution.row(PARABOLA + i);
            let shares = row
                .iter()
                .zip(&p.output)
                .map(|(c, power)| c.norm_sqr() / power);
            shares.sum::<f64>() / p.output.len() as f64
        };
        let doubt = |p: &&Piece| {
            let ratio = p.ratio().sum::<f64>() / p.output.len() as f64;
            p.inverse.row(PARABOLA + i).norm_squared() * ratio
        };
        let doubts: Vec<f64> = full.iter().map(doubt).collect();
        let middle = median(doubts.clone());
        let clear = full
            .iter()
            .zip(&doubts)
            .filter(|(_, doubt)| **doubt <= middle);
        let excess: Vec<f64> = clear.map(|(p, doubt)| share(p) - doubt).collect();
        excess.iter().sum::<f64>().max(0.0) / excess.len().max(1) as f64
    })
}

/// Whether a reference is visible in the input more than by chance.
fn is_related(pieces: &[Piece]) -> bool {
    let seen = pieces.iter().flat_map(|piece| {
        let ((gains, spread), nu) = (piece.gains(), piece.freedom());
        let noise = piece.products[(1, 1)].re / nu;
        let quantile = nu * ((1.0 - LEVEL).powf(-1.0 / nu) - 1.0);
        (0..PARABOLA).map(move |i| gains[(i, 1)].norm_sqr() > quantile * noise * spread[i])
    });
    let seen: Vec<bool> = seen.collect();
    let (n, chance) = (seen.len() as f64, 1.0 - LEVEL);
    let share = seen.iter().filter(|s| **s).count() as f64 / n;
    share >= chance + CHANCE * (chance * LEVEL / n).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Noise through a lag of the first order with the pole .8, from a state far from rest.
    fn recorded(n: usize, noise: f64) -> (Vec<f64>, Vec<f64>) {
        let (mut random, mut x) = (Random::new(8), 5.0);
        let u: Vec<f64> = (0..n).map(|_| random.normal()).collect();
        let moved = |u: &f64| {
            let y = x + noise * random.normal();
            x = 0.8 * x + 0.2 * u;
            y
        };
        let y = u.iter().map(moved).collect();
        (u, y)
    }

    fn of_lag(line: f64, n: usize) -> C64 {
        let z = C64::from_polar(1.0, -std::f64::consts::TAU * line / n as f64);
        z * 0.2 / (C64::from(1.0) - z * 0.8)
    }

    #[test]
    fn a_lag_has_its_response_without_the_leakage_of_its_start() {
        for n in [1023, 1024, 1500] {
            let (u, y) = recorded(n, 0.01);
            let found = response(&u, &y, None).unwrap();
            assert!(found.is_related && found.lines.len() > 9);
            for i in 0..found.lines.len() {
                let off = (found.value[i] - of_lag(found.lines[i], n)).norm_sqr();
                assert!(off < 30.0 * found.variance[i] + 1e-6, "{n} {i}");
                assert!(found.coherence[i] > 0.9 && found.blocks[i] >= 8.0);
            }
        }
    }

    #[test]
    fn a_reference_must_move_the_input() {
        let (u, y) = recorded(1500, 0.01);
        let found = response(&u, &y, Some(&u)).unwrap();
        assert!(found.is_related);
        for i in 0..found.lines.len() {
            let off = (found.value[i] - of_lag(found.lines[i], 1500)).norm_sqr();
            assert!(off < 30.0 * found.variance[i] + 1e-6);
        }
        let (other, _) = recorded(3000, 0.0);
        assert!(!response(&u, &y, Some(&other[1500..])).unwrap().is_related);
        assert!(response(&[1.0; 200], &y[..200], None).is_none());
    }
}
