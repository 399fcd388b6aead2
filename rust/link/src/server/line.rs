//! One direction of the link between device and port: frame by frame, with faults, at the rate of a serial line.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::faults::{Fate, Fault, FaultLog, Faults, Injector};

/// Longer runs of bytes without a zero are no frame and pass unchanged.
const LONGEST: usize = 512;

/// How long a frame waits for the one that should overtake it.
const PATIENCE: Duration = Duration::from_millis(20);

/// The direction of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// From the device.
    ToHost,
    /// From the host.
    ToDevice,
}

impl Direction {
    /// Its name in the log.
    pub fn name(self) -> &'static str {
        match self {
            Self::ToHost => "to_host",
            Self::ToDevice => "to_device",
        }
    }
}

/// A frame that is not due yet.
#[derive(Debug)]
struct Packet {
    due: Instant,
    bytes: Vec<u8>,
}

/// Bytes in transit in one direction.
#[derive(Debug)]
pub struct Line {
    direction: Direction,
    injector: Injector,
    delay: Duration,
    /// Faults to come, regardless of the injector.
    forced: VecDeque<Fault>,
    /// A frame whose zero has not arrived yet.
    partial: Vec<u8>,
    /// A frame to be overtaken by the next one.
    overtaken: Option<Packet>,
    late: VecDeque<Packet>,
    ready: VecDeque<u8>,
    /// The previous frame lost its closing zero: the next one is damaged with it.
    joined: bool,
    bucket: Option<Bucket>,
}

impl Line {
    /// An empty line; `baud` paces it.
    pub fn new(
        direction: Direction,
        faults: Faults,
        seed: u64,
        baud: Option<u32>,
        now: Instant,
    ) -> Self {
        Self {
            direction,
            injector: Injector::new(faults, seed, direction as u64),
            delay: faults.duration(Fault::Delay),
            forced: VecDeque::new(),
            partial: Vec::with_capacity(LONGEST),
            overtaken: None,
            late: VecDeque::new(),
            ready: VecDeque::new(),
            joined: false,
            bucket: baud.map(|baud| Bucket::new(baud, now)),
        }
    }

    /// Applies `fault` to the next frame.
    pub fn force(&mut self, fault: Fault) {
        self.forced.push_back(fault);
    }

    /// Takes bytes; their faults of link and device go to `events`.
    pub fn push(
        &mut self,
        mut bytes: &[u8],
        now: Instant,
        log: &mut FaultLog,
        events: &mut Vec<Fault>,
    ) {
        while let Some(at) = bytes.iter().position(|&byte| byte == 0) {
            let (frame, rest) = bytes.split_at(at + 1);
            self.partial.extend_from_slice(frame);
            self.frame(now, log, events);
            bytes = rest;
        }
        self.partial.extend_from_slice(bytes);
        if self.partial.len() > LONGEST {
            self.frame(now, log, events);
        }
    }

    /// Sends the frame in `partial`.
    fn frame(&mut self, now: Instant, log: &mut FaultLog, events: &mut Vec<Fault>) {
        let bytes = std::mem::take(&mut self.partial);
        // a lone zero resynchronises the other side; it is no frame
        if bytes.len() > 1 {
            let fate = self.fate();
            for event in fate.events.into_iter().flatten() {
                log.record(event, self.direction, &bytes);
                events.push(event);
            }
            self.befall(&bytes, fate, now, log);
        } else {
            self.emit(&bytes, now, log);
        }
        self.partial = bytes;
        self.partial.clear();
    }

    fn fate(&mut self) -> Fate {
        let fate = self.injector.next();
        let frame = self.forced.pop_front().or(fate.frame);
        Fate { frame, ..fate }
    }

    fn befall(&mut self, bytes: &[u8], fate: Fate, now: Instant, log: &mut FaultLog) {
        if let Some(fault) = fate.frame {
            log.record(fault, self.direction, bytes);
        }
        let mut copies = 1;
        match fate.frame {
            Some(Fault::Drop) => return,
            Some(Fault::Flip) => {
                let mut damaged = bytes.to_vec();
                let bit = (fate.chance % (8 * bytes.len() as u64)) as usize;
                damaged[bit / 8] ^= 1 << (bit % 8);
                return self.pass(&damaged, now, log);
            }
            Some(Fault::Reorder) if self.overtaken.is_none() => {
                let (due, bytes) = (now + PATIENCE, bytes.to_vec());
                self.overtaken = Some(Packet { due, bytes });
                return;
            }
            Some(Fault::Duplicate) => copies = 2,
            Some(Fault::Delay) => self.late.push_back(Packet {
                due: now + self.delay,
                bytes: Vec::new(),
            }),
            _ => {}
        }
        (0..copies).for_each(|_| self.emit(bytes, now, log));
        self.overtake(now, log);
    }

    /// Sends a frame, followed by the one that it overtakes.
    fn pass(&mut self, bytes: &[u8], now: Instant, log: &mut FaultLog) {
        self.emit(bytes, now, log);
        self.overtake(now, log);
    }

    fn overtake(&mut self, now: Instant, log: &mut FaultLog) {
        if let Some(packet) = self.overtaken.take() {
            self.emit(&packet.bytes, now, log);
        }
    }

    fn emit(&mut self, bytes: &[u8], now: Instant, log: &mut FaultLog) {
        if self.joined && bytes.len() > 1 {
            log.record(Fault::Flip, self.direction, bytes);
        }
        self.joined = bytes.last().is_some_and(|&byte| byte != 0);
        match self.late.back() {
            None => self.ready.extend(bytes),
            Some(last) => self.late.push_back(Packet {
                due: last.due.max(now),
                bytes: bytes.to_vec(),
            }),
        }
    }

    /// Passes on what is due.
    pub fn settle(&mut self, now: Instant, log: &mut FaultLog) {
        if self.overtaken.as_ref().is_some_and(|held| held.due <= now) {
            self.overtake(now, log);
        }
        while self.late.front().is_some_and(|packet| packet.due <= now) {
            let packet = self.late.pop_front();
            self.ready.extend(packet.into_iter().flat_map(|p| p.bytes));
        }
    }

    /// Number of bytes in it, of whole and partial frames.
    pub fn backlog(&self) -> usize {
        let late: usize = self.late.iter().map(|packet| packet.bytes.len()).sum();
        self.ready.len() + self.partial.len() + late
    }

    /// How many bytes may pass now at the line's rate.
    pub fn allowance(&mut self, now: Instant) -> usize {
        let bucket = self.bucket.as_mut();
        bucket.map_or(usize::MAX, |bucket| bucket.allowance(now))
    }

    /// Counts bytes that have passed at the line's rate.
    pub fn spend(&mut self, bytes: usize) {
        if let Some(bucket) = &mut self.bucket {
            bucket.spend(bytes);
        }
    }

    /// The bytes at the far end, as one slice.
    pub fn arrived(&mut self) -> &[u8] {
        self.ready.make_contiguous()
    }

    /// Removes the first `bytes` from those at the far end.
    pub fn consume(&mut self, bytes: usize) {
        self.ready.drain(..bytes);
    }

    /// Whether there are bytes at the far end.
    pub fn has_arrived(&self) -> bool {
        !self.ready.is_empty()
    }

    /// When to look again if nothing comes in: something is due, or the rate lets more pass.
    pub fn wakes_in(&self, now: Instant, paced: bool) -> Option<Duration> {
        let late = self.late.front().map(|packet| packet.due);
        let held = self.overtaken.as_ref().map(|packet| packet.due);
        let due = late.into_iter().chain(held).min();
        let due = due.map(|due| due.saturating_duration_since(now));
        let refill = self.bucket.as_ref().filter(|_| paced);
        due.into_iter().chain(refill.map(Bucket::refilled_in)).min()
    }

    /// Drops everything in transit: the cable is unplugged.
    pub fn clear(&mut self) {
        self.partial.clear();
        self.overtaken = None;
        self.late.clear();
        self.ready.clear();
        self.joined = false;
    }
}

/// Bits on the line per byte: start, eight, stop.
const BITS_PER_BYTE: f64 = 10.0;

/// Bytes that may pass now; over any time `T` at most `rate T + burst`.
#[derive(Clone, Debug)]
struct Bucket {
    /// Bytes a second.
    rate: f64,
    burst: f64,
    level: f64,
    filled: Instant,
}

impl Bucket {
    /// For `baud` bits a second. The burst is 2 ms of bytes, at least the 16 bytes of a common transmitter's memory.
    fn new(baud: u32, now: Instant) -> Self {
        let rate = f64::from(baud) / BITS_PER_BYTE;
        Self {
            rate,
            burst: (rate * 2e-3).max(16.0),
            level: 0.0,
            filled: now,
        }
    }

    /// How many bytes may pass.
    fn allowance(&mut self, now: Instant) -> usize {
        let passed = now.saturating_duration_since(self.filled).as_secs_f64();
        self.filled = now;
        self.level = (self.level + passed * self.rate).min(self.burst);
        self.level as usize
    }

    /// Counts bytes that have passed.
    fn spend(&mut self, bytes: usize) {
        self.level -= bytes as f64;
    }

    /// When about half a burst may pass again.
    fn refilled_in(&self) -> Duration {
        let missing = (0.5 * self.burst - self.level).max(1.0);
        Duration::from_secs_f64(missing / self.rate)
    }
}

#[cfg(test)]
mod tests {
    use sewfast_control::link::{Header, MAX_WIRE, encode};

    use super::*;

    fn frame(sequence: u32) -> Vec<u8> {
        let header = Header {
            kind: 0xC0,
            tag: 1,
            sequence,
            time: 1000,
        };
        let mut wire = [0; MAX_WIRE];
        let length = encode(&header, b"body", &mut wire).unwrap();
        wire[..length].to_vec()
    }

    fn line(faults: &str) -> Line {
        let faults = Faults::parse(faults).unwrap();
        Line::new(Direction::ToHost, faults, 1, None, Instant::now())
    }

    fn push(line: &mut Line, sequence: u32, now: Instant, log: &mut FaultLog) {
        line.push(&frame(sequence), now, log, &mut Vec::new());
    }

    /// Sends frames 0, 1, 2 with a fault in the second, then lets `wait` pass.
    fn sent(fault: Fault, wait: Duration) -> (Vec<u8>, FaultLog) {
        let (mut line, mut log, now) = (line(""), FaultLog::default(), Instant::now());
        push(&mut line, 0, now, &mut log);
        line.force(fault);
        push(&mut line, 1, now, &mut log);
        push(&mut line, 2, now, &mut log);
        line.settle(now + wait, &mut log);
        (line.arrived().to_vec(), log)
    }

    #[test]
    fn passes_bytes_however_they_are_cut() {
        let bytes: Vec<u8> = (0..50).flat_map(frame).collect();
        for size in [1, 7, 64, 1000] {
            let (mut line, mut log) = (line(""), FaultLog::default());
            for piece in bytes.chunks(size) {
                line.push(piece, Instant::now(), &mut log, &mut Vec::new());
            }
            assert_eq!(line.arrived(), bytes);
        }
    }

    #[test]
    fn does_to_a_frame_what_the_fault_says() {
        let of = |sequences: &[u32]| sequences.iter().flat_map(|&k| frame(k)).collect::<Vec<_>>();
        let now = |fault| sent(fault, Duration::ZERO);
        assert_eq!(now(Fault::Drop).0, of(&[0, 2]));
        assert_eq!(now(Fault::Duplicate).0, of(&[0, 1, 1, 2]));
        assert_eq!(now(Fault::Reorder).0, of(&[0, 2, 1]));
        assert_eq!(now(Fault::Delay).0, of(&[0]));
        assert_eq!(sent(Fault::Delay, Duration::from_secs(1)).0, of(&[0, 1, 2]));
        let (flipped, log) = now(Fault::Flip);
        let wrong: u32 = flipped
            .iter()
            .zip(of(&[0, 1, 2]))
            .map(|(a, b)| (a ^ b).count_ones())
            .sum();
        assert_eq!((wrong, log.count(Fault::Flip, Direction::ToHost)), (1, 1));
    }

    #[test]
    fn goes_wrong_alike_for_a_seed_and_a_traffic() {
        let text =
            "drop=.02,flip=.02,duplicate=.02,reorder=.02,delay=.02,stall=.01,reset=.01,unplug=.01";
        let went = |seed, size| {
            let (faults, start) = (Faults::parse(text).unwrap(), Instant::now());
            let mut line = Line::new(Direction::ToHost, faults, seed, None, start);
            let (mut log, mut events) = (FaultLog::default(), Vec::new());
            let traffic: Vec<u8> = (0..3000).flat_map(frame).collect();
            for piece in traffic.chunks(size) {
                line.push(piece, start, &mut log, &mut events);
            }
            line.settle(start + Duration::from_secs(1), &mut log);
            (line.arrived().to_vec(), log.counts(), events)
        };
        let first = went(1, 64);
        assert_eq!(first, went(1, 7));
        assert_ne!(first.0, went(2, 64).0);
        assert!(first.1[0].iter().all(|&count| count > 5));
    }

    #[test]
    fn lets_an_overtaken_frame_go_where_nothing_follows() {
        let (mut line, mut log, now) = (line("reorder=1"), FaultLog::default(), Instant::now());
        push(&mut line, 5, now, &mut log);
        assert!(!line.has_arrived());
        line.settle(now + PATIENCE, &mut log);
        assert_eq!(line.arrived(), frame(5));
    }

    #[test]
    fn names_both_frames_that_a_lost_zero_joins() {
        let (mut line, mut log, now) = (line(""), FaultLog::default(), Instant::now());
        let mut open = frame(1);
        *open.last_mut().unwrap() = 4;
        line.emit(&open, now, &mut log);
        line.emit(&frame(2), now, &mut log);
        line.emit(&frame(3), now, &mut log);
        assert_eq!(log.count(Fault::Flip, Direction::ToHost), 1);
    }

    #[test]
    fn keeps_what_is_no_frame_within_bounds() {
        let (mut line, mut log) = (line("drop=.5"), FaultLog::default());
        for _ in 0..1000 {
            line.push(&[1; 100], Instant::now(), &mut log, &mut Vec::new());
            let length = line.arrived().len();
            line.consume(length);
            assert!(line.backlog() <= LONGEST);
        }
    }

    #[test]
    fn passes_no_more_than_its_rate_and_a_burst() {
        let start = Instant::now();
        let mut bucket = Bucket::new(115_200, start);
        let mut passed = 0;
        for step in 0..10_000u64 {
            let now = start + Duration::from_micros(137 * step);
            let bytes = bucket.allowance(now);
            bucket.spend(bytes);
            passed += bytes;
            let limit = 11_520.0 * (137e-6 * step as f64) + 24.0;
            assert!(passed as f64 <= limit, "{passed} > {limit}");
        }
        assert!(passed as f64 >= 0.99 * 11_520.0 * 1.37);
    }

    #[test]
    fn keeps_a_burst_at_most_however_long_it_rests() {
        let start = Instant::now();
        let mut bucket = Bucket::new(9600, start);
        assert_eq!(bucket.allowance(start + Duration::from_secs(100)), 16);
    }
}
