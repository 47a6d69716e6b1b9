"""A film of a recognition: the arm, what its camera sees, and what the agent believes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from examples.robot_arm.arm import Arm
from examples.robot_arm.camera import DepthCamera
from examples.robot_arm.scene import Scene

SIZE = (720, 360)
"""Of the film, in pixels."""
_ARM, _IMAGE = (0, 0, 480, 360), (492, 12, 708, 174)
_INK, _FAINT, _BAR, _BEST = (30, 35, 40), (120, 128, 136), (150, 175, 205), (220, 120, 40)


@dataclass(frozen=True)
class Shot:
    """A look, as the film shows it.

    Attributes:
        title: what is seen.
        passed: joint angles on the way there.
        depth: the image, in metres.
        bars: what is believed after it: a name, a probability, and whether its bar stands out.
    """

    title: str
    passed: list[np.ndarray]
    depth: np.ndarray
    bars: list[tuple[str, float, bool]]


def write_film(shots: Sequence[Shot], scene: Scene, camera: DepthCamera, path: Path) -> None:
    """Writes a GIF, whose last frame stays for three seconds."""
    frames, times, arm = [], [], Arm(scene)
    for number, shot in enumerate(shots):
        for angles in shot.passed[:-1]:
            arm.place(angles)
            before = shots[number - 1] if number else None
            frames.append(_frame(camera.picture("outside"), before, f"moving to view {number + 1}"))
        arm.place(shot.passed[-1])
        frames.append(_frame(camera.picture("outside"), shot, shot.title))
        times += [70] * (len(shot.passed) - 1) + [900]
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


def _frame(picture: np.ndarray, shot: Shot | None, title: str) -> Image.Image:
    frame = Image.new("RGB", SIZE, "white")
    frame.paste(Image.fromarray(picture).resize((_ARM[2], _ARM[3])), (0, 0))
    draw, font, small = ImageDraw.Draw(frame), ImageFont.load_default(14), ImageFont.load_default(11)
    draw.text((12, 10), title, fill=_INK, font=font)
    if shot is None:
        draw.rectangle(_IMAGE, outline=_FAINT)
        return frame
    image = _depth_picture(shot.depth)
    image.thumbnail((_IMAGE[2] - _IMAGE[0], _IMAGE[3] - _IMAGE[1]), Image.Resampling.NEAREST)
    frame.paste(image, _IMAGE[:2])
    draw.text((492, 184), "what the agent believes", fill=_FAINT, font=small)
    for row, (name, share, best) in enumerate(shot.bars):
        top = 204 + 21 * row
        draw.text((492, top), name[:14], fill=_INK, font=small)
        draw.rectangle((580, top, 580 + int(90 * share), top + 13), fill=_BEST if best else _BAR)
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
