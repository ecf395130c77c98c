"""data/tdmpc2.py: small models of four tasks, as TD-MPC2's public code saves them, made here."""
import collections
import contextlib
import copy
import json

import numpy as np
import pytest

import fac_tdmpc_ref as fac
import import_expert
import multitask
import tdmpc2
from toys import ROBOTS, assert_close, numeric_gradient, refusal, write_replay

NAMES = ["walker-walk", "-", "hopper-hop", "reacher-hard"]
TASK, WIDE, M, E, A = "hopper-hop", 24, 16, 7, 6  # a robot that isn't the widest; model's sizes
CONFIG = fac.DistillConfig(steps=200, batch_size=16, warmup=10, expert_episodes=0, held_out=0.34,
                           horizon=2, encoder_input="observation")


def widths(hidden=20, enc=12, count=101):
    """{network in a file: (widths, whether its last layer is normed)}."""
    into = (M + E + A, hidden, hidden)
    return {"_encoder.state": ((WIDE + E, enc, enc, M), True), "_dynamics": ((*into, M), True),
            "_reward": ((*into, count), False), "_Qs.params": ((*into, count), False),
            "_pi": ((M + E, hidden, hidden, 2 * A), False)}


def make_state(seed=0):
    """A state dict of random weights, in the layout with Q by layer."""
    rng = np.random.default_rng(seed)

    def draw(*shape):
        return rng.standard_normal(shape).astype(np.float32)

    state = {"_task_emb.weight": draw(4, E) / 2, "_action_masks": np.zeros((4, A), np.float32),
             "log_std_min": np.float32([-10]), "log_std_dif": np.float32([12])}
    for mask, name in zip(state["_action_masks"], NAMES):
        mask[:ROBOTS.get(name, (0, 2))[1]] = 1
    for name, (sizes, normed) in widths().items():
        five = (5,) if name == "_Qs.params" else ()
        for k, (before, after) in enumerate(zip(sizes, sizes[1:])):
            state[f"{name}.{k}.weight"] = draw(*five, after, before) / np.float32(before ** 0.5)
            state[f"{name}.{k}.bias"] = draw(*five, after) / 2
            if normed or k < len(sizes) - 2:
                state[f"{name}.{k}.ln.weight"] = 1 + draw(*five, after) / 2
                state[f"{name}.{k}.ln.bias"] = draw(*five, after) / 2
    state.update({key.replace("_Qs.", "_target_Qs_"): draw(*value.shape)
                  for key, value in state.items() if key.startswith("_Qs.")})
    return state


def flat(state):
    """A state dict in the older layout: both ensembles as lists, no buffers."""
    found = {key: value for key, value in state.items() if "Qs" not in key and
             key[:4] not in ("_act", "log_")}
    for name in ("_Qs", "_target_Qs"):
        own = [value for key, value in state.items() if key.startswith(name)]
        found.update({f"{name}.params.{i}": value for i, value in enumerate(own)})
    return found


def write(path, state):
    np.savez(path, **state)
    return path


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("tdmpc2") / "model.npz"
    return tdmpc2.Checkpoint(write(path, make_state()), NAMES)


def in_float64(checkpoint, task=TASK):
    """A task's teacher in double precision."""
    precise = copy.copy(checkpoint)
    precise.embedding = checkpoint.embedding.astype(float)
    precise.params = {key: value.astype(float) for key, value in checkpoint.params.items()}
    return precise.teacher(task)


# the forward ------------------------------------------------------------------------------


class Reference:
    """TD-MPC2's model in PyTorch: batch first, observations and actions of the widest robot."""

    def __init__(self, torch, state, task, dtype):
        self.torch, self.fn = torch, torch.nn.functional
        self.state = {key: torch.tensor(value).to(dtype) for key, value in state.items()}
        self.mask = self.state["_action_masks"][task]
        self.embedding = self.fn.embedding(torch.tensor([task]), self.state["_task_emb.weight"],
                                           max_norm=1)

    def network(self, name, x, member=...):
        depth = len(widths()[name][0]) - 1
        for k in range(depth):
            W, b, *ln = (self.state[f"{name}.{k}.{part}"][member] for part in (
                "weight", "bias", "ln.weight", "ln.bias") if f"{name}.{k}.{part}" in self.state)
            x = self.fn.linear(x, W, b)
            if ln:
                x = self.fn.layer_norm(x, x.shape[-1:], *ln)
            if k < depth - 1:
                x = self.fn.mish(x)
        return x

    def simplices(self, x):
        return self.fn.softmax(x.unflatten(-1, (-1, 8)), -1).flatten(-2)

    def value(self, logits):
        spread = self.torch.linspace(-10, 10, 101, dtype=logits.dtype)
        v = (self.fn.softmax(logits, -1) * spread).sum(-1)
        return self.torch.sign(v) * (self.torch.exp(v.abs()) - 1)

    def joined(self, x, *more):
        return self.torch.cat([x, self.embedding.expand(len(x), -1), *more], -1)

    def outputs(self, obs, a):
        z = self.simplices(self.network("_encoder.state", self.joined(obs)))
        x = self.joined(z, a)
        mean, _ = self.network("_pi", self.joined(z)).chunk(2, -1)
        return [z, self.simplices(self.network("_dynamics", x)),
                self.value(self.network("_reward", x)),
                *(self.value(self.network("_Qs.params", x, i)) for i in range(2)),
                self.torch.tanh(mean * self.mask)]


def outputs(teacher, obs, a):
    """What `Reference.outputs` gives, samples first."""
    z = teacher.encode(obs)
    found = [z, teacher.next(z, a), teacher.reward(z, a), *teacher.q(z, a), teacher.policy(z)]
    return [value[0].T for value in found]


def save_torch(torch, path, state, layout):
    """What the public code's torch.save writes, of a state dict in one of its layouts."""
    state = {key: torch.nn.Parameter(torch.tensor(value)) for key, value in (
        flat(state) if layout == "flat" else state).items()}
    if layout != "flat":  # what tensordict adds, before and since it keeps this as metadata
        state["_Qs.module.0.weight"] = torch.empty(20, M + E + A, device="meta")
        state.update({"_Qs.params.__batch_size": torch.Size([5]), "_Qs.params.__device":
                      torch.device("cuda:0")} if layout == "by layer" else {})
        state = collections.OrderedDict(state)
        state._metadata = {"_Qs.params": {"batch_size": torch.Size([5]), "device": None}}
    torch.save({"model": state}, path)


@pytest.mark.parametrize("layout", ["flat", "by layer", "by layer, with metadata"])
@pytest.mark.parametrize("task", ROBOTS)
def test_a_checkpoint_computes_what_torch_does(tmp_path, layout, task):
    torch = pytest.importorskip("torch")
    state, index = make_state(1), NAMES.index(task)
    assert (np.linalg.norm(state["_task_emb.weight"], axis=1) > 1).any(), "none is shortened"
    save_torch(torch, tmp_path / "model.pt", state, layout)
    checkpoint = tdmpc2.Checkpoint(tmp_path / "model.pt", NAMES)
    teacher = checkpoint.teacher(task)
    assert (teacher.config.dim_obs, teacher.config.dim_action) == ROBOTS[task]
    assert teacher.has_policy
    rng, (dim_obs, dim_action) = np.random.default_rng(2), ROBOTS[task]
    obs, a = rng.standard_normal((dim_obs, 50)), rng.uniform(-1, 1, (1, dim_action, 50))
    wide = [torch.tensor(np.pad(x, ((0, 0), (0, width - x.shape[1]))))
            for x, width in ((obs.T, WIDE), (a[0].T, A))]
    for dtype, tolerance, model in ((np.float32, 1e-5, teacher),
                                    (float, 1e-11, in_float64(checkpoint, task))):
        kind = torch.float32 if dtype is np.float32 else torch.float64
        expected = Reference(torch, state, index, kind).outputs(*(x.to(kind) for x in wide))
        for found, value in zip(outputs(model, obs.astype(dtype), a.astype(dtype)), expected):
            value = value.numpy()
            value = value[:, :dim_action] if value.shape[1:] == (A,) else value
            error = np.abs(found - value) / np.maximum(1, np.abs(value))
            assert found.dtype == dtype and found.shape == value.shape and error.max() < tolerance
            assert value.std() > 0.01, "the check compares constants"


def test_layers_are_torch_s_far_from_zero():
    torch = pytest.importorskip("torch")
    x = np.float32(np.r_[-200, -50:50:0.25, 200]).reshape(1, -1, 1)
    expected = torch.nn.functional.mish(torch.tensor(x)).numpy()
    np.testing.assert_allclose(tdmpc2.mish(x), expected, rtol=1e-5, atol=1e-30)
    assert np.isfinite(tdmpc2.mish_backward(x, x)).all()
    far = np.float32([1e4, -1e4, 0, 3]).reshape(1, 4, 1)
    assert tdmpc2.simnorm(far, 4)[0, :, 0].tolist() == [1, 0, 0, 0]
    for logits, chosen in ((far, -10), (-far, -10 / 3)):  # of the bins -10, -10/3, 10/3, 10
        np.testing.assert_allclose(tdmpc2.two_hot(logits), -np.expm1(-chosen), rtol=1e-5)


# the backward -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", tdmpc2.LAST)
def test_networks_backward_is_what_differences_say(checkpoint, name):
    rng, model = np.random.default_rng(4), in_float64(checkpoint)
    x = rng.standard_normal((1, model.params[f"{name}.0.weight"].shape[2], 3))
    dy = rng.standard_normal(model.forward(name, x, tape := []).shape)
    expected = numeric_gradient(lambda: (model.forward(name, x) * dy).sum(), x)
    assert np.abs(expected).max() > 1e-3
    assert_close(model.backward(name, tape, dy, None), expected, 1e-6)
    assert not tape


def test_credit_is_what_moving_an_agent_s_actions_does(checkpoint):
    """Central differences of rewards and mean Q at each h, by each agent's actions at all steps."""
    rng, teacher = np.random.default_rng(5), in_float64(checkpoint)
    L, (dim_obs, agents) = 3, ROBOTS[TASK]
    z = teacher.encode(rng.standard_normal((dim_obs, 2)))
    at, step = rng.uniform(-0.9, 0.9, (2, L, agents, 2, 1)) * [[[[[1]]]], [[[[1e-3]]]]]

    def predicted(actions, tapes=None):
        reward, q1, q2 = fac.predict(teacher, z, actions, tapes)
        return np.stack([reward, (q1 + q2) / 2])

    ends, tapes = np.concatenate([at - step, at + step], -1), collections.defaultdict(list)
    y = predicted(ends, tapes)
    parts = fac.credit(teacher, tapes, ends, [y[0], y[1], y[1]], fac.ModelConfig(8, agents, agents))
    for i in range(agents):
        alone = np.where(np.arange(agents)[:, None, None] == i, step, 0)
        moved = predicted(np.concatenate([at - alone, at + alone], -1))
        expected = moved[..., 1] - moved[..., 0]
        assert np.abs(expected).max() > 1e-5
        assert_close(np.stack(parts[:2])[:, i, ..., 1], expected, 1e-4)


# distillation -----------------------------------------------------------------------------


def test_a_student_learns_from_a_teacher(checkpoint, tmp_path):
    write_replay(tmp_path / "replay.npz", ROBOTS[TASK])
    replay = fac.Replay(tmp_path / "replay.npz")
    with contextlib.closing(fac.Distiller(checkpoint.teacher(TASK), replay, CONFIG)) as distiller:
        before = distiller.ranks(64)[1].mean()
        losses = np.array([*distiller.run()])[:, 0]
        after = distiller.ranks(64)[1].mean()
    assert losses[-20:].mean() < 0.8 * losses[:20].mean() and after > before + 0.2


def test_the_command_has_a_teacher_play_and_a_student_distilled(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fac, "CONTROL_STEPS", 40)  # of 1000
    monkeypatch.chdir(tmp_path)
    teacher = ["--teacher", str(write(tmp_path / "model.npz", flat(make_state()))),
               "--teacher-tasks", *NAMES]
    flags = ["distill", *teacher, "--collect", "3", "--steps", "6", "--batch-size", "12",
             "--horizon", "1", "--held-out", "0.34", "--expert-episodes", "2", "--workers", "0",
             "--out", "runs/a", "--json"]
    assert multitask.main(flags) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["tasks"] == ["walker-walk", "hopper-hop", "reacher-hard"]
    assert len([*tmp_path.glob("runs/played/collected-*/*/replay.npz")]) == 3
    replay = fac.Replay(next(tmp_path.glob("runs/played/*/hopper-hop/replay.npz")))
    assert (len(replay.ends), replay.transitions) == (3, 3 * 19)
    monkeypatch.setattr(import_expert, "collect", None)  # nothing is played again
    assert multitask.main([*flags[:-2], "runs/b", "--json"]) == 0
    saved = [fac.read_npz(path / "student.npz", ("multitask",))[1]
             for path in (tmp_path / "runs" / "a", tmp_path / "runs" / "b")]
    assert all(np.array_equal(saved[0][key], saved[1][key]) for key in saved[0])
    capsys.readouterr()
    evaluate = ["evaluate", "--model", "runs/a/student.npz", "--episodes", "1", "--workers", "0",
                "--tasks", TASK, "--samples", "4", "--json"]
    assert multitask.main([*evaluate, *teacher]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])["tasks"][TASK]
    assert len(found["returns"]) == len(found["teacher_returns"]) == 1
    write(tmp_path / "model.npz", make_state(7))
    assert multitask.main([*evaluate, *teacher]) == 2
    assert "another expert" in capsys.readouterr().err


def test_a_teacher_needs_episodes_of_its_action_repeat(tmp_path, capsys):
    model = write(tmp_path / "model.npz", make_state())
    flags = ["distill", "--tasks", TASK, "--data", str(tmp_path), "--out", str(tmp_path / "run")]
    teacher = ["--teacher", str(model), "--teacher-tasks", *NAMES]
    for more, parts in ((["--collect", "3"], ["--collect", "--teacher"]),
                        (teacher, ["replay.npz: no such file", "--collect 20"])):
        assert multitask.main([*flags, *more]) == 2
        err = capsys.readouterr().err
        assert all(part in err for part in parts) and err.count("\n") == 1
    path = tmp_path / TASK / "replay.npz"
    write_replay(path, ROBOTS[TASK])
    header, arrays = fac.read_npz(path, ("replay",))
    fac.write_npz(path, {**header, "action_repeat": 4}, arrays)
    assert multitask.main([*flags, *teacher]) == 2
    expected = "action_repeat: expected 2, as the expert was made for, found 4"
    assert expected in capsys.readouterr().err


# files ------------------------------------------------------------------------------------


def zeros(*shape):
    return np.zeros(shape, np.float32)


@pytest.mark.parametrize("change, parts", [
    (lambda s: s.pop("_dynamics.1.ln.bias"), ["_dynamics.1.ln.bias", "(20,)", "found nothing"]),
    (lambda s: s.pop("_Qs.params.2.bias"), ["_Qs.params.2.bias", "(5, 101)", "found nothing"]),
    (lambda s: s.pop("_task_emb.weight"), ["_task_emb.weight", "rank 2", "many tasks"]),
    (lambda s: s.pop("_encoder.state.0.weight"), ["_encoder.state.0.weight", "state input"]),
    (lambda s: s.update({"_pi.2.weight": zeros(6, 20)}), ["_pi.2.weight", "(12, 20)", "(6, 20)"]),
    (lambda s: s.update({"_Qs.params.1.weight": zeros(20, 20)}), ["_Qs.params.1.weight", "5, 20"]),
    (lambda s: s.update({"_reward.2.weight": zeros(1, 20)}), ["two bins", "1 bins"]),
    (lambda s: s.update({"_dynamics.2.weight": zeros(12, 20)}), ["groups of 8", "12 features"]),
    (lambda s: s.update({"_dynamics.0.weight": zeros(20, 9)}), ["dim_action must be at least 1"]),
    (lambda s: s.update({"_action_masks": zeros(4, 5)}), ["_action_masks", "(4, 6)", "(4, 5)"]),
    (lambda s: s.update({"_termination.0.weight": zeros(20, 23)}), ["'_termination.0.weight'"]),
    (lambda s: s.update({"_reward.0.bias": zeros(20) + np.nan}), ["_reward.0.bias", "finite"]),
    (lambda s: s.update({"_reward.0.bias": np.zeros(20, bool)}), ["_reward.0.bias", "bool (20,)"])])
def test_what_does_not_fit_is_one_line(tmp_path, change, parts):
    change(state := make_state())
    path = write(tmp_path / "model.npz", state)
    refusal(lambda: tdmpc2.Checkpoint(path, NAMES), str(path), *parts)


def test_names_that_do_not_fit_the_model_are_refused(tmp_path, monkeypatch):
    path = write(tmp_path / "model.npz", make_state())
    refusal(lambda: tdmpc2.Checkpoint(path), "4 tasks", "0 names", "--teacher-tasks")
    for names in (["-"] * 4, [TASK, TASK, "-", "-"]):
        refusal(lambda names=names: tdmpc2.Checkpoint(path, names), "--teacher-tasks", "each once")
    refusal(lambda: tdmpc2.Checkpoint(path, NAMES).teacher("walker-run"), "not walker-run",
            "walker-walk, hopper-hop, reacher-hard")
    refusal(lambda: tdmpc2.Checkpoint(path, NAMES[::-1]).teacher("walker-walk"), "task 3",
            "3 of 6 actions", "walker-walk has (24, 6)")
    monkeypatch.setattr(tdmpc2, "MAX_WEIGHTS", 9999)
    refusal(lambda: tdmpc2.Checkpoint(path, NAMES), "at most 9999 weights")
    monkeypatch.undo()
    path = write(tmp_path / "model.npz", flat(make_state()))  # without masks
    refusal(lambda: tdmpc2.Checkpoint(path, ["quadruped-walk", *"---"]).teacher("quadruped-walk"),
            "up to 24 features", "(78, 12)")


def test_mt30_s_names_are_in_its_order():
    """Those whose robots tell them apart by their sizes, and the reachers, of three links here."""
    assert len(tdmpc2.MT30) == 30 and len(tdmpc2.KNOWN[80]) == 80
    known = [name for name in tdmpc2.MT30 if name != "-"]
    assert len({*known}) == len(known) == 19
    assert [tdmpc2.MT30[i] for i in (0, 3, 12, 16, 18, 26, 27)] == [
        "walker-stand", "cheetah-run", "ball_in_cup-catch", "fish-swim", "hopper-hop",
        "reacher-easy", "reacher-hard"]
    assert {"reacher-easy", "reacher-hard"}.isdisjoint(tdmpc2.MT30[:26])
