"""Creation of a data set with Apache Beam, for more objects than one machine can capture. The records are the same.

Captures are written to a folder that all workers share; shards are then written from there. Both steps are Beam pipelines, for
any runner. The process that starts them holds no list of objects: workers list them and plan the shards. Install Beam with
`pip install -e '.[beam]'`.
"""

from __future__ import annotations

import functools
import operator
import pickle
import shlex
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from data_pipeline.capture.casting import rig_for
from data_pipeline.capture.settings import CaptureConfig
from data_pipeline.capture.workers import capture_entry, say_damaged, still_to_capture
from data_pipeline.dataset.shards import Part, largest_of, tally_of
from data_pipeline.dataset.statistics import Tally
from data_pipeline.errors import DataError
from data_pipeline.files import write_bytes, write_text
from data_pipeline.objects.mesh import ObjectEntry

_rig_for = functools.cache(rig_for)


def beam_options(options: str) -> Any:
    """Returns Beam's pipeline options from a string such as `--runner=FlinkRunner --flink_master=host:8081`."""
    try:
        from apache_beam.options.pipeline_options import PipelineOptions
    except ImportError as error:
        raise DataError("--beam needs Apache Beam; install it with: pip install -e '.[beam]'") from error
    return PipelineOptions(shlex.split(options))


def _capture(entry: ObjectEntry, config: CaptureConfig, folder: Path, skip_damaged: bool) -> list[str]:
    if not still_to_capture([entry], folder):
        return []
    damage = capture_entry(entry, _rig_for(config), folder, config.backend, skip_damaged)
    return [damage] if damage else []


def _or_refused(_: None, make: Callable[[], Iterable[Any]], refused: Path) -> Iterable[Any]:
    """Returns what a function makes. What it refuses is left in a file, since runners wrap errors of workers, each in its way."""
    try:
        return make()
    except DataError as error:
        write_text(refused, str(error))
        return []


@contextmanager
def _pipeline(options: Any, refused: Path) -> Iterator[Any]:
    """Runs a pipeline; raises what a worker refused."""
    import apache_beam as beam

    refused.unlink(missing_ok=True)
    with beam.Pipeline(options=options) as pipeline:
        yield pipeline | beam.Create([None])
    if refused.exists():
        reason = refused.read_text()
        refused.unlink()
        raise DataError(reason)


def capture_by_beam(
    entries: Callable[[], Iterable[ObjectEntry]],
    config: CaptureConfig,
    captures: Path,
    options: Any,
    skip_damaged: bool,
) -> None:
    """Captures every object. A worker lists them, so that the process that starts the pipeline holds none.

    Like `capture.workers.capture_all`, but damage is reported only after all other objects are captured.

    Raises:
        DamagedMesh: if a mesh is damaged, unless `skip_damaged`.
    """
    import apache_beam as beam

    damage_file, refused = captures.with_name("damaged"), captures.with_name("refused")
    capture = functools.partial(_capture, config=config, folder=captures, skip_damaged=skip_damaged)
    with _pipeline(options, refused) as begin:
        (
            begin
            | "List" >> beam.FlatMap(_or_refused, entries, refused)
            | beam.Reshuffle()
            | "Capture" >> beam.FlatMap(capture)
            | beam.io.WriteToText(str(damage_file), shard_name_template="")
        )
    damaged = damage_file.read_text().splitlines()
    damage_file.unlink()
    if damaged:
        raise say_damaged(min(damaged))


def write_by_beam(
    plan: Callable[[], Iterable[Part]],
    write: Callable[[Part], Part],
    classes: Callable[[], int],
    folder: Path,
    options: Any,
) -> Tally:
    """Writes every shard; returns what statistics need, combined by the pipeline from the indices of the shards.

    Args:
        plan: returns the shards; called by a worker.
        write: writes a shard; returns it without its objects.
        classes: returns the number of classes, once `plan` was called.
    """
    import apache_beam as beam

    refused, tally = folder / "refused", folder / "tally"
    with _pipeline(options, refused) as begin:
        parts = (
            begin | "Plan" >> beam.FlatMap(_or_refused, plan, refused) | beam.Reshuffle() | "Write" >> beam.Map(write)
        )
        largest = parts | "Largest" >> beam.Map(largest_of, folder) | "Maximum" >> beam.CombineGlobally(_largest)
        _ = (
            parts
            | "Tally" >> beam.Map(_tally, beam.pvalue.AsSingleton(largest), folder, classes)
            | "Sum" >> beam.CombineGlobally(_sum).without_defaults()
            | "Keep" >> beam.Map(lambda found: write_bytes(tally, pickle.dumps(found)))
        )
    found = pickle.loads(tally.read_bytes())
    tally.unlink()
    return found


def _largest(values: Iterable[float]) -> float:
    return max(values, default=0.0)


def _tally(part: Part, largest: float, folder: Path, classes: Callable[[], int]) -> Tally:
    return tally_of(part, largest, folder, classes())


def _sum(tallies: Iterable[Tally]) -> Tally:
    return functools.reduce(operator.add, tallies)
