"""The same data set by Apache Beam, for more objects than one machine can capture: any runner, the same records.

Captures go to a folder that all workers see, as they do on one machine; then TFDS reads them from there and writes its shards.
Both steps are Beam pipelines. Install it with `pip install mevs-jax[beam]`.
"""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from data_pipeline.capture.casting import CaptureConfig, rig_for
from data_pipeline.capture.workers import capture_entry, left_out_of, say_damaged, still_to_capture
from data_pipeline.errors import DataError
from data_pipeline.objects.mesh import ObjectEntry

_rig_for = functools.cache(rig_for)


def beam_options(options: str) -> Any:
    """Beam's pipeline options, from a string such as `--runner=FlinkRunner --flink_master=host:8081`.

    Raises:
        DataError: where Beam is not installed.
    """
    try:
        from apache_beam.options.pipeline_options import PipelineOptions
    except ImportError as error:
        raise DataError("--beam needs Apache Beam; install it with: pip install mevs-jax[beam]") from error
    return PipelineOptions(shlex.split(options))


def _capture(entry: ObjectEntry, config: CaptureConfig, folder: Path, skip_damaged: bool) -> list[str]:
    damage = capture_entry(entry, _rig_for(config), folder, config.backend, skip_damaged)
    return [damage] if damage else []


def capture_by_beam(
    entries: Sequence[ObjectEntry], config: CaptureConfig, folder: Path, options: Any, *, skip_damaged: bool = False
) -> dict[str, str]:
    """`captures.capture_all`, by Beam; damaged objects are told after all others are captured."""
    import apache_beam as beam

    todo = still_to_capture(entries, folder)
    damages = folder.parent / "damaged"
    capture = functools.partial(_capture, config=config, folder=folder.absolute(), skip_damaged=skip_damaged)
    with beam.Pipeline(options=options) as pipeline:
        (
            pipeline
            | beam.Create(todo)
            | beam.Reshuffle()
            | "Capture" >> beam.FlatMap(capture)
            | beam.io.WriteToText(str(damages.absolute()), shard_name_template="")
        )
    damaged = damages.read_text().splitlines()
    damages.unlink()
    if damaged:
        raise say_damaged(min(damaged))
    return left_out_of(entries, folder)


def examples_by_beam(entries: Sequence[ObjectEntry], example_of: Callable[[ObjectEntry], Any]) -> Any:
    """The (key, example) pairs of a split as a Beam transform, as TFDS takes them."""
    import apache_beam as beam

    return beam.Create(list(entries)) | beam.Reshuffle() | beam.Map(example_of)
