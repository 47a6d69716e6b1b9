"""Names of files: how they are shown, and which are ignored."""

from __future__ import annotations

from collections import Counter
from pathlib import PurePosixPath

from mevs_jax.meshes import MESH_SUFFIXES, UNREAD_SUFFIXES

_PACKED = (".gz", ".bz2", ".xz", ".zst")


def plain_class(name: str) -> str:
    """Returns a class name without what does not matter: `Night Stands` and `night_stand` are one class.

    Case, spaces, punctuation and a plural s do not matter.
    """
    letters = "".join(letter for letter in name.casefold() if letter.isalnum())
    return letters.removesuffix("s") if len(letters) > 3 else letters


def kind_of_ignored(name: str) -> str:
    """Returns the kind under which a file or folder is counted that is ignored by rule; empty for others.

    What macOS adds to folders and archives is ignored, and hidden files.
    """
    if name in (".DS_Store", "__MACOSX"):
        return name
    if name.startswith("._"):
        return "._*"
    return "hidden" if name.startswith(".") else ""


def unread_reason(name: str) -> str | None:
    """Returns why a file is left out whose name is that of a mesh in a format that is not read; None for other files."""
    path = PurePosixPath(name.lower())
    if path.suffix in UNREAD_SUFFIXES:
        return f"is a {path.suffix} file, which is not read; convert it to .glb, .obj or .ply"
    if path.suffix in _PACKED and PurePosixPath(path.stem).suffix in (*MESH_SUFFIXES, *UNREAD_SUFFIXES):
        return f"is compressed ({path.suffix}); unpack it"
    if path.suffix == ".dvc" and PurePosixPath(path.stem).suffix in (*MESH_SUFFIXES, *UNREAD_SUFFIXES):
        return "stands for a file that is not here; fetch it with: dvc pull"
    return None


def say_ignored(ignored: Counter[str]) -> tuple[str, ...]:
    """Returns a sentence on the files and folders ignored by rule, if there are any; `ignored` counts them by kind."""
    if not ignored:
        return ()
    kinds = ", ".join(f"{count} × {kind}" for kind, count in sorted(ignored.items()))
    return (f"ignored by rule: {kinds}",)
