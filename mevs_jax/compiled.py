"""Compiled programs kept on disk, so that a later process does not wait for the compiler."""

from __future__ import annotations

import os
from pathlib import Path

import jax

LARGEST = 512 * 2**20
"""Largest size of the kept programs in bytes; the ones used longest ago go first."""


def keep_compiled(folder: str | Path | None = None) -> Path:
    """Keeps what JAX compiles from now on in a folder, and uses what it holds; returns the folder.

    Changes JAX's settings for the whole process (its persistent compilation cache). Programs of other versions of JAX, or for
    other devices, are told apart.

    A folder that JAX already uses, by `JAX_COMPILATION_CACHE_DIR` for example, is kept.

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
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.config.update("jax_compilation_cache_max_size", LARGEST)
    return folder
