"""The candidate viewpoints of a data set: those of a lattice by name, or a user's own from a file, with their neighbours.

The thesis's pipeline (§4.4) reads a configuration file with the possible viewpoints in their canonical order and their adjacency.
So does this: `--dataset.capture.lattice file:PATH`. What identifies the viewpoints is their content, not the path.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_pipeline.capture.settings import CaptureConfig
from data_pipeline.errors import DataError
from data_pipeline.files import short_hash

FILE = "file:"
"""What the lattice of a data set with viewpoints from a file begins with; a path follows, or the hash of the content."""

_POINTS, _ADJACENCY = ("viewpoints", "points"), ("adjacency", "edges")
_KNOWN = {*_POINTS, *_ADJACENCY, "n", "name", "description"}


@dataclass(frozen=True)
class OwnViewpoints:
    """Viewpoints from a file.

    Attributes:
        points: (views, 3) unit vectors.
        neighbours: pairs (i, j), i < j, of neighbouring views, sorted; None if the file has none.
    """

    points: np.ndarray
    neighbours: tuple[tuple[int, int], ...] | None = None

    @property
    def digest(self) -> str:
        """Hash of the viewpoints and their neighbours."""
        content = self.points.tobytes() + repr(self.neighbours).encode()
        return short_hash(content)


def is_file(lattice: str) -> bool:
    """Whether a lattice is viewpoints from a file."""
    return lattice.startswith(FILE)


def absolute_lattice(lattice: str) -> str:
    """Returns a lattice that holds in every working directory."""
    return f"{FILE}{Path(lattice.removeprefix(FILE)).expanduser().absolute()}" if is_file(lattice) else lattice


def read_viewpoints(path: Path) -> OwnViewpoints:
    """Reads viewpoints from a JSON or CSV file.

    JSON is a list of directions [x, y, z], or an object with the list as "viewpoints" and their neighbours as "adjacency": a list
    of pairs of view numbers, counted from 0, or a symmetric matrix of 0 and 1. CSV is a direction a line, with or without a
    header. A direction of any length but zero is divided by its length.

    Raises:
        DataError: if the file cannot be read, or holds no such viewpoints.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise DataError(f"the viewpoints in {path} cannot be read ({error.strerror}); correct the path") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is not a text file of viewpoints, JSON or CSV; choose another") from error
    is_json = path.suffix.lower() == ".json" or text.lstrip()[:1] in ("{", "[")
    points, adjacency = _of_json(text, path) if is_json else (_of_csv(text, path), None)
    points = _directions(points, path)
    return OwnViewpoints(points, None if adjacency is None else _pairs(adjacency, len(points), path))


def _of_json(text: str, path: Path) -> tuple[Any, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is no JSON: {error}"[:300] + "; repair it") from error
    if isinstance(content, list):
        return content, None
    if not isinstance(content, Mapping):
        raise DataError(f'{path} is neither a list of directions nor an object with "viewpoints"; repair it')
    if unknown := set(content) - _KNOWN:
        raise DataError(
            f'{path} has an entry {min(unknown)!r}, which is neither "viewpoints" nor "adjacency"; remove it'
        )
    points, adjacency = ([content[name] for name in names if name in content] for names in (_POINTS, _ADJACENCY))
    if len(points) != 1 or len(adjacency) > 1:
        raise DataError(f'{path} must have one list of "viewpoints", and at most one "adjacency"; repair it')
    return points[0], adjacency[0] if adjacency else None


def _of_csv(text: str, path: Path) -> list[list[float]]:
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        cells = line.replace(";", ",").replace("\t", ",").split(",") if any(c in line for c in ",;\t") else line.split()
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = [float(cell) for cell in cells]
        except ValueError as error:
            if not rows and number <= 2:
                continue  # a header
            raise DataError(f"line {number} of {path} is no direction: {line.strip()[:60]!r}; repair it") from error
        if len(row) != 3:
            raise DataError(f"line {number} of {path} has {len(row)} numbers, a direction has 3; repair it")
        rows.append(row)
    return rows


def _directions(content: Any, path: Path) -> np.ndarray:
    """Returns unit vectors (views, 3)."""
    try:
        points = np.array(content, dtype=float)
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{path} holds no list of directions [x, y, z]; repair it") from error
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"{path} holds an array of shape {list(points.shape)}, not directions [views, 3]; repair it")
    if len(points) < 2:
        raise DataError(f"{path} has {len(points)} viewpoints, and choosing a next view needs at least 2; add some")
    if len(bad := np.flatnonzero(~np.isfinite(points).all(axis=1))):
        raise DataError(f"viewpoint {bad[0]} of {path} is not finite; repair it")
    largest = np.abs(points).max(axis=1, keepdims=True)  # divided by first, so that no square overflows
    if len(bad := np.flatnonzero(largest[:, 0] < 1e-9)):
        raise DataError(f"viewpoint {bad[0]} of {path} is the zero vector, which is no direction; repair it")
    points = points / largest
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1) + 4 * np.eye(len(points))
    if apart.min() < 1e-4:
        first, second = sorted(np.unravel_index(apart.argmin(), apart.shape))
        raise DataError(f"viewpoints {first} and {second} of {path} have the same direction; remove one of them")
    return points


def _pairs(content: Any, views: int, path: Path) -> tuple[tuple[int, int], ...]:
    """Returns the pairs of neighbours from a list of pairs or a matrix."""
    try:
        numbers = np.array(content)
    except ValueError:  # rows of different lengths
        numbers = np.array("")
    if numbers.size == 0 and isinstance(content, list):
        return ()
    if numbers.ndim != 2 or numbers.dtype.kind not in "bif" or not np.isfinite(numbers).all():
        raise DataError(f"the adjacency in {path} is neither a list of pairs nor a matrix of numbers; repair it")
    if numbers.shape == (views, views) and views > 2:
        if not np.isin(numbers, (0, 1)).all():
            raise DataError(f"the adjacency matrix in {path} has other entries than 0 and 1; repair it")
        if len(odd := np.argwhere(numbers != numbers.T)):
            first, second = odd[0]
            raise DataError(
                f"the adjacency matrix in {path} is not symmetric: view {first} is a neighbour of {second}, or the other way "
                f"round, but not both; repair it"
            )
        numbers = np.argwhere(numbers.astype(bool))
    if numbers.shape[1] != 2 or (numbers != numbers.astype(int)).any():
        raise DataError(
            f"the adjacency in {path} has shape {list(numbers.shape)}; it is a list of pairs of view numbers, or a matrix of "
            f"{views} rows and columns: repair it"
        )
    numbers = numbers.astype(int)
    if len(bad := numbers[(numbers < 0) | (numbers >= views)]):
        raise DataError(
            f"the adjacency in {path} names view {bad[0]}, and there are the views 0 to {views - 1}; repair it"
        )
    if len(bad := numbers[numbers[:, 0] == numbers[:, 1]]):
        raise DataError(f"the adjacency in {path} makes view {bad[0, 0]} a neighbour of itself; remove that")
    return tuple(sorted({(min(i, j), max(i, j)) for i, j in numbers.tolist()}))


def viewpoints_of(config: CaptureConfig) -> OwnViewpoints:
    """Returns the viewpoints of a data set.

    Raises:
        DataError: if its file cannot be used, or has another number of viewpoints than the settings.
        ValueError: if its lattice does not exist, or not with this number of viewpoints.
    """
    if not is_file(config.lattice):
        from mevs_jax.geometry.viewpoints import viewpoint_lattice  # which imports JAX

        return OwnViewpoints(viewpoint_lattice(config.views, config.lattice))
    path = Path(config.lattice.removeprefix(FILE)).expanduser()
    found = read_viewpoints(path)
    if len(found.points) != config.views:
        raise DataError(
            f"{path} has {len(found.points)} viewpoints, and --views or --dataset.capture.views is {config.views}; leave it out"
        )
    return found


def identified(config: CaptureConfig, made: Mapping[str, Any] | None = None) -> CaptureConfig:
    """Returns the settings with the hash of the viewpoints' content in place of the path of their file.

    Args:
        made: settings that a data set was made with, whose hash is used if the file is gone.

    Raises:
        DataError: if the file cannot be used.
    """
    if not is_file(config.lattice):
        return config
    path, before = Path(config.lattice.removeprefix(FILE)).expanduser(), str((made or {}).get("lattice", ""))
    if not path.exists() and is_file(before):
        return replace(config, lattice=before)
    return replace(config, lattice=f"{FILE}{viewpoints_of(config).digest}")
