"""`Kind`: what a view is and where it is, as the command line names it."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import SettingError

KINDS = ("auto", "terminal", "none", "plotjuggler[:HOST:PORT]", "foxglove[:PORT]")

PLOTJUGGLER_PORT = 9870
FOXGLOVE_PORT = 8765

LOCAL = "127.0.0.1"
"""Where nobody but this machine listens."""


@dataclass(frozen=True)
class Kind:
    """A view by name; streams have an address.

    Attributes
    ----------
    name : str
        `auto`, `terminal`, `none`, `plotjuggler` or `foxglove`.
    host : str
        Where PlotJuggler listens; where the Foxglove server is bound.
    port : int
        Of the stream; 0 for views without one, and for a Foxglove server on any free port.
    """

    name: str
    host: str = ""
    port: int = 0

    @classmethod
    def parse(cls, text: str) -> Kind:
        """`plotjuggler:HOST:PORT` and its like, as in `KINDS`.

        Raises
        ------
        SettingError
            For a text that names no view, or a port outside 1 to 65535 (Foxglove: 0 to 65535).
        """
        if not isinstance(text, str):
            raise _refusal(text)
        name, _, rest = text.partition(":")
        if text in ("auto", "terminal", "none"):
            return cls(text)
        if name == "plotjuggler":
            return cls(name, *_host_and_port(text, rest))
        if name == "foxglove":
            return cls(name, LOCAL, _port(text, rest, 0) if rest else FOXGLOVE_PORT)
        raise _refusal(text)


def _host_and_port(text: str, rest: str) -> tuple[str, int]:
    if not rest:
        return LOCAL, PLOTJUGGLER_PORT
    host, _, port = rest.rpartition(":")
    if not host:
        raise _refusal(text)
    # brackets are how an IPv6 address keeps its colons apart from the port's
    return host.strip("[]"), _port(text, port, 1)


def _port(text: str, port: str, least: int) -> int:
    if not (port.isascii() and port.isdigit() and least <= int(port) <= 65535):
        raise _refusal(text)
    return int(port)


def _refusal(text: str) -> SettingError:
    return SettingError(
        f"expected a live view out of {', '.join(KINDS)}, received {text!r}; for example "
        f"plotjuggler:{LOCAL}:{PLOTJUGGLER_PORT}"
    )
