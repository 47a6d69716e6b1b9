"""`python -m examples.robot_arm [--object chair] [--film walk.gif] [--study] [--system PATH]`.

Without options an arm recognises one piece of furniture that no network was trained on. `--study` compares ways to choose views
on fifty of them, from three first views each, under the same reachability.
"""

from __future__ import annotations

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # without a display; read when MuJoCo is imported

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

import mevs_jax
from data_pipeline.objects.furniture import CLASSES
from data_pipeline.objects.mesh import Mesh, normalise
from data_pipeline.objects.recipes import FurniturePiece
from eval.numbers.comparison import intervals
from mevs_jax.markdown import markdown_table

POLICIES = ("random", "nearest", "best", "information_gain", "information_gain, near")
FIRSTS = 3
"""First views of each object in the study."""
HELD_OUT = 1_000_000
"""Seeds from here on are those of test objects; networks are trained on others."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m examples.robot_arm", description=__doc__)
    parser.add_argument(
        "--system", default="furniture10", help="trained system: a run, a folder or a name (furniture10)"
    )
    parser.add_argument("--object", default="chair", choices=CLASSES, help="what stands on the table (chair)")
    parser.add_argument("--seed", type=int, default=0, help="which one of its kind (0)")
    parser.add_argument(
        "--policy", default="information_gain, near", help='a policy; "POLICY, near", which pays for motion; or nearest'
    )
    parser.add_argument("--sensor", default="stereo", choices=("stereo", "structured-light", "none"))
    parser.add_argument("--views", type=int, default=4, help="most views of an object (4)")
    parser.add_argument("--stop", type=float, default=0.95, help="calibrated probability at which to stop (0.95)")
    parser.add_argument("--film", type=Path, help="write a film of it, as .gif")
    parser.add_argument("--study", action="store_true", help="compare ways to choose, on many objects")
    parser.add_argument("--each", type=int, default=5, help="objects of each class in the study (5)")
    parser.add_argument("--to", type=Path, help="write the study's figures into this .json")
    options = parser.parse_args()
    if options.each < 1 or options.seed < 0:
        parser.error("--each must be at least 1, and --seed at least 0")
    for path, suffix in ((options.film, ".gif"), (options.to, ".json")):
        if path is not None and (path.suffix.lower() != suffix or not path.parent.is_dir()):
            parser.error(f"{path} must be a {suffix} in a folder that exists")
    try:
        import mujoco

        from examples.robot_arm.looking import agent_of

        system = mevs_jax.load(options.system)
        if missing := sorted(set(CLASSES) - set(system.classes)):
            parser.error(f"{options.system} does not know {', '.join(missing)}, which may stand on the table")
        agents = {name: agent_of(system, name, options.views, options.stop) for name in _wanted(options)}
        mujoco.GLContext(64, 64).free()
    except ImportError as error:
        parser.error(f"this example needs MuJoCo ({error}): pip install mujoco")
    except AttributeError as error:
        parser.error(f"MuJoCo cannot draw here ({error}): install libegl1 and libgl1-mesa-dri, or set MUJOCO_GL")
    except (ValueError, OSError) as error:
        parser.error(str(error))
    for agent in agents.values():
        agent.warm_up()
    if options.study:
        study(agents, options)
    else:
        show(agents[options.policy], options)


def _wanted(options: argparse.Namespace) -> tuple[str, ...]:
    return POLICIES if options.study else (options.policy,)


def piece(kind: str, seed: int) -> Mesh:
    """A piece of furniture that no network was trained on."""
    return normalise(*FurniturePiece(kind, HELD_OUT + seed).load(), kind)


def show(agent: Any, options: argparse.Namespace) -> None:
    """Recognises one object, and films it."""
    from examples.robot_arm.arm import Arm
    from examples.robot_arm.camera import DepthCamera
    from examples.robot_arm.film import write_film
    from examples.robot_arm.looking import recognise
    from examples.robot_arm.scene import RADIUS, make_scene

    scene = make_scene(piece(options.object, options.seed))
    camera = DepthCamera(scene, options.sensor)
    camera.begin(options.seed)
    agent.reset(center=scene.center, radius=RADIUS, yaw=0.0, true_size=False)
    arm = Arm(scene)
    reach = arm.reach(agent.poses)
    free = np.isfinite(arm.costs(reach)[0])
    print(f"{free.sum()} of {len(free)} viewpoints can be reached")
    if not free.any():
        return
    found = recognise(agent, scene, camera, reach, int(np.argmax(free)), frames=14 if options.film else 1)
    for number, look in enumerate(found.looks, 1):
        sure = 100 * look.belief.confidence
        print(f"view {number}: {look.belief.name}, {sure:.1f} % ({1e3 * look.seconds:.0f} ms to decide)")
    views = f"{len(found.looks)} view{'s' * (len(found.looks) != 1)}"
    print(f"{found.name} after {views} ({found.reason}), {found.radians:.1f} rad of joint motion after the first")
    if options.film and found.looks:
        write_film(found, scene, camera, agent.system.classes, options.film)
        print(f"Film: {options.film}")
    camera.close()


def study(agents: dict[str, Any], options: argparse.Namespace) -> None:
    """Compares policies by objects recognised, views, and joint motion."""
    from examples.robot_arm.arm import Arm
    from examples.robot_arm.camera import DepthCamera
    from examples.robot_arm.looking import recognise
    from examples.robot_arm.scene import RADIUS, make_scene

    rows: dict[str, list[list[float]]] = {name: [] for name in POLICIES}
    reached = []
    for kind, seed in ((kind, seed) for kind in CLASSES for seed in range(options.each)):
        scene = make_scene(piece(kind, seed))
        camera, arm = DepthCamera(scene, options.sensor), Arm(scene)
        agents["best"].reset(center=scene.center, radius=RADIUS, yaw=0.0, true_size=False)
        reach = arm.reach(agents["best"].poses)
        firsts = np.flatnonzero(np.isfinite(arm.costs(reach)[0]))
        reached.append(len(firsts))
        if not len(firsts):
            sys.exit(f"no viewpoint of {kind} {seed} can be reached")
        for first in firsts[np.linspace(0, len(firsts) - 1, FIRSTS).astype(int)]:
            for name, agent in agents.items():
                camera.begin(CLASSES.index(kind) * 10_000 + seed, int(first))
                found = recognise(agent, scene, camera, reach, int(first))
                seconds = float(np.mean([look.seconds for look in found.looks] or [0.0]))
                rows[name].append([found.name == kind, len(found.looks), found.radians, seconds])
        camera.close()
        right = (f"{name} {np.mean([row[0] for row in rows[name][-FIRSTS:]]):.2f}" for name in rows)
        print(f"{kind} {seed}: {', '.join(right)}", file=sys.stderr)
    figures = {name: _figures(np.array(found, float), np.array(rows["random"], float)) for name, found in rows.items()}
    count, viewpoints = options.each * len(CLASSES), len(agents["random"].system.viewpoints)
    print(
        f"{count} objects, {FIRSTS} first views each; {np.mean(reached):.1f} of {viewpoints} viewpoints can be reached"
    )
    header = ["views chosen by", "right, %", "less random", "views", "joint motion, rad", "ms to decide"]
    print(markdown_table(header, [_row(name, of) for name, of in figures.items()]))
    if options.to:
        options.to.write_text(json.dumps({"reached": reached, "policies": figures}, indent=1))


def _figures(rows: np.ndarray, random: np.ndarray) -> dict[str, Any]:
    """Means with 95 % intervals over objects; rows are (right, views, radians, seconds), one for each first view of an object."""
    by_object, base = (array.reshape(-1, FIRSTS, array.shape[1]).mean(axis=1) for array in (rows, random))
    values = dict(zip(("right", "views", "radians", "seconds"), by_object.T, strict=True))
    values["gain"] = by_object[:, 0] - base[:, 0]
    return {name: [float(of.mean()), *intervals(of)] for name, of in values.items()}


def _row(name: str, of: dict[str, Any]) -> list[str]:
    def cell(key: str, scale: float, sign: str = "") -> str:
        middle, low, high = (scale * value for value in of[key])
        return f"{middle:{sign}.1f} [{low:{sign}.1f}, {high:{sign}.1f}]"

    cells = [cell("right", 100), cell("gain", 100, "+"), cell("views", 1), cell("radians", 1)]
    return [name, *cells, f"{1e3 * of['seconds'][0]:.0f}"]


if __name__ == "__main__":
    main()
