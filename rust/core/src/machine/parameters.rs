//! The machine's parameters: names, units, defaults, sensible ranges and the spread between machines of one type.

use crate::random::Random;
use crate::{Error, Result};
use std::f64::consts::TAU;

/// The highest frequency of a shaft [Hz].
const RESONANCE: f64 = 1000.0;

/// The highest rate at which a shaft's damping may equalise the speeds [1/s].
const RELAXATION: f64 = 5000.0;

/// How a parameter varies between machines of the same type (uniformly distributed).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Spread {
    /// The same in every machine.
    Fixed,
    /// Up to this fraction of the nominal value in either direction.
    Relative(f64),
    /// Up to this much in either direction.
    Absolute(f64),
}

use Spread::{Absolute, Fixed, Relative};

/// The table entry of a parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Entry {
    /// The parameter's name, as everywhere.
    pub name: &'static str,
    /// Its unit; `1` for a pure number.
    pub unit: &'static str,
    /// The nominal machine's value.
    pub default: f64,
    /// The least sensible value.
    pub low: f64,
    /// The largest sensible value.
    pub high: f64,
    /// How much it differs between machines.
    pub spread: Spread,
}

macro_rules! parameters {
    ($($(#[$doc:meta])+ $name:ident: $unit:literal = $default:expr, $low:expr, $high:expr, $spread:expr;)+) => {
        /// Every number of the machine, with its unit.
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub struct Parameters {
            $($(#[$doc])+ #[doc = concat!(" Unit: ", $unit, ".")] pub $name: f64,)+
        }

        impl Parameters {
            /// What is known about each parameter, in the order of [`Parameters::values`].
            pub const TABLE: &'static [Entry] = &[$(Entry {
                name: stringify!($name), unit: $unit, default: $default, low: $low, high: $high, spread: $spread,
            },)+];

            /// The values in the order of [`Parameters::TABLE`].
            pub fn values(&self) -> Vec<f64> {
                vec![$(self.$name,)+]
            }

            fn slot(&mut self, name: &str) -> Option<&mut f64> {
                match name {
                    $(stringify!($name) => Some(&mut self.$name),)+
                    _ => None,
                }
            }
        }

        impl Default for Parameters {
            fn default() -> Self {
                Self { $($name: $default,)+ }
            }
        }
    };
}

parameters! {
    /// Largest command to either side; beyond it the command is clipped.
    u_limit: "V" = 20.0, 0.1, 1e3, Fixed;
    /// Mean inverter voltage per command voltage.
    amplifier_gain: "V/V" = 15.0, 1e-2, 1e3, Relative(0.05);
    /// Bus voltage of the inverter, the most it can give.
    bus_voltage: "V" = 310.0, 1.0, 2e3, Relative(0.05);
    /// Switching frequency of the inverter.
    pwm_frequency: "Hz" = 10e3, 1e3, 1e6, Fixed;
    /// Dead time between the switches of a leg.
    dead_time: "s" = 0.4e-6, 0.0, 2e-5, Relative(0.25);
    /// Current ripple, over which the sign of the current in the dead-time error is smoothed.
    ripple_current: "A" = 0.08, 0.02, 10.0, Relative(0.2);
    /// Resistance of winding and inverter.
    resistance: "ohm" = 10.5, 1e-2, 1e3, Relative(0.1);
    /// Inductance of winding and output choke.
    inductance: "H" = 0.077, 1e-2, 10.0, Relative(0.1);
    /// Torque per current, equal to back-EMF per speed [V s/rad].
    motor_constant: "N m/A" = 0.283, 1e-3, 10.0, Relative(0.04);
    /// Where the drive limits the current.
    current_limit: "A" = 19.5, 0.1, 1e3, Relative(0.03);
    /// Mean inertia at the crank shaft.
    inertia: "kg m^2" = 2e-3, 1e-4, 1.0, Relative(0.15);
    /// Amplitude of the inertia's variation (twice per turn) relative to its mean.
    inertia_variation: "1" = 0.005, 0.0, 0.5, Relative(0.2);
    /// Crank angle of the largest inertia.
    inertia_angle: "rad" = 0.0, -7.0, 7.0, Absolute(0.2);
    /// Coulomb friction torque.
    coulomb_torque: "N m" = 0.1, 0.0, 10.0, Relative(0.3);
    /// What friction at standstill exceeds Coulomb friction by.
    stribeck_torque: "N m" = 0.05, 0.0, 10.0, Relative(0.3);
    /// Speed at which half of the excess is gone.
    stribeck_speed: "rad/s" = 10.0, 1.0, 1e3, Relative(0.3);
    /// Viscous friction.
    viscous_friction: "N m s/rad" = 2.4e-4, 0.0, 0.1, Relative(0.3);
    /// Amplitude of the load torque that varies once per turn.
    load_first: "N m" = 0.06, 0.0, 10.0, Relative(0.15);
    /// Crank angle at which the once-per-turn load brakes most.
    load_first_angle: "rad" = 0.6, -7.0, 7.0, Absolute(0.3);
    /// Amplitude of the load torque that varies twice per turn.
    load_second: "N m" = 0.03, 0.0, 10.0, Relative(0.15);
    /// Crank angle at which the twice-per-turn load brakes most.
    load_second_angle: "rad" = -0.9, -7.0, 7.0, Absolute(0.3);
    /// Torque ripple relative to the torque, at twice the electrical angle of two pole pairs: 4 times per turn.
    torque_ripple: "1" = 0.03, 0.0, 0.5, Relative(0.3);
    /// Crank angle of a ripple maximum.
    torque_ripple_angle: "rad" = 0.1, -7.0, 7.0, Absolute(0.25);
    /// Crank angle after a reset.
    initial_angle: "rad" = 0.0, -7.0, 7.0, Absolute(3.0);
    /// Encoder counts per turn.
    counts_per_rev: "1" = 1572.0, 1.0, 1e7, Fixed;
    /// Where between two edges the encoder stands after a reset.
    encoder_phase: "counts" = 0.5, 0.0, 0.999_999, Absolute(0.4);
    /// Inertia of a second mass behind an elastic shaft; 0: there is none.
    load_inertia: "kg m^2" = 0.0, 0.0, 1.0, Fixed;
    /// Stiffness of that shaft.
    shaft_stiffness: "N m/rad" = 200.0, 1e-2, 1e6, Fixed;
    /// Damping of that shaft.
    shaft_damping: "N m s/rad" = 0.01, 0.0, 10.0, Fixed;
    /// Play of that shaft, from one side to the other.
    shaft_backlash: "rad" = 0.0, 0.0, 1.0, Fixed;
    /// 1: load, inertia and torque vary over the turn; 0: they have their means.
    angle_dependence: "switch" = 1.0, 0.0, 1.0, Fixed;
    /// 1: counts are whole; 0: they are the exact position.
    quantisation: "switch" = 1.0, 0.0, 1.0, Fixed;
}

impl Parameters {
    /// Another machine of the same type: each parameter varied within its spread, the same for the same seed.
    pub fn variant(seed: u64) -> Self {
        let mut parameters = Self::default();
        for (stream, entry) in Self::TABLE.iter().enumerate() {
            let draw = Random::stream(seed, stream as u64).between(-1.0, 1.0);
            let moved = match entry.spread {
                Fixed => entry.default,
                Relative(spread) => entry.default * (1.0 + spread * draw),
                Absolute(spread) => entry.default + spread * draw,
            };
            parameters.put(entry.name, moved);
        }
        parameters
    }

    /// The same parameters with `changes` by name.
    ///
    /// # Errors
    /// A setting error for an unknown name and for a value that [`Parameters::validated`] refuses.
    pub fn with<'a>(mut self, changes: impl IntoIterator<Item = (&'a str, f64)>) -> Result<Self> {
        for (name, value) in changes {
            if !self.put(name, value) {
                return Err(unknown(name));
            }
        }
        self.validated()
    }

    /// The parameters, if each is finite and within its sensible range and the switches are 0 or 1.
    ///
    /// # Errors
    /// A setting error that names the parameter.
    pub fn validated(self) -> Result<Self> {
        for (entry, value) in Self::TABLE.iter().zip(self.values()) {
            let switch = entry.unit == "switch" && value != 0.0 && value != 1.0;
            if switch || !(entry.low..=entry.high).contains(&value) {
                return Err(out_of_range(entry, value));
            }
        }
        self.check_shaft()?;
        Ok(self)
    }

    /// Checks that the integration can handle the shaft.
    fn check_shaft(&self) -> Result<()> {
        if self.load_inertia == 0.0 {
            return Ok(());
        }
        let least = self.inertia * (1.0 - self.angle_dependence * self.inertia_variation);
        let inverse = 1.0 / least + 1.0 / self.load_inertia;
        let resonance = (self.shaft_stiffness * inverse).sqrt() / TAU;
        if resonance > RESONANCE {
            return Err(Error::setting(format!(
                "expected a shaft whose masses swing at up to {RESONANCE} Hz, got {resonance:.0} Hz; lower \
                 'shaft_stiffness', or leave 'load_inertia' at 0 and raise 'inertia'"
            )));
        }
        if self.shaft_damping * inverse > RELAXATION {
            return Err(Error::setting(format!(
                "expected machine parameter 'shaft_damping' up to {} N m s/rad with these inertias, got {}",
                RELAXATION / inverse,
                self.shaft_damping
            )));
        }
        Ok(())
    }

    fn put(&mut self, name: &str, value: f64) -> bool {
        self.slot(name).map(|slot| *slot = value).is_some()
    }
}

fn unknown(name: &str) -> Error {
    let known: Vec<_> = Parameters::TABLE.iter().map(|entry| entry.name).collect();
    Error::setting(format!(
        "expected the name of a machine parameter, got '{name}'; known are {}",
        known.join(", ")
    ))
}

fn out_of_range(entry: &Entry, value: f64) -> Error {
    let Entry {
        name,
        low,
        high,
        unit,
        ..
    } = entry;
    Error::setting(if *unit == "switch" {
        format!("expected 0 or 1 for machine parameter '{name}', got {value}")
    } else {
        format!(
            "expected machine parameter '{name}' between {low} and {high} {unit}, got {value}; \
             the nominal machine has {}",
            entry.default
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_and_variants_are_valid() {
        assert!(Parameters::default().validated().is_ok());
        for seed in 0..500 {
            assert!(Parameters::variant(seed).validated().is_ok());
        }
    }

    #[test]
    fn variants_repeat_for_a_seed_and_differ_between_seeds() {
        assert_eq!(Parameters::variant(3), Parameters::variant(3));
        assert_ne!(Parameters::variant(3), Parameters::variant(4));
        assert_ne!(Parameters::variant(0), Parameters::default());
    }

    #[test]
    fn every_parameter_refuses_what_is_not_sensible_by_name() {
        for entry in Parameters::TABLE {
            for bad in [f64::NAN, f64::INFINITY, entry.high + 1.0, entry.low - 1.0] {
                let error = Parameters::default().with([(entry.name, bad)]).unwrap_err();
                assert!(error.message.contains(entry.name), "{error}");
            }
        }
        let error = Parameters::default().with([("mass", 1.0)]).unwrap_err();
        assert!(error.message.contains("'mass'") && error.message.contains("inertia"));
        assert!(Parameters::default().with([("quantisation", 0.5)]).is_err());
    }

    #[test]
    fn changes_are_made_by_name() {
        let changed = Parameters::default().with([("inertia", 4e-3)]).unwrap();
        assert_eq!(
            changed,
            Parameters {
                inertia: 4e-3,
                ..Parameters::default()
            }
        );
    }
}
