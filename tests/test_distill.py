"""Algorithm 1 end to end on a small expert."""
import numpy as np
import pytest

import fac_tdmpc_ref as fac
from test_planning import random_model

CONFIG = fac.DistillConfig(steps=300, batch_size=16, warmup=20, lr=3e-3, horizon=3)


def write_replay(path, task="", mark=None):
    """24 episodes of 30 decisions; `mark`: what the held-out episodes' observations are set to."""
    rng = np.random.default_rng(0)
    observation = rng.standard_normal((24 * 31, 8)).astype(np.float16)
    action = rng.uniform(-1, 1, (24 * 31, 3)).astype(np.float16)
    continues = np.tile(np.arange(31) < 30, 24)
    if mark:
        observation[np.arange(24 * 31) // 31 == 19] = mark  # CONFIG holds out one in 20
    fac.write_npz(path, {"kind": "replay", "task": task}, {
        "observation": observation, "action": action, "continues": continues})
    return fac.Replay(path)


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    return write_replay(tmp_path_factory.mktemp("replay") / "replay.npz")


def distilled(replay, config, steps, num_agents=None, seed=0):
    expert = random_model(n=1, policy=True)
    distiller = fac.Distiller(expert, replay, config, num_agents, seed)
    losses = np.array([distiller.step() for _ in range(steps)])
    distiller.close()
    return distiller, losses


def rank(distiller):
    return fac.rank_correlation(distiller, 64, seed=0)


@pytest.mark.parametrize("settings", [{}, {"encoder_input": "observation", "kl": "reverse"}])
def test_the_student_learns_the_experts_order(replay, settings):
    config = fac.dataclasses.replace(CONFIG, **settings)
    fresh, _ = distilled(replay, config, 0)
    before = rank(fresh)
    weights = {k: v.copy() for k, v in fresh.expert.params.items()}
    distiller, losses = distilled(replay, config, config.steps)
    assert losses[-30:, 0].mean() < 0.7 * losses[:30, 0].mean()
    assert losses[-30:, 1].mean() < losses[:30, 1].mean()
    assert losses[-30:, 2].mean() < losses[:30, 2].mean()
    after = rank(distiller)
    assert after.shape == (4,) and (after > before + 0.2).all() and after[0] > 0.6
    for key, value in distiller.expert.params.items():
        assert np.array_equal(value, weights[key]), "the expert is frozen"
    for key, value in distiller.student.params.items():
        assert value.dtype == np.float32
        if key.startswith("_expert"):
            assert np.array_equal(value, weights[key[len("_expert"):]])


def test_rank_correlation_of_the_expert_with_itself_is_one(replay):
    distiller, _ = distilled(replay, CONFIG, 0)
    distiller.student = distiller.expert  # reads observations, as N = 1 does
    assert np.allclose(rank(distiller), 1, atol=1e-6)


def test_same_seed_same_student(replay):
    students = [distilled(replay, CONFIG, 5, seed=seed)[0].optimizer.vector for seed in (1, 1, 2)]
    assert np.array_equal(students[0], students[1])
    assert not np.array_equal(students[0], students[2])


def own_episode(observation):
    """An episode of one observation and one action."""
    steps = fac.EPISODE_STEPS
    return np.full((steps + 1, 8), observation), np.full((steps, 3), 0.25), np.zeros(steps)


def go_on(distiller, steps):
    distiller._teacher = fac.ThreadPoolExecutor(1)
    with fac.one_thread():  # it was closed before
        for _ in range(steps):
            distiller.step()
    distiller.close()


@pytest.mark.parametrize("own", [False, True])
def test_a_resumed_run_ends_as_an_uninterrupted_one(replay, own):
    whole, _ = distilled(replay, CONFIG, 5)
    if own:
        whole.add([own_episode(0.5), own_episode(-0.5)])
    go_on(whole, 7)
    second, _ = distilled(replay, CONFIG, 3)  # somewhere else, then put back
    second.load({k: np.copy(v) for k, v in whole.state().items()})
    go_on(whole, 8)
    go_on(second, 8)
    assert np.array_equal(whole.optimizer.vector, second.optimizer.vector)
    without, _ = distilled(replay, CONFIG, 20)
    assert np.array_equal(whole.optimizer.vector, without.optimizer.vector) != own


def test_a_share_of_each_batch_is_the_students_own(replay):
    config = fac.dataclasses.replace(CONFIG, encoder_input="observation", own_share=0.25,
                                     noise_std=1e-3, noise_std_min=1e-3)
    distiller, _ = distilled(replay, config, 0)
    before = distiller.batch(7)
    distiller.add([own_episode(7), own_episode(8)])
    distiller.add([own_episode(9)])
    assert len(distiller.own) == 3 and distiller.own_count == 4
    seen = set()
    for t in range(20):
        (features,), actions, _ = distiller.batch(t)
        own = features.min(0) >= 7
        assert own.sum() == 4 and np.abs(actions[:, :, own] - 0.25).max() < 0.01
        seen |= set(features[0, own])
    assert seen == {7, 8, 9}
    (features,), actions, _ = distiller.batch(7)
    assert np.array_equal(features[:, 4:], before[0][0][:, 4:]), "the others are as they were"


@pytest.mark.parametrize("n", [1, 3])
def test_any_divisor_of_the_actions(replay, n):
    distiller, losses = distilled(replay, CONFIG, 2, n)
    assert distiller.student.config.num_agents == n
    assert distiller.student.config.mlp_dim == max(512 // n, 50)
    assert np.isfinite(losses).all()


def test_other_numbers_of_agents_are_refused(replay):
    for n in (2, 0, 4):
        with pytest.raises(fac.UserError, match=r"one of \[1, 3\]"):
            fac.Distiller(random_model(n=1), replay, CONFIG, n)


def test_sizes_of_section_5_1():
    expert = fac.ModelConfig(8, 12, 1, 50, 256, 512)
    assert fac.student_config(expert, 12, "section51", "latent").latent_dim == 42
    assert fac.student_config(expert, 12, "table2", "latent").latent_dim == 50
    assert fac.student_config(expert, 12, "table2", "latent").expert_latent_dim == 50
    assert fac.student_config(expert, 12, "table2", "observation").expert_latent_dim == 0


def test_learning_rate_schedule():
    rates = [fac.learning_rate(CONFIG, t) for t in range(CONFIG.steps)]
    assert rates[0] < rates[10] < rates[19] <= CONFIG.lr and rates[-1] < 0.001 * CONFIG.lr
    constant = fac.dataclasses.replace(CONFIG, **fac.paper_preset(fac.DistillConfig))
    assert {fac.learning_rate(constant, t) for t in range(50)} == {1e-4}


def test_held_out_episodes_are_for_the_rank_correlation_alone(tmp_path, monkeypatch):
    replay = write_replay(tmp_path / "replay.npz", mark=50)
    config = fac.dataclasses.replace(CONFIG, encoder_input="observation")
    distiller, _ = distilled(replay, config, 0)
    for t in range(40):
        assert np.abs(distiller.batch(t)[0]).max() < 10
    seen, perturbed_batch = [], fac.perturbed_batch

    def watched(expert, student, obs, *rest):
        seen.append(obs)
        return perturbed_batch(expert, student, obs, *rest)

    monkeypatch.setattr(fac, "perturbed_batch", watched)
    rank(distiller)
    assert len(seen) == 1 and (seen[0] == 50).all()


def test_new_targets_reach_the_batch(tmp_path):
    """Half of reacher's states get another target, the rest of them is as it was [D7]."""
    config = fac.dataclasses.replace(CONFIG, encoder_input="observation", batch_size=4000)
    obs = {}
    for task in ("reacher-hard", "walker-walk"):
        replay = write_replay(tmp_path / f"{task}.npz", task)
        distiller, _ = distilled(replay, config, 0)
        obs[task] = distiller.batch(0)[0][0]
    moved = (obs["reacher-hard"] != obs["walker-walk"])
    assert moved[3].mean() > 0.45 and np.array_equal(moved[3], moved[4]) and moved[3].mean() < 0.55
    assert not np.delete(moved, [3, 4], 0).any()
    seen = obs["reacher-hard"][:, moved[3]]
    heading = np.cumsum(seen[:3], 0)
    target = seen[3:5] + 0.09 * np.stack([np.cos(heading).sum(0), np.sin(heading).sum(0)])
    assert np.hypot(*target).max() < 0.201 and np.hypot(*target).min() > 0.049
    assert abs(np.corrcoef(*target)[0, 1]) < 0.1  # x and y are two coordinates


def test_no_two_uses_of_a_seed_share_numbers():
    """NumPy pads a short key with zeros, so that [seed, 3] and [seed, 3, 0] are one stream."""
    draws = {fac.stream(seed, use, i).integers(2 ** 62) for seed in (0, 3, 2 ** 40)
             for use in ("batch", "own episode", "student") for i in (0, 1, 3)}
    assert len(draws) == 27
    assert fac.stream(0, "batch").random() == fac.stream(0, "batch", 0).random()
