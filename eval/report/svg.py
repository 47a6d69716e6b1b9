"""Figures inside the page: SVG elements whose text is text, and whose colours follow the page's light or dark scheme."""

from __future__ import annotations

import html
import re

from data_pipeline.files import short_hash

_VARIABLES = {
    "#111827": "currentColor",
    "#000000": "currentColor",
    "#ffffff": "var(--paper)",
    "#6b7280": "var(--grey)",
    "#9ca3af": "var(--light)",
    "#d1d5db": "var(--line)",
    "#e5e7eb": "var(--line)",
    "#2563eb": "var(--blue)",
    "#1d4ed8": "var(--blue)",
    "#93c5fd": "var(--pale)",
    "#0d9488": "var(--teal)",
    "#0891b2": "var(--teal)",
    "#d97706": "var(--orange)",
    "#9333ea": "var(--purple)",
    "#7c3aed": "var(--purple)",
    "#dc2626": "var(--red)",
    "#059669": "var(--green)",
    "#65a30d": "var(--green)",
    "#db2777": "var(--pink)",
    "#92400e": "var(--brown)",
}
"""Colours of the page (`page.css`) by the colours with which figures are drawn. Others, as those of cells, stay as they are."""
_ON_CELLS = ("#000000", "#ffffff")
"""Colours of text on coloured cells, which are the same in both schemes."""


def inline(content: str, alt: str) -> str:
    """Returns a matplotlib SVG file as an element of a page.

    Names inside it are made unique, so that a page can hold several figures.

    Args:
        content: of the file.
        alt: says what is seen.
    """
    drawing = content[content.index("<svg") :]
    width = float(re.search(r'width="([\d.]+)pt"', drawing).group(1)) * 4 / 3  # type: ignore[union-attr]
    box = re.search(r'viewBox="([^"]*)"', drawing).group(1)  # type: ignore[union-attr]
    body = drawing[drawing.index(">") + 1 : drawing.rindex("</svg>")]
    body = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r"<text [^>]*>|<[a-z][^>]*>", _coloured, body)
    body = re.sub(r"font: ([^;\"]*?)([\d.]+px)[^;\"]*", _font, body)
    body = re.sub(r"font-family: [^;\"]*;? ?", "", body)
    body = re.sub(r">\s+<", "><", body)
    return (
        f'<svg role="img" aria-label="{html.escape(alt)}" viewBox="{box}" style="--w:{width:.0f}px">'
        f"{_with_own_names(body, short_hash(content.encode())[:6])}</svg>"
    )


def _coloured(tag: re.Match[str]) -> str:
    """A tag with the page's colours, and numbers with two decimals; black and white text is on cells, and stays."""
    is_text = tag.group(0).startswith("<text")

    def of(found: re.Match[str]) -> str:
        colour = found.group(0).lower()
        return colour if is_text and colour in _ON_CELLS else _VARIABLES.get(colour, colour)

    shorter = re.sub(r"(\d\.\d\d)\d+", r"\1", tag.group(0))
    return re.sub(r"#[0-9a-fA-F]{6}\b", of, shorter)


def _font(found: re.Match[str]) -> str:
    """The size and weight of a font; the family is that of the page."""
    weight = "font-weight: 700; " if re.search(r"bold|[6-9]00", found.group(1)) else ""
    return f"{weight}font-size: {found.group(2)}"


def _with_own_names(body: str, prefix: str) -> str:
    """The elements with names that begin with `prefix`; names that nothing refers to are left out."""
    used = set(re.findall(r"url\(#([^)]+)\)|href=\"#([^\"]+)\"", body))
    names = {name for pair in used for name in pair if name}
    body = re.sub(r' id="([^"]+)"', lambda m: f' id="{prefix}{m.group(1)}"' if m.group(1) in names else "", body)
    return re.sub(r"(url\(#|href=\"#)", rf"\g<1>{prefix}", body)
