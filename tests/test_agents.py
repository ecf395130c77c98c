"""Agents as one chooses them: a grouping is the plain cut of a robot whose joints are permuted."""
import contextlib
import dataclasses
import json

import numpy as np
import pytest

import fac_tdmpc_ref as fac
import look
from toys import BUDGET, TINY, Joints, random_model, write_expert, write_replay

GROUPS, ORDER = "2,0/3,1", [2, 0, 3, 1]
BACK = np.argsort(ORDER)


def permuted(expert):
    """The expert of the robot whose joint i is joint ORDER[i] of the expert's."""
    params = {k: v.copy() for k, v in expert.params.items()}
    for name in ("_dynamics", "_reward", "_Q1", "_Q2"):
        latent, action = np.split(params[f"{name}.0.weight"], [expert.config.latent_dim], 2)
        params[f"{name}.0.weight"] = np.concatenate([latent, action[..., ORDER]], 2)
    for part in ("weight", "bias"):
        params[f"_pi.4.{part}"] = params[f"_pi.4.{part}"][:, ORDER]
    return fac.WorldModel(expert.config, params)


def replay_of(path, order):
    write_replay(path, dims=(8, 4))
    header, arrays = fac.read_npz(path, ("replay",))
    fac.write_npz(path, header, {**arrays, "action": arrays["action"][:, order]})
    return fac.Replay(path)


def learned(distiller, episodes, noise, monkeypatch):
    """A part of a pool, the losses of ten steps and ranks, with `noise` for perturbed_actions."""
    with monkeypatch.context() as patch:
        patch.setattr(fac, "perturbed_actions", noise)
        distiller.add(*episodes)
        drawn = distiller.draw(0, 0, 32)
        losses = [distiller.step() for _ in range(10)]
        return drawn, losses, distiller.ranks(16)


def test_a_grouping_learns_and_plans_as_the_plain_cut_of_a_permuted_robot(tmp_path, monkeypatch):
    expert, real = random_model(1, 4, policy=True), fac.perturbed_actions
    config = fac.DistillConfig(steps=20, batch_size=8, warmup=1, held_out=0.34, expert_episodes=2)
    with contextlib.closing(fac.Distiller(
            expert, replay_of(tmp_path / "a.npz", slice(None)), config, GROUPS)) as grouped, \
            contextlib.closing(fac.Distiller(
                permuted(expert), replay_of(tmp_path / "b.npz", ORDER), config, 2)) as plain:
        around = fac.PlannerConfig(**{**fac.STUDENT_PLANNING, "samples": 16})
        obs, action = fac.expert_episodes(grouped, None, around, environment=Joints())
        ours = learned(grouped, (obs, action), real, monkeypatch)
        theirs = learned(plain, (obs, action[..., ORDER]), lambda actions, *rest: real(
            actions[:, BACK], *rest)[:, ORDER], monkeypatch)
    assert grouped.student.config == dataclasses.replace(plain.student.config, groups=GROUPS)
    (features, actions, targets), losses, ranks = ours
    assert np.array_equal(features, theirs[0][0])
    assert np.allclose(actions, theirs[0][1], atol=1e-5)  # both in the agents' order
    assert targets[0].shape == (2, 4, 32, 5)  # credit: each agent's part
    for part, other in zip(targets, theirs[0][2]):
        assert np.allclose(part, other, atol=1e-4) and np.abs(part).max() > 1e-2
    assert np.allclose(losses, theirs[1], rtol=1e-3) and np.allclose(ranks, theirs[2], atol=0.02)

    # the same weights, so that rounding in learning doesn't matter: whole episodes are the same
    twin = fac.WorldModel(plain.student.config, {**grouped.student.params, **{
        k: v for k, v in plain.student.params.items() if k.startswith("_expert")}})
    for prior in ("own", "last"):
        config = dataclasses.replace(around, prior=prior)
        ours = fac.play(grouped.student, None, config, [3, 4], environment=Joints())
        theirs = fac.play(twin, None, config, [3, 4], environment=Joints(ORDER))
        for x, y in ((ours[0], theirs[0]), (ours[2], theirs[2])):
            assert np.allclose(x, y, atol=1e-3)
        assert np.allclose(ours[1][..., ORDER], theirs[1], atol=1e-3)
        assert not np.allclose(ours[1], theirs[1], atol=0.1)

    fac.save_model(tmp_path / "student.npz", grouped.student, {"kind": "student"})
    again, _ = fac.load_model(tmp_path / "student.npz")
    assert again.config.groups == GROUPS
    obs = np.linspace(-1, 1, 8)
    actions = [planner.act(obs) for planner in (
        fac.Planner(again, around), fac.Planner(grouped.student, around))]
    with fac.Planner(again, around, workers=1) as planner:
        actions.append(planner.act(obs))
    assert all(np.array_equal(action, actions[0]) for action in actions)


def test_what_is_told_of_joints_is_told_in_the_robot_s_order(tmp_path):
    """agreement's ranks by joint, what the policy would do and figure 9's credit."""
    expert = random_model(1, 4, policy=True)
    plain = random_model(2, 4, seed=1)
    grouped = fac.WorldModel(dataclasses.replace(plain.config, groups=GROUPS), plain.params)
    rng = np.random.default_rng(0)
    obs = rng.standard_normal((8, 6)).astype(np.float32)
    actions = rng.uniform(-1, 1, (4, 6)).astype(np.float32)
    values = rng.uniform(-1, 1, (4, 6 * 32))

    class Values:
        """The values that each joint takes, by joint."""
        def __init__(self, order):
            self.next = iter(values[order])

        def uniform(self, *_):
            return next(self.next)

    ours = look.agreement(grouped, expert, obs, actions, Values(slice(None)))
    theirs = look.agreement(plain, permuted(expert), obs, actions[ORDER], Values(ORDER))
    assert np.allclose(ours[ORDER], theirs, atol=0.02)
    config = fac.PlannerConfig(samples=8, iterations=1)
    plans = (fac.policy_plan(expert, obs, 4, grouped.config),
             fac.policy_plan(permuted(expert), obs, 4, plain.config))
    assert plans[0].shape == (2, 4, 2, 6) and np.allclose(*plans, atol=1e-4)
    episode = rng.standard_normal((9, 8)).astype(np.float32), rng.uniform(-1, 1, (9, 4))
    assert np.allclose(look.credit(grouped, *episode, config),
                       look.credit(plain, episode[0], episode[1][:, ORDER], config))


@pytest.mark.parametrize("groups, num_agents", [
    ("0,1/2,3", 1), ("0,1,2/3", 2), ("0,1/2", 2), ("0,1/2,2", 2), ("0,1/2,4", 2), ("a,b/2,3", 2),
    ("0,1/2,3/", 3), ("0,1/2,-3", 2), ("0, 1/2,3", 2), (",", 1), ("0,1,2,3", 2)])
def test_what_is_no_grouping_is_refused_in_one_line(groups, num_agents):
    with pytest.raises(fac.UserError) as caught:
        fac.ModelConfig(8, 4, num_agents, groups=groups)
    message = str(caught.value)
    assert "\n" not in message and (f"{groups!r}" in message or "num_agents must be" in message)
    assert fac.ModelConfig(8, 4, 2, groups=GROUPS).groups == GROUPS


def test_distill_takes_agents_and_evaluate_plays_them(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fac, "CONTROL_STEPS", 40)  # of 1000
    monkeypatch.chdir(tmp_path)
    write_expert(tmp_path / "expert.npz")
    write_replay(tmp_path / "replay.npz")
    command = ["distill", "--task", "reacher-hard", "--expert", str(tmp_path), "--workers", "0",
               *TINY, "--out", "run", "--json"]

    def refuses(*flags, parts):
        assert fac.main([*command, *flags]) == 2
        err = capsys.readouterr().err.splitlines()[-1]
        assert all(part in err for part in parts), err

    for groups in ("0/1/1", "0/1/3", "0,1/2/", ",1/2/0", ""):
        refuses("--agents", groups, parts=["groups", "0 to 2 once", "--agents 0,2/1,3"])
    for groups in ("0/1", "0,1/2"):
        refuses("--agents", groups, parts=["num_agents", "[1, 3]", "shared evenly, not 2"])
    refuses("--agents", "2/0/1", "--plain", parts=["--plain", "--num-agents"])
    with pytest.raises(SystemExit):
        fac.main([*command, "--agents", "2/0/1", "--num-agents", "3"])
    assert "not allowed with argument" in capsys.readouterr().err
    assert fac.main([*command, "--agents", "2/0/1"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    model, header = fac.load_model(tmp_path / "run" / "student.npz")
    assert result["num_agents"] == 3 and model.config.groups == header["num_agents"] == "2/0/1"
    refuses(parts=["num_agents", "expected 3, found 2/0/1"])
    assert fac.main(["evaluate", "--model", "run/student.npz", "--episodes", "1", "--workers", "0",
                     *BUDGET, "--json"]) == 0
    played = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert played["returns"] == result["student_returns"]
