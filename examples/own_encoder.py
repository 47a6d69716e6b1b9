"""A network of one's own, trained as the classifier: `python examples/own_encoder.py [RUN] [FOLDER]`.

The function `encoder` is all that `mevs run --encoder examples/own_encoder.py:encoder` needs. Here it is trained from Python: RUN
is a directory with a data set (`mevs data`; default: runs/demo); the network is written to FOLDER (default: RUN/own_encoder).
"""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
from flax import nnx

from data_pipeline.dataset.statistics import load_statistics
from eval.run_file import load_run
from eval.settings import SMALL
from train.loop import fit
from train.tasks.classifier import ClassifierTask


class Encoder(nnx.Module):
    """Three strided convolutions, and the mean over what is left of the image."""

    def __init__(self, classes: int, channels: int, rngs: nnx.Rngs):
        widths = (channels, 16, 32, 64)
        self.convolutions = nnx.List(
            nnx.Conv(before, after, (3, 3), strides=2, rngs=rngs) for before, after in pairwise(widths)
        )
        self.head = nnx.Linear(widths[-1], classes, rngs=rngs)

    def __call__(self, images: jax.Array, train: bool = False) -> jax.Array:
        del train  # no dropout and no batch norm
        for convolution in self.convolutions:
            images = jax.nn.relu(convolution(images))
        return self.head(jnp.mean(images, axis=(1, 2)))


def encoder(classes: int, channels: int, resolution: int, rngs: nnx.Rngs) -> Encoder:
    del resolution  # the mean makes it good for any
    return Encoder(classes, channels, rngs)


def main(run: Path, folder: Path) -> None:
    statistics, kept = load_statistics(run / "data"), load_run(run)
    config = (SMALL if kept is None else kept.settings).classifier
    config = replace(config, encoder=f"{__file__}:encoder")
    task = ClassifierTask.of(config, len(statistics.classes), statistics.camera)
    summary = fit(task, run / "data", statistics, folder)
    print(f"best epoch {summary['best_epoch']}: validation accuracy {100 * summary['best']['accuracy']:.1f} %")


if __name__ == "__main__":
    run = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo")
    main(run, Path(sys.argv[2]) if len(sys.argv) > 2 else run / "own_encoder")
