"""Long fuzzing: `python -m tests.fuzz.run [--inputs 20000] [--seed 0] [reader …]`, or `make fuzz`.

Each reader runs in a process of its own, so that one that ends by a signal is noticed. For each the program prints the number of
inputs, the longest time of one and the largest memory of the process, and ends with 1 if any went wrong. An input that went
wrong is left in the current folder.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import time
from pathlib import Path
from typing import Any

from hypothesis import given, seed

from tests.fuzz.targets import TARGETS, generated, mutated

SECONDS, MEGABYTES = 10.0, 2000


def fuzz(name: str, inputs: int, start: int, last: Path, result: Any) -> None:
    """Fuzzes one reader; `last` always holds the input that is being read."""
    done, longest = 0, 0.0

    @seed(start)
    @generated(inputs)
    @given(mutated(name))
    def check(content: bytes) -> None:
        nonlocal done, longest
        last.write_bytes(content)
        began, clock = time.process_time(), time.perf_counter()
        TARGETS[name].read(content)
        longest = max(longest, time.process_time() - began)
        done += 1
        assert longest < SECONDS, f"an input took {longest:.1f} s of the processor"
        assert time.perf_counter() - clock < 20 * SECONDS, "an input kept its reader waiting"

    message = ""
    try:
        check()
    except BaseException as error:
        import traceback

        traceback.print_exc()
        message = f"{type(error).__name__}: {error}".splitlines()[0]
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    if not message and memory > MEGABYTES:
        message = f"{memory:.0f} MB"
    result.put((done, longest, memory, message))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("readers", nargs="*", help=f"of {', '.join(TARGETS)}; all by default")
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    context, wrong = multiprocessing.get_context("spawn"), 0
    for name in options.readers or TARGETS:
        result, last = context.SimpleQueue(), Path(f"fuzz-{name}.input")
        process = context.Process(target=fuzz, args=(name, options.inputs, options.seed, last, result))
        process.start()
        process.join()
        if process.exitcode or result.empty():
            done, longest, memory, message = 0, 0.0, 0.0, f"the process ended with {process.exitcode}"
        else:
            done, longest, memory, message = result.get()
        print(f"{name}: {done} inputs, longest {longest:.2f} s, {memory:.0f} MB: {message or 'no errors'}", flush=True)
        if message:
            wrong += 1
            print(f"  the input is in {last}", flush=True)
        else:
            last.unlink(missing_ok=True)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
