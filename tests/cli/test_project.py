"""`sewfast init`, `sewfast.toml`, and a stranger's CSV taken to a controller without an option."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sewfast as api
from cli import call_refused as refused
from cli import called as sewfast
from effort import FULL
from sewfast.cli.project import NAME, find, load
from sewfast.errors import SettingError
from sewfast.readers import read_table, roles
from sewfast.units import split_unit, unit_in_name
from sewfast_studio.project import Project, Step

LIMITS = "volt = 8\nspeed = 3500\nacceleration = 40000\ncurrent = 15\n"


def fan(seed: int, count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Command [V] and speed [RPM] of a first-order fan, every 10 ms."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.uniform(0.0, 12.0, count // 20), 20)
    y = np.zeros(count)
    for k in range(1, count):
        y[k] = 0.95 * y[k - 1] + 6.25 * u[k - 1]
    return u, y + random.normal(0.0, 2.0, count)


def stranger(path: Path, header: str, seed: int = 0, *, above: str = "Instrument;X-1\n\n") -> None:
    """A file as an instrument writes it: lines above the header, semicolons, decimal commas."""
    u, y = fan(seed)
    rows = (f"{10 * k},0;{a:.4f};{b:.3f}" for k, (a, b) in enumerate(zip(u, y, strict=True)))
    path.write_text(above + header + "\n" + "\n".join(rows).replace(".", ",") + "\n")


def toml(folder: Path, text: str) -> Path:
    (folder / NAME).write_text(text)
    return folder / NAME


# --- a stranger's CSV -----------------------------------------------------------------------------


STRANGERS = [
    ("t [ms];u;y", 2),
    ("time_ms;voltage_V;speed_rpm", 0),
    ("Time (ms);Spannung [V];Drehzahl [rpm]", 1),
    ("time_ms;cmd;channel 2", 3),
]


@pytest.mark.nightly("default searches for each header; by day test_grey_box.py has one")
@pytest.mark.parametrize(("header", "seed"), STRANGERS if FULL else STRANGERS[:2])
def test_three_commands_without_an_option_reach_a_verified_controller(
    tmp_path: Path, header: str, seed: int
) -> None:
    stranger(tmp_path / "bench.csv", header, seed)
    sewfast(tmp_path, "identify", "bench.csv")
    sewfast(tmp_path, "tune", "bench-model.json")
    said = sewfast(tmp_path, "run", "bench-controller.json", "bench-model.json").err
    assert "overshoot" in said
    model = api.load_model(tmp_path / "bench-model.json")
    assert model.Ts == pytest.approx(0.01)
    # a file that nothing was learned from, and the loop on the model
    stranger(tmp_path / "other.csv", header, seed + 100)
    data = api.read(tmp_path / "other.csv", **model.columns)
    assert model.validate(data).simulation.fit_percent > 95.0
    run = api.run(api.load_controller(tmp_path / "bench-controller.json"), model)
    assert run.metrics()["rmse"] < 0.05 * np.ptp(run.r)


def table(tmp_path: Path, *names: str) -> api.readers.Table:
    rng = np.random.default_rng(0)
    columns = {name: rng.normal(size=50) for name in names} | {"t": 0.01 * np.arange(50)}
    api.write_table(tmp_path / "x.csv", columns)
    return read_table(tmp_path / "x.csv")


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("u", "y"), ("u", "y")),
        (("u", "y", "counts", "speed_true"), ("u", "y")),
        (("r", "u", "y"), ("u", "y")),
        (("voltage [V]", "current [A]", "speed [rad/s]"), ("voltage", "speed")),
        (("current [A]", "speed [rad/s]"), ("current", "speed")),
        (("pwm", "omega"), ("pwm", "omega")),
        (("left", "speed_rpm"), ("left", "speed_rpm")),
        (("a", "b"), None),
        (("u", "speed [RPM]", "angle [rad]"), None),
        (("v1 [V]", "v2 [V]", "speed [RPM]"), None),
        (("u", "foo", "bar"), None),
        (("motor voltage", "motor speed", "torque [Nm]"), ("motor voltage", "motor speed")),
        (("MotorVoltage", "ActualSpeed", "StatusWord"), ("MotorVoltage", "ActualSpeed")),
        (("bus_voltage [V]", "voltage [V]", "speed [rpm]"), ("voltage", "speed")),
        (("pwm [%]", "current [A]", "n [U/min]"), ("pwm", "n")),
        (("motor [Volt]", "tacho [Volt]"), ("motor", "tacho")),
        (("voltage [V]", "speed [rpm]", "temperature [°C]"), ("voltage", "speed")),
        (("voltage", "temperature"), ("voltage", "temperature")),
        (("speed_ref", "voltage", "speed"), ("voltage", "speed")),
        (("n_soll [rpm]", "Spannung", "n_ist [rpm]"), ("Spannung", "n_ist")),
        (("voltage_ref", "rpm"), ("voltage_ref", "rpm")),
        (("u1", "y1", "noise"), ("u1", "y1")),
        (("speed 1", "speed 2", "u"), None),
        (("Setpoint voltage [V]", "Drum speed [rpm]"), ("Setpoint voltage", "Drum speed")),
        (("Setpoint", "voltage [V]", "speed [rpm]"), ("voltage", "speed")),
        (("Setpoint Current [A]", "Velocity [mm/s]"), ("Setpoint Current", "Velocity")),
        (("Ankerspannung in V", "Ist-Drehzahl in U/min"), ("Ankerspannung", "Ist-Drehzahl")),
        (("Spannung / V", "Drehzahl / min⁻¹"), ("Spannung", "Drehzahl")),
        (("FanCommand_pct", "wheel_speed_mps"), ("FanCommand_pct", "wheel_speed_mps")),
        (("duty_cycle", "wheel_rpm", "battery_V"), ("duty_cycle", "wheel_rpm")),
        (("Supply voltage [V]", "voltage [V]", "rpm"), ("voltage", "rpm")),
        (("stellgroesse", "istwert", "regelabweichung"), ("stellgroesse", "istwert")),
        (("voltaje_V", "velocidad_rpm"), ("voltaje_V", "velocidad_rpm")),
        (("voltage/V", "speed/(rad/s)"), ("voltage", "speed")),
        (("heater_pct", "temp_C"), ("heater_pct", "temp_C")),
        (("heater_pct", "temp_C", "ambient_C"), ("heater_pct", "temp_C")),
        (("valve [%]", "level [m]", "noise"), ("valve", "level")),
        (("Voltage", "speed_rad/s", "other"), ("Voltage", "speed_rad/s")),
        (("compressor [%]", "cabinet [°F]"), ("compressor", "cabinet")),
        (("fan (%)", "duct (Pa)"), ("fan", "duct")),
        (("Pumpe [%]", "Niveau [cm]"), ("Pumpe", "Niveau")),
        (("duty_%", "flow in m³/h"), ("duty_%", "flow in m³/h")),
        (("thrust_pct", "altitude_m"), ("thrust_pct", "altitude_m")),
        (("setpoint_C", "heating_kW", "room_C"), ("heating_kW", "room_C")),
        (("torque_mNm", "current_A", "speed"), ("current_A", "speed")),
    ],
)
def test_columns_are_recognised_or_left_open(
    tmp_path: Path, names: tuple[str, ...], expected: tuple[str, str] | None
) -> None:
    found = roles(table(tmp_path, *names))
    assert (None if found is None else (found.input, found.output)) == expected


@pytest.mark.parametrize("levels", [2, 1000])
def test_of_two_columns_in_doubt_the_one_that_steps_is_the_command(
    tmp_path: Path, levels: int
) -> None:
    rng = np.random.default_rng(levels)
    steps = np.repeat(rng.integers(levels, size=30), 20) / (levels - 1)
    noisy = np.cumsum(steps - 0.3) + rng.normal(size=600)
    coarse = np.round(np.cumsum(steps - 0.3))  # a sensor, which keeps its value, too
    for answer in (noisy, coarse):
        for names in (("current_A", "voltage_V"), ("feed", "mass"), ("a", "b")):
            columns = {"t": 0.1 * np.arange(600), names[1]: answer, names[0]: steps}
            api.write_table(tmp_path / "x.csv", columns)
            found = roles(read_table(tmp_path / "x.csv"))
            assert found is not None
            assert (found.input, found.output) == names
    # names that are clear count, whatever the values look like
    api.write_table(tmp_path / "x.csv", {"voltage": noisy, "speed": steps})
    found = roles(read_table(tmp_path / "x.csv"))
    assert found is not None
    assert found.input == "voltage"


@pytest.mark.parametrize(
    ("names", "named", "expected"),
    [
        (("voltage", "speed", "a"), {"inputs": ("a",)}, ("a", "speed")),
        (("voltage", "a", "b"), {"output": "a"}, ("voltage", "a")),
        (("a", "b"), {"output": "b"}, ("a", "b")),
        (("a", "b"), {"inputs": ("b",)}, ("b", "a")),
        (("a", "b", "c"), {"inputs": ("b",)}, None),
        (("a", "speed", "angle_rad"), {"output": "speed"}, None),
    ],
)
def test_a_named_role_leaves_the_other_recognised(
    tmp_path: Path, names: tuple[str, ...], named: Any, expected: tuple[str, str] | None
) -> None:
    found = roles(table(tmp_path, *names), **named)
    assert (None if found is None else (found.input, found.output)) == expected


def test_the_command_line_python_and_the_studio_take_the_same_columns(tmp_path: Path) -> None:
    rows = [
        f"2026-03-14 10:{k // 60:02}:{k % 60:02},{(k // 9) % 5},{20 + (k // 7) % 3}"
        for k in range(300)
    ]
    (tmp_path / "oven.csv").write_text("\n".join(["Logged at,heater_pct,temp_C", *rows]))
    data = api.read(tmp_path / "oven.csv")
    assert (data.input_names, data.output_name, data.Ts) == (("heater_pct",), "temp_C", 1.0)
    assert (data.input_units, data.output_unit) == (("%",), "degC")
    for option in ((), ("--input", "heater_pct"), ("--output", "temp_C")):
        assert "heater_pct [%]" in sewfast(tmp_path, "look", "oven.csv", *option).out
    asked = Project(tmp_path).columns(Step("oven.csv"))
    assert (asked["inputs"], asked["output"]) == (["heater_pct"], "temp_C")


def test_the_studio_takes_no_time_for_a_voltage(tmp_path: Path) -> None:
    rows = "".join(f"{k},{k % 3},{k % 5}\n" for k in range(50))
    (tmp_path / "x.csv").write_text("Time,Voltage,Speed\n" + rows)
    asked = Project(tmp_path).columns(Step("x.csv"))
    assert (asked["inputs"], asked["output"]) == (["Voltage"], "Speed")
    (tmp_path / "y.csv").write_text("Time,a,b\n" + rows)
    asked = Project(tmp_path).columns(Step("y.csv"))
    assert (asked["inputs"], asked["output"]) == ([], None)


@pytest.mark.parametrize(
    "header",
    ["epoch_ms;u;y", "Elapsed Time (ms);u;y", "relative_time_ms;u;y", "time_ms;u;y;time_ms"],
)
def test_other_names_of_the_time(tmp_path: Path, header: str) -> None:
    rows = [f"{1_772_000_000_000 + 10 * k};{k % 7};{k % 5}" for k in range(60)]
    again = [f"{row};{row.split(';')[0]}" if header.endswith("time_ms") else row for row in rows]
    (tmp_path / "x.csv").write_text("\n".join([header, *again]))
    assert api.read(tmp_path / "x.csv", inputs="u", output="y").Ts == pytest.approx(0.01)


def test_dates_are_the_time_where_nothing_else_is(tmp_path: Path) -> None:
    rows = [f"2026-03-14 10:00:{k / 100:05.2f},{k % 7},{k % 5}" for k in range(60)]
    (tmp_path / "x.csv").write_text("\n".join(["Date,u,y", *rows]))
    assert api.read(tmp_path / "x.csv", inputs="u", output="y").Ts == pytest.approx(0.01)


def test_a_header_that_occurs_twice_with_other_values_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("t,u,y,y\n" + "".join(f"{k},{k % 3},1,{k}\n" for k in range(9)))
    assert "occurs more than once, with other values" in refused(tmp_path, "identify", "x.csv")


def test_a_column_that_counts_the_rows_is_neither(tmp_path: Path) -> None:
    rows = "".join(f"{k},{10 * k},{k % 7},{k % 5}\n" for k in range(60))
    (tmp_path / "x.csv").write_text("Sample,time_ms,Vmot,RPM\n" + rows)
    found = roles(read_table(tmp_path / "x.csv"))
    assert found is not None
    assert (found.input, found.output) == ("Vmot", "RPM")


def test_a_column_that_never_changes_is_neither(tmp_path: Path) -> None:
    columns = {
        "t": 0.01 * np.arange(9),
        "gain": np.ones(9),
        "in": np.arange(9.0),
        "x": np.arange(9.0) ** 2,
    }
    api.write_table(tmp_path / "x.csv", columns)
    found = roles(read_table(tmp_path / "x.csv"))
    assert found is not None
    assert (found.input, found.output) == ("in", "x")


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("speed_rpm", "RPM"), ("u_V", "V"), ("current_A", "A"), ("w_rad_s", "rad/s"),
        ("phase_A", ""), ("rpm", ""), ("i_a", ""), ("pos_m", ""), ("speed", ""), ("", ""),
        ("temp_C", "degC"), ("T_K", "K"), ("speed_rad/s", "rad/s"), ("phase_C", ""),
        ("vel_m_s", "m/s"), ("omega_rad_per_s", "rad/s"), ("pwm_percent", "%"), ("ao_volts", "V"),
        ("pressure_bar", "bar"), ("heating_kW", "kW"), ("flow_m3h", "m³/h"), ("level_cm", "cm"),
    ],
)  # fmt: skip
def test_units_in_names(name: str, unit: str) -> None:
    assert unit_in_name(name)[1] == unit


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("n/rpm", ("n", "rpm")), ("Drehzahl / 1/min", ("Drehzahl", "1/min")),
        ("Voltage, V", ("Voltage", "V")), ("u in mV", ("u", "mV")),
        ("speed m/s", ("speed m/s", "")),
        ("u [V rms]", ("u", "V")), ("u [ rms]", ("u", "")), ("speed_rad/s", ("speed_rad/s", "")),
        ("rad/s", ("rad/s", "")), ("in", ("in", "")), ("in / out", ("in / out", "")),
        ("power on/off", ("power on/off", "")), ("km/h", ("km/h", "")), ("/s", ("/s", "")),
    ],
)  # fmt: skip
def test_units_behind_a_name(header: str, expected: tuple[str, str]) -> None:
    assert split_unit(header) == expected


def test_names_may_hold_a_delimiter_that_the_numbers_do_not(tmp_path: Path) -> None:
    rows = "".join(f"{k / 100};{k % 7};{k % 5}\n" for k in range(60))
    (tmp_path / "x.csv").write_text("Time, s;Voltage, V;Speed, rpm\n" + rows)
    data = api.read(tmp_path / "x.csv", inputs="Voltage", output="Speed")
    assert (data.Ts, data.output_unit) == (pytest.approx(0.01), "rpm")


def test_in_doubt_it_asks(tmp_path: Path) -> None:
    table(tmp_path, "a", "b")
    said = refused(tmp_path, "identify", "x.csv")
    assert "expected columns that show which is the input" in said
    assert "--input COL" in said


def test_quiet_and_verbose(tmp_path: Path) -> None:
    stranger(tmp_path / "bench.csv", "time_ms;u;y", above="")
    fit = ("identify", "bench.csv", "--model", "arx", "-o", "m.json")
    plain = sewfast(tmp_path, *fit)
    assert plain.err == "bench.csv: input u, output y\n"
    quiet = sewfast(tmp_path, *fit, "-q")
    assert (quiet.out, quiet.err) == (plain.out, "")
    first, second, third = sewfast(tmp_path, *fit, "-v").err.splitlines()
    assert first == "bench.csv: read, 2000 rows of time_ms, u, y"
    assert second == "bench.csv: input u, output y"
    assert third.startswith("identify: done in ")
    assert f"{(tmp_path / 'm.json').resolve()}: written" in sewfast(tmp_path, *fit, "-vv").err
    # errors are not left out, and the two contradict each other
    assert "No such file" in refused(tmp_path, "identify", "nix.csv", "-q")
    assert "not allowed with" in refused(tmp_path, *fit, "-q", "-v")


def test_look_draws_columns_that_need_no_names(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    stranger(tmp_path / "bench.csv", "time_ms;voltage_V;speed_rpm")
    assert "input voltage" in sewfast(tmp_path, "look", "bench.csv", "--plot", "a.png").err
    assert (tmp_path / "a.png").stat().st_size > 0
    table(tmp_path, "a", "b")
    said = refused(tmp_path, "look", "x.csv", "--plot", "b.png")
    assert "which column is the input" in said


def test_a_message_does_not_steer_the_terminal(tmp_path: Path) -> None:
    assert "\x1b" not in refused(tmp_path, "identify", "\x1b[2Jbench.csv")


# --- init -----------------------------------------------------------------------------------------


def test_a_time_column_may_have_any_name(tmp_path: Path) -> None:
    stranger(tmp_path / "bench.csv", "Uhr [ms];u;y")
    assert "expected a column t or time" in refused(tmp_path, "identify", "bench.csv")
    arguments = ("bench.csv", "--model", "oe", "-o", "drive.json")
    sewfast(tmp_path, "identify", *arguments, "--time", "Uhr")
    assert api.load_model(tmp_path / "drive.json").Ts == pytest.approx(0.01)
    sewfast(tmp_path, "validate", "drive.json", "bench.csv", "--time", "Uhr")
    toml(tmp_path, '[columns]\ntime = "Uhr"\n')
    sewfast(tmp_path, "identify", *arguments)
    sewfast(tmp_path, "validate", "drive.json", "bench.csv")


def test_a_column_that_is_spoiled_is_named(tmp_path: Path) -> None:
    (tmp_path / "bench.csv").write_text("t,u,y\n0,1,2\n1,2,OVL\n2,3,4\n")
    assert "line 3, column 'y'" in refused(tmp_path, "identify", "bench.csv")


def test_init_lays_out_a_folder_that_can_be_read(tmp_path: Path) -> None:
    done = sewfast(tmp_path, "init", "spindle", "--json").json()
    assert [Path(f).name for f in done["files"]] == [NAME, "README.md"]
    assert (tmp_path / "spindle" / "recordings").is_dir()
    assert load(tmp_path / "spindle" / NAME).columns == {}
    assert "expected a new file" in refused(tmp_path, "init", "spindle")


def test_every_line_that_init_comments_out_is_a_setting(tmp_path: Path) -> None:
    sewfast(tmp_path, "init")
    text = (tmp_path / NAME).read_text()
    lines = [x.removeprefix("# ") if " = " in x else x for x in text.splitlines()]
    found = load(toml(tmp_path, "\n".join(lines)))
    assert found.port == "/dev/ttyUSB0"
    assert set(found.columns) == {"input", "output", "time", "counts", "counts_per_rev", "ts"}
    assert len(found.limits) == 4
    assert found.command == {"u_min": -10.0, "u_max": 10.0}
    assert found.units == {"u": "V", "speed": "RPM"}


def test_init_takes_the_columns_of_a_recording_and_keeps_what_is_there(tmp_path: Path) -> None:
    stranger(tmp_path / "bench.csv", 'time_ms;"vol""tage_V";speed_rpm')
    (tmp_path / "README.md").write_text("mine")
    sewfast(tmp_path, "init", "--recording", "bench.csv")
    found = load(tmp_path / NAME)
    assert found.columns == {"input": ['vol"tage_V'], "output": "speed_rpm"}
    assert found.units == {'vol"tage_V': "V", "speed_rpm": "RPM"}
    assert (tmp_path / "README.md").read_text() == "mine"


def test_init_refuses_a_file_and_columns_in_doubt(tmp_path: Path) -> None:
    (tmp_path / "f").touch()
    assert "expected a folder" in refused(tmp_path, "init", "f")
    table(tmp_path, "a", "b")
    assert "leave --recording out" in refused(tmp_path, "init", "--recording", "x.csv")


# --- sewfast.toml ---------------------------------------------------------------------------------


def test_columns_and_units_come_from_the_file_above_and_options_win(tmp_path: Path) -> None:
    toml(tmp_path, '[columns]\ninput = "a"\noutput = "b"\n[units]\na = "V"\nb = "RPM"\n')
    folder = tmp_path / "deep" / "down"
    folder.mkdir(parents=True)
    stranger(folder / "bench.csv", "time_ms;a;b")
    done = sewfast(folder, "identify", "bench.csv", "--model", "oe")
    assert f"from {tmp_path / NAME}: input = a, output = b" in done.err
    model = api.load_model(folder / "bench-model.json")
    assert (model.input_names, model.output_name) == (("a",), "b")
    assert (tuple(model.input_units), model.output_unit) == (("V",), "RPM")
    sewfast(folder, "validate", "bench-model.json", "bench.csv")
    other = ("--input", "b", "--output", "a", "-o", "swapped.json")
    said = refused(folder, "identify", "bench.csv", "--model", "arx", *other)
    assert "from" not in said.splitlines()[0]
    assert "are exchanged; take a as input and b as output" in said
    stranger(folder / "other.csv", "time_ms;b;a")
    done = sewfast(folder, "identify", "other.csv", "--model", "arx", *other)
    assert "from" not in done.err.splitlines()[0]
    assert api.load_model(folder / "swapped.json").output_name == "a"


def test_units_that_contradict_the_file_are_refused(tmp_path: Path) -> None:
    toml(tmp_path, '[units]\nspeed_rpm = "rad/s"\n')
    stranger(tmp_path / "bench.csv", "time_ms;voltage_V;speed_rpm")
    said = refused(tmp_path, "identify", "bench.csv")
    assert "expected the unit of sewfast.toml, rad/s, received RPM" in said


def test_the_range_of_the_command_is_for_tuning(tmp_path: Path) -> None:
    stranger(tmp_path / "bench.csv", "time_ms;u;y")
    sewfast(tmp_path, "identify", "bench.csv", "--model", "oe", "-o", "drive.json")
    toml(tmp_path, "[limits]\nu_min = -2\nu_max = 11\n")
    few = ("--evaluations", "20")
    sewfast(tmp_path, "tune", "drive.json", *few, "--u-min", "-1")
    controller = api.load_controller(tmp_path / "drive-controller.json")
    assert (controller.u_min, controller.u_max) == (-1.0, 11.0)
    # a controller to start with brings its own
    sewfast(
        tmp_path, "tune", "drive.json", *few, "--start", "drive-controller.json", "-o", "b.json"
    )
    assert api.load_controller(tmp_path / "b.json").u_max == 11.0


def test_limits_and_port_are_for_drives_alone(tmp_path: Path) -> None:
    toml(tmp_path, f'port = "socket://localhost:1"\n[limits]\n{LIMITS}')
    # a virtual machine refuses --limits; those of the file are not meant for it
    sewfast(tmp_path, "record", "--on", "virtual", "--signal", "step", "-o", "step.csv")
    for command in (
        ("doctor",), ("stop",), ("record", "--signal", "step", "-o", "a.mcap"),
        ("commission", "--out", "x"),
    ):  # fmt: skip
        done = sewfast(tmp_path, *command, done=2)
        assert "socket://localhost:1" in done.err, command
    assert "limits = volt=8,speed=3500" in done.err


def test_without_a_port_it_is_asked_for(tmp_path: Path) -> None:
    assert "--on" in refused(tmp_path, "record", "--signal", "step")
    assert "PORT" in refused(tmp_path, "stop")


def test_a_byte_order_mark_is_no_setting(tmp_path: Path) -> None:
    (tmp_path / NAME).write_text('port = "COM3"\n', encoding="utf-8-sig")
    assert load(tmp_path / NAME).port == "COM3"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('prot = "COM3"', "'prot' is not a setting; did you mean 'port'?"),
        ('[columns]\nouptut = "y"', "[columns] 'ouptut' is not a setting; did you mean 'output'?"),
        ("[limits]\nvolts = 3", "did you mean 'volt'?"),
        ("[limits]\nvolt = 3", "speed, acceleration, current missing"),
        ('[limits]\nu_max = "9"', "[limits] u_max: expected a number, received '9'"),
        ("[limits]\nu_max = nan", "expected a number"),
        ("[limits]\nu_max = " + "9" * 400, "expected a number below 1e308, received 400 digits"),
        ("[limits]\nu_max = true", "expected a number"),
        ("[limits]\nu_min = 3\nu_max = -3", "expected u_min below u_max, received u_min = 3"),
        ("[limits]\nu_min = 3\nu_max = 3", "expected u_min below u_max"),
        ("[limits]\nvolt = -8", "[limits] volt: expected a positive number, received -8"),
        ("limits = 3", "expected a table, [limits], received 3"),
        ("port = 3", "expected a text"),
        ("[columns]\ninput = []", "expected at least one name"),
        ("[columns]\ninput = [1]", "expected a text"),
        ("[columns]\nts = 0", "expected a positive number"),
        ("[columns]\nts = inf", "expected a positive number"),
        ("[units]\nu = 1", "[units] u: expected a text"),
        ("port = ", "expected TOML"),
        ('port = "a"\nport = "b"', "expected TOML"),
    ],
)
def test_faults_are_named(tmp_path: Path, text: str, words: str) -> None:
    path = toml(tmp_path, text)
    with pytest.raises(SettingError) as refusal:
        load(path)
    assert words in str(refusal.value)
    assert str(path) in str(refusal.value)


def test_help_is_to_be_had_with_a_faulty_file(tmp_path: Path) -> None:
    toml(tmp_path, "prot = 3")
    assert "usage" in sewfast(tmp_path, "tune", "--help").out
    assert "did you mean 'port'" in refused(tmp_path, "signals")


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SettingError, match="expected TOML"):
        load(tmp_path / NAME)
    (tmp_path / NAME).write_bytes(b"#" * 2_000_000)
    with pytest.raises(SettingError, match="at most 1 MB"):
        load(tmp_path / NAME)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_settings_or_refused(
    tmp_path_factory: pytest.TempPathFactory, raw: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / NAME
    path.write_bytes(raw)
    try:
        load(path)
    except SettingError:
        pass
    finally:
        path.unlink()


def test_without_a_file_there_are_no_settings(tmp_path: Path) -> None:
    assert find(tmp_path).path is None


def test_a_file_of_somebody_else_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file in /tmp by another user must not set the limits of a drive."""
    if not hasattr(os, "getuid"):
        pytest.skip("needs users with numbers")
    toml(tmp_path, 'port = "COM9"')
    owner = (tmp_path / NAME).stat().st_uid
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    if owner == 0:
        os.chown(tmp_path / NAME, 4711, -1)
    assert find(tmp_path).port is None
    assert "belongs to another user" in capsys.readouterr().err


def test_a_folder_that_is_gone_has_no_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone() -> Path:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "cwd", gone)
    assert find().path is None


@pytest.mark.skipif(sys.version_info >= (3, 11), reason="tomllib is there")
def test_on_python_3_10_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tomli", None)
    with pytest.raises(SettingError, match="pip install tomli"):
        load(toml(tmp_path, ""))


def test_a_model_keeps_its_own_columns(tmp_path: Path) -> None:
    stranger(tmp_path / "bench.csv", "time_ms;u;y")
    sewfast(tmp_path, "identify", "bench.csv", "--model", "oe", "-o", "drive.json")
    toml(tmp_path, '[columns]\ninput = "y"\noutput = "u"\n')
    found = json.loads(sewfast(tmp_path, "validate", "drive.json", "bench.csv", "--json").out)
    assert found["grade"] == "good"


def test_suggested_commands_quote_names_with_spaces(tmp_path: Path) -> None:
    stranger(tmp_path / "my bench.csv", "time_ms;u;y", above="")
    said = sewfast(tmp_path, "identify", "my bench.csv", "--model", "arx").out
    assert "sewfast validate 'my bench-model.json' DATA" in said


def test_look_counts_the_rows_of_the_longest_variable(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", info=np.arange(6.0), a=np.arange(7200.0), b=np.arange(7200.0) ** 2)
    assert "x.npz: 7200 rows" in sewfast(tmp_path, "look", "x.npz").out


def test_a_second_command_is_named_where_it_is_left_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    heater, fan = (np.repeat(rng.uniform(0.0, 100.0, 30), 20) for _ in range(2))
    columns = {
        "t_s": np.arange(600.0), "heater_pct": heater, "heater_V": 0.24 * heater, "fan_pct": fan,
        "temp_C": np.cumsum(heater - fan) / 100.0 + rng.normal(size=600),
    }  # fmt: skip
    api.write_table(tmp_path / "x.csv", columns)
    said = sewfast(tmp_path, "look", "x.csv", "--input", "heater_pct").err
    assert "fan_pct is left out" in said
    assert "--input heater_pct --input fan_pct" in said
    assert "heater_V" not in said
    named = ("--input", "heater_pct", "--input", "fan_pct", "--output", "temp_C")
    assert "left out" not in sewfast(tmp_path, "look", "x.csv", *named).err
