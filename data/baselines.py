"""What Figures 4 and 5 distil beside Fac-TDMPC: other losses, a small TD-MPC, and TAP; and how the
authors' program plans.

TAP (appendix B.2) is a world model whose actions are two latent numbers. A variational autoencoder
(VAE) maps actions to latent actions and back; as in TAP, both ways see the state, here the expert's
latent. Algorithm 1 perturbs latent actions, and the targets are the expert's for what they decode
to; MPPI plans latent actions, of which the robot gets the first, decoded. The VAE learns before,
from its own loss (reconstruction and KL to the prior), and stays as it is then.
"""
import dataclasses
import functools
from collections import defaultdict

import numpy as np

import fac_tdmpc_ref as fac
from numpy_learner import latents_after, latents_after_backward

# ------------------------------------------------------------------ other losses, other sizes

def squared_error(student, expert, *_):
    """Mean of (student - expert)^2 over the K predictions and its gradient: MSE for `soft_kl`."""
    error = student - expert
    return (error ** 2).mean(-1), 2 * error / error.shape[-1]


class MSEDistiller(fac.Distiller):
    """Figure 5: values, not rankings."""

    loss = staticmethod(functools.partial(fac.distill_loss, divergence=squared_error))


def consistency_loss(student, features, actions, targets, config, grads=None, weight=2.0):
    """Equation 4 and, with a weight of 2 (TD-MPC's; Table 2 has 0), TD-MPC's consistency.

    That is the mean of |s_{h+1} - f_E(g_{h+1})|^2 over features, with the student's encoding,
    held fixed, of the last of `targets`: what the student reads of the expert's own rollout."""
    *targets, after = targets  # (F, L, B, K)
    tapes, encoder_tape, end_tape = defaultdict(list), [], []
    z = student.encode_features(features, encoder_tape)
    L, _, B, K = actions.shape
    x = fac.unroll(student, z, actions, tapes)
    (loss, *means), d_shares = fac.divergences(fac.run_heads(student, x, actions, tapes), targets,
                                               config)
    n, m = student.config.num_agents, student.config.latent_dim
    own = latents_after(student, x, B * K, end_tape)
    goal = student.encode_features(after.reshape(1, len(after), -1))
    lam = np.repeat(config.lam ** np.arange(L), B * K).astype(z.dtype)
    gap, scale = own - goal, weight / (n * m * B * K)
    if grads is not None:
        dx = fac.heads_backward(student, tapes, d_shares, grads)
        latents_after_backward(student, end_tape, 2 * scale * lam * gap, dx, B * K, grads)
        dz = fac.unroll_backward(student, tapes, actions, dx, grads)
        student.encode_backward(dz, encoder_tape, grads)
    return loss + float(scale * (lam * gap ** 2).sum()), *means


class ConsistentDistiller(fac.Distiller):
    """Figure 5: with TD-MPC's consistency loss, along the expert's own rollout."""

    loss = staticmethod(consistency_loss)

    def draw(self, number, part, size):
        """As Distiller's; the targets are followed by the expert's latents (F, L, B, K)."""
        features, actions, targets = super().draw(number, part, size)
        steps, _, *columns = actions.shape
        x = fac.unroll(self.expert, features, actions)
        after = latents_after(self.expert, x, np.prod(columns))
        return features, actions, [*targets, after.reshape(-1, steps, *columns)]


class LightlyConsistentDistiller(ConsistentDistiller):
    """The same with a weight that leaves most of the loss to Equation 4."""

    loss = staticmethod(functools.partial(consistency_loss, weight=0.03))


def of_equal_weights(one, sizes, weights):
    """`one`, a ModelConfig, as wide as it takes to have as many weights as `sizes`, another;
    weights(ModelConfig): how many count."""
    return min((dataclasses.replace(one, mlp_dim=width) for width in range(1, 1024)),
               key=lambda one: abs(weights(one) - weights(sizes)))


def small_distiller(expert, replay, config, _, seed):
    """B.2's 10% TD-MPC: centralized, hidden layers of 66 (3% of the weights behind the encoder)."""
    return fac.Distiller(expert, replay, config, 1, seed, mlp_dim=66)


# ---------------------------------------------------------------------------------------- TAP

LATENT_ACTION = 2  # B.2
REACH = 3.0        # a latent action of 1 is this many deviations of the prior


class ActionVAE:
    """q(u | s, a) = N(mu, sigma^2) and a = g(s, u): two networks of fac_tdmpc_ref, one agent.

    Columns x (m + A, B) hold a latent and an action, as `unroll` gives them."""

    def __init__(self, latent_dim, dim_action, rng, hidden=128, dtype=np.float32):
        self.latent_dim, weights = latent_dim, {}
        for name, widths in (
                ("encode", (latent_dim + dim_action, hidden, hidden, 2 * LATENT_ACTION)),
                ("decode", (latent_dim + LATENT_ACTION, hidden, hidden, dim_action))):
            for i, (before, after) in enumerate(zip(widths, widths[1:])):
                weights[f"{name}.{2 * i}.weight"] = fac.orthogonal(rng, 1, after, before, dtype)
                weights[f"{name}.{2 * i}.bias"] = np.zeros((1, after, 1), dtype)
        self.optimizer = fac.Adam(weights)
        self.params = self.optimizer.params

    def loss(self, x, noise, beta, grads=None):
        """Mean over columns x of |a - g(s, u)|^2 + beta KL(q(u | s, a) || N(0, 1)), with u = mu +
        sigma noise, noise (2, B); and, into the dict `grads`, its gradients."""
        tapes, batch, s = ([], []), x.shape[1], x[:self.latent_dim]
        mu, log_var = np.split(fac.forward(fac.MLP, self.params, "encode", x[None], tapes[0])[0], 2)
        sigma = np.exp(log_var / 2)
        su = np.concatenate([s, mu + sigma * noise])[None]
        error = fac.forward(fac.MLP, self.params, "decode", su, tapes[1])[0] - x[self.latent_dim:]
        kl = (mu ** 2 + sigma ** 2 - log_var - 1) / 2
        if grads is not None:
            du = fac.backward(fac.MLP, self.params, "decode", tapes[1], 2 * error[None] / batch,
                              grads)[0, self.latent_dim:]
            d_mu = du + beta * mu / batch
            d_log_var = du * noise * sigma / 2 + beta * (sigma ** 2 - 1) / (2 * batch)
            fac.backward(fac.MLP, self.params, "encode", tapes[0],
                         np.concatenate([d_mu, d_log_var])[None], grads)
        return float((error ** 2).sum() + beta * kl.sum()) / batch

    def fit(self, draw, rng, steps, batch=256, lr=1e-3, beta=0.01):
        """Learn from draw(batch) -> columns x."""
        for _ in range(steps):
            noise = rng.standard_normal((LATENT_ACTION, batch), np.float32)
            self.loss(draw(batch), noise, beta, self.optimizer.grads)
            self.optimizer.step(lr, clip=10.0)

    def encode(self, x):
        """Columns x to latent actions (2, B) in [-1, 1]: the means of q."""
        mu = fac.forward(fac.MLP, self.params, "encode", x[None])[0, :LATENT_ACTION]
        return np.clip(mu / REACH, -1, 1)

    def decode(self, s, u):
        """Latents (m, B) and latent actions (2, B) in [-1, 1] to the robot's actions (A, B)."""
        su = np.concatenate([s, REACH * u])[None]
        return np.clip(fac.forward(fac.MLP, self.params, "decode", su)[0], -1, 1)


class TapDistiller(fac.Distiller):
    """Algorithm 1 for a centralized student of latent actions."""

    def __init__(self, expert, replay, config, num_agents=1, seed=0, vae_steps=3_000):
        super().__init__(expert, replay, config, 1, seed, dim_action=LATENT_ACTION)
        rng = fac.stream(seed, "action VAE")
        self.vae = ActionVAE(expert.config.latent_dim, expert.config.dim_action, rng)

        def draw(batch):
            obs, actions = replay.sequences(rng.choice(self.train_starts, batch), 1)
            return np.concatenate([expert.encode(obs)[0], actions[0]])

        self.vae.fit(draw, rng, vae_steps)

    def perturb(self, expert, student, obs, actions, config, rng):
        """As `perturbed_batch`, of latent actions u_h (L, 2, B, K): what actions encode to, each in
        the expert's own latent, plus noise (0.5 is 1.5 deviations of the prior), clipped like the
        planner's; the predictions are for what u_h decodes to."""
        L, A, B, _ = actions.shape
        K, z = config.noise_samples, expert.encode(obs)
        latent, inputs = [], []  # the latter as `unroll` gives them: (1, m + A, B * K) each
        for a in np.broadcast_to(actions, (L, A, B, K)).reshape(L, A, -1):
            s = expert.forward("_dynamics", inputs[-1]) if inputs else np.repeat(z, K, 2)
            noise = fac.F32(config.noise_std) * rng.standard_normal((LATENT_ACTION, B * K), fac.F32)
            u = self.vae.encode(np.concatenate([s[0], a])) + noise
            latent.append(np.clip(u, -1, 1))
            inputs.append(np.concatenate([s, self.vae.decode(s[0], latent[-1])[None]], 1))
        latent = np.stack(latent).reshape(L, -1, B, K)
        return student.read(obs), latent, [
            y.sum(0) for y in fac.run_heads(expert, np.concatenate(inputs, 2), latent)]


class DecodingEnvironment(fac.Environment):
    """A task for TAP's planner: its actions are latent ones."""

    def __init__(self, task, expert, vae, action_repeat=fac.ACTION_REPEAT):
        super().__init__(task, action_repeat)
        self._expert, self._vae, self._obs = expert, vae, None

    def reset(self, seed):
        self._obs = super().reset(seed)
        return self._obs

    def step(self, action):
        s = self._expert.encode(self._obs[:, None])[0]
        self._obs, reward = super().step(self._vae.decode(s, action[:, None])[:, 0])
        return self._obs, reward


def distiller_of(case):
    """What learns in a case of Figure 4 or 5; most differ from the default by settings alone."""
    return {"MSE": MSEDistiller, "consistency": ConsistentDistiller, "TAP": TapDistiller,
            "consistency 0.03": LightlyConsistentDistiller,
            "10% TD-MPC": small_distiller}.get(case, fac.Distiller)


# ------------------------------------------------------------------ as the authors' program plans

class AuthorsPlanner(fac.Planner):
    """A student's planner that sees its expert's policy, as in the authors' program: `pi_trajs` of
    its noisy rollouts, in the expert's model, compete in every iteration, and each agent chooses
    among its own parts of them by its own networks."""

    def __init__(self, student, expert, config, seed=0):
        super().__init__(student, config, seed)
        self.own.proposals, self.theirs = self.proposals, fac.AgentPlanner(expert, config)

    def plan(self, obs):
        self.obs = np.array(obs, fac.F32)[:, None]
        return super().plan(obs)

    def proposals(self, _):
        """The expert's, (1, L, A, P), cut into the agents' parts, (N, L, d, P); None if P = 0."""
        self.theirs.rngs = self.own.rngs  # an episode's
        found = self.theirs.proposals(self.theirs.model.encode(self.obs))
        if found is None:
            return None
        sizes, (_, L, _, P) = self.model.config, found.shape
        actions = found[0][:, fac.agent_order(sizes)]
        return actions.reshape(L, sizes.num_agents, -1, P).swapaxes(0, 1)
