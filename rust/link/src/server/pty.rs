//! A pseudo-terminal as a serial port, with a stable name if requested.

use std::fs;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::ffi::OsStringExt;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, QueueSelector, tcflush, tcgetattr, tcsetattr};

use super::port::{Port, explained};
use crate::ready::{Interest, Ready, wait};

/// The master side. The server keeps no slave open, so it sees a host hang up.
#[derive(Debug)]
pub struct Pty {
    master: Option<OwnedFd>,
    slave: PathBuf,
    link: Option<PathBuf>,
    connected: bool,
}

impl Pty {
    /// A new pseudo-terminal; while it exists `link` is a symbolic link to it.
    ///
    /// # Errors
    /// The system has none left; or `link` exists and is no symbolic link, or cannot be created.
    pub fn open(link: Option<PathBuf>) -> io::Result<Self> {
        let mut pty = Self {
            master: None,
            slave: PathBuf::new(),
            link: link.map(std::path::absolute).transpose()?,
            connected: false,
        };
        pty.plug()?;
        Ok(pty)
    }

    fn state(&self) -> Ready {
        let gone = Ready {
            gone: true,
            ..Ready::default()
        };
        self.master.as_ref().map_or(gone, |master| {
            wait([(master.as_fd(), Interest::READ)], Duration::ZERO)
                .map_or(Ready::default(), |[found]| found)
        })
    }

    /// Clears the line: a later host must not read what was meant for this one.
    fn hung_up(&mut self) {
        self.connected = false;
        if self.master.is_some() {
            // on failure stale bytes remain, which the host's receiver drops by their sequence
            let _ = prepare(&self.slave);
        }
    }
}

/// Sets the slave to raw mode and empties it. Opening and closing it also marks the master as hung up, which an unused one is not.
fn prepare(slave: &Path) -> io::Result<()> {
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC | OFlags::NONBLOCK;
    let slave = rustix::fs::open(slave, flags, Mode::empty())?;
    let mut settings = tcgetattr(&slave)?;
    settings.make_raw();
    tcsetattr(&slave, OptionalActions::Now, &settings)?;
    Ok(tcflush(&slave, QueueSelector::IFlush)?)
}

fn create() -> io::Result<(OwnedFd, PathBuf)> {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY)?;
    rustix::io::fcntl_setfd(&master, rustix::io::FdFlags::CLOEXEC)?;
    grantpt(&master)?;
    unlockpt(&master)?;
    let slave = ptsname(&master, Vec::new())?.into_bytes();
    let slave = PathBuf::from(std::ffi::OsString::from_vec(slave));
    prepare(&slave)?;
    rustix::fs::fcntl_setfl(&master, OFlags::RDWR | OFlags::NONBLOCK)?;
    Ok((master, slave))
}

/// Replaces the symbolic link `link` atomically; anything else of that name is left alone.
fn point(link: &Path, target: &Path) -> io::Result<()> {
    if fs::symlink_metadata(link).is_ok_and(|found| !found.is_symlink()) {
        return Err(io::Error::new(
            io::ErrorKind::AlreadyExists,
            "something else than a symbolic link has this name; choose another",
        ));
    }
    let mut name = link.file_name().unwrap_or_default().to_os_string();
    name.push(format!(".{}", std::process::id()));
    let temporary = link.with_file_name(name);
    let _ = fs::remove_file(&temporary);
    symlink(target, &temporary)?;
    fs::rename(&temporary, link).inspect_err(|_| {
        let _ = fs::remove_file(&temporary);
    })
}

impl Port for Pty {
    fn name(&self) -> String {
        let name = self.link.as_ref().unwrap_or(&self.slave);
        name.display().to_string()
    }

    fn connected(&mut self) -> bool {
        if !self.connected {
            let state = self.state();
            // bytes without a host come from one that was connected for a moment
            self.connected = !state.gone || state.read;
        }
        self.connected
    }

    fn read(&mut self, buffer: &mut [u8]) -> usize {
        let Some(master) = &self.master else { return 0 };
        match rustix::io::read(master, buffer) {
            Ok(length) if length > 0 => length,
            Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => 0,
            _ => {
                self.hung_up();
                0
            }
        }
    }

    fn write(&mut self, bytes: &[u8]) -> usize {
        let Some(master) = &self.master else { return 0 };
        rustix::io::write(master, bytes).unwrap_or(0)
    }

    fn wait(&mut self, interest: Interest, timeout: Duration) {
        let idle = !interest.read && !interest.write;
        let Some(master) = self.master.as_ref().filter(|_| self.connected && !idle) else {
            // a hung-up terminal is always ready, so waiting for it would not wait
            return thread::sleep(timeout);
        };
        // a failure shows when bytes are read
        let _ = wait([(master.as_fd(), interest)], timeout);
    }

    fn unplug(&mut self) {
        if let Some(link) = &self.link
            && fs::read_link(link).is_ok_and(|target| target == self.slave)
        {
            let _ = fs::remove_file(link);
        }
        self.master = None;
        self.connected = false;
    }

    fn plug(&mut self) -> io::Result<()> {
        let (master, slave) = create().map_err(|e| explained(&e, "a new pseudo-terminal"))?;
        if let Some(link) = &self.link {
            point(link, &slave).map_err(|e| explained(&e, &link.display().to_string()))?;
        }
        (self.master, self.slave) = (Some(master), slave);
        Ok(())
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        self.unplug();
    }
}
