"""The report of a run: what it is made from, and whether the page that is there is still of that."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from data_pipeline.dataset.statistics import SUMMARY
from data_pipeline.files import check_of_file
from eval.evaluation import read_results
from eval.numbers.metrics import Metrics, OverTrainings
from eval.report.current import is_current
from eval.report.html import ReportInputs
from eval.runs import Run
from train.results.identity import summary_of
from train.results.kept import record_in
from train.running.log import read_history

NETWORKS = {"classifier": "classifier", "entropy predictor": "entropy"}
"""Folders of the networks by how the report calls them."""


def write_run_report(run: Run, metrics: Metrics, preset: str, settings: dict[str, Any]) -> Path:
    """Writes the report and returns its path; a page that is as it was written, from the same content, is kept.

    Args:
        settings: all of them, as `run.json` has them.
    """
    out = run.out
    page, learned, over_seeds = out / "report" / "index.html", out / "learned" / "metrics.json", out / "seeds.json"
    folders = {name: out / folder for name, folder in NETWORKS.items()}
    of_networks = [folder / name for folder in folders.values() for name in ("summary.json", "metrics.jsonl")]
    tables = [out / "tables" / f"{split}.npz" for split in ("test", "val")]
    made_of = (out / "metrics.json", learned, over_seeds, run.data / SUMMARY, *tables, *of_networks)

    def described() -> list[Any]:
        return [preset, settings, *(path.is_file() and check_of_file(path) for path in made_of)]

    if is_current(page, described()):
        return page
    from eval.learned.page import active_section  # imported late: they need plots
    from eval.report.page import write_report

    of_study = read_results(learned, f"mevs study learned --out {out}") if learned.exists() else None
    seeds = None
    if settings["seeds"] > 1 and over_seeds.exists():
        seeds = record_in(OverTrainings, read_results(over_seeds, f"mevs eval --out {out}"), over_seeds)
    inputs = ReportInputs(
        statistics=run.statistics,
        metrics=metrics,
        tables=run.tables("test"),
        validation=run.tables("val"),
        data=run.data,
        histories={name: read_history(folder) for name, folder in folders.items()},
        summaries={name: summary_of(folder) for name, folder in folders.items()},
        preset=preset,
        settings=settings,
        learned=None if of_study is None else active_section(of_study),
        seeds=seeds,
    )
    write_report(inputs, page, described())  # the tables may have been made again
    return page
