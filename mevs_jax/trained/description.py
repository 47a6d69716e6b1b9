"""`trained.json`: what a trained system is, without its arrays."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from mevs_jax.gallery.matching import comparisons
from mevs_jax.geometry.cameras import ViewCamera
from mevs_jax.geometry.inputs import SizeInput
from mevs_jax.models.shapes import EncoderShape, PointNet2Shape, PoseShape, ResNetShape, SetFusionShape, ViewPolicyShape

FORM = 1
"""Version of the folder's form; a program reads this version alone."""
UNKNOWN_OBJECT = "unknown object"
"""Name of the class of all objects that belong to no other class, in a data set that has such objects."""


@dataclass(frozen=True)
class ImageInput:
    """The images that a classifier or recogniser was trained with.

    Attributes:
        content: `depth`: (far − depth) / (far − near), where near and far bound the object's sphere, and 0 for background;
            `depth_and_normals`: this and the unit normal in the camera's frame; `normals`: (normal + 1) / 2, 0 for
            background; `image`: grey levels, which a depth camera does not give.
        channels: of the image; depth is repeated in all channels, except for `depth_and_normals`, which has 4, or 5 of which
            the last is 1 where it is unknown what is there.
        mirrored: whether the features of a view are means of those of its image and of the mirror image, which shows an object
            of the same class.
    """

    content: Literal["depth", "depth_and_normals", "normals", "image"]
    channels: int
    mirrored: bool = False


@dataclass(frozen=True)
class CloudInput:
    """The partial clouds that an entropy predictor was trained with. Their unit is the object's radius.

    Attributes:
        points: number of points, drawn from the pixels that show the object.
        frame: `world`, the object's frame; or `camera`, with the origin moved along the optical axis to the object's centre.
        directions: whether each point has the unit vector towards the camera beside it, so a cloud has 6 columns; 3 if not.
    """

    points: int
    frame: Literal["world", "camera"]
    directions: bool

    @property
    def columns(self) -> int:
        """Number of columns of a cloud."""
        return 6 if self.directions else 3


@dataclass(frozen=True)
class DataDescription:
    """The data set of a system.

    Attributes:
        source: its name.
        fingerprint: hash of its statistics.
        objects: number of objects by split.
    """

    source: str
    fingerprint: str
    objects: dict[str, int]


@dataclass(frozen=True)
class Description:
    """All that `trained.json` holds besides the file of weights.

    Attributes:
        form: version of the folder's form.
        kind: `classifier`: logits of single views are added; `recogniser`: a network fuses the features of all views; `gallery`:
            views are compared with those of enrolled objects, without a network.
        classes: names of the classes, by label.
        camera: of the views that the networks were trained with.
        image: input of the classifier or recogniser.
        encoder: its shape; None for a gallery.
        fusion: shape of the set fusion, for a recogniser.
        size: how the object's radius is used, for a recogniser that was trained with it.
        pose: shape of the network that finds the yaw of objects, for a recogniser that was trained with it.
        entropy: shape of the entropy predictor, if there is one.
        cloud: input of the entropy predictor.
        view_policies: shapes of the networks that score views, by name of the policy.
        best: name of the policy that is used by default where the object's yaw is known.
        best_unposed: the same for an unknown yaw.
        chosen_by: how `best` was chosen.
        data: the data set that the networks were trained and calibrated on.
        made_by: hash of what the system was made from: data set, networks, evaluation.
        made_with: versions of packages.
        evaluation: figures of its own evaluation, on test objects.
        colour: whether images may have colours, for a gallery; those without are compared by depth alone.
        start: what the classifier's weights were before its training, with the licence of what was trained by others.
    """

    form: int
    kind: Literal["classifier", "recogniser", "gallery"]
    classes: tuple[str, ...]
    camera: ViewCamera
    image: ImageInput
    encoder: ResNetShape | EncoderShape | None
    best: str
    best_unposed: str
    chosen_by: str
    data: DataDescription
    made_by: str
    made_with: dict[str, str]
    fusion: SetFusionShape | None = None
    size: SizeInput | None = None
    pose: PoseShape | None = None
    entropy: PointNet2Shape | None = None
    cloud: CloudInput | None = None
    view_policies: dict[str, ViewPolicyShape] = field(default_factory=dict)
    evaluation: dict[str, Any] = field(default_factory=dict)
    colour: bool = False
    start: str = ""

    @property
    def told_unknown(self) -> bool:
        """Whether it is told what an image does not show, so that images may show a part of the object."""
        return self.image.channels == 5 or self.kind == "gallery"

    @property
    def uses_size(self) -> bool:
        """Whether the object's radius in metres says something about its class."""
        return self.size is not None or self.kind == "gallery"

    @property
    def features(self) -> int:
        """Length of what is kept of each view for the fusion."""
        return comparisons(len(self.classes) - 1, self.colour) if self.encoder is None else self.encoder.features

    @property
    def unknown_class(self) -> int | None:
        """Label of the class of objects that belong to no other class; None if there is no such class."""
        plain = [name.replace("_", " ").lower() for name in self.classes]
        return plain.index(UNKNOWN_OBJECT) if UNKNOWN_OBJECT in plain else None

    def __hash__(self) -> int:
        return hash(json.dumps(asdict(self), sort_keys=True, default=str))
