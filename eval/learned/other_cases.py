"""Sections of the page of learned view selection on what was not met in training: unknown poses, other candidates and classes."""

from __future__ import annotations

import html
from typing import Any

from eval.learned.study import WITHOUT
from eval.learned.tables import accuracy, against, gain_of_two, ladder
from eval.learned.walks import BY_EXPECTED_VIEWS
from eval.report.html import difference, percent, table
from mevs_jax.trained.system import EXPECTED_VIEWS


def unposed(metrics: dict[str, Any]) -> str:
    """Results for objects of unknown yaw, compared with a known pose from the same start views."""
    (views, turned), *_ = metrics["seeds"][0]["unposed"].items()
    posed = metrics["seeds"][0]["lattices"][views]["policies"]
    gains, of_pose, rows = turned["against"]["random"], "", []
    if EXPECTED_VIEWS in gains:
        of_pose = (
            " For each class, the azimuth of every view in the object's frame is estimated. Expected views are averaged over the "
            f"yaw, weighted by its probability: {gain_of_two(gains, EXPECTED_VIEWS)} points."
        )
    for name, policy in turned["policies"].items():
        if policy["knows"] != "truth":
            for title, found in ((policy["title"], policy), ("… pose known", posed[name])):
                cells = zip(found["after_views"], found["interval"], strict=True)
                rows.append([html.escape(title), *(accuracy(*cell) for cell in cells)])
    return (
        "<h2>Unknown yaw</h2>"
        "<p>Objects are turned about the vertical by an unknown angle; fusion and policy receive directions relative to the "
        f"first view only. After two views the policy's gain over random is {gain_of_two(gains)} points.{of_pose}</p>"
        + table(["next view chosen by", *(str(step + 1) for step in range(len(rows[0]) - 1))], rows)
    )


def rotated(metrics: dict[str, Any]) -> str:
    """Results for objects in any rotation."""
    if "rotated" not in metrics["seeds"][0]:
        return ""
    ((_, found),) = metrics["seeds"][0]["rotated"].items()
    every = found["random_sets"][-1]
    return (
        "<h2>Any rotation</h2><p>Objects are turned by an unknown rotation about any axis. The recogniser was trained for "
        "some further epochs on objects rotated in the same way, and finds the rotation of an object relative to the camera, for "
        "each class. Expected views are averaged over rotations, weighted by their probability. All "
        f"{every['views']} views fused: {percent(every['learned']['accuracy'])} %.</p>" + ladder(found) + against(found)
    )


def scattered(metrics: dict[str, Any]) -> str:
    """Results with separate candidate directions for each object."""
    ((views, found),) = metrics["seeds"][0]["scattered"].items()
    return (
        "<h2>Candidate directions that differ between objects</h2>"
        f"<p>Each object has {views} candidate directions of its own, from a randomly rotated lattice.</p>"
        + ladder(found)
        + against(found)
    )


def novel(metrics: dict[str, Any], classes: list[str]) -> str:
    """Results on classes that policies were trained without."""
    found = metrics["seeds"][0].get("novel")
    if found is None:
        return ""
    gains, rows, seeds = metrics.get("novel", found["gain"]), [], len(metrics["seeds"])
    steps = range(1, min(4, len(gains["trained_with"]["difference"])))
    over = "objects" if seeds < 2 else f"objects and {seeds} trainings; the second table is of the first"
    for name, title in (
        ("trained_without", "trained without these classes"),
        ("trained_with", "trained with all classes"),
        (EXPECTED_VIEWS, BY_EXPECTED_VIEWS.title),
        (WITHOUT, "… without expected views of these classes"),
    ):
        gain = gains[name]
        intervals = gain.get("over_both", gain["interval"])
        rows.append([title, *(difference(gain["difference"][step], intervals[step]) for step in steps)])
    each = [
        [
            html.escape(" and ".join(classes[label] for label in pair["classes"])),
            str(pair["objects"]),
            *(
                percent(pair[name][1])
                for name in ("random", "trained_without", "trained_with", EXPECTED_VIEWS, WITHOUT)
            ),
        ]
        for pair in found["pairs"]
    ]
    return (
        "<h2>Classes left out of policy training</h2>"
        f"<p>Gain over random in percentage points on the {found['objects']} test objects of pairs of classes that a policy was "
        "trained without. Encoder and fusion were trained on all classes. Expected views are those of the objects that the "
        "recogniser was trained on; no policy was trained for them. Intervals are over "
        + over
        + ".</p>"
        + table(["policy", *(f"{step + 1} views" for step in steps)], rows)
        + table(
            [
                "classes",
                "objects",
                "random, 2 views",
                "trained without these",
                "trained with all",
                "expected views",
                "… without these",
            ],
            each,
        )
    )
