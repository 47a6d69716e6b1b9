"""Errors about input data, with messages that tell the user what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class DataError(ValueError):
    """Data that cannot be used. The message is one sentence: what is wrong, where, and what to do."""


class DamagedMesh(DataError):
    """A file that is not a readable mesh: of another format, truncated, or with values that are not finite.

    The summary of a data set stores the messages of objects left out, so they are part of its fingerprint.
    """


class EmptyMesh(Exception):
    """A valid mesh without a surface. The object is left out of the data set and listed in its summary with this message."""


class Damage(Exception):
    """What is wrong with a file: the message of an error without the name of the file, with which it begins."""


def cut_short(there: str) -> Damage:
    """Returns the damage of a file that ends early; `there` says what of it is there."""
    return Damage(f"is cut short: {there}; fetch or export it again")


@contextmanager
def naming(where: str, kind: type[DataError] = DamagedMesh) -> Iterator[None]:
    """Raises an error of this kind with the name of a file in place of `Damage`."""
    try:
        yield
    except Damage as damage:
        raise kind(f"{where} {damage}") from damage


def reason_of(error: Exception) -> str:
    """Returns the first line of the message of a library's error, or the name of its kind if there is none."""
    return (str(error).splitlines() or [""])[0] or type(error).__name__


def kind_and_reason_of(error: Exception) -> str:
    """Returns the kind and the first line of the message of a library's error, at most 120 characters."""
    return f"{type(error).__name__}: {error}".splitlines()[0][:120]
