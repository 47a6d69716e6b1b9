"""Active recognition for Gymnasium; see `mevs_jax.environment.gymnasium` and, for `ap_gym`, `.active_perception`."""

from typing import Any

from mevs_jax.environment.gymnasium import NAME as NAME
from mevs_jax.environment.gymnasium import VIEW_SELECTION as VIEW_SELECTION
from mevs_jax.environment.gymnasium import ViewSelectionEnv as ViewSelectionEnv


def __getattr__(name: str) -> Any:
    if name not in ("ActiveRecognitionEnv", "ActiveRecognitionVectorEnv"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from mevs_jax.environment import active_perception  # which needs ap_gym

    return getattr(active_perception, name)
