"""A film of a recognition: the arm, what its camera sees, and what the agent believes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from examples.robot_arm.arm import Arm
from examples.robot_arm.camera import DepthCamera
from examples.robot_arm.looking import Looked, Recognition
from examples.robot_arm.scene import Scene

SIZE = (720, 360)
"""Of the film, in pixels."""
_ARM, _IMAGE = (0, 0, 480, 360), (492, 12, 708, 174)
_INK, _FAINT, _BAR, _BEST = (30, 35, 40), (120, 128, 136), (150, 175, 205), (220, 120, 40)


def write_film(found: Recognition, scene: Scene, camera: DepthCamera, classes: Sequence[str], path: Path) -> None:
    """Writes a GIF, whose last frame stays for three seconds."""
    frames, times, arm = [], [], Arm(scene)
    shown: Looked | None = None
    for number, look in enumerate(found.looks):
        for at, angles in enumerate(look.passed):
            arm.place(angles)
            there = at == len(look.passed) - 1
            shown = look if there else shown
            frames.append(_frame(camera.picture("outside"), shown, classes, _title(number, found, there)))
            times.append(900 if there else 70)
    times[-1] = 3000
    palette = _palette(frames)
    images = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    images[0].save(path, save_all=True, append_images=images[1:], duration=times, loop=0, optimize=True)


def _palette(frames: list[Image.Image]) -> Image.Image:
    """Colours of some frames, with enough greys for depth, and the bars."""
    some = [frames[at] for at in np.linspace(0, len(frames) - 1, 4).astype(int)]
    sheet = Image.new("RGB", (SIZE[0], SIZE[1] * len(some) + 128))
    for row, frame in enumerate(some):
        sheet.paste(frame, (0, row * SIZE[1]))
    shades = [(grey, grey, grey) for grey in range(40, 256, 12)]
    for number, colour in enumerate((*shades, _BAR, _BEST, _INK, _FAINT)):
        sheet.paste(colour, (number * 30, SIZE[1] * len(some), number * 30 + 30, sheet.height))
    return sheet.quantize(160, dither=Image.Dither.NONE)


def _title(number: int, found: Recognition, there: bool) -> str:
    if there and number == len(found.looks) - 1:
        return f"{found.name}: {found.reason} after {len(found.looks)} view{'s' * (len(found.looks) > 1)}"
    return f"view {number + 1}" if there else f"moving to view {number + 1}"


def _frame(picture: np.ndarray, look: Looked | None, classes: Sequence[str], title: str) -> Image.Image:
    frame = Image.new("RGB", SIZE, "white")
    frame.paste(Image.fromarray(picture).resize((_ARM[2], _ARM[3])), (0, 0))
    draw, font, small = ImageDraw.Draw(frame), ImageFont.load_default(14), ImageFont.load_default(11)
    draw.text((12, 10), title, fill=_INK, font=font)
    if look is None:
        draw.rectangle(_IMAGE, outline=_FAINT)
        return frame
    size = (_IMAGE[2] - _IMAGE[0], _IMAGE[3] - _IMAGE[1])
    frame.paste(_depth_picture(look.depth).resize(size, Image.Resampling.NEAREST), _IMAGE[:2])
    belief = look.belief
    labels = np.argsort(-belief.probabilities)[:7]
    draw.text((492, 184), "what the agent believes", fill=_FAINT, font=small)
    for row, label in enumerate(labels):
        top, share = 204 + 21 * row, float(belief.probabilities[label])
        draw.text((492, top), classes[label], fill=_INK, font=small)
        draw.rectangle((570, top, 570 + int(100 * share), top + 13), fill=_BEST if label == belief.label else _BAR)
        draw.text((676, top), f"{100 * share:.0f} %", fill=_INK, font=small)
    return frame


def _depth_picture(depth: np.ndarray) -> Image.Image:
    """Near is dark; what was not measured is white."""
    known = np.isfinite(depth) & (depth > 0)
    if not known.any():
        return Image.new("RGB", depth.shape[::-1], "white")
    near, far = np.quantile(depth[known], (0.01, 0.95))
    grey = np.clip((depth - near) / max(far - near, 1e-6), 0, 1, where=known, out=np.ones_like(depth))
    return Image.fromarray((40 + 190 * np.where(known, grey, 1.13)).clip(0, 255).astype(np.uint8)).convert("RGB")
