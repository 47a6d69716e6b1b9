"""Settings of the learned study, and the refusal of those that cannot be run."""

from __future__ import annotations

from dataclasses import dataclass

from data_pipeline.errors import DataError
from train.choosing.policy import PolicyConfig
from train.choosing.q_learning import QLearningConfig
from train.choosing.variants import ABLATIONS
from train.tasks.recogniser import RecogniserConfig


@dataclass(frozen=True)
class LearnedConfig:
    """Settings of the learned study: learned fusion and learned choice of views."""

    recogniser: RecogniserConfig = RecogniserConfig()
    folds: int = 2
    """parts of the training objects, for the ablation that learns from each part by a recogniser trained without it"""
    fold_epochs: int = 0
    """training epochs of those recognisers; 0: as many as for the recogniser itself"""
    changed: int = 3
    """augmented copies of each object that a policy learns from, mirrored and stretched as in the recogniser's training"""
    policy: PolicyConfig = PolicyConfig()
    q_learning: QLearningConfig = QLearningConfig()
    """training of the policy that learns from walks alone, for comparison"""
    seeds: int = 1
    """number of complete trainings, each with other random weights"""
    seed: int = 0
    """seed of the first training; the others count up from it"""
    max_views: int = 8
    """views of a walk"""
    draws: int = 8
    """walks per object and start view, for policies that choose at random"""
    fitting_starts: int = 1
    """n: temperatures are fitted on walks from every n-th start view"""
    lattices: tuple[int, ...] = (10,)
    """further numbers of candidate views to test on, which are not trained on; of the same lattice, or of golden_angle if the
    run's viewpoints are from a file"""
    ablations: tuple[str, ...] = ()
    """variants of the policy to compare with, for the first seed: as_it_is, look_ahead, probability, random_states, unchanged,
    crossed, known, summed, cloud (needs PointNet++, trained by `mevs train`), q_learning"""
    novel: int = 0
    """number of class pairs that a policy is trained without and then tested on"""
    rotation_epochs: int = 0
    """epochs of further training of the recogniser on objects turned by any rotation, which are then tested too, for the first
    seed; 0: no such training and test"""


def check_learned(config: LearnedConfig, views: int) -> None:
    """Raises `DataError` if the study cannot be run with these settings and this number of candidate views."""
    if config.folds < 2 or config.seeds < 1:
        raise DataError("--learned.folds must be at least 2 and --learned.seeds at least 1")
    if config.changed < 0:
        raise DataError(f"--learned.changed must be at least 0, got {config.changed}")
    network, optimiser = config.recogniser.network, config.recogniser.optimiser
    if network.channels not in (4, 5) or network.standardise or optimiser.validation_by != "object":
        raise DataError(
            "the recogniser sees depth and normals, four channels that are not standardised, or five with what is unknown, and "
            "is validated by object; leave out --learned.recogniser.network.channels, .standardise and "
            "--learned.recogniser.optimiser.validation-by"
        )
    if config.recogniser.augmentation.turn:
        raise DataError(
            "--learned.recogniser.augmentation.turn is for objects in any rotation; leave it out and set "
            "--learned.rotation-epochs, which trains a recogniser for them after that for upright objects"
        )
    if config.recogniser.azimuths and not 4 <= config.recogniser.azimuths <= 360:
        raise DataError(
            f"--learned.recogniser.azimuths must be 0, for none, or 4 to 360, got {config.recogniser.azimuths}"
        )
    if {optimiser.seed, optimiser.data_seed, config.policy.seed, config.q_learning.seed} - {0, config.seed}:
        raise DataError("the seeds of a study are counted up from --learned.seed; leave out those of its networks")
    for name in config.ablations:
        if name not in ABLATIONS:
            raise DataError(f"unknown ablation {name!r} in --learned.ablations; choose from {', '.join(ABLATIONS)}")
    walks = [config.policy.most_seen, config.max_views]
    if "q_learning" in config.ablations:
        walks.append(config.q_learning.most_seen)
    most, batch = max(walks), config.recogniser.optimiser
    if not 2 <= most < views:
        raise DataError(
            f"walks of {most} views are not possible with {views} candidate views; set --learned.max-views, "
            f"--learned.policy.most-seen and --learned.q-learning.most-seen to at least 2 and less than {views}"
        )
    if not batch.validation_views or 256 % batch.validation_views or batch.validation_views > views:
        raise DataError(
            f"--learned.recogniser.optimiser.validation-views must divide 256 and be at most {views}, "
            f"got {batch.validation_views}"
        )
