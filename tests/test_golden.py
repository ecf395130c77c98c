"""What PyTorch computed on the shipped weights, without PyTorch.

The references are float64 results on float32 weights; ours are float32.
"""
import shutil

import numpy as np
import pytest

import fac_tdmpc_ref as fac
from numpy_learner import ExpertConfig
from toys import (ADAM, FORWARD, GOLDEN, GRADIENT, NARROW, UNSEEN, assert_digest, narrow_expert,
                  present, relative)


@pytest.fixture(scope="module", params=GOLDEN)
def golden(request):
    folder = fac.EXPERTS / request.param
    model, _ = fac.load_model(folder / "expert.npz")
    header, arrays = fac.read_npz(folder / "golden.npz", ("golden",))
    return model, header, arrays


def test_there_is_an_expert():
    assert "reacher-hard" in GOLDEN


def test_expert_forward(golden):
    model, _, g = golden
    z = model.encode(g["obs"][0])
    a = g["action"][0][None]
    q1, q2 = model.q(z, a)
    for name, found in (("latent", z[0]), ("next_latent", model.next(z, a)[0]), ("q1", q1[0]),
                        ("reward", model.reward(z, a)[0]), ("q2", q2[0]),
                        ("policy", model.policy(z)[0])):
        assert found.dtype == np.float32
        assert relative(found, g[name]) < FORWARD, name


class FixedNoise:
    """Stands for a Generator: gives the golden file's noise."""

    def __init__(self, noise):
        self.noise = noise

    def standard_normal(self, shape, dtype):
        assert shape == self.noise.shape and dtype == np.float32
        return self.noise.copy()


def test_one_mppi_refinement(golden):
    model, header, g = golden
    config = fac.PlannerConfig(**{**present(fac.PlannerConfig, header["planner"]),
                                  "iterations": 1, "momentum": 0.0})
    z = model.encode(g["obs"][0][:, :1])
    fast = fac.Returns(model)
    fast.start(z, config)
    actions = np.clip(g["mppi_mean"][..., None] + config.max_std * g["mppi_noise"], -1, 1)[None]
    for returns in (fast(actions), fac.h_step_return(model, z, actions, config)):
        assert relative(returns[0], g["mppi_returns"]) < FORWARD
    mean, elites, weights = fac.mppi(fast, g["mppi_mean"][None], config,
                                     [FixedNoise(g["mppi_noise"])])
    assert np.isclose(weights.sum(), 1, atol=1e-6)
    expected = actions[0][..., g["mppi_elites"]]
    assert np.array_equal(np.sort(elites[0], axis=-1), np.sort(expected, axis=-1))
    # a weight is exp of a return: an error of 1e-5 in the return is one of 1e-5 in the weight
    assert np.abs(mean[0] - g["mppi_refined"]).max() < 1e-4
    std = np.sqrt((weights[0] * (elites[0] - mean[0][..., None]) ** 2).sum(-1))
    assert np.abs(np.clip(std, config.min_std, config.max_std) - g["mppi_std"]).max() < 1e-4


def golden_student(header, g, expert, dtype):
    """The stored student and its batch, with the expert's part computed in `dtype`."""
    expert = fac.WorldModel(expert.config, {k: v.astype(dtype) for k, v in expert.params.items()})
    student = fac.WorldModel(fac.ModelConfig(**header["student"]), {
        k[len("student "):]: v.astype(dtype) for k, v in g.items() if k.startswith("student ")})
    features = expert.encode(g["kl_obs"].astype(dtype))
    batch = features, g["kl_actions"].astype(dtype)
    return student, (*batch, fac.predict(expert, *batch)), fac.DistillConfig(
        **present(fac.DistillConfig, header["distill"]))


def ten_steps(student, batch, config, lr, losses, check_gradients=lambda grads: None):
    """Adam as Distiller runs it; returns the weights by name and whether every step clipped."""
    adam = fac.Adam(student.params)
    student, clipped = fac.WorldModel(student.config, adam.params), True
    for step, expected in enumerate(losses):
        loss, _, _ = fac.distill_loss(student, *batch, config, adam.grads)
        assert abs(loss / expected - 1) < ADAM
        if step == 0:
            check_gradients(adam.grads)
        clipped &= adam.step(lr, config.grad_clip) > config.grad_clip
    return adam.params, clipped


def test_kl_loss_and_gradients(golden):
    expert, header, g = golden
    student, batch, config = golden_student(header, g, expert, np.float32)
    grads = {k: np.zeros_like(v) for k, v in student.params.items()}
    loss, _, _ = fac.distill_loss(student, *batch, config, grads)
    assert abs(loss / g["kl_loss"] - 1) < FORWARD
    for key, gradient in grads.items():
        if key in UNSEEN:
            assert np.abs(gradient).max() < 1e-6
        else:
            assert_digest(gradient, g[f"kl_grad {key}"], GRADIENT)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_ten_adam_steps(golden, dtype):
    # Adam divides a gradient by its own size, so it makes as much of one that float32 rounds away
    # as of any other: biases, which start at zero, show that, and are compared in float64
    expert, header, g = golden
    student, (*batch, _), config = golden_student(header, g, expert, dtype)
    # a softmax doesn't see a constant, and float32 rounds a Q near 100 without it much less
    _, (*_, targets), _ = golden_student(header, g, expert, np.float64)
    batch.append([(t - t.mean(-1, keepdims=True)).astype(dtype) for t in targets])
    views, _ = ten_steps(student, batch, config, config.lr, g["adam_losses"])
    for key, value in views.items():
        if key.endswith("weight") or (dtype == np.float64 and key not in UNSEEN):
            assert_digest(value, g[f"adam {key}"], ADAM)


# ------------------------------------------------------- the narrow networks, in full


def narrow_case(tag, dtype):
    header, arrays = fac.read_npz(NARROW, ("golden",))
    g = {k[len(tag) + 1:]: v for k, v in arrays.items() if k.startswith(tag + " ")}
    config = header["configs"][tag]
    student = fac.WorldModel(fac.ModelConfig(**present(fac.ModelConfig, config["student"])), {
        k[len("weight "):]: v.astype(dtype) for k, v in g.items() if k.startswith("weight ")})
    batch = [g[k].astype(dtype) for k in ("features", "actions", "targets")]
    return student, batch, g, fac.DistillConfig(**present(fac.DistillConfig, config["distill"]))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", ["forward", "reverse"])
@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_narrow_students(n, kind, dtype):
    student, batch, g, config = narrow_case(f"{n} {kind}", dtype)
    outputs = fac.predict(student, student.encode_features(batch[0]), batch[1])
    for found, expected in zip(outputs, g["outputs"]):
        assert relative(found, expected) < FORWARD

    def check_gradients(grads):
        for key, found in grads.items():
            if key in UNSEEN:
                assert np.abs(found).max() < 1e-6
            else:
                assert relative(found, g[f"grad {key}"]) < GRADIENT, key

    views, clipped = ten_steps(student, batch, config, 1e-3, g["adam_losses"], check_gradients)
    assert clipped, "the case should clip"
    for key, found in views.items():
        if key.endswith("weight") or (dtype == np.float64 and key not in UNSEEN):
            assert relative(found, g[f"adam {key}"]) < ADAM, key


# ------------------------------------------------------- PyTorch itself, on the same inputs


@pytest.fixture
def export_golden():
    torch = pytest.importorskip("torch")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # more of them wait for a busy core
    import export_golden
    yield export_golden
    torch.set_num_threads(threads)


def settings_of(config_class, header, name):
    return config_class(**present(config_class, header[name]))


def assert_same(found, stored, tolerance):
    for key, value in found.items():
        if not key.endswith(tuple(UNSEEN)):
            assert relative(np.asarray(value).reshape(stored[key].shape), stored[key]) < tolerance


def test_pytorch_computes_what_a_golden_file_holds(golden, export_golden):
    expert, header, g = golden
    found = export_golden.task_golden(expert, g, settings_of(ExpertConfig, header, "training"),
                                      settings_of(fac.PlannerConfig, header, "planner"),
                                      settings_of(fac.DistillConfig, header, "distill"))
    assert {"kl_loss", "mppi_elites", "equation1_loss", "adam_losses"} <= set(found) <= set(g)
    assert_same(found, g, 1e-9)


def test_pytorch_computes_what_the_narrow_file_holds(export_golden):
    header, g = fac.read_npz(NARROW, ("golden",))
    experts = [narrow_expert(header, g, prefix).params for prefix in ("model ", "target ")]
    found = export_golden.expert_golden(*experts, g, settings_of(ExpertConfig, header,
                                                                 "training"))
    assert_same(found, g, 1e-6)  # kept as float32
    for tag, config in header["configs"].items():
        distill = settings_of(fac.DistillConfig, config, "distill")
        assert_same(export_golden.narrow_golden(g, tag, config["student"]["num_agents"], distill),
                    g, 1e-6)


def test_the_export_writes_files_of_the_same_entries(tmp_path, export_golden, capsys):
    (tmp_path / "reacher-hard").mkdir()
    for name in ("expert.npz", "replay.npz"):
        shutil.copy(fac.EXPERTS / "reacher-hard" / name, tmp_path / "reacher-hard")
    assert export_golden.main(["--data", str(tmp_path)]) == 0
    for name in ("reacher-hard/golden.npz", "golden-narrow.npz"):
        header, found = fac.read_npz(tmp_path / name, ("golden",))
        shipped, expected = fac.read_npz(fac.EXPERTS / name, ("golden",))
        assert set(header) == set(shipped)
        assert {k: (v.shape, v.dtype) for k, v in found.items()} == {
            k: (v.shape, v.dtype) for k, v in expected.items()}
    assert export_golden.main(["--data", str(tmp_path), "walker-walk"]) == 2
    header, weights = fac.read_npz(tmp_path / "reacher-hard" / "expert.npz", ("expert",))
    policy = {key for key in weights if key.startswith("_pi")}
    for i, (changed, without, part) in enumerate((
            ({"task": None}, set(), "unknown task"), ({}, policy, "_pi.0.weight: missing"),
            ({"task": "walker-walk"}, set(), "walker-walk has (24, 6)"),
            ({"kind": "student"}, set(), "'student'"))):
        fac.write_npz(tmp_path / str(i) / "expert.npz", {**header, **changed},
                      {key: weights[key] for key in weights.keys() - without})
        shutil.copy(fac.EXPERTS / "reacher-hard" / "replay.npz", tmp_path / str(i))
        assert export_golden.main(["--data", str(tmp_path), str(i)]) == 2
        assert part in capsys.readouterr().err
