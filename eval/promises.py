"""What a run promises beyond its metrics: live walks that are those on view tables, and what an agent with its system does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_pipeline.dataset.origin import objects_named
from data_pipeline.errors import DataError
from data_pipeline.files import write_json
from data_pipeline.objects.sources import load_object
from eval.checks.agent import AgentPromises, compare_walks, latency, recognised, stopping
from eval.runs import Run
from eval.system import USABLE
from eval.walks.knowledge import learn
from eval.walks.live import GIVEN, Agreement, Networks, compare_with_tables
from eval.walks.own_policies import checked, load_policies
from mevs_jax.policies.registry import policy_record
from mevs_jax.trained import load as load_system
from train.results.records import as_json


def live_agreement(run: Run) -> dict[str, Agreement]:
    """Compares walks with the networks in the loop with walks on view tables; writes `live.json`."""
    config = run.settings.live
    for policy in config.policies:
        try:
            record = policy_record(policy)
        except ValueError as error:
            raise DataError(str(error)) from error
        if not record.can_use(GIVEN):
            raise DataError(
                f"{policy} needs the tables of mevs study rendering, which live walks do not have; leave it out"
            )
    graph = run.statistics.graph
    own = checked(load_policies(run.settings.policies), graph, len(run.statistics.classes))
    validation = run.tables("val")
    found = compare_with_tables(
        run.data,
        "test",
        Networks(run.classify, run.classifier(), run.predict, run.predictor()),
        run.tables("test"),
        learn(validation.logits, validation.labels),
        graph,
        config=config,
        own=own,
    )
    write_json(run.out / "live.json", as_json(found))
    return found


def agent_promises(run: Run, system_folder: Path) -> AgentPromises:
    """Measures what an agent with the run's system promises, on test objects; writes `agent.json`."""
    dataset, config = run.settings.dataset, run.settings.agent
    if min(config.objects, config.shots, config.calls, config.max_views) < 1:
        raise DataError("--agent.objects, --agent.max-views, --agent.shots and --agent.calls must be at least 1")
    system, tables = load_system(system_folder), run.tables("test")
    chosen = np.unique(np.linspace(0, len(tables.names) - 1, config.objects).astype(int))
    entries = objects_named(dataset, [tables.names[index] for index in chosen])
    meshes = [(load_object(entry), int(tables.labels[index])) for entry, index in zip(entries, chosen, strict=True)]
    policies = [name for name in USABLE if name in system.policies]
    walks = compare_walks(system, run.data, config, policies)
    stops = {
        name: stopping(system, tables, name, config.max_views)
        for name in dict.fromkeys((system.description.best, "random"))
    }
    camera, times = recognised(system, meshes, config), latency(system, run.data, config.calls)
    found = AgentPromises(walks, stops, camera, times, config)
    write_json(run.out / "agent.json", as_json(found))
    return found
