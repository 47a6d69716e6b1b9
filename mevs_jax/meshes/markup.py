"""XML of mesh files. Documents that define entities are refused: a small one can unfold to any size."""

from __future__ import annotations

from typing import NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

from mevs_jax.errors import Damage


def parse_markup(content: bytes) -> tuple[ElementTree.Element, dict[str, str]]:
    """Returns the root of a document in any encoding, and its attributes as written, among them the prefixes of names."""
    written: list[dict[str, str]] = []

    def first(name: str, attributes: dict[str, str]) -> None:
        del name
        written.append(attributes)
        parser.StartElementHandler = None

    def entity(*about: object) -> NoReturn:
        raise Damage("defines XML entities, which are not read; export it again")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EntityDeclHandler = first, entity
    parser.Parse(content, True)
    return ElementTree.fromstring(content), written[0]
