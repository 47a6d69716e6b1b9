"""The report's section on confidence: calibration, and stopping by calibrated risk."""

from __future__ import annotations

import html
from collections.abc import Sequence

from eval.numbers.confidence import READINGS
from eval.numbers.metrics import Reading, Stop
from eval.report import figures
from eval.report.html import ReportInputs, image, percent, table
from eval.report.policies import steps_of

POLICY = "information_gain"
"""Whose walks the section is about."""


def confidence_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    readings, steps = metrics.confidence[POLICY].readings, steps_of(metrics, (1, 2, 4, 9))
    errors = " ".join(
        f"{READINGS[name]}: {100 * reading.ece[0]:.1f} % after one view, {100 * reading.ece[-1]:.1f} % at the end."
        for name, reading in readings.items()
    )
    return (
        f"<h2>Confidence and calibration</h2><p>Walks by {html.escape(metrics.titles[POLICY])}. The <dfn>confidence</dfn> is the "
        "probability of the most likely class, by the softmax of the fused logits. It is <dfn>calibrated</dfn> if predictions "
        "with a confidence of 80 %, say, are right in 80 % of the cases. Adding logits treats the views of one object as "
        "independent, so confidence exceeds accuracy. A <dfn>temperature</dfn> for each number of views, a number by which "
        "the logits are divided, fitted on validation walks, corrects this and changes no prediction; only the mean of "
        "probabilities can change one.</p>"
        + image(
            figures.calibration_by_views(readings, READINGS),
            "Expected calibration error (ECE): the mean distance between confidence and accuracy over 15 bins of confidence; "
            "test objects. Temperatures and exponent are fitted on validation objects.",
            f"Curves of calibration error by number of views. {errors}",
        )
        + _calibration(readings, steps)
        + "<p class='note'>After the given number of views: ECE and accuracy in %; negative log-likelihood (NLL) in nats, the "
        "mean of −log of the probability given to the true class. Lower is better for both.</p>"
        + image(
            figures.reliability_curves(readings, READINGS, steps),
            "On the dotted diagonal, confidence equals accuracy; below it, the answers are less often right than they claim. "
            "Larger markers hold more of the predictions.",
            f"Accuracy against confidence after {', '.join(map(str, steps))} views: of the sum of logits (discs, solid lines) "
            "and with a temperature per number of views (hollow squares, dotted lines), each beside the diagonal.",
        )
        + "<p>Stopping as soon as the <dfn>risk</dfn>, 1 − confidence, is at most the requested risk. Columns except views in "
        "%; <b>▲ bold</b>: the error exceeds the requested risk by its 95 % interval.</p>"
        + _stopping(readings["sum_of_logits"].stopping or (), readings["temperature"].stopping or ())
    )


def _calibration(readings: dict[str, Reading], steps: Sequence[int]) -> str:
    rows = [
        [
            html.escape(READINGS[name]),
            *(f"{100 * reading.ece[step - 1]:.1f}" for step in steps),
            *(f"{reading.nll[step - 1]:.2f}" for step in steps),
            percent(reading.accuracy[steps[-1] - 1]),
        ]
        for name, reading in readings.items()
    ]
    columns = *(f"ECE, {s}" for s in steps), *(f"NLL, {s}" for s in steps), f"accuracy, {steps[-1]}"
    return table(["confidence from", *columns], rows)


def _stopping(summed: Sequence[Stop], calibrated: Sequence[Stop]) -> str:
    def cells(stop: Stop) -> list[str]:
        error = "–" if stop.error is None else f"{100 * stop.error:.1f}"
        shown = f"<b class='up'>▲ {error}</b>" if stop.excess[0] > 0 else error
        return [shown, f"{100 * stop.sure:.0f}", f"{stop.views:.2f}", percent(stop.accuracy)]

    parts = ("error when confident", "confident", "views", "accuracy")
    header = ["requested risk", *(f"{part}, {kind}" for kind in ("summed", "calibrated") for part in parts)]
    pairs = zip(summed, calibrated, strict=True)
    return table(header, [[f"{100 * one.risk:g}", *cells(one), *cells(other)] for one, other in pairs])
