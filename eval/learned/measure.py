"""Measurements of `mevs study learned`: each lattice, unknown poses, classes left out of policy training, and decision time.

Results are stored in the folder of the seed and reused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.inputs import depth_and_normals
from data_pipeline.dataset.statistics import DatasetStatistics, load_statistics
from data_pipeline.errors import DataError
from data_pipeline.files import read_json
from data_pipeline.progress import console
from eval.learned.comparison import ByObject, gains_of_seeds, seeds_together
from eval.learned.poses import UnknownPose, of_any_rotation, of_unknown_yaw
from eval.learned.stopping import MOVEMENT_COSTS, VIEW_COSTS
from eval.learned.study import novel_classes, novel_metrics, study
from eval.learned.walks import OnLattice, Walking, by_network
from eval.machine import machine, milliseconds
from eval.runs import stored_tables
from eval.tables import ViewTables
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.models.view_policy import expected_gain
from mevs_jax.policies.registry import PolicyRecord
from mevs_jax.trained.description import UNKNOWN_OBJECT
from train.choosing.expected import FITTED_AS
from train.choosing.features import Features
from train.choosing.looks import seen_alike
from train.choosing.stages import Aside, Stages, lattice_data
from train.choosing.variants import VARIANTS
from train.results.finite import check_results
from train.results.identity import VERSIONS, identity_of, made_by, stamp_of, why_other
from train.results.kept import arrays_beside, kept_json, kept_with_arrays
from train.results.records import as_json

SPLITS = "val", "test"
"""Whose objects are walked around."""
APART = 2
"""Parts of the validation objects; stopping rules are fitted on walks of policies that were trained without their objects."""

_ENOUGH = 100
"""Validation objects that it takes to say how often confident answers are wrong."""


def why_stale(metrics: dict[str, Any], seeds: Sequence[Stages]) -> str | None:
    """Why metrics of the study are not of these settings and of the networks that are there, in a few words; None if they are.

    Compared are the walks of every seed on the run's own lattice, which the run's report shows.
    """
    views = seeds[0].dataset.capture.views
    pairs = [({"settings": metrics["settings"]}, {"settings": as_json(seeds[0].config)})]
    for stages, found in zip(seeds, metrics["seeds"], strict=False):
        walks = _Walks(stages, f"lattice_{views}", stages.out / "data")
        pairs += [(policy, policy | {"version": VERSIONS["network"]}) for policy in walks.policies]
        pairs.append((found["lattices"][str(views)]["identity"], as_json(walks.identity())))
    return next(filter(None, map(why_other, *zip(*pairs, strict=True))), None)


def entropy_tables(out: Path, split: str) -> ViewTables | None:
    """The view tables of `mevs run`, None without them; raises `DataError` if they are of other networks than the run has now."""
    exists = (out / "tables" / f"{split}.npz").exists()
    return stored_tables(load_statistics(out / "data"), out, split) if exists else None


def check_parts(statistics: DatasetStatistics) -> None:
    """Raises `DataError` if there are too few validation objects to fit stopping rules on."""
    if (count := statistics.objects_of(("val",))) < APART:
        raise DataError(
            f"mevs study learned fits stopping rules on {APART} parts of the validation objects, and the data set has {count}; "
            f"raise --dataset.validation-share, or give more objects"
        )


def measure(stages: Stages) -> dict[str, Any]:
    """Returns the metrics of one seed, by number of candidate views.

    Classes left out of policy training are measured for every seed. The first seed also has unknown yaw, separate candidate
    directions for each object, ablations, and objects in any rotation.
    """
    own, config = stages.dataset.capture.views, stages.config

    def on_lattice(views: int, **given: Any) -> dict[str, Any]:
        return _Walks(stages, f"lattice_{views}", lattice_data(stages.dataset, stages.out, views), **given).metrics()

    found = {"lattices": {str(views): on_lattice(views) for views in (own, *config.lattices)}}
    if _pairs(stages):
        found["novel"] = _novel(stages)
    if stages.seed != config.seed:
        return found
    found["decision"] = _decision(stages)
    found["unposed"] = {str(own): on_lattice(own, posed=False)}
    found["scattered"] = {str(own): _Walks(stages, "turned", stages.turned).metrics()}
    if config.ablations:
        found["ablations"] = {str(own): on_lattice(own, ablations=config.ablations)}
    if config.rotation_epochs:
        found["rotated"] = {str(own): _rotated(stages)}
    return found


def together(seeds: Sequence[Stages], found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over all seeds, by number of candidate views; `found` holds the result of `measure` for each seed."""
    lattices = {}
    for views, first in found[0]["lattices"].items():
        each = []
        for stages in seeds:
            kept = _by_object(stages, f"walks_lattice_{views}")
            each.append(
                {
                    name: ByObject(**{field.name: kept[f"{name} {field.name}"] for field in fields(ByObject)})
                    for name in first["policies"]
                }
            )
        lattices[views] = seeds_together([one["lattices"][views] for one in found], each, "learned")
    return lattices


def novel_together(seeds: Sequence[Stages]) -> dict[str, Any] | None:
    """Gains over random selection on classes that policies were trained without, over all seeds; None if not measured."""
    if not _pairs(seeds[0]):
        return None
    return gains_of_seeds([_by_object(stages, "walks_novel") for stages in seeds])


def _by_object(stages: Stages, name: str) -> dict[str, np.ndarray]:
    """The results by object that are stored with metrics."""
    path = stages.folder / f"{name}.json"
    return arrays_beside(path, read_json(path))


@dataclass(frozen=True)
class _Walks:
    """Walks on one data set, of all policies or of the method and its ablations.

    Attributes:
        stages: of the seed.
        views: names the data set in the files of features and walks.
        data: its folder.
        ablations: variants of the method; if there are any, nothing else is compared with it.
        posed: whether the pose of objects is known.
    """

    stages: Stages
    views: str
    data: Path
    ablations: tuple[str, ...] = ()
    posed: bool = True

    @property
    def variants(self) -> list[str]:
        """The variants of the view policy, the method first."""
        method = "learned" if self.posed else "learned_unposed"
        further = ["learned_and_table"] * (self.posed and not self.ablations)
        return [method, *(name for name in self.ablations if name != "cloud" or self.stages.has_clouds), *further]

    @property
    def with_costs(self) -> bool:
        """Whether stopping rules and movement costs are measured, which need the objects of `turned` one by one."""
        return self.posed and not self.ablations and self.data == self.stages.out / "data"

    def metrics(self) -> dict[str, Any]:
        """The metrics, computed first if they are not stored."""
        for name in self.variants:
            self._policy(name)  # trained first, as the identity says with what
        if "cloud" in self.ablations and not self.stages.has_clouds:
            console.print(
                f"The ablation with PointNet++ embeddings is left out; train PointNet++ with: "
                f"mevs train --out {self.stages.out}"
            )
        kind = ("" if self.posed else "_unposed") + ("_ablations" if self.ablations else "")
        path = self.stages.folder / f"walks_{self.views}{kind}.json"
        return kept_with_arrays(path, self.identity(), self._walk)[0]

    def _policy(self, name: str, aside: Aside | None = None) -> PolicyRecord:
        """A variant of the view policy, trained first if it is not yet; `aside` is as for `Stages.policy`."""
        variant, called = VARIANTS[name], "learned" if name == self.variants[0] else name
        network = self.stages.policy(variant.network or name, aside=aside)
        fusion = self.stages.fusion(posed=self.posed, summed=variant.summed)
        return by_network(called, variant.title, network, fusion, variant.by)

    @property
    def policies(self) -> list[dict[str, Any]]:
        """The identities of the view policies, which have to be trained."""
        return [_identity_of_policy(self.stages, VARIANTS[name].network or name) for name in self.variants]

    def identity(self) -> dict[str, Any]:
        """What the walks depend on."""
        stages, config = self.stages, self.stages.config
        clouds = [stages.out / "entropy"] if "cloud" in self.variants else []
        networks = made_by(load_statistics(self.data), stages.recogniser_folder(), *clouds)
        return identity_of(
            "walks",
            made_by=stamp_of("features", networks),
            policies=self.policies,
            tables_made_by=[tables.made_by for split in SPLITS if (tables := self._tables(split)) is not None],
            walks=[
                self.variants,
                config.max_views,
                config.draws,
                config.fitting_starts,
                self.with_costs and [VIEW_COSTS, MOVEMENT_COSTS],
                FITTED_AS,
                *["promising"] * self.promising,
            ],
        )

    @property
    def promising(self) -> bool:
        """Whether temperatures keep what confidences promise, since there are objects of no class, and many for validation."""
        statistics = self.stages.statistics
        return UNKNOWN_OBJECT in statistics.classes and statistics.objects_of(("val",)) >= _ENOUGH

    def _walk(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        stages, config, (method, *_) = self.stages, self.stages.config, self.variants
        lattices = self._objects("val"), self._objects("test")
        if self.with_costs:  # their parts are identified by position
            learned_from = stages.features("turned_val", stages.turned, "val")
            assert np.array_equal(lattices[0].features.labels, learned_from.labels), "the objects have another order"
        console.print(self._title(lattices[1].features))
        found, each = study(
            stages.fusion(posed=self.posed),
            [self._policy(name) for name in self.variants],
            lattices,
            Walking(
                config.max_views,
                config.draws,
                fitting_starts=config.fitting_starts,
                seed=stages.seed,
                promising=self.promising,
            ),
            fusions={name: stages.fusion(summed=True) for name in self.variants if VARIANTS[name].summed},
            apart=[self._policy(method, (part, APART)) for part in range(APART)] if self.with_costs else (),
            others=not self.ablations,
            known=_known(stages, self.posed, lattices[1].features.directions[0]),
        )
        found = check_results(as_json(found), f"walks by the recogniser in {stages.recogniser_folder()}")
        return found, {f"{name} {key}": value for name, one in each.items() for key, value in vars(one).items()}

    def _objects(self, split: str) -> OnLattice:
        features = self.stages.features(f"{self.views}_{split}", self.data, split)
        if "cloud" in self.variants:
            features = replace(features, clouds=self.stages.clouds(self.data, split))
        neighbours, tables = load_statistics(self.data).neighbours, self._tables(split)
        if tables is None:
            return OnLattice(features, neighbours=neighbours)
        return OnLattice(features, tables.predicted_entropy, tables.entropy, neighbours)

    def _tables(self, split: str) -> ViewTables | None:
        """The view tables of `mevs run`; None for another data set, or where there are none."""
        return entropy_tables(self.stages.out, split) if self.data == self.stages.out / "data" else None

    def _title(self, test: Features) -> str:
        objects, count, _ = test.logits.shape
        around = ", separate for each object" if self.data == self.stages.turned else ""
        around = ", objects in any rotation" if self.stages.upright is not None else around
        pose = "" if self.posed else ", unknown yaw"
        ablations = ", ablations" * bool(self.ablations)
        return f"Walking {objects} test objects, {count} candidate views{around}{pose}{ablations}"


def _identity_of_policy(stages: Stages, name: str) -> dict[str, Any]:
    """What a trained view policy was stored under."""
    return read_json(stages.policy_folder(name) / "summary.json")["identity"]


def _known(stages: Stages, posed: bool, directions: Float[Array, "views 3"]) -> ExpectedViews | UnknownPose | None:
    """What is known about views for objects of known pose, of unknown yaw, or in any rotation."""
    if posed:
        return stages.expected_views()
    if (head := stages.pose_head()) is None:
        return None
    of_poses = of_unknown_yaw if stages.upright is None else of_any_rotation
    return of_poses(head, stages.expected_views(), directions)


def _rotated(stages: Stages) -> dict[str, Any]:
    """Metrics for objects in any rotation, after further training of the recogniser on such objects."""
    rotated = stages.rotated()
    rotated.train_recogniser()
    return _Walks(rotated, "turned", stages.turned, posed=False).metrics()


def _pairs(stages: Stages) -> list[tuple[int, int]]:
    """The pairs of classes that policies are trained without; of each there are test objects."""
    classes, counts = stages.statistics.classes, stages.statistics.counts["test"]
    half = len(classes) // 2
    pairs = [(first, first + half) for first in range(min(stages.config.novel, half))]
    return [pair for pair in pairs if any(counts[classes[label]] for label in pair)]


def _novel(stages: Stages) -> dict[str, Any]:
    """Metrics of policies on classes that they were trained without; encoder and fusion were trained on all classes."""
    views, config, pairs = stages.dataset.capture.views, stages.config, _pairs(stages)
    data, fusion = lattice_data(stages.dataset, stages.out, views), stages.fusion()
    policies = [by_network("trained_without", "", stages.policy(without=pair), fusion) for pair in pairs]
    identity = identity_of(
        "walks",
        made_by=stamp_of("features", made_by(load_statistics(data), stages.recogniser_folder())),
        policy=_identity_of_policy(stages, "learned"),
        walks=[pairs, config.max_views, config.draws, FITTED_AS],
    )

    def walk() -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        features = stages.features(f"lattice_{views}_test", data, "test")
        console.print(f"Walking test objects of {2 * len(pairs)} classes that a policy was trained without")
        each = novel_classes(
            fusion,
            list(zip(pairs, policies, strict=True)),
            by_network("trained_with", "", stages.policy(), fusion),
            OnLattice(features, neighbours=load_statistics(data).neighbours),
            Walking(min(config.max_views, views), config.draws, seed=stages.seed),
            stages.expected_views(),
        )
        return novel_metrics(each, pairs, features.labels), each

    return kept_with_arrays(stages.folder / "walks_novel.json", identity, walk)[0]


def _decision(stages: Stages) -> dict[str, Any]:
    policy = _identity_of_policy(stages, "learned")
    identity = identity_of("decision", policy=policy, machine=machine(), candidates=stages.dataset.capture.views)
    return kept_json(stages.folder / "decision.json", identity, partial(_decision_times, stages))


def _decision_times(stages: Stages, calls: int = 200) -> dict[str, Any]:
    """Time of one decision among all candidate views (ms), from stored features and from the latest depth image."""
    camera, most, recogniser = stages.dataset.capture, stages.config.max_views, stages.recogniser()
    structure, weights = nnx.split((recogniser, stages.policy()))
    fusion, classes = stages.fusion(), len(stages.statistics.classes)
    channels, task, width = (
        stages.config.recogniser.network.channels,
        stages.task(),
        recogniser.encoder.head.in_features,
    )
    candidates = jnp.asarray(stages.statistics.viewpoints, jnp.float32)
    seen, present = candidates[:most], jnp.arange(most) < most - 1

    @jax.jit
    def from_features(weights: nnx.State, given: tuple[Array, Array]) -> Array:
        features, logits = given
        belief = fusion(features, seen, present)
        views = jax.nn.log_softmax(logits / fusion.single, axis=-1)
        gain_if = nnx.merge(structure, weights)[1](belief, views, seen, present, candidates)[1]
        return jnp.argmax(expected_gain(belief, gain_if).at[:most].set(-jnp.inf))

    @jax.jit
    def from_image(weights: nnx.State, given: tuple[Array, Array, Array]) -> Array:
        image, features, logits = given
        newest = seen_alike(nnx.merge(structure, weights)[0], task, depth_and_normals(image, camera, channels))
        features, logits = features.at[most - 2].set(newest[:width]), logits.at[most - 2].set(newest[-classes:])
        return from_features(weights, (features, logits))

    depth = open_split(stages.turned, "test")[0]["depth"]
    random = np.random.default_rng(0)
    inputs = [
        (depth[i % len(depth)], *(random.normal(size=(most, n)).astype(np.float32) for n in (width, classes)))
        for i in range(calls)
    ]
    times = {
        "from_features": milliseconds(partial(from_features, weights), [given[1:] for given in inputs]),
        "from_image": milliseconds(partial(from_image, weights), inputs),
    }
    return {
        name: {f"p{share}": float(np.percentile(taken, share)) for share in (50, 99)} for name, taken in times.items()
    }
