"""The thesis beside our run: its printed numbers, every table and figure from made-up networks, and the whole command."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from flax import nnx
from matplotlib.figure import Figure

import eval.thesis.run as thesis_run
import train.many.thesis as thesis_networks
from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.files import write_json
from data_pipeline.objects.furniture import CLASSES, furniture
from eval.machine import milliseconds
from eval.settings import PRESETS
from eval.thesis.figures import FIGURES
from eval.thesis.layout import thesis_numbers
from eval.thesis.page import CHAPTERS, _table_html
from eval.thesis.results import LatticeTables, best_cells
from eval.thesis.tables import all_tables, markdown
from eval.thesis.timing import decision_memory, time_local_maxima
from eval.walks.grid import THRESHOLDS, Results
from mevs_jax.geometry.viewpoints import ViewGraph, fibonacci_sphere
from tests.reference.made_up_thesis import OBJECTS
from tests.reference.policies import maxima_first
from tests.reference.weights import untrained
from train.many.thesis import BACKBONES, FRAMES, PIPELINE, backbone_task, entropy_task
from train.tasks.entropy import EntropyTask

# ------------------------------------------------------------------------------------------------------ the printed numbers


def test_the_numbers_are_the_ones_that_the_thesis_prints(thesis_files):
    printed = json.loads((thesis_files / "thesis_tables.json").read_text())
    carried = thesis_numbers()
    assert carried["thresholds"] == printed["confidence_thresholds"] == list(THRESHOLDS)
    for number in (7, 10, 11, 12, 13, 14, 15):
        assert carried[f"table_{number}"] == printed[f"table_{number}"]
    for number in (2, 3, 4, 5, 6, 8, 9):
        ours, theirs = carried[f"table_{number}"]["rows"], printed[f"table_{number}"]["rows"]
        assert len(ours) == len(theirs)
        for mine, cells in zip(ours.values(), theirs.values(), strict=True):
            assert mine == [float(re.sub(r"[^\d.]", "", str(cell))) for cell in cells]


def test_the_thesiss_own_tables_agree_with_each_other():
    """Tables 7 and 12 are the differences of 10 and 11, to rounding."""
    numbers = thesis_numbers()
    for gain, accuracy in ((7, 10), (12, 11)):
        for mv, values in numbers[f"table_{gain}"].items():
            random, predicted = (np.array(numbers[f"table_{accuracy}"][f"{mv} ({who})"]) for who in ("random", "pcd"))
            np.testing.assert_allclose(predicted - random, values, atol=0.0151)


# ----------------------------------------------------------------------------------------------------- from made-up networks


def cell_by_hand(lattice: LatticeTables, views: int, policy: str, row: int, column: int) -> float:
    """Accuracy of a (MV, CT) cell by walking every object from every start with every classifier, one at a time."""
    neighbours = np.asarray(ViewGraph.from_points(fibonacci_sphere(views)).neighbours)
    right = []
    for backbone in PIPELINE:
        logits = lattice.logits[backbone.name].astype(np.float64)
        for thing in range(OBJECTS):
            for start in range(views):
                predicted_entropy = lattice.predicted_entropy["world"][thing]
                if policy == "oracle_entropy":
                    predicted_entropy = np.repeat(lattice.entropy[thing][None], views, axis=0)
                seen, belief = [start], logits[thing, start].copy()
                while len(seen) < row + 2 and 1 / np.exp(belief - belief.max()).sum() < THRESHOLDS[column]:
                    scores = maxima_first(predicted_entropy[seen[-1]], seen, neighbours)
                    scores[seen] = -np.inf
                    seen.append(int(scores.argmax()))
                    belief += logits[thing, seen[-1]]
                right.append(belief.argmax() == lattice.labels[thing])
    return float(np.mean(right))


@pytest.mark.parametrize(("views", "number", "policy"), [(10, 10, "predicted_entropy"), (40, 11, "predicted_entropy")])
def test_a_cell_of_the_accuracy_tables_is_what_walking_by_hand_gives(lattices, results, views, number, policy):
    tables = {shown.number: shown for shown in all_tables(results)}
    row = next(row for row in tables[number].rows if row.name == "MV 4 (pcd)")
    assert row.ours[5] == pytest.approx(100 * cell_by_hand(lattices[views], views, policy, 2, 5), abs=0.15)


def test_the_oracle_table_is_what_walking_by_hand_gives(lattices, results):
    table = all_tables(results)[-1]
    shown = np.mean([row.ours[4] for row in table.rows if row.name.startswith("MV 3")])
    assert shown == pytest.approx(100 * cell_by_hand(lattices[40], 40, "oracle_entropy", 1, 4), abs=0.15)


def test_all_fifteen_tables_are_there_and_consistent(results):
    tables = {shown.number: shown for shown in all_tables(results)}
    assert list(tables) == list(range(1, 16))
    for gain, accuracy in ((7, 10), (12, 11)):
        rows = {row.name: np.array(row.ours) for row in tables[accuracy].rows}
        for row in tables[gain].rows:
            np.testing.assert_allclose(row.ours, rows[f"{row.name} (pcd)"] - rows[f"{row.name} (random)"], atol=1e-3)
    used = {row.name: np.array(row.ours) for row in tables[13].rows}
    for row in tables[14].rows:
        np.testing.assert_allclose(row.ours, used[f"{row.name} (pcd)"] - used[f"{row.name} (random)"], atol=1e-6)
    assert (used["MV 1 (pcd)"] == 1).all()
    assert (np.diff(used["MV 9 (random)"]) >= 0).all()
    for shown in tables.values():
        for row in shown.rows:
            assert len(row.ours) == len(shown.columns), (shown.number, row.name)
            assert len(row.thesis) in (0, len(shown.columns)), (shown.number, row.name)
        text = markdown(shown)
        assert f"**Table {shown.number}. " in text
        assert "nan" not in text
    assert "the mean map" not in markdown(tables[7])
    assert "(1.248)" not in markdown(tables[7])
    assert "(+1.25)" in markdown(tables[7])


def test_the_best_cell_is_chosen_where_it_says(lattices):
    def grid(right):
        steps = jnp.zeros((*right.shape[:2], 1))
        return Results(jnp.asarray(right), jnp.zeros(right.shape), steps, steps, jnp.zeros((1, 1), jnp.int32))

    random = np.random.default_rng(0)
    test, validation = (random.uniform(size=(3, OBJECTS, 8, 7)) for _ in range(2))
    validation[:, :, 5, 2] = 2.0
    found = best_cells(grid(test), grid(validation), lattices[10].labels)
    for backbone, best in enumerate(found):
        assert (best["validation"].max_views, best["validation"].threshold) == (7, 0.7)
        assert best["validation"].accuracy == pytest.approx(test[backbone, :, 5, 2].mean())
        assert best["test"].accuracy == pytest.approx(test[backbone].mean(axis=0).max())


def test_entropy_errors_are_by_class_and_beside_what_looks_at_nothing(lattices, statistics, results):
    found = results.entropy[40]
    world, lattice = found.frames["world"], lattices[40]
    assert world.mse == pytest.approx(0.05**2, rel=0.1)
    assert found.frames["camera"].mse == pytest.approx(0.2**2, rel=0.1)
    assert found.camera_minus_world.interval[0] > 0
    assert world.explained_variance == pytest.approx(1 - world.mse / lattice.entropy.var(), rel=1e-5)
    sofa = lattice.labels == CLASSES.index("sofa")
    by_hand = np.square(np.array(statistics[40].mean_map) - lattice.entropy[sofa]).mean()
    assert found.mean_map["sofa"][0] == pytest.approx(by_hand, rel=1e-5)


def test_every_figure_but_the_captures_is_drawn_and_told_in_words(inputs):
    said = {}
    for shown in FIGURES:
        if shown.number == 22:  # of stored captures; drawn by the whole command below
            continue
        figure, said[shown.number] = shown.draw(inputs)
        assert isinstance(figure, Figure)
        figure.canvas.draw()
        plt.close(figure)
    wanted = {f"F{n}" for n in (*range(5, 12), *range(17, 26))} | {f"T{n}" for n in range(1, 16)}
    assert {name for _, names in CHAPTERS for name in names} == wanted
    assert {f"F{shown.number}" for shown in FIGURES} == {name for name in wanted if name.startswith("F")}
    assert all(text.endswith(".") and len(text) > 50 for text in said.values())
    assert len(set(said.values())) == len(said)
    accuracies = 100 * inputs.results.pipeline[10].policies["random"].accuracy.mean(axis=0)
    assert f"Random: {accuracies.min():.1f} to {accuracies.max():.1f} %" in said[20]
    entropies = inputs.tables[40].entropy[0]
    assert f"to {entropies.max():.2f} (view {entropies.argmax()})" in said[7]
    assert "training loss from 1.0000 to 0.3333" in said[17]


def test_gains_are_marked_without_bold_print_or_colour(results):
    """Where the interval excludes zero, and nowhere else."""
    table = next(shown for shown in all_tables(results) if shown.number == 7)
    page = _table_html(table)
    gain = results.pipeline[10].gain["text"]
    for mark, ends in (("▲", [low > 0 for row in gain.interval for low, _ in row]),
                       ("▼", [high < 0 for row in gain.interval for _, high in row])):  # fmt: skip
        assert page.count(f"<b class='up'>{mark} ") == sum(ends)
    for mark, text in re.findall(r"<b class='up'>(.) (.)", page):
        assert (mark, text) in {("▲", "+"), ("▼", "−")}


def test_networks_are_trained_as_the_thesis_says(statistics):
    settings = PRESETS["thesis"]
    tasks = {b.name: backbone_task(b, settings.classifier, settings.thesis, statistics[b.views]) for b in BACKBONES}
    assert [(t.network_config.depth, t.images) for t in tasks.values()] == [
        (18, "image"), (18, "image"), (18, "depth"), (34, "depth"),
    ]  # fmt: skip
    for task in tasks.values():
        assert (task.optimiser.batch_size, task.optimiser.epochs, task.optimiser.patience) == (16, 50, 5)
        assert (task.optimiser.learning_rate, task.optimiser.weight_decay) == (1e-3, 1e-4)
        assert task.network_config.standardise
        assert task.network_config.width == 64
    assert [b.start for b in BACKBONES] == [None, "resnet18_image_10", "resnet18_image_40", None]
    for frame in FRAMES:
        task = entropy_task(frame, settings.entropy, statistics[10])
        assert task.network_config.frame == frame
        assert task.network_config.points == 4096
        assert (task.optimiser.batch_size, task.optimiser.epochs, task.optimiser.schedule) == (32, 200, "steps")
    world, camera = (asdict(entropy_task(frame, settings.entropy, statistics[10])) for frame in FRAMES)
    assert [key for key in world if world[key] != camera[key]] == ["network_config", "name"]


# -------------------------------------------------------------------------------------------------------------- measurements


def test_times_are_taken_after_warming_up():
    calls = []
    times = milliseconds(lambda _: calls.append(None) or np.zeros(1), [0] * 5)
    assert times.shape == (5,)
    assert (times > 0).all()
    assert len(calls) == 8
    found = time_local_maxima(10, runs=3, objects=50)
    assert min(found.batched, found.alone) > 0


def test_memory_grows_with_the_networks(statistics):
    settings = PRESETS["tiny"]
    classify = backbone_task(BACKBONES[2], settings.classifier, settings.thesis, statistics[40])
    predict = entropy_task("world", settings.entropy, statistics[40])
    alone, both = decision_memory(classify, None), decision_memory(classify, predict)
    assert 0.5 < alone.planned < both.planned  # 180,000 weights, and more
    assert alone.device_peak is None or alone.device_peak > 0


# --------------------------------------------------------------------------------------------------------- the whole command


def has_all_tables_and_figures(report: Path) -> None:
    page, text = (report / "index.html").read_text(), (report / "thesis.md").read_text()
    for number in range(1, 16):
        assert f'id="table-{number}"' in page
        assert f"**Table {number}. " in text
    for number in (*range(5, 12), *range(17, 26)):
        assert f'id="figure-{number}"' in page
        for kind in ("png", "svg"):
            assert (report / "figures" / f"figure_{number:02d}.{kind}").stat().st_size > 1000


@pytest.mark.slow
def test_the_stages_make_everything_and_go_on(results, tmp_path, monkeypatch, capfd):
    """With data sets as the command makes them, but networks that are not trained, and outputs that are made up."""
    settings = PRESETS["tiny"]
    begun, rates, asked, trained = {}, {}, [], []

    def fit(task, data, statistics, folder, start=None, rate_option=""):
        rates[folder.name] = rate_option
        trained.append(task)
        assert data == tmp_path / f"views{statistics.views}" / "data"
        begun[folder.name] = start.name if start else "random weights"
        summary = {
            "best_epoch": 2,
            "epoch": 3,
            "best": {"accuracy": 0.9},
            "best_loss": 0.5,
            "start": begun[folder.name],
            "seconds": 1.0,
        }
        write_json(folder / "config.json", {"task": task.name})
        write_json(folder / "summary.json", summary)
        lines = [
            json.dumps({"step": epoch, "epoch": epoch, "train/loss": 1 / epoch, "val/loss": 1.2 / epoch})
            for epoch in (1, 2, 3)
        ]
        (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")
        return summary

    def outputs(data, split, task, network):
        asked.append((data, split, task.name))
        last = task.views if isinstance(task, EntropyTask) else len(CLASSES)
        random = np.random.default_rng(len(asked))
        return random.normal(size=(len(open_split(data, split)), load_statistics(data).views, last)).astype(np.float32)

    def train_seeds(tasks, data, statistics, folders, work, starts=(), rate_option=""):
        starts = starts or [None] * len(tasks)
        return [
            fit(task, data, statistics, folder, start, rate_option=rate_option)
            for task, folder, start in zip(tasks, folders, starts, strict=True)
        ]

    monkeypatch.setattr(thesis_networks, "train_seeds", train_seeds)
    for module in (thesis_networks, thesis_run):
        monkeypatch.setattr(module, "load_best", lambda task, _: untrained(lambda: task.network(nnx.Rngs(0))))
    monkeypatch.setattr(thesis_run, "network_outputs", outputs)
    monkeypatch.setattr(thesis_run, "_memory", lambda *_: results.memory)
    monkeypatch.setattr(thesis_run, "_ascents", lambda *_: results.ascent)
    shown = []

    def write(inputs, lead, folder, over=None):
        shown.append((folder.relative_to(tmp_path), over))
        return folder / "index.html"

    monkeypatch.setattr(thesis_run, "write_thesis_report", write)  # the whole command, below, draws the figures
    page = thesis_run.reproduce(settings, "tiny", tmp_path)
    assert "Walking 10 test objects with 3 classifiers" in " ".join(capfd.readouterr().err.split())
    assert begun["resnet18_image_10"] == begun["resnet34_depth_40"] == "random weights"
    for name, before in (("image_40", "10 views/object, image"), ("depth_40", "40 views/object, image")):
        assert begun[f"resnet18_{name}"].startswith(f"ResNet-18 ({before}), validation loss 0.5")
    assert len(begun) == 8
    assert rates["resnet18_image_10"] == "--thesis.resnet18.learning-rate"
    assert rates["resnet34_depth_40"] == "--thesis.resnet34.learning-rate"
    assert rates["resnet18_depth_40"] == "--thesis.fine-tuning.learning-rate"
    assert rates["40_world"] == "--entropy.optimiser.learning-rate"
    assert (
        len(set(asked)) == len(asked) == 2 * 6 + 2 * 4
    )  # every network on both test splits, those walked with on both others
    assert thesis_run.reproduce(settings, "tiny", tmp_path) == page
    assert "Walking" not in capfd.readouterr().err
    assert len(asked) == 20
    # A second training of all networks: the first stays as it is, and numbers are of both.
    assert thesis_run.reproduce(replace(settings, seeds=2), "tiny", tmp_path) == page
    assert len(asked) == 40
    assert {task.optimiser.seed for task in trained} == {0, 1}
    (second, nothing), (first, over) = shown[2:]
    assert (str(second), str(first)) == ("seeds/1/report", "report")
    assert nothing is None
    markdown(over)
    rows = json.loads((tmp_path / "seeds.json").read_text())["rows"]
    assert len(rows) == len(over.rows) == 4 + 8 + 10
    by_seed = [json.loads((tmp_path / out / "thesis.json").read_text()) for out in (".", "seeds/1")]
    for row in rows:
        assert row["over_both"][0] <= row["mean"] <= row["over_both"][1]
        assert row["mean"] == pytest.approx(np.mean(row["each"]))
    accuracy = [one["single_views"]["resnet18_depth_40"]["40"]["accuracy"] for one in by_seed]
    (row,) = (
        row for row in rows if row["name"] == "ResNet-18 (40 views/object, depth): accuracy of single views, 40 views"
    )
    assert row["each"] == pytest.approx(accuracy)
    gain = [one["pipeline"]["40"]["gain"]["oracle"]["mean"] for one in by_seed]
    assert gain[0] != gain[1]
    assert [row["each"] for row in rows if row["table"] == "12"][-1] == pytest.approx(gain)


def meshes_of(folder: Path, classes: tuple[str, ...]) -> Path:
    """Five pieces of furniture of each class to train on and one to test on."""
    for name in classes:
        for split, seeds in (("train", range(5)), ("test", (5,))):
            (folder / name / split).mkdir(parents=True)
            for seed in seeds:
                furniture(name, seed).export(folder / name / split / f"{seed}.off")
    return folder


@pytest.mark.slow
def test_the_whole_command_makes_everything(tmp_path, tmp_path_factory):
    meshes = meshes_of(tmp_path_factory.mktemp("meshes"), ("bathtub", "chair"))
    command = [sys.executable, "-m", "mevs_jax", "thesis", "--preset", "tiny", "--out", str(tmp_path)]
    command += ["--data", str(meshes)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert result.returncode == 0, result.stderr[-2000:]
    has_all_tables_and_figures(tmp_path / "report")
    results = json.loads((tmp_path / "thesis.json").read_text())
    assert results["backbones"]["resnet18_image_40"]["start"].startswith("ResNet-18 (10 views/object, image), ")
    assert results["backbones"]["resnet34_depth_40"]["start"] == "random weights"
