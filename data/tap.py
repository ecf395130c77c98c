"""TAP of appendix B.2: a world model whose actions are two latent numbers.

A variational autoencoder (VAE) maps actions to latent actions and back; as in TAP, both ways see
the state, here the expert's latent. The student learns from encoded actions by Algorithm 1 as any
other does; MPPI plans latent actions, of which the robot gets the first, decoded. The VAE learns
before, from its own loss (reconstruction and KL to the prior), and stays as it is then.
"""
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import fac_tdmpc_ref as fac  # noqa: E402

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

    def draw(self, number, part, size):
        """As Distiller's, with encoded actions (L, 2, B, K): each in the expert's own latent."""
        features, actions, targets = super().draw(number, part, size)
        steps, _, *columns = actions.shape
        z = features if self.student.config.expert_latent_dim else self.expert.encode(features[0])
        x, _ = fac.unroll(self.expert, z, actions, steps - 1)
        u = self.vae.encode(x[0]).reshape(LATENT_ACTION, steps, *columns)
        return features, np.ascontiguousarray(u.swapaxes(0, 1)), targets

    def add(self, observation, action):
        """As Distiller's, of latent actions (E, T, 2): `draw` needs the robot's."""
        s = self.expert.encode(observation.reshape(-1, observation.shape[2]).T)[0]
        action = self.vae.decode(s, action.reshape(-1, LATENT_ACTION).T).T
        super().add(observation, action.reshape(*observation.shape[:2], -1))


class DecodingEnvironment(fac.Environment):
    """A task for TAP's planner: its actions are latent ones."""

    def __init__(self, task, expert, vae):
        super().__init__(task)
        self._expert, self._vae, self._obs = expert, vae, None

    def reset(self, seed):
        self._obs = super().reset(seed)
        return self._obs

    def step(self, action):
        s = self._expert.encode(self._obs[:, None])[0]
        self._obs, reward = super().step(self._vae.decode(s, action[:, None])[:, 0])
        return self._obs, reward
