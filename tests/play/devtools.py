"""A headless Chromium, driven by its DevTools protocol over a WebSocket."""

import itertools
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
_FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--mute-audio"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-default-apps", "--disable-extensions", "--remote-debugging-port=0"),
)


class Browser:
    """One page of a browser; requests and complaints are kept."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._numbers = itertools.count(1)
        self._session: str | None = None
        self.requests: list[str] = []
        self.complaints: list[str] = []
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(each["targetId"] for each in targets if each["type"] == "page")
        attached = self.call("Target.attachToTarget", targetId=page, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of a command."""
        number = next(self._numbers)
        message: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        self._connection.send(json.dumps(message))
        while True:
            answer = json.loads(self._connection.recv(timeout=120))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer.get("method"), answer.get("params", {}))

    def _note(self, method: str | None, event: dict[str, Any]) -> None:
        if method == "Network.requestWillBeSent":
            self.requests.append(event["request"]["url"])
        elif method == "Network.webSocketCreated":
            self.requests.append(event["url"])
        elif method == "Runtime.exceptionThrown":
            self.complaints.append(str(event["exceptionDetails"]))
        elif method == "Log.entryAdded" and event["entry"]["level"] == "error":
            self.complaints.append(str(event["entry"]))

    def open(self, url: str, width: int = 1200, height: int = 1000) -> None:
        """Shows a page in a window of this size."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.value("window.left = true")
        self.call("Page.navigate", url=url)
        self.until("!window.left && document.readyState === 'complete'")

    def value(self, expression: str) -> Any:
        """Of a JavaScript expression in the page."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, expression: str, seconds: float = 60.0) -> Any:
        """The value of an expression once it is true."""
        end = time.monotonic() + seconds
        while not (found := self.value(expression)):
            assert time.monotonic() < end, f"{expression} never became true"
            time.sleep(0.05)
        return found

    def text(self, selector: str) -> str:
        """The text of an element."""
        return self.value(f"document.querySelector({json.dumps(selector)}).textContent")

    def click(self, selector: str) -> None:
        """Clicks on the middle of an element, in view."""
        self.value(
            f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'center'}})"
        )
        box = "document.querySelector({}).getBoundingClientRect().toJSON()"
        found = self.value(box.format(json.dumps(selector)))
        place = found["x"] + found["width"] / 2, found["y"] + found["height"] / 2
        self.mouse("mousePressed", place)
        self.mouse("mouseReleased", place)

    def mouse(self, kind: str, place: tuple[float, float]) -> None:
        """An event of the mouse at a place in the window, px."""
        held = kind != "mouseReleased"
        x, y = place
        pressed = {"button": "left", "buttons": int(held), "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **pressed)

    def drag(
        self,
        begin: tuple[float, float],
        end: tuple[float, float],
        steps: int = 10,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> None:
        """Drags from a place to another."""
        self.mouse("mousePressed", begin)
        for step in range(1, steps + 1):
            share = step / steps
            place = tuple(a + share * (b - a) for a, b in zip(begin, end, strict=True))
            self.mouse("mouseMoved", (place[0], place[1]))
            time.sleep(0.02)
        meanwhile()
        self.mouse("mouseReleased", end)


@contextmanager
def browser() -> Iterator[Browser]:
    """A browser that ends with the block."""
    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [CHROMIUM, *_FLAGS, f"--user-data-dir={profile}", "about:blank"],
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            assert process.stderr is not None
            lines = iter(process.stderr.readline, "")
            address = next(line.split()[-1] for line in lines if "DevTools listening" in line)
            with connect(address, max_size=None) as connection:
                yield Browser(connection)
        finally:
            process.kill()
            process.wait()
            if process.stderr is not None:
                process.stderr.close()
