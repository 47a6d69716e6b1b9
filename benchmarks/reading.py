"""How fast views are read: by threads or processes, and in other forms of records. The tables of reading in docs/scaling.md.

`python -m benchmarks.reading FOLDER` makes a small data set of 40 views of 224×224 pixels in FOLDER. It prints views a second,
also of CPU time. That is of this process and of those that read, without their start: the difference between a longer and a
shorter stream.
"""

from __future__ import annotations

import io
import resource
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from data_pipeline.capture.settings import CaptureConfig
from data_pipeline.dataset.batches import ViewBatches, train_batches
from data_pipeline.dataset.builder import DataConfig, open_split, prepare

VIEWS, SIDE = 40, 224
DATA = DataConfig(train_per_class=6, test_per_class=1, capture=CaptureConfig(views=VIEWS, resolution=SIDE))
SHORT, LONG = 20, 100
"""Batches of a stream."""


def cpu() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def cost_of_stream(folder: Path, config: ViewBatches, batches: int) -> tuple[float, float]:
    """Seconds, from the first batch on, and seconds of CPU time of a stream of so many batches."""
    begun_cpu = cpu()
    stream = train_batches(folder, config)
    next(stream)
    begun = time.perf_counter()
    for _ in range(batches):
        next(stream)
    seconds = time.perf_counter() - begun
    stream.close()  # type: ignore[attr-defined]  # ends the processes, whose CPU time counts from then on
    return seconds, cpu() - begun_cpu


def rates(folder: Path) -> None:
    for views_per_object in (4, VIEWS):
        for workers in (0, 1, 2):
            config = ViewBatches(80, views_per_object, images="depth", workers=workers)
            short, long = (cost_of_stream(folder, config, count) for count in (SHORT, LONG))
            wall, used = ((LONG - SHORT) * 80 / (b - a) for a, b in zip(short, long, strict=True))
            how = f"{workers} processes" if workers else "threads"
            print(
                f"{views_per_object} of {VIEWS} views of a record, {how}: {wall:,.0f} views/s, {used:,.0f} a CPU second"
            )


def seconds_of(work: Callable[[], object]) -> float:
    """CPU seconds of the fastest of five calls."""
    times = []
    for _ in range(5):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)


def encoded(view: np.ndarray, form: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(view).save(buffer, form, **({"quality": 95} if form == "JPEG" else {}))
    return buffer.getvalue()


def read(source: Any, objects: int) -> None:
    for index in range(objects):
        source[index]


def decode(files: list[bytes]) -> None:
    for one in files:
        np.asarray(Image.open(io.BytesIO(one)))


def forms(folder: Path) -> None:
    """Bytes of a view, and views that a core decodes in a second, of depth (16 bits) and shaded images (8 bits)."""
    for key in ("depth", "image"):
        source = open_split(folder, "train", ("entropy", key))
        views = [view for index in range(8) for view in source[index][key]]
        used = seconds_of(partial(read, source, 8))
        print(f"{key}, record of all views (raw, zstd): {len(views) / used:,.0f} views/s")
        for form in ("PNG", "JPEG") if key == "image" else ("PNG",):
            files = [encoded(view, form) for view in views]
            used, mean = seconds_of(partial(decode, files)), sum(map(len, files)) / len(files)
            print(f"{key}, {form}: {mean:,.0f} bytes a view, {len(views) / used:,.0f} views/s")
    shards = [*folder.glob("shards/*/*/*.array_record*")]
    objects = sum(len(open_split(folder, split)) for split in ("train", "val", "test"))
    size = sum(path.stat().st_size for path in shards) / objects / VIEWS
    print(f"depth and image, record of all views (raw, zstd): {size:,.0f} bytes a view")


def main() -> None:
    folder = Path(sys.argv[1])
    prepare(DATA, folder)
    forms(folder)
    rates(folder)


if __name__ == "__main__":
    main()
