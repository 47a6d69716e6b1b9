"""The learned study as a stage of a run: trainings, measurements, page and trained system."""

from __future__ import annotations

from pathlib import Path

from data_pipeline.dataset.config import check_same_data
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.distributed import is_first
from data_pipeline.files import keep_json
from eval.learned.measure import APART, SPLITS, check_parts, entropy_tables, measure, novel_together, together
from eval.learned.system import make_learned_system
from eval.settings import Settings
from train.choosing.config import check_learned
from train.choosing.stages import Stages, train_recognisers, trained_policies
from train.results.finite import check_results
from train.results.records import as_json


def seeds_of(settings: Settings, out: Path) -> list[Stages]:
    """The stages of every seed of the study."""
    config = settings.learned
    numbers = range(config.seed, config.seed + config.seeds)
    return [Stages(config, settings.dataset, out, number, settings.entropy) for number in numbers]


def learn_to_choose(settings: Settings, out: Path) -> Path:
    """Trains and evaluates learned fusion and learned view selection; returns the path of the page."""
    config = settings.learned
    check_learned(config, settings.dataset.capture.views)
    check_same_data(settings.dataset, out / "data")
    for split in SPLITS:
        entropy_tables(out, split)  # so that stale ones are refused before anything is trained
    seeds = seeds_of(settings, out)
    seeds[0].prepare()
    check_parts(seeds[0].statistics)
    train_recognisers(seeds)
    trained_policies([stages.policy_job() for stages in seeds])
    for part in range(APART):
        trained_policies([stages.policy_job(aside=(part, APART)) for stages in seeds])
    found = [measure(stages) for stages in seeds]
    metrics = {"seeds": found, "together": together(seeds, found), "settings": config}
    if (novel := novel_together(seeds)) is not None:
        metrics["novel"] = novel
    metrics = check_results(as_json(metrics), "the metrics of the learned study")
    page = out / "learned" / "index.html"
    if is_first():
        from eval.learned.page import write_learned_page  # imported late: it needs plots

        keep_json(out / "learned" / "metrics.json", metrics)
        write_learned_page(metrics, load_statistics(out / "data"), page)
    make_learned_system(seeds[0], found[0])
    return page
