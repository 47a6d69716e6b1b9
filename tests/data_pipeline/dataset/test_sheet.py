"""The picture of a data set shows its objects, in the direction that is up."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.sheet import draw_objects
from data_pipeline.dataset.statistics import load_statistics


def test_each_object_is_shown_with_its_size_and_upward_direction(data, tmp_path, monkeypatch):
    statistics, drawn = load_statistics(data), []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    monkeypatch.setattr("data_pipeline.dataset.sheet.write_bytes", lambda *_: None)
    draw_objects(data, statistics, tmp_path / "objects.png")
    shown = [axis for axis in drawn[0].axes if axis.images]
    assert len(shown) == statistics.objects_of(["train"])
    assert [axis.get_title(loc="left") for axis in drawn[0].axes[::8]] == statistics.classes
    examples = sorted(open_split(data, "train"), key=lambda example: example["label"])
    for axis, example in zip(shown, examples, strict=True):
        size = " × ".join(f"{side:.3g}" for side in example["extent"])
        arrow, words = axis.texts
        assert words.get_text() == size
        view = next(n for n, image in enumerate(example["image"]) if np.array_equal(image, axis.images[0].get_array()))
        inverse = np.linalg.inv(example["pose"][view])
        ends = [inverse @ (0, 0, height, 1) for height in (0, 0.01)]  # of a short stick in the middle of the object
        seen = [end[:2] / end[2] for end in ends]
        along = np.subtract(arrow.xy, arrow.xyann)
        # Without perspective, which moves the end of a stick by less than this.
        assert along / np.linalg.norm(along) @ (seen[1] - seen[0]) / np.linalg.norm(seen[1] - seen[0]) == pytest.approx(
            1, abs=1e-3
        )
