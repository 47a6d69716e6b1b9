"""A hook of the documentation site: files outside of docs/ are not part of it, so that links to them become their text."""

from __future__ import annotations

import re
from typing import Any

_OUTSIDE = re.compile(r"(!?)\[([^\]]*)\]\(\.\./[^)]+\)")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by MkDocs with the text of every page."""
    return _OUTSIDE.sub(lambda match: "" if match[1] else f"`{match[2]}`", markdown)
