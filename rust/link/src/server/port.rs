//! Where a host connects: the interface of every port, the TCP port, and the gate that decides who is heard.

use std::fmt::Debug;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::time::Duration;

use sewfast_control::link::Deframer;

use crate::ready::Interest;

/// A port with at most one host; nothing in it blocks except [`Port::wait`].
pub trait Port: Debug + Send {
    /// The name that a host opens.
    fn name(&self) -> String;

    /// Checks the connection; true while a host is connected.
    fn connected(&mut self) -> bool;

    /// Reads bytes from the host; 0 if there are none. [`Port::connected`] then reports whether the host has gone.
    fn read(&mut self, buffer: &mut [u8]) -> usize;

    /// Writes bytes to the host; returns how many.
    fn write(&mut self, bytes: &[u8]) -> usize;

    /// Sleeps until `interest` can be served, at most for `timeout`.
    fn wait(&mut self, interest: Interest, timeout: Duration);

    /// Makes the port vanish.
    fn unplug(&mut self);

    /// Makes it return.
    ///
    /// # Errors
    /// The system does not provide it.
    fn plug(&mut self) -> io::Result<()>;

    /// Whether it can be reached by others than this computer's users, for example a web page.
    fn is_network(&self) -> bool {
        false
    }

    /// Disconnects the present host.
    fn hang_up(&mut self) {}

    /// Hosts turned away, because another was connected or because they were no hosts.
    fn refused(&self) -> u64 {
        0
    }
}

/// An error that says what was being done.
pub fn explained(error: &io::Error, what: &str) -> io::Error {
    io::Error::new(error.kind(), format!("{what}: {error}"))
}

/// A listener and the connected client.
#[derive(Debug)]
pub struct Tcp {
    address: SocketAddr,
    listener: Option<TcpListener>,
    client: Option<TcpStream>,
    /// The client has gone, and this has not been reported yet.
    gone: bool,
    refused: u64,
}

impl Tcp {
    /// Listens on `address`, such as `127.0.0.1:5000`; port 0 takes a free one. `anyone` permits an address that other computers reach.
    ///
    /// # Errors
    /// The address is not this computer's, in use or not permitted; or others can reach it without `anyone`.
    pub fn listen(address: &str, anyone: bool) -> io::Result<Self> {
        let resolved = address
            .to_socket_addrs()
            .and_then(|mut found| found.next().ok_or_else(|| ErrorKind::NotFound.into()))
            .map_err(|e| explained(&e, &format!("expected HOST:PORT, got {address:?}")))?;
        if !(anyone || resolved.ip().is_loopback()) {
            let what = format!(
                "expected an address that only this computer reaches, as 127.0.0.1:5000, got {address:?}; whoever reaches \
                 the port can start the motor: where that is meant, say so (anyone=True, --anyone)"
            );
            return Err(io::Error::new(ErrorKind::PermissionDenied, what));
        }
        let mut tcp = Self {
            address: resolved,
            listener: None,
            client: None,
            gone: false,
            refused: 0,
        };
        tcp.plug()?;
        Ok(tcp)
    }

    /// Accepts the first client; for others the connection is closed.
    fn accept(&mut self) {
        let Some(listener) = &self.listener else {
            return;
        };
        while let Ok((client, _)) = listener.accept() {
            if self.client.is_some() {
                self.refused += 1;
            } else {
                self.client = prepared(client).ok();
            }
        }
    }

    fn leave(&mut self) {
        self.gone |= self.client.take().is_some();
    }

    fn outcome(&mut self, result: io::Result<usize>) -> usize {
        match result {
            Ok(length) if length > 0 => length,
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => 0,
            _ => {
                self.leave();
                0
            }
        }
    }
}

fn prepared(client: TcpStream) -> io::Result<TcpStream> {
    client.set_nonblocking(true)?;
    client.set_nodelay(true)?;
    #[cfg(unix)]
    keep_alive(&client)?;
    Ok(client)
}

/// A client whose computer vanished silently makes room for another after some seconds.
#[cfg(unix)]
fn keep_alive(client: &TcpStream) -> io::Result<()> {
    use rustix::net::sockopt;
    sockopt::set_socket_keepalive(client, true)?;
    #[cfg(target_os = "linux")]
    {
        sockopt::set_tcp_keepidle(client, Duration::from_secs(2))?;
        sockopt::set_tcp_keepintvl(client, Duration::from_secs(1))?;
        sockopt::set_tcp_keepcnt(client, 3)?;
        sockopt::set_tcp_user_timeout(client, 5000)?;
    }
    Ok(())
}

impl Port for Tcp {
    fn name(&self) -> String {
        format!("socket://{}", self.address)
    }

    fn connected(&mut self) -> bool {
        // a client that arrives as another leaves is a new one: the old one's bytes must not count for it
        if std::mem::take(&mut self.gone) {
            return false;
        }
        self.accept();
        self.client.is_some()
    }

    fn read(&mut self, buffer: &mut [u8]) -> usize {
        let Some(client) = &mut self.client else {
            return 0;
        };
        let result = client.read(buffer);
        self.outcome(result)
    }

    fn write(&mut self, bytes: &[u8]) -> usize {
        let Some(client) = &mut self.client else {
            return 0;
        };
        let result = client.write(bytes);
        self.outcome(result)
    }

    #[cfg(unix)]
    fn wait(&mut self, interest: Interest, timeout: Duration) {
        use std::os::fd::AsFd;

        use crate::ready::wait;
        let client = self
            .client
            .as_ref()
            .filter(|_| interest.read || interest.write);
        let client = client.map(|client| (client.as_fd(), interest));
        let listener = self
            .listener
            .as_ref()
            .map(|listener| (listener.as_fd(), Interest::READ));
        // a failure shows when bytes are read
        match (client, listener) {
            (Some(client), Some(listener)) => drop(wait([client, listener], timeout)),
            (Some(port), None) | (None, Some(port)) => drop(wait([port], timeout)),
            (None, None) => std::thread::sleep(timeout),
        }
    }

    #[cfg(not(unix))]
    fn wait(&mut self, _: Interest, timeout: Duration) {
        std::thread::sleep(timeout.min(Duration::from_millis(1)));
    }

    fn unplug(&mut self) {
        self.leave();
        self.listener = None;
    }

    fn plug(&mut self) -> io::Result<()> {
        let open = || {
            let listener = TcpListener::bind(self.address)?;
            listener.set_nonblocking(true)?;
            // port 0 meant any port; the one assigned stays the same from here on
            Ok((listener.local_addr()?, listener))
        };
        let opened = open().map_err(|e: io::Error| {
            let address = self.address;
            explained(
                &e,
                &format!("cannot listen on {address}; choose another port, 0 for any"),
            )
        });
        let (address, listener) = opened?;
        (self.address, self.listener) = (address, Some(listener));
        Ok(())
    }

    fn is_network(&self) -> bool {
        true
    }

    fn hang_up(&mut self) {
        self.leave();
        self.refused += 1;
    }

    fn refused(&self) -> u64 {
        self.refused
    }
}

// Who may talk to a device on a network: whoever speaks its protocol, with this device's tag.
//
// A browser can be made to send arbitrary bytes to a port of its own computer, after the head of its request. That head
// is no frame, and a page cannot read the device's replies.

/// This many frames with another device's tag close a connection.
const WRONG_TAGS: u32 = 8;
/// The kind of the only frame without a tag.
const HELLO: u8 = 0x01;

/// What a connection has sent so far.
#[derive(Debug)]
pub struct Gate {
    deframer: Deframer,
    /// Whether the first block was a frame.
    speaks: bool,
    wrong: u32,
    /// The device's tags since the connection was made: after a reset a host uses the old one until it learns of the reset.
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

    /// Whether a connection that sends `bytes` to the device of this `tag` may continue; if not, none of them is passed on.
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
                // damage in transit is tolerated from a host that was understood before
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
    use sewfast_control::link::{Header, MAX_WIRE, encode};

    use super::*;

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
