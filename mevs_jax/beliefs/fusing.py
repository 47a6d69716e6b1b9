"""Beliefs: the class probabilities of an object after several views, and how far they can be trusted.

A belief is a vector of unnormalised log-probabilities. The thesis adds the logits of the views (§4.4): a product of experts,
which assumes that views are independent. Views of one object are not, so the sum finds the most likely class but is too
confident.

All beliefs of the family p ∝ Π pᵢ^α, where α depends on the number of views n alone, agree on the class (`discounted`): α = 1
is the thesis's sum, α = 1/n the mean of log-probabilities, and α = 1/T(n) uses temperatures fitted by `beliefs.calibration`.
The mean of probabilities (a mixture) can disagree. A `CalibratedFusion` computes the belief by a trained network from the
features and directions of the views, which need not be independent.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arguments import check
from mevs_jax.arrays import AnyArray


def confidence(belief: Float[Array, " classes"]) -> Float[Array, ""]:
    """Probability of the most likely class, in (0, 1]."""
    return jnp.max(jax.nn.softmax(belief))


def running_sum(values: Float[Array, " steps *rest"]) -> Float[Array, " steps *rest"]:
    """Cumulative sum over the first axis: of the logits of a walk, the belief after each step.

    The order of additions is that of the selection loop, so the rounding is the same.
    """
    sums = [values[0]]
    for step in range(1, values.shape[0]):
        sums.append(sums[-1] + values[step])
    return jnp.stack(sums)


def discounted(
    beliefs: Float[Array, "steps classes"], temperatures: Float[Array, " steps"]
) -> Float[Array, "steps classes"]:
    """Log-probabilities log softmax(belief / T(n)) after n = 1, 2, … views.

    Args:
        beliefs: sums of the logits after each step of a walk.
        temperatures: T(n); T = 1 is the thesis's sum of logits, T = n the mean of logits.

    Raises:
        ValueError: for a temperature that is known and not positive.
    """
    check(temperatures, "temperatures must be positive", lambda T: (T > 0) & (np.inf > T))
    return jax.nn.log_softmax(beliefs / temperatures[:, None], axis=-1)


def mean_of_probabilities(logits: Float[Array, "steps classes"]) -> Float[Array, "steps classes"]:
    """Logarithm of the mean probability of each class after each step of a walk (linear opinion pool)."""
    total = jax.lax.cumlogsumexp(jax.nn.log_softmax(logits, axis=-1), axis=0)
    return total - jnp.log(jnp.arange(1, len(logits) + 1))[:, None]


@flax.struct.dataclass
class CalibratedFusion:
    """A trained fusion network (`SetFusion` or `SumFusion`) with calibrated log-probabilities.

    Attributes:
        structure: graph definition of the network.
        weights: state of the network.
        prior: (classes,) log-probabilities of the classes in training. They are subtracted, so all classes are equally likely.
        temperatures: (most,) by number of views, from one view on; the last also applies to more views.
        single: temperature of the logits of a single view.
        posed: whether the pose of the objects is known; see `SetFusion`.
    """

    structure: nnx.GraphDef = flax.struct.field(pytree_node=False)
    weights: nnx.State
    prior: Float[Array, " classes"]
    temperatures: Float[Array, " most"]
    single: Float[Array, ""]
    posed: bool = flax.struct.field(pytree_node=False, default=True)

    def __call__(
        self,
        features: Float[AnyArray, "*batch views features"],
        directions: Float[AnyArray, "*batch views 3"],
        present: Bool[AnyArray, "*batch views"],
    ) -> Float[Array, "*batch classes"]:
        """Calibrated log-probabilities of the views that are `present`; arguments as of `SetFusion`."""
        network = nnx.merge(self.structure, self.weights)
        logits = network(features, directions, present, posed=self.posed) - self.prior
        count = jnp.clip(jnp.sum(present, axis=-1), 1, len(self.temperatures))
        return jax.nn.log_softmax(logits / self.temperatures[count - 1][..., None], axis=-1)
