"""A controller that only tells joint angles, written against the RTDE guide's tables alone."""

import contextlib
import json
import math
import os
import socket
import struct
import threading
import time


def free_address(last: int) -> str:
    """A loopback address that no other test process uses; ``last`` tells those of one apart."""
    pid = os.getpid()
    return f"127.{10 + pid % 200}.{pid // 200 % 250}.{last}"


class FakeController:
    """Streams ``joint_angles`` at 125 Hz on 30004 and keeps the wrench told on 63999.

    Attributes:
        joint_angles: six numbers, or a function of the controller's time [s] that gives them.
        frozen: whether the stream is silent.
        wrench: as last set.
        frequency: as the client asked for.
    """

    def __init__(self, address, joint_angles):
        self.address, self.joint_angles = address, joint_angles
        self.frozen, self.wrench, self.frequency = False, None, None
        self.clock_ahead = 1234.5  # of monotonic [s]
        self._sockets, self._closing = [], threading.Event()
        self.serve()

    def serve(self):
        self._closing = threading.Event()
        for port, handle in ((30004, self._rtde), (63999, self._control)):
            listener = socket.create_server((self.address, port))
            self._sockets.append(listener)
            threading.Thread(target=self._accept, args=(listener, handle), daemon=True).start()

    def close(self):
        self._closing.set()
        for one in self._sockets:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self._sockets = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def joints_at(self, robot_time):
        return self.joint_angles(robot_time) if callable(self.joint_angles) else self.joint_angles

    def _accept(self, listener, handle):
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                self._sockets.append(client)
                threading.Thread(target=self._handled, args=(handle, client), daemon=True).start()

    def _handled(self, handle, client):
        with contextlib.suppress(OSError, struct.error):
            handle(client)
        client.close()

    def _rtde(self, client):
        closing = self._closing
        stream = client.makefile("rb")
        while True:
            size, kind = struct.unpack(">HB", stream.read(3))
            payload = stream.read(size - 3)
            if kind == ord("V"):
                # a text message first: clients must pass over it
                text = b"hello"
                client.sendall(struct.pack(">HBB", 9, ord("M"), len(text)) + text)
                accepted = struct.unpack(">H", payload) == (2,)
                client.sendall(struct.pack(">HBB", 4, kind, accepted))
            elif kind == ord("O"):
                (self.frequency,) = struct.unpack(">d", payload[:8])
                assert payload[8:].rstrip(b",") == b"timestamp,actual_q"
                types = b"DOUBLE,VECTOR6D"
                client.sendall(struct.pack(">HBB", 4 + len(types), kind, 7) + types)
            elif kind == ord("S"):
                client.sendall(struct.pack(">HBB", 4, kind, 1))
                break
        while not closing.wait(1 / 125):
            if not self.frozen:
                now = time.monotonic() + self.clock_ahead
                package = struct.pack(">B7d", 7, now, *self.joints_at(now))
                client.sendall(struct.pack(">HB", 3 + len(package), ord("U")) + package)

    def _control(self, client):
        for line in client.makefile("rb"):
            request = json.loads(line)
            if request.get("set") == "wrench":
                assert all(map(math.isfinite, request["value"]))
                self.wrench = request["value"]
                reply = {"ok": True}
            else:
                now = time.monotonic() + self.clock_ahead
                reply = {"joints": list(self.joints_at(now))}
            client.sendall(json.dumps(reply).encode() + b"\n")
