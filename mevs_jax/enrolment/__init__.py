"""New objects without training: what they look like is kept, and compared with what a camera sees.

The names below are imported when they are first used: trained systems need a part of this folder, and it needs them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mevs_jax.enrolment.enrolling import AlikeWarning as AlikeWarning
    from mevs_jax.enrolment.enrolling import alike as alike
    from mevs_jax.enrolment.enrolling import enrol as enrol
    from mevs_jax.enrolment.enrolling import remove as remove
    from mevs_jax.enrolment.enrolling import rename as rename
    from mevs_jax.enrolment.pose import ObjectPose as ObjectPose

_HOMES = {name: "enrolling" for name in ("AlikeWarning", "alike", "enrol", "remove", "rename")} | {"ObjectPose": "pose"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
