"""The history of an agent in a browser, in 3-D: what each view showed, the candidates, and the belief. Needs viser."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mevs_jax.agent.records import History
from mevs_jax.geometry.cameras import partial_cloud
from mevs_jax.trained.situation import REPEATED
from mevs_jax.trained.system import TrainedSystem

if TYPE_CHECKING:
    import viser

_NEW, _SEEN, _PATH = (224, 138, 46), (130, 150, 173), (200, 30, 30)
_LOW, _HIGH, _UNKNOWN = np.array([219, 231, 245]), np.array([8, 48, 107]), (150, 150, 150)
"""Colours: of the lowest and the highest expected gain, and of candidates whose gain is not known."""
_SMALLEST, _LARGEST = 0.02, 0.06
_SHOWN = 5
_LEGEND = (
    "Spheres are candidate views: the larger and darker, the higher the expected gain; small and grey, not known. Large orange "
    "points are new with this view, small blue ones were seen before. Red: the cameras and their way."
)


def view(history: History, system: TrainedSystem, *, host: str = "127.0.0.1", port: int = 8080) -> viser.ViserServer:
    """Serves a 3-D scene of a history, with a slider over the views; the unit is the object's radius.

    Every view shows its points, large and orange in the step in which they are new, smaller and blue later. Candidates are
    darker and larger, the higher their expected gain is; grey where the system does not know it.

    Args:
        history: of an agent, as `Walk.history`, or from `mevs_jax.agent.load_history`.
        system: that made it.
        host: address to listen at; `0.0.0.0` lets other machines see it.
        port: to listen at; the next free one if it is taken.

    Returns:
        The server, which runs in the background: `sleep_forever` waits, `stop` ends it.

    Raises:
        ImportError: without viser.
        ValueError: for a history without views.
    """
    try:
        import viser
    except ImportError as error:
        raise ImportError("viewing a walk needs viser: pip install 'mevs-jax[view]'") from error
    if not history.views:
        raise ValueError("the history has no views")
    server = viser.ViserServer(host=host, port=port, label="mevs_jax", verbose=False)
    server.scene.set_up_direction("+z")
    server.initial_camera.position, server.initial_camera.look_at = (3.2, 2.4, 2.0), (0.0, 0.0, 0.0)
    _add_views(server, history, system)
    slider = server.gui.add_slider("views seen", min=1, max=max(2, history.views), step=1, initial_value=1)
    text = server.gui.add_html("")

    def show(step: int) -> None:
        step = min(step, history.views)
        with server.atomic():
            _show_views(server, history, step)
            _show_candidates(server, system, history, step)
        text.content = _belief(history, system, step)

    slider.on_update(lambda _: show(int(slider.value)))
    show(1)
    return server


def after(history: History, step: int) -> dict[str, Any]:
    """The decision after `step` views: the last `decide` before the next view; an empty dictionary if there is none."""
    count, found = 0, {}
    for event in history.events:
        if event["call"] == "observe":
            count += 1
        if count > step:
            break
        if count == step and event["call"] == "decide":
            found = event
    return found


def clouds_of(history: History, system: TrainedSystem) -> list[Float[np.ndarray, "points 3"]]:
    """The points that each view shows, in the object's frame, in radii."""
    camera, found = system.description.camera, []
    for depth, pose in zip(history.depths, history.poses, strict=True):
        points, hit = partial_cloud(jnp.asarray(depth), camera.at(pose, len(depth)))
        found.append(np.asarray(points)[np.asarray(hit)])
    return found


def _add_views(server: viser.ViserServer, history: History, system: TrainedSystem) -> None:
    """Adds the points and the camera of every view, and the ways between the cameras."""
    camera, size = system.description.camera, 1.2 / max(1, len(history.depths[0]))
    angle = camera.radians
    for number, (points, pose) in enumerate(zip(clouds_of(history, system), history.poses, strict=True), 1):
        for name, colour, larger in (("new", _NEW, 2.4), ("seen", _SEEN, 1.2)):
            server.scene.add_point_cloud(
                f"/{name}/{number}", points.astype(np.float32), colour, point_size=larger * size, point_shape="circle"
            )
        depth = history.depths[number - 1]
        grey = np.where(depth > 0, np.clip(255 * (camera.distance + 1 - depth) / 2, 0, 255), 0).astype(np.uint8)
        server.scene.add_camera_frustum(
            f"/cameras/{number}",
            fov=angle,
            aspect=1.0,
            scale=0.25,
            color=_PATH,
            image=np.repeat(grey[..., None], 3, axis=-1),
            wxyz=_quaternion(pose[:3, :3]),
            position=pose[:3, 3],
        )
        server.scene.add_label(f"/cameras/{number}/number", str(number))
        if number > 1:
            way = way_around(history.poses[number - 2][:3, 3], pose[:3, 3])
            server.scene.add_spline_catmull_rom(f"/ways/{number}", way, thickness=0.012, color=_PATH)


def _show_views(server: viser.ViserServer, history: History, step: int) -> None:
    for number in range(1, history.views + 1):
        shown = {"new": number == step, "seen": number < step, "cameras": number <= step, "ways": 1 < number <= step}
        for name, visible in shown.items():
            handle = server.scene.get_handle_by_name(f"/{name}/{number}")
            if handle is not None:
                handle.visible = visible


def _show_candidates(server: viser.ViserServer, system: TrainedSystem, history: History, step: int) -> None:
    """Draws the candidates that the agent chose from after `step` views."""
    decision = after(history, step)
    directions = np.asarray(decision.get("directions", system.viewpoints))
    gains = np.array([np.nan if gain is None else gain for gain in decision.get("gains", [None] * len(directions))])
    seen = np.stack([pose[:3, 3] / np.linalg.norm(pose[:3, 3]) for pose in history.poses[:step]])
    left = (directions @ seen.T).max(axis=1) < np.cos(REPEATED)
    known = left & np.isfinite(gains)
    low, high = (gains[known].min(), gains[known].max()) if known.any() else (0.0, 0.0)
    server.scene.remove_by_name("/candidates")
    for index in np.flatnonzero(left):
        share = (gains[index] - low) / (high - low) if known[index] and high > low else 0.5
        colour = tuple(int(c) for c in _LOW + share * (_HIGH - _LOW)) if known[index] else _UNKNOWN
        server.scene.add_icosphere(
            f"/candidates/{index}",
            radius=_SMALLEST + share * (_LARGEST - _SMALLEST) if known[index] else _SMALLEST,
            color=colour,
            subdivisions=1,
            position=system.description.camera.distance * directions[index],
        )


def _belief(history: History, system: TrainedSystem, step: int) -> str:
    """The belief after `step` views and the decision that followed, as HTML."""
    probabilities = np.asarray(history.beliefs[step - 1]["probabilities"])
    bars = "".join(
        f"<div>{html.escape(system.classes[label])} {100 * probabilities[label]:.1f} %<br>"
        f'<progress style="width:100%" value="{probabilities[label]:.4f}" max="1" '
        f'aria-label="probability of {html.escape(system.classes[label])}"></progress></div>'
        for label in np.argsort(-probabilities, kind="stable")[:_SHOWN]
    )
    found = after(history, step).get("step")
    said = "" if found is None else f"The end: {found['reason']}." if found["done"] else f"Next: view {found['index']}"
    if found is not None and found["expected_gain"] is not None:
        said += f", expected gain {found['expected_gain']:.3f} nats."
    return f'<div style="padding:0 1em"><b>After {step} of {history.views} views</b>{bars}<p>{said}</p><p>{_LEGEND}</p></div>'


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 4"]:
    """A rotation as a quaternion (w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(np.asarray(rotation, float)).as_quat()[[3, 0, 1, 2]]


def way_around(
    start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"], steps: int = 17
) -> Float[np.ndarray, "steps 3"]:
    """Points on the shortest way around the object from one camera to another."""
    away, last = np.linalg.norm(start), np.linalg.norm(end)
    first, other = start / away, end / last
    cosine = np.clip(first @ other, -1, 1)
    aside = other - cosine * first
    if np.linalg.norm(aside) < 1e-3:  # opposite: any way is the shortest
        aside = np.cross(first, np.eye(3)[np.abs(first).argmin()])
    share = np.linspace(0, 1, steps)[:, None]
    angle = share * np.arccos(cosine)
    points = np.cos(angle) * first + np.sin(angle) * aside / np.linalg.norm(aside)
    return ((1 - share) * away + share * last) * points
