"""TAP of appendix B.2: a world model whose actions are two latent numbers.

A variational autoencoder (VAE) maps actions to latent actions and back. The student learns from
encoded actions by Algorithm 1 as any other does; MPPI plans latent actions, which are decoded for
the robot. The VAE learns first, from its reconstruction loss alone, and stays as it is then.
"""
import dataclasses
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import fac_tdmpc_ref as fac  # noqa: E402

LATENT_ACTION = 2  # B.2
REACH = 3.0        # a latent action of 1 is this many deviations of the prior


class ActionVAE:
    """q(u | a) = N(mu, sigma^2) and a = g(u), two networks of fac_tdmpc_ref with one agent."""

    def __init__(self, dim_action, rng, hidden=64, dtype=np.float32):
        self.dim_action, weights = dim_action, {}
        for name, widths in (("encode", (dim_action, hidden, hidden, 2 * LATENT_ACTION)),
                             ("decode", (LATENT_ACTION, hidden, hidden, dim_action))):
            for i, (before, after) in enumerate(zip(widths, widths[1:])):
                weights[f"{name}.{2 * i}.weight"] = fac.orthogonal(rng, 1, after, before, dtype)
                weights[f"{name}.{2 * i}.bias"] = np.zeros((1, after, 1), dtype)
        self.optimizer = fac.Adam(weights)
        self.params = self.optimizer.params

    def loss(self, actions, noise, beta, grads=None):
        """Mean over actions (A, B) of |a - g(u)|^2 + beta KL(q(u | a) || N(0, 1)), with u = mu +
        sigma noise, noise (2, B); and, into the dict `grads`, its gradients."""
        tapes = [], []
        mu, log_var = np.split(fac.forward(fac.MLP, self.params, "encode", actions[None],
                                           tapes[0])[0], 2)
        sigma, batch = np.exp(log_var / 2), actions.shape[1]
        error = fac.forward(fac.MLP, self.params, "decode", (mu + sigma * noise)[None],
                            tapes[1])[0] - actions
        kl = (mu ** 2 + sigma ** 2 - log_var - 1) / 2
        if grads is not None:
            du = fac.backward(fac.MLP, self.params, "decode", tapes[1], 2 * error[None] / batch,
                              grads)[0]
            d_mu = du + beta * mu / batch
            d_log_var = du * noise * sigma / 2 + beta * (sigma ** 2 - 1) / (2 * batch)
            fac.backward(fac.MLP, self.params, "encode", tapes[0],
                         np.concatenate([d_mu, d_log_var])[None], grads)
        return float((error ** 2).sum() + beta * kl.sum()) / batch

    def fit(self, draw, rng, steps, batch=256, lr=1e-3, beta=0.01):
        """Learn from draw(batch) -> actions (A, B); returns the last tenth's mean loss."""
        losses = []
        for _ in range(steps):
            noise = rng.standard_normal((LATENT_ACTION, batch), np.float32)
            losses.append(self.loss(draw(batch), noise, beta, self.optimizer.grads))
            self.optimizer.step(lr, clip=10.0)
        return float(np.mean(losses[-max(1, steps // 10):]))

    def encode(self, actions):
        """Actions (..., A, B) to latent actions (..., 2, B) in [-1, 1]: the means of q."""
        x = np.moveaxis(actions, -2, 0)
        mu = fac.forward(fac.MLP, self.params, "encode", x.reshape(1, self.dim_action, -1))[0]
        u = np.clip(mu[:LATENT_ACTION] / REACH, -1, 1)
        return np.moveaxis(u.reshape(LATENT_ACTION, *x.shape[1:]), 0, -2)

    def decode(self, u):
        """A latent action (2,) in [-1, 1] to the robot's action (A,)."""
        a = fac.forward(fac.MLP, self.params, "decode", REACH * u[None, :, None])
        return np.clip(a[0, :, 0], -1, 1)


class TapDistiller(fac.Distiller):
    """Algorithm 1 for a centralized student of latent actions."""

    def __init__(self, expert, replay, config, num_agents=1, seed=0, vae_steps=3_000):
        sizes = fac.student_config(expert.config, 1, config.sizes, config.encoder_input)
        super().__init__(expert, replay, config, 1, seed,
                         dataclasses.replace(sizes, dim_action=LATENT_ACTION))
        rng = fac.stream(seed, "action VAE")
        self.vae = ActionVAE(expert.config.dim_action, rng)
        self.vae.fit(lambda batch: replay.sequences(rng.choice(self.train_starts, batch), 1)[1][0],
                     rng, vae_steps)

    def draw(self, number, part, size):
        """As Distiller's, with encoded actions (L, 2, B, K)."""
        features, actions, targets = super().draw(number, part, size)
        steps, _, *columns = actions.shape
        u = self.vae.encode(actions.reshape(steps, self.vae.dim_action, -1))
        return features, u.reshape(steps, LATENT_ACTION, *columns), targets
