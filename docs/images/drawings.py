"""The drawings of the page on concepts. `python docs/images/drawings.py` writes `geometry.svg` and `loop.svg`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

INK, GREY, MARK, SOFT = "#1b2a41", "#6b7785", "#c1440e", "#e8ddcf"
AXES = {"x": "#b3261e", "y": "#2e7d32", "z": "#1565c0"}
HEAD = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="15">'
    '<defs><marker id="tip" viewBox="0 0 10 10" refX="8" refY="5" markerWidth="7" markerHeight="7" orient="auto-start-reverse">'
    '<path d="M0 0 L10 5 L0 10 z" fill="context-stroke"/></marker></defs>'
    '<rect width="{width}" height="{height}" fill="white"/>'
)
Point = tuple[float, float]


def text(at: Point, words: str, colour: str = INK, anchor: str = "start", size: int = 15, more: str = "") -> str:
    where = f'x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}"'
    return f'<text {where} fill="{colour}" font-size="{size}" {more}>{words}</text>'


def line(
    start: Point, end: Point, colour: str = INK, width: float = 1.5, arrow: bool = False, dashed: bool = False
) -> str:
    more = ' marker-end="url(#tip)"' if arrow else ""
    more += ' stroke-dasharray="5 4"' if dashed else ""
    return (
        f'<line x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}" '
        f'stroke="{colour}" stroke-width="{width}"{more}/>'
    )


def circle(centre: Point, radius: float, more: str) -> str:
    return f'<circle cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" r="{radius}" {more}/>'


def polygon(points: list[Point], fill: str, stroke: str = GREY, width: float = 1) -> str:
    corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return (
        f'<polygon points="{corners}" fill="{fill}" stroke="{stroke}" stroke-width="{width}" stroke-linejoin="round"/>'
    )


SPHERE = f'fill="#f3f6f9" stroke="{GREY}" stroke-dasharray="5 4"'


class Scene:
    """Points in space, seen from afar."""

    def __init__(self, middle: Point, scale: float, azimuth: float, elevation: float) -> None:
        a, e = np.radians(azimuth), np.radians(elevation)
        self.right = np.array([-np.sin(a), np.cos(a), 0])
        self.up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
        self.middle, self.scale = middle, scale

    def __call__(self, point: np.ndarray) -> Point:
        return (
            float(self.middle[0] + self.scale * (self.right @ point)),
            float(self.middle[1] - self.scale * (self.up @ point)),
        )


def box(scene: Scene, low: tuple[float, float, float], high: tuple[float, float, float], seen: str) -> list[str]:
    """The sides of a box that face the reader, from the sides +x, +y, +z named in `seen`."""
    parts = []
    shades = {"x": "#d9cbb8", "y": "#cbbca6", "z": SOFT}
    for axis, name in enumerate("xyz"):
        if name not in seen:
            continue
        others = [other for other in range(3) if other != axis]
        corners = []
        for first, second in ((0, 0), (1, 0), (1, 1), (0, 1)):
            corner = np.array(high, float)
            corner[others[0]] = (low, high)[first][others[0]]
            corner[others[1]] = (low, high)[second][others[1]]
            corners.append(scene(corner))
        parts.append(polygon(corners, shades[name]))
    return parts


def frames() -> list[str]:
    """The object's frame and the camera's, in space."""
    scene = Scene((130, 245), 100, azimuth=38, elevation=20)
    position = 2 * np.array([-0.42, 0.80, 0.42])
    forward = -position / 2
    position, forward = position / np.linalg.norm(forward), forward / np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    parts = [text((20, 28), "Frames", size=17, more='font-weight="bold"')]
    centre = scene(np.zeros(3))
    parts.append(circle(centre, 100, SPHERE))
    for low, high in (((-0.4, -0.4, -0.15), (0.4, 0.4, 0.0)), ((-0.4, -0.4, 0.0), (-0.25, 0.4, 0.8))):
        for x, y in ((-0.4, -0.4), (0.25, -0.4), (-0.4, 0.25), (0.25, 0.25)) if high[2] == 0 else ():
            parts += box(scene, (x, y, -0.75), (x + 0.15, y + 0.15, -0.15), "xy")
        parts += box(scene, low, high, "xyz")
    for name, axis in zip("xyz", np.eye(3), strict=True):
        end = scene(1.3 * axis)
        parts += [line(centre, end, AXES[name], 2.2, arrow=True)]
        parts += [text((end[0] + (6 if name != "x" else -14), end[1] + (4 if name != "z" else -4)), name, AXES[name])]
    parts += [text((centre[0] - 98, centre[1] + 128), "object: centre, radius 1, z up", GREY, size=14)]
    camera = scene(position)
    for row, column in ((-1, -1), (-1, 1), (1, 1), (1, -1)):
        corner = position + 0.42 * (forward + np.tan(np.radians(30)) * (column * right + row * down))
        parts.append(line(camera, scene(corner), GREY, 1))
    plane = [
        scene(position + 0.42 * (forward + np.tan(np.radians(30)) * (column * right + row * down)))
        for row, column in ((-1, -1), (-1, 1), (1, 1), (1, -1))
    ]
    parts.append(polygon(plane, "#dfe7ef88", INK, 1.5))
    parts.append(line(scene(position + 0.45 * forward), centre, GREY, 1, dashed=True))
    for name, axis, length in (("x", right, 0.75), ("y", down, 0.75), ("z", forward, 0.75)):
        end = scene(position + length * axis)
        parts.append(line(camera, end, AXES[name], 2.2, arrow=True))
        label = {"x": (6, -4), "y": (8, 6), "z": (-4, -10)}[name]
        parts.append(text((end[0] + label[0], end[1] + label[1]), name, AXES[name]))
    parts.append(circle(camera, 4, f'fill="{INK}"'))
    parts.append(text((camera[0] - 70, camera[1] - 72), "camera: x right,", GREY, size=14))
    parts.append(text((camera[0] - 70, camera[1] - 54), "y down, z forward", GREY, size=14))
    return parts


def side() -> list[str]:
    """Distance, field of view and depth, from the side."""
    left, top = 480.0, 235.0
    scale = 88.0
    centre, camera = (left + 75, top), (left + 75 + 2 * scale, top)
    parts = [text((left + 20, 28), "Distance and depth", size=17, more='font-weight="bold"')]
    parts.append(circle(centre, scale, SPHERE))
    reach = 1.95 * scale
    for sign in (-1, 1):
        end = (camera[0] - reach * np.cos(np.radians(30)), camera[1] + sign * reach * np.sin(np.radians(30)))
        parts.append(line(camera, end, GREY, 1.2))
    parts.append(
        f'<path d="M {camera[0] - 45:.1f} {camera[1] - 26:.1f} a 52 52 0 0 0 0 52" fill="none" stroke="{GREY}"/>'
    )
    parts.append(text((camera[0] - 30, camera[1] - 34), "60°", GREY, "middle"))
    point = (centre[0] + 30, centre[1] - 62)
    parts.append(
        polygon([(point[0] - 62, point[1]), point, (point[0], point[1] + 105), (point[0] - 62, point[1] + 105)], SOFT)
    )
    parts.append(line(camera, point, MARK, 1.5, dashed=True))
    parts.append(text((point[0] + 44, point[1] + 4), "ray", MARK))
    parts.append(line((camera[0], camera[1] + 118), (point[0], camera[1] + 118), AXES["z"], 2, arrow=True))
    parts.append(line((camera[0], camera[1] + 8), (camera[0], camera[1] + 124), GREY, 0.8, dashed=True))
    parts.append(line(point, (point[0], camera[1] + 124), GREY, 0.8, dashed=True))
    parts.append(text(((camera[0] + point[0]) / 2, camera[1] + 138), "depth, along z", AXES["z"], "middle"))
    parts.append(line((camera[0], top - 118), (centre[0], top - 118), INK, 1.5, arrow=True))
    parts.append(line((centre[0], top - 118), (camera[0], top - 118), INK, 1.5, arrow=True))
    parts.append(text(((camera[0] + centre[0]) / 2, top - 126), "2 radii", INK, "middle"))
    parts += [circle(camera, 4, f'fill="{INK}"'), circle(point, 3.5, f'fill="{MARK}"')]
    parts.append(circle(centre, 3, f'fill="{INK}"'))
    return parts


def image() -> list[str]:
    """The image: the sphere in it, and where pixels have their centres."""
    left, top, size = 815.0, 130.0, 190.0
    parts = [text((left, 28), "Image and pixels", size=17, more='font-weight="bold"')]
    parts.append(
        f'<rect x="{left}" y="{top}" width="{size}" height="{size}" fill="white" stroke="{INK}" stroke-width="1.5"/>'
    )
    parts.append(circle((left + size / 2, top + size / 2), size / 2, SPHERE))
    parts.append(text((left + size / 2, top + size / 2 - 4), "the unit sphere", GREY, "middle", 14))
    parts.append(text((left + size / 2, top + size / 2 + 14), "fits exactly", GREY, "middle", 14))
    cell = 21.0
    for row in range(2):
        for column in range(2):
            x, y = left + column * cell, top + row * cell
            parts.append(f'<rect x="{x}" y="{y}" width="{cell}" height="{cell}" fill="white" stroke="{GREY}"/>')
            parts.append(circle((x + cell / 2, y + cell / 2), 2.4, f'fill="{MARK}"'))
    parts.append(line((left, top - 14), (left + 95, top - 14), AXES["x"], 2, arrow=True))
    parts.append(text((left + 101, top - 9), "u (column)", AXES["x"]))
    parts.append(line((left - 14, top), (left - 14, top + 95), AXES["y"], 2, arrow=True))
    parts.append(text((left - 20, top + 114), "v", AXES["y"]))
    parts.append(text((left - 5, top - 62), "centre of the first pixel:", MARK, size=14))
    parts.append(text((left - 5, top - 44), "K: (0, 0) · Camera: (½, ½)", MARK, size=14))
    return parts


def loop() -> str:
    """The selection loop."""
    width, height = 900, 250
    boxes = [
        (30, "Look", "networks on one view"),
        (250, "Fuse", "belief over classes"),
        (470, "Stop?", "confidence, views, reach"),
        (690, "Choose", "policy scores the views"),
    ]
    parts = [HEAD.format(width=width, height=height)]
    for x, title, what in boxes:
        fill = "#fbeee8" if title == "Choose" else "#f3f6f9"
        parts.append(
            f'<rect x="{x}" y="60" width="180" height="76" rx="8" fill="{fill}" stroke="{INK}" stroke-width="1.5"/>'
        )
        parts.append(text((x + 90, 93), title, INK, "middle", 18, 'font-weight="bold"'))
        parts.append(text((x + 90, 118), what, GREY, "middle", 14))
    for x, word in ((210, "logits"), (430, ""), (650, "no")):
        parts.append(line((x + 2, 98), (x + 38, 98), INK, 2, arrow=True))
        parts.append(text((x + 18, 88), word, GREY, "middle", 13))
    parts.append(
        f'<path d="M 780 136 V 196 H 120 V 140" fill="none" stroke="{MARK}" stroke-width="2" marker-end="url(#tip)"/>'
    )
    parts.append(text((450, 188), "the best view that is not seen yet and can be reached", MARK, "middle", 14))
    parts.append(line((560, 60), (560, 26), INK, 2, arrow=True))
    parts.append(text((572, 38), "yes: name the class", INK, size=14))
    parts.append(line((120, 26), (120, 56), INK, 2, arrow=True))
    parts.append(text((132, 38), "first view", INK, size=14))
    return "\n".join([*parts, "</svg>\n"])


def geometry() -> str:
    """The conventions of frames, distance, depth and pixels."""
    return "\n".join([HEAD.format(width=1030, height=420), *frames(), *side(), *image(), "</svg>\n"])


def main() -> None:
    here = Path(__file__).parent
    (here / "geometry.svg").write_text(geometry())
    (here / "loop.svg").write_text(loop())


if __name__ == "__main__":
    main()
