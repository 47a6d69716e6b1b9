"""Commands in the documentation exist with their options, blocks of Python run, links lead somewhere, tables are whole."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import yaml

import mevs_jax
from data_pipeline.capture.casting import Cast, default_caster
from data_pipeline.objects.furniture import furniture
from data_pipeline.objects.mesh import normalise
from eval.checks.camera import Shot, cast_shot
from mevs_jax.cli.commands import ALIASES, COMMANDS
from mevs_jax.cli.parsing import parse, tool_options
from tests.data_pipeline.frames.forms import bop, seven_scenes
from tests.data_pipeline.scene.test_scene import FLOOR, THINGS, recorded

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
CENTER, RADIUS = np.array([0.5, 0.1, 0.8]), 0.15
K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])


def commands_in(page: Path) -> list[str]:
    """The calls of `mevs` in a page's blocks of code, without comments."""
    text = page.read_text()
    fenced = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    outside = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    indented = [line.strip() for line in outside.splitlines() if line.startswith("    ")]
    lines = "\n".join([*fenced, *indented]).replace("\\\n", " ").splitlines()
    found = [re.search(r"(?:^|[ /\"])mevs (.*)", re.sub(r"\s#.*", "", line)) for line in lines]
    calls = [match[1].strip() for match in found if match]
    return [call.removesuffix('"') if call.count('"') % 2 else call for call in calls]


COMMANDS_OF_PAGES = {command: page.name for page in reversed(PAGES) for command in commands_in(page)}
"""The commands, each with the first page that has it."""


def test_pages_have_commands():
    assert len(COMMANDS_OF_PAGES) > 30
    assert {*COMMANDS_OF_PAGES.values()} >= {"README.md", "start.md", "scaling.md", "robot.md", "agent.md"}


@pytest.mark.parametrize(
    "command", [pytest.param(command, id=f"{page}: {command[:60]}") for command, page in COMMANDS_OF_PAGES.items()]
)
def test_documented_commands_take_their_options(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [word for word in shlex.split(command) if word != "…"]
    if words[:1] in (["COMMAND"], ["--help"]):
        return
    name = " ".join(words[:2]) if " ".join(words[:2]) in COMMANDS else words[0]
    arguments = words[len(name.split()) :]
    name = ALIASES.get(name, name)
    assert name in COMMANDS, command
    tool_options(name, arguments) if COMMANDS[name].tool else parse(name, arguments)


@cache
def chair() -> Cast:
    piece = furniture("chair", 900)
    return default_caster()(normalise(piece.vertices, piece.faces, "chair"))


def look_from(pose: np.ndarray, radius: float = RADIUS) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a chair around the centre of the documented calls, by a camera of 320×240 pixels."""
    depth = cast_shot(chair(), Shot(320, 240, K, pose, CENTER, radius))
    return np.where(depth > 0, depth, np.inf), K


def world_of(page: str, whole: Path) -> dict:
    """Names that a page's blocks use and a reader has: a camera, arrays, tables."""
    import jax

    from eval.tables import load_view_tables

    look = partial(look_from, radius=0.45) if page == "README.md" else look_from
    pose = np.array(mevs_jax.look_at_origin(np.array([0.3, -0.2, 0.25], np.float32)), float)
    pose[:3, 3] += CENTER
    depth, _ = look(pose)
    piece = furniture("desk", 900)
    tables = load_view_tables(whole / "tables" / "test.npz")
    return {
        "look_from": look if page == "README.md" else lambda pose: (*look(pose), pose),
        "can_reach": lambda pose: pose[2, 3] > CENTER[2] - 0.2,
        "depth": depth,
        "K": K,
        "T_world_camera": pose,
        "pose": pose,
        "vertices": np.asarray(piece.vertices) * 0.15,
        "faces": np.asarray(piece.faces),
        "frames": [mevs_jax.DepthImage(*look(pose), pose, mask=look(pose)[0] < np.inf)],
        "points": CENTER + RADIUS * np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)),
        "tables": tables.stacked(),
        "graph": mevs_jax.ViewGraph.from_points(mevs_jax.fibonacci_sphere(tables.logits.shape[1])),
        "key": jax.random.key(0),
    }


WITH_PYTHON = [page.name for page in PAGES if "```python" in page.read_text()]


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_PYTHON)
def test_documented_python_runs(page, whole, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(whole)
    if page == "environment.md":
        for package in ("ap_gym", "gymnax"):
            pytest.importorskip(package, reason=f"a block needs the package {package}")
    piece = furniture("chair", 900)
    piece.export(tmp_path / "chair.obj")
    bop(tmp_path / "ycbv" / "test" / "000048")
    if page == "scene.md":
        room = recorded([*FLOOR, *(box for thing in THINGS.values() for box in thing)], frames=48)
        seven_scenes(tmp_path / "scan", room.depth, room.T_world_camera, room.K[0])
    (path,) = (one for one in PAGES if one.name == page)
    world = world_of(page, whole)
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL)):
        exec(compile(block, f"{page}, block {number}", "exec"), world)


@pytest.mark.slow
def test_the_first_block_needs_the_library_alone(tmp_path):
    furniture("chair", 900).export(tmp_path / "chair.obj")
    without = (
        'import sys; sys.modules |= dict.fromkeys(("data_pipeline", "train", "eval", "trimesh", "open3d", "PIL"))\n'
    )
    block = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    subprocess.run([sys.executable, "-c", without + block], cwd=tmp_path, check=True)


def test_documented_json_and_yaml_can_be_read():
    found = {"json": 0, "yaml": 0}
    for page in PAGES:
        for language, block in re.findall(r"```(json|yaml)\n(.*?)```", page.read_text(), re.DOTALL):
            found[language] += 1
            assert json.loads(block) if language == "json" else list(yaml.safe_load_all(block))
    assert min(found.values()) > 0


def test_links_lead_somewhere():
    for page in [*PAGES, ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("examples/**/README.md")]:
        text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            if target.startswith(("http://", "https://")):
                continue
            file, _, anchor = target.partition("#")
            there = (page.parent / file).resolve() if file else page
            assert there.exists(), f"{page.name}: {target}"
            if anchor:
                headings = re.findall(r"^#+ (.*)$", there.read_text(), re.MULTILINE)
                assert anchor in {anchor_of(heading) for heading in headings}, f"{page.name}: {target}"


def tables_of(text: str) -> list[list[str]]:
    """The tables of a page, each a list of lines."""
    outside = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    return [block.strip().splitlines() for block in re.findall(r"(?:^\|.*\n?)+", outside, re.MULTILINE)]


def test_rows_of_a_table_have_as_many_cells_as_its_header():
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        for header, *rows in tables_of(page.read_text()):
            cells = header.count("|")
            assert [row for row in rows if row.count("|") != cells] == [], f"{page.name}: {header}"


def anchor_of(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")
