"""`plot` of every result: into new figures, into axes, into files; `--plot` of every command."""

from __future__ import annotations

import runpy
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import result_folder
import sewfast
from cli import call_refused as refused
from cli import called as command
from plants import bent_data, linear_data
from sewfast import Dataset, Model, VirtualMachine
from sewfast.errors import SettingError
from sewfast.plotting import thin

matplotlib = pytest.importorskip("matplotlib", reason="needs the report extra")
matplotlib.use("Agg")
from matplotlib import pyplot  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(autouse=True)
def no_figure_is_left() -> Iterator[None]:
    yield
    pyplot.close("all")


@cache
def model() -> Model:
    return sewfast.identify(bent_data(800, noise=0.05), model="oe")


PLANT = sewfast.LinearOE.from_tf(
    [0.0, 0.1313, 0.1255], [1.0, -1.86963, 0.87015], 0.001, input_units=["V"], output_unit="RPM"
)
"""A drive of 490 RPM/V with time constants of 252 and 7.4 ms."""


CALM = sewfast.Controller(sewfast.Gains.standard(0.005, 0.2), u_min=-20, u_max=20)


def loop(plant: Any) -> sewfast.ClosedLoopRun:
    return sewfast.run(sewfast.paper_controller(), plant, 500.0 * np.ones(200))


@cache
def results() -> dict[str, tuple[Any, int]]:
    """Every result that draws itself, and how many panels it has."""
    held = bent_data(400, noise=0.05)
    run = loop(VirtualMachine())
    return {
        "data": (held, 4),
        "summary": (held.summary(), 4),
        "validation": (sewfast.validate(model(), held), 2),
        "card": (sewfast.check(model(), held), 2),
        "run": (run, 3),
        "orders": (sewfast.orders(linear_data(600, noise=0.05), na=2, nb=2), 1),
        "delay": (sewfast.delay(linear_data(600, noise=0.05)), 2),
        "margins": (sewfast.margins(CALM, PLANT), 1),
    }


NAMES = ["data", "summary", "validation", "card", "run", "orders", "delay", "margins"]


@pytest.mark.parametrize("name", NAMES)
def test_a_result_draws_itself(name: str, tmp_path: Path) -> None:
    result, count = results()[name]
    others = pyplot.get_fignums()  # an executed page in the same process may have left its own
    panels = result.plot()
    assert len(panels) == count
    for ax in panels:
        assert ax.get_ylabel()
    assert panels[0].figure.number in pyplot.get_fignums()
    pyplot.close(panels[0].figure)

    figure, axes = pyplot.subplots(1, 2)
    assert result.plot(axes[0]) is axes[0]
    assert axes[0].lines
    if count > 1:
        result.plot(axes)
        assert axes[1].lines
    pyplot.close(figure)

    for ending in ("png", "svg", "pdf"):
        result.plot(file=tmp_path / f"{name}.{ending}")
        assert (tmp_path / f"{name}.{ending}").stat().st_size > 1000
    assert pyplot.get_fignums() == others


def test_wrong_axes_and_files_are_refused(tmp_path: Path) -> None:
    run = loop(VirtualMachine())
    with pytest.raises(SettingError, match=r"plot\(file=\.\.\.\)"):
        run.plot("run.png")
    with pytest.raises(SettingError, match="up to 3"):
        run.plot([None])
    with pytest.raises(SettingError, match=r"\.png, \.svg or \.pdf"):
        run.plot(file=tmp_path / "run.jpg")
    with pytest.raises(SettingError, match="expected the name of a figure, received 3"):
        run.plot(file=3)  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="folder that exists"):
        run.plot(file=tmp_path / "none" / "run.png")
    figure, axes = pyplot.subplots(1, 4)
    with pytest.raises(SettingError, match="up to 3"):
        run.plot(axes)
    with pytest.raises(SettingError, match="both"):
        run.plot(axes[0], file="run.png")
    pyplot.close(figure)
    card = sewfast.check(model(), bent_data(400, noise=0.05))
    with pytest.raises(SettingError, match="residuals"):
        card.plot(figure="spectrum")


def test_margins_of_an_unstable_loop_are_not_drawn() -> None:
    wild = sewfast.Controller(sewfast.Gains.standard(50.0, 0.001), u_min=-20, u_max=20)
    found = sewfast.margins(wild, PLANT)
    assert not found.stable
    with pytest.raises(SettingError, match="lower the gains"):
        found.plot()
    assert "unstable" in found._repr_html_()


@pytest.mark.parametrize("name", ["orders", "delay", "margins"])
def test_a_notebook_shows_a_table(name: str) -> None:
    result, _ = results()[name]
    shown = result._repr_html_()
    assert shown.startswith("<table>")
    assert str(result).splitlines()[-1].split()[-1] in shown or name == "orders"


def test_predicted_beside_measured() -> None:
    measured = loop(VirtualMachine())
    panels = measured.plot(others=[loop(VirtualMachine(7))])
    labels = [line.get_label() for line in panels[0].lines]
    assert len(labels) == 3
    assert labels[-1] == "reference"
    assert "7" in labels[1]
    pyplot.close(panels[0].figure)


def test_the_picture_of_the_readme_is_drawn_from_a_demo(tmp_path: Path) -> None:
    script = runpy.run_path(str(ROOT / "docs" / "pictures.py"))
    folder = result_folder.make(tmp_path / "demo")
    drawn = script["drawing"](script["traces"](folder)).plot(file=tmp_path / "picture.svg")
    assert len(drawn) == 4
    labels = [line.get_label() for line in drawn[0].lines]
    assert labels[-3:] == [*reversed(script["LABELS"].values()), "reference"]
    drawn_pages = {p.stem for p in (script["ASSETS"] / "pages").glob("*.png")}
    assert drawn_pages == set(script["PICTURES"])
    for picture in script["ASSETS"].rglob("*.png"):
        assert picture.stat().st_size <= script["LARGEST"]


def test_experiments_are_not_joined() -> None:
    data = Dataset.concat([linear_data(50, seed=1), linear_data(60, seed=2)])
    found = sewfast.validate(sewfast.identify(linear_data(400), model="arx"), data)
    output, error = found.plot()
    (measured,) = (x for x in output.lines if x.get_label() == "measured")
    t, y = np.asarray(measured.get_xdata()), np.asarray(measured.get_ydata())
    assert np.flatnonzero(np.isnan(y)).tolist() == [50]
    assert np.all(np.diff(t) > 0.0)
    assert "one after the other" in error.get_xlabel()
    pyplot.close(output.figure)


def test_gaps_stay_gaps_in_a_thinned_line() -> None:
    x = np.arange(30_000.0)
    y = np.sin(0.01 * x)
    y[12_000:12_400] = np.nan
    y[20_000] = 7.0
    _, kept = thin(x, y, 500)
    assert len(kept) < 1600
    assert np.isnan(kept).any()
    assert np.nanmax(kept) == 7.0
    # what a link loses here and there does not tear the line into dots, nor make it long
    y[::7] = np.nan
    assert len(thin(x, y, 500)[1]) < 1600
    assert np.isnan(thin(x, y, 500)[1]).sum() <= 9


# --- the command line -----------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    data = linear_data(600, noise=0.5)
    e = data.experiments[0]
    columns = {"t": data.Ts * np.arange(len(e)), "u": e.u[:, 0], "y": e.y}
    sewfast.write_table(tmp_path / "run.csv", columns, units={"u": "V", "y": "RPM"})
    return tmp_path


def test_every_command_draws(folder: Path) -> None:
    def drawn(*args: str) -> str:
        said = command(folder, *args, "--plot", f"{args[0]}.png").out
        assert (folder / f"{args[0]}.png").read_bytes().startswith(b"\x89PNG")
        return said

    columns = ("--input", "u", "--output", "y")
    for said in (
        drawn("look", "run.csv", *columns),
        drawn("identify", "run.csv", *columns, "--model", "oe", "-o", "m.json"),
        drawn("validate", "m.json", "run.csv"),
        drawn("check", "m.json", "run.csv"),
        drawn("tune", "m.json", "-o", "c.json", "--evaluations", "20"),
        drawn("run", "c.json", "m.json", "-o", "r.csv"),
        drawn("analyse", "c.json", "m.json"),
    ):
        assert ".png" in said
    assert "--plot" in refused(folder, "validate", "m.json", "run.csv", "--plot", "fit.doc")
    assert "none" in refused(folder, "run", "c.json", "m.json", "--plot", "none/run.png")
