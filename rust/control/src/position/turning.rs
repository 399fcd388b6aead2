//! A position loop on a counter that turns for as long as it likes, in single precision.
//!
//! Single precision tells counts apart only within 2^24 of the origin, and a profile needs parts of counts: a spindle would lose
//! both within minutes. Until a goal is given only differences of positions matter, so the origin goes along with the shaft.

use super::PositionLoop;
use crate::{Controller, Refused};

/// Counts from which on the origin goes along; single precision then still has 1/4096 of a count.
const FAR: f32 = 4096.0;
/// The largest goal and angle \[counts\]: single precision has half counts there.
pub const FARTHEST: f32 = 4_194_304.0;
/// Parts of a count in which the way of the origin is taken modulo a turn.
const PARTS: i64 = 1 << 16;

/// A [`PositionLoop`] whose positions are those of a counter, 0 where the run begins.
///
/// It begins as the speed loop alone; see [`follow`](Self::follow) and [`stop`](Self::stop).
#[derive(Clone, Debug)]
pub struct Turning {
    law: PositionLoop<f32>,
    /// Where the law's positions are 0.
    origin: i64,
}

impl Turning {
    /// A loop at rest.
    #[inline]
    pub fn new(law: PositionLoop<f32>) -> Self {
        Self { law, origin: 0 }
    }

    /// From the next sample on references are goals \[counts\].
    pub fn follow(&mut self) {
        self.law.follow();
    }

    /// From the next sample on it goes to a place that differs from `angle` by whole `turn`s \[counts\]; see [`PositionLoop::stop`].
    ///
    /// # Errors
    /// As there.
    pub fn stop(&mut self, angle: f32, turn: f32, onward: bool) -> Result<(), Refused> {
        // by whole counts, and in more digits than single precision has
        let way = self.origin.saturating_mul(PARTS);
        let turned = way.checked_rem((turn * PARTS as f32) as i64).unwrap_or(0);
        let at = angle - turned as f32 / PARTS as f32;
        self.law.stop(at, turn, onward).map(drop)
    }

    /// From the reference and the counts since the last sample to the command.
    #[inline]
    pub fn step(&mut self, reference: f32, moved: i32) -> f32 {
        let u = self.law.step(reference, moved as f32);
        let counts = self.law.counts();
        if self.law.is_speed_loop() && counts.abs() >= FAR {
            self.law.move_origin(counts);
            self.origin = self.origin.saturating_add(counts as i64);
        }
        u
    }

    /// The goal \[counts\]; `None` while it is a speed loop.
    pub fn goal(&self) -> Option<i64> {
        let goal = (!self.law.is_speed_loop()).then(|| self.law.goal());
        goal.map(|goal| self.origin.saturating_add(goal as i64))
    }

    /// Counts from where the run began to the origin of the law's positions.
    pub fn origin(&self) -> i64 {
        self.origin
    }

    /// The law, whose positions are counted from [`origin`](Self::origin).
    pub fn law(&self) -> &PositionLoop<f32> {
        &self.law
    }

    /// The filtered feedback of the last step \[y\].
    pub fn filtered(&self) -> f32 {
        self.law.filtered()
    }

    /// Least and largest command \[u\].
    pub fn limits(&self) -> (f32, f32) {
        self.law.speed().limits()
    }
}
