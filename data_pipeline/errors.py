"""Errors that a person can act on: input that cannot be used, in one sentence."""

from __future__ import annotations


class DataError(ValueError):
    """The data cannot be used: what was wrong, where, and what to do, in one sentence."""


class DamagedMesh(DataError):
    """A file that should be a mesh and is not, or is cut short, or holds numbers that are not finite."""


class EmptyMesh(Exception):
    """A sound mesh with nothing to see: it is left out of the data set, named and counted."""
