"""data/experiments.py: the paper's tables as users run them, small."""
import contextlib
import csv
import dataclasses
import functools
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import baselines
import experiments
import fac_tdmpc_ref as fac
import look
import plots
import runs
import speed
import students
import tables
import toys
import train_expert
from toys import (BLOCKED, CONFIG, ONE_THREAD, ROOT, SET, SWEEP, assert_close, last_json, launch,
                  numeric_gradient, random_model, write_expert)

refused = functools.partial(toys.refused, program="experiments.py")


def run(*arguments, cwd, env=ONE_THREAD):
    """In a process of its own; `here` is for what isn't about processes."""
    return launch([ROOT / "data" / "experiments.py", *arguments], cwd, env)


here = functools.partial(toys.here, experiments.main)


@pytest.mark.parametrize("flags, parts", [
    ([], ["EXPERIMENT"]),
    (["table3", "--robots", "reecher"], ["'reecher'", *speed.ROBOTS]),
    (["table3", "--runs", "9"], ["runs", "at least 10"]),
    (["table3", "--workers", "-1"], ["--workers", "-1"]),
    (["table3", "--elites", "600"], ["samples (512)", "not 600"]),
    (["figure12", "--decisions", "1000"], ["--decisions", "multiple of 2000", "not 1000"]),
    (["figure12", "--tasks", "gym:Pendulum-v1"], ["--tasks", "dm_control's"])])
def test_bad_commands_are_refused(tmp_path, flags, parts):
    refused(here(*flags, cwd=tmp_path), *parts)


@pytest.mark.parametrize("flags", [
    ["table3", "--figure", "file/x.png"],
    ["watch", "--model", "none.npz", "--out", "file/x.gif"]])
def test_pictures_that_cannot_be_written_are_missed_before_the_work(tmp_path, flags):
    pytest.importorskip("matplotlib")
    (tmp_path / "file").touch()  # no folder
    refused(here(*flags, cwd=tmp_path), f"{flags[-1]}: can't be written")


@pytest.mark.parametrize("command", [["table3", "--figure", "x.png"], ["figure6"]])
def test_table3_refuses_a_picture_it_cannot_draw(tmp_path, command):
    (tmp_path / "matplotlib.py").write_text(BLOCKED)
    refused(run(*command, cwd=tmp_path,
                env={"PYTHONPATH": str(tmp_path), **ONE_THREAD}), "matplotlib")


def test_table3_measures_every_mode(tmp_path, monkeypatch):
    monkeypatch.setattr(speed, "TABLE3_BATCH", 16)
    flags = ["--robots", "reacher", "hopper", "--runs", "10", "--samples", "16", "--iterations",
             "1", "--json"]
    if importlib.util.find_spec("matplotlib"):
        flags += ["--figure", "figure6.png"]
    done = here("table3", *flags, cwd=tmp_path)
    found = last_json(done)
    assert set(found) == {"prediction", "decision", "speedup", "handover_us", "cores"}
    assert found["cores"] == fac.cores()
    assert found["cores"] == 1 or found["handover_us"] > 0  # one core: no worker by default
    modes, functions = ("one-thread", "processes", "critical-path"), ("f_T", "f_R", "f_Q")
    rows = {(r["robot"], r["model"], r["function"], r["mode"]): r for r in found["prediction"]}
    assert set(rows) == {(robot, *subject) for robot in ("reacher", "hopper") for subject in (
        *((m, f, "one-thread") for m in ("TD-MPC", "10% TD-MPC", "TAP") for f in functions),
        *(("Fac-TDMPC", f, mode) for f in functions for mode in modes))}
    assert all(r["ms_mean"] > 0 and r["ms_std"] >= 0 for r in rows.values())
    decisions = {(r["robot"], r["model"], r["preset"], r["mode"], r["samples"], r["iterations"]): r
                 for r in found["decision"]}
    assert len(decisions) == len(found["decision"]) == 2 * 2 * 4 * 3
    for r in decisions.values():
        assert np.isclose(r["ratio_to_floor"], r["ms_median"] / r["floor_ms"])
    speedup = {(r["robot"], r["function"], r["mode"]): r for r in found["speedup"]}
    assert set(speedup) == {(robot, f, mode) for robot in ("reacher", "hopper")
                            for f in (*functions, "decision") for mode in modes}
    assert round(speedup["reacher", "f_T", "critical-path"]["paper"], 1) == 4.7
    assert round(speedup["hopper", "f_T", "processes"]["paper"], 1) == 7.1
    row = speedup["hopper", "decision", "one-thread"]
    times = [decisions["hopper", m, "section51", "one-thread", 16, 1]["ms_median"]
             for m in ("TD-MPC", "Fac-TDMPC")]
    assert row["paper"] is None and np.isclose(row["value"], times[0] / times[1])
    for part in ("hopper", "critical-path", "paper's x", "section 5.1's sizes", "16 x 1",
                 "hand-over"):
        assert part in done.stdout
    assert os.listdir(tmp_path) == ["figure6.png"] * ("--figure" in flags)
    if "--figure" in flags:
        assert (tmp_path / "figure6.png").read_bytes()[:4] == b"\x89PNG"


def test_table3_without_workers_and_with_a_budget_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(speed, "TABLE3_BATCH", 16)
    (path := tmp_path / "x.csv").write_text("processor,cores,blas,what,ms\nother,1,x,y,5.00\n")
    for _ in range(2):  # the second's in place of the first's
        found = last_json(here("table3", "--robots", "reacher", "reacher", "--runs", "10",
                               "--samples", "128", "--iterations", "2", "--workers", "0",
                               "--record", "x.csv", "--json", cwd=tmp_path))
    assert found["handover_us"] is None
    assert len(found["prediction"]) == 18 and len(found["decision"]) == 2 * 4
    head, other, *rows = csv.reader(path.read_text().splitlines())
    assert (head[3:], other) == (["what", "ms"], ["other", "1", "x", "y", "5.00"])
    assert [row[3:] for row in rows] == [
        ["{robot}, {model}, {preset}, 128 x 2, {mode}".format_map(of), f"{of['ms_median']:.2f}"]
        for of in found["decision"]]
    assert {tuple(row[:3]) for row in rows} == {speed.machine()}


def test_multiply_adds_count_the_weights_of_equation_2():
    model = random_model(3)
    sizes = {name: sum(v.size for k, v in model.params.items() if k.startswith(name)
                       and k.endswith("weight") and v.shape[2] > 1)
             for name in ("_dynamics", "_reward", "_Q")}
    config = fac.PlannerConfig(samples=7, iterations=2, horizon=3)
    assert speed.multiply_adds(model.config, config) == 7 * 2 * (
        3 * (sizes["_dynamics"] + sizes["_reward"]) + sizes["_Q"])


def test_help_teaches():
    """Of the program and of each command, which names every default."""
    parser = experiments.make_parser()
    (commands,) = (a.choices for a in parser._actions if isinstance(a.choices, dict))
    assert set(commands) == {"table3", "figure4", "figure5", "figure6", "figure7", "figure8",
                             "figure9", "figure12", "figure13", "departures", "sweep", "students",
                             "capacity", "experts", "printed", "authors", "agreement", "watch",
                             "report"}
    assert commands.pop("figure6") is commands["table3"]
    assert all(name in parser.format_help() for name in commands)
    for name, command in commands.items():
        assert f"experiments.py {name}" in command.format_help()
        without = {action.dest for action in command._actions
                   if not (action.required or action.nargs == 0 or "[" in action.help)}
        assert without <= {"beside", "figure", "workers"}


# runs ---------------------------------------------------------------------------------


def rows_of(path):
    """{settings: rows} of a CSV's finished runs, without what the clock says."""
    return {key[3]: [{k: v for k, v in row.items() if k != "minutes"} for row in rows]
            for key, rows in experiments.finished(experiments.read_rows(path)).items()}


def test_a_killed_sweep_goes_on_and_makes_no_run_twice(tmp_path):
    flags = [*SWEEP, *SET, "lr=1e-3,2e-3,3e-3,4e-3", "--jobs", "2"]
    process = subprocess.Popen([sys.executable, ROOT / "data" / "experiments.py", *flags],
                               cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    path, begun = tmp_path / "sweep.csv", time.time()
    while not rows_of(path) and time.time() - begun < 100:
        time.sleep(0.05)
    refused(here(*flags, cwd=tmp_path), "sweep.csv: another run is writing", "--out")
    process.kill()  # which leaves no lock
    process.wait()
    before = rows_of(path)
    assert 1 <= len(before) < 4
    with open(path, "a") as file:
        file.write('cheetah-run,0,sweep,"{""batch')  # a line that a kill cut off
    result = last_json(run(*flags, "--json", cwd=tmp_path))
    assert result == {"out": "sweep.csv", "runs": 4, "now": 4 - len(before), "failed": 0}
    after = rows_of(path)
    assert len(after) == 4 and all(len(rows) == 1 for rows in after.values())
    assert {k: after[k] for k in before} == before
    result = last_json(here(*flags, "--json", cwd=tmp_path))
    assert result["now"] == 0 and rows_of(path) == after


def test_a_failed_run_is_a_row_and_is_tried_again(tmp_path):
    flags = [*SWEEP, *SET, "noise-samples=3,1000000000"]
    for _ in range(2):
        done = run(*flags, "--json", cwd=tmp_path)
        assert done.returncode == 1 and "allocate" in done.stderr
        assert json.loads(done.stdout.splitlines()[-1])["failed"] == 1
    rows = experiments.read_rows(tmp_path / "sweep.csv")
    assert ["allocate" in row["error"] for row in rows].count(True) == 2
    assert len(rows) == 3 and len(rows_of(tmp_path / "sweep.csv")) == 1


def seven_but_one_dies(task, seed, case, settings):
    """A run whose second seed ends its process."""
    if seed == 1:
        os.kill(os.getpid(), 9)
    print("a table")
    yield {"return_mean": 7.0}


SEVENS = [runs.make_run("cheetah-run", seed, "x") for seed in range(4)]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_run_whose_process_dies_is_a_row_and_stops_nothing(jobs, capfd):
    found = list(runs.in_processes(seven_but_one_dies, SEVENS, jobs))
    rows = {row["seed"]: row for (row,) in found}
    assert len(found) == len(rows) == 4 and "terminated abruptly" in rows["1"]["error"]
    assert all(rows[seed]["return_mean"] == 7 and rows[seed]["minutes"] >= 0 for seed in "023")
    assert capfd.readouterr().out == ""  # the last line is the command's own


def with_a_worker(task, seed, case, settings):
    expert, _ = fac.load_model(fac.data_file(task, "expert.npz"))
    sizes = fac.student_config(expert.config, 2, "latent")
    student = fac.new_student(expert, sizes, 0)[1]
    with fac.Planner(student, fac.PlannerConfig(samples=4, iterations=1), workers=1) as planner:
        yield {"return_mean": float(np.abs(planner.act(np.zeros(17))).max())}


def test_a_run_may_have_workers_of_its_own():
    ((row,),) = runs.in_processes(with_a_worker, SEVENS[:1], 1)
    assert 0 < row["return_mean"] <= 1


def test_a_run_without_a_finite_return_has_failed():
    run = experiments.make_run("cheetah-run", 0, "x")
    (row,) = runs.attempt(lambda *_: [{"return_mean": float("nan")}], run)
    assert "not finite" in row["error"] and "minutes" not in row


def test_a_run_that_does_not_fit_its_figure_is_refused_before_the_work(tmp_path):
    write_rows(tmp_path / "4.csv", [("walker-run", 0, "TAP", {"steps": 3}, [{"minutes": 1.0}])])
    before = (tmp_path / "4.csv").read_bytes()
    refused(here("figure4", "--tasks", "walker-run", "--out", "4.csv", cwd=tmp_path), "4.csv: TAP",
            "'steps': 3", "'steps': 7000", "--out")
    assert (tmp_path / "4.csv").read_bytes() == before


@pytest.mark.parametrize("column, value", [
    ("return_mean", "nan"), ("step", "x"), ("settings", "[]"), ("settings", "{"),
    ("evaluation_seed", "x"), ("returns", 5.0), ("ranks", "[0.5"), ("ranks", "[1]")])
def test_a_damaged_row_is_shown(tmp_path, column, value):
    row = {**experiments.make_run("walker-run", 0, "TAP"), "step": 1, "return_mean": 2.0,
           "minutes": 1.0}
    experiments.append_rows(tmp_path / "figure4.csv", [row])
    assert len(experiments.read_rows(tmp_path / "figure4.csv")) == 1
    experiments.append_rows(tmp_path / "figure4.csv", [{**row, column: value}])
    with pytest.raises(fac.UserError, match=r"figure4.csv: .*TAP.*delete the line"):
        experiments.read_rows(tmp_path / "figure4.csv")


def test_a_csv_is_one_command_s_until_it_ends(tmp_path):
    path = tmp_path / "new" / "7.csv"
    with experiments.lock(path):
        with pytest.raises(fac.UserError, match="7.csv: another run is writing"):
            with experiments.lock(path):
                pass
        with pytest.raises(fac.UserError, match="another run"):  # which adds milliseconds
            experiments.time_all(None, {"out": str(path)}, [], None)
        experiments.append_rows(path, [{**experiments.make_run("x", 0, "y"), "minutes": 1.0}])
        assert len(experiments.read_rows(path)) == 1
    with experiments.lock(path):
        assert len(experiments.read_rows(path)) == 1


def test_workers_end_with_the_process_that_waits_for_them(tmp_path):
    flags = [*SWEEP[:-1], "orphan.csv", *SET, "lr=1e-3,2e-3", "--jobs", "2",
             "--steps", "100000"]
    process = subprocess.Popen([sys.executable, ROOT / "data" / "experiments.py", *flags],
                               cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def workers():
        """Processes in this folder that have a worker's command line and are at a run."""
        found = []
        for path in Path("/proc").glob("[0-9]*/cwd"):
            with contextlib.suppress(OSError):
                if path.resolve() == tmp_path.resolve() and b"spawn_main" in (
                        path.parent / "cmdline").read_bytes():
                    found.append(path.parent)
        return found

    if not Path("/proc/self/cmdline").exists():
        process.kill()
        pytest.skip("needs /proc")
    begun = time.time()
    while len(workers()) < 2 and time.time() - begun < 60:
        time.sleep(0.1)
    time.sleep(5)  # until both are at their runs
    assert len(workers()) >= 2
    process.kill()
    process.wait()
    begun = time.time()
    while workers() and time.time() - begun < 20:
        time.sleep(0.1)
    assert not workers()


def test_dask_gives_the_rows_that_processes_give(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    flags = [*SWEEP, *SET, "num-agents=3,6"]
    last_json(run(*flags, "--json", cwd=tmp_path))
    here = rows_of(tmp_path / "sweep.csv")
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "data"))
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1,
                                  dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        last_json(run(*flags, "--out", "dask.csv", "--scheduler", address, "--json",
                      cwd=tmp_path))
        cluster.scheduler.allowed_failures = 0
        ((row,),) = runs.on_cluster(seven_but_one_dies, SEVENS[1:2], runs.connect(address))
    assert row["seed"] == "1" and row["error"].startswith("KilledWorker")
    assert rows_of(tmp_path / "dask.csv") == here and len(here) == 2


@pytest.mark.parametrize("flags, parts", [
    (["sweep"], ["--set"]),
    (["sweep", "--set", "depth=3"], ["depth=3", "noise_samples"]),
    (["sweep", "--set", "lr=fast"], ["lr=fast", "float"]),
    (["sweep", "--set", "lr=1e-3", "lr=1e-4"], ["lr", "twice"]),
    (["sweep", "--set", "lr=1e-3", "--set", "lr=1e-4"], ["lr", "twice"]),
    (["figure6", "--out", "x.csv"], ["unrecognized", "--out"]),
    (["sweep", "--set", "kl=sideways"], ["kl", "sideways"]),
    (["sweep", "--set", "num-agents=3,7"], ["num_agents", "[1, 3]", "not 7"]),
    (["sweep", "--set", "lr=1e-3", "--scheduler"], ["--scheduler"]),
    (["sweep", "--set", "lr=1e-3", "--scheduler", "nowhere"], ["nowhere"]),
    (["sweep", "--set", "lr=1e-3", "--scheduler", "tls://host:1"], ["tls"]),
    (["figure4", "--tasks", "reecher-hard"], ["reecher-hard", "reacher-hard"]),
    (["figure5", "--jobs", "0"], ["--jobs"]),
    (["figure7", "--tasks", "walker-run", "--seeds", "7"], ["walker-run-7", "distill"]),
    (["report", "--results", "."], ["no runs"])])
def test_bad_runs_are_refused(tmp_path, flags, parts):
    pytest.importorskip("matplotlib")
    if flags[-1] in ("nowhere", "tls://host:1"):
        pytest.importorskip("distributed")
    before = sorted(experiments.RESULTS.iterdir())
    refused(here(*flags, cwd=tmp_path), *parts)
    assert sorted(experiments.RESULTS.iterdir()) == before  # the default --out


@pytest.mark.parametrize("figure", ["figure7", "figure8", "figure12"])
def test_report_names_the_file_that_holds_another_figure_s_runs(tmp_path, figure):
    pytest.importorskip("matplotlib")
    rows = [{**experiments.make_run("reacher-hard", 0, case, episodes=1), "step": 5,
             "return_mean": 1.0, "minutes": 1.0, "versions": experiments.versions()}
            for case in ("a", "b", "c")]
    experiments.append_rows(tmp_path / f"{figure}.csv", rows)
    refused(here("report", "--results", ".", "--figures", ".", cwd=tmp_path),
            f"{figure}.csv: not {figure}'s rows")


def test_report_names_the_file_whose_rows_lack_a_return(tmp_path):
    pytest.importorskip("matplotlib")
    rows = [{**experiments.make_run("reacher-hard", 0, "expert"), "minutes": 1.0}]
    experiments.append_rows(tmp_path / "figure8.csv", rows)
    refused(here("report", "--results", ".", "--figures", ".", cwd=tmp_path),
            "figure8.csv: not figure8's rows")


@pytest.mark.parametrize("found", [b"a,b\n1,2\n", b'{"not": "rows"}', b"\xff\xfe\n"])
def test_rows_of_another_kind_are_refused(tmp_path, found):
    (tmp_path / "x.csv").write_bytes(found)
    with pytest.raises(fac.UserError, match="expected the columns task,seed"):
        experiments.read_rows(tmp_path / "x.csv")


def untaught_priors(monkeypatch):
    """Priors as they begin."""
    monkeypatch.setattr(fac, "teach_priors", lambda distiller, *_: {
        "policy": fac.prior_weights(distiller.student)})


def short_episodes(monkeypatch):
    """Of 20 decisions; the expert's two are of ones; priors as they begin, ranks of 8 states."""
    untaught_priors(monkeypatch)
    ranks = fac.Distiller.ranks
    monkeypatch.setattr(fac.Distiller, "ranks", lambda self, *_: ranks(self, 8))
    monkeypatch.setattr(baselines.TapDistiller, "__init__", functools.partialmethod(
        baselines.TapDistiller.__init__, vae_steps=30))
    monkeypatch.setattr(fac, "CONTROL_STEPS", 40)
    monkeypatch.setattr(fac, "expert_episodes", lambda *_: (np.ones((2, 20, 8)),
                                                            np.ones((2, 20, 3))))


def test_every_method_of_figure_4_learns_and_plans(monkeypatch):
    """A row for each evaluation seed; 10% TD-MPC has few weights; TAP plans latent actions, which
    no prior knows."""
    weights = {}
    short_episodes(monkeypatch)
    for case, settings in experiments.FIGURE4.items():
        kind = baselines.distiller_of(case)
        expert, _ = fac.load_model(fac.data_file("cheetah-run", "expert.npz"))
        replay = fac.Replay(fac.data_file("cheetah-run", "replay.npz"))
        config = fac.DistillConfig(steps=2, batch_size=2, expert_episodes=0)
        distiller = kind(expert, replay, config, settings.get("num_agents"), 0)
        assert len(list(distiller.run())) == 2
        distiller.close()
        weights[case] = sum(v.size for k, v in distiller.student.params.items()
                            if k.startswith(("_dynamics", "_reward", "_Q")))
        rows = list(experiments.distil("cheetah-run", 0, case, {
            **settings, "steps": 4, "episodes": 1, "samples": 4, "iterations": 1,
            "expert_episodes": 0, "batch_size": 2}))
        assert [row["evaluation_seed"] for row in rows] == [101, 102]
        assert all(row["step"] == 4 and row["return_mean"] >= 0 for row in rows)
        assert all(len(row["policy_returns"]) == 1 for row in rows)
        assert all((case == "TAP") == ("ranks" not in row) for row in rows)
    assert 0.02 < weights["10% TD-MPC"] / weights["N = 1"] < 0.04


def test_a_run_is_distilled_as_it_says(monkeypatch):
    seen, made = [], []

    def play(model, task, planning, seeds, *_):
        seen.append((model.config.num_agents, planning.horizon, planning.samples * (
            planning.iterations > 0), seeds))
        return [np.zeros((len(seeds), fac.EPISODE_STEPS, *shape)) for shape in ((17,), (6,), ())]

    untaught_priors(monkeypatch)
    monkeypatch.setattr(fac, "play", play)
    monkeypatch.setattr(fac.Distiller, "ranks", lambda *_: (np.arange(3), np.arange(4, 7)))
    monkeypatch.setattr(experiments, "distiller_of", lambda case: lambda *args: (
        made.append(args[3:]), fac.Distiller(*args))[1])
    rows = list(experiments.distil("cheetah-run", 5, "x", {
        "num_agents": 3, "steps": 4, "batch_size": 2, "horizon": 2, "expert_episodes": 3,
        "samples": 7, "iterations": 1}))
    (*_, played), *evaluated = seen
    assert made == [(3, 5)] and played == fac.training_seeds(5, "expert episode", 0, 3)
    assert sorted(evaluated) == [
        (agents, horizon, samples, fac.episode_seeds(seed, 10)) for agents, horizon, samples in
        ((1, 3, 0), (3, 2, 0), (3, 2, 7)) for seed in (101, 102)]  # policy, priors, search
    assert [(row["rank_q"], row["rank_return"]) for row in rows] == [(0, 6)] * 2


@pytest.mark.parametrize("case, settings, prior", [
    ("default", {}, "own"), ("D3", {"encoder_input": "observation"}, "own"),
    ("D8", {"policy_share": 0.0}, "own"), ("D9", {"targets": "joint", "priors": False}, "last")])
def test_a_departure_s_student_searches_around_its_priors_but_for_d9(monkeypatch, case, settings,
                                                                    prior):
    planned = []
    monkeypatch.setattr(experiments, "measure", lambda model, task, planning, *_: (
        planned.append((model.config.num_agents, planning.prior, planning.iterations)),
        fac.Planner(model, planning).close(), {"returns": [0.0]})[2])
    monkeypatch.setattr(fac.Distiller, "ranks", lambda *_: (np.arange(3), np.arange(3)))
    list(experiments.distil("cheetah-run", 0, case, {
        **settings, "steps": 1, "batch_size": 2, "expert_episodes": 0}))
    reflex = [(6, "own", 0)] * (prior == "own")
    assert planned == [(6, prior, 1 if prior == "own" else 4), (1, "own", 0), *reflex] * 2


def test_every_method_of_figure_4_learns_from_its_run_s_seed(replay, monkeypatch):
    monkeypatch.setattr(baselines.ActionVAE, "fit", lambda *_: None)
    for case, settings in experiments.FIGURE4.items():
        weights = []
        for seed in (3, 3, 4):
            distiller = baselines.distiller_of(case)(
                random_model(1, hidden=512, policy=True), replay, CONFIG,
                settings.get("num_agents"), seed)
            distiller.close()
            weights.append(distiller.optimizer.vector)
            assert distiller.seed == seed
        assert np.array_equal(weights[0], weights[1]), case
        assert not np.array_equal(weights[0], weights[2]), case
        hidden = {"default": 170, "10% TD-MPC": 66}.get(case, 512)  # 512 // 3; B.2's; Table 2's
        assert distiller.student.config.mlp_dim == hidden, case


def test_a_row_holds_the_mean_and_the_least_of_its_returns(monkeypatch):
    rewards, seen = np.array([[1.0, 2.0], [0.0, 9.0], [5.0, 1.0], [0.0, 0.5]]), []
    monkeypatch.setattr(fac, "play", lambda *args: (seen.append(args[3]), (0, 0, rewards, 0))[1])
    found = experiments.measure(None, "x", None, 4, 101)
    assert (found["return_mean"], found["return_min"]) == (4.625, 0.5)  # of 3, 9, 6 and 0.5
    assert found["returns"] == [3, 9, 6, 0.5] and seen == [fac.episode_seeds(101, 4)]


def loss_inputs(dtype=np.float64):
    """A small student, features, actions, targets and the expert's latents."""
    rng = np.random.default_rng(0)
    sizes = dataclasses.replace(fac.ModelConfig(5, 2, 2, 3, 6, 7), expert_latent_dim=4,
                                expert_enc_dim=6)
    student = fac.WorldModel.create(sizes, rng, dtype=dtype)
    for value in student.params.values():
        value += 0.1 * rng.standard_normal(value.shape)
    targets = [rng.standard_normal((3, 4, 3)) for _ in range(3)]
    return (student, rng.standard_normal((1, 4, 4)), rng.uniform(-1, 1, (3, 2, 4, 3)),
            [*targets, rng.standard_normal((4, 3, 4, 3))])


@pytest.mark.parametrize("kind", [
    baselines.MSEDistiller, baselines.ConsistentDistiller, baselines.LightlyConsistentDistiller])
def test_gradients_of_the_other_losses(kind, monkeypatch):
    student, features, actions, targets = loss_inputs()
    config = fac.DistillConfig(horizon=2, lam=0.7)
    targets = targets[:3] if kind is baselines.MSEDistiller else targets
    grads = {k: np.zeros_like(v) for k, v in student.params.items() if k[:7] != "_expert"}
    kind.loss(student, features, actions, targets, config, grads)
    encode = student.encode_features  # the goals, of 3 * 4 * 3 columns, are held fixed
    goal = targets[-1].reshape(1, 4, -1) if len(targets) == 4 else None
    fixed = goal is not None and encode(goal)
    monkeypatch.setattr(student, "encode_features", lambda x, tape=None: fixed
                        if x.shape[-1] == 36 else encode(x, tape))
    for key in grads:
        numeric = numeric_gradient(lambda: kind.loss(
            student, features, actions, targets, config)[0], student.params[key])
        np.testing.assert_allclose(grads[key], numeric, rtol=1e-5, atol=1e-8)


def test_consistency_rolls_out_once(monkeypatch):
    """Equation 4 and the consistency are of one rollout and walk back together."""
    student, features, actions, targets = loss_inputs()
    config, calls = fac.DistillConfig(horizon=2), []
    for name in ("unroll", "run_heads", "heads_backward", "unroll_backward"):
        real = getattr(fac, name)
        monkeypatch.setattr(fac, name, lambda *args, real=real, name=name: (
            calls.append(name), real(*args))[1])
    grads = {k: np.zeros_like(v) for k, v in student.params.items() if k[:7] != "_expert"}
    baselines.consistency_loss(student, features, actions, targets, config, grads)
    assert calls == ["unroll", "run_heads", "heads_backward", "unroll_backward"]


def test_a_figure12_run_counts_as_finished_by_its_last_row_alone(tmp_path, monkeypatch):
    def train(args):
        Path(args.out).mkdir(parents=True)
        (Path(args.out) / "curve.csv").write_text(
            "decisions,seconds,eval_expert,eval_student\n2000,1,5,4\n4000,2,,\n6000,3,7,6\n")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_expert, "train", train)
    run = experiments.make_run("walker-walk", 0, "online", decisions=6000, episodes=1)
    rows = runs.attempt(experiments.follow, run)
    assert [(row["step"], row["return_mean"], row["expert_mean"]) for row in rows] == [
        ("2000", 4.0, 5.0), ("6000", 6.0, 7.0)]
    assert rows[-1]["minutes"] == 3 / 60  # of all its stretches
    for count in (1, 2):
        experiments.append_rows(path := tmp_path / f"{count}.csv", rows[:count])
        assert len(experiments.finished(experiments.read_rows(path))) == count - 1


def test_consistency_vanishes_where_the_student_follows_the_expert():
    """What it adds is the mean square of s_{h+1} - f_E(expert's s_{h+1}), by hand."""
    student, features, actions, targets = loss_inputs()
    config = fac.DistillConfig(horizon=2, lam=0.5)
    base = fac.distill_loss(student, features, actions, targets[:3], config)[0]
    found = baselines.consistency_loss(student, features, actions, targets, config)[0]
    z, expected = np.repeat(student.encode_features(features), 3, 2), 0.0
    for h in range(3):
        a = actions[h].reshape(2, 1, 12)
        z = student.next(z, a)
        goal = student.encode_features(targets[3][:, h].reshape(1, 4, 12))
        expected += 2.0 * 0.5 ** h * ((z - goal) ** 2).mean()
    assert np.isclose(found - base, expected)


def small_vae(dtype=np.float64):
    return baselines.ActionVAE(4, 3, np.random.default_rng(0), 8, dtype)


def test_gradients_of_the_action_vae():
    vae, rng = small_vae(), np.random.default_rng(2)
    x, noise = rng.uniform(-1, 1, (7, 5)), rng.standard_normal((2, 5))
    grads = {k: np.zeros_like(v) for k, v in vae.params.items()}
    vae.loss(x, noise, 0.3, grads)
    for key, p in vae.params.items():
        assert_close(grads[key], numeric_gradient(lambda: vae.loss(x, noise, 0.3), p), 1e-7)


def test_the_action_vae_against_pytorch():
    torch = pytest.importorskip("torch")
    from torch_learner import network
    vae, rng = small_vae(), np.random.default_rng(2)
    x, noise = rng.uniform(-1, 1, (7, 5)), rng.standard_normal((2, 5))
    grads = {k: np.zeros_like(v) for k, v in vae.params.items()}
    loss = vae.loss(x, noise, 0.3, grads)
    params = {k: torch.tensor(v, requires_grad=True) for k, v in vae.params.items()}
    x = torch.tensor(x.T)
    mu, log_var = network(fac.MLP, params, "encode", x[None])[0].chunk(2, -1)
    posterior = torch.distributions.Normal(mu, (log_var / 2).exp())
    prior = torch.distributions.Normal(torch.zeros(()), torch.ones(()))
    u = mu + posterior.stddev * torch.tensor(noise.T)
    back = network(fac.MLP, params, "decode", torch.cat([x[:, :4], u], 1)[None])[0]
    error = (back - x[:, 4:]).square().sum()
    total = (error + 0.3 * torch.distributions.kl_divergence(posterior, prior).sum()) / 5
    total.backward()
    assert np.isclose(loss, total.item())
    for key, p in params.items():
        np.testing.assert_allclose(grads[key], p.grad, rtol=1e-9, atol=1e-12)


def test_the_action_vae_learns_with_noise(monkeypatch):
    vae, noise, rng = small_vae(np.float32), [], np.random.default_rng(0)
    monkeypatch.setattr(vae, "loss", lambda x, drawn, *_: noise.append(drawn))
    vae.fit(lambda batch: np.zeros((7, batch), np.float32), rng, 20)
    noise = np.stack(noise)
    assert noise.shape == (20, 2, 256) and abs(noise.std() - 1) < 0.03 and abs(noise.mean()) < 0.03
    assert len({step.tobytes() for step in noise}) == 20


def test_the_action_vae_finds_a_plane():
    """Actions in a plane through a point that the state tells come back from two numbers."""
    rng = np.random.default_rng(0)
    plane = rng.standard_normal((4, 2)) / 3

    def draw(batch):
        s = rng.uniform(-0.5, 0.5, (4, batch))
        return np.concatenate([s, s + plane @ rng.uniform(-1, 1, (2, batch))]).astype(np.float32)

    vae = baselines.ActionVAE(4, 4, rng)
    vae.fit(draw, rng, 800, beta=1e-3)
    x = draw(64)
    u = vae.encode(x)
    assert u.shape == (2, 64) and np.abs(u).max() <= 1
    back = vae.decode(x[:4], u)
    assert ((back - x[4:]) ** 2).mean() < 0.05 * x[4:].var()


def test_tap_s_targets_are_for_what_the_robot_would_do():
    expert, _ = fac.load_model(fac.data_file("reacher-hard", "expert.npz"))
    replay, rng = fac.Replay(fac.data_file("reacher-hard", "replay.npz")), np.random.default_rng(0)
    config = fac.DistillConfig(steps=8, batch_size=8)
    distiller = baselines.TapDistiller(expert, replay, config, vae_steps=10)
    with contextlib.closing(distiller):
        obs, actions = replay.sequences(distiller.train_starts[:4], 4)
        spread = []
        for deviation in (1e-7, 0.5):  # targets are for what the robot would do
            z, u, targets = distiller.perturb(
                expert, distiller.student, obs, actions[..., None],
                fac.dataclasses.replace(config, noise_std=deviation), rng)
            s, copies = np.repeat(z, config.noise_samples, 2), np.repeat(actions, 5, 2)
            for h, a in enumerate(copies):
                u_h = u[h].reshape(2, -1)
                if deviation < 0.1:
                    encoded = distiller.vae.encode(np.concatenate([s[0], a]))
                    np.testing.assert_allclose(u_h, encoded, atol=1e-5)
                decoded = distiller.vae.decode(s[0], u_h)[None]
                np.testing.assert_allclose(targets[0][h].ravel(), expert.reward(s, decoded)[0],
                                           rtol=1e-3, atol=1e-4)
                s = expert.next(s, decoded)
            spread.append(u.std(-1).mean())
            assert u.shape == (4, 2, 4, config.noise_samples) and np.abs(u).max() <= 1
        assert spread[0] < 1e-5 < 0.2 < spread[1] < 0.5
        assert np.isfinite(distiller.step()).all()


def test_a_disturbed_robot():
    def step(kind, action, joint=0):
        environment = experiments.DisturbedEnvironment("walker-walk", joint, kind)
        environment.reset(0)
        return environment.step(np.array(action, np.float32))[0]

    plain = fac.Environment("walker-walk")
    plain.reset(0)
    full, half = np.eye(6)[0], np.eye(6)[0] / 2
    expected = plain.step(half)[0]
    np.testing.assert_allclose(step("0.5", full), expected, atol=1e-6)  # half a motor, whole action
    assert not np.allclose(step("1.5", full), step("0.5", full))
    assert not np.allclose(step("noise", full), step("1.5", 0 * full))
    for joint, other in ((0, 2), (2, 0)):
        one, two = np.eye(6)[[joint, other]]
        np.testing.assert_array_equal(step("noise", one, joint), step("noise", 0 * one, joint))
        assert not np.allclose(step("noise", two, joint), step("noise", 0 * two, joint))
        plain.reset(0)
        np.testing.assert_allclose(step("0.5", two, joint), plain.step(two)[0], atol=1e-6)
    servos = [e.env.physics.model.actuator_biasprm for e in (
        fac.Environment("quadruped-walk"),
        experiments.DisturbedEnvironment("quadruped-walk", 1, "0.5"))]
    assert servos[0][1].any() and np.array_equal(servos[1][1], servos[0][1] / 2)
    assert np.array_equal(servos[1][0], servos[0][0])


def test_figure_8_s_noise_is_a_standard_normal_cut_at_the_limits(monkeypatch):
    seen, action = [], np.full(3, 0.25, np.float32)
    monkeypatch.setattr(fac.Environment, "step", lambda self, action: seen.append(action))
    environment = experiments.DisturbedEnvironment("reacher-hard", 1, "noise")
    for _ in range(4000):
        environment.step(action)
    others, noise = np.delete(seen, 1, 1), np.array(seen)[:, 1]
    assert (others == 0.25).all() and (action == 0.25).all()
    assert (np.abs(noise) <= 1).all() and abs(noise.mean()) < 0.05
    assert abs((np.abs(noise) == 1).mean() - 0.317) < 0.03  # beyond one deviation
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.06


def test_a_run_is_planned_disturbed_and_timed_as_it_says(monkeypatch, tmp_path):
    seen, made, planner = [], [], fac.Planner
    monkeypatch.setattr(experiments, "measure", lambda *args: seen.append(args) or {})
    fac.save_model(tmp_path / "reacher-hard-0" / "student.npz", random_model(), {"kind": "student"})
    list(experiments.plan_with("reacher-hard", 0, "student", {
        "samples": 7, "iterations": 2, "episodes": 3, "joint": 1, "kind": "noise",
        **experiments.identity(random_model(), {})}, tmp_path))
    for (_, _, planning, count, of, environment), evaluation_seed in zip(seen, (101, 102)):
        assert (planning.samples, planning.iterations, count, of, environment._joint) == (
            7, 2, 3, evaluation_seed, 1)
    expert, header = fac.load_model(fac.data_file("reacher-hard", "expert.npz"))
    list(experiments.plan_with("reacher-hard", 0, "policy", {
        "episodes": 3, **experiments.identity(expert, header)}, tmp_path))
    assert (seen[-1][2].prior, seen[-1][2].iterations) == ("own", 0)
    monkeypatch.setattr(fac, "Planner", lambda model, config, **how: (
        made.append(config.samples), planner(model, config, **how))[1])
    (row,) = experiments.time_runs([experiments.make_run("x", 0, "expert", samples=7)],
                                   lambda run: (random_model(1), {}), 1)
    assert set(made) == {7} and row["ms"] > 0
    run = experiments.make_run("reacher-hard", 0, "N = 3", num_agents=3)
    assert experiments.fresh_student(run)[0].config.num_agents == 3
    small = experiments.fresh_student(experiments.make_run("reacher-hard", 0, "10% TD-MPC"))[0]
    assert (small.config.num_agents, small.config.mlp_dim) == (1, 66)


def test_milliseconds_are_medians_over_rounds(monkeypatch):
    monkeypatch.setattr(fac, "cores", lambda: 1)
    monkeypatch.setattr(fac, "interleaved_seconds", lambda calls, rounds, label: np.array(
        [[0.001], [0.002], [0.009]]))
    (row,) = experiments.time_runs([experiments.make_run("x", 0, "expert", samples=7)],
                                   lambda run: (random_model(1), {}), 3)
    assert row["ms"] == row["ms_workers"] == 2
    monkeypatch.setattr(fac, "cores", lambda: 2)  # of which no second process can be had
    monkeypatch.setattr("multiprocessing.util.spawnv_passfds", lambda *_: os.close(-1))
    (row,) = experiments.time_runs([experiments.make_run("x", 0, "student", samples=7)],
                                   lambda run: (random_model(), {}), 3)
    assert row["ms"] == row["ms_workers"] == 2


def test_figures_7_and_8_plan_with_both_models(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(experiments, "BUDGETS", [(8, 1), (4, 1)])
    fac.save_model("runs/reacher-hard-0/student.npz", random_model(), {"kind": "student"})
    flags = ["--tasks", "reacher-hard", "--seeds", "0", "--jobs", "1", "--episodes", "1",
             "--students", str(tmp_path / "runs")]
    for _ in range(2):  # nothing is missing the second time
        assert experiments.main(["figure7", *flags, "--rounds", "2", "--out", "7.csv"]) == 0
        rows = experiments.read_rows("7.csv")
        assert len(rows) == 12 and [bool(row["ms"]) for row in rows] == [False] * 8 + [True] * 4
    assert {row["case"] for row in rows} == {"expert", "student"}
    seen = []  # who plays is the same for figure 8
    monkeypatch.setattr(experiments, "run_all", lambda args, function, runs: seen.extend(runs))
    assert experiments.main(["figure8", *flags]) == 0
    assert len(seen) == 3 * (1 + 3 * 3)
    assert {run["case"] for run in seen} == {"expert", "policy", "student"}
    row = runs.attempt(functools.partial(experiments.plan_with, folder="runs"), {
        **seen[-1], "settings": seen[-1]["settings"].replace("weights ", "weights 1")})[-1]
    assert row["error"] == ("UserError: student of reacher-hard, seed 0, in data/ or runs/, has "
                            "changed; give the command again")
    for data, status in ((experiments.data_checksums("reacher-hard"), 0), ([1, 2, None], 2)):
        fac.save_model("runs/reacher-hard-0/student.npz", random_model(), {
            "kind": "student", "data": data})
        assert experiments.main(["figure8", *flags]) == status
    assert "student.npz: another expert's student" in capsys.readouterr().err


def test_a_run_made_with_other_defaults_is_another_run(monkeypatch):
    seen, flags = [], ["--tasks", "reacher-hard", "--seeds", "0", "--set", "lam=0.5"]
    monkeypatch.setattr(experiments, "run_all", lambda args, function, runs: seen.extend(runs))
    changed = dataclasses.make_dataclass("PlannerConfig", [(
        "samples", int, fac.field(7, "another default"))], bases=(fac.PlannerConfig,), frozen=True)
    for config_class in (fac.PlannerConfig, fac.PlannerConfig, changed):
        monkeypatch.setattr(fac, "PlannerConfig", config_class)
        assert experiments.main(["sweep", *flags]) == 0
    assert seen[0] == seen[1] != seen[2]
    expected = "data/experts/reacher-hard or a default has changed; give the command again"
    same = functools.partial(functools.partial, experiments.of_same_data)  # as run_all does
    assert expected in runs.attempt(same(experiments.distil), seen[0])[-1]["error"]
    settings = {"decisions": 4000, "episodes": 1}
    before = experiments.made_from("walker-walk", {"data": 0, **settings})
    monkeypatch.setitem(train_expert.FOLLOWING_DEFAULTS, "played_share", 0.25)
    run = experiments.make_run("walker-walk", 0, "online", data=before, **settings)
    row = runs.attempt(same(experiments.follow), run)[-1]
    assert "a default has changed" in row["error"]


def test_departures_are_those_that_the_settings_name(monkeypatch):
    seen = []
    monkeypatch.setattr(experiments, "run_all", lambda args, function, runs: seen.extend(runs))
    assert experiments.main(["departures", "--tasks", "walker-run", "--seeds", "3"]) == 0
    found = {run["case"]: json.loads(run["settings"]) for run in seen}
    assert set(found) == {"default", "D2", "D3", "D7", "D8", "D9"}
    own = set(found["default"])
    assert {k: v for k, v in found["D7"].items() if k not in own} == {"clip_actions": False}
    assert found["D2"]["kl"] == "reverse" and found["D8"]["expert_episodes"] == 0


def test_the_cases_of_figure_5_learn_what_they_say():
    kinds = {case: baselines.distiller_of(case) for case in experiments.FIGURE5}
    assert kinds.pop("MSE") is baselines.MSEDistiller
    assert kinds.pop("consistency") is baselines.ConsistentDistiller
    assert kinds.pop("consistency 0.03") is baselines.LightlyConsistentDistiller
    assert set(kinds.values()) == {fac.Distiller} and len(kinds) == 7
    assert {k: v for k, v in experiments.FIGURE5.items() if v} == {
        "joint targets": {"targets": "joint"},
        "MSE": {"targets": "joint"},  # values, not what changes them
        **{f"noise {x}": {"noise_std": x} for x in (0.1, 1.0, 2.0)},
        **{f"T_s {x}": {"temperature_student": x} for x in (0.1, 2.0)}}


def test_goals_of_the_consistency_loss_are_the_expert_s_next_latents(replay):
    expert = random_model(n=1, policy=True)
    with contextlib.closing(baselines.ConsistentDistiller(expert, replay,
                                                          CONFIG)) as distiller:
        z, actions, targets = distiller.draw(0, 0, 4)
    z = np.repeat(z, actions.shape[3], 2)
    assert targets[-1].shape == (6, 4, *actions.shape[2:]) and len(actions) == 4
    for a, after in zip(actions, targets[-1].swapaxes(0, 1)):
        z = expert.next(z, a.reshape(1, 3, -1))
        np.testing.assert_allclose(after.reshape(6, -1), z[0], rtol=1e-4, atol=1e-5)


def test_mse_is_a_mean_over_perturbations():
    x, y = np.random.default_rng(0).standard_normal((2, 4, 5))
    np.testing.assert_allclose(baselines.squared_error(x, y)[0], ((x - y) ** 2).mean(-1))


def test_tap_s_robot_gets_what_its_state_decodes_a_latent_action_to():
    expert, _ = fac.load_model(fac.data_file("reacher-hard", "expert.npz"))
    vae = baselines.ActionVAE(50, 3, np.random.default_rng(0))
    environment = baselines.DecodingEnvironment("reacher-hard", expert, vae)
    plain, u = fac.Environment("reacher-hard"), np.float32([0.3, -0.8])
    obs = plain.reset(0)
    assert np.array_equal(environment.reset(0), obs)
    for _ in range(3):
        obs, _ = plain.step(vae.decode(expert.encode(obs[:, None])[0], u[:, None])[:, 0])
        assert np.array_equal(environment.step(u)[0], obs)


@pytest.mark.parametrize("case, seed, setting, found", [
    ("TAP", 1, "episodes", (5, 10)),         # a case's seeds
    ("TAP", 1, "lr", (0.1, 0.2)),
    ("10% TD-MPC", 0, "episodes", (5, 10)),  # a task's cases have one budget
    ("TAP", 0, "weights", ("a", "b"))])      # a seed's student
def test_runs_of_other_settings_don_t_make_one_figure(tmp_path, capsys, case, seed, setting, found):
    path, rows = tmp_path / "figure4.csv", [{"step": 1, "return_mean": 1.0, "minutes": 1.0}]
    for i, (what, at) in enumerate((("TAP", 0), (case, seed))):
        settings = {"weights": at, "data": [1], "joint": i, setting: found[i]}
        write_rows(path, [("walker-run", at, what, settings, rows)])
    first, second = ({setting: value} for value in found)
    with pytest.raises(fac.UserError) as caught:
        experiments.settled(path, ("joint",))
    assert (f"TAP of walker-run, seed 0, was made with {first}, {case}, seed {seed}, with {second};"
            in str(caught.value))
    assert len(experiments.settled(path, ("joint", setting))) == 2
    assert "walker-run is of other data or defaults than now" in capsys.readouterr().err


def variant_row(evaluation_seed, search, priors=None, **more):
    """A row as `distil` makes it; without priors TAP's, which has no ranks."""
    return {"step": 9, **tables.of_returns(search, evaluation_seed), "minutes": 1.0,
            "policy_returns": [10.0, 30.0], **({
                "rank_q": 0.9, "rank_return": 0.5, "ranks": {"reflex_returns": priors}}
                if priors else {}), **more}


def test_a_report_needs_no_expert(tmp_path, monkeypatch):
    """What a change costs is of the same episodes and seeds; TAP has no priors and no ranks."""
    write_rows(path := tmp_path / "variants.csv", [
        *(("walker-stand", seed, case, {"data": [1]}, [
            variant_row(102, [40.0 + seed - less, 60.0], [10.0, 20.0]),
            variant_row(101, [50.0 - less, 70.0 + seed], [20.0, 30.0])])
          for case, less, seeds in (("MSE", 8, (1, 0, 2)), ("default", 0, (0, 1)))
          for seed in seeds),  # whichever ended first
        ("walker-stand", 0, "TAP", {"data": [1]}, [{"error": "it failed before"}]),
        ("walker-stand", 0, "TAP", {"data": [1]}, [variant_row(101, [1.0, 2.0]),
                                                   variant_row(102, [3.0, 4.0])]),
        ("walker-stand", 0, "default", {"data": [1]}, [{"ms": 2.5, "ms_workers": 1.0}])])
    monkeypatch.setattr(fac, "EXPERTS", tmp_path)
    monkeypatch.setattr(experiments, "draw_dots", lambda path, panels, _: drawn.update(panels))
    drawn = {}
    result, text = experiments.report_variants("variants", path, tmp_path)
    default, mse, tap = ([cell.strip() for cell in line.split("|")[1:-1]]
                         for line in text.splitlines()[2:])
    assert default == ["walker-stand", "default", "2", "20", "55", "+0 ± 0", "20",
                       "+35 ± 3", "0.90 / 0.50", "2.5"]
    # -8, 0, -8, 0 in both seeds that are compared: an error of 2.3 over episodes, none over seeds
    assert mse[2:7] == ["3", "20", "52", "-4 ± 2", "20"] and mse[-1] == "-"
    assert tap == ["walker-stand", "TAP", "1", "20", "2", "-52 ± 6", "-", "-", "-", "-"]
    assert result["walker-stand"]["MSE"]["above_default"] == pytest.approx((-4, (64 / 12) ** 0.5))
    assert {case: [*dots] for case, dots in drawn["walker-stand"].items()} == {
        "default": ["its search", "priors alone"], "MSE": ["its search", "priors alone"],
        "TAP": ["its search"]}


def test_what_a_student_was_made_with_tells_it_apart():
    model, seen = random_model(), set()
    for header in ({}, {"distill": {"lr": 1}}, {"distill": {"lr": 2}}, {"data": [1]},
                   {"training": {"discount": 0.5}}):
        seen.add(experiments.identity(model, header)["made"])
    assert len(seen) == 5


def test_a_seed_that_lacks_runs_is_left_out(tmp_path, capsys):
    path = tmp_path / "figure7.csv"
    write_rows(path, [("walker-run", seed, "student", {"samples": samples, "iterations": 6}, [
        {"return_mean": 1.0, "minutes": 1.0}])
        for seed, samples in ((0, 512), (0, 256), (1, 512))])
    found = experiments.settled(path, experiments.VARIED["figure7"])
    assert [key[1] for key in found] == ["0", "0"]
    assert "student of walker-run, seed 1, isn't whole: left out" in capsys.readouterr().err
    assert len(experiments.settled(path, experiments.VARIED["figure7"], whole=False)) == 3


def test_negative_returns_are_drawn(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    drawn = []
    monkeypatch.setattr(plots, "save_figure", lambda path, figure: drawn.extend(figure.axes))
    for values in ([-1200.0, -250.0], [0.0, 900.0]):
        points = {step: [value] for step, value in enumerate(values)}
        tables.draw_lines(tmp_path / "x.png", {"a robot": ({"TAP": points}, None)}, "step")
    (low, high), (least, most) = (ax.get_ylim() for ax in drawn)
    assert low < -1200 and high == 0 and least == 0 and most > 900


@pytest.mark.parametrize("left", ["", "task,se"])
def test_a_csv_without_a_row_is_begun_anew(tmp_path, left):
    path = tmp_path / "x.csv"
    path.write_text(left)
    assert experiments.read_rows(path) == []
    write_rows(path, [("walker-run", 0, "TAP", {}, [{"minutes": 1.0}])])
    assert len(experiments.read_rows(path)) == 1 and path.read_text().count("task") == 1


@pytest.mark.parametrize("command, cases, timed", [
    (["figure13"], ["N = 1", "default"], ["N = 1", "default"]),
    (["figure4", "--cases", "10% TD-MPC", "default", "TAP"], ["10% TD-MPC", "default", "TAP"],
     ["10% TD-MPC", "default"])])
def test_figures_4_and_13_distil_and_time_their_cases(tmp_path, monkeypatch, command, cases, timed):
    monkeypatch.chdir(tmp_path)
    short_episodes(monkeypatch)  # in this process
    monkeypatch.setattr(runs, "in_processes", lambda function, own, jobs: (
        runs.attempt(function, run) for run in own))
    flags = ["--tasks", "reacher-easy", "--seeds", "0", "1", "--jobs", "1", "--steps", "1",
             "--episodes", "1", "--samples", "4", "--iterations", "1", "--rounds", "2"]
    for _ in range(2):  # nothing is missing the second time
        assert experiments.main([*command, *flags, "--out", "rows.csv"]) == 0
        rows = experiments.read_rows("rows.csv")
        assert [row["case"] for row in rows] == [
            case for case in cases * 2 for _ in (101, 102)] + timed
        assert [bool(row["ms"]) for row in rows] == [False] * 4 * len(cases) + [True] * len(timed)


def write_rows(path, runs):
    """A CSV of runs: (task, seed, case, settings, [row, ...])."""
    for task, seed, case, settings, rows in runs:
        run = experiments.make_run(task, seed, case, **settings)
        experiments.append_rows(path, [{**run, **row} for row in rows])


def test_figure_7_judges_means_and_draws_along_its_axes(tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(experiments, "draw_lines", lambda path, panels, *_, **__:
                        drawn.update(panels))
    found = ((512, 6, (100.0, 100.0), 8.0), (64, 6, (60.0, 100.0), 4.0),
             (512, 2, (96.0, 96.0), 6.0))
    write_rows(tmp_path / "7.csv", [("walker-run", seed, case, {"samples": s, "iterations": i}, [
        {"return_mean": value[seed], "returns": [value[seed]] * 2, "minutes": 1.0},
        {"ms": ms, "ms_workers": ms}])
        for seed in (0, 1) for case in ("expert", "student") for s, i, value, ms in found])
    (row,), _ = experiments.report_figure7("", tmp_path / "7.csv", tmp_path)
    assert row["expert"] == {"samples": 512, "iterations": 2, "ms": 6, "return": 96}
    assert [set(lines["expert"]) for lines, _ in drawn.values()] == [{512, 64}, {6, 2}]


def test_figure_7_compares_at_equal_return_on_episodes_that_chose_nothing(tmp_path, monkeypatch):
    """The student's full return is 60: the expert reaches 0.95 of it in a millisecond, of its own
    in ten. A budget that only the reporting episodes favour isn't chosen."""
    monkeypatch.setattr(experiments, "draw_lines", lambda *_, **__: None)
    found = {"expert": {(512, 6): ([100, 102] * 2, 20.0), (128, 4): ([97, 75] * 2, 10.0),
                        (16, 1): ([60, 66] * 2, 1.0)},
             "student": {(512, 6): ([60, 50] * 2, 8.0), (128, 4): ([60, 48] * 2, 5.0),
                         (64, 1): ([57, 33] * 2, 2.0), (16, 1): ([56, 90] * 2, 0.5)}}
    write_rows(tmp_path / "7.csv", [("walker-run", 0, case, {"samples": s, "iterations": i}, [
        {"return_mean": np.mean(returns), "returns": returns[:2], "evaluation_seed": 101},
        {"return_mean": np.mean(returns), "returns": returns[2:], "minutes": 1.0},
        {"ms": ms, "ms_workers": 2 * ms}])
        for case, budgets in found.items() for (s, i), (returns, ms) in budgets.items()])
    (row,), table = experiments.report_figure7("", tmp_path / "7.csv", tmp_path)
    assert row["expert"] == {"samples": 128, "iterations": 4, "ms": 10.0, "return": 75.0}
    equal = row["equal_return"]
    assert equal["expert"] == {"samples": 16, "iterations": 1, "ms": 1.0, "return": 66.0}
    assert equal["student"] == {"samples": 64, "iterations": 1, "ms": 2.0, "return": 33.0}
    assert (row["ratio"], equal["ratio"]) == (5.0, 0.5)
    assert row["kept"] == {"512 x 6": 55 / 101, "128 x 4": 54 / 86}
    assert row["speedup"] == {"512 x 6": [2.5, 2.5], "128 x 4": [2.0, 2.0]}
    assert "16 x 1: 66, 1.0 ms | 64 x 1: 33, 2.0 ms" in table


def test_an_interval_is_as_wide_as_episodes_and_joints_scatter():
    def kept(one, other):
        parts = [tables.kept_of({key: [own] for key, own in found.items()}, "noise", [0, 1])
                 for found in (one, other)]
        return parts[0][0], tables.difference_cell(*parts), np.percentile(
            parts[0][1] - parts[1][1], (2.5, 97.5))

    steady = {("none", 0): [100.0] * 5, ("noise", 0): [60.0] * 5, ("noise", 1): [60.0] * 5}
    better = {**steady, ("noise", 0): [70.0] * 5, ("noise", 1): [70.0] * 5}
    assert kept(better, steady)[:2] == (0.7, "**+0.10 (+0.10 to +0.10)**")
    assert kept(steady, better)[:2] == (0.6, "**-0.10 (-0.10 to -0.10)**")
    _, text, interval = kept({**steady, ("noise", 0): [80.0] * 5}, steady)  # joints: 0, 0.1, 0.2
    assert interval == pytest.approx((0, 0.2)) and "*" not in text
    lucky = {**steady, ("noise", 0): [20.0, 100, 20, 100, 60], ("noise", 1): [100, 20, 60, 60, 60]}
    assert kept(lucky, lucky)[2].tolist() == [0, 0]  # the same episodes are drawn for both
    mean, _, (low, high) = kept(lucky, steady)
    assert mean == 0.6 and -0.4 < low < -0.1 < 0.1 < high < 0.4
    nothing = tables.kept_of({key: [[0.0] * 5] for key in steady}, "noise", [0, 1])
    assert tables.difference_cell(nothing, nothing) == "-"
    # students: their mean is an episode's
    one, _ = tables.kept_of({key: [[90.0] * 3, [110.0] * 3] if key[0] == "none" else [
        [30.0] * 3, [50.0] * 3] for key in steady}, "noise", [0, 1])
    assert one == 0.4


def test_bands_over_seeds_are_sample_deviations(monkeypatch, tmp_path):
    pytest.importorskip("matplotlib")
    kept = []
    monkeypatch.setattr(plots, "save_figure", lambda path, figure: kept.append(figure))
    tables.draw_lines(tmp_path / "x.png", {"task": ({"case": {1: [3.0, 5.0], 2: [7.0]}}, None)},
                      "step")
    (band,) = kept[0].axes[0].collections
    heights = {x: band.get_paths()[0].vertices[band.get_paths()[0].vertices[:, 0] == x, 1]
               for x in (1, 2)}
    assert np.ptp(heights[1]) == pytest.approx(2 * 2 ** 0.5) and np.ptp(heights[2]) == 0


def test_tables_hold_where_curves_end():
    assert tables.last({1: [1.0], 2: [3.0, 5.0]}, {1: [0.1], 2: [0.5, 0.25]}) == {
        "mean": 4, "std": 2 ** 0.5, "seeds": 2, "rank_return": 0.375}
    own = [{"step": str(i), "return_mean": value, "expert_mean": "10"}
           for i, value in enumerate(("1", "9"))]
    runs = {("walker-walk", "0", "online", "{}"): own}
    assert experiments.follow_up(runs, "walker-walk")[0] == 0.9
    runs["walker-walk", "1", "online", "{}"] = [{"step": "1", "return_mean": 9, "expert_mean": 2}]
    assert experiments.follow_up(runs, "walker-walk")[0] == 18 / 12  # of means


def test_report_draws_what_the_csvs_hold(tmp_path):
    pytest.importorskip("matplotlib")
    write_rows(tmp_path / "variants.csv", [
        ("walker-run", seed, case, {}, [variant_row(101, [10.0 + seed, 20.0], [9.0, 9.0]),
                                        variant_row(102, [30.0, 40.0], [9.0, 9.0])])
        for case in ("default", "MSE", "N = 1") for seed in (0, 2)] + [
        ("walker-run", 2, "N = 1", {}, [{"ms": 8.0, "ms_workers": 5.0}]),
        ("walker-run", 1, "TAP", {}, [{"error": "no"}])])
    write_rows(tmp_path / "figure12.csv", [("walker-walk", 0, "online", {}, [
        {"step": 4, "return_mean": 5.0, "expert_mean": 6.0, "minutes": 1.0}])])
    write_rows(tmp_path / "figure8.csv", [("walker-run", 0, case, about, [
        {"return_mean": value, "returns": [value], "minutes": 1.0},
        {"return_mean": value, "returns": [value]}]) for case in ("expert", "policy", "student")
        for about, value in (({}, 9.0), *(({"joint": j, "kind": kind}, 3.5 + 2 * j)
                                          for j in (0, 1) for kind in ("noise", "0.5", "1.5")))] + [
        ("fish-swim", 0, "policy", {"joint": 0, "kind": "noise"}, [  # what isn't there yet
            {"return_mean": 3.0, "returns": [3.0], "minutes": 1.0}])])
    write_rows(tmp_path / "figure7.csv", [("walker-run", 0, case, {"samples": s, "iterations": i}, [
        {"return_mean": value, "returns": [value] * 2, "minutes": 1.0},
        {"ms": ms, "ms_workers": ms / 2}])
        for case in ("expert", "student")
        for s, i, value, ms in ((512, 6, 100.0, 80.0), (64, 6, 96.0, 12.0), (64, 2, 94.0, 6.0),
                                (16, 6, 97.0 * (case == "student"), 4.0))])
    found = last_json(here("report", "--results", ".", "--figures", "pictures", "--json",
                           cwd=tmp_path))
    assert found["variants"]["walker-run"]["N = 1"]["search"] == 25.25
    assert found["figure12"]["walker-walk"]["expert"]["mean"] == 6.0
    assert found["figure12"]["walker-walk"]["ratio"] == 5 / 6
    assert found["figure8"]["walker-run"]["student"] == {"noise": 0.5, "0.5": 0.5, "1.5": 0.5}
    assert [*found["figure8"]] == ["walker-run"]
    (row,) = found["figure7"]
    assert row["task"] == "walker-run" and row["ratio"] == 6.0 and row["ratio_in_process"] == 3.0
    assert row["expert"] == {"samples": 64, "iterations": 6, "ms": 12.0, "return": 96.0}
    assert row["student"] == {"samples": 16, "iterations": 6, "ms": 2.0, "return": 97.0}
    assert sorted(os.listdir(tmp_path / "pictures")) == sorted(f"{k}.png" for k in found)
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    for part in ("## Figure 12", "| N = 1 | 2 | 20 | 25 | +0 ± 0 |", "pictures/figure7.png",
                 "| student - policy |  | +0.00 (+0.00 to +0.00) |"):
        assert part in text


# students -----------------------------------------------------------------------------


def test_what_each_joint_wins_alone_is_told_in_two_tables(tmp_path):
    """A student that doesn't search is its priors, and the same search is the policy."""
    def rows(iterations, **more):
        return [{"step": 9, "return_mean": 150.0, "returns": [160.0, 140.0], "minutes": 6.0,
                 "expert_returns": [200.0, 120.0], "policy_returns": [90.0, 110.0],
                 "evaluation_seed": seed, "ranks": {
                     "max_std": 0.15, "samples": 32, "iterations": iterations, **more,
                     "rank_correlation_returns": [0.9, 0.7, 0.5], "plan_ms_expert": 9.0,
                     "plan_ms_student_in_process": 2.0}}
                for seed in (101, 102)]

    own = {"num_agents": 6}
    write_rows(tmp_path / "alone.csv", [
        ("walker-run", 0, "default", own, rows(0)),
        ("walker-stand", 0, "paper", own, rows(
            3, reflex_returns=[80.0, 60.0], same_search_returns=[210.0, 20.0]))])
    _, text = experiments.report_alone("alone", tmp_path / "alone.csv", None)
    short, whole = ([[cell.strip() for cell in line.split("|")[1:-1]] for line in
                     table.splitlines()[2:]] for table in text.split("\n\n"))
    # less the expert's: -40, 20, twice, a standard error of 17.3
    assert short == [["walker-run, 6", "160", "100", "150 ± 17", "4"],
                     ["walker-stand, paper, 6", "160", "100", "150 ± 17\\*", "4"]]
    assert whole == [["walker-run", "6", "2", "160", "100", "150", "150", "100", "0.94 ± 0.11",
                      "none", "9.0", "2.0", "0.90 / 0.50", "836 / 809"],
                     ["walker-stand, paper", "6", "2", "160", "100", "70", "150", "115",
                      "0.94 ± 0.11", "32 x 3, 0.15", "9.0", "2.0", "0.90 / 0.50", "-"]]


def test_one_model_for_all_joints_has_as_many_weights_as_a_model_for_each():
    for task, width in (("walker-run", 241), ("humanoid-walk", 300)):
        assert students.one(task)["mlp_dim"] == width
        each, one = students.sizes_of(task), students.sizes_of(task, 1, width)
        assert abs(students.weights(one) / students.weights(each) - 1) < 0.005
        assert each.num_agents == each.dim_action and one.num_agents == 1
    student = fac.WorldModel.create(students.sizes_of("reacher-easy"), np.random.default_rng(0))
    assert students.weights(student.config) == sum(
        value.size for key, value in student.params.items()
        if "encoder" not in key and key.endswith("weight"))


def test_one_model_is_distilled_like_a_student(monkeypatch):
    made = []
    monkeypatch.setattr(experiments, "run_all", lambda args, _, runs: (made.extend(runs), {
        "out": "x.csv"})[1])
    monkeypatch.setattr(students, "time_models", lambda path: None)
    assert experiments.main(["capacity", "--tasks", "walker-run", "--seeds", "4"]) == 0
    about = [json.loads(run["settings"]) for run in made]
    assert [(run["case"], of["num_agents"], of.get("mlp_dim")) for run, of in zip(made, about)] == [
        ("default", 6, None), ("one model, equal weights", 1, 241), ("one model, 512 wide", 1, 512)]
    assert str(students.folder("runs", "walker-run", 4, made[1]["case"])) == (
        "runs/walker-run-4-one-model-equal-weights")


def test_students_of_several_experts_are_known_by_their_weights(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(experiments, "run_all", lambda args, function, runs: made.extend(runs))
    path = tmp_path / "walker-stand-3-8000" / "expert.npz"
    path.parent.mkdir()
    path.write_bytes(fac.data_file("walker-stand", "expert.npz").read_bytes())
    assert experiments.main(["experts", "--tasks", "walker-stand", "--seeds", "3", "--experts",
                             str(tmp_path), "--stages", "8000"]) == 0
    about = [json.loads(run["settings"]) for run in made]
    assert [run["case"] for run in made] == ["8000: a model for each joint", "8000: one model"]
    expert, _ = fac.load_model(path)
    assert all(of["weights"] == fac.checksum(expert.params.values()) and of["expert"] == str(path)
               for of in about)
    assert [of["num_agents"] for of in about] == [6, 1]
    sizes = [students.sizes_of("", of["num_agents"], of.get("mlp_dim"), path) for of in about]
    each, one = map(students.weights, sizes)
    assert abs(one / each - 1) < 0.02


def test_experts_are_told_apart_with_an_error_over_them(tmp_path):
    def rows(expert, student):
        return [{"step": 9, "return_mean": student, "returns": [student], "minutes": 6.0,
                 "expert_returns": [expert], "policy_returns": [50.0], "evaluation_seed": seed,
                 "ranks": {"samples": 32, "iterations": 3}} for seed in (102, 101)]

    write_rows(path := tmp_path / "experts.csv", [
        ("walker-run", 1, "8000: one model", {"expert": "a"}, rows(100.0, 80.0)),
        ("walker-run", 2, "8000: one model", {"expert": "b"}, rows(200.0, 200.0)),
        ("walker-run", 1, "24000: one model", {"expert": "c"}, rows(100.0, 60.0))])
    _, text = experiments.report_experts("experts", path, tmp_path)
    final, early = ([cell.strip() for cell in line.split("|")[1:-1]] for line in
                    text.splitlines()[2:])
    assert early == ["walker-run", "8000", "one model", "100 / 200", "50 / 50", "80 / 200",
                     "32 x 3 / 32 x 3", "0.90 ± 0.10", "90 ± 60"]
    assert final[-2:] == ["0.60", "10"]


def test_what_is_printed_stands_beside_what_its_search_can_get(tmp_path, monkeypatch):
    short_episodes(monkeypatch)
    made, found = [], {}
    monkeypatch.setattr(experiments, "run_all", lambda args, function, runs: made.extend(runs))
    assert experiments.main(["printed", "--tasks", "walker-run", "--seeds", "0", "1", "--batches",
                             "64", "--data", "1,000 more"]) == 0
    assert [(run["case"], run["seed"]) for run in made] == [
        ("the expert's search, 128 x 4", "0"), ("the expert's search, 512 x 6", "0"),
        *(("1,000 more, 14000 x 64" + models, seed) for seed in "01" for models in (
            "", ", one model"))]
    about = json.loads(made[2]["settings"])
    assert (about["preset"], about["reuse"], about["batch_size"], about["expert_episodes"]) == (
        "plain", 1, 64, 1000)

    monkeypatch.setattr(experiments, "measure", lambda model, task, planning, _, of: found.update(
        planning=planning) or tables.of_returns([60.0], of))
    rows = [*experiments.printed("walker-run", 0, made[0]["case"], {"episodes": 1}, tmp_path)]
    assert (found["planning"].pi_trajs, found["planning"].samples, found["planning"].prior) == (
        0, 128, "last")
    student = [{"step": 9, "return_mean": 40.0, "returns": [40.0], "minutes": 1.0,
                "expert_returns": [80.0], "policy_returns": [70.0], "evaluation_seed": seed,
                "ranks": {"rank_correlation_returns": [0.5, 0.25]}} for seed in (102, 101)]
    write_rows(path := tmp_path / "printed.csv", [
        ("walker-run", 0, made[0]["case"], {}, [{**row, "minutes": 1.0} for row in rows]),
        ("walker-run", 0, made[2]["case"], {"expert_episodes": 1000, "steps": 9,
                                            "batch_size": 64}, student)])
    monkeypatch.setattr(experiments, "draw_lines", lambda path, panels, *_, **__: found.update(
        panels))
    _, text = experiments.report_printed("printed", path, tmp_path)
    curves, bound = found["walker-run"]
    known = fac.Replay(fac.data_file("walker-run", "replay.npz")).transitions
    assert bound == 60 and curves == {"a model for each joint, 9 x 64": {
        known + 1000 * fac.EPISODE_STEPS: [40.0]}}
    bound, own = ([cell.strip() for cell in line.split("|")[1:-1]] for line in
                  text.splitlines()[2:])
    assert bound[3:] == ["80", "70", "60 ± 0", "0.75", "-"]
    assert own[1:] == ["1,000 more, 14000 x 64", "1", "80", "70", "40 ± 0", "0.50", "0.50 / 0.25"]


def test_capacity_is_timed_once_and_told_in_a_table(tmp_path, monkeypatch):
    """Two students of a model for each joint, one of one model; a search wins over the priors that
    it searches around, not over those that the policy taught."""
    def rows(kept, narrow):
        played = [{"taught": taught, "samples": 16, "iterations": iterations, "max_std": std,
                   "returns": found} for taught, iterations, std, found in (
                      ("policy", 0, 1.0, [0.0, 0.0]), ("plans", 0, 1.0, kept),
                      ("plans", 2, 0.15, kept), ("plans", 3, 0.15, narrow),
                      ("plans", 3, 1.0, kept))]
        return [{"step": 9, "return_mean": 150.0, "returns": [160.0, 140.0], "minutes": 6.0,
                 "expert_returns": [200.0, 120.0], "evaluation_seed": seed, "ranks": {
                     "played": played, "rank_correlation_returns": [0.9, 0.7, 0.5]}}
                for seed in (102, 101)]

    write_rows(path := tmp_path / "capacity.csv", [
        ("walker-run", 0, "one model, equal weights", {"num_agents": 1, "mlp_dim": 241},
         rows([50.0, 50.0], [49.0, 49.0])),
        ("walker-run", 0, "default", {"num_agents": 6}, rows([10.0, 30.0], [30.0, 70.0])),
        ("walker-run", 1, "default", {"num_agents": 6}, rows([20.0, 20.0], [40.0, 80.0]))])
    timed = []

    def seconds(calls, *_):
        timed.append([call() for call in calls])
        return np.arange(1.0, len(calls) + 1)[None] / 1e3

    monkeypatch.setattr(fac, "interleaved_seconds", seconds)
    for _ in range(2):
        students.time_models(path)
    assert [len(calls) for calls in timed] == [6]  # two models, three searches
    result, text = experiments.report_capacity("capacity", path, tmp_path)
    each, one = ([cell.strip() for cell in line.split("|")[1:-1]] for line in
                 text.splitlines()[2:])
    # narrow - priors: 20, 40 and 20, 60: students' means 30 and 40, an error of 5; episodes' 20 and
    # 50, one of 15
    assert each == ["walker-run", "6 models", "85", "376k", "2", "160", "150 ± 17", "20",
                    "+0 ± 0", "+35 ± 16", "+0 ± 0", "0.90 / 0.50", "1.00 / 2.00 / 3.00", "6.0"]
    assert one[1:4] == ["one model, equal weights", "241", "375k"]
    assert one[7:11] == ["50", "+0 ± 0", "-1 ± 0", "+0 ± 0"]
    assert one[12] == "4.00 / 5.00 / 6.00" and "| 16 x 3, 0.15 - priors |" in text
    assert result == {"tasks": ["walker-run"]} and (tmp_path / "capacity.png").exists()
    write_rows(path := tmp_path / "each.csv", [
        ("walker-run", 0, "default", {"num_agents": 6}, rows([10.0, 30.0], [30.0, 70.0]))])
    students.time_models(path)  # nothing to be beside
    assert "| 0.90 / 0.50 | - | 6.0 |" in experiments.report_capacity("capacity", path, tmp_path)[1]


def test_students_are_distilled_once_and_evaluated_on_two_seeds(tmp_path, monkeypatch):
    steps, step, rows = [], fac.Distiller.step, []
    short_episodes(monkeypatch)
    monkeypatch.setattr(fac.Distiller, "step", lambda self: (steps.append(1), step(self))[1])
    monkeypatch.setattr(fac.Distiller, "ranks", lambda *_: (np.full(4, 0.5), np.full(4, 0.25)))
    monkeypatch.setattr(fac, "recorded_returns", lambda *_: ([], ""))  # are of whole episodes
    monkeypatch.setattr(fac, "choose_by_playing", lambda distiller, task, taught, plannings, *_: (
        plannings[-2], []))  # narrow
    monkeypatch.setattr(fac, "interleaved_seconds", lambda calls, *_: np.ones((1, len(calls))))
    monkeypatch.setattr(fac, "draw_curve", lambda *_: True)
    monkeypatch.setattr(students, "time_both", lambda *_: {
        "plan_workers": 0, **{f"plan_ms_{who}": 1.0 for who in (
            "expert", "policy", "same_search", "student_in_process", "student")}})
    monkeypatch.setattr(experiments, "run_all", lambda args, function, own: (rows.extend(
        row for run in own for row in runs.attempt(
            functools.partial(experiments.of_same_data, function), run)),
        {"out": tmp_path / "none.csv"})[1])
    for budget in ([], ["--iterations", "1", "--samples", "4"]):  # a copy of the student is there
        assert experiments.main([
            "students", "--tasks", "reacher-easy", "--seeds", "3", "--steps", "1", "--episodes",
            "1", *budget, "--students", str(tmp_path)]) == 0
    experiments.append_rows(path := tmp_path / "students.csv", rows)
    rows = experiments.read_rows(path)
    assert [row["evaluation_seed"] for row in rows] == ["102", "101"] * 2 and len(steps) == 1
    assert [json.loads(row["settings"]).get("samples") for row in rows] == [None, None, 4, 4]
    assert len(experiments.finished(rows)) == 2
    _, header = fac.load_model(tmp_path / "reacher-easy-3" / "student.npz")
    assert header["planner"]["samples"] == 16
    model, header = fac.load_model(tmp_path / "reacher-easy-3-samples-4-iterations-1" /
                                   "student.npz")
    assert (header["seed"], model.config.num_agents, header["distill"]["steps"]) == (3, 3, 1)
    expert, _ = fac.load_model(fac.data_file("reacher-easy", "expert.npz"))
    own, students_own = (fac.PlannerConfig(**of) for of in ({}, {
        **fac.made_for(header, ""), "samples": 4, "iterations": 1}))
    for row in rows[2:]:
        seeds = fac.episode_seeds(int(row["evaluation_seed"]), 1)
        for found, who, planning in (
                (json.loads(row["returns"]), model, students_own),
                (json.loads(row["expert_returns"]), expert, own),
                (json.loads(row["policy_returns"]), expert,
                 dataclasses.replace(own, prior="own", iterations=0)),
                (students.returns(row, "same_search_returns"), expert,
                 dataclasses.replace(students_own, pi_trajs=0))):
            returns = fac.play(who, "reacher-easy", planning, seeds, 0)[2].sum(1)
            np.testing.assert_allclose(found, returns, atol=1e-3)
        assert json.loads(row["ranks"])["rank_correlation_returns"] == [0.25] * 4
        assert row["versions"] == experiments.versions()
        assert f"numpy {np.__version__}" in row["versions"] and "mujoco 3" in row["versions"]
    result = json.loads((tmp_path / "reacher-easy-3" / "result.json").read_text())
    assert (result["eval_seed"], result["samples"]) == (101, 16)
    _, text = experiments.report_alone("alone", path, tmp_path)
    lines = [line.split("|")[1].strip() for line in text.split("\n\n")[1].splitlines()[2:]]
    assert lines == ["reacher-easy", "reacher-easy, samples 4, iterations 1"]


def write_student_rows(path):
    """Two seeds of a default student, one of the paper's, and a budget chosen by flags."""
    def rows(samples=32, iterations=3):
        return [{"step": 9, "return_mean": 7.0, "minutes": 6.0, "evaluation_seed": seed, "ranks": {
            "plan_ms_expert": 9.0, "plan_ms_student_in_process": 2.0, "samples": samples,
            "iterations": iterations}} for seed in (102, 101)]

    own = {"steps": 9, "num_agents": 6}
    full = {**own, "samples": 512, "iterations": 6}
    write_rows(path, [("walker-run", 0, "default", own, rows()),
                      ("walker-run", 1, "default", own, rows()),
                      ("walker-run", 0, "paper", own, rows(512, 6)),
                      ("walker-run", 0, "default", full, rows(512, 6)),
                      ("walker-run", 1, "default", full, rows(512, 6))])


def test_milliseconds_of_students_are_measured_anew_for_each_preset_and_budget(tmp_path,
                                                                               monkeypatch):
    write_student_rows(path := tmp_path / "students.csv")
    write_rows(path, [("cheetah-run", 0, "default", {"num_agents": 6}, [{"step": 1, "ranks": {
        "samples": 32, "iterations": 3, "plan_ms_expert": 7.0}}])])
    before, timed = experiments.read_rows(path), []

    def time_both(expert, student, obs):
        timed.append([(model.config.num_agents, p.samples, p.iterations, p.prior)
                      for model, p in (expert, student)])
        return {"plan_ms_expert": 30.0, "plan_ms_student": float(len(timed)), "speedup": 3.0,
                "plan_ms_student_in_process": 7.0}

    monkeypatch.setattr(students, "time_both", time_both)
    experiments.time_students(path, ["walker-run"])
    assert timed == [[(1, 128, 4, "last"), (6, 32, 3, "own")],
                     [(1, 512, 6, "last"), (6, 512, 6, "last")],
                     [(1, 128, 4, "last"), (6, 512, 6, "own")]]
    for old, new in zip(before, experiments.read_rows(path), strict=True):
        number = {"paper": 2.0}.get(old["case"], 3.0 if '"samples"' in old["settings"] else 1.0)
        found = {"plan_ms_expert": 30.0, "plan_ms_student": number,
                 "plan_ms_student_in_process": 7.0} if old["task"] == "walker-run" else {}
        assert json.loads(new["ranks"]) == {**json.loads(old["ranks"]), **found}
        assert {**old, "ranks": "", "ms": "7" * bool(found),
                "ms_workers": f"{number:.0f}" * bool(found)} == {**new, "ranks": ""}
    experiments.time_students(path, ["walker-run"])
    assert len(timed) == 3  # they are measured
    experiments.time_students(path, ["walker-run", "cheetah-run"])
    assert len(timed) == 3 + 4  # but for one


def test_a_preset_s_students_have_its_budget_and_a_folder_of_their_own(monkeypatch):
    seen = []
    monkeypatch.setattr(experiments, "run_all", lambda args, function, runs: (
        seen.extend(runs), {"out": "none.csv"})[1])
    monkeypatch.setattr(experiments, "time_students", lambda path, tasks: None)
    for flags in ([], ["--preset", "paper"], ["--preset", "paper", "--steps", "14000", "--samples",
                                              "128", "--iterations", "4"]):
        assert experiments.main(["students", "--tasks", "walker-run", "--seeds", "0", *flags]) == 0
    found = [(run["case"], *(json.loads(run["settings"]).get(k) for k in (
        "steps", "samples", "iterations"))) for run in seen]
    assert found == [("default", 7000, None, None), ("paper", 100000, None, None),
                     ("paper", 14000, 128, 4)]
    assert [str(students.folder("runs", "walker-run", 0, preset)) for preset in (
        "default", "paper")] == ["runs/walker-run-0", "runs/walker-run-0-paper"]


def test_returns_of_other_versions_are_said_to_be_old(tmp_path, capsys):
    rows = [{"step": 1, "return_mean": 1.0, "minutes": 1.0}]
    for i, known in enumerate((experiments.versions(), "numpy 1.0", "")):
        write_rows(tmp_path / f"{i}.csv", [("walker-run", 0, "TAP", {}, [
            {**rows[0], "versions": known}])])
        experiments.settled(tmp_path / f"{i}.csv")
    found = capsys.readouterr().err
    assert "0.csv: returns" not in found and "1.csv: returns of numpy 1.0; now numpy" in found
    assert "2.csv: returns of versions that it doesn't name" in found


# watch --------------------------------------------------------------------------------


def test_a_joint_s_samples_narrow_to_its_plan():
    """Which an agent alone makes as well (Proposition 1); rows are in the robot's order."""
    model, config = random_model(), fac.PlannerConfig(samples=64, horizon=2)
    latents = model.latents(np.random.default_rng(0).standard_normal((8, 1), np.float32))
    ranges, plan = look.narrowing(model, latents, config)
    assert ranges.shape == (4, 3, 2) and plan.shape == (3,)
    wide = ranges[..., 1] - ranges[..., 0]
    assert (wide[0] > 1.9).all() and (wide[3] < 0.5 * wide[0]).all()
    assert ((ranges[3, :, 0] - 0.1 < plan) & (plan < ranges[3, :, 1] + 0.1)).all()
    for i in range(3):
        alone = look.narrowing(fac.some_agents(model, i, i + 1), latents[i:i + 1], config)
        np.testing.assert_allclose(alone[0][:, 0], ranges[:, i], atol=1e-3)
        np.testing.assert_allclose(alone[1], plan[i:i + 1], atol=1e-3)
    model.config = dataclasses.replace(model.config, groups="2/0/1")  # whose action is whose
    found = look.narrowing(model, latents, config)
    np.testing.assert_array_equal(found[1], plan[[1, 2, 0]])
    np.testing.assert_array_equal(found[0], ranges[:, [1, 2, 0]])


@pytest.mark.parametrize("iterations", [0, 4])
def test_plans_are_drawn_that_start_as_the_model_s_do(iterations):
    """Around its policy, with hardly any width or no search: the policy's own action."""
    model, obs = random_model(1, policy=True), np.full((8, 1), 0.3, np.float32)
    config = fac.PlannerConfig(iterations=iterations, prior="own", min_std=1e-6, max_std=1e-6,
                               horizon=2)
    ranges, plan = look.narrowing(model, model.latents(obs), config)
    expected = fac.policy_plan(model, obs, 3, model.config)[0, 0, :, 0]
    assert ranges.shape == (iterations, 3, 2)
    np.testing.assert_allclose(plan, expected, atol=1e-4)
    np.testing.assert_allclose(ranges, np.broadcast_to(expected[:, None], ranges.shape), atol=1e-4)


def test_frames_hold_pictures_and_plans():
    pytest.importorskip("PIL")
    size, plan = look.PIXELS, (np.array([[[-1.0, 1.0], [0.5, 1.0]]]), np.array([1.0, -0.5]))
    frames = [(np.full((size, size, 3), 7, np.uint8), plan, 3.0)] * 4
    images = look.draw_frames([(frames, "expert, N = 2", 1.0, 3.0), (frames, "student", 2.0, 3.0)])
    width = size + look.BARS
    assert len(images) == 4 and images[0].size == (2 * width, size + look.TEXT)
    for left in (0, width):
        assert images[0].getpixel((left + 5, 5)) == (7, 7, 7)
        drawn, planned = (left + size + look.BARS * x // 4 for x in (1, 3))

        def color(x, joint, action, image=images[0]):
            return image.getpixel((x, round(size / 2 * (joint + 0.5 - 0.4 * action))))

        assert color(drawn, 0, -0.9) == color(drawn, 1, 0.8) == (153, 153, 153)
        assert color(planned, 0, 1) == color(planned, 1, -0.5) == (31, 119, 180)
        assert color(drawn, 1, 0.3) == color(planned, 0, 0.8) == (255, 255, 255)


@pytest.mark.parametrize("name, task", [("x.gif", "pendulum-swingup"), ("x.mp4", "reacher-easy")])
def test_watch_writes_a_moving_picture(tmp_path, name, task):
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    pytest.importorskip("imageio_ffmpeg" if name == "x.mp4" else "PIL")
    expert, sizes = tmp_path / "expert.npz", fac.lookup_task(task)
    model = fac.WorldModel.create(fac.ModelConfig(*sizes, mlp_dim=8), np.random.default_rng(0))
    fac.save_model(expert, model, {"kind": "expert", "task": task})
    done = run("watch", "--model", expert, "--beside", expert, "--decisions", "4", "--out", name,
               "--json", cwd=tmp_path)
    if "can't draw off-screen" in done.stderr:
        pytest.skip("neither EGL nor OSMesa here")
    result = last_json(done)
    assert result["frames"] == 2 and result["returns"][0] == result["returns"][1]
    assert result["bytes"] == (tmp_path / name).stat().st_size
    if name == "x.mp4":
        assert (tmp_path / name).read_bytes()[4:8] == b"ftyp"
        return
    with image.open(tmp_path / name) as found:
        assert found.n_frames == 2


@pytest.mark.parametrize("flags, parts", [
    (["--model", "none.npz", "--out", "x.gif"], ["none.npz", "no such file"]),
    (["--model", "slow.npz", "--out", "x.gif", "--decisions", "251"], ["250", "251"]),
    (["--model", "slow.npz", "--beside", fac.EXPERTS / "reacher-hard" / "expert.npz", "--out",
      "x.gif"], ["expert.npz: decides every 2 control steps", "slow.npz every 4"]),
    (["--model", "none.npz", "--out", "x.png"], ["x.png", ".gif", ".mp4"])])
def test_watch_refuses(tmp_path, flags, parts):
    pytest.importorskip("matplotlib")
    expert, header = fac.load_model(fac.data_file("reacher-hard", "expert.npz"))
    fac.save_model(tmp_path / "slow.npz", expert, {**header, "action_repeat": 4})
    done = here("watch", *flags, cwd=tmp_path)
    if "can't draw off-screen" in done.stderr:
        pytest.skip("neither EGL nor OSMesa here")
    refused(done, *parts)


# figure9 and agreement ----------------------------------------------------------------


def test_clusters_tell_joints_apart_where_they_are():
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(0)
    before = rng.standard_normal((3, 5, 30))
    z = before + 8 * np.arange(3)[:, None, None]
    tsne, pca, joints, apart, shuffled, first = look.clusters(z, before, rng)
    assert tsne.shape == pca.shape == (90, 2) and joints.tolist() == [0] * 30 + [1] * 30 + [2] * 30
    assert apart > 0.5 > 0.1 > max(abs(shuffled), abs(first))
    assert look.clusters(z[:1], before[:1], rng)[3:] == (None, None, None)  # one agent


def test_credit_is_equation_2_of_what_was_executed():
    model, config = random_model(), fac.PlannerConfig(horizon=2)
    rng = np.random.default_rng(0)
    obs = rng.standard_normal((6, 8)).astype(np.float32)
    actions = rng.uniform(-1, 1, (6, 3)).astype(np.float32)
    found = look.credit(model, obs, actions, config)
    assert found.shape == (3, 4)
    z, expected = model.encode(obs[1:2].T), 0.0
    for h in range(2):
        expected = expected + 0.99 ** h * model.reward(z, actions[1 + h].reshape(3, 1, 1))
        z = model.next(z, actions[1 + h].reshape(3, 1, 1))
    expected = expected + 0.99 ** 2 * sum(model.q(z, actions[3].reshape(3, 1, 1))) / 2
    np.testing.assert_allclose(found[:, 1], expected[:, 0], rtol=1e-4)


def test_turning_points_are_where_returns_change_most():
    returns = np.repeat([0.0, 5.0, -1.0], 100)
    assert look.turning_points(returns) == pytest.approx([100, 200], abs=look.SMOOTH)


def test_agreement_finds_the_joint_that_is_wrong():
    """A student that is its expert agrees; with one agent's Q turned round, that one doesn't."""
    rng = np.random.default_rng(0)
    student = random_model()
    expert = type("Sum", (), {"encode": student.encode, "q": lambda self, z, a: tuple(
        q.sum(0, keepdims=True) for q in student.q(z, a.reshape(3, 1, -1)))})()
    obs = rng.standard_normal((8, 5)).astype(np.float32)
    actions = rng.uniform(-1, 1, (3, 5)).astype(np.float32)
    np.testing.assert_allclose(look.agreement(student, expert, obs, actions, rng), 1, atol=1e-3)
    wrong = fac.WorldModel(student.config, {k: v.copy() for k, v in student.params.items()})
    for name in ("_Q1", "_Q2"):
        wrong.params[f"{name}.5.weight"][1] *= -1
    found = look.agreement(wrong, expert, obs, actions, rng).mean(1)
    np.testing.assert_allclose(found, [1, -1, 1], atol=1e-3)


def test_the_additive_ceiling_is_one_for_a_sum_and_none_for_a_product(monkeypatch):
    rng = np.random.default_rng(0)
    obs = rng.standard_normal((8, 2)).astype(np.float32)
    actions = rng.uniform(-0.5, 0.5, (3, 3, 2)).astype(np.float32)
    ranks, explained = look.additive_ceiling(random_model(), obs, actions, 0.05, 0.99, rng)
    assert ranks.shape == (3, 2) and ranks.min() > 0.99 and explained.min() > 0.98

    def product(model, z, a):  # of what two joints do
        q = (a[:, 0] - actions[:, :1, 0, None]) * (a[:, 1] - actions[:, 1:2, 0, None])
        return 0 * q, q, q
    monkeypatch.setattr(fac, "predict", product)
    found = look.additive_ceiling(random_model(), obs[:, :1], actions[..., :1], 0.3, 0.99, rng)
    assert np.abs(found).max() < 0.3


def test_figure9_and_agreement_draw_a_model(tmp_path, monkeypatch):
    pytest.importorskip("sklearn")
    pytest.importorskip("matplotlib")
    write_expert(tmp_path / "expert.npz")
    student, quick = random_model(), {"samples": 8, "iterations": 1}
    fac.save_model(tmp_path / "student.npz", student, {"kind": "student", "task": "reacher-hard",
                                                       "planner": quick})
    before = look.untrained(student, 3)  # as distillation begins
    fresh = fac.WorldModel.create(student.config, fac.stream(3, "student"))
    for key, value in before.params.items():
        own = fresh if key.startswith("_encoder.") else student
        assert np.array_equal(value, own.params[key]), key
    found = last_json(run("figure9", "--model", "student.npz", "--episodes", "2", "--points", "20",
                          "--json", "--record", "9.csv", cwd=tmp_path))  # draws first in a process
    assert (tmp_path / "9.csv").read_text().splitlines()[:2] == [
        "task,seed,what,number", f"reacher-hard,,silhouette,{found['silhouette']:.2f}"]
    assert found["silhouette"] is not None and set(found["moments"]) == {"best", "worst"}
    assert found["silhouette_untrained"] not in (None, found["silhouette"])
    assert (tmp_path / "figure9.png").read_bytes()[:4] == b"\x89PNG"
    sizes = fac.ModelConfig(*fac.lookup_task("finger-spin"), 2, 4, 8, 8)  # none of the 11
    spin = fac.WorldModel.create(sizes, np.random.default_rng(0))
    fac.save_model(tmp_path / "spin.npz", spin, {"kind": "student", "task": "finger-spin",
                                                 "planner": quick})
    found = last_json(run("figure9", "--model", "spin.npz", "--episodes", "1", "--points", "20",
                          "--json", cwd=tmp_path))
    assert found["task"] == "finger-spin"
    shutil.copy(fac.data_file("reacher-hard", "replay.npz"), tmp_path)  # beside the expert
    monkeypatch.setattr(fac, "CONTROL_STEPS", 100)
    monkeypatch.setattr(fac, "cores", lambda: 0)  # all episodes in this process
    found = last_json(here("agreement", "--model", "student.npz", "--expert", ".",
                           "--episodes", "1", "--states", "8", "--json", "--record", "9.csv",
                           cwd=tmp_path))
    rows = [row.rsplit(",", 1) for row in (tmp_path / "9.csv").read_text().splitlines()[1:]]
    assert len(rows) == 3 + 2 * 3 + 2 * 4  # silhouettes; joints; best sums
    assert f"{found['ceiling'][3]:.2f}" in [row[-1] for row in rows if "H = 3" in row[0]]
    assert len(found["held_out"]) == len(found["worst_episode"]) == 3
    assert np.abs(found["when"]).max() <= 1
    assert len(found["ceiling"]) == 4 and 0.5 < found["ceiling_variance"][0] <= 1
    assert (tmp_path / "agreement.png").exists()
    for name in ("agreement", "figure9"):
        refused(here(name, "--model", "expert.npz", cwd=tmp_path), "expert.npz", "'expert'")
    shutil.copy(fac.data_file("walker-run", "replay.npz"), tmp_path / "other.npz")
    refused(here("agreement", "--model", "student.npz", "--expert", ".", "--replay", "other.npz",
                 cwd=tmp_path), "other.npz", "--replay")
    fac.save_model(tmp_path / "student.npz", student, {"kind": "student", "task": "reacher-hard",
                                                       "data": [1, 2, "reacher-hard"]})
    refused(here("agreement", "--model", "student.npz", "--expert", "expert.npz", cwd=tmp_path),
            "another expert", "--expert")


def test_numbers_of_the_same_are_kept_in_place_of_earlier_ones(tmp_path):
    path, heads = tmp_path / "numbers.csv", ("task", "seed", "what", "number")
    tables.record(path, heads, [("a, b", 0, "x", 1.234), ("c", 1, "x", 5)])
    tables.record(path, heads, [("a, b", 0, "x", 2), ("a, b", 0, "y", 3)])
    assert [*csv.reader(path.read_text().splitlines())] == [
        [*heads], ["c", "1", "x", "5.00"], ["a, b", "0", "x", "2.00"], ["a, b", "0", "y", "3.00"]]


# as the authors' program plans ----------------------------------------------------------


@pytest.mark.parametrize("agents, groups", [(3, ""), (3, "2/0/1"), (1, "")])
def test_agents_choose_among_their_own_parts_of_the_expert_s_rollouts(agents, groups):
    """With one sample and 24 proposals, most elites are parts of what the expert's policy does."""
    expert = random_model(1, policy=True, seed=1)
    student = random_model(agents)
    student.config = dataclasses.replace(student.config, groups=groups)
    config = fac.PlannerConfig(8, 1, pi_trajs=4, horizon=2)
    obs = np.linspace(-1, 1, 8, dtype=fac.F32)
    with baselines.AuthorsPlanner(student, expert, config, seed=3) as planner:
        planner.plan(obs)  # tells it the observation
        planner.reset(5)
        found = planner.proposals(None)
        assert found.shape == (agents, 3, 3 // agents, 4)
        rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(5).spawn(agents)[0]))
        noise = fac.policy_noise((3, 1, 3, 4), rng)
        z = np.repeat(expert.encode(obs[:, None]), 4, 2)
        rolled = fac.policy_rollout(expert, z, noise)[:, 0]  # (L, A, P)
        order = [2, 0, 1] if groups else [0, 1, 2]
        for i, joint in enumerate(order):
            assert (found[i * agents // 3, :, i % (3 // agents)] == rolled[:, joint]).all()


def test_a_student_without_proposals_plans_as_printed():
    expert, student = random_model(1, policy=True, seed=1), random_model()
    config, obs = fac.PlannerConfig(8, 2, pi_trajs=0), np.ones(8)
    with baselines.AuthorsPlanner(student, expert, config) as planner:
        assert (planner.act(obs) == fac.Planner(student, config).act(obs)).all()
    seen = dataclasses.replace(config, pi_trajs=24)
    with baselines.AuthorsPlanner(student, expert, seen) as planner:
        assert (planner.act(obs) != fac.Planner(student, seen).act(obs)).any()


def test_every_way_of_the_authors_program_is_played(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made, played = [], []
    for name, preset in (("reacher-hard-0", "default"), ("reacher-hard-0-plain", "plain")):
        config = fac.DistillConfig(**fac.preset_values(fac.DistillConfig, preset))
        fac.save_model(f"runs/{name}/student.npz", random_model(), {
            "kind": "student", "distill": vars(config), "planner": {"max_std": 0.15}})
    planner = baselines.AuthorsPlanner

    def spy(student, expert, config):
        made.append(config)
        return planner(student, expert, dataclasses.replace(config, samples=8, iterations=1))

    monkeypatch.setattr(experiments, "AuthorsPlanner", spy)
    monkeypatch.setattr(experiments, "returns_by", lambda planner, task, episodes, seed: (
        played.append((episodes, seed)) or [len(played), 1.0]))
    monkeypatch.setattr(experiments, "measure", lambda model, task, config, episodes, *_: {
        "returns": [0.5] * episodes})
    seen = []
    monkeypatch.setattr(experiments, "run_all", lambda args, function, runs: seen.extend(runs))
    assert experiments.main(["authors", "--tasks", "reacher-hard", "--seeds", "0", "--episodes",
                             "2", "--students", "runs"]) == 0
    play = functools.partial(experiments.plan_like_authors, folder="runs")
    experiments.append_rows(path := tmp_path / "authors.csv", [
        row for one in seen for row in runs.attempt(play, one)])
    assert played == [(2, 101), (2, 102)] * 10
    assert {(c.pi_trajs, c.inverse_temperature, c.output) for c in made} == {
        (0, 0.5, "sampled"), (24, 0.5, "sampled"), (0, 1.5, "sampled"), (24, 1.5, "sampled"),
        (24, 1.5, "mean")}
    assert {(c.max_std, c.prior, c.samples, c.iterations) for c in made} == {(2.0, "last", 128, 4)}
    _, text = experiments.report_authors("authors", path, None)
    assert "| reacher-hard, plain | 1 | 0 |" in text and text.count("±") == 10


def test_a_planner_s_returns_are_evaluate_s():
    expert, header = fac.load_model(fac.EXPERTS / "pendulum-swingup" / "expert.npz")
    config = fac.PlannerConfig(**{**fac.made_for(header, "expert"), "samples": 4, "iterations": 1})
    with fac.Planner(expert, config) as planner:
        found = experiments.returns_by(planner, header["task"], 2, 101)
    assert found == fac.evaluate(expert, header["task"], config, 2, 101, 0)["returns"]
