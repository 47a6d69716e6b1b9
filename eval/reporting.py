"""The report of a run: what it is made from, and whether the page that is there is still of that."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from data_pipeline.dataset.statistics import SUMMARY
from data_pipeline.errors import DataError
from data_pipeline.files import check_of_file
from data_pipeline.progress import console
from eval.evaluation import identity_of_seeds, read_results
from eval.numbers.metrics import Metrics, OverTrainings
from eval.report.current import is_current
from eval.report.html import ReportInputs
from eval.run_file import plain
from eval.runs import Run
from mevs_jax.policies.registry import PolicyRecord
from train.results.identity import summary_of, why, why_other
from train.results.kept import record_in
from train.running.log import read_history

NETWORKS = {"classifier": "classifier", "entropy predictor": "entropy"}
"""Folders of the networks by how the report calls them."""


def write_run_report(run: Run, metrics: Metrics, own: Sequence[PolicyRecord], preset: str) -> Path:
    """Writes the report and returns its path; a page that is as it was written, from the same content, is kept.

    The learned study and the numbers over seeds are shown if they are there, and of the run as it is now.

    Args:
        own: policies of the user among the metrics.
    """
    out, settings = run.out, plain(run.settings)
    page, learned, over_seeds = out / "report" / "index.html", out / "learned" / "metrics.json", out / "seeds.json"
    of_study = _current(learned, f"mevs study learned --out {out}", partial(_why_other_study, run))
    of_seeds = None
    if run.settings.seeds > 1:
        now = identity_of_seeds(run, own)
        of_seeds = _current(over_seeds, f"mevs eval --out {out}", lambda was: why_other(was["identity"], now))
    folders = {name: out / folder for name, folder in NETWORKS.items()}
    of_networks = [folder / name for folder in folders.values() for name in ("summary.json", "metrics.jsonl")]
    tables = [out / "tables" / f"{split}.npz" for split in ("test", "val")]
    shown = [path for path, content in ((learned, of_study), (over_seeds, of_seeds)) if content is not None]
    made_of = (out / "metrics.json", *shown, run.data / SUMMARY, *tables, *of_networks)

    def described() -> list[Any]:
        return [preset, settings, *(path.is_file() and check_of_file(path) for path in made_of)]

    if is_current(page, described()):
        return page
    from eval.learned.page import active_section  # imported late: they need plots
    from eval.report.page import write_report

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
        seeds=None if of_seeds is None else record_in(OverTrainings, of_seeds, over_seeds),
    )
    write_report(inputs, page, described())  # the tables may have been made again
    return page


def _current(path: Path, command: str, why_stale: Callable[[dict[str, Any]], str | None]) -> dict[str, Any] | None:
    """The results in a file; None where there are none, or stale ones, of which a line says why and what renews them."""
    if not path.exists():
        return None
    content = read_results(path, command)
    try:
        reason = why_stale(content)
    except (DataError, OSError, KeyError, TypeError, AttributeError, IndexError) as error:
        reason = why(error)
    if reason is None:
        return content
    console.print(
        f"{path} is stale ({reason}), so the report leaves it out; make it again with: {command}", markup=False
    )
    return None


def _why_other_study(run: Run, metrics: dict[str, Any]) -> str | None:
    from eval.learned.measure import why_stale  # imported late, where there is a study
    from eval.learned.stage import seeds_of

    return why_stale(metrics, seeds_of(run.settings, run.out))
