"""Every object of a recorded scene recognised: `mevs look --depth PATH --scene`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from data_pipeline.frames.recording import Recording
from data_pipeline.scene.objects import GROUND, Scene, ground_of, objects_by_masks, objects_in
from data_pipeline.scene.surfaces import fuse, planes_in, upward_of
from data_pipeline.scene.views import views_of
from mevs_jax.agent.looking import ShowsTooLittle, Walk, look_at_views
from mevs_jax.geometry.sphere import Sphere, upright
from mevs_jax.trained.system import TrainedSystem


@dataclass(frozen=True, eq=False)
class Sight:
    """An object of a scene, and how it was recognised.

    Attributes:
        sphere: where it is.
        walk: None if the images show too little of it.
    """

    sphere: Sphere
    walk: Walk | None

    @property
    def name(self) -> str:
        """The answer; `unknown object` too if too little of it was shown."""
        return "unknown object" if self.walk is None else self.walk.name

    @property
    def sure(self) -> bool:
        """Whether the agent is."""
        return self.walk is not None and self.walk.reason == "sure"

    def as_json(self) -> dict[str, Any]:
        """Values that JSON can hold; `pose` is that of an enrolled object."""
        sphere, belief = self.sphere, None if self.walk is None else self.walk.beliefs[-1]
        place = {"center": sphere.position.tolist(), "radius": sphere.radius}
        if self.walk is None or belief is None:
            return place | {
                "answer": self.name,
                "confidence": None,
                "reason": "seen too little",
                "evidence": 0.0,
                "views": [],
            }
        pose = None if belief.pose is None else belief.pose.T_world_object.tolist()
        said = {
            "answer": self.name,
            "confidence": belief.confidence,
            "reason": self.walk.reason,
            "evidence": belief.evidence,
        }
        return place | said | {"views": list(self.walk.views), "pose": pose}


def scene_in(
    recording: Recording,
    up: Float[np.ndarray, " 3"] | None = None,
    floor: float | None = None,
    masks: Int[np.ndarray, "frames height width"] | None = None,
) -> Scene:
    """The objects of a recording.

    Args:
        recording: of things that stand still.
        up: (3,) upward direction of any length; by default across the ground, for cameras without roll.
        floor: height of the ground along it, in metres; by default of the lowest large level plane.
        masks: of each image, the number of the object that a pixel shows, the same in all images, 0 for none, as a detector
            gives them; by default objects are found by what they stand on.

    Raises:
        DataError: if there is no ground, or nothing on it.
    """
    surfaces = fuse(recording)
    planes = planes_in(surfaces)
    upwards = upward_of(planes, recording.T_world_camera) if up is None else upright(up)[2]
    if masks is None:
        return objects_in(surfaces, recording, planes, upwards, floor)
    return objects_by_masks(
        surfaces, recording, masks, upwards, ground_of(surfaces, planes, upwards) if floor is None else floor
    )


def look_at_scene(system: TrainedSystem, recording: Recording, scene: Scene, **options: Any) -> list[Sight]:
    """Recognises every object, from what all images together show of it from the system's viewpoints.

    The images are there already, so no walk ends before its budget, and an answer is sure by what all its views say.

    Args:
        system: one whose networks receive a mask of the unknown pixels.
        recording, scene: of `scene_in`.
        options: of `mevs_jax.Agent`.
    """
    stop, seen = options.pop("stop", 0.95), []
    agent = system.agent(**options, stop=2.0)
    if not system.description.told_unknown:
        raise ValueError(
            "this system is not told which pixels are unknown, which a scene needs; train one with five channels"
        )
    for number, sphere in enumerate(scene.spheres):
        try:
            walk = look_at_views(agent, sphere, views_of(scene, recording, number, system))
            if walk.beliefs[-1].known and walk.confidence >= stop:
                walk = replace(walk, reason="sure")
        except ShowsTooLittle:
            walk = None
        seen.append(Sight(sphere, walk))
    return seen


def draw_scene(scene: Scene, seen: list[Sight], path: Path) -> None:
    """Draws a scene from above into an image file: what each object is called, with a question mark unless that is sure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    turn = upright(scene.up)
    places = scene.surfaces.points @ turn.T
    figure = Figure(figsize=(13, 9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    shown = places[scene.labels <= GROUND][::4]
    axes.scatter(shown[:, 0], shown[:, 1], s=0.3, color="#d5dbe1")
    for number, sight in enumerate(seen):
        own = places[scene.labels == number]
        colour = "#9aa5b1" if sight.name == "unknown object" else "#c1440e" if sight.sure else "#2a6fbb"
        axes.scatter(own[:, 0], own[:, 1], s=0.6, color=colour)
        confidence = "" if sight.walk is None else f" {100 * sight.walk.confidence:.0f} %"
        text = (
            f"{number}"
            if sight.name == "unknown object"
            else f"{number} {sight.name}{confidence}{'' if sight.sure else '?'}"
        )
        x, y = own[:, :2].mean(axis=0)
        axes.text(x, y, text, color="#1b2a41", fontsize=11, ha="center", va="center")
    axes.set_aspect("equal")
    axes.set_xlabel("m")
    axes.set_ylabel("m")
    axes.set_title("from above; grey: unknown object, blue: not sure, red: sure")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
