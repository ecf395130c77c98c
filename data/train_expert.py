#!/usr/bin/env python3
"""Train a TD-MPC expert in PyTorch and export it for fac_tdmpc_ref.py.

    python data/train_expert.py --task reacher-hard --decisions 40000 --updates-per-step 0.5

This is Equation 1 of the paper with Table 2's sizes, in the form of TD-MPC's public code:
exponential moving-average targets, a policy that is trained through Q and proposes
trajectories to MPPI, exploration noise that falls over the first 25,000 decisions.
Several environments step in worker processes and are planned for as one batch.

It stops cleanly after --minutes, and goes on from its last checkpoint (written after every
round of episodes) when started again with the same --out. When all decisions are made it
writes expert.npz, replay.npz and golden.npz into data/<task>/, and data/golden-narrow.npz.
"""
import argparse
import dataclasses
import functools
import sys
import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import fac_tdmpc_ref as fac  # noqa: E402


# --------------------------------------------------------------------------------- model

class Output(nn.Linear):
    """A last layer, in its weights' precision under autocast too.

    bfloat16 keeps eight bits: a Q of 100 would be a multiple of a half.
    """

    def forward(self, x):
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight.dtype))


def mlp(dim_in, hidden, dim_out):
    return nn.Sequential(nn.Linear(dim_in, hidden), nn.ELU(), nn.Linear(hidden, hidden), nn.ELU(),
                         Output(hidden, dim_out))


def q_network(dim_in, hidden):
    return nn.Sequential(nn.Linear(dim_in, hidden), nn.LayerNorm(hidden), nn.Tanh(),
                         nn.Linear(hidden, hidden), nn.ELU(), Output(hidden, 1))


class TOLD(nn.Module):
    """TD-MPC's world model; attribute names are the official state-dict's."""

    def __init__(self, dim_obs, dim_action, config):
        super().__init__()
        m, hidden = config.latent_dim, config.mlp_dim
        self._encoder = nn.Sequential(nn.Linear(dim_obs, config.enc_dim), nn.ELU(),
                                      Output(config.enc_dim, m))
        self._dynamics = mlp(m + dim_action, hidden, m)
        self._reward = mlp(m + dim_action, hidden, 1)
        self._pi = mlp(m, hidden, dim_action)
        self._Q1 = q_network(m + dim_action, hidden)
        self._Q2 = q_network(m + dim_action, hidden)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.orthogonal_(module.weight)
                nn.init.zeros_(module.bias)
        for network in (self._reward, self._Q1, self._Q2):
            nn.init.zeros_(network[-1].weight)

    def encode(self, obs):
        return self._encoder(obs)

    def next(self, z, a):
        x = torch.cat([z, a], -1)
        return self._dynamics(x), self._reward(x).squeeze(-1)

    def q(self, z, a):
        x = torch.cat([z, a], -1)
        return self._Q1(x).squeeze(-1), self._Q2(x).squeeze(-1)

    def pi(self, z, std=0.0):
        """Policy action with Gaussian noise, cut as in TD-MPC's TruncatedNormal."""
        mu = torch.tanh(self._pi(z))
        if std == 0:
            return mu
        noise = (torch.randn_like(mu) * std).clamp(-fac.POLICY_CUT, fac.POLICY_CUT)
        # the clamp to [-1, 1] passes gradients straight through
        a = mu + noise
        return a - a.detach() + a.detach().clamp(-1 + 1e-6, 1 - 1e-6)


def equation_1(model, target, obs, action, reward, config, pi_std):
    """Equation 1 on obs (H+1, B, O), action (H, B, A), reward (H, B): its three terms.

    Means over features and batch, weights lambda^h, as in TD-MPC's code; targets don't get
    gradients. Returns (consistency, reward, value, latents (H+1, B, m)).
    """
    horizon = action.shape[0]
    with torch.no_grad():
        s_next = target.encode(obs[1:])
        z_next = model.encode(obs[1:])
        td = reward + config.discount * torch.minimum(*target.q(z_next, model.pi(z_next, pi_std)))
    z, latents = model.encode(obs[0]), []
    consistency = reward_loss = value_loss = 0.0
    for h in range(horizon):
        latents.append(z)
        q1, q2 = model.q(z, action[h])
        z, r = model.next(z, action[h])
        weight = config.lam ** h
        consistency = consistency + weight * F.mse_loss(z, s_next[h])
        reward_loss = reward_loss + weight * F.mse_loss(r, reward[h])
        value_loss = value_loss + weight * (F.mse_loss(q1, td[h]) + F.mse_loss(q2, td[h]))
    latents.append(z)
    return consistency, reward_loss, value_loss, torch.stack(latents)


class Learner:
    """TOLD, its targets and its optimizers."""

    def __init__(self, dim_obs, dim_action, config, device, precision="float32"):
        self.config, self.updates = config, 0
        self.autocast = functools.partial(torch.autocast, torch.device(device).type,
                                          torch.bfloat16, enabled=precision == "bfloat16")
        self.model = TOLD(dim_obs, dim_action, config).to(device)
        self.target = TOLD(dim_obs, dim_action, config).to(device)
        self.target.load_state_dict(self.model.state_dict())
        self.target.requires_grad_(False)
        self.q_params = [*self.model._Q1.parameters(), *self.model._Q2.parameters()]
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=config.lr, fused=True)
        self.pi_optimizer = torch.optim.Adam(self.model._pi.parameters(), lr=config.lr,
                                             fused=True)

    def state(self):
        return {"model": self.model.state_dict(), "model_target": self.target.state_dict(),
                "optimizer": self.optimizer.state_dict(), "updates": self.updates,
                "pi_optimizer": self.pi_optimizer.state_dict()}

    def load(self, state):
        self.model.load_state_dict(state["model"])
        self.target.load_state_dict(state["model_target"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.pi_optimizer.load_state_dict(state["pi_optimizer"])
        self.updates = state["updates"]

    def update(self, obs, action, reward, pi_std=fac.POLICY_STD):
        """One step of Equation 1, one of the policy, and every second time the targets."""
        config = self.config
        self.optimizer.zero_grad(set_to_none=True)
        with self.autocast():
            consistency, reward_loss, value_loss, latents = equation_1(
                self.model, self.target, obs, action, reward, config, pi_std)
        loss = (config.consistency_coef * consistency + config.reward_coef * reward_loss
                + config.value_coef * value_loss) / len(action)
        loss.backward()
        nn.utils.clip_grad_norm_(self.model.parameters(), config.grad_clip)
        self.optimizer.step()

        for p in self.q_params:
            p.requires_grad_(False)
        self.pi_optimizer.zero_grad(set_to_none=True)
        latents = latents.detach()
        with self.autocast():
            q = torch.minimum(*self.model.q(latents, self.model.pi(latents, pi_std)))
        weights = config.lam ** torch.arange(len(q), device=q.device, dtype=q.dtype)
        (-(q.mean(1) * weights).sum()).backward()
        nn.utils.clip_grad_norm_(self.model._pi.parameters(), config.grad_clip)
        self.pi_optimizer.step()
        for p in self.q_params:
            p.requires_grad_(True)

        self.updates += 1
        if self.updates % config.target_every == 0:
            with torch.no_grad():
                pairs = zip(self.target.parameters(), self.model.parameters())
                for slow, fast in pairs:
                    slow.lerp_(fast, config.tau)
        return consistency, reward_loss, value_loss

    @torch.inference_mode()
    def plan(self, obs, mean, planner, min_std):
        """MPPI (Equation 2) for E environments at once; exploration noise of min_std.

        obs (E, O); mean (L, E, A) is the warm start. Returns actions (E, A) and the new mean.
        """
        length, horizon, gamma = len(mean), planner.horizon, planner.discount
        z0 = self.model.encode(obs)
        num_env, samples = len(obs), planner.samples
        pi_trajs, dim_action = planner.pi_trajs, mean.shape[-1]
        z, proposals = z0.repeat_interleave(pi_trajs, 0), []
        for h in range(length):
            proposals.append(self.model.pi(z, fac.POLICY_STD))
            if h < length - 1:
                z = self.model.next(z, proposals[-1])[0]
        proposals = torch.stack(proposals).view(length, num_env, pi_trajs, dim_action)
        std = torch.full_like(mean, planner.max_std)
        start = z0.repeat_interleave(samples + pi_trajs, 0)
        for _ in range(planner.iterations):
            noise = torch.randn(length, num_env, samples, dim_action, device=obs.device)
            actions = (mean[:, :, None] + std[:, :, None] * noise).clamp(-1, 1)
            actions = torch.cat([actions, proposals], 2)
            flat, z, value = actions.flatten(1, 2), start, 0.0
            for h in range(horizon):
                z, r = self.model.next(z, flat[h])
                value = value + gamma ** h * r
            value = value + gamma ** horizon * sum(self.model.q(z, flat[horizon])) / 2
            value = value.view(num_env, -1).nan_to_num()
            top, index = value.topk(planner.num_elites, 1)
            elites = actions.gather(2, index[None, :, :, None].expand(
                length, -1, -1, dim_action))
            score = torch.softmax(planner.inverse_temperature * top, 1)[None, :, :, None]
            new_mean = (score * elites).sum(2)
            std = ((score * (elites - new_mean[:, :, None]) ** 2).sum(2)).sqrt()
            std = std.clamp(min_std, planner.max_std)
            mean = planner.momentum * mean + (1 - planner.momentum) * new_mean
        chosen = torch.multinomial(score[0, :, :, 0], 1)[None, :, :, None]
        action = elites.gather(2, chosen.expand(length, -1, -1, dim_action))[0, :, 0]
        action = (action + min_std * torch.randn_like(action)).clamp(-1, 1)
        return action, mean


# ------------------------------------------------------------------------------ training

CURVE = ("decisions", "minutes", "std", "horizon", "return_mean", "return_min", "return_max",
         "consistency", "reward", "value")


def train(args, config, planner):
    """Train until args.decisions or args.minutes.

    Returns (learner, replay, decisions, minutes, done).
    """
    torch.manual_seed(args.seed)
    if args.threads:
        torch.set_num_threads(args.threads)
    _, _, dim_obs, dim_action = fac.lookup_task(args.task)
    rng = np.random.default_rng(args.seed)
    learner = Learner(dim_obs, dim_action, config, args.device, args.precision)
    replay = fac.ReplayBuffer(dim_obs, dim_action, config.buffer_size, config.buffer_dtype)
    decisions, seconds, elapsed, curve, began = 0, 0.0, 0.0, [], time.time()
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    checkpoint = out / "checkpoint.pt"
    # updates_per_step and the planner may change between two stretches of a run
    settings = {"config": dataclasses.asdict(config), "task": args.task, "seed": args.seed,
                "envs": args.envs}
    del settings["config"]["updates_per_step"]
    if checkpoint.exists():
        saved = torch.load(checkpoint, weights_only=False, map_location=args.device)
        fac.same_settings({key: saved["settings"][key] for key in settings}, settings, checkpoint)
        learner.load(saved["learner"])
        decisions, seconds, curve = (saved[key] for key in ("decisions", "seconds", "curve"))
        elapsed = seconds
        replay.load(saved)
        rng.bit_generator.state = saved["rng"]
        torch.set_rng_state(saved["torch_rng"].cpu())
        if torch.cuda.is_available():
            torch.cuda.set_rng_state_all([state.cpu() for state in saved.get("cuda_rng", [])])

    def to_device(x):
        return torch.as_tensor(np.ascontiguousarray(x), device=args.device)

    def learn():
        """One update on a fresh batch; returns its three loss terms."""
        obs, action, reward = replay.sample(rng, config.batch_size, config.horizon, args.task)
        batch = map(to_device, (obs.swapaxes(1, 2), action.swapaxes(1, 2), reward))
        return [x.detach() for x in learner.update(*batch)]

    def out_of_time():
        return args.minutes and time.time() - began > 60 * args.minutes

    done = False
    with fac.EnvironmentPool(args.task, args.envs, args.workers) as pool, \
            tqdm(total=args.decisions, initial=decisions, unit="decision", smoothing=0.05) as bar:
        while decisions < args.decisions and not done:
            obs = pool.reset(rng.integers(2 ** 31, size=args.envs).tolist())
            episode = [obs], [], []
            std = float(np.interp(decisions, [0, config.std_steps],
                                  [config.std_start, planner.min_std]))
            horizon = int(np.interp(decisions, [0, config.std_steps], [1, planner.horizon]))
            planning = dataclasses.replace(planner, horizon=horizon, discount=config.discount)
            warming = decisions < config.seed_decisions
            mean = torch.zeros(planning.horizon + 1, args.envs, dim_action, device=args.device)
            losses = []
            for step in range(fac.EPISODE_STEPS):
                if warming:
                    action = rng.uniform(-1, 1, (args.envs, dim_action)).astype(np.float32)
                else:
                    with learner.autocast():
                        action, mean = learner.plan(to_device(obs), mean, planning, std)
                    mean = torch.cat([mean[1:], torch.zeros_like(mean[:1])])
                    action = action.cpu().numpy()
                obs, reward = pool.step(action)
                for history, item in zip(episode, (obs, action, reward)):
                    history.append(item)
                quota = config.updates_per_step * args.envs
                updates = 0 if warming else int((step + 1) * quota) - int(step * quota)
                losses += [learn() for _ in range(updates)]
                bar.update(args.envs)
                if out_of_time():
                    done = True
                    break
            if done:
                break
            for one in zip(*(np.stack(x, 1) for x in episode)):
                replay.add(*one)
            decisions += args.envs * fac.EPISODE_STEPS
            returns = np.sum(episode[2], 0)
            if warming and decisions >= config.seed_decisions:  # catch up on the random episodes
                for _ in tqdm(range(int(config.updates_per_step * decisions)), desc="first updates",
                              leave=False):
                    losses.append(learn())
            recent = [[float(x) for x in row] for row in losses[-100:]]
            terms = np.mean(recent or [[0] * 3], 0)
            elapsed = seconds + time.time() - began
            bar.set_postfix_str(f"return {returns.mean():.0f} (best {returns.max():.0f}) "
                                f"consistency {terms[0]:.4f} reward {terms[1]:.4f} "
                                f"value {terms[2]:.3f}")
            curve.append([decisions, round(elapsed / 60, 2), round(std, 3), horizon,
                          *(round(float(f(returns)), 1) for f in (np.mean, np.min, np.max)),
                          *map(float, terms)])
            state = {"curve": curve, "settings": settings, "learner": learner.state(),
                     "decisions": decisions, "seconds": elapsed, **replay.state(),
                     "rng": rng.bit_generator.state, "torch_rng": torch.get_rng_state(),
                     "cuda_rng": torch.cuda.get_rng_state_all()}
            with fac.atomic_file(checkpoint) as file:
                torch.save(state, file)
            fac.write_curve(out / "curve.csv", CURVE, curve)  # after it: a kill doubles no row
    return learner, replay, decisions, elapsed / 60, decisions >= args.decisions


# -------------------------------------------------------------------------------- export

# golden files keep to the paper here, whatever the defaults are
AS_PRINTED = {"horizon": 3, "lam": 0.5, "noise_std": 0.5, "noise_std_min": 0.5,
              "clip_actions": False}


def export(args, config, planner, learner, replay, decisions, minutes):
    """Write data/<task>/expert.npz, replay.npz and golden.npz, and data/golden-narrow.npz."""
    folder = Path(args.data or Path(__file__).parent) / args.task
    _, _, dim_obs, dim_action = fac.lookup_task(args.task)
    sizes = fac.ModelConfig(dim_obs, dim_action, 1, config.latent_dim, config.enc_dim,
                            config.mlp_dim)
    weights = {k: v.cpu().numpy() for k, v in learner.model.state_dict().items()}
    about = {"task": args.task, "seed": args.seed, "decisions": decisions, "minutes": minutes,
             "updates": learner.updates, "torch": torch.__version__, "device": str(args.device),
             "precision": args.precision, "training": dataclasses.asdict(config),
             "training_planner": dataclasses.asdict(planner)}
    fac.write_npz(folder / "expert.npz",
                  {"kind": "expert", "model": dataclasses.asdict(sizes), **about}, weights)
    replay.write(folder / "replay.npz", about)
    write_golden(folder, replay, config)
    write_narrow_golden(folder.parent / "golden-narrow.npz")


def run_network(kinds, params, name, x):
    """A network of (N, out, in) weights on x (N, in, B): the student's layers, in PyTorch."""
    for i, kind in enumerate(kinds):
        if kind == "linear":
            x = torch.baddbmm(params[f"{name}.{i}.bias"], params[f"{name}.{i}.weight"], x)
        elif kind == "norm":
            x = F.layer_norm(x.transpose(1, 2), x.shape[1:2]).transpose(1, 2)
            x = x * params[f"{name}.{i}.weight"] + params[f"{name}.{i}.bias"]
        else:
            x = F.elu(x) if kind == "elu" else torch.tanh(x)
    return x


def rollout(params, z, actions):
    """Rewards and both Q, summed over agents, (L, B, K): actions (L, A, B, K), z (N, m, B)."""
    steps, _, batch, noise = actions.shape
    z, outputs = z.repeat_interleave(noise, 2), []
    for h in range(steps):
        a = actions[h].reshape(len(z), -1, batch * noise)
        x = torch.cat([z, a], 1)
        outputs.append([run_network(kinds, params, name, x).sum(0).view(batch, noise)
                        for name, kinds in fac.HEADS])
        z = run_network(fac.MLP, params, "_dynamics", x)
    return [torch.stack(head) for head in zip(*outputs)]


def equation_4(params, features, actions, targets, agents, config):
    """Algorithm 1's loss with autograd; targets: the expert's three (L, B, K)."""
    z = run_network(fac.ENCODER, params, "_encoder", features)
    z = z.reshape(agents, -1, features.shape[-1])
    loss = 0.0
    coefs = (config.reward_coef, config.value_coef, config.value_coef)
    for coef, student, expert in zip(coefs, rollout(params, z, actions), targets):
        log_s = F.log_softmax(student / config.temperature_student, -1)
        log_e = F.log_softmax(expert / config.temperature_expert, -1)
        to, of = (log_s, log_e) if config.kl == "forward" else (log_e, log_s)
        kl = F.kl_div(to, of, reduction="none", log_target=True).sum(-1)
        for h in range(len(kl)):
            loss = loss + coef * config.lam ** h * kl[h].mean()
    return loss


def alive_student(sizes, rng, dtype):
    """A fresh student, its zero layers drawn too so that every gradient is alive, in PyTorch."""
    student = fac.WorldModel.create(sizes, rng, dtype=np.float32)
    for key, value in student.params.items():
        if not value.any() and key.endswith("weight"):
            value += 0.1 * rng.standard_normal(value.shape, np.float32)
    return {k: torch.tensor(v, dtype=dtype, requires_grad=not k.startswith("_expert"))
            for k, v in student.params.items()}


def ten_adam_steps(params, loss_function, lr, clip):
    """Ten steps with clipping, in place; returns the ten losses."""
    trained = [p for p in params.values() if p.requires_grad]
    optimizer, losses = torch.optim.Adam(trained, lr=lr), []
    for _ in range(10):
        optimizer.zero_grad()
        loss = loss_function()
        loss.backward()
        nn.utils.clip_grad_norm_(trained, clip)
        optimizer.step()
        losses.append(loss.item())
    return np.array(losses)


def gradients(loss, params):
    """Gradients of named parameters as arrays (zeros where a parameter has none)."""
    values = [p for p in params.values() if p.requires_grad]
    found = iter(torch.autograd.grad(loss, values, allow_unused=True, materialize_grads=True))
    return {k: next(found).numpy() for k, p in params.items() if p.requires_grad}


def last_axis(x):
    """(..., B, F) of PyTorch to (..., F, B) of fac_tdmpc_ref."""
    return x.detach().transpose(-1, -2).numpy()


def expert_golden(model, target, obs, action, reward, config):
    """What a TOLD computes: networks on obs[0], action[0]; Equation 1 and its gradients."""
    z = model.encode(obs[0])
    z_next, r = model.next(z, action[0])
    q1, q2 = model.q(z, action[0])
    found = {"latent": last_axis(z), "next_latent": last_axis(z_next),
             "reward": r.detach().numpy(), "q1": q1.detach().numpy(), "q2": q2.detach().numpy(),
             "policy": last_axis(model.pi(z))}
    terms = equation_1(model, target, obs, action, reward, config, 0.0)[:3]
    loss = (config.consistency_coef * terms[0] + config.reward_coef * terms[1]
            + config.value_coef * terms[2]) / len(action)
    found["equation1_terms"] = np.array([t.item() for t in terms])
    found["equation1_loss"] = np.array(loss.item())
    named = {k: v for k, v in model.named_parameters() if not k.startswith("_pi")}
    return found, gradients(loss, named)


def write_golden(folder, replay, config):
    """golden.npz: the exported expert on its own replay, in float64 from its float32 weights."""
    expert, header = fac.load_model(folder / "expert.npz")
    _, arrays = fac.read_npz(folder / "expert.npz", ("expert",))
    rng = np.random.default_rng(0)
    model = TOLD(expert.config.dim_obs, expert.config.dim_action, config).double()
    model.load_state_dict({k: torch.tensor(v).double() for k, v in arrays.items()})
    obs, action, reward = replay.sample(rng, 16, config.horizon, "")
    double = [torch.tensor(x).double() for x in (obs.swapaxes(1, 2), action.swapaxes(1, 2), reward)]
    found, eq1_grads = expert_golden(model, model, *double, config)
    found.update({f"equation1_grad {k}": fac.digest(g) for k, g in eq1_grads.items()})
    found.update(obs=obs, action=action, rewards=reward)

    # one refinement of MPPI (Equation 2) with fixed noise
    planner = fac.PlannerConfig(samples=64, elites=8, pi_trajs=0)
    dim_action = expert.config.dim_action
    noise = rng.standard_normal((planner.horizon + 1, dim_action, planner.samples), np.float32)
    mean = rng.uniform(-0.5, 0.5, (planner.horizon + 1, dim_action)).astype(np.float32)
    actions = (torch.tensor(mean)[..., None] + planner.max_std * torch.tensor(noise)).clamp(-1, 1)
    actions = actions.double().transpose(1, 2)
    with torch.no_grad():
        z, value = model.encode(double[0][0, :1]).expand(planner.samples, -1), 0.0
        for h in range(planner.horizon):
            z_next, r = model.next(z, actions[h])
            value, z = value + planner.discount ** h * r, z_next
        value = value + planner.discount ** planner.horizon * sum(model.q(z, actions[-1])) / 2
        top, index = value.topk(planner.num_elites)
        score = torch.softmax(planner.inverse_temperature * top, 0)[None, :, None]
        refined = (score * actions[:, index]).sum(1)
        std = (score * (actions[:, index] - refined[:, None]) ** 2).sum(1).sqrt()
    found.update(mppi_noise=noise, mppi_mean=mean, mppi_returns=value.numpy(),
                 mppi_elites=np.sort(index.numpy()), mppi_refined=refined.numpy(),
                 mppi_std=std.clamp(planner.min_std, planner.max_std).numpy())

    # Equation 4 for a fresh student of the default preset, N = dim(A)
    distill = fac.DistillConfig(batch_size=8, noise_samples=10, **AS_PRINTED)
    sizes = fac.student_config(expert.config, dim_action, distill.sizes, distill.encoder_input)
    params = alive_student(sizes, rng, torch.float64)
    found.update({f"student {k}": v.detach().numpy().astype(np.float32) for k, v in params.items()
                  if not k.startswith("_expert")})
    starts = rng.integers(fac.EPISODE_STEPS - 4, size=8)
    actions = replay.action[0, starts + np.arange(4)[:, None]].swapaxes(1, 2)[..., None]
    actions = actions + distill.noise_std * rng.standard_normal(
        (*actions.shape[:3], distill.noise_samples), np.float32)
    with torch.no_grad():
        latent = model.encode(torch.tensor(replay.observation[0, starts]).double()).T[None]
        theirs = {k: torch.tensor(v).double() for k, v in expert.params.items()}
        targets = rollout(theirs, latent, torch.tensor(actions).double())

    def loss():
        return equation_4(params, latent, torch.tensor(actions).double(), targets, dim_action,
                          distill)

    found.update(kl_obs=replay.observation[0, starts].T, kl_actions=actions.astype(np.float32),
                 kl_loss=np.array(loss().item()))
    found.update({f"kl_grad {k}": fac.digest(g) for k, g in gradients(loss(), params).items()})
    found["adam_losses"] = ten_adam_steps(params, loss, distill.lr, distill.grad_clip)
    found.update({f"adam {k}": fac.digest(v.detach().numpy()) for k, v in params.items()
                  if not k.startswith("_expert")})
    fac.write_npz(folder / "golden.npz", {"kind": "golden", "task": header["task"],
                  "training": dataclasses.asdict(config), "planner": dataclasses.asdict(planner),
                  "distill": dataclasses.asdict(distill), "student": dataclasses.asdict(sizes)},
                  found)


def write_narrow_golden(path):
    """golden-narrow.npz: small random networks, N = 1, 2, 3, 6, with everything in full."""
    rng, found = np.random.default_rng(1), {}
    config = fac.ExpertConfig(latent_dim=5, enc_dim=16, mlp_dim=24)
    torch.manual_seed(0)
    model, target = TOLD(7, 6, config).double(), TOLD(7, 6, config).double()
    with torch.no_grad():
        for p in [*model.parameters(), *target.parameters()]:
            p.copy_((p + 0.1 * torch.randn_like(p)).float())  # float32 values
    draw = [rng.standard_normal((4, 8, 7)), rng.uniform(-1, 1, (3, 8, 6)),
            rng.standard_normal((3, 8))]
    draw = [x.astype(np.float32) for x in draw]
    outputs, grads = expert_golden(model, target, *(torch.tensor(x).double() for x in draw), config)
    found.update(outputs, obs=draw[0].swapaxes(1, 2), action=draw[1].swapaxes(1, 2),
                 rewards=draw[2])
    for prefix, network in (("model", model), ("target", target)):
        found.update({f"{prefix} {k}": v.numpy().astype(np.float32)
                      for k, v in network.state_dict().items()})
    found.update({f"equation1_grad {k}": g for k, g in grads.items()})
    configs = {}
    for n in (1, 2, 3, 6):
        for kind in ("forward", "reverse"):
            tag = f"{n} {kind}"
            distill = fac.DistillConfig(kl=kind, noise_samples=4, grad_clip=0.05,
                                        temperature_student=0.7, **{**AS_PRINTED, "horizon": 2})
            sizes = fac.ModelConfig(7, 6, n, 4, 16, 24)
            params = alive_student(sizes, rng, torch.float64)
            features = rng.standard_normal((1, 7, 5)).astype(np.float32)
            actions = rng.uniform(-1, 1, (3, 6, 5, 4)).astype(np.float32)
            targets = rng.standard_normal((3, 3, 5, 4)).astype(np.float32)
            double = [torch.tensor(x).double() for x in (features, actions, targets)]
            loss = lambda: equation_4(params, *double, n, distill)  # noqa: B023, E731
            found.update({f"{tag} weight {k}": v.detach().numpy().astype(np.float32)
                          for k, v in params.items()})
            with torch.no_grad():
                z = run_network(fac.ENCODER, params, "_encoder", double[0]).reshape(n, -1, 5)
                outputs = torch.stack(rollout(params, z, double[1])).numpy()
            found.update({f"{tag} features": features, f"{tag} actions": actions,
                          f"{tag} targets": targets, f"{tag} outputs": outputs,
                          f"{tag} loss": np.array(loss().item())})
            found.update({f"{tag} grad {k}": g for k, g in gradients(loss(), params).items()})
            found[f"{tag} adam_losses"] = ten_adam_steps(params, loss, 1e-3, distill.grad_clip)
            found.update({f"{tag} adam {k}": v.detach().numpy() for k, v in params.items()})
            configs[tag] = {"distill": dataclasses.asdict(distill),
                            "student": dataclasses.asdict(sizes)}
    # float32 keeps seven digits, more than the tests ask for
    found = {k: v.astype(np.float32) for k, v in found.items()}
    fac.write_npz(path, {"kind": "golden", "training": dataclasses.asdict(config),
                         "configs": configs}, found)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="reacher-hard")
    parser.add_argument("--decisions", type=fac.natural, default=100_000,
                        help="decisions in all, two environment steps each [100000]")
    parser.add_argument("--seed", type=fac.natural, default=1)
    parser.add_argument("--envs", type=fac.natural, default=8,
                        help="environments stepped side by side [8]")
    parser.add_argument("--workers", type=int, default=max(1, fac.cores() // 2),
                        help="processes that step them, at least one")
    parser.add_argument("--threads", type=int, default=0, help="PyTorch threads; 0: its default")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--precision", choices=("float32", "bfloat16"), default="float32",
                        help="of hidden layers' products; weights and outputs stay float32")
    parser.add_argument("--minutes", type=float, default=0, help="stop after this time; 0: never")
    parser.add_argument("--out", default=None, help="checkpoint directory [runs/expert-<task>]")
    parser.add_argument("--data", default=None, help="where to export [this script's folder]")
    fac.add_config(parser, fac.ExpertConfig)
    few = fac.TRAINING_BUDGET
    fac.add_config(parser, fac.PlannerConfig, "MPPI while training", "plan-",
                   skip=("discount", "output"), **few)
    args = parser.parse_args(argv)
    args.out = args.out or f"runs/expert-{args.task}"
    try:
        if not args.decisions >= args.envs * fac.EPISODE_STEPS > 0:
            raise fac.UserError(f"--decisions {args.decisions} and --envs {args.envs}: needs at "
                                f"least one environment and an episode ({fac.EPISODE_STEPS} "
                                f"decisions) in each")
        config = fac.from_args(fac.ExpertConfig, args)
        planner = fac.from_args(fac.PlannerConfig, args, **few)
        learner, replay, decisions, minutes, done = train(args, config, planner)
        if not done:
            print(f"stopped after {decisions} decisions; the same command goes on from "
                  f"{args.out}/checkpoint.pt (a round of episodes that was under way is lost)",
                  file=sys.stderr)
        else:
            export(args, config, planner, learner, replay, decisions, round(minutes, 1))
    except fac.UserError as error:
        print(f"train_expert.py: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
