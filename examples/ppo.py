"""PPO in the environment `ActiveRecognition`, beside other policies: `python examples/ppo.py [RUN]`.

RUN is a directory in which `mevs run` has been run (default: runs/demo). Policy networks learn by PPO (Schulman et al. 2017) on
the validation objects, which the classifier was not trained on; the policy is their mean. It is evaluated on the test objects
from every start view. A whole training is one compiled function of (config, key), as in purejaxrl (Lu et al. 2022), so several
networks are one `vmap`. All episodes have the same length, so a rollout is whole episodes. `mevs_jax.gymnasium` has the same
environment for programs written for Gymnasium.

All policies share the classifier and the fusion (sum of logits), so they differ only in the views that they choose. The
prediction of PPO's agent is the belief divided by a temperature for each number of views, which is fitted on the validation
objects. It does not change the predicted class, and gives rewards that are not dominated by a few overconfident beliefs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from flax import nnx

from eval.numbers.comparison import intervals
from eval.numbers.policies import EvaluationInputs, evaluate_policies
from mevs_jax import (
    POLICIES,
    ActiveRecognition,
    EnvironmentObservation,
    Policy,
    Scene,
    SelectionState,
    ViewGraph,
    ViewTable,
)
from mevs_jax.beliefs.calibration import fit_exponent
from mevs_jax.markdown import markdown_table


@dataclass(frozen=True)
class Config:
    """Settings; one network's training is as in PPO's paper, with rollouts of whole episodes."""

    run: Annotated[Path, tyro.conf.Positional] = Path("runs/demo")
    """directory in which `mevs run` has been run"""
    max_views: int = 5
    """views of an episode"""
    networks: int = 4
    """networks, each trained on another four fifths of the validation objects; the policy takes their mean"""
    updates: int = 100
    """rollouts of a network; it is kept as it was when the other fifth of the objects gave the highest return"""
    episodes: int = 2048
    """episodes of a rollout"""
    epochs: int = 4
    """passes over a rollout"""
    batches: int = 4
    """batches of a pass"""
    width: int = 128
    """width of the network's two hidden layers"""
    learning_rate: float = 1e-3
    """initial learning rate; it falls linearly to zero"""
    trace: float = 0.95
    """λ of the generalised advantage estimate; rewards are not discounted"""
    clip: float = 0.2
    """PPO's limit on the change of a probability"""
    entropy_bonus: float = 0.01
    """weight of the policy's entropy"""
    seed: int = 0
    """seed of everything that is drawn"""


class Agent(nnx.Module):
    """Computes a score for every view (−inf if it was seen) and the expected return from an observation."""

    def __init__(self, max_views: int, views: int, classes: int, width: int, rngs: nnx.Rngs):
        self.max_views = max_views
        self.first = nnx.Linear(3 * classes + views + 3 + max_views, width, rngs=rngs)
        self.second = nnx.Linear(width, width, rngs=rngs)
        self.scores = nnx.Linear(width, views, kernel_init=nnx.initializers.orthogonal(0.01), rngs=rngs)
        self.value = nnx.Linear(width, 1, rngs=rngs)

    def __call__(self, observation: EnvironmentObservation) -> tuple[jax.Array, jax.Array]:
        inputs = [
            jax.nn.softmax(observation.log_probabilities),
            jax.nn.softmax(observation.belief),
            observation.belief / 10,
            observation.attempted.astype(jnp.float32),
            observation.direction,
            jax.nn.one_hot(observation.steps - 1, self.max_views),
        ]
        hidden = nnx.tanh(self.second(nnx.tanh(self.first(jnp.concatenate(inputs)))))
        return jnp.where(observation.attempted, -jnp.inf, self.scores(hidden)), self.value(hidden)[0]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Step:
    """A step of an episode, as PPO needs it; arrays of many steps in training."""

    observation: EnvironmentObservation
    view: jax.Array
    log_probability: jax.Array
    value: jax.Array
    reward: jax.Array


Call = Callable[[EnvironmentObservation], tuple[jax.Array, jax.Array]]


def rollout(
    environment: ActiveRecognition, agent: Call, temperatures: jax.Array, key: jax.Array, episodes: int
) -> Step:
    """Whole episodes with views drawn from the agent's probabilities; arrays (steps, episodes, …)."""

    def act(carry: tuple[Any, EnvironmentObservation], key: jax.Array) -> tuple[Any, Step]:
        states, observations = carry
        keys = jax.random.split(key, episodes + 1)
        scores, values = jax.vmap(agent)(observations)
        views = jax.random.categorical(keys[-1], scores)
        chosen = jnp.take_along_axis(jax.nn.log_softmax(scores), views[:, None], axis=1)[:, 0]
        predictions = observations.belief / temperatures[observations.steps - 1, None]
        actions = {"action": views, "prediction": predictions}
        states, after, rewards, _, _ = jax.vmap(environment.step)(keys[:-1], states, actions)
        return (states, after), Step(observations, views, chosen, values, rewards)

    of_start, of_steps = jax.random.split(key)
    start = jax.vmap(environment.reset)(jax.random.split(of_start, episodes))
    return jax.lax.scan(act, start, jax.random.split(of_steps, environment.max_views))[1]


def advantages_of(steps: Step, trace: float) -> jax.Array:
    """Generalised advantage estimates (Schulman et al. 2016) of whole episodes without discount, (steps, episodes)."""

    def back(carry: tuple[jax.Array, jax.Array], now: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
        (advantage, value_after), (reward, value) = carry, now
        advantage = reward + value_after - value + trace * advantage
        return (advantage, value), advantage

    nothing = jnp.zeros(steps.reward.shape[1])
    return jax.lax.scan(back, (nothing, nothing), (steps.reward, steps.value), reverse=True)[1]


def loss_of(agent: Call, steps: Step, advantages: jax.Array, returns: jax.Array, config: Config) -> jax.Array:
    """PPO's clipped loss, the loss of the values and the bonus for entropy; all arguments have one axis of steps."""
    scores, values = jax.vmap(agent)(steps.observation)
    log_probabilities = jax.nn.log_softmax(scores)
    ratio = jnp.exp(jnp.take_along_axis(log_probabilities, steps.view[:, None], axis=1)[:, 0] - steps.log_probability)
    clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    finite = jnp.where(steps.observation.attempted, 0.0, log_probabilities)
    entropy = -jnp.sum(jnp.exp(log_probabilities) * finite, axis=1)
    gain = jnp.minimum(ratio * advantages, clipped * advantages) + config.entropy_bonus * entropy
    moves = steps.observation.steps < config.max_views  # the last step of an episode does not move
    return 0.5 * jnp.mean((values - returns) ** 2) - jnp.sum(jnp.where(moves, gain, 0)) / jnp.maximum(jnp.sum(moves), 1)


def train(config: Config, key: jax.Array, tables: ViewTable, graph: ViewGraph, temperatures: jax.Array) -> Any:
    """Trains one network; returns its weights at the highest return on the objects that were held out."""
    of_weights, of_objects, of_validation, of_updates = jax.random.split(key, 4)
    objects, views, classes = tables.logits.shape
    order = jax.random.permutation(of_objects, objects)

    def with_objects(part: jax.Array) -> ActiveRecognition:
        return ActiveRecognition(jax.tree.map(lambda leaf: leaf[part], tables), graph, max_views=config.max_views)

    held_out, training = with_objects(order[: objects // 5]), with_objects(order[objects // 5 :])
    structure, weights = nnx.split(Agent(config.max_views, views, classes, config.width, nnx.Rngs(of_weights)))
    rate = optax.linear_schedule(config.learning_rate, 0, config.updates * config.epochs * config.batches)
    optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(rate))

    def agent(weights: Any) -> Call:
        return nnx.merge(structure, weights, copy=True)

    def update(carry: tuple[Any, Any, Any, jax.Array], key: jax.Array) -> tuple[Any, None]:
        weights, optimised, best, highest = carry
        of_rollout, of_epochs = jax.random.split(key)
        steps = rollout(training, agent(weights), temperatures, of_rollout, config.episodes)
        advantages = advantages_of(steps, config.trace)
        returns = advantages + steps.value
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (steps, advantages, returns))

        def descend(carry: tuple[Any, Any], rows: jax.Array) -> tuple[Any, None]:
            weights, optimised = carry
            steps, advantages, returns = jax.tree.map(lambda leaf: leaf[rows], flat)
            gradient = jax.grad(lambda weights: loss_of(agent(weights), steps, advantages, returns, config))(weights)
            change, optimised = optimiser.update(gradient, optimised, weights)
            return (optax.apply_updates(weights, change), optimised), None

        count = config.episodes * config.max_views
        orders = jax.vmap(partial(jax.random.permutation, x=count))(jax.random.split(of_epochs, config.epochs))
        rows = orders.reshape(config.epochs * config.batches, -1)
        weights, optimised = jax.lax.scan(descend, (weights, optimised), rows)[0]
        found = rollout(held_out, agent(weights), temperatures, of_validation, config.episodes).reward.mean()
        best = jax.tree.map(lambda new, old: jnp.where(found > highest, new, old), weights, best)
        return (weights, optimised, best, jnp.maximum(found, highest)), None

    start = weights, optimiser.init(weights), weights, jnp.array(-jnp.inf)
    return nnx.merge(structure, jax.lax.scan(update, start, jax.random.split(of_updates, config.updates))[0][2])


def fitted_temperatures(key: jax.Array, tables: ViewTable, max_views: int) -> jax.Array:
    """Temperatures of the belief after 1, 2, … views, fitted on random walks over the objects of `tables`."""

    def beliefs(key: jax.Array, logits: jax.Array) -> jax.Array:
        return jnp.cumsum(logits[jax.random.permutation(key, len(logits))[:max_views]], axis=0)

    keys = jax.random.split(key, (8, len(tables.label)))
    walks = jax.vmap(jax.vmap(beliefs), (0, None))(keys, tables.logits).reshape(-1, max_views, tables.logits.shape[-1])
    scale, growth = fit_exponent(walks, jnp.tile(tables.label, 8))
    return scale * jnp.arange(1, max_views + 1) ** growth


def policy_of(networks: Agent) -> Policy:
    """The mean of the networks' probabilities, as a policy of the selection loop; their weights have a leading axis."""
    structure, weights = nnx.split(networks)

    def by_ppo(key: jax.Array, state: SelectionState, scene: Scene) -> jax.Array:
        del key
        observation = EnvironmentObservation(
            log_probabilities=jax.nn.log_softmax(state.latest.logits),
            belief=jax.nn.log_softmax(state.belief),
            view=state.view,
            direction=scene.graph.points[state.view],
            attempted=state.attempted,
            steps=state.count,
        )
        scores = jax.vmap(lambda weights: nnx.merge(structure, weights, copy=True)(observation)[0])(weights)
        return jax.nn.softmax(scores).mean(axis=0)

    return by_ppo


def main(config: Config) -> None:
    inputs = EvaluationInputs.of_run(config.run)
    inputs = replace(inputs, config=replace(inputs.config, max_views=max(2, config.max_views)))
    validation = replace(inputs.validation.stacked(), predicted_entropy=None)
    of_temperatures, of_training, _ = jax.random.split(jax.random.key(config.seed), 3)
    temperatures = jax.jit(fitted_temperatures, static_argnums=2)(of_temperatures, validation, config.max_views)
    keys = jax.random.split(of_training, config.networks)
    networks = nnx.jit(nnx.vmap(lambda key: train(config, key, validation, inputs.graph, temperatures)))(keys)
    policies = {"information_gain": POLICIES["information_gain"], "PPO": policy_of(networks)}
    study = evaluate_policies(inputs, policies)
    right = {name: study.right(name)[:, : config.max_views].T for name in ("random", *policies)}

    def row(title: str, shares: np.ndarray, sign: str = "") -> list[str]:
        cells = zip(100 * shares.mean(axis=1), 100 * np.array(intervals(shares)), strict=True)
        return [title, *(f"{mean:{sign}.1f} ({low:{sign}.1f} to {high:{sign}.1f})" for mean, (low, high) in cells)]

    rows = [row(name, shares) for name, shares in right.items()]
    rows += [row(f"PPO − {name}", right["PPO"] - right[name], "+") for name in ("random", "information_gain")]
    views = [f"{count} view{'s' * (count > 1)}" for count in range(1, config.max_views + 1)]
    print(f"Accuracy in % on {len(study.objects)} test objects from all start views, 95 % intervals over objects:\n")
    print(markdown_table(["policy", *views], rows))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
