"""A page in Chromium, with all that goes wrong in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

WAYS = [(1200, "light"), (1200, "dark"), (390, "light"), (390, "dark")]
"""Widths in pixels, and colour schemes, in which pages are looked at."""
_FRAMES = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"


class Opened:
    """A page of a file or an address.

    Attributes:
        page: of playwright.
        wrong: errors and warnings of its console, and what it asks of other places.
    """

    def __init__(self, browser: Any, address: Path | str, width: int, scheme: str = "light", **options: Any):
        self.context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, **options)
        self.page, self.wrong = self.context.new_page(), []
        url = address.resolve().as_uri() if isinstance(address, Path) else address
        within = url.rpartition("/")[0] if isinstance(address, Path) else "/".join(url.split("/")[:3])
        self.page.on("console", lambda said: said.type in ("error", "warning") and self.wrong.append(said.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", lambda request: self._check(request.url, within))
        self.page.goto(url)

    def _check(self, url: str, within: str) -> None:
        places = ("data:", "blob:", within + "/", within.replace("http:", "ws:", 1) + "/")
        if not url.startswith(places):
            self.wrong.append(f"asks for {url}")

    def see(self, width: int, scheme: str) -> None:
        """Changes the window and the scheme of the open page."""
        self.page.set_viewport_size({"width": width, "height": 900})
        self.page.emulate_media(color_scheme=scheme)
        self.page.evaluate(_FRAMES)

    def picture(self) -> str:
        """What the scene of the report shows."""
        self.page.evaluate(_FRAMES)
        return self.page.evaluate("document.getElementById('scene').toDataURL()")

    def overflow(self) -> int:
        """Pixels by which the page is wider than the window."""
        return self.page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")

    def unfold(self) -> None:
        """Opens all that is folded in the text."""
        self.page.evaluate("document.querySelectorAll('main details').forEach((fold) => (fold.open = true))")

    def faults(self) -> list[str]:
        """What axe-core finds, if it is serious."""
        axe = pytest.importorskip(
            "axe_playwright_python.sync_playwright", reason="axe-core is not installed: '.[browser]'"
        )
        found = axe.Axe().run(self.page, options={"resultTypes": ["violations"]}).response["violations"]
        return [
            f"{fault['id']}: {node['html'][:120]}"
            for fault in found
            if fault["impact"] in ("serious", "critical")
            for node in fault["nodes"]
        ]

    def is_sound(self) -> None:
        """Asserts that nothing is wider than the window, nothing is hard to use, and nothing went wrong."""
        assert self.overflow() <= 0
        self.unfold()
        assert self.overflow() <= 0
        assert self.faults() == []
        assert self.wrong == []
