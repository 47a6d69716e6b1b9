"""Functions of users, given as `module:function` or `path/to/file.py:function`: loading, and what identifies them."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from data_pipeline.errors import DataError, kind_and_reason_of
from data_pipeline.files import short_hash
from mevs_jax.models.shapes import ENCODERS


@dataclass(frozen=True)
class OwnCode:
    """A function of a user.

    Attributes:
        reference: as it was given.
        module: its module, or the name of its file.
        name: of the function.
        source: hash of the source files of the module and of the function. Modules that these import are not part of it.
        function: the function.
    """

    reference: str
    module: str
    name: str
    source: str
    function: Callable[..., Any] = field(compare=False)

    @property
    def identity(self) -> dict[str, str]:
        """What identifies the function: it changes when its source file is edited, not when the file is moved."""
        return {"module": self.module, "name": self.name, "source": self.source}


def absolute(reference: str) -> str:
    """Returns a reference that holds in every working directory: the path of a file is made absolute."""
    place, colon, name = reference.rpartition(":")
    return f"{Path(place).expanduser().absolute()}:{name}" if colon and place.endswith(".py") else reference


def named(reference: str) -> tuple[str, str]:
    """Returns the module, or the name of the file, and the function that a reference names, as in `OwnCode.identity`."""
    place, _, name = reference.rpartition(":")
    return (Path(place).name if place.endswith(".py") else place), name


def load_own(reference: str, option: str) -> OwnCode:
    """Loads a function from `module:function` or `path/to/file.py:function`.

    A module is looked for where Python looks for modules and in the working directory; a file may import modules beside it.

    Args:
        option: with which the reference was given, for messages.

    Raises:
        DataError: if there is no such module, file or function, or the module cannot be imported.
    """
    place, _, name = reference.rpartition(":")
    if not place or not name.isidentifier():
        built_in = f"{', '.join(ENCODERS)}, or " if option == "--encoder" else ""
        raise DataError(
            f"{option} {reference} is not {built_in}of the form module:function or path/to/file.py:function"
        )
    if place.endswith(".py"):
        module, content = _from_file(Path(place).expanduser(), reference, option)
    else:
        module = _imported(place, reference, option)
        content = b""
    function = getattr(module, name, None)
    if not callable(function):
        found = [
            key
            for key, value in vars(module).items()
            if inspect.isfunction(value) and value.__module__ == module.__name__ and not key.startswith("_")
        ]
        has = f"it has {', '.join(found[:8])}" if found else "it has none"
        raise DataError(f"{option} {reference}: {place} has no function {name!r} ({has}); correct the name")
    content = content or _source_of(module, reference, option)
    if (defined := _file_of(function)) not in (None, _file_of(module)):
        content += Path(str(defined)).read_bytes()
    return OwnCode(reference, *named(reference), short_hash(content), function)


def _from_file(path: Path, reference: str, option: str) -> tuple[ModuleType, bytes]:
    """Returns the module of a file and its content; the same content is run once in a process."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(
            f"{option} {reference}: {path} cannot be read ({error.strerror}); correct the path, or restore the file"
        ) from error
    path = path.absolute()
    name = f"own_{path.stem}_{hashlib.sha256(str(path).encode() + content).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name], content
    module = ModuleType(name)
    module.__file__ = str(path)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    sys.modules[name] = module
    try:
        # Compiled here, since Python's cache of compiled files misses an edit of the same length within a second.
        exec(compile(content, str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise _not_imported(str(path), reference, option, error) from error
    return module, content


def _imported(place: str, reference: str, option: str) -> ModuleType:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        return importlib.import_module(place)
    except (Exception, SystemExit) as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name and f"{place}.".startswith(f"{error.name}.")
        if missing or (isinstance(error, TypeError | ValueError) and place.startswith(".")):
            raise DataError(
                f"{option} {reference}: there is no module {place}; name one that Python can import, or a file ending in .py"
            ) from error
        raise _not_imported(place, reference, option, error) from error


def _not_imported(place: str, reference: str, option: str, error: BaseException) -> DataError:
    reason = kind_and_reason_of(error) if isinstance(error, Exception) else "it ends the program"
    return DataError(f"{option} {reference}: {place} cannot be imported ({reason}); repair it")


def _file_of(thing: Any) -> str | None:
    try:
        return inspect.getsourcefile(inspect.unwrap(thing) if callable(thing) else thing)
    except TypeError:  # built in, or an object that is called
        return None


def _source_of(module: ModuleType, reference: str, option: str) -> bytes:
    path = _file_of(module)
    if path is None:
        raise DataError(
            f"{option} {reference}: {module.__name__} has no source file; name a function written in Python"
        )
    return Path(path).read_bytes()
