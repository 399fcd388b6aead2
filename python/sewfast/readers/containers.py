"""`Table`, and files of named arrays (`.mat`, HDF5, `.npz`) read into one."""

from __future__ import annotations

import difflib
import io
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..dataset import FloatArray
from ..errors import DataError, SettingError, not_installed, printable
from ..units import split_unit, unit_in_name

# --- Table: the named columns of one file, and why others cannot be used --------------------------


MAX_COLUMNS = 10_000
ELEMENTS = 64
"""Most elements of an array in a message or a cell that become columns."""


@dataclass(frozen=True, eq=False, repr=False)
class Table:
    """Columns of one file by name; `table["speed"]` is a float64 array of shape (N,), and lengths
    can differ if the format allows it. `units` come from headers, `unusable` has the reason for
    columns without numbers, `lines` the row's line in a text (1-based), `notes` what was left out.
    `Ts` [s] and `counts_per_rev` are what the file states, at `Ts_source`; `moments` are columns
    that were dates or times, in seconds from the first one.
    """

    path: Path
    columns: Mapping[str, FloatArray]
    units: Mapping[str, str] = field(default_factory=dict)
    unusable: Mapping[str, str] = field(default_factory=dict)
    lines: Sequence[int] | None = None
    Ts: float | None = None
    counts_per_rev: float | None = None
    Ts_source: str = "the header"
    notes: tuple[str, ...] = ()
    moments: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.columns)

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __len__(self) -> int:
        return len(self.columns)

    def __repr__(self) -> str:
        return f"Table({self.path.name!r}: {', '.join(self.names)})"

    def resolve(self, name: str) -> str:
        """The column's own name for `name`, which can also be the whole header (`u [V]`)."""
        name = printable(name)
        for candidate in (name, split_unit(name)[0]):
            if candidate in self.columns:
                return candidate
            if candidate in self.unusable:
                raise DataError(f"{self.path}: {self.unusable[candidate]}")
        raise DataError(
            name=str(self.path), expected=f"a column {name!r}", received="none",
            remedy=self._hint(name),
        )  # fmt: skip

    def _hint(self, name: str) -> str:
        shown = ", ".join(self.names[:30]) + (", ..." if len(self) > 30 else "")
        lower = {n.lower(): n for n in self.names}
        close = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.6)
        guess = f" did you mean {lower[close[0]]!r}?" if close else ""
        return f"available: {shown or 'none'}.{guess}"

    def __getitem__(self, name: str) -> FloatArray:
        return self.columns[self.resolve(name)]

    def unit(self, name: str) -> str:
        """The unit of a column, empty where unknown."""
        return self.units.get(self.resolve(name), "")

    def row(self, k: int) -> str:
        """The place of sample `k` in the file, for messages."""
        return f"sample {k} (0-based)" if self.lines is None else f"line {self.lines[k]}"


def split_units(headers: Sequence[str]) -> tuple[list[str], list[str]]:
    """Names and units of a header row; a name that would then occur twice keeps its unit."""
    headers = [printable(h.strip()) for h in headers]
    pairs = [split_unit(h) for h in headers]
    bare = [name for name, _ in pairs]
    names = [n if bare.count(n) == 1 else h.strip() for n, h in zip(bare, headers, strict=True)]
    return names, [unit or unit_in_name(name)[1] for name, unit in pairs]


def from_headers(
    path: Path,
    headers: Sequence[str],
    columns: Sequence[FloatArray],
    bad: Mapping[int, str],
    lines: Sequence[int] | None = None,
) -> Table:
    """A table from a header row; `bad` holds the reason for each column that cannot be used.
    A column that occurs twice with the same header and values (some loggers repeat the time) is
    used once.
    """
    names, units = split_units(headers)
    unusable = {
        n: f"the header {n!r} occurs more than once, with other values; rename one"
        for n in dict.fromkeys(n for n in names if names.count(n) > 1)
        if not _all_equal([c for name, c in zip(names, columns, strict=True) if name == n])
    }
    unusable |= {names[i]: reason for i, reason in bad.items()}
    used = {n: c for n, c in zip(names, columns, strict=True) if n and n not in unusable}
    if not used and unusable:
        raise DataError(f"{path}: {next(iter(unusable.values()))}")
    known = {n: u for n, u in zip(names, units, strict=True) if u and n in used}
    return Table(path, {n: freeze(c) for n, c in used.items()}, known, unusable, lines)


def _all_equal(columns: Sequence[FloatArray]) -> bool:
    return all(np.array_equal(columns[0], other, equal_nan=True) for other in columns[1:])


def freeze(values: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> FloatArray:
    """A read-only contiguous float64 copy."""
    with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file becomes a quiet one
        array = np.array(values, dtype=np.float64, order="C")
    array.flags.writeable = False
    return array


# --- Arrays with a label for each element, such as the joints of a robot: columns `field.LABEL` ---


def label(name: str) -> str:
    """A joint's name without the dots and slashes that part the names of columns."""
    return printable(name.removesuffix(".pos")).replace(".", "_").replace("/", "_")


def labels_of(fields: Mapping[str, Any]) -> tuple[str, ...]:
    """The labels that a message has for its arrays, in `name`, `names` or `joint_names`."""
    for key in ("name", "names", "joint_names"):
        found = fields.get(key)
        if isinstance(found, (list, tuple)) and found and all(isinstance(n, str) for n in found):
            return tuple(map(label, found))
    return ()


# --- Files of named arrays (.mat, HDF5, .npz) -> Table --------------------------------------------


_MAX_DEPTH = 16
Value: TypeAlias = Any
"""An array, a mapping of field to value (a struct) or a list of values (struct array, cell)."""


def read_npz(path: Path, raw: bytes) -> Table:
    """Read the arrays of an `.npz` archive; pickled objects are never loaded.
    An archive can unpack to a thousand times its size. The claimed sizes of its members are
    therefore checked before any is unpacked, and a member never yields more than it claims.
    """
    # bytes: 64 columns of two million samples
    max_unpacked = 1 << 30
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as archive:
            claimed = sum(member.file_size for member in archive.zip.infolist())
            if claimed > max_unpacked:
                raise DataError(
                    f"{path}: expected arrays of at most {max_unpacked >> 20} MB in all, received "
                    f"{claimed >> 20} MB; save the columns that are needed, or a part of the time"
                )
            return _table(path, {name: _npz_member(archive, name) for name in archive.files})
    except DataError:
        raise
    except Exception as e:
        raise DataError(f"{path}: expected an .npz archive, but it cannot be read: {e}") from e


def _npz_member(archive: Any, name: str) -> Value:
    try:
        return archive[name]
    except ValueError as e:
        if "allow_pickle" in str(e):
            return "Python objects"
        raise


def read_mat(path: Path, raw: bytes) -> Table:
    """Read a MATLAB file of version 4, 5 (SciPy) or 7.3 (HDF5, h5py).
    Row and column vectors both become columns. A matrix of shape (N, n) with n <= N gives `NAME.0`
    to `NAME.n-1`, a struct `NAME.FIELD`, struct arrays and cells `NAME.0`, `NAME.1`, all 0-based.
    """
    hdf5 = b"\x89HDF\r\n\x1a\n"
    is_hdf5 = raw.startswith(hdf5) or raw[512:520] == hdf5
    try:
        return _table(path, _hdf5_values(raw) if is_hdf5 else _mat5_values(raw))
    except (DataError, SettingError):
        raise
    except Exception as e:
        # a damaged file can make the parsers raise anything
        raise DataError(f"{path}: expected a MATLAB file, but it cannot be read: {e}") from e


def _mat5_values(raw: bytes) -> dict[str, Value]:
    try:
        from scipy.io import loadmat
    except ImportError as e:
        raise _missing_extra("scipy") from e
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = loadmat(io.BytesIO(raw))
    return {name: _plain(v) for name, v in found.items() if not name.startswith("__")}


def _plain(value: Any) -> Value:
    """SciPy's structs and cells as mappings and lists."""
    names = getattr(getattr(value, "dtype", None), "names", None)
    if names:
        items = [{n: _plain(item[n]) for n in names} for item in np.atleast_1d(value).ravel()]
        return items[0] if len(items) == 1 else items
    if isinstance(value, np.ndarray) and value.dtype == object:
        return [_plain(item) for item in value.ravel()]
    return value


def _hdf5_values(raw: bytes) -> dict[str, Value]:
    try:
        import h5py
    except ImportError as e:
        raise _missing_extra("h5py") from e
    with h5py.File(io.BytesIO(raw), "r") as file:
        return {n: _hdf5_value(h5py, file, v, 0) for n, v in file.items() if n != "#refs#"}


def _hdf5_value(h5py: Any, file: Any, item: Any, depth: int) -> Value:
    if depth > _MAX_DEPTH:
        return "nested too deeply"
    if isinstance(item, h5py.Group):
        return _struct({n: _hdf5_value(h5py, file, v, depth + 1) for n, v in item.items()})
    matlab = item.attrs.get("MATLAB_class")
    if matlab == b"char":
        return "text"
    if "MATLAB_empty" in item.attrs:
        return np.empty(0)
    if h5py.check_dtype(ref=item.dtype) is not None:
        flat = np.asarray(item[()]).T.ravel(order="F")
        return [_hdf5_value(h5py, file, file[r], depth + 1) for r in flat]
    array = np.asarray(item[()])
    # MATLAB writes its column-major arrays with the dimensions reversed; other programs do not
    return array.T if matlab is not None else array


def _struct(fields: dict[str, Value]) -> Value:
    """A struct, or a struct array where all fields are lists of one length."""
    lengths = {len(v) if isinstance(v, list) else -1 for v in fields.values()}
    if len(lengths) != 1 or lengths == {-1}:
        return fields
    return [{n: v[k] for n, v in fields.items()} for k in range(lengths.pop())]


def _missing_extra(module: str) -> SettingError:
    return not_installed(module, "this .mat file", "sewfast[mat]")


def _table(path: Path, values: Mapping[str, Value]) -> Table:
    columns: dict[str, Any] = {}
    unusable: dict[str, str] = {}
    stated: dict[str, float] = {}
    texts = {
        n: v.tolist() for n, v in values.items() if getattr(v, "dtype", np.dtype("f8")).kind == "U"
    }
    labels = labels_of(texts)
    for name, value in values.items():
        _flatten(printable(name), value, columns, unusable, stated, 0, labels)
    if len(columns) > MAX_COLUMNS:
        raise DataError(f"{path}: expected at most {MAX_COLUMNS} columns, received {len(columns)}")
    if not columns:
        reason = next(iter(unusable.values()), "it is empty")
        raise DataError(
            f"{path}: expected variables with series of numbers, received none; {reason}"
        )
    Ts, source = _period(stated)
    return Table(
        path, {n: freeze(c) for n, c in columns.items()}, {}, unusable, Ts=Ts, Ts_source=source
    )


_PERIODS = ("ts", "dt", "t_s", "sample_time", "sampletime", "sampling_time")
_RATES = ("fs", "f_s", "sample_rate", "samplerate", "sampling_rate")


def _period(stated: Mapping[str, float]) -> tuple[float | None, str]:
    """The sample time [s] on which the file's scalar variables agree, and which states it."""
    found = {}
    for name, value in stated.items():
        last = name.rsplit(".", 1)[-1].lower()
        if math.isfinite(value) and value > 0.0 and last in (*_PERIODS, *_RATES):
            period = value if last in _PERIODS else 1.0 / value
            if 0.0 < period < math.inf:
                found[name] = period
    agree = found and max(found.values()) <= 1.01 * min(found.values())
    name = next(iter(found), "")
    return (found[name], f"variable {name!r}") if agree else (None, "the header")


def _flatten(
    name: str,
    value: Value,
    columns: dict[str, Any],
    unusable: dict[str, str],
    stated: dict[str, float],
    depth: int,
    labels: Sequence[str] = (),
) -> None:
    if isinstance(value, (dict, list)) and depth <= _MAX_DEPTH:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in items:
            _flatten(printable(f"{name}.{key}"), item, columns, unusable, stated, depth + 1)
        return
    name, reason = printable(name), _reason(value)
    if reason == "a single number":
        stated[name] = float(value.ravel()[0])
    if reason is not None:
        unusable[name] = f"variable {name!r} is {reason}; expected a series of real numbers"
    elif value.ndim == 1 or 1 in value.shape:
        columns[name] = value.ravel()
    else:
        known = labels if len(labels) == value.shape[1] else range(value.shape[1])
        columns.update({f"{name}.{k}": column for k, column in zip(known, value.T, strict=True)})
        unusable[name] = (
            f"variable {name!r} is a matrix of shape {value.shape}; name one of its columns, "
            f"{name}.0 to {name}.{value.shape[1] - 1}"
        )


def _reason(value: Value) -> str | None:
    """Why a value is not a column or a matrix of columns; None where it is."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        kind = "complex" if getattr(value, "dtype", np.dtype("U1")).kind == "c" else "not numeric"
        return kind
    if value.size <= 1:
        return "empty" if value.size == 0 else "a single number"
    if value.ndim > 2:
        return f"an array of shape {value.shape}"
    if value.ndim == 2 and 1 not in value.shape and value.shape[0] < value.shape[1]:
        return (
            f"a matrix of shape {value.shape} with time along its rows (nothing is transposed by "
            "guess; store it with one column per signal)"
        )
    return None
