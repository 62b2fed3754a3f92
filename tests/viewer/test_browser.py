"""The live viewer in a real browser: frames come, controls change them, two at once.

Without a browser or viser these tests are skipped; `make page-test` brings a browser in.
"""

import time

import numpy as np
import pytest
from browser import browser, installed

from univoxel.output.page import PageOptions
from univoxel.viewer import render_queue
from univoxel.viewer.server import serving

pytest.importorskip("viser")
pytestmark = pytest.mark.skipif(
    installed() is None, reason="needs a browser, such as Debian's package chromium"
)
PATIENCE = 120.0  # seconds, on a loaded machine
LEFT = (slice(100, 400), slice(100, 330))  # of the window, where nothing lies over the object


@pytest.fixture(scope="module")
def address(subject):
    """Pictures at rest are small, and so soon done."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render_queue, "REST_WIDTH", 320)
        with serving(subject, PageOptions(title="Balls"), port=0) as address:
            yield address


@pytest.fixture(scope="module")
def tab(address):
    with browser() as tab:
        tab.open(address, 760, 500)
        until(lambda: seen(tab).std() > 20)
        yield tab


def until(true):
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end
        time.sleep(0.1)


def seen(tab):
    return tab.screenshot()[LEFT].astype(float)


def rested(tab):
    """The picture after it has not changed for a while."""
    last, same = seen(tab), 0
    end = time.monotonic() + PATIENCE
    while same < 3 and time.monotonic() < end:
        time.sleep(0.3)
        now = seen(tab)
        same = same + 1 if np.abs(now - last).mean() < 0.3 else 0
        last = now
    return last


def test_dragging_shows_another_side(tab):
    before = rested(tab)
    tab.drag((200, 250), (300, 260))
    assert np.abs(rested(tab) - before).mean() > 3


def test_a_click_shows_the_light_at_a_point(tab):
    """A picture of it in the panel; beside the object a click shows nothing."""
    shown = """[...document.querySelectorAll("img")].filter(
        (image) => image.naturalWidth == 288 && image.naturalHeight == 144 && image.offsetWidth
    ).map((image) => image.src)"""
    click(tab, 30, 30)
    time.sleep(1)
    assert tab.run(shown) == []
    click(tab, 370, 250)
    until(lambda: len(tab.run(shown)) == 1)
    (before,) = tab.run(shown)
    click(tab, 360, 290)
    until(lambda: tab.run(shown) != [before])


def test_a_box_is_shown_as_the_option_that_it_is(tab):
    """A click on the object ends it there, and shows no light at a point."""
    option = """[...document.querySelectorAll("code")].map((code) => code.textContent).find(
        (text) => text.startsWith("--box") && text.split(" ").length == 7
    )"""
    tab.run("""[...document.querySelectorAll("label")].find(
        (label) => label.textContent.trim() == "box"
    ).click()""")
    until(lambda: tab.run(option))
    before = [float(value) for value in tab.run(option).split()[1:]]
    assert all(low < high for low, high in zip(before[:3], before[3:], strict=True))
    click(tab, 370, 250)
    until(lambda: tab.run(option).split()[3] != f"{before[2]:.4g}")
    after = [float(value) for value in tab.run(option).split()[1:]]
    assert after[:2] == before[:2]
    assert after[3:] == before[3:]
    assert before[2] < after[2] < before[5]


def click(tab, x, y):
    tab.mouse("mouseMoved", x, y)
    tab.mouse("mousePressed", x, y, button="left", clickCount=1)
    tab.mouse("mouseReleased", x, y, button="left", clickCount=1)


def test_a_turntable_is_sent(tab, monkeypatch):
    """As a download, in a form that the installation can write."""
    monkeypatch.setattr(render_queue, "FRAMES", 2)
    tab.run("""
        window.sent = [];
        const made = URL.createObjectURL;
        URL.createObjectURL = (blob) => { window.sent.push(blob.size); return made(blob); };
    """)
    press = """[...document.querySelectorAll("button")].find(
        (button) => button.textContent.trim() == "turntable"
    )"""
    tab.run(f"{press}.click()")
    until(lambda: tab.run("window.sent.length"))
    until(lambda: not tab.run(f"{press}.disabled"))


def test_nothing_is_asked_of_others(tab, address):
    ours = (address, "data:", f"blob:{address}")
    assert [url for url in tab.requests if not url.startswith(ours)] == []


def test_two_at_once_and_one_goes(address, tab):
    with browser() as other:
        other.open(address, 760, 500)
        until(lambda: seen(other).std() > 20)
        other.drag((200, 250), (260, 250))  # and away in the middle of its frames
    before = rested(tab)
    tab.drag((200, 250), (300, 260))
    assert np.abs(rested(tab) - before).mean() > 3
