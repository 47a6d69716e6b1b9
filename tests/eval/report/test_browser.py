"""The report and the documentation as a person opens them: in Chromium, at two widths, light and dark, by mouse, finger and keys.

Needs the extra `browser` and the program `chromium` (Debian's package has this name); nothing is loaded from elsewhere.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow
SITE = Path(__file__).resolve().parents[3] / "site"
WAYS = [(1200, "light"), (1200, "dark"), (390, "light"), (390, "dark")]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed: pip install '.[browser]'"
    )
    programs = map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))
    program = next((program for program in programs if program), None)
    if program is None:
        pytest.skip("there is no Chromium here: apt-get install chromium")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield opened
        opened.close()


class Opened:
    """A page of files, with all that went wrong in it."""

    def __init__(self, browser: Any, path: Path, width: int, scheme: str = "light", **options: Any):
        self.context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, **options)
        self.page, self.wrong = self.context.new_page(), []
        self.page.on("console", lambda said: said.type in ("error", "warning") and self.wrong.append(said.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", lambda request: self._check(request.url, path))
        self.page.goto(path.resolve().as_uri())

    def _check(self, url: str, path: Path) -> None:
        folder = path.resolve().parent.as_uri()
        if not url.startswith(("data:", "blob:")) and not url.startswith(folder):
            self.wrong.append(f"asks for {url}")

    def picture(self) -> str:
        self.page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return self.page.evaluate("document.getElementById('scene').toDataURL()")

    def overflow(self) -> int:
        return self.page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")

    def faults(self) -> list[str]:
        """What axe-core finds, if it is serious."""
        axe = pytest.importorskip(
            "axe_playwright_python.sync_playwright", reason="axe-core is not installed: '.[browser]'"
        )
        self.page.evaluate("document.querySelectorAll('main details').forEach((fold) => (fold.open = true))")
        found = axe.Axe().run(self.page).response["violations"]
        return [
            f"{fault['id']}: {node['html'][:120]}"
            for fault in found
            if fault["impact"] in ("serious", "critical")
            for node in fault["nodes"]
        ]


@pytest.fixture
def opened(browser) -> Iterator[Any]:
    pages: list[Opened] = []

    def open_page(path: Path, width: int, scheme: str = "light", **options: Any) -> Opened:
        pages.append(Opened(browser, path, width, scheme, **options))
        return pages[-1]

    yield open_page
    for page in pages:
        page.context.close()


@pytest.mark.parametrize(("width", "scheme"), WAYS)
def test_the_report_is_sound(whole, opened, width, scheme):
    page = opened(whole / "report" / "index.html", width, scheme)
    assert page.page.locator("#viewer").is_visible()
    assert page.overflow() <= 0
    assert page.faults() == []
    assert page.overflow() <= 0  # with all that was folded
    assert page.wrong == []


def test_the_scene_is_drawn_and_turns(whole, opened):
    """By mouse, keys, wheel and buttons."""
    shown = opened(whole / "report" / "index.html", 1200)
    page, seen = shown.page, [shown.picture()]
    assert page.evaluate(
        "() => { const c = document.getElementById('scene');"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data, found = new Set();"
        "for (let i = 0; i < d.length; i += 4) found.add((d[i] << 16) | (d[i + 1] << 8) | d[i + 2]); return found.size }"
    ) > 20  # fmt: skip
    box = page.locator("#scene").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 90, middle[1] + 30, steps=4)
    page.mouse.up()
    seen.append(shown.picture())
    page.locator("#scene").focus()
    for key in ("ArrowLeft", "ArrowUp", "+"):
        page.keyboard.press(key)
        seen.append(shown.picture())
    page.mouse.wheel(0, -300)
    page.wait_for_timeout(100)
    seen.append(shown.picture())
    page.get_by_role("button", name="turn right").click()
    seen.append(shown.picture())
    assert len(set(seen)) == len(seen)
    page.get_by_role("button", name="first position").click()
    assert shown.picture() == seen[0]
    assert shown.wrong == []


def test_a_finger_turns_the_scene_and_two_zoom(whole, opened):
    shown = opened(whole / "report" / "index.html", 390, has_touch=True, is_mobile=True)
    shown.page.locator("#scene").scroll_into_view_if_needed()
    box, before = shown.page.locator("#scene").bounding_box(), shown.picture()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = shown.context.new_cdp_session(shown.page)

    def moved(kind: str, *points: tuple[float, float]) -> None:
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": a, "y": b} for a, b in points]})

    moved("touchStart", (x, y))
    for step in range(1, 6):
        moved("touchMove", (x + 15 * step, y))
    moved("touchEnd")
    turned = shown.picture()
    assert turned != before
    moved("touchStart", (x - 20, y), (x + 20, y))
    for step in range(1, 6):
        moved("touchMove", (x - 20 - 8 * step, y), (x + 20 + 8 * step, y))
    moved("touchEnd")
    assert shown.picture() != turned
    assert shown.wrong == []


def test_the_slider_goes_through_the_views(whole, opened):
    shown = opened(whole / "report" / "index.html", 1200)
    page, seen = shown.page, []
    last = int(page.locator("#step").get_attribute("max"))
    page.locator("#step").focus()
    for step in range(1, last + 1):
        assert page.locator("#count").inner_text() == f"{step} of {last}"
        assert f"number {step} of {last}" in page.locator("#said").inner_text()
        assert page.locator(".walk:not([hidden]) li[aria-current]").count() == 1
        bars = page.locator("#bars li b").all_inner_texts()
        assert bars == sorted(bars, key=lambda text: -float(text.split()[0]))
        seen.append(shown.picture())
        page.keyboard.press("ArrowRight")
    assert len(set(seen)) == last
    assert "This is the last view" in page.locator("#said").inner_text()
    options = page.locator("#object option").count()
    said = set()
    for index in range(options):
        page.locator("#object").select_option(index=index)
        assert page.locator("#count").inner_text() == f"1 of {last}"
        assert page.locator(".walk:visible h3").count() == 1
        said.add(page.locator(".walk:visible h3").inner_text())
    assert len(said) == options
    assert shown.wrong == []


@pytest.mark.parametrize("width", [1200, 390])
def test_without_scripts_all_walks_are_read(whole, opened, width):
    page = opened(whole / "report" / "index.html", width, java_script_enabled=False).page
    assert page.get_by_text("The 3-D scene needs JavaScript").is_visible()
    assert not page.locator("#viewer").is_visible()
    assert page.locator(".walk").count() == page.locator(".walk:visible").count() > 0
    assert page.locator(".walk img").first.is_visible()


@pytest.mark.parametrize(("width", "scheme"), WAYS)
def test_the_documentation_is_sound(opened, width, scheme):
    if not (SITE / "index.html").exists():
        pytest.skip("the documentation is not built: make docs")
    for path in sorted(SITE.glob("**/index.html")):
        page = opened(path, width, scheme)
        assert page.overflow() <= 0, path
        assert page.faults() == [], path
        page.context.close()
