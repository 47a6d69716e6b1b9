"""The report and the documentation as a person opens them: in Chromium, at two widths, light and dark, by mouse, finger and keys.

Needs the extra `browser` and the program `chromium` (Debian's package has this name); nothing is loaded from elsewhere.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.reference.browser import WAYS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("browser"),
]  # first, so that nothing is made where it is not there
SITE = Path(__file__).resolve().parents[3] / "site"


@pytest.mark.parametrize(("width", "scheme"), WAYS)
def test_the_report_is_sound(whole, opened, width, scheme):
    page = opened(whole / "report" / "index.html", width, scheme)
    assert page.page.locator("#viewer").is_visible()
    page.is_sound()


def test_the_scene_is_drawn_and_turns(whole, opened):
    """By mouse, keys, wheel and buttons."""
    shown = opened(whole / "report" / "index.html", 1200)
    page, seen = shown.page, [shown.picture()]
    assert page.evaluate(
        "() => { const c = document.getElementById('scene');"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data, found = new Set();"
        "for (let i = 0; i < d.length; i += 4) found.add((d[i] << 16) | (d[i + 1] << 8) | d[i + 2]); return found.size }"
    ) > 20  # fmt: skip
    page.locator("#scene").scroll_into_view_if_needed()
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
    assert page.locator("noscript .warning").is_visible()
    assert not page.locator("#viewer").is_visible()
    assert page.locator(".walk").count() == page.locator(".walk:visible").count() > 0
    assert page.locator(".walk img").first.is_visible()


def test_all_walks_are_printed(whole, opened):
    page = opened(whole / "report" / "index.html", 1200).page
    assert page.locator(".walk").count() > page.locator(".walk:visible").count() == 1
    page.emulate_media(media="print")
    assert page.locator(".walk").count() == page.locator(".walk:visible").count()
    assert not page.locator(".controls").first.is_visible()


def test_nothing_moves_by_itself(whole, opened):
    page = opened(whole / "report" / "index.html", 1200).page
    assert page.evaluate("document.getAnimations().length") == 0
    style = page.locator("style").first.text_content()
    assert not [word for word in ("transition", "animation", "scroll-behavior") if word in style]


def test_the_tab_key_stops_only_where_something_is_done(whole, opened):
    """Tables and figures that fit are no stops; those that scroll are, and say so."""
    for width in (1200, 390):
        page = opened(whole / "report" / "index.html", width).page
        for box in page.locator("main > .scroll, main > figure .scroll").all():
            wider = box.evaluate("(box) => box.scrollWidth > box.clientWidth + 1")
            assert (box.get_attribute("tabindex") == "0") == wider == box.locator(".hint").is_visible()


@pytest.fixture(scope="module")
def site() -> Iterator[str]:
    """The address of the documentation, which a server of this process shows."""
    if not (SITE / "index.html").exists():
        pytest.skip("the documentation is not built: make docs")

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(SITE))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize(("width", "scheme"), [WAYS[0], WAYS[-1]])
def test_the_documentation_is_sound(site, opened, width, scheme):
    page, faults = opened(f"{site}/index.html", width, scheme), {}
    for path in sorted(SITE.glob("**/index.html")):
        name = path.relative_to(SITE).as_posix()
        page.page.goto(f"{site}/{name}")
        page.unfold()
        found = [*page.wrong, *page.faults(), *[f"{page.overflow()} pixels too wide"] * (page.overflow() > 0)]
        page.wrong.clear()
        if found:
            faults[name] = found
    assert faults == {}
