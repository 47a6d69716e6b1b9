"""Tools for trained systems: `mevs look`, `enrol`, `export`. They need the library alone, except to read recordings and runs."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mevs_jax.cli.failure import Unusable
from mevs_jax.deploy.compiled import keep_compiled

_UNSEEN = 900
"""Number of the built-in piece of each class; pieces with this number are in no data set."""

if TYPE_CHECKING:
    from data_pipeline.frames.recording import Recording
    from mevs_jax.agent import Frames, Walk
    from mevs_jax.cli.options import EnrolOptions, ExportOptions, LookOptions, ReadingOptions, RecordingOptions
    from mevs_jax.meshes.paint import Paint
    from mevs_jax.trained import TrainedSystem


def look(options: LookOptions) -> None:
    """Recognises one object, and prints how."""
    if (options.mesh is None) == (options.depth is None):
        raise Unusable("mevs look needs an object: --mesh FILE or --depth FILE, one of them")
    if options.draw is not None:
        check_drawing(options.draw)
    if options.scene:
        return look_at_scene(options)
    if options.view and importlib.util.find_spec("viser") is None:
        raise Unusable("--view needs viser: pip install 'mevs-jax[view]', or pip install viser")
    source = options.mesh or options.depth
    assert source is not None
    if options.metres < 0 or (options.metres and options.depth is not None):
        raise Unusable("--metres is the metres in one unit of a --mesh, 0.001 for millimetres; images are in metres")
    if options.mesh is not None:
        refuse_recording_options(options, "--mesh")
    mesh = read_mesh(options.mesh, options.up) if options.mesh is not None else None
    frames, names = frames_in(options.depth, options) if options.depth is not None else (None, ())
    with suppress(OSError):  # without a place to keep programs in, they are compiled again
        keep_compiled()
    system = load_system(options.system)
    if options.metres and not system.description.uses_size:
        raise Unusable(f"{options.system} does not use sizes; leave out --metres")
    given = _agent_options(options)
    try:
        if mesh is not None:
            walk = _look_at_mesh(system, mesh, options, given)
        else:
            from mevs_jax.agent.present import LEAST

            assert frames is not None
            usable = shown_in(frames, 0.0 if system.description.told_unknown else LEAST) if names else None
            walk = _look_at_frames(system, frames, options.first, usable, given)
    except ValueError as error:
        raise Unusable(f"{source}: {error}") from error
    taken = [names[view] for view in walk.views] if names else []
    if options.json:
        print(json.dumps(as_json(walk, source.name) | ({"frames": taken} if names else {})))
    else:
        print("\n".join([source.name, str(walk), *(["frames: " + ", ".join(taken)] if names else [])]))
    try:
        if options.save is not None:
            walk.history.save(options.save)
        if options.draw is not None:
            from mevs_jax.agent.drawing import draw_walk

            draw_walk(walk, system, options.draw, source.name)
        if options.view:
            from mevs_jax.agent.viewing import view

            server = view(walk.history, system)
            print(f"Viewer: http://127.0.0.1:{server.get_port()} (Ctrl-C ends it)", flush=True)
            server.sleep_forever()
    except OSError as error:
        raise Unusable(
            f"cannot write {error.filename or 'the results'} ({error.strerror}); choose another file"
        ) from error


def look_at_scene(options: LookOptions) -> None:
    """Recognises every object of a recorded scene, and prints a table of them."""
    defaults = {option.name: option.default for option in fields(options)}
    for name in ("mesh", "first", "view", "save", "metres", "center", "radius"):
        if getattr(options, name) != defaults[name]:
            raise Unusable(f"--scene finds all objects of --depth PATH by itself; leave out --{name}")
    assert options.depth is not None
    recording, up = _recording(options.depth, options), options.upward
    from data_pipeline.scene import looking

    with suppress(OSError):  # without a place to keep programs in, they are compiled again
        keep_compiled()
    system, given = load_system(options.system), _agent_options(options)
    try:
        scene = looking.scene_in(recording, None if up is None else np.array(up, float), options.floor)
        seen = looking.look_at_scene(system, recording, scene, **given)
        if options.draw is not None:
            looking.draw_scene(scene, seen, options.draw)
    except ValueError as error:
        raise Unusable(f"{options.depth}: {error}") from error
    except OSError as error:
        raise Unusable(
            f"cannot write {error.filename or options.draw} ({error.strerror}); choose another file"
        ) from error
    if options.json:
        objects = [sight.as_json() for sight in seen]
        print(json.dumps({"up": scene.up.tolist(), "floor": scene.floor, "pieces": scene.pieces, "objects": objects}))
        return
    print(f"up {_xyz(scene.up)}, floor {scene.floor:.2f} m along it")
    print(f"{'':3} {'object':16} {'confidence':>10}  {'why it ended':18} {'evidence':>8}  center, radius in m")
    for number, sight in enumerate(seen):
        said = sight.as_json()
        confidence = "" if said["confidence"] is None else f"{100 * said['confidence']:.0f} %"
        place = f"{_xyz(sight.sphere.position)}, {sight.sphere.radius:.2f}"
        print(f"{number:3} {sight.name:16} {confidence:>10}  {said['reason']:18} {said['evidence']:8.1f}  {place}")
        if said.get("pose") is not None and sight.name != "unknown object":
            print(f"{'':20} pose {said['pose']}")
    if scene.pieces:
        print(f"{scene.pieces} pieces that are too small are left out")


def _xyz(point: np.ndarray) -> str:
    return " ".join(f"{value:.2f}" for value in point)


def _agent_options(options: LookOptions) -> dict[str, Any]:
    given = {name: getattr(options, name) for name in ("policy", "stop", "max_views")}
    return given | ({} if options.unknown is None else {"unknown": options.unknown})


def check_drawing(path: Path) -> None:
    """Raises `Unusable` if a picture cannot be drawn into a file of this name."""
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise Unusable(f"{path} is no .png, .svg or .pdf; name the image by one of these")
    if importlib.util.find_spec("matplotlib") is None:
        raise Unusable("drawing a walk needs matplotlib: pip install matplotlib")


def _look_at_frames(
    system: TrainedSystem, frames: Frames, first: int | None, usable: np.ndarray | None, given: dict[str, Any]
) -> Walk:
    from mevs_jax.agent import look_at_frames

    if first is None:
        first = 0 if usable is None else int(usable.argmax())
    given["max_views"] = min(given["max_views"], len(frames.depth))
    agent = system.agent(**given, max_candidates=max(128, len(frames.depth)))
    return look_at_frames(agent, frames, first=first, usable=usable)


def _look_at_mesh(
    system: TrainedSystem, mesh: tuple[np.ndarray, np.ndarray], options: LookOptions, given: dict[str, Any]
) -> Walk:
    from mevs_jax.agent import look

    paint = paint_of(options.mesh, *mesh) if options.mesh is not None and system.description.colour else None
    return look(system, *mesh, first=options.first, metres=options.metres or None, paint=paint, **given)


def as_json(walk: Walk, name: str) -> dict[str, Any]:
    """A walk as values that JSON can hold."""
    return {
        "object": name,
        "answer": walk.name,
        "confidence": walk.confidence,
        "reason": walk.reason,
        "views": list(walk.views),
        "beliefs": walk.history.beliefs,
    }


def read_mesh(path: Path, up: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a mesh file, or of a built-in piece of furniture, which the study makes."""
    import mevs_jax
    from mevs_jax.cli.main import has_checkout

    if not path.exists() and not path.suffix:
        if not has_checkout():
            raise Unusable(f"{path} is no file; built-in furniture comes with a checkout of the project alone")
        from data_pipeline.objects.mesh import MODELNET10_CLASSES
        from data_pipeline.objects.recipes import FurniturePiece

        if str(path) in MODELNET10_CLASSES:
            return FurniturePiece(str(path), _UNSEEN).load()
    return mevs_jax.read_mesh(path, up)  # type: ignore[arg-type]


def paint_of(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Paint | None:
    """The colours of a mesh file, if it has some that can be read; says what is missing."""
    from mevs_jax.meshes.paint import read_paint

    if not path.is_file():  # a built-in piece of furniture
        return None
    try:
        paint = read_paint(path, vertices, faces)
    except (ValueError, ImportError) as error:
        print(f"Note: {error}; {path.name} is compared by its shape alone", file=sys.stderr)
        return None
    for note in () if paint is None else paint.notes:
        print(f"Note: {note}", file=sys.stderr)
    return paint


def frames_in(path: Path, options: RecordingOptions) -> tuple[Frames, tuple[str, ...]]:
    """Recorded depth images, and their names if they are of a folder. Options go before what files say of the object."""
    from mevs_jax.agent.looking import Frames, read_arrays

    given = {name: getattr(options, name) for name in ("center", "radius", "floor")} | {"up": options.upward}
    given = {name: np.array(value, float) for name, value in given.items() if value is not None}
    names: tuple[str, ...] = ()
    try:
        if is_archive(path):
            if options.every != 1 or options.depth_unit is not None or options.intrinsics is not None:
                raise ValueError(
                    "an .npz is in metres, with K; --every, --depth-unit and --intrinsics are for folders and bags"
                )
            stored = read_arrays(path)
        else:
            recording = _recording(path, options)
            stored, names = recording.arrays(), recording.names
            if "center" not in given and "mask" not in stored:
                raise ValueError(
                    "images do not say where the object is; give --center X Y Z and --radius R in metres, or choose an object of "
                    "a BOP scene as PATH#NUMBER"
                )
        return Frames.of(stored | given), names
    except ValueError as error:
        raise Unusable(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def refuse_recording_options(options: RecordingOptions, other: str) -> None:
    """Raises `Unusable` if an option says something of recorded images, where there are none."""
    from mevs_jax.cli.options import RecordingOptions

    for option in fields(RecordingOptions):
        if getattr(options, option.name) != option.default:
            raise Unusable(
                f"--{option.name.replace('_', '-')} is for recorded depth images, not for {other}; leave it out"
            )


def is_archive(path: Path) -> bool:
    """Whether a file of recorded images is an .npz, which the library reads by itself."""
    return path.suffix.lower() == ".npz"


def _recording(path: Path, options: RecordingOptions) -> Recording:
    """Recorded images, by the study's readers."""
    from mevs_jax.cli.main import has_checkout

    if not has_checkout():
        raise Unusable("folders and bags are read by a checkout of the project, not by the package alone; give an .npz")
    return read_recording(path, options)


def read_recording(path: Path, options: ReadingOptions) -> Recording:
    """A recording of any form; prints what was left out of it."""
    from data_pipeline.frames.reading import read_frames

    intrinsics = None if options.intrinsics is None else np.array(options.intrinsics, float)
    recording = read_frames(path, every=options.every, metres=options.depth_unit, intrinsics=intrinsics)
    for note in recording.notes:
        print(f"Note: {path}: {note}", file=sys.stderr)
    return recording


def shown_in(frames: Frames, least: float = 0.0) -> np.ndarray:
    """Which frames show the object, and at least a share of its sphere; says how many do not."""
    shown = frames.shown(least)
    if lost := np.sum(~shown):
        enough = f" at least {100 * least:.0f} % of" * (least > 0)
        print(f"Note: {lost} of {len(shown)} images do not show{enough} the object, and are left out", file=sys.stderr)
    return shown


def load_system(name: str | Path) -> TrainedSystem:
    """A trained system by its path or name."""
    import mevs_jax

    try:
        return mevs_jax.load(name)
    except (ValueError, OSError, ImportError) as error:
        raise Unusable(str(error)) from error


def enrol(options: EnrolOptions) -> None:
    """Writes a system that knows some objects."""
    import warnings

    from mevs_jax import enrolment

    if not (options.objects or options.remove or options.rename):
        raise Unusable("mevs enrol needs objects: NAME=FILE ..., or --remove NAME, or --rename OLD=NEW")
    if not 0 <= options.metres < float("inf"):
        raise Unusable(f"--metres is the metres in one unit of the meshes, 0.001 for millimetres, got {options.metres}")
    given = {name: _shape_of(Path(file), options) for name, file in _pairs(options.objects, "NAME=FILE")}
    if len(given) < len(options.objects):
        raise Unusable("two objects have one name; choose another for one of them")
    if options.center is not None and len(options.objects) > 1:
        raise Unusable("--center says where one object is; enrol one at a time, with --system of those before it")
    system = load_system(options.system)
    try:
        if options.remove:
            system = enrolment.remove(system, options.remove)
        if options.rename:
            system = enrolment.rename(system, dict(_pairs(options.rename, "OLD=NEW")))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", enrolment.AlikeWarning)
            if given:
                system = enrolment.enrol(given, system, true_size=options.metres > 0)
        system.save(options.to)
    except (ValueError, FileExistsError, ImportError) as error:
        raise Unusable(str(error)) from error
    except OSError as error:
        raise Unusable(f"cannot write {options.to} ({error.strerror}); choose another folder") from error
    for warning in said:
        print(f"Note: {warning.message}")
    known = ", ".join(system.classes[:-1]) or "none"
    print(
        f"Enrolled: {known}\nTrained system: {options.to.absolute()} (recognise with: mevs look --system {options.to})"
    )


def _pairs(given: tuple[str, ...], form: str) -> list[tuple[str, str]]:
    pairs = [one.partition("=") for one in given]
    for (name, equals, value), one in zip(pairs, given, strict=True):
        if not (name and equals and value):
            raise Unusable(f"{one!r} is not {form}")
    return [(name, value) for name, _, value in pairs]


def _shape_of(path: Path, options: EnrolOptions) -> Any:
    """An object as `mevs_jax.enrol` takes it, from a file."""
    from mevs_jax.agent.ros import BAGS

    if is_archive(path):
        return frames_in(path, options)[0]
    if path.is_dir() or path.suffix.lower() in BAGS or ("#" in str(path) and not path.exists()):
        frames = frames_in(path, options)[0]
        try:
            return frames.only(shown_in(frames))
        except ValueError as error:
            raise Unusable(f"{path}: {error}") from error
    refuse_recording_options(options, f"the mesh {path}")
    vertices, faces = read_mesh(path, options.up)
    paint = paint_of(path, vertices, faces)
    shape = vertices * (options.metres or 1.0), faces
    return shape if paint is None else (*shape, paint)


def export(options: ExportOptions) -> None:
    """Writes the trained system of a run, or any other, into a folder."""
    from mevs_jax.deploy.export import export as write_programs

    if (options.out is None) == (options.system is None):
        raise Unusable("mevs export needs a run or a system: --out DIR or --system PATH, one of them")
    if options.out is not None:
        system = _system_of_run(options.out)
    else:
        assert options.system is not None
        system = load_system(options.system)
    system = _with_measured(system, options.measured)
    try:
        system.save(options.to, half=options.half, programs=write_programs if options.stablehlo else None)
    except (FileExistsError, ImportError) as error:
        raise Unusable(str(error)) from error
    except OSError as error:
        raise Unusable(f"cannot write {options.to} ({error.strerror}); choose another folder") from error
    size = sum(path.stat().st_size for path in options.to.rglob("*") if path.is_file())
    print(f"Trained system: {options.to.absolute()} ({size / 1e6:.1f} MB)")


def _with_measured(system: TrainedSystem, paths: Sequence[Path]) -> TrainedSystem:
    """The system whose description says what was measured on objects of other sources."""
    from mevs_jax.trained.card import ELSEWHERE, elsewhere

    if not paths:
        return system
    if system.description.kind == "gallery":
        raise Unusable("--measured is of systems of classes; enrolled objects are measured by mevs study instances")
    try:
        measured = [elsewhere(Path(path).read_text()) for path in paths]
    except (OSError, ValueError, KeyError, TypeError) as error:
        files = ", ".join(map(str, paths))
        raise Unusable(f"{files}: not all are results of mevs check transfer --to FILE ({error})") from error
    evaluation = system.description.evaluation | {ELSEWHERE: measured}
    return replace(system, description=replace(system.description, evaluation=evaluation))


def _system_of_run(out: Path) -> TrainedSystem:
    from mevs_jax.cli.main import has_checkout

    if (out / "metrics.json").exists() and (out / "run.json").exists() and has_checkout():
        from data_pipeline.lock import locked
        from eval import stages
        from eval.run_file import load_run

        run = load_run(out)
        assert run is not None
        with locked(out, "mevs export"):
            stages.make_system(run.settings, out)
    return load_system(out)
