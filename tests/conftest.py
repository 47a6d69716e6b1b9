"""What tests share. Shapes in signatures are checked in every test (see `addopts` in pyproject.toml)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

REAL = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def real_voxels() -> Path:
    """The real ModelNet10 as voxel grids; kept beside a checkout by those who have it, never in it."""
    path = REAL / "data" / "modelnet10_voxels32.npz"
    if not path.exists():
        pytest.skip(f"real ModelNet10 voxels are not at {path.parent.name}/{path.name} beside the checkout")
    return path


@pytest.fixture(scope="session")
def real_meshes() -> Path:
    path = REAL / "data" / "modelnet10_off"
    if not path.exists():
        pytest.skip(f"original ModelNet10 meshes are not in {path.name} beside the checkout")
    return path


@pytest.fixture(scope="session")
def thesis_files() -> Path:
    path = REAL / "thesis"
    if not path.exists():
        pytest.skip("the thesis's view graphs and entropy maps are not beside the checkout")
    return path
