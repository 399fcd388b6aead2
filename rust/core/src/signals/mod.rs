//! Excitation signals and references: seeded, validated, sampled at `k Ts`.

mod check;
mod chirp;
mod jumps;
mod limit;
mod multisine;
mod prbs;
mod random_steps;
mod shapes;

pub use check::MAX_SAMPLES;
pub use chirp::{Chirp, Sweep};
pub use jumps::Jumps;
pub use limit::Limits;
pub use multisine::{Multisine, crest_factor};
pub use prbs::{prbs, register_length};
pub use random_steps::RandomSteps;
pub use shapes::{Trapezoid, staircase, step};
