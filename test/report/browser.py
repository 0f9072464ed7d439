# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium for tests, driven over the DevTools protocol through a pipe: no driver, port or network.

``Browser.open`` loads a page in a window of any size; the ``Tab`` runs scripts in it, moves a real mouse and
keeps every error, warning and request that the page made.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--remote-debugging-pipe",
)
PATIENCE = 60.0
"""Seconds for any one answer."""


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """A browser with its profile in ``folder``, ended at the end; skips the test where there is none."""
    found = next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip("no Chromium or Chrome on this machine")
    (its_in, to), (back, its_out) = (_high(os.pipe()) for _ in range(2))

    def connect() -> None:
        os.dup2(its_in, 3)  # where --remote-debugging-pipe listens
        os.dup2(its_out, 4)

    process = subprocess.Popen(
        [found, *FLAGS, f"--user-data-dir={folder / 'profile'}", "about:blank"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=connect,
        close_fds=False,
    )
    os.close(its_in)
    os.close(its_out)
    made = Browser(to, back)
    try:
        made.ask("Browser.getVersion")
        yield made
    finally:
        made.tell("Browser.close")
        os.close(to)
        try:
            process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        os.close(back)


def _high(ends: tuple[int, int]) -> tuple[int, ...]:
    """The same pipe at numbers that do not collide with 3 and 4."""
    moved = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends)
    for end in ends:
        os.close(end)
    return moved


class Browser:
    """Messages to and from the browser: JSON, each ended by a zero byte."""

    def __init__(self, to: int, back: int) -> None:
        self._to, self._back, self._rest, self._number = to, back, b"", 0
        self.events: list[dict[str, Any]] = []

    def open(self, page: Path | str, width: int = 1280, height: int = 900, *, javascript: bool = True) -> Tab:
        """Load a page, a file or an address, and wait until it has loaded."""
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        tab = Tab(self, session)
        for domain in ("Page", "Runtime", "Log", "Network"):
            tab.ask(f"{domain}.enable")
        tab.ask(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
        )
        tab.ask("Emulation.setScriptExecutionDisabled", value=not javascript)
        tab.ask("Page.navigate", url=page if isinstance(page, str) else page.resolve().as_uri())
        self.wait(lambda: any(e["method"] == "Page.loadEventFired" for e in tab.events))
        return tab

    def tell(self, method: str, session: str | None = None, **parameters: Any) -> int:
        """Send a command; returns its number."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        message |= {} if session is None else {"sessionId": session}
        os.write(self._to, json.dumps(message).encode() + b"\0")
        return self._number

    def ask(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Send a command and wait for its answer."""
        number, found = self.tell(method, session, **parameters), []

        def answered() -> bool:
            found.extend(e for e in self.events if e.get("id") == number)
            return bool(found)

        self.wait(answered)
        assert "error" not in found[0], (method, found[0]["error"])
        result: dict[str, Any] = found[0]["result"]
        return result

    def wait(self, condition: Any) -> None:
        """Read what comes until ``condition()``."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            left = deadline - time.monotonic()
            assert left > 0 and select.select([self._back], [], [], left)[0], "the browser does not answer"
            *messages, self._rest = (self._rest + os.read(self._back, 1 << 20)).split(b"\0")
            self.events += [json.loads(m) for m in messages]


class Tab:
    """A page that was loaded."""

    def __init__(self, browser: Browser, session: str) -> None:
        self._browser, self._session = browser, session

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command to this page."""
        return self._browser.ask(method, self._session, **parameters)

    @property
    def events(self) -> list[dict[str, Any]]:
        """What this page reported."""
        return [e for e in self._browser.events if e.get("sessionId") == self._session and "method" in e]

    @property
    def problems(self) -> list[str]:
        """Errors and warnings: exceptions, console, and the browser's own log (refused requests among them)."""
        self.run("")  # what was reported before its answer has arrived with it
        kinds = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
        return [json.dumps(e["params"]) for e in self.events if e["method"] in kinds]

    @property
    def requests(self) -> list[str]:
        """Addresses that were asked for; what is in the page itself (``data:``) is left out."""
        found = [e for e in self.events if e["method"] == "Network.requestWillBeSent"]
        urls = [e["params"]["request"]["url"] for e in found]
        return [url for url in urls if not url.startswith("data:")]

    def run(self, script: str) -> Any:
        """The value that the body of an async function returns in the page."""
        text = f"(async () => {{ {script} }})()"
        answer = self.ask("Runtime.evaluate", expression=text, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """``mousePressed``, ``mouseMoved``, ``mouseReleased`` or ``mouseWheel`` at a place in the window."""
        self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, *places: tuple[float, float]) -> None:
        """Press at the first place, move over the others, release at the last; one place is a click."""
        self.mouse("mousePressed", *places[0], button="left", clickCount=1)
        for place in places[1:]:
            self.mouse("mouseMoved", *place, button="left", buttons=1)
        self.mouse("mouseReleased", *places[-1], button="left", clickCount=1)

    def touch(self, kind: str, *fingers: tuple[float, float]) -> None:
        """``touchStart``, ``touchMove`` or ``touchEnd`` with all fingers that are down."""
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(fingers)]
        self.ask("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    def key(self, name: str) -> None:
        """Press and release a key."""
        code = {"text": name} if len(name) == 1 else {}
        self.ask("Input.dispatchKeyEvent", type="keyDown", key=name, **code)
        self.ask("Input.dispatchKeyEvent", type="keyUp", key=name)

    def paper(self) -> bytes:
        """The page as PDF, A4 by its own style."""
        return base64.b64decode(self.ask("Page.printToPDF", preferCSSPageSize=True)["data"])
