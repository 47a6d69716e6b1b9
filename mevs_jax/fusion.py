"""How the logits of several views become one belief.

The thesis adds them (§4.4): a product of experts that takes the views to be independent. The belief is kept as unnormalised
log-probabilities, so a fusion is one function from (belief, logits) to belief.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def sum_of_logits(belief: Float[Array, "classes"], logits: Float[Array, "classes"]) -> Float[Array, "classes"]:
    """The belief after one more view; the belief before any view is zero."""
    return belief + logits


def confidence(belief: Float[Array, "classes"]) -> Float[Array, ""]:
    """Probability of the most likely class, in (0, 1]."""
    return jnp.max(jax.nn.softmax(belief))
