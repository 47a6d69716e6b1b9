"""The parts of a trained system as named arrays, and back; shapes are checked against its description."""

from __future__ import annotations

from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.beliefs.strangeness import LEVELS, Strangeness
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.policies.base import Knowledge
from mevs_jax.trained.description import Description
from mevs_jax.trained.parts import Network, Parts

DESCRIPTION, WEIGHTS = "trained.json", "weights.safetensors"
"""Names of the files that describe them and that hold them."""
_MOST_DEGREE = 16
"""Of expected views; the time to load them grows with its square."""


def arrays_of(parts: Parts) -> dict[str, Any]:
    """All arrays by names joined with dots; those of a network by their place in it."""
    found: dict[str, Any] = {"viewpoints": parts.viewpoints, "neighbours": parts.neighbours, "single": parts.single}
    networks = {"encoder": parts.encoder, "entropy": parts.entropy, "pose": parts.pose}
    networks |= {f"view_policies.{name}": network for name, network in parts.view_policies.items()}
    for name, network in networks.items():
        if network is not None:
            found |= _flat(name, network.weights)
    if parts.fusion:
        found |= _flat("fusion.weights", parts.fusion["posed"].weights)
        found["fusion.prior"] = parts.fusion["posed"].prior
        found |= {f"fusion.temperatures.{name}": fusion.temperatures for name, fusion in parts.fusion.items()}
    if parts.knowledge is not None:
        if parts.knowledge.order is None or parts.knowledge.by_pose is not None:
            raise ValueError("the knowledge of a trained system is an order of its viewpoints and a class × view table")
        found["knowledge.order"] = parts.knowledge.order
        if (
            parts.expected is None and parts.knowledge.expected_logits is not None
        ):  # else it follows from expected views
            found["knowledge.expected_logits"] = parts.knowledge.expected_logits
    found |= {f"temperatures.{name}": values for name, values in parts.temperatures.items()}
    if parts.expected is not None:
        found["expected"] = parts.expected.coefficients
    if parts.size is not None:
        found["size"] = parts.size
    if parts.strangeness is not None:
        found["strangeness.quantiles"] = parts.strangeness.quantiles
    return found


def _flat(name: str, weights: nnx.State) -> dict[str, Any]:
    flat = flax.traverse_util.flatten_dict(nnx.to_pure_dict(weights))
    return {".".join(map(str, (name, *place))): value for place, value in flat.items()}


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
    """The parts that a description and the arrays of a file make.

    Raises:
        ValueError: if an array is missing, is left over, has another shape than is described, or is impossible.
    """
    take = _Arrays(arrays)
    classes = len(description.classes)
    viewpoints = take.take("viewpoints", (None, 3))
    views = len(viewpoints)
    if views < 2 or float(jnp.abs(jnp.linalg.norm(viewpoints, axis=1) - 1).max()) > 1e-3:
        raise ValueError("viewpoints are not at least two unit vectors")
    features = 8 * description.encoder.width
    fusion = {}
    if (shape := description.fusion) is not None:
        network = take.network("fusion.weights", lambda rngs: shape.network(features, classes, rngs))
        prior, single = take.take("fusion.prior", (classes,)), take.take("single", ())
        for name in ("posed", "unposed"):
            temperatures = _positive(take.take(f"fusion.temperatures.{name}", (None,)))
            fusion[name] = CalibratedFusion(
                network.structure, network.weights, prior, temperatures, single, name == "posed"
            )
    pose, entropy, knowledge, expected, strangeness = None, None, None, None, None
    if (of_pose := description.pose) is not None:
        pose = take.network("pose", lambda rngs: of_pose.network(features, classes, rngs))
    if (of_entropy := description.entropy) is not None:
        entropy = take.network("entropy", lambda rngs: of_entropy.network(views, rngs))
    if "expected" in arrays:
        expected = ExpectedViews(take.take("expected", (classes, None, classes)))
        terms = expected.coefficients.shape[1]
        if (expected.degree + 1) ** 2 != terms or expected.degree > _MOST_DEGREE:
            raise ValueError(f"expected in {WEIGHTS} has {terms} terms, not the square of 1 to {_MOST_DEGREE + 1}")
    elif pose is not None or "expected_views" in (description.best, description.best_unposed):
        raise ValueError(f"{WEIGHTS} lacks expected")
    if pose is None and description.best_unposed == "expected_views":
        raise ValueError("without a pose, expected views cannot be used for an unknown yaw")
    if "knowledge.order" in arrays:
        table = None if expected is None else expected.at(viewpoints)
        if "knowledge.expected_logits" in arrays:
            table = take.take("knowledge.expected_logits", (classes, views, classes))
        knowledge = Knowledge(take.take("knowledge.order", (views,)), table)
    if "strangeness.quantiles" in arrays:
        strangeness = Strangeness(take.take("strangeness.quantiles", (None, LEVELS)))
    names = sorted(name for name in arrays if name.startswith("temperatures."))
    if "temperatures.random" not in names:
        raise ValueError(f"{WEIGHTS} lacks temperatures.random")
    parts = Parts(
        encoder=take.network("encoder", lambda rngs: description.encoder.network(classes, rngs)),
        viewpoints=viewpoints,
        neighbours=take.take("neighbours", (views, views), bool),
        single=_positive(take.take("single", ())),
        size=None if description.size is None else take.take("size", (description.size.steps, features)),
        entropy=entropy,
        fusion=fusion,
        pose=pose,
        expected=expected,
        view_policies={
            name: take.network(f"view_policies.{name}", lambda rngs, of=of: of.network(classes, rngs))
            for name, of in description.view_policies.items()
        },
        knowledge=knowledge,
        temperatures={name.partition(".")[2]: _positive(take.take(name, (None,))) for name in names},
        strangeness=strangeness,
    )
    take.finish()
    return parts


def _positive(temperatures: jax.Array) -> jax.Array:
    if not bool(jnp.all(temperatures > 0)):
        raise ValueError("a temperature is not positive")
    return temperatures
