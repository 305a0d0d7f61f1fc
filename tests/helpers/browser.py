"""A page in headless Chromium, driven through its DevTools protocol: keys, clicks, screenshots."""

import base64
import json
import re
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.pages import CHROMIUM, sockets

# SwiftShader is WebGL without a GPU.
_OPTIONS = """--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist
--disable-quic --no-first-run --disable-background-networking --disable-component-update --disable-sync
--hide-scrollbars --remote-debugging-port=0 --window-size=1200,800""".split()


class Page:
    """One page; wait for what is expected instead of for a time, since software WebGL is slow."""

    def __init__(self, address: str) -> None:
        from websockets.sync.client import connect

        self._socket = connect(address, max_size=None)
        self._number, self._session = 0, None
        self.errors: list[str] = []  # what the page wrote into its console as an error, or left uncaught
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self._call(f"{domain}.enable")

    def open(self, url: str) -> None:
        self._call("Page.navigate", url=url)

    def run(self, expression: str) -> Any:
        """Return the value of an expression in JavaScript."""
        answer = self._call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def text(self) -> str:
        return self.run("document.body.innerText")

    def until(self, expression: str, timeout_s: float = 120.0) -> Any:
        """Wait until an expression is true, and return it."""
        ends = time.monotonic() + timeout_s
        while not (value := self.run(f"document.body && ({expression})")):
            assert time.monotonic() < ends, f"never true: {expression}; the page says: {self.text()}"
            time.sleep(0.2)
        return value

    def until_it_says(self, text: str) -> None:
        """Wait until a text stands on the page."""
        self.until(f"document.body.innerText.includes({json.dumps(text)})")

    def press(self, key: str, code: int, times: int = 1) -> None:
        for _ in range(times):
            for kind in ("keyDown", "keyUp"):
                self._call("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def resize(self, width: int, height: int) -> None:
        """Give the window another size [px]."""
        self._call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def screenshot(self) -> np.ndarray:
        """Return what is seen, uint8 RGB (H, W, 3)."""
        data = base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"])
        return cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)

    def _call(self, method: str, **parameters: Any) -> Any:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=120))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            self.errors += error_of(answer)


def error_of(event: dict[str, Any]) -> list[str]:
    """Return what an event of DevTools says, if it is an error."""
    said = event.get("params", {})
    kind = event.get("method")
    if kind == "Runtime.exceptionThrown":
        return [json.dumps(said["exceptionDetails"])]
    if kind == "Runtime.consoleAPICalled" and said["type"] in ("error", "assert"):
        return [json.dumps(said["args"])]
    if kind == "Log.entryAdded" and said["entry"]["level"] == "error":
        return [json.dumps(said["entry"])]
    return []


@contextmanager
def chromium(folder: Path) -> Iterator[Page]:
    """Yield an empty page; skip where there is no Chromium."""
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine to open the page in")
    command = [CHROMIUM, *_OPTIONS, f"--user-data-dir={folder / 'profile'}", "about:blank"]
    with sockets() as environment:
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment
        )
        try:
            assert process.stderr is not None
            lines = (re.search(r"DevTools listening on (ws://\S+)", line) for line in process.stderr)
            address = next((found[1] for found in lines if found), "")
            assert address, "Chromium ended before it listened"
            threading.Thread(target=process.stderr.read, daemon=True).start()  # a full pipe would stop it
            yield Page(address)
        finally:
            process.terminate()
            process.wait(30)
