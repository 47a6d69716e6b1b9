"""Active recognition as an environment for reinforcement learning, in pure JAX.

An agent sees one view of an unknown object, predicts its class, and chooses the next view. The environment reads view tables, so
a step is a few array look-ups; with `jax.vmap` and `jax.jit`, millions of steps a second run on a CPU.

Actions, rewards and `info` follow the active classification environments of `ap_gym` 0.7 (Active Perception Gym,
https://github.com/TimSchneider42/active-perception-gym). `mevs_jax.environment.gymnasium` has the same environment for Gymnasium.

    environment = ActiveRecognition.from_run("runs/demo")
    state, observation = environment.reset(key)
    action = {"action": next_view, "prediction": observation.belief}
    state, observation, reward, done, info = environment.step(key, state, action)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arguments import check, check_indices, whole
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, Observation, Scene, SelectionState
from mevs_jax.selection.loop import Fuse, ViewTable, sum_of_logits


@flax.struct.dataclass
class EnvironmentState:
    """The state of one episode, which the agent does not see.

    Attributes:
        object_index: index of the object in the tables.
        view: index of the view that the camera is at.
        steps: number of views taken so far, repeated ones included.
        count: number of different views seen so far.
        attempted: (views,) True for the views that have been seen.
        views: (max_views,) indices of the different views seen, in order; −1 beyond `count`.
        belief: (classes,) unnormalised log-probabilities, as in `SelectionState`.
    """

    object_index: Int[Array, "*batch"]
    view: Int[Array, "*batch"]
    steps: Int[Array, "*batch"]
    count: Int[Array, "*batch"]
    attempted: Bool[Array, "*batch views"]
    views: Int[Array, "*batch max_views"]
    belief: Float[Array, "*batch classes"]


@flax.struct.dataclass
class EnvironmentObservation:
    """What the agent sees.

    Attributes:
        log_probabilities: (classes,) of the classifier, from the current view alone.
        belief: (classes,) log-probabilities, fused from all views seen.
        view: index of the current view.
        direction: (3,) unit vector from the object to the camera.
        attempted: (views,) True for the views that have been seen.
        steps: number of views taken so far, 1 … max_views.
        reachable: (views,) True where the camera can go; None where it can go everywhere.
        predicted_entropy: (views,) predicted from the current view for every view; None where the tables have none.
        features: (features,) of the encoder for the current view; None where the tables have none.
        cloud: (embedding,) of the current view's partial cloud; None where the tables have none.
    """

    log_probabilities: Float[Array, "*batch classes"]
    belief: Float[Array, "*batch classes"]
    view: Int[Array, "*batch"]
    direction: Float[Array, "*batch 3"]
    attempted: Bool[Array, "*batch views"]
    steps: Int[Array, "*batch"]
    reachable: Bool[Array, "*batch views"] | None = None
    predicted_entropy: Float[Array, "*batch views"] | None = None
    features: Float[Array, "*batch features"] | None = None
    cloud: Float[Array, "*batch embedding"] | None = None


def check_action(action: Any, episodes: tuple[int, ...], classes: int) -> None:
    """Raises `ValueError` unless an action has a view and a prediction of finite logits for each of some episodes."""
    if not isinstance(action, Mapping) or not {"action", "prediction"} <= set(action):
        got = sorted(action) if isinstance(action, Mapping) else action
        raise ValueError(
            f'an action is {{"action": index of the next view, "prediction": logits of {classes} classes}}, got {got!r:.80}'
        )
    if (shape := np.shape(action["prediction"])) != (*episodes, classes):
        raise ValueError(f"a prediction is finite logits of shape {(*episodes, classes)}, got shape {shape}")
    check(action["prediction"], f"a prediction is finite logits of shape {shape}", np.isfinite)


@jax.tree_util.register_pytree_node_class
class ActiveRecognition:
    """Active recognition of one object per episode; `jax.vmap` over keys and states runs many episodes at once.

    An episode shows an object from a start view, both drawn uniformly. In each of its `max_views` steps the agent predicts the
    class from what it has seen so far, and names the next view. So the predictions after 1, 2, …, `max_views` views are each
    scored once. The last step ends the episode: it scores the prediction, and the camera stays where it is.

    An action is `{"action": index of the next view, "prediction": (classes,) logits}`. The reward is the base reward minus the
    loss of the prediction. The base reward is minus the cost of the movement. The loss is the cross-entropy of the prediction
    with the true class, divided by log(classes), so that a uniform prediction costs 1; this is the loss of `ap_gym`.

    A view may be taken again. The observation is then that of this view again, the step counts, the movement costs, and the
    belief does not change, because the same image holds no new evidence. An action that names an unreachable view leaves the
    camera where it is, with the same effect as taking the current view again. An index outside the range is clipped to it.

    An instance is a pytree, so it can be an argument of a jitted function. Its arrays are then arguments of the program. If
    `environment.step` itself is jitted, they are constants in it, which takes longer to compile for large tables.

    Args:
        tables: view tables with a leading axis of objects, for example `ViewTables.stacked()`; one classifier.
        graph: the candidate views.
        max_views: number of views of an episode, 1..views.
        reachable: (views,) True where the camera can go; None for everywhere. The start view may be unreachable, as in
            `select_views`.
        movement_cost: cost of each radian of great-circle distance travelled.
        normalised: whether the loss is divided by log(classes), as in `ap_gym`; False gives the cross-entropy in nats.
        fuse: computes the belief after each new view; see `mevs_jax.selection.loop`.

    Raises:
        ValueError: for tables without axis of objects or with several classifiers, for fewer than two classes, for a graph or a
            mask with another number of views, or `max_views` or `movement_cost` outside their ranges.
    """

    def __init__(
        self,
        tables: ViewTable,
        graph: ViewGraph,
        *,
        max_views: int,
        reachable: Bool[Array, " views"] | None = None,
        movement_cost: float | Float[Array, ""] = 0.0,
        normalised: bool = True,
        fuse: Fuse = sum_of_logits,
    ):
        if tables.logits.ndim != 3 or tables.label.ndim != 1:
            raise ValueError(
                "an environment needs view tables with logits (objects, views, classes) and labels (objects,), got shapes "
                f"{tables.logits.shape} and {tables.label.shape}"
            )
        objects, views, classes = tables.logits.shape
        if objects == 0 or classes < 2:
            raise ValueError(
                f"an environment needs an object and two classes, got {objects} objects and {classes} classes"
            )
        if graph.points.shape[0] != views:
            raise ValueError(f"the tables have {views} views, the graph has {graph.points.shape[0]}")
        if reachable is not None and reachable.shape != (views,):
            raise ValueError(f"`reachable` must have shape ({views},), got {reachable.shape}")
        max_views = whole(max_views, f"max_views must be between 1 and the {views} candidate views", 1, views)
        check(movement_cost, "movement_cost must be at least 0", lambda cost: (cost >= 0) & (cost < np.inf))
        self.tables, self.graph, self.reachable, self.movement_cost = tables, graph, reachable, movement_cost
        self.max_views, self.normalised, self.fuse = max_views, normalised, fuse

    @classmethod
    def from_run(cls, run: str | Path, split: str = "test", *, max_views: int = 5, **options: Any) -> ActiveRecognition:
        """The environment of the objects of a run's split, which its networks have seen from every view.

        Args:
            run: folder in which `mevs run` has been run.
            split: `val` or `test`. Policies learn on `val`, which the networks were not trained on, and are compared on `test`.
            max_views, options: as of the class.

        Raises:
            ValueError: for a folder that holds no finished run.
        """
        from mevs_jax.trained import load  # late, since an environment needs no networks

        path = Path(run) / "tables" / f"{split}.npz"
        if not path.is_file():
            raise ValueError(f"{run} has no view tables {path.name} of a run; make them with: mevs run --out {run}")
        with np.load(path) as stored:
            logits, label = jnp.asarray(stored["logits"]), jnp.asarray(stored["labels"])
            entropies = {name: jnp.asarray(stored[name]) for name in ("predicted_entropy", "entropy") if name in stored}
        tables = ViewTable(logits, entropies.get("predicted_entropy"), entropies.get("entropy"), label)
        return cls(tables, load(run).graph, max_views=max_views, **options)

    def tree_flatten(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """The arrays, and what is fixed when a program is compiled."""
        arrays = self.tables, self.graph, self.reachable, self.movement_cost
        return arrays, (self.max_views, self.normalised, self.fuse)

    @classmethod
    def tree_unflatten(cls, fixed: tuple[Any, ...], arrays: tuple[Any, ...]) -> ActiveRecognition:
        """The environment of these parts, which are not checked: JAX also passes placeholders."""
        environment = object.__new__(cls)
        environment.tables, environment.graph, environment.reachable, environment.movement_cost = arrays
        environment.max_views, environment.normalised, environment.fuse = fixed
        return environment

    @property
    def objects(self) -> int:
        """Number of objects."""
        return self.tables.logits.shape[0]

    @property
    def views(self) -> int:
        """Number of candidate views, the range of an action."""
        return self.tables.logits.shape[1]

    @property
    def classes(self) -> int:
        """Number of classes, the length of a prediction."""
        return self.tables.logits.shape[2]

    def reset(
        self,
        key: Array,
        object_index: int | Int[Array, ""] | None = None,
        start: int | Int[Array, ""] | None = None,
    ) -> tuple[EnvironmentState, EnvironmentObservation]:
        """Begins an episode and returns its state and the observation of the start view.

        Args:
            key: PRNG key, for what is drawn.
            object_index: index of the object; drawn uniformly if None.
            start: index of the start view; drawn uniformly if None.

        Raises:
            ValueError: for an index that is known and outside its range.
        """
        for name, given, size in (("object_index", object_index, self.objects), ("start", start, self.views)):
            if given is not None:
                check_indices(given, name, size)
        # Both indices from one call, because `step_autoreset` draws for every episode in every step, and `randint` is slower.
        sizes = jnp.array([self.objects, self.views])
        drawn = jnp.minimum((jax.random.uniform(key, (2,)) * sizes).astype(jnp.int32), sizes - 1)
        object_index = drawn[0] if object_index is None else object_index
        start = drawn[1] if start is None else start
        empty = EnvironmentState(
            object_index=jnp.asarray(object_index, jnp.int32),
            view=jnp.asarray(start, jnp.int32),
            steps=jnp.int32(0),
            count=jnp.int32(0),
            attempted=jnp.zeros(self.views, bool),
            views=jnp.full(self.max_views, -1, jnp.int32),
            belief=jnp.zeros(self.classes, self.tables.logits.dtype),
        )
        state = self._at(empty, empty.view)
        return state, self.observe(state)

    def step(
        self, key: Array, state: EnvironmentState, action: Mapping[str, Any]
    ) -> tuple[EnvironmentState, EnvironmentObservation, Float[Array, ""], Bool[Array, ""], dict[str, Any]]:
        """Scores the prediction, moves the camera and returns (state, observation, reward, done, info).

        A step of a finished episode scores its prediction, changes nothing and is done again.

        Args:
            key: PRNG key; not used, since only `reset` draws.
            state: of the episode.
            action: `{"action": index of the next view, "prediction": (classes,) logits}`.

        Raises:
            ValueError: for an action of another form, or a prediction that is known and not finite.

        Returns:
            The new state, the observation, the reward, whether the episode has ended, and
            `{"base_reward", "prediction": {"target", "loss", "metrics"}, "distance", "new_view"}`: the true class and the loss
            of the prediction as in `ap_gym` (`metrics` is empty), the distance travelled in radians, and whether the view was
            seen for the first time.
        """
        del key
        check_action(action, (), self.classes)
        check(action["action"], "an action is the index of a view", lambda view: view == np.floor(view))
        done = state.steps >= self.max_views
        target = jnp.clip(jnp.asarray(action["action"], jnp.int32), 0, self.views - 1)
        if self.reachable is not None:
            target = jnp.where(self.reachable[target], target, state.view)
        target = jnp.where(done, state.view, target)
        after = self._at(state, target)
        after = jax.tree.map(lambda old, new: jnp.where(done, old, new), state, after)
        distance = self.graph.distances[state.view, target]
        base_reward = 0.0 - self.movement_cost * distance  # not −0
        label = self.tables.label[state.object_index]
        loss = self.loss(jnp.asarray(action["prediction"]), label)
        info = {
            "base_reward": base_reward,
            "prediction": {"target": label, "loss": loss, "metrics": {}},
            "distance": distance,
            "new_view": after.count > state.count,
        }
        return after, self.observe(after), base_reward - loss, done, info

    def step_autoreset(
        self, key: Array, state: EnvironmentState, action: Mapping[str, Any]
    ) -> tuple[EnvironmentState, EnvironmentObservation, Float[Array, ""], Bool[Array, ""], dict[str, Any]]:
        """`step`, which begins another episode in the same step if the episode ends.

        The state and the observation are then those of the new episode; reward, `done` and `info` belong to the old one. Its last
        observation is not lost: it is that of the step before, as the last step does not move.

        Args:
            key: PRNG key for the new episode.
            state: as for `step`.
            action: as for `step`.
        """
        after, observation, reward, done, info = self.step(key, state, action)
        new = self.reset(key)
        after, observation = jax.tree.map(lambda begun, old: jnp.where(done, begun, old), new, (after, observation))
        return after, observation, reward, done, info

    def loss(self, prediction: Float[Array, " classes"], label: Int[Array, ""]) -> Float[Array, ""]:
        """Cross-entropy of the logits `prediction` with the true class, at least 0; see the class for its unit."""
        shifted = prediction - jnp.max(prediction)
        cross_entropy = jax.nn.logsumexp(shifted) - shifted[label]
        return cross_entropy / jnp.log(float(self.classes)) if self.normalised else cross_entropy

    def observe(self, state: EnvironmentState) -> EnvironmentObservation:
        """Returns what the agent sees in `state`."""
        latest = self._seen(state.object_index, state.view)
        return EnvironmentObservation(
            log_probabilities=jax.nn.log_softmax(latest.logits),
            belief=jax.nn.log_softmax(state.belief),
            view=state.view,
            direction=self.graph.points[state.view],
            attempted=state.attempted,
            steps=state.steps,
            reachable=self.reachable,
            predicted_entropy=latest.predicted_entropy,
            features=latest.features,
            cloud=latest.cloud,
        )

    def selection(self, state: EnvironmentState) -> SelectionState:
        """Returns `state` as the selection loop has it, so that a policy can act: `policy(key, selection, scene)`."""
        present = jnp.arange(self.max_views) < state.count
        seen = self._seen(state.object_index, jnp.maximum(state.views, 0))
        return SelectionState(
            count=state.count,
            view=state.view,
            attempted=state.attempted,
            belief=state.belief,
            latest=self._seen(state.object_index, state.view),
            views=state.views,
            seen=jax.tree.map(lambda leaf: jnp.where(present.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, 0), seen),
        )

    def scene(self, state: EnvironmentState, knowledge: Knowledge | None = None) -> Scene:
        """Returns the scene of the current object for a policy, with everything that an oracle uses."""
        table = jax.tree.map(lambda leaf: leaf[state.object_index], self.tables)
        return table.scene(self.graph, knowledge, self.reachable)

    def _at(self, state: EnvironmentState, view: Int[Array, ""]) -> EnvironmentState:
        """Returns the state after taking `view`."""
        here = jnp.arange(self.views) == view
        new = ~jnp.any(state.attempted & here)
        moved = replace(
            state,
            view=view,
            steps=state.steps + 1,
            count=state.count + new,
            attempted=state.attempted | here,
            views=jnp.where(new & (jnp.arange(self.max_views) == state.count), view, state.views),
        )
        belief = self.fuse(self.selection(moved), self.scene(moved))
        return replace(moved, belief=jnp.where(new, belief, state.belief))

    def _seen(self, object_index: Int[Array, ""], view: Int[Array, "*views"]) -> Observation:
        """Returns the networks' outputs at one view, or at several along a leading axis.

        Both indices are used at once, as taking the object's whole table first would copy it for every episode of a batch.
        """

        def at(leaf: Array | None) -> Array | None:
            return None if leaf is None else leaf[object_index, view]

        tables = self.tables
        return Observation(
            tables.logits[object_index, view],
            *map(at, (tables.predicted_entropy, tables.features, tables.clouds, tables.pose_evidence)),
        )
