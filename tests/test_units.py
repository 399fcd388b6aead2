"""Units: however one is written, it means the same to readers, controllers, drives and pictures."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from refusals import refuses
from sewfast import Controller, Gains
from sewfast.cli import main
from sewfast.cli.control import reference_of
from sewfast.errors import DataError, SettingError
from sewfast.link.plan import require_units
from sewfast.link.wire import Channel
from sewfast.motorfit import rad_per_second
from sewfast.plotting import quantity
from sewfast.readers import Roles, read_table, roles
from sewfast.units import ANGULAR_SPEEDS, SPEEDS, counts_per_unit, duration, is_unit, spelled

WRITTEN = [
    ("RPM", 60.0), ("rpm", 60.0), ("1/min", 60.0), ("U/min", 60.0), ("min⁻¹", 60.0),
    ("min^-1", 60.0), ("tr/min", 60.0), ("r/min", 60.0), ("rps", 1.0), ("1/s", 1.0), ("rev/s", 1.0),
    ("turns/s", 1.0), ("rad/s", math.tau), ("rad/sec", math.tau), ("°/s", 360.0), ("deg/s", 360.0),
]  # fmt: skip
"""And how many of it one turn a second is."""


@pytest.mark.parametrize(("unit", "turn"), WRITTEN)
def test_a_speed_means_the_same_however_it_is_written(
    unit: str, turn: float, tmp_path: Path
) -> None:
    assert counts_per_unit(1000.0, unit) == pytest.approx(1000.0 / turn)
    assert rad_per_second(unit) == pytest.approx(math.tau / turn)
    assert quantity(unit) == f"speed [{unit}]"
    controller = Controller(Gains.standard(0.01, 0.1, y_unit=unit), counts_per_rev=1000.0)
    assert controller.counts_per_unit == pytest.approx(1000.0 / turn)
    # a column of which nothing but the unit tells that it is a speed
    path = tmp_path / "x.csv"
    rows = "".join(f"{k},{k % 3},{k % 5},{k % 7}\n" for k in range(50))
    path.write_text(f"t [s],q [V],n [{unit}],other\n{rows}", encoding="utf-8")
    assert roles(read_table(path)) == Roles("q", "n")


@pytest.mark.parametrize("unit", sorted(SPEEDS))
def test_every_spelling_is_a_unit_below_a_header(unit: str) -> None:
    assert is_unit(unit)
    assert spelled(spelled(unit)) == spelled(unit)


def channel(name: str, unit: str) -> Channel:
    return Channel(number=0, encoding=0, steps_per_unit=1, name=name, unit=unit)


@pytest.mark.parametrize("unit", ["1/min", "min^-1", "U/min"])
def test_a_drive_in_rpm_takes_a_controller_in_turns_a_minute(unit: str) -> None:
    require_units(
        Controller(Gains.standard(0.01, 0.1, y_unit=unit)),
        [channel("u", "V"), channel("feedback", "RPM")],
    )
    with refuses(SettingError, expected="whose output is in RPM"):
        require_units(
            Controller(Gains.standard(0.01, 0.1, y_unit="rad/s")),
            [channel("u", "V"), channel("feedback", "RPM")],
        )


def test_a_reference_in_another_spelling_is_taken_and_in_another_unit_refused(
    tmp_path: Path,
) -> None:
    path = tmp_path / "r.csv"
    path.write_text("t [s],r [1/min]\n" + "".join(f"{k / 100},{k}\n" for k in range(20)))
    np.testing.assert_array_equal(reference_of(str(path), 0.01, "RPM"), np.arange(20.0))
    with pytest.raises(DataError, match="expected r in rad/s"):
        reference_of(str(path), 0.01, "rad/s")


def recorded(path: Path, speed: str, volt: str) -> Path:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-5.0, 5.0, 30), 20)
    y = np.convolve(u, 5.0 * 0.9 ** np.arange(100))[: len(u)] + rng.normal(size=len(u))
    rows = "".join(
        f"{k / 100},{a:.6f},{b:.6f}\n" for k, (a, b) in enumerate(zip(u, y, strict=True))
    )
    path.write_text(f"t [s],u [{volt}],speed [{speed}]\n{rows}")
    return path


def test_a_model_takes_data_and_settings_in_another_spelling(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    recorded(tmp_path / "a.csv", "1/min", "V")
    recorded(tmp_path / "b.csv", "RPM", "volt")
    recorded(tmp_path / "c.csv", "rad/s", "V")
    assert main(["identify", "a.csv", "--model", "oe", "-o", "m.json"]) == 0
    assert main(["validate", "m.json", "b.csv"]) == 0
    assert main(["validate", "m.json", "c.csv"]) == 2
    assert "expected the unit '1/min', received 'rad/s'" in capsys.readouterr().err
    (tmp_path / "sewfast.toml").write_text('[units]\nspeed = "rpm"\n')
    assert main(["validate", "m.json", "a.csv"]) == 0
    (tmp_path / "sewfast.toml").write_text('[units]\nspeed = "deg/s"\n')
    assert main(["validate", "m.json", "a.csv"]) == 2


def test_what_is_no_angular_speed_has_no_counts() -> None:
    assert "m/s" not in ANGULAR_SPEEDS
    with pytest.raises(SettingError, match="expected a speed unit out of rpm"):
        counts_per_unit(1000.0, "m/s")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 ms"), (0.0494, "49.4 ms"), (1.0, "1 s"), (599.0, "599 s"), (1697.4, "28.29 min"),
        (8139.4571, "135.7 min"), (97200.0, "27 h"), (math.inf, "inf ms"),
    ],
)  # fmt: skip
def test_times_are_written_in_the_unit_that_suits_them(seconds: float, text: str) -> None:
    assert duration(seconds) == text
