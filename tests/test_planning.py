"""MPPI on problems with known answers, Proposition 1, the fast returns, and the workers."""
import contextlib
import multiprocessing
import os
import platform
import signal
import subprocess
import sys
import time
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import fac_tdmpc_ref as fac
from toys import random_model, student_of


def streams(n, seed=0):
    return [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(n)]


def quadratic(target):
    """G = -|a - target|^2 for each agent: a linear-quadratic problem with optimum `target`."""
    return lambda actions: -((actions - target[..., None]) ** 2).sum((1, 2))


CONFIG = fac.PlannerConfig(samples=512, iterations=20, inverse_temperature=2.0, min_std=0.01)


@pytest.mark.parametrize("n, d", [(1, 3), (3, 1), (2, 2)])
def test_mppi_reaches_the_optimum(n, d):
    target = np.random.default_rng(0).uniform(-0.8, 0.8, (n, 4, d)).astype(np.float32)
    mean, elites, weights = fac.mppi(quadratic(target), np.zeros_like(target), CONFIG, streams(n))
    assert np.abs(mean - target).max() < 0.1
    assert mean.dtype == elites.dtype == weights.dtype == np.float32
    assert np.allclose(weights.sum(1), 1, atol=1e-6) and (weights >= 0).all()
    assert elites.shape == (n, 4, d, CONFIG.num_elites)


def test_mppi_respects_the_bounds():
    target = np.full((2, 4, 1), 3, np.float32)  # outside: the best allowed action is 1
    mean, elites, _ = fac.mppi(quadratic(target), np.zeros_like(target), CONFIG, streams(2))
    assert np.abs(elites).max() <= 1 and np.abs(mean).max() <= 1 and mean.min() > 0.9


def test_elites_are_the_best_of_each_agent():
    seen = []

    def returns(actions):
        G = quadratic(np.zeros((2, 3, 1), np.float32))(actions)
        seen.append((actions, G))
        return G

    config = fac.PlannerConfig(samples=40, elites=5, iterations=1)
    _, elites, weights = fac.mppi(returns, np.zeros((2, 3, 1), np.float32), config, streams(2))
    actions, G = seen[0]
    for i in range(2):
        best = np.argsort(-G[i])[:5]
        assert sorted(map(tuple, elites[i][..., :].reshape(3, -1).T.tolist())) == \
            sorted(map(tuple, actions[i][..., best].reshape(3, -1).T.tolist()))
        score = np.exp(config.inverse_temperature * (np.sort(G[i])[::-1][:5] - G[i].max()))
        assert np.allclose(np.sort(weights[i])[::-1], score / score.sum(), atol=1e-6)


@pytest.mark.parametrize("least", [0.05, 0.5])
def test_an_iteration_by_hand(least):
    """Sample 0 of the second one is its mean, sample 1 a tenth of its deviation away."""
    rng, seen = np.random.default_rng(0), []
    first = rng.standard_normal((3, 1, 40), np.float32)
    second = np.zeros_like(first)
    second[..., 1] = 0.1
    noise = iter((first, second))
    stream = SimpleNamespace(standard_normal=lambda *_: next(noise).copy())
    score = quadratic(np.full((1, 3, 1), 0.3, np.float32))
    mean = np.full((1, 3, 1), -0.4, np.float32)
    config = fac.PlannerConfig(samples=40, elites=5, iterations=2, momentum=0.25, min_std=least)
    fac.mppi(lambda actions: seen.append(actions[0].copy()) or score(actions), mean, config,
             [stream])
    G = score(seen[0][None])[0]
    best = np.argsort(-G)[:5]
    p = np.exp(0.5 * (G[best] - G.max()))
    p, elites = p / p.sum(), seen[0][..., best]
    middle = elites @ p
    std = np.sqrt((elites - middle[..., None]) ** 2 @ p)
    assert (std < 0.5).any()
    np.testing.assert_allclose(seen[1][..., 0], 0.25 * mean[0] + 0.75 * middle, atol=1e-6)
    np.testing.assert_allclose(seen[1][..., 1] - seen[1][..., 0], 0.1 * np.clip(std, least, 2),
                               atol=1e-6)


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_proposals_compete_in_every_iteration(iterations):
    """No sample hits the optimum, so that where it is the last elite it was proposed there."""
    target = np.array([[[0.3], [-0.4]]], np.float32)
    config = fac.PlannerConfig(samples=8, elites=1, iterations=iterations, momentum=0.0)
    mean, elites, _ = fac.mppi(quadratic(target), np.zeros_like(target), config, streams(1),
                               target[..., None])
    assert np.array_equal(elites[..., 0], target) and np.allclose(mean, target)


def test_proposals_are_scored_as_samples_are():
    target = np.array([[[0.3], [-0.4]]], np.float32)
    proposals = np.random.default_rng(0).uniform(-1, 1, (1, 2, 1, 20)).astype(np.float32)
    config = fac.PlannerConfig(samples=20, elites=20, iterations=1)
    _, elites, scores = fac.mppi(quadratic(target), np.zeros_like(target), config, streams(1),
                                 proposals)
    assert 0.2 < np.isin(elites, proposals).mean() < 0.9  # of both kinds
    expected = np.exp(0.5 * quadratic(target)(elites))
    np.testing.assert_allclose(scores, expected / expected.sum(), rtol=1e-5)


def test_an_elite_is_drawn_by_its_score_for_each_agent_alone():
    scores = np.array([[0.1, 0.2, 0.3, 0.4], [0.7, 0.0, 0.1, 0.2]], np.float32)
    elites = np.full((2, 3, 2, 4), 9, np.float32)  # (N, L, d, E)
    elites[:, 0] = np.arange(4) + 10 * np.arange(2)[:, None]  # 0 to 3, 10 to 13
    rngs = streams(2)
    drawn = np.array([fac.draw_elite(elites, scores, rngs) for _ in range(4000)])
    assert drawn.shape == (4000, 2, 3, 2) and (drawn[:, :, 1:] == 9).all()  # whole sequences
    drawn = drawn[:, :, 0]
    assert np.array_equal(drawn[:, :, 1], drawn[:, :, 0] + 10)  # both dimensions, of one elite
    for chosen, score in zip(drawn[:, :, 0].astype(int).T, scores):
        np.testing.assert_allclose(np.bincount(chosen, minlength=4) / 4000, score, atol=0.03)
    assert abs(np.corrcoef(drawn[:, :, 0].T)[0, 1]) < 0.1


def test_proposals_are_the_policy_s_actions_and_noise_of_their_own(monkeypatch):
    """Rolled out in the model: what is left where the policy's mean is taken away."""
    model, seen = random_model(1, policy=True), []
    for part in ("weight", "bias"):
        model.params[f"_pi.4.{part}"] *= 0.05  # small actions, which are not clipped
    monkeypatch.setattr(fac, "mppi", lambda returns, mean, config, rngs, proposals: (
        seen.append(proposals), (mean, mean[..., None], np.ones((1, 1))))[1])
    config = fac.PlannerConfig(samples=8, iterations=1, horizon=2, pi_trajs=300)
    fac.Planner(model, config).act(np.ones(8))
    ((proposals,),) = seen
    z, noise = np.repeat(model.encode(np.ones((8, 1), np.float32)), 300, 2), []
    for a in proposals:
        mean = model.policy(z)[0]
        noise.append(a - mean)
        z = model.next(z, a[None])
    assert np.shape(noise) == (3, 3, 300) and 0.01 < np.abs(mean).max() < 0.7
    for h in noise:
        np.testing.assert_allclose(h.std(1), 0.05, rtol=0.2)
    assert np.abs(np.corrcoef(np.reshape(noise, (9, -1))) - np.eye(9)).max() < 0.3


@pytest.mark.parametrize("horizon", [3, 1, 0])
@pytest.mark.parametrize("n", [1, 3])
def test_fast_returns_are_equation_2(n, horizon):
    model = random_model(n)
    config = fac.PlannerConfig(horizon=horizon, discount=0.8)
    rng = np.random.default_rng(1)
    fast = fac.Returns(model)
    for samples in (299, 5):  # two blocks, the last narrower; then buffers of another size
        z = model.encode(rng.standard_normal((8, 1), np.float32))
        actions = rng.uniform(-1, 1, (n, horizon + 1, 3 // n, samples)).astype(np.float32)
        fast.start(z, config)
        plain = fac.h_step_return(model, z, actions, config)
        assert fast(actions).dtype == plain.dtype == np.float32
        assert np.abs(fast(actions) - plain).max() < 1e-5 * np.abs(plain).max()


@pytest.mark.parametrize("horizon", [0, 2])
def test_equation_2_written_out(horizon):
    """H discounted rewards, then Q of action H + 1: here by hand, sample by sample."""
    model, rng = random_model(), np.random.default_rng(2)
    z = model.encode(rng.standard_normal((8, 1), np.float32))
    actions = rng.uniform(-1, 1, (3, horizon + 1, 1, 4)).astype(np.float32)
    found = fac.h_step_return(model, z, actions, fac.PlannerConfig(horizon=horizon, discount=0.9))
    for s in range(4):
        state, G = z, 0
        for h in range(horizon):
            G = G + 0.9 ** h * model.reward(state, actions[:, h, :, s:s + 1])
            state = model.next(state, actions[:, h, :, s:s + 1])
        q1, q2 = model.q(state, actions[:, horizon, :, s:s + 1])
        G = G + 0.9 ** horizon * (q1 + q2) / 2
        np.testing.assert_allclose(found[:, s], G[:, 0], rtol=1e-5, atol=1e-5)


def test_the_plain_return_can_be_planned_with(monkeypatch):
    """Who edits h_step_return sees it act; unedited it plans as the fast one does."""
    model, obs = random_model(), np.ones(8)
    fast, plain = (fac.PlannerConfig(samples=64, iterations=2, speed=form, output="mean")
                   for form in ("fast", "plain"))
    first = fac.Planner(model, fast).act(obs)
    np.testing.assert_allclose(fac.Planner(model, plain).act(obs), first, atol=1e-3)
    return_of = fac.h_step_return
    monkeypatch.setattr(fac, "h_step_return", lambda *args, **kw: -return_of(*args, **kw))
    assert np.array_equal(fac.Planner(model, fast).act(obs), first)
    assert not np.allclose(fac.Planner(model, plain).act(obs), first, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_proposition_1(seed):
    """The best joint sequence is the best of each agent: all 5^(2 * 3) joint ones are tried."""
    model = random_model(n=3, seed=seed)
    config, grid = fac.PlannerConfig(horizon=1), np.linspace(-1, 1, 5)
    z = model.encode(np.random.default_rng(seed).standard_normal((8, 1)).astype(np.float32))
    own = np.array(list(product(grid, repeat=2)), np.float32).T  # (L, 25)
    individual = fac.h_step_return(model, z, np.broadcast_to(own[None, :, None], (3, 2, 1, 25)),
                                   config)
    joint = np.array(list(product(range(25), repeat=3)))
    actions = own[:, joint].transpose(2, 0, 1)[:, :, None]  # (N, L, 1, 25^3)
    total = fac.h_step_return(model, z, np.ascontiguousarray(actions), config).sum(0)
    assert np.array_equal(joint[total.argmax()], individual.argmax(1))


def test_warm_start_shifts_by_one():
    model = random_model()
    config = fac.PlannerConfig(samples=32, iterations=1, horizon=2)
    planner, twin = fac.FastPlanner(model, config), fac.FastPlanner(model, config)
    z = model.encode(np.zeros((8, 1), np.float32))
    for one in (planner, twin):
        one.reset(np.random.SeedSequence(0).spawn(3))
    mean, _, _ = fac.mppi(twin.returns_from(z), twin.mean, config, twin.rngs)
    planner.plan(z)
    assert np.array_equal(planner.mean[:, :-1], mean[:, 1:])
    assert not planner.mean[:, -1].any() and planner.mean[:, :-1].any()
    planner.reset([])
    assert not planner.mean.any()


@pytest.mark.parametrize("output", ["mean", "sampled"])
def test_what_is_executed_is_what_is_asked_for(output):
    model = random_model()
    config = fac.PlannerConfig(samples=32, iterations=1, horizon=2, output=output)
    planner, z = fac.FastPlanner(model, config), model.encode(np.zeros((8, 1), np.float32))
    planner.reset(np.random.SeedSequence(0).spawn(3))
    twin = [np.random.Generator(np.random.SFC64(s)) for s in np.random.SeedSequence(0).spawn(3)]
    mean, *elites = fac.mppi(fac.Returns(model).start(z, config), planner.mean, config, twin)
    expected = mean if output == "mean" else fac.draw_elite(*elites, twin)
    assert np.array_equal(planner.plan(z), expected) and expected.shape == (3, 3, 1)


@pytest.mark.parametrize("output", ["sampled", "mean"])
@pytest.mark.parametrize("n", [1, 3])
def test_same_seed_same_plan(n, output):
    model = random_model(n, policy=n == 1)
    config = fac.PlannerConfig(samples=48, iterations=2, horizon=2, output=output)
    obs = np.random.default_rng(3).standard_normal((4, 8))
    plans = []
    for seed in (5, 5, 6):
        with fac.Planner(model, config, seed=seed) as planner:
            plans.append(np.array([planner.act(o) for o in obs]))
            planner.reset(seed)
            assert np.array_equal([planner.act(o) for o in obs], plans[-1])
    assert np.array_equal(plans[0], plans[1]) and not np.array_equal(plans[0], plans[2])
    assert plans[0].dtype == np.float32 and np.abs(plans[0]).max() <= 1


def test_policy_proposals_change_the_plan_of_the_expert_only():
    obs = np.ones(8)
    for n, differs in ((1, True), (3, False)):
        model = random_model(n, policy=n == 1)
        a, b = (fac.Planner(model, fac.PlannerConfig(samples=16, iterations=1, pi_trajs=p,
                                                     output="mean")).act(obs) for p in (0, 24))
        assert np.array_equal(a, b) != differs


def test_noisy_actions_of_a_policy_are_clipped():
    model = random_model(1, policy=True)
    z = model.encode(np.zeros((8, 2), np.float32))
    assert np.abs(fac.policy_rollout(model, z, [np.float32(2)] * 3)).max() == 1


def written_out(student, obs):
    """What a student's priors say, network by network, (N, L, d), of an observation (O,)."""
    p, sizes = student.params, student.config
    x = student.forward("_expert_encoder", obs[None, :, None])[0, :, 0]

    def layer(name, i, x):
        return p[f"{name}.weight"][i] @ x + p[f"{name}.bias"][i, :, 0]

    e = layer("_prior_encoder.2", 0, fac.elu(layer("_prior_encoder.0", 0, x)))
    plans = []
    for i, own in enumerate(e.reshape(sizes.num_agents, sizes.latent_dim)):
        for hidden in (0, 2):
            own = fac.elu(layer(f"_prior.{hidden}", i, own))
        plans.append(np.tanh(layer("_prior.4", i, own)).reshape(sizes.prior_steps, -1))
    return np.stack(plans)


def test_a_plan_of_no_iterations_is_what_the_prior_would_do(monkeypatch):
    """An expert's is its policy; and it costs no more: nothing is rolled out in the model, or
    encoded for it."""
    expert, obs = random_model(1, policy=True), np.linspace(-1, 1, 8, dtype=np.float32)
    student, config = student_of(expert), fac.PlannerConfig(prior="own", iterations=0)
    for key in [*student.params]:
        if key.startswith(("_encoder", "_dynamics", "_reward", "_Q")):
            student.params[key] = np.full_like(student.params[key], np.nan)
    monkeypatch.setattr(fac, "mppi", None)
    monkeypatch.setattr(fac.WorldModel, "next", None)
    z = expert.encode(obs[:, None])
    for model, expected in ((expert, expert.policy(z)[0, :, 0]),
                            (student, written_out(student, obs)[:, 0, 0])):
        for one in (config, fac.dataclasses.replace(config, horizon=0, output="mean")):
            with fac.Planner(model, one) as planner:
                plan, action = planner.plan(obs), planner.act(obs)
                assert np.array_equal(planner.act(obs), action)  # no mean is moved on
            assert plan.shape == (model.config.num_agents, 1, model.config.agent_actions)
            assert np.array_equal(plan.ravel(), action)
            np.testing.assert_allclose(action, expected, atol=1e-5)
    with pytest.raises(fac.UserError, match="iterations must be above 0 without a prior"):
        fac.Planner(model, fac.PlannerConfig(iterations=0))


@pytest.mark.parametrize("agents", [1, 3])
def test_a_reflex_is_the_prior_s_first_action_bit_for_bit_with_any_workers(agents):
    student = student_of(random_model(1, 6, policy=True), agents)
    reflex = fac.PlannerConfig(prior="own", iterations=0)
    for obs in np.random.default_rng(1).standard_normal((3, 8)).astype(np.float32):
        prior = student.prior(student.latents(obs[:, None], False), 1)[..., 0]
        assert prior.shape == (agents, 1, 6 // agents) and prior.any()
        np.testing.assert_allclose(prior, written_out(student, obs)[:, :1], atol=1e-5)
        whole = student.prior(student.latents(obs[:, None]), 4)[..., 0]
        assert np.array_equal(prior, whole[:, :1])  # whether the agents search or not
        for workers in range(min(3, agents)):
            with fac.Planner(student, reflex, workers=workers) as planner:
                assert np.array_equal(planner.plan(obs), prior)
                assert np.array_equal(planner.act(obs), prior.ravel())


def test_a_prior_names_its_steps_and_then_its_last_one_again():
    student, obs = student_of(random_model(1, policy=True)), np.ones(8, np.float32)
    latents, expected = student.latents(obs[:, None]), written_out(student, obs)
    assert np.abs(np.diff(expected, axis=1)).min() > 1e-4
    for steps in (1, 4, 6):
        found = student.prior(latents, steps)[..., 0]
        rows = np.minimum(np.arange(steps), 3)
        np.testing.assert_allclose(found, expected[:, rows], atol=1e-5)


@pytest.mark.parametrize("output", ["sampled", "mean"])
def test_a_search_around_the_prior_starts_there_every_time(monkeypatch, output):
    """In each agent's own plan, an expert's policy rolled out, with the first deviation for
    width."""
    expert, obs = random_model(1, policy=True), np.full(8, 0.3, np.float32)
    student = student_of(expert)
    config = fac.PlannerConfig(prior="own", samples=400, iterations=1, min_std=0.01,
                               max_std=0.01, horizon=2, output=output, pi_trajs=0)
    rollout = fac.policy_rollout(expert, expert.encode(obs[:, None]), [np.float32(0)] * 3)
    seen, returns = [], fac.Returns.__call__
    monkeypatch.setattr(fac.Returns, "__call__", lambda self, actions: (
        seen.append(actions), returns(self, actions))[1])
    for model, expected in ((student, written_out(student, obs)[:, :3]),
                            (expert, rollout[:, 0, :, 0][None])):
        planner = fac.Planner(model, config)
        for _ in range(2):
            planner.act(obs)
        assert np.abs(expected).max() > 0.1
        for actions in (seen.pop(0), seen.pop(0)):  # (N, L, d, S)
            assert np.abs(actions.mean(-1) - expected).max() < 0.01
            assert actions.std(-1).max() < 0.015


def test_a_prior_to_start_from_is_needed():
    for model in (random_model(1), random_model(3), student_of(random_model(1, policy=True),
                                                               prior_steps=0)):
        with pytest.raises(fac.UserError, match="no prior for plans.*--plan-prior last"):
            fac.Planner(model, fac.PlannerConfig(prior="own"))


def test_a_student_s_latents_are_its_agents_and_below_them_what_priors_read():
    """A search reads the first half alone, a reflex the second alone."""
    expert, obs = random_model(1, policy=True), np.random.default_rng(2).standard_normal((8, 5))
    student, plain = student_of(expert), student_of(expert, prior_steps=0)
    latents, reflex = student.latents(obs), student.latents(obs, False)
    assert latents.shape == (3, 12, 5) and np.array_equal(latents[:, 6:], reflex)
    assert np.array_equal(latents[:, :6], student.encode(obs))
    for model in (expert, plain):
        for search in (True, False):
            assert np.array_equal(model.latents(obs, search), model.encode(obs))
    latents, config = latents[..., :1], fac.PlannerConfig(samples=16, iterations=1, prior="own")
    planner, plans = fac.FastPlanner(student, config), []
    for spoil, moved in ((slice(0), False), (slice(6), True), (slice(6, 12), True)):
        spoilt = latents.copy()
        spoilt[:, spoil] += 1
        planner.reset(np.random.SeedSequence(0).spawn(3))
        plans.append(planner.plan(spoilt))
        assert np.array_equal(plans[-1], plans[0]) != moved
        assert np.array_equal(student.prior(spoilt, 4), student.prior(latents, 4)) != (
            spoil == slice(6, 12))


def test_an_observation_of_the_wrong_size_is_refused():
    with pytest.raises(fac.UserError, match=r"\(8,\), found \(7,\)"):
        fac.Planner(random_model()).act(np.zeros(7))


def test_an_observation_of_the_wrong_size_or_without_numbers_is_refused():
    with fac.Planner(random_model()) as planner:
        for wrong, text in ((np.zeros(7), r"\(8,\), found \(7,\)"),
                            (np.full(8, np.nan), "observation: .* not finite"),
                            (np.r_[np.zeros(7), np.inf], "observation: .* not finite")):
            with pytest.raises(fac.UserError, match=text):
                planner.act(wrong)


def test_planner_config_refuses_nonsense():
    for wrong, text in (({"elites": 9, "samples": 8}, r"elites must be at most samples \(8\)"),
                        ({"min_std": 3.0}, r"min_std must be at most max_std \(2.0\)"),
                        ({"discount": 1.1}, "at most 1"),
                        ({"samples": 64.0}, "samples must be of type int, not 64.0"),
                        ({"samples": 10 ** 8}, "at most 1000000"),
                        ({"discount": True}, "of type float"), ({"output": None}, "of type str"),
                        ({"inverse_temperature": 1e40}, r"at most 3e\+38")):
        with pytest.raises(fac.UserError, match=text):
            fac.PlannerConfig(**wrong)
    assert fac.PlannerConfig().num_elites == 16
    assert fac.dataclasses.replace(fac.PlannerConfig(), samples=512).num_elites == 64
    assert fac.PlannerConfig(samples=np.int64(3), discount=1).num_elites == 1


# ------------------------------------------------------------------------------- workers


def shared_memory():
    """What multiprocessing has made there that no other process uses: tests beside this one do."""
    made, used = {}, ""
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with contextlib.suppress(OSError):  # its process has ended
            used += maps.read_text() if maps.parent.name != str(os.getpid()) else ""
    for path in Path("/dev/shm").glob("*"):
        with contextlib.suppress(OSError):
            about = path.stat()  # a semaphore is mapped under another name, which is gone
            made[path.name] = (f"{os.major(about.st_dev):02x}:{os.minor(about.st_dev):02x} "
                               f"{about.st_ino} ")
    return {name for name, where in made.items()
            if name.startswith(("psm_", "sem.mp-")) and where not in used}


def left_behind(before):
    """What is there now and wasn't before, once what others are cleaning up is gone."""
    for _ in range(50):
        if not (left := shared_memory() - before):
            break
        time.sleep(0.1)
    return left


@pytest.mark.parametrize("search", [
    {"samples": 32, "iterations": 2, "max_std": 0.2}, {"iterations": 0}])
def test_workers_begin_where_their_agents_priors_do(search):
    student = student_of(random_model(1, policy=True))
    config = fac.PlannerConfig(prior="own", **search)
    obs, plans = np.random.default_rng(1).standard_normal((3, 8)), []
    for workers in (0, 1, 2):
        with fac.Planner(student, config, 0, workers) as planner:
            plans.append([planner.plan(o) for o in obs])
    assert np.array_equal(plans[0], plans[1]) and np.array_equal(plans[0], plans[2])
    assert np.shape(plans[0]) == (3, 3, 4 if config.iterations else 1, 1)


@pytest.mark.parametrize("iterations", [0, 1])
def test_a_worker_has_its_agents_networks_and_is_sent_their_latents_alone(monkeypatch, iterations):
    """Nothing of the expert, of an encoder, or of another agent."""
    student, sent = student_of(random_model(1, policy=True)), []
    obs, send_all = np.ones(8, np.float32), fac.Workers.send_all
    config = fac.PlannerConfig(samples=8, iterations=iterations, prior="own")

    def watched(self, messages):
        sent.append([*messages])
        send_all(self, sent[-1])

    monkeypatch.setattr(fac.Workers, "send_all", watched)
    with fac.Planner(student, config, workers=2) as planner:
        planner.act(obs)
    ((first, _), (second, _)), _, latents = sent  # models, seeds, latents
    whole = student.latents(obs[:, None], iterations > 0)
    assert [*map(np.shape, latents)] == [(1, 12 if iterations else 6, 1)] * 2
    assert np.array_equal(np.concatenate(latents), whole[1:])
    names = {name for name, *_ in fac.networks(student.config)}
    shared = {"_encoder", "_prior_encoder", "_expert_encoder"}
    for i, model in ((1, first), (2, second)):
        assert {key.split(".")[0] for key in model.params} == names - shared
        for key, value in model.params.items():
            assert np.array_equal(value, student.params[key][i:i + 1])


@pytest.mark.parametrize("n, d, workers", [(3, 1, 1), (3, 1, 2), (2, 3, 1), (6, 1, 3)])
def test_workers_plan_the_same_bit_for_bit(n, d, workers):
    model = random_model(n, n * d, hidden=50)
    config = fac.PlannerConfig(samples=200, iterations=3, horizon=3)
    obs = np.random.default_rng(4).standard_normal((5, 8))
    before = shared_memory()
    with fac.Planner(model, config, seed=1) as alone, \
            fac.Planner(model, config, seed=1, workers=workers) as parallel:
        for seed in (None, 9):
            if seed:
                alone.reset(seed), parallel.reset(seed)
            for o in obs:
                assert np.array_equal(alone.act(o), parallel.act(o))
    assert not left_behind(before)


def test_processes_share_the_agents_evenly_and_none_twice():
    for agents, workers in ((n, w) for n in range(1, 22) for w in range(n)):
        parts = fac.split_agents(agents, workers)
        assert sum((list(range(agents))[part] for part in parts), []) == list(range(agents))
        sizes = [part.stop - part.start for part in parts]
        assert len(parts) == workers + 1 and max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize("workers", [3, -1, 1.0, "1", None])
def test_what_is_no_number_of_workers_is_refused(workers):
    with pytest.raises(fac.UserError, match="^workers .* from 0 to 2, found"):
        fac.Planner(random_model(), workers=workers)


def in_a_pool(workers):
    """What a pool's process, a daemonic one, gets of a planner and of an evaluation."""
    model, config, found = random_model(), fac.PlannerConfig(samples=4, iterations=1), []
    for start in (lambda: fac.Planner(model, config, workers=workers).act(np.zeros(8)).shape,
                  lambda: len(fac.play(model, "reacher-easy", config, [0], workers)[0])):
        try:
            found.append(start())
        except fac.UserError as error:
            found.append(str(error))
    return found


def test_a_pool_s_process_that_wants_workers_is_told_to_go_without():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        for message in pool.apply(in_a_pool, [1]):
            assert "daemonic processes" in message and "pass workers=0" in message
        assert pool.apply(in_a_pool, [0]) == [(3,), 1]


@pytest.mark.parametrize("seed", [-1, 1.5, "x"])
def test_what_is_no_seed_is_refused_and_leaves_no_worker(seed):
    before = multiprocessing.active_children()
    for refused in (lambda: fac.Planner(random_model(), seed=seed, workers=1),
                    lambda: fac.Planner(random_model()).reset(seed),
                    lambda: fac.stream(seed, "x"), lambda: fac.episode_seeds(seed, 2)):
        with pytest.raises((TypeError, ValueError)):  # NumPy's words; of a command, its own
            refused()
    assert multiprocessing.active_children() == before


@pytest.mark.parametrize("obs", [["a"] * 8, [[1], [1, 2]] + [[]] * 6, [{}] * 8, "abc"])
def test_what_is_no_observation_is_refused(obs):
    with pytest.raises(fac.UserError, match=r"observation: expected numbers of shape \(8,\)"):
        fac.Planner(random_model(), fac.PlannerConfig(samples=4)).act(obs)


@pytest.mark.parametrize("count", [-1, 2.0, "2", 10 ** 9])
def test_what_is_no_number_of_episodes_or_workers_is_refused(count):
    with pytest.raises(fac.UserError, match="episodes: expected a whole number from 0"):
        fac.episode_seeds(0, count)
    if count != 10 ** 9:
        with pytest.raises(fac.UserError, match="workers: expected a whole number from 0"):
            fac.play(random_model(), "reacher-easy", fac.PlannerConfig(), [1], count)


def test_a_dead_worker_is_reported_and_nothing_hangs():
    with fac.Planner(random_model(), fac.PlannerConfig(samples=16), workers=2) as planner:
        planner.act(np.zeros(8))
        processes = [process for process, _ in planner._workers._members]
        os.kill(processes[0].pid, signal.SIGKILL)
        began = time.monotonic()
        for message in ("worker 0 ended with exit code -9", "start anew"):
            with pytest.raises(fac.WorkerError, match=message):
                for _ in range(3):
                    planner.act(np.zeros(8))
        assert time.monotonic() - began < 5  # a hang would last for ever
        assert not any(process.is_alive() for process in processes)


def test_a_dead_worker_is_reported_behind_an_answer_that_nobody_read():
    with fac.Planner(random_model(), fac.PlannerConfig(samples=16), workers=1) as planner:
        workers, z = planner._workers, planner.model.encode(np.zeros((8, 1), np.float32))[-1:]
        process, connection = workers._members[0]
        workers.send_all([z])
        assert connection.poll(10)
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        with pytest.raises(fac.WorkerError, match="worker 0 ended with exit code -9"):
            workers.send_all([z])


def test_an_interrupted_decision_ends_the_workers(monkeypatch):
    """Their answers, unread, would be taken for those of the next decision."""
    def interrupt(*_):
        raise KeyboardInterrupt

    with fac.Planner(random_model(), fac.PlannerConfig(samples=16), workers=1) as planner:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(planner.own, "plan", interrupt)
            planner.act(np.zeros(8))
        with pytest.raises(fac.WorkerError, match="start anew"):
            planner.act(np.zeros(8))


# how a script of its own process begins
IMPORTS = f"""
import sys
sys.path[:0] = [{os.path.dirname(os.path.abspath(__file__))!r}]
from toys import fac, random_model
"""
SCRIPT = """
import signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell has it ignored
""" + IMPORTS + """
if __name__ == "__main__":
    planner = fac.Planner(random_model(), fac.PlannerConfig(samples=16), workers=2)
    planner.act([0.0] * 8)
    print(*[process.pid for process, _ in planner._workers._members], flush=True)
    while True:
        planner.act([0.0] * 8)
"""


@pytest.mark.parametrize("blow", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_their_parent(blow, tmp_path):
    script = tmp_path / "plan.py"
    script.write_text(SCRIPT)
    before = shared_memory()
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True,
                               stderr=subprocess.PIPE, start_new_session=True)
    pids = [int(word) for word in process.stdout.readline().split()]
    assert len(pids) == 2
    if blow == signal.SIGINT:
        os.killpg(process.pid, blow)  # as a terminal does: to all of them
    else:
        process.kill()
    _, errors = process.communicate(timeout=20)
    for _ in range(100):
        if not any(os.path.exists(f"/proc/{pid}/cmdline") and
                   open(f"/proc/{pid}/cmdline").read() for pid in pids):
            break
        time.sleep(0.1)
    else:
        pytest.fail("a worker outlived its parent")
    assert errors.count("Traceback") <= 1, "only the parent may report the interrupt"
    assert not left_behind(before)


@pytest.mark.parametrize("hidden", [16, 400])  # in one piece through a pipe, and not
def test_an_unguarded_script_gets_an_error_not_a_hang(tmp_path, hidden):
    script = tmp_path / "plan.py"
    script.write_text(f"{IMPORTS}fac.Planner(random_model(hidden={hidden}), workers=1)\n"
                      "print('made')\n")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert done.returncode != 0 and "__main__" in done.stderr
    assert "made" not in done.stdout  # a planner that is made has workers that are ready


FAULTS = IMPORTS + """
from resource import RUSAGE_SELF, getrusage
assert not fac.keep_memory.cache_info().currsize  # an import changes no process
planner, faults = fac.Planner(random_model(12, 12, 50, 50)), []
for _ in range(5):
    planner.act([0.0] * 8)
    faults.append(getrusage(RUSAGE_SELF).ru_minflt)
print(faults[-1] - faults[-2])
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator")
def test_a_plan_keeps_its_memory():
    """Of a fresh process: 3,400 page faults a plan, a third of its time, were freed memory."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MALLOC_")}  # dask's
    done = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True,
                          timeout=60, env=environment)
    assert done.returncode == 0 and int(done.stdout) < 100, done.stderr


def refuses(connection):
    raise fac.UserError("not on this machine")


def test_a_worker_that_ends_while_it_is_sent_to_says_why():
    with fac.Workers(refuses, 1) as workers:
        with pytest.raises(fac.UserError, match="not on this machine"):
            workers.send_all([bytes(10_000_000)])  # more than a pipe holds


def wants_too_much(connection):
    np.zeros((1 << 44,))


def test_a_worker_without_memory_says_so():
    with fac.Workers(wants_too_much, 1) as workers:
        with pytest.raises(fac.UserError, match="Unable to allocate"):
            workers.receive(0)


def says_half(connection):
    os.write(connection.fileno(), b"\0\0\x01\0half of a message of 256 bytes")
    os._exit(7)


def test_a_worker_that_dies_in_the_middle_of_a_message_is_reported():
    with fac.Workers(says_half, 1) as workers:
        with pytest.raises(fac.WorkerError, match="worker 0 ended with exit code 7"):
            workers.receive(0)


def misses_a_file(connection):
    open("/nonexistent/file")


def tells_its_threads(connection):
    from threadpoolctl import threadpool_info
    connection.send([pool["num_threads"] for pool in threadpool_info()
                     if pool["user_api"] == "blas"])


def test_a_worker_s_products_take_one_thread(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    with fac.Workers(tells_its_threads, 1) as workers:
        assert set(workers.receive(0)) == {1}


def sleeps(connection):
    connection.send("soundly")
    time.sleep(20)


def test_a_worker_that_does_not_listen_is_ended():
    with fac.Workers(sleeps, 1) as workers:
        assert workers.receive(0) == "soundly"
        began, ((process, _),) = time.monotonic(), workers._members
    assert time.monotonic() - began < 10 and process.exitcode == -signal.SIGKILL


def fails(connection):
    raise ZeroDivisionError


def test_a_worker_s_own_error_is_seen(capfd):
    with fac.Workers(fails, 1) as workers:
        with pytest.raises(fac.WorkerError, match="exit code 1"):
            workers.receive(0)
    assert "ZeroDivisionError" in capfd.readouterr().err
    with fac.Workers(misses_a_file, 1) as workers:  # one line, as in the parent
        with pytest.raises(fac.UserError, match="No such file .*'/nonexistent/file'"):
            workers.receive(0)
    assert capfd.readouterr().err == ""


def test_a_gain_of_zero_is_a_gain_all_the_same():
    model, rng = random_model(), np.random.default_rng(3)
    model.params["_Q1.1.weight"][:, :4] = 0
    config = fac.PlannerConfig(horizon=2)
    z = model.encode(rng.standard_normal((8, 1), np.float32))
    actions = rng.uniform(-1, 1, (3, 3, 1, 9)).astype(np.float32)
    fast = fac.Returns(model)
    fast.start(z, config)
    plain = fac.h_step_return(model, z, actions, config)
    assert np.abs(fast(actions) - plain).max() < 1e-5 * np.abs(plain).max()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_returns_that_are_not_finite_are_never_elites(bad):
    target = np.full((2, 3, 1), 0.2, np.float32)

    def returns(actions):
        G = quadratic(target)(actions)
        G[actions[:, 0, 0] > 0.5] = bad
        return G

    config = fac.dataclasses.replace(CONFIG, samples=64, elites=60)  # more than there are
    mean, elites, weights = fac.mppi(returns, np.zeros_like(target), config, streams(2))
    assert np.isfinite(mean).all() and np.allclose(weights.sum(1), 1, atol=1e-6)
    assert not weights[elites[:, 0, 0] > 0.5].any() and np.abs(mean - target).max() < 0.2
    with np.errstate(invalid="ignore"):  # the second agent has none: `FastPlanner` refuses that
        _, _, weights = fac.mppi(lambda actions: returns(actions) * np.array(
            [[1], [bad]], np.float32), np.zeros_like(target), config, streams(2))
    assert np.isfinite(weights[0]).all() and np.isnan(weights[1]).all()


def test_weights_out_of_range_are_an_error_not_an_action():
    model = random_model()
    model.params["_Q1.5.bias"][:] = np.inf
    for workers in (0, 2):
        with fac.Planner(model, fac.PlannerConfig(samples=16), workers=workers) as planner:
            with pytest.raises(fac.UserError, match="finite return"):
                planner.act(np.zeros(8))


def test_without_a_seed_every_planner_is_another():
    plans = [fac.Planner(random_model(), fac.PlannerConfig(samples=16), seed=None).act(np.zeros(8))
             for _ in range(2)]
    assert not np.array_equal(*plans)


def test_cores_are_those_this_process_may_use(monkeypatch):
    from speed import useful_workers
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 5, 7}, raising=False)
    assert fac.cores() == 3 and useful_workers(6) == 2 and useful_workers(2) == 1
    monkeypatch.delattr(os, "sched_getaffinity")
    assert fac.cores() == 64


@pytest.mark.parametrize("output", ["sampled", "mean"])
@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("odd", [
    {"samples": 1}, {"elites": 16}, {"elites": 1}, {"iterations": 1}, {"horizon": 0},
    {"inverse_temperature": 1e-9}, {"momentum": 1.0}, {"discount": 0.0}, {"pi_trajs": 1},
    {"min_std": 2.0}, {"speed": "plain"}])
def test_odd_settings_plan_all_the_same(odd, n, output):
    """Also where all returns are equal, as those of a model without rewards and values."""
    config = fac.PlannerConfig(**{"samples": 16, "iterations": 2, "output": output, **odd})
    for model in (random_model(n), fac.WorldModel.create(random_model(n).config,
                                                         np.random.default_rng(0))):
        with fac.Planner(model, config, seed=0) as planner:
            actions = np.stack([planner.act(np.ones(8)) for _ in range(3)])
        assert actions.shape == (3, 3) and np.isfinite(actions).all() and np.abs(actions).max() <= 1
