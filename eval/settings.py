"""All settings, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, replace

from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.dataset.augment import CloudAugmentation, ViewAugmentation
from data_pipeline.dataset.builder import DataConfig
from eval.config import AgentConfig, AscentConfig, RenderingConfig
from eval.walks.grid import GridConfig
from eval.walks.live import LiveConfig
from mevs_jax.models import Abstraction
from train.choosing.config import LearnedConfig
from train.choosing.policy import PolicyConfig
from train.choosing.variants import ABLATIONS
from train.many.sweep import SweepConfig
from train.many.thesis import ThesisConfig
from train.optimiser import OptimiserConfig
from train.tasks.classifier import ClassifierConfig, ResNetConfig
from train.tasks.entropy import EntropyConfig, PointNet2Config
from train.tasks.recogniser import RecogniserConfig
from train.tasks.set_fusion import SetFusionConfig


@dataclass(frozen=True)
class Settings:
    """All settings; the defaults are those of the thesis."""

    dataset: DataConfig = DataConfig()
    classifier: ClassifierConfig = ClassifierConfig()
    entropy: EntropyConfig = EntropyConfig()
    evaluation: GridConfig = GridConfig()
    live: LiveConfig = LiveConfig()
    agent: AgentConfig = AgentConfig()
    thesis: ThesisConfig = ThesisConfig()
    sweep: SweepConfig = SweepConfig()
    ascent: AscentConfig = AscentConfig()
    rendering: RenderingConfig = RenderingConfig()
    learned: LearnedConfig = LearnedConfig()
    policies: tuple[str, ...] = ()
    """further policies to evaluate, as module:function or path/to/file.py:function (`--policy`)"""
    seeds: int = 1
    """number of trainings of the run's networks, from other seeds (`--seeds`)"""


THESIS = Settings()
"""The sizes of the thesis: 224×224, 40 views, ResNet-18 on depth, PointNet++ on 4,096 points. It needs an accelerator: two CPU
cores train PointNet++ of this size on 7 clouds per second, which is five hours for one epoch of ModelNet10.
`mevs run --preset thesis --data ModelNet10.zip`"""


_BRIEF = OptimiserConfig(
    epochs=8, batch_size=64, epoch_views=8, epoch_steps=30, validation_views=4, weight_decay=0.02, schedule="cosine"
)


SMALL = Settings(
    dataset=DataConfig(capture=CaptureConfig(resolution=64)),
    classifier=ClassifierConfig(
        network=ResNetConfig(width=32, channels=1, standardise=False),
        optimiser=_BRIEF,
    ),
    entropy=EntropyConfig(
        network=PointNet2Config(
            points=1024,
            abstractions=(
                Abstraction(centres=128, radius=0.25, samples=16, layers=(32, 32, 64)),
                Abstraction(centres=32, radius=0.5, samples=16, layers=(64, 64, 128)),
            ),
            dropout=0.0,
        ),
        augmentation=CloudAugmentation(scale=False, tilt=False, translate=False, jitter=False, drop=False),
        optimiser=OptimiserConfig(
            epochs=8,
            batch_size=32,
            views_per_object=2,
            epoch_views=4,
            epoch_steps=30,
            validation_views=2,
            learning_rate=2e-3,
            schedule="cosine",
        ),
    ),
    thesis=ThesisConfig(
        resnet18=replace(_BRIEF, epochs=7, views_per_object=1, learning_rate=2e-3),
        resnet34=replace(_BRIEF, epochs=9, views_per_object=2, learning_rate=2e-3),
        fine_tuning=replace(_BRIEF, epochs=4, views_per_object=2),
        resnet34_width=32,
    ),
    learned=LearnedConfig(
        recogniser=RecogniserConfig(
            network=ResNetConfig(width=32, channels=4, standardise=False, stem="patches"),
            augmentation=ViewAugmentation(stretch=0.15),
            balanced=True,
            optimiser=OptimiserConfig(
                method="muon",
                epochs=6,
                batch_size=256,
                views_per_object=8,
                epoch_views=40,
                validation_views=8,
                learning_rate=5e-3,
                weight_decay=0.05,
                schedule="cosine",
            ),
        ),
        fold_epochs=4,
        draws=2,
        fitting_starts=4,
        ablations=ABLATIONS,
        novel=5,
        rotation_epochs=10,
    ),
)
"""The thesis's study at 64×64 with narrower networks.
`mevs run --data modelnet10_voxels32.npz`: 12 minutes on two cores of an AMD EPYC (Zen 5), `mevs study thesis` 40."""


DEMO = replace(
    SMALL,
    classifier=ClassifierConfig(
        network=ResNetConfig(depth=10, width=32, channels=1, standardise=False, stem="patches"),
        optimiser=replace(_BRIEF, method="muon", epochs=7, learning_rate=5e-3, weight_decay=0.05),
    ),
    entropy=replace(
        SMALL.entropy,
        network=replace(SMALL.entropy.network, points=512, global_layers=(128, 256, 512), head_layers=(256,)),
        optimiser=replace(SMALL.entropy.optimiser, method="muon", epochs=4, learning_rate=3e-3),
    ),
)
"""`small` with networks that compile and train in half the time, for `make demo`."""


BEST = replace(
    SMALL,
    dataset=replace(SMALL.dataset, capture=CaptureConfig(resolution=128)),
    learned=replace(
        SMALL.learned,
        recogniser=replace(
            SMALL.learned.recogniser,
            network=ResNetConfig(channels=4, standardise=False),
            optimiser=replace(SMALL.learned.recogniser.optimiser, epochs=12, batch_size=512),
        ),
        folds=4,
        fold_epochs=0,
        seeds=3,
        lattices=(10, 60),
    ),
)
"""Settings of `mevs study learned` for an accelerator: views of 128×128, a ResNet-18 as wide as in its paper, four folds, three
seeds. This preset has been run for some steps, never to the end."""


_TINY_FUSION = SetFusionConfig(width=16, heads=2, blocks=1)


_TINY_OPTIMISER = OptimiserConfig(epochs=2, batch_size=16, views_per_object=2, epoch_views=4, schedule="cosine")


TINY = Settings(
    dataset=DataConfig(train_per_class=4, test_per_class=1, capture=CaptureConfig(views=6, resolution=32)),
    classifier=ClassifierConfig(
        network=ResNetConfig(depth=10, width=8, channels=1, standardise=False),
        optimiser=_TINY_OPTIMISER,
    ),
    entropy=EntropyConfig(
        network=PointNet2Config(
            points=64,
            abstractions=(
                Abstraction(centres=16, radius=0.4, samples=8, layers=(8, 16)),
                Abstraction(centres=8, radius=0.8, samples=8, layers=(16, 32)),
            ),
            global_layers=(32, 64),
            head_layers=(32,),
        ),
        optimiser=_TINY_OPTIMISER,
    ),
    evaluation=GridConfig(draws=2),
    live=LiveConfig(objects=10, at_once=8, max_views=4),
    agent=AgentConfig(objects=3, max_views=4, shots=2, distances=(2.0,), calls=10),
    thesis=ThesisConfig(
        _TINY_OPTIMISER,
        _TINY_OPTIMISER,
        _TINY_OPTIMISER,
        resnet34_width=8,
        timing_runs=3,
        ascent_runs=1,
        ascent_starts=2,
        ascent_resolution=16,
    ),
    learned=LearnedConfig(
        recogniser=RecogniserConfig(
            network=ResNetConfig(depth=10, width=8, channels=4, standardise=False, stem="patches"),
            fusion=_TINY_FUSION,
            optimiser=replace(_TINY_OPTIMISER, validation_views=2),
        ),
        policy=PolicyConfig(width=16, heads=2, blocks=1, most_seen=3, walks=1, rounds=1, epochs=2, batch_size=32),
        changed=1,
        max_views=4,
        draws=2,
        lattices=(),
        ablations=("look_ahead", "crossed", "summed", "cloud"),
        novel=1,
        rotation_epochs=1,
    ),
    rendering=RenderingConfig(objects=1, starts=2, resolution=16, faces=64),
)
"""Runs in a few minutes. It only checks that everything works."""


PRESETS = {"demo": DEMO, "small": SMALL, "best": BEST, "thesis": THESIS, "tiny": TINY}
