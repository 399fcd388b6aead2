"""Models, controllers and commissionings that several tests share: made once per build.

`fitted(recipe, *arguments)` calls the recipe once for all workers and keeps what it returns in
`target/fitted`, by the hash of the compiled core, of `python`, of `tests/support` and of
the recipe's file. A test that is about fitting itself does not take its result from here.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import pickle
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import sewfast

try:
    import fcntl
except ImportError:  # Windows: two workers may make the same thing; either is right
    fcntl = None  # type: ignore[assignment]

T = TypeVar("T")
FOLDER = Path(__file__).resolve().parents[2] / "target" / "fitted"
_PRODUCT = sorted(Path(sewfast.__file__).parents[1].glob("sewfast*"))


def fitted(recipe: Callable[..., T], *arguments: object) -> T:
    """What `recipe(*arguments)` returns; made by the first that asks.

    Parameters
    ----------
    recipe : callable
        A function at module level whose result can be pickled and depends on its arguments alone.
    *arguments
        Values whose `repr` says all of them: numbers, text, tuples.
    """
    kept = _place(recipe, arguments).with_suffix(".pickle")
    with _only_one(kept):
        if not kept.exists():
            part = kept.with_suffix(".part")
            part.write_bytes(pickle.dumps(recipe(*arguments)))
            part.replace(kept)
        return pickle.loads(kept.read_bytes())  # type: ignore[no-any-return]


def made(recipe: Callable[..., object], *arguments: object) -> Path:
    """Folder that `recipe(folder, *arguments)` has filled; who changes it takes a copy."""
    kept = _place(recipe, arguments)
    with _only_one(kept):
        if not kept.exists():
            part = kept.with_suffix(".part")
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir()
            recipe(part, *arguments)
            part.replace(kept)
    return kept


def _place(recipe: Callable[..., object], arguments: tuple[object, ...]) -> Path:
    source = Path(inspect.getsourcefile(recipe) or "").read_bytes()
    name = f"{recipe.__qualname__}{arguments!r}"
    key = hashlib.sha256(source + name.encode()).hexdigest()[:24]
    return FOLDER / build() / f"{recipe.__name__}-{key}"


@functools.cache
def build() -> str:
    """Hash of all that a fit may depend on."""
    found = hashlib.sha256()
    # templates, pages and tables as well
    files = (path for folder in _PRODUCT for path in folder.rglob("*"))
    product = [p for p in files if p.is_file() and "__pycache__" not in p.parts]
    for path in sorted([*product, *Path(__file__).parent.glob("*.py")]):
        found.update(str(path.name).encode())
        found.update(path.read_bytes())
    return found.hexdigest()[:24]


@contextlib.contextmanager
def _only_one(kept: Path) -> Iterator[None]:
    """One worker at a time; the first of a build forgets what other builds left a day ago."""
    if not kept.parent.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        for other in FOLDER.iterdir():
            if time.time() - other.stat().st_mtime > 86_400:
                shutil.rmtree(other, ignore_errors=True)
    with kept.with_suffix(".lock").open("w") as held:
        if fcntl is not None:
            fcntl.flock(held, fcntl.LOCK_EX)  # released with the file
        yield
