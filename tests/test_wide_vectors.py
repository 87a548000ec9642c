"""The compiled sweeps use the widest vectors that the processor has."""

import llvmlite.binding as llvm
import numpy as np
import pytest

numba = pytest.importorskip("numba", reason="the compiled sweeps need numba")
from bbr_layer.kernels import cpu_dual, cpu_dual_forces, cpu_dual_planes, cpu_forces, cpu_sweeps  # noqa: E402
from bbr_layer.kernels.cpu_math import wide_vectors  # noqa: E402

HAS_512 = llvm.get_host_cpu_features().get("avx512f", False)


@numba.njit(fastmath=True)
def _roots(x):
    wide_vectors()
    for i in range(x.size):
        x[i] = np.sqrt(x[i])


@pytest.mark.skipif(not HAS_512, reason="this processor has no vectors of 512 bits")
def test_a_loop_is_compiled_for_vectors_of_512_bits():
    values = np.arange(100, dtype=np.float32)
    _roots(values)
    assert values[81] == 9
    (assembly,) = _roots.inspect_asm().values()
    assert "zmm" in assembly


def test_every_sweep_asks_for_them():
    sweeps = [
        cpu_sweeps.denominators,
        cpu_sweeps.buddy_sums,
        cpu_dual.denominator_rates,
        cpu_dual.buddy_sum_rates,
        cpu_dual_forces.point_force_rates,
        cpu_dual_planes.plane_force_rates,
        cpu_forces.point_forces,
        cpu_forces.plane_forces,
    ]
    for sweep in sweeps:
        assert "wide_vectors" in sweep.py_func.__code__.co_names, sweep
