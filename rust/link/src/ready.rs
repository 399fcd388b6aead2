//! Waiting until a port is ready.

#[cfg(unix)]
pub use unix::{Ready, wait};

/// What to wait for.
#[derive(Clone, Copy, Debug)]
pub struct Interest {
    /// Bytes from the other side.
    pub read: bool,
    /// Room for bytes to the other side.
    pub write: bool,
}

impl Interest {
    /// Only bytes from the other side.
    pub const READ: Self = Self {
        read: true,
        write: false,
    };
}

/// By `poll`; on Apple's systems by `select`.
///
/// Under BUGS, Apple's poll(2) says that it does not support devices, and terminals are reported to return `POLLNVAL`;
/// its select(2) supports them. The tests run both on the present system; nothing of this was run on Apple's.
#[cfg(unix)]
mod unix {
    use std::os::fd::{AsRawFd, BorrowedFd};
    use std::time::Duration;

    use rustix::event::{
        FdSetElement, FdSetIter, PollFd, PollFlags, Timespec, fd_set_insert, fd_set_num_elements,
        poll, select,
    };
    use rustix::io::{Errno, ioctl_fionread};

    use super::Interest;

    /// What a port is ready for.
    #[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
    pub struct Ready {
        /// Bytes have arrived, or a caller.
        pub read: bool,
        /// Bytes can be written.
        pub write: bool,
        /// The other side has gone; some of its bytes may still be there.
        pub gone: bool,
    }

    /// Sleeps until a port is ready, at most for `timeout`; a signal ends it early with nothing ready.
    ///
    /// # Errors
    /// The system cannot wait for these ports.
    pub fn wait<const N: usize>(
        ports: [(BorrowedFd<'_>, Interest); N],
        timeout: Duration,
    ) -> Result<[Ready; N], Errno> {
        let found = if cfg!(target_vendor = "apple") {
            by_select(ports, timeout)
        } else {
            by_poll(ports, timeout)
        };
        match found {
            Err(Errno::INTR) => Ok([Ready::default(); N]),
            found => found,
        }
    }

    fn by_poll<const N: usize>(
        ports: [(BorrowedFd<'_>, Interest); N],
        timeout: Duration,
    ) -> Result<[Ready; N], Errno> {
        let mut fds = ports.map(|(port, interest)| {
            let mut wanted = PollFlags::empty();
            wanted.set(PollFlags::IN, interest.read);
            wanted.set(PollFlags::OUT, interest.write);
            PollFd::from_borrowed_fd(port, wanted)
        });
        poll(&mut fds, Some(&span(timeout)))?;
        Ok(fds.map(|fd| {
            let found = fd.revents();
            Ready {
                read: found.contains(PollFlags::IN),
                write: found.contains(PollFlags::OUT),
                gone: found.intersects(PollFlags::HUP | PollFlags::ERR | PollFlags::NVAL),
            }
        }))
    }

    /// A port whose other side has gone is readable here without bytes: it looks like a ready one, so the bytes are counted.
    fn by_select<const N: usize>(
        ports: [(BorrowedFd<'_>, Interest); N],
        timeout: Duration,
    ) -> Result<[Ready; N], Errno> {
        let above = ports
            .iter()
            .map(|(port, _)| port.as_raw_fd() + 1)
            .max()
            .unwrap_or(0);
        let empty = vec![FdSetElement::default(); fd_set_num_elements(N, above)];
        let (mut readable, mut writable) = (empty.clone(), empty);
        for (port, interest) in ports {
            // a port to be written to may vanish meanwhile
            fd_set_insert(&mut readable, port.as_raw_fd());
            if interest.write {
                fd_set_insert(&mut writable, port.as_raw_fd());
            }
        }
        // SAFETY: every descriptor in the sets is borrowed, so it stays open until the call has returned.
        unsafe {
            select(
                above,
                Some(&mut readable),
                Some(&mut writable),
                None,
                Some(&span(timeout)),
            )
        }?;
        Ok(ports.map(|(port, interest)| {
            let has = |set: &[FdSetElement]| FdSetIter::new(set).any(|fd| fd == port.as_raw_fd());
            let readable = has(&readable);
            // a listening port has no bytes to count
            let gone = readable && matches!(ioctl_fionread(port), Ok(0) | Err(Errno::IO));
            Ready {
                read: readable && !gone && interest.read,
                write: has(&writable),
                gone,
            }
        }))
    }

    fn span(timeout: Duration) -> Timespec {
        Timespec::try_from(timeout).unwrap_or_default()
    }

    #[cfg(test)]
    mod tests {
        use std::net::{TcpListener, TcpStream};
        use std::os::fd::AsFd;

        use rustix::fs::{Mode, OFlags};
        use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

        use super::*;

        const BOTH: Interest = Interest {
            read: true,
            write: true,
        };
        const READ: Interest = Interest::READ;
        const SHORT: Duration = Duration::from_millis(50);

        fn both_ways<const N: usize>(ports: [(BorrowedFd<'_>, Interest); N]) -> [Ready; N] {
            let found = by_poll(ports, SHORT).unwrap();
            assert_eq!(by_select(ports, SHORT).unwrap(), found);
            assert_eq!(wait(ports, SHORT).unwrap(), found);
            found
        }

        #[test]
        fn a_terminal_whose_host_comes_writes_and_goes() {
            let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
            grantpt(&master).unwrap();
            unlockpt(&master).unwrap();
            let name = ptsname(&master, Vec::new()).unwrap();
            let open =
                || rustix::fs::open(&name, OFlags::RDWR | OFlags::NOCTTY, Mode::empty()).unwrap();
            let [found] = {
                let _host = open();
                both_ways([(master.as_fd(), READ)])
            };
            assert_eq!(found, Ready::default());
            let host = open();
            rustix::io::write(&host, b"bytes\n").unwrap();
            let [found] = both_ways([(master.as_fd(), BOTH)]);
            assert_eq!((found.read, found.write, found.gone), (true, true, false));
            rustix::io::read(&master, &mut [0; 64]).unwrap();
            drop(host);
            let [found] = both_ways([(master.as_fd(), READ)]);
            assert_eq!((found.read, found.gone), (false, true));
        }

        #[test]
        fn a_socket_that_is_called() {
            let listener = TcpListener::bind("127.0.0.1:0").unwrap();
            assert_eq!(both_ways([(listener.as_fd(), READ)]), [Ready::default()]);
            let caller = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
            let ports = [(listener.as_fd(), READ), (caller.as_fd(), BOTH)];
            let [called, idle] = both_ways(ports);
            assert!(called.read);
            assert_eq!((idle.read, idle.write), (false, true));
        }
    }
}
