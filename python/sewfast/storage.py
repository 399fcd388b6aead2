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
import stat
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import FloatArray, labelled
from .errors import (
    DataError,
    ModelFileError,
    SettingError,
    SewfastError,
    not_installed,
    printable,
    unreadable,
    unwritable,
)
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
    with _staged(contents) as staged:
        for temporary, target in staged:
            temporary.replace(target)
            LOG.debug("%s: written", target)


def require_writable(path: str | os.PathLike[str], kind: type[SewfastError] = SettingError) -> None:
    """Raise before long work if its result could not be written; a temporary file shows it."""
    try:
        with _staged({path: b"\n"}):
            pass
    except OSError as error:
        raise unwritable(kind, path, error) from error


@contextmanager
def making(folder: Path) -> Iterator[None]:
    """Make a folder and those above it; if the block fails, remove those that are still empty."""
    new = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for place in new:  # inner folders first
            with suppress(OSError):
                place.rmdir()
        raise


@contextmanager
def _staged(contents: Mapping[Any, bytes]) -> Iterator[list[tuple[Path, Path]]]:
    """Temporary files with the contents and the names for them; what is left of them is deleted."""
    staged: list[tuple[Path, Path]] = []
    try:
        for path, content in contents.items():
            try:
                staged.append(names(path))
                with staged[-1][0].open("xb") as file:
                    note(*staged[-1], file.fileno())
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                raise OSError(error.errno, error.strerror, os.fspath(path)) from error
        yield staged
    finally:
        for temporary, _ in staged:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)


def names(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """A free temporary name beside a file, and its final name; `OSError` for a folder or device."""
    if "\0" in os.fspath(path):
        raise OSError(errno.EINVAL, "a name cannot hold the character 0")
    try:
        target = Path(path).resolve()
    except RuntimeError as error:  # a link to itself, before Python 3.13
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP)) from error
    if target.is_dir():
        raise OSError(errno.EISDIR, "a folder")
    if target.exists() and not target.is_file():
        raise OSError(errno.EINVAL, "a pipe or a device")
    return target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp"), target


def file_bytes(
    path: str | os.PathLike[str],
    kind: type[SewfastError] = DataError,
    *,
    most: int = -1,
    largest: float = math.inf,
) -> bytes:
    """The first `most` bytes of a file, by default all. Raises `kind` for what cannot be read or is
    larger than `largest`, and for folders, pipes and devices: these may never end, or never begin.
    """
    try:
        # without O_NONBLOCK, a pipe that nobody writes to could not even be opened
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        with open(path, "rb", opener=lambda name, _: os.open(name, flags)) as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise kind(
                    name=os.fspath(path), expected="a file", received="a pipe or a device",
                    remedy="copy its content to a file first",
                )  # fmt: skip
            if found.st_size > largest:
                raise kind(
                    name=os.fspath(path), expected=f"a file of at most {int(largest) >> 20} MB",
                    received=f"{found.st_size} bytes", remedy="check the name",
                )  # fmt: skip
            return file.read(most)
    except IsADirectoryError:
        raise kind(
            name=os.fspath(path), expected="a file", received="a folder",
            remedy="name a file in it",
        ) from None  # fmt: skip
    except (OSError, ValueError) as error:
        if isinstance(error, SewfastError):
            raise
        # open raises a ValueError for a name with the character 0
        raise unreadable(kind, path, error) from error


# --- JSON files of the package --------------------------------------------------------------------


LARGEST_FILE = 16 * 1024 * 1024
"""Most bytes of a file: the package writes none that is larger."""
LARGEST_NUMBER = 1e150
"""Largest magnitude of a number that something is computed from; the square of it is finite."""


def write(
    path: str | os.PathLike[str], format: str, version: int, payload: Mapping[str, Any]
) -> None:
    """Write ``payload`` (JSON values) under its ``format`` and ``version``, which :func:`read`
    checks; the file is either complete or absent. An existing file is replaced in one step.
    """
    try:
        document = {"format": format, "version": version, **payload}
        text = json.dumps(document, allow_nan=False, indent=1) + "\n"
    except (TypeError, ValueError) as error:
        raise ModelFileError(
            f"{path}: expected finite numbers, text, lists and dicts to save, got {error}"
        ) from error
    replace(path, text)


class Stored:
    """A value with a file: its `to_dict` under a format and a version."""

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int]

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values."""
        raise NotImplementedError

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it as JSON (docs/CONVENTIONS.md, Files); the file is either complete or absent.

        Raises
        ------
        ModelFileError
            If the file cannot be written.
        """
        write(path, self.FORMAT, self.VERSION, self.to_dict())


def replace(path: str | os.PathLike[str], content: str | bytes) -> None:
    """As :func:`replace_file`, with an error that has a remedy: `ModelFileError`."""
    try:
        replace_file(path, content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise unwritable(ModelFileError, path, error) from error


def read(path: str | os.PathLike[str], format: str, versions: Collection[int]) -> dict[str, Any]:
    """Read a document of a known format and version, without its ``format``; nothing in it is
    executed.
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
    data = file_bytes(path, ModelFileError, largest=LARGEST_FILE)
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
        found = json.loads(
            text,
            parse_constant=_refuse_constant,
            parse_float=_finite,
            parse_int=_in_range,
            object_pairs_hook=_without_repetition,
        )
    except (ValueError, RecursionError) as error:
        raise ModelFileError(
            f"{path}: expected a complete JSON file, got a damaged one ({error}); save it again"
        ) from error
    plain = text.isascii() and "\\" not in text and "\x7f" not in text
    return found if plain else with_printable_texts(found)


def with_printable_texts(value: Any) -> Any:
    """The same document with control characters and halves of surrogate pairs as escapes in its
    texts: a file can neither control the terminal nor hold what cannot be printed.
    """
    if isinstance(value, dict):
        return {with_printable_texts(k): with_printable_texts(v) for k, v in value.items()}
    if isinstance(value, list):
        return [with_printable_texts(v) for v in value]
    if isinstance(value, str) and not value.isprintable():
        return "\n".join(printable(line) for line in value.split("\n"))
    return value


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a finite number")


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"{digits} is beyond the range of float64")
    return value


def _in_range(digits: str) -> int:
    # float64 has 309 digits before the point; thousands of them take long to read
    if len(digits) > 310 or not math.isfinite(float(digits)):
        raise ValueError(f"{digits[:20]}... is beyond the range of float64")
    return int(digits)


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

    def take(self, **names: str) -> dict[str, Any]:
        """Fields by name, read by the method that each group is named after: `number="rmse Ts"`."""
        return {
            name: getattr(self, kind)(name) for kind, group in names.items()
            for name in group.split()
        }  # fmt: skip

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

    def conform(self, schema: Mapping[str, Any]) -> None:
        """Raise for the first field that a JSON schema refuses. It knows the keywords `type`,
        `minimum`, `properties`, `required`, `items`, `minItems` and `maxItems`.
        """
        for name in schema.get("required", ()):
            self.any(name)
        for name, inner in schema.get("properties", {}).items():
            if name in self.values:
                self._conform(name, self.values[name], inner)

    def _conform(self, name: str, value: Any, schema: Mapping[str, Any]) -> None:
        kinds = [schema["type"]] if isinstance(schema["type"], str) else schema["type"]
        if type(value) not in [kind for k in kinds for kind in _TYPES[k][1]]:
            raise self.refuse(name, " or ".join(_TYPES[k][0] for k in kinds), value)
        if isinstance(value, dict):
            self.nested(name, value).conform(schema)
        elif isinstance(value, (list, tuple)):
            low, high = schema.get("minItems", 0), schema.get("maxItems", math.inf)
            if not low <= len(value) <= high:
                raise self.refuse(name, f"{low} to {high} entries", value)
            for i, entry in enumerate(value if "items" in schema else ()):
                self._conform(f"{name}[{i}]", entry, schema["items"])
        elif type(value) in (int, float):
            least = schema.get("minimum", -LARGEST_NUMBER)
            if self._float(name, value) < least:
                raise self.refuse(name, f"a number of {least} or more", value)

    def _float(self, name: str, value: Any) -> float:
        if type(value) not in (int, float):
            raise self.refuse(name, "a number", value)
        number = float(value)
        if not abs(number) <= LARGEST_NUMBER:
            raise self.refuse(name, f"a number of at most {LARGEST_NUMBER:g}", value)
        return number


_TYPES: Mapping[str, tuple[str, tuple[type, ...]]] = {
    "number": ("a number", (int, float)),
    "integer": ("a whole number", (int,)),
    "string": ("text", (str,)),
    "array": ("a list", (list, tuple)),
    "object": ("an object", (dict,)),
    "boolean": ("true or false", (bool,)),
    "null": ("null", (type(None),)),
}
"""Types of a JSON schema, in words and as Python has them."""


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
    """Write `content` to a file: under a temporary name beside it, renamed once it is complete."""
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
