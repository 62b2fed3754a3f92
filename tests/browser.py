"""Headless Chromium with software WebGL, spoken to through its debugging pipe; needs no package.

Debian's package is `chromium`; scripts/system.sh brings it in.
"""

import base64
import io
import json
import os
import shutil
import subprocess
import tempfile
import time
from contextlib import contextmanager

import numpy as np
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",  # refused to root otherwise
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-default-apps",
    "--disable-extensions",
    "--disable-sync",
    "--force-color-profile=srgb",
    "--remote-debugging-pipe",
)
PATIENCE = 120.0  # seconds, for an answer of a browser that draws on a loaded processor


def installed():
    """The browser's path, or None."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Tab:
    """One tab of a browser. `requests` and `errors` are what it asked for and complained of."""

    def __init__(self, to_browser, from_browser):
        self._out, self._in = to_browser, from_browser
        self._number, self._rest, self._session = 0, b"", None
        self.requests, self.errors, self._events = [], [], []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        """Give a command and wait for its answer."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]

    def _next(self):
        until = time.monotonic() + PATIENCE
        while b"\0" not in self._rest:
            assert time.monotonic() < until, "the browser does not answer"
            read = os.read(self._in, 1 << 20)
            assert read, "the browser has ended"
            self._rest += read
        text, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(text)
        self._heard(message.get("method"), message.get("params", {}))
        return message

    def _heard(self, event, what):
        match event:
            case "Network.requestWillBeSent":
                self.requests.append(what["request"]["url"])
            case "Runtime.exceptionThrown":
                self.errors.append(what["exceptionDetails"].get("exception", {}).get("description"))
            case "Log.entryAdded" if what["entry"]["level"] == "error":
                self.errors.append(what["entry"]["text"])
            case "Runtime.consoleAPICalled" if what["type"] in ("error", "warning"):
                self.errors.append(" ".join(str(a.get("value")) for a in what["args"]))
            case "Page.loadEventFired":
                self._events.append(event)

    def window(self, width, height, phone=False):
        """Give the window a size, and a finger in place of the mouse."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        still = [{"name": "prefers-reduced-motion", "value": "reduce"}]
        self.call("Emulation.setEmulatedMedia", features=still)
        self.call("Emulation.setTouchEmulationEnabled", enabled=phone)

    def open(self, url, width=1280, height=800, phone=False):
        """Open a page in a window of some size; wait until it has loaded."""
        self.window(width, height, phone)
        self._events.clear()
        self.call("Page.navigate", url=url)
        while not self._events:
            self._next()

    def run(self, script):
        """The value of an expression; a promise's is waited for."""
        answer = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def mouse(self, kind, x, y, **more):
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, start, end, **more):
        """Press the left button, move in steps, let go."""
        self.mouse("mousePressed", *start, button="left", clickCount=1, **more)
        for i in range(1, 9):
            at = [a + (b - a) * i / 8 for a, b in zip(start, end, strict=True)]
            self.mouse("mouseMoved", *at, button="left", buttons=1, **more)
        self.mouse("mouseReleased", *end, button="left", clickCount=1, **more)

    def swipe(self, start, end):
        """Drag with one finger."""
        for i in range(9):
            kind = "touchMove" if i else "touchStart"
            x, y = (a + (b - a) * i / 8 for a, b in zip(start, end, strict=True))
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y}])
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def screenshot(self):
        """The window as [H, W, 3] bytes."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def pixels(url):
    """A PNG as a data URL as [H, W, 4] floats in [0, 1]."""
    data = base64.b64decode(url.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")) / 255


@contextmanager
def browser():
    """A tab of a browser that ends with the block."""
    to_browser, ours_out = os.pipe()
    ours_in, from_browser = os.pipe()
    with tempfile.TemporaryDirectory() as profile:
        # The browser reads from descriptor 3 and writes to 4
        inherited = f'exec 3<&{to_browser} 4>&{from_browser}; exec "$@"'
        process = subprocess.Popen(
            ["bash", "-c", inherited, "bash", installed(), *FLAGS, f"--user-data-dir={profile}"],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        try:
            yield Tab(ours_out, ours_in)
        finally:
            os.close(ours_out)
            os.close(ours_in)
            process.terminate()
            process.wait(30)
