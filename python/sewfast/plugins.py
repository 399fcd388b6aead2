"""Plug-ins: what installed packages add by entry points, and what is said where one cannot be used.

A group of entry points is a list in the metadata of the installed packages: `sewfast.readers`
(formats of files), `sewfast.commands` (commands), `sewfast.names` (names of `sewfast`, and of its
unit `link`). Nothing is registered, and nothing is imported before it is asked for.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from .errors import SettingError, SewfastError, printable

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

OWN = "sewfast"
"""The package whose plug-ins are in its own wheel."""


def points(group: str, name: str | None = None) -> tuple[EntryPoint, ...]:
    """The entry points of a group, or those of one name in it, by name."""
    # imported here: it loads parsers for mail and archives, and reads the metadata of all packages
    from importlib.metadata import entry_points

    try:
        found = list(entry_points(group=group))
    except Exception:
        # the metadata of one package are damaged
        found = list(_readable(group))
    found = [point for point in found if name in (None, point.name)]
    return tuple(sorted(found, key=lambda point: point.name))


def _readable(group: str) -> Iterator[EntryPoint]:
    """The entry points of a group that can be read; a package with damaged ones is named."""
    from importlib.metadata import distributions

    seen = set()
    for one in distributions():
        try:
            name = str(one.name).replace("_", "-").lower()
            # of two packages of a name Python imports the one that comes first on its path
            if name not in seen:
                yield from one.entry_points.select(group=group)
            seen.add(name)
        except Exception as e:
            place = getattr(one, "_path", "a package")
            text = f"{place}: expected entry points that can be read, received {told(e)}"
            warnings.warn(f"{text}; install the package again", stacklevel=2)


def are_registered(group: str) -> bool:
    """Whether the plug-ins of the wheel are known; not where only its files were copied."""
    return any(package(point) == OWN for point in points(group))


UNREGISTERED = (
    "the plug-ins of this installation are not registered: install sewfast again (in a checkout: "
    "make dev)"
)


def only(
    found: tuple[EntryPoint, ...], place: str, task: str, remedy: str = "uninstall one"
) -> EntryPoint:
    """The entry point for a task such as `that reads .dlog`; the wheel's cannot be taken over."""
    found = tuple(point for point in found if package(point) == OWN) or found
    if len(found) > 1:
        raise SettingError(
            name=place, expected=f"one installed package {task}",
            received=" and ".join(sorted(map(package, found))), remedy=remedy,
        )  # fmt: skip
    return found[0]


def load(point: EntryPoint, place: str, task: str) -> Any:
    """What an entry point names; `SettingError` if it cannot be imported."""
    try:
        return point.load()
    except SewfastError:
        raise
    except (Exception, SystemExit) as e:
        # importing runs code of another package
        raise unusable(point, place, task, told(e)) from e


def function(point: EntryPoint, place: str, task: str) -> Callable[..., Any]:
    """The function that an entry point names; `SettingError` if there is none."""
    found = load(point, place, task)
    if not callable(found):
        raise unusable(point, place, task, f"{point.value}, a {type(found).__name__}")
    named: Callable[..., Any] = found
    return named


def unusable(point: EntryPoint, place: str, task: str, received: str) -> SettingError:
    name = package(point)
    remedy = f"update {name} and what it needs, or uninstall it"
    return SettingError(
        name=place, expected=f"a part of {name} {task}", received=received,
        remedy=f"install {name} again" if name == OWN else remedy,
    )  # fmt: skip


def told(error: BaseException) -> str:
    """The error of another package in one short line."""
    return f"{type(error).__name__}: {printable(str(error))[:200]}"


def package(point: EntryPoint) -> str:
    """The package of an entry point; without metadata of it, what the point names."""
    try:
        return (point.dist and point.dist.name) or point.value
    except Exception:
        return point.value


NAMES = "sewfast.names"


def public_names() -> list[str]:
    """Names of `sewfast` that plug-ins add, without those of its units (`link.NAME`)."""
    return [point.name for point in points(NAMES) if "." not in point.name]


def public_name(name: str) -> Any:
    """What a plug-in has for a name of `sewfast`, or `AttributeError`, as `hasattr` expects."""
    found = points(NAMES, name)
    if not found:
        hint = "" if are_registered(NAMES) else f"; {UNREGISTERED}"
        raise AttributeError(f"module 'sewfast' has no attribute {name!r}{hint}")
    try:
        place, task = f"sewfast.{name}", "for this name"
        return load(only(found, place, task), place, task)
    except SewfastError as e:
        raise AttributeError(str(e)) from e


def on_first_use(
    package: str, homes: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package whose names and modules are loaded on first use.
    `homes` has the names for each module. A plug-in takes it so that its command can be listed
    without loading what carries it out.
    """
    home_of = {name: home for home, names in homes.items() for name in names.split()}
    own = vars(sys.modules[package])

    def found(name: str) -> Any:
        from importlib import import_module

        if name in homes:
            return import_module(f"{package}.{name}")
        if name not in home_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        own[name] = getattr(import_module(f"{package}.{home_of[name]}"), name)
        return own[name]

    return found, lambda: sorted({*own, *home_of})
