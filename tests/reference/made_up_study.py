"""The stages of the learned study without training: networks of random weights, whose outputs are made up."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from zlib import crc32

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy.spatial.transform import Rotation

import eval.learned.measure as measuring
import eval.learned.system as exporting
import eval.runs as of_run
import train.choosing.stages as choosing
from eval.settings import TINY
from mevs_jax import fibonacci_sphere
from mevs_jax.models import Recogniser, ViewPolicy
from mevs_jax.models.set_fusion import SetFusion
from tests.reference.evaluation import CLASSES, some_statistics, some_tables
from tests.reference.leaks import filled, other_labels, other_statistics, seed_of
from tests.reference.weights import untrained
from train.choosing.config import LearnedConfig
from train.choosing.policy import PolicyConfig, new_policy
from train.choosing.stages import Stages
from train.tasks.entropy import EntropyTask
from train.tasks.recogniser import RecogniserTask

VIEWS = 6
STUDIED = replace(
    some_statistics(some_tables()),
    viewpoints=fibonacci_sphere(VIEWS).tolist(),
    capture={"resolution": 32, "views": VIEWS},
)
"""Statistics of every data set of the study."""
OBJECTS_OF = {"train": 12, "val": 14, "test": 13}


class Adding(SetFusion):
    """A fusion that adds what the first features say, half of it where the pose is unknown."""

    def __init__(self, classes: int):
        self.classes = classes

    def __call__(self, features, directions, present, *, posed=True):
        del directions
        said = jnp.where(present[..., None], features[..., : self.classes], 0.0)
        return jnp.sum(said, axis=-2) * (1.0 if posed else 0.5)


@cache
def recogniser_of(task: RecogniserTask) -> Recogniser:
    """A recogniser whose first features are the logits."""
    network = filled(untrained(lambda: task.network(nnx.Rngs(0))), crc32(task.name.encode()))
    network.fusion = Adding(task.classes)
    head = network.encoder.head
    head.kernel.set_value(jnp.eye(*head.kernel.shape))
    return network


@cache
def untrained_policy(config: PolicyConfig, classes: int, posed: bool, cloud: int) -> ViewPolicy:
    return untrained(lambda: new_policy(config, classes, posed, cloud))


class Study:
    """The stages of the learned study, whose networks are not trained and whose outputs are made up.

    Networks that would be trained on outputs of others have weights that follow from everything that they would be trained on.

    Attributes:
        asked: data set, split and network of all outputs that were asked for.
        fitted_on: name of each view policy that was trained, and what it was trained on.
        stages: of the first seed.
    """

    def __init__(self, change: str | None, out: Path, patch: pytest.MonkeyPatch, config: LearnedConfig):
        self.asked: list[tuple[str, str, str]] = []
        self.fitted_on: list[tuple[str, Any]] = []
        self._change, self._policies = change, dict[Path, nnx.Module]()
        statistics = other_statistics(STUDIED) if change else STUDIED
        dataset = replace(TINY.dataset, capture=replace(TINY.dataset.capture, views=VIEWS))
        for module in (choosing, measuring, exporting, of_run):
            for name, replacement in {
                "load_statistics": lambda folder: statistics,
                "made_by": lambda statistics, *networks: " ".join(str(folder.relative_to(out)) for folder in networks),
                "load_best": lambda task, folder: recogniser_of(task) if isinstance(task, RecogniserTask) else None,
                "open_split": lambda folder, split: range(OBJECTS_OF[split]),
                "prepare": lambda dataset, folder: None,
                "fit": lambda *given, **named: {},
                "warn_of_chance": lambda *given: None,
                "network_outputs": self._outputs,
                "train_policies": self._trained,
                "train_by_q_learning": self._trained,
                "is_stored": lambda folder, identity: False,
                "trained_once": self._trained_once,
            }.items():
                if hasattr(module, name):
                    patch.setattr(module, name, replacement)
        self.stages = Stages(config, dataset, out, entropy=TINY.entropy)
        (out / "entropy").mkdir(parents=True)
        (out / "entropy" / "summary.json").touch()

    def _trained(self, config: Any, lessons: Any, folder: Path) -> list[tuple[nnx.Module, list]]:
        (lesson,) = lessons
        given = lesson.parts, lesson.validation
        self.fitted_on.append((lesson.name, given))
        fusion, data = lesson.parts[0]
        cloud = 0 if data.clouds is None else data.clouds.shape[-1]
        policy = untrained_policy(config, data.logits.shape[-1], fusion.posed, cloud)
        return [(filled(policy, seed_of(given)), [])]

    def _trained_once(self, folder: Path, identity: Any, like: Any, train: Any) -> nnx.Module:
        if folder not in self._policies:
            self._policies[folder] = train()[0]
        return self._policies[folder]

    def _outputs(
        self, data: Path, split: str, task: Any, network: Any, ask: Any = None, chosen: np.ndarray | None = None
    ) -> np.ndarray:
        self.asked.append((data.name, split, task.name))
        other, classes = self._change if split == "test" else None, CLASSES
        objects = np.arange(OBJECTS_OF[split])
        labels = np.random.default_rng(crc32(split.encode())).integers(0, classes, len(objects))
        which = f"{data.name} {split} {task.name} {getattr(ask, '__qualname__', '')} {'others' * (other == 'outputs')}"
        random = np.random.default_rng(crc32(which.encode()))
        if isinstance(task, EntropyTask):
            found = random.normal(size=(len(objects), VIEWS, task.network_config.global_layers[-1]))
            return (found if chosen is None else found[chosen]).astype(np.float32)
        width = 8 * task.network_config.width
        logits = random.normal(0, 1.2, (len(objects), VIEWS, classes))
        logits[objects, :, labels] += 1
        features = np.concatenate([logits, random.normal(size=(len(objects), VIEWS, width - classes))], axis=-1)
        directions = np.stack([fibonacci_sphere(VIEWS)] * len(objects))
        if data.name == "turned":
            directions = np.einsum(
                "oij,ovj->ovi", Rotation.random(len(objects), random_state=1).as_matrix(), directions
            )
        shown = other_labels(labels, classes) if other == "labels" else labels
        shown = np.broadcast_to(shown[:, None, None], (len(objects), VIEWS, 1))
        found = np.concatenate([features, logits, directions, shown], axis=-1)
        return (found if chosen is None else found[chosen]).astype(np.float32)
