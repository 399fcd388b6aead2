//! Tail and quantile of the chi-square distribution.

/// A number so small that it only keeps a division from dividing by zero.
const TINY: f64 = 1e-300;
const MOST_TERMS: usize = 100_000;

/// Probability that a chi-square variable of at least one degree of freedom exceeds `x`; NaN for a NaN.
///
/// `Q(a, z)` with `a = freedom/2`, `z = x/2`: power series of `P` below `a + 1`, Lentz's continued fraction above (Abramowitz and Stegun
/// 6.5.29 and 6.5.31).
pub fn tail(x: f64, freedom: usize) -> f64 {
    if x <= 0.0 {
        return 1.0;
    }
    if x.is_infinite() {
        return 0.0;
    }
    let (a, z) = (0.5 * freedom as f64, 0.5 * x);
    let scale = (a * z.ln() - z - ln_gamma_of_half(freedom)).exp();
    if z < a + 1.0 {
        (1.0 - scale * series(a, z)).max(0.0)
    } else {
        scale * fraction(a, z)
    }
}

/// The value that a chi-square variable exceeds with probability `share`, above 0 and below 1: bisection of [`tail`], which falls
/// everywhere.
pub fn quantile(share: f64, freedom: usize) -> f64 {
    let (mut low, mut high) = (0.0, freedom as f64);
    while tail(high, freedom) > share {
        low = high;
        high *= 2.0;
    }
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if tail(middle, freedom) > share {
            low = middle;
        } else {
            high = middle;
        }
        if high - low <= 1e-14 * high {
            break;
        }
    }
    0.5 * (low + high)
}

/// `ln Gamma(n/2)`, from `Gamma(1/2) = sqrt(pi)`, `Gamma(1) = 1` and `Gamma(x + 1) = x Gamma(x)`.
fn ln_gamma_of_half(n: usize) -> f64 {
    let start = if n.is_multiple_of(2) {
        0.0
    } else {
        0.5 * std::f64::consts::PI.ln()
    };
    let factors = (n % 2..n.saturating_sub(1)).step_by(2).filter(|k| *k > 0);
    start + factors.map(|k| (0.5 * k as f64).ln()).sum::<f64>()
}

fn series(a: f64, z: f64) -> f64 {
    let mut term = 1.0 / a;
    let mut total = term;
    for i in 1..MOST_TERMS {
        term *= z / (a + i as f64);
        total += term;
        if term < 1e-16 * total {
            break;
        }
    }
    total
}

fn fraction(a: f64, z: f64) -> f64 {
    let away = |v: f64| if v.abs() > TINY { v } else { TINY };
    let mut b = z + 1.0 - a;
    let (mut c, mut d) = (1.0 / TINY, 1.0 / b);
    let mut h = d;
    for i in 1..MOST_TERMS {
        let i = i as f64;
        let step = -i * (i - a);
        b += 2.0;
        d = 1.0 / away(step * d + b);
        c = away(b + step / c);
        h *= c * d;
        if (c * d - 1.0).abs() < 8e-16 {
            break;
        }
    }
    h
}
