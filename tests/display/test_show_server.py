"""The server of the live page, without a browser: who is let in, what a slow viewer costs."""

from __future__ import annotations

import asyncio
import json
import re
import socket
import sys
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from runs import RECIPE
from undertow.base import ArtefactError, InvalidInputError, MissingExtraError
from undertow.cascade import CascadeState
from undertow.cli import app
from undertow.display.live import Message, saved_page
from undertow.display.live.page import FILES, content, encoded
from undertow.display.live.server import FAREWELL, OTHERS, PICTURES, Server, Viewer
from undertow.runtime import Columns, InlineWorker, Log, Runtime, SimulatedClock, about
from undertow.studies.live import of_log

websockets = pytest.importorskip("websockets")


class Counting:
    """A show that counts."""

    def __init__(self, size: int = 1) -> None:
        self.ticks, self.size = 0, size
        self.heard: list[tuple[Message, int]] = []
        self.left: list[int] = []

    def hello(self) -> Message:
        return {"kind": "hello", "ticks": self.ticks}

    def advance(self, seconds: float) -> list[Message]:
        self.ticks += 1
        return [{"kind": "frame", "t": self.ticks, "filler": "x" * self.size}]

    def hear(self, said: Message, viewer: int) -> None:
        if said.get("do") == "wrong":
            raise InvalidInputError("wish", value="wrong", limit="right")
        self.heard.append((said, viewer))

    def gone(self, viewer: int) -> None:
        self.left.append(viewer)


def serving(show: Counting, look: Callable[[Server], Awaitable[None]]) -> None:
    """Serve a show while something looks at it."""

    async def both() -> None:
        server, stop = Server(show, 0), asyncio.Event()
        ready = asyncio.Event()
        running = asyncio.ensure_future(server.run(lambda _: ready.set(), stop))
        await asyncio.wait_for(ready.wait(), 5)
        try:
            await asyncio.wait_for(look(server), 30)
        finally:
            stop.set()
            await asyncio.wait_for(running, 15)

    asyncio.run(both())


def connected(server: Server, **how: Any) -> Any:
    address = server.address.replace("http", "ws") + "socket"
    how.setdefault("origin", server.address.split(f"/{server.token}")[0])
    return websockets.connect(address, proxy=None, **how)


async def fetched(address: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    def get() -> tuple[int, dict[str, str], bytes]:
        request = urllib.request.Request(address, headers=headers)
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        try:
            with opener.open(request, timeout=5) as answer:
                return answer.status, dict(answer.headers), answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, dict(error.headers), error.read()

    return await asyncio.to_thread(get)


def test_a_viewer_that_no_longer_answers_does_not_hold_up_the_end() -> None:
    """Ctrl-C waited ten seconds for a suspended page to say goodbye."""

    async def look(server: Server) -> None:
        async with connected(server) as line:
            await line.recv()
            (viewer,) = server.viewers.values()
            assert viewer.socket.close_timeout == FAREWELL

    serving(Counting(), look)


def test_the_page_is_for_those_who_have_its_address() -> None:
    """With its token all files come; without it, under another name, or elsewhere, nothing."""

    async def look(server: Server) -> None:
        assert server.address.startswith("http://127.0.0.1:")
        for name in ("", *FILES):
            status, headers, body = await fetched(server.address + name)
            assert status == 200
            assert body == content(name or "index.html")
            assert "default-src 'self'" in headers["Content-Security-Policy"]
        root = server.address.split(server.token)[0]
        for path in ("", "wrong/", f"{server.token[:-1]}/", "show.js"):
            assert (await fetched(root + path))[0] == 403
        for path in ("../server.py", "nothing.js", "%2e%2e/server.py"):
            assert (await fetched(server.address + path))[0] == 404
        assert (await fetched(server.address, Host="evil.example"))[0] == 403
        assert (await fetched(server.address, Origin="http://evil.example"))[0] == 403
        assert (await fetched(server.address.rstrip("/")))[2] == content("index.html")

    serving(Counting(), look)


def test_another_page_opens_no_socket() -> None:
    """A second origin, none at all, and a wrong token are refused before anything is said."""

    async def look(server: Server) -> None:
        for origin in ("http://evil.example", None, f"http://127.0.0.1:{server.port + 1}"):
            with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
                async with connected(server, origin=origin):
                    pass
        server.token = "another"
        with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
            async with websockets.connect(
                f"ws://127.0.0.1:{server.port}/wrong/socket", proxy=None,
                origin=f"http://127.0.0.1:{server.port}",
            ):  # fmt: skip
                pass
        assert not server.viewers

    show = Counting()
    serving(show, look)
    assert show.heard == []


def test_two_viewers_see_the_same_and_leave() -> None:
    """Each is told everything first; what one asks for is heard; who leaves lets go."""

    async def look(server: Server) -> None:
        async with connected(server) as one, connected(server) as two:
            for viewer in (one, two):
                assert json.loads(await viewer.recv())["kind"] == "hello"
                first, second = [json.loads(await viewer.recv()) for _ in range(2)]
                assert second["t"] > first["t"]
            await one.send('{"do":"grab","at":[0,0]}')
            await two.send('{"do":"wrong"}')
            await two.send("{")
            await two.send("[]")
            notes: list[str] = []
            while len(notes) < 3:
                said = json.loads(await two.recv())
                notes += [said["text"]] if said["kind"] == "note" else []
            assert "wish: got wrong, must be right" in notes[0]
            assert all("not understood" in text for text in notes[1:])
        for _ in range(100):
            if len(show.left) == 2:
                break
            await asyncio.sleep(0.02)

    show = Counting()
    serving(show, look)
    assert show.heard == [({"do": "grab", "at": [0, 0]}, 1)]
    assert sorted(show.left) == [1, 2]


def test_ten_reconnects() -> None:
    """Whoever comes back is told everything anew."""

    async def look(server: Server) -> None:
        for _ in range(10):
            async with connected(server) as viewer:
                assert json.loads(await viewer.recv())["kind"] == "hello"
        for _ in range(100):
            if not server.viewers:
                break
            await asyncio.sleep(0.02)
        assert not server.viewers

    serving(Counting(), look)


def test_a_viewer_who_does_not_read_slows_nobody() -> None:
    """A closed lid: what waits for it is bounded, the show keeps its 60 a second, others see it."""

    async def look(server: Server) -> None:
        async with connected(server, max_queue=1) as asleep, connected(server) as awake:
            await asleep.recv()
            before, seen = show.ticks, 0
            loop = asyncio.get_running_loop()
            until = loop.time() + 2.0
            while loop.time() < until:
                seen += json.loads(await awake.recv())["kind"] == "frame"
            ticks = show.ticks - before
            assert ticks > 60  # of 120, on a machine that is busy
            assert seen > 0.8 * ticks
            sleeper = server.viewers[1]
            assert sleeper.missed > 0
            assert len(sleeper.pictures) <= PICTURES
            asleep.transport.abort()

    show = Counting(size=60_000)
    serving(show, look)


def test_a_viewer_misses_pictures_and_no_decisions() -> None:
    """Of pictures the latest wait; of the rest all, up to a number: then the viewer is cut off."""

    async def look() -> None:
        viewer = Viewer(1, None)
        for k in range(3 * PICTURES):
            assert viewer.tell({"kind": "frame", "t": k})
        for k in range(OTHERS):
            assert viewer.tell({"kind": "plan", "t": k})
        assert not viewer.tell({"kind": "plan", "t": OTHERS})
        waiting = await viewer.next()
        assert [m["t"] for m in waiting if m["kind"] == "plan"] == [*range(OTHERS)]
        frames = [m["t"] for m in waiting if m["kind"] == "frame"]
        assert frames == [*range(2 * PICTURES, 3 * PICTURES)]

    asyncio.run(look())


def test_a_port_that_is_taken_is_said() -> None:
    """The one that was asked for: which, and what to do; otherwise any free one is taken."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        asked = CliRunner().invoke(app, ["show", "rotary_pendulum", "--port", str(port)])
        assert (asked.exit_code, "making ready" in asked.output) == (1, False)  # before the work
        server = Server(Counting(), port)
        with pytest.raises(ArtefactError, match=f"port {port} of 127.0.0.1.*leave --port out"):
            asyncio.run(server.run(lambda _: None, asyncio.Event()))
    with pytest.raises(InvalidInputError, match="0 to 65535"):
        Server(Counting(), 70_000)


def test_a_missing_extra_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """One line, before anything is computed."""
    monkeypatch.setitem(sys.modules, "websockets", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'undertow\[show\]'"):
        Server(Counting())
    said = CliRunner().invoke(app, ["show", "rotary_pendulum"])
    assert said.exit_code == 1
    assert "pip install 'undertow[show]'" in said.output


def test_numbers_are_short_and_what_is_none_is_null() -> None:
    """Six digits; NaN and infinity are no JSON."""
    text = encoded({"a": 1 / 3, "b": [float("nan"), float("inf"), 2], "c": None, "d": "ü"})
    assert text == '{"a":0.333333,"b":[null,null,2],"c":null,"d":"ü"}'


def test_a_saved_page_is_one_file_that_asks_nobody() -> None:
    """Scripts and styles are in it, with uPlot's licence; what a log says ends no script."""
    page = saved_page({"kind": "hello", "about": "</script><script>alert(1)</script>"}).decode()
    assert "alert(1)</script>" not in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "Leon Sorokin" in page
    assert page.count("</script>") == 3
    data = re.search(r'id="recording">(.*?)</script>', page, re.DOTALL)
    assert data is not None
    assert json.loads(data[1])["about"] == "</script><script>alert(1)</script>"


def test_a_log_becomes_a_recording_and_one_file(tmp_path: Path, memory: CascadeState) -> None:
    """Its frames and decisions, and the command that writes them into a page."""
    log, controller = tmp_path / "run.db", RECIPE.make_controller(memory)
    worker = InlineWorker(RECIPE.respond)
    with Log(log, Columns.of(RECIPE.belief), about(controller, RECIPE), threaded=False) as book:
        rig, clock = RECIPE.make_rig(), SimulatedClock()
        Runtime(controller, rig, worker, clock=clock, log=book).run(0.6)
    message = of_log(log)
    assert message["live"] is False
    assert message["frames"][-1]["t"] == pytest.approx(0.6, abs=0.02)
    assert len([one for one in message["plans"] if one["kind"] == "plan"]) >= 3
    assert {frame["mode"] for frame in message["frames"]} >= {"catch"}
    page = tmp_path / "page.html"
    said = CliRunner().invoke(app, ["show", str(log), "--save", str(page)])
    assert said.exit_code == 0, said.output
    assert b'id="recording"' in page.read_bytes()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["show", "rotary_pendlum"], "Did you mean rotary_pendulum"),
        (
            ["show", "rotary_pendulum", "--start", "phi=0.5deg", "--save", "page.html"],
            "more than 0.01",
        ),
        (["show", "nothing.db"], "log 'nothing.db'"),
        (["show", "rotary_pendulum", "--mechanism", "a.py:b"], "--mechanism"),
        (["show", "rotary_pendulum", "--objective", "glory"], "objective"),
    ],
)
def test_what_cannot_be_shown_is_one_line(words: list[str], says: str) -> None:
    """Exit 2 for a wrong word, 1 for a file that is not there."""
    said = CliRunner().invoke(app, words)
    assert said.exit_code in (1, 2)
    assert says in said.output
    assert "Traceback" not in said.output
