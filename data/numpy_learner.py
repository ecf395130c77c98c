"""TD-MPC's Equation 1, its policy loss and its updates in NumPy: how an expert learns.

`train_expert.py` learns with it; torch_learner.py is the same in PyTorch. Networks, their
gradients and Adam are fac_tdmpc_ref's; arrays are features first, samples last, as there.
"""
import dataclasses
from collections import defaultdict

import numpy as np

import fac_tdmpc_ref as fac


@dataclasses.dataclass(frozen=True)
class ExpertConfig(fac.Settings):
    """TD-MPC's training (Equation 1)."""
    latent_dim: int = fac.field(50, "m: latent features (Table 2)", least=1)
    enc_dim: int = fac.field(256, "hidden width of the encoder (Table 2)", least=1)
    mlp_dim: int = fac.field(512, "hidden width of the other networks (Table 2)", least=1)
    horizon: int = fac.field(3, "H: steps of the latent rollout (Table 2)", least=1,
                             most=fac.EPISODE_STEPS)
    batch_size: int = fac.field(512, "segments in an update (Table 2)", least=2)
    updates_per_step: float = fac.field(1.0, "updates for each decision", least=0)
    lr: float = fac.field(5e-4, "Adam's learning rate (authors' expert)", above=0)
    discount: float = fac.field(0.99, "gamma (Table 2)", least=0, most=1)
    lam: float = fac.field(0.5, "lambda of Equation 1 (rho in Table 2)", least=0)
    consistency_coef: float = fac.field(2.0, "weight of the latent term (TD-MPC)", least=0)
    reward_coef: float = fac.field(0.5, "weight of the reward term (Table 2)", least=0)
    value_coef: float = fac.field(0.1, "weight of the value term (Table 2)", least=0)
    grad_clip: float = fac.field(10.0, "largest gradient norm (Table 2)", above=0)
    tau: float = fac.field(0.01, "step of the moving-average targets (Table 2)", least=0, most=1)
    target_every: int = fac.field(2, "updates between two steps of the targets (TD-MPC)", least=1)
    std_start: float = fac.field(0.5, "smallest sampling deviation at the start (TD-MPC)", least=0)
    std_steps: int = fac.field(25_000, "decisions over which it falls to the planner's min_std",
                               least=0)
    seed_decisions: int = fac.field(4_000, "random decisions before the first update", least=0)
    random_hold: int = fac.field(0, "decisions that each of these holds, all joints at a limit, "
                                 "where reward is a swing away; 0: uniform, anew each", least=0)
    buffer_size: int = fac.field(1_000_000, "replay capacity, transitions (Table 2)", least=1)
    buffer_dtype: str = fac.field("float32", "how the replay is kept in memory",
                                  choices=("float32", "float16"))


def td_targets(model, target, obs, reward, noise, discount):
    """What TD-MPC's code holds fixed: latents of the moving-average encoder, and TD targets.

    obs (H, O, B): the observation after each action; reward (H, B); noise (A, H * B): the
    policy's; discount: gamma, or (H, B), 0 where that observation ended the episode. Returns
    (1, m, H * B), columns ordered (H, B), and the targets
    r_h + gamma min(Q1, Q2)(s_{h+1}, pi(s_{h+1})) (H, B) with the moving averages of Q."""
    after = np.ascontiguousarray(obs.swapaxes(0, 1)).reshape(obs.shape[1], -1)
    z = model.encode(after)
    q = np.minimum(*target.q(z, np.clip(model.policy(z) + noise, -1, 1)))
    return target.encode(after), reward + discount * q.reshape(reward.shape)


def latents_after(model, x, columns, tape=None):
    """s_1, ..., s_L (N, m, L * columns) of `fac.unroll`'s x, which ends with s_{L-1}; the tape is
    the last step's."""
    end = model.forward("_dynamics", x[:, :, -columns:], tape)
    return np.concatenate([x[:, :model.config.latent_dim, columns:], end], 2)


def latents_after_backward(model, tape, d, dx, columns, grads):
    """Walk `latents_after` back: adds its gradient d to x's, dx, and to `grads`."""
    dx[:, :model.config.latent_dim, columns:] += d[:, :, :-columns]
    dx[:, :, -columns:] += model.backward("_dynamics", tape, d[:, :, -columns:], grads)


def equation_1(model, obs, actions, reward, latents, td, config, grads=None):
    """Equation 1 and, into the dict `grads`, its gradients.

        1/H sum_{h=0}^{H-1} lambda^h [c_T |s_{h+1} - latents_h|^2 + c_R (r_h - reward_h)^2
                            + c_Q ((Q1_h - td_h)^2 + (Q2_h - td_h)^2)],  means over B and m,

    as TD-MPC's code has it (the paper prints h = 0..H without 1/H, sums over m, one Q, no
    coefficients, and holds fixed the latents of f_E itself, not of its moving average).

    obs (O, B): the first ones; actions (H, A, B); reward (H, B); latents and td from `td_targets`.
    Returns the loss, its three sums over h without coefficients, and the rollout s_0, ..., s_H
    (1, m, (H + 1) * B)."""
    H, _, B = actions.shape
    tapes, encoder_tape, end_tape, actions = defaultdict(list), [], [], actions[..., None]  # K = 1
    z = model.encode_features(obs[None], encoder_tape)
    m, x = z.shape[1], fac.unroll(model, z, actions, tapes)
    after = latents_after(model, x, B, end_tape)
    lam = (config.lam ** np.arange(H) / B).astype(z.dtype)[:, None]
    terms, d_shares = [], []
    coefs = (config.reward_coef, config.value_coef, config.value_coef)
    for coef, shares, goal in zip(coefs, fac.run_heads(model, x, actions, tapes), (reward, td, td)):
        error = shares.sum(0)[..., 0] - goal
        terms.append(float((lam * error ** 2).sum()))
        d_shares.append((2 * coef / H * lam * error)[None, ..., None])
    gap = (after - latents).reshape(*z.shape[:2], H, B)
    lam = lam / m
    terms.insert(0, float((lam * gap ** 2).sum()))
    terms = [terms[0], terms[1], terms[2] + terms[3]]
    loss = np.dot(terms, [config.consistency_coef, config.reward_coef, config.value_coef]) / H
    if grads is not None:
        d_latents = (2 * config.consistency_coef / H * lam * gap).reshape(1, m, -1)  # of s_1 .. s_H
        dx = fac.heads_backward(model, tapes, d_shares, grads)
        latents_after_backward(model, end_tape, d_latents, dx, B, grads)
        dz = fac.unroll_backward(model, tapes, actions, dx, grads)
        model.encode_backward(dz, encoder_tape, grads)
    return float(loss), terms, np.concatenate([z, after], 2)


def policy_loss(model, rollout, noise, lam, grads):
    """- sum_h lambda^h mean over B of min(Q1, Q2)(s_h, pi(s_h) + noise); gradients for `_pi` only.

    rollout (1, m, L * B): the latents of `equation_1`, held fixed; noise (A, L, B). The clipping
    of the noisy action to [-1, 1] lets gradients through, as in TD-MPC's code."""
    tape, q_tapes, (dim_action, steps, batch) = [], ([], []), noise.shape
    mu = np.tanh(model.forward("_pi", rollout, tape))
    a = np.clip(mu + noise.reshape(1, dim_action, -1), -1, 1)
    x = np.concatenate([rollout, a], 1)
    q1, q2 = (model.forward(name, x, q_tape) for name, q_tape in zip(fac.HEADS[1:], q_tapes))
    lam = np.repeat(lam ** np.arange(steps) / batch, batch).astype(x.dtype)
    first = np.where(q1 == q2, fac.F32(0.5), q1 < q2).astype(x.dtype)  # a tie counts half for each
    da = 0
    for name, q_tape, smaller in (("_Q1", q_tapes[0], first), ("_Q2", q_tapes[1], 1 - first)):
        dx = model.backward(name, q_tape, -lam * smaller, None)
        da = da + dx[:, rollout.shape[1]:]
    model.backward("_pi", tape, fac.tanh_backward(da, mu), grads)
    return -float((lam * np.minimum(q1, q2)).sum())


class Learner:
    """TD-MPC: the model, its moving averages, and what an `update` of them takes."""
    about = {"backend": "numpy"}

    def __init__(self, sizes, config, rng, dtype=fac.F32):
        fac.keep_memory()
        model = fac.WorldModel.create(sizes, rng, policy=True, dtype=dtype)
        policy = {k: v for k, v in model.params.items() if k.startswith("_pi")}
        self.config = config
        self.optimizer = fac.Adam({k: v for k, v in model.params.items() if k not in policy})
        self.policy_optimizer = fac.Adam(policy)
        self.model = fac.WorldModel(sizes, {**self.optimizer.params,
                                            **self.policy_optimizer.params})
        self.slow_vector, slow = fac.flatten(self.optimizer.params)
        self.target = fac.WorldModel(sizes, slow)
        threads = fac.thread_pool(2)
        self._fit = fac.Halves(self.optimizer, threads)
        self._improve = fac.Halves(self.policy_optimizer, threads)

    @fac.one_thread()
    def update(self, obs, actions, reward, rng, continues=1.0):
        """One step of Equation 1, one of the policy; every `target_every` times the averages. Two
        threads take half of the batch each.

        obs (H + 1, O, B), actions (H, A, B), reward (H, B); continues (H, B): 0 where the next
        state ended the episode, whose value is zero, else 1. Returns the terms of Equation 1."""
        config, (steps, dim_action, batch) = self.config, actions.shape
        noise = fac.policy_noise((dim_action, 2 * steps + 1, batch), rng)
        discount, rollouts = np.full_like(reward, config.discount * continues), {}

        def fit(part, grads):
            latents, td = td_targets(self.model, self.target, obs[1:, :, part], reward[:, part],
                                     noise[:, :steps, part].reshape(dim_action, -1),
                                     discount[:, part])
            _, terms, rollouts[part.start] = equation_1(
                self.model, obs[0][:, part], actions[..., part], reward[:, part], latents, td,
                config, grads)
            return terms

        def improve(part, grads):
            return policy_loss(self.model, rollouts[part.start], noise[:, steps:, part],
                               config.lam, grads)

        terms = self._fit.learn(batch, fit)
        self.optimizer.step(config.lr, config.grad_clip)
        self._improve.learn(batch, improve)
        self.policy_optimizer.step(config.lr, config.grad_clip)
        if self.updates % config.target_every == 0:  # averages += tau (weights - averages)
            self.slow_vector += config.tau * (self.optimizer.vector - self.slow_vector)
        return terms.tolist()

    @property
    def updates(self):
        """Updates made so far."""
        return self.optimizer.t

    def state(self):
        """Everything that a resumed run needs, as arrays."""
        return {"slow": self.slow_vector, **named("expert", fac.optimizer_state(self.optimizer)),
                **named("policy", fac.optimizer_state(self.policy_optimizer))}

    def load(self, arrays):
        """Go on from a `state`."""
        self.slow_vector[:] = arrays["slow"]
        for name, optimizer in (("expert", self.optimizer), ("policy", self.policy_optimizer)):
            fac.load_optimizer(optimizer, unnamed(name, fac.optimizer_state(optimizer), arrays))


def unnamed(name, state, arrays):
    """A state with the entries of `state`, which `named` has put into arrays under this name."""
    return {key: arrays[f"{name} {key}"] for key in state}


def named(name, state):
    """A state, its entries under this name."""
    return {f"{name} {key}": value for key, value in state.items()}
