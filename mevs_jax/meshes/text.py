"""Text of mesh files: its encoding, its lines and its numbers. A `ValueError` says which word is no number."""

from __future__ import annotations

import codecs
import re
import warnings
from contextlib import suppress
from typing import Any

import numpy as np

from mevs_jax.errors import Damage

_NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|inf(inity)?)", re.IGNORECASE | re.ASCII)
"""What all readers take for a number; `float` also reads `2_0` and digits of other scripts."""

_NOT_A_NUMBER = re.compile(r"[+-]?(nan(\(.*\))?|\d+\.#(QNAN|SNAN|IND|R)\d*)", re.IGNORECASE | re.ASCII)
"""Spellings of NaN that C libraries print, such as `-nan(ind)` and `1.#QNAN`; `float` reads only `nan`."""

WHOLE = re.compile(r"[+-]?[0-9]+")

_COMMENT = re.compile(r"(?<!\d\.)#.*")
"""A comment to the end of its line, as against a spelling of NaN."""

_FILLER = b"\0\r\n\t \x1a"
"""Bytes that fill a file up behind its end."""


def text_of(content: bytes, kind: str) -> str:
    """Returns the text of a file with line ends as `\\n`.

    A byte order mark is removed. Without one, every byte is one character (Latin-1), since comments may have any encoding and
    all else is ASCII.
    """
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = content.decode("utf-16", errors="replace")
    else:
        text = content.removeprefix(codecs.BOM_UTF8).rstrip(b"\x1a").decode("latin-1")  # 1a ends a text of DOS
    if "\0" in text or "\ufffd" in text:
        raise Damage(f"is not {kind} mesh: it holds bytes that are not text; repair it or take it away")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def without_comments(text: str) -> str:
    """Returns a text without what follows `#` in each line."""
    return _COMMENT.sub("", text) if "#" in text else text


def lines_of(text: str) -> list[str]:
    """Returns the lines of a text that are not blank."""
    return [line for line in text.split("\n") if line and not line.isspace()]


def quoted(line: str) -> str:
    """Returns the begin of a line for a message."""
    return repr(line.strip()[:40])


def is_filler(rest: bytes) -> bool:
    """Returns whether the bytes behind the end of a binary mesh hold nothing."""
    return not rest.strip(_FILLER)


def number(word: str) -> float:
    """Returns the number that a word spells, in any spelling of NaN."""
    if _NUMBER.fullmatch(word):
        return float(word)
    if _NOT_A_NUMBER.fullmatch(word):
        return float("nan")
    raise ValueError(f"{word[:40]!r} is not a number")


def whole_number(word: str) -> int:
    """Returns the integer that a word spells; one of more than 62 bits becomes smaller."""
    if not WHOLE.fullmatch(word):
        raise ValueError(f"{word[:40]!r} is not a whole number")
    return max(min(int(word), 2**62), -(2**62))


def numbers(lines: list[str], kind: type[Any] = np.float64) -> tuple[np.ndarray, np.ndarray]:
    """Returns all numbers of some lines, float64 or int64, and how many there are in each line."""
    counts = np.array([len(line.split()) for line in lines], np.int64)
    if not counts.sum():
        return np.zeros(0, kind), counts
    text = "\n".join(lines)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # how NumPy before 2.3 says that it stopped early
        with suppress(ValueError, DeprecationWarning):
            values = np.fromstring(text, kind, sep=" ")  # ten times as fast as words one by one
            if len(values) == counts.sum():  # it takes `- 2` for one number
                return values, counts
    read = whole_number if kind is np.int64 else number
    return np.array([read(word) for word in text.split()], kind), counts


def starts_of(counts: np.ndarray) -> np.ndarray:
    """Returns where each of some runs begins, from their lengths."""
    return np.cumsum(counts) - counts


def columns(lines: list[str], wanted: int, *more: int) -> np.ndarray:
    """Returns the first `wanted` numbers of every line, (lines, wanted) float64.

    Args:
        more: how many numbers a line may have instead of `wanted`; those after the wanted ones are ignored.
    """
    counts = np.array([len(line.split()) for line in lines], np.int64)
    wrong = np.flatnonzero(~np.isin(counts, (wanted, *more)))
    if len(wrong):
        line = lines[wrong[0]]
        raise ValueError(f"the line {quoted(line)} has {counts[wrong[0]]} numbers instead of {wanted}")
    values, _ = numbers(lines)
    return values[starts_of(counts)[:, None] + np.arange(wanted)]
