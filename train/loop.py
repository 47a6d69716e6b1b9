"""The training loop: one function, read from top to bottom, for every network of this project.

A `Task` says what is particular: the network, its loss, its inputs. Everything else is here: batches, steps, validation by
object, early stopping, checkpoints, metrics. A run that was stopped, however rudely, goes on from its last epoch and ends
with the same weights, because a batch and a key depend on the seed and the step alone.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from tensorboardX import SummaryWriter

from data_pipeline.batches import ViewBatches, steps_per_epoch, train_batches, training_splits, validation_batches
from data_pipeline.builder import DatasetStatistics
from data_pipeline.files import read_json, write_json, write_text
from data_pipeline.meshes import DataError
from data_pipeline.progress import console, progress_bar
from train.checkpoints import Checkpoints
from train.pretrained import StartingWeights

Batch = dict[str, jax.Array]


@dataclass(frozen=True)
class OptimiserConfig:
    """How a network is trained; the thesis's values unless a preset says otherwise."""

    epochs: int = 50
    """at most this many"""
    patience: int = 5
    """epochs without a better validation loss before training stops"""
    batch_size: int = 16
    """views in a batch"""
    views_per_object: int = 4
    """views of one object in a batch: reading an object once for several views is what keeps a CPU fed"""
    epoch_views: int = 0
    """views of each training object in an epoch; 0 for all of them"""
    validation_views: int = 0
    """views of each validation object that are looked at after an epoch; 0 for all of them"""
    learning_rate: float = 1e-3
    """of Adam, at the start"""
    weight_decay: float = 0.0
    """decoupled (AdamW)"""
    schedule: Literal["constant", "cosine", "steps"] = "constant"
    """cosine: to zero over `epochs`; steps: ×0.7 every 20,000 samples, not below 1e-5 (thesis's PointNet++)"""
    validation_by: Literal["object", "view"] = "object"
    """what is put aside for validation: objects, or (the thesis's published code) a fifth of every object's views"""
    seed: int = 0
    """of initial weights, batches, augmentation and dropout"""


class Task(Protocol):
    """What one network adds to the loop."""

    @property
    def name(self) -> str: ...

    @property
    def optimiser(self) -> OptimiserConfig: ...

    @property
    def batches(self) -> ViewBatches: ...

    def network(self, rngs: nnx.Rngs) -> Any:
        """A new network."""

    def loss(
        self, network: Any, batch: Batch, key: jax.Array, samples: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Mean training loss and metrics of a batch, `samples` views into the training."""

    def evaluate(self, network: Any, batch: Batch) -> dict[str, jax.Array]:
        """Metrics of every view of a batch, each (views,), `loss` among them; no augmentation, no dropout."""


@flax.struct.dataclass
class TrainState:
    """All that a step changes."""

    step: jax.Array
    parameters: nnx.State
    statistics: nnx.State
    optimiser: optax.OptState


def learning_rate_schedule(config: OptimiserConfig, steps: int) -> Callable[[jax.Array], jax.Array]:
    """Learning rate by step."""
    if config.schedule == "cosine":
        return optax.warmup_cosine_decay_schedule(
            config.learning_rate / 20, config.learning_rate, max(1, min(200, steps // 10)), max(2, steps)
        )
    if config.schedule == "steps":
        return lambda step: jnp.maximum(config.learning_rate * 0.7 ** (step * config.batch_size // 20_000), 1e-5)
    return optax.constant_schedule(config.learning_rate)


def build_network(task: Task, start: StartingWeights | None = None) -> tuple[nnx.GraphDef, nnx.State, nnx.State]:
    """Structure, parameters and the rest (batch-norm statistics) of a new network."""
    network = task.network(nnx.Rngs(task.optimiser.seed))
    if start is not None:
        start.put(network)
    structure, parameters, *rest = nnx.split(network, nnx.Param, ...)
    return structure, parameters, rest[0]


def _make_steps(task: Task, structure: nnx.GraphDef, optimiser: optax.GradientTransformation):
    key = jax.random.key(task.optimiser.seed)

    @jax.jit
    def train_step(state: TrainState, batch: Batch) -> tuple[TrainState, dict[str, jax.Array]]:
        step_key = jax.random.fold_in(key, state.step)

        def loss_of(parameters: nnx.State):
            network = nnx.merge(structure, parameters, state.statistics, copy=True)
            loss, metrics = task.loss(network, batch, step_key, state.step * task.optimiser.batch_size)
            return loss, (metrics, nnx.state(network, nnx.Not(nnx.Param)))

        gradients, (metrics, statistics) = jax.grad(loss_of, has_aux=True)(state.parameters)
        updates, optimiser_state = optimiser.update(gradients, state.optimiser, state.parameters)
        parameters = optax.apply_updates(state.parameters, updates)
        return TrainState(state.step + 1, parameters, statistics, optimiser_state), metrics

    @jax.jit
    def evaluate_step(parameters: nnx.State, statistics: nnx.State, batch: Batch) -> dict[str, jax.Array]:
        return task.evaluate(nnx.merge(structure, parameters, statistics), batch)

    return train_step, evaluate_step


def validation_set(task: Task, data: Path) -> list[dict[str, np.ndarray]]:
    """The validation views in batches of one size."""
    chosen = list(validation_batches(data, task.batches, task.optimiser.validation_views))
    whole = {name: np.concatenate([batch[name] for batch in chosen]) for name in chosen[0]}
    size = min(256, len(whole["label"]))
    return [{name: array[i : i + size] for name, array in whole.items()} for i in range(0, len(whole["label"]), size)]


def validate(evaluate_step, state: TrainState, batches: list[dict[str, np.ndarray]]) -> dict[str, float]:
    """Mean of every metric over the validation views; a last, shorter batch is padded, not recompiled."""
    size = len(batches[0]["label"])
    collected: dict[str, list[np.ndarray]] = {}
    for batch in batches:
        count = len(batch["label"])
        padded = {name: np.resize(array, (size, *array.shape[1:])) for name, array in batch.items()}
        for name, values in evaluate_step(state.parameters, state.statistics, padded).items():
            collected.setdefault(name, []).append(np.asarray(values)[:count])
    return {name: float(np.concatenate(values).mean()) for name, values in collected.items()}


class MetricsLog:
    """Metrics as JSON lines and for TensorBoard; on resuming, what was logged after the checkpoint is taken back."""

    def __init__(self, folder: Path, step: int):
        self._path = folder / "metrics.jsonl"
        lines = self._path.read_text().splitlines() if self._path.exists() else []
        kept = [line for line in lines if line.endswith("}") and json.loads(line)["step"] <= step]
        write_text(self._path, "".join(line + "\n" for line in kept))
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def write(self, step: int, metrics: dict[str, float]) -> None:
        with self._path.open("a") as file:
            file.write(json.dumps({"step": step, **metrics}) + "\n")
        for name, value in metrics.items():
            self._board.add_scalar(name, value, step)

    def close(self) -> None:
        self._board.close()


def fit(
    task: Task, data: Path, statistics: DatasetStatistics, folder: Path, start: StartingWeights | None = None
) -> dict[str, Any]:
    """Trains `task` on the data set in `data`, into `folder`, from `start` or random weights; returns the run's summary.

    A finished run is returned as it is, an unfinished one goes on. Raises `DataError` where the folder holds a run of another
    configuration.
    """
    config = task.optimiser
    identity = json.loads(
        json.dumps({"task": asdict(task), "data": statistics.fingerprint, "start": start and start.name})  # type: ignore[call-overload]
    )
    if (folder / "config.json").exists() and read_json(folder / "config.json") != identity:
        raise DataError(
            f"{folder} holds a network trained with other settings; choose another --out, or delete that folder"
        )
    if (folder / "summary.json").exists():
        return read_json(folder / "summary.json")
    write_json(folder / "config.json", identity)

    objects = sum(sum(statistics.counts[split].values()) for split in training_splits(task.batches))
    # An epoch is a whole number of passes over the objects' views.
    epoch_steps = steps_per_epoch(
        objects * (config.epoch_views or statistics.views) // config.views_per_object, task.batches
    )
    total_steps = epoch_steps * config.epochs

    structure, parameters, rest = build_network(task, start)
    schedule = learning_rate_schedule(config, total_steps)
    optimiser = optax.adamw(schedule, weight_decay=config.weight_decay)
    state = TrainState(jnp.zeros((), jnp.int32), parameters, rest, optimiser.init(parameters))
    progress: dict[str, Any] = {"epoch": 0, "best_loss": None, "best_epoch": 0, "seconds": 0.0}

    checkpoints = Checkpoints(folder)
    if (saved := checkpoints.restore("latest", state)) is not None:
        state, progress = saved
        console.print(f"{task.name}: going on after epoch {progress['epoch']}")
    log = MetricsLog(folder, int(state.step))
    train_step, evaluate_step = _make_steps(task, structure, optimiser)
    validation = validation_set(task, data)
    batches = train_batches(data, task.batches, first_step=int(state.step))

    with progress_bar("views") as bar:
        line = bar.add_task(
            f"Training {task.name}",
            total=total_steps * config.batch_size,
            completed=int(state.step) * config.batch_size,
            note="",
        )
        while progress["epoch"] < config.epochs and progress["epoch"] - progress["best_epoch"] < config.patience:
            started = time.perf_counter()
            collected = []
            for _ in range(epoch_steps):
                state, metrics = train_step(state, next(batches))
                collected.append(metrics)  # stays on the device until the epoch ends
                bar.advance(line, config.batch_size)
            step = int(state.step)
            means = {name: float(jnp.mean(jnp.stack([m[name] for m in collected]))) for name in collected[0]}
            checked = validate(evaluate_step, state, validation)
            if not np.isfinite(means["loss"]):
                raise FloatingPointError(
                    f"{task.name}: the training loss is no longer finite at step {step}; lower the learning rate"
                )

            progress["epoch"] += 1
            progress["seconds"] += time.perf_counter() - started
            better = progress["best_loss"] is None or checked["loss"] < progress["best_loss"]
            if better:
                progress |= {"best_loss": checked["loss"], "best_epoch": progress["epoch"], "best": checked}
                checkpoints.save("best", step, state, progress)
            rates = {
                "epoch": progress["epoch"],
                "learning_rate": float(schedule(state.step)),
                "seconds": progress["seconds"],
            }
            log.write(
                step, rates | {f"train/{k}": v for k, v in means.items()} | {f"val/{k}": v for k, v in checked.items()}
            )
            # After the log: resuming takes back lines beyond the checkpoint, but cannot invent one that is missing.
            checkpoints.save("latest", step, state, progress)
            note = ", ".join(f"{name} {value:.4f}" for name, value in checked.items())
            bar.update(line, note=f"val {note}")
            console.print(
                f"{task.name} epoch {progress['epoch']}/{config.epochs}: train loss {means['loss']:.4f}, val {note}"
            )

    log.close()
    checkpoints.close()
    started_from = start.name if start else "random weights"
    summary = progress | {
        "steps": int(state.step),
        "start": started_from,
        "stopped_early": progress["epoch"] < config.epochs,
    }
    write_json(folder / "summary.json", summary)
    return summary


def load_best(task: Task, folder: Path) -> nnx.Module:
    """The network of the best epoch.

    Raises:
        DataError: where nothing was trained, or the network there has another shape than `task`'s.
    """
    if not (folder / "best").is_dir():
        raise DataError(f"no trained {task.name} in {folder}; train one with: mevs train")
    structure, parameters, rest = build_network(task)
    saved = read_json(folder / "config.json")["task"]
    wanted = json.loads(json.dumps(asdict(task)))  # type: ignore[call-overload]
    for name in ("views", "classes"):
        if name in saved and saved[name] != wanted[name]:
            raise DataError(
                f"the {task.name} in {folder} was trained for {saved[name]} {name}, the data set has {wanted[name]}; "
                f"train another in another --out, or evaluate it on its own data set"
            )
    if saved["network_config"] != wanted["network_config"]:
        raise DataError(
            f"the {task.name} in {folder} has other layers than asked for; use the settings it was trained with"
        )
    optimiser = optax.adamw(learning_rate_schedule(task.optimiser, 10))
    like = TrainState(jnp.zeros((), jnp.int32), parameters, rest, optimiser.init(parameters))
    checkpoints = Checkpoints(folder)
    restored = checkpoints.restore("best", like)
    checkpoints.close()
    if restored is None:
        raise DataError(f"no trained {task.name} in {folder}; train one with: mevs train")
    return nnx.merge(structure, restored[0].parameters, restored[0].statistics)
