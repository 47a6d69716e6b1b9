"""Several processes that work on one job (`--distributed`), each with devices of its own and one folder that all see.

Every process runs the same program. Work is shared out by objects, or arrays are spread over the devices of all. The first
process writes files and messages; the others wait for it before they read what it wrote.
"""

from __future__ import annotations

import json
import os
import platform
import socket
import sys
import threading

import jax
import numpy as np
from jax.experimental import multihost_utils

from data_pipeline.errors import DataError, causes_of


def join_processes() -> None:
    """Joins this process to the others of a multi-process training; must be called before JAX computes anything.

    On Slurm, Open MPI, Kubernetes and Cloud TPUs, JAX finds the other processes. Elsewhere, environment variables name them:
    JAX_COORDINATOR_ADDRESS (host:port of process 0), JAX_NUM_PROCESSES and JAX_PROCESS_ID.

    Raises:
        DataError: if the other processes cannot be found or reached, or cannot reach this one.
    """
    numbers = {}
    try:
        for argument, name in (("num_processes", "JAX_NUM_PROCESSES"), ("process_id", "JAX_PROCESS_ID")):
            if name in os.environ:
                numbers[argument] = int(os.environ[name])
        jax.distributed.initialize(**numbers, heartbeat_timeout_seconds=30)  # type: ignore[arg-type]
    except (ValueError, RuntimeError) as error:
        raise DataError(
            f"--distributed cannot join the other processes ({str(error).splitlines()[0]}); outside Slurm, Open MPI, Kubernetes "
            f"and Cloud TPUs set JAX_COORDINATOR_ADDRESS=host:port, JAX_NUM_PROCESSES and JAX_PROCESS_ID for each"
        ) from error
    try:
        jax.devices()
    except RuntimeError as error:
        if "gloo" not in str(error) or not (name := unresolved_name()):
            raise
        raise DataError(
            f"--distributed on CPUs needs the name of this machine to have an address, and {name} has none; add a line to "
            f"/etc/hosts: its address, then {name}"
        ) from error


_SECONDS_TO_LEAVE = 10
"""How long a process that ends with an error waits for others that end with the same one."""


def leave(code: int) -> None:
    """Ends this process with an exit code if it has joined others, which may wait for it in vain.

    Python's own way out waits minutes for the others, and then ends with another code.
    """
    if not jax.distributed.is_initialized():
        return
    sys.stdout.flush()
    sys.stderr.flush()
    latest = threading.Timer(_SECONDS_TO_LEAVE, os._exit, (code,))
    latest.daemon = True
    latest.start()
    try:
        jax.distributed.shutdown()  # returns once all are here
    finally:
        os._exit(code)


def unresolved_name() -> str:
    """Returns the name of this machine if it has no address, else an empty string.

    Processes that train on CPUs find each other by these names (JAX's Gloo collectives).
    """
    name = socket.gethostname()
    try:
        socket.getaddrinfo(name, None)
    except OSError:
        return name
    return ""


def is_first() -> bool:
    """Returns whether this process is the one that writes files and messages for all."""
    return jax.process_index() == 0


def own_share(count: int) -> np.ndarray:
    """Returns which of so many things are this process's, (share,): every n-th. Some process may have none."""
    return np.arange(count)[jax.process_index() :: jax.process_count()]


def from_all(own: np.ndarray, count: int) -> np.ndarray:
    """Returns what all processes have made together, (count, …), from what each has made of its `own_share`, (share, …)."""
    processes = jax.process_count()
    if processes == 1:
        return own
    most = -(-count // processes)
    padded = np.zeros((most, *own.shape[1:]), own.dtype)
    padded[: len(own)] = own
    every = np.asarray(multihost_utils.process_allgather(padded))  # (processes, most, …)
    return every.swapaxes(0, 1).reshape(-1, *own.shape[1:])[:count]


def by_all(own: dict[str, str]) -> dict[str, str]:
    """Returns what all processes have found, from what each has found."""
    if jax.process_count() == 1:
        return own
    content = np.frombuffer(json.dumps(own).encode(), np.uint8)
    sizes = multihost_utils.process_allgather(np.array(len(content)))
    every = multihost_utils.process_allgather(np.pad(content, (0, int(sizes.max()) - len(content))))
    joined: dict[str, str] = {}
    for size, of_one in zip(sizes, every, strict=True):
        joined |= json.loads(bytes(of_one[:size]))
    return joined


def hosts_of_all() -> list[str]:
    """Returns the name of the machine of each process, in their order."""
    return list(by_all({f"{jax.process_index():06d}": platform.node()}).values())


def agreed(value: bool) -> bool:
    """Returns what the first process says, to all of them."""
    return value if jax.process_count() == 1 else bool(multihost_utils.broadcast_one_to_all(np.array(value)))


def wait_for_all(name: str) -> None:
    """Waits until every process is here; `name` is of the place."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)


_LOST = ("gloo", "coordination service", "heartbeat", "connection closed by peer", "connection reset", "nccl")


def is_lost_process(error: BaseException) -> bool:
    """Returns whether an error of JAX's runtime means that another process of this training has ended or is unreachable."""
    said = [str(link).lower() for link in causes_of(error)]
    return jax.process_count() > 1 and any(sign in words for words in said for sign in _LOST)
