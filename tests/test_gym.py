"""Gymnasium's robots: their actions, ends and lengths, Equation 1 beyond an end, the commands."""
import contextlib
import csv
import json
import os

import numpy as np
import pytest

import experiments
import fac_tdmpc_ref as fac
import import_expert
import multitask
import train_expert
from toys import (BLOCKED, EQUATION_1, ONE_THREAD, ROOT, SCRIPT, assert_close, last_json, launch,
                  refused, small_batch, small_learner, succeeded, write_expert)

pytest.importorskip("gymnasium")
WALK, STROLL = "gym:gym_toys:Walk-v0", "gym:gym_toys:Stroll-v0"
SMALL = ["--latent-dim", "6", "--enc-dim", "8", "--mlp-dim", "16", "--batch-size", "8",
         "--plan-samples", "8", "--plan-iterations", "1", "--plan-pi-trajs", "2", "--workers", "1"]
DISTILL = ["--steps", "8", "--batch-size", "4", "--expert-episodes", "2", "--plan-samples", "8",
           "--plan-iterations", "1", "--episodes", "2", "--workers", "0", "--held-out", "0.3"]


def fallen(seed):
    """The episode's length that Walk's seed stands for."""
    robot = fac.make_robot(WALK)
    robot.reset(seed)
    return int(robot.env.unwrapped.left)


# the robot ----------------------------------------------------------------------------


@pytest.mark.parametrize("repeat", [1, 2])
def test_actions_are_scaled_to_the_robot_s_bounds_and_repeated(repeat):
    robot = fac.make_robot(STROLL, repeat)
    assert (robot.dim_obs, robot.dim_action, robot.episode_steps) == (3, 2, 12 // repeat)
    robot.reset(0)
    for action, expected in ((-1, [-2, 0]), (1, [2, 10]), (0, [0, 5]), (0.5, [1, 7.5])):
        action, told = np.full(2, action, np.float32), robot.env.unwrapped.told
        before = action.copy()
        obs, reward, over, _ = fac.robot_step(robot, action, robot, 0)
        assert np.array_equal(told[-repeat:], [expected] * repeat)
        assert (reward, over) == (repeat, False) and np.array_equal(action, before)
        assert obs.dtype == np.float32 and obs is not robot.env.unwrapped.state


def test_a_state_and_the_time_end_an_episode_apart():
    """A robot's third and fourth value; what is left of a repeated action isn't done."""
    for task, repeat, decisions, state_did in ((WALK, 1, 2, True), (WALK, 4, 1, True),
                                               (STROLL, 1, 12, False), (STROLL, 5, 3, False)):
        robot = fac.make_robot(task, repeat)
        robot.reset(next(seed for seed in range(99) if task == STROLL or fallen(seed) == 2))
        for t in range(decisions):
            _, reward, over, terminated = fac.robot_step(robot, np.zeros(2), robot, t)
            assert over == (t == decisions - 1) and terminated == (over and state_did)
        assert reward == {4: 2, 5: 2}.get(repeat, 1)
    assert fac.make_robot("gym:gym_toys:Endless-v0").episode_steps == 1000


def test_episodes_are_as_long_as_the_robot_says_in_processes_too():
    model = fac.WorldModel.create(fac.ModelConfig(3, 2, 2, 2, 4, 4), np.random.default_rng(0))
    config, seeds = fac.PlannerConfig(samples=2, iterations=1, action_repeat=1), [3, 5, 8]
    lengths = [fallen(seed) for seed in seeds]
    assert len(set(lengths)) > 1
    alone, beside = (fac.play(model, WALK, config, seeds, workers) for workers in (0, 2))
    assert alone[2].sum(1).tolist() == lengths and alone[2].shape == (3, max(lengths))
    assert all(np.array_equal(x, y, equal_nan=True) for x, y in zip(alone[:3], beside))
    found = fac.evaluate(model, WALK, config, 4, 0, 0)
    assert found["returns"] == [fallen(seed) for seed in fac.episode_seeds(0, 4)]
    assert np.isfinite(found["plan_ms_median"])


def test_a_robot_that_only_one_process_can_hold_is_played():
    model = fac.WorldModel.create(fac.ModelConfig(3, 2, 2, 2, 4, 4), np.random.default_rng(0))
    config = fac.PlannerConfig(samples=2, iterations=1, action_repeat=1)
    for _ in range(2):  # which closes it
        found = fac.evaluate(model, "gym:gym_toys:Port-v0", config, 2, 0, 0)
        assert found["returns"] == [fallen(seed) for seed in fac.episode_seeds(0, 2)]


@pytest.mark.parametrize("workers, error", [(0, RuntimeError), (1, fac.WorkerError)])
def test_what_a_robot_raises_is_shown_with_its_lines(workers, error, capfd):
    model = fac.WorldModel.create(fac.ModelConfig(3, 2, 2, 2, 4, 4), np.random.default_rng(0))
    config = fac.PlannerConfig(samples=2, iterations=1, action_repeat=1)
    with pytest.raises(error) as caught:
        fac.evaluate(model, "gym:gym_toys:Hot-v0", config, 1, 0, workers)
    assert "motor 3 overheated" in str(caught.value) + capfd.readouterr().err


def test_a_robot_s_end_that_raises_costs_no_episode(capsys):
    model = fac.WorldModel.create(fac.ModelConfig(3, 2, 2, 2, 4, 4), np.random.default_rng(0))
    config = fac.PlannerConfig(samples=2, iterations=1, action_repeat=1)
    found = fac.evaluate(model, "gym:gym_toys:Stuck-v0", config, 2, 0, 0)
    assert found["returns"] == [fallen(seed) for seed in fac.episode_seeds(0, 2)]
    assert "Stuck-v0: close: RuntimeError('motor off failed')" in capsys.readouterr().err


def test_a_robot_s_own_folder_and_prints_are_not_the_command_s(tmp_path):
    """Files that the user names are below ours; JSON is the last line, and begins one."""
    elsewhere = "gym:gym_toys:Elsewhere-v0"
    robot, home = fac.make_robot(elsewhere), os.getcwd()
    for act in (lambda: robot.reset(0), lambda: robot.step(np.zeros(2)), robot.close):
        act()
        assert os.getcwd() == home and robot._ask(os.getcwd) == robot.env.unwrapped.folder
    env = {**ONE_THREAD, "PYTHONPATH": str(ROOT / "tests"), "PYTHONUNBUFFERED": ""}
    (tmp_path / "mine").mkdir()
    write_expert(tmp_path / "mine" / "expert.npz", elsewhere, (3, 2))
    budget = ["--episodes", "2", "--plan-samples", "4", "--plan-iterations", "1", "--workers"]
    small = [flag.replace("--plan-", "--") for flag in budget]
    commands = [
        [SCRIPT, "evaluate", "--model", "mine/expert.npz", "--record", *small, "0"],
        [ROOT / "data" / "import_expert.py", "mine/expert.npz", "--task", elsewhere, "--collect",
         "8", "--out", "out"],
        [SCRIPT, "distill", "--task", elsewhere, "--expert", "out", "--out", "student",
         "--batch-size", "4", "--steps", "4", *budget, "1"],
        [ROOT / "data" / "train_expert.py", *SMALL[:-2], "--task", elsewhere, "--envs", "1",
         "--steps", "12", "--seed-decisions", "12", "--out", "trained", "--evaluate-episodes", "1",
         *budget[:2], "--workers", "1"]]
    for command in commands:
        assert isinstance(last_json(launch([*command, "--json"], tmp_path, env)), dict)
    assert {"mine/expert.json", "out/replay.npz", "student/result.json", "trained/expert.npz"} <= {
        str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")}


def test_a_module_that_data_hides_is_refused(tmp_path, monkeypatch):
    (tmp_path / "own_robot.py").touch()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(fac.UserError, match="own_robot.py may be imported instead; give your"):
        fac.make_robot("gym:own_robot:Walk-v0")


def test_no_record_speaks_for_a_robot_that_may_be_another_by_now(tmp_path, monkeypatch):
    model = fac.WorldModel.create(fac.ModelConfig(3, 2, 1, 2, 4, 4), np.random.default_rng(0))
    config = fac.PlannerConfig(samples=2, iterations=1, action_repeat=1)
    fac.record_returns(path := tmp_path / "x.npz", model, config, 0, [99.0, 99.0])
    measured = [fallen(seed) for seed in fac.episode_seeds(0, 2)]
    args = fac.make_parser().parse_args(["distill", "--task", WALK, "--episodes", "2",
                                         "--workers", "0"])
    both = (model, config), (model, config)
    found, _ = fac.compare(fac.compared(*both), path, args)
    assert (found["expert_returns"], found["expert_recorded"]) == (measured, False)
    header = {"kind": "expert", "task": WALK, "planner": {"samples": 2}}
    assert multitask.teacher_returns(model, header, path, 2, 0) == measured


def test_a_gym_task_s_action_is_applied_once_unless_told_otherwise():
    assert (fac.make_robot(WALK).action_repeat, fac.make_robot("reacher-easy").action_repeat) == (
        1, 2)
    assert fac.made_for({"task": WALK}, "x") == {"action_repeat": 1}
    assert fac.made_for({"task": WALK, "action_repeat": 4}, "x") == {"action_repeat": 4}
    assert fac.made_for({"task": "reacher-easy"}, "x") == {}


# Equation 1 beyond an end -------------------------------------------------------------


def test_two_decisions_by_hand():
    """Q is 5 in the moving averages, gamma 0.9, rewards 1 and 2: where the second state ended the
    episode its target is 2, where the time did 2 + 0.9 * 5."""
    learner = small_learner(np.random.default_rng(0))
    for name in ("_Q1", "_Q2"):
        learner.target.params[f"{name}.5.weight"][:] = 0
        learner.target.params[f"{name}.5.bias"][:] = 5
    from numpy_learner import td_targets
    obs, reward = np.zeros((2, 4, 2)), np.array([[1.0, 1.0], [2.0, 2.0]])
    buffer = train_expert.ReplayBuffer(4, 2, 100, steps=2)
    for terminated in (True, False):
        buffer.add(np.zeros((3, 4)), np.zeros((2, 2)), [1, 2], terminated)
    continues = buffer.continues((np.array([0, 1]), np.array([0, 0])), 2)
    assert continues.tolist() == [[1, 1], [0, 1]]
    _, td = td_targets(learner.model, learner.target, obs, reward, np.zeros((2, 4)),
                       0.9 * continues.astype(float))
    assert np.allclose(td, [[5.5, 5.5], [2.0, 6.5]])


@pytest.mark.parametrize("dtype, tolerance", [(np.float64, 1e-9), (np.float32, 2e-3)])
def test_updates_beyond_an_end_are_pytorch_s(dtype, tolerance):
    pytest.importorskip("torch")
    from torch_learner import TorchLearner, torch
    ours = small_learner(np.random.default_rng(3), dtype)
    theirs = TorchLearner(fac.WorldModel(ours.model.config, {
        k: v.copy() for k, v in ours.model.params.items()}), EQUATION_1, "cpu")
    for key, value in ours.target.params.items():
        theirs.target[key].copy_(torch.tensor(value))
    for t in range(5):
        rng = np.random.default_rng(t)
        batch, continues = small_batch(rng, dtype=dtype), (rng.random((3, 4)) < 0.5).astype(dtype)
        found = ours.update(*batch, np.random.default_rng(t), continues)
        expected = theirs.update(*batch, np.random.default_rng(t), continues)
        assert_close(np.array(found), np.array(expected), 10 * tolerance)
        if not t:  # not what is learned where all goes on
            again = small_learner(np.random.default_rng(3), dtype)
            assert again.update(*batch, np.random.default_rng(t))[2] != found[2]
    for key, value in ours.model.params.items():
        assert_close(value, np.asarray(theirs.model.params[key]), tolerance)


def test_a_learner_s_value_where_the_state_ended_is_the_reward():
    """Of an episode that is always the same, Q of its decision: 1 where the state ended it, above
    5 (10 in the end) where only the time did."""
    def value(terminated):
        learner, rng = small_learner(np.random.default_rng(1), np.float32), np.random.default_rng(2)
        buffer = train_expert.ReplayBuffer(4, 2, 10, steps=1)
        buffer.add(np.ones((2, 4)), np.zeros((1, 2)), [1.0], terminated)
        learner.config = train_expert.ExpertConfig(horizon=1, discount=0.9, lr=3e-3, tau=0.1,
                                                   value_coef=1.0)
        for _ in range(600):
            *batch, where = buffer.sample(rng, 8, 1)
            learner.update(*batch, rng, buffer.continues(where, 1))
        z = learner.model.encode(np.ones((4, 1), np.float32))
        return learner.model.q(z, np.zeros((1, 2, 1), np.float32))[0].item()

    assert abs(value(True) - 1) < 0.1 and value(False) > 5


def test_training_tells_the_learner_which_states_ended_an_episode(monkeypatch):
    args = train_expert.make_parser().parse_args(["--task", WALK, *SMALL])
    training, seen = train_expert.Training(args, *train_expert.read_settings(args)), []
    assert args.steps == 30_000  # 625 rounds of 4 x 12
    args.task, args.steps = "gym:Pendulum-v1", None
    train_expert.read_settings(args)
    assert args.steps == 38 * 4 * 200
    training.buffer.add(np.zeros((4, 3)), np.zeros((3, 2)), np.zeros(3), True)
    monkeypatch.setattr(training.learner, "update",
                        lambda *batch: seen.append(batch[-1]) or [0.0] * 3)
    training.learn()
    assert seen[0].tolist() == [[1] * 8, [1] * 8, [0] * 8] and seen[0].dtype == np.float32


# the buffer ---------------------------------------------------------------------------


def filled(buffer, rng, episodes):
    """Adds episodes of 1 to 20 decisions, whose rows are numbered; returns all that were added."""
    added = []
    for _ in range(episodes):
        n, first = int(rng.integers(1, 21)), 100.0 * buffer.count
        rows = first + np.arange(n + 1.0)
        added.append((rows, bool(rng.integers(2))))
        buffer.add(rows[:, None] * [1, 2], rows[:-1, None] / 1e5, rows[:-1], added[-1][1])
    return added


def held(buffer):
    return [(buffer.observation[b:b + n + 1, 0].astype(float), bool(t)) for b, n, t in zip(
        buffer.begins, buffer.lengths, buffer.terminated)]


@pytest.mark.parametrize("seed", range(5))
def test_a_buffer_of_episodes_of_any_length_holds_the_newest(seed):
    rng = np.random.default_rng(seed)
    buffer, added = train_expert.ReplayBuffer(2, 1, 100, steps=20), []
    for _ in range(40):
        added += filled(buffer, rng, 1)
        kept = held(buffer)
        assert buffer.count == len(added) and len(kept) == len(buffer) >= 1
        for (rows, terminated), (found, ended) in zip(added[-len(kept):], kept, strict=True):
            assert np.array_equal(rows, found) and terminated == ended  # whole, oldest first
        lost = added[:-len(kept)]
        assert sum(len(rows) for rows, _ in kept) >= (65 if lost else 0)  # of 105 rows


def test_segments_are_drawn_evenly_and_end_with_their_episode():
    rng = np.random.default_rng(0)
    buffer = train_expert.ReplayBuffer(2, 1, 60, steps=20)
    for n, terminated in ((2, True), (3, True), (9, False), (20, True)):
        rows = 100.0 * buffer.count + np.arange(n + 1.0)
        buffer.add(rows[:, None] * [1, 2], rows[:-1, None] / 1e5, rows[:-1], terminated)
    obs, action, reward, (episode, start) = where = buffer.sample(rng, 5200, 3)
    assert np.array_equal(obs[0, 0], 100 * episode + start)
    assert np.array_equal(obs[:, 0], obs[0, 0] + np.arange(4)[:, None])
    assert np.array_equal(reward, obs[:3, 0]) and np.allclose(action[:, 0], reward / 1e5)
    drawn = np.unique(obs[0, 0], return_counts=True)
    assert drawn[0].tolist() == [100, *range(200, 207), *range(300, 318)]  # 26 starts
    assert 140 < drawn[1].min() < drawn[1].max() < 260
    continues = buffer.continues(where[3], 3)
    ends = np.isin(obs[1:, 0], (103, 320))  # not 209: there only the time was over
    assert np.array_equal(continues, 1 - ends) and 0 < ends.sum() < ends.size
    with pytest.raises(fac.UserError, match="no episode has the 21 decisions"):
        buffer.sample(rng, 1, 21)


def test_a_buffer_goes_on_from_its_state_and_writes_whole_episodes(tmp_path):
    first, second = (train_expert.ReplayBuffer(2, 1, 100, steps=20) for _ in range(2))
    filled(first, np.random.default_rng(1), 30)
    np.savez(tmp_path / "state.npz", **first.state())
    with np.load(tmp_path / "state.npz") as file:
        second.load(dict(file))
    for buffer in (first, second):
        filled(buffer, np.random.default_rng(2), 9)
    assert first.count == second.count == 39
    ours, theirs = (buffer.sample(np.random.default_rng(3), 50, 3) for buffer in (first, second))
    assert all(np.array_equal(x, y) for x, y in zip(ours[:3], theirs[:3]))
    first.write(tmp_path / "replay.npz", {"task": WALK})
    replay = fac.Replay(tmp_path / "replay.npz")
    whole = np.concatenate([rows for rows, _ in held(first)])
    assert np.allclose(replay.observation[:, 0], whole, rtol=1e-3)
    assert np.diff(np.r_[-1, replay.ends]).tolist() == [len(rows) for rows, _ in held(first)]
    assert not replay.action[replay.ends].any() and replay.action.any()


# refusals -----------------------------------------------------------------------------

REFUSALS = [("gym:gym_toys:Discrete-v0", ["actions: expected a flat Box", "Discrete(3)"]),
            ("gym:gym_toys:Dict-v0", ["observations: expected a flat Box", "Dict('a'"]),
            ("gym:gym_toys:Image-v0", ["observations: expected a flat Box", "(8, 8, 3)"]),
            ("gym:gym_toys:Empty-v0", ["actions: expected a flat Box"]),
            ("gym:gym_toys:Unbounded-v0", ["finite bounds", "RescaleAction"]),
            ("gym:gym_toys:Whole-v0", ["expected floats"]),
            ("gym:gym_toys:Older-seed-v0", ["its first step: TypeError", "argument 'seed'"]),
            ("gym:gym_toys:Older-reset-v0", ["its first step: ValueError", "(seed=..., options"]),
            ("gym:gym_toys:Older-step-v0", ["its first step: ValueError", "expected 5, got 4"]),
            ("gym:gym_toys:Older-reward-v0", ["its first step: TypeError", "reward is a number"]),
            ("gym:CartPole-v1", ["Discrete(2)", "gymnasium.wrappers"]),
            ("gym:Pendulun-v1", ["Pendulun", "Did you mean", "Pendulum"]),
            ("gym:Reacher-v2", ["gymnasium-robotics"]),
            ("gym:no_such_module:X-v0", ["No module named 'no_such_module'"]),
            ("gym:", ["Malformed environment ID"])]


@pytest.mark.parametrize("task, parts", REFUSALS)
def test_what_is_no_robot_for_this_is_refused_in_one_line(task, parts, tmp_path, capsys):
    for call in (lambda: fac.main(["distill", "--task", task, "--out", str(tmp_path)]),
                 lambda: train_expert.main(["--task", task, "--out", str(tmp_path)])):
        assert call() == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert task in line and all(part in line for part in parts)
    assert not list(tmp_path.iterdir())


def test_what_draws_says_that_it_is_for_others(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    model = fac.WorldModel.create(fac.ModelConfig(3, 2, 2, 2, 4, 4), np.random.default_rng(0))
    fac.save_model(tmp_path / "model.npz", model, {"kind": "student", "task": WALK})
    for command, out in (("watch", "x.gif"), ("figure9", "x.png"), ("agreement", "x.png")):
        assert experiments.main([command, "--model", str(tmp_path / "model.npz"), "--out",
                                 str(tmp_path / out)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{WALK}: expected a task of dm_control" in line or (
            command == "watch" and "can't draw off-screen" in line)


def test_without_gymnasium_all_else_works_and_the_extra_is_named(tmp_path):
    (tmp_path / "gymnasium.py").write_text(BLOCKED)
    env = {**ONE_THREAD, "PYTHONPATH": str(tmp_path)}
    for program, arguments in ((SCRIPT, ["distill"]), (ROOT / "data" / "train_expert.py", [])):
        refused(launch([program, *arguments, "--task", "gym:Pendulum-v1"], tmp_path, env),
                "pip install 'fac-tdmpc-ref[gym]'", program=program.name)
        succeeded(launch([program, *arguments, "--help"], tmp_path, env))
    code = "import fac_tdmpc_ref as fac; fac.make_robot('reacher-easy').reset(0); import sys; " \
           "assert not {'gymnasium', 'gym_robot'} & set(sys.modules)"
    succeeded(launch(["-c", code], tmp_path, {**ONE_THREAD, "PYTHONPATH": str(ROOT)}))


# the commands -------------------------------------------------------------------------


def last(capsys):
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_robot_that_falls_is_learned_imported_distilled_and_played(tmp_path, capsys):
    """Rounds of as many decisions as any robot's, in which its episodes follow each other; the
    same with two workers; the last one of a round is cut off, and no end of its own."""
    command = ["--task", WALK, *SMALL, "--steps", "96", "--envs", "2", "--seed-decisions", "24",
               "--updates-per-step", "0.25", "--evaluate-every", "24", "--evaluate-episodes", "2",
               "--episodes", "2", "--student", "fac", "--distill-batch-size", "8", "--json"]
    found = []
    for workers in ("1", "2"):
        out = tmp_path / workers
        assert train_expert.main([*command, "--workers", workers, "--out", str(out)]) == 0
        found.append((last(capsys), fac.load_model(out / "expert.npz")))
    (result, (expert, header)), (_, (other, _)) = found
    assert all(np.array_equal(v, other.params[k]) for k, v in expert.params.items())
    assert (result["steps"], result["updates"], header["action_repeat"]) == (96, 24, 1)
    assert result["returns"] == [fallen(seed) for seed in fac.episode_seeds(0, 2)]
    with open(tmp_path / "1" / "curve.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["decisions"]) for row in rows] == [24, 48, 72, 96]
    assert all(2 <= float(row["return_min"]) <= float(row["return_max"]) <= 9 for row in rows)
    tested = [fallen(seed) for seed in fac.episode_seeds(1, 2)]
    assert float(rows[-1]["eval_expert"]) == float(rows[-1]["eval_student"]) == np.mean(tested)
    _, arrays = fac.read_npz(tmp_path / "1" / "checkpoint.npz", ("checkpoint",))
    assert arrays["lengths"].sum() == 96 and arrays["lengths"].max() <= 9
    assert arrays["own lengths"].sum() == 72  # one round later
    whole = arrays["observation"][(arrays["begins"] + arrays["lengths"]), 1] < 0.05  # none left
    assert np.array_equal(arrays["terminated"], whole) and 0 < (~whole).sum() <= 8

    distill = ["distill", "--task", WALK, "--expert", str(tmp_path / "1"), *DISTILL, "--json",
               "--out", str(tmp_path / "run")]
    assert fac.main(distill) == 0
    result, (student, header) = last(capsys), fac.load_model(tmp_path / "run" / "student.npz")
    assert header["action_repeat"] == 1 and student.config.num_agents == 2
    assert result["student_returns"] == result["expert_returns"]
    assert fac.main(["evaluate", "--model", str(tmp_path / "run" / "student.npz"), "--episodes",
                     "2", "--workers", "0", "--json"]) == 0
    played = last(capsys)
    assert played["returns"] == result["student_returns"] and np.isfinite(played["plan_ms_median"])

    weights = {k: v for k, v in np.load(tmp_path / "1" / "expert.npz").items() if k != "header"}
    np.savez(tmp_path / "weights.npz", **weights)
    assert import_expert.main([str(tmp_path / "weights.npz"), "--task", WALK, "--out",
                               str(tmp_path / "imported"), "--collect", "9", "--json"]) == 0
    result = last(capsys)
    assert result["action_repeat"] == 1 and len(set(result["returns"])) > 1
    assert result["transitions"] == sum(result["returns"]) - 9


def test_a_run_cut_off_goes_on_to_the_same_result(tmp_path, capsys):
    command = ["--task", WALK, *SMALL, "--envs", "1", "--seed-decisions", "12", "--episodes", "0",
               "--buffer-size", "24", "--evaluate-episodes", "1", "--evaluate-every", "999",
               "--steps", "120", "--json"]  # more than the buffer holds

    def train(out, *flags):
        assert train_expert.main([*command, *flags, "--out", str(tmp_path / out)]) == 0
        return last(capsys)

    assert train("whole")["done"]
    stretches = [train("parts", "--minutes", minutes)["steps"] for minutes in (
        "2e-3", "4e-3", "8e-3", "2e-2")]
    assert train("parts")["done"] and any(0 < steps < 120 for steps in stretches)
    whole, parts = (fac.read_npz(tmp_path / out / "checkpoint.npz", ("checkpoint",))[1]
                    for out in ("whole", "parts"))
    assert whole["count"] > len(whole["lengths"])
    for key in ("begins", "lengths", "terminated", "observation", "end"):
        assert np.array_equal(whole[key], parts[key]), key
    assert "action_repeat" in fac.read_npz(tmp_path / "whole" / "expert.npz", ("expert",))[0]
    assert train_expert.main([*command, "--plan-action-repeat", "2", "--out",
                              str(tmp_path / "whole")]) == 2
    assert "action_repeat: expected 2, found 1" in capsys.readouterr().err


def test_a_robot_of_mujoco_with_two_joints_is_learned_and_distilled(tmp_path, capsys):
    """Reacher: 50 decisions, returns below zero: nothing that could be kept, and tables say so."""
    assert train_expert.main(["--task", "gym:Reacher-v5", *SMALL, "--steps", "400", "--envs", "2",
                              "--seed-decisions", "100", "--updates-per-step", "0.25",
                              "--evaluate-episodes", "2", "--episodes", "2", "--out",
                              str(tmp_path / "expert"), "--json"]) == 0
    expert = last(capsys)
    assert expert["updates"] == 100 and max(expert["returns"]) < 0
    assert fac.main(["distill", "--task", "gym:Reacher-v5", "--expert", str(tmp_path / "expert"),
                     *DISTILL, "--out", str(tmp_path / "run"), "--json"]) == 0
    out = capsys.readouterr().out
    result = json.loads(out.splitlines()[-1])
    assert result["kept"] is None and "return kept -, rank" in out and "nan" not in out.lower()
    assert result["num_agents"] == 2 and -99 < result["student_return_mean"] < 0
    assert result["expert_recorded"] and result["expert_returns"] == expert["returns"]
    with open(tmp_path / "expert" / "curve.csv", newline="") as file:
        assert all(float(row["return_mean"]) < 0 for row in csv.DictReader(file))


def test_pendulum_is_learned_in_a_minute_and_distilled(tmp_path, capsys):
    """4,800 decisions, narrow networks: -207 or -361, as a processor rounds, its student of one
    agent alike; at random -1,360."""
    out = tmp_path / "expert"
    assert train_expert.main([
        "--task", "gym:Pendulum-v1", "--steps", "4800", "--seed-decisions", "800", "--std-steps",
        "2400", "--updates-per-step", "0.6", "--lr", "2e-3", "--latent-dim", "8", "--enc-dim", "32",
        "--mlp-dim", "64", "--batch-size", "64", "--plan-samples", "32", "--plan-iterations", "2",
        "--plan-pi-trajs", "8", "--evaluate-every", "99999", "--evaluate-episodes", "1",
        "--episodes", "8", "--workers", "1", "--out", str(out), "--json"]) == 0
    found = last(capsys)
    assert found["return_mean"] > -600 and found["updates"] == 2880
    expert, header = fac.load_model(out / "expert.npz")
    config = fac.DistillConfig(steps=1500, batch_size=16, expert_episodes=0)
    with contextlib.closing(fac.Distiller(expert, fac.Replay(out / "replay.npz"), config,
                                          latent_dim=16, enc_dim=32, mlp_dim=64)) as distiller:
        list(distiller.run())
    planning = fac.PlannerConfig(**{**fac.made_for(header, out), "samples": 64, "iterations": 3})
    returns = fac.evaluate(distiller.student, "gym:Pendulum-v1", planning, 8, 0, 0)["returns"]
    assert distiller.student.config.num_agents == 1 and -600 < np.mean(returns) < 0
