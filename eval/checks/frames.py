"""Whether a recording is what it says: faults of depth, intrinsics, poses and times that single images do not show."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_pipeline.errors import DataError
from data_pipeline.frames.agreement import (
    NEAR,
    Geometry,
    chosen_pairs,
    meeting,
    normals_at,
    pixels_of,
    scores,
)
from data_pipeline.frames.changes import FAMILIES, discrete, fitted, typical_depth
from data_pipeline.frames.recording import Recording

_WIDTH = 0.01
"""Error, as a share of the distance, that counts half when two readings of a recording are compared."""
_GAIN, _SURE = 0.01, 6.0
"""By how much, and by how many standard errors, surfaces have to agree better under another reading to call it a fault."""
_ALIKE = 0.01
"""Readings that differ by less cannot be told apart."""
_FEWEST = 0.6
"""Share of points that agree between the nearest images of a sound recording, at least."""
_DEPTHS = (0.05, 50.0)
"""Metres between which the middle of all depths is plausible."""
_FITTED = 112
"""Pairs of images by which a fault's size is estimated."""
_REPEATED = 0.05
"""Share of the images that may be copies, or have the pose of the one before."""
_CHANGED = 0.03
"""Share of the pixels that change in images of a camera that stands still, by noise at edges, at most."""
_LEVEL = np.cos(np.radians(10))


@dataclass(frozen=True)
class Finding:
    """A fault: what it is called, and what was found or is to be done."""

    name: str
    said: str


@dataclass(frozen=True)
class Level:
    """How pairs of images agree whose cameras are about equally far apart.

    Attributes:
        pairs: how many.
        degrees, metres: by which one camera is turned and moved against the other, median.
        overlap: share of the points of one image that the other measures.
        error: median distance between the surfaces, as a share of the distance from the camera.
        agree: share of these points whose surfaces agree within `NEAR`.
        through: share that the other image sees through, by more than twice that.
    """

    pairs: int
    degrees: float
    metres: float
    overlap: float
    error: float
    agree: float
    through: float


@dataclass(frozen=True)
class FramesCheck:
    """What was found.

    Attributes:
        images: how many were compared.
        levels: from near pairs to those that are far apart.
        findings: the faults.
        notes: what is to be known besides.
    """

    images: int
    levels: tuple[Level, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]


def check_frames(recording: Recording, upward: Float[np.ndarray, " 3"] | None = None) -> FramesCheck:
    """Looks for faults of a recording.

    Args:
        recording: at least two images.
        upward: which way is up in its world; by default as the file says, or z.

    Raises:
        DataError: if no two images show one surface.
    """
    said = Geometry.of(recording)
    findings = _plain(recording, said)
    if any(finding.name == "one pose for all images" for finding in findings):
        return FramesCheck(len(said.depth), (), tuple(findings), ())
    pairs = chosen_pairs(said.poses)
    levels = tuple(_level(said, one[one[:, 0] >= 0]) for one in np.swapaxes(pairs, 0, 1) if (one[:, 0] >= 0).any())
    used = pairs.reshape(-1, 2)
    used = used[used[:, 0] >= 0]
    if not len(used):
        raise DataError(
            "no two cameras look the same way within 40°, so images cannot be compared; record more of them"
        )
    findings += _other_reading(said, used)
    if not findings and levels[0].agree * levels[0].overlap < _FEWEST / 2:
        findings.append(Finding("views that do not agree", "no single fault of those that are known explains it"))
    notes = []
    if not findings:
        notes = _odd_images(said, used, recording.names)
        notes += _upward(said, recording.known.get("up") if upward is None else upward)
    return FramesCheck(len(said.depth), levels, tuple(findings), tuple(notes))


def _plain(recording: Recording, said: Geometry) -> list[Finding]:
    """Faults that need no comparison of surfaces."""
    found, poses, times = [], said.poses, recording.times
    if len(poses) < 2:
        raise DataError("there is one image; faults of poses and intrinsics show between two")
    still = np.isclose(poses[1:], poses[:-1], atol=1e-9).all(axis=(1, 2))
    same = np.array([np.array_equal(one, other) for one, other in zip(said.depth[1:], said.depth[:-1], strict=True)])
    if still.any() and _changed(said, still) > _CHANGED:
        if still.all():
            found.append(Finding("one pose for all images", "the images differ: give each its own pose"))
        elif (stale := int(still.sum())) > _REPEATED * len(poses):
            what = f"{stale} images have the pose of the image before, to the last digit, and show something else"
            found.append(Finding("stale poses", what))
    if (stale := int((same & ~still).sum())) > _REPEATED * len(poses):
        found.append(Finding("stale images", f"{stale} images are copies of the image before, with another pose"))
    if times is not None and (stale := int((np.diff(times) <= 0).sum())):
        found.append(Finding("stale times", f"{stale} images have a time that is not after that of the image before"))
    if not _DEPTHS[0] <= (middle := typical_depth(said)) <= _DEPTHS[1]:
        unit = "millimetres were read as metres" if middle > _DEPTHS[1] else "metres were read as millimetres"
        found.append(Finding("implausible depth", f"the images show things {middle:.3g} m away: perhaps {unit}"))
    return found


def _changed(said: Geometry, still: np.ndarray) -> float:
    """Share of the pixels that changed since the camera took its pose, in the median image of those that have an old pose."""
    first = np.maximum.accumulate(np.where(np.r_[True, ~still], np.arange(len(still) + 1), 0))
    images = np.flatnonzero(still) + 1
    now, before = (said.depth[chosen, ::2, ::2] for chosen in (images, first[images]))
    both = (now > 0) & (before > 0)
    changed = both & (np.abs(now - before) > 2 * NEAR * before)
    return float(np.median(changed.sum(axis=(1, 2)) / np.maximum(both.sum(axis=(1, 2)), 1)))


def _level(said: Geometry, pairs: np.ndarray) -> Level:
    first, second = said.poses[pairs[:, 0]], said.poses[pairs[:, 1]]
    traces = np.einsum("nij,nij->n", first[:, :3, :3], second[:, :3, :3])
    met = meeting(said, pairs)
    errors = met.errors[np.isfinite(met.errors)]
    measured = max(int(np.isfinite(met.points[..., 2]).sum()), 1)
    known = errors if errors.size else np.array([np.inf])
    return Level(
        len(pairs),
        float(np.degrees(np.median(np.arccos(np.clip((traces - 1) / 2, -1, 1))))),
        float(np.median(np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1))),
        errors.size / measured,
        float(np.median(np.abs(known))),
        float(np.mean(np.abs(known) < NEAR)),
        float(np.mean(known > 2 * NEAR)),
    )


def _other_reading(said: Geometry, pairs: np.ndarray) -> list[Finding]:
    """The reading of the recording under which surfaces agree clearly better than as it says, if there is one."""
    base = scores(said, pairs, _WIDTH)
    readings = []

    def gain_of(geometry: Geometry) -> float:
        """The gain; 0 unless it is sure."""
        more = scores(geometry, pairs, _WIDTH) - base
        error = more.std() / np.sqrt(len(more))
        return float(more.mean()) if more.mean() > max(_GAIN, _SURE * error) else 0.0

    for change in discrete(said):
        if gain := gain_of(change.geometry):
            readings.append((gain, change.name, change.advice))
    some = np.random.default_rng(0).permutation(pairs)[:_FITTED]
    if max((gain for gain, *_ in readings), default=0.0) < 0.1:  # none that undoes a fault without a size
        for family in FAMILIES:
            numbers = fitted(family, said, some)
            if (np.abs(numbers) > family.least).any() and (gain := gain_of(family.change(said, numbers))):
                readings.append((gain, family.name, family.advice(said, numbers)))
    if not readings:
        return []
    best = max(readings)[0]
    alike = [reading for reading in readings if reading[0] > best - _ALIKE * min(1.0, best / 0.1)]
    name, advice = alike[0][1:]
    others = dict.fromkeys(other for _, other, _ in alike if other != name)
    more = f" (or {', '.join(others)}: the images do not tell these apart)" if others else ""
    return [Finding(name, f"{advice}; {100 * best:.0f} % more of the surfaces agree then{more}")]


def _odd_images(said: Geometry, pairs: np.ndarray, names: tuple[str, ...]) -> list[str]:
    """Images that agree with none of those near them, where most others do."""
    agree = scores(said, pairs, NEAR)
    images = np.unique(pairs[:, 0])
    each = np.array([np.sort(agree[pairs[:, 0] == image])[-2:].mean() for image in images])
    odd = images[each < np.median(each) / 3]
    listed = ", ".join(names[image] for image in odd[:5])
    return [f"{len(odd)} of {len(images)} images do not agree with those near them: {listed}"] * bool(len(odd))


def _upward(said: Geometry, upward: np.ndarray | None) -> list[str]:
    """Which way the largest surface that is seen from above faces, where that is not upward."""
    given = np.array([0.0, 0, 1]) if upward is None else np.asarray(upward, float) / np.linalg.norm(upward)
    images = np.unique(np.linspace(0, len(said.poses) - 1, min(len(said.poses), 24)).astype(int))[:, None]
    rows, columns = pixels_of(said)
    normals = normals_at(said, images, rows, columns)
    rays = said.points(images, rows, columns)
    facing = normals * -np.sign((normals * rays).sum(axis=-1, keepdims=True))
    turns = said.poses[images[:, 0], :3, :3]
    world = (facing @ np.swapaxes(turns, 1, 2)).reshape(-1, 3)
    world = world[np.isfinite(world).all(axis=1)]
    if len(world) < 100:
        return []
    some = world[:: max(1, len(world) // 2000)]
    above = -turns[..., 1].mean(axis=0) - 0.7 * turns[..., 2].mean(axis=0)
    close = some @ some.T > _LEVEL
    counts = np.where(some @ above > 0.5, close.sum(axis=1), 0)
    normal = some[close[counts.argmax()]].mean(axis=0)
    normal /= np.linalg.norm(normal)
    angle = np.degrees(np.arccos(np.clip(normal @ given, -1, 1)))
    if counts.max() < 0.05 * len(some) or angle < 10:
        return []
    x, y, z = normal
    return [
        f"the largest surface that is seen from above is {angle:.0f}° from level, if ({given[0]:g}, {given[1]:g}, {given[2]:g}) "
        f"is upward; if it is the floor or a table, give --upward {x:.3f} {y:.3f} {z:.3f}"
    ]


def draw_check(recording: Recording, path: Path) -> None:
    """Draws two pairs of images, near and far apart: where the surfaces of one agree with the other's."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    said = Geometry.of(recording)
    pairs = chosen_pairs(said.poses)
    chosen = pairs[len(pairs) // 2]
    chosen = chosen[chosen[:, 0] >= 0][[0, -1] if len(pairs[0]) > 1 else [0]]
    figure, axes = pyplot.subplots(len(chosen), 3, figsize=(12, 3.2 * len(chosen)), squeeze=False, layout="constrained")
    for row, pair in zip(axes, chosen, strict=True):
        for axis, image in zip(row, pair, strict=False):
            depth = said.depth[image]
            figure.colorbar(axis.imshow(np.where(depth > 0, depth, np.nan)), ax=axis, label="m")
            axis.set_title(recording.names[image], fontsize=8)
        errors = 100 * _errors_of_image(said, pair)
        figure.colorbar(row[2].imshow(errors, cmap="coolwarm", vmin=-5, vmax=5), ax=row[2], label="% of the distance")
        row[2].set_title("surface of the second image behind that of the first", fontsize=8)
        for axis in row:
            axis.set_axis_off()
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def _errors_of_image(said: Geometry, pair: np.ndarray) -> Float[np.ndarray, "height width"]:
    """Errors at every pixel of the first image."""
    height, width = said.depth.shape[1:]
    rows, columns = np.mgrid[:height, :width].reshape(2, 1, -1)
    met = meeting(said, pair[None], (rows, columns))
    return met.errors.reshape(height, width)
