"""data/students.py: what argues about students."""
from types import SimpleNamespace

import numpy as np
import pytest

import fac_tdmpc_ref as fac
import students
from toys import random_model


@pytest.mark.parametrize("cores, seconds, workers, best", [
    (1, [4, 2], 0, 2000), (2, [4, 2, 1], 1, 1000), (2, [4, 2, 3], 0, 2000)])
def test_distill_times_workers_only_where_there_are_cores(cores, seconds, workers, best,
                                                          monkeypatch):
    def timed(calls, rounds, label):
        assert len(calls) == len(seconds)
        assert all(call().shape == (3,) for call in calls)
        return np.array([seconds, seconds, [9] * len(seconds)])  # the last: a busy machine

    monkeypatch.setattr(fac, "cores", lambda: cores)
    monkeypatch.setattr(fac, "interleaved_seconds", timed)
    planning = fac.PlannerConfig(8, 1)
    found = students.time_both((random_model(1), planning), (random_model(), planning), np.zeros(8))
    assert (found["plan_workers"], found["plan_ms_student"]) == (workers, best)
    assert (found["plan_ms_student_in_process"], found["speedup"]) == (2000, 4000 / best)


def test_a_pool_s_process_times_itself_alone(monkeypatch):
    """It can't start workers, which distill --workers 0 doesn't need for anything else."""
    monkeypatch.setattr(fac, "cores", lambda: 2)
    monkeypatch.setattr(fac.multiprocessing, "current_process",
                        lambda: SimpleNamespace(daemon=True))
    planning = fac.PlannerConfig(8, 1)
    found = students.time_both((random_model(1), planning), (random_model(), planning), np.zeros(8))
    assert found["plan_workers"] == 0
    assert found["plan_ms_student"] == found["plan_ms_student_in_process"] > 0


def test_students_are_compared_with_the_expert_in_their_search():
    own = fac.PlannerConfig(horizon=2, discount=0.5)
    expert = random_model(1, policy=True), own
    around = fac.PlannerConfig(**fac.STUDENT_PLANNING, elites=5, horizon=1)
    found = students.compared(expert, (None, around))
    assert [*found] == ["expert", "policy", "reflex", "student", "same_search"]
    model, same = found["same_search"]
    assert model is expert[0]  # its own horizon and discount; a student has no proposals
    assert same == fac.dataclasses.replace(around, horizon=2, discount=0.5, pi_trajs=0)
    alone = fac.dataclasses.replace(around, iterations=0)
    assert [*students.compared(expert, (None, alone))] == ["expert", "policy", "student"]
    assert [*students.compared(expert, (None, own))] == ["expert", "policy", "student"]
