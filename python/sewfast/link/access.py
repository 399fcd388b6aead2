"""A serial port as the operating system sees it: permissions, open handles, latency timer."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass
from pathlib import Path

SYS = Path("/sys/class/tty")
PROC = Path("/proc")


@dataclass(frozen=True)
class Access:
    """Who may open a port.

    Parameters
    ----------
    allowed : bool
        Whether this user may read and write it.
    group : str or None
        The group that may open it, where the port's mode grants that.
    owner : str
    mode : str
        In the notation of ``ls``.
    member : bool
        Whether this process is in the group; a user who has just joined must log in again.
    """

    allowed: bool
    group: str | None
    owner: str
    mode: str
    member: bool


def access(path: str, user: int | None = None, groups: frozenset[int] | None = None) -> Access:
    """Who may open the port at `path`.

    Parameters
    ----------
    user, groups : int, frozenset of int, optional
        Ids to check; by default those of this process.

    Raises
    ------
    OSError
        If there is no such port.
    """
    user = os.geteuid() if user is None else user
    groups = frozenset((os.getegid(), *os.getgroups())) if groups is None else groups
    found = os.stat(path)
    mode, member = stat.S_IMODE(found.st_mode), found.st_gid in groups
    needed = stat.S_IRUSR | stat.S_IWUSR
    if user == 0:
        granted = needed
    elif user == found.st_uid:
        granted = mode
    else:
        granted = mode << 3 if member else mode << 6
    may_group = mode & (needed >> 3) == needed >> 3
    return Access(
        allowed=granted & needed == needed,
        group=_group_name(found.st_gid) if may_group else None,
        owner=_user_name(found.st_uid),
        mode=stat.filemode(found.st_mode),
        member=member,
    )


def _group_name(number: int) -> str:
    try:
        import grp

        return grp.getgrgid(number).gr_name
    except (ImportError, KeyError):
        return str(number)


def _user_name(number: int) -> str:
    try:
        import pwd

        return pwd.getpwuid(number).pw_name
    except (ImportError, KeyError):
        return str(number)


def permission_remedy(found: Access, vid: int | None = None, pid: int | None = None) -> str:
    """How a user gets to open a port: by joining its group, or by a udev rule."""
    usb = "" if vid is None or pid is None else (
        f'ATTRS{{idVendor}}=="{vid:04x}", ATTRS{{idProduct}}=="{pid:04x}", '
    )  # fmt: skip
    rule = f'SUBSYSTEM=="tty", {usb}MODE="0660", GROUP="{found.group or "dialout"}"'
    by_rule = (
        f"put the line {rule} into /etc/udev/rules.d/70-sewfast.rules, run "
        "`sudo udevadm control --reload` and plug it in again"
    )
    if found.group is None:
        return f"{by_rule}; then join the group: sudo usermod -aG dialout $USER, and log in again"
    if found.member:
        return f"its mode {found.mode} is in the way: {by_rule}"
    return (
        f"join its group and log in again: sudo usermod -aG {found.group} $USER; or for this port "
        f"alone, {by_rule}"
    )


def holders(path: str, proc: Path = PROC) -> list[tuple[int, str]]:
    """Number and name of the other processes that hold a port open, as far as this user can see.

    Empty on a system without /proc.
    """
    wanted = os.path.realpath(path)
    found = []
    for folder in proc.glob("[0-9]*"):
        number = int(folder.name)
        if number != os.getpid() and _holds(folder / "fd", wanted):
            found.append((number, _command(folder)))
    return sorted(found)


def _holds(folder: Path, wanted: str) -> bool:
    try:
        with os.scandir(folder) as entries:
            return any(_target(entry.path) == wanted for entry in entries)
    except OSError:
        return False


def _target(path: str) -> str | None:
    try:
        return os.readlink(path)
    except OSError:
        return None


def _command(folder: Path) -> str:
    try:
        return (folder / "comm").read_text(errors="replace").strip()
    except OSError:
        return "unknown"


def latency_timer(path: str, root: Path = SYS) -> tuple[int, Path] | None:
    """Milliseconds for which an FTDI adapter holds bytes back, and the file to change them in.

    None for an adapter without such a timer, and on a system that does not show it.
    """
    file = root / Path(os.path.realpath(path)).name / "device" / "latency_timer"
    try:
        return int(file.read_text()), file
    except (OSError, ValueError):
        return None
