"""The drawing of frames on the page on concepts: `python docs/images/drawings.py` writes `geometry.svg`.

The other drawing, `loop.svg`, is its own source.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

INK, GREY, MARK, SOFT = "#1b2a41", "#6b7785", "#c1440e", "#e8ddcf"
AXES = {"x": "#b3261e", "y": "#2e7d32", "z": "#1565c0"}
HEAD = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1030 420" font-family="sans-serif" font-size="15">'
    '<defs><marker id="tip" viewBox="0 0 10 10" refX="8" refY="5" markerWidth="7" markerHeight="7" orient="auto-start-reverse">'
    '<path d="M0 0 L10 5 L0 10 z" fill="context-stroke"/></marker></defs>'
    '<rect width="1030" height="420" fill="white"/>'
)
Point = tuple[float, float]
Corner = tuple[float, float, float]


class Drawing:
    """Parts of an SVG, in order."""

    def __init__(self) -> None:
        self.parts = [HEAD]

    def text(
        self, at: Point, words: str, colour: str = INK, anchor: str = "start", size: int = 15, more: str = ""
    ) -> None:
        where = f'x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}"'
        self.parts.append(f'<text {where} fill="{colour}" font-size="{size}" {more}>{words}</text>')

    def title(self, at: Point, words: str) -> None:
        self.text(at, words, size=17, more='font-weight="bold"')

    def line(
        self,
        start: Point,
        end: Point,
        colour: str = INK,
        width: float = 1.5,
        arrow: bool = False,
        dashed: bool = False,
    ) -> None:
        where = f'x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}"'
        more = ' marker-end="url(#tip)"' * arrow + ' stroke-dasharray="5 4"' * dashed
        self.parts.append(f'<line {where} stroke="{colour}" stroke-width="{width}"{more}/>')

    def circle(self, centre: Point, radius: float, more: str) -> None:
        self.parts.append(f'<circle cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" r="{radius}" {more}/>')

    def dot(self, centre: Point, radius: float, colour: str = INK) -> None:
        self.circle(centre, radius, f'fill="{colour}"')

    def sphere(self, centre: Point, radius: float) -> None:
        self.circle(centre, radius, f'fill="#f3f6f9" stroke="{GREY}" stroke-dasharray="5 4"')

    def polygon(self, points: list[Point], fill: str, stroke: str = GREY, width: float = 1) -> None:
        corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        edge = f'stroke="{stroke}" stroke-width="{width}" stroke-linejoin="round"'
        self.parts.append(f'<polygon points="{corners}" fill="{fill}" {edge}/>')

    def rectangle(self, at: Point, width: float, height: float, more: str) -> None:
        self.parts.append(f'<rect x="{at[0]}" y="{at[1]}" width="{width}" height="{height}" {more}/>')


class Scene:
    """Points in space, seen from afar."""

    def __init__(self, middle: Point, scale: float, azimuth: float, elevation: float) -> None:
        a, e = np.radians(azimuth), np.radians(elevation)
        self.right = np.array([-np.sin(a), np.cos(a), 0])
        self.up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
        self.middle, self.scale = middle, scale

    def __call__(self, point: np.ndarray) -> Point:
        x, y = self.scale * (self.right @ point), self.scale * (self.up @ point)
        return float(self.middle[0] + x), float(self.middle[1] - y)


def box(draw: Drawing, scene: Scene, low: Corner, high: Corner, seen: str) -> None:
    """The sides of a box that face the reader, from the sides +x, +y, +z named in `seen`."""
    shades = {"x": "#d9cbb8", "y": "#cbbca6", "z": SOFT}
    for axis in map("xyz".index, seen):
        one, other = (number for number in range(3) if number != axis)
        corners = []
        for first, second in ((0, 0), (1, 0), (1, 1), (0, 1)):
            corner = np.array(high, float)
            corner[one], corner[other] = (low, high)[first][one], (low, high)[second][other]
            corners.append(scene(corner))
        draw.polygon(corners, shades["xyz"[axis]])


def frames(draw: Drawing) -> None:
    """The object's frame and the camera's, in space."""
    scene = Scene((130, 245), 100, azimuth=38, elevation=20)
    position = 2 * np.array([-0.42, 0.80, 0.42])
    forward = -position / 2
    position, forward = position / np.linalg.norm(forward), forward / np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    centre, camera = scene(np.zeros(3)), scene(position)
    draw.title((20, 28), "Frames")
    draw.sphere(centre, 100)
    for x, y in ((-0.4, -0.4), (0.25, -0.4), (-0.4, 0.25), (0.25, 0.25)):
        box(draw, scene, (x, y, -0.75), (x + 0.15, y + 0.15, -0.15), "xy")
    box(draw, scene, (-0.4, -0.4, -0.15), (0.4, 0.4, 0.0), "xyz")
    box(draw, scene, (-0.4, -0.4, 0.0), (-0.25, 0.4, 0.8), "xyz")
    for name, axis, beside in zip("xyz", np.eye(3), ((-14, 4), (6, 4), (6, -4)), strict=True):
        end = scene(1.3 * axis)
        draw.line(centre, end, AXES[name], 2.2, arrow=True)
        draw.text((end[0] + beside[0], end[1] + beside[1]), name, AXES[name])
    draw.text((centre[0] - 98, centre[1] + 128), "object: centre, radius 1, z up", GREY, size=14)
    plane = [
        scene(position + 0.42 * (forward + np.tan(np.radians(30)) * (column * right + row * down)))
        for row, column in ((-1, -1), (-1, 1), (1, 1), (1, -1))
    ]
    for corner in plane:
        draw.line(camera, corner, GREY, 1)
    draw.polygon(plane, "#dfe7ef88", INK, 1.5)
    draw.line(scene(position + 0.45 * forward), centre, GREY, 1, dashed=True)
    for name, axis, beside in (("x", right, (6, -4)), ("y", down, (8, 6)), ("z", forward, (-4, -10))):
        end = scene(position + 0.75 * axis)
        draw.line(camera, end, AXES[name], 2.2, arrow=True)
        draw.text((end[0] + beside[0], end[1] + beside[1]), name, AXES[name])
    draw.dot(camera, 4)
    draw.text((camera[0] - 70, camera[1] - 72), "camera: x right,", GREY, size=14)
    draw.text((camera[0] - 70, camera[1] - 54), "y down, z forward", GREY, size=14)


def side(draw: Drawing) -> None:
    """Distance, field of view and depth, from the side."""
    left, top, scale = 480.0, 235.0, 88.0
    centre, (x, y) = (left + 75, top), (left + 75 + 2 * scale, top)
    draw.title((left + 20, 28), "Distance and depth")
    draw.sphere(centre, scale)
    reach, half = 1.95 * scale, np.radians(30)
    for sign in (-1, 1):
        draw.line((x, y), (x - reach * np.cos(half), y + sign * reach * np.sin(half)), GREY, 1.2)
    draw.parts.append(f'<path d="M {x - 45:.1f} {y - 26:.1f} a 52 52 0 0 0 0 52" fill="none" stroke="{GREY}"/>')
    draw.text((x - 30, y - 34), "60°", GREY, "middle")
    u, v = centre[0] + 30, centre[1] - 62
    draw.polygon([(u - 62, v), (u, v), (u, v + 105), (u - 62, v + 105)], SOFT)
    draw.line((x, y), (u, v), MARK, 1.5, dashed=True)
    draw.text((u + 44, v + 4), "ray", MARK)
    draw.line((x, y + 118), (u, y + 118), AXES["z"], 2, arrow=True)
    draw.line((x, y + 8), (x, y + 124), GREY, 0.8, dashed=True)
    draw.line((u, v), (u, y + 124), GREY, 0.8, dashed=True)
    draw.text(((x + u) / 2, y + 138), "depth, along z", AXES["z"], "middle")
    draw.line((x, top - 118), (centre[0], top - 118), INK, 1.5, arrow=True)
    draw.line((centre[0], top - 118), (x, top - 118), INK, 1.5, arrow=True)
    draw.text(((x + centre[0]) / 2, top - 126), "2 radii", INK, "middle")
    draw.dot((x, y), 4)
    draw.dot((u, v), 3.5, MARK)
    draw.dot(centre, 3)


def image(draw: Drawing) -> None:
    """The image: the sphere in it, and where pixels have their centres."""
    left, top, half, cell = 815.0, 130.0, 95.0, 21.0
    draw.title((left, 28), "Image and pixels")
    draw.rectangle((left, top), 2 * half, 2 * half, f'fill="white" stroke="{INK}" stroke-width="1.5"')
    draw.sphere((left + half, top + half), half)
    draw.text((left + half, top + half - 4), "the unit sphere", GREY, "middle", 14)
    draw.text((left + half, top + half + 14), "fits exactly", GREY, "middle", 14)
    for row, column in np.ndindex(2, 2):
        x, y = left + column * cell, top + row * cell
        draw.rectangle((x, y), cell, cell, f'fill="white" stroke="{GREY}"')
        draw.dot((x + cell / 2, y + cell / 2), 2.4, MARK)
    draw.line((left, top - 14), (left + 95, top - 14), AXES["x"], 2, arrow=True)
    draw.text((left + 101, top - 9), "u (column)", AXES["x"])
    draw.line((left - 14, top), (left - 14, top + 95), AXES["y"], 2, arrow=True)
    draw.text((left - 20, top + 114), "v", AXES["y"])
    draw.text((left - 5, top - 62), "centre of the first pixel:", MARK, size=14)
    draw.text((left - 5, top - 44), "K: (0, 0) · Camera: (½, ½)", MARK, size=14)


if __name__ == "__main__":
    drawing = Drawing()
    for part in (frames, side, image):
        part(drawing)
    Path(__file__).with_name("geometry.svg").write_text("\n".join([*drawing.parts, "</svg>\n"]))
