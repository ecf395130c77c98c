"""What several test modules share: small models, data and robots, and running commands."""
import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "data")]  # whatever is installed, and for whatever starts

import fac_tdmpc_ref as fac  # noqa: E402
from numpy_learner import ExpertConfig, Learner  # noqa: E402

SCRIPT = ROOT / "fac_tdmpc_ref.py"
# A softmax doesn't see a constant, so these have no gradient but rounding errors, and Adam lets
# them wander. Planning doesn't see a constant either.
UNSEEN = ("_reward.4.bias", "_Q1.5.bias", "_Q2.5.bias")
FORWARD, GRADIENT, ADAM = 1e-5, 1e-4, 1e-5  # relative to the largest entry, or to the norm
NARROW = fac.EXPERTS / "golden-narrow.npz"
GOLDEN = sorted(p.parent.name for p in fac.EXPERTS.glob("*/golden.npz"))
BUDGET = ["--samples", "16", "--iterations", "1"]
STEPS = 6
TINY = ["--steps", str(STEPS), "--batch-size", "4", "--horizon", "1", "--held-out", "0.34",
        "--warmup", "2", "--expert-episodes", "0", "--episodes", "1", "--plan-samples", "16",
        "--plan-iterations", "1"]
# BLAS threads that wait for a busy core make runs many times longer
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
BLOCKED = "raise ImportError('blocked by a test')\n"
TRAINING = ["--task", "reacher-easy", "--steps", "3000", "--envs", "2", "--seed-decisions", "1000",
            "--updates-per-step", "0.01", "--batch-size", "8", "--mlp-dim", "16", "--enc-dim", "8",
            "--latent-dim", "6", "--plan-samples", "8", "--plan-iterations", "1",
            "--evaluate-every", "2000", "--evaluate-episodes", "1", "--distill-batch-size", "8",
            "--student", "fac", "--workers", "1", "--episodes", "0"]
EQUATION_1 = ExpertConfig(latent_dim=3, enc_dim=5, mlp_dim=6, lam=0.7, batch_size=4,
                          consistency_coef=1.5, value_coef=0.3)
CONFIG = fac.DistillConfig(steps=300, batch_size=16, warmup=20, lr=3e-3, horizon=3,
                           expert_episodes=0, noise_std=0.5)
ROBOTS = {"reacher-hard": (8, 3), "hopper-hop": (15, 4), "walker-walk": (24, 6)}
SWEEP = ["sweep", "--tasks", "cheetah-run", "--seeds", "0", "--steps", "4", "--episodes", "1",
         "--samples", "8", "--iterations", "1", "--out", "sweep.csv"]
SET = ["--set", "expert-episodes=0", "batch-size=2", "priors=false"]


def numeric_gradient(function, x, step=1e-6):
    """Central differences of a scalar function of the array x (changed in place and back)."""
    gradient = np.zeros_like(x)
    for i in np.ndindex(x.shape):
        kept = x[i]
        x[i] = kept + step
        above = function()
        x[i] = kept - step
        below = function()
        x[i] = kept
        gradient[i] = (above - below) / (2 * step)
    return gradient


def assert_close(found, expected, tolerance=1e-7):
    scale = max(np.abs(expected).max(), 1e-3)
    assert np.abs(found - expected).max() <= tolerance * scale, np.abs(found - expected).max()


def present(config_class, values):
    """Those settings of a golden file's header that still exist."""
    names = {f.name for f in fac.dataclasses.fields(config_class)}
    values = {{"temperature": "inverse_temperature"}.get(k, k): v for k, v in values.items()}
    return {k: v for k, v in values.items() if k in names}


def relative(found, expected):
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def assert_digest(array, expected, tolerance, size=None):
    """Norm, product with a fixed unit vector and 64 entries, all relative to the norm or `size`."""
    from export_golden import digest  # imports PyTorch where there is one
    error = np.abs(digest(array) - expected).max() / (size or expected[0])
    assert error <= tolerance, error


def narrow_expert(header, g, prefix):
    """The centralized model whose weights the narrow file keeps under a prefix."""
    training = header["training"]
    sizes = fac.ModelConfig(7, 6, 1, *(training[k] for k in ("latent_dim", "enc_dim", "mlp_dim")))
    return fac.WorldModel(sizes, {
        k[len(prefix):]: v[None, :, None] if v.ndim == 1 else v[None]
        for k, v in g.items() if k.startswith(prefix)})


def refusal(call, *parts):
    """The message of the UserError that `call` raises; it is one line and holds all `parts`."""
    with pytest.raises(fac.UserError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert str(part) in message
    return message


def random_model(n=3, dim_action=3, latent=6, hidden=24, seed=0, policy=False):
    sizes = fac.ModelConfig(8, dim_action, n, latent, 16, hidden)
    rng = np.random.default_rng(seed)
    model = fac.WorldModel.create(sizes, rng, policy)
    for value in model.params.values():
        value += 0.3 * rng.standard_normal(value.shape, np.float32)
    return model


def student_of(expert, agents=3, prior_steps=4, **sizes):
    """A student that reads the expert's latent and has priors, its own weights alive."""
    sizes = {"latent_dim": 6, "mlp_dim": 24, **sizes}
    config = fac.dataclasses.replace(fac.student_config(expert.config, agents, "latent",
                                                        prior_steps), **sizes)
    student = fac.new_student(expert, config, 0)[1]
    rng = np.random.default_rng(3)
    for key, value in student.params.items():
        if not key.startswith("_expert"):
            value += 0.3 * rng.standard_normal(value.shape, np.float32)
    return student


def write_expert(path, task="reacher-hard", dims=(8, 3), seed=0, latent=6):
    rng = np.random.default_rng(seed)
    config = fac.ModelConfig(*dims, num_agents=1, latent_dim=latent, enc_dim=16, mlp_dim=24)
    model = fac.WorldModel.create(config, rng, policy=True)
    for key in ("_reward.4.weight", "_Q1.5.weight", "_Q2.5.weight"):  # zero: nothing to learn from
        model.params[key] = rng.standard_normal(model.params[key].shape, np.float32)
    fac.save_model(path, model, {"kind": "expert", "task": task})


def replay_arrays(dims=(8, 3), episodes=6, rows=30, seed=1):
    rng, n = np.random.default_rng(seed), episodes * rows
    return {"observation": rng.standard_normal((n, dims[0])).astype(np.float16),
            "action": rng.uniform(-1, 1, (n, dims[1])).astype(np.float16),
            "continues": np.arange(1, n + 1) % rows != 0}


def write_replay(path, dims=(8, 3), episodes=6, rows=30, seed=1, task=None, **changes):
    """`changes`: other arrays than replay_arrays', or None for none."""
    arrays = {**replay_arrays(dims, episodes, rows, seed), **changes}
    fac.write_npz(path, {"kind": "replay", "task": task},
                  {k: v for k, v in arrays.items() if v is not None}, compress=True)
    return path


def distilled(replay, config, steps, num_agents=None, seed=0):
    expert = random_model(n=1, policy=True)
    distiller = fac.Distiller(expert, replay, config, num_agents, seed)
    losses = np.array([distiller.step() for _ in range(steps)])
    distiller.close()
    return distiller, losses


def ramp():
    """An episode: step t's observation is t, its action t / 512, both of which float16 holds."""
    t = np.arange(fac.EPISODE_STEPS + 1.0)[:, None]
    return np.repeat(t, 8, 1), np.repeat(t[:-1] / 512, 3, 1)


def small_learner(rng, dtype=np.float64):
    """A learner whose every weight is alive, its moving averages apart from its model."""
    learner = Learner(fac.ModelConfig(4, 2, 1, 3, 5, 6), EQUATION_1, rng, dtype)
    for vector in (learner.optimizer.vector, learner.policy_optimizer.vector, learner.slow_vector):
        vector += 0.3 * rng.standard_normal(vector.shape).astype(dtype)
    return learner


def small_batch(rng, steps=3, batch=4, dtype=np.float64):
    """obs (H + 1, O, B), actions (H, A, B), reward (H, B)."""
    return (rng.standard_normal((steps + 1, 4, batch)).astype(dtype),
            rng.uniform(-1, 1, (steps, 2, batch)).astype(dtype),
            rng.standard_normal((steps, batch)).astype(dtype))


class Joints:
    """Four joints that move by what they are told, and their sum; `order`: of its joints."""

    episode_steps = 12

    def __init__(self, order=slice(None)):
        self.order = order

    def reset(self, seed):
        self.state = np.random.default_rng(seed).standard_normal(8)
        return self.state

    def step(self, action):
        joints = np.empty(4)
        joints[self.order] = action
        self.state = 0.9 * self.state + 0.3 * np.r_[joints, np.cumsum(joints)]
        return self.state, self.state[0] - self.state[5]


def launch(command, cwd, env=ONE_THREAD):
    return subprocess.run([sys.executable, *map(str, command)], cwd=cwd, capture_output=True,
                          text=True, encoding="utf-8", timeout=120,
                          env={**os.environ, "PYTHONIOENCODING": "utf-8", **env})


def here(main, *arguments, cwd=None):
    """A command in this process: what `launch` returns, without an interpreter's start."""
    out, err, before = io.StringIO(), io.StringIO(), os.getcwd()
    os.chdir(cwd or before)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main([*map(str, arguments)])
    except SystemExit as end:  # argparse's
        code = end.code
    finally:
        os.chdir(before)
    return SimpleNamespace(returncode=code, stdout=out.getvalue(), stderr=err.getvalue())


def run(*arguments, cwd, env=ONE_THREAD):
    return launch([SCRIPT, *arguments], cwd, env)


def distill_arguments(files, *more):
    return ["distill", "--expert", files / "expert.npz", "--replay", files / "replay.npz", *TINY,
            *more]


def succeeded(done):
    assert done.returncode == 0, done.stderr
    return done


def last_json(done):
    """The last line of stdout, as strict JSON: NaN and Infinity are none."""
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(succeeded(done).stdout.splitlines()[-1], parse_constant=refuse)


def refused(done, *parts, program="fac_tdmpc_ref.py"):
    """Status 2 and one line on stderr that holds `parts`; returns the line."""
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1 and done.stderr.endswith("\n"), done.stderr
    assert done.stderr.startswith(program) and ": error: " in done.stderr
    for part in parts:
        assert part in done.stderr
    return done.stderr


def student_in(folder):
    """{key: bytes} of a student's weights, and its header."""
    model, header = fac.load_model(folder / "student.npz")
    return {k: v.tobytes() for k, v in model.params.items()}, header


WATCHED = f"""
import os, sys
sys.path.insert(0, {str(ROOT)!r})
def refuse(*_):
    raise RuntimeError("a process was started")
def audit(event, _):
    if event in ("subprocess.Popen", "os.fork", "os.posix_spawn", "os.system", "os.exec"):
        refuse()
sys.addaudithook(audit)
import _posixsubprocess
_posixsubprocess.fork_exec = refuse   # what multiprocessing starts processes with, unaudited
import fac_tdmpc_ref as fac
try:
    fac.main(sys.argv[1:])
except SystemExit as end:
    heavy = {{"mujoco", "dm_control", "matplotlib", "torch", "scipy", "tqdm"}} & set(sys.modules)
    assert not heavy, heavy
    sys.exit(end.code)
"""
