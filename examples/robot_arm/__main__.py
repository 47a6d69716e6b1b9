"""`python -m examples.robot_arm [--object chair] [--film walk.gif] [--study] [--find NAME --among NAME=FILE …] [--table DIR]`.

Without options an arm recognises one piece of furniture that no network was trained on. `--study` compares ways to choose views
on fifty of them, from three first views each, under the same reachability. `--find` looks for one of your objects: they are
enrolled from their meshes, and stand on the table one after another. `--table` enrols the meshes of a folder and recognises some
of them that stand on the table together; with `--study`, it compares ways to choose on many tables.
"""

from __future__ import annotations

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # without a display; read when MuJoCo is imported

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import mevs_jax
from data_pipeline.errors import DataError
from data_pipeline.objects.furniture import CLASSES


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m examples.robot_arm", description=__doc__)
    add = parser.add_argument
    add("--system", help="trained system: a run, a folder or a name (furniture10; objects, with --table)")
    add("--object", default="chair", choices=CLASSES, help="what stands on the table (chair)")
    add("--seed", type=int, default=0, help="which one of its kind (0)")
    add(
        "--policy", default="information_gain, near", help='a policy; "POLICY, near", which pays for motion; or nearest'
    )
    add("--sensor", default="stereo", choices=("stereo", "structured-light", "none"))
    add("--views", type=int, default=4, help="most views of an object (4)")
    add("--stop", type=float, default=0.95, help="calibrated probability at which to stop (0.95)")
    add("--film", type=Path, help="write a film of it, as .gif")
    add("--among", nargs="+", default=(), metavar="NAME=FILE", help="meshes of objects to enrol, for --find")
    add("--find", metavar="NAME", help="the object of --among that is looked for")
    add("--study", action="store_true", help="compare ways to choose, on many objects")
    add("--each", type=int, default=5, help="objects of each class in the study (5)")
    add("--to", type=Path, help="write the study's figures into this .json")
    add("--table", metavar="FOLDER", help="of meshes, each an object of its own, some of which stand on the table")
    add("--metres", type=float, default=1.0, help="in one unit of these meshes (1)")
    add("--objects", type=int, default=5, help="objects on the table (5)")
    add("--tables", type=int, default=30, help="tables of the study (30)")
    options = parser.parse_args()
    if min(options.each, options.objects, options.tables) < 1 or options.seed < 0:
        parser.error("--each, --objects and --tables must be at least 1, and --seed at least 0")
    if (options.find is None) != (not options.among):
        parser.error("--find NAME needs --among NAME=FILE ..., and --among needs --find")
    options.system = options.system or ("objects" if options.table else "furniture10")
    for path, suffix in ((options.film, ".gif"), (options.to, ".json")):
        if path is not None and (path.suffix.lower() != suffix or not path.parent.is_dir()):
            parser.error(f"{path} must be a {suffix} in a folder that exists")
    try:
        import mujoco

        act = _act(options, parser)
        mujoco.GLContext(64, 64).free()
    except ImportError as error:
        parser.error(f"this example needs MuJoCo ({error}): pip install mujoco")
    except AttributeError as error:
        parser.error(f"MuJoCo cannot draw here ({error}): install libegl1 and libgl1-mesa-dri, or set MUJOCO_GL")
    except (ValueError, OSError) as error:
        parser.error(str(error))
    try:
        act()
    except DataError as error:
        parser.error(str(error))


def _act(options: argparse.Namespace, parser: argparse.ArgumentParser) -> Callable[[], None]:
    if options.find is not None:
        return _find(options)
    return _table(options) if options.table else _furniture(options, parser)


def _furniture(options: argparse.Namespace, parser: argparse.ArgumentParser) -> Callable[[], None]:
    from examples.robot_arm import running
    from examples.robot_arm.looking import agent_of

    system = mevs_jax.load(options.system)
    if missing := sorted(set(CLASSES) - set(system.classes)):
        parser.error(f"{options.system} does not know {', '.join(missing)}, which may stand on the table")
    policies = running.POLICIES if options.study else (options.policy,)
    agents = {name: agent_of(system, name, options.views, options.stop) for name in policies}
    for agent in agents.values():
        agent.warm_up()
    return (
        partial(running.study, agents, options)
        if options.study
        else lambda: running.show(agents[options.policy], options)
    )


def _table(options: argparse.Namespace) -> Callable[[], None]:
    from examples.robot_arm import table, together

    meshes = table.meshes_of(options.table, options.metres)
    if options.objects > len(meshes):
        raise ValueError(
            f"{options.table} has {len(meshes)} objects that fit on the table; take at most so many --objects"
        )
    shapes = {name: (mesh.vertices * mesh.radius, mesh.faces) for name, mesh in meshes.items()}
    system = mevs_jax.enrol(shapes, options.system)
    return partial(together.study_tables if options.study else together.show_table, meshes, system, options)


def _find(options: argparse.Namespace) -> Callable[[], None]:
    from examples.robot_arm import running
    from examples.robot_arm.looking import NEAR, agent_of

    objects = running.meshes_of(options.among)
    system = mevs_jax.enrol({name: (mesh.vertices, mesh.faces) for name, mesh in objects.items()}, true_size=False)
    agent = agent_of(system, "information_gain" + NEAR, options.views, options.stop, options.find)
    agent.warm_up()
    return partial(running.find, agent, objects, options)


if __name__ == "__main__":
    main()
