"""The studio's server: one page and one socket, for browsers here that hold the token."""

from __future__ import annotations

import contextlib
import errno
import hmac
import json
import logging
import math
import secrets
import struct
import threading
import time
from collections.abc import Callable, Mapping
from importlib.resources import files
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import Interrupted, SettingError, SewfastError
from .project import Commission, Project, Step, checked_name

if TYPE_CHECKING:
    from websockets.http11 import Request, Response
    from websockets.sync.server import ServerConnection

    from ..dataset import FloatArray

ADDRESS = "127.0.0.1"
LARGEST_MESSAGE = 64 * 1024
PATIENCE = 5.0
"""Seconds that a socket has for its token."""

FAREWELL = 1.0
"""Seconds that a page has to answer the end of its socket."""

BETWEEN_REPORTS = 0.05
"""Seconds between two messages of a job's progress."""
WRITES = ("identify", "commission", "cancel", "tune_search", "tune_save")
"""What only the page that holds the control can ask for."""

PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/studio.js": ("studio.js", "text/javascript; charset=utf-8"),
    "/curves.js": ("curves.js", "text/javascript; charset=utf-8"),
    "/commission.js": ("commission.js", "text/javascript; charset=utf-8"),
    "/copies.js": ("copies.js", "text/javascript; charset=utf-8"),
    "/tune.js": ("tune.js", "text/javascript; charset=utf-8"),
    "/server.js": ("server.js", "text/javascript; charset=utf-8"),
    "/studio.css": ("studio.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
"""Everything that is served: a path is looked up here and never on the disk."""

HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class _Cancelled(KeyboardInterrupt):
    """Raised out of a job's progress; a search then hands over its best so far."""


class Studio:
    """Serves a project; use it in a `with`.

    The token stands in the address's fragment, which a browser never sends; the page gives it in
    the first message of its socket. One page may start steps, all others look on.

    Parameters
    ----------
    project : Project
    port : int
        0 takes a free one.

    Raises
    ------
    SettingError
        Where the extra is missing or the port is taken.
    """

    def __init__(self, project: Project, port: int = 0) -> None:
        try:
            from websockets.sync.server import serve
        except ImportError as e:
            raise SettingError(
                'the studio needs websockets, which is not installed: pip install "sewfast[studio]"'
            ) from e
        if not 0 <= port < 65536:
            raise SettingError(f"port: expected 0 to 65535, received {port}")
        silent = logging.Logger("sewfast.studio")
        silent.addHandler(logging.NullHandler())
        self.project = project
        self.token = secrets.token_urlsafe(32)
        self._pages: set[ServerConnection] = set()
        self._writer: ServerConnection | None = None
        self._lock = threading.RLock()
        self._job: threading.Thread | None = None
        self._cancel = threading.Event()
        try:
            self._server = serve(
                self._talk, ADDRESS, port, process_request=self._admit, max_size=LARGEST_MESSAGE,
                server_header=None, compression=None, close_timeout=FAREWELL, logger=silent,
            )  # fmt: skip
        except OSError as e:
            if e.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
            raise SettingError(
                f"port {port}: expected a free port, received {e.strerror!r}; choose another "
                "with --port, or leave --port out"
            ) from e
        self.port: int = self._server.socket.getsockname()[1]
        self._hosts = {f"{name}:{self.port}" for name in (ADDRESS, "localhost")}

    @property
    def address(self) -> str:
        return f"http://{ADDRESS}:{self.port}/#{self.token}"

    def serve(self) -> None:
        """Serve until `close`, or Ctrl-C."""
        self._server.serve_forever()

    def close(self) -> None:
        """End a running job and every socket, also those of pages that no longer answer."""
        self._cancel.set()
        with self._lock:
            pages = list(self._pages)
        for page in pages:
            page.close(1001, "the studio has ended")
        self._server.shutdown()
        if self._job is not None:
            self._job.join()

    def __enter__(self) -> Studio:
        self._thread = threading.Thread(target=self.serve, daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
        self._thread.join()

    # --- Who is let in ----------------------------------------------------------------------------

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """A page, a refusal, or None: the socket may open.

        The list of hosts keeps out a foreign name that was bound to this address, the list of
        origins a foreign page in the same browser.
        """
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        known = {f"http://{host}" for host in self._hosts}
        if len(hosts) != 1 or hosts[0] not in self._hosts or not set(origins) <= known:
            return _answer(connection, 403, b"refused\n")
        if request.path == "/socket":
            return None if len(origins) == 1 else _answer(connection, 403, b"refused\n")
        if request.path not in PAGE:
            return _answer(connection, 404, b"not found\n")
        name, kind = PAGE[request.path]
        return _answer(connection, 200, (files(__package__) / "page" / name).read_bytes(), kind)

    def _talk(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            if not self._is_known(connection):
                connection.close(1008, "wrong token")
                return
            with self._lock:
                self._pages.add(connection)
                self._writer = self._writer or connection
            try:
                self._tell_all()
                for message in connection:
                    connection.send(self._answer(connection, message))
            finally:
                with self._lock:
                    self._pages.discard(connection)
                    self._writer = None if self._writer is connection else self._writer
                self._tell_all()

    def _is_known(self, connection: ServerConnection) -> bool:
        try:
            given = connection.recv(timeout=PATIENCE)
        except TimeoutError:
            return False
        given = given.encode() if isinstance(given, str) else given
        return hmac.compare_digest(given, self.token.encode())

    # --- What a page asks for ---------------------------------------------------------------------

    def _answer(self, connection: ServerConnection, message: str | bytes) -> str | bytes:
        number: Any = None
        try:
            asked = json.loads(message)
            if not isinstance(asked, dict):
                raise SettingError("expected an object")
            number = asked.get("id") if isinstance(asked.get("id"), int) else None
            found = self._do(connection, asked)
            if isinstance(found, tuple):
                return _packed({"id": number, "found": found[0]}, found[1])
            return _text({"id": number, "found": found})
        except Exception as e:
            return _text({"id": number, "error": _said(e)})

    def _do(self, connection: ServerConnection, asked: dict[str, Any]) -> Any:
        name = asked.get("do")
        if name == "take":
            with self._lock:
                self._writer = connection
            self._tell_all()
            return None
        if name in WRITES and self._writer is not connection:
            raise SettingError("this page looks on; press 'take control' first")
        if name == "cancel":
            self._cancel.set()
            return None
        if isinstance(name, str) and name.startswith("tune"):
            return self._tune(name, asked)
        if name == "commission":
            wanted = Commission.parse(asked)
            self._start("commissioned", lambda report: self.project.commission(wanted, report))
            return None
        step = Step.parse(asked)
        if name == "columns":
            return self.project.columns(step)
        if name in ("look", "validate"):
            return {**getattr(self.project, name)(step), **self._copies(step, name)}
        if name == "identify":
            copies = self._copies(step, "identify")  # refuses wrong columns before work is begun
            self._start(
                "identified", lambda progress: {**self.project.identify(step, progress), **copies}
            )
            return None
        raise SettingError(f"expected a known step, received {str(name)[:40]!r}")

    def _tune(self, name: str, asked: dict[str, Any]) -> Any:
        tuning = self.project.tuning(asked.get("model"), asked.get("controller"))
        values = asked.get("values", {})
        if not isinstance(values, dict):
            raise SettingError("values: expected numbers by name")
        if name == "tune_open":
            return tuning.opened()
        if name == "tune_move":
            return tuning.move(values)
        if name == "tune_costs":
            return {"costs": tuning.costs([{}, values])}
        if name == "tune_search":
            n, seed = (asked.get(name, -1) for name in ("evaluations", "seed"))
            tuning.check_search(n, seed)
            self._start("searched", lambda progress: tuning.search(values, n, seed, progress))
            return None
        file = checked_name(asked.get("file"))
        if name == "tune_save":
            self.project.save_controller(tuning, values, file)
            self._tell_all()
        elif name != "tune_copy":
            raise SettingError(f"expected a known step, received {name[:40]!r}")
        return {"python": tuning.python(values, file), "commands": tuning.commands(values, file)}

    def _copies(self, step: Step, name: str) -> dict[str, str]:
        return {
            "python": self.project.python(step, name),
            "commands": self.project.commands(step, name),
        }

    def _start(self, event: str, work: Callable[[Any], dict[str, Any]]) -> None:
        """Do something long; its result goes to every page as an event."""
        with self._lock:
            if self._job is not None and self._job.is_alive():
                raise SettingError("something else is running; cancel it or wait for its end")
            self._cancel.clear()
            self._job = threading.Thread(target=self._work, args=(event, work))
            self._job.start()

    def _work(self, event: str, work: Callable[[Any], dict[str, Any]]) -> None:
        told, stage = -math.inf, ""

        def progress(done: int, total: int, best: float | str) -> None:
            nonlocal told, stage
            if self._cancel.is_set():
                raise _Cancelled
            before, stage = stage, str(best).split(" ")[0] if isinstance(best, str) else ""
            if stage != before or time.monotonic() - told > BETWEEN_REPORTS:
                told = time.monotonic()
                self._tell(
                    {"event": "progress", "of": event, "done": done, "total": total, "best": best}
                )

        found: dict[str, Any]
        try:
            found = {"found": work(progress)}
        except (KeyboardInterrupt, Interrupted):  # whoever passes it on makes one of the two of it
            found = {"error": "cancelled; nothing was written"}
        except Exception as e:
            found = {"error": _said(e)}
        self._tell({"event": event, **found})
        self._tell_all()

    def _tell_all(self) -> None:
        """The state, to every page; each hears whether it holds the control."""
        state = self.project.state()
        with self._lock:
            pages, writer = list(self._pages), self._writer
        for page in pages:
            _send(page, {"event": "state", **state, "writes": page is writer, "pages": len(pages)})

    def _tell(self, event: dict[str, Any]) -> None:
        with self._lock:
            pages = list(self._pages)
        for page in pages:
            _send(page, event)


def _answer(
    connection: ServerConnection, status: int, body: bytes, kind: str = "text/plain"
) -> Response:
    response = connection.respond(status, "")
    response.body = body
    for name in ("Content-Type", "Content-Length"):
        del response.headers[name]
    written = {"Content-Type": kind, "Content-Length": str(len(body)), **HEADERS}
    for name, value in written.items():
        response.headers[name] = value
    return response


def _said(error: Exception) -> str:
    """What the page is told: a refusal in its own words, a fault with its kind."""
    if isinstance(error, (ValueError, RecursionError, SewfastError, OSError)):
        return str(error)
    return f"a fault in sewfast: {type(error).__name__}: {error}"


def _packed(head: dict[str, Any], curves: Mapping[str, FloatArray]) -> bytes:
    """A message with curves: length of the head, head as JSON, then every curve in float32.

    The head's `curves` are names and lengths in order; it is padded so that a browser can lay an
    array over the rest.
    """
    names = [[name, len(values)] for name, values in curves.items()]
    text = _text({**head, "curves": names}).encode()
    text += b" " * (-len(text) % 4)
    rows = [np.asarray(values, dtype="<f4").tobytes() for values in curves.values()]
    return b"".join([struct.pack("<I", len(text)), text, *rows])


def _send(page: ServerConnection, event: dict[str, Any]) -> None:
    from websockets.exceptions import ConnectionClosed

    with contextlib.suppress(ConnectionClosed):
        page.send(_text(event))


def _text(value: Any) -> str:
    return json.dumps(_finite(value), allow_nan=False)


def _finite(value: Any) -> Any:
    """JSON knows no NaN: null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return value
