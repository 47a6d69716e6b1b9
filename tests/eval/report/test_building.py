"""Building blocks of the page: colours, figures, tables, marks."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import numpy as np
import pytest

from eval.numbers.metrics import Headline
from eval.projections import equal_area
from eval.report import figures
from eval.report.grid import _most_confused
from eval.report.html import MANY_CLASSES, STYLE, commands, difference, document, drawn, embedded, table
from eval.report.svg import _VARIABLES, inline


def variables(block: str) -> dict[str, str]:
    return dict(re.findall(r"--([a-z-]+):(#[0-9a-f]{3,6})", block))


LIGHT = variables(STYLE[: STYLE.index("@media (prefers-color-scheme")])
DARK = variables(STYLE[STYLE.index("@media (prefers-color-scheme") : STYLE.index("*{box-sizing")])


def luminance(colour: str) -> float:
    digits = colour[1:] if len(colour) == 7 else "".join(2 * digit for digit in colour[1:])
    parts = np.array([int(digits[at : at + 2], 16) / 255 for at in (0, 2, 4)])
    linear = np.where(parts <= 0.03928, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", [LIGHT, DARK], ids=["light", "dark"])
def test_text_has_a_contrast_of_4_5_and_lines_one_of_3(scheme):
    for ink in ("ink", "note", "link"):
        for ground in ("paper", "soft", "warning"):
            assert contrast(scheme[ink], scheme[ground]) >= 4.5, (ink, ground)
    for name in ("grey", "blue", "teal", "orange", "purple", "red", "green", "pink", "brown", "path"):
        assert contrast(scheme[name], scheme["paper"]) >= 4.5, name
    assert contrast(scheme["paper"], scheme["path"]) >= 4.5  # the numbers of the views seen
    assert contrast(scheme["gain-high"], scheme["gain-low"]) >= 4.5


def test_both_schemes_have_the_same_colours():
    assert LIGHT.keys() == DARK.keys()
    assert {value[6:-1] for value in _VARIABLES.values() if value.startswith("var")} <= LIGHT.keys()


def a_figure(colour: str = "#dc2626"):
    figure, axis = plt.subplots(figsize=(3, 2))
    axis.plot([0, 1], [0.123456, 1], "o-", color=colour, label="a line")
    axis.text(0.5, 0.5, "0.0117", color="black")
    axis.text(0.2, 0.2, "white", color="white")
    axis.set_title("Accuracy & views")
    content = drawn(figure, "svg").decode()
    plt.close(figure)
    return content


def test_a_figure_is_text_in_the_colours_of_the_page():
    element = inline(a_figure(), 'curves of "a" & b')
    parsed = ElementTree.fromstring(element.replace("xlink:href", "href"))
    assert parsed.attrib["aria-label"] == 'curves of "a" & b'
    texts = {node.text: node.attrib["style"] for node in parsed.iter("text")}
    assert {"Accuracy & views", "0.0117", "white"} <= texts.keys()
    assert "fill" not in texts["0.0117"]  # black, which is the default
    assert "#ffffff" in texts["white"]
    assert "currentColor" in texts["Accuracy & views"]
    assert "var(--red)" in element
    assert "#dc2626" not in element
    assert "var(--paper)" in element
    assert "DejaVu" not in element


def test_figures_of_a_page_share_no_names():
    page = inline(a_figure(), "one") + inline(a_figure("#2563eb"), "other")
    names = re.findall(r' id="([^"]+)"', page)
    assert len(names) == len(set(names)) > 0
    assert set(re.findall(r"url\(#([^)]+)\)|href=\"#([^\"]+)\"", page)[0]) - {""} <= set(names)


def test_the_same_figure_is_the_same_text():
    assert inline(a_figure(), "a") == inline(a_figure(), "a")


@pytest.mark.parametrize(
    ("interval", "mark"), [((0.01, 0.03), "▲ +2.0"), ((-0.01, 0.03), "+2.0"), ((0.0, 0.03), "+2.0")]
)
def test_differences_are_marked_without_colour(interval, mark):
    assert re.sub(r"<[^>]+>", "", difference(0.02, interval)).startswith(mark)
    assert ("▲" in difference(0.02, interval)) == ("▲" in mark)
    assert "▼ −2.0" in difference(-0.02, (-0.03, -0.01))


def test_a_table_has_headings_for_rows_and_columns():
    shown = table(["policy", "1 < 2"], [["<b>Uses nothing</b>"], ["random", "3"], ["group"], ["b", "4"]], "a table")
    assert shown.count("<tbody>") == 2
    assert '<th scope="col">1 &lt; 2</th>' in shown
    assert '<th scope="rowgroup" colspan="2"><span class="group"><b>Uses nothing</b></span></th>' in shown
    assert '<th scope="row">random</th><td>3</td>' in shown
    assert 'tabindex="0" role="group" aria-label="Table: a table"' in shown


def test_ink_on_a_cell_has_a_contrast_of_4_5():
    for cmap in ("RdBu", "Blues"):
        for colour in plt.get_cmap(cmap)(np.linspace(0, 1, 200)):
            cell = "#" + "".join(f"{round(255 * c):02x}" for c in colour[:3])
            ink = {"black": "#000000", "white": "#ffffff"}[figures.ink_on(colour)]
            assert contrast(ink, cell) >= 4.5


def test_confusions_of_many_classes_are_a_table():
    classes = [f"class {number}" for number in range(MANY_CLASSES + 1)]
    matrix = 10 * np.eye(len(classes))
    matrix[3, 7], matrix[5, 2] = 30, 10
    shown = _most_confused("random", matrix, classes, Headline(0.99, 4))
    cells = re.findall(r'<th scope="row">(.*?)</th><td>(.*?)</td><td>(.*?)</td>', shown)
    assert cells == [("class 3", "class 7", "75.0"), ("class 5", "class 2", "50.0")]


def test_steps_are_listed_with_their_commands():
    assert commands([("Do <this>:", "mevs a --b 'c'")]) == (
        "<ol><li><p>Do &lt;this&gt;:</p><pre><code>mevs a --b &#x27;c&#x27;</code></pre></li></ol>"
    )


def test_a_document_says_its_size():
    assert "it has 2.0 MB" in document("T", "<p>" + 2_000_000 * "a" + "</p>")


def test_a_document_links_to_its_sections():
    page = document("T", "<h2>One &amp; two</h2><h2>Three</h2><h2>Four</h2>")
    for target in re.findall(r'href="#([^"]+)"', page):
        assert f'id="{target}"' in page
    assert 'lang="en"' in page


def test_an_image_says_what_is_seen():
    assert 'alt="a chair"' in embedded(b"", "png", "caption", alt="a chair")
    assert 'alt="caption"' in embedded(b"", "png", "caption")


def test_the_map_has_equal_areas(random):
    """The share of directions in a part of the map is the share of the map's area."""
    points = random.normal(size=(200_000, 3))
    x, y = equal_area(points / np.linalg.norm(points, axis=1, keepdims=True))
    assert ((x / (2 * np.sqrt(2))) ** 2 + (y / np.sqrt(2)) ** 2).max() <= 1 + 1e-9
    inside = (x / (2 * np.sqrt(2))) ** 2 + (y / np.sqrt(2)) ** 2
    for share in (0.1, 0.4, 0.8):
        assert (inside < share).mean() == pytest.approx(share, abs=0.005)
    assert (y > 0.9 * np.sqrt(2)).mean() == pytest.approx((np.arccos(0.9) - 0.9 * np.sqrt(0.19)) / np.pi, abs=0.002)


def test_a_map_shows_views_at_their_places():
    points = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0]])
    weights, maxima = np.array([0.1, 0.2, 0.3, 0.4]), np.array([False, False, False, True])
    figure = figures.view_map(points, ~np.eye(4, dtype=bool), weights, maxima, "map", (0.1, 0.4))
    dots, rings = figure.axes[0].collections
    assert len(dots.get_offsets()) == 4
    assert len(rings.get_offsets()) == 1
    assert np.all(np.diff(dots.get_sizes()) > 0)  # not by colour alone
    plt.close(figure)
