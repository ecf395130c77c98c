"""TD-MPC's networks, Equation 1 and its updates in PyTorch.

`train_expert.py --backend torch` learns with it, on a GPU or in bfloat16 if wanted, and the golden
files are what it computes. Parameters are a dict of tensors with fac.WorldModel's names and
shapes; arrays are PyTorch's way round: (N, B, features), samples before features.
"""
import functools

import numpy as np
import torch
import torch.nn.functional as F

import fac_tdmpc_ref as fac

MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # of torch's Adam


def network(kinds, params, name, x):
    """A network of (N, out, in) weights on x (N, B, in).

    Under autocast the last layer keeps its weights' precision: bfloat16 has eight bits, in which
    a Q of 100 would be a multiple of a half.
    """
    for i, kind in enumerate(kinds):
        W, b = (params.get(f"{name}.{i}.{part}") for part in ("weight", "bias"))
        if kind == "linear" and i < len(kinds) - 1:
            x = linear(x, W, b)
        elif kind == "linear":
            with torch.autocast(x.device.type, enabled=False):
                x = linear(x.to(W.dtype), W, b)
        elif kind == "norm":
            x = norm(x, W, b)
        else:
            x = F.elu(x) if kind == "elu" else torch.tanh(x)
    return x


def linear(x, W, b):
    """x W^T + b for each agent; a single one's as PyTorch is fastest."""
    if len(W) == 1:
        return F.linear(x[0], W[0], b[0, :, 0])[None]
    return torch.baddbmm(b.mT, x, W.mT)


def norm(x, W, b):
    """LayerNorm with each agent's own scale and shift."""
    if len(W) == 1:
        return F.layer_norm(x, x.shape[-1:], W[0, :, 0], b[0, :, 0])
    return F.layer_norm(x, x.shape[-1:]) * W.mT + b.mT


def heads(params, x, names=fac.HEADS):
    """Global reward and both Q, or those named: sums over agents, (B,) each, of x (N, B, m + d)."""
    return [network(fac.NETWORKS[name], params, name, x).sum(0)[:, 0] for name in names]


def transition(params, x):
    """f_T: the next latents (N, B, m) of x (N, B, m + d)."""
    return network(fac.MLP, params, "_dynamics", x)


def least_q(params, z, a):
    """min(Q1, Q2) (B,) of latents (N, B, m) and actions (N, B, d)."""
    return torch.minimum(*heads(params, torch.cat([z, a], -1), fac.HEADS[1:]))


def policy(params, z, noise=0.0):
    """The policy's action (1, B, A) with given noise; its clipping lets gradients through."""
    a = torch.tanh(network(fac.MLP, params, "_pi", z)) + noise
    return a - a.detach() + a.detach().clamp(-1, 1)


def equation_1(params, target, obs, action, reward, config, noise=0.0, continues=1.0):
    """Equation 1 on obs (H+1, B, O), action (H, B, A), reward and continues (H, B) (the latter 0
    where the next state ended the episode): loss, its three terms.

    As numpy_learner's: means over features and batch, weighted by lambda^h; what it holds fixed
    comes from the parameters `target` and the policy with noise (1, H * B, A). Returns also the
    latents s_0, ..., s_H (1, (H+1) * B, m).
    """
    steps, batch, _ = action.shape
    after = obs[1:].reshape(1, steps * batch, -1)
    with torch.no_grad():
        s_next, z_next = (network(fac.ENCODER, p, "_encoder", after) for p in (target, params))
        q = least_q(target, z_next, policy(params, z_next, noise))
        td = reward + continues * (config.discount * q.view(steps, batch))
    latents, terms = [network(fac.ENCODER, params, "_encoder", obs[:1])], [0.0, 0.0, 0.0]
    for h in range(steps):
        x = torch.cat([latents[-1], action[h:h + 1]], -1)
        r, q1, q2 = heads(params, x)
        latents.append(transition(params, x))
        found = (F.mse_loss(latents[-1], s_next[:, h * batch:(h + 1) * batch]),
                 F.mse_loss(r, reward[h]), F.mse_loss(q1, td[h]) + F.mse_loss(q2, td[h]))
        terms = [term + config.lam ** h * x for term, x in zip(terms, found)]
    coefs = config.consistency_coef, config.reward_coef, config.value_coef
    loss = sum(coef * term for coef, term in zip(coefs, terms)) / steps
    return loss, terms, torch.cat(latents, 1)


class TorchLearner:
    """numpy_learner.Learner in PyTorch: from the same weights and noise the same, up to rounding.

    model: the fac.WorldModel to start from, kept for `model`. precision: float32, or bfloat16 for
    the products of the hidden layers; weights, outputs and losses stay float32.
    """

    def __init__(self, model, config, device=None, precision="float32"):
        device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self.config, self.updates, self._model = config, 0, model
        self.about = {"backend": "torch", "torch": torch.__version__, "device": device,
                      "precision": precision}
        self._tensor = functools.partial(torch.tensor, device=device)
        self._autocast = functools.partial(torch.autocast, torch.device(device).type,
                                           torch.bfloat16, enabled=precision == "bfloat16")
        self.params = {k: self._tensor(v, requires_grad=True) for k, v in model.params.items()}
        self.target = {k: self._tensor(v) for k, v in model.params.items() if k[:3] != "_pi"}
        parts = ([p for k, p in self.params.items() if k in self.target],
                 [p for k, p in self.params.items() if k not in self.target])
        self._optimizer, self._policy_optimizer = (
            torch.optim.Adam(part, lr=config.lr, fused=True) for part in parts)

    @property
    def model(self):
        """The weights as they are now, as a fac.WorldModel: always the same arrays."""
        for key, value in self.params.items():
            self._model.params[key][:] = value.detach().cpu().numpy()
        return self._model

    def update(self, obs, actions, reward, rng, continues=1.0):
        """One step of Equation 1, one of the policy; every `target_every` times the averages.

        obs (H + 1, O, B), actions (H, A, B), reward (H, B), arrays, and continues, as
        numpy_learner's. Returns the three terms.
        """
        config, (steps, dim_action, batch) = self.config, actions.shape
        noise = fac.policy_noise((dim_action, 2 * steps + 1, batch), rng)
        noise = self._tensor(noise.reshape(dim_action, -1).T[None])  # (1, (2H + 1) * B, A)
        obs, actions = (self._tensor(x.swapaxes(1, 2)) for x in (obs, actions))
        with self._autocast():
            loss, terms, latents = equation_1(self.params, self.target, obs, actions,
                                              self._tensor(reward), config,
                                              noise[:, :steps * batch], self._tensor(continues))
        self._step(self._optimizer, loss)
        latents = latents.detach()
        with self._autocast():
            a = policy(self.params, latents, noise[:, steps * batch:])
            q = least_q(self.params, latents, a).view(-1, batch).mean(1)
        self._step(self._policy_optimizer, -sum(config.lam ** h * x for h, x in enumerate(q)))
        self.updates += 1
        if self.updates % config.target_every == 0:
            with torch.no_grad():
                for key, slow in self.target.items():
                    slow.lerp_(self.params[key], config.tau)
        return [term.item() for term in terms]

    def _step(self, optimizer, loss):
        """A step of one optimizer, whose own parameters alone get gradients."""
        params = optimizer.param_groups[0]["params"]
        optimizer.zero_grad(set_to_none=True)
        loss.backward(inputs=params)
        torch.nn.utils.clip_grad_norm_(params, self.config.grad_clip)
        optimizer.step()

    def _moments(self):
        """Where Adam keeps what it knows about each parameter: {name: dict}."""
        return {k: (self._optimizer if k in self.target else self._policy_optimizer).state[p]
                for k, p in self.params.items()}

    def state(self):
        """Everything that a resumed run needs, as arrays."""
        found = {f"weights {k}": v for k, v in self.params.items()}
        found.update({f"target {k}": v for k, v in self.target.items()})
        found.update({f"{name} {k}": v for k, moments in self._moments().items()
                      for name, v in moments.items()})
        return {"updates": np.int64(self.updates),
                **{k: v.detach().cpu().numpy() for k, v in found.items()}}

    def load(self, arrays):
        """Go on from a `state`."""
        self.updates = int(arrays["updates"])
        with torch.no_grad():
            for name, params in (("weights", self.params), ("target", self.target)):
                for key, value in params.items():
                    value.copy_(torch.as_tensor(arrays[f"{name} {key}"]))
        for key, moments in self._moments().items():
            moments.update({name: self._tensor(arrays[f"{name} {key}"])
                            for name in MOMENTS if self.updates})
