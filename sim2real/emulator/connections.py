"""What the emulator's servers share: a listener on a loopback address with a bounded crowd."""

import asyncio
import logging
from collections.abc import Callable

from sim2real.emulator.loopback import check_loopback

_log = logging.getLogger(__name__)

MAX_CONNECTIONS = 32  # on one port
LARGEST_BACKLOG = 1 << 20  # bytes a client may leave unread before it is dropped
LONGEST_LINE = 1 << 16


class Listener:
    """One port: makes a ``Connection`` for every client, up to a limit.

    Attributes:
        connections: that are open.
    """

    def __init__(self, address: str, port: int, make: Callable[["Listener"], "Connection"]) -> None:
        self.address, self.port = check_loopback(address), port
        self.connections: set[Connection] = set()
        self._make = make
        self._server: asyncio.Server | None = None

    async def open(self) -> None:
        """Start to listen; nothing if it does already."""
        if self._server is None:
            loop = asyncio.get_running_loop()
            self._server = await loop.create_server(
                lambda: self._make(self), self.address, self.port, backlog=64
            )

    def refuse(self) -> None:
        """Close the port to new connections; the open ones go on."""
        if self._server is not None:
            self._server.close()
            self._server = None

    def drop(self) -> None:
        """Close all connections."""
        for connection in list(self.connections):
            connection.abort()


class Connection(asyncio.Protocol):
    """A client of one port."""

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        if len(self._listener.connections) >= MAX_CONNECTIONS:
            _log.debug("port %d: too many connections", self._listener.port)
            transport.abort()
            return
        self._transport = transport
        self._listener.connections.add(self)
        self.greet()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        self._listener.connections.discard(self)
        self.leave()

    def greet(self) -> None:
        """A client has come."""

    def leave(self) -> None:
        """The client has gone."""

    def send(self, data: bytes) -> bool:
        """Send, or drop a client that does not read; whether it is still there."""
        if self._transport is None:
            return False
        if self._transport.get_write_buffer_size() > LARGEST_BACKLOG:
            _log.warning("port %d: a client does not read, dropped", self._listener.port)
            self.abort()
            return False
        self._transport.write(data)
        return True

    @property
    def backlog(self) -> int:
        """Bytes that wait for the client to read."""
        return 0 if self._transport is None else self._transport.get_write_buffer_size()

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()

    def close(self) -> None:
        """Close when everything is sent."""
        if self._transport is not None:
            self._transport.close()


class LineConnection(Connection):
    """A client that sends lines and gets one reply to each, with ``ending`` behind it."""

    ending = b"\n"

    def __init__(self, listener: Listener) -> None:
        super().__init__(listener)
        self._rest = b""

    def data_received(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            self.abort()
            return
        for line in lines:
            reply = self.answer(line.decode(errors="replace").strip())
            if reply is not None and not self.send(reply.encode() + self.ending):
                return

    def answer(self, line: str) -> str | None:
        """The reply to a line, without its end; None for none."""
        raise NotImplementedError
