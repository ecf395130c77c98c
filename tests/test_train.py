"""Training in NumPy: the buffer, rounds that don't depend on workers, checkpoints, the CLI."""
import csv
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import fac_tdmpc_ref as fac
from test_cli import last_json, refused, run, succeeded

TINY = ["--task", "reacher-easy", "--steps", "3000", "--envs", "2", "--seed-decisions", "1000",
        "--updates-per-step", "0.01", "--batch-size", "8", "--mlp-dim", "16", "--enc-dim", "8",
        "--latent-dim", "6", "--plan-samples", "8", "--plan-iterations", "1", "--evaluate-every",
        "2000", "--evaluate-episodes", "1", "--student", "fac", "--workers", "1", "--episodes", "0"]


def episode(rng, value):
    return (np.full((fac.EPISODE_STEPS + 1, 8), value, np.float32),
            rng.uniform(-1, 1, (fac.EPISODE_STEPS, 3)), np.full(fac.EPISODE_STEPS, value))


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_the_buffer_drops_the_oldest_and_writes_a_replay(tmp_path, dtype):
    rng = np.random.default_rng(0)
    buffer = fac.ReplayBuffer(8, 3, 2 * fac.EPISODE_STEPS, dtype)
    for value in (1, 2, 3):
        buffer.add(*episode(rng, value))
    assert len(buffer) == 2
    obs, action, reward = buffer.sample(rng, 50, 3, "walker-walk")
    assert obs.shape == (4, 8, 50) and action.shape == (3, 3, 50) and reward.shape == (3, 50)
    assert obs.dtype == action.dtype == reward.dtype == np.float32
    assert set(np.unique(obs)) == {2, 3} and np.array_equal(reward, obs[:3, 0])
    buffer.write(tmp_path / "replay.npz", {"task": "reacher-easy"})
    replay = fac.Replay(tmp_path / "replay.npz")
    assert replay.transitions == 2 * fac.EPISODE_STEPS
    assert replay.observation[0, 0] == 2 and replay.observation[-1, 0] == 3  # oldest first
    assert np.allclose(replay.action[:500], buffer.action[1], atol=1e-3)


def test_segments_are_in_order_and_most_get_other_targets():
    rng = np.random.default_rng(1)
    buffer = fac.ReplayBuffer(8, 3, fac.EPISODE_STEPS)
    walk = np.cumsum(rng.standard_normal((501, 8)) * 0.1 + 1, 0).astype(np.float32)
    buffer.add(walk, rng.uniform(-1, 1, (500, 3)), np.zeros(500))
    obs, _, reward = buffer.sample(rng, 400, 3, "reacher-easy")
    starts = [int(np.argmin(np.abs(walk[:, 0] - x))) for x in obs[0, 0]]
    untouched = [0, 1, 2, 5, 6, 7]  # only finger-to-target ever differs from the episode
    for h in range(4):
        assert np.allclose(obs[h][untouched], walk[np.add(starts, h)].T[untouched])
    moved = ~np.isclose(obs[0, 3], walk[starts, 3])
    assert 0.67 < moved.mean() < 0.83
    assert not reward[:, ~moved].any() and reward[:, moved].any()
    # hindsight moves the target by a later finger-to-target of the episode, fresh ones are near 0
    back = walk[starts, 3] - obs[0, 3]
    hindsight = np.isclose(back[:, None], walk[:, 3], atol=1e-4).any(1)
    finger = fac.REACHER_LINK * np.cos(np.cumsum(obs[0, :3], 0)).sum(0)
    fresh = moved & (np.abs(finger + obs[0, 3]) <= 0.2 + 1e-4)
    assert 0.42 < (moved & hindsight).mean() < 0.58 and 0.17 < fresh.mean() < 0.33
    assert (hindsight | fresh)[moved].all()


def play(parts, seed=4, policy=True):
    """Actions of a training episode, from the first model and then, part by part, another."""
    episode = fac.Exploration(fac.Environment("reacher-easy"), seed, 0.1)
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
        warm_start = None

        def reset(self, seed):
            pass

        def act(self, obs):
            return np.full(3, 0.1, np.float32)

    episode = fac.Exploration(fac.Environment("reacher-easy"), 0, std)
    episode.play(Still(), 300)
    noise = np.stack(episode.action) - np.float32(0.1)
    assert abs(noise.std() - std) <= 0.1 * std and abs(noise.mean()) <= 0.1 * std
    if std:
        assert len(np.unique(noise)) == noise.size


def test_an_episode_may_get_new_weights_on_its_way():
    whole = play([(0, 12)])
    assert np.array_equal(play([(0, 5), (0, 7)]), whole)  # warm start and random streams go on
    newer = play([(0, 5), (1, 7)])
    assert np.array_equal(newer[:5], whole[:5]) and not np.allclose(newer[5:], whole[5:])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A finished run: (its process, its folder)."""
    folder = tmp_path_factory.mktemp("train")
    return run("train", *TINY, "--episodes", "1", "--out", "whole", "--json", cwd=folder), \
        folder / "whole"


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
    assert set(os.listdir(folder)) - {"curve.png"} == {"curve.csv", "expert.npz", "replay.npz",
                                                       "student.npz"}
    with open(folder / "curve.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(r["decisions"]) for r in rows] == [1000, 2000, 3000]
    assert tuple(rows[0]) == fac.TRAINING_CURVE and rows[0]["value"] == ""
    assert float(rows[-1]["value"]) > 0
    # every 2000 decisions, and what came out; in the row whose weights were tested
    assert [bool(r["eval_expert"] and r["eval_student"]) for r in rows] == [False, True, True]
    assert fac.Replay(folder / "replay.npz").transitions == 3000
    distilled = run("distill", "--task", "reacher-easy", "--expert", folder, "--steps", "3",
                    "--own-episodes", "0", "--episodes", "1", "--plan-samples", "8",
                    "--plan-iterations", "1", "--held-out", "0.5", "--json", cwd=tmp_path)
    assert last_json(distilled)["steps"] == 3


def test_the_number_of_workers_changes_nothing(trained, tmp_path):
    succeeded(run("train", *TINY, "--workers", "2", "--out", "other",
                  cwd=tmp_path))
    for kind in ("expert", "student"):
        assert weights(tmp_path / "other", kind) == weights(trained[1], kind)


def test_a_run_may_begin_without_random_episodes(tmp_path):
    done = run("train", *TINY, "--seed-decisions", "0", "--steps", "1000", "--out", "run", "--json",
               cwd=tmp_path)
    assert last_json(done)["steps"] == 1000


def test_a_killed_run_goes_on_to_the_same_result(trained, tmp_path):
    out = tmp_path / "killed"
    stopped = run("train", *TINY, "--minutes", "1e-9", "--out", out, "--json", cwd=tmp_path)
    assert last_json(stopped)["done"] is False and "goes on" in stopped.stderr
    process = subprocess.Popen([sys.executable, fac.__file__, "train", *TINY,
                                "--out", out], stderr=subprocess.DEVNULL,
                               stdout=subprocess.DEVNULL)
    deadline = time.time() + 100
    while not (out / "curve.csv").exists() and time.time() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    for _ in range(20):  # a round at a time, until something has been learned
        if fac.read_npz(out / "checkpoint.npz", ("checkpoint",))[0]["updates"]:
            break
        last_json(run("train", *TINY, "--minutes", "1e-2", "--out", out, "--json", cwd=tmp_path))
    before = fac.read_npz(out / "checkpoint.npz", ("checkpoint",))[0]
    assert before["updates"] > 0 and before["decisions"] < 3000
    succeeded(run("train", *TINY, "--resume", "--out", out, cwd=tmp_path))
    for kind in ("expert", "student"):
        assert weights(out, kind) == weights(trained[1], kind)


@pytest.mark.parametrize("flags, parts", [
    (["--task", "reacher-eesy"], ["did you mean 'reacher-easy'"]),
    (["--resume"], ["checkpoint.npz", "nothing to resume"]),
    (["--steps", "10"], ["steps", "1000"]),
    (["--envs", "0"], ["envs", "at least 1"]),
    (["--workers", "0"], ["workers", "at least 1"]),
    (["--lr", "0"], ["lr", "above 0"]),
    (["--lr", "inf"], ["lr", "finite"]),
    (["--updates-per-step", "nan"], ["updates_per_step", "nan"]),
    (["--mlp-dim", "0"], ["mlp_dim", "at least 1"]),
    (["--distill-horizon", "3"], ["4 actions", "hold 3"]),
    (["--num-agents", "2"], ["[1, 3]"]),
    (["--num-agents", "0"], ["[1, 3]"]),
    (["--horizon", "501"], ["horizon", "500"]),
    (["--updates-per-step", "inf"], ["updates_per_step", "finite"]),
    (["--std-start", "3"], ["std_start", "2.0"]),
    (["--distill-batch-size", "3"], ["--distill-batch-size"]),
    (["--out", fac.__file__], ["can't be written"]),
    (["--out", "x" * 300], ["can't be written"]),
    (["--evaluate-every", "0"], ["evaluate"]),
    (["--evaluate-episodes", "0"], ["evaluate"]),
    (["--episodes", "-1"], ["--episodes"]),
])
def test_train_refuses(tmp_path, flags, parts):
    refused(run("train", *TINY, *flags, cwd=tmp_path), *parts)


def test_other_settings_and_broken_checkpoints_are_refused(tmp_path):
    out = tmp_path / "run"
    succeeded(run("train", *TINY, "--minutes", "1e-9", "--out", out, cwd=tmp_path))
    before = (out / "checkpoint.npz").read_bytes()
    refused(run("train", *TINY, "--out", out, "--lr", "0.01", cwd=tmp_path), "checkpoint.npz", "lr",
            "0.01")
    assert (out / "checkpoint.npz").read_bytes() == before
    (out / "checkpoint.npz").write_bytes(before[:1000])
    refused(run("train", *TINY, "--out", out, cwd=tmp_path), "checkpoint.npz", "not a readable")
    for key in ("slow", "student adam_v"):
        (out / "checkpoint.npz").write_bytes(before)
        header, arrays = fac.read_npz(out / "checkpoint.npz", ("checkpoint",))
        del arrays[key]
        fac.write_npz(out / "checkpoint.npz", header, arrays)
        refused(run("train", *TINY, "--out", out, cwd=tmp_path), "checkpoint.npz", key)


def test_the_lag_is_counted_from_the_expert_s_crossing():
    def row(decisions, expert, student):
        return [decisions] + [None] * (len(fac.TRAINING_CURVE) - 3) + [expert, student]

    curve = [row(1000, None, None), row(2000, 400.0, 0.0), row(4000, 800.0, 500.0),
             row(6000, 1000.0, 700.0)]
    assert fac.lag(curve, 0.4) == 2000 and fac.lag(curve, 0.7) == 2000
    assert fac.lag(curve, 0.9) is None and fac.lag(curve[:1], 0.5) is None
    assert json.dumps(fac.lag([row(2000, 0.0, 0.0)], 0.5)) == "null"
