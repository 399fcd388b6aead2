"""Frequency responses of machines whose truth is known: figures of `sewfast.bode` and `fit_shaft`.

    python benches/bode.py                  40 virtual machines with a shaft, 20 without
    python benches/bode.py --held           drives of drives.py, which no rule was made on
    python benches/bode.py --count 10

The truth is the exact small-signal behaviour at the working speed, sampled: what a shaken machine
shows besides, by friction and dead time, counts as an error.
"""

from __future__ import annotations

import argparse
import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sewfast
from sewfast import VirtualMachine, bode, fit_shaft

SPEED = 1500.0


def virtual(machine: VirtualMachine, speed: float) -> tuple[NDArray[np.float64], float]:
    """Small signals of a virtual machine: `matrix` of its parameters, and the command's share."""
    p = machine.parameters
    w = speed * math.pi / 30.0
    square = p["stribeck_speed"] ** 2
    excess = p["stribeck_torque"] * square
    friction = p["coulomb_torque"] + excess / (square + w * w) + p["viscous_friction"] * w
    current = friction / p["motor_constant"]
    viscous = p["viscous_friction"] - 2.0 * excess * w / (square + w * w) ** 2
    ripple = p["ripple_current"] ** 2
    dead = p["dead_time"] * p["pwm_frequency"] * p["bus_voltage"]
    resistance = p["resistance"] + dead * ripple / (ripple + current * current) ** 1.5
    far = p["load_inertia"]
    c, d = (p["shaft_stiffness"], p["shaft_damping"]) if far > 0.0 else (0.0, 0.0)
    A = matrix(
        resistance, p["inductance"], p["motor_constant"], p["inertia"], far, c, d, viscous, 0.0
    )
    return A, p["amplifier_gain"] / p["inductance"]


def matrix(
    R: float,
    L: float,
    K: float,
    J: float,
    far: float,
    c: float,
    d: float,
    near_b: float,
    far_b: float,
) -> NDArray[np.float64]:
    """Of current, motor's speed and angle, load's speed, twist."""
    load = [0.0, d / far, 0.0, -(d + far_b) / far, c / far] if far > 0.0 else [0.0] * 5
    return np.array([
        [-R / L, -K / L, 0.0, 0.0, 0.0],
        [K / J, -(near_b + d) / J, 0.0, d / J, -c / J],
        [0.0, 1.0, 0.0, 0.0, 0.0],
        load,
        [0.0, 1.0, 0.0, -1.0, 0.0],
    ])  # fmt: skip


def small_signals(machine: VirtualMachine, hertz: Any, speed: float) -> NDArray[np.complex128]:
    """Command to mean speed over the sample before [RPM/V], linearised and sampled exactly."""
    A, drive = virtual(machine, speed)
    Ts = machine.Ts
    held = np.zeros((6, 6))
    held[:5, :5], held[0, 5] = A * Ts, drive * Ts
    power = exponential(held)
    z = np.exp(2j * np.pi * np.asarray(hertz) * Ts)
    angle = [np.linalg.solve(x * np.eye(5) - power[:5, :5], power[:5, 5])[2] for x in z]
    return np.array(angle) * (1.0 - 1.0 / z) / Ts * 30.0 / math.pi


def modes(A: NDArray[np.float64], near: float) -> dict[str, float]:
    """Resonance and antiresonance: the swing of the whole near `near` Hz, and of the load alone.

    The motor's back-EMF damps the first as well.
    """
    poles = np.linalg.eigvals(A)
    pole = min(poles[poles.imag > 0.0], key=lambda p: abs(abs(p) / (2.0 * math.pi) - near))
    a1, a0 = -A[3, 3], A[3, 4]
    return {
        "resonance_hertz": float(abs(pole)) / (2.0 * math.pi),
        "resonance_damping": float(-pole.real / abs(pole)),
        "antiresonance_hertz": math.sqrt(a0) / (2.0 * math.pi),
        "antiresonance_damping": a1 / (2.0 * math.sqrt(a0)),
    }


def exponential(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """By scaling and squaring of the series."""
    small, found = matrix / 2.0**12, np.eye(len(matrix))
    term = np.eye(len(matrix))
    for k in range(1, 12):
        term = term @ small / k
        found = found + term
    for _ in range(12):
        found = found @ found
    return found


def drawn(seed: int, *, shaft: bool) -> tuple[VirtualMachine, dict[str, float]]:
    """A machine, and what its shaft is: 20 to 400 Hz, damping .01 to .05."""
    rng = np.random.default_rng([seed, 77])
    hertz = math.exp(rng.uniform(math.log(20.0), math.log(400.0)))
    share, damping, inertia = rng.uniform(0.2, 0.7), rng.uniform(0.01, 0.05), 3e-3
    if not shaft:
        return VirtualMachine(seed), {}
    motor, load = inertia * (1.0 - share), inertia * share
    reduced, omega = motor * load / inertia, 2.0 * math.pi * hertz
    machine = VirtualMachine(
        seed, load_inertia=load, stiffness=reduced * omega**2,
        damping=2.0 * damping * omega * reduced, parameters={"inertia": motor},
    )  # fmt: skip
    return machine, modes(virtual(machine, SPEED)[0], hertz)


def held(count: int) -> list[tuple[Any, dict[str, float]]]:
    """Drives of drives.py, with shafts that are not its own, and its rigid ones."""
    import drives

    found: list[tuple[Any, dict[str, float]]] = []
    for seed in range(count):
        rng = np.random.default_rng([seed, 78])
        hertz = math.exp(rng.uniform(math.log(20.0), math.log(400.0)))
        share, damping = rng.uniform(0.2, 0.7), rng.uniform(0.01, 0.05)
        rigid = drives.replace(drives.drawn(seed), current=20.0)
        found.append((drives.bench_of(drives.Simulator(rigid)), {}))
        drive = drives.replace(rigid, share=share, shaft=hertz, damping=damping)
        _, R, L, K, _, J, far, c, d, *_ = drive.vector()
        truth = modes(matrix(R, L, K, J, far, c, d, 0.0, drive.viscous), hertz)
        found.append((drives.bench_of(drives.Simulator(drive)), truth))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--held", action="store_true")
    parser.add_argument("--count", type=int, default=40)
    args = parser.parse_args()
    if args.held:
        cases = held(args.count)
    else:
        cases = [drawn(s, shaft=True) for s in range(args.count)]
        cases += [drawn(s, shaft=False) for s in range(args.count // 2)]
    errors: dict[str, list[float]] = {}
    shafts = found = false = second = inside = lines = 0
    took = []
    for machine, truth in cases:
        began = time.perf_counter()
        try:
            response = bode(machine, speed=SPEED)
            fit = fit_shaft(response)
        except sewfast.SewfastError as refused:
            print(f"refused: {refused}", flush=True)
            continue
        took.append(time.perf_counter() - began)
        second += fit.resonances > 1
        row = [f"{k} {v:.4g}" for k, v in truth.items()]
        if isinstance(machine, VirtualMachine):
            exact = small_signals(machine, response.hertz, SPEED)
            good = response.coherence > 0.95
            ratio = response.value[good] / exact[good]
            errors.setdefault("dB", []).extend(np.abs(20.0 * np.log10(np.abs(ratio))))
            errors.setdefault("deg", []).extend(np.abs(np.rad2deg(np.angle(ratio))))
            inside += int((np.abs(response.value - exact) < response.radius()).sum())
            lines += len(exact)
        if not truth:
            false += fit.has_resonance
        else:
            shafts += 1
            found += fit.has_resonance
            for name, value in truth.items() if fit.has_resonance else ():
                off = fit.parameters[name].value / value - 1.0
                errors.setdefault(name, []).append(abs(100.0 * off))
                row.append(f"{100.0 * off:+.1f} %")
        print("; ".join([*row, "found" if fit.has_resonance else "rigid"]), flush=True)
    rigid = len(took) - shafts
    print(f"shafts found {found} of {shafts}; rigid machines with a shaft {false} of {rigid}")
    print(f"machines with a second shaft, which none has, {second} of {len(took)}")
    for name, values in errors.items():
        a, b, c = np.percentile(values, [50, 90, 100])
        print(f"{name:<22} median {a:.3g}, 90 % {b:.3g}, worst {c:.3g}")
    if lines:
        print(f"95 % bands hold the small-signal response at {100 * inside / lines:.1f} % of lines")
    print(f"seconds of each {np.median(took):.2f}")


if __name__ == "__main__":
    main()
