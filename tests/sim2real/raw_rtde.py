"""An RTDE client of a few lines, written from Universal Robots' RTDE guide and nothing else."""

import os
import socket
import struct


def address_of(last):
    """A loopback address that no other test process uses."""
    pid = os.getpid()
    return f"127.{10 + pid % 200}.{pid // 200 % 250}.{last}"


class RawRtde:
    """One connection; every method is one packet of the guide."""

    def __init__(self, address, timeout=5.0):
        self.socket = socket.create_connection((address, 30004), timeout)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def send(self, kind, payload=b""):
        self.socket.sendall(struct.pack(">HB", len(payload) + 3, ord(kind)) + payload)

    def receive(self):
        size, kind = struct.unpack(">HB", self._exactly(3))
        return chr(kind), self._exactly(size - 3)

    def ask(self, kind, payload=b""):
        """Send a packet; the payload of the reply, which has the same type."""
        self.send(kind, payload)
        while True:
            received, reply = self.receive()
            if received == kind:
                return reply

    def version(self, number=2):
        return self.ask("V", struct.pack(">H", number))

    def outputs(self, names, frequency=500.0):
        """Recipe id and types of an output setup."""
        reply = self.ask("O", struct.pack(">d", frequency) + names.encode())
        return reply[0], reply[1:].decode().split(",")

    def inputs(self, names):
        reply = self.ask("I", names.encode())
        return reply[0], reply[1:].decode().split(",")

    def sample(self, layout):
        """The next data packet's recipe id and values."""
        while True:
            kind, payload = self.receive()
            if kind == "U":
                return payload[0], struct.unpack(">" + layout, payload[1:])

    def _exactly(self, count):
        data = b""
        while len(data) < count:
            chunk = self.socket.recv(count - len(data))
            if not chunk:
                raise ConnectionResetError("the controller closed the link")
            data += chunk
        return data
