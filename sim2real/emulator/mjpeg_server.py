"""Pictures as MJPEG streams over HTTP, and short JSON answers beside them."""

import json
import logging
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Protocol
from urllib.parse import parse_qsl

from sim2real.emulator.camera_feed import CameraFeed, Picture
from sim2real.emulator.loopback import check_loopback

BOUNDARY = "frame"
MOST_CONNECTIONS = 32
LARGEST_BODY = 4096  # of a request [bytes]
_REQUEST_TIMEOUT = 10.0  # for a request to come in whole, and for a picture to be taken [s]
_SEND_BUFFER = 1 << 17  # one or two pictures: a slow client skips some instead of falling behind
_FIRST_PICTURE = 3.0  # that a request for one picture waits for it [s]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Answer:
    """A whole HTTP answer."""

    status: int
    body: bytes
    content_type: str = "application/json"
    headers: Mapping[str, str] | None = None

    @classmethod
    def of(cls, value: Any, status: int = 200) -> "Answer":
        """``value`` as JSON."""
        return cls(status, json.dumps(value, allow_nan=False).encode())

    @classmethod
    def wrong(cls, status: int, what: str) -> "Answer":
        return cls.of({"error": what}, status)


class Pages(Protocol):
    """What else is served: answers by path, or None where there is no such page."""

    def get(self, path: str, query: Mapping[str, str]) -> Answer | None:
        """Raises ValueError on a wrong query."""
        ...

    def post(self, path: str, body: Any) -> Answer | None:
        """``body`` is the request's JSON value; raises ValueError on a wrong one."""
        ...


class MjpegServer:
    """Serves ``/<camera>`` as a stream, ``/<camera>.jpg`` as one picture, and other pages.

    Every part of a stream has the headers Content-Type, Content-Length and X-Timestamp: the time
    that the picture shows, CLOCK_MONOTONIC seconds. Clients that are slow skip pictures.

    Args:
        address, port: in 127.0.0.0/8; port 0 takes a free one.
        feeds: the cameras by name.
        pages: the other paths.

    Attributes:
        port: where it listens.

    Raises:
        ValueError: on an address that other machines could reach.
        OSError: if the address is taken.
    """

    def __init__(
        self, address: str, port: int, feeds: Mapping[str, CameraFeed], pages: Pages
    ) -> None:
        check_loopback(address, "address")
        self._feeds = feeds
        self._server = _Server((address, port), feeds, pages)
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.2}, name="http"
        )
        self._thread.daemon = True
        self._thread.start()

    def close(self) -> None:
        """Stops listening and ends all streams."""
        for feed in self._feeds.values():
            feed.close()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 64
    allow_reuse_address = True

    def __init__(
        self, where: tuple[str, int], feeds: Mapping[str, CameraFeed], pages: Pages
    ) -> None:
        self.feeds, self.pages = feeds, pages
        self.free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        super().__init__(where, _Handler)

    def server_bind(self) -> None:
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        # Not HTTPServer's: it would look the address up in the DNS.
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = self.server_address[:2]  # type: ignore[assignment]

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self.free.acquire(blocking=False):
            request.settimeout(0.2)
            with suppress(OSError):
                request.sendall(b"HTTP/1.1 503 Too many connections\r\nContent-Length: 0\r\n\r\n")
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        _log.debug("connection from %s ended", client_address, exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    server: _Server  # type: ignore[assignment]
    protocol_version = "HTTP/1.1"
    server_version = "dlo-world"
    sys_version = ""
    timeout = _REQUEST_TIMEOUT
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?")
        name, feeds = path.removeprefix("/"), self.server.feeds
        if name in feeds:
            self._stream(feeds[name])
        elif name.endswith(".jpg") and name[:-4] in feeds:
            self._answer(lambda: _one_picture(feeds[name[:-4]]))
        else:
            self._answer(lambda: self.server.pages.get(path, dict(parse_qsl(query))))

    def do_POST(self) -> None:
        self.close_connection = True  # what is left of a refused body is not read
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal()):
            self._send(Answer.wrong(411, "Content-Length missing"))
            return
        if len(length) > 9 or int(length) > LARGEST_BODY:
            self._send(Answer.wrong(413, f"at most {LARGEST_BODY} bytes"))
            return
        body = self.rfile.read(int(length))
        self._answer(lambda: self.server.pages.post(self.path, _json_value(body)))

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        # Unknown methods and versions are the client's mistakes.
        super().send_error({501: 405, 505: 400}.get(code, code), message, explain)

    def _answer(self, make: Callable[[], Answer | None]) -> None:
        try:
            answer = make()
        except ValueError as error:
            answer = Answer.wrong(400, str(error))
        self._send(answer or Answer.wrong(404, "no such page"))

    def _send(self, answer: Answer) -> None:
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.content_type)
        self.send_header("Content-Length", str(len(answer.body)))
        self.send_header("Cache-Control", "no-store")
        for name, value in (answer.headers or {}).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(answer.body)

    def _stream(self, feed: CameraFeed) -> None:
        if feed.dropped:
            self._send(Answer.wrong(503, "the camera is gone"))
            return
        self.close_connection = True
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        number = 0
        # An OSError: the client or the camera went away.
        with feed.watched(), suppress(OSError):
            while True:
                picture = feed.newer(number, timeout=1.0)
                if picture is not None:
                    number = picture.number
                    self.wfile.write(_part(picture))
                elif self._client_gone():
                    return

    def _client_gone(self) -> bool:
        """Whether a client, who gets nothing just now, has closed the connection."""
        self.connection.setblocking(False)
        try:
            return self.connection.recv(1, socket.MSG_PEEK) == b""
        except BlockingIOError:
            return False
        finally:
            self.connection.settimeout(self.timeout)

    def log_message(self, format: str, *args: Any) -> None:
        _log.debug(format, *args)


def _part(picture: Picture) -> bytes:
    head = (
        f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture.jpeg)}\r\n"
        f"X-Timestamp: {picture.stamp:.6f}\r\n\r\n"
    )
    return head.encode() + picture.jpeg + b"\r\n"


def _one_picture(feed: CameraFeed) -> Answer:
    try:
        picture = feed.newer(0, timeout=_FIRST_PICTURE)
    except ConnectionError as error:
        return Answer.wrong(503, str(error))
    if picture is None:
        return Answer.wrong(503, "no picture yet")
    stamp = {"X-Timestamp": f"{picture.stamp:.6f}"}
    return Answer(200, picture.jpeg, "image/jpeg", stamp)


def _json_value(body: bytes) -> Any:
    try:
        return json.loads(body)
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"expected JSON: {error}") from error
