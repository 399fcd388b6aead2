use super::*;

const TS: f64 = 1e-3;
const PER_TURN: f64 = 4096.0;

/// A motor of 250 RPM/V and .1 s with friction of .3 V, by Euler's method in tenths of a sample; a fault changes it.
struct Rig {
    speed: f64,
    angle: f64,
    counted: f64,
    sent: Vec<f64>,
}

#[derive(Clone, Copy)]
struct Fault {
    change: Change,
    value: f64,
    at: usize,
}

impl Rig {
    fn new() -> Self {
        Self {
            speed: 0.0,
            angle: 0.0,
            counted: 0.0,
            sent: Vec::new(),
        }
    }

    fn step(&mut self, u: f64, fault: Option<Fault>) {
        let k = self.sent.len();
        self.sent.push(u);
        let now = fault.filter(|f| k >= f.at);
        let is = |change| {
            now.filter(|f| f.change == change)
                .map_or(f64::NAN, |f| f.value)
        };
        let or = |value: f64, other: f64| if value.is_nan() { other } else { value };
        let late = 2 + (or(is(Change::Delay), 0.0) / TS) as usize;
        let mut drive = if k >= late { self.sent[k - late] } else { 0.0 };
        drive = or(is(Change::Stuck), drive * or(is(Change::Gain), 1.0));
        drive += or(is(Change::Load), 0.0);
        let friction = 0.3 + or(is(Change::Friction), 0.0);
        let lag = 0.1 * or(is(Change::Inertia), 1.0);
        for _ in 0..10 {
            let held = if self.speed == 0.0 {
                drive.clamp(-friction, friction)
            } else {
                friction * self.speed.signum()
            };
            let before = self.speed;
            self.speed += 0.1 * TS / lag * (250.0 * (drive - held) - self.speed);
            if before * self.speed < 0.0 {
                self.speed = 0.0;
            }
            let turned = 0.1 * TS * self.speed / 60.0;
            self.angle += turned;
            self.counted += turned * or(is(Change::Counts), 1.0);
        }
        if fault.is_some_and(|f| f.change == Change::Jump && f.at == k) {
            self.counted += or(is(Change::Jump), 0.0) / PER_TURN;
        }
    }

    fn counts(&self) -> f64 {
        (PER_TURN * self.counted).floor()
    }
}

/// A loop that follows levels, or given commands; ends at 3,000 RPM.
fn run(fault: Option<Fault>, samples: usize, is_loop: bool) -> (Vec<f64>, Vec<f64>) {
    let mut rig = Rig::new();
    let (mut u, mut counts, mut sum) = (vec![], vec![], 0.0);
    for k in 0..samples {
        let now = rig.counts();
        let before = counts.last().copied().unwrap_or(now);
        counts.push(now);
        let measured = 60.0 * (now - before) / (PER_TURN * TS);
        let level = [700.0, 1200.0, 400.0, 1000.0, 200.0][k / 500 % 5];
        let command = if is_loop {
            sum += 0.04 * (level - measured) * TS;
            (0.004 * (level - measured) + sum).clamp(-10.0, 10.0)
        } else {
            level / 250.0
        };
        u.push(command);
        rig.step(command, fault);
        if rig.speed.abs() > 3000.0 {
            break;
        }
    }
    (u, counts)
}

fn as_run(columns: &(Vec<f64>, Vec<f64>)) -> Run<'_> {
    Run {
        u: &columns.0,
        counts: &columns.1,
    }
}

const FAULTS: [(Change, f64); 11] = [
    (Change::Gain, -1.0),
    (Change::Gain, 0.5),
    (Change::Gain, 2.0),
    (Change::Stuck, 6.0),
    (Change::Load, 1.5),
    (Change::Counts, -1.0),
    (Change::Counts, 0.0),
    (Change::Counts, 0.5),
    (Change::Jump, 3000.0),
    (Change::Delay, 0.02),
    (Change::Inertia, 3.0),
];

#[test]
fn each_change_is_named_with_its_value_after_earlier_runs() {
    let healthy = run(None, 2500, false);
    for (change, value) in FAULTS {
        for at in [600, 1750] {
            let fault = Fault { change, value, at };
            let columns = run(Some(fault), 2500, true);
            let monitor = Monitor::default();
            let found = causes(
                &[as_run(&healthy)],
                as_run(&columns),
                TS,
                PER_TURN,
                f64::INFINITY,
                &monitor,
            )
            .unwrap();
            let best = found.findings[0];
            let said = format!(
                "{change:?} {value} at {at}: {best:?}, without {}",
                found.error
            );
            assert_eq!(best.change, change, "{said}");
            assert!(
                (best.value - value).abs() < 0.25 * value.abs().max(0.5),
                "{said}"
            );
            // a delay shows only when the command changes
            assert!((best.at - at as f64 * TS).abs() < 0.1, "{said}");
            assert!(best.error < 0.5 * found.error, "{said}");
        }
    }
}

#[test]
fn a_run_alone_shows_what_changed_within_it() {
    for (change, value) in FAULTS.into_iter().filter(|f| f.0 != Change::Delay) {
        let fault = Fault {
            change,
            value,
            at: 1130,
        };
        let columns = run(Some(fault), 2500, true);
        let found = causes(
            &[],
            as_run(&columns),
            TS,
            PER_TURN,
            f64::INFINITY,
            &Monitor::default(),
        )
        .unwrap();
        let best = found.findings[0];
        assert_eq!(best.change, change, "{value}: {found:?}");
        assert!((best.at - 1.13).abs() < 0.1, "{value}: {best:?}");
    }
}

#[test]
fn a_healthy_run_needs_no_change() {
    let (first, second) = (run(None, 2500, false), run(None, 2500, true));
    let found = causes(
        &[as_run(&first)],
        as_run(&second),
        TS,
        PER_TURN,
        f64::INFINITY,
        &Monitor::default(),
    )
    .unwrap();
    assert!(found.error < 0.03 * found.size, "{found:?}");
    assert!((found.motor.gain - 250.0).abs() < 10.0, "{found:?}");
    // in one direction friction and a load are the same number
    let lost = found.motor.friction - found.motor.bias;
    assert!((lost - 0.3).abs() < 0.1, "{found:?}");
}

#[test]
fn hostile_runs_are_refused_or_survived() {
    let of = |u: &[f64], counts: &[f64]| {
        causes(
            &[],
            Run { u, counts },
            TS,
            PER_TURN,
            f64::INFINITY,
            &Monitor::default(),
        )
    };
    assert!(of(&[1.0, 2.0], &[0.0, 1.0]).is_err());
    assert!(of(&[1.0; 4], &[0.0; 5]).is_err());
    assert!(of(&[f64::NAN; 5], &[0.0; 5]).is_err());
    assert!(
        causes(
            &[],
            Run {
                u: &[1.0; 5],
                counts: &[0.0; 5]
            },
            0.0,
            1.0,
            f64::INFINITY,
            &Monitor::default()
        )
        .is_err()
    );
    for (u, counts) in [
        (vec![0.0; 3], vec![0.0; 3]),
        (vec![5.0; 500], vec![0.0; 500]),
        (vec![0.0; 500], (0..500).map(f64::from).collect()),
        (vec![1e300; 50], vec![1e15; 50]),
    ] {
        let found = of(&u, &counts).unwrap();
        assert!(found.error >= 0.0 || found.error.is_nan());
    }
}
