"""The studio's server: one page and one socket, for browsers here that hold the token."""

from __future__ import annotations

import contextlib
import errno
import hmac
import json
import logging
import math
import secrets
import threading
from collections.abc import Mapping
from importlib.resources import files
from types import TracebackType
from typing import TYPE_CHECKING, Any

from ..errors import SettingError, SewfastError
from .project import Project, Step

if TYPE_CHECKING:
    from websockets.http11 import Request, Response
    from websockets.sync.server import ServerConnection

ADDRESS = "127.0.0.1"
LARGEST_MESSAGE = 64 * 1024
PATIENCE = 5.0
"""Seconds that a socket has for its token."""

PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/studio.js": ("studio.js", "text/javascript; charset=utf-8"),
    "/curves.js": ("curves.js", "text/javascript; charset=utf-8"),
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


class _Cancelled(Exception):
    """Raised out of a job's progress."""


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
                server_header=None, compression=None, logger=silent,
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
        """End a running job and every socket."""
        self._cancel.set()
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
                    connection.send(_text(self._answer(connection, message)))
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

    def _answer(self, connection: ServerConnection, message: str | bytes) -> dict[str, Any]:
        number: Any = None
        try:
            asked = json.loads(message)
            if not isinstance(asked, dict):
                raise SettingError("expected an object")
            number = asked.get("id") if isinstance(asked.get("id"), int) else None
            return {"id": number, "found": self._do(connection, asked)}
        except (ValueError, RecursionError, SewfastError, OSError) as e:
            return {"id": number, "error": str(e)}
        except Exception as e:
            return {"id": number, "error": f"a fault in sewfast: {type(e).__name__}: {e}"}

    def _do(self, connection: ServerConnection, asked: dict[str, Any]) -> Any:
        name = asked.get("do")
        if name == "take":
            with self._lock:
                self._writer = connection
            self._tell_all()
            return None
        if name in ("identify", "cancel") and self._writer is not connection:
            raise SettingError("this page looks on; press 'take control' first")
        if name == "cancel":
            self._cancel.set()
            return None
        step = Step.parse(asked)
        if name == "columns":
            return self.project.columns(step)
        if name in ("look", "validate"):
            return {**getattr(self.project, name)(step), **self._copies(step, name)}
        if name == "identify":
            self._start(step)
            return None
        raise SettingError(f"expected a known step, received {str(name)[:40]!r}")

    def _copies(self, step: Step, name: str) -> dict[str, str]:
        return {
            "python": self.project.python(step, name),
            "commands": self.project.commands(step, name),
        }

    def _start(self, step: Step) -> None:
        copies = self._copies(step, "identify")  # refuses wrong columns before work is begun
        with self._lock:
            if self._job is not None and self._job.is_alive():
                raise SettingError("a model is being identified; cancel it or wait for its end")
            self._cancel.clear()
            self._job = threading.Thread(target=self._identify, args=(step, copies))
            self._job.start()

    def _identify(self, step: Step, copies: dict[str, str]) -> None:
        def progress(done: int, total: int, best: float) -> None:
            if self._cancel.is_set():
                raise _Cancelled
            self._tell({"event": "progress", "done": done, "total": total, "best": best})

        found: dict[str, Any]
        try:
            found = {"found": {**self.project.identify(step, progress), **copies}}
        except _Cancelled:
            found = {"error": "cancelled; nothing was written"}
        except (SewfastError, OSError) as e:
            found = {"error": str(e)}
        except Exception as e:
            found = {"error": f"a fault in sewfast: {type(e).__name__}: {e}"}
        self._tell({"event": "identified", **found})
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
