"""Training: the buffer, rounds that don't depend on workers, checkpoints, learners, the CLI."""
import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

import fac_tdmpc_ref as fac
import own_robot
import train_expert
from toys import (ONE_THREAD, ROOT, TRAINING, WATCHED, here, last_json, launch, ramp, refused,
                  succeeded)

SCRIPT = ROOT / "data" / "train_expert.py"


def train(*arguments, cwd):
    return here(train_expert.main, *TRAINING, *arguments, cwd=cwd)


def episode(rng, value):
    return (np.full((fac.EPISODE_STEPS + 1, 8), value, np.float32),
            rng.uniform(-1, 1, (fac.EPISODE_STEPS, 3)), np.full(fac.EPISODE_STEPS, value))


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_the_buffer_drops_the_oldest_and_writes_a_replay(tmp_path, dtype):
    rng = np.random.default_rng(0)
    buffer = train_expert.ReplayBuffer(8, 3, 2 * fac.EPISODE_STEPS, dtype)
    for value in (1, 2, 3):
        buffer.add(*episode(rng, value))
    assert len(buffer) == 2
    obs, action, reward, (episodes, start) = buffer.sample(rng, 50, 3)
    assert obs.shape == (4, 8, 50) and action.shape == (3, 3, 50) and reward.shape == (3, 50)
    assert obs.dtype == action.dtype == reward.dtype == np.float32
    assert set(np.unique(obs)) == {2, 3} and np.array_equal(reward, obs[:3, 0])
    for h in range(3):
        rows = buffer.begins[episodes] + start + h
        assert np.array_equal(action[h].T, buffer.action[rows].astype(np.float32))
    buffer.write(tmp_path / "replay.npz", {"task": "reacher-easy"})
    replay = fac.Replay(tmp_path / "replay.npz")
    assert replay.transitions == 2 * fac.EPISODE_STEPS
    assert replay.observation[0, 0] == 2 and replay.observation[-1, 0] == 3  # oldest first
    assert np.allclose(replay.action[:501], buffer.action[501:], atol=1e-3)
    buffer.write(tmp_path / "replay.npz", {"task": "reacher-easy"}, episodes=1)
    assert set(fac.Replay(tmp_path / "replay.npz").observation[:, 0]) == {3}  # the newest


def test_segments_begin_anywhere_in_an_episode():
    buffer = train_expert.ReplayBuffer(8, 3, fac.EPISODE_STEPS)
    buffer.add(*episode(np.random.default_rng(0), 1))
    *_, (_, start) = buffer.sample(np.random.default_rng(0), 5000, 3)
    drawn, _ = np.histogram(start, 7, (0, 497))  # 498 starts, the last of which is 497
    assert (start.min(), start.max()) == (0, 497)
    assert 0.8 < drawn.min() / (5000 / 7) < drawn.max() / (5000 / 7) < 1.2


def test_a_replay_is_spread_over_training(tmp_path):
    buffer = train_expert.ReplayBuffer(8, 3, 10 * fac.EPISODE_STEPS)
    for value in range(10):
        buffer.add(*episode(np.random.default_rng(0), value))
    buffer.write(tmp_path / "replay.npz", {"task": "walker-walk"}, episodes=3)
    assert fac.Replay(tmp_path / "replay.npz").observation[::501, 0].tolist() == [3, 6, 9]
    buffer.write(tmp_path / "replay.npz", {"task": "reacher-hard"}, episodes=3)
    found = fac.Replay(tmp_path / "replay.npz").observation
    assert abs((found[:, 3:5] != found[:, :1]).all(1).mean() - 0.5) < 0.05  # other targets [D6]


def test_half_of_a_reacher_replay_s_states_get_another_target():
    rng = np.random.default_rng(0)
    before = rng.standard_normal((4000, 8)).astype(np.float16)
    for task, share in (("walker-walk", 0), ("reacher-mine", 0), ("reacher-hard", 0.5)):
        after = before.copy()
        train_expert.spread_targets(task, after, rng)
        moved = (after[:, 3:5] != before[:, 3:5]).all(1)
        assert abs(moved.mean() - share) < 0.03
        assert np.array_equal(after[~moved], before[~moved])
        assert np.array_equal(np.delete(after, [3, 4], 1), np.delete(before, [3, 4], 1))
    seen = after[moved].astype(np.float32)
    heading = np.cumsum(seen[:, :3], 1)
    target = seen[:, 3:5] + 0.09 * np.stack([np.cos(heading).sum(1), np.sin(heading).sum(1)], 1)
    distance = np.linalg.norm(target, axis=1)
    assert 0.049 < distance.min() < 0.06 and 0.19 < distance.max() < 0.201
    assert abs(np.corrcoef(target.T)[0, 1]) < 0.1  # x and y are two coordinates


def test_segments_are_in_order_and_most_get_other_targets():
    rng = np.random.default_rng(1)
    buffer = train_expert.ReplayBuffer(8, 3, fac.EPISODE_STEPS)
    walk = np.cumsum(rng.standard_normal((501, 8)) * 0.1 + 1, 0).astype(np.float32)
    buffer.add(walk, rng.uniform(-1, 1, (500, 3)), np.zeros(500))
    obs, _, reward, where = buffer.sample(rng, 400, 3)
    before = obs.copy(), reward.copy()
    train_expert.hindsight("walker-walk", buffer, where, obs, reward, rng)
    assert np.array_equal(obs, before[0]) and np.array_equal(reward, before[1])
    train_expert.hindsight("reacher-easy", buffer, where, obs, reward, rng)
    starts = [int(np.argmin(np.abs(walk[:, 0] - x))) for x in obs[0, 0]]
    assert np.array_equal(starts, where[1])
    untouched = [0, 1, 2, 5, 6, 7]  # only finger-to-target ever differs from the episode
    for h in range(4):
        assert np.allclose(obs[h][untouched], walk[np.add(starts, h)].T[untouched])
    moved = ~np.isclose(obs[0, 3], walk[starts, 3])
    assert 0.67 < moved.mean() < 0.83
    assert not reward[:, ~moved].any() and reward[:, moved].any()
    again = before[0].copy(), before[1].copy()  # of decisions of four steps
    train_expert.hindsight("reacher-easy", buffer, where, *again, np.random.default_rng(2), 4)
    assert set(np.unique(reward)) == {0, 2} and set(np.unique(again[1])) == {0, 4}
    # hindsight moves the target by a later finger-to-target of the episode, fresh ones are near 0
    back = walk[starts, 3] - obs[0, 3]
    reached = np.isclose(back[:, None], walk[:, 3], atol=1e-4)
    hindsight = reached.any(1)
    assert (reached.argmax(1) >= starts)[moved & hindsight].all()
    finger = train_expert.REACHER_LINK * np.cos(np.cumsum(obs[0, :3], 0)).sum(0)
    fresh = moved & (np.abs(finger + obs[0, 3]) <= 0.2 + 1e-4)
    assert 0.42 < (moved & hindsight).mean() < 0.58 and 0.17 < fresh.mean() < 0.33
    assert (hindsight | fresh)[moved].all()


def play(parts, seed=4, policy=True):
    """Actions of a training episode, from the first model and then, part by part, another."""
    episode = train_expert.Episode(fac.Environment("reacher-easy"), seed, exploration_std=0.1)
    sizes = fac.ModelConfig(8, 3, 1, 4, 6, 6)
    for model_seed, decisions in parts:
        model = fac.WorldModel.create(sizes, np.random.default_rng(model_seed), policy=policy)
        for key in ("_Q1.5.weight", "_Q2.5.weight"):  # zero at birth: all plans alike
            model.params[key] += 1
        episode.play(fac.Planner(model, fac.PlannerConfig(samples=16, iterations=2)), decisions)
    return np.stack(episode.action)


@pytest.mark.parametrize("std", [0.0, 0.2])
def test_exploration_adds_noise_of_its_deviation(std):
    """Played twice with the same plans: what differs is the noise."""
    class Still:
        own = SimpleNamespace(mean=None, rngs=None, t=None)

        def reset(self, seed):
            pass

        def act(self, obs):
            return np.full(3, 0.1, np.float32)

    episode = train_expert.Episode(fac.Environment("reacher-easy"), 0, exploration_std=std)
    episode.play(Still(), 300)
    noise = np.stack(episode.action) - np.float32(0.1)
    assert abs(noise.std() - std) <= 0.1 * std and abs(noise.mean()) <= 0.1 * std
    if std:
        assert len(np.unique(noise)) == noise.size


@pytest.mark.parametrize("hold", [0, 8])
def test_random_actions_and_those_that_are_held(hold):
    """Part by part, as a round plays them, and in the episode that follows."""
    first = train_expert.Episode(fac.Environment("reacher-easy"), 0, exploration_std=0.1, hold=hold)
    for episode in (first, first.next()):
        for decisions in (13, 11, 56):
            episode.play(None, decisions)
        actions = np.stack(episode.action)
        if hold:
            assert set(np.unique(actions)) == {-1, 1}
            by_hold = actions.reshape(-1, hold, 3)
            assert (by_hold == by_hold[:, :1]).all() and len(np.unique(by_hold[:, 0], axis=0)) > 4
        else:
            assert len(np.unique(actions)) == actions.size and np.abs(actions).max() < 1


def test_an_episode_may_get_new_weights_on_its_way():
    whole = play([(0, 12)])
    assert np.array_equal(play([(0, 5), (0, 7)]), whole)  # warm start and random streams go on
    newer = play([(0, 5), (1, 7)])
    assert np.array_equal(newer[:5], whole[:5]) and not np.allclose(newer[5:], whole[5:])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A finished run: (what it printed, its folder)."""
    folder = tmp_path_factory.mktemp("train")
    return train("--episodes", "1", "--out", "whole", "--json", cwd=folder), folder / "whole"


def weights(folder, kind):
    model, _ = fac.load_model(folder / f"{kind}.npz")
    return {k: v.tobytes() for k, v in model.params.items()}


def test_train_prints_json_and_writes_what_distill_takes(trained, tmp_path):
    done, folder = trained
    found = last_json(done)
    assert {"task", "seed", "steps", "updates", "seconds", "return_mean", "return_std", "returns",
            "student_return_mean", "ratio", "lag", "out", "done"} <= set(found)
    assert (found["steps"], found["updates"]) == (3000, 30) and set(found["lag"]) == {"50", "75",
                                                                                      "90"}
    assert set(os.listdir(folder)) - {"curve.png"} == {
        "checkpoint.npz", "curve.csv", "expert.json", "expert.npz", "replay.npz", "student.json",
        "student.npz"}
    with open(folder / "curve.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(r["decisions"]) for r in rows] == [1000, 2000, 3000]
    assert tuple(rows[0]) == train_expert.CURVE and rows[0]["value"] == ""
    assert float(rows[-1]["value"]) > 0 and int(rows[-1]["updates"]) == 30
    # every 2000 decisions, and what came out; in the row whose weights were tested
    assert [bool(r["eval_expert"] and r["eval_student"]) for r in rows] == [False, True, True]
    assert fac.Replay(folder / "replay.npz").transitions == 3000
    distilled = here(fac.main, "distill", "--task", "reacher-easy", "--expert", folder, "--steps",
                     "3", "--expert-episodes", "0", "--episodes", "1", "--plan-samples", "8",
                     "--plan-iterations", "1", "--held-out", "0.5", "--json", "--workers", "0",
                     cwd=tmp_path)
    assert last_json(distilled)["steps"] == 3


def test_the_student_plays_beside_the_expert(trained, tmp_path):
    """As many a round, once it learns, as the expert, two; none without a share."""
    def played(folder, experts):
        header, arrays = fac.read_npz(folder / "checkpoint.npz", ("checkpoint",))
        assert arrays["count"] == experts and header["settings"]["distill"]["expert_episodes"] == 0
        assert set(arrays["own lengths"]) <= {fac.EPISODE_STEPS}
        assert arrays["own action"].shape == (arrays["own count"] * (fac.EPISODE_STEPS + 1), 3)
        return arrays["own count"]

    assert played(trained[1], 6) == 4
    succeeded(train("--steps", "2000", "--distill-played-share", "0", "--out", "none",
                    cwd=tmp_path))
    assert played(tmp_path / "none", 4) == 0


def test_a_share_of_an_online_student_s_states_is_its_own(monkeypatch):
    """There half of the perturbed actions are what it did (2), half the policy's (0)."""
    expert = fac.WorldModel.create(fac.ModelConfig(8, 3, 1, 4, 6, 6), np.random.default_rng(0),
                                   policy=True)
    for key, value in expert.params.items():
        value *= not key.startswith("_pi")
    own, seen = train_expert.ReplayBuffer(8, 3, fac.EPISODE_STEPS), []
    config = fac.DistillConfig(batch_size=64, played_share=0.25)
    student = train_expert.OnlineStudent(expert, 3, config, 0, own)
    real = fac.taught_batch
    monkeypatch.setattr(fac, "taught_batch",
                        lambda *args: seen.append((args[2], args[3])) or real(*args))
    for _ in range(2):
        student.update(expert, np.ones((8, 80), np.float32), np.ones((5, 3, 80), np.float32))
        own.add(*(np.full_like(x, 2) for x in episode(np.random.default_rng(0), 2)))
    (obs, actions), (mixed, both) = seen
    assert (obs == 1).all() and actions.shape == (4, 3, 64, 1) and set(np.unique(actions)) == {0, 1}
    assert (mixed[:, :16] == 2).all() and (mixed[:, 16:] == 1).all()
    assert set(np.unique(both[:, :, :16])) == {0, 2} and set(np.unique(both[:, :, 16:])) == {0, 1}


def test_an_online_student_s_own_actions_begin_where_their_state_is(monkeypatch):
    sizes, seen, real = fac.ModelConfig(8, 3, 1, 4, 6, 6), [], fac.taught_batch
    expert = fac.WorldModel.create(sizes, np.random.default_rng(0), policy=True)
    own = train_expert.ReplayBuffer(8, 3, fac.EPISODE_STEPS)
    own.add(*ramp(), np.zeros(fac.EPISODE_STEPS))
    config = fac.DistillConfig(batch_size=128, played_share=1.0)
    monkeypatch.setattr(fac, "taught_batch", lambda *args: seen.append(args[2:4]) or real(*args))
    train_expert.OnlineStudent(expert, 3, config, 0, own).update(
        expert, np.ones((8, 128), np.float32), np.ones((4, 3, 128), np.float32))
    ((obs, actions),) = seen
    played = (actions[:, 0, :, 0] == (obs[0] + np.arange(4)[:, None]) / 512).all(0)
    assert 0.35 < played.mean() < 0.65  # the others' are the policy's [D8]


def training(*more):
    """A Training that has done nothing yet."""
    args = train_expert.make_parser().parse_args([*TRAINING, *more])
    return train_expert.Training(args, *train_expert.read_settings(args))


def test_exploration_falls_and_no_episode_is_played_twice():
    found, seeds = training("--std-steps", "2000"), []
    for decisions, std, horizon in ((0, 0.5, 1), (1000, 0.275, 2), (2000, 0.05, 3),
                                    (3000, 0.05, 3)):
        found.decisions = decisions
        assert found.scheduled() == {"exploration_std": pytest.approx(std), "horizon": horizon}
        if decisions:
            planning = found.explorers()["explorer"][1]
            assert (planning.min_std, planning.horizon) == (pytest.approx(std), horizon)
        seeds += [seed for seed, *_ in found.explorations()]
    assert len(set(seeds)) == len(seeds) == 2 + 3 * 4


def test_evaluations_are_of_episodes_apart_and_of_each_model_s_horizon():
    found = training("--seed", "4", "--evaluate-episodes", "2", "--distill-horizon", "1",
                     "--std-steps", "0")
    seeds = fac.episode_seeds(5, 2)  # not those that a run's own evaluation plays in the end
    assert found.tests() == [(seed, name) for name in ("expert", "student") for seed in seeds]
    planners = found.planners()
    assert planners["expert"][1].horizon == 3 and planners["student"][1].horizon == 1
    assert planners["student"][0] is found.student.model
    for elites, own in ((64, 0), (8, 8)):  # a student has 32 samples
        found = training("--plan-samples", "512", "--plan-elites", str(elites))
        assert [found.planners()[name][1].elites for name in found.models] == [elites, own]


def test_every_update_has_states_and_perturbations_of_its_own(monkeypatch):
    found, noise, states, real = training(), [], [], fac.taught_batch
    found.buffer.add(*episode(np.random.default_rng(0), 1))
    sample = found.buffer.sample
    found.buffer.sample = lambda *args: states.append(sample(*args)) or states[-1]

    def perturbed(expert, student, obs, actions, *rest):
        noise.append(real(expert, student, obs, 0 * actions, *rest)[1])
        return real(expert, student, obs, actions, *rest)

    monkeypatch.setattr(fac, "taught_batch", perturbed)
    for _ in range(2):
        found.learn()
    assert not np.array_equal(states[0][3][1], states[1][3][1])
    assert not np.array_equal(*noise)


@pytest.mark.parametrize("horizon", [0, 2, 4])  # beside the expert's 3
def test_expert_and_student_learn_over_their_own_horizons(horizon, monkeypatch):
    found, seen = training("--distill-horizon", str(horizon), "--distill-grad-clip", "0.5"), []
    found.buffer.add(*episode(np.random.default_rng(0), 1))
    update, perturbed, student = found.learner.update, fac.taught_batch, found.student
    monkeypatch.setattr(found.learner, "update", lambda obs, actions, reward, *rest: (
        seen.append((len(obs), len(actions), len(reward))), update(obs, actions, reward, *rest))[1])
    monkeypatch.setattr(fac, "taught_batch", lambda *args: (
        seen.append(len(args[3])), perturbed(*args))[1])
    step = student.optimizer.step
    monkeypatch.setattr(student.optimizer, "step", lambda lr, clip: (
        seen.append((lr, clip)), step(lr, clip))[1])
    for t in range(2):
        found.learn()
        assert seen == [(4, 3, 3), horizon + 1, (fac.learning_rate(student.config, t), 0.5)]
        seen.clear()


def test_an_online_student_s_priors_learn_what_the_policy_does_now(monkeypatch):
    """In its batch's states, at its rate; Algorithm 1's weights are those of one without priors."""
    expert = fac.WorldModel.create(fac.ModelConfig(8, 3, 1, 4, 6, 6), np.random.default_rng(0),
                                   policy=True)
    own, seen = train_expert.ReplayBuffer(8, 3, fac.EPISODE_STEPS), []
    config = fac.DistillConfig(batch_size=32, lr=5e-3, warmup=1, steps=400)
    student, plain = (train_expert.OnlineStudent(expert, 3, fac.dataclasses.replace(
        config, priors=priors), 0, own) for priors in (True, False))
    assert [*student.optimizers] == ["student", "priors"] and [*plain.optimizers] == ["student"]
    rng, loss = np.random.default_rng(0), fac.prior_loss
    monkeypatch.setattr(fac, "prior_loss", lambda *args: (
        seen.append((loss(*args), args[1:3])), seen[-1][0])[1])
    for t in range(200):
        if t == 100:  # an expert that has learned: nothing of it is kept
            expert.params["_pi.4.bias"] += 0.5
        obs = rng.standard_normal((8, 40)).astype(np.float32)
        actions = rng.uniform(-1, 1, (4, 3, 40)).astype(np.float32)
        for one in (student, plain):
            one.update(expert, obs.copy(), actions)
        _, (x, plans) = seen[t]
        assert np.array_equal(x, student.model.read(obs[:, :32]))
        assert np.array_equal(plans, fac.policy_plan(expert, obs[:, :32], 4, student.model.config))
    assert len(seen) == 200 and seen[99][0] < seen[0][0] / 3 and seen[199][0] < seen[100][0] / 3
    assert np.array_equal(student.optimizer.vector, plain.optimizer.vector)
    assert student.model.config.prior_steps == 4 and plain.model.config.prior_steps == 0


def test_an_online_student_s_priors_go_on_bit_for_bit(tmp_path):
    whole, again = training(), training()
    for found in (whole, again):
        found.buffer.add(*episode(np.random.default_rng(0), 1))
    for _ in range(3):
        whole.learn()
    (tmp_path / "run").mkdir()
    whole.save(tmp_path / "run")
    _, arrays = fac.read_npz(tmp_path / "run" / "checkpoint.npz", ("checkpoint",))
    assert {"priors weights", "priors adam_m", "priors adam_v", "priors step"} <= {*arrays}
    before = fac.flatten(fac.prior_weights(whole.student.model))[0]
    assert np.array_equal(arrays["priors weights"], before) and arrays["priors step"] == 3
    again.load(tmp_path / "run" / "checkpoint.npz")
    for found in (whole, again):
        for _ in range(2):
            found.learn()
    after, other = (fac.flatten(fac.prior_weights(found.student.model))[0]
                    for found in (whole, again))
    assert np.array_equal(after, other) and not np.array_equal(after, before)
    for key, value in whole.student.model.params.items():
        assert np.array_equal(value, again.student.model.params[key]), key


class Still:
    """Stands for `Actors`: notes what it is asked for; every episode is of ones."""

    def __init__(self, learner):
        self.learner, self.played = learner, []

    def begin(self, episodes):
        self.begun = episodes

    def play(self, decisions, planners):
        self.played.append((decisions, self.learner.updates, set(planners)))

    def receive_all(self):
        pass

    def episodes(self):
        return [[(*episode(np.random.default_rng(0), 1), False)] for _ in self.begun]


def test_a_round_s_episodes_go_on_with_newer_weights_in_every_part():
    found = training("--refresh", "125")
    assert found.student.config.steps == 30  # a hundredth of 3,000: the rate falls over these
    found.decisions, found.allowed, found.curve = 2000, 8.0, [{}]
    found.buffer.add(*episode(np.random.default_rng(0), 1))
    actors = Still(found.learner)
    found.round(actors, SimpleNamespace(update=lambda: None, set_postfix_str=lambda *_: None))
    playing = {"explorer", "own"}  # and, with the weights that they began with, those tested
    assert actors.played == [(125, 0, {*playing, "expert", "student"}), (125, 2, playing),
                             (125, 4, playing), (125, 6, playing)]
    assert (found.learner.updates, found.allowed, found.decisions) == (8, 18, 3000)
    assert (len(found.buffer), len(found.student.own)) == (3, 2)


def test_the_expert_learns_from_segments_with_other_targets(monkeypatch):
    found, seen = training("--batch-size", "400"), []
    found.buffer.add(*episode(np.random.default_rng(0), 1))
    monkeypatch.setattr(found.learner, "update", lambda obs, *_: seen.append(obs) or [0.0] * 3)
    found.learn()
    assert 0.65 < (seen[0][0, 3:5] != 1).all(0).mean() < 0.85  # three quarters [D6]


def test_evaluations_and_their_ratio_are_of_whom_they_name(monkeypatch, tmp_path):
    found = training("--episodes", "1")
    found.curve = [{"decisions": 500, "return_mean": 1}]
    found.note([(1, "expert"), (2, "student")], [[(np.float32([3, 4]), False)],
                                                 [(np.float32([1, 1]), False)]])
    assert found.curve == [{"decisions": 500, "return_mean": 1, "eval_expert": 7,
                            "eval_student": 2}]
    found.buffer.add(*episode(np.random.default_rng(0), 1))
    workers = []
    monkeypatch.setattr(fac, "evaluate", lambda *where: (workers.append(where[5]), {
        "returns": [4.0 if where[6].endswith("student") else 8.0], "plan_ms_median": 1.0})[1])
    monkeypatch.setattr(train_expert, "draw_lines", lambda *_: True)
    assert train_expert.export(found, tmp_path, {"updates": 0})["ratio"] == 0.5
    assert workers == [1, 1]  # --workers


def test_the_number_of_workers_changes_nothing(trained, tmp_path):
    succeeded(train("--workers", "2", "--out", "other", cwd=tmp_path))
    for kind in ("expert", "student"):
        assert weights(tmp_path / "other", kind) == weights(trained[1], kind)


def test_a_run_may_begin_without_random_episodes(tmp_path):
    done = train("--seed-decisions", "0", "--steps", "1000", "--out", "run", "--json",
               cwd=tmp_path)
    assert last_json(done)["steps"] == 1000


def test_a_killed_run_goes_on_to_the_same_result(trained, tmp_path):
    out = tmp_path / "killed"
    stopped = train("--minutes", "1e-9", "--out", out, "--json", cwd=tmp_path)
    assert last_json(stopped)["done"] is False and "goes on" in stopped.stderr
    process = subprocess.Popen([sys.executable, SCRIPT, *TRAINING, "--out", out],
                               stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    deadline = time.time() + 100
    while len((out / "curve.csv").read_text().splitlines()) < 2 and time.time() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    for _ in range(20):  # a round at a time, until something has been learned
        if fac.read_npz(out / "checkpoint.npz", ("checkpoint",))[0]["updates"]:
            break
        last_json(train("--minutes", "1e-2", "--out", out, "--json", cwd=tmp_path))
    before = fac.read_npz(out / "checkpoint.npz", ("checkpoint",))[0]
    with open(out / "curve.csv", newline="") as file:  # no row that a resumed run makes again
        assert len(list(csv.DictReader(file))) <= len(before["curve"])
    assert before["updates"] > 0 and before["decisions"] < 3000
    succeeded(train("--resume", "--out", out, cwd=tmp_path))
    for kind in ("expert", "student"):
        assert weights(out, kind) == weights(trained[1], kind)


@pytest.mark.parametrize("name", ["expert.npz", "replay.npz", "student.npz", "curve.csv",
                                  "curve.png", "expert.json"])
def test_another_run_s_files_are_not_replaced(tmp_path, name):
    (tmp_path / name).write_text("an hour's work")
    done = train("--out", ".", cwd=tmp_path)
    assert done.returncode == 2 and f"{name}: not this run's" in done.stderr
    assert (tmp_path / name).read_text() == "an hour's work"


@pytest.mark.parametrize("flags, parts", [
    (["--task", "reacher-eesy"], ["did you mean 'reacher-easy'"]),
    (["--resume"], ["checkpoint.npz", "nothing to resume"]),
    (["--steps", "10"], ["steps", "1000"]),
    (["--steps", "1500"], ["--envs", "whole rounds", "not 1500"]),
    (["--precision", "bfloat16"], ["--precision needs --backend torch"]),
    (["--threads", "2"], ["--threads needs --backend torch"]),
    (["--envs", "0"], ["envs", "at least 1"]),
    (["--workers", "0"], ["workers", "at least 1"]),
    (["--minutes", "nan"], ["--minutes", "nan"]),
    (["--num-agents", "2"], ["[1, 3]"]),
    (["--num-agents", "0"], ["[1, 3]"]),
    (["--std-start", "3"], ["std_start", "2.0"]),
    (["--student", "fac", "--plan-min-std", "0.2"], ["min_std", "0.15"]),
    (["--distill-batch-size", "9"], ["--distill-batch-size 9", "at most", "(8)"]),
    (["--distill-encoder-input", "observation"], ["--distill-policy-share 0"]),
    (["--out", fac.__file__], ["can't be read or written"]),
    (["--out", "x" * 300], ["can't be read or written"]),
    (["--evaluate-every", "0"], ["evaluate"]),
    (["--evaluate-episodes", "0"], ["evaluate"]),
    (["--episodes", "-1"], ["--episodes"]),
])
def test_train_refuses(tmp_path, flags, parts):
    refused(train(*flags, cwd=tmp_path), *parts, program="train_expert.py")


def test_other_settings_and_broken_checkpoints_are_refused(tmp_path):
    out, checkpoint = tmp_path / "run", tmp_path / "run" / "checkpoint.npz"

    def refuses(*parts, flags=()):
        refused(train("--out", out, *flags, cwd=tmp_path), *parts, program="train_expert.py")

    succeeded(train("--minutes", "1e-9", "--out", out, cwd=tmp_path))
    before = checkpoint.read_bytes()
    refuses("checkpoint.npz", "lr", "0.01", flags=("--lr", "0.01"))
    assert checkpoint.read_bytes() == before
    checkpoint.write_bytes(before[:1000])
    refuses("checkpoint.npz", "not a readable")
    for key in ("slow", "student adam_v"):
        checkpoint.write_bytes(before)
        header, arrays = fac.read_npz(checkpoint, ("checkpoint",))
        del arrays[key]
        fac.write_npz(checkpoint, header, arrays)
        refuses("checkpoint.npz", key)


def test_the_lag_is_counted_from_the_expert_s_crossing():
    def row(decisions, expert, student):
        return {"decisions": decisions, "eval_expert": expert, "eval_student": student}

    curve = [row(1000, None, None), row(2000, 400.0, 0.0), row(4000, 800.0, 500.0),
             row(6000, 1000.0, 700.0)]
    lag = train_expert.lag
    assert lag(curve, 0.4) == 2000 and lag(curve, 0.7) == 2000
    assert lag(curve, 0.9) is None and lag(curve[:1], 0.5) is None
    assert json.dumps(lag([row(2000, 0.0, 0.0)], 0.5)) == "null"


# the two learners, and acting for them ------------------------------------------------

SMALL = [*TRAINING[:TRAINING.index("--student")], "--workers", "1", "--episodes", "0"]


def trained_here(capsys, *arguments):
    """The result of a small run in this process, where PyTorch is imported once."""
    assert train_expert.main([*SMALL, *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def weights_of(folder):
    model, header = fac.load_model(folder / "expert.npz")
    return np.concatenate([v.ravel() for v in model.params.values()]), header


def test_both_learners_learn_the_same_from_the_same_episodes(tmp_path, capsys):
    """Random episodes, since one rounded bit may turn a plan; then ten updates."""
    pytest.importorskip("torch")
    for backend in ("numpy", "torch"):
        trained_here(capsys, "--backend", backend, "--steps", 1000, "--student", "fac",
                     "--out", tmp_path / backend)
    (ours, header), (theirs, other) = (weights_of(tmp_path / b) for b in ("numpy", "torch"))
    assert (header["backend"], header["updates"]) == ("numpy", 10)
    assert (other["backend"], other["updates"], other["precision"]) == ("torch", 10, "float32")
    fresh = fac.WorldModel.create(fac.ModelConfig(8, 3, 1, 6, 8, 16), fac.stream(0, "expert"), True)
    fresh = np.concatenate([v.ravel() for v in fresh.params.values()])
    assert np.abs(theirs - fresh).max() > 4e-3  # Adam's ten steps, 5e-4 each
    assert np.linalg.norm(ours - theirs) < 1e-3 * np.linalg.norm(theirs - fresh)


def test_train_expert_in_stretches(tmp_path, capsys):
    """Both learners go on with another planner, but not with another learning rate."""
    pytest.importorskip("torch")
    out = tmp_path / "run"

    def train(steps, *more):
        return train_expert.main([*SMALL, "--task", "walker-walk", "--envs", "1", "--backend",
                                  "torch", "--plan-pi-trajs", "2", "--seed-decisions", "500",
                                  "--steps", str(steps), "--out", str(out), *more])

    assert train(499) == 2 and "499" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert train(500, "--updates-per-step", "0.1") == 0
    assert train(1000, "--plan-horizon", "0", "--updates-per-step", "0.2") == 0
    assert len((out / "curve.csv").read_text().splitlines()) == 3
    expert, header = fac.load_model(out / "expert.npz")
    assert expert.has_policy and (header["decisions"], header["updates"]) == (1000, 150)
    assert header["training_planner"]["horizon"] == 0
    assert fac.Replay(out / "replay.npz").transitions == 1000
    assert train(1500, "--lr", "1e-3") == 2
    message = capsys.readouterr().err.splitlines()[-1]
    for part in ("checkpoint.npz", "lr: expected 0.001, found 0.0005", "--out"):
        assert part in message
    assert train(1500, "--backend", "numpy") == 2
    assert train(1500, "--device", "nonsense") == 2
    assert "--device nonsense" in capsys.readouterr().err.splitlines()[-1]


def test_a_run_in_pytorch_goes_on_to_the_same_result(tmp_path, capsys):
    pytest.importorskip("torch")
    arguments = ["--backend", "torch", "--steps", 2000]
    trained_here(capsys, *arguments, "--out", tmp_path / "whole")
    for _ in range(20):
        found = trained_here(capsys, *arguments, "--minutes", 1e-4, "--out", tmp_path / "parts")
        if found["done"]:
            break
        header, arrays = fac.read_npz(tmp_path / "parts" / "checkpoint.npz", ("checkpoint",))
    assert header["updates"] > 0 and "exp_avg _encoder.0.weight" in arrays
    whole, parts = (weights_of(tmp_path / name)[0] for name in ("whole", "parts"))
    assert np.array_equal(whole, parts)


def test_numpy_s_learner_needs_no_pytorch(tmp_path):
    code = "import sys; sys.modules['torch'] = None; import train_expert; " \
           "sys.exit(train_expert.main(sys.argv[1:]))"
    env = {**ONE_THREAD, "PYTHONPATH": os.pathsep.join([str(SCRIPT.parent), str(ROOT)])}
    run = ["-c", code, *SMALL, "--minutes", "1e-9"]
    succeeded(launch(run, tmp_path, env))
    refused(launch([*run, "--backend", "torch"], tmp_path, env),
            "pip install 'fac-tdmpc-ref[torch]'", program="train_expert.py")


def test_help_is_quick_and_starts_nothing(tmp_path):
    code = WATCHED.replace("import fac_tdmpc_ref as fac", "import train_expert as fac")
    env = {**ONE_THREAD, "PYTHONPATH": str(SCRIPT.parent)}
    done = succeeded(launch(["-c", code, "--help"], tmp_path, env))
    text = re.sub(r"\s+", " ", done.stdout)
    assert text.startswith("usage: train_expert.py") and done.stderr == ""
    for part in ("--student", "--plan-samples", "(Table 2) [128; paper: 512]",
                 "(Table 2) [256; paper: 512]", "--backend"):
        assert part in text
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("workers", [1, 2])
def test_actors_equal_single_environments(workers, monkeypatch):
    """Random episodes, a part at a time, in processes: what their actions lead to here; they are
    sent once, not all of them after every part."""
    task, seeds, sent, receive = "reacher-easy", [3, 4, 5], [], fac.Workers.receive
    monkeypatch.setattr(fac.Workers, "receive", lambda *args: (
        sent.append(found := receive(*args)), found)[1])
    actors = train_expert.Actors(task, workers)
    try:
        actors.begin([(seed, "explorer", 0.5) for seed in seeds])
        for decisions in (1, 2):
            actors.play(decisions, {})
            actors.receive_all()
        assert sent == ["played"] * 2 * workers
        episodes = actors.episodes()
    finally:
        actors.close()
    environment = fac.Environment(task)
    for seed, ((obs, action, reward, terminated),) in zip(seeds, episodes, strict=True):
        assert not terminated
        assert obs.dtype == action.dtype == reward.dtype == np.float32
        np.testing.assert_array_equal(obs[0], environment.reset(seed))
        for t in range(3):
            after, earned = environment.step(action[t])
            np.testing.assert_array_equal(obs[t + 1], after)
            assert reward[t] == np.float32(earned)


def test_tests_beside_the_training_are_an_evaluation():
    """A named player keeps its planner and explores nothing: the returns that evaluate gives."""
    model = fac.WorldModel.create(fac.ModelConfig(8, 3, 1, 4, 6, 6), np.random.default_rng(0))
    for key in ("_Q1.5.weight", "_Q2.5.weight"):
        model.params[key] += 1
    planning, seeds = fac.PlannerConfig(samples=8, iterations=1), fac.episode_seeds(0, 2)
    actors = train_expert.Actors("reacher-easy", 1)
    try:
        actors.begin([(7, "explorer", 0.5), *((seed, "expert") for seed in seeds)])
        actors.play(200, {"expert": (model, planning)})
        actors.receive_all()
        actors.play(300, {"explorer": (model, planning)})
        actors.receive_all()
        returns = [reward.sum() for ((*_, reward, _),) in actors.episodes()[1:]]
    finally:
        actors.close()
    assert returns == fac.evaluate(model, "reacher-easy", planning, 2, 0, 0)["returns"]


def test_a_robot_of_one_s_own_is_learned_distilled_and_played(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(fac, "CONTROL_STEPS", 100)
    monkeypatch.setattr(fac, "EPISODE_STEPS", 50)
    own_robot.main(episodes=10, updates=2, steps=4, out=tmp_path)
    for kind in ("expert", "student"):
        assert fac.load_model(tmp_path / f"{kind}.npz")[0].config.dim_action == 2
    said = capsys.readouterr().out.split("\n")
    assert said[0].startswith("expert: ") and said[1].startswith("student: ")
