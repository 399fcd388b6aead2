//! Sine and cosine of an angle together, the same bits on every platform.

/// 2/pi, and pi/2 in two parts whose products with small whole numbers are exact (Cody and Waite 1980).
const PER_QUADRANT: f64 = std::f64::consts::FRAC_2_PI;
const QUADRANT: [f64; 2] = [1.570_796_326_734_125_6, 6.077_100_506_506_192e-11];

/// Adding this rounds a double to the nearest whole number and leaves that number in its low bits.
const ROUND: f64 = 6_755_399_441_055_744.0;

/// `(sin x, cos x)` for `|x|` below 1e5, to a few units of the last place.
///
/// Minimax polynomials of fdlibm on `[-pi/4, pi/4]`; arithmetic only, hence no platform's own last bits.
#[inline(always)]
pub fn sin_cos(x: f64) -> (f64, f64) {
    let rounded = x * PER_QUADRANT + ROUND;
    let (whole, quadrant) = (rounded - ROUND, rounded.to_bits());
    let r = (x - whole * QUADRANT[0]) - whole * QUADRANT[1];
    let (s, c) = kernel(r);
    let odd = quadrant & 1 != 0;
    let (s, c) = if odd { (c, s) } else { (s, c) };
    (negate(s, quadrant), negate(c, quadrant.wrapping_add(1)))
}

/// The largest turn whose series below are exact to rounding: the next terms are `e^9/9!` and `e^10/10!`.
const SMALL_TURN: f64 = 0.07;

/// Sine and versine `1 - cos e` of a turn, of a small one in a third of the time that [`sin_cos`] takes.
#[inline(always)]
pub fn turn(e: f64) -> (f64, f64) {
    if e.abs() > SMALL_TURN {
        let (sine, cosine) = sin_cos(e);
        return (sine, 1.0 - cosine);
    }
    let e2 = e * e;
    let e4 = e2 * e2;
    let sine = (1.0 - e2 * (1.0 / 6.0)) + e4 * (1.0 / 120.0 - e2 * (1.0 / 5_040.0));
    let versine = (0.5 - e2 * (1.0 / 24.0)) + e4 * (1.0 / 720.0 - e2 * (1.0 / 40_320.0));
    (e * sine, e2 * versine)
}

/// `(sin(x + e), cos(x + e))` from `(sin x, cos x)` and the [`turn`] by `e`.
#[inline(always)]
pub fn turned((s, c): (f64, f64), (sine, versine): (f64, f64)) -> (f64, f64) {
    (s + (c * sine - s * versine), c - (s * sine + c * versine))
}

/// Changes the sign of `value` where bit 1 of `quadrant` is set.
#[inline(always)]
fn negate(value: f64, quadrant: u64) -> f64 {
    f64::from_bits(value.to_bits() ^ ((quadrant & 2) << 62))
}

/// Sine and cosine on `[-pi/4, pi/4]`, summed in pairs so that the processor can overlap them.
#[inline(always)]
fn kernel(r: f64) -> (f64, f64) {
    let z = r * r;
    let z2 = z * z;
    let s = (-1.666_666_666_666_663_2e-1 + z * 8.333_333_333_322_49e-3)
        + z2 * ((-1.984_126_982_985_795e-4 + z * 2.755_731_370_707_006_8e-6)
            + z2 * (-2.505_076_025_340_686_3e-8 + z * 1.589_690_995_211_55e-10));
    let c = (4.166_666_666_666_66e-2 + z * -1.388_888_888_887_411e-3)
        + z2 * ((2.480_158_728_947_673e-5 + z * -2.755_731_435_139_066_3e-7)
            + z2 * (2.087_572_321_298_175e-9 + z * -1.135_964_755_778_819_5e-11));
    (r + r * z * s, 1.0 - 0.5 * z + z2 * c)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_by_any_angle() {
        for k in -4_000..4_000 {
            let (x, e) = (f64::from(k) * 0.003_7, f64::from(k % 97) * 1e-3);
            let (s, c) = turned(sin_cos(x), turn(e));
            assert!(
                (s - (x + e).sin()).abs() < 1e-15 && (c - (x + e).cos()).abs() < 1e-15,
                "{e} from {x}"
            );
        }
    }

    #[test]
    fn agrees_with_the_standard_library() {
        for k in -20_000..20_000 {
            let x = f64::from(k) * 0.003_7;
            let (s, c) = sin_cos(x);
            assert!(
                (s - x.sin()).abs() < 1e-15 && (c - x.cos()).abs() < 1e-15,
                "at {x}"
            );
        }
    }
}
