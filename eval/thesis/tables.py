"""The thesis's Tables 1–15: our numbers, its numbers, and a note on why they differ."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np

from eval.rendering.ascent import FACES
from eval.thesis.layout import Cell, Row, ThesisTable, thesis_numbers
from eval.thesis.results import ORACLE_MV, ThesisResults
from eval.thesis.timing import AscentTimes
from mevs_jax.markdown import markdown_table
from train.many.thesis import BACKBONES, FRAMES, PIPELINE, VIEWS


def _percent(values: Iterable[float]) -> list[Cell]:
    return [100 * value for value in values]


def _points(value: float) -> str:
    """A share in percentage points, with a sign."""
    return f"{100 * value:+.2f}".replace("-", "−")


def _with_ends(mean: float, interval: np.ndarray) -> str:
    """A difference of shares in percentage points with its interval."""
    low, high = map(_points, interval)
    return f"{_points(mean)} [{low}, {high}]"


def _ct(results: ThesisResults) -> list[str]:
    return [f"CT {threshold:g}" for threshold in results.thresholds]


# ------------------------------------------------------------------------------------------------------------- the tables


def machine_table(results: ThesisResults) -> ThesisTable:
    ours = results.machine
    memory = f"{ours.memory_gib:.0f} GiB" if ours.memory_gib else None
    return ThesisTable(
        1,
        "Machine",
        ["value"],
        [
            Row("Operating system", [ours.operating_system], ["Linux Mint 20.3"]),
            Row("CPU", [f"{ours.cpu}, {ours.cores} cores"], ["Intel i7-10875H, 16 threads"]),
            Row("Device", [ours.device], ["NVIDIA GeForce RTX 2060 Max-Q, 6 GB"]),
            Row("Memory", [memory], ["31,817 MiB"]),
            Row("Framework", [f"JAX {ours.jax}"], ["PyTorch 1.7.1, CUDA 11.0"]),
            Row("Python", [ours.python], ["3.7"]),
        ],
        "The machine of all results below.",
    )


def rendering_times(results: ThesisResults) -> ThesisTable:
    thesis, ours = thesis_numbers()["table_2"], results.ascent
    methods = [method.seconds for method in (ours.mesh, ours.volume) if method is not None]
    rows = [
        Row(name, [n for seconds in methods for n in seconds[name]] or [None] * 4, thesis["rows"].get(name, [None] * 4))
        for name in [*results.classes, "all"]
        if not methods or name in methods[0]
    ]
    return ThesisTable(
        2,
        "Time of the methods by differentiable rendering (s)",
        thesis["columns"],
        rows,
        f"Ours: depth entropy of a soft mesh of at most {FACES} faces, and opacity entropy of a 32³ volume, both at "
        f"{ours.resolution}×{ours.resolution} pixels; all {ours.starts} start views of an object together, "
        f"{ours.runs} objects per class, on the machine of Table 1. The thesis: one start view, on its GPU.{_missing(ours)}",
    )


def _missing(ascent: AscentTimes) -> str:
    return f" Not measured: {ascent.missing}." if ascent.missing else ""


def predictor_times(results: ThesisResults) -> ThesisTable:
    thesis, ours = thesis_numbers()["table_3"]["rows"], results.timing
    rows = [
        Row(
            name,
            [number for views in VIEWS for number in ours.of(views).by_class.get(name, (None, None))],
            thesis.get(name, [None] * 4),
        )
        for name in [*results.classes, "all"]
    ]
    found = {views: ours.of(views).local_maxima for views in VIEWS}
    maxima = ", ".join(
        f"{times.alone:.3f} ms alone and {1000 * times.batched:.2f} µs per object in a batch of 1,000 for {views} views"
        for views, times in found.items()
    )
    return ThesisTable(
        3,
        "Time of PointNet++ by class (ms)",
        ["10 views, mean", "sd", "40 views, mean", "sd"],
        rows,
        f"One cloud, {ours.runs} runs per class with device synchronisation, for the network size of this run on "
        f"the machine of Table 1. Local maxima (Appendix A; in the thesis 0.144 and 0.584 ms): {maxima}.",
        digits=3,
    )


def entropy_table(results: ThesisResults) -> ThesisTable:
    thesis, rows = thesis_numbers()["table_4"]["rows"], []
    for name in [*results.classes, "all"]:
        ours: list[Cell] = []
        for found in results.entropy.values():
            world, camera = (found.frames[frame].by_class.get(name, (None, None)) for frame in ("world", "camera"))
            maps = (by_class.get(name, (None,))[0] for by_class in (found.mean_map, found.class_mean_map))
            ours += [*world, camera[0], *maps]
        theirs = thesis.get(name, [None] * 4)
        rows.append(Row(name, ours, [*theirs[:2], None, None, None, *theirs[2:], None, None, None]))
    parts = [heading for views in VIEWS for heading in (f"{views} views", "sd", "camera", "mean map", "class map")]
    shares, differences = [], []
    for views, found in results.entropy.items():
        explained = {frame: 100 * of.explained_variance for frame, of in found.frames.items()}
        shares.append(
            f"{views} views: {explained['world']:.1f} % in the world frame, {explained['camera']:.1f} % in the camera frame"
        )
        low, high = found.camera_minus_world.interval
        difference = f"{found.camera_minus_world.mse:+.4f} [{low:+.4f}, {high:+.4f}] for {views} views"
        differences.append(difference.replace("-", "−"))
    # Classes on which the network is no better than a predictor that receives no view.
    above: dict[str, list[str]] = {frame: [] for frame in FRAMES}
    for frame, (views, found) in product(FRAMES, results.entropy.items()):
        for name, (error, _) in found.frames[frame].by_class.items():
            if error >= min(found.mean_map[name][0], found.class_mean_map[name][0]):
                every_side = f" ({found.every_side[name][0]:.4f} with the mean prediction over clouds of all views)"
                above[frame].append(f"{name} with {views} views{every_side if frame == 'world' else ''}")
    return ThesisTable(
        4,
        "Squared error of predicted entropies by class",
        parts,
        rows,
        "On test objects, normalised by the largest entropy of each training split; the thesis chose its checkpoints on these "
        "objects, this run did not. The thesis's clouds do not hold the camera pose. Ours are in the world frame, where each "
        "point has the direction to the camera unless that is switched off; for comparison, also in the camera frame, without "
        "directions. The mean map receives no view; the class map, the mean of a class, is given the true class. Variance "
        f"explained, {'; '.join(shares)}; from the thesis's means and its standard deviation of 0.156: 51 % and 30 %. Error in "
        f"the camera frame minus the world frame, paired by object: {', '.join(differences)}. Not below both trivial predictors: "
        f"in the world frame {', '.join(above['world']) or 'none'}; in the camera frame {', '.join(above['camera']) or 'none'}.",
        digits=4,
    )


def losses_table(results: ThesisResults) -> ThesisTable:
    thesis = thesis_numbers()["table_5"]["rows"]
    trained = [(backbone.title, results.backbones[backbone.name]) for backbone in BACKBONES]
    rows = [Row(title, [found.train_loss, found.val_loss], thesis[title]) for title, found in trained]
    started = "; ".join(f"{title}: {found.start}" for title, found in trained)
    return ThesisTable(
        5,
        "Best losses of the classifiers",
        ["training loss", "validation loss"],
        rows,
        "Validation objects are never trained on; the thesis holds out views, so the same objects are in both splits. Training "
        f"losses are with augmentation. Initial weights: {started}.",
        digits=3,
    )


def single_view_table(results: ThesisResults) -> ThesisTable:
    thesis = thesis_numbers()["table_6"]["rows"]
    rows = []
    for backbone in BACKBONES:
        ours = _percent(found.accuracy for found in results.single_views[backbone.name].values())
        rows.append(Row(backbone.title, ours, thesis[backbone.title]))
    return ThesisTable(
        6,
        "Accuracy of the classifiers on single views (%)",
        ["10-view data", "40-view data"],
        rows,
        "All views of all test objects; each classifier receives the kind of image that it was trained on.",
    )


def gain_table(number: int, views: int, results: ThesisResults) -> ThesisTable:
    thesis, found = thesis_numbers()[f"table_{number}"], results.pipeline[views]
    gain = found.gain["text"]
    rows = [
        Row(
            f"MV {mv}",
            _percent(values),
            thesis.get(str(mv), ()),
            [bool(low > 0 or high < 0) for low, high in intervals],
        )
        for mv, values, intervals in zip(found.max_views, gain.difference, gain.interval, strict=True)
    ]
    switches = {
        "text": "PointNet++ minus random",
        "camera": "with clouds in the camera frame",
        "repetition": "random with repetition, as in the published code",
        "published_code": "camera frame, repetition, and the list sorted in place",
        "oracle": "the oracle minus random",
    }
    means = []
    for name, title in switches.items():
        of = found.gain[name]
        means.append(f"{title}: {_with_ends(of.mean, of.mean_interval)}, {of.above_zero} cells above zero")
    printed = [value for values in thesis.values() for value in values]
    above = sum(value > 0 for value in printed)
    theirs = f"{_points(sum(printed) / len(printed) / 100)}, {above} of {len(printed)} cells above zero"
    return ThesisTable(
        number,
        f"Gain of PointNet++ over random selection, {views} views (points)",
        _ct(results),
        rows,
        "Mean of the three backbones, over every start view of every test object; bold if the 95 % interval over objects "
        f"excludes zero. Mean of all cells: {'; '.join(means)}. The thesis: {theirs}, from three runs (five for 40 views) in "
        "rows 2–5 and from single runs below.",
        digits=2,
        signed=True,
    )


def best_table(results: ThesisResults) -> ThesisTable:
    thesis, rows = thesis_numbers()["table_8"]["rows"], []
    for backbone in PIPELINE:
        for views, found in results.pipeline.items():
            kind = "images" if backbone.images == "image" else backbone.images
            title = f"ResNet-{backbone.depth} ({kind}) + PointNet++ ({views} views)"
            ours: list[Cell] = []
            for chosen_on in ("test", "validation"):
                cell = found.best[backbone.name][chosen_on]
                ours += [100 * cell.accuracy, 100 * cell.class_accuracy, f"MV {cell.max_views}, CT {cell.threshold:g}"]
            rows.append(Row(title, ours, [*thesis[title], None, None, None, None]))
    return ThesisTable(
        8,
        "Best cell of every pipeline (%)",
        ["chosen on test", "by class", "cell", "chosen on validation", "by class", "cell"],
        rows,
        "The thesis reports the maximum of its grid on test objects, as do the first columns. The accuracy of the cell chosen on "
        "validation objects is the one to expect for new objects. By class: mean recall.",
    )


def memory_table(results: ThesisResults) -> ThesisTable:
    thesis, ours, ascent = thesis_numbers()["table_9"]["rows"], dict(results.memory), results.ascent
    for name, method in (("Neural Renderer", ascent.mesh), ("DiffDVR", ascent.volume)):
        if method is not None:
            ours[name] = method.memory
    rows = [
        Row(name, [*vars(ours[name]).values()] if name in ours else [None, None], [*values, None])
        for name, values in thesis.items()
    ]
    return ThesisTable(
        9,
        "Memory of one decision (MB)",
        ["planned by XLA", "peak of the device"],
        rows,
        "Weights, inputs and temporaries of one compiled decision, for the network sizes of this run. CPUs report no peak. The "
        "thesis reports PyTorch's peak on a GPU. Neural Renderer and DiffDVR: all start views of Table 2 on one object."
        f"{_missing(ascent)}",
        digits=2,
    )


def _pairs(
    number: int,
    title: str,
    results: ThesisResults,
    grids: dict[str, np.ndarray],
    max_views: Iterable[int],
    note: str,
) -> ThesisTable:
    """A table with alternating rows for random and PointNet++, as in the thesis."""
    thesis, rows = thesis_numbers()[f"table_{number}"], []
    for index, mv in enumerate(max_views):
        for short, grid in grids.items():
            rows.append(Row(f"MV {mv} ({short})", grid[index].tolist(), thesis.get(f"{mv} ({short})", ())))
    return ThesisTable(number, title, _ct(results), rows, note)


_POLICIES = {"random": "random", "pcd": "predicted_entropy"}
"""Policies by how the thesis's tables call them."""


def accuracy_table(number: int, views: int, results: ThesisResults) -> ThesisTable:
    found = results.pipeline[views]
    grids = {short: 100 * found.policies[name].accuracy.mean(axis=0) for short, name in _POLICIES.items()}
    note = (
        "Mean of the three backbones, over every start view of every test object; random selection in exact expectation. The "
        "thesis draws a random start view, and its random policy may repeat a view. 'pcd' is PointNet++."
    )
    return _pairs(
        number, f"Accuracy of all pipelines, {views} views (%)", results, grids, found.max_views.tolist(), note
    )


def _views_used(results: ThesisResults) -> dict[str, np.ndarray]:
    """Mean over backbones and both lattices, (MV, CT), of random and of PointNet++; the first row is for one view."""
    used = {}
    for short, name in _POLICIES.items():
        lattices = [found.policies[name].views_used.mean(axis=0) for found in results.pipeline.values()]
        rows = min(map(len, lattices))
        mean = np.mean([lattice[:rows] for lattice in lattices], axis=0)
        used[short] = np.concatenate([np.ones((1, mean.shape[1])), mean])
    return used


def views_table(results: ThesisResults) -> ThesisTable:
    grids = _views_used(results)
    max_views = range(1, len(grids["random"]) + 1)
    note = "Mean of the three backbones and both lattices."
    return _pairs(13, "Number of views used", results, grids, max_views, note)


def views_gain_table(results: ThesisResults) -> ThesisTable:
    thesis = thesis_numbers()["table_14"]
    used = _views_used(results)
    rows = [
        Row(f"MV {mv}", gains.tolist(), thesis.get(str(mv), ()))
        for mv, gains in enumerate(used["pcd"] - used["random"], start=1)
    ]
    return ThesisTable(
        14,
        "Number of views used, PointNet++ minus random",
        _ct(results),
        rows,
        "The thesis's caption calls this the decrease, but its numbers have this sign: below zero means fewer views.",
        digits=3,
        signed=True,
    )


def oracle_table(results: ThesisResults) -> ThesisTable:
    thesis, found, rows = thesis_numbers()["table_15"], results.pipeline[40], []
    for backbone, grid in zip(PIPELINE, found.policies["oracle_entropy"].accuracy, strict=True):
        for mv, values in zip(found.max_views, grid, strict=True):
            if mv <= ORACLE_MV:
                title = f"ResNet-{backbone.depth}, {backbone.images}"
                rows.append(Row(f"MV {mv} ({title})", _percent(values), thesis[f"{mv} ({title})"]))
    gain = found.gain["oracle"]
    return ThesisTable(
        15,
        "Accuracy of the oracle, 40 views (%)",
        _ct(results),
        rows,
        "The oracle is given the true entropies of all views. Its gain over random selection is "
        f"{_with_ends(gain.mean, gain.mean_interval)} points over all cells up to nine views; in the thesis's own Tables 15 and "
        "11 it is −0.72 points up to five views.",
    )


def all_tables(results: ThesisResults) -> list[ThesisTable]:
    """Tables 1–15, in order."""
    return [
        machine_table(results),
        rendering_times(results),
        predictor_times(results),
        entropy_table(results),
        losses_table(results),
        single_view_table(results),
        gain_table(7, 10, results),
        best_table(results),
        memory_table(results),
        accuracy_table(10, 10, results),
        accuracy_table(11, 40, results),
        gain_table(12, 40, results),
        views_table(results),
        views_gain_table(results),
        oracle_table(results),
    ]


# --------------------------------------------------------------------------------------------------------------- as text


def cell_text(value: Cell, table: ThesisTable) -> str:
    """A cell as formatted text."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    text = f"{value:+.{table.digits}f}" if table.signed else f"{value:.{table.digits}f}"
    return text.replace("-", "−")


def shown_cells(row: Row, table: ThesisTable) -> list[tuple[str, bool, str]]:
    """For each cell: our text, whether it is bold, and the text of the thesis (empty if missing)."""
    bold = [*row.bold, *[False] * (len(row.ours) - len(row.bold))]
    thesis = [*row.thesis, *[None] * (len(row.ours) - len(row.thesis))]
    return [
        (cell_text(ours, table), marked, "" if theirs is None else cell_text(theirs, table))
        for ours, marked, theirs in zip(row.ours, bold, thesis, strict=True)
    ]


def markdown(table: ThesisTable) -> str:
    """The table in Markdown; the numbers of the thesis follow ours in parentheses."""
    rows = []
    for row in table.rows:
        cells = [
            (f"**{ours}**" if bold else ours) + (f" ({theirs})" if theirs else "")
            for ours, bold, theirs in shown_cells(row, table)
        ]
        rows.append([row.name, *cells])
    shown = markdown_table(["", *table.columns], rows)
    return f"**{table.heading}**\n\n{shown}\n\n{table.remark}\n"
