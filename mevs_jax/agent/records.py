"""What an agent returns, and the history of its views."""

from __future__ import annotations

import io
import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal
from zipfile import ZipFile

import numpy as np
from jaxtyping import Float

from mevs_jax.arrays import ByContent
from mevs_jax.gallery.pose import ObjectPose

Reason = Literal["", "sure", "budget", "nothing reachable", "unknown object"]
"""Why an agent is done; empty while it is not."""
LARGEST_HISTORY = 2**28
"""Largest size of a history in memory, in bytes: 512 images of 362×362 pixels."""


@dataclass(frozen=True, eq=False)
class Belief(ByContent):
    """What an agent knows after a view.

    Attributes:
        probabilities: (classes,) calibrated, with sum 1.
        label: index of the most likely class.
        name: its name.
        confidence: its probability.
        views: number of views seen; one that was taken again counts once.
        images: number of images seen, which the budget counts.
        strangeness: share of the known objects that look less strange after as many views, in [0, 1]; NaN if it is not measured.
        known: False if the object is stranger than the agent's limit `unknown`, or most likely of the class of unknown objects.
        evidence: how much of the object's sphere was seen, known background included, in views that show all of it.
        unseen: share of the object's sphere that the latest view does not show, in [0, 1]; a view may be combined from images.
        pose: of the most likely object, if it is an enrolled one.
        doubt: what is wrong with the latest image, its camera or the sphere, by what it shows; empty if nothing was noticed.
        latency_ms: time that the call took, which is not compared.
    """

    probabilities: Float[np.ndarray, " classes"]
    label: int
    name: str
    confidence: float
    views: int
    images: int
    strangeness: float
    known: bool
    evidence: float
    unseen: float
    pose: ObjectPose | None
    doubt: str
    latency_ms: float = field(compare=False)


@dataclass(frozen=True, eq=False)
class Step(ByContent):
    """The next view, or the end.

    Attributes:
        T_world_camera: (4, 4) pose of the next camera, in metres; None when done.
        direction: (3,) unit vector from the object to that camera, in the world's frame; None when done.
        index: of the candidate; −1 when done.
        expected_gain: expected decrease of the belief's entropy in nats, by views of other objects; NaN where none are known.
        done: whether no further view is needed, or none is possible.
        reason: why it is done.
        latency_ms: time that the call took, which is not compared.
    """

    T_world_camera: Float[np.ndarray, "4 4"] | None
    direction: Float[np.ndarray, " 3"] | None
    index: int
    expected_gain: float
    done: bool
    reason: Reason
    latency_ms: float = field(compare=False)


@dataclass(eq=False)
class History(ByContent):
    """The images that an agent received for one object, and all that it answered, so that its beliefs can be computed again.

    Attributes:
        system: name of the system.
        options: of the agent and of `reset`.
        events: one dictionary for each call, in order: `observe`, `decide` or `mark_failed`, with its result; of `decide`, also
            the expected `gains` of all candidates, and their `directions` in the object's frame if they were given.
        depths: (views, side, side) the images that the networks received, in radii; those of parts are combined.
        poses: (views, 4, 4) their poses in the object's frame.
        colours: (views, side, side, 3) their colours, from 0 to 1, NaN where unknown; None for an image without.
    """

    system: str
    options: dict[str, Any]
    events: list[dict[str, Any]] = field(default_factory=list)
    depths: list[np.ndarray] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    colours: list[np.ndarray | None] = field(default_factory=list)

    __hash__ = None  # type: ignore[assignment]  # it changes

    @property
    def views(self) -> int:
        """Number of images seen, views that were taken again included."""
        return len(self.depths)

    @property
    def beliefs(self) -> list[dict[str, Any]]:
        """The belief after each view, as plain values."""
        return [event["belief"] for event in self.events if event["call"] == "observe"]

    def add(self, depth: np.ndarray, pose: np.ndarray, colours: np.ndarray | None, belief: dict[str, Any]) -> None:
        """Adds a view, and the belief after it."""
        self.depths.append(depth)
        self.poses.append(pose)
        self.colours.append(colours)
        self.events.append({"call": "observe", "belief": belief})

    def save(self, path: str | Path) -> None:
        """Writes the history into one `.npz` file, which `load_history` reads. Nothing in it is executed when it is read."""
        path = Path(path)
        text = json.dumps({"system": self.system, "options": self.options, "events": self.events}, default=float)
        side = self.depths[0].shape if self.depths else (0, 0)
        colours: dict[str, Any] = {f"colours_{at}": one for at, one in enumerate(self.colours) if one is not None}
        content = io.BytesIO()
        np.savez_compressed(
            content,
            form=np.array(1),
            text=np.array(text),
            depths=np.stack(self.depths) if self.depths else np.zeros((0, *side), np.float32),
            poses=np.stack(self.poses) if self.poses else np.zeros((0, 4, 4), np.float32),
            **colours,
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        made = path.with_name(f".{path.name}.{os.getpid()}")
        made.write_bytes(content.getvalue())
        made.replace(path)


def load_history(path: str | Path) -> History:
    """Reads a history that `History.save` wrote.

    Raises:
        ValueError: for any other file.
    """
    try:
        with ZipFile(path) as packed:
            if (size := sum(member.file_size for member in packed.infolist())) > LARGEST_HISTORY:
                raise ValueError(
                    f"it would take {size >> 20} MB of memory, and at most {LARGEST_HISTORY >> 20} are read"
                )
        with np.load(path, allow_pickle=False) as stored:
            if int(stored["form"]) != 1:
                raise ValueError("it is of another version")
            text = json.loads(str(stored["text"]))
            history = History(text["system"], dict(text["options"]), list(text["events"]))
            depths, poses = np.asarray(stored["depths"], np.float32), np.asarray(stored["poses"], np.float32)
            names = [f"colours_{number}" for number in range(len(depths))]
            history.colours = [np.asarray(stored[name], np.float32) if name in stored else None for name in names]
    except FileNotFoundError:
        raise
    except Exception as error:  # the content of a damaged file decides which
        raise ValueError(f"{path} is no history of an agent ({str(error).splitlines()[0][:100]})") from error
    if depths.ndim != 3 or poses.shape != (len(depths), 4, 4):
        raise ValueError(f"{path} is no history of an agent (images of shape {depths.shape}, poses {poses.shape})")
    history.depths, history.poses = list(depths), list(poses)
    return history


def plain(record: Belief | Step) -> dict[str, Any]:
    """A record as values that JSON can hold; None for numbers that are not finite."""

    def of(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: of(part) for name, part in value.items()}
        if isinstance(value, np.ndarray):
            return value.tolist()
        return None if isinstance(value, float) and not np.isfinite(value) else value

    return {name: of(value) for name, value in asdict(record).items()}
