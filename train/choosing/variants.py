"""The variants of the view policy: the method, and the ablations that measure the effect of its parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from mevs_jax.policies.learned import By


@dataclass(frozen=True)
class Variant:
    """A way to train the view policy, or to score candidates with it.

    Attributes:
        title: title in the report.
        posed: whether the objects' pose is known.
        by: how candidates are scored; see `mevs_jax.policies.learned.By`.
        network: name of the variant whose network is used; its own if empty.
        changed: whether it also learns from mirrored and stretched copies of the objects.
        learns_from: "validation": validation objects; "parts": training objects in parts, each with the features of a recogniser
            that was trained without it; "training": training objects, with the features of the recogniser trained on them.
        cloud: whether it is also given PointNet++'s embedding of every partial cloud.
        summed: whether beliefs are sums of logits, in training and on its walks.
        q_learning: whether it is trained by Q-learning, from walks alone.
        settings: settings that differ from `LearnedConfig.policy`.
    """

    title: str
    posed: bool = True
    by: By = "belief"
    network: str = ""
    changed: bool = True
    learns_from: Literal["validation", "parts", "training"] = "validation"
    cloud: bool = False
    summed: bool = False
    q_learning: bool = False
    settings: dict[str, Any] = field(default_factory=dict)


VARIANTS = {
    "learned": Variant("view policy"),
    "learned_unposed": Variant("view policy", posed=False),
    "learned_and_table": Variant("view policy and expected views", by="table", network="learned"),
    "as_it_is": Variant("… by the gain expected in the state, not per class", by="state", network="learned"),
    "look_ahead": Variant("… two views ahead", by="ahead", network="learned"),
    "probability": Variant(
        "… by the rise of the probability, not of its logarithm", settings={"utility": "probability"}
    ),
    "random_states": Variant("… trained on random walks alone", settings={"rounds": 1}),
    "unchanged": Variant("… trained on unchanged objects", changed=False),
    "crossed": Variant("… trained on training objects, by recognisers without them", learns_from="parts"),
    "known": Variant("… trained on training objects, by their own recogniser", learns_from="training"),
    "summed": Variant("… with the sum of logits as fusion", summed=True),
    "cloud": Variant("… with PointNet++'s embedding of clouds as further input", cloud=True, changed=False),
    "q_learning": Variant("… Q-learning (as MVSelect)", by="state", q_learning=True),
}
"""The method (`learned…`), and the ablations that measure the effect of its parts."""

ABLATIONS = tuple(name for name in VARIANTS if not name.startswith("learned"))
