"""Damages every file of a finished run, one at a time, and runs the same command again: `python -m tests.damage.run [RUN]`.

Of each file there are six cases: empty, half, with one bit flipped, deleted, of foreign content, and a folder in its place. The
command should end with the same metrics, or with one sentence. Each case has its own process, forked from one that has imported
everything.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np


def _flip(path: Path, random: np.random.Generator) -> None:
    """Flips a bit, of what is not padding."""
    content = np.frombuffer(path.read_bytes(), np.uint8).copy()
    if len(content):
        content[random.choice(np.flatnonzero(content) if content.any() else len(content))] ^= 1 << random.integers(8)
    path.write_bytes(content.tobytes())


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


KINDS: dict[str, Callable[[Path, np.random.Generator], None]] = {
    "empty": lambda path, _: path.write_bytes(b"") and None,
    "half": lambda path, _: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]) and None,
    "flipped": _flip,
    "deleted": lambda path, _: path.unlink(),
    "foreign": lambda path, _: path.write_bytes(b'{"a": [1]}\n') and None,
    "folder": lambda path, _: _folder(path),
}
OUTCOMES = ("same", "sentence", "DIFFERENT", "TRACEBACK", "HANG")


def _run_again(run: Path, log: Path) -> None:
    """Runs `mevs run` in this process, a forked one, and ends it."""
    code = 1
    try:
        file = os.open(log, os.O_WRONLY | os.O_CREAT)
        os.dup2(file, 1)
        os.dup2(file, 2)
        from mevs_jax.cli import main

        sys.argv = ["test", "run", "--preset", "tiny", "--out", str(run)]
        try:
            main.main()
            code = 0
        except SystemExit as ended:
            code = int(ended.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _forked(run: Path, log: Path, limit: float) -> int | None:
    """Returns the exit code of a run in a forked process; None if it took longer than `limit` seconds."""
    sys.stdout.flush()
    child, begun = os.fork(), time.monotonic()
    if child == 0:
        _run_again(run, log)
    while time.monotonic() - begun < limit:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def outcome(run: Path, whole: Path, log: Path, limit: float = 300) -> tuple[str, str]:
    """Returns how a run of a damaged directory ends, and the last lines that it prints."""
    code = _forked(run, log, limit)
    said = log.read_text(errors="replace").strip()
    last = "\n".join(said.splitlines()[-12:])
    if code is None:
        return "HANG", last
    if code == 0:
        equal = (run / "metrics.json").read_bytes() == (whole / "metrics.json").read_bytes()
        return ("same" if equal and (run / "report" / "index.html").is_file() else "DIFFERENT"), last
    told = code in (2, 75) and "Traceback" not in said and said.splitlines()[-1].startswith("mevs: ")
    return ("sentence" if told else "TRACEBACK"), last


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", nargs="?", type=Path, help="a finished run of the preset tiny; made first if left out")
    parser.add_argument("--cases", type=int, default=0, help="how many cases, chosen at random; all by default")
    parser.add_argument("--only", default="", help="a regular expression for cases as they are printed: kind, file")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(work / "compiled"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
        import tensorflow_datasets  # noqa: F401

        import eval.stages  # noqa: F401

        whole = options.run or work / "whole"
        if options.run is None and _forked(whole, work / "log", 900) != 0:
            sys.exit((work / "log").read_text())
        files = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())
        cases = [(file, kind) for file in files for kind in KINDS if re.search(options.only, f"{kind} {file}")]
        if options.cases and options.cases < len(cases):
            cases = [cases[at] for at in sorted(random.choice(len(cases), options.cases, replace=False))]
        counts: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
        for file, kind in cases:
            run = work / "run"
            shutil.rmtree(run, ignore_errors=True)
            (work / "log").unlink(missing_ok=True)
            shutil.copytree(whole, run)
            KINDS[kind](run / file, random)
            begun = time.monotonic()
            found, said = outcome(run, whole, work / "log")
            counts[kind][found] += 1
            print(f"{found:9} {time.monotonic() - begun:5.1f} s  {kind} {file}", flush=True)
            if found not in ("same", "sentence"):
                print("    " + said.replace("\n", "\n    "), flush=True)
            elif found == "sentence":
                print(f"    {said.splitlines()[-1]}", flush=True)
    print(f"\n{'':9}" + "".join(f"{name:>11}" for name in OUTCOMES))
    for kind, of in counts.items():
        print(f"{kind:9}" + "".join(f"{of[name]:>11}" for name in OUTCOMES))
    bad = sum(of[name] for of in counts.values() for name in OUTCOMES[2:])
    sys.exit(int(bad > 0))


if __name__ == "__main__":
    main()
