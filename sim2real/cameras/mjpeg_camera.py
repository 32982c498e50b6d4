"""A camera that streams JPEGs over HTTP: network cameras, ustreamer, the emulated cell."""

import base64
import http.client
import re
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import BinaryIO, NamedTuple
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_gym.exceptions import DeviceError
from dlo_gym.geometry.camera import CameraModel
from sim2real.cameras.camera import CameraSettings
from sim2real.cameras.capture import (
    CLOCK_TOLERANCE,
    DamagedImageError,
    Shot,
    StreamCamera,
    plausible_stamp,
)

MAX_IMAGE_BYTES = 16 * 2**20
MAX_LINE_BYTES = 4096
MAX_HEADERS = 64
# ustreamer's X-Timestamp is when it sent the image; asked with ``?extra_headers=1`` it also
# tells when it took it.
STAMP_HEADERS = ("x-ustreamer-grab-begin-time", "x-ustreamer-grab-time", "x-timestamp")


class MjpegCamera(StreamCamera):
    """A ``multipart/x-mixed-replace`` stream of JPEGs.

    With stamps "header" the capture time is the part's ``X-Timestamp`` [s], on this machine's
    monotonic clock or on the wall clock; a stream without it is refused. With "arrival" it is
    the arrival minus the latency.

    Args:
        settings: ``device`` is an http or https URL; user and password in it are sent along.
        model: the camera's size, intrinsics and place.

    Raises:
        ValueError: if the device is not such a URL.
    """

    def __init__(self, settings: CameraSettings, model: CameraModel) -> None:
        super().__init__(
            model,
            latency=settings.latency,
            timeout=settings.timeout,
            rate_hz=settings.rate_hz,
        )
        self.url = str(settings.device)
        parts = urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError(
                f"device: expected a URL like http://host:port/stream of an mjpeg camera,"
                f" got {settings.device!r}"
            )
        self._by_header = settings.stamps != "arrival"

    def _connect(self) -> "_MjpegSource":
        # A stream that is silent for longer than this is opened anew.
        silence = min(max(2.0 * self.timeout, 1.0), self.open_timeout)
        return _MjpegSource(self.url, silence, by_header=self._by_header)


class _MjpegSource:
    """One HTTP connection."""

    def __init__(self, url: str, silence: float, *, by_header: bool) -> None:
        parts = urlsplit(url)
        secure = parts.scheme == "https"
        kind = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        self._by_header = by_header
        self._http = kind(parts.hostname or "", parts.port, timeout=silence)
        try:
            self._response = self._request(url)
            self._parts = MultipartReader(self._response, _boundary(self._response))
        except (OSError, http.client.HTTPException) as error:
            self._http.close()
            raise DeviceError(
                f"{_without_password(url)}: {error or type(error).__name__}"
            ) from error
        except DeviceError as error:
            self._http.close()
            raise DeviceError(f"{_without_password(url)}: {error}") from None

    def _request(self, url: str) -> http.client.HTTPResponse:
        parts = urlsplit(url)
        target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        headers = {"Accept": "multipart/x-mixed-replace"}
        if parts.username is not None:
            secret = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
            headers["Authorization"] = f"Basic {base64.b64encode(secret.encode()).decode()}"
        self._http.connect()
        self._socket = self._http.sock
        self._http.request("GET", target, headers=headers)
        response = self._http.getresponse()
        if response.status != http.HTTPStatus.OK:
            raise DeviceError(f"HTTP status {response.status} {response.reason}")
        return response

    def read(self) -> Shot:
        try:
            part = self._parts.read()
        except TimeoutError:
            raise DeviceError(f"silent for {self._http.timeout:g} s") from None
        arrival = time.monotonic()
        stamp = header_stamp(part.headers, arrival) if self._by_header else None
        return Shot(decode(part.body), stamp)

    def interrupt(self) -> None:
        with suppress(OSError):  # already closed
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._response.close()
        self._http.close()


class Part(NamedTuple):
    """One part of a multipart stream; header names in lower case."""

    headers: Mapping[str, str]
    body: bytes


class MultipartReader:
    """Parts of a multipart stream, by their ``Content-Length`` or by search for the boundary.

    Args:
        stream: the response's body.
        boundary: from its ``Content-Type``; some servers put the leading dashes there too.
        max_bytes: size at which a part is refused.
    """

    def __init__(self, stream: BinaryIO, boundary: str, max_bytes: int = MAX_IMAGE_BYTES) -> None:
        self._stream = stream
        self._delimiter = b"--" + boundary.encode("latin-1").removeprefix(b"--")
        self._max_bytes = max_bytes
        self._at_part = self._ended = False

    def read(self) -> Part:
        """The next part.

        Raises:
            DeviceError: if the stream ended, is malformed, or a part is larger than allowed.
            TimeoutError: if it was silent for the socket's timeout.
        """
        if not self._at_part:
            self._skip_to_delimiter()
        self._at_part = False
        if self._ended:
            raise DeviceError("the server ended the stream")
        headers = self._read_headers()
        length = headers.get("content-length")
        if length is None:
            return Part(headers, self._read_to_delimiter())
        if not re.fullmatch(r"\d{1,12}", length) or int(length) > self._max_bytes:
            raise DeviceError(
                f"expected a Content-Length of at most {self._max_bytes} bytes, got {length[:40]!r}"
            )
        body = self._stream.read(int(length))
        if len(body) < int(length):
            raise DeviceError("the stream ended")
        return Part(headers, body)

    def _line(self, limit: int) -> bytes:
        line = self._stream.readline(limit)
        if not line:
            raise DeviceError("the stream ended")
        return line

    def _skip_to_delimiter(self) -> None:
        skipped = 0
        while not self._is_delimiter(line := self._line(MAX_LINE_BYTES)):
            skipped += len(line)
            if skipped > self._max_bytes:
                raise DeviceError(f"no {self._delimiter!r} in {skipped} bytes of the stream")

    def _is_delimiter(self, line: bytes) -> bool:
        if not line.startswith(self._delimiter):
            return False
        rest = line[len(self._delimiter) :].strip()
        self._ended = rest == b"--"
        return not rest or self._ended

    def _read_headers(self) -> dict[str, str]:
        headers: dict[str, str] = {}
        for _ in range(MAX_HEADERS + 1):
            line = self._line(MAX_LINE_BYTES)
            if not line.endswith(b"\n"):
                raise DeviceError(f"a part's header is longer than {MAX_LINE_BYTES} bytes")
            if not line.strip():
                return headers
            name, _, value = line.decode("latin-1").partition(":")
            headers[name.strip().lower()] = value.strip()
        raise DeviceError(f"a part has more than {MAX_HEADERS} headers")

    def _read_to_delimiter(self) -> bytes:
        body = bytearray()
        at_line_start = False
        while True:
            line = self._line(65536)
            if at_line_start and self._is_delimiter(line):
                self._at_part = True
                return bytes(body[:-2] if body.endswith(b"\r\n") else body[:-1])
            at_line_start = line.endswith(b"\n")
            body += line
            if len(body) > self._max_bytes:
                raise DeviceError(f"a part is larger than {self._max_bytes} bytes")


def header_stamp(headers: Mapping[str, str], arrival: float) -> float:
    """The capture time that a part's headers tell, on the monotonic clock [s].

    Args:
        headers: lower-case names.
        arrival: of the part, monotonic [s].

    Raises:
        DeviceError: if no header tells a time that could be true on the monotonic clock or the
            wall clock.
    """
    told = [headers[name] for name in STAMP_HEADERS if name in headers]
    for text in told:
        try:
            value = float(text)
        except ValueError:
            continue
        for stamp in (value, value - time.time() + time.monotonic()):
            if plausible_stamp(stamp, arrival):
                return min(stamp, arrival)
    if not told:
        raise DeviceError('sends no X-Timestamp with its images; set stamps = "arrival"')
    raise DeviceError(
        f"tells {told[-1][:40]!r} as X-Timestamp, which is more than {CLOCK_TOLERANCE:g} s ahead"
        " or seconds behind on both the monotonic and the wall clock; synchronise the clocks or"
        ' set stamps = "arrival"'
    )


def decode(jpeg: bytes) -> NDArray[np.uint8]:
    """The image (height, width, 3) uint8 RGB of a JPEG.

    Raises:
        DamagedImageError: if it is none.
    """
    image = None
    if jpeg:
        image = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise DamagedImageError(f"{len(jpeg)} bytes are no JPEG")
    return image  # type: ignore[return-value]  # OpenCV's stubs know no dtype


def _boundary(response: http.client.HTTPResponse) -> str:
    kind = response.headers.get_content_type()
    boundary = response.headers.get_boundary()
    if kind != "multipart/x-mixed-replace" or not boundary:
        raise DeviceError(
            "expected Content-Type multipart/x-mixed-replace with a boundary, got"
            f" {response.headers.get('Content-Type', 'none')[:80]!r}"
        )
    return boundary


def _without_password(url: str) -> str:
    parts = urlsplit(url)
    return parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()
