"""Checks of triangles that readers and the normalisation share."""

from __future__ import annotations

import numpy as np

from data_pipeline.errors import DamagedMesh


def check_indices(indices: np.ndarray, vertex_count: int, where: str) -> None:
    """Raises DamagedMesh if an index of a vertex is negative or beyond the last vertex."""
    if indices.size and (indices.min() < 0 or indices.max() >= vertex_count):
        raise DamagedMesh(f"{where} has faces that name vertices beyond its {vertex_count}; repair it or take it away")
