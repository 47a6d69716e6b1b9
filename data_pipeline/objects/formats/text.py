"""Text of mesh files: its encoding, its lines and its numbers. A `ValueError` says which word is no number."""

from __future__ import annotations

import codecs
import re
import warnings
from collections.abc import Iterable
from contextlib import suppress

import numpy as np

from data_pipeline.errors import Damage

_NOT_A_NUMBER = re.compile(r"[+-]?(nan(\(.*\))?|\d+\.#(QNAN|SNAN|IND|R)\d*)", re.IGNORECASE)
"""Spellings of NaN that C libraries print, such as `-nan(ind)` and `1.#QNAN`; `float` reads only `nan`."""

_COMMENT = re.compile(r"(?<!\d\.)#.*")
"""A comment to the end of its line, as against a spelling of NaN."""


def text_of(content: bytes, kind: str) -> str:
    """Returns the text of a file with line ends as `\\n`.

    A byte order mark is removed. Without one, every byte is one character (Latin-1), since comments may have any encoding and
    all else is ASCII.
    """
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = content.decode("utf-16", errors="replace")
    else:
        text = content.removeprefix(codecs.BOM_UTF8).decode("latin-1")
    if "\0" in text or "\ufffd" in text:
        raise Damage(f"is not {kind} mesh: it holds bytes that are not text; repair it or take it away")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def without_comments(text: str) -> str:
    """Returns a text without what follows `#` in each line."""
    return _COMMENT.sub("", text) if "#" in text else text


def number(word: str) -> float:
    """Returns the number that a word spells, in any spelling of NaN."""
    try:
        return float(word)
    except ValueError:
        if _NOT_A_NUMBER.fullmatch(word):
            return float("nan")
        raise ValueError(f"{word[:40]!r} is not a number") from None


def whole_numbers(words: Iterable[str]) -> np.ndarray:
    """Returns the integers that words spell, int64; those of more than 62 bits become smaller."""
    return np.array([int(word) for word in words], object).clip(-(2**62), 2**62).astype(np.int64)


def numbers(text: str, kind: type = np.float64) -> np.ndarray:
    """Returns all numbers of a text, separated by white space, as float64 or int64."""
    if not text or text.isspace():
        return np.zeros(0, kind)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # how NumPy before 2.3 says that it stopped early
        with suppress(ValueError, DeprecationWarning):
            return np.fromstring(text, kind, sep=" ")  # ten times as fast as words one by one
    words = text.split()
    return whole_numbers(words) if kind is np.int64 else np.array([number(word) for word in words], np.float64)


def columns(lines: list[str], wanted: int) -> np.ndarray:
    """Returns the first `wanted` numbers of every line, (lines, wanted) float64; further words of a line are ignored."""
    with suppress(ValueError):  # words after the wanted ones may be anything
        values = numbers("\n".join(lines))
        if len(values) == wanted * len(lines) and all(len(lines[at].split()) == wanted for at in (0, -1) if lines):
            return values.reshape(-1, wanted)
    words = [line.split()[:wanted] for line in lines]
    for line, found in zip(lines, words, strict=True):
        if len(found) < wanted:
            raise ValueError(f"the line {line.strip()[:40]!r} has {len(found)} numbers instead of {wanted}")
    return np.array([[number(word) for word in found] for found in words], np.float64).reshape(-1, wanted)
