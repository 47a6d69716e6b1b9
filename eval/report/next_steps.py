"""The end of the report: what to do next with this run, by commands that fit it."""

from __future__ import annotations

from eval.report.html import ReportInputs, commands
from mevs_jax.models.shapes import ENCODERS
from train.results.chance import Chance

RUN = "RUN"
"""Stands for the folder of the run: the page is the same wherever the run is."""


def next_section(inputs: ReportInputs) -> str:
    """Commands that continue this run, each with what it gives; those that were run already are left out."""
    return (
        f"<h2>What to do next</h2><p><code>{RUN}</code> stands for the folder of this run, in which "
        "<code>report/index.html</code> is this page. Each command continues from what the run holds.</p>"
        f"{commands(_steps(inputs))}"
    )


def _steps(inputs: ReportInputs) -> list[tuple[str, str]]:
    """Sentences and commands, the most useful first."""
    metrics, steps = inputs.metrics, []
    chance = Chance.of(metrics.single_view.accuracy, inputs.statistics, ["test"])
    if chance.warning("classifier", "test") is not None:
        steps.append(
            (
                "The classifier is hardly better than chance, so no policy can help much. Train it longer, or with more "
                "objects:",
                f"mevs run --preset {inputs.preset} --data {inputs.settings['dataset']['source']} "
                f"--classifier.optimiser.epochs {4 * inputs.settings['classifier']['optimiser']['epochs']} --out OTHER",
            )
        )
    if inputs.settings["classifier"]["encoder"] in ("", *ENCODERS):
        steps += [
            (
                "Recognise a mesh of your own with the networks of this run, and look at the walk in a browser:",
                f"mevs look --system {RUN} --mesh FILE --view",
            ),
            ("Put the trained system into a folder of its own, for a robot:", f"mevs export --out {RUN} --to FOLDER"),
        ]
    if inputs.learned is None:
        steps.append(
            (
                "Train the fusion of views and the policy themselves, which this run only computes from tables:",
                f"mevs study learned --out {RUN}",
            )
        )
    if inputs.seeds is None:
        steps.append(
            (
                "The intervals above are for these networks alone. To know whether the results hold for other trainings:",
                f"mevs run --out {RUN} --seeds 3",
            )
        )
    if any(row.difference is None for row in metrics.compatibility.rows.values()):
        steps.append(
            ("Compare with all changes of the thesis's published code:", f"mevs study published-code --out {RUN}")
        )
    if metrics.ascents is None:
        steps.append(
            ("Compare with the thesis's two methods by differentiable rendering:", f"mevs study rendering --out {RUN}")
        )
    steps.append(
        (
            "Compare a policy of your own, a function in a Python file:",
            f"mevs eval --out {RUN} --policy my_policy.py:scores",
        )
    )
    return steps
