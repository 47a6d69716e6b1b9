"""The command line `mevs`. It is the one place that knows the library, the data pipeline, the training and the evaluation.

Heavy imports wait until a command needs them, so that `mevs --help` answers at once.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mevs_jax.cli.options import Options

COMMANDS = {
    "run": "data, train, eval and report, skipping what is done",
    "data": "capture objects from every viewpoint, write them as a sharded TFDS data set",
    "train": "train the classifier and the entropy predictor on it",
    "sweep": "train many configurations of one of them as one program",
    "eval": "walk every test object from every start view; write metrics.json",
    "report": "write report/index.html",
    "compat": "train the classifier the published code's way too, evaluate and report again",
    "thesis": "every network, table and figure of the thesis, beside its own numbers",
    "ascend": "climb to the best view of one object by a renderer's gradient; draw it",
    "learned": "learn to fuse views and to choose them; compare with every other policy",
    "climb": "where differentiable rendering would look next; evaluate and report again",
    "live": "walk test objects with the networks in the loop; compare with the tables",
}

_HELP = """usage: mevs COMMAND [--preset small|best|thesis] [--data PATH] [--views N] [--out DIR] [SETTINGS]

Where should a camera look next? Trains the networks of maximum entropy viewpoint selection and
measures how much choosing the next view helps.

commands:
{commands}

common options:
  --preset small|best|thesis
                          small (default): 64×64 views, narrow networks, for a CPU; best: 128×128
                          and wide ones for mevs study learned, thesis: the thesis's sizes, both for an
                          accelerator; tiny: to see it all run in a minute
  --data PATH             furniture10 (default, built in), modelnet10 or modelnet40 (downloaded), a
                          folder <class>/{{train,test}}/ of .off, .obj, .stl, .ply or .glb, a zip of
                          that layout, or an .npz of voxel grids
  --archive FILE          ModelNet10.zip or ModelNet40.zip, where it is here already
  --pretrained FILE ...   ImageNet weights for the classifiers: torchvision's .pth or .safetensors
  --views N               candidate viewpoints around an object (default 40)
  --out DIR               where everything is written (default runs/<preset>); a run goes on there

`mevs COMMAND --help` lists every setting. Examples:
  mevs run
  mevs run --data modelnet10 --out runs/modelnet10
  mevs study thesis --data modelnet10 --archive ModelNet10.zip
  mevs train --out runs/modelnet10 --classifier.optimiser.epochs 20
"""


def _preset_of(arguments: list[str]) -> str:
    """The preset named on the command line; it decides the defaults of all other settings."""
    for position, argument in enumerate(arguments):
        if argument.startswith("--preset="):
            return argument.split("=", 1)[1]
        if argument == "--preset" and position + 1 < len(arguments):
            return arguments[position + 1]
    return "small"


def _parse(command: str, arguments: list[str]) -> Options:
    import tyro

    from data_pipeline.errors import DataError
    from eval.settings import PRESETS
    from mevs_jax.cli.options import Options, options_from

    preset = _preset_of(arguments)
    if preset not in PRESETS:
        raise DataError(f"unknown preset {preset!r}; it is one of {', '.join(PRESETS)}")

    return tyro.cli(
        Options,
        prog=f"mevs {command}",
        description=COMMANDS[command],
        args=arguments,
        default=options_from(preset),  # type: ignore[arg-type]
    )


def _run(command: str, arguments: list[str]) -> None:
    from data_pipeline.errors import DataError

    options = _parse(command, arguments)
    if command != "train" and (options.distributed or options.model_devices != 1):
        raise DataError(
            "--distributed and --model-devices go with mevs train alone; make the data first, then train, then eval"
        )
    if command != "data" and options.beam is not None:
        raise DataError("--beam goes with mevs data alone")
    if options.distributed:
        from train.devices import join_processes

        join_processes()  # before anything is computed
    preset, settings = options.preset, options.settings()
    out = options.out or Path("runs") / (preset if command != "thesis" else f"thesis-{preset}")
    from data_pipeline.progress import console
    from eval import stages
    from train.devices import device_mesh, is_first
    from train.tasks.classifier import starting_weights

    console.quiet = options.distributed and not is_first()

    stages.check_output(out)
    if command == "thesis":
        from eval.thesis.run import reproduce

        if options.views is not None:
            raise DataError(
                "mevs study thesis makes both of the thesis's data sets, of 10 and of 40 views; leave --views out"
            )

        console.print(f"Report: {reproduce(settings, preset, out, options.pretrained).absolute()}")
        return
    if command == "ascend":
        from eval.rendering.ascent import ascend_on

        sentence, path = ascend_on(settings.dataset, settings.ascent, out)
        console.print(sentence)
        console.print(f"Animation: {path.absolute()}")
        return
    if command == "learned":
        console.print(f"Report: {stages.learn_to_choose(settings, out).absolute()}")
        return
    start = starting_weights(options.pretrained, settings.classifier.network)
    if command in ("run", "data"):
        stages.make_data(settings, out, options.beam)
    if command in ("run", "train"):
        stages.train(settings, out, start, device_mesh(options.model_devices))
    if command == "sweep":
        folder, members = stages.train_sweep(settings, out)
        best = min(members, key=lambda member: member.loss)
        console.print(
            f"Best of {len(members)}: validation loss {best.loss:.4f} with learning rate {best.learning_rate:.2e}, weight decay "
            f"{best.weight_decay:.2e}, dropout {best.dropout:.2f}, augmentation {best.augmentation:.2f}"
        )
        console.print(f"All of them: {folder / 'members.md'}; the best network: {folder / 'network'}")
    if command == "compat":
        stages.train_by_view(settings, out, start)
    if command == "climb":
        stages.ascend_on_objects(settings, out)
    if command in ("run", "eval", "compat", "climb"):
        metrics = stages.evaluate(settings, out)
        console.print(
            f"Single views: {100 * metrics['single_view']['accuracy']:.1f} % of {metrics['objects']} test objects right"
        )
        titles = {rung["policy"]: rung["title"] for rung in metrics["ladder"]}
        after_two = ", ".join(
            f"{titles[name]} {100 * metrics['policies'][name]['after_views'][1]:.1f} %"
            for name in ("random", "predicted_entropy", "oracle_entropy", "information_gain")
        )
        console.print(f"After two views: {after_two}")
        console.print(f"Metrics: {out / 'metrics.json'}")
    if command == "live":
        for policy, found in stages.check_live(settings, out).items():
            console.print(
                f"{policy}: {found.same} of {found.walks} walks are the same live as by table "
                f"(confidences within {found.largest_difference:.1e})"
            )
    if command in ("run", "report", "compat", "climb"):
        console.print(f"Report: {stages.report(settings, preset, out).absolute()}")


def _interrupt(signum: int, frame: object) -> None:
    """Ends the job, and tries again in a second: Python loses an interrupt that falls into a finaliser or a GC callback."""
    signal.setitimer(signal.ITIMER_REAL, 1.0)
    raise KeyboardInterrupt


def _begin_with_large_pages() -> None:
    """Begins the program again so that glibc asks Linux for large pages, which it does only if told before: training on two CPU
    cores then takes 11 % (ResNet-34) to 25 % (PointNet++) less time, since every step allots hundreds of megabytes anew.
    """
    alone = Path(sys.argv[0]).name in ("mevs", "__main__.py")  # not called from another program
    if not alone or "CS_GNU_LIBC_VERSION" not in getattr(os, "confstr_names", ()) or "GLIBC_TUNABLES" in os.environ:
        return
    os.environ["GLIBC_TUNABLES"] = "glibc.malloc.hugetlb=1"
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def main() -> None:
    """The program `mevs`.

    Exit codes: 0; 2 for input that cannot be used; 130 when interrupted; 143 when asked to end (SIGTERM), with everything
    saved; 75 when another process of the run was lost. After the last three, the same command goes on where it stopped.
    """
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_HELP.format(commands="\n".join(f"  {name:<8}{what}" for name, what in COMMANDS.items())))
        sys.exit(0 if arguments else 2)
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(version("mevs-jax"))
        return
    if arguments[0] not in COMMANDS:
        print(f"mevs: unknown command {arguments[0]!r}; it is one of {', '.join(COMMANDS)}", file=sys.stderr)
        sys.exit(2)
    _begin_with_large_pages()
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    # Tracing leaves many small objects that live: looking through them as often as Python does takes a twentieth of a short job.
    gc.set_threshold(100_000, 50, 100)
    from data_pipeline.errors import DataError

    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGINT, _interrupt)
        signal.signal(signal.SIGALRM, _interrupt)
    try:
        _run(arguments[0], arguments[1:])
    except (DataError, FloatingPointError) as error:  # the latter: a loss that is no number any more
        print(f"mevs: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0)
        print("mevs: interrupted; the same command goes on where it stopped", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        from train.devices import is_lost_process
        from train.preemption import Preempted

        if isinstance(error, Preempted):
            print(f"mevs: {error} and saved it; the same command goes on from there", file=sys.stderr)
            sys.exit(143)
        if not is_lost_process(error):
            raise
        reason = str(error).splitlines()[0]
        print(
            f"mevs: another process of this run is gone ({reason}); start all of them again with the same command, which goes "
            f"on from the last checkpoint",
            file=sys.stderr,
        )
        sys.stderr.flush()
        os._exit(75)  # JAX's own way out waits for the process that is gone


if __name__ == "__main__":
    main()
