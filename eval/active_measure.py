"""What the networks of `mevs active` reach: on each lattice, without a pose, on classes never chosen for, and how fast.

What is found is kept in files of the seed's folder; what is there is not measured again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from data_pipeline.builder import load_statistics
from data_pipeline.files import as_read, read_json, write_json
from data_pipeline.progress import console
from eval.active import ABLATIONS, Stages, lattice_data
from eval.active_study import OnLattice, novel_classes, study
from eval.view_tables import load_view_tables, made_by


def train_all(stages: Stages) -> None:
    """Every network of one seed, but those of ablations."""
    stages.prepare()
    for fold in (None, *range(stages.config.folds)):
        stages.train_recogniser(fold)
    for name in ("learnt", "learnt_unposed"):
        stages.policy(name)


def measure(stages: Stages) -> dict[str, Any]:
    """What one seed's networks reach: by number of candidate views, and where nobody knows which way the objects face."""
    own, first = stages.dataset.capture.views, stages.seed == 0
    found = {
        "lattices": {
            str(views): _on_lattice(stages, views, ABLATIONS if first and views == own else ())
            for views in (own, *stages.config.lattices)
        },
        "unposed": {str(own): _on_lattice(stages, own, posed=False)},
    }
    if first and stages.config.novel:
        found["novel"] = _novel(stages)
    return found


def _kept(path: Path, identity: dict[str, Any], find: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What the file holds under this identity, else what is found now."""
    identity = as_read(identity)
    if not path.exists() or read_json(path)["identity"] != identity:
        write_json(path, find() | {"identity": identity})
    return read_json(path)


def _on_lattice(stages: Stages, views: int, ablations: tuple[str, ...] = (), posed: bool = True) -> dict[str, Any]:
    config, method = stages.config, "learnt" if posed else "learnt_unposed"
    data = lattice_data(stages.dataset, stages.out, views)
    on = {
        split: OnLattice(stages.features(f"lattice_{views}_{split}", data, split), *_entropies(stages.out, data, split))
        for split in ("val", "test")
    }
    names = (method, *(name for name in ablations if name in config.ablations))
    learners = [stages.learner(name) for name in names]
    learners[0] = replace(learners[0], name="learnt")

    def walk() -> dict[str, Any]:
        known = "" if posed else ", which way they face unknown"
        console.print(f"Walking {len(on['test'].features.labels)} test objects, {views} candidate views{known}")
        return study(
            stages.fusion(posed=posed),
            learners,
            on["val"],
            on["test"],
            max_views=config.max_views,
            draws=config.draws,
            seed=stages.seed,
        )

    identity = {
        "made_by": made_by(load_statistics(data), stages.recogniser_folder()),
        "policies": [
            read_json(stages.policy_folder(learner.made_as) / "summary.json")["identity"] for learner in learners
        ],
        "walks": [names, config.max_views, config.draws, on["test"].entropy is not None],
    }
    return _kept(stages.folder / f"metrics_{views}{'' if posed else '_unposed'}.json", identity, walk)


def _novel(stages: Stages) -> dict[str, Any]:
    """How policies do on the classes that they were trained without; encoder and fusion know all."""
    views, classes = stages.dataset.capture.views, len(stages.statistics.classes)
    data = lattice_data(stages.dataset, stages.out, views)
    test = stages.features(f"lattice_{views}_test", data, "test")
    half = classes // 2
    pairs = [(first, first + half) for first in range(min(stages.config.novel, half))]
    policies = [(pair, stages.policy(without=pair)) for pair in pairs]
    identity = {
        "made_by": made_by(load_statistics(data), stages.recogniser_folder()),
        "policy": read_json(stages.policy_folder() / "summary.json")["identity"],
        "walks": [pairs, stages.config.max_views, stages.config.draws],
    }

    def walk() -> dict[str, Any]:
        console.print(f"Walking test objects of {2 * len(pairs)} classes that a policy was trained without")
        return novel_classes(
            stages.fusion(), policies, stages.policy(), test, stages.config.max_views, stages.config.draws, stages.seed
        )

    return _kept(stages.folder / "metrics_novel.json", identity, walk)


def _entropies(out: Path, data: Path, split: str) -> tuple[np.ndarray | None, np.ndarray | None]:
    """What the entropy predictor of the run says of every view, and the true entropies, where `mevs run` has made them."""
    path = out / "tables" / f"{split}.npz"
    if data != out / "data" or not path.exists():
        return None, None
    tables = load_view_tables(path)
    return tables.utility, tables.entropy
