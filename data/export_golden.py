#!/usr/bin/env python3
"""Write the golden files: what PyTorch computes on the shipped weights, in float64.

    python data/export_golden.py [TASK ...]

writes data/experts/TASK/golden.npz for an expert and a replay that lie beside it (all tasks that
have them), and golden-narrow.npz, small random networks. tests/test_golden.py holds the NumPy code
to them without PyTorch. Each file keeps its inputs, float32, beside what comes out of them.
"""
import dataclasses
import sys
from pathlib import Path

import numpy as np

sys.path[:0] = map(str, Path(__file__).resolve().parents[:2])
import fac_tdmpc_ref as fac  # noqa: E402
from numpy_learner import ExpertConfig  # noqa: E402

try:
    import torch
    import torch.nn.functional as F
    from torch_learner import equation_1, heads, network, policy, transition
except ImportError:
    torch = None  # `digest`, with which the golden files are read, doesn't need it

# golden files keep to the paper in these, whatever the defaults are
AS_PRINTED = {"horizon": 3, "lam": 0.5, "noise_std": 0.5, "clip_actions": False}
FROZEN = "_expert"  # a student's copy of the expert's encoder
FIRST = "student "  # prefix of weights that a file keeps


def digest(array):
    """What golden files keep of a large array: norm, product with a unit vector, 64 entries."""
    flat = np.asarray(array, np.float64).ravel()
    fixed = np.cos(np.arange(flat.size, dtype=np.float64) ** 2 % 1009)
    entries = flat[np.linspace(0, flat.size - 1, 64).astype(int)]
    return np.r_[np.linalg.norm(flat), flat @ fixed / np.linalg.norm(fixed), entries]


def double(x):
    """An array as a float64 tensor."""
    return torch.tensor(np.asarray(x), dtype=torch.float64)


def last(x):
    """(..., B, F) of PyTorch to (..., F, B) of fac_tdmpc_ref, as an array."""
    return x.detach().swapaxes(-1, -2).numpy()


def rollout(params, z, actions):
    """Shares of reward and both Q, three (N, L, B, K): actions (L, A, B, K), z (N, B, m)."""
    steps, _, batch, noise = actions.shape
    z, outputs = z.repeat_interleave(noise, 1), []
    for h in range(steps):
        x = torch.cat([z, actions[h].reshape(len(z), -1, batch * noise).mT], -1)
        outputs.append([network(fac.NETWORKS[name], params, name, x).view(-1, batch, noise)
                        for name in fac.HEADS])
        z = transition(params, x)
    return [torch.stack(head, 1) for head in zip(*outputs)]


def latents(params, features, agents):
    """The trained encoder on features (1, F, B), cut into the agents' latents (N, B, m)."""
    z = network(fac.ENCODER, params, "_encoder", features.mT)[0]
    return z.reshape(len(z), agents, -1).swapaxes(0, 1)


def equation_4(params, features, actions, targets, agents, config):
    """Algorithm 1's loss; features (1, F, B), targets: the expert's three (L, B, K), or each
    agent's parts of these, (N, L, B, K)."""
    loss, coefs = 0.0, (config.reward_coef, config.value_coef, config.value_coef)
    students = rollout(params, latents(params, features, agents), actions)
    for coef, student, expert in zip(coefs, students, targets):
        expert = expert.reshape(-1, *student.shape[1:])
        student = student.reshape(len(expert), -1, *student.shape[1:]).sum(1)
        log_s = F.log_softmax(student / config.temperature_student, -1)
        log_e = F.log_softmax(expert / config.temperature_expert, -1)
        to, of = (log_s, log_e) if config.kl == "forward" else (log_e, log_s)
        kl = F.kl_div(to, of, reduction="none", log_target=True).sum(-1)
        for h in range(kl.shape[1]):
            loss = loss + coef * config.lam ** h * kl[:, h].sum(0).mean()
    return loss


def gradients(loss, params):
    """Gradients of those parameters that take them, as arrays (zeros where there is none)."""
    trained = {k: p for k, p in params.items() if p.requires_grad}
    found = torch.autograd.grad(loss, list(trained.values()), allow_unused=True,
                                materialize_grads=True)
    return {k: g.numpy() for k, g in zip(trained, found)}


def ten_adam_steps(params, loss_function, lr, clip):
    """Ten steps with clipping, in place; returns the ten losses."""
    trained = [p for p in params.values() if p.requires_grad]
    optimizer, losses = torch.optim.Adam(trained, lr=lr), []
    for _ in range(10):
        optimizer.zero_grad()
        loss = loss_function()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trained, clip)
        optimizer.step()
        losses.append(loss.item())
    return np.array(losses)


def alive(model, rng):
    """A fresh model's weights, its zero layers drawn too so that every gradient is alive."""
    for key, value in model.params.items():
        if not value.any() and key.endswith("weight"):
            value += 0.1 * rng.standard_normal(value.shape, np.float32)
    return model.params


def trainable(weights):
    """Float64 tensors of weights, which take gradients but for a frozen encoder's."""
    return {k: double(v).requires_grad_(not k.startswith(FROZEN)) for k, v in weights.items()}


def plain_shapes(weights, prefix=""):
    """Weights of one agent as torch's layers have them, (out, in) and (out,)."""
    return {prefix + k: v[0] if v.shape[2] > 1 else v[0, :, 0] for k, v in weights.items()}


def expert_golden(model, target, g, config):
    """Outputs of an expert's networks on obs[0], action[0], and Equation 1 with its gradients."""
    params = trainable(model)
    obs, action = double(g["obs"]).mT, double(g["action"]).mT
    z = network(fac.ENCODER, params, "_encoder", obs[:1])
    x = torch.cat([z, action[:1]], -1)
    found = {"latent": last(z)[0], "next_latent": last(transition(params, x))[0],
             "policy": last(policy(params, z))[0]}
    found.update(zip(("reward", "q1", "q2"), (y.detach().numpy() for y in heads(params, x))))
    loss, terms, _ = equation_1(params, {k: double(v) for k, v in target.items()}, obs, action,
                                double(g["rewards"]), config)
    found["equation1_terms"] = np.array([t.item() for t in terms])
    found["equation1_loss"] = np.array(loss.item())
    found.update(plain_shapes({k: v for k, v in gradients(loss, params).items()
                               if not k.startswith("_pi")}, "equation1_grad "))
    return found


def mppi_golden(model, g, planner):
    """One refinement of MPPI (Equation 2) for obs[0, :, 0] from a mean, with fixed noise."""
    params = {k: double(v) for k, v in model.items()}
    noise, mean = torch.tensor(g["mppi_noise"]), torch.tensor(g["mppi_mean"])
    actions = (mean[..., None] + planner.max_std * noise).clamp(-1, 1).double().mT  # (L, S, A)
    z, value = network(fac.ENCODER, params, "_encoder", double(g["obs"])[:1, :, :1].mT), 0.0
    z = z.expand(-1, planner.samples, -1)
    for h in range(planner.horizon):
        x = torch.cat([z, actions[h:h + 1]], -1)
        value, z = value + planner.discount ** h * heads(params, x)[0], transition(params, x)
    _, q1, q2 = heads(params, torch.cat([z, actions[-1:]], -1))
    value = value + planner.discount ** planner.horizon * (q1 + q2) / 2
    top, index = value.topk(planner.num_elites)
    score = torch.softmax(planner.inverse_temperature * top, 0)[None, :, None]
    refined = (score * actions[:, index]).sum(1)
    std = (score * (actions[:, index] - refined[:, None]) ** 2).sum(1).sqrt()
    return {"mppi_returns": value.numpy(), "mppi_elites": np.sort(index.numpy()),
            "mppi_refined": refined.numpy(),
            "mppi_std": std.clamp(planner.min_std, planner.max_std).numpy()}


def student_golden(expert, student, g, agents, config):
    """Equation 4 of a student that reads the expert's latents, its gradients, ten Adam steps."""
    theirs, params, actions = trainable(expert), trainable(student), double(g["kl_actions"])
    with torch.no_grad():
        z = latents(theirs, double(g["kl_obs"])[None], 1)
        targets = [shares.sum(0) for shares in rollout(theirs, z, actions)]

    def loss():
        return equation_4(params, z.mT, actions, targets, agents, config)

    found = {"kl_loss": np.array(loss().item())}
    found.update({f"kl_grad {k}": v for k, v in gradients(loss(), params).items()})
    found["adam_losses"] = ten_adam_steps(params, loss, config.lr, config.grad_clip)
    found.update({f"adam {k}": v.detach().numpy() for k, v in params.items() if v.requires_grad})
    return found


def draw_inputs(expert, replay, student, config, distill, rng):
    """What a task's golden file computes with: segments of its replay, and random numbers."""
    rows = rng.choice(replay.starts(config.horizon + 1, 0.05)[0], 16)
    rows = rows + np.arange(config.horizon + 1)[:, None]
    shape = fac.PlannerConfig().horizon + 1, expert.config.dim_action
    starts = rng.choice(replay.starts(distill.horizon + 1, 0.05)[0], distill.batch_size)
    kl_obs, actions = replay.sequences(starts, distill.horizon + 1)
    noise = rng.standard_normal((*actions.shape, distill.noise_samples), np.float32)
    return {"obs": replay.observation[rows].astype(np.float32).swapaxes(1, 2),
            "action": replay.action[rows[:-1]].astype(np.float32).swapaxes(1, 2),
            "rewards": rng.uniform(0, 2, rows[:-1].shape).astype(np.float32),
            "mppi_noise": rng.standard_normal((*shape, 64), np.float32),
            "mppi_mean": rng.uniform(-0.5, 0.5, shape).astype(np.float32), "kl_obs": kl_obs,
            "kl_actions": actions[..., None] + np.float32(distill.noise_std) * noise,
            **{FIRST + k: v for k, v in student.items() if not k.startswith(FROZEN)}}


def task_golden(expert, g, config, planner, distill):
    """All that a task's golden file says of inputs `g`; of large arrays, a digest."""
    student = {k[len(FIRST):]: v for k, v in g.items() if k.startswith(FIRST)}
    found = {**expert_golden(expert.params, expert.params, g, config),
             **mppi_golden(expert.params, g, planner),
             **student_golden(expert.params, student, g, expert.config.dim_action, distill)}
    return {k: digest(v) if k.startswith(("equation1_grad", "kl_grad", "adam ")) else v
            for k, v in found.items()}


def write_golden(folder):
    """golden.npz of the expert and the replay in a folder."""
    path, rng = folder / "expert.npz", np.random.default_rng(0)
    expert, header = fac.load_model(path, ["expert"])
    fac.need(expert.has_policy, f"{path}: _pi.0.weight: missing; golden files hold a policy's")
    replay = fac.Replay(folder / "replay.npz")
    for sizes, name in ((expert.config, path), (replay, folder / "replay.npz")):
        fac.check_task(sizes, header.get("task"), name)
    config = fac.from_dict(ExpertConfig, header.get("training", {}), f"{path}: header: training")
    planner = fac.PlannerConfig(samples=64, elites=8, pi_trajs=0)
    distill = fac.DistillConfig(batch_size=8, noise_samples=10, **AS_PRINTED)
    sizes = fac.student_config(expert.config, expert.config.dim_action, "latent")
    student = alive(fac.WorldModel.create(sizes, rng), rng)
    g = draw_inputs(expert, replay, student, config, distill, rng)
    header = {"kind": "golden", "task": header["task"], **{
        name: dataclasses.asdict(values) for name, values in (
            ("training", config), ("planner", planner), ("distill", distill), ("student", sizes))}}
    fac.write_npz(folder / "golden.npz", header,
                  {**g, **task_golden(expert, g, config, planner, distill)})


def narrow_golden(g, tag, agents, config):
    """What a narrow student's networks, Equation 4 and ten Adam steps give for its inputs."""
    weights = {k[len(f"{tag} weight "):]: v for k, v in g.items() if k.startswith(f"{tag} weight")}
    params = trainable(weights)
    features, actions, targets = (double(g[f"{tag} {k}"]) for k in ("features", "actions",
                                                                    "targets"))
    with torch.no_grad():
        outputs = torch.stack(rollout(params, latents(params, features, agents), actions)).sum(1)

    def loss():
        return equation_4(params, features, actions, targets, agents, config)

    found = {"outputs": outputs.numpy(), "loss": np.array(loss().item())}
    found.update({f"grad {k}": v for k, v in gradients(loss(), params).items()})
    found["adam_losses"] = ten_adam_steps(params, loss, 1e-3, config.grad_clip)
    found.update({f"adam {k}": v.detach().numpy() for k, v in params.items()})
    return {f"{tag} {k}": v for k, v in found.items()}


def write_narrow_golden(path):
    """golden-narrow.npz: small random networks, N = 1, 2, 3, 6, with everything in full."""
    rng, config = np.random.default_rng(1), ExpertConfig(latent_dim=5, enc_dim=16, mlp_dim=24)
    sizes, experts = fac.ModelConfig(7, 6, 1, 5, 16, 24), []
    for _ in range(2):
        experts.append(fac.WorldModel.create(sizes, rng, policy=True).params)
        for value in experts[-1].values():
            value += 0.1 * rng.standard_normal(value.shape, np.float32)
    g = {"obs": rng.standard_normal((4, 7, 8), np.float32),
         "action": rng.uniform(-1, 1, (3, 6, 8)).astype(np.float32),
         "rewards": rng.standard_normal((3, 8), np.float32)}
    found, configs = expert_golden(*experts, g, config), {}
    for n, kind in ((n, kind) for n in (1, 2, 3, 6) for kind in ("forward", "reverse")):
        tag, sizes = f"{n} {kind}", fac.ModelConfig(7, 6, n, 4, 16, 24)
        distill = fac.DistillConfig(kl=kind, noise_samples=4, grad_clip=0.05,
                                    temperature_student=0.7, **{**AS_PRINTED, "horizon": 2})
        g.update({f"{tag} weight {k}": v
                  for k, v in alive(fac.WorldModel.create(sizes, rng), rng).items()})
        g[f"{tag} features"] = rng.standard_normal((1, 7, 5), np.float32)
        g[f"{tag} actions"] = rng.uniform(-1, 1, (3, 6, 5, 4)).astype(np.float32)
        g[f"{tag} targets"] = rng.standard_normal((3, 3, 5, 4), np.float32)
        found.update(narrow_golden(g, tag, n, distill))
        configs[tag] = {"distill": dataclasses.asdict(distill),
                        "student": dataclasses.asdict(sizes)}
    for prefix, weights in zip(("model ", "target "), experts):
        g.update(plain_shapes(weights, prefix))
    # float32 keeps seven digits, more than the tests ask for
    fac.write_npz(path, {"kind": "golden", "training": dataclasses.asdict(config),
                         "configs": configs},
                  {**g, **{k: v.astype(np.float32) for k, v in found.items()}})


def run(args):
    """Write the golden files of the tasks, and that of narrow networks."""
    fac.need(torch, "golden files hold what PyTorch computes: pip install torch")
    fac.need(args.data.is_dir(), f"{args.data}: no such folder")
    tasks = args.tasks or sorted(p.parent.name for p in args.data.glob("*/expert.npz")
                                 if (p.parent / "replay.npz").exists())
    for task in tasks:
        write_golden(args.data / task)
    write_narrow_golden(args.data / "golden-narrow.npz")
    return {"data": str(args.data), "tasks": tasks}


def main(argv=None):
    """Run the command line; returns the exit status."""
    parser = fac.Parser(prog="export_golden.py", description=(__doc__ or "").split("\n")[0])
    parser.set_defaults(run=run)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help="[all that have an expert]")
    parser.add_argument("--data", type=Path, default=fac.EXPERTS,
                        help="their folder [data/experts]")
    parser.add_argument("--json", action="store_true",
                        help="print one JSON object as the last line of stdout")
    return fac.run_command(parser, argv)


if __name__ == "__main__":
    sys.exit(main())
