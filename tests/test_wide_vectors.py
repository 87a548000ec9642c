"""The compiled sweeps use the widest vectors that the processor has."""

import pytest

llvm = pytest.importorskip("llvmlite.binding", reason="the compiled sweeps need numba and its llvmlite")
numba = pytest.importorskip("numba", reason="the compiled sweeps need numba")
from bbr_layer.kernels import cpu_dual, cpu_dual_forces, cpu_dual_planes, cpu_forces, cpu_sweeps  # noqa: E402
from bbr_layer.kernels.cpu_compiling import FAST  # noqa: E402

HAS_512 = llvm.get_host_cpu_features().get("avx512f", False)
SWEEPS = [
    cpu_sweeps.denominators,
    cpu_sweeps.buddy_sums,
    cpu_forces.point_forces,
    cpu_forces.plane_forces,
    cpu_dual.denominator_rates,
    cpu_dual.buddy_sum_rates,
    cpu_dual_forces.point_force_rates,
    cpu_dual_planes.plane_force_rates,
]


@pytest.mark.skipif(not HAS_512, reason="this processor has no vectors of 512 bits")
@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.__name__)
def test_sweeps_are_compiled_for_vectors_of_512_bits(sweep):
    """Compiled anew, as Numba shows no assembly of what it has from its cache; zmm are the registers of 512 bits."""
    tables, sums = (numba.types.UniTuple(number[:, ::1], 2) for number in (numba.float32, numba.float64))
    normals = tables if "plane" in sweep.__name__ else numba.none
    anew = numba.njit(fastmath=FAST, error_model="numpy")(sweep.py_func)
    anew.compile((tables, normals, sums, numba.float32[::1], numba.none))
    (assembly,) = anew.inspect_asm().values()
    assert "zmm" in assembly
