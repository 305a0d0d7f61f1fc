"""HTML pages under test: are their elements closed, what would they load, and what happens when they are clicked?"""

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_OPTIONS = """--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking
--disable-component-update --disable-sync --hide-scrollbars --window-size=1100,1400
--virtual-time-budget=6000""".split()
_REPORT = """
window.faults = [];
window.addEventListener("error", event => window.faults.push(String(event.message)));
document.addEventListener("securitypolicyviolation", event => window.faults.push("asked for " + event.blockedURI));
"""


class Tags(HTMLParser):
    """Collect every attribute that could load something, and check that elements are closed in order."""

    EMPTY = frozenset({"meta", "img", "input", "br", "rect", "line", "path", "circle"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.faults: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.EMPTY:
            self.open.append(tag)
        loaded = [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        self.addresses += [value for value in loaded if not value.startswith("#")]  # a place in the page itself

    def handle_endtag(self, tag: str) -> None:
        if tag in self.EMPTY:
            return
        if not self.open or self.open.pop() != tag:
            self.faults.append(f"</{tag}> at {self.getpos()}")


@contextmanager
def sockets() -> Iterator[dict[str, str]]:
    """Yield the environment for Chromium, whose sockets need a short path and are left behind if it is killed."""
    with tempfile.TemporaryDirectory(prefix="cgwm-", ignore_cleanup_errors=True) as folder:
        yield os.environ | {"TMPDIR": folder}


def clicked(page: Path, folder: Path, script: str) -> dict[str, Any]:
    """Open a page in headless Chromium, run the body of an async function in it, and return what that returns.

    The answer also has `faults`: uncaught errors, and whatever the page wanted to load against its own policy; and
    `loaded`: the addresses of all that it loaded.
    """
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine to open the page in")
    runner = f"""
    (async () => {{ {script} }})().catch(error => ({{ failed: String(error) }})).then(answer => {{
      answer.faults = window.faults;
      answer.loaded = performance.getEntriesByType("resource").map(entry => entry.name.slice(0, 80));
      const element = document.createElement("pre");
      element.id = "answer"; element.textContent = JSON.stringify(answer); document.body.append(element);
    }});"""
    html = page.read_text(encoding="utf-8")
    html = html.replace("<title>", f"<script>{_REPORT}</script><title>", 1)
    html = html.replace("</body>", f"<script>{runner}</script></body>", 1)
    copy = folder / "clicked.html"
    copy.write_text(html, encoding="utf-8")
    command = [CHROMIUM, *_OPTIONS, f"--user-data-dir={folder / 'profile'}", "--dump-dom", copy.as_uri()]
    with sockets() as environment:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=environment)
    parser = _Answer()
    parser.feed(done.stdout)
    assert parser.text, done.stderr[-2000:]
    return json.loads(parser.text)


class _Answer(HTMLParser):
    """Collect the text of the element with the answer."""

    def __init__(self) -> None:
        super().__init__()
        self.text, self._inside = "", False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._inside = ("id", "answer") in attrs

    def handle_data(self, data: str) -> None:
        if self._inside:
            self.text += data

    def handle_endtag(self, tag: str) -> None:
        self._inside = False
