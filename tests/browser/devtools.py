"""A headless Chromium, driven through the DevTools protocol over two pipes: nothing but the standard library.

https://chromedevtools.github.io/devtools-protocol/; `--remote-debugging-pipe` reads commands from file descriptor 3
and writes answers and events to 4, each a JSON document that ends in a NUL byte.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import queue
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
    # Pages that only this program's `be_seen` calls seen are not held back as those behind others are.
    "--disable-background-timer-throttling",
    "--disable-renderer-backgrounding",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
TIMEOUT_S = 30.0


_SEEN = """Object.defineProperty(Document.prototype, 'hidden', { get: () => window.put_away === true });
window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 50);"""


class Page:
    """One page of the browser."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        target = browser.command("Target.createTarget", {"url": "about:blank"})["targetId"]
        attached = browser.command("Target.attachToTarget", {"targetId": target, "flatten": True})
        self._session: str = attached["sessionId"]
        self._target = target
        for domain in ("Page", "Runtime", "Log"):
            self.command(f"{domain}.enable")

    def command(self, method: str, parameters: dict[str, Any] | None = None) -> Any:
        return self._browser.command(method, parameters or {}, self._session)

    def close(self) -> None:
        self._browser.command("Target.closeTarget", {"targetId": self._target})

    def look(self, width: int, height: int, *, dark: bool = False) -> None:
        """Size in CSS pixels (at two device pixels each) and colour scheme."""
        size = {"width": width, "height": height, "deviceScaleFactor": 2, "mobile": width < 600}
        self.command("Emulation.setDeviceMetricsOverride", size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.command("Emulation.setEmulatedMedia", {"features": [scheme]})

    def be_seen(self) -> None:
        """A window of its own that is seen until its `put_away` is true: of several headless Chromium draws only the
        newest."""
        self.command("Page.addScriptToEvaluateOnNewDocument", {"source": _SEEN})

    def open(self, url: str) -> None:
        """Goes there and waits until the document and its scripts are loaded."""
        answer = self.command("Page.navigate", {"url": url})
        assert "errorText" not in answer, f"{url}: {answer['errorText']}"
        self.until("location.href != 'about:blank' && document.readyState == 'complete'")

    def evaluate(self, script: str) -> Any:
        """The value of an expression, awaited if it is a promise.

        Raises:
            AssertionError: the script threw.
        """
        options = {"expression": script, "awaitPromise": True, "returnByValue": True, "userGesture": True}
        answer = self.command("Runtime.evaluate", options)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, script: str, timeout_s: float = TIMEOUT_S) -> Any:
        """Waits for an expression to become truthy, and gives its value.

        Raises:
            TimeoutError: it did not; with the page's text.
        """
        deadline = time.monotonic() + timeout_s
        while not (value := self.evaluate(script)):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{script} is still {value!r}; the page says: {self.text()[:2000]}; {self.errors()}")
            time.sleep(0.05)
        return value

    def text(self, selector: str = "body") -> str:
        return str(self.evaluate(f"document.querySelector({json.dumps(selector)})?.innerText ?? ''"))

    def press(self, key: str, code: int) -> None:
        for kind in ("rawKeyDown", "keyUp"):
            event = {"type": kind, "key": key, "code": key, "windowsVirtualKeyCode": code}
            self.command("Input.dispatchKeyEvent", event)

    def drag(self, x: float, y: float, to_x: float) -> None:
        """The left button is pressed, the pointer pulled sideways, and the button let go."""
        for kind, at, pressed in (
            ("mouseMoved", x, 0),
            ("mousePressed", x, 1),
            ("mouseMoved", to_x, 1),
            ("mouseReleased", to_x, 0),
        ):
            event = {
                "type": kind,
                "x": at,
                "y": y,
                "button": "none" if kind == "mouseMoved" else "left",
                "buttons": pressed,
            }
            self.command("Input.dispatchMouseEvent", {**event, "clickCount": 1})

    def click(self, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            event = {"type": kind, "x": x, "y": y, "button": "left", "clickCount": 1}
            self.command("Input.dispatchMouseEvent", event)

    def picture(self, path: Path) -> None:
        """The whole page as a PNG."""
        size = self.command("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        shot = self.command("Page.captureScreenshot", {"clip": clip, "captureBeyondViewport": True})
        path.write_bytes(base64.b64decode(shot["data"]))

    def errors(self) -> list[str]:
        """What went to the console as error or warning, and every exception, since the page was made."""
        out = []
        for event in self._browser.events(self._session):
            method, p = event["method"], event["params"]
            if method == "Runtime.exceptionThrown":
                out.append(str(p["exceptionDetails"].get("exception", {}).get("description", p)))
            elif method == "Runtime.consoleAPICalled" and p["type"] in {"error", "warning", "assert"}:
                out.append(" ".join(str(a.get("value", a)) for a in p["args"]))
            elif method == "Log.entryAdded" and p["entry"]["level"] in {"error", "warning"}:
                out.append(f"{p['entry']['text']} {p['entry'].get('url', '')}")
        return out


class Browser:
    """The process and its pipes. Use `browsing`."""

    def __init__(self, program: str, profile: Path) -> None:
        self._ids = count(1)
        self._answers: dict[int, queue.SimpleQueue[dict[str, Any]]] = {}
        self._events: list[dict[str, Any]] = []
        theirs_in, self._out = os.pipe()
        self._in, theirs_out = os.pipe()
        # Out of the way of 3 and 4, onto which they are duplicated in the child.
        child_in, child_out = (fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, 10) for fd in (theirs_in, theirs_out))
        log = os.open(profile / "stderr.txt", os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        actions = [
            (os.POSIX_SPAWN_DUP2, log, 1),
            (os.POSIX_SPAWN_DUP2, log, 2),
            (os.POSIX_SPAWN_DUP2, child_in, 3),
            (os.POSIX_SPAWN_DUP2, child_out, 4),
        ]
        arguments = [program, *FLAGS, f"--user-data-dir={profile / 'profile'}"]
        self.pid = os.posix_spawn(program, arguments, dict(os.environ), file_actions=actions, setpgroup=0)
        for fd in (theirs_in, theirs_out, child_in, child_out, log):
            os.close(fd)
        self._reader = threading.Thread(target=self._read, name="devtools", daemon=True)
        self._reader.start()

    def _read(self) -> None:
        rest = b""
        while chunk := os.read(self._in, 1 << 16):
            *messages, rest = (rest + chunk).split(b"\0")
            for message in map(json.loads, messages):
                if "id" in message:
                    self._answers[message["id"]].put(message)
                else:
                    self._events.append(message)
        for answer in list(self._answers.values()):
            answer.put({"error": {"message": "the browser ended"}})

    def command(self, method: str, parameters: dict[str, Any], session: str | None = None) -> Any:
        """One command and its result.

        Raises:
            RuntimeError: the browser refused it.
            queue.Empty: no answer in time.
        """
        number = next(self._ids)
        answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._answers[number] = answers
        message = {"id": number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        answer = answers.get(timeout=TIMEOUT_S)
        del self._answers[number]
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']['message']}")
        return answer["result"]

    def events(self, session: str) -> list[dict[str, Any]]:
        return [e for e in list(self._events) if e.get("sessionId") == session]

    def close(self) -> None:
        """Ends the process group that `__init__` started, by its id."""
        os.close(self._out)  # the browser ends when its command pipe does
        deadline = time.monotonic() + 5
        gone = False
        while not gone and time.monotonic() < deadline:
            gone = os.waitpid(self.pid, os.WNOHANG)[0] == self.pid
            time.sleep(0.02)
        if not gone:
            os.killpg(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
        self._reader.join(5)
        os.close(self._in)


def chromium() -> str | None:
    """The browser's program, None where it is not installed."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


@contextmanager
def browsing(program: str) -> Iterator[Browser]:
    """A fresh browser with a profile of its own, both gone at the end."""
    with tempfile.TemporaryDirectory(prefix="servo-browser-", ignore_cleanup_errors=True) as folder:
        browser = Browser(program, Path(folder))
        try:
            yield browser
        finally:
            browser.close()
