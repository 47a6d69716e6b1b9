"""Compiling for devices that are not here: what is asked for, what a program's text says, and what is told of it."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest
from jax.sharding import SingleDeviceSharding

from data_pipeline.errors import DataError
from train.planning import targets
from train.planning.compile import Program, compile_for, shapes_on
from train.planning.hlo import Collective, Contents, bytes_of_shape
from train.planning.targets import Chip, Target, mesh_of

HERE = Target("cpu", "cpu", "", Chip("cpu", 1e9, 1e6), "", "jax")
"""What is here, as if it were elsewhere."""


def compiled(function, *arguments):
    where = SingleDeviceSharding(jax.devices()[0])
    return compile_for(HERE, Program(function, shapes_on(where, arguments)))


def test_figures_are_those_of_the_program():
    found = compiled(lambda a, b: a @ b, jnp.zeros((64, 32)), jnp.zeros((32, 16)))
    assert found.flop == 2 * 64 * 32 * 16
    assert found.accessed_bytes == found.contents.traffic_bytes == 4 * (64 * 32 + 32 * 16 + 64 * 16)
    assert found.flop_per_byte == found.flop / found.accessed_bytes
    assert found.least_seconds == found.accessed_bytes / HERE.chip.bandwidth  # longer than the arithmetic takes
    assert found.peak_bytes >= 4 * (64 * 32 + 32 * 16 + 64 * 16)
    assert found.contents == replace(found.contents, collectives={}, kernels=1, loops=0, open_loops=0, host_transfers=0)


def test_loops_are_told_by_whether_their_length_is_known():
    counted = lambda x: jax.lax.fori_loop(0, 9, lambda i, x: jnp.sin(x) * i, x)  # noqa: E731
    until = lambda x: jax.lax.while_loop(lambda x: jnp.sum(x) < 9, lambda x: x * 2 + 1, x)  # noqa: E731
    assert [compiled(one, jnp.ones(300)).contents.loops for one in (counted, until)] == [1, 1]
    assert [compiled(one, jnp.ones(300)).contents.open_loops for one in (counted, until)] == [0, 1]


TEXT = """HloModule jit_step, is_scheduled=true

%region_1.14 (wide.arg: (s32[], f32[8])) -> pred[] {
  %constant.3 = s32[]{:T(128)} constant(127)
  %wide.arg = (s32[]{:T(128)}, f32[8]{0:T(8)S(1)}) parameter(0)
  %get.1 = s32[]{:T(128)} get-tuple-element(%wide.arg), index=0
  ROOT %lt.45 = pred[]{:T(512)} compare(%get.1, %constant.3), direction=LT
}

%region_2.1 (arg: (s32[], pred[])) -> pred[] {
  %constant.4 = s32[] constant(40)
  %arg = (s32[], pred[]) parameter(0)
  %calm = pred[] get-tuple-element(%arg), index=1
  %get.2 = s32[] get-tuple-element(%arg), index=0
  %lt.2 = pred[] compare(%get.2, %constant.4), direction=LT
  ROOT %and.1 = pred[] and(%lt.2, %calm)
}

ENTRY %main.9 (p: f32[8]) -> f32[8] {
  %p = f32[8]{0} parameter(0)
  %while.2 = (s32[]{:T(128)}, f32[8]{0:T(8)S(1)}) while(%tuple.7), condition=%region_1.14, body=%body.1
  %while.3 = (s32[], pred[]) while(%tuple.8), condition=%region_2.1, body=%body.2
  %all-reduce.1 = f32[64,3]{1,0:T(8,128)} all-reduce(%fusion.1), replica_groups={{0,1}}, to_apply=%add
  %all-reduce-start.2 = (f32[8]{0}, f32[8]{0}) all-reduce-start(%p), to_apply=%add
  %all-reduce-done.2 = f32[8]{0} all-reduce-done(%all-reduce-start.2)
  %all-gather.1 = (bf16[16]{0}, pred[4]{0}) all-gather(%p, %q), dimensions={0}
  %custom-call.1 = f32[8]{0} custom-call(%p), custom_call_target="GatherScatterIndicesBitpacked"
  %custom-call.2 = f32[8]{0} custom-call(%p), custom_call_target="xla_ffi_python_cpu_callback"
  %send.1 = (f32[8]{0}, u32[], token[]) send(%p, %token.1), channel_id=3, is_host_transfer=true
  %send-done.1 = token[] send-done(%send.1), channel_id=3, is_host_transfer=true
  %send.2 = (f32[8]{0}, u32[], token[]) send(%p, %token.1), channel_id=4
  ROOT %infeed.1 = (f32[8]{0}, token[]) infeed(%token.1)
}
"""


def test_contents_of_a_program_for_several_devices():
    assert Contents.of(TEXT) == Contents(
        collectives={"all-reduce": Collective(2, 4 * 64 * 3 + 4 * 8), "all-gather": Collective(1, 2 * 16 + 4)},
        custom_calls={"GatherScatterIndicesBitpacked": 1, "xla_ffi_python_cpu_callback": 1},
        kernels=11,
        traffic_bytes=Contents.of(TEXT).traffic_bytes,
        loops=2,
        open_loops=1,
        host_transfers=3,
    )


MEMORY = """HloModule jit_step, is_scheduled=true

%fused.1 (param_0.1: f32[100,64], param_1.1: s32[]) -> f32[1,64] {
  %param_0.1 = f32[100,64]{1,0:T(8,128)} parameter(0)
  %param_1.1 = s32[]{:T(128)S(6)} parameter(1)
  %constant.1 = s32[]{:T(128)} constant(0)
  ROOT %dynamic-slice.1 = f32[1,64]{1,0:T(8,128)} dynamic-slice(%param_0.1, %param_1.1, %constant.1), dynamic_slice_sizes={1,64}
}

%body.1 (arg: (f32[8,64], s32[])) -> (f32[8,64], s32[]) {
  %arg = (f32[8,64]{1,0:T(8,128)}, s32[]{:T(128)S(6)}) parameter(0)
  %x = f32[8,64]{1,0:T(8,128)} get-tuple-element(%arg), index=0
  %i = s32[]{:T(128)S(6)} get-tuple-element(%arg), index=1
  %copy.1 = f32[8,64]{0,1:T(8,128)} copy(%x)
  ROOT %tuple.1 = (f32[8,64]{0,1:T(8,128)}, s32[]{:T(128)S(6)}) tuple(%copy.1, %i)
}

ENTRY %main.1 (p: f32[100,64], i: s32[]) -> f32[8,64] {
  %p = f32[100,64]{1,0:T(8,128)} parameter(0)
  %i.1 = s32[]{:T(128)S(6)} parameter(1)
  %fusion.1 = f32[1,64]{1,0:T(8,128)S(1)} fusion(%p, %i.1), kind=kLoop, calls=%fused.1
  %slice-start.1 = ((f32[100,64]{1,0:T(8,128)}), f32[8,64]{1,0:T(8,128)S(1)}, s32[]{:S(2)}) slice-start(%p), slice={[0:8], [0:64]}
  %slice-done.1 = f32[8,64]{1,0:T(8,128)S(1)} slice-done(%slice-start.1)
  %copy-start.1 = (f32[8,64]{1,0:T(8,128)}, f32[8,64]{1,0:T(8,128)S(1)}, u32[]{:S(2)}) copy-start(%slice-done.1)
  %copy-done.1 = f32[8,64]{1,0:T(8,128)} copy-done(%copy-start.1)
  %tuple.2 = (f32[8,64]{1,0:T(8,128)}, s32[]{:T(128)S(6)}) tuple(%copy-done.1, %i.1)
  %while.1 = (f32[8,64]{1,0:T(8,128)}, s32[]{:T(128)S(6)}) while(%tuple.2), condition=%none, body=%body.1
  ROOT %out = f32[8,64]{1,0:T(8,128)} get-tuple-element(%while.1), index=0
}
"""


def test_traffic_is_with_the_device_s_memory():
    """Slices, not what they are cut from; nothing for vector memory; rows of 64 numbers fill tiles of 128."""
    of_slice, padded = 4 * 64, 4 * 8 * 128
    found = Contents.of(MEMORY)
    # The fusion reads a row; a slice is fetched, and written back; the loop copies an array to another order, of 64 rows.
    assert found.traffic_bytes == of_slice + 4 * 8 * 64 + padded + padded + 4 * 64 * 128
    assert found.kernels == 4


@pytest.mark.parametrize(
    ("shape", "size"), [("f32[]", 4), ("(f64[2,3]{1,0:T(2,128)}, s8[5]{0})", 53), ("f8e4m3fn[7]", 7), ("token[]", 0)]
)
def test_bytes_of_shapes(shape, size):
    assert bytes_of_shape(shape) == size


@pytest.mark.parametrize("name", ["tpu", "tpu:v5e", "tpu:v9:2x2", "gpu:a100", "v5e:2x2"])
def test_targets_that_do_not_exist_are_refused(name):
    with pytest.raises(DataError, match=f"--target {name} names no device; it is gpu:h100, or .*tpu:v5e:2x2"):
        Target.of(name)


@pytest.mark.parametrize(("name", "extra"), [("tpu:v5e:8x8", "aot-tpu"), ("gpu:h100", "aot-cuda")])
def test_a_missing_compiler_is_named_by_its_extra(name, extra, monkeypatch):
    monkeypatch.setattr(targets, "find_spec", lambda _: None)
    with pytest.raises(DataError, match=rf"compiling for {name} needs \w+: pip install -e '\.\[{extra}\]'"):
        Target.of(name)


@pytest.mark.skipif(importlib.util.find_spec("libtpu") is None, reason="needs the extra aot-tpu")
def test_a_tpu_that_is_not_here():
    with pytest.raises(DataError, match="XLA has no devices for --target tpu:v5e:3x3"):
        Target.of("tpu:v5e:3x3").devices()
    target = Target.of("tpu:v5e:2x2")
    mesh = mesh_of(target.devices())
    assert mesh.shape == {"data": 4, "model": 1}
    split = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("data"))
    found = compile_for(target, Program(jnp.sum, shapes_on(split, (jnp.zeros((8, 128)),))))
    assert found.contents.collectives["all-reduce"].bytes == 4
    assert found.contents.traffic_bytes
