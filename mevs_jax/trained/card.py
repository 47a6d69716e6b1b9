"""The model card of a trained system, in the form that the Hugging Face hub shows."""

from __future__ import annotations

import json
from pathlib import PurePath
from typing import Any

from mevs_jax.markdown import markdown_table
from mevs_jax.trained.description import Description

_INPUTS = {
    "depth": "depth as (far − depth) / (far − near), background 0, where near and far bound the object's sphere",
    "depth_and_normals": "depth as (far − depth) / (far − near), and the unit normal in the camera's frame; background 0",
    "normals": "the unit normal in the camera's frame as (normal + 1) / 2, background 0",
    "image": "grey levels in [0, 1], background 0",
}
_KINDS = {
    "recogniser": "a network fuses the features of all views (recogniser)",
    "classifier": "the logits of all views are added, with a temperature for each number of views (classifier)",
}


_CARD = """---
library_name: mevs_jax
tags: [active-recognition, next-best-view, depth, jax]
---

# Recognition of {count} classes by chosen views

```python
import mevs_jax

system = mevs_jax.load("PATH OF THIS FOLDER")
agent = system.agent()
```

* Classes: {classes}.
* Data: {data.source} ({objects} objects; fingerprint {data.fingerprint}).
* Camera: {camera.resolution}×{camera.resolution} pixels, field of view {camera.field_of_view:g}°, {camera.distance:g} radii \
from the object's centre, z up in the image.
* Image: {image}; {channels}.
{size}* Kind: {kind}.
{start}* Policy by default: `{of.best}` ({of.chosen_by}); with unknown yaw `{of.best_unposed}`.
* Weights: {megabytes:.1f} MB. Made with {versions}.

{figures}## Limits

* Only these classes are known. {strangers}
* The figures are of perfect depth. Noise, missing depth and wrong centres cost accuracy.{parts}
* Confidence is calibrated on validation objects of the same source.
"""
_STRANGERS = {
    True: "Other objects are an `unknown object`, as far as those that it was trained on resemble them.",
    False: "Detection of objects of other classes was not measured for this system.",
}
_MIRRORED = "; features are means over the image and its mirror image"
_PARTS = " Images may show a part of the object; pixels of unknown depth are an input of their own."
ELSEWHERE = "elsewhere"
"""The entry of `Description.evaluation` with what was measured on objects of other sources, as by `elsewhere`."""
_STOP = 0.95
_GALLERY = """---
library_name: mevs_jax
tags: [active-recognition, next-best-view, depth, enrolment, jax]
---

# Recognition of enrolled objects by chosen views

```python
import mevs_jax

system = mevs_jax.load("PATH OF THIS FOLDER")
more = mevs_jax.enrol({{"mug": (vertices, faces)}}, system)  # without training
agent = more.agent()
```

* Objects: {objects}. Everything else is an `{unknown}`.
* Views are compared with those of the objects at every yaw, by a matcher that was learned from procedural shapes with the
  errors of real images. There is no network.
* Camera: {camera.resolution}×{camera.resolution} pixels, field of view {camera.field_of_view:g}°, {camera.distance:g} radii \
from the object's centre, z up in the image.
* Weights: {megabytes:.1f} MB. Made with {versions}.

## Limits

* Objects are distinguished by their shape, by their size where it is known{colour}.
  Some objects look alike: `mevs_jax.enrolment.alike` names them.
* Objects are upright. Their yaw may be unknown, a tilt may not.
* Confidence is calibrated on procedural shapes of other kinds.
"""


def model_card(description: Description, size: int) -> str:
    """Returns the card as Markdown, for weights of `size` bytes."""
    of, sizes = description, description.size
    if of.kind == "gallery":
        *objects, unknown = of.classes
        colour = ", and by their colours where images have some" if of.colour else "; colour is not used"
        known = {"colour": colour, "objects": ", ".join(objects) or "none yet", "unknown": unknown, "camera": of.camera}
        made = ", ".join(f"{name} {version}" for name, version in of.made_with.items())
        return _GALLERY.format(**known, megabytes=size / 1e6, versions=made)
    told = "* Size: the object's radius, where it is given, from {0.smallest:g} to {0.largest:g} m.\n"
    return _CARD.format(
        of=of,
        data=of.data,
        camera=of.camera,
        count=len(of.classes),
        classes=", ".join(of.classes),
        objects=", ".join(f"{count} {split}" for split, count in of.data.objects.items()),
        image=_INPUTS[of.image.content] + _MIRRORED * of.image.mirrored,
        channels=f"{of.image.channels} channel{'s' * (of.image.channels > 1)}",
        size="" if sizes is None else told.format(sizes),
        kind=_KINDS[of.kind],
        start=f"* Training began with {of.start}.\n" * bool(of.start),
        megabytes=size / 1e6,
        versions=", ".join(f"{name} {version}" for name, version in of.made_with.items()),
        figures=_figures(of) + _elsewhere(of),
        strangers=_STRANGERS[of.unknown_class is not None],
        parts=_PARTS * of.told_unknown,
    )


def elsewhere(written: str) -> dict[str, Any]:
    """What a card says of the results that `mevs check transfer --to FILE` wrote.

    Raises:
        ValueError, KeyError, TypeError: for anything else.
    """
    found = json.loads(written)
    last = max((row for row in found["promises"] if row["stop"] == _STOP), key=lambda row: row["views"])
    shares = {name: last[name] for name in ("wrong", "sure", "refused", "strangers_sure", "strangers_refused")}
    about = {
        "source": PurePath(found["data"]).name.removesuffix(".zip"),
        "views": last["views"],
        "posed": found["posed"],
    }
    return about | {"known": found["known"], "strangers": found["strangers"]} | shares


def _elsewhere(description: Description) -> str:
    measured = description.evaluation.get(ELSEWHERE)
    if not measured:
        return ""

    def percent(share: float | None) -> str:
        return "–" if share is None else f"{100 * share:.1f} %"

    head = ["objects", "number", f"sure at {_STOP:g}", "of these wrong", "unknown object"]
    rows = []
    for one in measured:
        yaw = "known" if one["posed"] else "unknown"
        where = f"{one['source']}, yaw {yaw}, up to {one['views']} views"
        if one["known"]:
            rows.append([where, str(one["known"]), *(percent(one[name]) for name in ("sure", "wrong", "refused"))])
        if one["strangers"]:
            wrong = "all" if one["strangers_sure"] else "–"
            shares = percent(one["strangers_sure"]), wrong, percent(one["strangers_refused"])
            rows.append([f"{where}: of no known class", str(one["strangers"]), *shares])
    return f"Agents by the default policy, by `mevs check transfer`:\n\n{markdown_table(head, rows)}\n\n"


def _figures(description: Description) -> str:
    after = description.evaluation.get("after_views")
    if not isinstance(after, dict) or not after:
        return ""
    most = max(map(len, after.values()))
    head = ["", *(f"{count} view{'s' * (count > 1)}" for count in range(1, most + 1))]
    rows = [["`" + name + "`", *(f"{100 * share:.1f}" for share in shares)] for name, shares in after.items()]
    objects = description.evaluation.get("objects", "the")
    about = f"Share of {objects} test objects recognised, in %, from all first views, their yaw known:"
    return f"## Evaluation\n\n{about}\n\n{markdown_table(head, rows)}\n\n"
