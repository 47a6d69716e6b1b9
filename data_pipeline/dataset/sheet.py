"""A picture of a data set's objects, on which a wrong upward direction, unit or file is seen before anything is trained."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_pipeline.dataset.index import read_index
from data_pipeline.dataset.proof import open_split
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.files import write_bytes

_ACROSS, _DOWN = 8, 40
"""The most objects of a class, and classes, on the picture."""
_FROM = np.array([0.7, -0.5, 0.5])
"""Direction from which objects are shown: from in front and a little above, where there is such a view."""


def draw_objects(folder: Path, statistics: DatasetStatistics, path: Path) -> None:
    """Draws the first training objects of each class in the data set of `folder`, with their upward directions and sizes."""
    from matplotlib.figure import Figure  # late: it takes half a second

    index = read_index(folder, "train", "label", "extent")
    examples = open_split(folder, "train", ("image", "pose"))
    labels = [label for label in range(len(statistics.classes)) if (index["label"] == label).any()][:_DOWN]
    view = int((np.array(statistics.viewpoints) @ _FROM).argmax())
    figure = Figure(figsize=(1.3 * _ACROSS, 1.55 * len(labels)), layout="constrained")
    for row, axes in zip(labels, figure.subplots(len(labels), _ACROSS, squeeze=False), strict=True):
        for axis in axes:
            axis.set_axis_off()
        axes[0].set_title(statistics.classes[row], loc="left", fontsize=8)
        for axis, number in zip(axes, np.flatnonzero(index["label"] == row), strict=False):
            example = examples[number]
            image, up = example["image"][view], _up_in_image(example["pose"][view])
            axis.imshow(image, cmap="gray")
            middle = np.array(image.shape[::-1]) * (0.06, 0.5)
            axis.annotate(
                "", middle + 0.2 * len(image) * up, middle, arrowprops={"arrowstyle": "->", "color": "tab:red"}
            )
            size = " × ".join(f"{side:.3g}" for side in index["extent"][number])
            axis.text(0.5, -0.04, size, fontsize=6, ha="center", va="top", transform=axis.transAxes)
    picture = BytesIO()
    figure.savefig(picture, dpi=110)
    write_bytes(path, picture.getvalue())


def _up_in_image(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 2"]:
    """The world's z axis in an image, to the right and down, from `T_world_camera`."""
    return pose[2, :2]
