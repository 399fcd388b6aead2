"""What notches bring: bandwidth of a speed loop with them over that without, at equal Ms.

    python benches/notches.py                40 virtual machines with a shaft of 20 to 400 Hz
    python benches/notches.py --held         drives of drives.py, which no rule was made on
    python benches/notches.py --again        margins measured on the machine beside the predicted

Each machine is shaken once, two masses and a shaft are fitted, and `sewfast.frequency.propose`
makes two controllers for one Ms, with a notch and without. What they do is judged on the exact
small-signal behaviour of the machine, which neither has seen: bandwidth is where |S| comes to
1/sqrt(2). Where no shaft is found there is one controller, and the ratio is 1.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sewfast
from bode import SPEED, drawn, exponential, held, matrix, small_signals, virtual
from sewfast import Controller, bode, fit_shaft
from sewfast.control.systems import LinearLoop
from sewfast.frequency import FrequencyResponse, propose
from sewfast.models.conversion import StateSpace

HALF = 0.5**0.5


def plant_of(A: NDArray[np.float64], drive: float, Ts: float) -> StateSpace:
    """Command to the motor's speed at the samples [RPM/V]; the angle has no part in it."""
    keep = [0, 1, 3, 4]
    held = np.zeros((5, 5))
    held[:4, :4], held[0, 4] = A[np.ix_(keep, keep)] * Ts, drive * Ts
    power = exponential(held)
    C = np.array([[0.0, 30.0 / np.pi, 0.0, 0.0]])
    return StateSpace(power[:4, :4], power[:4, 4:], C, np.zeros((1, 1)))


def truth(
    response: FrequencyResponse, exact: Any, plant: StateSpace, controller: Controller
) -> tuple[float, float, bool]:
    """Bandwidth [Hz], Ms and whether the loop is stable, on the machine itself."""
    hertz = np.geomspace(0.1, 0.49 / response.Ts, 3000)
    n = len(hertz)
    of = FrequencyResponse(
        hertz, exact(hertz), np.zeros(n), np.ones(n), 16.0, response.Ts, u_unit="V", y_unit="RPM",
        from_counts=True,
    )  # fmt: skip
    S = 1.0 / np.abs(1.0 + of.loop(controller))
    above = np.flatnonzero(S >= HALF)
    poles = LinearLoop.of(controller, plant).poles()
    return float(hertz[above[0]]), float(S.max()), bool(np.abs(poles[0]) < 1.0)


def cases(count: int, *, is_held: bool) -> list[tuple[Any, Any, StateSpace, str]]:
    """Machine, its exact response, its plant, its name."""
    found: list[tuple[Any, Any, StateSpace, str]] = []
    if not is_held:
        for seed in range(count):
            machine, modes = drawn(seed, shaft=True)
            A, drive = virtual(machine, SPEED)
            found.append((
                machine, lambda f, m=machine: small_signals(m, f, SPEED),
                plant_of(A, drive, machine.Ts), f"{modes['resonance_hertz']:.0f} Hz",
            ))  # fmt: skip
        return found
    for bench, modes in held(count):
        if not modes:
            continue
        d = bench.machine.drive
        gain, R, L, K, _, J, far, c, damping, *_ = d.vector()
        A = matrix(R, L, K, J, far, c, damping, 0.0, d.viscous)
        drive = gain / L

        def exact(f: Any, A: Any = A, drive: float = drive, d: Any = d) -> Any:
            held = np.zeros((6, 6))
            held[:5, :5], held[0, 5] = A * d.Ts, drive * d.Ts
            power = exponential(held)
            z = np.exp(2j * np.pi * np.asarray(f) * d.Ts)
            angle = [np.linalg.solve(x * np.eye(5) - power[:5, :5], power[:5, 5])[2] for x in z]
            late = z ** -float(d.late + d.old)
            return np.array(angle) * (1.0 - 1.0 / z) / d.Ts * 30.0 / np.pi * late

        found.append((bench, exact, plant_of(A, drive, d.Ts), f"{modes['resonance_hertz']:.0f} Hz"))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--held", action="store_true")
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--Ms", type=float, default=1.7)
    parser.add_argument(
        "--u-max", type=float, default=float("inf"), help="a limit: the encoder may move 5 %% of it"
    )
    args = parser.parse_args()
    ratios, peaks, found, off = [], [], 0, []
    for machine, exact, plant, name in cases(args.count, is_held=args.held):
        try:
            response = bode(machine, speed=SPEED)
            proposed = propose(fit_shaft(response), Ms=args.Ms, u_max=args.u_max)
        except sewfast.SewfastError as refused:
            print(f"{name}: refused: {refused}", flush=True)
            continue
        best = truth(response, exact, plant, proposed.controller)
        plain = proposed.without
        other = best if plain is None else truth(response, exact, plant, plain.controller)
        found += plain is not None
        ratios.append(best[0] / other[0])
        peaks += [best[1], other[1]]
        text = (
            f"{name}: bandwidth {best[0]:.2f} Hz, without {other[0]:.2f}, ratio {ratios[-1]:.2f}; "
            f"Ms {best[1]:.3f}, {other[1]:.3f}; stable {best[2]}, {other[2]}"
        )
        if args.again:
            at_work = again(machine, proposed.controller, fit_shaft(response).to_model())
            text += "; margins not measured" if at_work is None else f"; off by {at_work}"
            off += [] if at_work is None else [at_work]
        print(text, flush=True)
    print(f"a notch on {found} of {len(ratios)} machines")
    all_of = np.percentile(ratios, [0, 25, 50, 75, 100])
    print(f"bandwidth over that without, least to largest by quarters {np.round(all_of, 2)}")
    print(f"Ms on the machines at most {max(peaks):.3f}, asked for {args.Ms:g}")
    if off:
        worst = np.max(np.abs(off), axis=0)
        print(
            f"re-measured at worst: phase {worst[0]:.2f} deg, gain {worst[1]:.2f} dB, "
            f"Ms {worst[2]:.1f} %"
        )


def again(machine: Any, controller: Controller, model: Any) -> tuple[float, float, float] | None:
    """Measured less predicted phase margin [deg], gain margin [dB], Ms [%]."""
    from sewfast.commissioning.bench import bench_of
    from sewfast.commissioning.shaking import margins_at_work

    with bench_of(machine, None) as bench:
        found = margins_at_work(bench, controller, model, SPEED, 0)
    if found is None:
        return None
    one, other = found[0]["predicted"], found[0]["measured"]
    return (
        other["phase_margin_deg"] - one["phase_margin_deg"],
        20.0 * float(np.log10(other["gain_margin"] / one["gain_margin"])),
        100.0 * (other["Ms"] / one["Ms"] - 1.0),
    )


if __name__ == "__main__":
    main()
