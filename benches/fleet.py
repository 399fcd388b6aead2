"""Recordings a second of `fleet` on one worker and on two, and what a worker's death costs.

python benches/fleet.py                       2,000 recordings of 5,000 samples
python benches/fleet.py --recordings 200 --killed    the last part alone, compared with this process
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from sewfast import fleet


def made(folder: Path, count: int, samples: int) -> None:
    """First-order machines with noise, each with a gain and time constant of its own."""
    for i in range(count):
        rng = np.random.default_rng(i)
        gain, pole = rng.uniform(50.0, 150.0), np.exp(-1e-3 / rng.uniform(0.02, 0.2))
        u = np.repeat(rng.uniform(-5.0, 5.0, samples // 50), 50)
        y = np.zeros(samples)
        for k in range(1, samples):
            y[k] = pole * y[k - 1] + (1.0 - pole) * gain * u[k - 1]
        y += 2.0 * rng.normal(size=samples)
        np.savez(folder / f"machine-{i:05d}.npz", t=np.arange(samples) * 1e-3, u=u, y=y)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=int, default=2000)
    parser.add_argument("--samples", type=int, default=5000)
    parser.add_argument("--killed", action="store_true", help="only with workers being killed")
    parser.add_argument("--every", type=float, default=10.0, help="seconds between two kills")
    args = parser.parse_args()
    import dask
    import distributed

    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        made(folder, args.recordings, args.samples)
        rows, seconds = {}, {}
        options: dict[str, Any] = {
            "threads_per_worker": 1, "dashboard_address": None, "memory_limit": "500MB",
        }  # fmt: skip
        if args.killed:
            rows[1] = [repr(row) for row in fleet(folder, workers=0).rows]
        for workers in () if args.killed else (1, 2):
            with (
                distributed.LocalCluster(n_workers=workers, **options) as cluster,
                distributed.Client(cluster) as client,
            ):
                began = time.perf_counter()
                rows[workers] = [repr(row) for row in fleet(folder, client=client).rows]
                seconds[workers] = time.perf_counter() - began
                memory = max(
                    w["metrics"]["memory"]
                    for w in client.scheduler_info(n_workers=-1)["workers"].values()
                )
            rate = args.recordings / seconds[workers]
            print(
                f"{workers} worker(s): {seconds[workers]:.1f} s, {rate:.1f} recordings/s, "
                f"{memory / 1e6:.0f} MB a worker",
                flush=True,
            )
        if not args.killed:
            print(f"two over one: {seconds[1] / seconds[2]:.2f} x (must 1.8)")
            print(f"same bits: {rows[1] == rows[2]}")
        with (
            dask.config.set({"distributed.scheduler.allowed-failures": 50}),
            distributed.LocalCluster(n_workers=2, **options) as cluster,
            distributed.Client(cluster) as client,
        ):
            ended, killed = threading.Event(), [0]

            def kill() -> None:
                while not ended.wait(args.every):
                    # one that goes while it is asked is killed the next time
                    alive = client.run(os.getpid, on_error="ignore")
                    for pid in list(alive.values())[:1]:
                        os.kill(pid, signal.SIGKILL)
                        killed[0] += 1

            killer = threading.Thread(target=kill, daemon=True)
            killer.start()
            began = time.perf_counter()
            found = [repr(row) for row in fleet(folder, client=client).rows]
            ended.set()
            taken = time.perf_counter() - began
            print(
                f"{killed[0]} killed in {taken:.0f} s: {len(found)} rows of {len(rows[1])}, "
                f"the same bits: {found == rows[1]}"
            )


if __name__ == "__main__":
    main()
