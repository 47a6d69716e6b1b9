"""Results stored on disk under an identity, and computed again when the identity has changed or the file is damaged.

An identity is whatever the result depends on: the version of its kind, settings, the data set, the networks it was computed with
(`train.results.identity`). Every kept file has a check in `checks.json` beside it, so that a file that was edited is noticed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from data_pipeline.distributed import agreed, is_first, wait_for_all
from data_pipeline.errors import Unreadable
from data_pipeline.files import (
    check_of,
    check_of_file,
    damage_in,
    json_of,
    keep_checks,
    npz_bytes,
    read_json,
    write_bytes,
)
from data_pipeline.progress import console
from train.results.identity import why, why_other, why_other_stamp
from train.results.records import as_json, from_json

Result = TypeVar("Result")

_ARRAYS = "arrays"
"""Entry of a JSON file that holds the check of the arrays beside it."""


def keep(path: Path, content: bytes) -> None:
    """Writes a file and its check; a job that ends in between leaves the old file, whose check is accepted still."""
    keep_checks(path.parent, {path.name: check_of(content)})
    write_bytes(path, content)


def check_kept(path: Path) -> None:
    """Raises `Unreadable` if a file that is there is not as `keep` wrote it; one without a check, as older ones, is accepted."""
    if path.exists() and (damage := damage_in(path.parent, [path.name])) is not None:
        raise Unreadable(path, damage.removeprefix(f"{path} ").replace("is not", "it is not", 1))


def check_no_folder(path: Path) -> None:
    """Raises `Unreadable` if `path` is a folder."""
    if path.is_dir():
        raise Unreadable(path, "it is a folder", "remove it, and the same command goes on")


def kept(
    path: Path,
    load: Callable[[Path], Result],
    save: Callable[[Path, Result], None],
    why_stale: Callable[[Result], str | None],
    compute: Callable[[], Result],
) -> Result:
    """Returns the result stored in `path`; computes and stores it first if it is missing, damaged or not current.

    The result is always loaded from the file, so that a first run and a later one return the same. Of several processes, which
    all call this, the first one decides and stores; all compute, since they may share that work. A sentence says why a stored
    result is computed anew.

    Args:
        load: reads the file; raises if it is not as it was written.
        why_stale: returns why a result is not current, in a few words; None if it is.

    Raises:
        Unreadable: if `path` is a folder.
    """
    check_no_folder(path)
    stored = None
    if path.exists():
        try:
            stored = load(path)
            if (reason := why_stale(stored)) is not None:
                stored = None
                if is_first():
                    console.print(f"{path} is computed anew: {reason}", markup=False)
        except Exception as error:  # the content of a damaged file decides which
            console.print(f"{path} cannot be read ({why(error)}), so it is made again", markup=False)
            stored = None
    if agreed(stored is not None):
        return load(path) if stored is None else stored
    result = compute()
    if is_first():
        save(path, result)
    wait_for_all(f"kept {path.name}")
    return load(path)


def kept_json(
    path: Path,
    identity: Any,
    compute: Callable[[], Any],
    read: Callable[[dict[str, Any]], Any] = lambda content: content,
) -> Any:
    """Returns the content of a JSON file; computes it first unless the file's `"identity"` is `identity`.

    Args:
        compute: returns the content, or a pair of it and the arrays beside it. The identity is added as the last entry, or
            replaces an `"identity"` entry in its place.
        read: makes the result of the content. A file that it raises for is made again.
    """
    identity = as_json(identity)

    def load(path: Path) -> Any:
        content = read_json(path)
        reason = why_other(content["identity"], identity)
        return reason, read(content) if reason is None else None

    def save(path: Path, made: Any) -> None:
        content, arrays = made if isinstance(made, tuple) else (made, None)
        if arrays is not None:
            written = npz_bytes(**arrays)
            write_bytes(path.with_suffix(".npz"), written)
            content = content | {_ARRAYS: check_of(written)}
        keep(path, json_of(content | {"identity": identity}))

    return kept(path, load, save, lambda stored: stored[0], compute)[1]


def kept_record(path: Path, kind: type[Result], identity: Any, compute: Callable[[], Result]) -> Result:
    """As `kept_json` for a record, whose class is `kind`."""
    return kept_json(path, identity, lambda: as_json(compute()), lambda content: record_in(kind, content, path))


def record_in(kind: type[Result], content: dict[str, Any], path: Path) -> Result:
    """Returns the record in the content of the JSON file `path`, without its identity; `DataError` for another form."""
    return from_json(kind, {name: value for name, value in content.items() if name != "identity"}, str(path))


def kept_with_arrays(
    path: Path, identity: Any, compute: Callable[[], tuple[dict[str, Any], dict[str, np.ndarray]]]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Returns the content of a JSON file and of the `.npz` file beside it, which are one result; computes both if one is stale.

    The JSON file holds the check of the arrays and is written last. Arrays of another result are therefore never taken for those
    of this one, wherever a job ends.
    """

    def read(content: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        return {name: value for name, value in content.items() if name != _ARRAYS}, arrays_beside(path, content)

    return kept_json(path, identity, compute, read)


def arrays_beside(path: Path, content: dict[str, Any]) -> dict[str, np.ndarray]:
    """Returns the arrays that belong to the content of a JSON file.

    Raises:
        Unreadable: if the arrays are missing, or are not those that were stored with it.
    """
    beside = path.with_suffix(".npz")
    if not beside.exists():
        raise Unreadable(path, f"{beside.name}, which belongs to it, is missing")
    if content.get(_ARRAYS) != check_of_file(beside):
        raise Unreadable(path, f"{beside.name} holds other arrays than those that were stored with it")
    with np.load(beside) as stored:
        return {name: stored[name] for name in stored.files}


def kept_array(path: Path, made: str, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """Returns the array of an `.npz` file; computes it first unless the file's stamp (`stamp_of`) is `made`."""

    def load(path: Path) -> dict[str, np.ndarray]:
        check_kept(path)
        with np.load(path) as stored:
            return {name: stored[name] for name in ("array", "made_by")}

    return kept(
        path,
        load,
        lambda path, content: keep(path, npz_bytes(**content)),
        lambda stored: why_other_stamp(str(stored["made_by"]), made),
        lambda: {"array": compute(), "made_by": np.array(made)},
    )["array"]


def keep_beside(path: Path, content: bytes) -> None:
    """Writes a file whose content follows from another file, unless it holds this content already.

    Raises:
        Unreadable: if `path` is a folder.
    """
    check_no_folder(path)
    if path.exists():
        if damage_in(path.parent, [path.name]) is not None:
            console.print(f"{path} is not as it was written, so it is made again", markup=False)
        elif path.read_bytes() == content:
            return
    if is_first():
        keep(path, content)
