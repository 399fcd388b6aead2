"""`Dataset`: shapes, ranges, immutability and what it refuses."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sewfast.dataset import Dataset, Experiment
from sewfast.errors import DataError, SettingError


def make(n: int = 100, nu: int = 1, **options: object) -> Dataset:
    u = np.sin(np.arange(n * nu, dtype=float)).reshape(n, nu)
    return Dataset.from_arrays(u, np.arange(n, dtype=float), 0.01, **options)  # type: ignore[arg-type]


def test_arrays_are_copied_and_read_only() -> None:
    u, y = np.ones(5), np.arange(5.0)
    data = Dataset.from_arrays(u, y, 0.1)
    u[0] = y[0] = 99.0
    e = data.experiments[0]
    assert e.u[0, 0] == 1.0
    assert e.y[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        e.y[0] = 1.0
    assert u.flags.writeable


def test_a_single_input_becomes_one_column() -> None:
    e = make(7).experiments[0]
    assert e.u.shape == (7, 1)
    assert e.u.flags.c_contiguous
    assert e.u.dtype == np.float64


def test_default_names_follow_the_number_of_inputs() -> None:
    assert make().input_names == ("u",)
    assert make(nu=2).input_names == ("u1", "u2")


def test_other_dtypes_and_strides_are_converted() -> None:
    u = np.arange(20, dtype=np.int16).reshape(10, 2)[:, ::-1]
    data = Dataset.from_arrays(u, np.arange(10, dtype=np.float32), 1.0)
    np.testing.assert_array_equal(data.experiments[0].u, u)


@pytest.mark.parametrize(
    ("u", "y", "words"),
    [
        (np.ones((1, 5)), np.ones(5), ["(5,)", "(1, 5)", "transposed"]),
        (np.ones(4), np.ones(5), ["(5,)", "(4,)"]),
        (np.ones(5), np.ones((5, 1)), ["(N,)", "(5, 1)"]),
        (np.ones((5, 0)), np.ones(5), ["(5, 0)"]),
        (np.ones((5, 1, 1)), np.ones(5), ["(5, 1, 1)"]),
        (np.ones(0), np.ones(0), ["at least 1 sample"]),
        (np.ones(5) * 1j, np.ones(5), ["real numbers", "complex128"]),
        (["a", "b"], [1.0, 2.0], ["real numbers", "<U1"]),
        (np.array([None, 1.0]), np.ones(2), ["object"]),
    ],
)
def test_wrong_shapes_say_what_was_expected_and_received(
    u: object, y: object, words: list[str]
) -> None:
    with pytest.raises(DataError) as caught:
        Dataset.from_arrays(u, y, 0.1)  # type: ignore[arg-type]
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("Ts", [0.0, -1.0, float("nan"), float("inf"), 1e295])
def test_a_sample_time_is_positive_and_finite(Ts: float) -> None:
    with pytest.raises(DataError, match="positive sample time"):
        Dataset.from_arrays(np.ones(3), np.ones(3), Ts)


def test_names_match_the_columns() -> None:
    with pytest.raises(DataError, match="2 input names"):
        make(nu=2, input_names=["u"])
    with pytest.raises(DataError, match="different input names"):
        make(nu=2, input_names=["u", "u"])


def test_an_output_may_be_left_out() -> None:
    assert np.isnan(Dataset.from_arrays(np.ones((4, 2)), None, 1.0).experiments[0].y).all()


def test_masked_values_become_nan() -> None:
    y = np.ma.masked_greater(np.arange(5.0), 3.0)
    assert np.isnan(Dataset.from_arrays(np.ones(5), y, 1.0).experiments[0].y[4])


def test_ranges_apply_to_each_experiment() -> None:
    data = Dataset.concat([make(100, name="a"), make(50, name="b")])
    part = data.slice("10:40")
    assert [len(e) for e in part.experiments] == [30, 30]
    assert [e.range_text for e in part.experiments] == ["10:40", "10:40"]
    assert part[5:].experiments[1].range_text == "15:40"


def test_a_slice_is_a_view() -> None:
    data = make(10)
    assert np.shares_memory(data[2:5].experiments[0].y, data.experiments[0].y)


@pytest.mark.parametrize("text", ["1", "a:b", "1:2:3", "-5:3", "1.5:3", ""])
def test_text_that_is_no_range_is_refused(text: str) -> None:
    with pytest.raises(SettingError, match="A:B"):
        make().slice(text)


@pytest.mark.parametrize("text", ["50:50", "60:50", "0:101", "100:"])
def test_a_range_outside_names_the_experiment_and_its_length(text: str) -> None:
    with pytest.raises(DataError, match=r"run 7.*0:100"):
        make(name="run 7").slice(text)


def test_open_ranges() -> None:
    assert len(make().slice(":30")) == 30
    assert len(make().slice(" 30 : ")) == 70
    assert len(make()[-10:]) == 10


def test_python_slices_must_leave_something() -> None:
    with pytest.raises(DataError, match="at least one sample"):
        make(10)[10:20]
    with pytest.raises(SettingError, match="range"):
        make(10)[::2]
    with pytest.raises(SettingError, match="experiments"):
        make(10)[0]  # type: ignore[index]
    with pytest.raises(TypeError):
        iter(make(10))  # type: ignore[call-overload]


@given(st.integers(2, 500), st.floats(0.01, 0.99))
def test_split_loses_nothing(n: int, fraction: float) -> None:
    at = round(fraction * n)
    data = make(n)
    if not 0 < at < n:
        with pytest.raises(DataError, match="at least one sample"):
            data.split(fraction)
        return
    first, rest = (d.experiments[0] for d in data.split(fraction))
    np.testing.assert_array_equal(np.concatenate([first.y, rest.y]), data.experiments[0].y)
    assert len(first) == at
    assert rest.start == at


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.5, float("nan")])
def test_split_needs_a_true_fraction(fraction: float) -> None:
    with pytest.raises(SettingError, match="between 0 and 1"):
        make().split(fraction)


def test_concat_refuses_what_does_not_belong_together() -> None:
    fast = Dataset.from_arrays(np.ones(9), np.ones(9), 0.02, name="fast")
    with pytest.raises(DataError, match=r"0\.01.*fast"):
        Dataset.concat([make(), fast])
    with pytest.raises(DataError, match="expected the unit 'RPM', received 'rad/s'"):
        Dataset.concat([make(output_unit="RPM"), make(output_unit="rad/s")])
    with pytest.raises(DataError, match=r"expected 1 inputs.*received 2"):
        Dataset.concat([make(), make(nu=2)])
    with pytest.raises(DataError, match="none"):
        Dataset.concat([])
    assert len(Dataset.concat([make(output_unit="RPM"), make()])) == 200


def test_channels_follow_the_range() -> None:
    data = make(10, channels={"truth": np.arange(10) * 2})
    np.testing.assert_array_equal(data[3:5].experiments[0].channels["truth"], [6.0, 8.0])
    with pytest.raises(DataError, match=r"truth.*10 samples.*received 9"):
        make(10, channels={"truth": np.arange(9)})


def test_values_that_are_not_finite_are_named_by_their_place_in_the_recording() -> None:
    y = np.arange(10.0)
    y[7] = np.nan
    data = Dataset.from_arrays(np.arange(10.0), y, 1.0, name="run.csv", output_name="speed")
    with pytest.raises(DataError, match=r"run\.csv, output 'speed'.*sample 7"):
        data[5:].require_complete()
    data[:7].require_complete()
    data.require_inputs()
    broken = Dataset.from_arrays([0.0, np.inf], [1.0, 2.0], 1.0)
    with pytest.raises(DataError, match=r"input 'u'.*inf at sample 1"):
        broken.require_inputs()


def test_an_all_nan_column_is_said_to_be_one() -> None:
    data = Dataset.from_arrays(np.arange(3.0), np.full(3, np.nan), 1.0)
    with pytest.raises(DataError, match="every value is NaN"):
        data.require_complete()
    assert "nan to nan" in str(data)


def test_constant_columns_are_refused_for_identification() -> None:
    with pytest.raises(DataError, match="input 'u' is constant at 1"):
        Dataset.from_arrays(np.ones(9), np.arange(9), 1.0).require_excited()
    with pytest.raises(DataError, match="output 'y' is constant at 3"):
        Dataset.from_arrays(np.arange(9), np.full(9, 3), 1.0).require_excited()
    make().require_excited()


def test_it_describes_itself_with_units_and_ranges() -> None:
    data = make(10, input_units="V", output_unit="RPM", name="run.csv")
    assert "u [V] -> y [RPM]" in repr(data)
    assert "10 samples" in repr(data)
    assert "run.csv [0:10]" in str(data)
    assert "y [RPM]: 0 to 9" in str(data)


def test_it_can_be_pickled() -> None:
    data = make(10, channels={"truth": np.arange(10)})
    again = pickle.loads(pickle.dumps(data))
    np.testing.assert_array_equal(again.experiments[0].u, data.experiments[0].u)
    assert list(again.experiments[0].channels) == ["truth"]
    assert isinstance(again.experiments[0], Experiment)
