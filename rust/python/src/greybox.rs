//! Bindings of the grey-box motor, alone and with a network for what its equations leave unexplained, and of the tracker.

use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::{Listening, TRACKED, Tracker as Core};
use sewfast_core::Error;
use sewfast_core::greybox::{
    self, Current, Fit, Frame, JOINT, Measured, ORDERS, PARAMETERS, Pieces, Run, Smoothing,
};

use crate::models::{Kind, Model};
use crate::seam::{
    Experiments, Matrix, Raised, Rows, Values, Vector, array1, array2, raise, released, rows,
    samples, slice, watched, watched_over,
};

/// Speed, drive and their derivatives.
type Found<'py> = (Vector<'py>, Vector<'py>, Matrix<'py>, Matrix<'py>);

#[pyfunction]
#[pyo3(signature = (theta, free, u, *, Ts, steps, speed=0.0, mean=false, angle=None, orders=[0; ORDERS]))]
pub fn greybox_run<'py>(
    py: Python<'py>,
    theta: Values<'py>,
    free: Vec<usize>,
    u: Values<'py>,
    Ts: f64,
    steps: usize,
    speed: f64,
    mean: bool,
    angle: Option<Values<'py>>,
    orders: [u32; ORDERS],
) -> PyResult<Found<'py>> {
    let u = slice(&u, "u")?;
    let angle = angle.as_ref().map(|a| slice(a, "angle")).transpose()?;
    let theta = all_of(py, slice(&theta, "theta")?)?;
    let found = watched_over(py, u.len(), |monitor| {
        let task = Run {
            theta,
            free: &free,
            sample_time: Ts,
            steps,
            speed,
            mean,
            angle,
            orders,
        };
        greybox::run(task, u, monitor)
    })?;
    let columns = free.len();
    Ok((
        array1(py, found.speed),
        array1(py, found.drive),
        array2(py, found.speed_by, columns)?,
        array2(py, found.drive_by, columns)?,
    ))
}

fn all_of<'a>(py: Python<'_>, values: &'a [f64]) -> PyResult<&'a [f64; PARAMETERS.len()]> {
    values.try_into().map_err(|_| {
        let message = format!(
            "expected {} parameters, got {}",
            PARAMETERS.len(),
            values.len()
        );
        raise(py, Error::setting(message))
    })
}

/// Cost, gradient and Gram matrix.
type Sums<'py> = (f64, Vector<'py>, Matrix<'py>);

/// Currents, their filter and the resistance.
type Amperes<'py> = (Values<'py>, Values<'py>, f64);

#[pyfunction]
#[pyo3(signature = (theta, free, u, y, used, *, Ts, steps, filter, speed=0.0, mean=false, angle=None, orders=[0; ORDERS], current=None))]
pub fn greybox_normal<'py>(
    py: Python<'py>,
    theta: Values<'py>,
    free: Vec<usize>,
    u: Values<'py>,
    y: Values<'py>,
    used: PyReadonlyArray1<'py, bool>,
    Ts: f64,
    steps: usize,
    filter: Values<'py>,
    speed: f64,
    mean: bool,
    angle: Option<Values<'py>>,
    orders: [u32; ORDERS],
    current: Option<Amperes<'py>>,
) -> PyResult<Sums<'py>> {
    let u = slice(&u, "u")?;
    let angle = angle.as_ref().map(|a| slice(a, "angle")).transpose()?;
    let theta = all_of(py, slice(&theta, "theta")?)?;
    let current = match &current {
        Some((samples, filter, resistance)) => Some(Current {
            samples: slice(samples, "current")?,
            filter: slice(filter, "current filter")?,
            resistance: *resistance,
        }),
        None => None,
    };
    let measured = Measured {
        speed: slice(&y, "y")?,
        used: used.as_slice()?,
        filter: slice(&filter, "filter")?,
        current,
    };
    let found = watched_over(py, u.len(), |monitor| {
        let task = Run {
            theta,
            free: &free,
            sample_time: Ts,
            steps,
            speed,
            mean,
            angle,
            orders,
        };
        greybox::normal(task, u, measured, monitor)
    })?;
    let columns = found.gradient.len();
    Ok((
        found.cost,
        array1(py, found.gradient),
        array2(py, found.matrix, columns)?,
    ))
}

/// Estimates, and which parameters have moved.
type Followed<'py> = (Matrix<'py>, Bound<'py, PyArray2<bool>>);

#[pyclass(module = "sewfast._core")]
pub struct Tracker(Core<f64>);

#[pymethods]
impl Tracker {
    #[new]
    #[pyo3(signature = (*, Ts, smoothing, lag, memory, speed))]
    fn new(
        py: Python<'_>,
        Ts: f64,
        smoothing: f64,
        lag: f64,
        memory: f64,
        speed: f64,
    ) -> PyResult<Self> {
        let of = Listening {
            ts: Ts,
            smoothing,
            lag,
            memory,
            speed,
        };
        Core::new(of).map(Self).map_err(|e| refused(py, e))
    }

    fn reset(&mut self) {
        self.0.reset();
    }

    fn step(&mut self, u: f64, y: f64) {
        self.0.step(u, y);
    }

    fn run<'py>(
        &mut self,
        py: Python<'py>,
        u: Values<'py>,
        y: Values<'py>,
    ) -> PyResult<Followed<'py>> {
        let (u, y) = (slice(&u, "u")?, slice(&y, "y")?);
        if u.len() != y.len() {
            let message = format!(
                "expected as many commands as speeds, got {} and {}",
                u.len(),
                y.len()
            );
            return Err(raise(py, Error::data(message)));
        }
        let core = &mut self.0;
        let (estimates, moved) = watched_over(py, u.len(), |monitor| {
            let mut estimates = Vec::with_capacity(TRACKED * u.len());
            let mut moved = Vec::with_capacity(TRACKED * u.len());
            for (k, (&u, &y)) in u.iter().zip(y).enumerate() {
                if k % 1000 == 0 && monitor.stopped() {
                    return Err(Error::fit(
                        "expected to be left alone, got a request to stop",
                    ));
                }
                core.step(u, y);
                estimates.extend(core.estimate());
                moved.extend(core.moved());
            }
            Ok((estimates, moved))
        })?;
        use numpy::PyArrayMethods;
        let rows = moved.len() / TRACKED;
        let moved = PyArray1::from_vec(py, moved).reshape([rows, TRACKED])?;
        Ok((array2(py, estimates, TRACKED)?, moved))
    }

    #[getter]
    fn estimate(&self) -> [f64; TRACKED] {
        self.0.estimate()
    }

    #[getter]
    fn variance(&self) -> [f64; TRACKED] {
        self.0.variance()
    }

    #[getter]
    fn moved(&self) -> [bool; TRACKED] {
        self.0.moved()
    }

    fn watch(
        &mut self,
        py: Python<'_>,
        reference: [f64; TRACKED],
        tolerance: [f64; TRACKED],
    ) -> PyResult<()> {
        let set = self.0.watch(reference, tolerance);
        set.map_err(|e| refused(py, e))
    }
}

fn refused(py: Python<'_>, refused: sewfast_control::Refused) -> PyErr {
    raise(py, Error::setting(refused.to_string()))
}

/// A motor and a network for what its equations leave.
#[pyclass(frozen, extends = Model, module = "sewfast._core")]
pub struct GreyBox {
    inner: Arc<greybox::GreyBox>,
}

impl Kind for GreyBox {
    type Inner = greybox::GreyBox;

    fn of(inner: Arc<Self::Inner>) -> Self {
        Self { inner }
    }
}

#[pymethods]
impl GreyBox {
    #[new]
    #[pyo3(signature = (
        *, values, free, Ts, steps, mean, unit, speed_scale, command_scale, residual_variance, process_noise, theta,
        position=false, joint=[0.0; JOINT.len()]
    ))]
    fn new(
        py: Python<'_>,
        values: Values<'_>,
        free: Vec<usize>,
        Ts: f64,
        steps: usize,
        mean: bool,
        unit: f64,
        speed_scale: f64,
        command_scale: f64,
        residual_variance: f64,
        process_noise: f64,
        theta: Values<'_>,
        position: bool,
        joint: [f64; JOINT.len()],
    ) -> PyResult<PyClassInitializer<Self>> {
        let given = slice(&values, "values")?;
        let values = given.try_into().map_err(|_| {
            let message = format!(
                "expected {} values of a motor, got {}; identify the model again",
                PARAMETERS.len(),
                given.len()
            );
            raise(py, Error::setting(message))
        })?;
        let frame = Frame {
            values,
            joint,
            free,
            sample_time: Ts,
            steps,
            mean,
            position,
            unit,
            speed_scale,
            command_scale,
            residual_variance,
            process_noise,
        };
        greybox::GreyBox::new(frame, slice(&theta, "theta")?)
            .map(Self::wrapped)
            .raised(py)
    }

    #[getter]
    fn settings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let frame = self.inner.frame();
        Ok(dict! { py;
            "nx" => self.inner.order(), "nk" => self.inner.nk(), "n_inputs" => 1,
            "integrator" => self.inner.integrates(), "hidden" => self.inner.units(),
            "values" => array1(py, frame.values.to_vec()), "joint" => frame.joint, "free" => frame.free.clone(),
            "Ts" => frame.sample_time, "steps" => frame.steps, "mean" => frame.mean,
            "position" => frame.position, "unit" => frame.unit, "speed_scale" => frame.speed_scale,
            "command_scale" => frame.command_scale, "residual_variance" => frame.residual_variance,
            "process_noise" => frame.process_noise,
        })
    }

    fn states<'py>(
        &self,
        py: Python<'py>,
        u: Rows<'py>,
        state: Values<'py>,
    ) -> PyResult<Matrix<'py>> {
        let ((u, channels), state) = (rows(&u, "u")?, slice(&state, "state")?);
        let found = py.detach(|| self.inner.states(u, channels, state));
        array2(py, found.raised(py)?, self.inner.order())
    }

    /// The least squares over pieces from theta as it is: the model there, its cost and the pieces' initial states.
    #[pyo3(signature = (experiments, *, prior, low, high, enough, iterations, progress=None))]
    fn descended<'py>(
        &self,
        py: Python<'py>,
        experiments: Experiments<'py>,
        prior: Values<'py>,
        low: Values<'py>,
        high: Values<'py>,
        enough: f64,
        iterations: usize,
        progress: Option<Bound<'py, PyAny>>,
    ) -> PyResult<(Py<Self>, f64, Matrix<'py>)> {
        let samples = samples(py, &experiments)?;
        let fit = Fit {
            prior: slice(&prior, "prior")?,
            low: slice(&low, "low")?,
            high: slice(&high, "high")?,
            enough,
            iterations,
        };
        let found = watched(py, progress.as_ref(), |monitor| {
            Pieces::new(&samples)?.descend(&self.inner, &fit, monitor)
        })?;
        let order = found.model.order();
        Ok((
            Py::new(py, Self::wrapped(found.model))?,
            found.cost,
            array2(py, found.states.concat(), order)?,
        ))
    }

    /// States at which pieces begin, from their first outputs, (pieces, nx).
    fn first_states<'py>(
        &self,
        py: Python<'py>,
        experiments: Experiments<'py>,
    ) -> PyResult<Matrix<'py>> {
        let samples = samples(py, &experiments)?;
        let found = released(py, || Pieces::new(&samples)?.states(&self.inner))?;
        array2(py, found.concat(), self.inner.order())
    }

    /// Weighted squared errors of free runs over pieces from these states; infinite if one diverges.
    fn squares<'py>(
        &self,
        py: Python<'py>,
        experiments: Experiments<'py>,
        states: Rows<'py>,
    ) -> PyResult<f64> {
        let (samples, states) = (samples(py, &experiments)?, self.states_of(&states)?);
        released(py, || {
            Ok(Pieces::new(&samples)?.squares(&self.inner, &states))
        })
    }

    /// Covariance of theta at the pieces' least squares, (p, p), and which parameters are determined, (p,).
    fn covariance<'py>(
        &self,
        py: Python<'py>,
        experiments: Experiments<'py>,
        states: Rows<'py>,
    ) -> PyResult<Estimate<'py>> {
        let (samples, states) = (samples(py, &experiments)?, self.states_of(&states)?);
        let (covariance, determined) = released(py, || {
            Pieces::new(&samples)?.covariance(&self.inner, &states)
        })?;
        let columns = determined.len();
        Ok((
            array2(py, covariance, columns)?,
            PyArray1::from_vec(py, determined),
        ))
    }

    /// Number of samples of the pieces that are as good as independent.
    fn independent<'py>(
        &self,
        py: Python<'py>,
        experiments: Experiments<'py>,
        states: Rows<'py>,
    ) -> PyResult<f64> {
        let (samples, states) = (samples(py, &experiments)?, self.states_of(&states)?);
        released(py, || {
            Pieces::new(&samples)?.independent(&self.inner, &states)
        })
    }
}

impl GreyBox {
    fn states_of(&self, states: &Rows<'_>) -> PyResult<Vec<Vec<f64>>> {
        let (states, columns) = rows(states, "states")?;
        Ok(states.chunks(columns.max(1)).map(<[f64]>::to_vec).collect())
    }
}

/// A covariance, and which parameters are determined.
type Estimate<'py> = (Matrix<'py>, Bound<'py, PyArray1<bool>>);

#[pyfunction]
#[pyo3(signature = (experiments, *, width, delays, Ts, unit, k_q))]
pub fn greybox_regressed(
    py: Python<'_>,
    experiments: Experiments<'_>,
    width: f64,
    delays: Vec<f64>,
    Ts: f64,
    unit: f64,
    k_q: f64,
) -> PyResult<Vec<Option<[f64; 4]>>> {
    let samples = samples(py, &experiments)?;
    let how = Smoothing {
        width,
        delays: &delays,
        sample_time: Ts,
        unit,
        k_q,
    };
    released(py, || greybox::regressed(&samples, &how))
}

/// What a wave of each order over the position leaves of the drive, for the start of a cogging.
#[pyfunction]
#[pyo3(signature = (experiments, *, width, delay, Ts, unit, k_q, orders))]
pub fn greybox_waves(
    py: Python<'_>,
    experiments: Experiments<'_>,
    width: f64,
    delay: f64,
    Ts: f64,
    unit: f64,
    k_q: f64,
    orders: Vec<f64>,
) -> PyResult<Vec<f64>> {
    let samples = samples(py, &experiments)?;
    let how = Smoothing {
        width,
        delays: &[delay],
        sample_time: Ts,
        unit,
        k_q,
    };
    released(py, || greybox::waves(&samples, &how, &orders))
}
