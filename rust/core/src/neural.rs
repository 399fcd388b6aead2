//! The neural output-error model: network, simulation, exact sensitivities, training.
