"""data/train_gpu.py: all tasks' models as one learn and plan as each alone."""
import dataclasses

import numpy as np
import pytest

import fac_tdmpc_ref as fac

torch = pytest.importorskip("torch")
import torch_learner  # noqa: E402
import train_gpu  # noqa: E402
from numpy_learner import ExpertConfig  # noqa: E402

TASKS = ("cheetah-run", "humanoid-stand")
CONFIG = ExpertConfig(mlp_dim=24, enc_dim=16, latent_dim=10, batch_size=6)
PLANNING = fac.PlannerConfig(samples=12, iterations=2, pi_trajs=4)


def models():
    sizes = [fac.ModelConfig(*fac.TASKS[task], 1, CONFIG.latent_dim, CONFIG.enc_dim,
                             CONFIG.mlp_dim) for task in TASKS]
    found = [fac.WorldModel.create(size, fac.stream(0, "expert", i), policy=True)
             for i, size in enumerate(sizes)]
    rng = np.random.default_rng(1)
    for model in found:  # rewards and Q of fresh models are zero
        for value in model.params.values():
            value += 0.1 * rng.standard_normal(value.shape).astype(np.float32)
    return found


@pytest.fixture
def learner():
    return train_gpu.Learner(models(), CONFIG, PLANNING, 2, "cpu", torch.float32)


def test_updates_are_those_of_each_task_alone(learner, monkeypatch):
    """Three updates of the stack: weights and moving averages as three of a TorchLearner each."""
    rng, (H, B) = np.random.default_rng(0), (CONFIG.horizon, CONFIG.batch_size)
    config = dataclasses.replace(CONFIG, target_every=1)
    alone = [torch_learner.TorchLearner(model, config, "cpu") for model in models()]
    for _ in range(3):
        obs, action, reward, noise = (
            np.zeros(shape, np.float32) for shape in (
                (H + 1, 2, B, learner.dim_obs), (H, 2, B, learner.dim_action), (H, 2, B),
                (2, (2 * H + 1) * B, learner.dim_action)))
        for i, (one, model) in enumerate(zip(alone, learner.models)):
            o, d = model.config.dim_obs, model.config.dim_action
            obs[:, i, :, :o] = rng.standard_normal((H + 1, B, o))
            action[:, i, :, :d] = rng.uniform(-1, 1, (H, B, d))
            reward[:, i] = rng.standard_normal((H, B))
            noise[i] = fac.policy_noise(noise[i].shape, rng)  # padding is masked
            own = noise[i, :, :d].T
            monkeypatch.setattr(fac, "policy_noise", lambda shape, _, own=own: own.reshape(shape))
            one.update(obs[:, i, :, :o].swapaxes(1, 2), action[:, i, :, :d].swapaxes(1, 2),
                       reward[:, i], None)
            monkeypatch.undo()
        learner.update(*map(torch.from_numpy, (obs, action, reward, noise)))
        learner.target.lerp_(learner.main.vector.detach(), CONFIG.tau)
    slow = learner.main.vector
    for i, one in enumerate(alone):
        found = {**learner.main.arrays(i, one.model.config), **learner.pi.arrays(
            i, one.model.config)}
        assert found.keys() == one.params.keys()
        for key, value in one.model.params.items():
            np.testing.assert_allclose(found[key], value, rtol=0, atol=2e-5, err_msg=key)
        learner.main.vector = learner.target
        found = learner.main.arrays(i, one.model.config)
        learner.main.vector = slow
        for key, value in one.target.items():
            np.testing.assert_allclose(found[key], value.numpy(), rtol=0, atol=2e-5, err_msg=key)


def test_what_is_padded_stays_zero(learner):
    learner.filled.fill_(2)
    learner.obs[0, ..., :17].normal_()
    learner.obs[1, ..., :67].normal_()
    learner.action[0, ..., :6].uniform_(-1, 1)
    before = learner.main.arrays(0, learner.models[0].config)
    learner.learn()
    changed = learner.main.arrays(0, learner.models[0].config)
    assert all((before[k] != changed[k]).any() for k in before)
    first = learner.main.views()["_encoder.0.weight"]
    assert not first[0, :, 17:].any() and not first[1, :, 67:].any()
    assert not learner.main.views()["_dynamics.0.weight"][0, :, 10 + 6:].any()


def test_returns_and_plans_are_the_planner_s(learner):
    """G of given actions as `h_step_return`; plans better by it than what the policy does."""
    rng, E, L = np.random.default_rng(0), 3, CONFIG.horizon + 1
    obs = torch.zeros(2, E, learner.dim_obs)
    for i, model in enumerate(learner.models):
        obs[i, :, :model.config.dim_obs] = torch.from_numpy(
            rng.standard_normal((E, model.config.dim_obs)).astype(np.float32))
    with torch.no_grad():
        p = learner.main.views()
        learner.std.fill_(0)
        actions, mean = learner.plan(obs, torch.zeros(L, 2, E, learner.dim_action))
        given = torch.rand(L, 2, E, learner.dim_action) * 2 * learner.mask - learner.mask
        G = learner.returns(p, learner.encode(p, obs), given)
    assert actions.abs().max() <= 1 and not mean[-1].any()
    for i, model in enumerate(learner.models):
        o, d = model.config.dim_obs, model.config.dim_action
        assert not actions[i, :, d:].any() and not mean[:, i, :, d:].any()
        z = model.encode(obs[i, :, :o].numpy().T)
        for e in range(E):
            own = given[:, i, e, :d].numpy()[None, ..., None]
            np.testing.assert_allclose(
                G[i, e], fac.h_step_return(model, z[..., e:e + 1], own, PLANNING)[0, 0], rtol=2e-4)


def test_an_expert_trained_further(tmp_path, capsys, monkeypatch):
    """A first round, in which nothing is learned and all plan, the new model with noise: weights
    are the file's, rounded to float16, and its header says what they had learned from."""
    plan, widths = train_gpu.Learner.plan, []
    monkeypatch.setattr(train_gpu.Learner, "plan", lambda self, *given: (
        widths.append(self.std.flatten().tolist()), plan(self, *given))[1])
    path, out = tmp_path / "expert.npz", tmp_path / "out"
    fac.save_model(path, models()[0], {"kind": "expert", "task": TASKS[0], "decisions": 7,
                                       "updates": 3})
    small = ["--tasks", TASKS[0], "ball_in_cup-catch", "--device", "cpu", "--envs", "1",
             "--updates", "2", "--minutes", "0.001", "--precision", "float32", "--out", str(out),
             "--plan-samples", "4", "--plan-iterations", "1", "--plan-pi-trajs", "1",
             "--replay", "1"] + [
        x for name in ("mlp_dim", "enc_dim", "latent_dim", "batch_size")
        for x in ("--" + name.replace("_", "-"), str(getattr(CONFIG, name)))]
    assert train_gpu.main([*small, "--start", str(path), "--json"]) == 0
    assert '"decisions": 500' in capsys.readouterr().out.splitlines()[-1]
    assert len(widths) == 500
    np.testing.assert_allclose(widths[0], [PLANNING.min_std, CONFIG.std_start])
    one, header = fac.load_model(out / TASKS[0] / "expert.npz")
    assert header["before"] == {"decisions": 7, "updates": 3} and header["updates"] == 0
    for name, value in one.params.items():
        np.testing.assert_allclose(value, models()[0].params[name], rtol=1e-3, atol=1e-6)
    assert "before" not in fac.load_model(out / "ball_in_cup-catch" / "expert.npz")[1]
    (out / "new").mkdir()
    (out / "new" / TASKS[0]).mkdir()
    (out / "new" / TASKS[0] / "curve.csv").write_text("another's")
    for wrong, message in ((["--out", str(out / "new")], "curve.csv: not this run's"),
                           (["--start", *[str(path)] * 3], "--start: expected at most 2"),
                           (["--start", str(path), str(path)], "expected ('ball_in_cup-catch', 2)"),
                           (["--start", str(path), "--mlp-dim", "8"], "an expert with a policy"),
                           (["--plan-iterations", "0"], "must be above 0"), ([], "not this run's")):
        assert train_gpu.main([*small, *wrong]) == 2
        assert message in capsys.readouterr().err


def test_a_model_that_diverged_counts_as_failed(tmp_path, monkeypatch, capsys):
    def save(path, model, *_):
        raise fac.UserError(f"{path}: would hold values that are not finite")

    monkeypatch.setattr(fac, "save_model", save)
    assert train_gpu.main(["--tasks", "ball_in_cup-catch", "--device", "cpu", "--envs", "1",
                           "--minutes", "0.001", "--mlp-dim", "8", "--enc-dim", "8", "--json",
                           "--out", str(tmp_path)]) == 1
    assert '"failed": 1' in capsys.readouterr().out
