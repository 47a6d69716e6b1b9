"""`mevs check compile`: the table of programs, and the comparison with earlier figures. Compilers of devices are optional."""

from __future__ import annotations

import json
from dataclasses import replace

import jax
import pytest

from data_pipeline.errors import DataError
from eval.checks.compiling import CompileCheck, check_compile, chosen_programs, grown, read_check
from eval.checks.programs import PROGRAMS
from mevs_jax.cli.checks import compile_text, compiling
from mevs_jax.cli.failure import Unusable
from mevs_jax.cli.options import CompileOptions
from train.planning.compile import Compiled
from train.planning.hlo import Collective, Contents
from train.planning.targets import Chip, Target, mesh_of
from train.results.records import as_json, from_json

HERE = Target("cpu", "cpu", "", Chip("cpu", 1e9, 1e6), "", "jax")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * name.startswith("train")) for name in PROGRAMS]
)
def test_every_program_can_be_lowered_for_every_platform(name, monkeypatch):
    """On a host that knows nothing of them: none asks which device is here."""
    program = PROGRAMS[name](mesh_of(jax.devices()))
    monkeypatch.setattr(jax, "default_backend", lambda: pytest.fail("a program asks for the host's device"))
    traced = jax.jit(program.function).trace(*program.arguments)
    texts = {platform: traced.lower(lowering_platforms=(platform,)).as_text() for platform in ("cpu", "tpu")}
    assert all("func.func public @main" in text for text in texts.values())


def figures(traffic_bytes=8_000_000, **changes) -> Compiled:
    contents = Contents({"all-reduce": Collective(23, 1_500_000)}, {"Gather": 3}, 57, traffic_bytes, 2, 1, 1)
    return replace(Compiled(1.25, 2_000_000, 4e9, 9e6, contents, 500.0, 0.004), **changes)


def made(**programs) -> CompileCheck:
    return CompileCheck("tpu:v5e:8x8", 64, {"jax": "0.10.2"}, programs, {})


def test_figures_are_read_as_they_were_written():
    found = replace(made(one=figures(), two=figures(accessed_bytes=None)), refused={"three": "why"})
    assert from_json(CompileCheck, json.loads(json.dumps(as_json(found))), "figures") == found


def test_the_table_shows_what_a_program_needs_and_does():
    text = compile_text(replace(made(one=figures(), two=figures()), refused={"three": "too large"}))
    assert "tpu:v5e:8x8, 64 devices; jax 0.10.2" in text
    line, said, other, *_ = text.splitlines()[3:]
    assert line.split() == ["one", "1.2", "s", "2", "MB", "4", "GFLOP", "8", "MB", "500", "4", "ms", "57"]
    expected = "23 all-reduce (1.5 MB); 3 Gather; 2 loops, 1 of unknown length; 1 transfers from or to the host"
    assert said.strip() == expected
    assert other.startswith("two")
    assert "three cannot be compiled: too large" in text


def test_programs_that_grew_by_more_than_a_quarter_are_named():
    before = made(one=figures(), two=figures(), three=figures(), gone=figures())
    now = made(
        one=figures(traffic_bytes=10_000_000),
        two=figures(traffic_bytes=10_100_000),
        three=figures(peak_bytes=3_000_000),
    )
    said = grown(replace(now, refused={"gone": "too large"}), before)
    assert said == [
        "two moves 1.01e+07 bytes instead of 8e+06 (+26%)",
        "three holds 3e+06 bytes instead of 2e+06 (+50%)",
        "gone was compiled before, and is not now (too large)",
    ]
    assert grown(made(new=figures()), before) == []
    with pytest.raises(DataError, match="are of gpu:h100, not of tpu:v5e:8x8"):
        grown(now, replace(before, target="gpu:h100"))


def test_programs_are_chosen_by_how_their_names_begin():
    assert chosen_programs([]) == list(PROGRAMS)
    assert chosen_programs(["decide", "ball"]) == [
        "ball-query",
        *("decide", "decide-expected-views", "decide-fused", "decide-exported"),
    ]
    with pytest.raises(
        DataError, match="--only stroll: there is no such program; they are farthest-points, ball-query"
    ):
        chosen_programs(["ball", "stroll"])


def test_the_command_compiles_keeps_and_compares(monkeypatch, tmp_path, capsys):
    """For the device that is here, as if it were not."""
    monkeypatch.setattr(Target, "of", lambda _: HERE)
    monkeypatch.setattr(Target, "devices", lambda _: jax.devices()[:1])
    path = tmp_path / "figures.json"
    options = CompileOptions(target="cpu", only=("ball-query",), to=path)
    compiling(options)
    assert "ball-query" in capsys.readouterr().out
    kept = read_check(path)
    assert kept.programs["ball-query"].contents.traffic_bytes > 0
    assert kept.made_with["jax"] == jax.__version__
    compiling(replace(options, against=path, json=True))
    assert json.loads(capsys.readouterr().out)["target"] == "cpu"
    old = kept.programs["ball-query"]
    path.write_text(json.dumps(as_json(replace(kept, programs={"ball-query": replace(old, peak_bytes=9)}))))
    with pytest.raises(Unusable, match=r"programs have grown since .*: ball-query holds"):
        compiling(replace(options, against=path, to=None))
    with pytest.raises(DataError, match="there is no such file; write one with --to"):
        read_check(tmp_path / "none.json")


def test_what_xla_cannot_compile_is_said_and_the_others_are_compiled(monkeypatch):
    def refuse(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory\nmore")

    monkeypatch.setattr(Target, "devices", lambda _: jax.devices()[:1])
    monkeypatch.setitem(PROGRAMS, "ball-query", refuse)
    found = check_compile(HERE, ["ball-query", "farthest-points"])
    assert found.refused == {"ball-query": "RESOURCE_EXHAUSTED: out of memory"}
    assert list(found.programs) == ["farthest-points"]
