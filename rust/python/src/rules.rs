//! Bindings of the first-order-plus-dead-time fit and of the tuning rules.

use numpy::PyReadonlyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sewfast_control::Standard;
use sewfast_core::fopdt::fit_fopdt as fit;
use sewfast_core::rules::{self, Costs, Outside, Rule};
use sewfast_core::{Record, Result};

use crate::arrays::{raise, slice};
use crate::control::named;
use crate::watch::watched;

type Values<'py> = PyReadonlyArray1<'py, f64>;

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(fit_fopdt, module)?)?;
    module.add_function(wrap_pyfunction!(table_1, module)?)?;
    module.add_function(wrap_pyfunction!(eq_12, module)?)?;
    module.add_function(wrap_pyfunction!(eq_12_costs, module)?)?;
    module.add_function(wrap_pyfunction!(simc, module)?)?;
    module.add_function(wrap_pyfunction!(amigo, module)?)
}

#[pyfunction]
#[pyo3(signature = (u, y, *, Ts))]
#[expect(non_snake_case, reason = "the field's name for the sample time")]
fn fit_fopdt<'py>(
    py: Python<'py>,
    u: Values<'py>,
    y: Values<'py>,
    Ts: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let record = Record::new(slice(&u, "u")?, 1, slice(&y, "y")?).map_err(|e| raise(py, e))?;
    let found = watched(py, None, |monitor| fit(record, Ts, monitor))?;
    let dict = named(
        py,
        [
            ("K", found.k),
            ("T", found.t),
            ("L", found.l),
            ("offset", found.offset),
            ("u_low", found.u_low),
            ("u_high", found.u_high),
            ("fit_percent", found.fit_percent),
            ("K_se", found.errors[0]),
            ("T_se", found.errors[1]),
            ("L_se", found.errors[2]),
            ("overshoot_percent", 100.0 * found.overshoot),
        ],
    )?;
    dict.set_item("limited", found.limited)?;
    dict.set_item("moving", found.moving)?;
    Ok(dict)
}

#[pyfunction]
#[pyo3(signature = (K, T, L, *, nearest=false))]
#[expect(non_snake_case, reason = "the field's names")]
fn table_1(py: Python<'_>, K: f64, T: f64, L: f64, nearest: bool) -> PyResult<Bound<'_, PyDict>> {
    let outside = if nearest {
        Outside::Nearest
    } else {
        Outside::Error
    };
    answered(py, rules::table_1(K, T, L, outside))
}

#[pyfunction]
#[pyo3(signature = (K, T, L, *, Ms))]
#[expect(non_snake_case, reason = "the field's names")]
fn eq_12(py: Python<'_>, K: f64, T: f64, L: f64, Ms: f64) -> PyResult<Bound<'_, PyDict>> {
    let (rule, costs) = watched(py, None, |_| rules::eq_12(K, T, L, Ms))?;
    let dict = answered(py, Ok(rule))?;
    for (name, value) in by_name(costs) {
        dict.set_item(name, value)?;
    }
    Ok(dict)
}

#[pyfunction]
#[pyo3(signature = (ratio, *, KpK, Ti, Td, alpha, beta))]
#[expect(non_snake_case, reason = "the field's names")]
fn eq_12_costs(
    py: Python<'_>,
    ratio: f64,
    KpK: f64,
    Ti: f64,
    Td: f64,
    alpha: f64,
    beta: f64,
) -> PyResult<Bound<'_, PyDict>> {
    let gains = Standard {
        kp: KpK,
        ti: Ti,
        td: Td,
    };
    let costs = watched(py, None, |_| rules::costs(ratio, gains, alpha, beta))?;
    named(py, by_name(costs))
}

#[pyfunction]
#[pyo3(signature = (K, T, L, *, tau_c, derivative))]
#[expect(non_snake_case, reason = "the field's names")]
fn simc(
    py: Python<'_>,
    K: f64,
    T: f64,
    L: f64,
    tau_c: f64,
    derivative: bool,
) -> PyResult<Bound<'_, PyDict>> {
    answered(py, rules::simc(K, T, L, tau_c, derivative))
}

#[pyfunction]
#[pyo3(signature = (K, T, L))]
#[expect(non_snake_case, reason = "the field's names")]
fn amigo(py: Python<'_>, K: f64, T: f64, L: f64) -> PyResult<Bound<'_, PyDict>> {
    answered(py, rules::amigo(K, T, L))
}

fn by_name(costs: Costs) -> [(&'static str, f64); 3] {
    [
        ("disturbance_cost", costs.disturbance),
        ("reference_cost", costs.reference),
        ("Ms", costs.ms),
    ]
}

fn answered(py: Python<'_>, rule: Result<Rule>) -> PyResult<Bound<'_, PyDict>> {
    let rule = rule.map_err(|e| raise(py, e))?;
    named(
        py,
        [
            ("Kp", rule.gains.kp),
            ("Ti", rule.gains.ti),
            ("Td", rule.gains.td),
            ("alpha", rule.alpha),
            ("beta", rule.beta),
        ],
    )
}
