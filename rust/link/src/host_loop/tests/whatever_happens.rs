//! The loop under arbitrary happenings and bytes.

use proptest::prelude::*;

use super::super::Outcome;
use super::{World, host_loop};
use crate::client::kind;

/// What happens between two calls.
#[derive(Clone, Debug)]
enum Happening {
    Wait(u64),
    Noise(Vec<u8>),
    Mute(bool),
    Event(u8, u8),
    Beat(u8),
    Stop,
}

fn happening() -> impl Strategy<Value = Happening> {
    prop_oneof![
        12 => (0_u64..40_000).prop_map(Happening::Wait),
        1 => (0_u64..3_000_000).prop_map(Happening::Wait),
        4 => prop::collection::vec(any::<u8>(), 0..300).prop_map(Happening::Noise),
        2 => any::<bool>().prop_map(Happening::Mute),
        1 => (0_u8..8, 0_u8..12).prop_map(|(code, reason)| Happening::Event(code, reason)),
        1 => (0_u8..6).prop_map(Happening::Beat),
        1 => Just(Happening::Stop),
    ]
}

proptest! {
    #[test]
    fn whatever_happens_no_command_follows_a_stop(happenings in prop::collection::vec(happening(), 1..120), ticks in 1_usize..60) {
        let mut world = World::new(ticks);
        for happens in happenings {
            let mut wait = 100;
            match happens {
                Happening::Wait(time) => wait = time,
                Happening::Noise(bytes) => world.peer.out.extend(bytes),
                Happening::Mute(mute) => world.peer.mute = mute,
                Happening::Event(code, reason) => world.peer.event(code, reason, 0.0),
                Happening::Beat(state) => world.peer.beat(state, 1),
                Happening::Stop => world.looped.stop(Outcome::Interrupted),
            }
            world.call(world.now + wait);
        }
        world.serve(u64::MAX);
        prop_assert!(world.looped.done() && world.outcome().is_some());
        let stop = world.peer.said.iter().position(|(header, _)| header.kind == kind::STOP);
        let moves = |kind: u8| matches!(kind, kind::ARM | kind::START | kind::KEEP | kind::DRIVE);
        if let Some(stop) = stop {
            prop_assert!(!world.peer.said[stop..].iter().any(|(header, _)| moves(header.kind)));
        }
        let log = world.looped.ticks();
        prop_assert!(log.run.len() as u64 + log.missed <= ticks as u64);
        prop_assert!(log.run.windows(2).all(|pair| pair[0].number < pair[1].number));
        prop_assert_eq!(world.peer.count(kind::DRIVE), log.run.len());
        if world.outcome() == Some(&Outcome::Completed) {
            prop_assert_eq!(log.run.len() as u64 + log.missed, ticks as u64);
        }
        prop_assert!(world.looped.history().times().len() <= 10 * ticks + 15);
    }

    #[test]
    fn any_bytes_at_any_clock_are_endured(calls in prop::collection::vec((any::<u64>(), prop::collection::vec(any::<u8>(), 0..100)), 0..50)) {
        let mut looped = host_loop(20);
        for (now, bytes) in calls {
            let said = looped.tick(now, &bytes);
            prop_assert!(said.iter().filter(|&&byte| byte == 0).count() <= 1);
        }
    }
}
