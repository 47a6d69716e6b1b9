"""How the logits of several views become one belief.

The thesis adds them (§4.4): a product of experts that takes the views to be independent. The belief is kept as unnormalised
log-probabilities, so a fusion is one function from (belief, logits) to belief.

What the sum gets wrong is not which class is the most likely but how sure one may be: views of one object are anything but
independent. All of the family p ∝ Π pᵢ^α with an α that depends on the number of views (`discounted`) agree on the class; the
thesis has α = 1, the mean of log-probabilities α = 1/n, and α = 1/T(n) is what `mevs_jax.calibration` fits. The mean of
probabilities (a mixture) can disagree.

`SetFusion` is learned: a belief of features and directions of any views, which need not be independent.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arrays import AnyArray


def sum_of_logits(belief: Float[Array, " classes"], logits: Float[Array, " classes"]) -> Float[Array, " classes"]:
    """The belief after one more view; the belief before any view is zero."""
    return belief + logits


def confidence(belief: Float[Array, " classes"]) -> Float[Array, ""]:
    """Probability of the most likely class, in (0, 1]."""
    return jnp.max(jax.nn.softmax(belief))


def running_sum(values: Float[Array, " steps *rest"]) -> Float[Array, " steps *rest"]:
    """Cumulative sum over a few steps, one after the other like the selection loop, so that no rounding differs from it."""
    sums = [values[0]]
    for step in range(1, values.shape[0]):
        sums.append(sums[-1] + values[step])
    return jnp.stack(sums)


def beliefs_along(logits: Float[Array, "steps classes"]) -> Float[Array, "steps classes"]:
    """Sum of the logits seen so far after each step of a walk."""
    return running_sum(logits)


def discounted(
    beliefs: Float[Array, "steps classes"], temperatures: Float[Array, " steps"]
) -> Float[Array, "steps classes"]:
    """Log-probabilities softmax(belief / T(n)) after each number of views; T = 1 is the thesis, T = n the mean of logits."""
    return jax.nn.log_softmax(beliefs / temperatures[:, None], axis=-1)


def mean_of_probabilities(logits: Float[Array, "steps classes"]) -> Float[Array, "steps classes"]:
    """Logarithm of the mean probability of each class after each step of a walk (linear opinion pool)."""
    total = jax.lax.cumlogsumexp(jax.nn.log_softmax(logits, axis=-1), axis=0)
    return total - jnp.log(jnp.arange(1, len(logits) + 1))[:, None]


@flax.struct.dataclass
class CalibratedFusion:
    """A trained set fusion, or the sum of logits, whose log-probabilities can be taken at their word.

    Attributes:
        structure: of the network.
        weights: of the network.
        prior: (classes,) log-probabilities of the classes in training, which are taken off: here each is as likely as another.
        temperatures: (most,) by number of views, from one view on; the last is also that of more.
        single: temperature of the logits of a view alone.
        posed: whether the objects' pose is known; see `SetFusion`.
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
        """Log-probabilities of what was seen, as in `SetFusion`."""
        network = nnx.merge(self.structure, self.weights)
        logits = network(features, directions, present, posed=self.posed) - self.prior
        count = jnp.clip(jnp.sum(present, axis=-1), 1, len(self.temperatures))
        return jax.nn.log_softmax(logits / self.temperatures[count - 1][..., None], axis=-1)
