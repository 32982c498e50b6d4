"""The MJPEG camera against hand-written streams, good and bad, and against the emulated cell's."""

import io
import os
import socketserver
import threading
import time
from contextlib import suppress

import cv2
import numpy as np
import pytest

from dlo_gym.exceptions import DeviceError
from dlo_gym.geometry.camera import CameraModel
from sim2real.cameras.camera import CameraSettings
from sim2real.cameras.capture import DamagedImageError
from sim2real.cameras.mjpeg_camera import MjpegCamera, MultipartReader, decode, header_stamp
from sim2real.emulator.mjpeg_server import CameraFeed, MjpegServer

ADDRESS = f"127.{10 + os.getpid() % 200}.{os.getpid() // 200 % 250}.6"
MODEL = CameraModel.looking_at("side", (0, -1, 0), (0, 0, 0), width=32, height=24)


def jpeg(color=(255, 0, 0), size=(24, 32)):
    """An RGB colour as a JPEG."""
    return cv2.imencode(".jpg", np.full((*size, 3), color[::-1], np.uint8))[1].tobytes()


def part(body, *headers, boundary=b"--frame"):
    lines = [boundary, b"Content-Type: image/jpeg", *headers]
    return b"\r\n".join(lines) + b"\r\n\r\n" + body + b"\r\n"


def length(body):
    return b"Content-Length: %d" % len(body)


class ScriptedServer(socketserver.ThreadingTCPServer):
    """Answers each connection by ``serve(connection, n)``, n counting from 0."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, serve):
        self.serve = serve
        self.requests = []
        super().__init__((ADDRESS, 0), ScriptedHandler)
        threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True).start()

    @property
    def url(self):
        return f"http://{ADDRESS}:{self.server_address[1]}/side?quality=80"


class ScriptedHandler(socketserver.BaseRequestHandler):
    def handle(self):
        self.server.requests.append(self.request.recv(4096).decode())
        with suppress(OSError):  # the client has gone
            self.server.serve(self.request, len(self.server.requests) - 1)


HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"


def stream(link, n, n_parts=10**9, color=(255, 0, 0), age=0.02):
    link.sendall(HEAD)
    body = jpeg(color)
    for _ in range(n_parts):
        stamp = b"X-Timestamp: %.6f" % (time.monotonic() - age)
        link.sendall(part(body, length(body), stamp))
        time.sleep(0.02)


@pytest.fixture
def serve():
    servers = []

    def start(handle):
        servers.append(ScriptedServer(handle))
        return servers[-1]

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def camera_at(url, **settings):
    return MjpegCamera(CameraSettings("mjpeg", url, **({"timeout": 0.5} | settings)), MODEL)


def eventually(condition, seconds=5.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "never came true"
        time.sleep(0.005)


def reader(data, boundary="frame", **limits):
    return MultipartReader(io.BytesIO(data), boundary, **limits)


def test_parts_by_length():
    a, b = b"first\r\n--frame\r\n", b"second"  # a boundary inside a part of known length is data
    parts = reader(b"preamble\r\n" + part(a, length(a), b"X-Timestamp: 1.5") + part(b, length(b)))
    first = parts.read()
    assert (first.body, first.headers["x-timestamp"]) == (a, "1.5")
    assert parts.read().body == b
    with pytest.raises(DeviceError, match="ended"):
        parts.read()


def test_parts_by_boundary():
    images = [jpeg((10 * i, 200, 30)) for i in range(5)]
    parts = reader(b"".join(map(part, images)) + b"--frame--\r\n")
    assert [parts.read().body for _ in images] == images
    with pytest.raises(DeviceError, match="ended the stream"):
        parts.read()


@pytest.mark.parametrize("seed", range(10))
def test_binary_bodies_by_boundary(seed):
    rng = np.random.default_rng(seed)
    bodies = [rng.choice(np.frombuffer(b"\r\n-fram\0", np.uint8), 300).tobytes() for _ in range(4)]
    parts = reader(b"".join(map(part, bodies)) + b"--frame\r\n")
    assert [parts.read().body for _ in bodies] == bodies


def test_boundary_named_with_its_dashes():
    body = b"image"
    parts = reader(part(body, length(body), boundary=b"--frame"), boundary="--frame")
    assert parts.read().body == body


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (part(b"x", b"Content-Length: 1001"), "at most 1000 bytes, got '1001'"),
        (part(b"x", b"Content-Length: -1"), "Content-Length"),
        (part(b"x", b"Content-Length: 9" + b"9" * 60), "Content-Length"),
        (part(b"x" * 2000) + part(b""), "larger than 1000 bytes"),
        (b"y" * 9000, "no b'--frame'"),
        (b"y\n" * 9000, "no b'--frame'"),
        (part(b"", *[b"A: b"] * 100), "more than 64 headers"),
        (part(b"", b"A: " + b"b" * 9000), "longer than 4096"),
        (part(b"abc", b"Content-Length: 10"), "ended"),
        (b"--frame\r\nContent-Le", "header is longer|ended"),
        (b"", "ended"),
    ],
)
def test_malformed_streams_are_refused(data, message):
    parts = reader(data, max_bytes=1000)
    with pytest.raises(DeviceError, match=message):
        parts.read()


@pytest.mark.parametrize("seed", range(20))
def test_noise_ends_in_a_device_error(seed):
    rng = np.random.default_rng(seed)
    data = bytearray(b"".join(part(jpeg(), length(jpeg())) for _ in range(3)))
    for i in rng.integers(0, len(data), 40):
        data[i] = rng.integers(256)
    parts = reader(bytes(data), max_bytes=10**5)

    def read_all():
        while True:
            with suppress(DamagedImageError):
                decode(parts.read().body)

    with pytest.raises(DeviceError):
        read_all()


def test_stamp_of_a_header():
    now, ahead = time.monotonic(), time.time() - time.monotonic()
    assert header_stamp({"x-timestamp": f"{now - 0.1:.6f}"}, now) == pytest.approx(now - 0.1)
    wall = header_stamp({"x-timestamp": f"{now - 0.1 + ahead:.6f}"}, now)
    assert wall == pytest.approx(now - 0.1, abs=1e-3)
    # When the image was taken, rather than when it was sent.
    both = {"x-timestamp": f"{now + ahead}", "x-ustreamer-grab-time": f"{now - 0.06:.6f}"}
    assert header_stamp(both, now) == pytest.approx(now - 0.06)
    for text in (f"{now - 60}", f"{now + 1}", "soon", "nan", "inf"):
        with pytest.raises(DeviceError, match='X-Timestamp.*stamps = "arrival"'):
            header_stamp({"x-timestamp": text}, now)


def test_images_are_rgb_and_damaged_ones_are_told():
    assert np.abs(decode(jpeg((250, 20, 60)))[5, 5].astype(int) - [250, 20, 60]).max() < 4
    for broken in (b"", b"no jpeg", jpeg()[:50]):
        with pytest.raises(DamagedImageError):
            decode(broken)


def test_streams_with_the_sources_stamps(serve):
    server = serve(stream)
    with camera_at(server.url) as camera:
        eventually(lambda: camera.latest().index > 20)
        frames = camera.frames(0.0)
        assert camera.statistics().rate_hz > 20.0
    assert server.requests[0].startswith("GET /side?quality=80 HTTP/1.1\r\n")
    assert frames[0].image[3, 3].tolist() == pytest.approx([255, 0, 0], abs=4)
    delays = [each.arrival - each.stamp for each in frames]
    assert 0.02 <= np.median(delays) < 0.2


def test_stamps_by_arrival(serve):
    server = serve(lambda link, n: stream(link, n, age=77.0))
    with camera_at(server.url, stamps="arrival", latency=0.07) as camera:
        newest = camera.latest()
    assert newest.arrival - newest.stamp == pytest.approx(0.07)


def test_a_stream_without_stamps_says_what_to_do(serve):
    def bare(link, n):
        link.sendall(HEAD + part(jpeg()) * 5)
        time.sleep(1.0)

    server = serve(bare)
    with pytest.raises(DeviceError, match='no X-Timestamp.*stamps = "arrival"'):
        camera_at(server.url).open()
    with camera_at(server.url, stamps="arrival") as camera:
        camera.latest()


def test_reconnects_and_goes_on(serve):
    server = serve(lambda link, n: stream(link, n, n_parts=5 if n == 0 else 10**9))
    with camera_at(server.url) as camera:
        eventually(lambda: len(server.requests) == 2 and camera.frames(0.0)[-1].index > 10)
        camera.latest()
        assert camera.statistics().n_reopened == 1


def test_a_silent_stream_is_opened_anew(serve):
    def stall(link, n):
        stream(link, n, n_parts=3 if n == 0 else 10**9)
        if n == 0:
            time.sleep(5.0)

    server = serve(stall)
    with camera_at(server.url, timeout=0.2) as camera:
        time.sleep(0.6)
        with pytest.raises(DeviceError, match="'side': no new frame"):
            camera.latest()
        eventually(lambda: camera.statistics().n_reopened == 1)
        eventually(lambda: time.monotonic() - camera.frames(0.0)[-1].arrival < 0.1)
        assert len(server.requests) == 2
        camera.latest()


def test_close_ends_a_pending_read_and_the_connection(serve):
    def stall(link, n):
        stream(link, n, n_parts=1)
        assert link.recv(1) == b""  # the client has gone
        ended.set()

    ended = threading.Event()
    camera = camera_at(serve(stall).url, timeout=30.0)
    camera.open()
    start = time.monotonic()
    camera.close()
    assert ended.wait(2.0)
    assert time.monotonic() - start < 2.0  # long before the read's own timeout
    assert not any(thread.name == "camera-side" for thread in threading.enumerate())


def test_password_is_sent_but_not_shown(serve):
    server = serve(lambda link, n: link.sendall(b"HTTP/1.1 401 Unauthorized\r\n\r\n"))
    url = server.url.replace("http://", "http://lab:s3cret%21@")
    with pytest.raises(
        DeviceError, match="'side' cannot be opened: http://127.*status 401"
    ) as info:
        camera_at(url).open()
    assert "s3cret" not in str(info.value)
    assert "Authorization: Basic bGFiOnMzY3JldCE=" in server.requests[0]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (b"HTTP/1.1 404 Not Found\r\n\r\n", "HTTP status 404"),
        (b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n", "multipart.*got 'text/html'"),
        (b"\0\1\2\r\n\r\n", "http://"),
        (b"", "http://"),
        (HEAD + b"--frame--\r\n", "ended"),
        (HEAD + part(jpeg(), length(jpeg()), b"X-Timestamp: 0"), "X-Timestamp"),
    ],
)
def test_wrong_answers_are_told(serve, answer, message):
    server = serve(lambda link, n: link.sendall(answer))
    with pytest.raises(DeviceError, match=f"'side' cannot be opened.*{message}"):
        camera_at(server.url).open()


def test_chunked_transfer(serve):
    def chunked(link, n):
        link.sendall(HEAD[:-2] + b"Transfer-Encoding: chunked\r\n\r\n")
        for _ in range(200):
            data = part(jpeg(), length(jpeg()), b"X-Timestamp: %.6f" % time.monotonic())
            for piece in (data[:100], data[100:]):
                link.sendall(b"%x\r\n%s\r\n" % (len(piece), piece))
            time.sleep(0.02)

    with camera_at(serve(chunked).url) as camera:
        eventually(lambda: camera.latest().index > 5)


def test_nobody_there():
    with pytest.raises(DeviceError, match="'side' cannot be opened: http.*refused"):
        camera_at(f"http://{ADDRESS}:1/side").open()


def test_a_url_is_needed():
    for device in ("side", "ftp://host/x", 0, "http://"):
        with pytest.raises(ValueError, match="device: expected a URL"):
            camera_at(device)


class NoPages:
    def get(self, path, query):
        return None

    def post(self, path, body):
        return None


def test_the_emulated_cells_stream():
    feed = CameraFeed()
    server = MjpegServer(ADDRESS, 0, {"side": feed}, NoPages())
    stop = threading.Event()

    def publish():
        while not stop.wait(0.05):
            feed.publish(jpeg((0, 0, 255)), time.monotonic() - 0.01)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        with camera_at(f"http://{ADDRESS}:{server.port}/side", timeout=0.4) as camera:
            eventually(lambda: camera.latest().index > 10)
            assert camera.latest().image[3, 3].tolist() == pytest.approx([0, 0, 255], abs=4)
            assert 0.01 <= camera.statistics().delay < 0.1
            feed.freeze(0.8)
            time.sleep(0.55)
            with pytest.raises(DeviceError, match="no new frame"):
                camera.latest()
            eventually(lambda: time.monotonic() - camera.frames(0.0)[-1].arrival < 0.1)
            feed.drop(0.5)
            eventually(lambda: camera.statistics().n_reopened == 1)
            camera.latest()
    finally:
        stop.set()
        thread.join()
        server.close()
