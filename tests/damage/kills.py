"""Kills jobs at random moments and starts them in pairs: `python -m tests.damage.kills [--kills 48] [--workers 12]`.

After each kill the same command runs again. After a few kills it is left alone, and should end with the metrics of a run that was
never interrupted. No job may print a traceback or leave a process behind. A kill is a signal to the job, or SIGKILL to one of its
capture workers, for which the job captures more objects than the preset has. Of two jobs that start in one directory, one should
finish and the other end with one sentence, or wait.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

LIMIT = 300.0
"""Seconds after which a job counts as one that hangs."""
KINDS = {"SIGKILL": (-9,), "SIGTERM": (-15, 143), "SIGINT": (130, -2)}
"""The exit codes that a job may have after each signal. While Python itself ends, after all is done, SIGINT gives -2."""
OUTCOMES = ("same", "DIFFERENT", "CODE", "TRACEBACK", "HANG", "REMAINS")
RUN = ("run", "--preset", "tiny")
DATA = ("data", "--preset", "tiny", "--dataset.train-per-class", "12", "--dataset.test-per-class", "2")


class Job:
    """A command in a process group of its own; its output is in `log`."""

    def __init__(self, out: Path, log: Path, arguments: tuple[str, ...] = RUN) -> None:
        self.log = log
        with log.open("w") as file:
            command = [sys.executable, "-m", "mevs_jax", *arguments, "--out", str(out)]
            self.process = subprocess.Popen(command, stdout=file, stderr=file, start_new_session=True)

    def code(self) -> int | None:
        """Returns the exit code; None if the job hangs, which is then killed."""
        try:
            return self.process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            return None

    def processes(self) -> dict[int, str]:
        """Returns the running processes of the group and their command lines."""
        listed = subprocess.run(["ps", "-eo", "pgid=,pid=,stat=,args="], capture_output=True, text=True, check=True)
        rows = (line.split(None, 3) for line in listed.stdout.splitlines())
        return {
            int(pid): what for group, pid, state, what in rows if int(group) == self.process.pid and state[0] != "Z"
        }

    def workers(self) -> list[int]:
        """Returns the process ids of the capture workers."""
        return [pid for pid, what in self.processes().items() if "spawn_main" in what]

    def remains(self) -> bool:
        """Returns whether a process of the group still runs after ten seconds."""
        for _ in range(100):
            if not self.processes():
                return False
            time.sleep(0.1)
        return True

    def text(self) -> str:
        return self.log.read_text(errors="replace").strip()


def _kill(job: Job, kind: str, moment: float) -> bool:
    """Sends a signal to a job after `moment` seconds. Returns whether it was still running."""
    begun = time.monotonic()
    while time.monotonic() - begun < moment and job.process.poll() is None:
        time.sleep(0.005)
    if job.process.poll() is not None:
        return False
    job.process.send_signal(getattr(signal, kind))
    return True


def _kill_worker(job: Job, moment: float, random: np.random.Generator) -> bool:
    """Kills a capture worker of a job, `moment` seconds after the first one starts. Returns whether one was running."""
    while job.process.poll() is None and not job.workers():
        time.sleep(0.02)
    time.sleep(moment)
    try:
        if found := job.workers():
            os.kill(int(random.choice(found)), signal.SIGKILL)
        return bool(found)
    except ProcessLookupError:
        return False


def _is_whole(out: Path, whole: Path) -> bool:
    equal = (out / "metrics.json").read_bytes() == (whole / "metrics.json").read_bytes()
    return equal and (out / "report" / "index.html").is_file() and not list(out.rglob("*.partial*"))


def killed(
    work: Path, whole: Path, kills: int, length: float, random: np.random.Generator
) -> tuple[str, list[str], str]:
    """Returns how a job ends that is killed `kills` times and then left alone, how it was killed, and what explains it.

    Args:
        length: seconds that a run takes.
    """
    run, hits, last, left = work / "run", list[str](), "", length
    for at in range(kills + 1):
        job, moment, kind = Job(run, work / f"{at}.log"), random.uniform(0, left), ""
        if at < kills:
            kind = str(random.choice(list(KINDS)))
            hit, left = _kill(job, kind, moment), max(left - 0.6 * moment, 0.3 * length)
            kind = kind if hit else ""
        code, text = job.code(), job.text()
        last += f"; {kind or 'left alone'} at {moment:.1f} s: {code} {text.splitlines()[-1:]}"
        hits += [kind] if kind else []
        if code is None or "Traceback" in text:
            return ("HANG" if code is None else "TRACEBACK"), hits, f"{last}\n{text}"
        if code and code not in KINDS.get(kind, ()):
            return "CODE", hits, last
        if job.remains():
            return "REMAINS", hits, f"{last}\n{job.processes()}"
        if code == 0:
            break
    return ("same" if _is_whole(run, whole) else "DIFFERENT"), hits, last


def _same_records(data: Path, other: Path, split: str) -> bool:
    """Returns whether two data sets have the same records in a split. The bytes of the files that hold them may differ."""
    from data_pipeline.dataset.builder import open_split

    pairs = zip(open_split(data, split), open_split(other, split), strict=True)
    return all(
        mine.keys() == theirs.keys() and all(np.array_equal(mine[k], theirs[k]) for k in mine) for mine, theirs in pairs
    )


def bereaved(work: Path, captured: Path, moment: float, random: np.random.Generator) -> tuple[str, list[str], str]:
    """Returns as `killed` does, for a job that captures objects and loses a worker after `moment` seconds."""
    first = Job(work / "run", work / "first.log", DATA)
    kinds = ["worker"] if _kill_worker(first, moment, random) else []
    code, again = first.code(), Job(work / "run", work / "again.log", DATA)
    last = f"at {moment:.2f} s: {code} {first.text().splitlines()[-1:]}"
    codes = code, again.code()
    if None in codes:
        return "HANG", kinds, last
    if any("Traceback" in job.text() for job in (first, again)):
        return "TRACEBACK", kinds, f"{first.text()}\n{again.text()}"
    if codes not in ((0, 0), (2, 0) if kinds else (0, 0)):
        return "CODE", kinds, f"{codes} {last}"
    if first.remains() or again.remains():
        return "REMAINS", kinds, last
    equal = all(_same_records(work / "run" / "data", captured / "data", split) for split in ("train", "val", "test"))
    return ("same" if equal and not list(work.rglob("*.partial*")) else "DIFFERENT"), kinds, last


def paired(work: Path, whole: Path, stagger: float) -> tuple[str, str]:
    """Returns how two jobs end that start in one directory, `stagger` seconds apart."""
    jobs = [Job(work / "run", work / "first.log")]
    time.sleep(stagger)
    jobs.append(Job(work / "run", work / "second.log"))
    codes = [code for job in jobs if (code := job.code()) is not None]
    said = [job.text().splitlines()[-1:] for job in jobs]
    if len(codes) < len(jobs):
        return "HANG", str(said)
    if any("Traceback" in job.text() for job in jobs):
        return "TRACEBACK", "\n".join(job.text() for job in jobs)
    if sorted(codes) not in ([0, 0], [0, 2]):
        return "CODE", f"{codes}: {said}"
    if any(job.remains() for job in jobs):
        return "REMAINS", ""
    return ("same" if _is_whole(work / "run", whole) else "DIFFERENT"), f"{codes}: {said[codes.index(max(codes))]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", nargs="?", type=Path, help="a finished run of the preset tiny; made first if left out")
    parser.add_argument("--kills", type=int, default=48)
    parser.add_argument("--in-a-row", type=int, default=3, help="kills of a run before it is left alone")
    parser.add_argument("--workers", type=int, default=12, help="kills of a capture worker")
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    random, counts = np.random.default_rng(options.seed), Counter[tuple[str, str]]()
    with tempfile.TemporaryDirectory() as folder:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(folder) / "compiled"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
        whole = options.run or Path(folder) / "whole"
        if options.run is None and (job := Job(whole, Path(folder) / "log")).code() != 0:
            sys.exit(job.text())
        begun = time.monotonic()
        timing = Job(Path(folder) / "timed", Path(folder) / "log")
        if timing.code() != 0:
            sys.exit(timing.text())
        length = time.monotonic() - begun
        print(f"a run takes {length:.1f} s", flush=True)
        captured = Path(folder) / "captured"
        if options.workers and (job := Job(captured, Path(folder) / "log", DATA)).code() != 0:
            sys.exit(job.text())
        done = at = 0
        while done < options.kills or at < options.pairs + options.workers:
            work = Path(folder) / str(at)
            work.mkdir()
            if at < options.pairs:
                kinds, moment = ["pair"], random.uniform(0, 3)
                found, said = paired(work, whole, moment)
                said = f"{moment:.2f} s apart: {said}"
            elif at < options.pairs + options.workers:
                found, kinds, said = bereaved(work, captured, random.uniform(0, 5), random)
            else:
                found, kinds, said = killed(work, whole, min(options.in_a_row, options.kills - done), length, random)
                done += len(kinds)
            at += 1
            counts.update((kind, found) for kind in kinds)
            print(f"{found:9} {' '.join(kinds)} {said}", flush=True)
    print(f"\n{'':9}" + "".join(f"{name:>11}" for name in OUTCOMES))
    for kind in ("pair", "worker", *KINDS):
        print(f"{kind:9}" + "".join(f"{counts[kind, name]:>11}" for name in OUTCOMES))
    sys.exit(int(any(name != "same" for _, name in counts)))


if __name__ == "__main__":
    main()
