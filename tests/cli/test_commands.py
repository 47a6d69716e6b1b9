"""The command line as a user meets it: help, options, settings, and one sentence for bad input."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh

import mevs_jax
from data_pipeline.errors import DataError
from eval.run_file import load_run
from eval.settings import PRESETS, TINY
from mevs_jax.cli import main as cli
from mevs_jax.cli import parsing
from mevs_jax.cli.commands import ALIASES, COMMANDS
from tests.cli.conftest import MEVS, refused


def cube_off() -> str:
    cube = trimesh.creation.box((1, 2, 3))
    rows = [f"OFF\n{len(cube.vertices)} {len(cube.faces)} 0"]
    rows += [" ".join(map(str, vertex)) for vertex in cube.vertices] + [
        "3 " + " ".join(map(str, face)) for face in cube.faces
    ]
    return "\n".join(rows) + "\n"


def folder_with(root: Path, bad: str) -> Path:
    """Two classes of cubes, one of them with a file of the content `bad`."""
    for name in ("cup", "jug"):
        for split in ("train", "test"):
            (root / name / split).mkdir(parents=True)
            for index in range(3):
                (root / name / split / f"{index}.off").write_text(cube_off())
    (root / "jug" / "train" / "1.off").write_text(bad)
    return root


BY_THREADS = ["--dataset.capture.backend", "rasterise"]  # other backends capture in processes, which import for seconds


def no_such_file(root: Path) -> list:
    return ["--data", root / "nowhere"]


def not_a_mesh(root: Path) -> list:
    return [*BY_THREADS, "--data", folder_with(root / "set", "hello")]


def truncated(root: Path) -> list:
    return [*BY_THREADS, "--data", folder_with(root / "set", cube_off()[:80])]


def not_finite(root: Path) -> list:
    return [*BY_THREADS, "--data", folder_with(root / "set", cube_off().replace("0.5", "nan", 1))]


def empty_class(root: Path) -> list:
    folder = folder_with(root / "set", cube_off())
    (folder / "vase" / "train").mkdir(parents=True)
    return ["--data", folder]


def zip_that_leaves(root: Path) -> list:
    import zipfile

    with zipfile.ZipFile(root / "a.zip", "w") as archive:
        archive.writestr("../cup/train/a.off", cube_off())
    return ["--data", root / "a.zip"]


def unwritable(root: Path) -> list:
    (root / "file").write_text("in the way")
    return ["--out", root / "file" / "run"]


def no_archive(root: Path) -> list:
    return ["--data", "modelnet10", "--archive", root / "ModelNet10.zip"]


def weights_for_another(root: Path) -> list:
    (root / "resnet18.pth").write_bytes(b"")
    return ["--pretrained", root / "resnet18.pth"]


def weights_that_are_none(root: Path) -> list:
    fitting = {"width": "64", "depth": "18", "channels": "3", "stem": "convolution"}
    options = [word for name, value in fitting.items() for word in (f"--classifier.network.{name}", value)]
    return [*weights_for_another(root), *options]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (no_such_file, "no such file or folder: .*nowhere"),
        (lambda _: ["--data", "gs://bucket/meshes"], "read from this machine's disk, not from gs://bucket/meshes"),
        (not_a_mesh, r"jug/train/1.off is not an OFF mesh"),
        (truncated, r"jug/train/1.off is cut short"),
        (not_finite, r"jug/train/1.off has \d vertices that are not finite"),
        (empty_class, "class folder .*vase.train is empty"),
        (zip_that_leaves, "a path that leaves its folder"),
        (unwritable, "cannot write to"),
        (no_archive, r"--archive .*ModelNet10.zip cannot be read: No such file"),
        (
            weights_for_another,
            r"as its stem, this one has width 8, depth 10, 1 channels and the stem \w+; use --preset thesis",
        ),
        (weights_that_are_none, r"resnet18.pth is not a file of weights that can be read safely"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_bad_input_gets_one_sentence_and_exit_code_2(tmp_path, make, message, refuses):
    arguments = make(tmp_path)
    if "--out" not in arguments:
        arguments += ["--out", tmp_path / "run"]
    assert re.search(message, refuses("run", "--preset", "tiny", *arguments))


def test_unknown_words_are_refused_and_help_reads_well(tmp_path, refuses, at_once):
    assert "unknown command 'fly'" in refuses("fly")
    assert "unknown preset 'huge'" in refuses("run", "--preset", "huge")
    studies = "thesis, learned, rendering, instances, published-code, future-work"
    assert f"followed by one of {studies}; none was given" in refuses("study")
    assert "'fly' is none of them" in refuses("check", "fly")
    assert "no data set in" in refuses("train", "--out", tmp_path)
    assert "cannot join the other processes" in refuses("train", "--distributed", "--out", tmp_path)
    for command, option in (("run", "--distributed"), ("run", "--beam"), ("report", "--data"), ("thesis", "--views")):
        ended = at_once(*command.split(), option, "5", "--out", tmp_path)
        assert (ended.returncode, ended.stdout) == (2, ""), command
        assert option in ended.stderr, command
    assert not (tmp_path / "run.json").exists()
    shown = at_once("--help")
    assert shown.returncode == 0
    for word in ("run", "data", "train", "eval", "report", "--preset", "--data", "--views", "--out"):
        assert word in shown.stdout
    assert max(map(len, shown.stdout.splitlines())) <= 100


@pytest.mark.parametrize("name", [*COMMANDS, *ALIASES])
def test_a_command_shows_its_own_options(name, at_once):
    shown = at_once(*name.split(), "--help")
    assert shown.returncode == 0
    assert len(shown.stdout.splitlines()) <= 80
    command = COMMANDS[ALIASES.get(name, name)]
    assert ("--preset" in shown.stdout) != command.tool
    assert ("--data " in shown.stdout) == (
        "dataset" in command.settings or name in ("check transfer", "check reality", "study instances")
    )
    for group in command.settings:
        assert f"--{group}.*" in shown.stdout


def test_all_settings_are_shown_when_they_are_asked_for(at_once):
    for name, there, missing in (
        ("run", "--classifier.optimiser.epochs", "--sweep."),
        ("eval", "--evaluation.", "--dataset.capture"),
    ):
        shown = at_once(name, "--help-all")
        assert shown.returncode == 0
        assert there in shown.stdout
        assert missing not in shown.stdout


def test_help_and_the_library_are_there_at_once():
    """Nothing heavy is imported for them: neither JAX nor, for the commands, tyro."""
    asked = """
import sys
import mevs_jax.cli.main
assert "tyro" not in sys.modules
import mevs_jax.cli.parsing
assert "jax" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_finished_run_imports_neither_plots_nor_meshes(whole):
    asked = (
        "import sys; from mevs_jax.cli.main import main\n"
        "try: main()\n"
        "except SystemExit as end: assert not end.code, end.code\n"
        "print('heavy:', *{'matplotlib', 'scipy.spatial', 'trimesh', 'grain', 'orbax'} & sys.modules.keys())"
    )
    call = [sys.executable, "-c", asked, "run", "--out", str(whole)]
    done = subprocess.run(call, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "heavy:"


def test_a_run_keeps_its_settings(whole, tmp_path, monkeypatch, capsys):
    """Later stages start from `run.json`, other options override it, and what is printed is what is kept."""
    kept = json.loads((whole / "run.json").read_text())
    assert (kept["preset"], kept["settings"]["dataset"]["capture"]["views"]) == ("tiny", 6)
    assert kept["arguments"][:3] == ["run", "--preset", "tiny"]
    assert {"python", "jax", "mevs-jax"} <= set(kept["made_with"])
    assert kept["made_with"]["devices"] == {"platform": "cpu", "kind": "cpu", "count": 1}
    run = load_run(whole)
    assert (run.preset, run.settings) == ("tiny", TINY)
    call = parsing.parse("eval", ["--out", str(whole), "--seed", "3", "--evaluation.draws", "5"])
    assert (call.preset, call.settings.evaluation.draws, call.settings.evaluation.seed) == ("tiny", 5, 3)
    assert replace(call.settings, evaluation=TINY.evaluation) == TINY  # networks keep theirs
    seeded = parsing.parse("train", ["--out", str(whole), "--seed", "3"]).settings
    assert seeded.classifier.optimiser.seed == seeded.entropy.optimiser.data_seed == 3
    assert seeded.dataset == TINY.dataset
    with pytest.raises(DataError, match="was made with --preset tiny, not small, which mevs report does not change"):
        parsing.parse("report", ["--out", str(whole), "--preset", "small"])
    other = parsing.parse("eval", ["--out", str(whole), "--preset", "small"]).settings
    assert other == replace(TINY, evaluation=PRESETS["small"].evaluation)
    monkeypatch.setattr(sys, "argv", ["test", "train", "--out", str(whole), "--print-config"])
    cli.main()
    assert json.loads(capsys.readouterr().out) == {name: kept[name] for name in ("preset", "settings")}
    for name, change, said in (
        ("unknown", {"settings": {"colour": 1}}, "settings has no setting 'colour'"),
        (
            "type",
            {"settings": {"evaluation": {"draws": "many"}}},
            "settings.evaluation.draws is 'many', not of type int",
        ),
        ("choice", {"settings": {"dataset": {"capture": {"backend": "magic"}}}}, "'magic', not one of"),
        ("preset", {"preset": "foo"}, "preset is 'foo', not one of"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").write_text(json.dumps(kept | change))
        with pytest.raises(DataError, match=re.escape(said)):
            load_run(tmp_path / name)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(DataError, match="delete it, and give the options of the run again"):
        load_run(tmp_path)


def test_a_run_that_cannot_begin_leaves_no_settings(tmp_path, refuses):
    assert "--views 1 is too few" in refuses("run", "--preset", "tiny", "--views", "1", "--out", tmp_path / "new")
    assert not (tmp_path / "new" / "run.json").exists()


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"]], ids=len)
def test_a_reader_may_close_the_output(arguments):
    """As `| head` does: no traceback, no complaint. The output is buffered, as it is for users."""
    reading, writing = os.pipe()
    os.close(reading)
    buffered = os.environ | {"PYTHONUNBUFFERED": ""}
    ended = subprocess.run([*MEVS, *arguments], stdout=writing, stderr=subprocess.PIPE, text=True, env=buffered)
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_there_may_be_no_output_at_all():
    """As with `>&-`."""
    ended = subprocess.run(
        ["sh", "-c", f'exec "{sys.executable}" -m mevs_jax --help >&-'], stderr=subprocess.PIPE, text=True
    )
    assert (ended.returncode, ended.stderr) == (0, "")


def test_the_library_alone_says_that_studies_need_a_checkout(tmp_path):
    shutil.copytree(Path(mevs_jax.__file__).parent, tmp_path / "mevs_jax", ignore=shutil.ignore_patterns("__pycache__"))
    asked = "import sys; sys.path.insert(0, sys.argv.pop(1)); from mevs_jax.cli.main import main; main()"
    ended = subprocess.run(
        [sys.executable, "-c", asked, tmp_path, "run"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": ""},
    )
    assert "studies run from a checkout of the project" in refused(ended)


def test_an_interrupt_that_is_lost_is_given_again():
    """Python ignores an interrupt that falls into a finaliser; here one does."""
    script = """
import os, signal, sys, time
from mevs_jax.cli import main as cli

class Loses:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)

def job(*arguments):
    Loses()
    print("lost", flush=True)
    time.sleep(300)

cli._run, sys.argv = job, ["mevs", "run"]
cli.main()
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert result.returncode == 130
    assert result.stdout == "lost\n"
    assert result.stderr == "mevs: interrupted; the same command goes on where it stopped\n"


def test_an_interrupt_waits_for_an_import(tmp_path):
    """Where extension modules are imported, it aborted the process."""
    (tmp_path / "imported.py").write_text(
        "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(0.5)\nprint('whole', flush=True)\n"
    )
    script = """
import sys, time
from mevs_jax.cli import main as cli

def job(*arguments):
    import imported
    time.sleep(300)

cli._run, sys.argv = job, ["mevs", "run"]
cli.main()
"""
    root = str(Path(mevs_jax.__file__).parents[1])
    result = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), root])},
    )
    said = "mevs: interrupted; the same command goes on where it stopped\n"
    assert (result.returncode, result.stdout, result.stderr) == (130, "whole\n", said)


def test_an_interrupt_while_python_ends_ends_the_program():
    """It ended by the signal of the timer a second later."""
    script = """
import atexit, os, signal, sys, time
from mevs_jax.cli import main as cli

def late():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(5)

atexit.register(late)
cli._run, sys.argv = lambda *arguments: print("done"), ["mevs", "run"]
cli.main()
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert (result.returncode, result.stdout, result.stderr) == (-signal.SIGINT, "done\n", "")


@pytest.mark.skipif("CS_GNU_LIBC_VERSION" not in os.confstr_names, reason="large pages are asked of glibc")
def test_jobs_begin_again_with_large_pages(monkeypatch):
    """Once, with the arguments they had; and never where `main` is called from another program."""
    begun = []
    monkeypatch.setattr(os, "execv", lambda *command: begun.append(command))
    monkeypatch.setattr(sys, "orig_argv", ["python", "-m", "mevs_jax", "run", "--views", "10"])
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    monkeypatch.setattr(sys, "argv", ["/usr/bin/notebook"])
    cli._begin_with_large_pages()
    assert not begun
    for program in ("/somewhere/bin/mevs", "/somewhere/mevs_jax/__main__.py"):
        monkeypatch.setattr(sys, "argv", [program])
        monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
        cli._begin_with_large_pages()
        assert os.environ["GLIBC_TUNABLES"] == "glibc.malloc.hugetlb=1"
        cli._begin_with_large_pages()
    assert begun == [(sys.executable, [sys.executable, "-m", "mevs_jax", "run", "--views", "10"])] * 2


@pytest.mark.parametrize("program", ["/somewhere/bin/mevs", "/usr/bin/notebook"])
def test_programs_keep_what_they_compile(program, tmp_path, monkeypatch):
    """In the user's cache folder, within bounds; not where another program calls `main`, nor if the user says otherwise."""
    monkeypatch.setattr(sys, "argv", [program])
    for name in ("DIR", "MAX_SIZE"):
        monkeypatch.setenv(f"JAX_COMPILATION_CACHE_{name}", "")  # so that it is as before after the test
        monkeypatch.delenv(f"JAX_COMPILATION_CACHE_{name}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cli._keep_compiled()
    if "notebook" in program:
        assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
        assert not list(tmp_path.iterdir())
        return
    folder = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    assert folder.is_dir()
    assert folder.is_relative_to(tmp_path / "cache" / "mevs_jax" / "compiled")
    assert int(os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"]) == 2**30
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/of/the/user")
    cli._keep_compiled()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "/of/the/user"
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    cli._keep_compiled()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_another_kind_of_cpu_has_a_folder_of_its_own(monkeypatch):
    here = cli._kind_of_cpu()
    assert here == cli._kind_of_cpu()
    monkeypatch.setattr(Path, "read_text", lambda path: "processor : 0\nflags : fpu sse2\n")
    assert cli._kind_of_cpu() != here


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/a/b"), 2, "cannot write /a/b: the disk is full"),
        (ValueError("Error writing /a: No space left on device"), 2, "the disk is full; free some space"),
        (MemoryError("cannot allocate"), 75, "there is not enough memory"),
    ],
)
def test_what_the_machine_lacks_is_a_sentence(error, code, said, tmp_path, at_once, monkeypatch):
    from mevs_jax.cli import stages

    def fails(call):
        raise error

    monkeypatch.setattr(stages, "data", fails)
    result = at_once("data", "--preset", "tiny", "--out", tmp_path)
    assert result.returncode == code
    assert said in result.stderr
    assert "Traceback" not in result.stderr


def test_a_platform_that_is_not_there_is_a_sentence():
    script = """
import sys
from mevs_jax.cli import main as cli

def job(*arguments):
    import jax
    jax.numpy.zeros(3)

cli._run, sys.argv = job, ["test", "run"]
cli.main()
"""
    environment = os.environ | {"JAX_PLATFORMS": "cuda"}
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert "JAX_PLATFORMS=cuda asks for a device that cannot be used here" in refused(result)
