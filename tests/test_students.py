"""data/students.py: what argues about students; and their learning curves' pictures."""
import importlib.util
import json
from types import SimpleNamespace

import numpy as np
import pytest

import experiments
import fac_tdmpc_ref as fac
import students
import test_cli
from test_cli import ONE_THREAD, ROOT, launch, succeeded
from test_planning import random_model

files = test_cli.files


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
    assert [*found] == ["expert", "student", "policy", "reflex", "same_search"]
    model, same = found["same_search"]
    assert model is expert[0]  # its own horizon and discount; a student has no proposals
    assert same == fac.dataclasses.replace(around, horizon=2, discount=0.5, pi_trajs=0)
    alone = fac.dataclasses.replace(around, iterations=0)
    assert [*students.compared(expert, (None, alone))] == ["expert", "student", "policy"]
    assert [*students.compared(expert, (None, own))] == ["expert", "student", "policy"]


@pytest.fixture(scope="module")
def curve(tmp_path_factory, files):
    """A folder of distill's."""
    out = tmp_path_factory.mktemp("curve") / "out"
    arguments = test_cli.distill_arguments(files, "--out", out, "--workers", "0")
    assert fac.main([str(a) for a in arguments]) == 0
    return out


@pytest.mark.skipif(not importlib.util.find_spec("matplotlib"), reason="no matplotlib")
@pytest.mark.parametrize("broken", [False, True])
def test_a_curve_is_drawn(tmp_path, curve, broken):
    """A notebook's backend and a user's LaTeX are theirs; what else goes wrong is said."""
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\n")
    (tmp_path / "at" / "matplotlib").mkdir(parents=True)
    (tmp_path / "at" / "matplotlib" / "__init__.py").write_text("raise ImportError('no\\nhome')")
    env = {"MPLBACKEND": "module://nobody_has.this", "MATPLOTLIBRC": str(tmp_path / "matplotlibrc"),
           "PATH": "/nowhere", **({"PYTHONPATH": str(tmp_path / "at")} if broken else {})}
    out = tmp_path / "curve.png"
    done = launch([ROOT / "data" / "experiments.py", "curve", curve, "--out", out, "--json"],
                  tmp_path, {**ONE_THREAD, **env})
    assert done.returncode == (2 if broken else 0), done.stderr
    assert out.exists() != broken
    if broken:
        assert "this needs matplotlib: pip install" in done.stderr.splitlines()[-1] + done.stderr
    else:
        assert json.loads(succeeded(done).stdout.splitlines()[-1]) == {
            "out": str(out), "picture": True}


@pytest.mark.skipif(not importlib.util.find_spec("matplotlib"), reason="no matplotlib")
def test_a_picture_that_cannot_be_made_is_said(tmp_path, curve, capsys, monkeypatch):
    def fail(*_):
        raise OSError("no\nhome")

    monkeypatch.setattr(experiments.plots, "save_figure", fail)
    assert experiments.main(["curve", str(curve), "--out", str(tmp_path / "curve.png")]) == 0
    assert "curve.png: no picture: no home\n" in capsys.readouterr().err
    assert not (tmp_path / "curve.png").exists()


def test_what_is_no_curve_is_named(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    (tmp_path / "curve.csv").write_text("steps,return\n1,2\n")
    assert experiments.main(["curve", str(tmp_path)]) == 2
    assert "curve.csv: not a curve of distill's" in capsys.readouterr().err
