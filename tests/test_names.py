"""Every name that a function uses exists: linters are blind to that here, since jaxtyping's shapes look like undefined names."""

from __future__ import annotations

import builtins
import dis
import importlib
from pathlib import Path
from types import CodeType

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for package in ("mevs_jax", "data_pipeline", "train", "eval", "benchmarks")
    for path in (ROOT / package).rglob("*.py")
    if path.stem not in ("__init__", "__main__", "torch_peer")  # the last needs PyTorch
)


def global_names(code: CodeType) -> set[str]:
    found = {step.argval for step in dis.get_instructions(code) if step.opname == "LOAD_GLOBAL"}
    return found.union(*(global_names(inner) for inner in code.co_consts if isinstance(inner, CodeType)))


@pytest.mark.parametrize("name", MODULES)
def test_names_exist(name, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    module = importlib.import_module(name)
    code = compile(Path(str(module.__file__)).read_text(), name, "exec")
    missing = global_names(code) - set(vars(module)) - set(vars(builtins))
    assert not missing


def test_a_missing_name_is_found():
    assert global_names(compile("def f():\n    return [nothing_here for _ in range(3)]", "x", "exec")) == {
        "nothing_here",
        "range",
    }
