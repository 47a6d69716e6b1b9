"""New objects for a system without training: `enrol`, `remove`, `rename`."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mevs_jax.agent.looking import Frames
from mevs_jax.arrays import AnyArray, AnyVector
from mevs_jax.gallery.frames import images_of_frames, refined
from mevs_jax.gallery.matching import ALIKE, Gallery, differences_by_turn
from mevs_jax.gallery.meshes import images_of_mesh
from mevs_jax.geometry.cameras import ViewCamera
from mevs_jax.geometry.source_view import DepthImage
from mevs_jax.geometry.sphere import Sphere, estimate_sphere, upright
from mevs_jax.meshes.paint import Paint
from mevs_jax.trained.description import UNKNOWN_OBJECT, DataDescription
from mevs_jax.trained.files import MOST_CLASSES, load
from mevs_jax.trained.system import TrainedSystem

OBJECTS = "objects"
"""Name of the shipped system that objects are enrolled with."""
Shape = tuple[AnyArray, AnyArray] | tuple[AnyArray, AnyArray, AnyArray | Paint] | Frames | Sequence[DepthImage]
"""A mesh, as vertices (n, 3) and faces (m, 3), and its colours, if it has some; or depth images of the object."""

_EQUAL = 1e-3
"""Equal objects are those whose images differ by less than this, as `alike` has it."""


class AlikeWarning(UserWarning):
    """Two enrolled objects look alike to a depth camera."""


def enrol(
    objects: Mapping[str, Shape],
    system: str | TrainedSystem = OBJECTS,
    *,
    up: AnyVector = (0.0, 0.0, 1.0),
    true_size: bool = True,
) -> TrainedSystem:
    """Returns a system that recognises some objects, at any yaw, and calls everything else an unknown object.

    No network is trained. It takes about a second for each object. An object's own frame, against which its yaw is measured, has
    the axes of its mesh, or of the world of its images, with `up` as z.

    Args:
        objects: by name, a mesh (in metres), maybe with colours: for each vertex or face, (n, 3) or (m, 3), or a
            `mevs_jax.meshes.paint.Paint`; or depth images of the object from around it: `Frames`, or images that each have a
            `mask` or a `floor`, which tells it from what is beside it. Three images suffice if they show all sides.
        system: what views are compared by: `objects`, or a system of enrolled objects, which the new ones are added to.
        up: the objects' upward direction; not of `Frames`, which have their own.
        true_size: False if the sizes of meshes say nothing about those of the objects.

    Raises:
        ValueError: for a name that is taken, arrays that are no mesh, or images that do not show the object.
        ImportError: for a mesh, without the package embreex.
    """
    known = load(system) if isinstance(system, str) else system
    gallery = _gallery_of(known)
    if not isinstance(objects, Mapping) or not objects:
        raise ValueError(
            'objects must be a mapping from names to meshes or depth images, as {"mug": (vertices, faces)}'
        )
    camera = known.description.camera
    images: list[np.ndarray] = []
    colours: list[np.ndarray | None] = []
    radii: list[float] = []
    for name, shape in objects.items():
        _check_name(name, (*known.classes, *list(objects)[: len(images)]))
        try:
            image, colour, radius = _images(shape, camera, up)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        images.append(image)
        colours.append(colour)
        radii.append(radius if true_size else 0.0)
    together = Gallery.of(
        gallery.matcher,
        np.concatenate([np.asarray(gallery.images), np.stack(images)]),
        np.concatenate([np.asarray(gallery.radii), radii]),
        None if gallery.colours is None else gallery.colours.with_more(colours, len(gallery.radii)),
    )
    system_now = _with(known, together, (*known.classes[:-1], *objects))
    equal = alike(system_now, _EQUAL)
    for one, other in alike(system_now):
        if {one, other} & set(objects):
            how = "are equal" if (one, other) in equal else "look alike"
            warnings.warn(
                f"{one} and {other} {how} to a depth camera: an answer between them is hardly ever sure. Enrol one "
                "of them, or distinguish them by other means",
                AlikeWarning,
                stacklevel=2,
            )
    return system_now


def remove(system: TrainedSystem, names: str | Iterable[str]) -> TrainedSystem:
    """Returns the system without some of its objects; raises `ValueError` for a name that it does not know."""
    gone = [names] if isinstance(names, str) else list(names)
    gallery, known = _gallery_of(system), system.classes[:-1]
    for name in gone:
        _check_known(name, known)
    kept = np.array([place for place, name in enumerate(known) if name not in gone], int)
    colours = None if gallery.colours is None else gallery.colours.only(kept)
    left = Gallery.of(gallery.matcher, np.asarray(gallery.images)[kept], np.asarray(gallery.radii)[kept], colours)
    return _with(system, left, tuple(known[place] for place in kept))


def rename(system: TrainedSystem, names: Mapping[str, str]) -> TrainedSystem:
    """Returns the system with other names for some of its objects.

    Args:
        system: of enrolled objects.
        names: from old to new.

    Raises:
        ValueError: for an old name that it does not know, or a new one that is taken.
    """
    known = system.classes[:-1]
    for old in names:
        _check_known(old, known)
    renamed = tuple(names.get(name, name) for name in known)
    for place, name in enumerate(renamed):
        if name != known[place] or name in names.values():
            _check_name(name, (*renamed[:place], UNKNOWN_OBJECT))
    return _with(system, _gallery_of(system), renamed)


def alike(system: TrainedSystem, apart: float = ALIKE) -> list[tuple[str, str]]:
    """Pairs of enrolled objects that a depth camera can hardly tell apart, nor colours where those of both are known."""
    gallery, names = _gallery_of(system), system.classes
    features, radii = np.asarray(gallery.features), np.asarray(gallery.radii)
    told = (radii > 0) & (radii[:, None] > 0)
    sizes = np.log(np.where(radii > 0, radii, 1.0))
    of_one_size = ~told | (np.abs(sizes - sizes[:, None]) < 2 * float(gallery.matcher.size))
    similar = of_one_size & (differences_by_turn(features).min(axis=2) < apart)
    if gallery.colours is not None and len(gallery.colours.objects):
        coloured = np.ix_(*[np.asarray(gallery.colours.objects)] * 2)
        similar[coloured] &= differences_by_turn(np.asarray(gallery.colours.features)).min(axis=2) < apart
    return [(names[first], names[second]) for first, second in np.argwhere(np.triu(similar, 1))]


def _images(
    shape: Any, camera: ViewCamera, up: AnyVector
) -> tuple[UInt8[np.ndarray, "heights yaws pixels"], UInt8[np.ndarray, "heights yaws colours"] | None, float]:
    if isinstance(shape, Frames):
        frames, sphere = [shape.image(number) for number in range(len(shape.depth))], shape.sphere
        return *images_of_frames(frames, sphere, camera), sphere.radius
    parts = list(shape) if isinstance(shape, Iterable) else [shape]
    if parts and all(isinstance(part, DepthImage) for part in parts):
        if any(image.mask is None and image.floor is None for image in parts):
            raise ValueError("an image needs a mask or a floor, to tell the object from the rest")
        points = [_above(image, number, up) for number, image in enumerate(parts, 1)]
        sphere = refined(Sphere(*estimate_sphere(np.concatenate(points), up=up), up), parts)
        return *images_of_frames(parts, sphere, camera), sphere.radius
    if len(parts) not in (2, 3) or any(isinstance(part, DepthImage) for part in parts):
        raise ValueError(
            "an object is a mesh (vertices, faces) or (vertices, faces, colours), mevs_jax.agent.Frames, or a list of "
            "mevs_jax.DepthImage"
        )
    vertices, faces = (np.asarray(part) for part in parts[:2])
    paint = parts[2] if len(parts) == 3 else None
    if paint is not None and not isinstance(paint, Paint):
        paint = Paint.of(paint, faces, len(vertices))
    if vertices.ndim == 2 and vertices.shape[1] == 3:
        vertices = vertices @ upright(up).T
    return images_of_mesh(vertices, faces, camera, paint)


def _above(frame: DepthImage, number: int, up: AnyVector) -> Float[np.ndarray, "points 3"]:
    """The points of the object in an image."""
    points = frame.points()
    if not len(points):
        raise ValueError(f"frame {number} has no measured depth within its mask; leave it out, or mend its mask")
    if frame.floor is None:
        return points
    return points[points @ upright(up)[2] >= frame.floor]


def _gallery_of(system: TrainedSystem) -> Gallery:
    if system.parts.gallery is None:
        raise ValueError(
            f"{system.name or 'this system'} recognises what it was trained on; objects are enrolled with the system "
            f"{OBJECTS!r}, or one that mevs_jax.enrol returned"
        )
    return system.parts.gallery


def _with(system: TrainedSystem, gallery: Gallery, names: tuple[str, ...]) -> TrainedSystem:
    """The system with other objects."""
    if len(names) >= MOST_CLASSES:
        raise ValueError(f"a system has at most {MOST_CLASSES - 1} objects")
    content = [gallery.images, gallery.radii, *([] if gallery.colours is None else [gallery.colours.images])]
    digest = hashlib.sha256(b"".join(np.asarray(one).tobytes() for one in content)).hexdigest()
    data = DataDescription("enrolled objects", digest[:16], {"enrolled": len(names)})
    description = replace(system.description, classes=(*names, UNKNOWN_OBJECT), data=data, evaluation={})
    return TrainedSystem(description, replace(system.parts, gallery=gallery), system.name)


def _check_name(name: Any, taken: Iterable[str]) -> None:
    if not isinstance(name, str) or not name.strip():
        raise ValueError(f"the name of an object must be a text, got {name!r:.80}")
    if name in taken or name.replace("_", " ").lower() == UNKNOWN_OBJECT:
        raise ValueError(f"there is an object {name!r} already; remove it first, or choose another name")


def _check_known(name: Any, known: Sequence[str]) -> None:
    if name not in known:
        raise ValueError(f"no object {name!r:.80} is enrolled; those are {', '.join(known) or 'none'}")
