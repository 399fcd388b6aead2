//! A controller and a plant in closed loop, with encoder, feedback filter and limits inside the loop.
