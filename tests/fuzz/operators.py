"""Mutations that know what mesh files hold: numbers on lines, counts that are declared, ids, names, and members of archives."""

from __future__ import annotations

import io
import re
import warnings
import zipfile
from collections.abc import Callable

from hypothesis import strategies as st

_BETWEEN = re.compile(rb"(?<=[\d.])(?:[ \t]+|\r?\n)(?=[-+.\d])")
_COUNT = re.compile(rb"(?<![\w.+-])\d{1,9}(?![\w.])")
_NAME = re.compile(rb'"[^"\n]{1,80}"|[A-Za-z_][\w:]{1,40}')
Operator = Callable[[bytes, st.DrawFn], bytes]


def _one_of(pattern: re.Pattern[bytes], content: bytes, draw: st.DrawFn) -> re.Match[bytes] | None:
    found = list(pattern.finditer(content[:200_000]))
    return found[draw(st.integers(0, len(found) - 1))] if found else None


def _replaced(content: bytes, match: re.Match[bytes], by: bytes) -> bytes:
    return content[: match.start()] + by + content[match.end() :]


def number_to_another_line(content: bytes, draw: st.DrawFn) -> bytes:
    """What parts two numbers is a line's end where it was a space, and the reverse."""
    if (match := _one_of(_BETWEEN, content, draw)) is None:
        return content
    return _replaced(content, match, b" " if b"\n" in match.group() else b"\n")


def another_count(content: bytes, draw: st.DrawFn) -> bytes:
    """A whole number is another one, such as a count that a header declares, or an index."""
    if (match := _one_of(_COUNT, content, draw)) is None:
        return content
    number = int(match.group())
    return _replaced(
        content, match, str(max(0, draw(st.sampled_from((number - 1, number + 1, 2 * number, 0))))).encode()
    )


def one_name_twice(content: bytes, draw: st.DrawFn) -> bytes:
    """A name or text takes the place of another one: ids are there twice, references lead elsewhere."""
    one, other = (_one_of(_NAME, content, draw) for _ in range(2))
    return content if one is None or other is None else _replaced(content, one, other.group())


def another_name(content: bytes, draw: st.DrawFn) -> bytes:
    """A name or text in other capitals, or with a letter more."""
    if (match := _one_of(_NAME, content, draw)) is None:
        return content
    name = match.group()
    return _replaced(content, match, draw(st.sampled_from((name.swapcase(), name[:-1] + b"x" + name[-1:]))))


def in_archive(content: bytes, draw: st.DrawFn) -> bytes:
    """A member of an archive is renamed, there twice, left out, or changed by another operator."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()[:200]]
    except Exception:  # what was mutated before may be no archive any more
        return content
    if not members:
        return content
    at, kind = draw(st.integers(0, len(members) - 1)), draw(st.integers(0, 5))
    name, inside = members[at]
    if kind == 0:
        members[at] = draw(st.sampled_from((name.upper(), name + "x", name[1:], "../" + name))), inside
    elif kind == 1:
        members.append((name, members[draw(st.integers(0, len(members) - 1))][1]))
    elif kind == 2:
        del members[at]
    else:
        members[at] = name, draw(st.sampled_from(_OF_TEXT))(inside, draw)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a name is there twice
        for name, inside in members:
            archive.writestr(name, inside)
    return made.getvalue()


_OF_TEXT: tuple[Operator, ...] = (number_to_another_line, another_count, one_name_twice, another_name)


@st.composite
def changed(draw: st.DrawFn, content: bytes) -> bytes:
    """The content with one of these mutations."""
    operators = (in_archive,) if content.startswith(b"PK") else _OF_TEXT
    return draw(st.sampled_from(operators))(content, draw)
