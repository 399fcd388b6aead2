//! Excitation signals and references.
