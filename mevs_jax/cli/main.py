"""The command line `mevs`: the one place that knows all packages. It imports them only when a command needs them.

Results go to standard output, progress and messages to standard error.
"""

from __future__ import annotations

import gc
import os
import platform
import select
import signal
import sys
import warnings
import zlib
from contextlib import redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from mevs_jax.cli.commands import COMMANDS, Command, find, help_text

if TYPE_CHECKING:
    from types import FrameType

    from mevs_jax.cli.parsing import Invocation

_HELP = ("-h", "--help")
_COMPILED_BYTES = 2**30
"""Size of the cache of compiled programs."""


def _fail(message: str, code: int = 2) -> NoReturn:
    print(f"mevs: {message}", file=sys.stderr)
    if (distributed := sys.modules.get("data_pipeline.distributed")) is not None:
        distributed.leave(code)
    sys.exit(code)


def has_checkout() -> bool:
    """Whether the packages of the study are beside this one; if so, they can be imported from then on."""
    import mevs_jax

    root = Path(mevs_jax.__file__).resolve().parents[1]
    if not all((root / package / "__init__.py").is_file() for package in ("data_pipeline", "train", "eval")):
        return False
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    return True


def _run(name: str, arguments: list[str]) -> None:
    import json

    if COMMANDS[name].tool:
        from mevs_jax.cli.parsing import tool_options

        COMMANDS[name].load()(tool_options(name, arguments))
        return
    from data_pipeline.lock import locked
    from data_pipeline.progress import watched
    from eval.consistency import check_output
    from eval.run_file import configuration
    from mevs_jax.cli.parsing import parse

    call = parse(name, arguments)
    if call.options.print_config:
        print(json.dumps(configuration(call.preset, call.settings), indent=1, default=str))
        return
    command = COMMANDS[name]
    if getattr(call.options, "plan", None) is not None:
        from mevs_jax.cli.planning import is_asked, plan

        if is_asked(call.options):  # nothing is written for it
            plan(call)
            return
    hosts: list[str] = []
    if getattr(call.options, "distributed", False):
        from data_pipeline.distributed import hosts_of_all, is_first, join_processes

        join_processes()  # before anything is computed
        hosts = hosts_of_all()
        if not is_first():  # which speaks, keeps the settings, and holds the lock of the run directory
            _run_silently(call, command)
            return
    check_output(call.out)
    if not command.locks or (name == "sweep" and call.settings.sweep.trials):  # whose jobs have locks of their own
        _run_in(call, command)
        return
    with locked(call.out, " ".join(["mevs", *call.arguments]), hosts), watched(call.out):
        _run_in(call, command)


def _run_silently(call: Invocation, command: Command) -> None:
    """Runs a command as one of several processes, of which another one speaks."""
    from data_pipeline.progress import console

    console.quiet = True
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        command.load()(call)


def _run_in(call: Invocation, command: Command) -> None:
    """Runs a command in its output directory, where its settings are kept."""
    from data_pipeline.errors import DataError
    from data_pipeline.files import CHECKS
    from eval.run_file import NAME, load_run
    from mevs_jax.cli.parsing import keep_settings

    def is_made() -> bool:
        return any((call.out / made).exists() for made in ("data", "classifier", "entropy", "learned"))

    begins, continued = command.writes_run and load_run(call.out) is None, is_made()
    if begins:  # a run that is interrupted continues with the same settings
        keep_settings(call)
    try:
        command.load()(call)
    except DataError:
        if begins and (continued or not is_made()):  # settings that were refused do not become those of the run
            for kept in (NAME, *([CHECKS] if not continued else [])):
                (call.out / kept).unlink(missing_ok=True)
        raise
    if command.writes_run:
        keep_settings(call)


def _interrupt(signum: int, frame: FrameType | None) -> None:
    """Ends the job, and tries again in a second: Python loses an interrupt that falls into a finaliser or a GC callback.

    An import is not interrupted: extension modules may abort the process then.
    """
    imports = False
    while frame is not None and not imports:
        imports, frame = frame.f_code.co_filename.startswith("<frozen importlib"), frame.f_back
    signal.setitimer(signal.ITIMER_REAL, 0.1 if imports else 1.0)
    if not imports:
        raise KeyboardInterrupt


def _leave_interrupts() -> None:
    """Lets an interrupt end the process from now on: all is done or said, and no Python code can handle one while Python ends."""
    sys.stdout.flush()
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGINT, signal.SIG_DFL if _is_a_program() else signal.default_int_handler)


def _say_unraisable(lost: sys.UnraisableHookArgs) -> None:
    """Prints an exception that Python cannot raise, as Python does, except an interrupt, which comes again."""
    if not issubclass(lost.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(lost)


def _is_a_program() -> bool:
    """Whether this is the program `mevs`, and not a part of another one that calls it."""
    return Path(sys.argv[0]).name in ("mevs", "__main__.py")


def _begin_with_large_pages() -> None:
    """Starts the program again with large pages, which glibc requests from Linux only if an environment variable says so.

    Training on two CPU cores then takes 11 % (ResNet-34) to 25 % (PointNet++) less time, since every step allocates hundreds of
    megabytes anew.
    """
    if (
        not _is_a_program()
        or "CS_GNU_LIBC_VERSION" not in getattr(os, "confstr_names", ())
        or "GLIBC_TUNABLES" in os.environ
    ):
        return
    os.environ["GLIBC_TUNABLES"] = "glibc.malloc.hugetlb=1"
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _keep_compiled() -> None:
    """Lets JAX keep what it compiles in the user's cache folder, so that a second job does not compile it again.

    The folder is of one kind of CPU, since XLA's programs for one may not run on another where a home is shared. JAX deletes what
    was used least recently beyond a gigabyte. Variables that the user has set are left as they are.
    """
    if not _is_a_program() or "JAX_COMPILATION_CACHE_DIR" in os.environ or find_spec("filelock") is None:
        return
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = root / "mevs_jax" / "compiled" / f"{platform.machine()}-{_kind_of_cpu():08x}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home, or none that can be written to
        return
    if os.access(folder, os.W_OK):
        from mevs_jax.deploy.entries import check_entries

        with warnings.catch_warnings(record=True) as said:
            check_entries(folder)
        for warning in said:
            print(f"Note: {warning.message}", file=sys.stderr)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(_COMPILED_BYTES))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
        os.environ.setdefault("JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES", "none")  # else a moved folder is compiled anew


def _kind_of_cpu() -> int:
    """A number that differs where the CPU has other instructions."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return zlib.crc32(platform.processor().encode())
    return zlib.crc32(
        "".join(sorted({line for line in lines if line.lower().startswith(("flags", "features"))})).encode()
    )


def _say_and_end(error: Exception) -> None:
    """Ends the program for an error that a person can act on; returns for any other."""
    missing = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
    if missing and missing.split(".")[0] not in ("mevs_jax", "data_pipeline", "train", "eval"):
        _fail(f"the package {missing} is not installed; install the study's packages: pip install -e '.[study]'")
    from mevs_jax.cli.failure import Unusable
    from mevs_jax.errors import DataError

    if isinstance(error, Unusable | DataError):
        _fail(str(error))
    if not has_checkout():
        if isinstance(error, OSError | MemoryError):
            _fail(f"{getattr(error, 'filename', None) or 'the command'}: {getattr(error, 'strerror', None) or error}")
        return
    from data_pipeline.errors import Diverged

    if isinstance(error, Diverged):
        _fail(str(error), 3)
    from data_pipeline.files import why_not_written

    if (sentence := why_not_written(error)) is not None:
        _fail(sentence)
    if isinstance(error, MemoryError):
        _fail(f"there is not enough memory ({error}); free some, and the same command goes on where it stopped", 75)
    if (reason := _why_no_device()) is not None:
        platforms = os.environ.get("JAX_PLATFORMS")
        asked = f"JAX_PLATFORMS={platforms} asks for a device" if platforms else "JAX chose a device"
        _fail(f"{asked} that cannot be used here ({reason}); set JAX_PLATFORMS=cpu, or install what the device needs")
    from data_pipeline.distributed import is_lost_process
    from train.running.preemption import Preempted

    if isinstance(error, Preempted):
        _fail(f"{error} and saved it; the same command goes on from there", 143)
    if is_lost_process(error):
        reason = str(error).splitlines()[0]
        print(
            f"mevs: another process of this run is gone ({reason}); start all of them again with the same command, which goes "
            f"on from the last checkpoint",
            file=sys.stderr,
        )
        sys.stderr.flush()
        os._exit(75)  # JAX's own way out waits for the process that is gone


def _why_no_device() -> str | None:
    """Returns why JAX has no device to compute on; None if it has one, or was not needed."""
    if "jax" not in sys.modules:
        return None
    import jax

    from data_pipeline.errors import reason_of

    try:
        jax.devices()
    except AssertionError:  # of JAX itself, where no plugin has this name
        return "JAX has none of that name"
    except Exception as error:
        return reason_of(error)
    return None


def _output_is_closed() -> bool:
    """Whether the reader of the standard output has closed it, as `| head` does."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def main() -> None:
    """The program `mevs`.

    Exit codes: 0; 2 for input that cannot be used; 3 when a training diverged, or the outputs of a network are not finite; 130
    when interrupted; 143 when asked to end (SIGTERM), with everything saved; 75 when another process of the run was lost, or
    memory ran out. After the last three, the same command goes on where it stopped.
    """
    for stream in ("stdout", "stderr"):
        if getattr(sys, stream) is None:  # the program was started without it: `>&-`
            setattr(sys, stream, open(os.devnull, "w"))  # noqa: SIM115  # open until the program ends
    try:
        try:
            _main(sys.argv[1:])
        finally:
            sys.stdout.flush()
    except BrokenPipeError as error:
        if not _output_is_closed():
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(error.__context__.code if isinstance(error.__context__, SystemExit) else 0)


def _main(arguments: list[str]) -> None:
    if not arguments or arguments[0] in (*_HELP, "--help-all"):
        print(help_text(), end="")
        sys.exit(0 if arguments else 2)
    if arguments[0] == "--version":
        from mevs_jax import __version__

        print(__version__)
        return
    if len(arguments) == 2 and arguments[1] in _HELP and any(name.startswith(arguments[0] + " ") for name in COMMANDS):
        print(help_text(), end="")
        return
    try:
        name, rest, note = find(arguments)
    except ValueError as error:
        _fail(str(error))
    if any(argument in _HELP for argument in rest):
        from mevs_jax.cli.parsing import show_options

        show_options(name)
    _begin_with_large_pages()
    _keep_compiled()
    if note:
        print(f"mevs: {note}", file=sys.stderr)
    if COMMANDS[name].needs_study and not has_checkout():
        _fail(
            "the installed package holds the library alone; studies run from a checkout of the project: clone it, run "
            "`make demo` there, and then use .venv/bin/mevs"
        )
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    # Tracing leaves many small objects that live: looking through them as often as Python does takes a twentieth of a short job.
    gc.set_threshold(100_000, 50, 100)
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGINT, _interrupt)
        signal.signal(signal.SIGALRM, _interrupt)
        sys.unraisablehook = _say_unraisable
    try:
        _run(name, rest)
        _leave_interrupts()
    except KeyboardInterrupt:
        _leave_interrupts()
        _fail("interrupted" if COMMANDS[name].tool else "interrupted; the same command goes on where it stopped", 130)
    except Exception as error:
        _say_and_end(error)
        raise


if __name__ == "__main__":
    main()
