//! Laws of the machine.

use super::*;

fn nominal() -> Machine {
    Machine::new(Parameters::default()).unwrap()
}

#[test]
fn has_the_gain_and_the_time_constants_of_the_real_machine() {
    for speed in [1000.0, 1500.0, 2000.0] {
        let small = nominal().linearise(speed).unwrap();
        assert!((small.gain / 490.0 - 1.0).abs() < 0.03);
        assert!((small.time_constants[0] / 0.252 - 1.0).abs() < 0.05);
        assert!((small.time_constants[1] / 0.0074 - 1.0).abs() < 0.10);
    }
}
