"""Open3D, without what is not needed of it."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

_LEARNING = "open3d.ml"


def load_open3d() -> Any:
    """Returns Open3D without its part for machine learning, which takes two thirds of the time of the import.

    That part imports scikit-learn and pandas, in every process that casts rays. Whoever imports `open3d.ml` later gets it.

    Raises:
        ImportError, OSError: if Open3D or a library of the system that it needs is not installed.
    """
    left_out = {"open3d", _LEARNING}.isdisjoint(sys.modules)
    if left_out:
        sys.modules[_LEARNING] = ModuleType(_LEARNING)
    try:
        import open3d
    finally:
        if left_out:  # with the parts that Open3D has put under that name
            for name in [name for name in sys.modules if f"{name}.".startswith(f"{_LEARNING}.")]:
                sys.modules.pop(name, None)
    return open3d
