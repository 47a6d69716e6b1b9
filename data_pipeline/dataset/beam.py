"""Creation of a data set with Apache Beam, for more objects than one machine can capture. The records are the same.

Captures are written to a folder that all workers share; shards are then written from there. Both steps are Beam pipelines, for
any runner. Install Beam with `pip install -e '.[beam]'`.
"""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from data_pipeline.capture.casting import rig_for
from data_pipeline.capture.settings import CaptureConfig
from data_pipeline.capture.workers import capture_entry, left_out_of, say_damaged, still_to_capture
from data_pipeline.dataset.shards import Part
from data_pipeline.errors import DataError
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
    damage = capture_entry(entry, _rig_for(config), folder, config.backend, skip_damaged)
    return [damage] if damage else []


def capture_by_beam(
    entries: Sequence[ObjectEntry], config: CaptureConfig, folder: Path, options: Any, *, skip_damaged: bool = False
) -> dict[str, str]:
    """Captures every object with Beam and returns the names of the objects left out, with the reasons.

    Like `capture.workers.capture_all`, but damage is reported only after all other objects are captured.

    Raises:
        DamagedMesh: if a mesh is damaged, unless `skip_damaged`.
    """
    import apache_beam as beam

    todo = still_to_capture(entries, folder)
    damage_file = folder.parent / "damaged"
    capture = functools.partial(_capture, config=config, folder=folder.absolute(), skip_damaged=skip_damaged)
    with beam.Pipeline(options=options) as pipeline:
        (
            pipeline
            | beam.Create(todo)
            | beam.Reshuffle()
            | "Capture" >> beam.FlatMap(capture)
            | beam.io.WriteToText(str(damage_file.absolute()), shard_name_template="")
        )
    damaged = damage_file.read_text().splitlines()
    damage_file.unlink()
    if damaged:
        raise say_damaged(min(damaged))
    return left_out_of(entries, folder)


def write_by_beam(parts: Sequence[Part], write: Callable[[Part], None], options: Any) -> None:
    """Writes every shard with Beam."""
    import apache_beam as beam

    with beam.Pipeline(options=options) as pipeline:
        _ = pipeline | beam.Create(list(parts)) | beam.Reshuffle() | "Write" >> beam.Map(write)
