"""The same answers from any number of threads, and none waited for that a forked process does not have."""

import multiprocessing
import threading
import time

import pytest
import torch
from problems import bumpy, motion

from bbr_layer import Adam, BBRLayer, RigidMotion, estimate_normals
from bbr_layer.neighbours import MutualNeighbours
from bbr_layer.threads import library_threads, side_by_side
from bbr_layer.trees import FOR_THREADS

# Seconds after which a forked process is taken to wait for ever; its work takes less than one.
PATIENCE = 30


@pytest.fixture
def threads():
    """Set torch's threads for a test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def _everything(cloud: torch.Tensor) -> list[torch.Tensor]:
    """Normals, neighbours and a registration of two clouds, with the gradient."""
    P = cloud.clone().requires_grad_()
    Q = motion(3, 0.1).inverse()(cloud.flip(0)) + 0.01
    found = BBRLayer("F")(P, Q).target_from_source.matrix
    pairs = MutualNeighbours(cloud, Q)(RigidMotion(*(x.expand(2, *x.shape) for x in motion(3, 0.05))))
    return [estimate_normals(cloud), *pairs, found.detach(), *torch.autograd.grad(found.square().sum(), P)]


def _clouds() -> torch.Tensor:
    return torch.stack([bumpy(FOR_THREADS + 50, 3), bumpy(FOR_THREADS + 50, 3)])


def test_answers_do_not_depend_on_the_number_of_threads(threads, monkeypatch):
    monkeypatch.setattr("bbr_layer.normals.ROWS_AT_ONCE", 100)
    cloud, answers = _clouds(), []
    for count in (1, 3):
        threads(count)
        answers.append(_everything(cloud))
    for one, other in zip(*answers, strict=True):
        assert one.any() and torch.equal(one, other)


def test_threads_do_not_share_what_the_sweeps_keep(threads):
    P = torch.stack([bumpy(150, 3) for _ in range(8)])
    P = P * torch.linspace(0.5, 2.0, 8)[:, None, None]
    Q, answers = P.flip(1) + 0.05, []
    for count in (1, 3):
        threads(count)
        given = P.clone().requires_grad_()
        found = BBRLayer("softBD", inner=Adam(20, 0.05))(given, Q).target_from_source.matrix
        answers.append((found.detach(), *torch.autograd.grad(found.square().sum(), given)))
    for one, other in zip(*answers, strict=True):
        assert one.any() and torch.equal(one, other)


def test_every_number_is_worked_on_once(threads):
    threads(3)
    done = [0] * 20

    def work(number: int) -> None:
        done[number] += 1

    side_by_side(work, 20)
    side_by_side(work, 0)
    assert done == [1] * 20


def test_what_one_thread_raises_reaches_the_caller(threads):
    threads(2)

    def work(number: int) -> None:
        if number == 3:
            raise ValueError("three")

    with pytest.raises(ValueError, match="three"):
        side_by_side(work, 5)


def test_after_a_failure_nothing_new_is_begun(threads):
    threads(2)
    done = []

    def work(number: int) -> None:
        if threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt
        time.sleep(0.01)
        done.append(number)

    with pytest.raises(KeyboardInterrupt):
        side_by_side(work, 100)
    assert len(done) < 50


def test_work_that_is_shared_out_again_does_not_wait_for_itself(threads):
    threads(3)
    done = torch.zeros(4, 5)

    def work(number: int) -> None:
        side_by_side(lambda inner: done[number].__setitem__(inner, 1), 5)

    side_by_side(work, 4)
    assert done.all()


def _in_a_fork(cloud: torch.Tensor, answer: torch.Tensor) -> None:
    answer[:] = estimate_normals(cloud.clone())  # of the cloud itself everything is known
    assert library_threads() == 1


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system cannot fork")
def test_a_forked_process_does_not_wait_for_its_parents_threads(threads):
    threads(2)
    assert library_threads() == 2
    cloud = _clouds()
    wanted, answer = estimate_normals(cloud), torch.zeros_like(cloud).share_memory_()
    child = multiprocessing.get_context("fork").Process(target=_in_a_fork, args=(cloud, answer))
    child.start()
    child.join(PATIENCE)
    code = child.exitcode
    child.kill()
    assert code == 0 and torch.equal(answer, wanted)
