//! A TCP port with one client at a time.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::time::Duration;

use super::port::{Port, explained};
use crate::ready::Interest;

/// A listener and the client that is there.
#[derive(Debug)]
pub struct Tcp {
    address: SocketAddr,
    listener: Option<TcpListener>,
    client: Option<TcpStream>,
    /// The client has gone and nobody has looked since.
    gone: bool,
    refused: u64,
}

impl Tcp {
    /// Listens on `address`, as `127.0.0.1:5000`; port 0 takes a free one. `anyone`: on one that other computers reach, too.
    ///
    /// # Errors
    /// Where the address is none of this computer, in use or not allowed; where others reach it and that was not said.
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

    /// Takes the first client; the others are told by a closed connection.
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

/// A client whose computer is gone without a word makes room for another after some seconds.
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
        // one that comes as another goes is another one: what that one has said must not count for it
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
        // a failure is seen when bytes are read
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
            // port 0 was a wish for any; the one given stays the same from here on
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
