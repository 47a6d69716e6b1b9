"""A hook of the documentation site. It shows the notebooks of `examples/notebooks` and pictures from outside of docs/.

The pages link to a notebook's file, as it is read on GitHub. On the site, the notebook is a page of its own.
Other links to files outside of docs/ become their text.
"""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "examples" / "notebooks"
_TO_NOTEBOOK = re.compile(r"\(\.\./examples/notebooks/(\w+)\.ipynb\)")
_PICTURE = re.compile(r"!\[([^\]]*)\]\(\.\./([\w/]+?)(\w+\.png)\)")
_OUTSIDE = re.compile(r"\[([^\]]*)\]\(\.\./[^)]+\)")


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """Called by MkDocs with all files of the site; adds a page and the pictures of every notebook."""
    from mkdocs.structure.files import File

    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        page, pictures = page_of(path.stem, json.loads(path.read_text()))
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=page))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    for path in sorted((ROOT / "docs").glob("*.md")):
        for _, folder, name in _PICTURE.findall(path.read_text()):
            files.append(File.generated(config, f"pictures/{name}", content=(ROOT / folder / name).read_bytes()))
    return files


def page_of(name: str, notebook: dict[str, Any]) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and its pictures by file name."""
    parts, pictures = [], {}
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source.replace("](../../docs/", "](../").replace(".ipynb)", ".md)"))
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            if output["output_type"] == "stream":
                parts.append(f'```text title="Output"\n{"".join(output["text"]).rstrip()}\n```')
            else:
                file = f"{name}_{len(pictures) + 1}.png"
                pictures[file] = base64.b64decode(output["data"]["image/png"])
                parts.append(f"![Figure {len(pictures)} of this notebook]({file})")
    where = f"*This page is the notebook `examples/notebooks/{name}.ipynb`.*"
    return "\n\n".join([parts[0], where, *parts[1:]]) + "\n", pictures


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Called by MkDocs with the text of every page."""
    if page.file.src_uri.startswith("notebooks/"):
        return markdown
    markdown = _TO_NOTEBOOK.sub(r"(notebooks/\1.md)", markdown)
    markdown = _PICTURE.sub(r"![\1](pictures/\3)", markdown)
    return _OUTSIDE.sub(r"`\1`", markdown)


def on_post_page(output: str, **_: Any) -> str:
    """Called by MkDocs with the HTML of every page; for those who hear pages, names the search, and no empty cell is a header."""
    output = re.sub(r"<th([^>]*)></th>", r"<td\1></td>", output)
    return output.replace(
        'data-md-component="search" role="dialog"', 'data-md-component="search" role="dialog" aria-label="Search"'
    )
