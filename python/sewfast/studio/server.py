"""The studio's server: one page and one socket, for browsers here that hold the token."""

from __future__ import annotations

import contextlib
import errno
import hmac
import json
import logging
import math
import queue
import secrets
import struct
import threading
import time
from collections.abc import Callable, Mapping
from importlib.resources import files
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import Interrupted, SettingError
from .bench import said
from .commissioning import Commission
from .driving import checked_recording
from .line import Line
from .messages import checked
from .project import CONTROLLER_FORMAT, Project, Step, checked_name

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
WRITES = (
    "identify", "commission", "cancel", "tune_search", "tune_save", "drive_connect",
    "drive_disconnect", "drive_limits", "drive_arm", "drive_disarm", "drive_clear", "drive_go",
    "drive_record", "drive_run", "drive_commission",
)  # fmt: skip
"""What only the page that holds the control can ask for; a stop may come from any."""

BEAT = 0.1
"""Seconds between two questions whether the page that holds the control is there."""

PROMPT, ROW = 0.15, 10
"""A drive is armed for a page that has answered so many times in a row within so many seconds."""

MOST_UNANSWERED = 20
"""Questions to a page that does not answer, which are then no longer put."""

PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/studio.js": ("studio.js", "text/javascript; charset=utf-8"),
    "/curves.js": ("curves.js", "text/javascript; charset=utf-8"),
    "/commission.js": ("commission.js", "text/javascript; charset=utf-8"),
    "/copies.js": ("copies.js", "text/javascript; charset=utf-8"),
    "/tune.js": ("tune.js", "text/javascript; charset=utf-8"),
    "/drive.js": ("drive.js", "text/javascript; charset=utf-8"),
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


class _Page:
    """A page that has given its token.

    What is said to it and what it asks for each have a thread of their own, so that a page that
    takes nothing more holds up nobody, and a long question of a page not its STOP.
    """

    def __init__(
        self, connection: ServerConnection, answer: Callable[[_Page, str | bytes], object]
    ) -> None:
        self.connection = connection
        self._says: queue.SimpleQueue[str | bytes | None] = queue.SimpleQueue()
        self._asks: queue.SimpleQueue[str | bytes | None] = queue.SimpleQueue()
        self._answer = answer
        self._beats: dict[int, float] = {}
        self._beat = 0
        #: Questions in a row that it has answered promptly.
        self.prompt = 0
        for run in (self._speak, self._work):
            threading.Thread(target=run, daemon=True).start()

    def say(self, message: str | bytes) -> None:
        self._says.put(message)

    def ask(self, message: str | bytes) -> None:
        self._asks.put(message)

    def end(self) -> None:
        self._says.put(None)
        self._asks.put(None)

    def _speak(self) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            while (message := self._says.get()) is not None:
                self.connection.send(message)

    def _work(self) -> None:
        while (message := self._asks.get()) is not None:
            self._answer(self, message)

    def beat(self) -> None:
        """Ask whether it is there."""
        now = time.monotonic()
        if len(self._beats) >= MOST_UNANSWERED:
            self.prompt = 0
            oldest = min(self._beats)
            if now - self._beats[oldest] > 10.0:  # it may have lost them, for all that is known
                self._beats.clear()
            return
        self._beat += 1
        self._beats[self._beat] = now
        self.say(_text({"event": "beat", "n": self._beat, "prompt": self.prompt}))

    def answered(self, n: int) -> float | None:
        """Seconds that the answer to a beat took; None where that was not asked."""
        sent = self._beats.pop(n, None)
        if sent is None:
            return None
        took = time.monotonic() - sent
        self.prompt = self.prompt + 1 if took <= PROMPT else 0
        return took


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
        self._pages: set[_Page] = set()
        self._writer: _Page | None = None
        self._line = Line(project.folder, self._tell)
        self._ended = threading.Event()
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
        threading.Thread(target=self._beat, daemon=True).start()
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
        self._ended.set()
        self._line.close()
        with self._lock:
            pages = list(self._pages)
        for page in pages:
            page.connection.close(1001, "the studio has ended")
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
            page = _Page(connection, self._answer)
            with self._lock:
                self._pages.add(page)
                self._writer = self._writer or page
            try:
                self._tell_all()
                page.say(_text(self._line.state))
                for message in connection:
                    if not self._is_done_at_once(page, message):
                        page.ask(message)
            finally:
                with self._lock:
                    self._pages.discard(page)
                    was_writer = self._writer is page
                    self._writer = None if was_writer else self._writer
                if was_writer and self._line.may_move:
                    self._line.stop("the page that held the control was closed")
                page.end()
                self._tell_all()

    def _is_known(self, connection: ServerConnection) -> bool:
        try:
            given = connection.recv(timeout=PATIENCE)
        except TimeoutError:
            return False
        given = given.encode() if isinstance(given, str) else given
        return hmac.compare_digest(given, self.token.encode())

    # --- What a page asks for ---------------------------------------------------------------------

    def _is_done_at_once(self, page: _Page, message: str | bytes) -> bool:
        """Do what must not wait behind anything else; False for what may."""
        # a stop is heard of every page, also where the rest of its message is nonsense
        try:
            asked = json.loads(message)
            name = asked.get("do") if isinstance(asked, dict) else None
        except (ValueError, RecursionError):
            return False
        if name == "stop":
            self._line.stop("STOP on the page")
        elif name not in ("alive", "live"):
            return False
        number = asked.get("id") if isinstance(asked.get("id"), int) else None
        try:
            fields = checked(asked)
            if name == "alive":
                took = page.answered(fields["n"])
                if took is not None and page is self._writer:
                    self._line.alive(took)
                return True
            found = self._line.live(**fields) if name == "live" else (None, {})
            page.say(packed({"id": number, "found": found[0]}, found[1]))
        except Exception as e:
            page.say(_text({"id": number, "error": said(e)}))
        return True

    def _beat(self) -> None:
        """Ask the page that holds the control whether it is there, as long as there is a drive."""
        while not self._ended.wait(BEAT):
            page = self._writer
            if page is not None and self._line.is_connected:
                page.beat()

    def _answer(self, page: _Page, message: str | bytes) -> None:
        number: Any = None
        try:
            asked = json.loads(message)
            if not isinstance(asked, dict):
                raise SettingError("expected an object")
            number = asked.get("id") if isinstance(asked.get("id"), int) else None
            found = self._do(page, asked)
            if isinstance(found, tuple):
                page.say(packed({"id": number, "found": found[0]}, found[1]))
            else:
                page.say(_text({"id": number, "found": found}))
        except Exception as e:
            page.say(_text({"id": number, "error": said(e)}))

    def _do(self, page: _Page, asked: dict[str, Any]) -> Any:
        name = asked.get("do")
        if name in WRITES and self._writer is not page:
            raise SettingError("this page looks on; press 'take control' first")
        fields = checked(asked)
        name = str(name)
        if name == "take":
            with self._lock:
                before, self._writer = self._writer, page
            if before is not page and self._line.may_move:
                self._line.stop("another page has taken the control")
            self._tell_all()
            return None
        if name == "cancel":
            self._cancel.set()
            return None
        if name == "ports":
            return _ports()
        if name.startswith("drive_"):
            return self._drive(page, name.removeprefix("drive_"), fields)
        if name.startswith("tune"):
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

    def _drive(self, page: _Page, name: str, fields: dict[str, Any]) -> Any:
        line = self._line
        if name == "arm" and page.prompt < ROW:
            raise SettingError(
                f"expected {ROW} answers of this page in a row within {PROMPT * 1e3:.0f} ms, "
                f"received {page.prompt}: page or computer are too busy to watch over a motor; "
                "close what is not needed, then arm again"
            )
        if name in ("record", "run", "commission"):
            if "file" in fields:
                place = self.project.folder / checked_recording(fields["file"])
                if place.exists() or place.is_symlink():
                    raise SettingError(
                        f"{fields['file']}: expected a new name, there is such a file; a recording "
                        "of a drive is not replaced"
                    )
            if name == "run":
                self.project.document(fields["controller"], CONTROLLER_FORMAT)
            line.work(name, **fields)
            return None
        return getattr(line, name)(**fields)

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
        heard, stage = -math.inf, ""

        def progress(done: int, total: int, best: float | str) -> None:
            nonlocal heard, stage
            if self._cancel.is_set():
                raise _Cancelled
            before, stage = stage, str(best).split(" ")[0] if isinstance(best, str) else ""
            if stage != before or time.monotonic() - heard > BETWEEN_REPORTS:
                heard = time.monotonic()
                self._tell(
                    {"event": "progress", "of": event, "done": done, "total": total, "best": best}
                )

        found: dict[str, Any]
        try:
            found = {"found": work(progress)}
        except (KeyboardInterrupt, Interrupted):  # whoever passes it on makes one of the two of it
            found = {"error": "cancelled; nothing was written"}
        except Exception as e:
            found = {"error": said(e)}
        self._tell({"event": event, **found})
        self._tell_all()

    def _tell_all(self) -> None:
        """The state, to every page; each hears whether it holds the control."""
        state = self.project.state()
        with self._lock:
            pages, writer = list(self._pages), self._writer
        for page in pages:
            told = {**state, "writes": page is writer, "pages": len(pages)}
            page.say(_text({"event": "state", **told}))

    def _tell(self, event: dict[str, Any]) -> None:
        with self._lock:
            pages = list(self._pages)
        text = _text(event)
        for page in pages:
            page.say(text)
        if event["event"] == "driven":
            self._tell_all()  # there may be another file


def _ports() -> list[dict[str, str]]:
    """The serial ports of this computer; without pyserial none are known."""
    from ..link.ports import list_ports

    try:
        return [{"path": p.path, "text": p.problem or p.description} for p in list_ports()]
    except SettingError:
        return []


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


def packed(head: dict[str, Any], curves: Mapping[str, FloatArray]) -> bytes:
    """A message with curves: length of the head, head as JSON, then every curve in float32.

    The head's `curves` are names and lengths in order; it is padded so that a browser can lay an
    array over the rest.
    """
    names = [[name, len(values)] for name, values in curves.items()]
    text = _text({**head, "curves": names}).encode()
    text += b" " * (-len(text) % 4)
    rows = [np.asarray(values, dtype="<f4").tobytes() for values in curves.values()]
    return b"".join([struct.pack("<I", len(text)), text, *rows])


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
