"""Devices that programs are compiled for without being here: what XLA is told of them, and how fast they are."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import jax
import numpy as np
from jax.experimental import topologies
from jax.sharding import AbstractDevice, AbstractMesh, Mesh

from data_pipeline.errors import DataError, reason_of
from train.running.devices import DATA, MODEL


@dataclass(frozen=True)
class Chip:
    """One chip, by its maker's figures.

    Attributes:
        kind: as JAX names it.
        flop: largest number of floating-point operations in a second: matrix products in bfloat16, without sparsity.
        bandwidth: bytes in a second from and to its memory.
    """

    kind: str
    flop: float
    bandwidth: float


_TPUS = {
    "v5e": Chip("TPU v5 lite", 197e12, 819e9),  # docs.cloud.google.com/tpu/docs/v5e
    "v5p": Chip("TPU v5", 459e12, 2765e9),  # docs.cloud.google.com/tpu/docs/v5p
    "v6e": Chip("TPU v6 lite", 918e12, 1638e9),  # docs.cloud.google.com/tpu/docs/v6e
}
_H100 = Chip("NVIDIA H100 80GB HBM3", 989.4e12, 3352e9)  # H100 SXM: nvidia.com/h100, without sparsity

_DESCRIPTION_OF_H100 = """
gpu_device_info {
  threads_per_block_limit: 1024
  threads_per_warp: 32
  shared_memory_per_block: 49152
  shared_memory_per_core: 233472
  threads_per_core_limit: 2048
  core_count: 132
  fpus_per_core: 128
  block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535
  block_dim_limit_z: 65535
  memory_bandwidth: 3352320000000
  l2_cache_size: 52428800
  clock_rate_ghz: 1.98
  device_memory_size: 84929347584
  shared_memory_per_block_optin: 232448
  cuda_compute_capability { major: 9 }
  registers_per_core_limit: 65536
  registers_per_block_limit: 65536
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 7 }
runtime_version { major: 13 minor: 0 patch: 0 }
device_description_str: "NVIDIA H100 80GB HBM3"
"""
"""What XLA asks of a GPU (`GpuTargetConfigProto`), as CUDA reports it."""


@dataclass(frozen=True)
class Target:
    """Devices that are not here.

    Attributes:
        name: as it was given, such as `tpu:v5e:8x8`.
        platform: JAX's, `tpu` or `cuda`.
        topology: its name in XLA.
        chip: each of them.
        extra: of this project, which installs XLA's compiler for them.
        compiler: the module that holds it.
    """

    name: str
    platform: str
    topology: str
    chip: Chip
    extra: str
    compiler: str

    @classmethod
    def of(cls, name: str) -> Target:
        """Returns a target by its name.

        Raises:
            DataError: if there is none of this name, or its compiler is not installed.
        """
        kind, _, which = name.partition(":")
        generation, _, shape = which.partition(":")
        if name == "gpu:h100":
            found = cls(name, "cuda", "1x1x1", _H100, "aot-cuda", "jax_cuda13_plugin")
        elif kind == "tpu" and generation in _TPUS and shape:
            found = cls(name, "tpu", which, _TPUS[generation], "aot-tpu", "libtpu")
        else:
            raise DataError(
                f"--target {name} names no device; it is gpu:h100, or a TPU with the shape of its slice: "
                + ", ".join(f"tpu:{known}:{'2x2x1' if known == 'v5p' else '2x2'}" for known in _TPUS)
            )
        if find_spec(found.compiler) is None:
            raise DataError(f"compiling for {name} needs {found.compiler}: pip install -e '.[{found.extra}]'")
        return found

    def devices(self) -> list[Any]:
        """Returns its devices, for which programs can be compiled and on which nothing can run.

        Raises:
            DataError: if there is no slice of this shape.
        """
        jax.config.update("jax_platforms", "cpu")  # else the plugin looks for its device
        if self.platform == "tpu":
            for variable, value in _WITHOUT_A_HOST.items():
                os.environ.setdefault(variable, value)
            given = {"platform": "tpu", "topology_name": self.topology}
        else:
            given = {"platform": "cuda", "topology": self.topology, "target_config": _DESCRIPTION_OF_H100}
        try:
            return list(topologies.get_topology_desc(**given).devices)
        except (RuntimeError, ValueError) as error:
            raise DataError(f"XLA has no devices for --target {self.name} ({reason_of(error)})") from error

    @contextmanager
    def lowering(self) -> Iterator[None]:
        """Within it, JAX lowers programs for devices that are not here."""
        if self.platform != "cuda":
            yield
            return
        mesh = AbstractMesh((), (), abstract_device=AbstractDevice(self.chip.kind, None, platform="gpu"))
        from jax._src import xla_bridge

        known = xla_bridge.canonicalize_platform
        # JAX takes "gpu" for the kind of GPU that is here, and there is none (jax-ml/jax#23971).
        xla_bridge.canonicalize_platform = lambda platform: "cuda" if platform == "gpu" else known(platform)
        try:
            with jax.sharding.use_abstract_mesh(mesh):  # JAX 0.12 asks which GPU it lowers kernels for
                yield
        finally:
            xla_bridge.canonicalize_platform = known


_WITHOUT_A_HOST = {
    "TPU_SKIP_MDS_QUERY": "1",
    "TPU_WORKER_HOSTNAMES": "localhost",
    "TPU_ACCELERATOR_TYPE": "v5litepod-4",  # of any kind
}
"""What libtpu asks of the host of a TPU, and else complains about; it changes nothing that is compiled."""


def mesh_of(devices: list[Any], model: int = 1) -> Mesh:
    """Returns the mesh of devices over which a batch is split, as training has it; `model` of them share the weights."""
    return Mesh(np.array(devices).reshape(-1, model), (DATA, MODEL))
