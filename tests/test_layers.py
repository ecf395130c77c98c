"""Every backward pass against central differences in float64, and against live PyTorch."""
import collections
import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fac_tdmpc_ref as fac
from numpy_learner import ExpertConfig
from toys import UNSEEN, assert_close, numeric_gradient

SHAPES = [(1, 5, 4, 1), (1, 3, 7, 6), (3, 4, 5, 2), (2, 6, 3, 1)]  # N, in, out, B


@pytest.mark.parametrize("n, inputs, outputs, batch", SHAPES)
def test_linear_backward(n, inputs, outputs, batch):
    rng = np.random.default_rng(0)
    x, W, b = (rng.standard_normal(s) for s in ((n, inputs, batch), (n, outputs, inputs),
                                                (n, outputs, 1)))
    dy = rng.standard_normal((n, outputs, batch))
    for found, array in zip(fac.linear_backward(dy, x, W), (x, W, b)):
        assert_close(found, numeric_gradient(lambda: (fac.linear(x, W, b) * dy).sum(), array))


@pytest.mark.parametrize("n, features, _, batch", SHAPES)
def test_norm_backward(n, features, _, batch):
    rng = np.random.default_rng(1)
    x, g, b = (rng.standard_normal(s) for s in ((n, features, batch), (n, features, 1),
                                                (n, features, 1)))
    dy = rng.standard_normal(x.shape)
    for found, array in zip(fac.norm_backward(dy, x, g), (x, g, b)):
        assert_close(found, numeric_gradient(lambda: (fac.norm(x, g, b) * dy).sum(), array), 1e-6)


@pytest.mark.parametrize("forward, backward", [(fac.elu, fac.elu_backward),
                                               (np.tanh, fac.tanh_backward)])
def test_activation_backward(forward, backward):
    rng = np.random.default_rng(2)
    x, dy = rng.standard_normal((2, 2, 4, 5))
    numeric = numeric_gradient(lambda: (forward(x) * dy).sum(), x)
    assert_close(backward(dy, forward(x)), numeric)


@pytest.mark.parametrize("kinds", [fac.ENCODER, fac.MLP, fac.QNET])
@pytest.mark.parametrize("n, batch", [(1, 1), (3, 4)])
def test_network_backward(kinds, n, batch):
    rng = np.random.default_rng(3)
    params, width = {}, 4
    for i, kind in enumerate(kinds):
        out = 3 if i == len(kinds) - 1 else 6
        if kind == "linear":
            params[f"f.{i}.weight"], width = rng.standard_normal((n, out, width)), out
        if kind == "norm":
            params[f"f.{i}.weight"] = rng.standard_normal((n, width, 1))
        if kind in ("linear", "norm"):
            params[f"f.{i}.bias"] = rng.standard_normal((n, width, 1))
    x, dy = rng.standard_normal((n, 4, batch)), rng.standard_normal((n, 3, batch))

    def loss():
        return (fac.forward(kinds, params, "f", x) * dy).sum()

    tape, grads = [], {k: np.zeros_like(v) for k, v in params.items()}
    fac.forward(kinds, params, "f", x, tape)
    assert_close(fac.backward(kinds, params, "f", tape, dy, grads), numeric_gradient(loss, x), 1e-6)
    for key, value in params.items():
        assert_close(grads[key], numeric_gradient(loss, value), 1e-6)


@pytest.mark.parametrize("kind", ["forward", "reverse"])
def test_soft_kl(kind):
    rng = np.random.default_rng(5)
    student, expert = rng.standard_normal((2, 3, 4, 6))
    kl, gradient = fac.soft_kl(student, expert, 0.7, 0.4, kind)
    assert (kl > 0).all()
    assert_close(gradient, numeric_gradient(
        lambda: fac.soft_kl(student, expert, 0.7, 0.4, kind)[0].sum(), student))
    # the definition, and its zero: predictions that differ by a constant and the temperatures
    p, q = (np.exp(x / t) / np.exp(x / t).sum(-1, keepdims=True)
            for x, t in ((expert, 0.4), (student, 0.7)))
    if kind == "reverse":
        p, q = q, p
    assert np.allclose(kl, (p * np.log(p / q)).sum(-1))
    assert np.allclose(fac.soft_kl(expert * 0.7 / 0.4 + 3, expert, 0.7, 0.4, kind)[0], 0)


def small_case(n, batch, steps, kind, rng, expert_latent=0, groups=()):
    """A float64 student with live last layers, and a batch for it; groups: (N,), of parts."""
    sizes = fac.ModelConfig(4, 6, n, 3, 5, 6, expert_latent_dim=expert_latent, expert_enc_dim=4)
    student = fac.WorldModel.create(sizes, rng, dtype=np.float64)
    for value in student.params.values():
        value += 0.3 * rng.standard_normal(value.shape)
    features = rng.standard_normal((1, expert_latent or 4, batch))
    actions = rng.uniform(-1, 1, (steps, 6, batch, 3))
    targets = rng.standard_normal((3, *groups, steps, batch, 3))
    config = fac.DistillConfig(lam=0.7, kl=kind, temperature_student=0.8)
    return student, features, actions, targets, config


def test_the_divergences_that_a_curve_shows_are_means():
    student, features, actions, targets, config = small_case(3, 2, 3, "forward",
                                                             np.random.default_rng(6))
    _, *found = fac.distill_loss(student, features, actions, targets, config)
    outputs = fac.predict(student, student.encode_features(features), actions)
    reward, q1, q2 = (fac.soft_kl(o, t, 0.8, 0.5)[0].mean() for o, t in zip(outputs, targets))
    np.testing.assert_allclose(found, [reward, (q1 + q2) / 2])


@pytest.mark.parametrize("n, batch, steps, kind, latent, groups", [
    (1, 1, 4, "forward", 0, ()), (2, 3, 3, "reverse", 5, ()), (3, 1, 2, "forward", 5, ()),
    (6, 2, 4, "reverse", 0, ()), (3, 2, 1, "forward", 0, ()),
    (3, 2, 3, "forward", 5, (3,)), (2, 1, 4, "reverse", 0, (2,))])
def test_distill_loss_through_the_rollout(n, batch, steps, kind, latent, groups):
    rng = np.random.default_rng(6)
    student, *case = small_case(n, batch, steps, kind, rng, latent, groups)
    grads = {k: np.zeros_like(v) for k, v in student.params.items()}
    fac.distill_loss(student, *case, grads)
    for key, value in student.params.items():
        expected = numeric_gradient(lambda: fac.distill_loss(student, *case)[0], value)
        assert_close(grads[key], expected, 1e-5)
        if not (key.startswith("_expert") or key in UNSEEN) and steps > 1:
            assert np.abs(expected).max() > 1e-7, f"{key}: the check compares zeros"


def credited(agents, noise=0.3, seed=9):
    """A float64 expert's parts of what noise on its actions does, (2, N, 4, 3, 5): rewards' and the
    mean Q's; its predictions of these (2, 4, 3, 5); expert, latents, actions."""
    rng = np.random.default_rng(seed)
    expert = fac.WorldModel.create(fac.ModelConfig(4, 6, 1, 5, 6, 7), rng, dtype=np.float64)
    for value in expert.params.values():
        value += 0.3 * rng.standard_normal(value.shape)
    z, actions = rng.standard_normal((1, 5, 3)), rng.uniform(-1, 1, (4, 6, 3, 5))
    actions = actions[..., :1] + noise * (actions - actions[..., :1])
    tapes = collections.defaultdict(list)
    x = fac.unroll(expert, z, actions, tapes)
    predicted = [shares.sum(0) for shares in fac.run_heads(expert, x, actions, tapes)]
    reward, q, again = fac.credit(expert, tapes, actions, predicted, fac.ModelConfig(4, 6, agents))
    assert again is q or np.array_equal(again, q)
    return (np.stack([reward, q]), np.stack([predicted[0], (predicted[1] + predicted[2]) / 2]),
            expert, z, actions)


@pytest.mark.parametrize("agents", [1, 2, 6])
def test_parts_add_up_to_what_the_noise_did(agents):
    parts, predicted, *_ = credited(agents)
    assert parts.shape == (2, agents, 4, 3, 5)
    assert np.allclose(parts.sum(1), predicted - predicted[..., :1], rtol=1e-12, atol=1e-12)


def test_a_part_is_what_its_own_actions_did():
    """Up to what the line's two ends leave, of third order in the noise, and what joints do only
    together, of second order."""
    def error(noise):
        parts, predicted, expert, z, actions = credited(3, noise)
        errors = []
        for i in range(3):
            moved = np.repeat(actions[..., :1], 5, -1)
            moved[:, 2 * i:2 * i + 2] = actions[:, 2 * i:2 * i + 2]
            reward, q1, q2 = fac.predict(expert, z, moved)
            alone = np.stack([reward, (q1 + q2) / 2])
            errors.append(np.abs(parts[:, i] - (alone - alone[..., :1])).max())
        return max(errors) / np.abs(predicted - predicted[..., :1]).max()

    assert error(1e-2) < 2e-2 and error(1e-4) < 2e-4


def test_parts_of_an_expert_that_is_a_sum_are_its_terms():
    """Two models side by side in one expert's rewards: each agent's part is its own model's."""
    rng = np.random.default_rng(3)
    pair = fac.WorldModel.create(fac.ModelConfig(2, 2, 2, 3, 4, 5), rng, dtype=np.float64)
    expert = fac.WorldModel.create(fac.ModelConfig(2, 2, 1, 6, 4, 10), rng, dtype=np.float64)
    for key, value in pair.params.items():
        value += 0.3 * rng.standard_normal(value.shape)
        if not key.startswith(("_dynamics", "_reward")):
            continue
        whole = expert.params[key]
        whole[:] = 0
        if key.endswith("bias"):
            whole[:] = value.reshape(1, -1, 1) if whole.shape[1] > 1 else value.sum()
        elif key == "_reward.4.weight":
            whole[:] = value.reshape(1, 1, -1)
        else:  # inputs of a first layer: both latents, then both actions
            out, into = value.shape[1:]
            for i in range(2):
                columns = (np.r_[3 * i:3 * i + 3, 6 + i] if into == 4 else
                           np.arange(into * i, into * (i + 1)))
                whole[0][np.ix_(np.arange(out * i, out * (i + 1)), columns)] = value[i]
    z, actions = rng.standard_normal((1, 6, 3)), rng.uniform(-1, 1, (4, 2, 3, 5))
    actions = actions[..., :1] + 1e-4 * (actions - actions[..., :1])
    tapes = collections.defaultdict(list)
    x = fac.unroll(expert, z, actions, tapes)
    predicted = [shares.sum(0) for shares in fac.run_heads(expert, x, actions, tapes)]
    found = fac.credit(expert, tapes, actions, predicted, pair.config)[0]
    theirs = fac.unroll(pair, z.reshape(2, 3, 3), actions)
    share = fac.run_heads(pair, theirs, actions)[0]
    assert np.allclose(share.sum(0), predicted[0])
    change = share - share[..., :1]
    assert np.abs(found - change).max() < 1e-6 * np.abs(change).max()


def test_one_agent_s_part_teaches_what_the_paper_s_joint_divergence_does():
    parts, predicted, *_, actions = credited(1)
    student, features, *_, config = small_case(1, 3, 4, "forward", np.random.default_rng(2))
    found = []
    for targets in ((parts[0], parts[1], parts[1]), (predicted[0], predicted[1], predicted[1])):
        grads = {k: np.zeros_like(v) for k, v in student.params.items()}
        found.append((fac.distill_loss(student, features, actions, targets, config, grads), grads))
    (loss, grads), (joint, theirs) = found
    assert np.allclose(loss, joint, rtol=1e-12)
    for key, value in grads.items():
        assert_close(value, theirs[key], 1e-9)


def test_predict_is_the_step_by_step_rollout():
    rng = np.random.default_rng(7)
    student, features, actions, _, _ = small_case(3, 2, 4, "forward", rng)
    z = student.encode_features(features)
    found = fac.predict(student, z, actions)
    z = np.repeat(z, 3, axis=2)
    for h in range(4):
        a = actions[h].reshape(3, 2, 6)
        for output, share in zip(found, (student.reward(z, a), *student.q(z, a))):
            assert np.allclose(output[h], share.sum(0).reshape(2, 3))
        z = student.next(z, a)


def test_orthogonal():
    rng = np.random.default_rng(8)
    for rows, columns in ((5, 3), (3, 5), (4, 4)):
        W = fac.orthogonal(rng, 2, rows, columns, np.float64)
        assert W.shape == (2, rows, columns)
        product = W @ W.swapaxes(1, 2) if rows <= columns else W.swapaxes(1, 2) @ W
        assert np.allclose(product, np.eye(min(rows, columns)))


def test_orthogonal_matrices_are_uniform_over_rotations():
    """No entry has a sign of its own, as QR's have: they are even, and each agent's are others."""
    for rows, columns in ((5, 3), (3, 5), (4, 4)):
        W = fac.orthogonal(np.random.default_rng(9), 600, rows, columns)
        assert np.abs(W.mean(0)).max() < 0.1 and W.std(0).min() > 0.35
        assert abs((W > 0).mean(0) - 0.5).max() < 0.1


def test_create_follows_told():
    sizes = fac.ModelConfig(8, 3, 3, 50, 256, 170)
    params = fac.WorldModel.create(sizes, np.random.default_rng(0)).params
    small = fac.ModelConfig(8, 3, 1, 6, 7, 8)
    policy = fac.WorldModel.create(small, np.random.default_rng(0), policy=True).params
    assert policy["_pi.4.weight"].any()  # alone of the last layers
    assert all(v.dtype == np.float32 for v in params.values())
    assert all(not params[f"{name}.weight"].any() for name in ("_reward.4", "_Q1.5", "_Q2.5"))
    assert all(not v.any() for k, v in params.items() if k.endswith("bias"))
    assert (params["_Q1.1.weight"] == 1).all()


def test_agents_must_divide_the_actions():
    with pytest.raises(fac.UserError, match=r"one of \[1, 2, 3, 6\]"):
        fac.ModelConfig(8, 6, 4)


def test_a_step_gives_the_gradient_s_norm_before_clipping():
    adam = fac.Adam({"w": np.zeros(2)})
    for clip in (10, 1):
        adam.grads["w"] += [3.0, 4.0]
        assert adam.step(0.1, clip) == 5


def test_flatten_gives_views():
    arrays = {"a": np.ones((2, 3), np.float32), "b": np.zeros((4, 1), np.float32)}
    vector, views = fac.flatten(arrays)
    vector[:] = np.arange(10)
    assert views["a"].shape == (2, 3) and views["b"][:, 0].tolist() == [6, 7, 8, 9]


# ------------------------------------------------------------------------- live PyTorch


@settings(max_examples=15, deadline=None)
@given(st.sampled_from([1, 2, 3, 6]), st.integers(1, 4), st.integers(1, 4),
       st.sampled_from(["forward", "reverse"]), st.booleans(), st.integers(0, 2 ** 31))
def test_distill_loss_against_torch(n, batch, steps, kind, parts, seed):
    torch = pytest.importorskip("torch")
    import export_golden
    student, features, actions, targets, config = small_case(
        n, batch, steps, kind, np.random.default_rng(seed), 0, (n,) if parts else ())
    theirs = {k: torch.tensor(v, requires_grad=True) for k, v in student.params.items()}
    loss = export_golden.equation_4(theirs, torch.tensor(features), torch.tensor(actions),
                                   [torch.tensor(t) for t in targets], n, config)
    grads = {k: np.zeros_like(v) for k, v in student.params.items()}
    ours = fac.distill_loss(student, features, actions, targets, config, grads)[0]
    assert np.isclose(ours, loss.item(), rtol=1e-10)
    for key, expected in export_golden.gradients(loss, theirs).items():
        assert_close(grads[key], expected, 1e-7)


@pytest.mark.parametrize("kind", [fac.DistillConfig, fac.PlannerConfig, ExpertConfig])
def test_every_range_is_checked(kind):
    for f in dataclasses.fields(kind):
        wrong = [type(f.default)(f.metadata[bound] + step) for bound, step in
                 (("least", -1), ("above", 0), ("most", 1)) if bound in f.metadata]
        wrong += [np.nan, np.inf] * isinstance(f.default, float)
        wrong += ["sideways"] * ("choices" in f.metadata)
        wrong += [10 ** 9 + 1] * (type(f.default) is int)
        for value in wrong:
            with pytest.raises(fac.UserError, match=f"{f.name} must be"):
                kind(**{f.name: value})
        assert f.metadata["help"]


def test_settings_hold_python_s_own_numbers():
    """A whole number, or NumPy's, for a decimal one makes no other name in records and CSVs."""
    found = fac.PlannerConfig(discount=1, samples=np.int64(64), max_std=np.float32(2))
    assert repr(found) == repr(fac.PlannerConfig(discount=1.0, samples=64, max_std=2.0))


def test_one_number_that_is_not_finite_is_divergence():
    fac.check_finite("loss is", [1.0, 2.0], 5, 1e-3)
    for name, value in (("loss is", [1.0, np.nan]), ("weights are", [1, -np.inf])):
        with pytest.raises(fac.UserError, match=f"update 5 the {name} no longer finite"):
            fac.check_finite(name, value, 5, 1e-3)
