"""`python -m examples.robot_arm [--object chair] [--film walk.gif] [--study] [--system PATH]`.

Without options an arm recognises one piece of furniture that no network was trained on. `--study` compares ways to choose views
on fifty of them, from three first views each, under the same reachability.
"""

from __future__ import annotations

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # without a display; read when MuJoCo is imported

import argparse
from pathlib import Path

import mevs_jax
from data_pipeline.objects.furniture import CLASSES


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m examples.robot_arm", description=__doc__)
    add = parser.add_argument
    add("--system", default="furniture10", help="trained system: a run, a folder or a name (furniture10)")
    add("--object", default="chair", choices=CLASSES, help="what stands on the table (chair)")
    add("--seed", type=int, default=0, help="which one of its kind (0)")
    add(
        "--policy", default="information_gain, near", help='a policy; "POLICY, near", which pays for motion; or nearest'
    )
    add("--sensor", default="stereo", choices=("stereo", "structured-light", "none"))
    add("--views", type=int, default=4, help="most views of an object (4)")
    add("--stop", type=float, default=0.95, help="calibrated probability at which to stop (0.95)")
    add("--film", type=Path, help="write a film of it, as .gif")
    add("--study", action="store_true", help="compare ways to choose, on many objects")
    add("--each", type=int, default=5, help="objects of each class in the study (5)")
    add("--to", type=Path, help="write the study's figures into this .json")
    options = parser.parse_args()
    if options.each < 1 or options.seed < 0:
        parser.error("--each must be at least 1, and --seed at least 0")
    for path, suffix in ((options.film, ".gif"), (options.to, ".json")):
        if path is not None and (path.suffix.lower() != suffix or not path.parent.is_dir()):
            parser.error(f"{path} must be a {suffix} in a folder that exists")
    try:
        import mujoco

        from examples.robot_arm import running
        from examples.robot_arm.looking import agent_of

        system = mevs_jax.load(options.system)
        if missing := sorted(set(CLASSES) - set(system.classes)):
            parser.error(f"{options.system} does not know {', '.join(missing)}, which may stand on the table")
        policies = running.POLICIES if options.study else (options.policy,)
        agents = {name: agent_of(system, name, options.views, options.stop) for name in policies}
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
        running.study(agents, options)
    else:
        running.show(agents[options.policy], options)


if __name__ == "__main__":
    main()
