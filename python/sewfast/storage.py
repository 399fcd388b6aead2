"""Files: written whole or not at all; JSON, read strictly and field by field; tables of columns."""

from __future__ import annotations

import csv
import errno
import io
import json
import logging
import math
import os
import re
import secrets
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import FloatArray, labelled
from .errors import DataError, ModelFileError, SettingError, not_installed, unreadable, unwritable
from .written import staged as note

LOG = logging.getLogger(__package__)

# --- Atomic writing -------------------------------------------------------------------------------


def replace_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write `content` to a temporary file in the same folder, then rename it to `path`.
    Raises `OSError` if the folder is not writable, or if `path` is a folder, a device or a pipe,
    which must not be replaced; nothing is left behind.
    """
    replace_files({path: content})


def replace_files(contents: Mapping[Any, bytes]) -> None:
    """Write several files together: none is renamed before the last one is written. Raises
    `OSError` as `replace_file`, with the name of the file that failed; then no file is changed.
    """
    staged: list[tuple[Path, Path]] = []
    try:
        for path, content in contents.items():
            try:
                staged.append(_names(path))
                with staged[-1][0].open("xb") as file:
                    note(*staged[-1], file.fileno())
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                raise OSError(error.errno, error.strerror, os.fspath(path)) from error
        for temporary, target in staged:
            temporary.replace(target)
            LOG.debug("%s: written", target)
    finally:
        for temporary, _ in staged:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)


def _names(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """A free temporary name in the folder of a file, and the file's final name."""
    if "\0" in os.fspath(path):
        raise OSError(errno.EINVAL, "a name cannot hold the character 0")
    target = Path(path).resolve()
    if target.is_dir():
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR))
    if target.exists() and not target.is_file():
        raise OSError(errno.EINVAL, "what has that name is no file")
    return target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp"), target


# --- JSON files of the package --------------------------------------------------------------------


LARGEST_FILE = 16 * 1024 * 1024
"""Most bytes of a file: the package writes none that is larger."""


def write(
    path: str | os.PathLike[str], format: str, version: int, payload: Mapping[str, Any]
) -> None:
    """Write ``payload`` (JSON values) under its ``format`` and ``version``, which :func:`read`
    checks; the file is either complete or absent. An existing file is replaced in one step. Raises
    `ModelFileError` if a number is not finite or a value is no JSON value, or the folder is not
    writable.
    """
    try:
        document = {"format": format, "version": version, **payload}
        text = json.dumps(document, allow_nan=False, indent=1) + "\n"
    except (TypeError, ValueError) as error:
        raise ModelFileError(
            f"{path}: expected finite numbers, text, lists and dicts to save, got {error}"
        ) from error
    replace(path, text)


def replace(path: str | os.PathLike[str], content: str | bytes) -> None:
    """As :func:`replace_file`, with an error that has a remedy: `ModelFileError`."""
    try:
        replace_file(path, content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise unwritable(ModelFileError, path, error) from error


def read(path: str | os.PathLike[str], format: str, versions: Collection[int]) -> dict[str, Any]:
    """Read a document of a known format and version, without its ``format``; nothing in it is
    executed. Raises `ModelFileError` if the file is missing, larger than 16 MB or not JSON,
    contains a number that is not finite or a key twice, or has another format or an unknown
    version.
    """
    document = _parse(path, _text(path))
    if not isinstance(document, dict):
        raise ModelFileError(
            f"{path}: expected a JSON object of format {format!r}, got {type(document).__name__}; "
            "give a file that sewfast has written"
        )
    received = document.pop("format", None)
    if received != format:
        raise ModelFileError(
            f"{path}: expected a file of format {format!r}, got {received!r}; give one that "
            "sewfast has written in this format"
        )
    version = document.get("version")
    # True == 1 and 1.0 == 1, yet neither is a version.
    if type(version) is not int or version not in versions:
        known = ", ".join(str(v) for v in sorted(versions))
        raise ModelFileError(
            f"{path}: expected version {known} of {format!r}, got {version!r}; "
            "a newer sewfast may be able to read it"
        )
    return document


def format_of(path: str | os.PathLike[str]) -> str:
    """The format stated in a file; empty if it is not a JSON document with one."""
    try:
        document = _parse(path, _text(path))
    except ModelFileError:
        return ""
    found = document.get("format") if isinstance(document, dict) else None
    return found if isinstance(found, str) else ""


def _text(path: str | os.PathLike[str]) -> str:
    try:
        with Path(path).open("rb") as file:
            data = file.read(LARGEST_FILE + 1)
    except (OSError, ValueError) as error:
        # open raises a ValueError for a name with the character 0
        raise unreadable(ModelFileError, path, error) from error
    if len(data) > LARGEST_FILE:
        raise ModelFileError(f"{path}: expected a file of at most 16 MB, got a larger one")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ModelFileError(
            f"{path}: expected UTF-8 text, got binary data; the file is damaged"
        ) from error


def _parse(path: str | os.PathLike[str], text: str) -> Any:
    if text.lstrip()[:1] not in ("", "{", "["):
        raise ModelFileError(
            name=str(path), expected="a file that sewfast has written (JSON)",
            received="one of another kind",
            remedy="of a recording, sewfast identify makes a model, and sewfast tune a controller "
            "of a model",
        )  # fmt: skip
    try:
        return json.loads(
            text,
            parse_constant=_refuse_constant,
            parse_float=_finite,
            object_pairs_hook=_without_repetition,
        )
    except (ValueError, RecursionError) as error:
        raise ModelFileError(
            f"{path}: expected a complete JSON file, got a damaged one ({error}); save it again"
        ) from error


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a finite number")


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"{digits} is beyond the range of float64")
    return value


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    if len(set(keys)) < len(keys):
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} occurs twice")
    return dict(pairs)


# --- Fields of a JSON object, each refused by name ------------------------------------------------


@dataclass(frozen=True)
class Fields:
    """Typed access to `values`; `place` is the path of the object within the file."""

    path: str
    values: Mapping[str, Any]
    place: str = ""

    def refuse(self, name: str, expected: str, received: object) -> ModelFileError:
        shown = repr(received)
        shown = shown if len(shown) <= 60 else shown[:57] + "..."
        return ModelFileError(
            f"{self.path}: field {self.place + name!r}: expected {expected}, received {shown}; the "
            "file is damaged or was edited"
        )

    def require_only(self, known: Collection[str]) -> None:
        """Raise if a field is missing or unknown."""
        for name in self.values:
            if name not in known:
                raise self.refuse(name, f"one of {', '.join(known)}", self.values[name])
        for name in known:
            self.any(name)

    def any(self, name: str) -> Any:
        if name not in self.values:
            raise ModelFileError(
                name=f"{self.path}: field {self.place + name!r}", expected="a value",
                received="none", remedy="the file is damaged",
            )  # fmt: skip
        return self.values[name]

    def text(self, name: str) -> str:
        value = self.any(name)
        if not isinstance(value, str):
            raise self.refuse(name, "text", value)
        return value

    def flag(self, name: str) -> bool:
        value = self.any(name)
        if not isinstance(value, bool):
            raise self.refuse(name, "true or false", value)
        return value

    def integer(self, name: str) -> int:
        value = self.any(name)
        if type(value) is not int or not 0 <= value <= 1_000_000:
            raise self.refuse(name, "a whole number from 0 to 1,000,000", value)
        return value

    def number(self, name: str) -> float:
        return self._float(name, self.any(name))

    def optional_number(self, name: str) -> float | None:
        return None if self.any(name) is None else self.number(name)

    def positive(self, name: str) -> float:
        value = self.number(name)
        if value <= 0:
            raise self.refuse(name, "a positive number", value)
        return value

    def vector(self, name: str) -> FloatArray:
        return np.array([self._float(name, v) for v in self.items(name)], dtype=np.float64)

    def matrix(self, name: str) -> FloatArray:
        rows = self.items(name)
        if not rows or not all(isinstance(r, list) and len(r) == len(rows[0]) for r in rows):
            raise self.refuse(name, "rows of numbers of one length", rows)
        return np.array([[self._float(name, v) for v in r] for r in rows], dtype=np.float64)

    def items(self, name: str) -> list[Any]:
        value = self.any(name)
        if not isinstance(value, list):
            raise self.refuse(name, "a list", value)
        return value

    def object(self, name: str) -> Fields:
        return self.nested(name, self.any(name))

    def objects(self, name: str) -> list[Fields]:
        return [self.nested(f"{name}[{i}]", v) for i, v in enumerate(self.items(name))]

    def nested(self, name: str, value: Any) -> Fields:
        if not isinstance(value, dict):
            raise self.refuse(name, "an object", value)
        return Fields(self.path, value, f"{self.place}{name}.")

    def _float(self, name: str, value: Any) -> float:
        if type(value) not in (int, float):
            raise self.refuse(name, "a number", value)
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.refuse(name, "a finite number", value)
        return number


def entries(shapes: Mapping[str, tuple[int, ...]]) -> tuple[str, ...]:
    """The name of every entry of matrices stored one after the other, row by row."""
    return tuple(
        name + (f"[{','.join(map(str, index))}]" if index else "")
        for name, shape in shapes.items()
        for index in np.ndindex(*shape)
    )


# --- Tables: named columns as CSV, `.npz`, `.mat` or Parquet --------------------------------------


_Columns = dict[str, NDArray[Any]]


def write_table(
    path: str | os.PathLike[str],
    columns: Mapping[str, ArrayLike],
    *,
    units: Mapping[str, str] | None = None,
) -> None:
    """Write columns of one length to a file, in the format given by its extension.

    Every float reads back to the same bits. A column `t` comes first.

    Parameters
    ----------
    path : path
        `.csv`, `.npz`, `.mat` or `.parquet`; an existing file is replaced in one step.
    columns : mapping of name to array of shape (N,)
    units : mapping of name to text, optional
        Put into the headers of CSV and Parquet as `name [unit]`.

    Raises
    ------
    DataError
        If columns differ in length or shape, or the file cannot be written.
    SettingError
        If the extension is unknown or its package is not installed.
    """
    path = Path(path)
    encode = _ENCODERS.get(path.suffix.lower())
    if encode is None:
        raise SettingError(
            f"{path}: expected a file ending in {', '.join(_ENCODERS)}; received {path.suffix!r}"
        )
    write_bytes(path, encode(_checked(path, columns), units or {}))


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write `content` to a file: under a temporary name beside it, renamed once it is complete.
    Raises `DataError` if the folder does not exist or cannot be written to.
    """
    try:
        replace_file(path, content)
    except OSError as e:
        raise unwritable(DataError, path, e) from e


def _checked(path: Path, columns: Mapping[str, ArrayLike]) -> _Columns:
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    shapes = {name: a.shape for name, a in arrays.items()}
    if not arrays or any(a.ndim != 1 for a in arrays.values()) or len(set(shapes.values())) > 1:
        raise DataError(f"{path}: expected columns of one shape (N,), received {shapes}")
    if wrong := [n for n, a in arrays.items() if a.dtype.kind not in "biuf"]:
        raise DataError(f"{path}: expected real numbers in column {wrong[0]!r}")
    return {n: arrays[n] for n in sorted(arrays, key=lambda n: n != "t")}


def _csv(columns: _Columns, units: Mapping[str, str]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([labelled(n, units.get(n, "")) for n in columns])
    # Python's repr of a float is the shortest text that reads back to the same bits
    rows = zip(*(map(repr, c.tolist()) for c in columns.values()), strict=True)
    writer.writerows(row for row in rows)  # a generator, so that Ctrl-C is heard
    return text.getvalue().encode()


def _npz(columns: _Columns, units: Mapping[str, str]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **columns)  # type: ignore[arg-type]
    return buffer.getvalue()


def _mat(columns: _Columns, units: Mapping[str, str]) -> bytes:
    try:
        from scipy.io import savemat
    except ImportError as e:
        raise not_installed("scipy", "writing .mat", "sewfast[mat]") from e
    for name in columns:
        if re.fullmatch(r"[A-Za-z]\w{0,30}", name, re.ASCII) is None:
            raise DataError(
                name=f"column {name!r}",
                expected="a name of letters, digits and _, at most 31 long, that starts with a "
                "letter, as MATLAB has them",
                received="another", remedy="rename it or write CSV",
            )  # fmt: skip
    buffer = io.BytesIO()
    savemat(buffer, columns, oned_as="column")
    return buffer.getvalue()


def _parquet(columns: _Columns, units: Mapping[str, str]) -> bytes:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as e:
        raise not_installed("pyarrow", "writing Parquet", "sewfast[parquet]") from e
    buffer = io.BytesIO()
    pq.write_table(pa.table({labelled(n, units.get(n, "")): c for n, c in columns.items()}), buffer)
    return buffer.getvalue()


_ENCODERS: dict[str, Callable[[_Columns, Mapping[str, str]], bytes]] = {
    ".csv": _csv,
    ".npz": _npz,
    ".mat": _mat,
    ".parquet": _parquet,
}
