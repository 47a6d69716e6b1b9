"""Compiled programs kept on disk, so that a later process does not wait for the compiler."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

from mevs_jax.deploy.entries import check_entries

LARGEST = 512 * 2**20
"""Size in bytes above which the oldest programs in the folder are removed."""


def keep_compiled(folder: str | Path | None = None) -> Path:
    """Keeps what JAX compiles from now on in a folder, and uses what it holds; returns the folder.

    Changes JAX's settings for the whole process (its persistent compilation cache). Programs of other versions of JAX, or for
    other devices, are kept under other names.

    A folder that JAX already uses, by `JAX_COMPILATION_CACHE_DIR` for example, is kept. Programs that are damaged, or another's,
    are removed with a warning.

    Args:
        folder: by default `mevs_jax/compiled` in the user's cache, `$XDG_CACHE_HOME` or `~/.cache`.

    Raises:
        OSError: if the folder cannot be made.
    """
    if folder is None and (used := getattr(jax.config, "jax_compilation_cache_dir", None)):
        return Path(used)
    if folder is None:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mevs_jax" / "compiled"
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _prune(folder)
    check_entries(folder)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    compilation_cache.reset_cache()  # JAX keeps the folder that it has begun to use
    jax.config.update(
        "jax_persistent_cache_enable_xla_caches", "none"
    )  # their folder is a part of the names of programs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


def _prune(folder: Path, largest: int = LARGEST) -> None:
    """Removes the oldest of JAX's files until the rest is small enough. (JAX's own limit needs a further package.)"""
    found = []
    for path in folder.glob("*-cache"):
        with suppress(OSError):  # another process may have removed it
            found.append((path.stat().st_mtime, path.stat().st_size, path))
    size = sum(of for _, of, _ in found)
    for _, of, path in sorted(found):
        if size <= largest:
            return
        with suppress(OSError):
            path.unlink()
        size -= of
