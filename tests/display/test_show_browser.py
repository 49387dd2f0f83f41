"""The live page in a real browser: it is opened, poked, changed, left and replayed.

Debian's chromium through Playwright; where either is missing these tests say so and are skipped.
What is asserted is the state that the page exposes as ``window.undertow``, and one screenshot.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from undertow.cli.show import show  # noqa: F401 - what is tested here
from undertow.display.live import saved_page
from undertow.display.sketches import sketch
from undertow.mechanisms import LIBRARY
from undertow.studies.live import of_run
from undertow.studies.live.planner import Task, cascade_for
from undertow.studies.live.recorded import recording_of

pytest.importorskip("websockets", reason="the extra 'show' is not installed")
playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((found for name in NAMES if (found := shutil.which(name))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason=f"no browser found: {', '.join(NAMES)}"),
]

#: Where the tip of the figure is on the screen, px.
TIP = """(() => { const f = undertow.frame, k = 2 * undertow.hello.count - 2;
          return undertow.pixel(f.points[k], f.points[k + 1]); })()"""


class Browser:
    """A browser, and whatever it complained of or asked others for."""

    def __init__(self, engine: Any) -> None:
        self.engine, self.said, self.asked = engine, list[str](), list[str]()

    def open(self, address: str, **how: Any) -> Any:
        page = self.engine.new_page(**({"viewport": {"width": 1280, "height": 820}} | how))
        page.on("console", lambda m: self.said.append(m.text))
        page.on("pageerror", lambda error: self.said.append(str(error)))
        root = address.rsplit("/", 1)[0]
        page.on("request", lambda r: self.asked.extend([r.url] * (not r.url.startswith(root))))
        page.goto(address)
        return page


def until(page: Any, what: str, seconds: float = 30.0) -> None:
    """Wait until an expression is true; the page lets nobody evaluate from within."""
    end = time.monotonic() + seconds
    while not page.evaluate(what):
        assert time.monotonic() < end, (what, page.evaluate("undertow.state"))
        page.wait_for_timeout(30)


def reset(page: Any) -> None:
    """Press Reset and wait until what the page shows is of the new motion."""
    page.evaluate("window.before = undertow.bounds")
    page.click("#reset")
    until(page, "undertow.bounds !== before", 20)  # a new list for every motion


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with playwright.sync_playwright() as engine:
        made = engine.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        found = Browser(made)
        yield found
        made.close()
        # A page that has lost its server says so; that is what one test is about.
        assert [text for text in found.said if "ERR_CONNECTION_REFUSED" not in text] == []
        assert [url for url in found.asked if not url.startswith("data:")] == []


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """The page of ``undertow show rotary_pendulum``, served by a process of its own."""
    words = ["show", "rotary_pendulum", "--no-browser", "--port", "0", "--set", "d_e=0.025"]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        [sys.executable, "-m", "undertow", *words], stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL, text=True, env=environment,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        found = re.search(r"http://\S+", process.stdout.readline())
        assert found
        yield found[0]
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0


@pytest.fixture
def page(browser: Browser, address: str) -> Iterator[Any]:
    """The page, its simulation at the start with everything as usual."""
    made = browser.open(address)
    until(made, "window.undertow && undertow.hello", 60)
    made.evaluate("document.getElementById('defaults').click()")
    made.evaluate("document.getElementById('speed').value = 1")
    made.keyboard.press("1")
    if made.evaluate("undertow.state.paused"):
        made.click("#pause")
    reset(made)
    until(made, "undertow.frames.length && undertow.frames.at(-1).t < 1", 20)
    until(made, "undertow.state.mode === 'running' && undertow.plans.length > 0", 240)
    yield made
    made.close()


def test_it_balances_at_sixty_frames(page: Any) -> None:
    """The pendulum comes upright; the page is drawn at the screen's rate; no stale words."""
    until(page, "undertow.frame?.t > 2.5")
    assert abs(page.evaluate("undertow.frame.x[1]")) < 0.05
    assert page.evaluate("undertow.state.fps") > 40
    assert page.inner_text("#mode") in ("On its way", "At the target")
    assert page.evaluate("undertow.plans.filter(p => p.accepted).length") > 5
    assert "taken" in page.evaluate(
        "getComputedStyle(document.querySelector('#plans .yes b'), '::after').content"
    )


def test_every_button_and_key_does_what_it_says(page: Any) -> None:
    """Pause, step, slow motion, reset and push, by mouse and by key."""
    page.click("#pause")
    until(page, "undertow.state.paused")
    assert page.inner_text("#pause") == "Play"
    t = page.evaluate("undertow.frames.at(-1).t")
    page.click("#step")
    until(page, f"undertow.frames.at(-1).t > {t + 0.012} && undertow.frames.at(-1).t < {t + 0.03}")
    page.locator("#scene").focus()
    page.keyboard.press("Space")
    until(page, "!undertow.state.paused")
    page.keyboard.press("3")
    until(page, "undertow.state.speed === 0.2")
    page.select_option("#speed", "1")
    until(page, "undertow.state.speed === 1")
    # Pushed at rest: the arm goes after the rod, which turns for less than a picture.
    followed: dict[str, Callable[[], None]] = {
        "< -0.4": lambda: page.click("#right"),
        "> 0.4": lambda: page.keyboard.press("ArrowLeft"),
    }
    for driven, press in followed.items():
        until(page, "undertow.frames.slice(-20).every(f => Math.abs(f.x[2]) < 0.1)")
        t = page.evaluate("undertow.frames.at(-1).t")
        page.locator("#scene").focus()
        press()
        until(page, f"undertow.frames.some(f => f.t > {t} && f.x[2] {driven})", 10)
    page.keyboard.press("r")
    until(page, "undertow.frame && undertow.frame.t < 1", 5)


def slide(page: Any, name: str, value: float) -> None:
    """Move a slider to a value, as a person would see it move."""
    page.evaluate(
        """([name, value]) => { const input =
        document.querySelector(`.control[data-name="${name}"] input`);
        input.closest('details')?.setAttribute('open', '');
        input.value = value; input.dispatchEvent(new Event('input', {bubbles: true})); }""",
        [name, value],
    )
    until(
        page, f"Math.abs(undertow.controls['{name}'].value - {value}) < 1e-5 * {abs(value)} + 1e-9"
    )


def test_every_control_does_what_it_says(page: Any) -> None:
    """All sliders arrive; target, objective and limit show in plans and inputs; then as usual."""
    until(page, "undertow.frame?.t > 1.5")
    slide(page, "target theta", 40.0)
    until(page, "Math.abs(undertow.plans.at(-1)?.goal[0] - 0.698) < 1e-3")
    page.select_option('.control[data-name="objective"] select', "energy")
    until(page, "undertow.plans.at(-1)?.objective === 'energy'", 180)
    slide(page, "limit voltage", 5.0)
    slide(page, "push", 2.0)
    page.click("#left")
    page.wait_for_timeout(600)
    assert (
        page.evaluate("Math.max(...undertow.frames.slice(-20).map(f => Math.abs(f.u[0])))") <= 5.0
    )
    for one in page.evaluate("Object.values(undertow.controls)"):
        if not one["choices"]:
            slide(page, one["name"], 0.5 * (one["usual"] + one["high"]))
    page.click("#defaults")
    until(page, "Object.values(undertow.controls).every(c => c.value === c.usual)")


def test_the_pendulum_is_grabbed_thrown_and_caught_again(page: Any) -> None:
    """A pull that it survives; one that throws it down, which is said; a lift that is caught."""
    until(page, "undertow.frame?.t > 2.5")
    x, y = page.evaluate(TIP)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 15, y, steps=4)
    until(page, "undertow.frame.held && undertow.frame.held.length === 1")
    until(page, "document.getElementById('mode').textContent === 'Held by hand'", 5)
    page.mouse.up()
    until(page, "!undertow.frames.at(-1).held")
    page.wait_for_timeout(1500)
    assert page.evaluate("undertow.state.mode") == "running"
    x, y = page.evaluate(TIP)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 250, y + 250, steps=5)
    until(page, "undertow.state.mode === 'fallen'", 10)
    until(page, "document.getElementById('banner').innerText.includes('It has fallen.')", 5)
    assert page.is_visible("#banner button")
    # Drawn up over the hinge, wherever that goes, until the law takes over; then let go.  What
    # slips is drawn up again, as a person would.
    for _ in range(6):
        end = time.monotonic() + 8
        while page.evaluate("undertow.state.mode") != "running" and time.monotonic() < end:
            over = page.evaluate(
                "undertow.pixel(undertow.frame.points[6], undertow.frame.points[7])"
            )
            rod = page.evaluate("undertow.pixel(0, 0)[1] - undertow.pixel(0, 0.335)[1]")
            page.mouse.move(over[0], over[1] - 1.2 * rod)
            page.wait_for_timeout(20)
        page.mouse.up()
        page.wait_for_timeout(2500)
        if page.evaluate("undertow.state.mode") == "running":
            break
        page.mouse.move(*page.evaluate(TIP))
        page.mouse.down()
    assert page.evaluate("undertow.state.mode") == "running"
    until(page, "undertow.frames.slice(-20).every(f => Math.abs(f.x[1]) < 0.2)", 10)


def test_a_finger_pulls_as_a_mouse_does(browser: Browser, page: Any, address: str) -> None:
    """On a touch screen: what is taken hold of follows the finger, and is let go with it."""
    phone = browser.open(address, viewport={"width": 390, "height": 844}, has_touch=True)
    until(phone, "window.undertow && undertow.frame && undertow.state.mode === 'running'", 60)
    until(phone, "undertow.frame?.t > 2")
    x, y = phone.evaluate(TIP)
    touch = phone.context.new_cdp_session(phone)
    for kind, points in (
        ("touchStart", [{"x": x, "y": y}]),
        ("touchMove", [{"x": x + 6, "y": y}]),
        ("touchMove", [{"x": x + 12, "y": y}]),
    ):
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    until(phone, "undertow.frame.held && undertow.frame.held.length === 1", 10)
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    until(phone, "!undertow.frames.at(-1).held", 10)
    assert phone.evaluate("document.documentElement.scrollWidth") <= 390
    phone.close()


def test_bound_map_and_ensemble_stand_beside_the_motion(page: Any) -> None:
    """The map is of the plane that is chosen; the bound is no dearer than what was predicted; the
    ensemble closes in."""
    until(page, "undertow.region?.axis === 1", 120)
    until(page, "/home|proved/.test(document.getElementById('region').innerText)")
    cells = page.evaluate("undertow.region.cells")
    assert len(cells) == page.evaluate("undertow.region.side ** 2")
    assert set(cells) <= {"0", "1", "2"}
    assert cells[len(cells) // 2] == "2"  # the target itself
    assert page.evaluate("undertow.region.proved.length") == 4
    page.select_option("#axis", "0")
    until(page, "undertow.region?.axis === 0", 60)
    page.select_option("#axis", "1")
    reset(page)
    if importlib.util.find_spec("casadi"):
        until(page, "undertow.bounds.some(b => b.cost > 0)", 60)
        until(page, "document.getElementById('legend-cost').innerText.includes('best of all')")
        found = page.evaluate("undertow.bounds.find(b => b.cost > 0).cost")
        first = page.evaluate("undertow.plans.find(p => p.first).predicted")
        assert 0.9 * first < found < 1.02 * first
        page.click("#right")  # from here on it is another motion
        until(page, "undertow.bounds.at(-1)?.cost === null", 10)
    span = "(p => p.plausible.map(r => Math.max(...r.members) - Math.min(...r.members)))"
    page.evaluate(f"window.wide = {span}(undertow.plans[0])")
    assert page.evaluate("wide.length") > 4
    thinner = f"{span}(undertow.plans.at(-1)).reduce((sum, v, k) => sum + v / wide[k], 0)"
    until(page, f"{thinner} < 0.9 * wide.length")
    assert page.is_visible("#plausible")


def test_charts_begin_with_the_motion(page: Any) -> None:
    """After a reset the axis of time starts at zero: nothing was before."""
    page.click("#pause")
    reset(page)
    until(page, "undertow.frames.length > 0 && undertow.frames[0].t < 0.2", 20)
    until(page, "document.querySelector('#states canvas')")
    page.wait_for_timeout(300)
    assert page.evaluate("undertow.window.min") >= 0.0
    assert page.evaluate("undertow.window.max") >= 1.0
    page.click("#pause")


def test_two_viewers_ten_reconnects_and_a_closed_lid(
    page: Any, browser: Browser, address: str
) -> None:
    """What one viewer changes the other sees; who was away comes back to the present."""
    other = browser.open(address)
    until(other, "window.undertow && undertow.state.connected && undertow.frame")
    slide(other, "push", 3.0)
    until(page, "undertow.controls.push.value === 3")
    for _ in range(10):
        page.evaluate("undertow.disconnect()")
        until(page, "!undertow.state.connected", 5)
        until(page, "undertow.state.connected", 10)
    until(page, "undertow.frames.at(-1).t > 0.5")
    session = other.context.new_cdp_session(other)
    session.send("Page.setWebLifecycleState", {"state": "frozen"})
    t = page.evaluate("undertow.frame.t")
    until(page, f"undertow.frame?.t > {t + 2}", 10)  # nobody waited for it
    session.send("Page.setWebLifecycleState", {"state": "active"})
    until(other, f"undertow.frame && undertow.frame?.t > {t + 2}", 15)
    assert abs(other.evaluate("undertow.frame.t") - page.evaluate("undertow.frame.t")) < 0.5
    other.close()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A saved page of a short motion."""
    rig = LIBRARY["cart_pendulum"]()
    cascade = cascade_for(rig, Task("bench-energy", tuple(rig.input_limits.tolist()), 0.1))
    path = tmp_path_factory.mktemp("saved") / "page.html"
    path.write_bytes(saved_page(of_run(cascade.simulate(), cascade, sketch(rig))))
    return path


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_a_saved_page_replays_anywhere(
    browser: Browser, recorded: Path, scheme: str, width: int
) -> None:
    """From file://, with a time bar, wide and narrow, light and dark; nothing is cut off."""
    page = browser.open(
        f"file://{recorded}", viewport={"width": width, "height": 820}, color_scheme=scheme
    )
    until(page, "undertow.state.playing && undertow.state.shown > 0.3")
    page.locator("#scene").focus()
    page.keyboard.press("Space")
    until(page, "!undertow.state.playing")
    t = page.evaluate("undertow.state.shown")
    page.wait_for_timeout(200)
    assert page.evaluate("undertow.state.shown") == t
    page.evaluate(
        "(() => { const bar = document.getElementById('time'); bar.value = bar.max; "
        "bar.dispatchEvent(new Event('input')); })()"
    )
    until(page, "undertow.state.shown === undertow.frames.at(-1).t")
    page.click("#reset")  # here it means "to the start"
    until(page, "undertow.state.shown < 0.5")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert not page.is_visible("#controls")
    back = page.evaluate("getComputedStyle(document.documentElement).backgroundColor")
    assert (back == "rgb(255, 255, 255)") == (scheme == "light")
    page.close()


def test_every_mechanism_is_drawn(browser: Browser, tmp_path: Path) -> None:
    """All thirteen at their usual starts: a figure within the picture, and labels of its own."""
    for name, make in LIBRARY.items():
        mechanism = make()
        x = np.array([mechanism.usual_start, 0.5 * mechanism.usual_start])
        none = np.zeros((2, mechanism.m))
        message = recording_of(
            mechanism, sketch(mechanism), np.array([0.0, 0.1]), x, none, none, none, np.ones(2), []
        )
        path = tmp_path / f"{name}.html"
        path.write_bytes(saved_page(message))
        page = browser.open(f"file://{path}")
        until(page, "undertow.frame && document.getElementById('legend-states').children.length")
        left, top = page.evaluate(TIP)
        box = page.locator("#scene").bounding_box()
        assert box["x"] < left < box["x"] + box["width"], name
        assert box["y"] < top < box["y"] + box["height"], name
        page.wait_for_timeout(150)
        image = Image.open(BytesIO(page.locator("#scene").screenshot())).convert("RGB")
        picture = np.asarray(image, dtype=int)
        inked = np.abs(picture - picture[-1, 0]).max(axis=2) > 60
        assert inked.sum() > 300, name
        assert page.inner_text("#name").lower() == name.replace("_", " ")
        page.close()


def test_a_recording_looks_the_same_twice(browser: Browser, recorded: Path) -> None:
    """The same moment gives the same picture to 2 % of its points, and one with something in it."""
    pictures = []
    for _ in range(2):
        page = browser.open(f"file://{recorded}")
        until(page, "undertow.frames.length > 10")
        page.evaluate(
            "(() => { const bar = document.getElementById('time'); bar.value = 0.5; "
            "bar.dispatchEvent(new Event('input')); })()"
        )
        page.wait_for_timeout(600)
        image = Image.open(BytesIO(page.screenshot())).convert("RGB")
        pictures.append(np.asarray(image, dtype=int))
        page.close()
    differ = (np.abs(pictures[0] - pictures[1]).max(axis=2) > 24).mean()
    assert differ < 0.02
    assert (np.abs(pictures[0] - pictures[0][0, 0]).max(axis=2) > 24).mean() > 0.02
