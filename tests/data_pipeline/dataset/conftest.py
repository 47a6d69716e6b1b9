"""The data set that tests of this folder read."""

from __future__ import annotations

from pathlib import Path

import pytest

from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.dataset.builder import DataConfig, prepare
from tests.conftest import made_once

CONFIG = DataConfig(train_per_class=5, test_per_class=1, capture=CaptureConfig(views=8, resolution=32))


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """Eight views of six objects of each class, few enough for one process to capture them; for reading only."""
    return made_once(tmp_path_factory, "data_of_eight_views", lambda folder: prepare(CONFIG, folder))
