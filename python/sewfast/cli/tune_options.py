"""Parsing of the options of `sewfast tune`: weights, limits, load steps, variables, notches."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from ..errors import SettingError

if TYPE_CHECKING:
    from ..control.biquad import Biquad
    from ..tuning.objective import Constraints, Cost, LoadStep
    from ..tuning.task import Wanted


def _pairs(given: list[str] | None, option: str) -> dict[str, float]:
    """NAME=NUMBER of every occurrence of an option."""
    pairs = {}
    for text in given or ():
        name, equals, number = text.partition("=")
        try:
            pairs[name.strip()] = float(number)
        except ValueError:
            equals = ""
        if not equals or not name.strip():
            raise SettingError(f"{option} {text}: expected NAME=NUMBER, as in {option} overshoot=2")
    return pairs


def cost(given: list[str] | None) -> Cost:
    """Weights of every --cost."""
    from ..tuning.objective import Cost

    return Cost(**_known(_pairs(given, "--cost"), "--cost", tuple(Cost.__dataclass_fields__)))


def constraints(given: list[str] | None) -> Constraints:
    """Limits of every --constraint."""
    from ..tuning.objective import Constraints

    pairs = _pairs(given, "--constraint")
    return Constraints(
        **_known(pairs, "--constraint", ("Ms", "overshoot", "u", "recovery", "load"))
    )


def loads(given: list[str] | None) -> list[LoadStep]:
    """Disturbances of every --load."""
    from ..tuning.objective import LoadStep

    steps = []
    for text in given or ():
        try:
            level, disturbance = (float(number) for number in text.split(":"))
        except ValueError:
            raise SettingError(
                f"--load {text}: expected LEVEL:COMMAND, as in --load=1500:-2"
            ) from None
        steps.append(LoadStep(level, disturbance))
    return steps


def _known(pairs: dict[str, float], option: str, names: tuple[str, ...]) -> dict[str, Any]:
    """The pairs, if all names are known."""
    for name in pairs:
        if name not in names:
            raise SettingError(f"{option} {name}: expected one of {', '.join(names)}")
    return dict(pairs)


def variables(text: str | None) -> list[Wanted] | None:
    """`Kp,Ti=0.02:0.5` as names and (name, low, high).

    Raises
    ------
    SettingError
        For bounds that are not two numbers.
    """
    if text is None:
        return None
    found: list[Wanted] = []
    for part in text.split(","):
        name, equals, bounds = (piece.strip() for piece in part.partition("="))
        if not equals:
            found.append(name)
            continue
        try:
            low, high = (float(bound) for bound in bounds.split(":"))
        except ValueError:
            raise SettingError(
                f"--variables {part}: expected NAME or NAME=LOW:HIGH, as in Ti=0.02:0.5"
            ) from None
        found.append((name, low, high))
    return found


def command_limits(args: argparse.Namespace) -> tuple[float | None, float | None]:
    """Least and largest command [V]: as given, else a recording's volt limit, else None.

    Raises
    ------
    SettingError, DataError
        For a recording without a volt limit, or one that cannot be read.
    """
    if args.limits_of is None:
        return args.u_min, args.u_max
    volt = _volt_limit(args.limits_of)
    return (
        -volt if args.u_min is None else args.u_min,
        volt if args.u_max is None else args.u_max,
    )


def _volt_limit(path: str) -> float:
    """Volt limit of the drive that a recording was made on [V]."""
    from ..recordfile.reader import read_header

    limits = read_header(path).settings.get("limits")
    volt = limits.get("volt") if isinstance(limits, dict) else None
    if not isinstance(volt, (int, float)) or isinstance(volt, bool) or volt <= 0.0:
        raise SettingError(
            f"--limits-of {path}: expected a recording of a drive with a volt limit, it states "
            "none; give --u-min and --u-max"
        )
    return float(volt)


def notches(given: list[str] | None) -> list[Biquad]:
    """Notches of every --notch.

    Raises
    ------
    SettingError
        For anything but HZ[:DEPTH[:WIDTH]].
    """
    from ..control.biquad import Biquad

    found = []
    for text in given or ():
        try:
            numbers = [float(number) for number in text.split(":")]
        except ValueError:
            numbers = []
        if not 1 <= len(numbers) <= 3:
            raise SettingError(
                f"--notch {text}: expected HZ, HZ:DEPTH or HZ:DEPTH:WIDTH, as in --notch 75:0.1:0.5"
            )
        found.append(Biquad.notch(*numbers))
    return found
