"""The command line as users run it, on a small expert and replay made here."""
import csv
import dataclasses
import errno
import functools
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import fac_tdmpc_ref as fac
from toys import (BUDGET, ONE_THREAD, ROOT, SCRIPT, STEPS, TINY, TRAINING, WATCHED,
                  distill_arguments, here, last_json, launch, random_model, refused, run,
                  student_in, succeeded, write_expert)

KEYS = {"task", "seed", "steps", "seconds", "expert_return_mean", "expert_return_std",
        "student_return_mean", "student_return_std", "episodes", "kl_reward", "kl_value",
        "rank_correlation", "plan_ms_expert", "plan_ms_student", "speedup", "expert_recorded",
        "out"}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """What runs in this process, as well."""
    with fac.one_thread():
        yield


# help ---------------------------------------------------------------------------------


@pytest.mark.parametrize("command, expected", [
    ((), ["distill", "evaluate"]),
    (("distill",), ["--task", "--preset", "--num-agents", "--evaluate-expert", "--plan-samples",
                    "[7000; paper: 100000]", "[forward; paper: reverse]", "reacher-hard"]),
    (("evaluate",), ["--model", "--record", "--samples", "--output", "[4; paper: 6]"])])
def test_help_is_quick_and_starts_nothing(tmp_path, command, expected):
    done = succeeded(launch(["-c", WATCHED, *command, "--help"], tmp_path))
    text = re.sub(r"\s+", " ", done.stdout)
    assert text.startswith("usage: fac_tdmpc_ref.py") and done.stderr == ""
    for part in expected:
        assert part in text
    assert os.listdir(tmp_path) == []


# configuration ------------------------------------------------------------------------


def configs_of(monkeypatch, *arguments):
    """The configs that a command line leads to; nothing is run with them."""
    caught, from_args = [], fac.from_args

    def watched(*args, **defaults):
        caught.append(from_args(*args, **defaults))
        return caught[-1]

    def stop(*_, **__):
        raise fac.UserError("enough")

    monkeypatch.setattr(fac, "from_args", watched)
    monkeypatch.setattr(fac, "load_data", lambda _: (None, {}, None, "x"))
    monkeypatch.setattr(fac, "load_model", lambda _: (None, {}))
    for where, function in ((fac, "read_records"), (fac, "evaluate")):
        monkeypatch.setattr(where, function, stop)
    assert fac.main([str(a) for a in arguments]) == 2
    monkeypatch.undo()
    return tuple(caught)


def test_default_settings_are_those_of_the_dataclasses(monkeypatch):
    assert configs_of(monkeypatch, "distill") == (
        fac.DistillConfig(), fac.PlannerConfig(**fac.STUDENT_PLANNING))
    assert configs_of(monkeypatch, "distill", "--plan-prior", "last")[1:] == (fac.PlannerConfig(),)
    assert configs_of(monkeypatch, "evaluate", "--model", "x") == (fac.PlannerConfig(),)


def test_preset_paper_is_the_paper(monkeypatch):
    config, planner = configs_of(monkeypatch, "distill", "--preset", "paper")
    found = dataclasses.asdict(config)
    expected = {"steps": 100_000, "batch_size": 512, "noise_samples": 10, "horizon": 3,
                "lam": 0.5, "reward_coef": 0.5, "value_coef": 0.1,
                "kl": "reverse", "encoder_input": "observation", "lr": 1e-4,
                "lr_schedule": "constant", "warmup": 0, "grad_clip": 10,
                "noise_std": 0.5, "clip_actions": False,
                "reuse": 1, "expert_episodes": 0, "played_share": 0, "policy_share": 0,
                "targets": "joint", "priors": False}
    assert {k: found[k] for k in expected} == expected
    assert (planner.samples, planner.iterations, planner.num_elites, planner.pi_trajs,
            planner.horizon, planner.discount) == (512, 6, 64, 24, 3, 0.99)
    assert (planner.prior, planner.max_std, planner.output) == ("last", 2.0, "mean")


def test_preset_plain_is_the_paper_s_method_at_our_budget(monkeypatch):
    ours, *_ = configs_of(monkeypatch, "distill")
    config, planner = configs_of(monkeypatch, "distill", "--preset", "plain")
    changed = {k: v for k, v in dataclasses.asdict(config).items() if v != getattr(ours, k)}
    assert changed == {"targets": "joint", "policy_share": 0, "expert_episodes": 0,
                       "played_share": 0, "noise_std": 0.5, "priors": False}
    assert planner == fac.PlannerConfig()


def test_plain_takes_a_preset_that_is_named(monkeypatch):
    for name, flags in (("plain", []), ("paper", ["--preset", "paper"])):
        config, planner = configs_of(monkeypatch, "distill", "--preset", name)
        assert configs_of(monkeypatch, "distill", "--plain", *flags) == (
            dataclasses.replace(config, reuse=1), dataclasses.replace(planner, speed="plain"))


def test_flags_go_before_the_preset(monkeypatch):
    config, *_ = configs_of(monkeypatch, "distill", "--preset", "paper", "--steps", 7, "--kl",
                            "forward")
    assert (config.steps, config.kl, config.batch_size) == (7, "forward", 512)


def another_value(f):
    """Flags that set a field to something else, and that value."""
    flag = f.name.replace("_", "-")
    if isinstance(f.default, bool):
        return [("no-" if f.default else "") + flag], not f.default
    if f.metadata.get("choices"):
        value = next(c for c in f.metadata.get("choices") if c != f.default)
    else:
        value = f.default + 1 if isinstance(f.default, int) else f.default / 2
    return [flag, str(value)], value


@pytest.mark.parametrize("config_class, prefix, start", [
    (fac.DistillConfig, "", ["distill"]), (fac.PlannerConfig, "plan-", ["distill"]),
    (fac.PlannerConfig, "", ["evaluate", "--model", "x"])])
def test_every_flag_reaches_its_setting(monkeypatch, config_class, prefix, start):
    for f in dataclasses.fields(config_class):
        if prefix and f.name == "horizon" or f.name == "action_repeat":
            continue  # distill has one for loss and planning; a model's file says it
        (flag, *rest), value = another_value(f)
        if prefix and f.name == "prior":
            rest, value = ["last"], "last"
        flag = f"--no-{prefix}{flag[3:]}" if flag.startswith("no-") else f"--{prefix}{flag}"
        found = next(c for c in configs_of(monkeypatch, *start, flag, *rest)
                     if isinstance(c, config_class))
        default = config_class(**(fac.STUDENT_PLANNING if prefix and f.name != "prior" else {}))
        assert found == dataclasses.replace(default, **{f.name: value})


def test_interrupt_is_one_line_and_status_130(monkeypatch, capsys):
    def interrupted(args):
        raise KeyboardInterrupt

    monkeypatch.setattr(fac, "command_distill", interrupted)
    assert fac.main(["distill"]) == 130
    assert capsys.readouterr().err.count("\n") == 1


# bad input ----------------------------------------------------------------------------


@pytest.mark.parametrize("flags, parts", [
    (["--task", "reacher-hart"], ["did you mean 'reacher-hard'", *fac.TASKS]),
    (["--task", "walker-walk"], ["expert.npz", "task", "'walker-walk'", "'reacher-hard'"]),
    (["--num-agents", "2"], ["num_agents", "[1, 3]", "not 2"]),
    (["--num-agents", "0"], ["agents", "[1, 3]", "0"]),
    (["--num-agents", "-3"], ["agents", "[1, 3]", "-3"]),
    (["--steps", "0"], ["steps", "at least 1", "0"]),
    (["--batch-size", "9" * 23], ["batch_size", "at most 1000000000"]),
    (["--noise-std", "nan"], ["noise_std", "nan"]),
    (["--lr", "inf"], ["lr", "at most", "inf"]),
    (["--expert-episodes", "1", "--played-share", "0"], ["played_share", "above 0", "not 0.0"]),
    (["--no-priors", "--plan-prior", "own"], ["no prior", "--plan-prior last"]),
    (["--held-out", "1"], ["held_out", "at most 0.5"]),
    (["--horizon", "40"], ["replay.npz", "two episodes of at least 41 actions"]),
    (["--kl", "sideways"], ["--kl", "'sideways'", "forward"]),
    (["--plan-horizon", "0"], ["--plan-horizon"]),
    (["--plan-min-std", "3"], ["min_std", "max_std"]),
    (["--episodes", "0"], ["episodes", "at least 1"]),
    (["--workers", "-1"], ["--workers", "-1"]),
    (["--seed", "-1"], ["--seed", "-1"]),
    (["--eval-seed", "x"], ["--eval-seed", "'x'"]),
    (["--stepz", "3"], ["--stepz"]),
    (["--plan-samples", "512", "--plan-elites", "513"], ["elites", "at most samples (512)"]),
    (["--expert", "none.npz"], ["none.npz", "no such file"]),
    (["--replay", "none.npz"], ["none.npz", "no such file"]),
    (["--replay", "{files}/walker.npz"], ["walker.npz", "(24, 6)", "(8, 3)"]),
    (["--replay", "{files}/expert.npz"], ["expert.npz", "kind", "'expert'"]),
    (["--expert", "{files}/replay.npz"], ["replay.npz", "kind", "'replay'"]),
    (["--expert", "{files}/spoilt.npz"], ["spoilt.json", "rename it"]),  # before it distils
    (["--out", "{files}/corrupt.npz"], ["corrupt.npz", "can't be read or written"]),
    (["--out", "{files}/corrupt.npz/below"], ["corrupt.npz", "can't be read or written"]),
])
def test_distill_refuses(tmp_path, files, flags, parts):
    flags = [flag.format(files=files) for flag in flags]
    refused(here(fac.main, *distill_arguments(files, *flags), cwd=tmp_path), *parts)


@pytest.mark.parametrize("flags", [["--steps", "x"], ["--steps", "0"]])
def test_a_refusal_is_the_process_s_status_and_its_one_line(tmp_path, files, flags):
    """Of argparse, and of what is found later."""
    refused(run(*distill_arguments(files, *flags), cwd=tmp_path), "steps")


def test_too_little_memory_is_one_line(monkeypatch, capsys):
    def allocate(_):
        raise MemoryError("Unable to allocate 2.4 TiB")

    monkeypatch.setattr(fac, "command_distill", allocate)
    assert fac.main(["distill"]) == 2
    assert capsys.readouterr().err == "fac_tdmpc_ref.py: error: Unable to allocate 2.4 TiB\n"


@pytest.mark.parametrize("steps", ["1", "20"])
def test_what_diverges_is_refused_and_leaves_no_weights(tmp_path, files, steps):
    done = run(*distill_arguments(files, "--lr", "1e38", "--warmup", "0", "--steps", steps,
                                  "--out", "run", "--json"), cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == "" and "Traceback" not in done.stderr
    assert "diverged; lower the learning rate (1e+38)" in done.stderr.splitlines()[-1]
    assert "RuntimeWarning" not in done.stderr
    assert not list((tmp_path / "run").glob("*.npz"))


@pytest.mark.parametrize("arguments, parts", [
    ([], ["COMMAND"]),
    (["tarin"], ["'tarin'", "distill"]),
    (["evaluate"], ["--model"]),
    (["evaluate", "--model", "none.npz"], ["none.npz", "no such file"]),
    (["evaluate", "--model", "{files}/corrupt.npz"], ["corrupt.npz", "not a readable .npz"]),
    (["evaluate", "--model", "{files}/replay.npz"], ["replay.npz", "expert or student"]),
    (["evaluate", "--model", "{files}/expert.npz", "--task", "reacher-heart"],
     ["did you mean 'reacher-hard'", *fac.TASKS]),
    (["evaluate", "--model", "{files}/expert.npz", "--task", "hopper-hop"], ["(8, 3)", "(15, 4)"]),
    (["evaluate", "--model", "{files}/expert.npz", "--episodes", "0"], ["episodes", "at least 1"]),
    (["evaluate", "--model", "{files}/expert.npz", "--samples", "8", "--elites", "9"],
     ["elites", "samples (8)", "not 9"]),
    (["evaluate", "--model", "{files}/expert.npz", "--seed", "-1"], ["--seed", "-1"]),
])
def test_other_bad_commands_are_refused(tmp_path, files, arguments, parts):
    refused(here(fac.main, *(a.format(files=files) for a in arguments), cwd=tmp_path), *parts)


def test_a_task_without_data_says_what_to_do(tmp_path):
    task = "acrobot-swingup"
    refused(here(fac.main, "distill", "--task", task, cwd=tmp_path),
            f"train_expert.py --task {task}", "--expert")
    assert os.listdir(tmp_path) == []


def test_a_student_is_no_expert(tmp_path, files, distilled):
    _, folder = distilled
    arguments = distill_arguments(files, "--expert", folder / "student.npz")
    refused(here(fac.main, *arguments, cwd=tmp_path), "student.npz", "kind", "'expert'",
            "'student'")


def test_the_replay_is_the_one_beside_the_expert(tmp_path, files):
    (tmp_path / "expert.npz").write_bytes((files / "expert.npz").read_bytes())
    refused(here(fac.main, "distill", "--expert", tmp_path / "expert.npz", *TINY),
            str(tmp_path / "replay.npz"), "no such file")


# distill ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def distilled(tmp_path_factory, files):
    """A whole run: (finished process, its results' folder)."""
    cwd = tmp_path_factory.mktemp("distilled")
    done = run(*distill_arguments(files, "--workers", "0", "--json"), cwd=cwd, env={})
    return succeeded(done), cwd / "runs" / "reacher-hard-0"


def test_distill_prints_json_and_a_table(distilled):
    done, folder = distilled
    result = last_json(done)
    assert KEYS <= set(result)
    assert (result["task"], result["seed"], result["steps"], result["episodes"]) == (
        "reacher-hard", 0, STEPS, 1)
    assert Path(result["out"]) == Path("runs/reacher-hard-0")
    assert result["expert_recorded"] is False
    assert result["speedup"] == result["plan_ms_expert"] / result["plan_ms_student"]
    for who in ("expert", "student"):
        returns = result[f"{who}_returns"]
        assert len(returns) == 1 and 0 <= returns[0] <= 1000
        assert result[f"{who}_return_mean"] == returns[0]
        assert result[f"{who}_return_std"] == 0
    assert -1 <= result["rank_correlation"] <= 1 and result["kl_reward"] > 0 < result["kl_value"]
    table = done.stdout
    assert "\nthe expert  " in table and ", N = 3, " in table and "±" in table
    assert f"{result['speedup']:.1f}" in table and "speed-up" in table
    assert "horizon 3 and 1" in table and "128 x 4" in table and "16 x 1" in table
    policy = np.mean(result["policy_returns"])
    assert len(result["policy_returns"]) == 1 and f"{policy:.0f} ± 0" in table
    (line,) = [line for line in table.splitlines() if "the student's priors alone" in line]
    ms, experts = result["plan_ms_reflex"], result["plan_ms_expert"]
    assert line.split()[-7:] == [
        "alone", "0", f"{result['reflex_return_mean']:.0f}", "±", "0", f"{ms:.1f}",
        f"{experts / ms:.1f}"]
    header, _ = fac.read_npz(folder / "student.npz", ("student",))
    planning = fac.PlannerConfig(**{**fac.STUDENT_PLANNING, "samples": 16, "iterations": 1})
    assert header["planner"].items() <= vars(planning).items()
    assert {*vars(planning)} - {*header["planner"]} == {
        "horizon", "discount", "speed", "action_repeat"}
    assert [result[name] for name in fac.CHOSEN] == [0.15, 16, 1]
    assert result["played"] == header["played"] == [] and "chosen by" not in table


@pytest.fixture
def quick(files, tmp_path, monkeypatch, capsys):
    """distill in this process and in `out`, with the default search unless flags say otherwise,
    where priors learn to be `taught`, and `chosen` of the plannings is chosen by playing: result,
    student, header, plannings that were tried, (model, planning)s that were evaluated."""
    arguments = distill_arguments(files, "--workers", "0", "--json", "--out", tmp_path / "out")
    own, episodes = arguments.index("--plan-samples"), arguments.index("--expert-episodes")
    arguments[episodes + 1] = 1  # without one, nothing is chosen
    arguments = [str(a) for a in arguments[:own] + arguments[own + 4:]]
    returns = [{"taught": "plans", **dict.fromkeys(fac.CHOSEN, 1), "returns": [2.0]}]

    def distill(*flags, taught=0.5, chosen=-1):
        tried, evaluated = [], []

        def teach(distiller, *_):
            for key, value in fac.prior_weights(distiller.student).items():
                distiller.student.params[key] = value * 0 + taught
            return {"policy": fac.prior_weights(distiller.student)}

        def choose(distiller, task, taught, plannings, workers):
            tried.extend(plannings)
            assert [*taught] == ["policy"]
            return plannings[chosen], returns

        def compare(each, *_):
            evaluated.append(each["student"])
            return {"episodes": 1, "eval_seed": 0, "expert_horizon": 0, "student_horizon": 0,
                    "kept": None}, [("",)]

        with monkeypatch.context() as patch:
            for name, stands in {
                    "teach_priors": taught and teach, "choose_by_playing": taught and choose,
                    "play": None, "learn_priors": None,
                    "expert_episodes": lambda *_: (np.zeros((1, 30, 8)), np.zeros((1, 30, 3))),
                    "draw_curve": lambda *_: True, "compare": compare,
            }.items():
                patch.setattr(fac, name, stands)
            assert fac.main([*arguments, *flags]) == 0, capsys.readouterr().err
        student, header = fac.load_model(tmp_path / "out" / "student.npz")
        result = json.loads(capsys.readouterr().out.splitlines()[-1])
        return result, student, header, tried, evaluated

    return distill


@pytest.mark.parametrize("flags, tried", [
    ([], [(0.15, 16, 0), (0.15, 16, 1), (1.0, 32, 3)]),
    (["--plan-max-std", "0.3"], [(0.3, 16, 0), (0.3, 16, 1), (0.3, 32, 3)]),
    (["--plan-min-std", "0.1"], [(0.15, 16, 0), (0.15, 16, 1), (1.0, 32, 3)]),
    (["--plan-samples", "8"], [(0.15, 8, 0), (0.15, 8, 1), (1.0, 8, 3)]),
    (["--plan-iterations", "1"], [(0.15, 16, 1), (1.0, 32, 1)]),
    (["--plan-iterations", "3", "--plan-max-std", "1"], [(1.0, 16, 3), (1.0, 32, 3)]),
    (["--plan-samples", "8", "--plan-iterations", "1", "--plan-max-std", "0.5"], [(0.5, 8, 1)]),
    (["--plan-elites", "20", "--plan-samples", "24"],
     [(0.15, 24, 0), (0.15, 24, 1), (1.0, 24, 3)])])
def test_searches_that_flags_leave_are_tried_cheapest_first(quick, flags, tried):
    """And the one that is chosen is the student's, here, in its file and where it is evaluated."""
    chosen = len(tried) // 2
    result, _, header, found, evaluated = quick(*flags, chosen=chosen)
    assert [tuple(getattr(of, name) for name in fac.CHOSEN) for of in found] == tried
    rest = [{k: v for k, v in vars(of).items() if k not in fac.CHOSEN} for of in found]
    assert all(of == rest[0] for of in rest) and rest[0]["prior"] == "own"
    ((_, planning),) = evaluated
    assert planning == found[chosen] == fac.PlannerConfig(**fac.made_for(header, "student"))
    assert [result[name] for name in fac.CHOSEN] == [*tried[chosen]]
    assert result["played"] == header["played"] and len(result["played"]) == 1


@pytest.mark.parametrize("flags", [
    ["--no-priors"], ["--preset", "plain", "--expert-episodes", "0"]])
def test_students_without_priors_plan_from_the_last_plan(quick, flags):
    """Nothing is chosen by playing, and no prior learned."""
    result, student, header, tried, evaluated = quick(*flags, taught=None)
    assert tried == [] == result["played"] and student.config.prior_steps == 0
    ((learner, planning),) = evaluated
    assert planning == fac.PlannerConfig(horizon=1) and header["planner"]["prior"] == "last"
    assert planning == fac.PlannerConfig(**fac.made_for(header, "student"))
    assert not fac.prior_weights(student) and not fac.prior_weights(learner)


def test_a_first_run_with_priors_plans_around_them(quick):
    with pytest.raises(AssertionError, match="--plan-prior last: expected --no-priors"):
        quick("--plan-prior", "last")


def test_a_finished_run_given_again_reads_its_priors_and_its_choice(quick, tmp_path):
    """And plays nothing to find them; flags go before the choice."""
    first = quick(chosen=1)
    written = (tmp_path / "out" / "student.npz").read_bytes()
    again = quick(taught=None)  # whatever teaches or chooses is gone
    assert (tmp_path / "out" / "student.npz").read_bytes() == written
    ((learner, planning),) = again[4]
    priors = fac.prior_weights(learner)
    assert priors and all((value == 0.5).all() for value in priors.values())
    assert planning == first[4][0][1] and (planning.samples, planning.iterations) == (16, 1)
    assert again[0]["played"] == first[0]["played"] == first[2]["played"] == again[2]["played"]
    ((_, planning),) = quick("--plan-max-std", "0.5", taught=None)[4]
    assert [getattr(planning, name) for name in fac.CHOSEN] == [0.5, 16, 1]
    ((_, planning),) = quick("--plan-prior", "last", taught=None)[4]
    assert planning == fac.PlannerConfig(horizon=1)
    assert (tmp_path / "out" / "student.npz").read_bytes() == written  # as it was chosen


def test_evaluate_plans_a_student_as_it_was_chosen(quick, tmp_path, monkeypatch):
    """With --prior last by the planner's own defaults: its search was around priors."""
    seen = []
    _, _, _, tried, _ = quick(chosen=1)
    monkeypatch.setattr(fac, "evaluate", lambda model, task, planning, *_: (
        seen.append(planning), {"returns": [0.0], "plan_ms_median": 0.0})[1])
    for flags in ([], ["--samples", "7"], ["--prior", "last"]):
        fac.main(["evaluate", "--model", str(tmp_path / "out" / "student.npz"), *flags])
    assert seen == [tried[1], dataclasses.replace(tried[1], samples=7),
                    fac.PlannerConfig(horizon=1)]


def test_flags_of_a_search_need_one(quick, tmp_path, monkeypatch, capsys):
    """A student that acts by its priors would leave them unused, without a word."""
    quick(chosen=0)
    model = ["evaluate", "--model", str(tmp_path / "out" / "student.npz"), "--episodes", "1"]
    monkeypatch.setattr(fac, "evaluate", lambda model, task, planning, *_: {
        "returns": [planning.samples * planning.iterations], "plan_ms_median": 0.0})
    assert fac.main([*model, "--samples", "7"]) == 2
    assert "without a search; flags of one need --iterations" in capsys.readouterr().err
    assert fac.main([*model, "--samples", "7", "--iterations", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["returns"] == [14]
    assert fac.main([*model, "--iterations", "0"]) == 0


def test_part_one_alone_distils_and_goes_on_from_its_end(tmp_path, files, short_episodes):
    """--plain: the loop and the planner that Part I reads; given again it is evaluated alone."""
    arguments = distill_arguments(files, "--plain", "--workers", "0", "--json")
    first, second = (last_json(here(fac.main, *arguments, cwd=tmp_path)) for _ in range(2))
    assert first["student_returns"] == second["student_returns"] and first["kl_value"] > 0
    header, _ = fac.read_npz(tmp_path / "runs/reacher-hard-0/student.npz", ("student",))
    assert header["distill"]["targets"] == "joint" and header["distill"]["reuse"] == 1
    assert header["planner"]["prior"] == "last"
    refused(here(fac.main, *arguments, "--targets", "credit", cwd=tmp_path), "--plain",
            "without --targets")


def no_more(*_, **__):
    raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))


@pytest.mark.parametrize("what", ["multiprocessing.util.spawnv_passfds", "os.pipe",
                                  "multiprocessing.connection.Pipe"])
def test_where_no_process_can_be_started_none_is_needed(tmp_path, files, capsys, monkeypatch,
                                                        short_episodes, what):
    """At a limit of processes or of open files: --workers 0 asks for none."""
    monkeypatch.setattr(fac, "cores", lambda: 2)
    monkeypatch.setattr(what, no_more)
    arguments = [*map(str, distill_arguments(files, "--out", tmp_path / "out", "--workers"))]
    assert fac.main([*arguments, "2"]) == 2
    assert "no process can be started" in (line := capsys.readouterr().err.splitlines()[-1])
    assert "--workers 0" in line and "limit" in line
    assert fac.main([*arguments, "0"]) == 0
    assert (tmp_path / "out" / "result.json").exists()


def test_where_no_thread_can_be_started_it_is_said_in_a_line(tmp_path, files, capsys, monkeypatch):
    def refuse(*_, **__):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    arguments = distill_arguments(files, "--out", tmp_path / "out", "--workers", "0")
    assert fac.main([*map(str, arguments)]) == 2
    assert "error: can't start new thread" in capsys.readouterr().err.splitlines()[-1]
    monkeypatch.undo()
    monkeypatch.setattr(fac.Distiller, "step", lambda _: {}["a mistake"])
    with pytest.raises(KeyError):
        fac.main([*map(str, arguments)])


def test_timings_take_turns_and_count_the_second_call_of_each(monkeypatch):
    """One that takes 9 seconds after the other's call and 1 after its own, and one that takes 2."""
    clock, called, takes = [0.0], [], {"a": [9, 1] * 3, "b": [2] * 6}

    def call(name):
        called.append(name)
        clock[0] += takes[name].pop(0)

    monkeypatch.setattr(fac.time, "perf_counter", lambda: clock[0])
    calls = [lambda name=name: call(name) for name in "ab"]
    assert fac.interleaved_seconds(calls, 3, "timing").tolist() == [[1, 2]] * 3
    assert "".join(called) == "aabb" * 3


def test_distill_shows_its_progress(distilled):
    done, _ = distilled
    for part in ("distilling", "loss", "KL reward", "value", "step/s", "evaluating the student",
                 "evaluating the expert"):
        assert part in done.stderr
    assert "Traceback" not in done.stderr and "Warning" not in done.stderr


@pytest.mark.skipif(not importlib.util.find_spec("matplotlib"), reason="no matplotlib")
@pytest.mark.parametrize("broken", [False, True])
def test_a_picture_costs_no_result(tmp_path, files, broken):
    """A notebook's backend and a user's LaTeX are theirs; what else goes wrong is said."""
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\n")
    (tmp_path / "at" / "matplotlib").mkdir(parents=True)
    (tmp_path / "at" / "matplotlib" / "__init__.py").write_text("raise OSError('no\\nhome')")
    env = {"MPLBACKEND": "module://nobody_has.this", "MATPLOTLIBRC": str(tmp_path / "matplotlibrc"),
           "PATH": "/nowhere", **({"PYTHONPATH": str(tmp_path / "at")} if broken else {})}
    done = run(*distill_arguments(files, "--out", "out", "--workers", "0"), cwd=tmp_path,
               env={**ONE_THREAD, **env})
    assert "return kept" in succeeded(done).stdout
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["picture"] == (not broken) == (tmp_path / "out" / "curve.png").exists()
    assert ("curve.png: no picture: no home\n" in done.stderr) == broken


def test_the_time_of_all_is_that_of_distilling_and_more(tmp_path, files, short_episodes):
    """Of a run that is given again, or was cut off, too."""
    arguments = *distill_arguments(files, "--out", "out", "--workers", "0"), "--json"
    first = last_json(here(fac.main, *arguments, cwd=tmp_path))
    assert first["seconds_total"] >= first["seconds"]
    header, arrays = fac.read_npz(path := tmp_path / "out" / "checkpoint.npz", ("checkpoint",))
    fac.write_npz(path, {**header, "seconds": 5000.0}, arrays)
    again = last_json(here(fac.main, *arguments, cwd=tmp_path))
    assert 5000 <= again["seconds"] < again["seconds_total"] < 5000 + 120


@pytest.mark.parametrize("closed", ["2>&-", ">&-", "<&- >&- 2>&-"])
def test_streams_may_be_closed(tmp_path, files, closed):
    """As by a daemon: files are written, by workers' work, too; a fault is still a status of 2."""
    def shell(*arguments):
        command = f'"$0" "$@" {closed}'
        return subprocess.run(["sh", "-c", command, sys.executable, *map(str, arguments)],
                              cwd=tmp_path, env={**os.environ, **ONE_THREAD}, timeout=120,
                              capture_output=True, text=True)

    (tmp_path / "expert.npz").write_bytes((files / "expert.npz").read_bytes())
    done = shell(SCRIPT, "evaluate", "--model", "expert.npz", "--episodes", "2", "--workers", "1",
                 "--record", *BUDGET)
    assert done.returncode == 0, done.stderr
    assert len(fac.read_records(tmp_path / "expert.npz")) == 1
    done = shell(SCRIPT, "evaluate", "--model", "none.npz")
    assert done.returncode == 2 and "Error" not in done.stdout + done.stderr


@pytest.mark.parametrize("program", ["manipulator_demo.py", *(f"data/{name}.py" for name in (
    "experiments", "export_golden", "import_expert", "train_expert"))])
def test_programs_find_this_module_under_pythonsafepath(tmp_path, program):
    code = (f"import runpy, sys; sys.argv = ['x', '--help']\n"
            f"try: runpy.run_path({str(ROOT / program)!r}, run_name='__main__')\n"
            f"except SystemExit as end: assert not end.code\n"
            f"assert sys.modules['fac_tdmpc_ref'].__file__ == {str(SCRIPT)!r}")
    succeeded(launch(["-c", code], tmp_path, {"PYTHONSAFEPATH": "1"}))


def test_a_folder_whose_name_is_not_ascii(tmp_path, files):
    """Under a locale that can't say it, too."""
    (folder := tmp_path / "h\u00e9 \u5b66" / "data").mkdir(parents=True)
    for path in (SCRIPT, ROOT / "data" / "reacher.xml"):
        (folder.parent / path.relative_to(ROOT)).write_bytes(path.read_bytes())
    for name in ("expert", "replay"):
        (folder / f"{name}.npz").write_bytes((files / f"{name}.npz").read_bytes())
    for env in ({}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}):
        done = launch([folder.parent / SCRIPT.name, "evaluate", "--model", folder / "expert.npz",
                       "--episodes", "1", "--workers", "1", *BUDGET], tmp_path,
                      {**ONE_THREAD, "PYTHONIOENCODING": "", **env})
        assert "reacher-hard" in succeeded(done).stdout


def test_numpy_may_be_set_to_raise(tmp_path, files):
    """And Python's warnings to errors: planning and distilling go on where an exp underflows."""
    expert, _ = fac.load_model(files / "expert.npz")
    for key in expert.params:
        expert.params[key] = 40 * expert.params[key]
    config = fac.DistillConfig(steps=4, batch_size=4, horizon=1, held_out=0.34, expert_episodes=0,
                               lr=1e-6)
    with np.errstate(all="raise"), warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        fac.Planner(expert, fac.PlannerConfig(samples=8)).act(np.full(8, 1e3))
        distiller = fac.Distiller(expert, fac.Replay(files / "replay.npz"), config)
        for _ in distiller.run():
            pass
        distiller.ranks(8, 0.99)
        fac.teach_priors(distiller, None, fac.PlannerConfig(samples=8))
        distiller.close()
        assert fac.compact(np.array([[1e9], [1.0]])).dtype == np.float32
        with pytest.raises(FloatingPointError):  # the caller's setting stays
            np.exp(np.float32(-1e3))


def on_standard_input(code):
    """What a script with a small model prints."""
    model = ("import numpy as np, fac_tdmpc_ref as fac\n"
             "model = fac.WorldModel.create(fac.ModelConfig(8, 3, 3, 4, 8, 8), "
             "np.random.default_rng(0))\n")
    return succeeded(subprocess.run(
        [sys.executable, "-"], input=model + code, capture_output=True, text=True, cwd=ROOT,
        timeout=60, env={**os.environ, **ONE_THREAD})).stdout


def test_a_script_on_standard_input_may_have_workers():
    assert on_standard_input(
        "with fac.Planner(model, fac.PlannerConfig(samples=8), workers=1) as planner:\n"
        "    print(planner.act(np.zeros(8)).shape)\n") == "(3,)\n"


def test_under_a_debugger_a_process_that_cannot_start_is_one_line():
    """pdb's __main__ has no __spec__."""
    printed = on_standard_input("del __spec__\n"
                                "try:\n"
                                "    fac.Planner(model, workers=1)\n"
                                "except fac.UserError as error:\n"
                                "    print(error)\n")
    assert "pass workers=0" in printed and printed.count("\n") == 1


def test_progress_goes_to_whatever_stands_for_stderr(monkeypatch):
    written = []
    for stream in (None, SimpleNamespace(write=written.append, flush=lambda: None)):
        monkeypatch.setattr(sys, "stderr", stream)
        with fac.progress("playing", 3, "decision") as bar:
            bar.update(3)
    assert "playing" in "".join(written)


def test_distill_writes_its_results_and_nothing_else(distilled):
    done, folder = distilled
    pictures = ["curve.png"] if importlib.util.find_spec("matplotlib") else []
    assert sorted(os.listdir(folder)) == sorted(
        ["checkpoint.npz", "config.json", "curve.csv", "result.json", "student.npz", *pictures])
    assert os.listdir(folder.parents[1]) == ["runs"]
    assert json.loads((folder / "result.json").read_text()) == last_json(done)

    model, header = fac.load_model(folder / "student.npz")
    assert model.config.num_agents == 3 and (header["kind"], header["task"]) == (
        "student", "reacher-hard")
    with np.load(folder / "student.npz") as file:  # nothing of its expert's but the encoder
        assert {key.split(".")[0] for key in file.files} == {
            "header", "_encoder", "_dynamics", "_reward", "_Q1", "_Q2", "_expert_encoder",
            "_prior_encoder", "_prior"}
    config = json.loads((folder / "config.json").read_text())
    assert config["distill"]["steps"] == STEPS and config["planner"]["samples"] == 16
    assert config["num_agents"] == 3 and config["seed"] == 0
    fac.from_dict(fac.DistillConfig, config["distill"], "config.json")
    fac.from_dict(fac.PlannerConfig, config["planner"], "config.json")


def test_the_curve_is_a_table_of_numbers(distilled):
    done, folder = distilled
    with open(folder / "curve.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == fac.CURVE
    steps = [int(row["step"]) for row in rows]
    assert steps == sorted(set(steps)) and len(steps) > 1 and steps[-1] == STEPS
    assert np.isfinite([[float(v) for v in row.values()] for row in rows]).all()
    assert abs(float(rows[-1]["kl_reward"]) - last_json(done)["kl_reward"]) < 1e-5


def test_the_student_differs_from_its_start(distilled, files):
    """Guards the comparisons of weights below: training did change them."""
    weights, header = student_in(distilled[1])
    expert, _ = fac.load_model(files / "expert.npz")
    config = fac.from_dict(fac.DistillConfig, header["distill"], "student")
    distiller = fac.Distiller(expert, fac.Replay(files / "replay.npz"), config)
    try:
        changed = {k for k, v in distiller.student.params.items() if v.tobytes() != weights[k]}
    finally:
        distiller.close()
    for network in ("_encoder", "_dynamics", "_reward", "_Q1", "_Q2", "_prior_encoder", "_prior"):
        assert f"{network}.0.weight" in changed
    assert not [k for k in changed if k.startswith("_expert")]


def test_the_same_command_gives_the_same_student(tmp_path, files, distilled, no_plots):
    """Bit for bit, in another folder, with other numbers of processes and of BLAS threads."""
    done = run(*distill_arguments(files, "--workers", "1", "--json", "--out", "here"),
               cwd=tmp_path, env=no_plots)
    first, again = last_json(distilled[0]), last_json(done)
    assert student_in(tmp_path / "here") == student_in(distilled[1])
    for key in ("student_returns", "expert_returns", "kl_reward", "kl_value",
                "rank_correlation_by_step", "rank_correlation_returns"):
        assert again[key] == first[key]
    assert Path(again["out"]) == Path("here")


# going on after a crash ---------------------------------------------------------------

# `distill` with a checkpoint after every third row of the curve (the clock strides), a made-up
# evaluation, and a SIGKILL before step argv[1]: nothing gets to clean up.
DRIVER = f"""
import itertools, os, signal, sys, time, types
sys.path.insert(0, {str(ROOT)!r})
import fac_tdmpc_ref as fac
clock = itertools.count()
fac.time = types.SimpleNamespace(monotonic=lambda: 7.0 * next(clock),
                                 perf_counter=time.perf_counter)
fac.evaluate = lambda *_, **__: {{"returns": [1.0]}}
stop, step = int(sys.argv[1]), fac.Distiller.step
def step_or_die(self):
    if self.t == stop:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self)
fac.Distiller.step = step_or_die
sys.exit(fac.main(sys.argv[2:]))
"""


def rows_without_seconds(path):
    with open(path, newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def driven(files, env, out, *more, stop=-1):
    return launch(["-c", DRIVER, stop, *distill_arguments(files, "--out", out, *more)], out.parent,
                  env)


@pytest.fixture(scope="module")
def killed_once(tmp_path_factory, files, no_plots):
    out = tmp_path_factory.mktemp("killed") / "out"
    assert driven(files, no_plots, out, stop=3).returncode == -signal.SIGKILL
    assert sorted(os.listdir(out)) == ["checkpoint.npz", "curve.csv"]
    with np.load(out / "checkpoint.npz") as file:
        assert file["step"] == 1  # so that two steps are taken twice
    return out


@pytest.fixture
def killed(tmp_path, files, no_plots, killed_once):
    """A folder whose run was killed half way, and a function that goes on there."""
    out = shutil.copytree(killed_once, tmp_path / "out")
    return out, functools.partial(driven, files, no_plots, out)


def test_a_killed_run_goes_on_as_if_nothing_had_been(killed, distilled):
    out, distill = killed
    first = distill(stop=5)  # and once more, later
    assert first.returncode == -signal.SIGKILL
    assert not (out / "student.npz").exists()
    succeeded(distill())
    assert student_in(out) == student_in(distilled[1])
    assert rows_without_seconds(out / "curve.csv") == rows_without_seconds(
        distilled[1] / "curve.csv")
    assert (out / "result.json").exists()
    before = student_in(out), (out / "curve.csv").read_bytes()
    succeeded(distill("--episodes", "2", stop=0))  # it is over: nothing begins again
    assert (student_in(out), (out / "curve.csv").read_bytes()) == before


def test_a_killed_run_whose_expert_plays_goes_on(tmp_path, files, no_plots, distilled):
    """The expert's episodes depend on the seed alone, whoever plays them [D8]."""
    def distill(out, *more, stop=-1):
        return driven(files, no_plots, tmp_path / out, "--expert-episodes", "2", *more, stop=stop)

    told = succeeded(distill("whole", "--workers", "0")).stdout
    assert "chosen by playing 1 episodes of the run's own seeds" in told
    for stop in (3, 5):
        assert distill("parts", "--workers", "2", stop=stop).returncode == -signal.SIGKILL
    with np.load(tmp_path / "parts" / "checkpoint.npz") as file:
        assert file["played"].shape == (2 * fac.EPISODE_STEPS, 8 + 3)  # states and actions
        assert file["lengths"].tolist() == [fac.EPISODE_STEPS] * 2
    succeeded(distill("parts", "--workers", "1"))
    assert student_in(tmp_path / "parts") == student_in(tmp_path / "whole")
    assert student_in(distilled[1])[0] != student_in(tmp_path / "whole")[0]  # without its episodes


@pytest.mark.parametrize("flags, parts", [
    (["--seed", "1"], ["seed: expected 1, found 0"]),
    (["--num-agents", "1"], ["num_agents: expected 1, found 3"]),
    (["--noise-std", "0.25"], ["noise_std: expected 0.25, found 0.3"]),
    (["--expert", "{files}/other.npz"], ["(data"]),
    (["--replay", "{files}/longer.npz"], ["(data"]),
    (["--replay", "{files}/named.npz"], ["(data"]),
    (["--expert", "{files}/wider.npz"], ["(data"])])
def test_a_checkpoint_with_other_settings_is_refused(killed, files, capsys, flags, parts):
    """In this process: nothing is trained or evaluated before the refusal."""
    out, _ = killed
    before = (out / "checkpoint.npz").read_bytes()
    arguments = distill_arguments(files, "--out", out, *(f.format(files=files) for f in flags))
    assert fac.main([str(a) for a in arguments]) == 2
    message = capsys.readouterr().err.splitlines()[-1]
    for part in ("checkpoint.npz", "other settings", "--out", *parts):
        assert part in message
    assert (out / "checkpoint.npz").read_bytes() == before


def test_an_expert_s_own_elites_are_not_its_student_s(files, tmp_path, capsys, short_episodes):
    """Table 2's 64 of 512 are more than a student's 32 samples."""
    model, header = fac.load_model(files / "expert.npz")
    fac.save_model(path := tmp_path / "expert.npz", model, {
        **header, "planner": {"samples": 512, "elites": 64, "min_std": 0.2}})
    arguments = distill_arguments(files, "--out", tmp_path / "run", "--expert", path, "--workers",
                                  "0")
    assert fac.main([str(a) for a in arguments]) == 0, capsys.readouterr().err
    planner = json.loads((tmp_path / "run" / "config.json").read_text())["planner"]
    assert (planner["elites"], planner["min_std"]) == (0, 0.05)


def test_a_finished_run_is_not_replaced_by_one_with_other_settings(distilled, files, capsys):
    folder = distilled[1]
    before = {path: path.read_bytes() for path in folder.iterdir()}
    arguments = distill_arguments(files, "--lr", "1e-4", "--out", folder)
    assert fac.main([str(a) for a in arguments]) == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert ("student.npz: a run with other settings (distill: lr: expected 0.0001, found 0.001)"
            in message)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("name", ["config.json", "result.json", "curve.csv", "curve.png"])
def test_another_program_s_files_are_not_replaced(tmp_path, files, capsys, name):
    (tmp_path / name).write_text("an hour's work")
    assert fac.main([str(a) for a in distill_arguments(files, "--out", tmp_path)]) == 2
    assert f"{name}: not this run's" in capsys.readouterr().err.splitlines()[-1]
    assert [path.read_text() for path in tmp_path.iterdir()] == ["an hour's work"]


HOLDER = """
import sys, time
sys.path[:0] = [sys.argv[1]]
import fac_tdmpc_ref as fac
with fac.locked(sys.argv[2]):
    print("locked", flush=True)
    time.sleep(100)
"""


def test_two_runs_into_one_folder_do_not_both_begin(tmp_path, files, capsys):
    """Whatever the first was; one that was killed leaves no lock."""
    import import_expert
    import train_expert
    expert, out = str(files / "expert.npz"), str(tmp_path / "out")
    runs = [(fac.main, distill_arguments(files, "--task", "reacher-hard", "--workers", "0")),
            (train_expert.main, [*TRAINING, "--minutes", "1e-9"]),
            (import_expert.main, [expert, "--task", "reacher-hard"])]
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, ROOT, out], stdout=subprocess.PIPE)
    assert holder.stdout.readline() == b"locked\n"
    for main, arguments in runs:
        assert main([str(a) for a in (*arguments, "--out", out)]) == 2
        message = capsys.readouterr().err.splitlines()[-1]
        assert f"error: {out}: another run is writing into it" in message and "--out" in message
        assert not os.listdir(out)
    holder.kill()
    holder.communicate()
    for i, (main, arguments) in enumerate(runs):
        free = f"{out}{i}" if i else out
        assert main([str(a) for a in (*arguments, "--out", free)]) == 0 and os.listdir(free)


@pytest.mark.skipif(not os.path.exists("/proc/self"), reason="no folder in which nobody may write")
def test_a_folder_that_nobody_can_write_into_is_missed_before_the_work(files, capsys):
    assert fac.main([str(a) for a in distill_arguments(files, "--out", "/proc/self")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "/proc/self/...: can't be written: " in line


@pytest.mark.parametrize("missing", ["fcntl", "the disk's locks"])
def test_where_there_are_no_locks_a_run_goes_on(tmp_path, monkeypatch, missing):
    import fcntl
    if missing == "fcntl":
        monkeypatch.setitem(sys.modules, "fcntl", None)
    else:
        monkeypatch.setattr(fcntl, "flock", lambda *_: os.close(-1))  # an OSError
    with fac.locked(tmp_path / "a" / "b"), fac.locked(tmp_path / "a" / "b"):
        assert os.listdir(tmp_path / "a") == ["b"]


# evaluate and the record of the expert ------------------------------------------------


def test_what_is_kept_is_the_student_s_return_by_the_expert_s(monkeypatch):
    monkeypatch.setattr(fac, "evaluate", lambda *_: {"returns": [4.0, 8.0]})
    args = SimpleNamespace(task="x", episodes=2, eval_seed=0, workers=0, evaluate_expert=False)
    sizes = SimpleNamespace(dim_obs=3)
    planned = SimpleNamespace(has_policy=False, config=sizes), fac.PlannerConfig()
    monkeypatch.setattr(fac, "recorded_returns", lambda path, model, *_: (
        [9.0, 15.0, 99.0] if model is planned[0] else [], {}))
    monkeypatch.setattr(fac, "Planner", lambda *_: SimpleNamespace(act=print))
    monkeypatch.setattr(fac, "interleaved_seconds", lambda *_: np.array([[4, 1], [6, 3], [8, 2]]))
    each = {"expert": planned, "student": (None, planned[1])}
    found, rows = fac.compare(each, "expert.npz", args)
    assert rows[1][0] == "the expert (recorded with other versions)"
    assert (found["plan_ms_expert"], found["plan_ms_student"], found["speedup"]) == (6000, 2000, 3)
    assert (found["kept"], found["expert_return_std"], found["student_return_std"]) == (0.5, 3, 2)
    assert fac.return_kept(3, 0) is fac.return_kept(3, -1) is None  # nothing to keep


def test_distill_compares_with_the_expert_s_policy_and_the_student_s_priors():
    own = fac.PlannerConfig(horizon=2, discount=0.5)
    expert = random_model(1, policy=True), own
    around = fac.PlannerConfig(**fac.STUDENT_PLANNING, elites=5, horizon=1)
    found = fac.compared(expert, (None, around))
    assert [*found] == ["expert", "policy", "reflex", "student"]
    alone = fac.dataclasses.replace(around, iterations=0)
    assert found["reflex"] == (None, alone)
    assert found["policy"] == (expert[0], fac.dataclasses.replace(own, prior="own", iterations=0))
    assert [*fac.compared(expert, (None, alone))] == ["expert", "policy", "student"]
    assert [*fac.compared(expert, (None, own))] == ["expert", "policy", "student"]
    assert [*fac.compared((random_model(1), own), (None, own))] == ["expert", "student"]


def test_what_stops_several_workers_is_said_once(tmp_path, distilled):
    done = run("evaluate", "--model", distilled[1] / "student.npz", "--episodes", "2",
               "--workers", "2", cwd=tmp_path, env={**ONE_THREAD, "MUJOCO_GL": "garbage"})
    assert done.returncode == 2 and "MUJOCO_GL" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr and done.stderr.count("error:") == 1


def test_a_model_that_names_no_task_needs_one(tmp_path, distilled, capsys):
    model, header = fac.load_model(distilled[1] / "student.npz")
    fac.save_model(tmp_path / "student.npz", model, {"kind": "student",
                                                     "distill": header["distill"]})
    assert fac.main(["evaluate", "--model", str(tmp_path / "student.npz")]) == 2
    assert "student.npz: header: no task; pass --task" in capsys.readouterr().err


def test_evaluation_does_not_depend_on_the_number_of_workers(tmp_path, distilled):
    student = distilled[1] / "student.npz"
    command = ["evaluate", "--model", student, "--episodes", "2", "--seed", "3", "--json", *BUDGET]
    found = [last_json(here(fac.main, *command, "--workers", workers, cwd=tmp_path))
             for workers in (0, 1, 2)]
    assert last_json(run(*command, cwd=tmp_path, env={**ONE_THREAD, "TQDM_DISABLE": "1"})
                     )["returns"] == found[0]["returns"]
    for result in found:
        assert {"return_mean", "return_std", "returns", "plan_ms_median", "episodes"} <= set(result)
        assert (result["episodes"], len(result["returns"])) == (2, 2)
        assert result["returns"] == found[0]["returns"]
        assert result["return_mean"] == np.mean(result["returns"])
        assert result["return_std"] == np.std(result["returns"])
        assert result["plan_ms_median"] > 0
    assert os.listdir(tmp_path) == []


def test_returns_that_are_no_whole_numbers_add_up_alike(tmp_path):
    write_expert(tmp_path / "walker.npz", "walker-walk", (24, 6))
    command = ["evaluate", "--model", "walker.npz", "--episodes", "1", "--json", *BUDGET]
    found = [last_json(here(fac.main, *command, "--workers", workers, cwd=tmp_path))["returns"]
             for workers in (0, 1)]
    assert found[0] == found[1] and found[0][0] % 1


@pytest.mark.parametrize("discount", [0.9, "0.9", 2])
def test_models_plan_with_the_discount_they_were_trained_with(tmp_path, files, capsys, discount):
    """Expert, student, and both again by `evaluate`; a flag goes before it."""
    model, header = fac.load_model(files / "expert.npz")
    fac.save_model(tmp_path / "expert.npz", model, {**header, "training": {"discount": discount}})
    seen, evaluate = [], fac.evaluate
    arguments = distill_arguments(files, "--expert", tmp_path / "expert.npz", "--out",
                                  tmp_path / "out")
    evaluations = [["evaluate", "--model", tmp_path / path] for path in ("expert.npz",
                                                                         "out/student.npz")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fac, "evaluate", lambda model, task, planning, *_, **__: (
            seen.append(planning.discount), {"returns": [1.0], "plan_ms_median": 1.0})[1])
        if discount != 0.9:
            for command in (arguments, evaluations[0]):
                assert fac.main([str(a) for a in command]) == 2
                message = capsys.readouterr().err.splitlines()[-1]
                assert "expert.npz: header: " in message
                assert "discount" in message and message.endswith(repr(discount))
            return
        for command in (arguments, *evaluations, [*evaluations[0], "--discount", "0.5"]):
            assert fac.main([str(a) for a in command]) == 0
    assert seen == [0.9] * 6 + [0.5] and evaluate is fac.evaluate  # four in distill


def test_recorded_returns_stand_for_the_expert_in_distill(tmp_path, files, no_plots, monkeypatch,
                                                          capsys):
    """Also: a single agent, no --json, and no matplotlib."""
    expert = tmp_path / "expert.npz"
    write_expert(expert)
    done = run("evaluate", "--model", expert, "--task", "reacher-hard", "--episodes", "2",
               "--workers", "1", "--record", "--json", cwd=tmp_path)
    measured = last_json(done)
    ((key, (returns, versions)),) = fac.read_records(expert).items()
    assert returns == measured["returns"] and versions == fac.software()
    assert "evaluation seed 0" in key and "samples=128" in key

    arguments = distill_arguments(files, "--expert", expert, "--num-agents", "1", "--out", "out")
    done = succeeded(run(*arguments, "--workers", "0", cwd=tmp_path, env=no_plots))
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["expert_recorded"] is True
    assert result["expert_returns"] == measured["returns"][:1]
    assert "the expert (recorded)" in done.stdout and ", N = 1, " in done.stdout
    assert "evaluating the expert" not in done.stderr
    assert "curve.png: no picture: this needs matplotlib: pip install" in done.stderr
    assert not (tmp_path / "out" / "curve.png").exists()
    with pytest.raises(ValueError):
        json.loads(done.stdout.splitlines()[-1])

    record = expert.with_suffix(".json")
    record.write_text(json.dumps({key: {"returns": returns, "versions": {"numpy": "1.0"}}}))
    done = succeeded(run(*arguments, "--workers", "0", cwd=tmp_path, env=no_plots))
    assert "expert (recorded with other versions)" in done.stdout

    labels = []

    def evaluate(*arguments):
        labels.append(arguments[-1])
        return {"returns": [123.0]}

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fac, "evaluate", evaluate)
    assert fac.main([str(a) for a in (*arguments, "--evaluate-expert", "--json")]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["expert_recorded"] is False and result["expert_returns"] == [123.0]
    assert labels == [f"evaluating {label}" for label in fac.COMPARED.values()]


def test_expert_and_student_plan_over_the_horizon_they_were_made_for(tmp_path, files, monkeypatch,
                                                                     capsys):
    """And the table says which; a flag of `evaluate` goes before."""
    seen, timed, planner = [], [], fac.Planner
    monkeypatch.setattr(fac, "Planner", lambda model, config, **more: (
        timed.append(config.horizon), planner(model, config, **more))[1])
    monkeypatch.setattr(fac, "evaluate", lambda model, task, planning, *_: (
        seen.append(planning.horizon), {"returns": [1.0], "plan_ms_median": 1.0})[1])
    arguments = distill_arguments(files, "--horizon", "2", "--out", tmp_path)
    assert fac.main([str(a) for a in arguments]) == 0
    out = capsys.readouterr().out
    assert "horizon 3 and 2" in out
    assert timed[:2] == [2, 3]
    evaluation = ["evaluate", "--model", str(tmp_path / "student.npz")]
    assert fac.main(evaluation) == fac.main([*evaluation, "--horizon", "0"]) == 0
    assert seen == [3, 3, 2, 2, 2, 0]  # expert, student, each in more ways; evaluate twice


def test_a_terminal_without_plus_minus_gets_its_table(tmp_path, files):
    done = run("evaluate", "--model", files / "expert.npz", "--episodes", "1", "--workers", "0",
               "--horizon", "0", *BUDGET, cwd=tmp_path, env={**ONE_THREAD, "PYTHONIOENCODING":
                                                             "ascii"})
    assert " ? " in succeeded(done).stdout


def test_a_record_counts_for_its_own_weights_planner_and_episodes_only(tmp_path):
    path, model, config = tmp_path / "expert.npz", random_model(), fac.PlannerConfig()
    assert fac.read_records(path) == {}
    fac.record_returns(path, model, config, 5, [1.0, 2.0])
    fac.record_returns(path, model, config, 5, [3.0, 5.0])  # replaces it
    fac.record_returns(path, model, config, 5, [6.0])  # doesn't: it holds less
    fac.record_returns(path, model, fac.PlannerConfig(samples=7), 5, [4.0])
    keys = [fac.record_key(*which) for which in (
        (model, config, 5), (model, fac.PlannerConfig(samples=7), 5), (model, config, 6),
        (model, fac.PlannerConfig(output="mean"), 5), (random_model(seed=1), config, 5),
        (model, fac.PlannerConfig(action_repeat=4), 5))]
    found = fac.read_records(path)
    assert [found.pop(key, None) for key in keys] == [
        ([3.0, 5.0], fac.software()), ([4.0], fac.software()), *[None] * 4]
    assert not found


def test_jobs_of_an_array_record_all_their_seeds(tmp_path):
    """At the same time, and in the program that has the folder."""
    path, about = tmp_path / "expert.npz", (random_model(), fac.PlannerConfig())
    path.touch()
    with fac.locked(tmp_path), ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda seed: fac.record_returns(path, *about, seed, [float(seed)]),
                      range(40)))
    assert len(fac.read_records(path)) == 40


@pytest.mark.parametrize("name, recorded", [(250 * "n", True), (83 * "\u8d70", True),
                                            (251 * "n", False)])
def test_a_record_beside_a_long_name_is_kept_or_refused_before_the_episodes(
        tmp_path, capsys, monkeypatch, name, recorded):
    write_expert(tmp_path / "expert.npz")
    path = (tmp_path / "expert.npz").rename(tmp_path / f"{name}.npz")
    monkeypatch.setattr(fac, "evaluate", lambda *_: {"returns": [7.0], "plan_ms_median": 1.0})
    flags = ["evaluate", "--model", str(path), "--record"]
    assert fac.main(flags) == (0 if recorded else 2)
    out, err = capsys.readouterr()
    assert ("reacher-hard" in out) == recorded and ("File name too long" in err) == (not recorded)
    assert [returns for returns, _ in fac.read_records(path).values()] == [[7.0]] * recorded


def test_returns_that_cannot_be_recorded_are_told(files, capsys, monkeypatch):
    def full(*_):
        raise fac.UserError("full")

    monkeypatch.setattr(fac, "evaluate", lambda *_: {"returns": [7.0], "plan_ms_median": 1.0})
    monkeypatch.setattr(fac, "record_returns", full)
    assert fac.main(["evaluate", "--model", str(files / "expert.npz"), "--record"]) == 2
    assert "7 \u00b1 0" in capsys.readouterr().out


def test_a_record_of_other_versions_gives_way_to_a_shorter_one_of_these(tmp_path):
    path, about = tmp_path / "expert.npz", (random_model(), fac.PlannerConfig(), 5)
    path.with_suffix(".json").write_text(json.dumps({fac.record_key(*about): {
        "returns": [1.0, 2.0], "versions": {}}}))
    assert list(fac.read_records(path).values()) == [([1.0, 2.0], {})]
    fac.record_returns(path, *about, [3.0])
    assert list(fac.read_records(path).values()) == [([3.0], fac.software())]


@pytest.mark.parametrize("text", ["{", "[3]", '"x"', '{"a": 1}', '{"a": ["x"]}', '{"a": {}}',
                                  '{"a": {"returns": [1], "versions": 2}}',
                                  '{"layers": [256, 256]}'])  # a user's settings
def test_a_spoilt_record_is_named(tmp_path, text):
    (tmp_path / "expert.json").write_text(text)
    with pytest.raises(fac.UserError, match="expert.json: not what evaluate --record writes"):
        fac.read_records(tmp_path / "expert.npz")


# the README -------------------------------------------------------------------------


def test_the_readme_distils_an_expert_of_one_s_own(tmp_path, monkeypatch):
    """Its commands and code, on a checkpoint in the official form and 20 short episodes."""
    torch = pytest.importorskip("torch")
    import import_expert
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    fac.save_model("official.npz", fac.WorldModel.create(fac.ModelConfig(24, 6), rng, policy=True),
                   {"kind": "expert"})
    _, weights = fac.read_npz("official.npz", ("expert",))
    torch.save({"model": {key: torch.tensor(value) for key, value in weights.items()}}, "model.pt")
    np.savez("data.npz", observation=rng.standard_normal((180, 24)),
             action=rng.uniform(-1, 1, (180, 6)), continues=np.arange(180) % 9 < 8)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    command = "import_expert.py model.pt --task walker-walk --out mine --collect 20"
    assert command in text and "--replay FILE" in text
    arguments = command.replace("--collect 20", "--replay data.npz").split()[1:]
    assert import_expert.main(arguments) == 0
    *_, written = re.findall(r"```python\n(.*?)```", text, re.S)
    assert "dim_obs=4, dim_action=2" in written
    _, arrays = fac.read_npz("mine/replay.npz", ("replay",))
    weights = torch.load("model.pt")["model"]
    written = written.replace("gym:MODULE:ID", "walker-walk")
    exec(written.replace("dim_obs=4, dim_action=2", "dim_obs=24, dim_action=6"), {
        "fac": fac, "weights": weights, "o": arrays["observation"], "a": arrays["action"],
        "c": arrays["continues"]})
    expert, header, replay, _ = fac.load_data(fac.make_parser().parse_args(
        ["distill", "--task", "walker-walk", "--expert", "mine"]))
    assert fac.made_for(header, "expert.npz") == {"discount": 0.99}
    assert len(replay.ends) == 20
    np.testing.assert_array_equal(expert.params["_pi.0.bias"][0, :, 0], weights["_pi.0.bias"])
