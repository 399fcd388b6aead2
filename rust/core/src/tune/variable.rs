//! The variables of a search: parameters of a controller with their bounds and scales.

use std::f64::consts::PI;

use sewfast_control::{
    AnyDesign, Biquad, Cascade, Design, Point, Schedule, Standard, StateDesign, lqg,
};

use crate::{Error, Result};

/// A number of a controller that can be searched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(
    missing_docs,
    reason = "the names are those of the controller's settings"
)]
pub enum Parameter {
    Kp,
    Ti,
    Td,
    Alpha,
    Beta,
    N,
    Tt,
    FilterSamples,
    FilterTime,
    ObserverTime,
    RRate,
    /// State feedback: what its gains are designed from, and its feedforward.
    Rho,
    Integral,
    Noise,
    Weight,
    Lead,
    /// `Kp`, `Ti` and `Td` of a point of the gain schedule, counted from 0.
    KpAt(usize),
    TiAt(usize),
    TdAt(usize),
    /// A biquad that is a notch, counted from 0.
    NotchFrequency(usize),
    NotchDepth(usize),
    NotchWidth(usize),
}

const NAMES: [(&str, Parameter); 16] = [
    ("Kp", Parameter::Kp),
    ("Ti", Parameter::Ti),
    ("Td", Parameter::Td),
    ("alpha", Parameter::Alpha),
    ("beta", Parameter::Beta),
    ("N", Parameter::N),
    ("Tt", Parameter::Tt),
    ("filter_samples", Parameter::FilterSamples),
    ("filter_time", Parameter::FilterTime),
    ("observer_time", Parameter::ObserverTime),
    ("r_rate", Parameter::RRate),
    ("rho", Parameter::Rho),
    ("integral", Parameter::Integral),
    ("noise", Parameter::Noise),
    ("weight", Parameter::Weight),
    ("lead", Parameter::Lead),
];

impl Parameter {
    /// By its name. Gains of a schedule's points are `Kp[0]`, `Ti[0]`, `Td[0]`, `Kp[1]` and so on; notches, by the
    /// number of the biquad, `notch_frequency[0]`, `notch_depth[0]`, `notch_width[0]`.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for an unknown name.
    pub fn named(name: &str) -> Result<Self> {
        if let Some((_, parameter)) = NAMES.iter().find(|(known, _)| *known == name) {
            return Ok(*parameter);
        }
        let point = |gain: &str| -> Option<usize> {
            let inner = name.strip_prefix(gain)?.strip_prefix('[')?;
            inner.strip_suffix(']')?.parse().ok()
        };
        let numbered = NUMBERED.iter().find_map(|(known, of)| point(known).map(of));
        numbered.ok_or_else(|| {
            Error::setting(format!(
                "expected a variable named {}, Kp[0], Ti[0], Td[0] .. of a schedule's points, or notch_frequency[0], \
                 notch_depth[0], notch_width[0] .. of a notch, got '{name}'",
                NAMES.map(|(known, _)| known).join(", ")
            ))
        })
    }

    /// Its name.
    pub fn name(self) -> String {
        let known = NAMES.iter().find(|(_, parameter)| *parameter == self);
        match (self, known) {
            (_, Some((name, _))) => (*name).into(),
            (Self::KpAt(k), _) => format!("Kp[{k}]"),
            (Self::TiAt(k), _) => format!("Ti[{k}]"),
            (Self::TdAt(k), _) => format!("Td[{k}]"),
            (Self::NotchFrequency(k), _) => format!("notch_frequency[{k}]"),
            (Self::NotchDepth(k), _) => format!("notch_depth[{k}]"),
            (Self::NotchWidth(k), _) => format!("notch_width[{k}]"),
            _ => String::new(),
        }
    }

    /// Its value in a design; NaN if the design has no such parameter.
    pub fn of(self, design: &AnyDesign<f64>) -> f64 {
        match design {
            AnyDesign::Pid(design) => self.of_pid(design),
            AnyDesign::StateFeedback(design) => self.of_states(design),
        }
    }

    /// NaN for a parameter that state feedback does not have.
    fn of_states(self, design: &StateDesign<f64>) -> f64 {
        match self {
            Self::Rho => design.weights.rho,
            Self::Integral => design.weights.integral,
            Self::Noise => design.weights.noise,
            Self::Weight => design.weights.reference,
            Self::Lead => design.lead,
            Self::RRate => design.r_rate,
            _ => f64::NAN,
        }
    }

    /// NaN for a point that the schedule does not have, or a biquad that is no notch.
    fn of_pid(self, design: &Design<f64>) -> f64 {
        let point = |k: usize, gain: fn(&Standard<f64>) -> f64| {
            let points = design.schedule.points();
            points.get(k).map_or(f64::NAN, |point| gain(&point.gains))
        };
        let notch = |k: usize, of: fn(&Notch) -> f64| {
            let section = design.biquads.sections().get(k);
            let notch = section.and_then(|section| Notch::of(section, design.pid.ts));
            notch.map_or(f64::NAN, |notch| of(&notch))
        };
        match self {
            Self::Kp => design.pid.gains.kp,
            Self::Ti => design.pid.gains.ti,
            Self::Td => design.pid.gains.td,
            Self::Alpha => design.pid.alpha,
            Self::Beta => design.pid.beta,
            Self::N => design.pid.n,
            Self::Tt => design.pid.tt,
            Self::FilterSamples => design.filter_samples as f64,
            Self::FilterTime => design.filter_time,
            Self::ObserverTime => design.observer_time,
            Self::RRate => design.r_rate,
            Self::Rho | Self::Integral | Self::Noise | Self::Weight | Self::Lead => f64::NAN,
            Self::KpAt(k) => point(k, |g| g.kp),
            Self::TiAt(k) => point(k, |g| g.ti),
            Self::TdAt(k) => point(k, |g| g.td),
            Self::NotchFrequency(k) => notch(k, |n| n.frequency),
            Self::NotchDepth(k) => notch(k, |n| n.depth),
            Self::NotchWidth(k) => notch(k, |n| n.width),
        }
    }

    /// The biquad it belongs to.
    fn section(self) -> Option<usize> {
        match self {
            Self::NotchFrequency(k) | Self::NotchDepth(k) | Self::NotchWidth(k) => Some(k),
            _ => None,
        }
    }

    fn set(
        self,
        design: &mut Design<f64>,
        points: &mut [Point<f64>],
        notches: &mut [Option<Notch>],
        value: f64,
    ) {
        if let Some(Some(notch)) = self.section().and_then(|k| notches.get_mut(k)) {
            match self {
                Self::NotchFrequency(_) => notch.frequency = value,
                Self::NotchDepth(_) => notch.depth = value,
                _ => notch.width = value,
            }
            return;
        }
        match self {
            Self::Kp => design.pid.gains.kp = value,
            Self::Ti => design.pid.gains.ti = value,
            Self::Td => design.pid.gains.td = value,
            Self::Alpha => design.pid.alpha = value,
            Self::Beta => design.pid.beta = value,
            Self::N => design.pid.n = value,
            Self::Tt => design.pid.tt = value,
            Self::FilterSamples => design.filter_samples = value.round() as usize,
            Self::FilterTime => design.filter_time = value,
            Self::ObserverTime => design.observer_time = value,
            Self::RRate => design.r_rate = value,
            Self::KpAt(k) => points[k].gains.kp = value,
            Self::TiAt(k) => points[k].gains.ti = value,
            Self::TdAt(k) => points[k].gains.td = value,
            // a notch's, handled above; or state feedback's, refused before
            _ => {}
        }
    }

    fn is_linear(self) -> bool {
        matches!(
            self,
            Self::Alpha | Self::Beta | Self::FilterSamples | Self::Weight | Self::Lead
        )
    }

    /// Wide multiples of the start and of the sample time. A negative alpha or beta weights the reference by more than
    /// 1, as feedforward beside a slow feedback.
    fn bounds(self, start: &AnyDesign<f64>) -> Option<(f64, f64)> {
        let (ts, own) = (start.ts(), self.of(start));
        match self {
            Self::Kp | Self::KpAt(_) => Some(ordered(own / 50.0, own * 50.0)),
            Self::Ti | Self::TiAt(_) => Some((4.0 * ts, 1e4 * ts)),
            Self::Td | Self::TdAt(_) => Some((0.05 * ts, 200.0 * ts)),
            Self::Alpha => Some((-0.5, 1.2)),
            Self::Beta => Some((-8.0, 1.2)),
            Self::N => Some((1.0, 50.0)),
            Self::Tt => Some((2.0 * ts, 1e3 * ts)),
            Self::FilterSamples => Some((1.0, 24.0)),
            Self::FilterTime | Self::ObserverTime => Some((0.25 * ts, 30.0 * ts)),
            Self::RRate if own.is_finite() => Some((own / 10.0, own * 10.0)),
            Self::RRate => None,
            Self::Rho | Self::Noise => Some((1e-4 * own, 1e4 * own)),
            Self::Integral if own > 0.0 => Some((own / 100.0, own * 100.0)),
            Self::Integral => None,
            Self::Weight => Some((0.0, 1.2)),
            Self::Lead => Some((0.0, 30.0 * ts)),
            Self::NotchFrequency(_) => Some((own / 1.5, (own * 1.5).min(0.45 / ts))),
            Self::NotchDepth(_) => Some((0.01, 1.0)),
            Self::NotchWidth(_) => Some((0.05, 3.0)),
        }
    }
}

/// Makes the parameter of a point or biquad from its number.
type Numbered = fn(usize) -> Parameter;

const NUMBERED: [(&str, Numbered); 6] = [
    ("Kp", Parameter::KpAt),
    ("Ti", Parameter::TiAt),
    ("Td", Parameter::TdAt),
    ("notch_frequency", Parameter::NotchFrequency),
    ("notch_depth", Parameter::NotchDepth),
    ("notch_width", Parameter::NotchWidth),
];

/// A notch by its design parameters.
#[derive(Clone, Copy, Debug)]
struct Notch {
    frequency: f64,
    depth: f64,
    width: f64,
}

impl Notch {
    /// The arguments of [`Biquad::notch`]; `None` for another section.
    ///
    /// With `D0 = 1 + D1 + D2` the denominator is `4/D0` at `q = 1` and `4 D2/D0` at `q = -1`. The numerator differs
    /// from it by `c0 - c1 = 2 (N2 - D2)/D0` and `c0 + c1 = 2 (N1 - D1)/D0`. A notch has `N2 = D2`.
    fn of(section: &Biquad<f64>, ts: f64) -> Option<Self> {
        let Biquad { c0, c1, a1, a2 } = *section;
        let d0 = 4.0 / (1.0 + a1 + a2);
        let d2 = (1.0 - a1 + a2) / (1.0 + a1 + a2);
        let d1 = d0 - 1.0 - d2;
        let is_notch = (c0 - c1).abs() <= 1e-9 * (c0.abs() + c1.abs()) && d2 > 0.0;
        let t = d2.sqrt().recip();
        is_notch.then(|| Self {
            frequency: t.atan() / (PI * ts),
            depth: (1.0 + 0.5 * d0 * (c0 + c1) / d1).clamp(0.0, 1.0),
            width: d1 * t,
        })
    }
}

/// The bounds of a gain that may be negative.
fn ordered(one: f64, other: f64) -> (f64, f64) {
    (one.min(other), one.max(other))
}

/// A parameter between bounds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Variable {
    /// What is searched.
    pub parameter: Parameter,
    /// Least value.
    pub low: f64,
    /// Largest value.
    pub high: f64,
    /// Searched by its logarithm.
    logarithmic: bool,
    /// Whether the caller gave the bounds.
    given: bool,
}

impl Variable {
    /// A variable of a controller like `start`, between `bounds` or else the usual bounds.
    ///
    /// Times and gains are searched by their logarithm if the bounds have one sign; alpha, beta and samples linearly.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for bounds that are not finite or do not increase, a point that the schedule does not have,
    /// or no bounds for a parameter without usual ones.
    pub fn new(
        parameter: Parameter,
        bounds: Option<(f64, f64)>,
        start: &AnyDesign<f64>,
    ) -> Result<Self> {
        let name = parameter.name();
        match start {
            AnyDesign::Pid(design) => check_pid(parameter, design)?,
            AnyDesign::StateFeedback(design) => check_states(parameter, design)?,
        }
        let Some((low, high)) = bounds.or(parameter.bounds(start)) else {
            return Err(Error::setting(format!(
                "expected bounds for {name}, as the start has none; give (\"{name}\", low, high)"
            )));
        };
        if !(low < high && (high - low).is_finite()) {
            return Err(Error::setting(format!(
                "expected finite bounds for {name}, the lower one first, got {low} and {high}"
            )));
        }
        if bounds.is_some() {
            for value in [low, high] {
                Self::probe(parameter, value, start)?;
            }
        }
        Ok(Self {
            parameter,
            low,
            high,
            logarithmic: low * high > 0.0 && !parameter.is_linear(),
            given: bounds.is_some(),
        })
    }

    /// Refuses a bound that no controller can have.
    fn probe(parameter: Parameter, value: f64, start: &AnyDesign<f64>) -> Result<()> {
        let fixed = Self {
            parameter,
            low: value,
            high: value,
            logarithmic: false,
            given: true,
        };
        designed(&[fixed], &[0.0], start)
            .and_then(|design| Ok(design.controller()?))
            .map(drop)
    }

    /// The usual variables of a controller: its gains, alpha and beta, `N` if it has a derivative filter, its notches.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for a start without usual bounds.
    pub fn usual(start: &AnyDesign<f64>) -> Result<Vec<Self>> {
        let all = match start {
            AnyDesign::Pid(design) => usual_of_pid(design),
            AnyDesign::StateFeedback(_) => OF_STATES.to_vec(),
        };
        all.into_iter()
            .map(|parameter| Self::new(parameter, None, start))
            .collect()
    }

    /// The value at a position between 0 and 1.
    fn value(&self, place: f64) -> f64 {
        if self.logarithmic {
            let ratio = self.high / self.low;
            self.low * ratio.powf(place)
        } else {
            self.low + place * (self.high - self.low)
        }
    }

    /// The position of a value, clipped to the bounds.
    fn place(&self, value: f64) -> f64 {
        let place = if self.logarithmic {
            (value / self.low).ln() / (self.high / self.low).ln()
        } else {
            (value - self.low) / (self.high - self.low)
        };
        // A value of 0 or of the other sign has no logarithm; the smaller bound is the nearest.
        let smaller = if self.low.abs() < self.high.abs() {
            0.0
        } else {
            1.0
        };
        if place.is_nan() {
            smaller
        } else {
            place.clamp(0.0, 1.0)
        }
    }
}

/// The parameters of state feedback that are searched.
const OF_STATES: [Parameter; 5] = [
    Parameter::Rho,
    Parameter::Integral,
    Parameter::Noise,
    Parameter::Weight,
    Parameter::Lead,
];

/// Refuses a parameter that state feedback does not have.
fn check_states(parameter: Parameter, start: &StateDesign<f64>) -> Result<()> {
    if !parameter.of_states(start).is_nan() {
        return Ok(());
    }
    Err(Error::setting(format!(
        "expected a variable of state feedback, {} or r_rate, got {}; that is one of a PID",
        OF_STATES.map(Parameter::name).join(", "),
        parameter.name()
    )))
}

/// Refuses a parameter that a PID does not have or does not use.
fn check_pid(parameter: Parameter, start: &Design<f64>) -> Result<()> {
    let (name, absent) = (parameter.name(), parameter.of_pid(start).is_nan());
    if OF_STATES.contains(&parameter) {
        return Err(Error::setting(format!(
            "expected a variable of a PID, got {name}, which is one of state feedback; give a start of that kind"
        )));
    }
    if parameter.section().is_some() && absent {
        return Err(Error::setting(format!(
            "expected a variable of a controller whose biquad of that number is a notch, got {name} with {} biquads; they \
             count from 0",
            start.biquads.sections().len()
        )));
    }
    if absent {
        return Err(Error::setting(format!(
            "expected a variable of a controller with {} points in its schedule, got {name}; points count from 0",
            start.schedule.points().len()
        )));
    }
    let gain = matches!(parameter, Parameter::Kp | Parameter::Ti | Parameter::Td);
    if gain && !start.schedule.is_empty() {
        return Err(Error::setting(format!(
            "expected gains of the schedule's points, which the controller uses, got {name}; search {name}[0], {name}[1] .."
        )));
    }
    Ok(())
}

/// Gains, alpha and beta, `N` if there is a derivative filter, notches.
fn usual_of_pid(start: &Design<f64>) -> Vec<Parameter> {
    let points = start.schedule.points().len();
    let mut all = match points {
        0 => vec![Parameter::Kp, Parameter::Ti, Parameter::Td],
        _ => (0..points)
            .flat_map(|k| [Parameter::KpAt(k), Parameter::TiAt(k), Parameter::TdAt(k)])
            .collect(),
    };
    all.extend([Parameter::Alpha, Parameter::Beta]);
    if start.pid.n.is_finite() {
        all.push(Parameter::N);
    }
    for (k, section) in start.biquads.sections().iter().enumerate() {
        if Notch::of(section, start.pid.ts).is_some() {
            all.extend([
                Parameter::NotchFrequency(k),
                Parameter::NotchDepth(k),
                Parameter::NotchWidth(k),
            ]);
        }
    }
    all
}

/// The point of the box that belongs to a design.
pub(super) fn place(variables: &[Variable], design: &AnyDesign<f64>) -> Vec<f64> {
    variables
        .iter()
        .map(|v| v.place(v.parameter.of(design)))
        .collect()
}

/// A start clipped to the bounds that the caller gave.
pub(super) fn moved(variables: &[Variable], start: &AnyDesign<f64>) -> Result<AnyDesign<f64>> {
    let outside = |v: &&Variable| {
        let own = v.parameter.of(start);
        v.given && !(v.low <= own && own <= v.high)
    };
    let outside: Vec<Variable> = variables.iter().filter(outside).copied().collect();
    designed(&outside, &place(&outside, start), start)
}

/// The design at a point of the box; parameters that are not searched are the start's.
pub(super) fn designed(
    variables: &[Variable],
    point: &[f64],
    start: &AnyDesign<f64>,
) -> Result<AnyDesign<f64>> {
    match start {
        AnyDesign::Pid(start) => Ok(designed_pid(variables, point, start)?.into()),
        AnyDesign::StateFeedback(start) => Ok(designed_states(variables, point, start)?.into()),
    }
}

fn designed_states(
    variables: &[Variable],
    point: &[f64],
    start: &StateDesign<f64>,
) -> Result<StateDesign<f64>> {
    let (mut design, mut weights) = (*start, start.weights);
    for (variable, place) in variables.iter().zip(point) {
        let value = variable.value(*place);
        match variable.parameter {
            Parameter::Rho => weights.rho = value,
            Parameter::Integral => weights.integral = value,
            Parameter::Noise => weights.noise = value,
            Parameter::Weight => weights.reference = value,
            Parameter::Lead => design.lead = value,
            Parameter::RRate => design.r_rate = value,
            _ => {}
        }
    }
    // gains whose weights are not searched stay bit for bit
    Ok(if weights == start.weights {
        design
    } else {
        lqg(design, weights)?
    })
}

fn designed_pid(variables: &[Variable], point: &[f64], start: &Design<f64>) -> Result<Design<f64>> {
    let mut design = *start;
    let mut points = start.schedule.points().to_vec();
    // notches that are not searched stay bit for bit
    let searched = |k| variables.iter().any(|v| v.parameter.section() == Some(k));
    let sections = start.biquads.sections();
    let mut notches: Vec<_> = (0..sections.len())
        .map(|k| {
            searched(k)
                .then(|| Notch::of(&sections[k], start.pid.ts))
                .flatten()
        })
        .collect();
    for (variable, place) in variables.iter().zip(point) {
        let value = variable.value(*place);
        variable
            .parameter
            .set(&mut design, &mut points, &mut notches, value);
    }
    design.schedule = Schedule::new(&points)?;
    let section = |(own, notch): (&Biquad<f64>, &Option<Notch>)| match *notch {
        Some(Notch {
            frequency,
            depth,
            width,
        }) => Biquad::notch(frequency, depth, width, start.pid.ts),
        None => Ok(*own),
    };
    let sections = sections.iter().zip(&notches).map(section);
    let sections: std::result::Result<Vec<_>, _> = sections.collect();
    design.biquads = Cascade::new(&sections?)?;
    Ok(design)
}
