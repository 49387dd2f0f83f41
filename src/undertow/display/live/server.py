"""A page and its data on 127.0.0.1: HTTP for the files, a web socket for everything that moves.

Who has the address has the token, which is its path; a socket is opened only by the page itself,
whose origin is this server.  All runs in one thread: the show advances by the clock, and what it
says is laid into the queue of each viewer, which is bounded: a viewer that is slow, or whose lid is
closed, misses pictures and slows nobody.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import signal
import socket
import time
from collections import deque
from collections.abc import Callable
from http import HTTPStatus
from typing import Any, Protocol

from undertow.base import ArtefactError, InvalidInputError, between, parse_json, require_extra
from undertow.display.live.page import FILES, content, encoded

#: What is said to viewers: JSON values.  ``kind`` is "frame" for a picture, of which a slow viewer
#: may miss some.
Message = dict[str, Any]

#: Where it listens, and on which port if that is free.
HOST, PORT = "127.0.0.1", 8417

#: Pictures in a second; the longest time that is caught up with when the process was held up, s.
RATE, CATCH_UP = 60.0, 0.1

#: Pictures and other messages that wait for a viewer at most.  Who misses one of the others is cut
#: off, comes back by itself, and is told everything anew.
PICTURES, OTHERS = 6, 200

#: Largest message from a viewer, bytes, and most viewers.
MOST_BYTES, MOST_VIEWERS = 4096, 16

#: How long a viewer may take to answer a ping, s: a suspended page is let go.
PATIENCE = 20.0

#: How long viewers have to be told the rest of what is over, and then to take their leave, s.
FAREWELL = 1.0

_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Show(Protocol):
    """What is shown."""

    def hello(self) -> Message:
        """Return all that a new viewer must know."""
        ...

    def advance(self, seconds: float) -> list[Message]:
        """Go on by so much time, s, and return what is new for all viewers."""
        ...

    def hear(self, said: Message, viewer: int) -> None:
        """Do what a viewer asks for.

        Raises
        ------
        InvalidInputError
            For what cannot be done: the viewer is told.
        """
        ...

    def gone(self, viewer: int) -> None:
        """Forget a viewer: whatever it held is let go."""
        ...


class Viewer:
    """Who looks on, and what waits to be sent there."""

    def __init__(self, number: int, line: Any) -> None:
        self.number, self.socket = number, line
        self.pictures: deque[Message] = deque(maxlen=PICTURES)
        self.others: deque[Message] = deque()
        self.missed = 0
        self._news = asyncio.Event()
        self._ending: asyncio.Future[None] | None = None

    def cut_off(self) -> None:
        """End the connection, without waiting for it."""
        self._ending = asyncio.ensure_future(self.socket.close(1013, "too slow"))

    def tell(self, message: Message) -> bool:
        """Lay a message into the queue; false where too many others wait."""
        if message["kind"] == "frame":
            self.missed += len(self.pictures) == PICTURES
            self.pictures.append(message)
        elif len(self.others) >= OTHERS:
            return False
        else:
            self.others.append(message)
        self._news.set()
        return True

    async def next(self) -> list[Message]:
        """Wait for what is next, and return all of it."""
        await self._news.wait()
        self._news.clear()
        waiting = [*self.others, *self.pictures]
        self.others.clear()
        self.pictures.clear()
        return waiting


class Server:
    """Serves a show until it is stopped.

    ``show``: what is shown. ``port``: of 127.0.0.1; by default 8417, or any free one where that is
    taken. ``over``: whether the show has ended: then its viewers are told the rest, and so ends the
    server. ``address``: where the page is, with its token; known once it listens.
    """

    def __init__(
        self, show: Show, port: int | None = None, over: Callable[[], bool] = lambda: False
    ) -> None:
        need = "the live page needs websockets"
        self._ws = require_extra("websockets", "show", need)
        self._serve = require_extra("websockets.asyncio.server", "show", need).serve
        self._headers = require_extra("websockets.datastructures", "show", need).Headers
        self._response = require_extra("websockets.http11", "show", need).Response
        between("port", port or 0, 0, 65535, remedy="0: a free one")
        self.show, self._wanted, self._over = show, port, over
        self.token, self.port = secrets.token_urlsafe(16), 0
        self.viewers: dict[int, Viewer] = {}
        self._count = 0

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.port}/{self.token}/"

    @property
    def _origins(self) -> list[str]:
        return [f"http://{host}:{self.port}" for host in (HOST, "localhost")]

    async def run(self, ready: Callable[[str], None], stop: asyncio.Event) -> None:
        """Listen, call ``ready`` with the address, and serve until ``stop`` is set.

        Raises
        ------
        ArtefactError
            For a port that is taken.
        """
        listener = await self._listen()
        async with listener:
            self.port = listener.sockets[0].getsockname()[1]
            ready(self.address)
            ticking = asyncio.ensure_future(self._tick())
            stopping = asyncio.ensure_future(stop.wait())
            await asyncio.wait({ticking, stopping}, return_when=asyncio.FIRST_COMPLETED)
            for task in (ticking, stopping):
                if not task.done():
                    task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await ticking  # what it raised is raised

    async def _listen(self) -> Any:
        ports = [PORT, 0] if self._wanted is None else [self._wanted]
        for port in ports:
            try:
                return await self._serve(
                    self._talk, HOST, port, process_request=self._answer, compression=None,
                    max_size=MOST_BYTES, ping_timeout=PATIENCE, close_timeout=FAREWELL,
                    server_header=None,
                )  # fmt: skip
            except OSError as error:
                if port == ports[-1]:
                    raise _taken(port, error) from error
        raise AssertionError("the last port returns or raises")

    def _answer(self, _connection: Any, request: Any) -> Any:
        """Serve a file; refuse a wrong token, name or origin; let the page open its socket."""
        hosts = {origin.removeprefix("http://") for origin in self._origins}
        path = request.path.partition("?")[0]
        head, _, name = path.removeprefix("/").partition("/")
        asked = request.headers.get_all("Host")
        if len(asked) != 1 or asked[0] not in hosts:
            return self._said(HTTPStatus.FORBIDDEN, "This page is for this machine alone.")
        if not secrets.compare_digest(head.encode(), self.token.encode()):
            words = "The address lacks its token: open the one that 'undertow show' printed."
            return self._said(HTTPStatus.FORBIDDEN, words)
        origins = request.headers.get_all("Origin")  # a browser names one for a socket, always
        if not {*origins} <= {*self._origins} or (name == "socket" and len(origins) != 1):
            return self._said(HTTPStatus.FORBIDDEN, "Not from another page.")
        if name == "socket":
            if len(self.viewers) >= MOST_VIEWERS:
                return self._said(HTTPStatus.SERVICE_UNAVAILABLE, "Too many viewers.")
            return None
        if not name and not path.endswith("/"):
            return self._said(HTTPStatus.PERMANENT_REDIRECT, "", Location=f"/{self.token}/")
        name = name or "index.html"
        if name not in FILES:
            return self._said(HTTPStatus.NOT_FOUND, "There is no such file.")
        return self._said(HTTPStatus.OK, content(name), **{"Content-Type": FILES[name]})

    def _said(self, status: HTTPStatus, body: str | bytes, **more: str) -> Any:
        data = body.encode() if isinstance(body, str) else body
        named = {"Content-Type": "text/plain; charset=utf-8", **_HEADERS, **more}
        headers = self._headers(
            {**named, "Content-Length": str(len(data)), "Connection": "close"}.items()
        )
        return self._response(status.value, status.phrase, headers, data)

    async def _talk(self, line: Any) -> None:
        """Tell one viewer what there is to tell, and hear what it asks for."""
        self._count += 1
        viewer = Viewer(self._count, line)
        viewer.tell(self.show.hello())
        self.viewers[viewer.number] = viewer
        sender = asyncio.ensure_future(self._send(viewer))
        try:
            async for text in line:
                self._hear(viewer, text)
        except self._ws.exceptions.ConnectionClosed:
            pass
        finally:
            sender.cancel()
            self.viewers.pop(viewer.number, None)
            self.show.gone(viewer.number)

    def _hear(self, viewer: Viewer, text: str | bytes) -> None:
        try:
            said = parse_json(text)
            if not isinstance(said, dict):
                raise ValueError("not an object")
        except ValueError as error:
            viewer.tell({"kind": "note", "text": f"not understood: {error}"})
            return
        try:
            self.show.hear(said, viewer.number)
        except InvalidInputError as error:
            viewer.tell({"kind": "note", "text": str(error)})

    async def _send(self, viewer: Viewer) -> None:
        with contextlib.suppress(self._ws.exceptions.ConnectionClosed):
            while True:
                for message in await viewer.next():
                    # A full buffer is waited for here, by nobody else.
                    await viewer.socket.send(encoded(message))

    async def _tick(self) -> None:
        """Advance the show by the clock, whoever looks on, until it is over."""
        last = due = time.monotonic()
        while not self._over():
            due = max(due + 1.0 / RATE, time.monotonic() - CATCH_UP)
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            now = time.monotonic()
            for message in self.show.advance(min(now - last, CATCH_UP)):
                for viewer in [*self.viewers.values()]:
                    if not viewer.tell(message):
                        del self.viewers[viewer.number]
                        viewer.cut_off()
            last = now
        await asyncio.sleep(FAREWELL)


def check_port(port: int) -> None:
    """Refuse a port of 127.0.0.1 that is taken, before any long work.

    Raises
    ------
    ArtefactError
        As for :func:`serve`.
    """
    try:
        socket.create_server((HOST, port)).close()
    except OSError as error:
        raise _taken(port, error) from error


def _taken(port: int, error: OSError) -> ArtefactError:
    return ArtefactError(
        f"port {port} of {HOST}",
        value=(error.strerror or str(error)).lower(),
        limit="a free port",
        remedy="Another page may be open there; leave --port out for any free one",
    )


def serve(
    show: Show, ready: Callable[[str], None], *, port: int | None = None,
    over: Callable[[], bool] = lambda: False,
) -> None:  # fmt: skip
    """Serve a show until Ctrl-C, or until it is over.

    Parameters
    ----------
    show
        What is shown.
    ready
        Called with the address once the page can be opened.
    port
        Of 127.0.0.1; by default 8417, or any free one where that is taken.
    over
        Whether the show has ended: then its viewers are told the rest, and so ends the server.

    Raises
    ------
    MissingExtraError
        Where ``websockets`` is not installed.
    ArtefactError
        For a port that is taken.
    """
    server = Server(show, port, over)

    async def until_stopped() -> None:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        with contextlib.suppress(NotImplementedError, RuntimeError):  # Windows; another thread
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, stop.set)
        await server.run(ready, stop)

    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(until_stopped())
