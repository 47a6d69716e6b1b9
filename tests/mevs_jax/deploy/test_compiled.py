"""Compiled programs are kept in a folder of the user's, for the next process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zlib

import pytest

from mevs_jax.deploy.compiled import _prune
from mevs_jax.deploy.entries import DamagedProgramsWarning, check_entries

PROGRAM = """
import jax, jax.numpy as jnp
from mevs_jax import keep_compiled
print(keep_compiled())
jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((7, 7))).block_until_ready()
"""


def test_programs_are_kept_in_the_users_cache(tmp_path):
    there = {"XDG_CACHE_HOME": str(tmp_path)}
    given = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"} | there
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=given, timeout=300)
    assert ended.returncode == 0, ended.stderr
    folder = tmp_path / "mevs_jax" / "compiled"
    assert ended.stdout.strip() == str(folder)
    assert list(folder.iterdir())
    other = given | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "own")}
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=other, timeout=300)
    assert ended.stdout.strip() == str(tmp_path / "own")


SECOND = """
import sys, jax, jax.numpy as jnp
from mevs_jax import keep_compiled
for size, folder in enumerate(sys.argv[1:], 5):
    print(keep_compiled(folder))
    jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((size, size))).block_until_ready()
"""


def test_a_second_folder_is_used_from_then_on(tmp_path):
    folders = [str(tmp_path / name) for name in ("one", "two")]
    ended = subprocess.run([sys.executable, "-c", SECOND, *folders], capture_output=True, text=True, timeout=300)
    assert ended.stdout.split() == folders, ended.stderr
    for folder in folders:
        assert any(path.name.endswith("-cache") for path in os.scandir(folder))


def test_the_oldest_programs_go_first(tmp_path):
    for age, name in enumerate(("a-cache", "b-cache", "c-cache", "d-cache", "notes.txt")):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (1000 - age, 1000 - age))
    _prune(tmp_path, 250)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a-cache", "b-cache", "notes.txt"]


def test_a_copied_folder_is_used(tmp_path):
    given = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    for folder in ("own", "copy"):
        command = [sys.executable, "-c", SECOND, str(tmp_path / folder)]
        assert subprocess.run(command, capture_output=True, env=given, timeout=300).returncode == 0
        kept = sorted(path.name for path in (tmp_path / folder).glob("*-cache"))
        if folder == "own":
            shutil.copytree(tmp_path / "own", tmp_path / "copy")
            before = kept
    assert before
    assert kept == before


TWO = """
import sys, warnings, jax, jax.numpy as jnp
from mevs_jax import keep_compiled
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    keep_compiled(sys.argv[1])
    one = jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((5, 5)))
    other = jax.jit(lambda x: jnp.cos(x) @ x)(jnp.ones((5, 5)))
print(f"{float(one[0, 0]):.4f} {float(other[0, 0]):.4f}", [str(warning.message).partition(" in ")[0] for warning in said])
"""


@pytest.mark.parametrize("damage", ["swapped", "cut"])
def test_programs_that_are_not_as_they_were_written_are_compiled_again(damage, tmp_path):
    given = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}

    def said() -> str:
        command = [sys.executable, "-c", TWO, str(tmp_path)]
        return subprocess.run(command, capture_output=True, text=True, env=given, timeout=300, check=True).stdout

    right = "4.2074 2.7015 "
    assert said() == f"{right}[]\n"
    one, other = sorted(tmp_path.glob("jit__lambda*-cache"))  # of one name, so that only their checks differ
    contents = one.read_bytes(), other.read_bytes()
    for path, content in zip((other, one), contents, strict=True):
        path.write_bytes(content if damage == "swapped" else content[:-20])
    assert said() == f"{right}['2 compiled programs']\n"
    assert said() == f"{right}[]\n"


@pytest.mark.parametrize("content", [b"", b"no program", b"\x78\x9c", zlib.compress(b"the program jit_other")])
def test_files_that_were_damaged_before_they_were_known(content, tmp_path):
    (tmp_path / "jit_one-0-cache").write_bytes(content)
    (tmp_path / "jit_two-0-cache").write_bytes(zlib.compress(b"the program jit_two"))
    (tmp_path / "checks.json").write_bytes(b"{")
    with pytest.warns(DamagedProgramsWarning, match="^1 compiled programs"):
        check_entries(tmp_path)
    assert [path.name for path in tmp_path.glob("*-cache")] == ["jit_two-0-cache"]
