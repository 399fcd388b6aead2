//! The loop with the state machine of a real device and the virtual sewing machine, in computed time.

use sewfast_control::link::{
    Body, Deframer, Device, Header, MAX_WIRE, Measurement, Reason, State, encode,
};
use sewfast_control::{Design, PidController, Settings as Pid, Standard};
use sewfast_core::machine::{Machine, Parameters};

use super::super::{HostLoop, Outcome, Settings};
use crate::bench;
use crate::client::Client;
use crate::samples::Channel;

const RATIO: u32 = 20;
const TS: f64 = 0.02;
const COUNTS_PER_UNIT: f64 = 1572.0 / 60.0;
const OFFSET: u64 = 7_654_321;

fn controller() -> PidController<f64> {
    let gains = Standard {
        kp: 0.002,
        ti: 0.25,
        td: 0.0,
    };
    let settings = Pid {
        u_min: 0.0,
        u_max: 10.0,
        tt: 0.0,
        ..Pid::new(gains, TS)
    };
    PidController::new(Design::new(settings)).unwrap()
}

fn reference() -> Vec<f64> {
    (0..100)
        .map(|k| 1500.0 * (f64::from(k) / 40.0).min(1.0))
        .collect()
}

/// The same loop without a link: measurement and command take effect at once.
fn simulated() -> Vec<f64> {
    let (mut machine, mut controller) =
        (Machine::new(Parameters::default()).unwrap(), controller());
    let mut before = machine.counts();
    let tick = |&r: &f64| {
        let now = machine.counts();
        let speed = (now - before) / (TS * COUNTS_PER_UNIT);
        before = now;
        let u = controller.step(r, speed);
        (0..RATIO).for_each(|_| machine.advance(u));
        speed
    };
    reference().iter().map(tick).collect()
}

/// A device, its machine, and a host whose clock differs by [`OFFSET`].
struct Bench {
    device: Device<8>,
    machine: Machine,
    now: u64,
    /// Fields of the reply to HELLO.
    key: u32,
}

impl Bench {
    fn new() -> Self {
        let device = Device::new(bench::identity());
        let mut bench = Self {
            device: device.unwrap(),
            machine: Machine::new(Parameters::default()).unwrap(),
            now: OFFSET,
            key: 0,
        };
        bench.pass(200);
        let mut hello = Body::new();
        hello.u8(3).u8(3).u32(99);
        bench.say(0x01, 0, 0, &hello);
        bench.key = greeted(&bench.pass(1));
        let mut limits = Body::new();
        limits
            .f32(20.0)
            .f32(4000.0)
            .f32(f32::INFINITY)
            .f32(f32::INFINITY);
        bench.say(0x04, 3, 1, &limits);
        bench.pass(1);
        bench
    }

    fn say(&mut self, kind: u8, tag: u16, sequence: u32, body: &Body) {
        let header = Header {
            kind,
            tag,
            sequence,
            time: Header::host_time(99, self.now),
        };
        let mut wire = [0; MAX_WIRE];
        let length = encode(&header, body.bytes().unwrap(), &mut wire).unwrap();
        self.hear(&wire[..length]);
    }

    fn hear(&mut self, bytes: &[u8]) {
        let time = self.now - OFFSET;
        self.device.receive(time, bytes);
        self.device.poll(time);
    }

    /// Lets milliseconds pass; returns what the device sends meanwhile.
    fn pass(&mut self, milliseconds: u32) -> Vec<u8> {
        let mut said = Vec::new();
        for _ in 0..milliseconds {
            self.now += 1000;
            let measurement = Measurement {
                counts: self.machine.counts() as i32,
                current: f32::NAN,
                further: &[],
            };
            let output = self.device.sample(self.now - OFFSET, &measurement);
            self.machine.advance(f64::from(output.u));
            let mut chunk = [0; 512];
            let length = self.device.transmit(&mut chunk);
            said.extend_from_slice(&chunk[..length]);
        }
        said
    }
}

/// The key at the end of a reply to HELLO.
fn greeted(mut said: &[u8]) -> u32 {
    let mut deframer = Deframer::new();
    while let Some(frame) = deframer.next(&mut said) {
        let Ok(frame) = frame else { continue };
        if let (0x81, Some(key)) = (frame.header.kind, frame.body.last_chunk()) {
            return u32::from_le_bytes(*key);
        }
    }
    panic!("HELLO is not answered")
}

fn pair() -> (Bench, HostLoop) {
    let bench = Bench::new();
    let looped = host_loop(bench.key);
    (bench, looped)
}

fn host_loop(key: u32) -> HostLoop {
    let settings = Settings {
        device_period: 1000,
        ratio: RATIO,
        watchdog: 80_000,
        batch: 5,
        mask: 3,
        counts_per_unit: COUNTS_PER_UNIT,
    };
    let channels =
        [(0, 1), (1, 1000)].map(|(code, steps)| Channel::described(code, steps).unwrap());
    let client = Client::new(99, 80_000).continued(3, key, 1, 0);
    HostLoop::new(client, settings, &channels, controller(), reference()).unwrap()
}

/// Runs the loop to its end; `disturb` is called before each millisecond.
fn serve(bench: &mut Bench, looped: &mut HostLoop, mut disturb: impl FnMut(&mut Bench, u64)) {
    for k in 0..20_000 {
        disturb(bench, k);
        let received = bench.pass(1);
        let said = looped.tick(bench.now, &received).to_vec();
        bench.hear(&said);
        if looped.done() {
            return;
        }
    }
    panic!("the loop does not end");
}

#[test]
fn tracks_as_the_simulated_loop_does() {
    let (mut bench, mut looped) = pair();
    serve(&mut bench, &mut looped, |_, _| {});
    assert_eq!(looped.outcome(), Some(&Outcome::Completed));
    let taken = looped.status().map(|status| status.samples as usize);
    assert_eq!(taken, Some(looped.history().times().len()));
    assert_eq!((looped.ticks().run.len(), looped.ticks().missed), (100, 0));
    let simulated = simulated();
    let difference = looped
        .ticks()
        .run
        .iter()
        .zip(&simulated)
        .map(|(tick, y)| tick.y - y);
    let rms = (difference.map(|d| d * d).sum::<f64>() / 100.0).sqrt();
    // A batch before the first tick, some samples of age, and the effect of the machine's ripple on both.
    assert!(rms < 5.0, "{rms} RPM");
    assert!((looped.ticks().run[99].y - 1500.0).abs() < 40.0);
}

#[test]
fn a_trip_of_the_device_ends_the_loop_with_its_reason() {
    let (mut bench, mut looped) = pair();
    serve(&mut bench, &mut looped, |bench, k| {
        if k == 700 {
            bench.device.trip(bench.now - OFFSET, Reason::StopInput);
        }
    });
    assert!(matches!(
        looped.outcome(),
        Some(Outcome::Tripped { reason: 10, .. })
    ));
    assert_eq!(bench.device.state(), State::Tripped);
    let taken = looped.status().map(|status| status.samples as usize);
    assert_eq!(taken, Some(looped.history().times().len()));
}

#[test]
fn a_stop_leaves_the_device_idle_and_its_samples_here() {
    let (mut bench, mut looped) = pair();
    for _ in 0..600 {
        let received = bench.pass(1);
        let said = looped.tick(bench.now, &received).to_vec();
        bench.hear(&said);
    }
    looped.stop(Outcome::Interrupted);
    serve(&mut bench, &mut looped, |_, _| {});
    assert_eq!(bench.device.state(), State::Idle);
    assert_eq!(looped.outcome(), Some(&Outcome::Interrupted));
    let taken = looped.status().map(|status| status.samples as usize);
    assert_eq!(taken, Some(looped.history().times().len()));
}

#[test]
fn a_host_that_stops_calling_is_stopped_by_the_watchdog() {
    let (mut bench, mut looped) = pair();
    for _ in 0..600 {
        let received = bench.pass(1);
        let said = looped.tick(bench.now, &received).to_vec();
        bench.hear(&said);
    }
    assert_eq!(bench.device.state(), State::Running);
    let received = bench.pass(100);
    assert_eq!(bench.device.state(), State::Tripped);
    looped.tick(bench.now, &received);
    assert!(matches!(
        looped.outcome(),
        Some(Outcome::Tripped { reason: 1, .. })
    ));
}
