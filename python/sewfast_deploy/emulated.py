"""An emulated Cortex-M4 or M7 that runs the example firmware: QEMU as a drive behind a port."""

from __future__ import annotations

import math
import mmap
import os
import secrets
import shutil
import socket
import struct
import subprocess
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sewfast.errors import LinkError, SettingError
from sewfast.storage import file_bytes

BOARDS = {"mps2-an386": 0x21000000, "mps2-an500": 0x60000000}
"""QEMU's boards, a Cortex-M4 and a Cortex-M7, with the address of the memory shared with us."""
EMULATOR = "qemu-system-arm"
PACKAGES = "gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm rustc-web rust-web-src"
"""Debian's packages for building and running the firmware."""

# as in examples/firmware/mps2/board.c and board.ld
_SHARED = struct.Struct("<6I3QI")
_FAULT = struct.Struct("<I")
_WRONG = struct.Struct("<2I8f")
_FASTEST = struct.Struct("<f")
_STACK_TOP = 1 << 20
_STACK = 64 << 10
_PAINT = b"\xa5"

_SHIFT = 5
"""An instruction takes 2**5 ns of the board's time; a tick of its timer is 40 ns."""

_START = 20.0
"""Time for the emulator to open its port [s]."""


@dataclass(frozen=True)
class BoardFigures:
    """Figures of the processor since its boot.

    Attributes
    ----------
    steps : int
        Control periods: a measurement handed to the device, an output taken from it.
    instructions : tuple of (float, float, float) or None
        Least, mean and most instructions of a period, within 2; None in real time, where they are
        not counted.
    stack : int
        Deepest use of the stack [bytes].
    code : int
        Code and constants [bytes].
    memory : int
        Static memory without the stack [bytes].
    """

    steps: int
    instructions: tuple[float, float, float] | None
    stack: int
    code: int
    memory: int

    def __str__(self) -> str:
        counted = "not counted in real time"
        if self.instructions is not None:
            least, mean, most = self.instructions
            counted = f"{least:.0f} to {most:.0f}, mean {mean:.0f}"
        return (
            f"control periods          {self.steps:,}\n"
            f"instructions a period    {counted}\n"
            f"stack                    {self.stack:,} bytes\n"
            f"code and constants       {self.code:,} bytes\n"
            f"static memory            {self.memory:,} bytes"
        )


def build_firmware(source: str | os.PathLike[str] = ".", *, board: str = "mps2-an386") -> Path:
    """Compile the example firmware for the emulated boards.

    Parameters
    ----------
    source : path
        A source checkout of sewfast, or a folder in it.
    board : {"mps2-an386", "mps2-an500"}
        The board whose firmware to return: a Cortex-M4, or a Cortex-M7.

    Returns
    -------
    Path
        The firmware, an ELF file.

    Raises
    ------
    SettingError
        For another board, without a source checkout or a compiler, and if it does not compile.
    """
    if board not in BOARDS:
        raise SettingError(name="board", expected=" or ".join(BOARDS), received=repr(board))
    start = Path(source).resolve()
    places = (start, *start.parents)
    root = next((p for p in places if (p / "examples/firmware/mps2/board.c").is_file()), None)
    if root is None:
        raise SettingError(
            name="firmware", expected="a source checkout of sewfast", received=str(start),
            remedy="name one by --source, or a firmware that is built already by --firmware "
            "FILE.elf",
        )  # fmt: skip
    missing = [t for t in ("make", "cargo", "arm-none-eabi-gcc") if shutil.which(t) is None]
    if not Path("/usr/bin/rustc").exists():
        missing.append("/usr/bin/rustc")
    if missing:
        raise SettingError(
            name="firmware", expected=" and ".join(missing), received="none",
            remedy=f"on Debian: apt-get install make cargo-web {PACKAGES}",
        )  # fmt: skip
    made = subprocess.run(
        ["make", "--no-print-directory", "-C", str(root), "firmware"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if made.returncode != 0:
        last = (made.stderr or made.stdout).strip().splitlines()[-8:]
        raise SettingError(
            name="firmware", expected="sources that compile",
            received="what make says:\n  " + "\n  ".join(last),
        )  # fmt: skip
    return root / "target" / "bare" / f"{board}.elf"


class EmulatedBoard:
    """A Cortex-M4 or M7 with floating-point unit in QEMU, its UART a TCP port.

    Parameters
    ----------
    firmware : path
        ELF file, as from `build_firmware`; its addresses show for which board it was linked.
    clock : {"credit", "real"}
        On credit the board's time advances only by what the host grants: a busy computer
        changes no recording, and instructions are counted. In real time its clock is the
        computer's.
    boot_id : int or None
        Number of this boot, which also seeds its random bits; None draws it.

    Raises
    ------
    SettingError
        Without an emulator, and for a file that is not firmware for one of the boards.
    LinkError
        If the emulator ends, or opens no port.

    Examples
    --------
    >>> with EmulatedBoard(build_firmware()) as board:  # doctest: +SKIP
    ...     print(examine(board.port))
    """

    def __init__(
        self,
        firmware: str | os.PathLike[str],
        *,
        clock: Literal["credit", "real"] = "credit",
        boot_id: int | None = None,
    ) -> None:
        if clock not in ("credit", "real"):
            raise SettingError(name="clock", expected="'credit' or 'real'", received=repr(clock))
        #: QEMU's name of the board.
        self.board, self._code, self._static = _examined(Path(firmware))
        if shutil.which(EMULATOR) is None:
            raise SettingError(
                name="board", expected=f"the emulator {EMULATOR}", received="none",
                remedy=f"on Debian: apt-get install {EMULATOR}",
            )  # fmt: skip
        self._counts = clock == "credit"
        self._faults = 0
        drawn = secrets.randbits(32) if boot_id is None else boot_id & 0xFFFFFFFF
        with ExitStack() as opened:
            folder = opened.enter_context(tempfile.TemporaryDirectory(prefix="sewfast-"))
            self._memory = opened.enter_context(_memory(Path(folder) / "memory"))
            _SHARED.pack_into(
                self._memory, 0, drawn, drawn ^ 0x9E3779B9, not self._counts, *[0] * 7
            )
            self._log = opened.enter_context((Path(folder) / "log").open("w+b"))
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                number = free.getsockname()[1]
            self.process = opened.enter_context(
                subprocess.Popen(
                    self._command(Path(firmware), Path(folder) / "memory", number),
                    stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log,
                    start_new_session=True,  # keep Ctrl-C for the host, which stops the motor first
                )
            )  # fmt: skip
            opened.callback(self.process.kill)
            self.port = f"socket://127.0.0.1:{number}"
            self._wait_for(number)
            self._opened = opened.pop_all()

    def _command(self, firmware: Path, memory: Path, number: int) -> list[str]:
        # QEMU wants a comma in a value doubled
        place = str(memory).replace(",", ",,")
        command = [EMULATOR, "-M", f"{self.board},memory-backend=shared", "-display", "none"]
        command += ["-monitor", "none", "-kernel", str(firmware)]
        command += ["-object", f"memory-backend-file,id=shared,mem-path={place},size=16M,share=on"]
        command += ["-serial", f"tcp:127.0.0.1:{number},server=on,wait=off,nodelay=on"]
        return [*command, "-icount", f"shift={_SHIFT}"] if self._counts else command

    def _wait_for(self, number: int) -> None:
        """Wait until the port listens; the board would take a trial connection for its host."""
        until = time.monotonic() + _START
        tables = [p for p in (Path("/proc/net/tcp"),) if p.exists()]
        while self.process.poll() is None and time.monotonic() < until:
            if not tables:
                time.sleep(1.0)
                return
            if f"0100007F:{number:04X} 00000000:0000 0A" in tables[0].read_text():
                return
            time.sleep(0.02)
        self._log.seek(0)
        said = self._log.read().decode(errors="replace").strip().splitlines()[-3:]
        raise LinkError(
            name="firmware", expected=f"the emulated board to open its port within {_START:g} s",
            received="none", remedy=f"{EMULATOR} says: {' '.join(said) or 'nothing'}",
        )  # fmt: skip

    def figures(self) -> BoardFigures:
        """Instructions, stack and size so far."""
        *_, steps, least, most, total, _, _, _ = _SHARED.unpack_from(self._memory)
        counted = None
        if self._counts and steps:
            counted = tuple(t * 40.0 / 2**_SHIFT for t in (least, total / steps, most))
        stack = self._memory[_STACK_TOP - _STACK : _STACK_TOP]
        return BoardFigures(
            steps=steps,
            instructions=counted,
            stack=len(stack.lstrip(_PAINT)),
            code=self._code,
            memory=self._static,
        )

    def safe_after(self) -> float | None:
        """Time from the last bytes that the board received until its output was off [s].

        None while the output is on.
        """
        *_, heard, safe, enabled = _SHARED.unpack_from(self._memory)
        return None if enabled else (safe - heard) * 1e-6

    def break_motor(
        self, after: float = 0.0, *, command: float = 1.0, encoder: float = 1.0, lag: float = 1.0,
        load: float = 0.0, stuck: float = math.nan, dead: float = 0.0, brake: float = 0.0,
        jump: float = 0.0,
    ) -> None:  # fmt: skip
        """Put a fault into the emulated motor, to see what its host does.

        Parameters
        ----------
        after : float
            Time from when the output is next switched on until the fault begins [s]; 0 is at once.
        command, encoder, lag : float
            Factors on the command, on the counted motion and on the motor's time constant.
        load, dead, brake : float
            Added command, dead band and added friction [V].
        stuck : float
            Command at which the output stage is stuck [V]; inf is the one it has then.
        jump : float
            Added to the counter once.

        Raises
        ------
        SettingError
            For a number that is out of its range.
        """
        numbers = {
            "command": command, "encoder": encoder, "lag": lag, "load": load, "stuck": stuck,
            "dead": dead, "brake": brake, "jump": jump,
        }  # fmt: skip
        for name, value in numbers.items():
            least = {"lag": 1e-3, "dead": 0.0, "brake": 0.0}.get(name, -1e6)
            if not (least <= value <= 1e6 or name == "stuck"):
                raise SettingError(
                    name=name, expected=f"a number from {least:g} to 1e6", received=f"{value:g}"
                )
        if not 0.0 <= after <= 4000.0:
            raise SettingError(name="after", expected="0 to 4000 s", received=f"{after:g}")
        self.mend_motor()
        self._faults += 1
        place = self._memory, _SHARED.size
        _WRONG.pack_into(*place, 0, round(1e6 * after), *numbers.values())
        _FAULT.pack_into(*place, self._faults)  # last: it begins with this

    def mend_motor(self) -> None:
        """Take the fault out of the emulated motor, and forget its fastest speed."""
        _WRONG.pack_into(self._memory, _SHARED.size, *[0] * 10)
        _FASTEST.pack_into(self._memory, _SHARED.size + _WRONG.size, 0.0)

    @property
    def fastest(self) -> float:
        """Fastest speed of the emulated motor since its boot, or since a change of it [RPM]."""
        found: float = _FASTEST.unpack_from(self._memory, _SHARED.size + _WRONG.size)[0]
        return found

    def close(self) -> None:
        """End the emulator."""
        self._opened.close()

    def __enter__(self) -> EmulatedBoard:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _memory(path: Path) -> mmap.mmap:
    """The board's memory as a file, its stack painted to show how deep it was used."""
    with path.open("w+b") as file:
        file.truncate(16 << 20)
        file.seek(_STACK_TOP - _STACK)
        file.write(_PAINT * _STACK)
        file.flush()
        return mmap.mmap(file.fileno(), _STACK_TOP)


def _examined(firmware: Path) -> tuple[str, int, int]:
    """The board, and bytes of code with constants and of static memory, of an ELF file."""
    remedy = "build one by `make firmware` in a source checkout"
    raw = file_bytes(firmware, SettingError)
    if len(raw) < 52 or raw[:6] != b"\x7fELF\x01\x01" or raw[18:20] != b"\x28\x00":
        raise SettingError(
            name=str(firmware), expected="a firmware for ARM (ELF)", received="another file",
            remedy=remedy,
        )  # fmt: skip
    start, size, count = struct.unpack_from("<I10xHH", raw, 28)
    code = static = 0
    board = None
    for k in range(count):
        header = raw[start + k * size : start + k * size + 32]
        if len(header) < 32:
            break
        kind, _, address, _, in_file, in_memory, _, _ = struct.unpack("<8I", header)
        if kind != 1:
            continue
        code += in_file
        if 0x20000000 <= address < 0x21000000:
            static += in_memory
        board = next((name for name, place in BOARDS.items() if place == address), board)
    if board is None:
        raise SettingError(
            name=str(firmware), expected=f"a firmware for {' or '.join(BOARDS)}",
            received="one for another board", remedy=remedy,
        )  # fmt: skip
    return board, code, static
