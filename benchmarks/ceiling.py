"""What limits accuracy, regardless of the number of views: `python benchmarks/ceiling.py RUN ARCHIVE [--split val]`.

RUN is a directory in which `mevs study learned` was run on ARCHIVE, an .npz of voxel grids. Grids of this resolution
have lost thin surfaces: table tops, mattresses, whole chairs except for their feet. An object counts as whole by the
share of its filled cells that are connected (26 neighbours). The results are the accuracy from 1, 2, 4 and all views
for whole and other objects, the classes that are confused after all views, and how often the nearest training grid
has the same label.

The table is written to `benchmarks/results/ceiling.md`, images of some objects that are wrong after all views to `ceiling.png`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from scipy.ndimage import label as connected

from data_pipeline.dataset.builder import open_split
from data_pipeline.files import write_text
from eval.numbers.comparison import intervals
from eval.settings import PRESETS
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.markdown import markdown_table
from train.choosing.calibrated import beliefs_of_sets
from train.choosing.features import Features, sets_of_size
from train.choosing.stages import Stages

RESULTS = Path(__file__).parent / "results"
WHOLE = 0.9
"""An object is whole if at least this share of its cells is connected."""


@dataclass(frozen=True)
class Options:
    run: Annotated[Path, tyro.conf.Positional]
    """directory in which `mevs study learned` was run"""
    archive: Annotated[Path, tyro.conf.Positional]
    """the .npz of voxel grids that the study used"""
    preset: Literal["small", "tiny"] = "small"
    """preset of the study"""
    split: Literal["test", "val"] = "test"
    """split whose objects are evaluated"""


def wholeness(grids: np.ndarray) -> np.ndarray:
    """The share of each grid's filled cells in its largest piece."""
    shares = []
    for grid in grids:
        pieces = np.bincount(connected(grid, np.ones((3, 3, 3)))[0].reshape(-1))[1:]
        shares.append(pieces.max() / pieces.sum())
    return np.array(shares)


def nearest(some: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the other grid with the largest intersection over union, and that value, for each grid."""
    flat, against = (grids.reshape(len(grids), -1).astype(np.float32) for grids in (some, others))
    common = flat @ against.T
    overlap = common / (flat.sum(axis=1)[:, None] + against.sum(axis=1) - common)
    return overlap.argmax(axis=1), overlap.max(axis=1)


def predictions(fusion: CalibratedFusion, data: Features, size: int, draws: int = 8) -> np.ndarray:
    """Predicted classes of random sets of `size` views, (objects, draws)."""
    views = data.features.shape[1]
    sets = sets_of_size(len(data.labels), views, size, 1 if size == views else draws)
    return beliefs_of_sets(fusion, data, sets).argmax(axis=-1).T


def draw(path: Path, views: list[np.ndarray], titles: list[str], columns: int = 8) -> None:
    figure, axes = plt.subplots(
        -(-len(views) // columns), columns, figsize=(1.5 * columns, 1.8 * -(-len(views) // columns))
    )
    for axis in axes.flat:
        axis.axis("off")
    for axis, view, title in zip(axes.flat, views, titles, strict=False):
        axis.imshow(view, cmap="gray")
        axis.set_title(title, fontsize=6)
    figure.tight_layout(pad=0.3)
    figure.savefig(path, dpi=90)


def main(options: Options) -> None:
    settings = PRESETS[options.preset]
    stages = Stages(settings.learned, settings.dataset, options.run)
    classes, views = stages.statistics.classes, settings.dataset.capture.views
    data = stages.features(f"lattice_{views}_{options.split}", options.run / "data", options.split)
    source = open_split(options.run / "data", options.split)
    objects = [source[index] for index in range(len(source))]
    with np.load(options.archive) as archive:
        train, train_labels = archive["X_train"] > 0, archive["y_train"]
        # Validation objects are of the official training split.
        from_split = "test" if options.split == "test" else "train"
        grids = archive[f"X_{from_split}"] > 0
    number = np.array([int(example["name"].decode().rsplit("_", 1)[1]) for example in objects])
    grids, labels = grids[number], np.asarray(data.labels)

    whole = wholeness(grids) >= WHOLE
    groups = {
        "all": np.ones(len(labels), bool),
        f"in one piece (≥ {WHOLE:.0%} of the cells)": whole,
        "in pieces": ~whole,
    }
    sizes, predicted = (1, 2, 4, views), {}
    for size in sizes:
        predicted[size] = predictions(stages.fusion(), data, size)
    rows = []
    for title, chosen in groups.items():
        cells = []
        for size in sizes:
            right = (predicted[size] == labels[:, None]).mean(axis=1)[chosen]
            low, high = intervals(right[None])[0]
            cells.append(f"{100 * right.mean():.1f} [{100 * low:.1f}, {100 * high:.1f}]")
        rows.append([title, str(chosen.sum()), *cells])

    final = predicted[views][:, 0]
    wrong = np.flatnonzero(final != labels)
    pairs, counts = np.unique(np.stack([labels[wrong], final[wrong]]), axis=1, return_counts=True)
    often = np.argsort(-counts)[:8]
    confusions = ", ".join(f"{classes[pairs[0, i]]} for {classes[pairs[1, i]]} {counts[i]}" for i in often)
    header = ["objects", "number", *(f"{size} views" if size > 1 else "1 view" for size in sizes)]
    lines = [
        f"# What holds accuracy down ({options.split} objects)",
        "",
        "Accuracy (%) of random views fused, 95 % intervals over objects.",
        "",
        markdown_table(header, rows),
        "",
        f"Wrong after all {views} views: {len(wrong)} of {len(labels)}. Taken the first for the second: {confusions}.",
    ]

    others = np.setdiff1d(np.arange(len(train)), number) if options.split == "val" else np.arange(len(train))
    others = others[train[others].any(axis=(1, 2, 3))]
    index, overlap = nearest(grids, train[others])
    same = train_labels[others][index] == labels
    lines += ["", "The training grid that overlaps most has the same label:", ""]
    for least in (0.0, 0.7, 0.8, 0.9):
        near = overlap >= least
        lines.append(f"* overlap of {least:.1f} and more: {100 * same[near].mean():.1f} % of {near.sum()} objects")
    write_text(RESULTS / "ceiling.md", "\n".join(lines) + "\n")
    print("\n".join(lines))

    some = wrong[np.linspace(0, len(wrong) - 1, min(40, len(wrong))).astype(int)]
    from_above = int(np.argmin(np.abs(np.asarray(data.directions[0, :, 2]) - 0.45)))
    draw(
        RESULTS / "ceiling.png",
        [objects[i]["image"][from_above] for i in some],
        [f"{classes[labels[i]]},\ntaken for {classes[final[i]]}" for i in some],
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__.splitlines()[0]))
