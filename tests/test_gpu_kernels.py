"""The sweeps in Triton against those in torch: in Triton's interpreter everywhere, on a GPU where there is one."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from gpu_problems import INTERPRETED, PRECISIONS, PROBLEMS, cast, error, scene_of

PROJECT = Path(__file__).resolve().parent.parent
# Errors relative to the largest number of a field. In float32, u = -D / alpha carries an error of 6e-8 |u|, the
# exponential as much relative to itself, and derivatives of a mean are differences of such numbers.
WITHIN = {"float64": 1e-10, "float32": 1e-4}

pytestmark = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")


@pytest.fixture(scope="module")
def interpreted() -> dict[str, Any]:
    """The errors in the interpreter; Triton has to know before it is imported, so another process computes them."""
    paths = os.pathsep.join([str(PROJECT), str(PROJECT / "tests")])
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(PROJECT / "tests" / "gpu_problems.py")]
    run = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.mark.parametrize(("name", "precision"), INTERPRETED)
def test_the_sweeps_agree_with_torch(name, precision, interpreted):
    (found,) = [found for *which, found in interpreted["errors"] if which == [name, precision]]
    assert found < WITHIN[precision]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_sweeps_agree_with_torch_on_a_gpu(name, precision):
    assert error(name, precision, "cuda") < WITHIN[precision]


@pytest.mark.slow
@pytest.mark.parametrize("kind", range(4))
def test_the_sweeps_compile_for_a_gpu_that_is_not_there(kind, tmp_path, monkeypatch):
    from triton import compile
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from bbr_layer.kernels.gpu_forces import forces
    from bbr_layer.kernels.gpu_sweeps import buddy_sums, denominators

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    pointers = {"own": "*fp32", "other": "*fp32", "numbers": "*fp64", "out": "*fp64", "KIND": "constexpr"}
    for sweep in (denominators, buddy_sums, forces):
        source = ASTSource(sweep, signature=pointers, constexprs={"KIND": kind})
        # sm_90 is an H100; the options are those of kernels.gpu_clouds.
        built = compile(source, target=GPUTarget("cuda", 90, 32), options={"num_warps": 4, "enable_fp_fusion": True})
        assert built.asm["cubin"]


@pytest.mark.parametrize(
    ("change", "lacking"),
    [
        ({}, ""),
        ({"planes": True}, ""),
        ({"match": "both"}, "matching by features on a GPU"),
        ({"clip": 3.0}, "clipped distances on a GPU"),
        ({"outlier": 0.0}, "an epsilon of 0, below 1e-19"),
        ({"outlier": 1e-30}, "an epsilon of 1e-30, below 1e-19"),  # a float32 exponential cannot be compared with it
    ],
)
def test_what_cannot_be_done_is_left_to_torch(change, lacking):
    from bbr_layer.kernels.gpu import lacks

    scene, _ = scene_of(PROBLEMS["softBD"])
    terms = PROBLEMS["softBD"].terms._replace(**change)
    assert lacks(terms, cast(scene, torch.float32, "cpu")) == lacking


def test_importing_the_layer_leaves_triton_alone(interpreted):
    assert interpreted["unasked"] is False
