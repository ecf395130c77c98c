"""NumPy against PyTorch on one machine, in one run: `python tests/bench_peer.py [--record]`.

The same models, the same MPPI and the same distillation step, written plainly in PyTorch
(eager, `inference_mode`; batched `baddbmm` for the agents; `torch.compile` where it works); a
decision also in JAX, compiled as a whole (pip install -e '.[peers]').
Both take turns, so that noise hits both; figures are medians of NumPy's time over PyTorch's in
the same turn, below 1 is faster. Sizes are section 5.1's (latent and hidden 512 // N), MPPI is
Table 2's (512 samples, 6 iterations, horizon 3). `--record` keeps the ratios to eager PyTorch in
data/results/bench.csv, in place of this machine's earlier ones.
"""
import argparse
import contextlib
import functools
import json
import os
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "data")]

import numpy as np  # noqa: E402
import torch  # noqa: E402
import torch.nn.functional as F  # noqa: E402

import fac_tdmpc_ref as fac  # noqa: E402
import numpy_learner  # noqa: E402
from speed import TIMED, machine  # noqa: E402
from tables import record  # noqa: E402
from torch_learner import TorchLearner  # noqa: E402


def run_network(kinds, params, name, x):
    """A network of (N, in, out) weights on x (N, B, in), samples in PyTorch's place."""
    for i, kind in enumerate(kinds):
        if kind == "linear" and len(x) == 1:
            x = F.linear(x[0], params[f"{name}.{i}.weight"][0].T, params[f"{name}.{i}.bias"][0, 0])
            x = x[None]
        elif kind == "linear":
            x = torch.baddbmm(params[f"{name}.{i}.bias"], x, params[f"{name}.{i}.weight"])
        elif kind == "norm":
            x = F.layer_norm(x, x.shape[-1:])
            x = x * params[f"{name}.{i}.weight"] + params[f"{name}.{i}.bias"]
        else:
            x = F.elu(x) if kind == "elu" else torch.tanh(x)
    return x


def to_torch(model):
    """Weights as (N, in, out) and biases as (N, 1, out): what baddbmm takes without copies."""
    return {k: torch.tensor(np.ascontiguousarray(v.swapaxes(1, 2))) for k, v in
            model.params.items()}


class TorchPlanner:
    """MPPI for a model without policy, plainly: Equations 2 and 3 with a batch of agents."""

    def __init__(self, model, config):
        self.sizes, self.config, self.params = model.config, config, to_torch(model)
        self.mean = torch.zeros(self.sizes.num_agents, config.horizon + 1, 1,
                                self.sizes.agent_actions)

    def returns(self, z, actions):
        """Equation 2: z (N, S, m), actions (N, L, S, d) -> (N, S)."""
        total, config, p = 0.0, self.config, self.params
        for h in range(config.horizon):
            x = torch.cat([z, actions[:, h]], -1)
            total = total + config.discount ** h * run_network(fac.MLP, p, "_reward", x)[..., 0]
            z = run_network(fac.MLP, p, "_dynamics", x)
        x = torch.cat([z, actions[:, -1]], -1)
        q = run_network(fac.QNET, p, "_Q1", x) + run_network(fac.QNET, p, "_Q2", x)
        return total + config.discount ** config.horizon * q[..., 0] / 2

    @torch.inference_mode()
    def act(self, obs):
        """Observation (O,) to action (A,), with the warm start kept."""
        n, config = self.sizes.num_agents, self.config
        z = run_network(fac.ENCODER, self.params, "_encoder", torch.from_numpy(obs)[None, None])
        z = z.view(n, 1, -1).expand(-1, config.samples, -1)
        mean, std = self.mean, torch.tensor(config.max_std)
        for _ in range(config.iterations):
            noise = torch.randn(n, config.horizon + 1, config.samples, self.sizes.agent_actions)
            actions = (mean + std * noise).clamp(-1, 1)
            top, index = self.returns(z, actions).topk(config.num_elites, 1)
            elites = actions.gather(2, index[:, None, :, None].expand(-1, *actions.shape[1:2], -1,
                                                                      actions.shape[-1]))
            score = torch.softmax(config.inverse_temperature * top, 1)[:, None, :, None]
            new = (score * elites).sum(2, keepdim=True)
            std = (score * (elites - new) ** 2).sum(2, keepdim=True).sqrt()
            std = std.clamp(config.min_std, config.max_std)
            mean = config.momentum * mean + (1 - config.momentum) * new
        self.mean = torch.cat([mean[:, 1:], torch.zeros_like(mean[:, :1])], 1)
        pick = torch.multinomial(score[:, 0, :, 0], 1)
        return elites[torch.arange(n), 0, pick[:, 0]].flatten().numpy()


def jax_planner(model, config):
    """A decision in JAX: the same MPPI as one jax.jit; None where JAX is missing."""
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false "
                          "intra_op_parallelism_threads=1")
    try:
        import jax
        import jax.numpy as jnp
    except ImportError:
        return None
    params, n, m = jax.tree.map(jnp.asarray, model.params), model.config.num_agents, -1
    d, steps = model.config.agent_actions, config.horizon + 1

    def run(kinds, name, x):
        for i, kind in enumerate(kinds):
            W, b = params.get(f"{name}.{i}.weight"), params.get(f"{name}.{i}.bias")
            if kind == "linear":
                x = W @ x + b
            elif kind == "norm":
                x = x - x.mean(1, keepdims=True)
                x = W * x / jnp.sqrt((x ** 2).mean(1, keepdims=True) + fac.NORM_EPS) + b
            else:
                x = jax.nn.elu(x) if kind == "elu" else jnp.tanh(x)
        return x

    def returns(z, actions):  # (N, m, S), (N, L, d, S) -> (N, S)
        total = 0.0
        for h in range(config.horizon):
            x = jnp.concatenate([z, actions[:, h]], 1)
            total = total + config.discount ** h * run(fac.MLP, "_reward", x)[:, 0]
            z = run(fac.MLP, "_dynamics", x)
        x = jnp.concatenate([z, actions[:, -1]], 1)
        q = run(fac.QNET, "_Q1", x) + run(fac.QNET, "_Q2", x)
        return total + config.discount ** config.horizon * q[:, 0] / 2

    @jax.jit
    def act(obs, mean, key):
        z = run(fac.ENCODER, "_encoder", obs[None, :, None]).reshape(n, m, 1)
        z, std = jnp.broadcast_to(z, (*z.shape[:2], config.samples)), config.max_std
        for _ in range(config.iterations):
            key, part = jax.random.split(key)
            noise = jax.random.normal(part, (n, steps, d, config.samples))
            actions = jnp.clip(mean + std * noise, -1, 1)
            top, index = jax.lax.top_k(returns(z, actions), config.num_elites)
            elites = jnp.take_along_axis(actions, index[:, None, None], 3)
            score = jax.nn.softmax(config.inverse_temperature * top, 1)
            p = score[:, None, None]
            new = (p * elites).sum(3, keepdims=True)
            std = jnp.sqrt((p * (elites - new) ** 2).sum(3, keepdims=True))
            std = jnp.clip(std, config.min_std, config.max_std)
            mean = config.momentum * mean + (1 - config.momentum) * new
        key, part = jax.random.split(key)
        pick = jax.random.categorical(part, jnp.log(score))
        action = jnp.take_along_axis(elites[:, 0], pick[:, None, None], 2).ravel()
        return action, jnp.concatenate([mean[:, 1:], 0 * mean[:, :1]], 1), key

    state = [jnp.zeros((n, steps, d, 1)), jax.random.key(0)]

    def decide(obs):
        action, *state[:] = act(obs, *state)
        return np.asarray(action)

    decide.returns = returns
    return decide


def make_model(n, dim_action, seed=0):
    """Section 5.1's sizes for N agents, with random weights (last layers too)."""
    width, rng = 512 // n, np.random.default_rng(seed)
    config = fac.ModelConfig(24, dim_action, n, width, 256, width)
    model = fac.WorldModel.create(config, rng)
    for value in model.params.values():
        value += 0.05 * rng.standard_normal(value.shape, np.float32)
    return model


def ratios(ours, theirs, turns):
    """Median over turns of our seconds over theirs, after one turn that isn't counted."""
    found = []
    for _ in range(turns + 1):
        seconds = []
        for run in (ours, theirs):
            begin = time.perf_counter()
            run()
            seconds.append(time.perf_counter() - begin)
        found.append(seconds)
    seconds = np.array(found[1:])
    return float(np.median(seconds[:, 0] / seconds[:, 1])), *1e3 * np.median(seconds, 0)


def planning(n, dim_action, turns, compiled=False, jax=False):
    """(ratio, our ms, theirs) of one decision, one thread each; None where JAX is missing."""
    model, config = make_model(n, dim_action), fac.PlannerConfig(samples=512, iterations=6)
    obs = np.random.default_rng(1).standard_normal(24).astype(np.float32)
    theirs = TorchPlanner(model, config)
    z, actions = torch.randn(n, 7, model.config.latent_dim), torch.rand(n, 4, 7, dim_action // n)
    expected = fac.h_step_return(model, z[:, :1].numpy().swapaxes(1, 2),
                                 actions.numpy().swapaxes(2, 3), config)
    with torch.inference_mode():
        found = theirs.returns(z[:, :1].expand(-1, 7, -1), actions).numpy()
    decide = theirs.act
    if jax:
        decide = jax_planner(model, config)
        if decide is None:
            return None
        found = np.asarray(decide.returns(z[:, :1].numpy().swapaxes(1, 2).repeat(7, 2),
                                          actions.numpy().swapaxes(2, 3)))
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max(), "the models differ"
    if compiled:
        theirs.returns = torch.compile(theirs.returns)
    torch.set_num_threads(1)
    with fac.Planner(model, config) as ours:
        return ratios(lambda: ours.act(obs), lambda: decide(obs), turns)


class TorchDistiller:
    """Algorithm 1 with the same networks, batch and settings as fac.Distiller."""

    def __init__(self, distiller, replay):
        self.config, self.agents = distiller.config, distiller.student.config.num_agents
        self.expert, self.student = to_torch(distiller.expert), to_torch(distiller.student)
        self.trained = [p.requires_grad_() for k, p in self.student.items()
                        if not k.startswith("_expert")]
        self.optimizer = torch.optim.Adam(self.trained, lr=self.config.lr)
        self.obs = torch.tensor(replay.observation.astype(np.float32))
        self.action = torch.tensor(replay.action.astype(np.float32))
        self.starts = torch.tensor(distiller.train_starts)

    @staticmethod
    def rollout(params, z, actions):
        """Rewards and both Q, (L, B * K): z (N, B * K, m), actions (L, B * K, N, d)."""
        outputs = []
        for a in actions:
            x = torch.cat([z, a.transpose(0, 1)], -1)
            outputs.append([run_network(fac.NETWORKS[name], params, name, x).sum(0)[:, 0]
                            for name in fac.HEADS])
            z = run_network(fac.MLP, params, "_dynamics", x)
        return [torch.stack(head) for head in zip(*outputs)]

    def step(self):
        """One gradient step on a fresh batch; returns the loss."""
        config = self.config
        steps, batch, noise = config.horizon + 1, config.batch_size, config.noise_samples
        with torch.no_grad():
            rows = self.starts[torch.randint(len(self.starts), (batch,))]
            actions = self.action[rows + torch.arange(steps)[:, None]].repeat_interleave(noise, 1)
            actions = (actions + config.noise_std * torch.randn_like(actions)).clamp(-1, 1)
            latent = run_network(fac.ENCODER, self.expert, "_encoder", self.obs[rows][None])
            targets = self.rollout(self.expert, latent.repeat_interleave(noise, 1),
                                   actions[:, :, None])
        z = run_network(fac.ENCODER, self.student, "_encoder", latent)
        z = z.view(batch, self.agents, -1).transpose(0, 1).repeat_interleave(noise, 1)
        outputs = self.rollout(self.student, z, actions.view(*actions.shape[:2], self.agents, -1))
        loss, coefs = 0.0, (config.reward_coef, config.value_coef, config.value_coef)
        for coef, ours, theirs in zip(coefs, outputs, targets):
            kl = F.kl_div(F.log_softmax(ours.view(steps, batch, noise)
                                        / config.temperature_student, -1),
                          F.log_softmax(theirs.view(steps, batch, noise)
                                        / config.temperature_expert, -1),
                          reduction="none", log_target=True).sum(-1)
            weights = config.lam ** torch.arange(steps)[:, None]
            loss = loss + coef * (weights * kl).sum() / batch
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.trained, config.grad_clip)
        self.optimizer.step()
        return loss.item()


@contextlib.contextmanager
def on_cores(threads):
    """Inside, this process has so many cores, and PyTorch as many threads."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, list(cores)[:threads])
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def distillation(threads, turns):
    """(ratio, our ms, PyTorch's ms) of a distillation step: reacher-hard, Algorithm 1 with default
    sizes, on one core, or two. Both compute the expert's predictions for every step: ours has a
    pool for each turn of 20.
    """
    expert, _ = fac.load_model(fac.data_file("reacher-hard", "expert.npz"))
    replay = fac.Replay(fac.data_file("reacher-hard", "replay.npz"))
    config = fac.DistillConfig(targets="joint", policy_share=0.0, reuse=1)
    with on_cores(threads), contextlib.closing(fac.Distiller(expert, replay, config)) as ours:
        ours.pool_size = 20 * config.batch_size
        theirs = TorchDistiller(ours, replay)
        return ratios(lambda: [ours.step() for _ in range(20)],
                      lambda: [theirs.step() for _ in range(20)], turns)


def training(threads, turns, batch=256):
    """(ratio, our ms, PyTorch's ms) of an update of Equation 1, policy and averages included."""
    config, rng = numpy_learner.ExpertConfig(batch_size=batch), np.random.default_rng(0)
    obs = rng.standard_normal((4, 24, batch), np.float32)
    reward = rng.random((3, batch), np.float32)
    actions = rng.uniform(-1, 1, (3, 6, batch)).astype(np.float32)
    with on_cores(threads):
        ours = numpy_learner.Learner(fac.ModelConfig(24, 6), config, rng)
        theirs = TorchLearner(fac.WorldModel.create(ours.model.config, rng, policy=True), config,
                              "cpu")
        return ratios(*(lambda learner=learner: learner.update(obs, actions, reward, rng)
                        for learner in (ours, theirs)), turns)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--turns", type=functools.partial(fac.natural, least=1), default=9,
                        help="of each comparison [9]")
    parser.add_argument("--json", action="store_true", help="print one JSON object as last line")
    parser.add_argument("--record", action="store_true",
                        help="keep the ratios to eager PyTorch in data/results/bench.csv")
    args = parser.parse_args()
    result = {"central_ratio": None, "fac_ratio": {}, "jax_ratio": {}, "distill_ratio": {},
              "update_ratio": {}, "machine": machine(), "torch": torch.__version__,
              "numpy": np.__version__}
    print("{}, {} cores, BLAS {}".format(*machine()), flush=True)

    def show(what, found, threads=1, peer="PyTorch"):
        per = 20 if what.startswith("distillation") else 1
        many = f"{threads} thread{'s' * (threads > 1)}"
        print(f"{what:<42}{many:<10} NumPy {found[1] / per:7.1f} ms"
              f"  {peer} {found[2] / per:7.1f} ms  ratio {found[0]:.2f}", flush=True)
        if args.record and peer == "PyTorch" and "compile" not in what:
            record(fac.DATA / "results" / "bench.csv", (*TIMED, "ratio"), [
                (*machine(), f"{what}, {many}", found[0])])
        return found[0]

    result["central_ratio"] = show("plan, TD-MPC (N = 1, latent 512)", planning(1, 6, args.turns))
    for n in (3, 6, 12, 21):
        result["fac_ratio"][str(n)] = show(f"plan, Fac-TDMPC (N = {n})", planning(n, n, args.turns))
    for threads in (1, 2):
        if threads <= fac.cores():
            result["distill_ratio"][str(threads)] = show(
                "distillation step", distillation(threads, args.turns), threads)
            result["update_ratio"][str(threads)] = show(
                "update of TD-MPC (batch 256)", training(threads, args.turns), threads)
    with on_cores(1):  # JAX's own threads, too, begin on this one core
        for n in (1, 6, 21):
            found = planning(n, max(n, 6), args.turns, jax=True)
            if found:
                result["jax_ratio"][str(n)] = show(f"plan, N = {n}, jax.jit", found, peer="JAX    ")
    for n in (1, 6):
        try:
            show(f"plan, N = {n}, torch.compile", planning(n, 6, args.turns, compiled=True))
        except Exception as error:  # no compiler on this machine, for one
            print(f"torch.compile, N = {n}: does not work here ({type(error).__name__})")
    if args.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
