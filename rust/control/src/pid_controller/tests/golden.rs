//! Golden bits of filter and PID alone: a part that is switched off leaves no trace in them.

use crate::{Design, PidController, Real, Settings, Standard};

/// Numbers from -1 to 1, the same for ever.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

/// FNV-1a over 64-bit words.
fn hash(sum: u64, word: u64) -> u64 {
    (sum ^ word).wrapping_mul(0x0100_0000_01b3)
}

/// Reference and output of sample `k`: steps, noise, lost measurements.
fn sample(noise: &mut Noise, k: u32) -> (f64, f64) {
    let r = f64::from(k / 150 % 3) * 700.0 - 200.0;
    let y = 600.0 + 900.0 * noise.next();
    (r, if k % 97 == 96 { f64::NAN } else { y })
}

macro_rules! golden {
    ($name:ident $float:ident $made:ident) => {
        fn $name() -> u64 {
            let (mut sum, mut noise) = (0xcbf2_9ce4_8422_2325, Noise(88_172_645_463_325_252));
            let inf = $float::INFINITY;
            for (kp, ti, td) in [(0.02, 0.25, 0.004), (0.02, inf, 0.0), (-0.3, 0.01, 0.1)] {
                for (n, tt, slew) in [(inf, 0.0, inf), (8.0, 0.05, 2e3), (3.0, inf, 5e4)] {
                    for (samples, time) in [(1, 0.0), (8, 0.0), (64, 0.003)] {
                        let gains = Standard { kp, ti, td };
                        let settings = Settings {
                            alpha: 0.4,
                            beta: -0.7,
                            n,
                            tt,
                            slew,
                            u_min: -12.0,
                            u_max: 15.0,
                            ..Settings::new(gains, 1e-3)
                        };
                        let mut controller = $made(settings, samples, time);
                        for k in 0..700 {
                            let (r, y) = sample(&mut noise, k);
                            let u = controller.step(r as $float, y as $float);
                            sum = hash(sum, u.to_bits().into());
                            sum = hash(sum, controller.filtered().to_bits().into());
                        }
                    }
                }
            }
            sum
        }
    };
}

fn made<T: Real>(pid: Settings<T>, filter_samples: usize, filter_time: T) -> PidController<T> {
    let design = Design {
        filter_samples,
        filter_time,
        ..Design::new(pid)
    };
    PidController::new(design).unwrap()
}

golden!(double f64 made);
golden!(single f32 made);

#[test]
fn filter_and_pid_alone_give_these_bits() {
    assert_eq!(double(), 0x8849_10b4_fd16_f95c);
    assert_eq!(single(), 0x5552_cc79_5b9a_2f65);
}
