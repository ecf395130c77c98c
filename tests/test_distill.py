"""Algorithm 1 end to end on a small expert."""
import contextlib
import functools

import numpy as np
import pytest

import fac_tdmpc_ref as fac
from toys import CONFIG, distilled, ramp, random_model, write_replay


def fresh(replay, config):
    """A distiller before its first step, to be closed."""
    return contextlib.closing(fac.Distiller(random_model(n=1, policy=True), replay, config))


def test_a_student_is_no_expert(replay):
    """Its encoder reads an expert's latent: no student's file could hold it as its own expert's."""
    with fresh(replay, CONFIG) as distiller:
        with pytest.raises(fac.UserError, match="this is a student"):
            fac.Distiller(distiller.student, replay, CONFIG)


def rank(distiller):
    """Of Q at each h."""
    return distiller.ranks(64)[0]


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
        if key.startswith("_prior"):
            assert np.array_equal(value, fresh.student.params[key]), "priors learn by themselves"


def test_rank_correlation_of_the_expert_with_itself_is_one(replay):
    distiller, _ = distilled(replay, CONFIG, 0)
    distiller.student = distiller.expert  # reads observations, as N = 1 does
    for of_q_or_return in distiller.ranks(64):
        assert of_q_or_return.shape == (4,) and np.allclose(of_q_or_return, 1, atol=1e-6)


def test_rank_correlations_are_over_32_sequences_discounted_as_planned(replay, monkeypatch):
    distiller, copies = distilled(replay, CONFIG, 0)[0], []
    weights = distiller.optimizer.vector  # of which some begin at zero
    weights += 0.1 * np.random.default_rng(0).standard_normal(len(weights))

    def watched(expert, student, obs, around, *rest):
        features, actions, predictions = fac.taught_batch(expert, student, obs, around, *rest)
        copies.append(actions.shape[3])
        for state, sequence in zip(obs.T, around[..., 0].transpose(2, 0, 1)):
            ((row, *_),) = np.nonzero((replay.observation == state).all(1))
            assert np.array_equal(replay.action[row:row + 4], sequence)  # what was done there
        return features, actions, predictions

    monkeypatch.setattr(distiller, "perturb", watched)
    _, of_rewards, *_ = distiller.ranks(16, 0.0)
    assert set(copies) == {32}
    assert (of_rewards[1:] == of_rewards[1]).all() and of_rewards[0] != of_rewards[1]
    _, of_returns, *_ = distiller.ranks(16, 0.9)
    assert len(set(of_returns)) == 4 and of_returns[0] == of_rewards[0]  # Q alone


def test_rank_correlations_are_spearman_s():
    from scipy.stats import spearmanr
    x = np.random.default_rng(0).standard_normal((3, 9))
    y = np.exp(3 * x) + np.random.default_rng(1).standard_normal((3, 9))
    np.testing.assert_allclose(fac.spearman(x, y), [spearmanr(a, b)[0] for a, b in zip(x, y)])


@pytest.mark.parametrize("steps", [0, 5])
def test_same_seed_same_student(replay, steps):
    students = [distilled(replay, CONFIG, steps, seed=seed)[0].optimizer.vector
                for seed in (1, 1, 2)]
    assert np.array_equal(students[0], students[1])
    assert not np.array_equal(students[0], students[2])


def go_on(distiller, steps):
    distiller._threads = distiller._halves.threads = fac.ThreadPoolExecutor(3)
    with fac.one_thread():  # it was closed before
        for _ in range(steps):
            distiller.step()
    distiller.close()


def played(*values):
    """Episodes of one observation each and actions of -0.9, as `Distiller.add` takes them."""
    return (np.zeros((len(values), fac.EPISODE_STEPS, 8)) + np.array(values)[:, None, None],
            np.full((len(values), fac.EPISODE_STEPS, 3), -0.9))


@pytest.mark.parametrize("pool, own", [(4096, False), (64, False), (64, True)])
def test_a_resumed_run_ends_as_an_uninterrupted_one(replay, monkeypatch, pool, own):
    monkeypatch.setattr(fac, "POOL", pool)  # a pool of 64 lasts 16 steps
    whole, _ = distilled(replay, CONFIG, 5)
    if own:
        whole.add(*played(0.5, -0.5))
    go_on(whole, 7)
    second, _ = distilled(replay, CONFIG, 3)  # somewhere else, then put back
    second.load({k: np.copy(v) for k, v in whole.state().items()})
    go_on(whole, 8)
    go_on(second, 8)
    assert np.array_equal(whole.optimizer.vector, second.optimizer.vector)
    without, _ = distilled(replay, CONFIG, 20)
    assert np.array_equal(whole.optimizer.vector, without.optimizer.vector) != own


def test_a_share_of_the_states_is_from_what_was_played(replay):
    """With what was done there, or what the policy would do."""
    config = fac.dataclasses.replace(CONFIG, encoder_input="observation", played_share=0.25,
                                     noise_std=1e-3, batch_size=400)
    with fresh(replay, config) as distiller:
        distiller.add(*played(7, 8))
        distiller.add(*played(9))
        (features,), actions, _ = distiller.batch(0)
        own = features[0] >= 7
        assert 0.18 < own.mean() < 0.32 and set(features[0, own]) == {7, 8, 9}
        expert, obs = distiller.expert, features[:, own]
        z, expected = expert.encode(obs), []
        for _ in actions:  # what the expert's policy does there
            expected.append(expert.policy(z)[0])
            z = expert.next(z, expected[-1][None])
        done, theirs = (np.abs(actions[:, :, own] - base).max((0, 1, 3)) < 0.01
                        for base in (-0.9, np.array(expected)[..., None]))
        assert (done ^ theirs).all() and 0.3 < done.mean() < 0.7
    with fresh(replay, fac.dataclasses.replace(config, expert_episodes=2)) as distiller:
        with pytest.raises(fac.UserError, match="expert_episodes=0"):
            next(distiller.run())
        distiller.add(*played(1, 2))
        next(distiller.run())


def test_played_episodes_may_be_of_any_length(replay):
    """NaN is past an end; sequences stay in their episode; those of H decisions serve nothing."""
    config = fac.dataclasses.replace(CONFIG, encoder_input="observation", played_share=1.0,
                                     policy_share=0.0, noise_std=1e-6)
    lengths, begin = [7, 3, 4], np.array([0, 100, 200])
    t = np.arange(9)
    values = np.where(t < np.array(lengths)[:, None], begin[:, None] + t, np.nan)
    with fresh(replay, config) as distiller:
        distiller.add(*(np.repeat(x[..., None], n, 2) for x, n in ((values, 8), (values / 512, 3))))
        distiller.add(np.full((1, 5, 8), 300), np.full((1, 5, 3), 300 / 512))
        assert distiller.lengths.tolist() == [7, 4, 5]
        (features,), actions, _ = distiller.draw(0, 0, 200)
    assert set(features[0]) == {0, 1, 2, 3, 200, 300}
    ramp = (features[0] < 300) * np.arange(4)[:, None]
    np.testing.assert_allclose(actions[:, 0, :, 0], (features[0] + ramp) / 512, atol=1e-3)


def test_played_episodes_that_are_too_short_are_refused(replay):
    with fresh(replay, CONFIG) as distiller:
        with pytest.raises(fac.UserError, match="played episodes: none has 4 decisions"):
            distiller.add(np.zeros((2, 3, 8)), np.zeros((2, 3, 3)))


def test_played_actions_begin_where_their_state_is(replay):
    obs, action = ramp()
    config = fac.dataclasses.replace(CONFIG, encoder_input="observation", played_share=1.0,
                                     noise_std=1e-6)
    with fresh(replay, config) as distiller:
        distiller.add(obs[None, :-1], action[None])
        (features,), actions, _ = distiller.draw(0, 0, 64)
    expected = (features[0] + np.arange(4)[:, None]) / 512
    done = (np.abs(actions[:, 0] - expected[..., None]) < 1e-4).all((0, 2))
    assert 0.3 < done.mean() < 0.7  # the others' are the policy's [D8]


def test_the_expert_s_policy_plays_first_with_noise_and_once(replay, tmp_path, monkeypatch):
    """A run that goes on learns from the same episodes, and plays none."""
    seen = []

    def play(model, task, planning, seeds, workers, label, environment, noise):
        seen.append((model, planning.prior, planning.iterations, seeds, noise))
        return played(*range(len(seeds)))

    monkeypatch.setattr(fac, "play", play)
    monkeypatch.setattr(fac.Distiller, "ranks", lambda *_: (np.zeros(4), np.zeros(4)))
    config = fac.dataclasses.replace(CONFIG, steps=8, batch_size=4, expert_episodes=3)
    for _ in range(2):
        with fresh(replay, config) as distiller:
            fac.train_student(distiller, tmp_path, {"task": "x"}, fac.PlannerConfig(), 0)
            assert len(distiller.lengths) == 3
    seeds = fac.training_seeds(0, "expert episode", 0, 3)
    assert len(set(seeds)) == 3 and len(seen) == 1
    assert seen[0][1:] == ("own", 0, seeds, 0.6) and seen[0][0].has_policy


@pytest.mark.parametrize("clip", [True, False])
def test_perturbed_actions_are_clipped_where_they_should_be(replay, clip):
    with fresh(replay, fac.dataclasses.replace(CONFIG, clip_actions=clip)) as distiller:
        assert (np.abs(distiller.draw(0, 0, 64)[1]).max() <= 1) == clip


def test_perturbations_are_of_their_deviation_and_each_its_own(replay):
    config = fac.dataclasses.replace(CONFIG, noise_std=0.3, noise_samples=51, clip_actions=False)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (4, 3, 20, 1)).astype(np.float32)
    with fresh(replay, config) as distiller:
        _, perturbed, _ = fac.taught_batch(distiller.expert, distiller.student,
                                              np.zeros((8, 20), np.float32), actions, config, rng)
    assert np.array_equal(perturbed[..., :1], actions)
    noise = (perturbed - actions)[..., 1:]
    assert noise.shape == (4, 3, 20, 50)
    assert abs(noise.std() / 0.3 - 1) < 0.03 and abs(noise.mean()) < 0.02
    for axis in range(4):  # of step, dimension, state and copy
        one, two = np.moveaxis(noise, axis, 0)[:2]
        assert abs(np.corrcoef(one.ravel(), two.ravel())[0, 1]) < 0.2


def test_no_two_parts_of_a_pool_share_perturbations(replay):
    with fresh(replay, CONFIG) as distiller:
        parts = [distiller.draw(number, part, 8)[1].tobytes()
                 for number in (0, 1) for part in (0, 1)]
    assert len(set(parts)) == 4


def test_each_state_of_a_pool_is_learned_from_as_often_as_it_says(replay, monkeypatch):
    """In another order each time; then comes a new pool."""
    monkeypatch.setattr(fac, "POOL", 64)
    pools = []
    for number in (0, 1):
        with fresh(replay, fac.dataclasses.replace(CONFIG, reuse=3)) as distiller:
            batches = [distiller.batch(t)[1] for t in range(12 * number, 12 * (number + 1))]
        passes = [np.concatenate(batches[i:i + 4], 2) for i in (0, 4, 8)]
        assert not np.array_equal(passes[0], passes[1])
        keys = [{passes[r][:, :, b].tobytes() for b in range(64)} for r in range(3)]
        assert keys[0] == keys[1] == keys[2] and len(keys[0]) == 64
        pools.append(keys[0])
    assert not pools[0] & pools[1]


@pytest.mark.parametrize("targets", ["joint", "credit"])
def test_the_batch_s_predictions_are_the_experts_for_its_actions(replay, targets):
    """Or, of each agent, its part of how they differ from those for the actions without noise."""
    config = fac.dataclasses.replace(CONFIG, encoder_input="observation", targets=targets)
    with fresh(replay, config) as distiller:
        (obs,), actions, found = distiller.batch(3)
    expected = fac.predict(distiller.expert, distiller.expert.encode(obs), actions)
    if targets == "credit":
        assert all(parts.shape[:2] == (3, 4) for parts in found)
        reward, q1, q2 = expected
        expected = [y - y[..., :1] for y in (reward, (q1 + q2) / 2, (q1 + q2) / 2)]
        found = [parts.sum(0) for parts in found]
    for output, target in zip(expected, found):
        np.testing.assert_allclose(output, target, rtol=1e-4, atol=2e-5)


def test_with_credit_a_state_s_first_copy_is_not_perturbed(replay):
    """Half of the states' copies are around what was done, half around what the policy would do."""
    config = fac.dataclasses.replace(CONFIG, encoder_input="observation", targets="credit")
    with fresh(replay, config) as distiller:
        (obs,), actions, _ = distiller.draw(0, 0, 200)
        expert = distiller.expert
        z = expert.encode(obs)
        policy = fac.policy_rollout(expert, z, [np.float32(0)] * 4)[:, 0]
        _, joint, _ = fac.taught_batch(expert, distiller.student, obs, policy[..., None],
                                          fac.dataclasses.replace(config, targets="joint"),
                                          np.random.default_rng(0))
    theirs = (np.abs(actions[..., 0] - policy) < 1e-5).all((0, 1))
    assert 0.4 < theirs.mean() < 0.6
    done = distiller.replay.action.astype(np.float32)
    assert all((np.abs(done - a).max(1) < 1e-3).any() for a in actions[0, :, ~theirs, 0][:20])
    assert (actions[..., 1] != actions[..., 0]).mean() > 0.8  # where noise is not clipped away
    assert (joint[..., 0] != policy).mean() > 0.8


def test_the_number_of_threads_changes_no_bit(replay, monkeypatch):
    monkeypatch.setattr(fac, "PART", 16)  # of a pool: four parts
    config, found = fac.dataclasses.replace(CONFIG, batch_size=5, steps=48, reuse=4), []
    for threads in (1, 2, 4):
        with fresh(replay, config) as distiller:
            distiller._threads.shutdown()
            distiller._threads = distiller._halves.threads = fac.ThreadPoolExecutor(threads)
            losses = [distiller.step() for _ in range(15)]
            found.append((losses, distiller.optimizer.vector.tobytes()))
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize("batch", [2, 5, 16])
def test_a_step_in_halves_is_the_step_of_the_whole(replay, batch):
    config = fac.dataclasses.replace(CONFIG, batch_size=batch, warmup=0, grad_clip=1e9)
    seen = []
    with fresh(replay, config) as distiller:
        loss, *means = fac.distill_loss(distiller.student, *distiller.batch(0), config,
                                        distiller.optimizer.grads)
        gradient = distiller.optimizer.gradient.copy()
        distiller.optimizer.gradient[:] = 0
        distiller.optimizer.step = lambda *_: seen.append(distiller.optimizer.gradient.copy())
        found = distiller.step()
    np.testing.assert_allclose(found, (loss, *means), rtol=1e-5)
    np.testing.assert_allclose(seen[0], gradient, rtol=1e-3, atol=1e-5 * np.abs(gradient).max())


def test_a_step_learns_at_its_rate_and_clips_its_gradient(replay, monkeypatch):
    config, seen = fac.dataclasses.replace(CONFIG, grad_clip=0.5), []
    with fresh(replay, config) as distiller:
        step = distiller.optimizer.step
        monkeypatch.setattr(distiller.optimizer, "step",
                            lambda lr, clip: seen.append((lr, clip)) or step(lr, clip))
        for _ in range(3):
            distiller.step()
    assert seen == [(fac.learning_rate(config, t), 0.5) for t in range(3)]
    assert len({lr for lr, _ in seen}) == 3


def test_returns_over_every_horizon_are_equation_2():
    """What the rank correlation of G is taken of, against what planning uses."""
    model, rng = random_model(), np.random.default_rng(3)
    z = model.encode(rng.standard_normal((8, 1), np.float32))
    actions = rng.uniform(-1, 1, (4, 3, 1, 6)).astype(np.float32)
    found = fac.horizon_returns(*fac.predict(model, z, actions), 0.9)
    for horizon in range(4):
        config = fac.PlannerConfig(horizon=horizon, discount=0.9)
        expected = fac.h_step_return(model, z, actions[:, :, 0].swapaxes(0, 1)[:, :, None], config)
        np.testing.assert_allclose(found[horizon, 0], expected.sum(0), rtol=1e-4)


@pytest.mark.parametrize("n", [1, 3])
def test_any_divisor_of_the_actions(replay, n):
    distiller, losses = distilled(replay, CONFIG, 2, n)
    assert distiller.student.config.num_agents == n
    assert distiller.student.config.mlp_dim == 50  # at least; its expert has 24
    assert np.isfinite(losses).all()


def test_hidden_layers_share_the_expert_s_width_and_have_50_units_or_more(tmp_path):
    rng = np.random.default_rng(0)
    fac.write_npz(tmp_path / "replay.npz", {"kind": "replay"}, {
        "observation": rng.standard_normal((60, 8)).astype(np.float16),
        "action": rng.uniform(-1, 1, (60, 12)).astype(np.float16),
        "continues": np.arange(1, 61) % 10 != 0})
    expert = random_model(1, 12, hidden=512, policy=True)
    config = fac.dataclasses.replace(CONFIG, held_out=0.3)
    for n, width in ((12, 50), (6, 85)):  # 512 // 12 is 42
        with contextlib.closing(fac.Distiller(expert, fac.Replay(tmp_path / "replay.npz"), config,
                                              n)) as distiller:
            assert distiller.student.config.mlp_dim == width


def test_what_diverges_stops(replay):
    with fresh(replay, CONFIG) as distiller:
        distiller.optimizer.vector[:] = np.nan
        with pytest.raises(fac.UserError, match="after update 1 the loss is no longer finite"):
            list(distiller.run())


def test_other_numbers_of_agents_are_refused(replay):
    for n in (2, 0, 4):
        with pytest.raises(fac.UserError, match=r"one of \[1, 3\]"):
            fac.Distiller(random_model(n=1, policy=True), replay, CONFIG, n)


def test_sizes_of_a_student():
    expert = fac.ModelConfig(8, 12, 1, 60, 256, 512)
    for agents, hidden in ((1, 512), (3, 170), (12, 50)):
        found = fac.student_config(expert, agents, "latent")
        assert (found.latent_dim, found.mlp_dim, found.expert_latent_dim) == (50, hidden, 60)
    assert fac.student_config(expert, 12, "observation").expert_latent_dim == 0


def test_what_learns_keeps_its_memory(replay):
    from numpy_learner import ExpertConfig, Learner
    for make in (lambda: fresh(replay, CONFIG), lambda: Learner(
            fac.ModelConfig(8, 3, 1, 4, 5, 5), ExpertConfig(), np.random.default_rng(0))):
        fac.keep_memory.cache_clear()
        made = make()
        assert fac.keep_memory.cache_info().currsize == 1, made


def test_learning_rate_schedule():
    rates = [fac.learning_rate(CONFIG, t) for t in range(CONFIG.steps)]
    assert rates[0] < rates[10] < rates[19] <= CONFIG.lr and rates[-1] < 0.001 * CONFIG.lr
    constant = fac.dataclasses.replace(CONFIG, **fac.preset_values(fac.DistillConfig, "paper"))
    assert {fac.learning_rate(constant, t) for t in range(50)} == {1e-4}


def test_held_out_episodes_are_for_the_rank_correlation_alone(tmp_path, replay, monkeypatch):
    observation = replay.observation.copy()
    observation[np.isin(np.arange(24 * 31) // 31, (9, 19))] = 50  # CONFIG holds out one in 10
    replay = fac.Replay(write_replay(tmp_path / "replay.npz", (8, 3), 24, 31, 0,
                                     observation=observation))
    config = fac.dataclasses.replace(CONFIG, encoder_input="observation")
    with fresh(replay, config) as distiller:
        for t in range(40):
            assert np.abs(distiller.batch(t)[0]).max() < 10
    seen = []

    def watched(expert, student, obs, *rest):
        seen.append(obs)
        return fac.taught_batch(expert, student, obs, *rest)

    monkeypatch.setattr(distiller, "perturb", watched)
    rank(distiller)
    assert len(seen) == 1 and (seen[0] == 50).all()


def test_no_two_uses_of_a_seed_share_numbers():
    """NumPy pads a short key with zeros, so that [seed, 3] and [seed, 3, 0] are one stream."""
    draws = {fac.stream(seed, use, i).integers(2 ** 62) for seed in (0, 3, 2 ** 40)
             for use in ("batch", "own episode", "student") for i in (0, 1, 3)}
    assert len(draws) == 27
    assert fac.stream(0, "batch").random() == fac.stream(0, "batch", 0).random()


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("odd", [
    {"batch_size": 2}, {"noise_samples": 2}, {"horizon": 0}, {"steps": 1}, {"reuse": 7},
    {"batch_size": 3, "reuse": 1}, {"warmup": 0}, {"lam": 0.0}])
def test_odd_settings_learn_all_the_same(replay, odd, n):
    config = fac.dataclasses.replace(CONFIG, **{"batch_size": 4, "steps": 3, **odd})
    distiller, losses = distilled(replay, config, config.steps, n)
    assert losses.shape == (config.steps, 3) and np.isfinite(losses).all() and (losses >= 0).all()
    assert np.isfinite(distiller.ranks(8)).all()


@pytest.mark.parametrize("encoder_input", ["latent", "observation"])
def test_sizes_of_one_s_own_leave_what_the_encoder_reads(tmp_path, replay, encoder_input):
    expert = random_model(n=1, policy=True)
    config = fac.dataclasses.replace(CONFIG, encoder_input=encoder_input)
    sizes = fac.student_config(expert.config, 3, encoder_input, 4)
    with contextlib.closing(fac.Distiller(expert, replay, config, mlp_dim=7)) as distiller:
        assert distiller.student.config == fac.dataclasses.replace(sizes, mlp_dim=7)
        distiller.step()
        fac.save_model(tmp_path / "student.npz", distiller.student, {"kind": "student"})
    student, _ = fac.load_model(tmp_path / "student.npz")
    assert student.encode(np.zeros((8, 2), np.float32)).shape == (3, sizes.latent_dim, 2)


def test_an_expert_without_a_policy_says_so(replay):
    expert = random_model(n=1)
    with pytest.raises(fac.UserError, match="no policy.*--policy-share 0 --expert-episodes 0"):
        fac.Distiller(expert, replay, CONFIG)
    without = fac.dataclasses.replace(CONFIG, policy_share=0.0, priors=False)
    for more in ({"policy_share": 0.5}, {"expert_episodes": 1}, {"priors": True}):
        with pytest.raises(fac.UserError, match="no policy to learn from.*--no-priors"):
            fac.Distiller(expert, replay, fac.dataclasses.replace(without, **more))
    fac.Distiller(expert, replay, without).close()


@pytest.mark.parametrize("num_agents", [1, 3])
def test_the_distiller_is_algorithm_1_in_less_time(replay, monkeypatch, num_agents):
    """The same batches as Part I's loop, one a pool: the same weights to rounding."""
    monkeypatch.setattr(fac, "POOL", 16)
    config = fac.dataclasses.replace(CONFIG, steps=30, targets="joint", policy_share=0.0, reuse=1)
    fast, losses = distilled(replay, config, 30, num_agents)
    plain = list(fac.distill(random_model(n=1, policy=True), replay, config, num_agents))
    student = plain[-1][0]
    for key in fast.optimizer.params:
        if key in ("_reward.4.bias", "_Q1.5.bias", "_Q2.5.bias"):  # a softmax knows no constants:
            continue  # Adam enlarges the rounding of a gradient of zero
        np.testing.assert_allclose(fast.student.params[key], student.params[key], rtol=0,
                                   atol=2e-4, err_msg=key)
    np.testing.assert_allclose([found for _, found in plain], losses, rtol=1e-3)
    assert losses[-1, 0] < 0.97 * losses[0, 0]


PLAIN = fac.dataclasses.replace(CONFIG, targets="joint", policy_share=0.0, reuse=1, priors=False)


def test_a_plain_run_that_is_resumed_ends_as_the_loop_itself(replay):
    expert = random_model(n=1, policy=True)
    make = functools.partial(fac.PlainDistiller, expert, replay, PLAIN)
    with contextlib.closing(make()) as first, contextlib.closing(make()) as second:
        for _ in range(3):
            first.step()
        second.load(first.state())
        for _ in range(4):
            second.step()
        loop = fac.distill(expert, replay, PLAIN)
        student, _ = [next(loop) for _ in range(7)][-1]
        assert all(np.array_equal(second.student.params[key], value)
                   for key, value in student.params.items())


def test_a_plain_step_takes_one_thread_as_every_other(replay, monkeypatch):
    from threadpoolctl import threadpool_limits
    seen = []

    def watched(*arguments):
        for found in plain(*arguments):
            seen.extend(pool["num_threads"] for pool in fac._thread_pools().info()
                        if pool["user_api"] == "blas")  # not SciPy's, loaded later
            yield found

    plain = fac.distill
    monkeypatch.setattr(fac, "distill", watched)
    with threadpool_limits(2), contextlib.closing(
            fac.PlainDistiller(random_model(n=1, policy=True), replay, PLAIN)) as distiller:
        distiller.step()
    assert set(seen) == {1}
