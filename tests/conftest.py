"""What tests share. Shapes in signatures are checked in every test (see `addopts` in pyproject.toml)."""

from __future__ import annotations

import atexit
import fcntl
import gc
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tests.typecheck  # noqa: F401  # jaxtyping's hook looks for it, and imports no more than `tests`

# `MEVS_TEST_DEFAULT_FLAGS=1` runs the tests with XLA as users run it: all optimisations, by the emitters that are its default.
DEFAULT_FLAGS = os.environ.get("MEVS_TEST_DEFAULT_FLAGS", "0") not in ("", "0")

if "PYTEST_XDIST_WORKER" not in os.environ:
    # One cache of compiled programs for all workers and for the programs that tests start, which inherit these variables. JAX
    # is not imported yet. CI names one for several runs of the tests.
    compiled = os.environ.get("MEVS_TEST_COMPILED") or tempfile.mkdtemp(prefix="mevs_jax-compiled-")
    if not os.environ.get("MEVS_TEST_COMPILED"):
        atexit.register(shutil.rmtree, compiled, ignore_errors=True)
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": compiled, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05"}
    # Tests compile much and run little: without most optimisations, and by XLA's older emitters, that takes a third of the time.
    # What runs long has all optimisations (`fully_compiled`); CI runs some of the library's tests with all of them, too.
    jaxlib = tuple(map(int, version("jaxlib").split(".")[:2]))
    if not DEFAULT_FLAGS:
        flags = [
            os.environ.get("XLA_FLAGS", ""),
            "--xla_cpu_parallel_codegen_split_count=1",
        ]  # small programs: no threads
        if jaxlib < (0, 11):  # later versions have the newer emitters alone, and end at the name of this flag
            flags.append("--xla_cpu_use_fusion_emitters=false")
        os.environ["XLA_FLAGS"] = " ".join(flags).strip()
        os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

# Tracing leaves many small objects that live: looking through them all as often as Python does takes up to a tenth of the time.
gc.set_threshold(100_000, 50, 100)

REAL = Path(__file__).resolve().parents[2] / "shared"


LONG = (
    "tests/cli/test_cli.py",
    "tests/eval/test_leaks.py",
    "tests/eval/test_processes.py",
    "tests/eval/thesis/test_thesis.py",
    "tests/train/many/test_seeds.py",
    "tests/train/many/test_sweep.py",
    "tests/train/test_training.py",
    "tests/train/running/test_scaling.py",
    "tests/train/choosing/test_recogniser.py",
    "tests/train/choosing/test_together.py",
    "tests/mevs_jax/rendering/test_soft.py",
    "tests/train/running/test_processes.py",
    "tests/eval/learned/test_study.py",
    "tests/eval/walks/test_evaluation.py",
    "tests/eval/test_seeds.py",
)
"""The files that take longest. They begin first, so that no worker is left with one of them at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def place(item: pytest.Item) -> int:
        file = item.nodeid.split("::")[0]
        return LONG.index(file) if file in LONG else len(LONG)

    items.sort(key=place)


def open3d_or_skip() -> None:
    """For what needs Open3D and its system libraries."""
    from data_pipeline.objects.open3d_parts import load_open3d

    try:
        load_open3d()
    except (ImportError, OSError) as error:
        pytest.skip(f"Open3D cannot be loaded here: {error}")


@pytest.fixture
def fully_compiled() -> Iterator[None]:
    """For tests whose programs need all optimisations. The older emitters stay, where the installed XLA has them."""
    import jax

    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """This worker's copy of a folder that the first worker to need it makes. It must not be written to.

    It is a copy because a command locks the folder that it runs in, also while it changes nothing there.
    With `MEVS_TEST_MADE=DIRECTORY` several sessions that test the same code share it, as in CI.
    """
    shared = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent  # each worker has a folder of its own in it
    if given := os.environ.get("MEVS_TEST_MADE"):
        shared = Path(given) / f"jax-{version('jax')}"
        shared.mkdir(parents=True, exist_ok=True)
    folder, done = shared / f"shared_{name}", shared / f"shared_{name}.done"
    with (shared / f"shared_{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            make(folder)
            done.touch()
    return shutil.copytree(folder, factory.mktemp(name) / name)


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """The data set of the preset `tiny`, for reading only. Some modules have another fixture of this name."""
    from data_pipeline.dataset.builder import prepare
    from eval.settings import TINY

    return made_once(tmp_path_factory, "data", lambda folder: prepare(TINY.dataset, folder))


@pytest.fixture(scope="session")
def turned(tmp_path_factory) -> Path:
    """As `data`, but the cameras of each object are turned; for reading only."""
    from dataclasses import replace

    from data_pipeline.dataset.builder import prepare
    from eval.settings import TINY

    config = replace(TINY.dataset, capture=replace(TINY.dataset.capture, turned=True))
    return made_once(tmp_path_factory, "turned", lambda folder: prepare(config, folder))


@pytest.fixture(scope="session")
def otherwise_tested(tmp_path_factory) -> Path:
    """As `data`, but with other test objects, and another number of them in each class; for reading only."""
    from data_pipeline.dataset.builder import prepare
    from eval.settings import TINY
    from tests.reference.leaks import other_test_objects

    def make(folder: Path) -> None:
        with other_test_objects():
            prepare(TINY.dataset, folder)

    return made_once(tmp_path_factory, "otherwise_tested", make)


@pytest.fixture(scope="session")
def whole(tmp_path_factory, data) -> Path:
    """One run of the preset `tiny` by the command line, with `data`, never interrupted, for reading only."""

    def make(folder: Path) -> None:
        shutil.copytree(data, folder / "data")
        command = [sys.executable, "-m", "mevs_jax", "run", "--preset", "tiny", "--out", str(folder)]
        result = subprocess.run(command, capture_output=True, text=True, timeout=900)
        assert result.returncode == 0, result.stderr
        assert "Report:" in result.stdout

    return made_once(tmp_path_factory, "whole", make)


@pytest.fixture(scope="session")
def studied(tmp_path_factory, whole) -> Path:
    """The run of `whole` with a learned study by `tests.reference.leaks.LEARNED`, for reading only."""
    from eval.learned.stage import learn_to_choose
    from tests.reference.leaks import LEARNED

    def make(folder: Path) -> None:
        shutil.copytree(whole, folder)
        learn_to_choose(LEARNED, folder)

    return made_once(tmp_path_factory, "studied", make)


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium, without a window; skipped where it, or what drives it, is not installed."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed: pip install '.[browser]'"
    )
    programs = map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))
    program = next((program for program in programs if program), None)
    if program is None:
        pytest.skip("there is no Chromium here: apt-get install chromium")
    # WebGL without a graphics card, and the same pixels whenever the same is drawn.
    drawing = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-accelerated-2d-canvas"]
    with playwright.sync_playwright() as started:
        launch = partial(
            started.chromium.launch, executable_path=program, args=["--no-sandbox", *drawing], timeout=60_000
        )
        opened = _at_the_third_try(launch, playwright.TimeoutError)
        yield opened
        opened.close()


def _at_the_third_try(start: Callable[[], Any], late: type[Exception]) -> Any:
    """What `start` returns, which may be late twice: once, Chromium said nothing until it was given up."""
    for _ in range(2):
        with suppress(late):
            return start()
    return start()


@pytest.fixture
def opened(browser) -> Iterator[Callable[..., Any]]:
    """A function that opens pages, as `tests.reference.browser.Opened`."""
    from tests.reference.browser import Opened

    pages: list[Opened] = []

    def open_page(address: Path | str, width: int, scheme: str = "light", **options: Any) -> Opened:
        pages.append(Opened(browser, address, width, scheme, **options))
        return pages[-1]

    yield open_page
    for page in pages:
        page.context.close()


@pytest.fixture(scope="session")
def fusion():
    """A learned fusion of arbitrary weights, of five features."""
    from tests.reference.choosing import CLASSES, fusion_of

    return fusion_of(5, CLASSES)


@pytest.fixture(scope="session")
def policy():
    """A view policy of arbitrary weights."""
    from tests.reference.choosing import some_policy

    return some_policy()


@pytest.fixture(scope="session")
def adding():
    """The sum of logits, as a fusion."""
    from tests.reference.choosing import adding_fusion

    return adding_fusion()


@pytest.fixture
def named() -> None:
    """Processes on CPUs find each other by the name of this machine; the test is skipped where it has no address."""
    from data_pipeline.distributed import unresolved_name

    if name := unresolved_name():
        pytest.skip(f"processes on CPUs cannot reach each other: the name of this machine, {name}, has no address")


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
