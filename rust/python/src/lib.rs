//! The Python module `sewfast._core`: convert, release the interpreter, call, convert back.

// Python's keywords, one by one
#![allow(non_snake_case, clippy::too_many_arguments)]

#[macro_use]
mod seam;

mod causes;
mod control;
mod device;
mod estimation;
mod evidence;
mod frequency;
mod greybox;
mod guard;
mod host_loop;
mod least_squares;
mod link;
mod loop_transfer;
mod models;
mod signals;

use pyo3::prelude::*;

#[pymodule(gil_used = false)]
mod _core {
    use pyo3::prelude::*;
    use sewfast_core::{greybox, simd};

    use crate::seam::Raised;

    #[pymodule_export]
    use crate::causes::causes;
    #[pymodule_export]
    use crate::control::controller::{
        Controller, SingleController, SingleStateFeedback, StateFeedback, biquad, inverse_taps,
    };
    #[pymodule_export]
    use crate::control::moves::{MoveLearner, constant_reach, plan_move, profile, reach};
    #[pymodule_export]
    use crate::control::position::{
        PositionController, approach, judge_stops, position_rates, position_run,
    };
    #[pymodule_export]
    use crate::control::tuning::{cost_terms, pareto, run_cost, tune, tuning_costs, tuning_loads};
    #[pymodule_export]
    use crate::control::{
        amigo, closed_loop, convert_gains, effort, eq_12, eq_12_costs, fit_fopdt, simc,
        step_metrics, table_1,
    };
    #[pymodule_export]
    use crate::device::{DeviceServer, Machine};
    #[pymodule_export]
    use crate::estimation::{inverse_root, minimised, sandwich_covariance};
    #[pymodule_export]
    use crate::evidence::{
        changed, coloured_information, computed, copied, dead, delay, explained, feedback,
        innovation, integration, limits, order_in_time, order_table, parameter_test, period,
        quantum, residual_tests, rests, spikes, two_levels, unstable_pole, wraps,
    };
    #[pymodule_export]
    use crate::frequency::{
        ProposalTask, fit_shaft, record_response, shaft_fraction, shaft_response,
    };
    #[pymodule_export]
    use crate::greybox::{
        GreyBox, Tracker, greybox_normal, greybox_regressed, greybox_run, greybox_waves,
    };
    #[pymodule_export]
    use crate::guard::Guard;
    #[pymodule_export]
    use crate::host_loop::host_loop;
    #[pymodule_export]
    use crate::least_squares::least_squares_fit;
    #[pymodule_export]
    use crate::link::{LinkBodies, LinkClient, LinkReceiver, LinkUpload, link_frame};
    #[pymodule_export]
    use crate::loop_transfer::{
        LoopPath, loop_response, margins, position_sensitivity, sampled_fopdt, tolerance,
    };
    #[pymodule_export]
    use crate::models::linear::{
        HammersteinWiener, HammersteinWienerFit, LinearFit, LinearModel, fit_arx,
        fit_hammerstein_wiener, fit_innovations, fit_iv, fit_oe,
    };
    #[pymodule_export]
    use crate::models::neural::{NeuralFit, NeuralOE, fit_neural_oe};
    #[pymodule_export]
    use crate::models::neural_ss::{NeuralSS, NeuralSSFit, fit_neural_ss};
    #[pymodule_export]
    use crate::models::{EmbeddedModel, Model, convex_weights, guard, tanh_quotients};
    #[pymodule_export]
    use crate::signals::{
        chirp, crest_factor, jumps, limit, multisine, prbs, random_steps, speed_difference,
        speed_kalman, speed_savgol, staircase, step, trapezoid, unwrap_counts,
    };

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("cpu", simd::level().raised(module.py())?.name())?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))?;
        module.add("GREYBOX_PARAMETERS", greybox::PARAMETERS)?;
        module.add("GREYBOX_JOINT", greybox::JOINT)?;
        module.add("GREYBOX_UNITS", greybox::MOST_UNITS)
    }
}
