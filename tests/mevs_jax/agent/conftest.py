"""The systems that agents are tested with. All tests share them, since what an agent compiles is kept by its system."""

from __future__ import annotations

import pytest

from mevs_jax.trained import TrainedSystem
from tests.mevs_jax.trained import making


@pytest.fixture(scope="session")
def classifier() -> TrainedSystem:
    return making.system("classifier")


@pytest.fixture(scope="session")
def recogniser() -> TrainedSystem:
    return making.system("recogniser")


@pytest.fixture(scope="session")
def system(classifier) -> TrainedSystem:
    return classifier
