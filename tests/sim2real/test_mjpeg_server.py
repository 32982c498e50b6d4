import http.client
import json
import socket
import threading
import time

import pytest

from sim2real.emulator.camera_feed import CameraFeed
from sim2real.emulator.mjpeg_server import (
    LARGEST_BODY,
    MOST_CONNECTIONS,
    Answer,
    MjpegServer,
)
from tests.sim2real.fake_controller import free_address

JPEG = b"\xff\xd8--frame\r\nnot a boundary\r\n\xff\xd9"


class FakePages:
    def get(self, path, query):
        if path == "/echo":
            return Answer.of(dict(query))
        if path == "/wrong":
            raise ValueError("that is wrong")
        return None

    def post(self, path, body):
        return Answer.of({"got": body}) if path == "/echo" else None


@pytest.fixture
def feed():
    return CameraFeed()


@pytest.fixture
def server(feed):
    server = MjpegServer(free_address(21), 0, {"side": feed}, FakePages())
    yield server
    server.close()


def request(server, method, path, body=None):
    connection = http.client.HTTPConnection(free_address(21), server.port, timeout=5)
    connection.request(method, path, body)
    response = connection.getresponse()
    answer = response.read()
    connection.close()
    return response.status, response.headers, answer


def raw(server, data):
    with socket.create_connection((free_address(21), server.port), 5) as client:
        client.sendall(data)
        client.shutdown(socket.SHUT_WR)
        received = b""
        while chunk := client.recv(65536):
            received += chunk
    return received


class Stream:
    """An MJPEG client by the book."""

    def __init__(self, server):
        self.connection = http.client.HTTPConnection(free_address(21), server.port, timeout=5)
        self.connection.request("GET", "/side")
        self.response = self.connection.getresponse()

    def part(self):
        assert self.response.readline() == b"--frame\r\n"
        headers = http.client.parse_headers(self.response)
        data = self.response.read(int(headers["Content-Length"]))
        assert self.response.readline() == b"\r\n"
        return headers, data


def test_stream_has_parts_with_length_and_stamp(server, feed):
    feed.publish(JPEG, 12.3456789)
    stream = Stream(server)
    assert stream.response.status == 200
    assert stream.response.headers["Content-Type"] == "multipart/x-mixed-replace; boundary=frame"
    for k in range(3):
        headers, data = stream.part()
        assert data == JPEG + b"x" * k
        assert headers["Content-Type"] == "image/jpeg"
        assert headers["X-Timestamp"] == ("12.345679" if k == 0 else f"{k:.6f}")
        feed.publish(JPEG + b"x" * (k + 1), k + 1)
    stream.connection.close()


def test_slow_client_skips_pictures_instead_of_falling_behind(server, feed):
    stream = Stream(server)
    big = bytes(200_000)
    for k in range(100):
        feed.publish(big, float(k))
        time.sleep(0.002)
    stamps = []
    while not stamps or stamps[-1] < 99:
        stamps.append(float(stream.part()[0]["X-Timestamp"]))
    assert stamps == sorted(set(stamps))
    assert len(stamps) < 80
    stream.connection.close()


def test_one_picture(server, feed):
    feed.publish(JPEG, 1.5)
    status, headers, data = request(server, "GET", "/side.jpg")
    assert (status, data) == (200, JPEG)
    assert headers["Content-Type"] == "image/jpeg"
    assert headers["X-Timestamp"] == "1.500000"


def test_pages_and_errors(server):
    assert request(server, "GET", "/echo?since=1.5&x=")[::2] == (200, b'{"since": "1.5"}')
    assert request(server, "GET", "/nowhere")[0] == 404
    assert request(server, "GET", "/wrong")[::2] == (400, b'{"error": "that is wrong"}')
    status, _, answer = request(server, "POST", "/echo", json.dumps({"a": [1]}))
    assert (status, json.loads(answer)) == (200, {"got": {"a": [1]}})
    assert request(server, "POST", "/echo", "{")[0] == 400
    assert request(server, "POST", "/nowhere", "{}")[0] == 404
    assert request(server, "POST", "/echo", "1" * (LARGEST_BODY + 1))[0] == 413
    assert request(server, "PUT", "/echo", "{}")[0] == 405


@pytest.mark.parametrize(
    "data",
    [
        b"nonsense\r\n\r\n",
        b"GET /side HTTP/9.9\r\n\r\n",
        b"GET /" + b"a" * 70000 + b" HTTP/1.1\r\n\r\n",
        b"GET /echo HTTP/1.1\r\n" + b"X: y\r\n" * 200 + b"\r\n",
        b"GET /echo HTTP/1.1\r\nX: " + b"y" * 70000 + b"\r\n\r\n",
        b"GET http://[ HTTP/1.1\r\n\r\n",
        b"POST /echo HTTP/1.1\r\n\r\n",
        b"POST /echo HTTP/1.1\r\nContent-Length: -1\r\n\r\n",
        b"POST /echo HTTP/1.1\r\nContent-Length: 99999999999999\r\n\r\n",
        b"POST /echo HTTP/1.1\r\nContent-Length: 4\r\n\r\n\xff\xfe\x00\x01",
        b"POST /echo HTTP/1.1\r\nContent-Length: 4000\r\n\r\n" + b"[" * 4000,
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
    ],
)
def test_malformed_requests_are_answered_with_4xx(server, data):
    answer = raw(server, data)
    assert answer.split(b" ")[1][:1] == b"4" or b"Error code: 4" in answer
    assert request(server, "GET", "/echo")[0] == 200


def test_more_connections_than_allowed_are_refused(server):
    idle = [
        socket.create_connection((free_address(21), server.port), 5)
        for _ in range(MOST_CONNECTIONS)
    ]
    try:
        with socket.create_connection((free_address(21), server.port), 5) as client:
            assert b" 503 " in client.recv(100)
    finally:
        for client in idle:
            client.close()
    deadline = time.monotonic() + 5
    while request(server, "GET", "/echo")[0] != 200:
        assert time.monotonic() < deadline


def test_only_this_machine_is_served(feed):
    for address in ("0.0.0.0", "10.0.0.1", "localhost", "::1", ""):
        with pytest.raises(ValueError, match="127.0.0.0/8"):
            MjpegServer(address, 0, {"side": feed}, FakePages())


def test_frozen_camera_is_silent_and_goes_on(feed):
    feed.publish(JPEG, 1.0)
    number = feed.newer(0, 0.1).number
    feed.freeze(0.3)
    feed.publish(JPEG, 2.0)
    assert feed.newer(number, 0.05) is None
    time.sleep(0.3)
    feed.publish(JPEG, 3.0)
    assert feed.newer(number, 0.1).stamp == 3.0


def test_dropped_camera_ends_streams_and_refuses_new_ones(server, feed):
    feed.publish(JPEG, 1.0)
    stream = Stream(server)
    stream.part()
    feed.drop(0.5)
    assert stream.response.readline() == b""  # the server has closed
    assert request(server, "GET", "/side")[0] == 503
    assert request(server, "GET", "/side.jpg")[0] == 503
    feed.clear()
    feed.publish(JPEG, 2.0)
    assert Stream(server).part()[0]["X-Timestamp"] == "2.000000"


def test_latency_delays_pictures_and_keeps_their_stamps(feed):
    feed.delay(0.2)
    began = time.monotonic()
    feed.publish(JPEG, 1.0)
    assert feed.newer(0, 0.05) is None
    picture = feed.newer(0, 1.0)
    assert picture.stamp == 1.0
    assert 0.2 <= time.monotonic() - began < 0.5


def test_latency_does_not_thin_the_stream_out(feed):
    feed.delay(0.2)

    def publish():
        for k in range(20):
            feed.publish(JPEG, float(k))
            time.sleep(0.02)

    threading.Thread(target=publish).start()
    stamps, number = [], 0
    while (picture := feed.newer(number, 0.5)) is not None:
        number = picture.number
        stamps.append(picture.stamp)
    assert stamps[-1] == 19.0
    assert len(stamps) >= 15


def test_closing_ends_streams_promptly(feed):
    server = MjpegServer(free_address(21), 0, {"side": feed}, FakePages())
    feed.publish(JPEG, 1.0)
    stream = Stream(server)
    stream.part()
    began = time.monotonic()
    server.close()
    assert stream.response.readline() == b""
    assert time.monotonic() - began < 2.0
    with pytest.raises(OSError):  # noqa: PT011
        socket.create_connection((free_address(21), server.port), 1)
