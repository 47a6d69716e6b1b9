"""The parts of a trained system as named arrays, and back; shapes are checked against its description."""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.beliefs.strangeness import LEVELS, Strangeness
from mevs_jax.gallery.colours import COLOURS, NUMBERS, ColourMatcher, Colours
from mevs_jax.gallery.grid import HEIGHTS, YAWS
from mevs_jax.gallery.matching import PIXELS, Gallery, Matcher
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.policies.base import Knowledge
from mevs_jax.trained.description import Description
from mevs_jax.trained.parts import Network, Parts

DESCRIPTION, WEIGHTS = "trained.json", "weights.safetensors"
"""Names of the files that describe them and that hold them."""
QUANTILES = "strangeness.quantiles"
_MOST_DEGREE = 16
"""Of expected views; the time to load them grows with its square."""


def arrays_of(parts: Parts) -> dict[str, Any]:
    """All arrays by names joined with dots; those of a network by their place in it."""
    known, fusion, gallery = parts.knowledge, parts.fusion.get("posed"), parts.gallery
    colours = gallery and gallery.colours
    if known is not None and (known.order is None or known.by_pose is not None):
        raise ValueError("the knowledge of a trained system is an order of its viewpoints and a class × view table")
    return _flat(
        "",
        {
            "viewpoints": parts.viewpoints,
            "neighbours": parts.neighbours,
            "single": parts.single,
            "encoder": parts.encoder,
            "entropy": parts.entropy,
            "pose": parts.pose,
            "view_policies": parts.view_policies,
            "fusion.weights": fusion and fusion.weights,
            "fusion.prior": fusion and fusion.prior,
            "fusion.temperatures": {name: fusion.temperatures for name, fusion in parts.fusion.items()},
            "knowledge.order": known and known.order,
            # With expected views, the table follows from them.
            "knowledge.expected_logits": known.expected_logits if known and parts.expected is None else None,
            "temperatures": parts.temperatures,
            "expected": parts.expected and parts.expected.coefficients,
            "size": parts.size,
            "gallery": gallery and {"images": gallery.images, "radii": gallery.radii},
            "matcher": gallery and dict(vars(gallery.matcher)),
            "colours": colours and {"images": colours.images, "objects": colours.objects},
            "colour_matcher": colours and dict(vars(colours.matcher)),
            QUANTILES: parts.strangeness and parts.strangeness.quantiles,
        },
    )


def _flat(name: str, part: Any) -> dict[str, Any]:
    if isinstance(part, Network | nnx.State):
        part = nnx.to_pure_dict(part.weights if isinstance(part, Network) else part)
    if isinstance(part, dict):
        inner = [_flat(f"{name}.{key}".lstrip("."), value) for key, value in part.items()]
        return {place: array for arrays in inner for place, array in arrays.items()}
    return {} if part is None else {name: part}


class _Arrays:
    """Takes arrays by name, of the shapes that they must have; `finish` names those that are left."""

    def __init__(self, arrays: dict[str, np.ndarray]):
        self.arrays, self.left = arrays, set(arrays)

    def take(self, name: str, shape: tuple[int | None, ...], dtype: Any = np.float32) -> jax.Array:
        """The array of a name; None in `shape` allows any extent from 1 on."""
        if name not in self.arrays:
            raise ValueError(f"{WEIGHTS} lacks {name}")
        array = self.arrays[name]
        fits = array.ndim == len(shape) and all(
            got >= 1 if want is None else got == want for got, want in zip(array.shape, shape, strict=True)
        )
        if not fits:
            raise ValueError(f"{name} in {WEIGHTS} has shape {array.shape}, not {shape}")
        if np.issubdtype(dtype, np.floating) and not np.isfinite(array).all():
            raise ValueError(f"{name} in {WEIGHTS} has numbers that are not finite")
        self.left.discard(name)
        return jnp.asarray(array.astype(dtype))

    def positive(self, name: str, shape: tuple[int | None, ...]) -> jax.Array:
        """Temperatures."""
        temperatures = self.take(name, shape)
        if not bool(jnp.all(temperatures > 0)):
            raise ValueError("a temperature is not positive")
        return temperatures

    def network(self, name: str, make: Any) -> Network:
        """A network with its weights; `make` is a function of `nnx.Rngs`, which is not computed."""
        module = nnx.eval_shape(lambda: make(nnx.Rngs(0)))
        structure, shapes = nnx.split(module)
        flat = flax.traverse_util.flatten_dict(nnx.to_pure_dict(shapes))
        filled = {
            place: self.take(".".join(map(str, (name, *place))), like.shape, np.dtype(like.dtype))
            for place, like in flat.items()
        }
        nnx.replace_by_pure_dict(shapes, flax.traverse_util.unflatten_dict(filled))
        return Network(structure, shapes)

    def finish(self) -> None:
        """Raises `ValueError` if arrays are left."""
        if self.left:
            raise ValueError(f"{WEIGHTS} has {min(self.left)!r:.60}, which {DESCRIPTION} does not describe")


def parts_of(description: Description, arrays: dict[str, np.ndarray]) -> Parts:
    """The parts that a description and the arrays of a file make, all of which must be as described."""
    of, take = description, _Arrays(arrays)
    classes, features = len(of.classes), of.features
    viewpoints = take.take("viewpoints", (None, 3))
    if len(viewpoints) < 2 or float(jnp.abs(jnp.linalg.norm(viewpoints, axis=1) - 1).max()) > 1e-3:
        raise ValueError("viewpoints are not at least two unit vectors")
    expected = _expected(of, take)
    parts = Parts(
        encoder=None if of.encoder is None else take.network("encoder", partial(of.encoder.network, classes)),
        viewpoints=viewpoints,
        neighbours=take.take("neighbours", (len(viewpoints), len(viewpoints)), bool),
        single=take.positive("single", ()),
        size=None if of.size is None else take.take("size", (of.size.steps, features)),
        entropy=None if of.entropy is None else take.network("entropy", partial(of.entropy.network, len(viewpoints))),
        fusion=_fusion(of, take),
        pose=None if of.pose is None else take.network("pose", partial(of.pose.network, features, classes)),
        expected=expected,
        view_policies={
            name: take.network(f"view_policies.{name}", partial(shape.network, classes))
            for name, shape in of.view_policies.items()
        },
        knowledge=_knowledge(take, classes, viewpoints, expected),
        temperatures=_temperatures(take),
        strangeness=Strangeness(take.take(QUANTILES, (None, LEVELS))) if QUANTILES in arrays else None,
        gallery=_gallery(take, classes - 1, of.colour) if of.kind == "gallery" else None,
    )
    take.finish()
    return parts


def _gallery(take: _Arrays, objects: int, colour: bool) -> Gallery:
    matcher = Matcher(
        projection=take.take("matcher.projection", (PIXELS, None)),
        floor=take.positive("matcher.floor", ()),
        heat=take.take("matcher.heat", (3,)),
        stranger=take.take("matcher.stranger", (5,)),
        unseen=take.positive("matcher.unseen", ()),
        size=take.positive("matcher.size", ()),
    )
    images = take.take("gallery.images", (objects, HEIGHTS, YAWS, PIXELS), np.uint8)
    radii = take.take("gallery.radii", (objects,))
    return Gallery.of(matcher, images, radii, _colours(take, objects) if colour else None)


def _colours(take: _Arrays, objects: int) -> Colours:
    matcher = ColourMatcher(
        projection=take.take("colour_matcher.projection", (NUMBERS, None)),
        floor=take.positive("colour_matcher.floor", ()),
        heat=take.take("colour_matcher.heat", (3,)),
        stranger=take.take("colour_matcher.stranger", (6,)),
        unseen=take.positive("colour_matcher.unseen", ()),
    )
    coloured = len(take.arrays.get("colours.objects", ()))
    which = take.take("colours.objects", (coloured,), np.int32)
    if len(np.unique(which)) < coloured or not ((which >= 0) & (which < objects)).all():
        raise ValueError(f"colours.objects in {WEIGHTS} are not different objects of the {objects} there are")
    return Colours.of(matcher, take.take("colours.images", (coloured, HEIGHTS, YAWS, COLOURS), np.uint8), which)


def _fusion(of: Description, take: _Arrays) -> dict[str, CalibratedFusion]:
    if of.fusion is None:
        return {}
    classes, features = len(of.classes), of.features
    network = take.network("fusion.weights", partial(of.fusion.network, features, classes))
    prior, single = take.take("fusion.prior", (classes,)), take.take("single", ())
    temperatures = {name: take.positive(f"fusion.temperatures.{name}", (None,)) for name in ("posed", "unposed")}
    return {
        name: CalibratedFusion(network.structure, network.weights, prior, values, single, name == "posed")
        for name, values in temperatures.items()
    }


def _expected(of: Description, take: _Arrays) -> ExpectedViews | None:
    if of.pose is None and of.best_unposed == "expected_views":
        raise ValueError("without a pose, expected views cannot be used for an unknown yaw")
    if "expected" not in take.arrays:
        if of.pose is not None or "expected_views" in (of.best, of.best_unposed):
            raise ValueError(f"{WEIGHTS} lacks expected")
        return None
    expected = ExpectedViews(take.take("expected", (len(of.classes), None, len(of.classes))))
    terms = expected.coefficients.shape[1]
    if (expected.degree + 1) ** 2 != terms or expected.degree > _MOST_DEGREE:
        raise ValueError(f"expected in {WEIGHTS} has {terms} terms, not the square of 1 to {_MOST_DEGREE + 1}")
    return expected


def _knowledge(take: _Arrays, classes: int, viewpoints: jax.Array, expected: ExpectedViews | None) -> Knowledge | None:
    if "knowledge.order" not in take.arrays:
        return None
    views, table = len(viewpoints), None if expected is None else expected.at(viewpoints)
    if "knowledge.expected_logits" in take.arrays:
        table = take.take("knowledge.expected_logits", (classes, views, classes))
    return Knowledge(take.take("knowledge.order", (views,)), table)


def _temperatures(take: _Arrays) -> dict[str, jax.Array]:
    names = sorted(name for name in take.arrays if name.startswith("temperatures."))
    if "temperatures.random" not in names:
        raise ValueError(f"{WEIGHTS} lacks temperatures.random")
    return {name.partition(".")[2]: take.positive(name, (None,)) for name in names}
