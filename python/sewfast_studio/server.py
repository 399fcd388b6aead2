"""The studio's server: one page and one socket, for browsers here that hold the token."""

from __future__ import annotations

import base64
import contextlib
import errno
import hashlib
import hmac
import json
import logging
import secrets
import socket
import threading
import time
from collections.abc import Mapping
from importlib.resources import files
from typing import TYPE_CHECKING, Any, cast
from weakref import WeakSet

from sewfast.errors import SettingError, not_installed

from .driving import checked_recording
from .jobs import Jobs, Steps
from .line import Line
from .project import CONTROLLER_FORMAT, Project, Upload
from .requests import COMMISSIONED
from .session import PROMPT, ROW, Session, checked, packed, to_text
from .words import error_text

if TYPE_CHECKING:
    from websockets.http11 import Request, Response
    from websockets.sync.server import ServerConnection

ADDRESS = "127.0.0.1"
LARGEST_MESSAGE = 64 * 1024
PATIENCE = 5.0
"""Time for a socket to send its token, and of a closing studio for what it still computes [s]."""

FAREWELL = 0.2
"""Time for the pages to confirm the end of their sockets [s]."""

WRITES = (
    "identify", "bode", "commission", "report", "cancel", "tune_search", "tune_front", "tune_save",
    "upload",
    "upload_end", "drive_connect",
    "drive_disconnect", "drive_limits", "drive_arm", "drive_disarm", "drive_clear", "drive_go",
    "drive_record", "drive_run", "drive_commission",
)  # fmt: skip
"""Messages that only the page in control can send; every page can send a stop."""

RESULTS = (
    "identified", "responded", "searched", "traded", "commissioned", "reported", "driven",
)  # fmt: skip
"""Events at the end of a step."""

LONG = ("identify", "bode", "commission", "report", "tune_search", "tune_front")
"""Messages that start a step whose end is an event; why it failed is told to their page alone."""

BEAT = 0.1
"""Time between two heartbeats to the page in control [s]."""

PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/studio.js": ("studio.js", "text/javascript; charset=utf-8"),
    "/curves.js": ("curves.js", "text/javascript; charset=utf-8"),
    "/tell.js": ("tell.js", "text/javascript; charset=utf-8"),
    "/commission.js": ("commission.js", "text/javascript; charset=utf-8"),
    "/bode.js": ("bode.js", "text/javascript; charset=utf-8"),
    "/model.js": ("model.js", "text/javascript; charset=utf-8"),
    "/deploy.js": ("deploy.js", "text/javascript; charset=utf-8"),
    "/data.js": ("data.js", "text/javascript; charset=utf-8"),
    "/look.js": ("look.js", "text/javascript; charset=utf-8"),
    "/copies.js": ("copies.js", "text/javascript; charset=utf-8"),
    "/tune.js": ("tune.js", "text/javascript; charset=utf-8"),
    "/drive.js": ("drive.js", "text/javascript; charset=utf-8"),
    "/server.js": ("server.js", "text/javascript; charset=utf-8"),
    "/studio.css": ("studio.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    "/design.css": ("design.css", "text/css; charset=utf-8"),
}
"""All files that are served: a path is looked up here and never on the disk."""

SHARED = ("design.css",)
"""Files that reports and documentation use as well, from the core."""

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

REPORT = "report.html"
REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'; sandbox allow-scripts"
)
"""Policy for a report, which is a file from an unknown source: it allows only the package's own
script, and the sandbox keeps it from the page's token."""

LARGEST_REPORT = 64 * 2**20
"""Most bytes of a report."""


class Studio:
    """Serves a project; use it in a `with` block.

    The token is in the address's fragment, which a browser never sends; the page sends it as the
    first message of its socket. One page can start steps, all others only watch.

    Parameters
    ----------
    project : Project
    port : int
        0 takes a free one.

    Raises
    ------
    SettingError
        If the extra is missing or the port is taken.
    """

    def __init__(self, project: Project, port: int = 0) -> None:
        try:
            from websockets.sync.server import serve
        except ImportError as e:
            raise not_installed("websockets", "the studio", "sewfast[studio]") from e
        if not 0 <= port < 65536:
            raise SettingError(f"port: expected 0 to 65535, received {port}")
        silent = logging.Logger("sewfast_studio")
        silent.addHandler(logging.NullHandler())
        self.project = project
        self.token = secrets.token_urlsafe(32)
        self._pages: set[Session] = set()
        self._connections: WeakSet[ServerConnection] = WeakSet()
        self._writer: Session | None = None
        self._asker: Session | None = None
        self._since = 0.0
        self._uploads: dict[Session, Upload] = {}
        self._line = Line(project.folder, self._tell)
        self._jobs = Jobs(project.folder, self._tell)
        self._steps = Steps(project, self._jobs)
        self._report = f"/report/{secrets.token_urlsafe(32)}"
        self._ended = threading.Event()
        self._lock = threading.RLock()
        try:
            self._server = serve(
                self._talk, ADDRESS, port, process_request=self._admit, max_size=LARGEST_MESSAGE,
                server_header=None, compression=None, close_timeout=FAREWELL, logger=silent,
                create_connection=cast("type[ServerConnection]", self._connected),
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
        """End a running step and every socket, the motor first; a socket that takes long, as one
        that never said anything or no longer reads, is cut off.
        """
        self._line.release()
        self._jobs.cancel()
        self._ended.set()
        with self._lock:
            pages = list(self._pages)
        for page in pages:
            page.end()
        ending = threading.Thread(target=self._server.shutdown, daemon=True)
        ending.start()
        self._line.close()
        ending.join(FAREWELL)
        for connection in list(self._connections):
            with contextlib.suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)
        end = time.monotonic() + PATIENCE
        ending.join(PATIENCE)
        for page in pages:
            page.wait(max(end - time.monotonic(), 0.0))
        self._jobs.close()

    def __enter__(self) -> Studio:
        self._thread = threading.Thread(target=self.serve, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
        self._thread.join()

    def _connected(self, *given: Any, **options: Any) -> ServerConnection:
        """A socket that was opened, whatever becomes of it."""
        from websockets.sync.server import ServerConnection

        connection = ServerConnection(*given, **options)
        self._connections.add(connection)
        return connection

    # --- Access -----------------------------------------------------------------------------------

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """A page, a refusal, or None to open the socket. The check of the host keeps out foreign
        names bound to this address, the check of the origin foreign pages in the same browser.
        """
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        known = {f"http://{host}" for host in self._hosts}
        if len(hosts) != 1 or hosts[0] not in self._hosts or not set(origins) <= known:
            return _answer(connection, 403, b"refused\n")
        if request.path == "/socket":
            return None if len(origins) == 1 else _answer(connection, 403, b"refused\n")
        if hmac.compare_digest(request.path.encode(), self._report.encode()):
            return self._written_report(connection)
        if request.path not in PAGE:
            return _answer(connection, 404, b"not found\n")
        name, kind = PAGE[request.path]
        place = files("sewfast") if name in SHARED else files(__package__) / "page"
        return _answer(connection, 200, (place / name).read_bytes(), kind)

    def _written_report(self, connection: ServerConnection) -> Response:
        """The report of the project's commissioning; its address is as secret as the token."""
        path = self.project.folder / COMMISSIONED / REPORT
        try:
            inside = path.resolve() == path and path.stat().st_size <= LARGEST_REPORT
            body = path.read_bytes() if inside else b""
        except OSError:
            body = b""
        if not body:
            return _answer(connection, 404, b"not found\n")
        script = (files("sewfast.report") / "templates" / "zoom.js").read_bytes()
        digest = base64.b64encode(hashlib.sha256(script).digest()).decode()
        policy = {"Content-Security-Policy": REPORT_POLICY.format(digest=digest)}
        return _answer(connection, 200, body, "text/html; charset=utf-8", policy)

    def _talk(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            if not self._is_known(connection):
                connection.close(1008, "wrong token")
                return
            page = Session(connection, self._answer)
            with self._lock:
                self._pages.add(page)
                if self._writer is None:
                    self._writer, self._since = page, time.monotonic()
            try:
                self._tell_all()
                page.send(to_text(self._line.state))
                for message in connection:
                    if isinstance(message, bytes) or not self._is_done_at_once(page, message):
                        page.take(message)
            finally:
                with self._lock:
                    self._pages.discard(page)
                    upload = self._uploads.pop(page, None)
                    was_writer = self._writer is page
                    self._writer = None if was_writer else self._writer
                if was_writer and self._line.may_move:
                    self._line.stop("the page in control was closed")
                if upload is not None:
                    upload.abandon()
                page.end()
                if not self._ended.is_set():
                    self._tell_all()

    def _is_known(self, connection: ServerConnection) -> bool:
        try:
            given = connection.recv(timeout=PATIENCE)
        except TimeoutError:
            return False
        given = given.encode() if isinstance(given, str) else given
        return hmac.compare_digest(given, self.token.encode())

    # --- Requests of a page -----------------------------------------------------------------------

    def _is_done_at_once(self, page: Session, message: str | bytes) -> bool:
        """Carry out an urgent message at once; return False for any other."""
        # accept a stop from every page, even if the rest of its message is invalid
        try:
            asked = json.loads(message)
            name = asked.get("do") if isinstance(asked, dict) else None
        except (ValueError, RecursionError):
            return False
        if name == "stop":
            self._line.stop("STOP on the page")
        elif name not in ("alive", "live", "cancel"):
            return False
        number = asked.get("id") if isinstance(asked.get("id"), int) else None
        try:
            fields = self._permitted(page, asked)
            if name == "alive":
                took = page.answered(fields["n"])
                if took is not None and page is self._writer:
                    self._line.alive(took)
                return True
            if name == "cancel":
                self._jobs.cancel()
            found = self._line.live(**fields) if name == "live" else (None, {})
            page.send(packed({"id": number, "found": found[0]}, found[1]))
        except Exception as e:
            page.send(to_text({"id": number, "error": error_text(e)}))
        return True

    def _beat(self) -> None:
        """Send heartbeats to the page in control while a drive is connected."""
        while not self._ended.wait(BEAT):
            page = self._writer
            if page is not None and self._line.is_connected:
                page.beat()

    def _answer(self, page: Session, message: str | bytes) -> None:
        number: Any = None
        try:
            if isinstance(message, bytes):
                self._add_to_upload(page, message)
                return
            asked = json.loads(message)
            if not isinstance(asked, dict):
                raise SettingError("expected an object")
            number = asked.get("id") if isinstance(asked.get("id"), int) else None
            found = self._do(page, asked)
            if isinstance(found, tuple):
                page.send(packed({"id": number, "found": found[0]}, found[1]))
            else:
                page.send(to_text({"id": number, "found": found}))
        except Exception as e:
            page.send(to_text({"id": number, "error": error_text(e)}))

    def _permitted(self, page: Session, asked: dict[str, Any]) -> dict[str, Any]:
        """The fields of a message, checked against its schema and the page's rights."""
        if asked.get("do") in WRITES and self._writer is not page:
            raise SettingError(
                name="page", expected="one in control", received="one that looks on",
                remedy="press 'take control' first",
            )  # fmt: skip
        return checked(asked)

    def _do(self, page: Session, asked: dict[str, Any]) -> Any:
        fields = self._permitted(page, asked)
        name = str(asked["do"])
        if name == "take":
            return self._take(page, **fields)
        if name == "ports":
            return _ports()
        if name.startswith("upload"):
            return self._upload(page, name, fields)
        if name.startswith("drive_"):
            return self._drive(page, name.removeprefix("drive_"), fields)
        found = self._steps.do(name, fields)
        if name in LONG:
            self._asker = page
        if name == "tune_save":
            self._tell_all()
        return found

    def _take(self, page: Session, over: bool = False) -> dict[str, Any] | None:
        """Give a page the control. If another one holds that of a drive, the page is told so first,
        and has to ask again, to take over.
        """
        line = self._line
        with self._lock:
            before = self._writer
            others = before if before is not page else None
            if others is not None and line.is_connected and not (over and page.told is others):
                page.told = others
                return {"held_s": time.monotonic() - self._since, "moves": line.may_move}
            page.told, self._writer, self._since = None, page, time.monotonic()
        if before is not page and line.may_move:
            line.stop("another page has taken control")
        if others is not None:
            others.send(to_text({"event": "lost"}))
        self._tell_all()
        return None

    # --- Uploads ----------------------------------------------------------------------------------

    def _upload(self, page: Session, name: str, fields: dict[str, Any]) -> Any:
        upload = self._uploads.pop(page, None)
        if name == "upload_end":
            if upload is None:
                raise SettingError("expected a file under way, there is none; upload it again")
            file = upload.finish()
            self._tell_all()
            return {"file": file}
        if upload is not None:
            upload.abandon()
        begun = Upload(self.project.folder, **fields)
        with self._lock:
            if is_open := page in self._pages:
                self._uploads[page] = begun
        if not is_open:  # the page was closed meanwhile: nothing else would delete the file
            begun.abandon()
        return None

    def _add_to_upload(self, page: Session, piece: bytes) -> None:
        upload = self._uploads.get(page)
        try:
            if upload is None or page is not self._writer:
                raise SettingError("expected no bytes, as no file is under way; upload it again")
            answer: dict[str, Any] = {"bytes": upload.add(piece)}
        except SettingError as e:
            self._uploads.pop(page, None)
            if upload is not None:
                upload.abandon()
            answer = {"error": str(e)}
        page.send(to_text({"event": "received", **answer}))

    # --- The drive --------------------------------------------------------------------------------

    def _drive(self, page: Session, name: str, fields: dict[str, Any]) -> Any:
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

    def _tell_all(self) -> None:
        """Send the state to every page, with whether it is in control."""
        state = self.project.state()
        with self._lock:
            pages, writer = list(self._pages), self._writer
        for page in pages:
            own = {"writes": page is writer, "pages": len(pages)}
            page.send(to_text({"event": "state", **state, **own}))

    def _tell(self, event: dict[str, Any]) -> None:
        """Send an event to every page; after the result of a long step, also the state.
        The others than the page that asked for a step hear of a failure only that it has ended; if
        that page is closed, or was loaded anew, all are told.
        """
        with self._lock:
            pages = list(self._pages)
        asker = self._asker if self._asker in pages and event["event"] != "driven" else None
        others = to_text({"event": event["event"]}) if asker and "error" in event else None
        if event["event"] == "reported" and "found" in event:
            event["found"]["address"] = self._report
        text = to_text(event)
        for page in pages:
            page.send(text if others is None or page is asker else others)
        if event["event"] in RESULTS:
            self._tell_all()


def _ports() -> list[dict[str, str]]:
    """The serial ports of this computer; none without pyserial."""
    from sewfast.link.ports import list_ports

    try:
        return [{"path": p.path, "text": p.problem or p.description} for p in list_ports()]
    except SettingError:
        return []


def _answer(
    connection: ServerConnection,
    status: int,
    body: bytes,
    kind: str = "text/plain",
    others: Mapping[str, str] | None = None,
) -> Response:
    response = connection.respond(status, "")
    response.body = body
    for name in ("Content-Type", "Content-Length"):
        del response.headers[name]
    written = {"Content-Type": kind, "Content-Length": str(len(body))}
    written |= {**HEADERS, **(others or {})}
    for name, value in written.items():
        response.headers[name] = value
    return response
