"""Errors about stored files and trainings, beside those of the library."""

from __future__ import annotations

from pathlib import Path

from mevs_jax.errors import Damage as Damage
from mevs_jax.errors import DamagedMesh as DamagedMesh
from mevs_jax.errors import DataError as DataError
from mevs_jax.errors import EmptyMesh as EmptyMesh
from mevs_jax.errors import kind_and_reason_of as kind_and_reason_of
from mevs_jax.errors import naming as naming
from mevs_jax.errors import reason_of as reason_of


class Unreadable(DataError):
    """A stored file that cannot be read, or is not as it was written.

    Attributes:
        path: of the file.
        reason: why it cannot be read.
    """

    def __init__(self, path: Path, reason: str, way_out: str = "delete it, and the same command makes it again"):
        super().__init__(f"{path} cannot be read ({reason}); {way_out}")
        self.path, self.reason = path, reason


def causes_of(error: BaseException) -> list[BaseException]:
    """Returns an error, what it was raised for, and so on."""
    chain: list[BaseException] = []
    link: BaseException | None = error
    while link is not None and link not in chain:
        chain.append(link)
        link = link.__cause__ or link.__context__
    return chain


class Diverged(ArithmeticError):
    """Numbers that are infinite or NaN: in a training, a network's outputs, or results computed from them.

    The message is one sentence: which network, where, what is kept, and what to do. The program ends with exit code 3.
    """
