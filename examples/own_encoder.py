"""An encoder of one's own, trained as the classifier: `python examples/own_encoder.py [RUN] [FOLDER]`.

Training needs a `Task`: a network, its inputs, its loss. Here it is the classifier's, with another network. RUN is a directory
with a data set (`mevs data`; default: runs/demo); the network is written to FOLDER (default: RUN/own_encoder).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
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

    def __init__(self, classes: int, rngs: nnx.Rngs):
        widths = (1, 16, 32, 64)
        self.convolutions = nnx.List(
            nnx.Conv(before, after, (3, 3), strides=2, rngs=rngs) for before, after in pairwise(widths)
        )
        self.head = nnx.Linear(widths[-1], classes, rngs=rngs)

    def __call__(self, images: jax.Array, train: bool = False) -> jax.Array:
        del train  # no dropout and no batch norm
        for convolution in self.convolutions:
            images = jax.nn.relu(convolution(images))
        return self.head(jnp.mean(images, axis=(1, 2)))


@dataclass(frozen=True)
class OwnTask(ClassifierTask):
    """The classifier's task with another network; `name` is part of what identifies the trained network."""

    name: str = "classifier with an encoder of one's own"

    def network(self, rngs: nnx.Rngs) -> Encoder:  # type: ignore[override]
        return Encoder(self.classes, rngs)


def main(run: Path, folder: Path) -> None:
    statistics = load_statistics(run / "data")
    kept = load_run(run)
    config = (SMALL if kept is None else kept.settings).classifier
    config = replace(config, network=replace(config.network, channels=1))
    summary = fit(OwnTask.of(config, len(statistics.classes), statistics.camera), run / "data", statistics, folder)
    print(f"best epoch {summary['best_epoch']}: validation accuracy {100 * summary['best']['accuracy']:.1f} %")


if __name__ == "__main__":
    run = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo")
    main(run, Path(sys.argv[2]) if len(sys.argv) > 2 else run / "own_encoder")
