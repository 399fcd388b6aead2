//! First-order-plus-dead-time approximation (paper Eq. 10-11) of a measured step response.
