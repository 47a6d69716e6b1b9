"""The report's section on confidence: calibration, and stopping by calibrated risk."""

from __future__ import annotations

import html

from eval.numbers.confidence import READINGS
from eval.report import figures
from eval.report.html import ReportInputs, image, percent, table
from eval.report.policies import steps_of, titles_of


def confidence_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    titles = titles_of(metrics)
    name = "information_gain"
    readings = metrics["confidence"][name]["readings"]
    steps = steps_of(metrics, (1, 2, 4, 9))
    rows = [
        [
            html.escape(READINGS[reading]),
            *(f"{100 * values['ece'][step - 1]:.1f}" for step in steps),
            *(f"{values['nll'][step - 1]:.2f}" for step in steps),
            percent(values["accuracy"][steps[-1] - 1]),
        ]
        for reading, values in readings.items()
    ]
    header = ["confidence from", *(f"ECE, {s}" for s in steps), *(f"NLL, {s}" for s in steps), f"accuracy, {steps[-1]}"]
    stops = []
    for plain, calibrated in zip(
        readings["sum_of_logits"]["stopping"], readings["temperature"]["stopping"], strict=True
    ):
        row = [f"{100 * plain['risk']:g}"]
        for cell in (plain, calibrated):
            exceeded = cell["excess"][0] > 0
            error = "–" if cell["error"] is None else f"{100 * cell['error']:.1f}"
            row += [
                f"<b class='up'>▲ {error}</b>" if exceeded else error,
                f"{100 * cell['sure']:.0f}",
                f"{cell['views']:.2f}",
                percent(cell["accuracy"]),
            ]
        stops.append(row)
    parts = ("error when confident", "confident", "views", "accuracy")
    return (
        f"<h2>Confidence and calibration</h2><p>Walks by {html.escape(titles[name])}. The <dfn>confidence</dfn> is the "
        "probability of the most likely class, by the softmax of the fused logits. It is <dfn>calibrated</dfn> if predictions "
        "with a confidence of 80 %, say, are right in 80 % of the cases. Adding logits treats the views of one object as "
        "independent, so confidence exceeds accuracy. A <dfn>temperature</dfn> for each number of views, a number by which "
        "the logits are divided, fitted on validation walks, corrects this and changes no prediction; only the mean of "
        "probabilities can change one.</p>"
        + image(
            figures.calibration_by_views(readings, READINGS),
            "Expected calibration error (ECE): the mean distance between confidence and accuracy over 15 bins of confidence; "
            "test objects. Temperatures and exponent are fitted on validation objects.",
            "Curves of calibration error by number of views. "
            + " ".join(
                f"{READINGS[reading]}: {100 * found['ece'][0]:.1f} % after one view, {100 * found['ece'][-1]:.1f} % at the end."
                for reading, found in readings.items()
            ),
        )
        + table(header, rows)
        + "<p class='note'>After the given number of views: ECE and accuracy in %; negative log-likelihood (NLL) in nats, the "
        "mean of −log of the probability given to the true class. Lower is better for both.</p>"
        + image(
            figures.reliability_curves(readings, READINGS, steps),
            "On the dotted diagonal, confidence equals accuracy; below it, the answers are less often right than they claim. "
            "Larger "
            "markers hold more of the predictions.",
            "Accuracy against confidence after "
            + ", ".join(map(str, steps))
            + " views: of the sum of logits (discs, solid lines) and with a temperature per number of views (hollow squares, "
            "dotted "
            "lines), each beside the diagonal.",
        )
        + "<p>Stopping as soon as the <dfn>risk</dfn>, 1 − confidence, is at most the requested risk. Columns except views in "
        "%; <b>▲ bold</b>: the error exceeds the requested risk by its 95 % interval.</p>"
        + table(
            ["requested risk", *(f"{part}, summed" for part in parts), *(f"{part}, calibrated" for part in parts)],
            stops,
        )
    )
