"""What tests share. Shapes in signatures are checked in every test (see `addopts` in pyproject.toml)."""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

if "PYTEST_XDIST_WORKER" not in os.environ:
    # What one test has compiled the others need not, nor the workers and programs that they start, which inherit this. JAX is not
    # imported yet.
    compiled = tempfile.mkdtemp(prefix="mevs_jax-compiled-")
    atexit.register(shutil.rmtree, compiled, ignore_errors=True)
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": compiled, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2"}
    # Tests compile much and run little: without most optimisations, and by XLA's older emitters, that takes a third of the time.
    # What is compared with PyTorch and plain loops, and what runs long, has all optimisations (`fully_compiled`).
    jaxlib = tuple(map(int, version("jaxlib").split(".")[:2]))
    if jaxlib < (0, 11):  # later ones have the newer emitters alone, and end at the name of the choice
        flags = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_use_fusion_emitters=false".strip()
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

# Tracing leaves many small objects that live: looking through them all as often as Python does takes up to a tenth of the time.
gc.set_threshold(100_000, 50, 100)

REAL = Path(__file__).resolve().parents[2] / "shared"


# The files that take longest, one worker each: begun first, so that none is left for one worker at the end.
LONG = (
    "test_cli",
    "test_sweep",
    "test_thesis",
    "test_training",
    "test_soft_rendering",
    "test_scaling",
    "test_processes",
    "test_evaluation",
    "test_policy",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def place(item: pytest.Item) -> int:
        return LONG.index(item.path.stem) if item.path.stem in LONG else len(LONG)

    items.sort(key=place)


def open3d_or_skip() -> None:
    """For what needs Open3D and its system libraries."""
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError) as error:
        pytest.skip(f"Open3D cannot be loaded here: {error}")


@pytest.fixture
def fully_compiled() -> Iterator[None]:
    """For tests whose programs are to have all optimisations, though by the older emitters too where there are any."""
    import jax

    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """The data set of the preset `tiny`, to be read and not written to, where a module has no other of this name."""
    from data_pipeline.dataset.builder import prepare
    from eval.settings import TINY

    folder = tmp_path_factory.mktemp("tiny") / "data"
    prepare(TINY.dataset, folder)
    return folder


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


def beside_the_checkout(*parts: str) -> Path:
    """Real data, kept beside a checkout by those who have it, never in it; the test is skipped where it is not."""
    path = REAL.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{path.name} is not beside the checkout")
    return path


@pytest.fixture(scope="session")
def real_voxels() -> Path:
    """All of ModelNet10 as voxel grids."""
    return beside_the_checkout("data", "modelnet10_voxels32.npz")


@pytest.fixture(scope="session")
def real_meshes() -> Path:
    """Some original ModelNet10 meshes."""
    return beside_the_checkout("data", "modelnet10_off")


@pytest.fixture(scope="session")
def thesis_files() -> Path:
    """The thesis's view graphs and entropy maps."""
    return beside_the_checkout("thesis")
