"""A headless Chromium over its debugging protocol: pages are opened, asked and photographed."""

from __future__ import annotations

import base64
import itertools
import json
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
"""None where none is installed."""


class Page:
    """One page of a browser."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)

    def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the protocol, and return its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=20))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def value(self, code: str) -> Any:
        """The value of an expression of JavaScript on the page."""
        result = self.call("Runtime.evaluate", expression=code, returnByValue=True, userGesture=True)
        return result["result"].get("value")

    def until(self, code: str) -> Any:
        """Wait up to ten seconds until the expression is true, and return it."""
        for _ in range(200):
            found = self.value(code)
            if found:
                return found
            time.sleep(0.05)
        raise AssertionError(f"never true: {code}")

    def photograph(self, url: str = "", *, until: str = "document.readyState === 'complete'") -> bytes:
        """PNG of the window, after going to an address where one is given."""
        if url:
            self.call("Page.navigate", url=url)
        self.until(until)
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])


@contextmanager
def opened(profile: Path, *, width: int, height: int) -> Iterator[Page]:
    """A blank page of a browser of its own, in a window of so many pixels."""
    words = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-port=0"]
    process = subprocess.Popen(
        [str(BROWSER), *words, f"--user-data-dir={profile}", "about:blank"],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    assert process.stderr is not None
    found = None
    while found is None:
        found = re.search(r"ws://\S+", process.stderr.readline())
    browser = found[0]
    with connect(browser, max_size=None) as socket:
        target = Page(socket).call("Target.createTarget", url="about:blank")["targetId"]
        with connect(re.sub(r"/devtools/.*", f"/devtools/page/{target}", browser), max_size=None) as tab:
            page = Page(tab)
            size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            page.call("Emulation.setDeviceMetricsOverride", **size)
            yield page
    process.terminate()
    process.wait()
    process.stderr.close()
