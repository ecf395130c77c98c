"""Equation 1 and the policy's loss: central differences, golden files, ten updates of PyTorch's."""
import dataclasses

import numpy as np
import pytest

import fac_tdmpc_ref as fac
from numpy_learner import ExpertConfig, equation_1, policy_loss, td_targets
from toys import (EQUATION_1, FORWARD, GOLDEN, GRADIENT, NARROW, assert_close, assert_digest,
                  narrow_expert, numeric_gradient, present, relative, small_batch, small_learner)


@pytest.mark.parametrize("steps, batch", [(3, 4), (1, 1), (4, 2)])
def test_gradients_through_the_rollout(steps, batch):
    rng = np.random.default_rng(0)
    learner = small_learner(rng)
    obs, actions, reward = small_batch(rng, steps, batch)
    latents, td = td_targets(learner.model, learner.target, obs[1:], reward,
                                 np.zeros((2, steps * batch)), 0.9)
    case = obs[0], actions, reward, latents, td, EQUATION_1
    equation_1(learner.model, *case, learner.optimizer.grads)
    for key, value in learner.optimizer.params.items():
        expected = numeric_gradient(lambda: equation_1(learner.model, *case)[0], value)
        assert_close(learner.optimizer.grads[key], expected, 1e-5)
        assert np.abs(expected).max() > 1e-7, f"{key}: the check compares zeros"


def test_policy_gradient():
    rng = np.random.default_rng(1)
    learner = small_learner(rng)
    rollout, noise = rng.standard_normal((1, 3, 12)), 0.01 * rng.standard_normal((2, 3, 4))
    grads, model = learner.policy_optimizer.grads, learner.model
    before = {k: v.copy() for k, v in learner.optimizer.grads.items()}
    loss = policy_loss(model, rollout, noise, 0.7, grads)
    for key, value in learner.policy_optimizer.params.items():
        expected = numeric_gradient(lambda: policy_loss(
            model, rollout, noise, 0.7, {k: np.zeros_like(v) for k, v in grads.items()}), value)
        assert_close(grads[key], expected, 1e-5)
        assert np.abs(expected).max() > 1e-7
    z = rollout.reshape(1, 3, 3, 4)
    plain = -sum(0.7 ** h * np.minimum(*model.q(z[:, :, h], model.policy(z[:, :, h])
                                                + noise[None, :, h])).mean() for h in range(3))
    assert np.isclose(loss, plain)
    assert all(np.array_equal(v, before[k]) for k, v in learner.optimizer.grads.items())


def test_clipped_policy_noise_lets_gradients_through():
    """As TD-MPC: where mu + noise is clipped, mu's gradient is that of the clipped action's Q."""
    rng = np.random.default_rng(2)
    learner = small_learner(rng)
    learner.model.params["_pi.4.bias"][:] = 3  # tanh(3) = 0.995
    noise = np.full((2, 1, 5), 0.3)
    policy_loss(learner.model, rng.standard_normal((1, 3, 5)), noise, 1.0,
                    learner.policy_optimizer.grads)
    assert np.abs(learner.policy_optimizer.grads["_pi.4.bias"]).min() > 0


def golden_case(source):
    """(model, target, arrays, training) of a golden file."""
    if source == "narrow":
        header, g = fac.read_npz(NARROW, ("golden",))
        models = [narrow_expert(header, g, prefix) for prefix in ("model ", "target ")]
    else:
        header, g = fac.read_npz(fac.EXPERTS / source / "golden.npz", ("golden",))
        models = [fac.load_model(fac.EXPERTS / source / "expert.npz")[0]] * 2
    return *models, g, ExpertConfig(**present(ExpertConfig, header["training"]))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("source", ["narrow", *GOLDEN])
def test_golden_loss_and_gradients(source, dtype):
    """The loss squares small differences of Q and target, so float32 rounds it like a gradient."""
    model, target, g, config = golden_case(source)
    forward, bound = FORWARD, GRADIENT
    if dtype == np.float64:  # the narrow file holds what PyTorch computed as float32
        forward = bound = 1e-6 if source == "narrow" else 1e-9
    model, target = (fac.WorldModel(m.config, {k: v.astype(dtype) for k, v in m.params.items()})
                     for m in (model, target))
    g = {k: v.astype(dtype) if k in ("obs", "action", "rewards") else v for k, v in g.items()}
    steps, dim_action, batch = g["action"].shape
    latents, td = td_targets(model, target, g["obs"][1:], g["rewards"],
                                 np.zeros((dim_action, steps * batch), dtype), config.discount)
    grads = {k: np.zeros_like(v) for k, v in model.params.items() if not k.startswith("_pi")}
    loss, terms, rollout = equation_1(model, g["obs"][0], g["action"], g["rewards"], latents,
                                          td, config, grads)
    assert rollout.dtype == td.dtype == latents.dtype == dtype
    assert abs(loss / g["equation1_loss"] - 1) < bound
    assert relative(np.array(terms), g["equation1_terms"]) < bound
    assert relative(rollout[0, :, batch:2 * batch], g["next_latent"]) < forward
    for key, gradient in grads.items():
        expected = g[f"equation1_grad {key}"]
        if source == "narrow":
            gradient = gradient[0] if key.endswith("weight") and gradient.shape[2] > 1 else \
                gradient.reshape(expected.shape)
            assert relative(gradient.reshape(expected.shape), expected) < bound, key
        else:
            size = None
            if dtype == np.float32 and key == "_reward.4.bias":
                # sums the rewards' errors, which nearly cancel: rounded as its layer's weights are
                size = np.hypot(expected[0], g["equation1_grad _reward.4.weight"][0])
            assert_digest(gradient, expected, bound, size)


@pytest.mark.parametrize("dtype, tolerance", [(np.float64, 1e-9), (np.float32, 2e-3)])
def test_ten_updates_are_pytorch_s(dtype, tolerance):
    """Adam divides a gradient by its own size: in float32, rounding moves small ones visibly."""
    pytest.importorskip("torch")
    from torch_learner import TorchLearner, torch
    ours = small_learner(np.random.default_rng(3), dtype)
    ours.config = dataclasses.replace(EQUATION_1, grad_clip=0.5, tau=0.1)
    copy = {k: v.copy() for k, v in ours.model.params.items()}
    theirs = TorchLearner(fac.WorldModel(ours.model.config, copy), ours.config, "cpu")
    for key, value in ours.target.params.items():
        theirs.target[key].copy_(torch.tensor(value))
    for t in range(10):
        batch = small_batch(np.random.default_rng(t), dtype=dtype)
        found = ours.update(*batch, np.random.default_rng(t))
        expected = theirs.update(*batch, np.random.default_rng(t))
        assert_close(np.array(found), np.array(expected), 10 * tolerance)
    for model, params in ((ours.model, theirs.model.params), (ours.target, theirs.target)):
        assert set(model.params) == set(params)
        for key, value in model.params.items():
            assert_close(value, np.asarray(params[key]), tolerance)


def test_half_precision_ends_at_the_last_layer():
    pytest.importorskip("torch")
    from torch_learner import TorchLearner, heads, torch
    learner = TorchLearner(small_learner(np.random.default_rng(0), np.float32).model, EQUATION_1,
                           "cpu", "bfloat16")
    torch.manual_seed(0)
    x = torch.randn(1, 50, EQUATION_1.latent_dim + 2)
    torch.nn.init.normal_(learner.params["_Q1.5.weight"])
    with torch.no_grad():
        with learner._autocast():
            half = heads(learner.params, x)[1] + 100
            half -= 100
        whole = heads(learner.params, x)[1]
    assert half.dtype == torch.float32
    assert 0 < (half - whole).abs().max() < 0.03 * whole.std()  # bfloat16's steps at 100 are 0.5


def test_the_averages_follow_every_second_update():
    rng = np.random.default_rng(4)
    learner = small_learner(rng, np.float32)
    batch = small_batch(rng, dtype=np.float32)
    slow = learner.slow_vector.copy()
    learner.update(*batch, rng)
    assert np.array_equal(learner.slow_vector, slow)
    learner.update(*batch, rng)
    assert np.allclose(learner.slow_vector, slow + 0.01 * (learner.optimizer.vector - slow))
    assert learner.slow_vector.dtype == learner.optimizer.vector.dtype == np.float32


def test_a_learner_goes_on_where_numpy_is_set_to_raise():
    rng = np.random.default_rng(0)
    learner, (obs, *more) = small_learner(rng, np.float32), small_batch(rng, dtype=np.float32)
    with np.errstate(all="raise"):  # what exp underflows
        assert np.isfinite(learner.update(1e4 * obs, *more, rng)).all()


def test_an_update_s_bits_are_the_same_by_one_thread_or_two():
    found = []
    for threads in (1, 2):
        learner = small_learner(np.random.default_rng(6), np.float32)
        learner._fit.threads = learner._improve.threads = fac.thread_pool(threads)
        for t in range(3):
            learner.update(*small_batch(np.random.default_rng(t), dtype=np.float32),
                           np.random.default_rng(t))
        found.append({k: v.tobytes() for k, v in learner.state().items()})
    assert found[0] == found[1]


def test_a_learner_goes_on_from_its_state():
    """Weights, both of Adam's means, steps made and moving averages."""
    first, second = (small_learner(np.random.default_rng(seed), np.float32) for seed in (6, 7))
    for t in range(3):
        first.update(*small_batch(np.random.default_rng(t), dtype=np.float32),
                     np.random.default_rng(t))
    second.load({k: np.copy(v) for k, v in first.state().items()})
    for learner in (first, second):
        learner.update(*small_batch(np.random.default_rng(9), dtype=np.float32),
                       np.random.default_rng(9))
    ours, theirs = first.state(), second.state()
    assert ours.keys() == theirs.keys() and first.updates == second.updates == 4
    for key, value in ours.items():
        assert np.array_equal(value, theirs[key]), key


def test_the_policy_s_noise_is_constant_and_cut():
    """TD-MPC's: deviation 0.05, whatever the exploration's is by then; no more than 0.3."""
    noise = fac.policy_noise((200_000,), np.random.default_rng(0))
    assert noise.dtype == np.float32
    assert abs(noise.std() - 0.05) < 1e-3 and abs(noise.mean()) < 1e-3

    class Far:
        def standard_normal(self, shape, dtype):
            return np.linspace(-20, 20, shape[0], dtype=dtype)

    assert np.abs(fac.policy_noise((41,), Far())).max() == np.float32(0.3)


def test_an_update_s_targets_and_policy_see_that_noise(monkeypatch):
    """With another deviation, target and policy learn something else; the rest is the same."""
    terms = []
    real = fac.policy_noise
    for factor in (1, 1, 10):
        monkeypatch.setattr(fac, "policy_noise", lambda *of, factor=factor: (
            np.float32(factor) * real(*of)))
        rng = np.random.default_rng(5)
        learner = small_learner(rng, np.float32)
        found = learner.update(*small_batch(rng, dtype=np.float32), rng)
        terms.append((*found, learner.policy_optimizer.m.sum()))
    assert terms[0] == terms[1] and terms[0][:2] == terms[2][:2]
    assert terms[0][2] != terms[2][2] and terms[0][3] != terms[2][3]
