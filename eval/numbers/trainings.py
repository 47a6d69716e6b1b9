"""Numbers over several trainings: means with intervals over objects, and over objects and trainings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.errors import DataError
from eval.numbers.comparison import interval_of, interval_of_both
from eval.numbers.metrics import TrainingsRow
from eval.numbers.policies import EvaluationInputs
from eval.numbers.study import BASELINE, Setting
from eval.walks.grid import Results
from eval.walks.ladder import ladder
from eval.walks.own_policies import checked
from mevs_jax.policies.registry import PolicyRecord
from train.results.records import csv_of, ends, numbered


def walks_of_all(
    inputs: Sequence[EvaluationInputs], own: Sequence[PolicyRecord] = ()
) -> tuple[tuple[PolicyRecord, ...], dict[str, Results]]:
    """The grid of all trainings as one program: trainings × objects × start views × draws × policies × thresholds.

    Args:
        inputs: of each training, on the same objects.
        own: further policies.

    Returns:
        The policies, and their results with a leading axis of trainings.

    Raises:
        DataError: if the trainings were evaluated on different objects.
    """
    first = inputs[0]
    for other in inputs[1:]:
        if other.tables.names != first.tables.names:
            raise DataError("the trainings were evaluated on different objects; evaluate them again: mevs eval")
    settings = [Setting.of(one.graph, one.validation, one.config) for one in inputs]
    knowledge = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(setting.knowledge for setting in settings))
    logits, entropies = (
        jnp.stack([jnp.asarray(getattr(one.tables, name)) for one in inputs], axis=1)
        for name in ("logits", "predicted_entropy")
    )
    table = replace(first.tables.stacked(), logits=logits, predicted_entropy=entropies)
    policies = ladder(checked(own, first.graph, logits.shape[-1]))
    return policies, replace(settings[0], knowledge=knowledge).with_random(table, policies)[0]


def rows_over_trainings(policies: Sequence[PolicyRecord], results: Mapping[str, Results]) -> tuple[TrainingsRow, ...]:
    """A row for each policy and number of views: accuracy and difference from random, with both kinds of interval."""
    after = {name: np.moveaxis(np.asarray(result.after, float), -1, 0) for name, result in results.items()}
    rows = []
    for policy in policies:
        found, gain = after[policy.name], after[policy.name] - after[BASELINE]
        columns = {
            "accuracy": found.mean(axis=(-2, -1)),
            "over_objects": interval_of(found.mean(axis=-2)),
            "over_both": interval_of_both(found),
            "difference": gain.mean(axis=(-2, -1)),
            "difference_over_objects": interval_of(gain.mean(axis=-2)),
            "difference_over_both": interval_of_both(gain),
            "each": found.mean(axis=-1),
            "difference_each": gain.mean(axis=-1),
        }
        for step in range(len(found)):
            numbers: dict[str, Any] = {name: column[step] for name, column in columns.items()}
            numbers |= {name: float(numbers[name]) for name in ("accuracy", "difference")}
            rows.append(TrainingsRow(policy.name, policy.title, policy.knows, step + 1, **numbers))
    return tuple(rows)


def csv_over_trainings(rows: Sequence[TrainingsRow]) -> bytes:
    """The rows as CSV, with a column for each end of an interval and for each training."""
    return csv_of(
        [
            {"policy": row.policy, "title": row.title.lstrip("— "), "knows": row.knows, "views": row.views}
            | {"accuracy": row.accuracy}
            | ends("over_objects", row.over_objects)
            | ends("over_both", row.over_both)
            | {"difference": row.difference}
            | ends("difference_over_objects", row.difference_over_objects)
            | ends("difference_over_both", row.difference_over_both)
            | numbered("accuracy_training", row.each)
            | numbered("difference_training", row.difference_each)
            for row in rows
        ]
    )
