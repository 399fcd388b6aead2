"""`examine` diagnoses a port and the device behind it, with remedies; it moves nothing."""

from __future__ import annotations

import math
import os
import random
import stat
import statistics
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

from ..errors import LinkError, SettingError
from . import wire
from .connection import Connection
from .drive import PATIENCE, Drive
from .ports import A_PORT, CONNECT_TIMEOUT, Port, list_ports, open_port, transport_of

# --- `Diagnosis`: the findings --------------------------------------------------------------------


Verdict: TypeAlias = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Parameters
    ----------
    name : str
    verdict : "ok", "warn" or "fail"
    measured : str
        The finding as text.
    remedy : str
        What to do; empty if nothing is needed.
    values : dict
        Its numbers, with units in their names.
    """

    name: str
    verdict: Verdict
    measured: str
    remedy: str = ""
    values: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        text = f"{self.verdict:<4}  {self.name:<14}{self.measured}"
        return f"{text}\n{'':20}-> {self.remedy}" if self.remedy else text


@dataclass(frozen=True)
class Diagnosis:
    """The findings of `examine` in the order of its checks; a failure can end them early."""

    port: str
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst of all."""
        verdicts = {f.verdict for f in self.findings}
        return "fail" if "fail" in verdicts else "warn" if "warn" in verdicts else "ok"

    def __getitem__(self, name: str) -> Finding:
        """The finding of this name; KeyError if that check was not made."""
        for finding in self.findings:
            if finding.name == name:
                return finding
        raise KeyError(name)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "port": self.port,
            "verdict": self.verdict,
            "findings": [
                {
                    "name": f.name, "verdict": f.verdict, "measured": f.measured,
                    "remedy": f.remedy, **f.values,
                }
                for f in self.findings
            ],
        }  # fmt: skip

    def __str__(self) -> str:
        ends = {
            "ok": "nothing is wrong with it",
            "warn": "it works; see the warnings",
            "fail": "it does not work yet; see the failures",
        }
        return "\n".join([*map(str, self.findings), f"{self.port}: {ends[self.verdict]}"])


# --- measurements of a device and its link: state, round trips, throughput, loss, clock -----------


SHORT, LONG = 0, 200
"""Bytes of the two kinds of echoes; the difference of their times is the cost of the bytes."""
SPARE = 0.4
"""Share of the link that a recording at full rate should leave free."""


class Metered(Port):
    """A port around an open one, which counts what is written to it."""

    def __init__(self, port: Port) -> None:
        self._port = port
        self.url, self.baud = port.url, port.baud
        self.frames = 0

    def _open(self) -> None: ...

    def read(self, timeout: float) -> bytes:
        return self._port.read(timeout)

    def write(self, data: bytes) -> None:
        self.frames += 1
        self._port.write(data)

    @property
    def max_rate(self) -> float:
        return self._port.max_rate

    def describe(self) -> str:
        return self._port.describe()

    def fileno(self) -> int:
        return self._port.fileno()

    def close(self) -> None:
        self._port.close()

    def reopen(self, timeout: float = CONNECT_TIMEOUT) -> None:
        self._port.reopen(timeout)


# --- the device -----------------------------------------------------------------------------------


def checkup(port: Metered, echoes: int) -> Iterator[Finding]:
    """Check the device behind an open port, finding by finding; `LinkError` if it is mute."""
    link = Connection(port, watchdog=0.05, patience=PATIENCE, resume=0.0)
    drive = Drive(link)
    yield _identity(drive)
    # count frames up to the first copy of each STATUS, as the device does: repeats are no loss
    sent, before = port.frames, drive.status()
    yield _state(before)
    yield _limits(drive)
    times = _echo(drive, echoes)
    yield _round_trip(times)
    yield _throughput(times, drive, port)
    sent, after = port.frames - sent, drive.status()
    yield _loss(link, before, after, sent, 2 * echoes)
    yield _clock(drive)
    yield _counters(after, before, drive)


def _identity(drive: Drive) -> Finding:
    i = drive.identity
    names = ", ".join(f"{c.name} [{c.unit}]" if c.unit else c.name for c in drive.channels)
    return Finding(
        "device", "ok",
        f"{i.name}, firmware {i.firmware}, protocol {i.version}, {i.period_us} us; {names}",
        values={
            "device": i.name, "firmware": i.firmware, "protocol": i.version,
            "period_us": i.period_us, "counts_per_rev": i.counts_per_rev,
            "channels": [c.name for c in drive.channels],
        },
    )  # fmt: skip


def _state(status: wire.Status) -> Finding:
    values = {"state": status.state, "reason": status.reason}
    if status.state == "tripped":
        return Finding(
            "state", "warn", f"tripped: {status.reason}",
            f"{_TRIPS.get(status.reason, 'find out why')}; then take it back: `sewfast clear`",
            values,
        )  # fmt: skip
    if status.state == "boot":
        return Finding(
            "state", "fail", "stays in boot: it never measured ten samples in a row without error",
            "check encoder and sensors", values,
        )  # fmt: skip
    return Finding("state", "ok", status.state, values=values)


_TRIPS = {
    "watchdog": "its host fell silent or the cable was unplugged: see the loss below, give a busy "
    "computer more time (--watchdog 250)",
    "speed": "the speed limit was exceeded; check the limits and the controller",
    "acceleration": "the acceleration limit was exceeded; check the limits and the encoder",
    "current": "the current limit was exceeded; check the mechanics for a jam",
    "underrun": "the profile ran dry; see the throughput below",
    "bad command": "a command was refused while running (check host and firmware versions), or a "
    "stop was to begin above the fastest speed of its position loop",
    "host changed": "another host connected while it was running; use one host only",
    "measurement": "a measurement was not finite; check the sensors",
    "no motion": "the motor did not move; check motor cable, drive supply and encoder",
    "stop input": "the stop input is active; release it",
    "late": "a control period came late; see the counters below",
    "travel": "the counter, or the goal of a stop, was beyond the limits of the position; turn the "
    "shaft back without a command, or widen them (drive.set_travel)",
    "swinging": "the loop oscillated between its limits; lower the gains or look for a resonance",
}


def _limits(drive: Drive) -> Finding:
    limits = drive.limits()
    names = ("volt", "speed_rpm", "acceleration", "current")
    values = dict(zip(names, (v if math.isfinite(v) else None for v in limits.values), strict=True))
    if not limits.are_set:
        return Finding("limits", "ok", "none set in this session: it will not arm before they are")
    volt, speed, acceleration, current = limits.values
    detail = f"{volt:g} V, {speed:g} RPM, {acceleration:g} RPM/s, {current:g} A"
    return Finding("limits", "ok", detail, values=values)


# --- the link -------------------------------------------------------------------------------------


def _echo(drive: Drive, echoes: int) -> dict[int, list[float]]:
    """Round trips of short and long messages in turn [s]."""
    times: dict[int, list[float]] = {SHORT: [], LONG: []}
    # random bytes, so that a line that damages certain values is found
    content = random.Random(0)
    for _ in range(echoes):
        for size, list_ in times.items():
            list_.append(drive.echo(content.randbytes(size)))
    return times


def _round_trip(times: dict[int, list[float]]) -> Finding:
    median, worst = statistics.median(times[SHORT]), max(times[SHORT])
    values = {"median_s": median, "worst_s": worst}
    detail = f"median {_time(median)}, worst {_time(worst)} of {len(times[SHORT])}"
    if median <= 0.01:
        return Finding("round trip", "ok", detail, values=values)
    return Finding(
        "round trip", "warn", detail,
        "an adapter's latency timer or a busy computer; runs go on, a loop on the host suffers",
        values,
    )  # fmt: skip


def _throughput(times: dict[int, list[float]], drive: Drive, port: Port) -> Finding:
    """Bytes a second that the link carries, compared with the need of samples at full rate."""
    batch = 10
    # the fastest echo of each size is the one that nothing else delayed
    cost = min(times[LONG]) - min(times[SHORT])
    encodings = [c.encoding for c in drive.channels[:2]]
    size = wire.wire_size(wire.body_size(encodings, batch))
    needed = size / (batch * drive.identity.Ts)
    values = {"needed_bytes_per_s": needed, "stated_baud": port.baud}
    # least difference of times from which a rate can be computed [s]
    if cost < 20e-6:
        detail = f"too fast to be measured; {needed:.0f} B/s are needed for counts and command"
        return Finding("throughput", "ok", detail, values=values)
    rate = 2 * (LONG - SHORT) / cost
    spare = 1.0 - needed / rate
    values |= {"bytes_per_s": rate, "spare": spare}
    detail = (
        f"{rate:.0f} B/s each way; counts and command each {drive.identity.Ts * 1e3:g} ms need "
        f"{needed:.0f}"
    )
    remedy = "raise the baud rate of both sides, or stream fewer channels"
    if spare < 0.0:
        return Finding("throughput", "fail", f"{detail}: too slow", remedy, values)
    detail += f": {100 * spare:.0f} % to spare"
    if spare < SPARE:
        return Finding(
            "throughput", "warn", f"{detail}, {100 * SPARE:.0f} % wanted", remedy, values
        )
    return Finding("throughput", "ok", detail, values=values)


def _loss(
    link: Connection, before: wire.Status, after: wire.Status, sent: int, echoes: int
) -> Finding:
    """Frames lost or damaged in either direction."""
    counters = link.receiver.counters
    to_device = max(0, sent - (after.received - before.received))
    damaged = after.refused - before.refused
    values = {
        "echoes": echoes, "lost_to_device": to_device, "damaged_to_device": damaged,
        "lost_to_host": counters["missing"], "damaged_to_host": counters["rejected"],
        "repeated_to_host": counters["repeated"], "late_to_host": counters["late"],
    }  # fmt: skip
    bad = to_device + counters["missing"]
    odd = damaged + counters["rejected"] + counters["repeated"] + counters["late"]
    detail = (
        f"{to_device} of {sent} frames lost on the way there ({damaged} seen damaged), "
        f"{counters['missing']} on the way back ({counters['rejected']} damaged), "
        f"of {echoes} echoes"
    )
    if not bad and not odd:
        return Finding("loss", "ok", f"none of {echoes} echoes", values=values)
    # share of lost frames above which loss is a failure rather than a warning
    verdict: Verdict = "fail" if bad > 0.01 * 2 * echoes else "warn"
    return Finding(
        "loss", verdict, detail,
        "shorten or shield the cable, connect the grounds, lower the baud rate, and make sure "
        "that no other program has the port open",
        values,
    )  # fmt: skip


def _clock(drive: Drive) -> Finding:
    drift_ppm = 500.0
    if drive.identity.on_credit:
        return Finding("clock", "ok", "advances only by what the host grants")
    bounds = drive.clock
    if bounds is None:
        return Finding("clock", "warn", "no answer, so that the clocks cannot be compared")
    if not bounds.consistent:
        return Finding(
            "clock", "fail", str(bounds), "the device's clock jumps; fix its timer in the firmware"
        )
    low, high = bounds.drift_ppm
    values = {
        "uncertainty_s": bounds.offset_s[1] - bounds.offset_s[0],
        "drift_ppm_least": low, "drift_ppm_most": high,
    }  # fmt: skip
    if low > drift_ppm or high < -drift_ppm:
        return Finding(
            "clock",
            "warn",
            str(bounds),
            "check the firmware's clock: a crystal is within 100 ppm",
            values,
        )
    return Finding("clock", "ok", str(bounds), values=values)


def _counters(after: wire.Status, before: wire.Status, drive: Drive) -> Finding:
    """The device's own counters since its boot."""
    values = {
        "received": after.received, "refused": after.refused, "dropped": after.dropped,
        "late_us": after.late_us, "foreign": after.foreign,
    }  # fmt: skip
    detail = (
        f"since boot: {after.received} frames received, {after.refused} refused, {after.dropped} "
        f"dropped; latest control period {after.late_us} us late"
    )
    remedies = []
    if after.dropped:
        remedies.append("frames were dropped: the link was too slow or the host did not read")
    if 2 * after.late_us >= drive.identity.period_us:
        remedies.append("control periods come late: shorten the firmware's other tasks")
    if after.foreign != before.foreign:
        remedies.append(
            "frames of another host arrived meanwhile: use the line from one program only"
        )
    verdict: Verdict = "warn" if remedies else "ok"
    return Finding("counters", verdict, detail, "; ".join(remedies), values)


def _time(seconds: float) -> str:
    return f"{seconds * 1e3:.3g} ms" if seconds >= 1e-3 else f"{seconds * 1e6:.0f} us"


# --- `examine` ------------------------------------------------------------------------------------


ECHOES = 200


def examine(url: str, *, baud: int = 115_200, echoes: int = ECHOES) -> Diagnosis:
    """Examine a port and the device behind it.

    The device is queried, never armed. Connecting opens a new session, which ends a run of another
    host.

    Parameters
    ----------
    url : str
        An address for `open_port`.
    baud : int
        Bits per second of a serial port.
    echoes : int
        Messages sent back and forth, 10 or more; a smaller loss than one in so many is not found.

    Raises
    ------
    SettingError
        For an invalid url, baud or count; a fault of port or device is a finding.
    """
    if isinstance(echoes, bool) or not isinstance(echoes, int) or echoes < 10:
        raise SettingError(
            name="echoes", expected="10 or more", received=repr(echoes),
            remedy=f"{ECHOES} suits most",
        )  # fmt: skip
    return Diagnosis(url, tuple(_findings(url, baud, echoes)))


def _findings(url: str, baud: int, echoes: int) -> Iterator[Finding]:
    """The findings, until one makes the next impossible."""
    try:
        port = Metered(open_port(url, baud))
    except LinkError as error:
        yield _unopened(url, error)
        return
    try:
        yield _opened(url, port)
        yield from _latency(url)
        try:
            yield from checkup(port, echoes)
        except LinkError as error:
            yield _failure("device", error)
    finally:
        port.close()


# --- the port -------------------------------------------------------------------------------------


def _failure(name: str, error: LinkError) -> Finding:
    found, _, _ = str(error).partition(f"; {error.remedy}")
    return Finding(name, "fail", found, error.remedy or "")


def _unopened(url: str, error: LinkError) -> Finding:
    """Why a port does not open: permission, or another program; and which other ports exist."""
    finding = _failure("port", error)
    if not _is_local(url):
        return finding
    if not os.path.exists(url):
        if "://" in finding.remedy:
            return finding  # an address, whatever ports there are
        others = ", ".join(p.path for p in list_ports()) or "none"
        return _with(finding, f"{finding.remedy}; ports there are: {others}", others=others)
    if os.name != "nt" and not (found := access(url)).allowed:
        vid, pid = _usb(url)
        remedy = permission_remedy(found, vid, pid)
        measured = f"{url} belongs to {found.owner} with mode {found.mode}; you may not open it"
        return Finding("port", "fail", measured, remedy, {"group": found.group})
    if error.expected == A_PORT:
        return finding  # not a port: every program holds /dev/null open
    if held := holders(url):
        return _with(finding, f"end {_named(held)}, which has it open", holders=held)
    return finding


def _with(finding: Finding, remedy: str, **values: Any) -> Finding:
    return Finding(finding.name, finding.verdict, finding.measured, remedy, values)


def _usb(url: str) -> tuple[int | None, int | None]:
    real = os.path.realpath(url)
    for port in list_ports():
        if os.path.realpath(port.path) == real:
            return port.vid, port.pid
    return None, None


def _named(held: list[tuple[int, str]]) -> str:
    return ", ".join(f"{name} (process {number})" for number, name in held)


def _opened(url: str, port: Port) -> Finding:
    if _is_local(url) and (held := holders(url)):
        return Finding(
            "port", "warn", f"opens, but {_named(held)} has it open too and receives some bytes",
            "end that program (a serial monitor, ModemManager)", {"holders": held},
        )  # fmt: skip
    return Finding("port", "ok", port.describe())


def _is_local(url: str) -> bool:
    """Whether it is a device of this computer, which other programs can hold open."""
    kind = transport_of(url)
    return kind is None or kind.is_local


def _latency(url: str) -> Iterator[Finding]:
    """The latency timer of adapters with one; call it after opening, which tries to shorten it."""
    if not _is_local(url) or (found := latency_timer(url)) is None:
        return
    milliseconds, file = found
    values = {"latency_timer_ms": milliseconds}
    if milliseconds <= 2:
        yield Finding("latency timer", "ok", f"{milliseconds} ms", values=values)
        return
    yield Finding(
        "latency timer", "warn", f"{milliseconds} ms: the adapter holds bytes back for that long",
        f"echo 1 | sudo tee {file}, or setserial {url} low_latency; permanently by a udev rule: "
        'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"',
        values,
    )  # fmt: skip


# --- The port as the operating system sees it: permissions, open handles, latency timer -----------


SYS = Path("/sys/class/tty")
PROC = Path("/proc")


@dataclass(frozen=True)
class Access:
    """Who may open a port. `allowed` is whether this user may read and write it, `group` the group
    that may open it, where the port's mode grants that, and `mode` is in the notation of ``ls``.
    `member` is whether this process is in the group; a user who has just joined must log in again.
    """

    allowed: bool
    group: str | None
    owner: str
    mode: str
    member: bool


def access(path: str, user: int | None = None, groups: frozenset[int] | None = None) -> Access:
    """Who may open the port at `path`. `user` and `groups` are ids to check, by default those of
    this process. Raises `OSError` if there is no such port.
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
    """Number and name of other processes that hold a port, as far as /proc shows them."""
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
    """Milliseconds for which an FTDI adapter holds bytes, and the file to change them in."""
    file = root / Path(os.path.realpath(path)).name / "device" / "latency_timer"
    try:
        return int(file.read_text()), file
    except (OSError, ValueError):
        return None
