"""The report's section on single objects: a 3-D scene of the object, its candidate views and a walk, step by step.

The scene is drawn by `viewer.js` on a canvas in two dimensions, without a library: three.js (0.7 MB) needs WebGL, which remote
desktops and locked browsers lack, and plotly adds 4.5 MB to every page. The viewer has 13 kB, and its text, buttons and numbers
are plain HTML. Without JavaScript, the pictures and beliefs of every walk are shown.
"""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path
from typing import Any

import numpy as np

from data_pipeline.dataset.builder import open_split
from eval.report.html import ReportInputs, data_url, percent, picture
from eval.report.surface import Surface, seen_by, surface_of
from eval.report.walks import OF_EACH, POLICY, Walks, walks_of

VIEWER = Path(__file__).with_name("viewer.js").read_text()
_BARS = 5
_SCALE = 20_000
"""Steps of a stored coordinate in a radius; two bytes hold 1.6 radii."""
_POINTS = '<rect x="{0}" y="{0}" width="{1}" height="{1}" fill="var(--{2})" stroke="none"/>'
_MARKS = (
    ('<circle cx="12" cy="12" r="4" fill="var(--gain-low)"/>', 'lowest expected gain, <span id="lowest"></span>'),
    ('<circle cx="12" cy="12" r="9" fill="var(--gain-high)"/>', 'highest expected gain, <span id="highest"></span>'),
    (
        '<circle cx="12" cy="12" r="9" fill="var(--path)"/><text x="12" y="16.5" text-anchor="middle" font-size="13" '
        'font-weight="700" style="fill:var(--paper)" stroke="none">1</text>',
        "views seen, in order; the line is the walk",
    ),
    (
        '<circle cx="12" cy="12" r="6" fill="none"/><circle cx="12" cy="12" r="10" fill="none" stroke-dasharray="3 2"/>',
        "the view that is chosen next",
    ),
    ('<path d="M6 6L18 18M6 18L18 6"/>', "a view that cannot be reached"),
    (_POINTS.format(6, 12, "new"), "points of the surface, new with this view"),
    (_POINTS.format(8, 8, "seen"), "points seen before"),
    (_POINTS.format(10, 4, "unseen"), "points not seen yet"),
)
"""The legend: drawings in a square of 24, and what they mean."""


def scenes_section(inputs: ReportInputs) -> str:
    """The walks around some objects, with a viewer; empty if the tables of the validation objects are not at hand."""
    if inputs.validation is None:
        return ""
    metrics = inputs.metrics
    walks = walks_of(
        inputs.tables,
        inputs.validation,
        inputs.statistics.graph,
        metrics.reachable,
        metrics.confidence[POLICY].temperatures,
    )
    source, shown, scenes = open_split(inputs.data, "test"), list[str](), list[dict]()
    for index, kind in walks.chosen().items():
        example = source[index]
        scenes.append(_scene(inputs, walks, index, kind, example))
        shown.append(_static(inputs, walks, index, kind, example, len(shown)))
    data = {
        "classes": inputs.statistics.classes,
        "directions": np.round(inputs.statistics.viewpoints, 4).tolist(),
        "reachable": metrics.reachable.tolist(),
        "scenes": scenes,
    }
    stored = json.dumps(data, separators=(",", ":"), ensure_ascii=False).replace(
        "<", "\\u003c"
    )  # no tag ends the script
    return (
        f"<h2>Objects, and the views chosen around them</h2>{_text(inputs, walks)}"
        f'<div id="walks">{_controls(walks.views.shape[1], inputs.statistics.views)}{"".join(shown)}</div>'
        f'<script type="application/json" id="scenes">{stored}</script><script>{VIEWER}</script>'
    )


def _text(inputs: ReportInputs, walks: Walks) -> str:
    """What is shown, and how the objects were chosen."""
    counts = "; ".join(
        f"{kind}: {members.sum()} ({percent(members.mean())} %)" for kind, members in walks.kinds().items()
    )
    images = inputs.settings["classifier"]["images"]
    received = "the depths of the same view" if images != "image" else "the same image"
    return (
        f"<p>A <dfn>walk</dfn> is a series of views around one object, here of {walks.views.shape[1]}. The first view is given; "
        "then the policy “expected information gain” goes to the view whose expected gain is highest. The gain is negative if "
        "the view would rather make the belief less sure. The pictures are shaded for the reader; the classifier receives "
        f"{received}. The probabilities are <dfn>calibrated</dfn>: the sums of logits are divided by numbers that were fitted on "
        "validation objects, so that answers given with 80 %, say, are right in 80 % of the cases.</p>"
        "<p class='note'>How the objects were chosen: every test object is walked around once, the first from view 0, the "
        f"second from view 1, and so on. Of {len(walks.labels)} walks: {counts}. {_which(walks)}</p>"
        "<noscript><p class='warning'>The 3-D scene needs JavaScript, which is off or not supported here. The pictures and "
        "beliefs of all walks follow.</p></noscript>"
    )


def _which(walks: Walks) -> str:
    """Says which of the walks are shown."""
    shown = (
        f"The first {OF_EACH} objects of each of the first four kinds are shown, where there are any; objects of a class that is "
        "not shown yet come first."
    )
    if walks.right[:, -1].all():
        return f"{shown} No walk ends with a wrong answer, so there is no failure to show."
    return f"{shown} Failures are therefore more frequent here than among all walks."


def _controls(steps: int, views: int) -> str:
    """The scene with its controls, which `viewer.js` shows and fills."""
    turns = "".join(
        f'<button type="button" data-do="{key}" aria-label="{label}">{sign}</button>'
        for key, label, sign in (
            ("left", "turn left", "←"),
            ("right", "turn right", "→"),
            ("up", "turn up", "↑"),
            ("down", "turn down", "↓"),
            ("in", "closer", "+"),
            ("out", "farther", "−"),
            ("reset", "first position", "⟲"),
        )
    )
    legend = "".join(
        f'<li><svg viewBox="0 0 24 24" aria-hidden="true" stroke="currentColor">{drawn}</svg>{text}</li>'
        for drawn, text in _MARKS
    )
    return f"""
<div id="viewer" hidden>
<div class="controls"><label for="object">Object</label> <select id="object"></select></div>
<div class="controls"><label for="step">Views seen</label>
<button type="button" data-do="back" aria-label="one view less">◀</button>
<input type="range" id="step" min="1" max="{steps}" value="1">
<button type="button" data-do="next" aria-label="one view more">▶</button>
<output id="count" for="step"></output></div>
<div class="stage"><div>
<canvas id="scene" tabindex="0" role="img" aria-label="3-D scene" aria-describedby="how"></canvas>
<div class="turn">{turns}</div></div>
<div class="now"><img id="picture" alt=""><p id="said" aria-live="polite"></p>
<p id="bars-title"><b>Belief: the most likely classes, and the true one</b></p>
<ol class="bars" id="bars" aria-labelledby="bars-title"></ol></div>
<div><p class="note" id="how">To turn the scene, drag it with the mouse, or with a finger that starts sideways (up and down
scrolls the page), or press the arrow keys. To zoom, press + or −, pinch, or use the wheel after a click. The larger a candidate
view, the higher its expected gain. The candidates are drawn nearer to the object than they are, and the surface is shown by the
points that the {views} views together see.</p>
<ul class="legend">{legend}</ul></div></div>
</div>"""


def _scene(inputs: ReportInputs, walks: Walks, index: int, kind: str, example: dict[str, Any]) -> dict[str, Any]:
    """What the viewer needs to know of one object."""
    camera, views = inputs.statistics.camera, walks.views[index]
    surface = surface_of(example, camera)
    first = np.zeros(len(surface.points), np.uint8)
    for step in range(len(views), 0, -1):
        view = views[step - 1]
        first[seen_by(surface, example["depth"][view], example["pose"][view], camera)] = step
    stops = []
    for step, view in enumerate(views.tolist()):
        probabilities = walks.probabilities[index, step]
        best = np.argsort(-probabilities, kind="stable")[:_BARS].tolist()
        if walks.labels[index] not in best:  # the true class is always shown, last
            best.append(int(walks.labels[index]))
        gains = np.round(walks.gains[index, step], 3).astype(float)
        stops.append(
            {
                "view": view,
                "gains": [0.0 if gain == 0 else gain for gain in gains.tolist()],
                "bars": [[int(label), round(float(probabilities[label]), 4)] for label in best],
            }
        )
    return {
        "name": f"{inputs.tables.names[index]} ({inputs.statistics.classes[walks.labels[index]]}): {kind}",
        "truth": int(walks.labels[index]),
        "spacing": round(surface.spacing, 4),
        "count": len(surface.points),
        "points": _packed(surface, first),
        "stops": stops,
    }


def nats(gain: float) -> str:
    """An expected gain as the viewer writes it."""
    return f"{round(gain, 3) + 0.0:.3f} nats".replace("-", "−")


def _packed(surface: Surface, first: np.ndarray) -> str:
    """Points as base64: coordinates in two bytes, normals in one, and the step that first shows the point, 0 for none."""
    coordinates = np.clip(np.round(surface.points * _SCALE), -32767, 32767).astype("<i2")
    normals = np.round(surface.normals * 127).astype("i1")
    return base64.b64encode(coordinates.tobytes() + normals.tobytes() + first.tobytes()).decode()


def _static(inputs: ReportInputs, walks: Walks, index: int, kind: str, example: dict[str, Any], number: int) -> str:
    """The pictures and beliefs of a walk, as they are read without the viewer too."""
    classes, items = inputs.statistics.classes, []
    views, truth = walks.views[index].tolist(), int(walks.labels[index])
    for step, view in enumerate(views):
        probabilities = walks.probabilities[index, step]
        said = int(probabilities.argmax())
        verdict = "✓ right" if said == truth else "✗ wrong"
        following = ""
        if step + 1 < len(views):
            gain = walks.gains[index, step, views[step + 1]]
            following = f"<br>next: view {views[step + 1]}, expected gain {nats(float(gain))}"
        name = html.escape(classes[said])
        items.append(
            f'<li><img alt="{html.escape(inputs.tables.names[index])} from view {view}, shaded" '
            f'src="{data_url(picture(example["image"][view]))}"><b>{step + 1}.</b> view {view}: {name} '
            f"{percent(float(probabilities[said]))} %, {verdict}{following}</li>"
        )
    return (
        f'<section class="walk" data-scene="{number}"><h3>{html.escape(inputs.tables.names[index])}, class '
        f'{html.escape(classes[truth])}: {kind}</h3><ol class="stops">{"".join(items)}</ol></section>'
    )
