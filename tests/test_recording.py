"""Recordings of the virtual machine: what stands in them, and that files give it back."""

from pathlib import Path

import numpy as np
import pytest

from sewfast import signals
from sewfast.control.record import record
from sewfast.errors import DataError
from sewfast.machine import VirtualMachine
from sewfast.readers import read, read_table
from sewfast.recording import Recording


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(VirtualMachine(), signals.excitation("step"), name="step")


def test_a_recording_starts_at_rest_wherever_the_machine_was(recording: Recording) -> None:
    machine = VirtualMachine()
    machine.run(np.full(500, 5.0))
    again = record(machine, signals.excitation("step"))
    np.testing.assert_array_equal(again.counts, recording.counts)
    np.testing.assert_array_equal(again.speed_true, recording.speed_true)


def test_the_speed_is_estimated_from_whole_counts(recording: Recording) -> None:
    np.testing.assert_array_equal(recording.counts, np.round(recording.counts))
    error = recording.y - recording.speed_true
    assert 0.0 < np.sqrt(np.mean(error**2)) < 5.0
    raw = recording.speed("difference")
    assert np.sqrt(np.mean((raw - recording.speed_true) ** 2)) > 10.0


def test_another_method_can_be_chosen(recording: Recording) -> None:
    raw = record(VirtualMachine(), recording.u, method="difference")
    np.testing.assert_array_equal(raw.y, recording.speed("difference"))


def test_a_variant_differs(recording: Recording) -> None:
    other = record(VirtualMachine(3), recording.u)
    assert np.abs(other.speed_true - recording.speed_true).max() > 5.0


def test_a_data_set_carries_units_and_the_true_speed(recording: Recording) -> None:
    data = recording.dataset()
    assert (data.input_units, data.output_unit, data.Ts) == (("V",), "RPM", 0.001)
    experiment = data.experiments[0]
    assert experiment.name == "step"
    np.testing.assert_array_equal(experiment.channels["speed_true"], recording.speed_true)
    np.testing.assert_array_equal(recording.dataset(np.ones(3000)).experiments[0].y, 1.0)


@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_a_saved_recording_reads_back_bit_for_bit(
    recording: Recording, tmp_path: Path, ending: str
) -> None:
    path = tmp_path / f"step{ending}"
    recording.save(path)
    table = read_table(path)
    assert table.names == ("t", "u", "counts", "y", "speed_true")
    for name, column in recording.columns().items():
        np.testing.assert_array_equal(table[name], column)


def test_a_saved_recording_identifies_by_its_column_names(
    recording: Recording, tmp_path: Path
) -> None:
    recording.save(tmp_path / "step.csv")
    data = read(tmp_path / "step.csv", inputs="u", output="y")
    assert (data.Ts, data.input_units, data.output_unit) == (0.001, ("V",), "RPM")
    counted = read(tmp_path / "step.csv", inputs="u", counts="counts", counts_per_rev=1572)
    np.testing.assert_array_equal(counted.experiments[0].y, recording.y)


@pytest.mark.parametrize(
    ("u", "word"),
    [
        (np.zeros((10, 1)), "(10, 1)"),
        (np.array([0.0, np.nan, 1.0, 1.0, 1.0, 1.0]), "finite"),
        (np.zeros(1), "5"),
    ],
)
def test_an_unusable_excitation_is_refused(u: np.ndarray, word: str) -> None:
    with pytest.raises(DataError) as caught:
        record(VirtualMachine(), u)
    assert word in str(caught.value)


def test_the_callers_excitation_is_left_alone() -> None:
    u = np.full(50, 30.0)
    recording = record(VirtualMachine(), u)
    u[:] = 0.0
    np.testing.assert_array_equal(recording.u, 30.0)
