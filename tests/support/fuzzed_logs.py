"""Damaged logs of every format, by the thousand: each is read or refused, in time and in memory.

    python tests/support/fuzzed_logs.py --count 100000 --only mf4 tdms

A library reads in a process of its own, which takes a second to start. Here that process is forked
from one that has the library loaded already; what it then does is the product's own code.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from sewfast.errors import DataError
from sewfast.readers import Table, logs, read_table

sys.path.append(str(Path(__file__).parents[1] / "readers"))
from test_logs import KINDS, blackbox, saleae

PATIENCE = 2.0
"""For a reader that need not load its library first [s]."""
MAKE = {n: kind[0] for n, kind in KINDS.items()} | {"run.bbl": blackbox, "run.bin": saleae}


class Forked:
    """`subprocess.run` of a reader, as a fork of this process.

    Attributes
    ----------
    largest : int
        Memory that a reader took, at the most [kB].
    """

    def __init__(self, folder: Path) -> None:
        self.largest = 0
        self._streams = folder / "out", folder / "err"

    def run(self, args: Sequence[str], timeout: float, **_: Any) -> Any:
        name = str(args[2]).partition("send('")[2].partition("'")[0]
        child = os.fork()
        if child == 0:
            self._read(name, str(args[3]))
        until = time.monotonic() + timeout
        while True:
            pid, status, usage = os.wait4(child, os.WNOHANG)
            if pid:
                break
            if time.monotonic() > until:
                os.kill(child, signal.SIGKILL)
                os.wait4(child, 0)
                raise subprocess.TimeoutExpired(args, timeout)
            time.sleep(0.0005)
        self.largest = max(self.largest, usage.ru_maxrss)
        out, err = (stream.read_bytes() for stream in self._streams)
        return SimpleNamespace(returncode=os.waitstatus_to_exitcode(status), stdout=out, stderr=err)

    def _read(self, name: str, path: str) -> None:
        """In the child; it does not return."""
        status = 1
        try:
            for number, stream in zip((1, 2), self._streams, strict=True):
                os.dup2(os.open(stream, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
            sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
            sys.argv = ["-c", path]
            out = sys.stdout
            logs.send(name)
            out.flush()
            status = 0
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
        finally:
            os._exit(status)


def damaged(raw: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes are others, and half of the files are cut off."""
    content = bytearray(raw)
    for at in rng.integers(8, len(raw), rng.integers(1, 30)):
        content[at] = rng.integers(0, 256)
    if rng.random() < 0.5:
        del content[int(rng.integers(8, len(raw))) :]
    return bytes(content)


def fuzz(name: str, count: int, seed: int, folder: Path, seconds: float) -> bool:
    """Whether every damaged file of this kind was read or refused, as far as time allows."""
    try:
        whole = MAKE[name](folder / name)
    except BaseException as error:  # pytest's own, where a library is missing
        print(f"{name}: no file to damage, {error}")
        return False
    raw = whole.read_bytes()
    kind = logs._KINDS.get(logs._kind_of(raw) or "")
    if kind is not None and kind.module is not None:
        importlib.import_module(kind.module)
    read_table(whole)  # loads what is loaded when first used
    logs.PATIENCE = PATIENCE
    forked = Forked(folder)
    logs.subprocess = SimpleNamespace(run=forked.run, TimeoutExpired=subprocess.TimeoutExpired)
    gc.freeze()
    outcomes: Counter[str] = Counter()
    slowest, began, tried = 0.0, time.monotonic(), 0
    place = folder / f"damaged-{name}"
    for k in range(count):
        if time.monotonic() - began > seconds:
            break
        rng = np.random.default_rng([seed, k])
        place.write_bytes(damaged(raw, rng))
        start = time.monotonic()
        try:
            outcomes[type(read_table(place)).__name__] += 1
        except DataError as refused:
            text = str(refused)
            crashed, late = "crashed on it" in text, "found no end" in text
            outcomes["crash contained" if crashed else "too slow" if late else "refused"] += 1
            if str(place) not in text:
                outcomes["refused without its name"] += 1
        except Exception:
            outcomes["WRONG"] += 1
            print(f"{name}: damaged file {k} of seed {seed}")
            traceback.print_exc()
        slowest = max(slowest, time.monotonic() - start)
        tried += 1
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        f"{name}: {tried} damaged files, {dict(outcomes)}, slowest {slowest:.2f} s, largest "
        f"{max(own, forked.largest) / 1e3:.0f} MB, {time.monotonic() - began:.0f} s",
        flush=True,
    )
    return set(outcomes) <= {Table.__name__, "refused", "crash contained", "too slow"}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="for each format")
    parser.add_argument("--only", nargs="*", default=[], metavar="WORD")
    args = parser.parse_args()
    chosen = [n for n in MAKE if not args.only or any(word in n for word in args.only)]
    with tempfile.TemporaryDirectory() as place:
        # a process for each kind: what one library leaves behind is not the next one's
        found = [_apart(name, args, Path(place)) for name in chosen]
    return 0 if all(found) else 1


def _apart(name: str, args: argparse.Namespace, folder: Path) -> bool:
    child = os.fork()
    if child == 0:
        status = 1
        try:
            status = 0 if fuzz(name, args.count, args.seed, folder, args.seconds) else 1
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


if __name__ == "__main__":
    sys.exit(main())
