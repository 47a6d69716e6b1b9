"""How well enrolled objects are recognised, from meshes and from a few depth images: `mevs study instances`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from data_pipeline.capture.casting import capture
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.dataset.light import LightConfig
from data_pipeline.dataset.reality import RealityAugmentation, realistic_views
from data_pipeline.errors import DataError, EmptyMesh, reason_of
from data_pipeline.files import short_hash
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.recipes import MeshFile
from data_pipeline.objects.sources import load_object, objects_to_test
from data_pipeline.progress import progress_bar
from eval.checks.agent import STOPS
from eval.checks.promise import PromiseRow, Strangers, promises, strangers
from eval.checks.walks import BASELINE, AccuracyRow, Observer, Walker, Walks, rows_of
from mevs_jax.enrolment import alike, enrol, remove
from mevs_jax.gallery.grid import YAWS
from mevs_jax.geometry.cameras import ViewCamera
from mevs_jax.geometry.source_view import DepthImage
from mevs_jax.meshes import Up
from mevs_jax.meshes.paint import Paint, read_paint
from mevs_jax.selection.loop import ViewTable
from mevs_jax.trained import TrainedSystem
from mevs_jax.trained.usable import BELIEF_ORACLE, GAIN_ORACLE
from train.results.identity import identity_of
from train.results.kept import kept_record
from train.tasks.colours import lit_views
from train.tasks.matcher import turned_rig

VIEWS = (1, 2, 3, 4)
POLICIES = (BASELINE, "farthest", "information_gain", GAIN_ORACLE, BELIEF_ORACLE)
_WITHIN = np.radians(10)
"""A yaw is right if it is off by at most this much."""
_RADII = 0.003, 10.0
"""Radii of objects, in metres, that a camera could be held before."""
_LEVEL = -0.1
"""Least height of the directions that depth images for enrolment are taken from: tables hide what is below."""


@dataclass(frozen=True)
class Condition:
    """What objects are enrolled from, and how they are seen.

    Attributes:
        name: of the condition.
        frames: number of depth images that objects are enrolled from; 0 for their meshes.
        unseen: largest share of the sphere that half of the views do not show.
        sized: whether the objects' true size is known, with the error of the sphere.
        errors: whether views, and the images that objects are enrolled from, have the errors of real ones.
        distance: metres from the sensor to the objects, whose size is true.
        compared: what is compared: depth, or colours of objects that have them, or both.
        light: how strongly it changes from view to view, in standard deviations of what systems are fitted with.
    """

    name: str
    frames: int = 0
    unseen: float = 0.0
    sized: bool = False
    errors: bool = True
    distance: float = 0.6
    compared: Literal["depth", "both", "colours"] = "depth"
    light: float = 1.0

    @property
    def reality(self) -> RealityAugmentation:
        """The errors of the views; the sphere is off by up to 5 % of the radius."""
        strength = 1.0 if self.errors else 0.0
        return RealityAugmentation(
            strength, sphere=0.05, floor=0.0, hidden=0.0, unseen=self.unseen, distance=self.distance
        )

    @property
    def lights(self) -> LightConfig:
        """How the light changes from view to view."""
        usual = LightConfig()
        changing = ("exposure", "balance", "tone", "gloss", "noise")
        return replace(usual, **{name: self.light * getattr(usual, name) for name in changing})


CONDITIONS = (
    Condition("mesh, perfect views", errors=False),
    Condition("mesh"),
    Condition("mesh, true size", sized=True),
    Condition("mesh, parts", unseen=0.7),
    Condition("3 images", frames=3),
    Condition("8 images", frames=8),
    Condition("20 images", frames=20),
    Condition("mesh, colours alone", compared="colours"),
    Condition("mesh, depth and colours", compared="both"),
    Condition("mesh, depth and colours, strong light", compared="both", light=2.0),
    Condition("mesh, depth and colours, true size", compared="both", sized=True),
)
"""Views have the errors of real images, but for the first; an object's yaw is never known."""


@dataclass(frozen=True)
class PoseRow:
    """Share of walks whose yaw is right within 10°, up to the object's symmetry, if the object is right; round ones left out."""

    views: int
    right: float
    objects: int


@dataclass(frozen=True)
class Measured:
    """One condition and one size of the gallery.

    Attributes:
        condition: its name.
        enrolled: number of objects.
        policies: accuracy among them, and gain over random views.
        poses: of random views.
        promises, unknown_objects: where a third of the objects is not enrolled.
        twins: pairs of objects that look alike to a depth camera (`mevs_jax.enrolment.alike`).
        unknown_without_twins: as `unknown_objects`, without unknown objects whose twin is enrolled.
    """

    condition: str
    enrolled: int
    policies: list[AccuracyRow]
    poses: list[PoseRow]
    promises: list[PromiseRow]
    unknown_objects: Strangers | None
    twins: list[list[str]]
    unknown_without_twins: Strangers | None


@dataclass(frozen=True)
class Instances:
    """`instances.json`: the objects, those left out with their reasons, and what was measured."""

    system: str
    data: str
    objects: list[str]
    left_out: dict[str, str]
    measured: list[Measured]


Painted = tuple[Mesh, Paint | None]
"""An object, and its colours if it has some that are compared."""


class Seen(NamedTuple):
    """Views of an object at a random yaw, with errors."""

    depth: Float[np.ndarray, "views side side"]
    radius: float
    yaw: float
    colours: Float[np.ndarray, "views side side 3"] | None = None


def study_instances(
    system: TrainedSystem,
    data: str,
    to: Path,
    *,
    up: Up = "auto",
    metres: float = 1.0,
    sizes: Sequence[int] = (),
    conditions: Sequence[Condition] = CONDITIONS,
    yaws: int = 2,
    seed: int = 0,
) -> Instances:
    """Enrols objects with a system and measures how well they are recognised, each of them as a class of its own.

    Args:
        system: that objects are enrolled with, as `objects`.
        data: meshes, as of `mevs check transfer`; their classes do not matter.
        to: folder where the result of each condition is kept, so that a study that was interrupted goes on from there.
        up: upward axis of the meshes.
        metres: in one unit of the files.
        sizes: numbers of objects to enrol, drawn at random; all that there are, besides.
        conditions: what to measure.
        yaws: how often each object is walked around, at a random yaw each.
        seed: of objects, yaws and errors.

    Raises:
        DataError: if fewer than 3 objects can be used, or one has an impossible size.
    """
    source, left_out = objects_to_test(data, up), dict[str, str]()
    meshes: dict[str, Painted] = {}
    coloured = any(condition.compared != "depth" for condition in conditions)
    for entry in source.entries:
        try:
            mesh = load_object(entry)
            paint = _paint_of(entry, mesh) if coloured else None
            left_out |= {f"colours of {entry.name}": note for note in (paint.notes if paint else ())}
            meshes[entry.name] = replace(mesh, radius=mesh.radius * metres), paint
        except (DataError, EmptyMesh) as error:
            left_out[entry.name] = reason_of(error)
    if len(meshes) < 3:
        raise DataError(f"{data} has {len(meshes)} objects that can be used, and 3 are needed")
    for name, (mesh, _) in meshes.items():
        if mesh.radius < _RADII[0] or mesh.radius > _RADII[1]:
            raise DataError(
                f"{name} would be {2 * mesh.radius:.3g} metres large, and the errors of cameras depend on sizes; say how many "
                f"metres one unit of the files is, such as --metres 0.01 for centimetres, and give all files the same unit"
            )
    random, measured = np.random.default_rng(seed), []
    chosen = [random.permutation(len(meshes))[:size] for size in sorted({*sizes}) if 3 <= size < len(meshes)]
    with progress_bar("conditions") as bar:
        line = bar.add_task("Measure", total=len(conditions) * (len(chosen) + 1), note="")
        for condition in conditions:
            for some in [*chosen, np.arange(len(meshes))]:
                named = {list(meshes)[place]: list(meshes.values())[place] for place in some}
                measured.append(_kept(to, system, named, condition, yaws, seed))
                bar.advance(line)
    return Instances(system.name, data, list(meshes), left_out, measured)


def _paint_of(entry: ObjectEntry, mesh: Mesh) -> Paint | None:
    return read_paint(entry.recipe.path, mesh.vertices, mesh.faces) if isinstance(entry.recipe, MeshFile) else None


def _kept(
    to: Path, system: TrainedSystem, meshes: dict[str, Painted], condition: Condition, yaws: int, seed: int
) -> Measured:
    arrays = [*jax.tree.leaves(system.parts)]
    for mesh, paint in meshes.values():
        arrays += [mesh.vertices, mesh.faces, np.float64(mesh.radius)]
        arrays += [] if paint is None or condition.compared == "depth" else [paint.colours, paint.uv, *paint.textures]
    made_by = short_hash(b"".join(np.asarray(array).tobytes() for array in arrays))
    identity = identity_of(
        "instances", condition=condition, objects=[*meshes], yaws=yaws, seed=seed, policies=POLICIES, made_by=made_by
    )
    name = f"{condition.name.replace(',', '').replace(' ', '_')}-{len(meshes)}.json"
    return kept_record(
        to / "conditions" / name, Measured, identity, lambda: _measure(system, meshes, condition, yaws, seed)
    )


def _measure(system: TrainedSystem, meshes: dict[str, Painted], condition: Condition, yaws: int, seed: int) -> Measured:
    names, camera = list(meshes), system.description.camera
    random, see = np.random.default_rng([seed, len(names)]), partial(seen_with_errors, system, condition)
    seen = [
        see(mesh, random.uniform(0, 2 * np.pi), jax.random.key(int(random.integers(2**31))), paint)
        for mesh, paint in meshes.values()
        for _ in range(yaws)
    ]
    shapes = {name: _shape(*mesh, condition, camera, random) for name, mesh in meshes.items()}
    labels = np.repeat(np.arange(len(names)), yaws)
    everything = enrol(shapes, system, true_size=condition.sized)
    if condition.compared == "colours":
        everything = _without_shape(everything)
    tables = _tables(everything, seen, labels, condition)
    walks = _by_object(_walks(everything, tables, POLICIES, max(VIEWS)), len(names))
    enrolled = np.sort(random.permutation(len(names))[: -(-2 * len(names) // 3)])
    known = np.isin(np.arange(len(names)), enrolled)
    place = np.where(known, np.cumsum(known) - 1, -1)[labels]
    some = remove(everything, [name for name, is_known in zip(names, known, strict=True) if not is_known])
    fewer = _by_object(
        _walks(some, _tables(some, seen, place, condition), (BASELINE, "information_gain"), max(VIEWS)), len(names)
    )
    twins = [list(pair) for pair in alike(everything)]
    with_twin = {one for pair in twins for one, other in (pair, pair[::-1]) if other in some.classes}
    alone = known | ~np.isin(names, [*with_twin])
    return Measured(
        condition=condition.name,
        enrolled=len(names),
        policies=rows_of(walks, VIEWS),
        poses=_poses(everything, tables, labels, np.array([one.yaw for one in seen])),
        promises=promises(fewer["information_gain"], known, STOPS, (1, 2, 4)),
        unknown_objects=strangers(fewer[BASELINE], known),
        twins=twins,
        unknown_without_twins=strangers(fewer[BASELINE].some(alone), known[alone]),
    )


def _without_shape(system: TrainedSystem) -> TrainedSystem:
    """A system of enrolled objects that compares their colours alone: the likelihood of shapes has no power."""
    gallery = system.parts.gallery
    assert gallery is not None
    matcher = replace(gallery.matcher, heat=jnp.array([-30.0, 0.0, 0.0]))
    parts = replace(system.parts, gallery=replace(gallery, matcher=matcher))
    return TrainedSystem(system.description, parts, system.name)


def seen_with_errors(
    system: TrainedSystem, condition: Condition, mesh: Mesh, yaw: float, key: jax.Array, paint: Paint | None = None
) -> Seen:
    camera = system.description.camera
    depth = jnp.asarray(capture(mesh, turned_rig(camera, system.viewpoints, yaw)).depth)
    if not condition.errors:
        return Seen(np.asarray(metric_depth(depth)), mesh.radius, yaw)
    real = _realistic(key, depth, jnp.asarray(system.poses), camera, condition.reality, mesh.radius)
    off = float(jax.random.uniform(jax.random.fold_in(key, 1), minval=-0.05, maxval=0.05))
    colours = None
    if paint is not None and condition.compared != "depth":
        triangles, given = mesh.vertices[mesh.faces], (yaw, key, camera, condition.reality, condition.lights)
        lit = lit_views(triangles, [paint.on(mesh.vertices, mesh.faces)], system.viewpoints, *given)[0]
        colours = np.where((real > 0)[..., None], lit, np.nan)
    return Seen(np.asarray(real), mesh.radius * (1 + off), yaw, colours)


@partial(jax.jit, static_argnames=("camera", "reality"))
def _realistic(
    key: jax.Array,
    depth: jax.Array,
    poses: jax.Array,
    camera: ViewCamera,
    reality: RealityAugmentation,
    radius: float | jax.Array,
) -> jax.Array:
    return realistic_views(key, {"depth": depth, "pose": poses}, camera, reality, len(depth), radius)[0]


def _shape(
    mesh: Mesh, paint: Paint | None, condition: Condition, camera: ViewCamera, random: np.random.Generator
) -> Any:
    """What an object is enrolled from: its mesh in metres, or depth images from around it, above the level of its centre."""
    if not condition.frames:
        shape = mesh.vertices * mesh.radius, mesh.faces
        return shape if paint is None or condition.compared == "depth" else (*shape, paint)
    directions = random.normal(size=(50 * condition.frames, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = _spread(directions[directions[:, 2] > _LEVEL], condition.frames)
    rig = turned_rig(camera, directions, 0.0)
    depth = capture(mesh, rig).depth
    reality = replace(condition.reality, sphere=0.0, unseen=0.0)
    key = jax.random.key(int(random.integers(2**31)))
    real = np.asarray(_realistic(key, jnp.asarray(depth), jnp.asarray(rig.poses), camera, reality, mesh.radius))
    poses = rig.poses.astype(float)
    poses[:, :3, 3] *= mesh.radius
    return [
        DepthImage(image * mesh.radius, camera.intrinsics, pose, mask=mask)
        for image, pose, mask in zip(real, poses, depth > 0, strict=True)
        if (mask & (image > 0)).any()  # others measured nothing, and would not be taken
    ]


def _spread(directions: Float[np.ndarray, "all 3"], count: int) -> Float[np.ndarray, "some 3"]:
    """Some directions, each as far as can be from those before."""
    chosen = [0]
    while len(chosen) < count:
        chosen.append(int((directions @ directions[chosen].T).max(axis=1).argmin()))
    return directions[chosen]


def _tables(system: TrainedSystem, seen: Sequence[Seen], labels: np.ndarray, condition: Condition) -> ViewTable:
    observer = Observer(system)
    for one in seen:
        observer.add(one.depth, one.radius if condition.sized else np.nan, one.colours)
    return observer.tables(labels)


def _walks(system: TrainedSystem, tables: ViewTable, policies: Sequence[str], steps: int) -> dict[str, Walks]:
    walker = Walker(system)
    return {name: walker.walk(tables, name, steps, posed=False) for name in policies}


def _by_object(walks: dict[str, Walks], objects: int) -> dict[str, Walks]:
    """Walks around an object at several yaws as walks around one object."""
    return {
        name: Walks(*(array.reshape(objects, -1, *array.shape[2:]) for array in vars(found).values()))
        for name, found in walks.items()
    }


def _poses(
    system: TrainedSystem,
    tables: ViewTable,
    labels: Int[np.ndarray, " walks"],
    yaws: Float[np.ndarray, " walks"],
) -> list[PoseRow]:
    """How often the likeliest yaw of the right object is right, after some random views."""
    gallery = system.parts.gallery
    assert gallery is not None
    assert tables.features is not None
    symmetry = np.asarray(gallery.symmetries)[labels]
    counted, random, rows = symmetry < YAWS, np.random.default_rng(0), []
    evidence = jax.jit(lambda views: gallery.hypotheses(gallery.evidence(views, jnp.ones(len(views), bool), False)))
    for count in VIEWS:
        off = np.full(len(labels), np.nan)
        for walk in np.flatnonzero(counted):
            views = random.permutation(len(system.viewpoints))[:count]
            found = np.asarray(evidence(tables.features[walk, views]))[labels[walk]].argmax() * 2 * np.pi / YAWS
            turns = symmetry[walk]
            off[walk] = abs(np.angle(np.exp(1j * turns * (found - yaws[walk])))) / turns
        right: Bool[np.ndarray, " walks"] = off[counted] <= _WITHIN
        rows.append(PoseRow(count, float(right.mean()) if counted.any() else np.nan, len(set(labels[counted]))))
    return rows


def instances_text(study: Instances) -> str:
    """The figures of `study_instances`, for a terminal."""
    lines = [f"left out: {name}: {reason}" for name, reason in study.left_out.items()]
    lines.append(f"{'enrolled from':<22}{'objects':>8}{'policy':>18}{'1':>8}{'2':>8}{'3':>8}{'4 views':>9}  gain at 2")
    for one in study.measured:
        for policy in dict.fromkeys(row.policy for row in one.policies):
            rows = [row for row in one.policies if row.policy == policy]
            right = "".join(f"{100 * row.accuracy:>8.1f}" for row in rows)
            low, high = (100 * limit for limit in rows[1].gain_interval)
            lines.append(
                f"{one.condition:<22}{one.enrolled:>8}{policy:>18}{right}   {100 * rows[1].gain:+.1f} [{low:+.1f}, {high:+.1f}]"
            )
        yaw = ", ".join(f"{100 * row.right:.0f}" for row in one.poses)
        lines.append(
            f"  yaw within 10°: {yaw} % after 1, 2, 3, 4 random views ({one.poses[0].objects} objects not round)"
        )
        sure = next(row for row in one.promises if (row.stop, row.views) == (0.95, 4))
        wrong = "–" if sure.wrong is None else f"{100 * sure.wrong:.1f}"
        lines.append(
            f"  a third not enrolled, stop 0.95, up to 4 views: sure {100 * (sure.sure or 0):.0f} %, of these wrong {wrong} %; "
            f"unknown {100 * (sure.refused or 0):.0f} %; of the others sure {100 * (sure.strangers_sure or 0):.1f} %"
        )
        for what, found in (("", one.unknown_objects), (" without twins", one.unknown_without_twins)):
            lines += [
                f"  AUROC of unknown objects{what} after {row.views}: {row.auroc:.3f}"
                for row in (found.after if found else ())
            ]
        lines += [f"  twins: {' and '.join(pair)}" for pair in one.twins]
    return "\n".join(lines)
