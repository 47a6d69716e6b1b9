"""Faults of cameras are noticed by single images, but for those that no single image shows; sound images are in no doubt."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from data_pipeline.capture.casting import default_caster
from data_pipeline.objects.mesh import ObjectEntry
from data_pipeline.objects.recipes import FurniturePiece
from data_pipeline.objects.sources import load_object
from mevs_jax import DepthImage, Sphere, ViewCamera
from mevs_jax.geometry.canonical import convert
from tests.cameras.faults import ONE, Given, taken

CAMERA = ViewCamera(resolution=64)
UNSEEN = {
    "intrinsics": {"focal lengths +10 %", "focal lengths +20 %", "focal lengths +50 %", "focal lengths +100 %",
                   "focal lengths -10 %", "focal lengths -20 %", "fy 1.3 times fx", "principal point off by 5%, 0%",
                   "principal point off by 10%, 10%"},
    "image": {"of 16×12 pixels", "turned by 180°", "mirrored left to right", "upside down"},
    "depth": {"a tenth too long", "a tenth too short", "a fifth too short", "halved", "inverse", "Euclidean distance"},
    "pose": {"turned about its optical axis by 10°", "turned about its optical axis by 90°",
             "turned about its optical axis by 180°", "turned about its vertical axis by 5°", "in a world turned by 30°",
             "0.1 m aside", "0.1 m further back", "0.25 m further back", "0.25 m further forward"},
    "sphere": {"radius 0.85 times", "radius 1.2 times", "center 0.15 radii aside", "center 0.3 radii aside",
               "center 0.6 radii aside", "up is y", "up is −z", "up leans by 20°"},
    "mask and floor": {"mask shifted by 10 pixels", "mask of all pixels", "mask of the left half", "floor 0.2 radii too high",
                       "floor relative to the center"},
}  # fmt: skip
"""Faults that one image need not show: docs/camera.md lists them."""


@cache
def views() -> list[Given]:
    """A chair and a toilet from two directions each, alone and in a room with a mask."""
    found = []
    for name in ("chair", "toilet"):
        mesh = load_object(ObjectEntry(name, 0, "test", FurniturePiece(name, 3)))
        cast, lowest = default_caster()(mesh), float(mesh.vertices[:, 2].min())
        for at, direction in enumerate(((0.8, 0.3, 0.5), (-0.4, 0.9, 0.3))):
            found.append(taken(cast, np.array(direction) / np.linalg.norm(direction), lowest=lowest, room=at == 1))
    return found


def said(given: Given) -> str:
    """The refusal of an image, or the doubt."""
    try:
        image = DepthImage(given.depth, given.K, given.pose, given.mask, given.floor)
        view = convert(image, Sphere(given.center, given.radius, given.up), CAMERA)
    except ValueError as reason:
        assert "\n" not in str(reason)  # noqa: PT017
        return str(reason)
    shown = (view.depth > 0).sum()
    return view.doubt or ("too few pixels" if shown < 20 else "")


def test_sound_images_are_in_no_doubt():
    for given in views():
        assert said(given) == ""
        assert said(replace(given, mask=None, floor=given.center[2] + given.radius * (given.lowest + 0.03))) == ""
        steps = np.where(np.isfinite(given.depth), np.round(given.depth, 3), 0).astype(np.float32)
        assert said(replace(given, depth=steps)) == ""
        off = given.center + 0.03 * given.radius
        assert said(replace(given, center=off, radius=0.97 * given.radius)) == ""


@pytest.mark.parametrize(("kind", "fault"), [(kind, fault) for kind, faults in ONE.items() for fault in faults])
def test_faults_are_noticed_by_one_image(kind, fault):
    """By at least half of the images: some shapes and rooms hide some faults."""
    noticed = [said(ONE[kind][fault](given)) for given in views()]
    if fault not in UNSEEN[kind]:
        assert 2 * sum(map(bool, noticed)) >= len(noticed), noticed


def test_each_message_says_what_is_wrong():
    for kind, fault, message in (
        ("image", "transposed", "check whether the image is transposed"),
        ("intrinsics", "K of half the resolution", "0.5 times as many pixels a side"),
        ("intrinsics", "principal point off by 60%, 0%", "outside, for an image of 640×480 pixels"),
        ("intrinsics", "focal lengths in millimetres", "field of view of 1"),
        ("depth", "z-buffer, planes 0.1 and 10", "z-buffer"),
        ("image", "of 8×6 pixels", r"pixels across in the image, and 8 are needed"),
        ("sphere", "radius 0.5 times", "goes on beyond the object's sphere"),
        ("sphere", "radius 2 times", "reaches only"),
        ("mask and floor", "floor 0.5 radii too high", "something below the floor"),
        ("mask and floor", "mask shifted by 100 pixels", "of the mask's pixels show nothing"),
    ):
        assert message in said(ONE[kind][fault](views()[0])), (kind, fault, said(ONE[kind][fault](views()[0])))
