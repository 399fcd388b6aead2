//! Who may speak to a device behind a network: whoever speaks its protocol, and of this device.
//!
//! A browser can be made to send any bytes to a port of its own computer, behind the head of its request. That head is no
//! frame, and a page does not hear what the device says.

use sewfast_control::link::Deframer;

/// So many frames with the tag of another device close a connection.
const WRONG_TAGS: u32 = 8;
/// The kind of the frame that carries no tag.
const HELLO: u8 = 0x01;

/// What a connection has said so far.
#[derive(Debug)]
pub struct Gate {
    deframer: Deframer,
    /// The first block was a frame.
    speaks: bool,
    wrong: u32,
    /// The device's tags since the connection was made: after a reset a host goes on with the one before until it hears of it.
    tags: Vec<u16>,
}

impl Gate {
    /// For a new connection.
    pub fn new() -> Self {
        Self {
            deframer: Deframer::new(),
            speaks: false,
            wrong: 0,
            tags: Vec::new(),
        }
    }

    /// Whether a connection that says `bytes` to the device of this `tag` may go on; none of them counts where it may not.
    pub fn admits(&mut self, mut bytes: &[u8], tag: u16) -> bool {
        if self.tags.last() != Some(&tag) {
            self.tags.push(tag);
        }
        while let Some(block) = self.deframer.next(&mut bytes) {
            match block {
                Ok(frame) => {
                    self.speaks = true;
                    let named = frame.header.kind != HELLO;
                    self.wrong += u32::from(named && !self.tags.contains(&frame.header.tag));
                }
                // damage on the way happens to a host that was understood before
                Err(_) if !self.speaks => return false,
                Err(_) => {}
            }
            if self.wrong >= WRONG_TAGS {
                return false;
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sewfast_control::link::{Header, MAX_WIRE, encode};

    fn wire(kind: u8, tag: u16) -> Vec<u8> {
        let header = Header {
            kind,
            tag,
            ..Header::default()
        };
        let mut wire = [0; MAX_WIRE];
        let length = encode(&header, b"body", &mut wire).unwrap();
        wire[..length].to_vec()
    }

    #[test]
    fn a_host_is_admitted_however_its_bytes_are_cut() {
        let said = [
            vec![0, 0],
            wire(HELLO, 0),
            wire(0x03, 7),
            wire(0x20, 7),
            vec![9, 9, 9, 0],
            wire(0x20, 7),
        ]
        .concat();
        for size in [1, 5, 1000] {
            let mut gate = Gate::new();
            assert!(said.chunks(size).all(|piece| gate.admits(piece, 7)));
        }
    }

    #[test]
    fn what_begins_with_no_frame_is_not() {
        let head = b"POST / HTTP/1.1\r\nHost: 127.0.0.1:5000\r\n\r\n".to_vec();
        let posted = [head.clone(), vec![0], wire(HELLO, 0)].concat();
        assert!(!Gate::new().admits(&posted, 7));
        let mut gate = Gate::new();
        assert!(gate.admits(&head, 7));
        assert!(!gate.admits(&[vec![0], wire(HELLO, 0)].concat(), 7));
        assert!(!Gate::new().admits(&[b'x'; 300], 7));
    }

    #[test]
    fn eight_wrong_tags_close_and_those_of_the_boot_before_do_not() {
        let mut gate = Gate::new();
        assert!(gate.admits(&wire(HELLO, 0), 7));
        for _ in 0..7 {
            assert!(gate.admits(&wire(0x05, 6), 7));
        }
        assert!((0..100).all(|_| gate.admits(&wire(0x20, 7), 8)));
        assert!(!gate.admits(&wire(0x05, 5), 8));
    }
}
