"""What limits accuracy, regardless of the number of views: `python benchmarks/ceiling.py RUN ARCHIVE [--split val]`.

RUN is a directory in which `mevs study learned` was run on ARCHIVE, an .npz of voxel grids. Grids of this resolution
have lost thin surfaces: table tops, mattresses, whole chairs except for their feet. An object counts as whole by the
share of its filled cells that are connected (26 neighbours). The results are the accuracy from 1, 2, 4 and all views
for whole and other objects, the classes that are confused after all views, and how often the nearest training grid
has the same label.

The table is written to `benchmarks/results/ceiling.md`, images of some objects that are wrong after all views to `ceiling.png`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from matplotlib.figure import Figure
from scipy.ndimage import label as connected

from benchmarks.reporting import RESULTS
from data_pipeline.dataset.builder import open_split
from data_pipeline.files import write_text
from eval.numbers.comparison import intervals
from eval.settings import PRESETS
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.markdown import markdown_table
from train.choosing.calibrated import beliefs_of_sets
from train.choosing.features import Features, sets_of_size
from train.choosing.stages import Stages

WHOLE = 0.9
"""An object is whole if at least this share of its cells is connected."""


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
    rows = -(-len(views) // columns)
    figure = Figure(figsize=(1.5 * columns, 1.8 * rows))
    for number, (view, title) in enumerate(zip(views, titles, strict=True), 1):
        axes = figure.add_subplot(rows, columns, number)
        axes.axis("off")
        axes.imshow(view, cmap="gray")
        axes.set_title(title, fontsize=6)
    figure.tight_layout(pad=0.3)
    figure.savefig(path, dpi=90)


def accuracies(right: dict[int, np.ndarray], whole: np.ndarray) -> str:
    """A table of accuracies of whole and other objects; `right` has the share of right answers by number of views, (objects,)."""
    groups = {
        "all": np.ones(len(whole), bool),
        f"in one piece (≥ {WHOLE:.0%} of the cells)": whole,
        "in pieces": ~whole,
    }
    rows = []
    for title, chosen in groups.items():
        cells = []
        for shares in right.values():
            low, high = intervals(shares[None, chosen])[0]
            cells.append(f"{100 * shares[chosen].mean():.1f} [{100 * low:.1f}, {100 * high:.1f}]")
        rows.append([title, str(chosen.sum()), *cells])
    return markdown_table(["objects", "number", *(f"{size} view{'s' * (size > 1)}" for size in right)], rows)


def confusions(labels: np.ndarray, answers: np.ndarray, classes: list[str]) -> str:
    pairs, counts = np.unique(np.stack([labels, answers])[:, answers != labels], axis=1, return_counts=True)
    often = np.argsort(-counts)[:8]
    return ", ".join(f"{classes[pairs[0, i]]} for {classes[pairs[1, i]]} {counts[i]}" for i in often)


def main(
    run: Annotated[Path, tyro.conf.Positional],
    archive: Annotated[Path, tyro.conf.Positional],
    preset: Literal["small", "tiny"] = "small",
    split: Literal["test", "val"] = "test",
) -> None:
    """Measures, shows and keeps.

    Args:
        run: directory in which `mevs study learned` was run.
        archive: the .npz of voxel grids that the study used.
        preset: of the study.
        split: whose objects are evaluated.
    """
    settings = PRESETS[preset]
    stages = Stages(settings.learned, settings.dataset, run)
    classes, views = stages.statistics.classes, settings.dataset.capture.views
    data = stages.features(f"lattice_{views}_{split}", run / "data", split)
    objects = list(open_split(run / "data", split))
    number = np.array([int(example["name"].decode().rsplit("_", 1)[1]) for example in objects])
    with np.load(archive) as stored:
        train, train_labels = stored["X_train"] > 0, stored["y_train"]
        # Validation objects are of the official training split.
        grids = (stored["X_test"] > 0 if split == "test" else train)[number]
    labels = np.asarray(data.labels)
    answers = {size: predictions(stages.fusion(), data, size) for size in (1, 2, 4, views)}
    right = {size: (found == labels[:, None]).mean(axis=1) for size, found in answers.items()}
    final = answers[views][:, 0]
    wrong = np.flatnonzero(final != labels)

    others = np.setdiff1d(np.arange(len(train)), number) if split == "val" else np.arange(len(train))
    others = others[train[others].any(axis=(1, 2, 3))]
    index, overlap = nearest(grids, train[others])
    same = train_labels[others][index] == labels
    near = {least: overlap >= least for least in (0.0, 0.7, 0.8, 0.9)}
    parts = [
        f"# What holds accuracy down ({split} objects)",
        "Accuracy (%) of random views fused, 95 % intervals over objects.",
        accuracies(right, wholeness(grids) >= WHOLE),
        f"Wrong after all {views} views: {len(wrong)} of {len(labels)}. "
        f"Taken the first for the second: {confusions(labels, final, classes)}.",
        "The training grid that overlaps most has the same label:",
        "\n".join(
            f"* overlap of {least:.1f} and more: {100 * same[chosen].mean():.1f} % of {chosen.sum()} objects"
            for least, chosen in near.items()
        ),
    ]
    text = "\n\n".join(parts)
    write_text(RESULTS / "ceiling.md", f"{text}\n")
    print(text)

    some = wrong[np.linspace(0, len(wrong) - 1, min(40, len(wrong))).astype(int)]
    from_above = int(np.argmin(np.abs(np.asarray(data.directions[0, :, 2]) - 0.45)))
    titles = [f"{classes[labels[i]]},\ntaken for {classes[final[i]]}" for i in some]
    draw(RESULTS / "ceiling.png", [objects[i]["image"][from_above] for i in some], titles)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
