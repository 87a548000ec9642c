"""What people are told while functions are compiled, and what happens where nothing can be kept."""

import logging

import pytest

numba = pytest.importorskip("numba", reason="Numba is not installed")
from numba.core import caching, event  # noqa: E402

from bbr_layer.kernels.cpu_compiling import Told, cacheable  # noqa: E402


def compile_one(module):
    def function(x):
        return x + 1

    function.__module__ = module
    assert numba.njit(function)(1) == 2


def told_of(modules, caplog):
    """How often ours is said to be compiled, while functions of these modules are."""
    listener = Told()
    event.register("numba:compile", listener)
    with caplog.at_level(logging.WARNING, logger="bbr_layer"):
        for module in modules:
            compile_one(module)
    event.unregister("numba:compile", listener)
    return sum("compiled for this processor" in record.message for record in caplog.records)


def test_people_are_told_that_functions_are_being_compiled(caplog):
    # The library's own listener hears it too, and has perhaps spoken before.
    assert told_of(["bbr_layer.kernels.a", "bbr_layer.kernels.b"], caplog) in (1, 2)


def test_nothing_is_said_of_other_peoples_functions(caplog):
    assert told_of(["elsewhere"], caplog) == 0


def test_what_is_compiled_is_kept():
    assert cacheable()


def test_without_a_folder_that_can_be_written_to_people_are_warned_and_it_goes_on(monkeypatch):
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    with pytest.warns(UserWarning, match="set NUMBA_CACHE_DIR to a folder that can"):
        assert not cacheable()
