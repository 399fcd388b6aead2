//! Gains of the two-degree-of-freedom PID in their three forms, with exact conversions.
//!
//! | form | terms | relation to the standard form |
//! |---|---|---|
//! | standard | `Kp (e + (1/Ti) int e dt + Td de/dt)` | |
//! | parallel | `Kp e + Ki int e dt + Kd de/dt` | `Ki = Kp/Ti`, `Kd = Kp Td` |
//! | per sample | `Kp e + Ki sum e + Kd (e(k) - e(k-1))` | `Ki = Kp Ts/Ti`, `Kd = Kp Td/Ts` |
//!
//! `Ti = inf` and `Ki = 0` both mean no integral action.

use crate::{Real, Refused};

/// Gain, integral time and derivative time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Standard<T> {
    /// Proportional gain \[u/y\].
    pub kp: T,
    /// Integral time \[s\], above 0; infinite for no integral action.
    pub ti: T,
    /// Derivative time \[s\], 0 or more.
    pub td: T,
}

/// One gain per term, in continuous time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parallel<T> {
    /// Proportional gain \[u/y\].
    pub kp: T,
    /// Integral gain \[u/(y s)\].
    pub ki: T,
    /// Derivative gain \[u s/y\].
    pub kd: T,
}

/// One gain per term, on sums and differences of samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PerSample<T> {
    /// Proportional gain \[u/y\].
    pub kp: T,
    /// Gain on the sum of errors \[u/y\].
    pub ki: T,
    /// Gain on the difference of errors \[u/y\].
    pub kd: T,
    /// Sample time at which the gains hold \[s\].
    pub ts: T,
}

impl<T: Real> Standard<T> {
    /// The gains, if they make sense.
    ///
    /// # Errors
    /// `Kp` or `Td` not finite, `Ti` not above 0, `Td` below 0.
    pub fn checked(self) -> Result<Self, Refused> {
        let Self { kp, ti, td } = self;
        Refused::unless(kp.is_finite(), "Kp", "a finite number", kp.to_f64())?;
        Refused::unless(ti > T::ZERO, "Ti", "a time above 0 s, or inf", ti.to_f64())?;
        Refused::unless(
            td >= T::ZERO && td.is_finite(),
            "Td",
            "a finite time of 0 s or more",
            td.to_f64(),
        )?;
        Ok(self)
    }

    /// `Ki = Kp/Ti`, `Kd = Kp Td`.
    pub fn to_parallel(self) -> Parallel<T> {
        Parallel {
            kp: self.kp,
            ki: self.kp / self.ti,
            kd: self.kp * self.td,
        }
    }

    /// `Ki = Kp Ts/Ti`, `Kd = Kp Td/Ts`.
    pub fn to_per_sample(self, ts: T) -> PerSample<T> {
        self.to_parallel().to_per_sample(ts)
    }
}

impl<T: Real> Parallel<T> {
    /// `Ti = Kp/Ki`, `Td = Kd/Kp`.
    ///
    /// # Errors
    /// Gains that are not finite or have different signs, or an integral or derivative gain with `Kp = 0`, which the
    /// standard form cannot express.
    pub fn to_standard(self) -> Result<Standard<T>, Refused> {
        let Self { kp, ki, kd } = self;
        for (name, gain) in [("Kp", kp), ("Ki", ki), ("Kd", kd)] {
            Refused::unless(gain.is_finite(), name, "a finite number", gain.to_f64())?;
        }
        for (name, gain) in [("Ki", ki), ("Kd", kd)] {
            let expressible =
                gain == T::ZERO || (gain > T::ZERO) == (kp > T::ZERO) && kp != T::ZERO;
            let expected = "0 or a gain of the sign of Kp (the standard form factors Kp out)";
            Refused::unless(expressible, name, expected, gain.to_f64())?;
        }
        let ratio = |gain: T| if gain == T::ZERO { T::ZERO } else { gain / kp };
        let ti = if ki == T::ZERO { T::INFINITY } else { kp / ki };
        Standard {
            kp,
            ti,
            td: ratio(kd),
        }
        .checked()
    }

    /// `Ki' = Ki Ts`, `Kd' = Kd/Ts`.
    pub fn to_per_sample(self, ts: T) -> PerSample<T> {
        PerSample {
            kp: self.kp,
            ki: self.ki * ts,
            kd: self.kd / ts,
            ts,
        }
    }
}

impl<T: Real> PerSample<T> {
    /// `Ki = Ki'/Ts`, `Kd = Kd' Ts`.
    pub fn to_parallel(self) -> Parallel<T> {
        Parallel {
            kp: self.kp,
            ki: self.ki / self.ts,
            kd: self.kd * self.ts,
        }
    }

    /// `Ti = Kp Ts/Ki'`, `Td = Kd' Ts/Kp`.
    ///
    /// # Errors
    /// A sample time that is not above 0, and everything that [`Parallel::to_standard`] refuses.
    pub fn to_standard(self) -> Result<Standard<T>, Refused> {
        sample_time(self.ts)?;
        self.to_parallel().to_standard()
    }
}

/// Refuses a sample time that is not finite or not above 0.
pub(crate) fn sample_time<T: Real>(ts: T) -> Result<(), Refused> {
    let positive = ts > T::ZERO && ts.is_finite();
    Refused::unless(
        positive,
        "Ts",
        "a finite sample time above 0 s",
        ts.to_f64(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn close(a: f64, b: f64) -> bool {
        a == b || (a - b).abs() <= 4.0 * f64::EPSILON * a.abs().max(b.abs())
    }

    proptest! {
        #[test]
        fn standard_survives_the_way_through_both_other_forms(
            kp in prop_oneof![1e-6..1e6, -1e6..-1e-6],
            ti in prop_oneof![1e-6..1e6, Just(f64::INFINITY)],
            td in prop_oneof![1e-6..1e6, Just(0.0)],
            ts in 1e-6..1.0,
        ) {
            let gains = Standard { kp, ti, td };
            for back in [gains.to_parallel().to_standard(), gains.to_per_sample(ts).to_standard()] {
                let back = back.unwrap();
                prop_assert!(close(back.kp, kp) && close(back.ti, ti) && close(back.td, td), "{back:?}");
            }
        }

        #[test]
        fn per_sample_survives_the_way_through_parallel(
            kp in -1e3..1e3, ki in -1e3..1e3, kd in -1e3..1e3, ts in 1e-6..1.0,
        ) {
            let back = PerSample { kp, ki, kd, ts }.to_parallel().to_per_sample(ts);
            prop_assert!(close(back.ki, ki) && close(back.kd, kd));
        }
    }

    #[test]
    fn converts_the_gains_of_the_paper() {
        let paper = PerSample {
            kp: 0.02,
            ki: 0.02,
            kd: 0.5,
            ts: 1e-3,
        };
        let standard = paper.to_standard().unwrap();
        assert!(
            close(standard.ti, 1e-3) && close(standard.td, 0.025),
            "{standard:?}"
        );
        let parallel = paper.to_parallel();
        assert!(
            close(parallel.ki, 20.0) && close(parallel.kd, 5e-4),
            "{parallel:?}"
        );
    }

    #[test]
    fn no_integral_action_is_infinite_ti_and_zero_ki() {
        let gains = Standard {
            kp: 2.0_f32,
            ti: f32::INFINITY,
            td: 0.0,
        };
        assert_eq!(gains.to_parallel().ki, 0.0);
        assert_eq!(gains.to_parallel().to_standard(), Ok(gains));
        let off = Parallel {
            kp: 0.0,
            ki: 0.0,
            kd: 0.0,
        }
        .to_standard()
        .unwrap();
        assert_eq!(
            off,
            Standard {
                kp: 0.0,
                ti: f64::INFINITY,
                td: 0.0
            }
        );
    }

    #[test]
    fn refuses_what_the_standard_form_cannot_express() {
        let refused = |kp, ki, kd| Parallel { kp, ki, kd }.to_standard().unwrap_err().name;
        assert_eq!(refused(0.0, 1.0, 0.0), "Ki");
        assert_eq!(refused(1.0, -1.0, 0.0), "Ki");
        assert_eq!(refused(-1.0, -1.0, 1.0), "Kd");
        assert_eq!(refused(f64::NAN, 0.0, 0.0), "Kp");
        let per_sample = PerSample {
            kp: 1.0,
            ki: 1.0,
            kd: 0.0,
            ts: 0.0,
        };
        assert_eq!(per_sample.to_standard().unwrap_err().name, "Ts");
        for ti in [0.0, -1.0, f64::NAN] {
            assert_eq!(
                Standard {
                    kp: 1.0,
                    ti,
                    td: 0.0
                }
                .checked()
                .unwrap_err()
                .name,
                "Ti"
            );
        }
        assert_eq!(
            Standard {
                kp: 1.0,
                ti: 1.0,
                td: -1.0
            }
            .checked()
            .unwrap_err()
            .name,
            "Td"
        );
    }
}
