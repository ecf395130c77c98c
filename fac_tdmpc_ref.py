"""Fac-TDMPC in NumPy: a factored world model for robot planning, in one file.

A TD-MPC expert (encoder, dynamics, reward, value; planning by MPPI in latent space) is distilled
into a student whose latent, dynamics, reward and value fall apart into one small model for each
action dimension. Each joint then acts and plans alone: cheaper, and in parallel.

    python fac_tdmpc_ref.py distill --task reacher-hard

Part I is the method, to be read from top to bottom: 1 settings, 2 layers, 3 world model, 4
distillation (Equation 4, Algorithm 1), 5 planning (Equations 2 and 3). It runs (`distill --plain`).
Part II adds [D8], credit and what teaches priors [D9], pools of reused copies [D1], speed, and the
engineering. Experts learn, by Equation 1, in data/. The README lists departures, [D1] to [D9].

The one idea that keeps it small: every model carries an agent axis N, and a centralized model is
the case N = 1. There is one world model, one planner, one loss. The axes, everywhere:

    N   agents: 1 in TD-MPC; dim(A), or any divisor of it, in Fac-TDMPC
    m   latent features of an agent; a latent, the paper's s, is z (N, m, B) in the code
    d   action dimensions of an agent: dim(A) / N
    O   observation features;   A = N * d   action dimensions
    B   batch;   S   action sequences (the last axis);   M   rows of a replay
    K   noisy copies in the loss, whose actions are (L, A, B, K); in a plan they are (N, L, d, S)
    H   horizon: a return G is H discounted rewards, then Q;   L   actions: H + 1 (Eq. 2 and 4)
    F   features an encoder reads;   P   proposals;   E   elites, or episodes;   T   decisions

A decision is one planned action, which the robot repeats for two control steps; a proposal is an
action sequence that the expert's policy suggests to a plan. What a student computes in training:

    observation g (O, B) -> the expert's f_E, frozen -> its latent (1, F, B) [D3]
      -> the student's f_E -> cut into s^1, ..., s^N: (N, m, B), each repeated for K copies
    (s^i_h, a^i_h) -> f_T^i -> s^i_{h+1} for h < H: columns (L, B, K), copies side by side
                   -> f_R^i, f_Q^i -> agent i's shares of reward and value (N, L, B, K)
    sum over i (not for credit [D9]) -> R_h, Q_h (L, B, K) -> softmax over K -> divergence (Eq. 4)

A layer is W (N, out, in), b (N, out, 1) and computes W @ x + b on x (N, in, B): samples last, so
that activations run over long rows. A torch Linear.weight is itself in files, weight[None] here.
"""
from __future__ import annotations

import dataclasses
import functools
import zlib
from collections import defaultdict

import numpy as np

F32 = np.float32

# ==== 1. Settings =====================================================================

CONTROL_STEPS = 1000  # of dm_control, in an episode
ACTION_REPEAT = 2  # control steps a decision, whose rewards are added; a model's file may differ
EPISODE_STEPS = CONTROL_STEPS // ACTION_REPEAT  # T: decisions in an episode


def field(default, help, repr=True, **about):
    """A field; about: `least`, `above`, `most`, `choices`, values in presets `paper`, `plain`."""
    return dataclasses.field(default=default, repr=repr, metadata={"help": help, **about})


class Settings:
    """Base of the settings below, whose values Part II checks as they are made."""

    def __post_init__(self):
        check_settings(self)


@dataclasses.dataclass(frozen=True)
class ModelConfig(Settings):
    """Sizes of a world model. Raises UserError if the agents don't share the actions evenly."""
    dim_obs: int = field(0, "O: observation features", least=1)
    dim_action: int = field(0, "A: action dimensions", least=1, most=1_000_000)
    num_agents: int = field(1, "N: 1 is TD-MPC, A is Fac-TDMPC")
    latent_dim: int = field(50, "m: an agent's latent features (Table 2; 5.1: 512 // N)", least=1)
    enc_dim: int = field(256, "hidden width of the encoder (Table 2)", least=1)
    mlp_dim: int = field(512, "hidden width of an agent's other networks (Table 2)", least=1)
    expert_latent_dim: int = field(0, "features of an expert's latent to encode; 0: none", least=0)
    expert_enc_dim: int = field(256, "hidden width of the expert's encoder", least=1)
    prior_steps: int = field(0, "actions that an agent's own prior gives [D9]; 0: none", least=0)
    groups: str = field("", "robot's action dimensions of each agent, 0,2/1,3; '': in order")

    @property
    def agent_actions(self):
        """d: action dimensions of one agent."""
        return self.dim_action // self.num_agents


@dataclasses.dataclass(frozen=True)
class PlannerConfig(Settings):
    """MPPI. A model's file may name others. Raises UserError for values that can't plan."""
    samples: int = field(128, "S: sequences drawn at once [D5]", paper=512, least=1, most=10 ** 6)
    iterations: int = field(4, "of MPPI [D5]; 0: the priors act", paper=6, least=0)
    prior: str = field("last", "first mean: the last plan's, shifted; own: the agents' own "
                       "priors' (an expert's: policy's) [D9]", repr=False, choices=("last", "own"))
    elites: int = field(0, "best, which make the next mean; 0: samples / 8 (Table 2: 64)", least=0)
    pi_trajs: int = field(24, "P: policy proposals (Table 2)", least=0, most=10 ** 6)
    horizon: int = field(3, "H of Equation 2", least=0, most=EPISODE_STEPS - 1)
    discount: float = field(0.99, "gamma (Table 2)", least=0, most=1)
    min_std: float = field(0.05, "smallest sampling deviation (Table 2)", above=0)
    max_std: float = field(2.0, "largest and first one (Table 2) [D9]", above=0)
    inverse_temperature: float = field(0.5, "scores: exp(this * G). Table 2: temperature", above=0)
    momentum: float = field(0.1, "part of the old mean in the new (TD-MPC's code)", least=0, most=1)
    speed: str = field("fast", "Equation 2 by Part II or, plain, as Part I reads", repr=False,
                       choices=("fast", "plain"))
    output: str = field("sampled", "an elite drawn by score (TD-MPC's code), or 3.2's mean [D5]",
                        paper="mean", choices=("sampled", "mean"))
    action_repeat: int = field(ACTION_REPEAT, "control steps a decision", repr=False)

    @property
    def num_elites(self):
        """E: `elites`, or their default for this many samples."""
        return self.elites or max(1, self.samples // 8)


@dataclasses.dataclass(frozen=True)
class Algorithm1Config(Settings):
    """Algorithm 1; paper: what `--preset paper` takes. Additions: Part II's `DistillConfig`."""
    steps: int = field(7_000, "gradient steps (section 5.1: 10^5) [D1]", paper=100_000, least=1)
    batch_size: int = field(32, "B: states in a step [D1]", paper=512, least=2)
    noise_samples: int = field(5, "K: copies of actions, perturbed [D1]", paper=10, least=2)
    noise_std: float = field(0.3, "deviation of the noise [D9]", paper=0.5, plain=0.5, above=0)
    clip_actions: bool = field(True, "clip perturbed actions to [-1, 1] [D7]", paper=False)
    horizon: int = field(3, "H of loss and planning (Table 2)", least=0, most=EPISODE_STEPS - 1)
    lam: float = field(0.5, "lambda (rho in Table 2): step h weighs lambda^h", least=0, most=1)
    reward_coef: float = field(0.5, "weight of the rewards' divergence (Table 2)", least=0)
    value_coef: float = field(0.1, "weight of each Q's divergence (Table 2)", least=0)
    temperature_student: float = field(0.5, "T_s of Equation 4 (authors' code)", above=0)
    temperature_expert: float = field(0.5, "T_e (authors' code)", above=0)
    kl: str = field("forward", "D(expert || student), or reverse, Algorithm 1's order [D2]",
                    paper="reverse", choices=("forward", "reverse"))
    encoder_input: str = field("latent", "the encoder reads the expert's latent or the observation "
                               "[D3]", paper="observation", choices=("latent", "observation"))
    lr: float = field(1e-3, "Adam's learning rate [D1]", paper=1e-4, above=0)
    lr_schedule: str = field("cosine", "it falls to 0 like half a cosine, or stays [D1]",
                             paper="constant", choices=("cosine", "constant"))
    warmup: int = field(200, "steps over which lr rises from zero [D1]", paper=0, least=0)
    grad_clip: float = field(10.0, "largest gradient norm (Table 2)", above=0)
    held_out: float = field(0.1, "share of episodes to measure ranks in", least=1e-4, most=0.5)


def student_config(theirs, num_agents, encoder_input, prior_steps=0):
    """A student's sizes: as by default, but MLPs are max(its expert's // N, 50) wide."""
    num_agents = theirs.dim_action if num_agents is None else num_agents
    latent = theirs.num_agents * theirs.latent_dim * (encoder_input == "latent")
    return ModelConfig(theirs.dim_obs, theirs.dim_action, num_agents, prior_steps=prior_steps,
                       mlp_dim=max(theirs.mlp_dim // max(1, num_agents), 50),
                       expert_latent_dim=latent, expert_enc_dim=theirs.enc_dim)


def stream(seed, use, index=0):
    """The Generator of one use of a run's seed: no two uses, or indices of one, share numbers."""
    return np.random.default_rng(
        np.random.SeedSequence(seed, spawn_key=(zlib.crc32(use.encode()), index)))


# ==== 2. Layers: each forward beside its backward =====================================

# TD-MPC's networks as layer kinds. Layer 3 of the first Q is `_Q1.3.weight` in its state dict.
ENCODER = ("linear", "elu", "linear")
MLP = ("linear", "elu", "linear", "elu", "linear")
QNET = ("linear", "norm", "tanh", "linear", "elu", "linear")
NETWORKS = {"_encoder": ENCODER, "_dynamics": MLP, "_reward": MLP, "_Q1": QNET, "_Q2": QNET,
            "_pi": MLP, "_prior_encoder": ENCODER, "_prior": MLP}  # the last two are ours [D9]
HEADS = ("_reward", "_Q1", "_Q2")
NORM_EPS = 1e-5  # PyTorch's LayerNorm
POLICY_STD, POLICY_CUT = 0.05, 0.3  # of TD-MPC's policy noise: deviation, and where it is cut


def linear(x, W, b):
    """y = W x + b.  x (N, in, B), W (N, out, in), b (N, out, 1) -> (N, out, B)."""
    y = W @ x
    y += b
    return y


def linear_dx(dy, W):
    """dx = W^T dy; of one output an outer product, which is slow in BLAS: broadcast."""
    return W.swapaxes(1, 2) @ dy if W.shape[1] > 1 else W.swapaxes(1, 2) * dy


def linear_backward(dy, x, W):
    """Gradients of y = W x + b: dx = W^T dy, dW = dy x^T, db = sum over B of dy."""
    return linear_dx(dy, W), dy @ x.swapaxes(1, 2), dy @ np.ones((dy.shape[2], 1), dy.dtype)


def elu(x):
    """y = x where x > 0, else exp(x) - 1: the larger of x and exp(min(x, 0)) - 1."""
    y = x.clip(-np.inf, 0)  # 3 times as fast as minimum
    np.exp(y, out=y)  # expm1 takes 4 times as long where there is no AVX-512
    y -= 1
    return np.maximum(x, y, out=y)


def elu_backward(dy, y):
    """y = elu(x): dy/dx is 1 where y > 0, else exp(x) = y + 1. Overwrites dy with dx."""
    dy *= y.clip(-np.inf, 0) + 1
    return dy


def tanh_backward(dy, y):
    """y = tanh(x): dy/dx = 1 - y^2. Overwrites dy with dx."""
    dy *= 1 - y * y
    return dy


def standardize(x):
    """x_hat = (x - mean) / sqrt(var + eps) over the features of each agent; also 1 / sqrt."""
    x_hat = x - x.mean(1, keepdims=True)
    var = np.einsum("nfb,nfb->nb", x_hat, x_hat)[:, None] / x.shape[1]
    scale = 1 / np.sqrt(var + x.dtype.type(NORM_EPS))
    x_hat *= scale
    return x_hat, scale


def norm(x, g, b):
    """LayerNorm: y = g x_hat + b.  x (N, in, B), g and b (N, in, 1)."""
    return g * standardize(x)[0] + b


def norm_backward(dy, x, g):
    """Gradients of y = g x_hat + b. With u = g dy: dx = (u - mean(u) - x_hat mean(u x_hat)) scale,
    means over the features."""
    x_hat, scale = standardize(x)
    dg, dx = np.einsum("nfb,nfb->nf", dy, x_hat)[:, :, None], dy * g
    dx -= dx.mean(1, keepdims=True) + x_hat * (dx * x_hat).mean(1, keepdims=True)
    return dx * scale, dg, dy.sum(2, keepdims=True)


def forward(kinds, params, name, x, tape=None):
    """Run a network on x (N, in, B). A tape (list) keeps x and every layer's output."""
    if tape is not None:
        tape.append(x)
    for i, kind in enumerate(kinds):
        if kind in ("linear", "norm"):
            layer = linear if kind == "linear" else norm
            x = layer(x, params[f"{name}.{i}.weight"], params[f"{name}.{i}.bias"])
        else:
            x = elu(x) if kind == "elu" else np.tanh(x)
        if tape is not None:
            tape.append(x)
    return x


def backward(kinds, params, name, tape, dy, grads):
    """Walk `forward` back: adds parameter gradients to `grads` (None: not wanted), returns dx."""
    for i in reversed(range(len(kinds))):
        kind, x, y = kinds[i], tape[i], tape[i + 1]
        if kind == "linear" and grads is None:
            dy = linear_dx(dy, params[f"{name}.{i}.weight"])
        elif kind in ("linear", "norm"):
            layer_backward = linear_backward if kind == "linear" else norm_backward
            dy, dW, db = layer_backward(dy, x, params[f"{name}.{i}.weight"])
            if grads is not None:
                grads[f"{name}.{i}.weight"] += dW
                grads[f"{name}.{i}.bias"] += db
        else:
            dy = elu_backward(dy, y) if kind == "elu" else tanh_backward(dy, y)
    return dy


def orthogonal(rng, agents, rows, columns, dtype=F32):
    """(N, rows, columns) matrices with orthonormal rows or columns, whichever are fewer."""
    q, r = np.linalg.qr(rng.standard_normal((agents, max(rows, columns), min(rows, columns))))
    q *= np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]  # uniform over rotations
    return np.ascontiguousarray(q if rows >= columns else q.swapaxes(1, 2), dtype)


def flatten(arrays):
    """One vector that holds all arrays of a dict, and a dict of views into it."""
    vector = np.concatenate([a.ravel() for a in arrays.values()])
    ends = np.cumsum([a.size for a in arrays.values()])
    return vector, {k: vector[end - a.size:end].reshape(a.shape)
                    for (k, a), end in zip(arrays.items(), ends)}


class Adam:
    """Adam as PyTorch defines it, with clipping, on a dict of arrays: all of them views of one
    vector, so that a step is a few calls a block. Add to `grads`, then `step`."""

    def __init__(self, arrays):
        self.vector, self.params = flatten(arrays)
        self.gradient, self.grads = flatten({k: np.zeros_like(v) for k, v in arrays.items()})
        self.m, self.v, self.t = np.zeros_like(self.vector), np.zeros_like(self.vector), 0
        self.blocks = [[a[i:i + 16384] for a in (self.vector, self.gradient, self.m, self.v)]
                       for i in range(0, len(self.vector), 16384)]  # what fits a core's cache

    def step(self, lr, clip=np.inf):
        """params -= lr m_hat / (sqrt(v_hat) + eps), of the gradient clipped to norm `clip`. Sets
        the gradient to zero; returns its norm before."""
        length, beta1, beta2, eps = float(np.linalg.norm(self.gradient)), 0.9, 0.999, 1e-8
        if length > clip:
            self.gradient *= self.gradient.dtype.type(clip / (length + 1e-6))  # PyTorch's 1e-6
        self.t += 1
        for w, gradient, m, v in self.blocks:
            m += (1 - beta1) * (gradient - m)
            v += (1 - beta2) * (gradient ** 2 - v)
            root = np.sqrt(v / (1 - beta2 ** self.t))
            w -= lr / (1 - beta1 ** self.t) * m / (root + eps)
            gradient[:] = 0
        return length


# ==== 3. World model (sections 3.2 and 4.2) ===========================================

class WorldModel:
    """f_E, f_T, f_R, f_Q with an agent axis: TD-MPC for N = 1, Fac-TDMPC for N = A.

    `params` maps TD-MPC's state-dict names to arrays with a leading agent axis. The encoder is
    centralized. Experts also have TD-MPC's policy, `_pi`; students a prior for each agent, `_prior`
    [D9], and their expert's frozen encoder, whose latent their own encoders read [D3]."""

    def __init__(self, config, params):
        self.config, self.params = config, params

    @classmethod
    def create(cls, config, rng, policy=False, dtype=F32):
        """Fresh weights: orthogonal, biases zero, last layer of reward and Q zero (TD-MPC)."""
        params = {}
        for name, i, kind, shape, last in layers(config, policy):
            zero = last and name in HEADS
            params[f"{name}.{i}.weight"] = (
                np.ones(shape, dtype) if kind == "norm" else
                np.zeros(shape, dtype) if zero else orthogonal(rng, *shape, dtype))
            params[f"{name}.{i}.bias"] = np.zeros((*shape[:2], 1), dtype)
        return cls(config, params)

    def forward(self, name, x, tape=None):
        """Run one of its NETWORKS on x (N, in, B; encoders' N is 1); `backward` walks it back."""
        return forward(NETWORKS[name.removeprefix("_expert")], self.params, name, x, tape)

    def backward(self, name, tape, dy, grads):
        return backward(NETWORKS[name], self.params, name, tape, dy, grads)

    def encode(self, obs):
        """s = f_E(g).  obs (O, B) -> latents (N, m, B)."""
        return self.encode_features(self.read(obs))

    def read(self, obs):
        """What its encoders read of obs (O, B): it, or its expert's latent [D3], (1, F, B)."""
        return (self.forward("_expert_encoder", obs[None]) if self.config.expert_latent_dim
                else obs[None])

    def encode_features(self, x, tape=None, name="_encoder"):
        """A trained encoder on (1, F, B); its output is cut into the agents' latents."""
        z = self.forward(name, x, tape)
        return z.reshape(self.config.num_agents, self.config.latent_dim, -1)

    def encode_backward(self, dz, tape, grads, name="_encoder"):
        """Walk `encode_features` back from dz (N, m, B): adds to `grads`, returns dx (1, F, B)."""
        return self.backward(name, tape, dz.reshape(1, -1, dz.shape[-1]), grads)

    def next(self, z, a):
        """s' = f_T(s, a).  z (N, m, B), a (N, d, B) -> (N, m, B)."""
        return self.forward("_dynamics", np.concatenate([z, a], 1))

    def reward(self, z, a):
        """r^i = f_R^i(s^i, a^i) -> (N, B); the global reward is the sum over N."""
        return self.forward("_reward", np.concatenate([z, a], 1))[:, 0]

    def q(self, z, a):
        """Both q^i = f_Q^i(s^i, a^i) (Table 2: num_q 2) -> two (N, B); the sums are global."""
        x = np.concatenate([z, a], 1)
        return tuple(self.forward(name, x)[:, 0] for name in ("_Q1", "_Q2"))

    def policy(self, z):
        """The expert's policy mean, z (1, m, B) -> (1, A, B) in [-1, 1]."""
        return np.tanh(self.forward("_pi", z))

    @property
    def has_policy(self):
        return "_pi.0.weight" in self.params

    def latents(self, obs, search=True):
        """What agents plan from, obs (O, B) -> s^i (N, m, B); with priors [D9] s^i stacked on
        what the priors read, (N, 2m, B); without a search the latter alone, (N, m, B)."""
        x = self.read(obs)
        if not self.config.prior_steps:
            return self.encode_features(x)
        e = self.encode_features(x, name="_prior_encoder")
        return np.concatenate([self.encode_features(x), e], 1) if search else e

    def prior(self, latents, steps):
        """What each agent would do without a search, `latents` -> actions (N, steps, d, B): its
        prior's `prior_steps`, the last one repeated [D9]; an expert: its policy, rolled out."""
        if self.has_policy:
            return policy_rollout(self, latents, [F32(0)] * steps).swapaxes(0, 1)
        sizes = self.config
        actions = np.tanh(self.forward("_prior", latents[:, -sizes.latent_dim:]))
        actions = actions.reshape(sizes.num_agents, sizes.prior_steps, sizes.agent_actions, -1)
        return actions[:, np.minimum(np.arange(steps), sizes.prior_steps - 1)]


def networks(config, policy=False):
    """(name, agents, widths) of every network of a model."""
    n, m, hidden = config.num_agents, config.latent_dim, (config.mlp_dim, config.mlp_dim)
    d, latent = config.agent_actions, config.expert_latent_dim
    found = [("_encoder", 1, (latent or config.dim_obs, config.enc_dim, n * m)),
             ("_dynamics", n, (m + d, *hidden, m)),
             *((name, n, (m + d, *hidden, 1)) for name in HEADS)]
    if policy:
        found.append(("_pi", n, (m, *hidden, d)))
    if latent:
        found.append(("_expert_encoder", 1, (config.dim_obs, config.expert_enc_dim, latent)))
    if steps := config.prior_steps:
        found += [("_prior_encoder", 1, (latent or config.dim_obs, config.enc_dim, n * m)),
                  ("_prior", n, (m, *hidden, steps * d))]
    return found


def layers(config, policy=False):
    """(network, index, kind, weight shape, whether it is the last) of every layer with weights."""
    for name, agents, (before, *after) in networks(config, policy):
        kinds = NETWORKS[name.removeprefix("_expert")]
        for i, kind in enumerate(kinds):
            if kind == "linear":
                yield name, i, kind, (agents, after[0], before), i == len(kinds) - 1
                before, *after = after
            elif kind == "norm":
                yield name, i, kind, (agents, before, 1), False


def unroll(model, z, actions, tapes=None):
    """Roll a model's latent out under given actions; all h side by side, so that heads run once.

    z (N, m, B), actions (L, A, B, K): K perturbed copies of a trajectory. Returns the networks'
    input x (N, m + d, L * B * K), columns in the order (L, B, K). tapes: a defaultdict(list)."""
    L, _, B, K = actions.shape
    n, m, d = model.config.num_agents, model.config.latent_dim, model.config.agent_actions
    x = np.empty((n, m + d, L * B * K), z.dtype)
    # A, already in the order of `groups`, is cut into N x d: with d = 2 agent 0 has the first two
    x[:, m:] = actions.reshape(L, n, d, B * K).transpose(1, 2, 0, 3).reshape(n, d, -1)
    x[:, :m, :B * K] = np.repeat(z, K, axis=2)
    for h in range(L - 1):
        now, after = (slice(i * B * K, (i + 1) * B * K) for i in (h, h + 1))
        x[:, :m, after] = model.forward("_dynamics", x[:, :, now],
                                        None if tapes is None else tapes[f"_dynamics {h}"])
    return x


def run_heads(model, x, actions, tapes=None):
    """Every agent's share of reward and both Q at `unroll`'s x: three (N, L, B, K)."""
    L, _, B, K = actions.shape
    return [model.forward(name, x, None if tapes is None else tapes[name])
            .reshape(-1, L, B, K) for name in HEADS]


def predict(model, z, actions, tapes=None):
    """Global rewards and both Q at every step of a rollout: sums over agents, three (L, B, K)."""
    x = unroll(model, z, actions, tapes)
    return [shares.sum(0) for shares in run_heads(model, x, actions, tapes)]


def heads_backward(model, tapes, d_shares, grads):
    """Walk `run_heads` back: adds to `grads`, returns dx (N, m + d, L * B * K). d_shares: gradients
    by each share (N, L, B, K), or by their sum (1, L, B, K), the same for each summand."""
    n, dx = model.config.num_agents, 0
    for name, dy in zip(HEADS, d_shares):
        dy = np.repeat(dy, n // len(dy), 0).reshape(n, 1, -1)  # of a sum: the same N times
        dx += model.backward(name, tapes[name], dy, grads)
    return dx


def unroll_backward(model, tapes, actions, dx, grads):
    """Walk `unroll` back from dx: adds to dx and `grads`; returns dz (N, m, B), summed over K."""
    (L, _, B, K), n, m = actions.shape, model.config.num_agents, model.config.latent_dim
    for h in reversed(range(L - 1)):
        now, after = (slice(i * B * K, (i + 1) * B * K) for i in (h, h + 1))
        dx[:, :, now] += model.backward("_dynamics", tapes[f"_dynamics {h}"], dx[:, :m, after],
                                        grads)
    return dx[:, :m, :B * K].reshape(n, m, B, K).sum(3)


# ==== 4. Model distillation (section 4.4) =============================================

def log_softmax(x):
    """log of exp(x) / sum exp(x) over the last axis."""
    x = x - x.max(-1, keepdims=True)
    return x - np.log(np.exp(x).sum(-1, keepdims=True))


def soft_kl(student, expert, temperature_student, temperature_expert, kind="forward"):
    """D(p_e || p_s) of p_e = softmax(expert / T_e) and p_s = softmax(student / T_s), Equation 4.

    student, expert (..., K): predictions for K copies, each rolled out by itself. "reverse"
    is D(p_s || p_e) [D2]. Returns the divergence (...) and its gradient by `student` (..., K)."""
    log_s = log_softmax(student / temperature_student)
    log_e = log_softmax(expert / temperature_expert)
    p_s, p_e = np.exp(log_s), np.exp(log_e)
    if kind == "forward":   # by x_k = student_k / T_s: p_s,k sum_j p_e,j - p_e,k
        kl = (p_e * (log_e - log_s)).sum(-1)
        return kl, (p_s - p_e) / temperature_student
    gap = log_s - log_e     # dp_s,j / dx_k = p_s,j ([j=k] - p_s,k), and sum_j of them is 0
    kl = (p_s * gap).sum(-1)
    return kl, p_s * (gap - kl[..., None]) / temperature_student


def distill_loss(student, features, actions, targets, config, grads=None, divergence=soft_kl):
    """Line 6 of Algorithm 1, with Table 2's coefficients c, for both Q; adds gradients to `grads`.

        mean over B of sum_h lambda^h [c_R D(R_h) + c_Q (D(Q1_h) + D(Q2_h))]

    features (1, F, B): what the student's encoder reads in the first states; actions (L, A, B, K):
    perturbed; targets: what the expert predicts for them, three (L, B, K), or each agent's part,
    (N, L, B, K) [D9]: then D is a sum over agents. Returns loss, mean D of reward, of value."""
    tapes, encoder_tape = defaultdict(list), []
    z = student.encode_features(features, encoder_tape)
    x = unroll(student, z, actions, tapes)
    losses, d_shares = divergences(run_heads(student, x, actions, tapes), targets, config,
                                   divergence)
    if grads is not None:
        dx = heads_backward(student, tapes, d_shares, grads)
        dz = unroll_backward(student, tapes, actions, dx, grads)
        student.encode_backward(dz, encoder_tape, grads)  # its dx is dropped: the expert is frozen
    return losses


def divergences(heads, targets, config, divergence=soft_kl):
    """What `distill_loss` returns, and the loss's gradients by each head's shares: three
    (N, L, B, K) or, where targets are sums, (1, L, B, K), the same for all agents."""
    _, L, B, K = heads[0].shape
    weight = (config.lam ** np.arange(L) / B).astype(heads[0].dtype)[:, None]  # a mean over B
    loss, means, d_shares = 0.0, [], []
    coefs = (config.reward_coef, config.value_coef, config.value_coef)
    for coef, shares, target in zip(coefs, heads, targets):
        target = target.reshape(-1, L, B, K)  # one row: of the sum; N rows: of each share
        output = shares.reshape(len(target), -1, L, B, K).sum(1)  # 1 x N: their sum; N x 1: each
        kl, d_output = divergence(output, target, config.temperature_student,
                                  config.temperature_expert, config.kl)
        loss += coef * float((weight * kl).sum())
        means.append(float(kl.sum(0).mean()))
        d_shares.append(coef * weight[..., None] * d_output)
    return (loss, means[0], (means[1] + means[2]) / 2), d_shares


def new_student(expert, config, seed):
    """(Adam, student): a student with fresh weights, and Adam on those that Algorithm 1 learns: the
    student's arrays are views of Adam's vector. The frozen encoder's are the expert's arrays."""
    student = WorldModel.create(config, stream(seed, "student"))
    frozen = {k: expert.params[k[len("_expert"):]] for k in student.params
              if k.startswith("_expert")}
    priors = {k: v for k, v in student.params.items() if k.startswith("_prior")}
    optimizer = Adam({k: v for k, v in student.params.items() if k not in {**frozen, **priors}})
    return optimizer, WorldModel(config, {**optimizer.params, **priors, **frozen})


def learning_rate(config, t):
    """lr, rising linearly over `warmup` steps, times 1 or (1 + cos) / 2, which ends at 0 [D1]."""
    rate = config.lr * min(1.0, (t + 1) / max(1, config.warmup))
    if config.lr_schedule == "cosine":
        rate *= 0.5 * (1 + np.cos(np.pi * min(1.0, t / config.steps)))
    return float(rate)


def perturbed_actions(actions, config, rng):
    """a_h + eps_h (L, A, B, K) of actions (L, A, B, 1); clipped, if wanted [D7]."""
    noise = rng.standard_normal((*actions.shape[:3], config.noise_samples), F32)
    limit = 1 if config.clip_actions else np.inf
    return np.clip(actions + F32(config.noise_std) * noise, -limit, limit)


def perturbed_batch(expert, student, obs, actions, config, rng):
    """What `distill_loss` learns from, of observations (O, B) and the actions (L, A, B, 1) done:
    features (1, F, B), perturbed actions (L, A, B, K), the expert's predictions for them."""
    perturbed, z = perturbed_actions(actions, config, rng), expert.encode(obs)
    return student.read(obs), perturbed, predict(expert, z, perturbed)


def distill(expert, replay, config, num_agents=None, seed=0, made=None):
    """Algorithm 1 by its lines: a factored student of an expert; yields it with each step's losses.

    replay: the dataset, Part II's `Replay`: `starts(...)` gives (rows to learn from, held out);
    `sequences(rows, L)` their g_0 (O, B), next actions (L, A, B). made: (Adam, student) so far."""
    sizes = student_config(expert.config, num_agents, config.encoder_input)
    optimizer, student = made or new_student(expert, sizes, seed)
    starts, _ = replay.starts(config.horizon + 1, config.held_out, seed)
    for t in range(optimizer.t, config.steps):                                          # line 3
        rng = stream(seed, f"pool {t}")  # Part II: one pool of states for several steps
        rows = rng.choice(starts, config.batch_size)
        obs, actions = replay.sequences(rows, config.horizon + 1)                       # line 4
        batch = perturbed_batch(expert, student, obs, actions[..., None], config, rng)
        losses = distill_loss(student, *batch, config, optimizer.grads)                 # line 6
        optimizer.step(learning_rate(config, t), config.grad_clip)                      # line 5
        yield student, losses


# ==== 5. Planning: MPPI (Equations 2 and 3) ===========================================

def h_step_return(model, z, actions, config):
    """Equation 2 for every agent as it reads; Part II's `Returns` computes the same faster.

        G_i = sum_{h=0}^{H-1} gamma^h f_R^i(s_h^i, a_h^i) + gamma^H f_Q^i(s_H^i, a_H^i)

    z (N, m, 1), actions (N, H + 1, d, S) -> G_i (N, S). Q is the mean of the two: unlike TD-MPC's
    minimum, a mean of sums is the sum of means, as Proposition 1 needs [D4]."""
    gamma, G = config.discount, 0.0
    z = np.repeat(z, actions.shape[-1], axis=2)
    for h in range(config.horizon):
        G = G + gamma ** h * model.reward(z, actions[:, h])
        z = model.next(z, actions[:, h])
    q1, q2 = model.q(z, actions[:, config.horizon])
    return G + gamma ** config.horizon * (q1 + q2) / 2


def mppi(returns, mean, config, rngs, proposals=None):
    """MPPI: refine a Gaussian over action sequences by its elites, in every iteration anew.

    returns, a function: actions (N, L, d, S) -> G_i (N, S); mean (N, L, d): the first Gaussian's;
    rngs: a Generator an agent; proposals (N, L, d, P): sequences that compete in every iteration.
    Elites are chosen agent by agent: G is sum_i G_i(a_i), so the best of each is the best of all
    (Equation 3, Proposition 1). N = 1 is centralized MPPI. Returns the new mean (N, L, d), the last
    elites (N, L, d, E) and their scores (N, E), of sum 1, NaN without a finite G."""
    mean, std = mean[..., None], F32(config.max_std)
    G_proposals = None if proposals is None else returns(proposals)
    for _ in range(config.iterations):
        noise = np.stack([rng.standard_normal((*mean.shape[1:3], config.samples), F32)
                          for rng in rngs])
        actions = np.clip(mean + std * noise, -1, 1)  # sample
        G = returns(actions)  # score
        if proposals is not None:
            actions = np.concatenate([actions, proposals], -1)
            G = np.concatenate([G, G_proposals], 1)
        G = np.where(np.isfinite(G), G, F32(-np.inf))  # these weigh nothing
        best = np.argpartition(-G, config.num_elites - 1, axis=1)[:, :config.num_elites]
        elites = np.take_along_axis(actions, best[:, None, None], 3)  # each agent's own (Eq. 3)
        G = np.take_along_axis(G, best, 1)
        scores = np.exp(config.inverse_temperature * (G - G.max(1, keepdims=True)))
        scores /= scores.sum(1, keepdims=True)
        p = scores[:, None, None]  # refit
        new = (p * elites).sum(3, keepdims=True)
        std = np.sqrt((p * (elites - new) ** 2).sum(3, keepdims=True))
        std = np.clip(std, config.min_std, config.max_std)
        mean = config.momentum * mean + (1 - config.momentum) * new
    return mean[..., 0], elites, scores


def draw_elite(elites, scores, rngs):
    """The actions (N, L, d) of one elite of each agent, drawn by score (TD-MPC's code)."""
    pick = [min(np.searchsorted(np.cumsum(p), rng.random(), "right"), len(p) - 1)
            for p, rng in zip(scores, rngs)]
    return np.stack([e[:, :, i] for e, i in zip(elites, pick)])


def policy_noise(shape, rng):
    """What TD-MPC adds to its policy's actions, where it learns and where it proposes."""
    return np.clip(rng.standard_normal(shape, F32) * F32(POLICY_STD), -POLICY_CUT, POLICY_CUT)


def policy_rollout(model, z, noise):
    """Roll an expert's policy out in its model from z (1, m, B): actions (L, 1, A, B), each the
    policy's plus its entry of `noise` (L of them), clipped to [-1, 1]."""
    actions = []
    for eps in noise:
        z = model.next(z, actions[-1]) if actions else z
        actions.append(np.clip(model.policy(z) + eps, -1, 1))
    return np.stack(actions)


class AgentPlanner:
    """Plans for each of a model's agents from its own latent, networks, random stream and prior
    alone: so processes that split them up plan the same (Part II, which also has it faster)."""

    def __init__(self, model, config):
        self.model, self.config = model, config
        self.reset()

    def reset(self, seeds=()):
        """Start an episode, mean zero. seeds: a SeedSequence an agent, needed by a first search."""
        sizes, L = self.model.config, 1 + self.config.horizon * (self.config.iterations > 0)
        self.mean = np.zeros((sizes.num_agents, L, sizes.agent_actions), F32)
        if seeds:
            self.rngs = [np.random.Generator(np.random.SFC64(seed)) for seed in seeds]

    def plan(self, latents):
        """`WorldModel.latents` (N, ., 1) -> actions (N, L, d), the first of which acts. A search
        begins from the agents' own priors [D9] or from the last mean, shifted. Without a search
        the priors act, L = 1 (`check_settings` then wants prior "own")."""
        own = self.config.prior == "own"
        first = self.model.prior(latents, self.mean.shape[1])[..., 0] if own else self.mean
        if not self.config.iterations:
            return first
        z = latents[:, :self.model.config.latent_dim]
        mean, elites, scores = mppi(self.returns_from(z), first, self.config, self.rngs,
                                    self.proposals(z))
        self.mean = np.concatenate([mean[:, 1:], np.zeros_like(mean[:, :1])], 1)  # warm start
        return mean if self.config.output == "mean" else draw_elite(elites, scores, self.rngs)

    def returns_from(self, z):
        """`mppi`'s `returns`."""
        return functools.partial(h_step_return, self.model, z, config=self.config)

    def proposals(self, z):
        """Noisy policy rollouts (1, L, A, P) of an expert (N = 1), if any (TD-MPC's code)."""
        P, L = self.config.pi_trajs, self.config.horizon + 1
        if not (self.model.has_policy and P):
            return None
        noise = policy_noise((L, 1, self.model.config.dim_action, P), self.rngs[0])
        return policy_rollout(self.model, np.repeat(z, P, 2), noise).swapaxes(0, 1)


# ==== Part II: additions and engineering ==============================================
# A first reader is done: what follows is added to the paper, saves time, or is a program's needs.

import argparse
import contextlib
import csv
import difflib
import importlib.metadata
import json
import multiprocessing
import operator
import os
import pickle
import signal
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

__version__ = "0.1.0"  # to be raised where plans change: recorded returns name it
DATA = Path(__file__).resolve().parent / "data"
EXPERTS = DATA / "experts"


# ==== 6. Errors, and checks of settings where a user's values enter ===================

class UserError(Exception):
    """Something the user can mend: printed as one line, exit status 2."""


def need(condition, message):
    """UserError with this message unless the condition holds."""
    if not condition:
        raise UserError(message)


def shown(value):
    """A value of a user's, in a message."""
    return " ".join(repr(value).split())[:200]


def count(value, name, most=10 ** 9):
    """The value, if it's a whole number from 0 to `most`; else UserError."""
    need(isinstance(value, (int, np.integer)) and 0 <= value <= most,
         f"{name}: expected a whole number from 0 to {most}, found {value!r}")
    return value


def check_finite(name, value, update, lr):
    """UserError if learning diverged, before its weights are saved."""
    need(np.isfinite(value).all(), f"after update {update} the {name} no longer finite: "
         f"learning diverged; lower the learning rate ({lr})")


def episode_steps(action_repeat):
    """T for this many control steps a decision; UserError if an episode doesn't divide by it."""
    need(action_repeat in range(1, CONTROL_STEPS + 1) and CONTROL_STEPS % action_repeat == 0,
         f"action_repeat: expected a divisor of {CONTROL_STEPS}, found {action_repeat!r}")
    return CONTROL_STEPS // action_repeat


RANGE = {"least": ("at least", operator.ge), "above": ("above", operator.gt),
         "most": ("at most", operator.le), "choices": ("one of", lambda value, of: value in of)}


def check_settings(config):
    """UserError for a type or a value that a config's field rules out, and for two that don't go
    together. 1 becomes 1.0 where a float is meant, and NumPy's numbers Python's."""
    def must(name, holds, rule):
        need(holds, f"{type(config).__name__}: {name} must be {rule}, not "
             f"{getattr(config, name)!r}")

    for f in dataclasses.fields(config):
        value, cls = getattr(config, f.name), type(f.default)
        kinds = {int: "iu", float: "iuf", bool: "b", str: "U"}[cls]
        must(f.name, np.dtype(type(value)).kind in kinds, f"of type {cls.__name__}")
        bounds = {**{int: {"most": 10 ** 9}, float: {"most": 3e38}}.get(cls, {}), **f.metadata}
        for bound, (words, holds) in RANGE.items():
            if bound in bounds:
                must(f.name, holds(value, bounds[bound]), f"{words} {bounds[bound]}")
        object.__setattr__(config, f.name, cls(value))
    if isinstance(config, ModelConfig):
        A, each = config.dim_action, map(str, range(config.dim_action))
        agents = [n for n in range(1, A + 1) if A % n == 0]
        must("num_agents", config.num_agents in agents,
             f"one of {agents}, as {A} action dimensions are shared evenly")
        groups = [group.split(",") for group in config.groups.split("/")]
        alike = len(groups) == config.num_agents and len({len(group) for group in groups}) == 1
        must("groups", not config.groups or alike and sorted(sum(groups, [])) == sorted(each),
             f"equally many for each agent, each of 0 to {A - 1} once, as --agents 0,2/1,3")
    elif isinstance(config, PlannerConfig):
        T = episode_steps(config.action_repeat)
        must("horizon", config.horizon < T, f"below {T}, an episode's decisions")
        must("elites", config.elites <= config.samples, f"at most samples ({config.samples})")
        must("min_std", config.min_std <= config.max_std, f"at most max_std ({config.max_std})")
        must("iterations", config.iterations or config.prior == "own", "above 0 without a prior")
    elif isinstance(config, DistillConfig):
        must("played_share", config.played_share or not config.expert_episodes,
             "above 0 where there are expert_episodes")


def from_dict(config_class, values, where):
    """A config from a dict, e.g. a file's header; what is none, and unknown keys, are refused."""
    try:
        return config_class(**values)
    except (UserError, TypeError) as error:  # Python's own words for a key that it doesn't know
        raise UserError(f"{where}: {error}") from None


# ==== 7. Added to the paper: more states [D8], credit and priors of their own [D9] =====

@dataclasses.dataclass(frozen=True)
class DistillConfig(Algorithm1Config):
    """Algorithm 1 and what is added to it. `--preset plain` leaves the additions out."""
    targets: str = field("credit", "each share learns its agent's part, or (joint) all of them "
                         "the sum [D9]", paper="joint", plain="joint", choices=("credit", "joint"))
    policy_share: float = field(0.5, "share of states where the policy's actions are perturbed, "
                                "not those done [D8]", paper=0.0, plain=0.0, least=0, most=1)
    reuse: int = field(4, "steps that learn from a state's perturbations [D1]", paper=1, least=1)
    expert_episodes: int = field(96, "that its policy plays first [D8]; priors an eighth "
                                 "a round, a sixth to choose [D9]", paper=0, plain=0, least=0)
    played_share: float = field(0.5, "share of states that are from these episodes [D8]",
                                paper=0.0, plain=0.0, least=0, most=1)
    priors: bool = field(True, "each agent learns a prior of its own behind Algorithm 1 [D9]",
                         paper=False, plain=False)


# how a student with priors plans, where no flag says otherwise and no search was chosen
STUDENT_PLANNING = {"prior": "own", "max_std": 0.15, "samples": 16, "iterations": 1,
                    "output": "mean"}
ALONE = {"prior": "own", "iterations": 0}  # of a PlannerConfig: priors, or a policy, act
SEARCH = [f.name for f in dataclasses.fields(PlannerConfig)  # what a student's file says of it
          if f.name not in ("horizon", "discount", "speed", "action_repeat")]
CHOSEN = "max_std", "samples", "iterations"  # by playing, of: none, a narrow search, a wide one
SEARCHES = {"iterations": 0}, {}, {"max_std": 1.0, "samples": 32, "iterations": 3}


def student_planning(config):
    """Settings of a PlannerConfig that students distilled with this config plan with."""
    return STUDENT_PLANNING if config.priors else {}


def agent_order(sizes):
    """An index that takes a robot's action dimensions to the order of a ModelConfig's agents."""
    return [*map(int, sizes.groups.replace("/", ",").split(","))] if sizes.groups else slice(None)


def policy_plan(expert, obs, steps, sizes):
    """What an expert's policy would do from obs (O, B) on, rolled out in its model: the part of
    each agent of a ModelConfig, (N, L, d, B)."""
    actions = policy_rollout(expert, expert.encode(obs), [F32(0)] * steps)[:, 0, agent_order(sizes)]
    return actions.reshape(steps, sizes.num_agents, -1, obs.shape[1]).swapaxes(0, 1)


def around_policy(expert, obs, actions, share, rng):
    """Actions (L, A, B) to perturb in states obs (O, B): for a share of these what the expert's
    policy would do, rolled out in its model, for the others the given ones [D8]."""
    chosen = rng.random(obs.shape[1]) < share
    if chosen.any():
        actions = actions.copy()
        actions[:, :, chosen] = policy_plan(expert, obs[:, chosen], len(actions), expert.config)[0]
    return actions


def credit(expert, tapes, actions, predicted, sizes):
    """Each agent's part of what perturbing actions does to the expert's predictions.

    Copy 0 is unperturbed. Along the line from its actions to copy k's a prediction y changes by the
    integral of its gradient g, which is a sum over agents. By the trapezoidal rule, agent i's is

        part^i(y_h)_k = sum_{j <= h} (a_j^i,k - a_j^i,0) . (g_j^i,k + g_j^i,0) / 2,  g_j = dy_h/da_j

    What these leave of y_h,k - y_h,0 is shared evenly, so that the parts add up to it.

    expert: of one agent; tapes: of `unroll` and `run_heads` for its actions (L, A, B, K);
    predicted: three (L, B, K); sizes: the agents' ModelConfig. Returns the reward's parts
    (N, L, B, K) and, for each Q, those of both Q's mean, by which plans are ranked."""
    (L, A, B, K), m = actions.shape, expert.config.latent_dim
    half = np.full((1, 1, L * B * K), 0.5, actions.dtype)
    d_reward, *d_q = (expert.backward(name, tapes[name], half, None) for name in HEADS)
    dx = np.concatenate([2 * d_reward, sum(d_q)]).reshape(2, m + A, L, B * K)
    way = (actions - actions[..., :1]) / 2
    parts, d = np.zeros((L, 2, A, B, K), actions.dtype), dx[:0, :, 0]  # d: empty
    for j in reversed(range(L)):
        if j < L - 1:  # of outputs at h > j, through s_j+1: each on the axis that agents have
            d = expert.backward("_dynamics", tapes[f"_dynamics {j}"], d[:, :m], None)
        d = np.concatenate([dx[:, :, j], d])  # by (s_j, a_j), of both outputs at h = j, j + 1, ...
        g = d[:, m:].reshape(L - j, 2, A, B, K)
        parts[j:] += way[j] * (g + g[..., :1])
    parts = parts[:, :, agent_order(sizes)].reshape(L, 2, sizes.num_agents, -1, B, K).sum(3)
    y = np.stack([predicted[0], (predicted[1] + predicted[2]) / 2], 1)
    parts += (y - y[..., :1] - parts.sum(2))[:, :, None] / sizes.num_agents
    reward, q = parts.transpose(1, 2, 0, 3, 4)
    return [reward, q, q]


def prior_loss(student, x, targets, lam, grads=None):
    """How far the agents' priors are from what they are taught [D9]; adds gradients to `grads`.

        mean over B of sum_h lambda^h |P_h^i(e^i) - target_h^i|^2, summed over the agents i

    x (1, F, B): what encoders read; e: its encoding for the priors; targets (N, L, d, B)."""
    tapes, (_, L, _, B) = ([], []), targets.shape
    e = student.encode_features(x, tapes[0], "_prior_encoder")                 # (N, m, B)
    y = np.tanh(student.forward("_prior", e, tapes[1]))                       # (N, L * d, B)
    error = y.reshape(targets.shape) - targets
    weights = (lam ** np.arange(L) / B).astype(error.dtype)[:, None, None]
    if grads is not None:
        dy = (2 * weights * error).reshape(y.shape)
        de = student.backward("_prior", tapes[1], tanh_backward(dy, y), grads)
        student.encode_backward(de, tapes[0], grads, "_prior_encoder")
    return float((weights * error ** 2).sum())


def taught_batch(expert, student, obs, actions, config, rng):
    """`perturbed_batch` for the config's `targets`: if these are "credit", each agent's part of the
    expert's predictions, and copy 0 is what `actions` say. Perturbed actions (L, A, B, K) are in
    the order of the student's agents."""
    perturbed, z, tapes = perturbed_actions(actions, config, rng), expert.encode(obs), None
    if config.targets == "credit":
        perturbed[..., :1], tapes = actions[..., :1], defaultdict(list)
    targets = predict(expert, z, perturbed, tapes)
    if config.targets == "credit":
        targets = credit(expert, tapes, perturbed, targets, student.config)
    return student.read(obs), perturbed[:, agent_order(student.config)], targets


# ==== 8. The same, in less time =======================================================

def optimizer_state(adam):
    """Everything of an Adam that a resumed run needs."""
    return {"weights": adam.vector, "adam_m": adam.m, "adam_v": adam.v, "step": np.int64(adam.t)}


def load_optimizer(adam, state):
    """Go on from an `optimizer_state`."""
    adam.vector[:], adam.m[:], adam.v[:] = (state[k] for k in ("weights", "adam_m", "adam_v"))
    adam.t = int(state["step"])


@functools.cache
def _thread_pools():
    from threadpoolctl import ThreadpoolController
    return ThreadpoolController()


@functools.cache
def keep_memory():
    """Free a large array, once: glibc then keeps smaller ones, whose page faults took 0.4 of a
    plan's time. What plans or learns calls it first."""
    np.empty(1 << 22, F32)


@contextlib.contextmanager
def one_thread():
    """Inside, BLAS uses one thread: more would change bits, and cores are for agents. And NumPy,
    however a caller has set it, goes on where an exp underflows."""
    with _thread_pools().limit(limits=1, user_api="blas"), np.errstate(all="ignore"):
        yield


def compact(rows):
    """Rows (M, F) in float16; float32 where that moves a feature by above 1% of its deviation."""
    with np.errstate(all="ignore"):  # what is too large is infinite
        rows = np.asarray(rows, F32)
        half = rows.astype(np.float16)
        moved, apart = ((x - x[:1]).std(0, dtype=float) for x in (half - rows, rows))
    return half if (moved <= 0.01 * apart).all() else rows


def thread_pool(threads):
    """Threads that go on where NumPy, however a caller has set it, would raise."""
    return ThreadPoolExecutor(threads, "", lambda: np.seterr(all="ignore"))


class Halves:
    """A batch's two halves, each learned by one of two threads, into a gradient of its own."""

    def __init__(self, optimizer, threads):
        self.optimizer, self.threads = optimizer, threads
        self.gradients = [flatten(optimizer.params) for _ in range(2)]

    def learn(self, size, loss):
        """The optimizer's gradient of the mean of loss(part, grads) over `size`; that mean."""
        def fill(gradient, part):
            (vector, grads), fraction = gradient, (part.stop - part.start) / size
            vector[:] = 0
            losses = loss(part, grads)
            vector *= vector.dtype.type(fraction)
            return fraction * np.array(losses)

        parts = slice(0, size // 2), slice(size // 2, size)
        losses = sum(self.threads.map(fill, self.gradients, parts))
        np.add(*(vector for vector, _ in self.gradients), out=self.optimizer.gradient)
        return losses


POOL, PART = 4096, 32  # states that the expert predicts at once, and a thread's part of them
EXPERT_NOISE = 0.6  # largest deviation of the noise in episodes that its policy plays [D8]


class Distiller:
    """Algorithm 1: one `step` after the other, reproducible from the seed, and from `state`.

    The expert is frozen: what it predicts for a pool of states and their perturbed actions is
    computed once and learned from `reuse` times; by up to four threads, which change no bit.
    num_agents: N, or `groups`; sizes: replace `student_config`'s. UserError if expert, replay and
    config don't fit. A subclass may have its own `create`, `loss`, `perturb` and `ranks`."""

    create, loss, perturb = map(staticmethod, (new_student, distill_loss, taught_batch))

    def __init__(self, expert, replay, config, num_agents=None, seed=0, **sizes):
        keep_memory()
        theirs = expert.config
        self.train_starts, self.held_out_starts = replay.starts(config.horizon + 1, config.held_out,
                                                                count(seed, "seed"))
        need((replay.dim_obs, replay.dim_action) == (theirs.dim_obs, theirs.dim_action),
             f"{replay.path}: holds (dim O, dim A) = ({replay.dim_obs}, {replay.dim_action}), the "
             f"expert expects ({theirs.dim_obs}, {theirs.dim_action}); pass its own task's replay")
        need(not theirs.expert_latent_dim, "an expert has an encoder of its own; this is a student")
        self.expert, self.replay, self.config, self.seed = expert, replay, config, seed
        need(expert.has_policy or not (config.policy_share or config.expert_episodes or
                                       config.priors), "the expert has no policy to learn from; "
             "pass --policy-share 0 --expert-episodes 0 --no-priors")
        self.played = np.zeros((0, replay.dim_obs + replay.dim_action), np.float16)
        self.lengths = np.zeros(0, np.int64)
        if isinstance(num_agents, str):
            sizes["groups"], num_agents = num_agents or ",", num_agents.count("/") + 1
        needed = config.steps * config.batch_size // config.reuse
        self.pool_size = max(config.batch_size, min(POOL, needed))
        shared = dataclasses.replace(theirs, dim_action=sizes.get("dim_action", theirs.dim_action))
        prior_steps = (config.horizon + 1) * config.priors
        sizes = dataclasses.replace(student_config(shared, num_agents, config.encoder_input,
                                                   prior_steps), **sizes)
        with one_thread():
            self.optimizer, self.student = self.create(expert, sizes, seed)
        self._number = None
        self._threads = thread_pool(min(4, cores()))
        self._halves = Halves(self.optimizer, self._threads)

    def draw(self, number, part, size):
        """Lines 4 and 6 (expert), `size` states, part `part` of a pool; as `perturb` returns."""
        rng, L = stream(self.seed, f"pool {number}", part), self.config.horizon + 1
        obs, actions = self.replay.sequences(rng.choice(self.train_starts, size), L)
        is_played = len(self.played) and rng.random(size) < self.config.played_share
        if n := np.sum(is_played):
            episode = rng.integers(len(self.lengths), size=n)
            t = rng.integers(self.lengths[episode] - L + 1) + np.arange(L)[:, None]
            rows = (np.cumsum(self.lengths) - self.lengths)[episode] + t
            seen, done = np.split(self.played[rows].swapaxes(1, 2).astype(F32),
                                  [self.replay.dim_obs], 1)
            obs[:, is_played], actions[:, :, is_played] = seen[0], done  # seen (L, O, n)
        if self.config.policy_share:
            actions = around_policy(self.expert, obs, actions, self.config.policy_share, rng)
        return self.perturb(self.expert, self.student, obs, actions[..., None], self.config, rng)

    def batch(self, t):
        """Step t's part of its pool, which is gone through `reuse` times, in another order each:
        features, perturbed actions and targets."""
        size, reuse = self.config.batch_size, self.config.reuse
        number, step = divmod(t, reuse * self.pool_size // size)  # which pool, which of its steps
        if number != self._number:
            lengths = np.diff(np.r_[0:self.pool_size:PART, self.pool_size])
            features, actions, targets = zip(*self._threads.map(
                self.draw, [number] * len(lengths), range(len(lengths)), lengths))
            self._pool = (np.concatenate(features, 2), np.concatenate(actions, 2),
                          [np.concatenate(target, -2) for target in zip(*targets)])
            rng, self._number = stream(self.seed, "order", number), number
            self._order = np.concatenate([rng.permutation(self.pool_size) for _ in range(reuse)])
        chosen = self._order[step * size:(step + 1) * size]
        features, actions, targets = self._pool
        return features[..., chosen], actions[:, :, chosen], [x[..., chosen, :] for x in targets]

    def step(self):
        """Lines 4 to 6 once. Returns loss, mean reward divergence, mean value divergence."""
        def loss(part, grads):
            return self.loss(self.student, features[..., part], actions[:, :, part],
                             [x[..., part, :] for x in targets], self.config, grads)

        with one_thread():
            features, actions, targets = self.batch(self.t)
            losses = self._halves.learn(self.config.batch_size, loss)
            self.optimizer.step(learning_rate(self.config, self.t), self.config.grad_clip)
        return tuple(losses.tolist())

    def in_parts(self, function, obs):
        """What a function makes of many observations (O, M), by the threads: (..., M)."""
        parts = np.array_split(obs, -(-obs.shape[1] // 512), 1)
        with one_thread():
            return np.concatenate([*self._threads.map(function, parts)], -1)

    def run(self):
        """Algorithm 1 from here to its end; yields each step's losses. UserError if they diverge.
        `add` what the expert's policy plays first."""
        need(len(self.played) or not self.config.expert_episodes, "`add` the `expert_episodes`, or "
             "set expert_episodes=0")
        while self.t < self.config.steps:
            losses = self.step()
            check_finite("loss is", losses, self.t, self.config.lr)
            yield losses

    @property
    def t(self):
        """Steps made so far."""
        return self.optimizer.t

    def add(self, observation, action):
        """Let episodes (E, T, O), (E, T, A), as `play` returns them, join `played`, the rows
        (all, O + A) of episodes of `lengths` [D8]; those of H decisions or fewer are left out."""
        episodes, L = np.concatenate([observation, action], 2), self.config.horizon + 1
        lived = np.isfinite(episodes).all(2)
        long = lived.sum(1) >= L
        need(long.any(), f"played episodes: none has {L} decisions, one more than the horizon")
        self.played = np.concatenate([self.played, compact(episodes[long][lived[long]])])
        self.lengths = np.concatenate([self.lengths, lived[long].sum(1)])
        self._number = None  # its pool is drawn again, with them

    def state(self):
        """Everything that a resumed run needs; its arrays, which the next `step` overwrites."""
        return {**optimizer_state(self.optimizer), "played": self.played, "lengths": self.lengths}

    def load(self, state):
        """Go on from a `state`."""
        load_optimizer(self.optimizer, state)
        played = state["played"].reshape(-1, self.played.shape[1])  # or it is another robot's
        self.played, self.lengths, self._number = played, state["lengths"], None

    def ranks(self, states, discount=0.99):
        """Spearman's correlation of student and expert over 32 perturbed action sequences, mean
        over so many held-out states: of the global Q at each step h, and of G (Equation 2), by
        which planning ranks, for each H; two (L,). 1 is the same order, as for a loss of 0."""
        rng, student = stream(self.seed, "rank correlation"), self.student
        config = dataclasses.replace(self.config, noise_samples=32, targets="joint")
        rows = rng.choice(self.held_out_starts, states)
        obs, actions = self.replay.sequences(rows, config.horizon + 1)
        with one_thread():
            x, actions, expert = self.perturb(self.expert, student, obs, actions[..., None], config,
                                              rng)
            found = predict(student, student.encode_features(x), actions)
        G = (horizon_returns(*out, discount) for out in (expert, found))
        return (spearman(expert[1] + expert[2], found[1] + found[2]).mean(-1),
                spearman(*G).mean(-1))

    def close(self):
        """Stop the threads."""
        self._threads.shutdown(wait=True, cancel_futures=True)


class PlainDistiller(Distiller):
    """Part I's `distill` in a Distiller's place, for `distill --plain`."""

    def __init__(self, expert, replay, config, num_agents=None, seed=0, **sizes):
        need((config.targets, config.policy_share, config.expert_episodes, config.reuse,
              config.priors, isinstance(num_agents, str), sizes) == (
                  "joint", 0, 0, 1, False, False, {}),
             "--plain goes without --targets, --policy-share, --expert-episodes, --reuse, --priors "
             "and --mlp-dim, and with --num-agents for --agents")
        super().__init__(expert, replay, config, num_agents, seed)
        self._plain = distill(expert, replay, config, num_agents, seed,
                              (self.optimizer, self.student))

    def step(self):
        """The loop's next."""
        with one_thread():
            return next(self._plain)[1]


def spearman(x, y):
    """Spearman's correlation over the last axis, where K values are ranked: (..., K) -> (...)."""
    from scipy.stats import rankdata
    x, y = (rankdata(v, axis=-1) - (v.shape[-1] + 1) / 2 for v in (x, y))
    norms = np.linalg.norm(x, axis=-1) * np.linalg.norm(y, axis=-1)
    return (x * y).sum(-1) / np.maximum(norms, 1e-12)


def horizon_returns(rewards, q1, q2, discount):
    """Equation 2 for H = 0, 1, ... at once, (L, B, K), from `predict`'s global rewards and Q."""
    weights = (discount ** np.arange(len(rewards)))[:, None, None]
    rewarded = weights * rewards
    return np.cumsum(rewarded, 0) - rewarded + weights * (q1 + q2) / 2


def homogeneous(params, *layers):
    """Layers of one size as [[W, b], [0, 1]], on x that ends in 1: (N, layers, out + 1, in + 1)."""
    W, b = (np.stack([params[f"{layer}.{part}"] for layer in layers], 1)
            for part in ("weight", "bias"))
    return np.block([[W, b], [np.zeros_like(W[..., :1, :]), np.ones_like(b[..., :1, :])]])


class Returns:
    """`h_step_return` in little more than the time of its matrix products.

    Layers are homogeneous matrices: a bias costs no pass over the activations, and the row of
    ones goes through ELU unchanged. Networks with the same input share its first product
    (dynamics with reward; both Q). The first latent's part of it is computed once a plan; later
    ones are linear in a hidden layer, which is read in their place unless they are narrower."""

    def __init__(self, model):
        self.sizes, p, m = model.config, model.params, model.config.latent_dim  # w: hidden width
        first = homogeneous(p, "_dynamics.0", "_reward.0"), self._fold_norm(p)
        self.first = [W.reshape(len(W), -1, W.shape[3]) for W in first]  # (N, 2w + 2, m + d + 1)
        self.second = [homogeneous(p, "_dynamics.2", "_reward.2"),      # (N, 2, w + 1, w + 1)
                       homogeneous(p, "_Q1.3", "_Q2.3")]
        self.to_latent, self.to_reward, *to_q = (
            np.concatenate([p[f"{layer}.weight"], p[f"{layer}.bias"]], 2)
            for layer in ("_dynamics.4", "_reward.4", "_Q1.5", "_Q2.5"))
        self.to_q = np.concatenate(to_q, 2) / 2                         # (N, 1, 2w + 2)
        skips = self.skips_latent = 3 * m > 2 * self.sizes.mlp_dim  # for 2 w^2 products, not 3 m w
        self.later = [np.concatenate([W[..., :m] @ self.to_latent, W[..., m:]], 2) if skips else W
                      for W in self.first]                              # (N, 2w + 2, w + d + 2)

    def _fold_norm(self, p):
        """First layers of both Q, after which LayerNorm is y / sqrt(spread @ y^2 + eps) + shift.

        Centred rows give centred outputs, and a row times its gain gives its output times it;
        `spread` takes the gains out of the variance again. The row of ones becomes zeros here,
        and 20 by `shift`, which tanh takes to 1."""
        W = homogeneous(p, "_Q1.0", "_Q2.0")
        W[:, :, -1] = 0
        W[:, :, :-1] -= W[:, :, :-1].mean(2, keepdims=True)
        gain, self.shift = np.ones_like(W[..., :1]), np.full_like(W[..., :1], 20)
        for i, name in enumerate(("_Q1", "_Q2")):
            gain[:, i, :-1] = p[f"{name}.1.weight"]
            self.shift[:, i, :-1] = p[f"{name}.1.bias"]
        gain[np.abs(gain) < 1e-12] = 1e-12
        W *= gain
        self.spread = (1 / (self.sizes.mlp_dim * gain ** 2)).swapaxes(2, 3)
        return W

    def start(self, z, config):
        """Plan from the latent z (N, m, 1): at h = 0 the first products read (a, 1) only."""
        self.horizon, self.discount = config.horizon, config.discount
        m = self.sizes.latent_dim
        self.at_start = [np.concatenate([W[..., m:-1], W[..., -1:] + W[..., :m] @ z], 2)
                         for W in self.first]                           # (N, 2w + 2, d + 1)
        return self

    def __call__(self, actions):
        """actions (N, L, d, S) -> G (N, S), in blocks of samples that fit the cache."""
        blocks = np.array_split(actions, max(1, round(actions.shape[-1] / 256)), axis=-1)
        return np.concatenate([self._block(block) for block in blocks], 1)

    def _block(self, actions):
        """Equation 2 for a block of samples."""
        half, d, G = self.sizes.mlp_dim + 1, actions.shape[2], F32(0)
        x = np.ones((len(actions), self.later[0].shape[2], actions.shape[-1]), F32)  # (z, a, 1)
        for h in range(self.horizon + 1):
            x[:, -d - 1:-1] = actions[:, h]
            if h < self.horizon:
                y = self._hidden(0, h, x)
                out = self.to_reward @ y[:, half:]
                x[:, :-d - 1] = y[:, :half] if self.skips_latent else self.to_latent @ y[:, :half]
            else:
                out = self.to_q @ self._hidden(1, h, x)
            G = G + F32(self.discount ** h) * out[:, 0]
        return G

    def _hidden(self, pair, h, x):
        """Both hidden layers of a pair of networks (0: dynamics and reward, 1: the two Q)."""
        first = (self.later if h else self.at_start)[pair]
        y = first @ x[:, -first.shape[2]:]
        shape, y = y.shape, y.reshape(len(y), 2, -1, y.shape[2])        # (N, 2, w + 1, S)
        if pair:  # tanh(LayerNorm(y))
            y /= np.sqrt(self.spread @ (y * y) + F32(NORM_EPS))         # (N, 2, 1, S)
            y += self.shift
        y = np.tanh(y, out=y) if pair else elu(y)
        return elu((self.second[pair] @ y).reshape(shape))


class FastPlanner(AgentPlanner):
    """`AgentPlanner` with `Returns`, unless its config says plain, or it can't know a client's
    networks. UserError: no finite G."""

    def __init__(self, model, config):
        keep_memory()
        super().__init__(model, config)
        plain = config.speed == "plain" or type(model).forward is not WorldModel.forward
        self.fast = None if plain else Returns(model)

    def returns_from(self, z):
        return self.fast.start(z, self.config) if self.fast else super().returns_from(z)

    def plan(self, latents):
        actions = super().plan(latents)
        need(np.isfinite(actions).all() and np.isfinite(self.mean).all(), "planning: no action "
             "sequence has a finite return; weights or observation are far out of range")
        return actions


# ==== 9. The same, in processes: workers plan for a part of the agents each ============

def some_agents(model, i, j):
    """The model of agents i..j-1 alone, without what all share; the whole if it's all."""
    sizes = model.config
    if j - i == sizes.num_agents:
        return model
    config = dataclasses.replace(sizes, num_agents=j - i, groups="", expert_latent_dim=0,
                                 dim_action=(j - i) * sizes.agent_actions)
    return WorldModel(config, {k: np.ascontiguousarray(v[i:j]) for k, v in model.params.items()
                               if k.startswith(("_dynamics", "_reward", "_Q", "_prior."))})


def split_agents(agents, workers):
    """The agents, a slice, of this process and of each worker beside it. UserError: too many."""
    count(workers, "workers (an agent is left to this process)", agents - 1)
    cuts = np.linspace(0, agents, workers + 2).round().astype(int)
    return [slice(i, j) for i, j in zip(cuts, cuts[1:])]


def cores():
    """Cores that this process may use, where the system tells (taskset, cpusets)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def checked(values, shape, what, dtype=F32):
    """A finite copy, of this shape, of values: a robot may use its array again. UserError: none."""
    try:
        with np.errstate(all="ignore"):  # what is too large is infinite
            found = np.array(values, dtype)
    except (TypeError, ValueError, RuntimeError):  # the last is PyTorch's
        raise UserError(f"{what}: expected numbers of shape {shape}, found {shown(values)}, of "
                        "which NumPy makes no array") from None
    need(found.shape == shape, f"{what}: expected shape {shape}, found {found.shape}")
    need(np.isfinite(found).all(), f"{what}: holds values that are not finite")
    return found


class Planner(contextlib.ExitStack):  # whose `close` ends the workers
    """Observation in, action out; a plan starts from priors, or from an episode's last mean.

        with Planner(model, PlannerConfig(), seed=0, workers=1) as planner:
            action = planner.act(obs)      # (O,) -> (A,) in [-1, 1]

    workers: processes beside this one, each for a part of the agents (0: all here). They import the
    file that makes the planner, which needs `if __name__ == "__main__":`. Every agent owns its
    random stream and one BLAS thread computes each product, so the plan is the same, bit for bit,
    for every number of workers. Raises UserError for too many, WorkerError when one has died. Some
    weights are copied: make a new planner when they have changed."""

    def __init__(self, model, config=PlannerConfig(), seed=0, workers=0):
        self.model, self.config, sequence = model, config, np.random.SeedSequence(seed)
        need(config.prior == "last" or model.has_policy or model.config.prior_steps,
             "the model has no prior for plans to begin from (an expert: no policy); pass "
             "--plan-prior last (evaluate: --prior last)")
        self._parts = split_agents(model.config.num_agents, workers)
        own, *others = ((some_agents(model, part.start, part.stop), config) for part in self._parts)
        self.own = FastPlanner(*own)
        super().__init__()
        self._workers = self.enter_context(Workers(_planning_worker, workers, "planning worker"))
        self._workers.send_all(others)
        self._workers.receive_all()  # they are ready: no decision waits for their start
        self.reset(sequence.entropy)  # of None: the system's own

    def reset(self, seed=None):
        """Start an episode: forget the last plan's mean; a seed also starts the streams anew."""
        agents = self.model.config.num_agents
        seeds = [] if seed is None else np.random.SeedSequence(seed).spawn(agents)
        self._workers.send_all(seeds[part] for part in self._parts[1:])
        self.own.reset(seeds[self._parts[0]])

    def act(self, obs):
        """obs (O,) -> action (A,), float32 in [-1, 1]: the first of `plan`."""
        action = np.empty(self.model.config.dim_action, F32)
        action[agent_order(self.model.config)] = self.plan(obs)[:, 0].reshape(-1)
        return action

    def plan(self, obs):
        """obs (O,) -> actions (N, L, d), of one step without a search. UserError: other shape, NaN,
        no finite G."""
        obs = checked(obs, (self.model.config.dim_obs,), "observation")[:, None]
        with one_thread():
            latents = self.model.latents(obs, self.config.iterations > 0)
            own, *others = (latents[part] for part in self._parts)
            try:
                self._workers.send_all(others)
                return np.concatenate([self.own.plan(own), *self._workers.receive_all()])
            except BaseException:  # answers left unread would be the next decision's
                self.close()
                raise


def _planning_worker(connection):
    """Plans for its part of the agents: latents in, plans out; a list is `reset`'s seeds."""
    planner = FastPlanner(*connection.recv())
    connection.send("ready")
    while True:
        message = connection.recv()
        if isinstance(message, list):
            planner.reset(message)
        else:
            connection.send(planner.plan(message))


class WorkerError(UserError):
    """A worker process died."""


class Workers(contextlib.AbstractContextManager):
    """`count` processes that each run target(connection).

    Spawned, since fork is unsafe once BLAS has threads; with one BLAS thread each; deaf to
    Ctrl-C, which ends the parent, whose closed pipes end them. What they work on is sent."""

    def __init__(self, target, count, name="worker"):
        context, self._name, self._members = multiprocessing.get_context("spawn"), name, []
        if getattr(main := sys.modules["__main__"], "__file__", "") == "<stdin>":
            del main.__file__  # or children look for it
        try:
            for _ in range(count):
                here, there = context.Pipe()
                process = context.Process(target=_run_worker, args=(target, there), daemon=True)
                process.start()
                there.close()
                self._members.append((process, here))
        except (AssertionError, AttributeError, pickle.PicklingError, OSError) as error:
            self.close()
            raise UserError(f"no process can be started ({error}), as in a pool's or at a limit "
                            "(ulimit -a): pass workers=0 (--workers 0)") from None

    def __len__(self):
        return len(self._members)

    def send_all(self, messages):
        """Send one of the messages to each worker, in their order."""
        for i, ((_, connection), message) in enumerate(zip(self._members, messages)):
            try:  # plain pickle: Connection.send's own takes half of a hand-over's time
                connection.send_bytes(pickle.dumps(message))
            except OSError:  # it has died, or was stopped
                while True:  # past answers left unread, to what it ended with
                    self.receive(i)

    def receive(self, i):
        """The next message of worker i; WorkerError as soon as it has died."""
        process, connection = self._members[i]
        try:
            message = connection.recv()
        except (EOFError, OSError):  # also in the middle of a message
            process.join(1)
            message = WorkerError(f"{self._name} {i} ended with exit code {process.exitcode}; all "
                                  "are stopped, start anew")
        if isinstance(message, Exception):
            self.close()
            raise message
        return message

    def receive_all(self):
        """The next message of every worker, in their order."""
        return [self.receive(i) for i in range(len(self))]

    def close(self):
        """End all processes: closed pipes first, then force."""
        for _, connection in self._members:
            connection.close()
        for process, _ in self._members:
            process.join(0.2)
            process.kill()  # does nothing to one that has ended
            process.join()

    def __exit__(self, *_):
        self.close()


def _run_worker(target, connection):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(EOFError, ConnectionError), one_thread():  # the parent is gone
        try:
            target(connection)
        except (UserError, MemoryError, OSError) as error:
            connection.send(UserError(str(error) or "not enough memory"))


# ==== 10. Environments (appendix B.1) =================================================

# dm_control's domain and task: (dim O, dim A) of Figure 3
TASKS = {"reacher-easy": (8, 3), "reacher-hard": (8, 3), "hopper-hop": (15, 4),
         "fish-swim": (24, 5), "cheetah-run": (17, 6), "walker-walk": (24, 6),
         "walker-run": (24, 6), "quadruped-walk": (78, 12), "quadruped-run": (78, 12),
         "humanoid-stand": (67, 21), "humanoid-walk": (67, 21)}
TASK_NAMES = f"{', '.join(TASKS)}, another DOMAIN-TASK of dm_control's suite, Gymnasium's gym:ID"
REACHER_TARGET = {"easy": 0.05, "hard": 0.015}  # radius of the target, metres
REACHER = DATA / "reacher.xml"  # three links; dm_control's has two


def import_dm_control():
    """dm_control's suite. Nothing else here imports MuJoCo. Where dm_control is to draw, MUJOCO_GL
    has to be set before."""
    backend = os.environ.get("MUJOCO_GL")
    try:
        import mujoco  # noqa: F401  (whose own renderer is the caller's)
        os.environ.setdefault("MUJOCO_GL", "disable")  # states only need no display
        from dm_control import suite
        suite.reacher.Physics.from_xml_string("<mujoco/>")  # other versions' import, and fail here
    except Exception as error:
        raise UserError(f"dm_control does not import ({error}); it needs mujoco==3.17.0 beside "
                        f"dm-control==1.0.50, and MUJOCO_GL unset or one of egl, osmesa, disable "
                        f"(it is {backend!r})") from error
    finally:
        if backend is None:
            os.environ.pop("MUJOCO_GL", None)
    return suite


def is_gym(task):
    """Whether a task is one of Gymnasium's, gym:ID."""
    return str(task).startswith("gym:")


def make_robot(task, action_repeat=None):
    """The robot of a task: dm_control's, an `Environment`, or data/gym_robot.py's of gym:ID."""
    repeat = () if action_repeat is None else (action_repeat,)
    if not is_gym(task):
        return Environment(task, *repeat)
    if str(DATA) not in sys.path:
        sys.path.append(str(DATA))
    with optional("gymnasium, and a clone of the repository", "gym"):
        from gym_robot import GymRobot
    try:
        return GymRobot(task.removeprefix("gym:"), *repeat)
    except ValueError as error:
        raise UserError(f"{task}: {error}") from None


class Environment:
    """One of the paper's 11 tasks, or another one of dm_control's suite.

    Observations are dm_control's dict, concatenated in its own order, float32 (dim O,).
    Actions (dim A,) in [-1, 1] are scaled to the action spec and applied `action_repeat` times.
    Raises UserError for an unknown task or an installation that dm_control can't work with."""

    def __init__(self, task, action_repeat=ACTION_REPEAT):
        self.action_repeat, self.episode_steps = action_repeat, episode_steps(action_repeat)
        suite = import_dm_control()
        domain, _, name = str(task).partition("-")
        if task in TASKS and domain == "reacher":
            self.env = suite.reacher.control.Environment(
                suite.reacher.Physics.from_xml_string(REACHER.read_text("ascii")),
                suite.reacher.Reacher(REACHER_TARGET[name], random=0), time_limit=20)
        else:
            known = [*TASKS, *map("-".join, suite.ALL_TASKS)]
            near = difflib.get_close_matches(str(task), known, 1, 0)[0]
            need(task in known, f"unknown task {task!r}; did you mean {near!r}? Known tasks: "
                 f"{TASK_NAMES}")
            try:
                self.env = suite.load(domain, name, task_kwargs={"random": 0})
                self.env.reset()
            except RuntimeError as error:
                raise UserError(f"{task}: dm_control can't play it here ({error}); MUJOCO_GL=egl "
                                "or osmesa may help") from None
            steps = self.env._step_limit  # it has no public name
            need(task in TASKS or steps == CONTROL_STEPS, f"{task}: has {steps} control steps; "
                 f"expected {CONTROL_STEPS}")
        self.dim_obs = sum(int(np.prod(s.shape)) for s in self.env.observation_spec().values())
        spec = self.env.action_spec()
        self.dim_action = spec.shape[0]
        self._low, self._scale = spec.minimum, (spec.maximum - spec.minimum) / 2
        self.close = self.env.close

    @staticmethod
    def _observation(timestep):
        return np.concatenate([np.ravel(v) for v in timestep.observation.values()]).astype(F32)

    def reset(self, seed):
        """Start the episode that the integer `seed` stands for; returns (dim O,)."""
        self.env.task.random.seed(seed if seed is None else count(seed, "seed", 2 ** 32 - 1))
        return self._observation(self.env.reset())

    def step(self, action):
        """Apply action (dim A,); returns next observation (dim O,) and the sum of the rewards.
        UserError: the action has another shape or isn't finite, or the episode is over."""
        action = checked(action, (self.dim_action,), "action", np.float64)
        control, reward = self._low + self._scale * (action + 1), 0.0
        for _ in range(self.action_repeat):
            timestep = self.env.step(control)
            need(timestep.reward is not None, f"the episode is over ({self.episode_steps} "
                 "decisions), or none has begun; call reset(seed)")
            reward += timestep.reward
        return self._observation(timestep), reward


def robot_step(robot, action, sizes, t):
    """Decision t of an episode: next observation (O,), reward, whether it is over, and whether by
    its state, so that later value is zero (a robot's third value, if any; a fourth: by the time).
    dm_control's reward of None: the next episode has begun. UserError: what isn't finite."""
    obs, reward, *ends = robot.step(np.array(action))
    need(len(ends) < 3 and all(end in (False, True) for end in ends), f"decision {t}: expected "
         "(observation, reward), or also, True or False, whether the state ended the episode, and "
         f"whether the time did; found {shown((obs, reward, *ends))}")
    if reward is None and t:
        return None, None, True, False
    reward = checked(np.squeeze(reward), (), f"decision {t}: reward", float).item()
    obs = checked(obs, (sizes.dim_obs,), f"decision {t}: observation")
    return obs, reward, any(ends), any(ends[:1])


@functools.cache
def lookup_task(task):
    """(dim O, dim A) of a task; UserError with the nearest name otherwise."""
    if task in TASKS:
        return TASKS[task]
    with contextlib.closing(make_robot(task)) as robot:  # what it holds may be needed to play
        return robot.dim_obs, robot.dim_action


def episode_seeds(seed, episodes):
    """Seeds of an evaluation's episodes: independent, whatever their number."""
    streams = np.random.SeedSequence(seed).spawn(count(episodes, "episodes", 10 ** 5))
    return [int(s.generate_state(1)[0]) for s in streams]


def training_seeds(seed, use, first, count):
    """Seeds of the episodes first, first + 1, ... that a run learns from, apart for each use."""
    return [int(stream(seed, use, i).integers(2 ** 31)) for i in range(first, first + count)]


# ==== 11. Files: weights, replay, records =============================================

FORMAT = "fac-tdmpc-ref 1"


@contextlib.contextmanager
def atomic_file(path, mode="wb", **options):
    """A file that appears under its name, of any length, when it is complete; UserError: can't."""
    temporary = (path := Path(path)).parent / f"{path.name[:40]}{os.urandom(4).hex()}.tmp"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, mode.replace("w", "x"), **options) as file:  # readable as umask says
            yield file
        os.replace(temporary, path)
    except OSError as error:
        raise UserError(f"{path}: can't be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def check_writable(path):
    """UserError now, not after hours of work, if no file of this name can be made there."""
    with contextlib.suppress(EOFError), atomic_file(path):
        Path(path).exists()  # raises where the name is too long
        raise EOFError  # so that none gets that name


@contextlib.contextmanager
def locked(path, folder=True, wait=False):
    """Keep other runs out of a folder, which is made, or of a file; UserError where one is in it,
    or `wait` for its end. The lock ends with the process, however that ends; where the system or
    the disk has none, there is none."""
    if folder:
        Path(path).mkdir(parents=True, exist_ok=True)
        check_writable(Path(path, "..."))
    with contextlib.ExitStack() as stack:
        try:
            import fcntl
            handle = os.open(path, os.O_RDONLY if folder else os.O_RDWR)  # as NFS wants files
            stack.callback(os.close, handle)
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise UserError(f"{path}: another run is writing into it; wait for its end, or choose "
                            "another --out") from None
        except (ImportError, OSError):
            pass
        yield


def write_npz(path, header, arrays, compress=False):
    """Arrays and a JSON header in one .npz."""
    text = np.frombuffer(json.dumps({"format": FORMAT, **header}).encode(), np.uint8)
    with atomic_file(path) as file:
        (np.savez_compressed if compress else np.savez)(file, header=text, **arrays)


def read_npz(path, kinds):
    """(header, arrays) of a file, of one of `kinds`, by `write_npz`; UserError: what is wrong."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: np.asarray(file[key]) for key in file.files}
        header = dict(json.loads(arrays.pop("header").tobytes()))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except Exception as error:  # a damaged file can raise nearly anything
        reason = " ".join(str(error).split()).split(". ")[0]  # NumPy advises to load it unsafely
        raise UserError(f"{path}: not a readable .npz file with a JSON header ({reason}); files "
                        "are made by distill, data/train_expert.py and, of others' checkpoints "
                        "and data, data/import_expert.py") from None
    for key, expected in (("format", (FORMAT,)), ("kind", kinds)):
        need(header.get(key) in expected, f"{path}: header: {key}: expected "
             f"{' or '.join(expected)!r}, found {header.get(key)!r}")
    return header, arrays


def save_model(path, model, header, compress=False):
    """Weights (compress: as float16) under TD-MPC's names, in torch's shapes; N > 1 leads them."""
    arrays = {}
    for key, value in model.params.items():
        need(value.ndim == 3, f"{key}: expected (N, rows, columns), found {value.shape}")
        value = value[..., 0] if key.endswith("bias") or key.split(".")[1] == "1" else value
        value = (value[0] if len(value) == 1 else value).astype("f2" if compress else F32)
        need(np.isfinite(value).all(), f"{path}: {key}: would hold values that are not finite")
        arrays[key] = value
    write_npz(path, {**header, "model": vars(model.config)}, arrays, compress)


def load_model(path, kinds=("expert", "student")):
    """(model, header) of one of these kinds. UserError names file, key, expected and found."""
    header, arrays = read_npz(path, kinds)
    if isinstance(header.get("model"), dict):
        header["model"].pop("expert_mlp_dim", 0)  # earlier versions wrote that there is none
    config = from_dict(ModelConfig, header.get("model"), f"{path}: header: model")
    params, policy = {}, config.num_agents == 1 and "_pi.0.weight" in arrays
    for name, i, kind, shape, _ in layers(config, policy):
        for part, expected in (("weight", shape), ("bias", (*shape[:2], 1))):
            key = f"{name}.{i}.{part}"
            on_disk = expected if kind == "linear" and part == "weight" else expected[:2]
            on_disk = on_disk[1:] if expected[0] == 1 else on_disk
            value = arrays.pop(key, np.zeros(0, object))
            need(value.shape == on_disk and value.dtype in (F32, np.float16),
                 f"{path}: {key}: expected float32 {on_disk}, found {value.dtype} {value.shape}")
            need(np.isfinite(value).all(), f"{path}: {key}: holds values that are not finite")
            params[key] = np.ascontiguousarray(value.reshape(expected), F32)
    need(not arrays, f"{path}: {next(iter(arrays), None)}: unknown entry; expected TD-MPC's "
         f"state-dict names only, _pi's of one agent")
    return WorldModel(config, params), header


def made_for(header, where):
    """What a model's file was trained, or distilled, for, as settings of a PlannerConfig: discount,
    horizon, SEARCH and the header's action repeat, where it names them. Nothing else reads them."""
    found = {}
    for group, names in (("training", ()), ("distill", ()), ("planner", SEARCH)):
        settings = header.get(group) or {}
        need(isinstance(settings, dict), f"{where}: header: {group}: expected settings")
        found.update({name: value for name, value in settings.items()
                      if name in ("discount", "horizon", *names)})
    if "action_repeat" in header or is_gym(header.get("task")):
        found["action_repeat"] = header.get("action_repeat", 1)  # Gymnasium's
    from_dict(PlannerConfig, found, f"{where}: header")
    return found


def check_rows(name, rows, most=None):
    """UserError names the first of rows (M, F) with a value that isn't finite, or above `most`."""
    for i, j in np.argwhere(~(np.abs(rows) <= (most or np.finfo(rows.dtype).max)))[:1]:
        wrong = "outside [-1, 1] (its bounds)" if np.isfinite(rows[i, j]) else "not finite"
        raise UserError(f"{name}: row {i}, column {j}: {rows[i, j]} is {wrong}; drop its episode")


class Replay:
    """The dataset of Algorithm 1 [D6]: transitions in order, episode after episode.

    observation (M, O) and action (M, A) float16 or float32, continues (M,): False in an episode's
    last row, whose action stands for nothing. UserError for anything else, and for a file of
    another action repeat than `repeat`, the expert's, if given."""

    def __init__(self, path, repeat=None):
        self.path = path
        self.header, arrays = read_npz(path, ("replay",))
        for key, rank, kinds in (("observation", 2, "float16, float32"), ("continues", 1, "bool"),
                                 ("action", 2, "float16, float32")):
            value = arrays.get(key, np.zeros(0, object))
            found = f"{value.dtype} {value.shape}" if key in arrays else "nothing"
            need(value.ndim == rank and str(value.dtype) in kinds.split(", ")
                 and len(value) == len(arrays["observation"]), f"{path}: {key}: expected {kinds} "
                 f"of rank {rank}, a row a transition, found {found}")
            if rank == 2:
                check_rows(f"{path}: {key}", value, 1 if key == "action" else None)
        self.observation, self.action = arrays["observation"], arrays["action"]
        self.ends = np.flatnonzero(~arrays["continues"])
        self.dim_obs, self.dim_action = self.observation.shape[1], self.action.shape[1]
        self.transitions = len(self.observation) - len(self.ends)
        need(self.ends[-1:].tolist() == [len(self.observation) - 1],
             f"{path}: continues: expected False in the last row, {len(self.observation) - 1}")
        if repeat:
            found = made_for(self.header, path).get("action_repeat", repeat)
            need(found == repeat, f"{path}: header: action_repeat: expected {repeat}, as the "
                 f"expert was made for, found {found}; pass its own data")

    def starts(self, length, held_out, seed=0):
        """Rows from which `length` actions stay in their episode: (training, held-out) rows.

        Every (1 / held_out)-th episode is held out, early and late ones, which ones by the seed; of
        fewer one, of a single one its end. UserError: too short."""
        begins, ends = np.r_[0, self.ends[:-1] + 1], self.ends
        if len(ends) == 1:  # as two, of which the second is held out
            cut = max(0, ends[0] - max(length, round(held_out * ends[0])))
            begins, ends, seed = [0, cut], [cut, ends[0]], 0
        parts = [np.arange(begin, end - length + 1) for begin, end in zip(begins, ends)]
        rows, episode = np.concatenate(parts), np.repeat(np.arange(len(ends)), [*map(len, parts)])
        for every in range(max(2, round(1 / held_out)), 1, -1):
            held = (episode + 1 - seed) % every == 0
            if 0 < held.sum() < len(rows):
                return rows[~held], rows[held]
        raise UserError(f"{self.path}: expected two episodes of at least {length} actions (horizon "
                        f"+ 1), or one of {2 * length}; give longer ones, or lower the horizon")

    def sequences(self, starts, length):
        """First observations (O, B) and actions (L, A, B), float32, from the rows `starts` on."""
        actions = self.action[starts + np.arange(length)[:, None]]
        return self.observation[starts].T.astype(F32), actions.swapaxes(1, 2).astype(F32)


def checksum(arrays):
    """CRC of the arrays' bytes: tells experts and replays of the same sizes apart."""
    return functools.reduce(lambda crc, a: zlib.crc32(np.ascontiguousarray(a), crc), arrays, 0)


def data_checksums(expert, replay):
    """Of the expert's weights and of the replay's transitions; then the task that it names."""
    return [checksum(expert.params.values()),
            checksum([replay.observation, replay.action, replay.ends]), replay.header.get("task")]


def data_file(task, name):
    """data/experts/TASK/<name>; UserError that says what to do if it isn't there."""
    lookup_task(task)
    path = EXPERTS / task / name
    need(path.exists(), f"{path}: no such file; train an expert with 'python data/train_expert.py "
         f"--task {task}', and give --expert, --replay")
    return path


# ==== 12. Commands ====================================================================

def episodes_of(model, task, config, seeds, environment, noise, teacher, share):
    """Plan through the episode of each seed; yields its decisions, a list of observation (O,),
    action (A,), reward, seconds of planning and, with a teacher, its plan (N * L * d,). The last
    four arguments are `play`'s."""
    if environment is None:
        with contextlib.closing(make_robot(task, config.action_repeat)) as environment:
            yield from episodes_of(model, task, config, seeds, environment, noise, teacher, share)
        return
    planners, sizes = [Planner(model, of) for of in (config, teacher) if of], model.config
    T = getattr(environment, "episode_steps", episode_steps(config.action_repeat))
    for seed in seeds:
        for planner in planners:
            planner.reset(seed)
        obs = checked(environment.reset(seed), (sizes.dim_obs,), "reset: observation")
        rng, decisions = stream(seed, "exploration"), []
        deviation = F32(rng.uniform(0, noise))
        for t in range(max(1, int(share * T))):
            begin = time.perf_counter()
            action = planners[0].act(obs)
            seconds = time.perf_counter() - begin
            taught = [planner.plan(obs).ravel() for planner in planners[1:]]
            if noise:
                action = action + deviation * rng.standard_normal(action.shape, F32)
                action = np.clip(action, -1, 1)
            before, (obs, reward, over, _) = obs, robot_step(environment, action, sizes, t)
            if obs is not None:
                decisions.append((before, action, reward, seconds, *taught))
            if over:
                break
        yield decisions


def _playing_worker(connection):
    """Sends the episodes of each message, one after the other."""
    while True:
        for decisions in episodes_of(*connection.recv()):
            connection.send(decisions)


def players(workers, episodes):
    """Processes that `play` [one for each core], no more than there are episodes."""
    return Workers(_playing_worker, min(
        episodes, cores() if workers is None else count(workers, "workers")), "evaluation worker")


def play(model, task, config, seeds, workers=None, label="playing", environment=None, noise=0.0,
         teacher=None, share=1.0):
    """Plan through the episodes of `seeds`: observations (E, T, O), actions (E, T, A), rewards
    (E, T), seconds of planning (E, T); NaN past the end of one shorter than the longest, rewards 0.

    workers: processes that share the episodes [one for each core], or `players`; 0, or with an
    `environment`: all in this one. An episode depends on its seed, not on their number.
    environment: instead of the task's, see `robot_step`; with T as `episode_steps` if it has that.
    noise: each episode draws the deviation of what is added to its actions, evenly from 0 to this.
    teacher: a PlannerConfig, by which the model also plans in each state; its plans
    (E, T, N * L * d) are a fifth array. share: of an episode that is played, from its beginning."""
    E, episodes, total = len(seeds), [], 0.0
    here = episodes_of(model, task, config, seeds, environment, noise, teacher, share)
    with progress(label, E, "episode") as bar, contextlib.ExitStack() as stack:
        workers = workers if environment is None else 0
        pool = workers if isinstance(workers, Workers) else stack.enter_context(players(workers, E))
        pool.send_all((model, task, config, seeds[w::len(pool)], None, noise, teacher, share)
                      for w in range(len(pool)))
        for i in range(E):
            episodes.append(pool.receive(i % len(pool)) if len(pool) else next(here))
            total += sum(decision[2] for decision in episodes[i])
            bar.update()
            bar.set_postfix_str(f"mean return {total / (i + 1):.0f}", False)
    T = max(map(len, episodes))
    found = [np.full((E, T, *np.shape(x)), np.nan, np.result_type(x)) for x in episodes[0][0]]
    found[2][:] = 0
    for i, decisions in enumerate(episodes):
        for array, values in zip(found, zip(*decisions)):
            array[i, :len(decisions)] = values
    return found


def evaluate(model, task, config, episodes=20, seed=0, workers=None, label="evaluating"):
    """{"returns", "plan_ms_median" (over episodes, of a mean decision)} of `episodes` episodes, as
    `play` plays them. Raises UserError if the model isn't for the task."""
    check_task(model.config, task)
    *_, rewards, seconds = play(model, task, config, episode_seeds(seed, episodes), workers, label)
    return {"returns": rewards.sum(1).tolist(),
            "plan_ms_median": 1e3 * float(np.median(np.nanmean(seconds, 1)))}


def check_task(sizes, task, what="the model"):
    """UserError if what has these sizes (a ModelConfig, a Replay) isn't for the task."""
    found, expected = (sizes.dim_obs, sizes.dim_action), lookup_task(task)
    need(found == expected, f"{what} has (dim O, dim A) = {found}, {task} has {expected}; name the "
         "task it was made for")


def progress(label, total, unit, initial=0):
    """A progress bar on stderr with rate and remaining time."""
    from tqdm import tqdm
    return tqdm(desc=label, total=total, initial=initial, unit=unit, dynamic_ncols=True,
                file=sys.stderr or open(os.devnull, "w"), mininterval=0.5 if os.isatty(2) else 20,
                smoothing=0.1, leave=None)  # one below another vanishes


def interleaved_seconds(calls, rounds, label):
    """Seconds (rounds, calls) of functions called in turn, so that noise hits all alike: of each a
    second call, which finds weights in the cache, as a robot's next decision does; one thread."""
    seconds = np.zeros((rounds, len(calls)))
    with one_thread(), progress(label, seconds.size, "call") as bar:
        for i, j in np.ndindex(seconds.shape):
            calls[j]()
            begin = time.perf_counter()
            calls[j]()
            seconds[i, j] = time.perf_counter() - begin
            bar.update()
    return seconds


def expert_episodes(distiller, task, config, workers=None, environment=None):
    """What `Distiller.add` takes: episodes in which the expert's policy acts, each with noise of
    another deviation [D8]. config: a PlannerConfig; workers, environment: as `play`'s."""
    seeds = training_seeds(distiller.seed, "expert episode", 0, distiller.config.expert_episodes)
    policy = dataclasses.replace(config, **ALONE)
    return play(distiller.expert, task, policy, seeds, workers, "the expert plays", environment,
                EXPERT_NOISE)[:2]


PRIOR_ROUNDS, PRIOR_BATCH, PRIOR_LR = 3, 256, 5e-3
OWN_NOISE = 0.3  # largest deviation of the noise in episodes that priors play


def teach_priors(distiller, task, planning, workers=None, environment=None):
    """Each agent learns its own prior [D9], in PRIOR_ROUNDS: what the expert's policy would do, in
    the replay's and the played states and, from the second round on, in states that the priors get
    into by themselves: in an eighth as many episodes a round as the expert's policy played, and in
    five times as many beginnings, a tenth as long. Then planning is taught back: what the student's
    search (`planning`) finds in as many. Returns their weights, {"policy": ..., "plans": ...}."""
    student, config = distiller.student, distiller.config
    L, episodes = config.horizon + 1, -(-config.expert_episodes // 8)
    reflex = dataclasses.replace(planning, **ALONE)

    def own_states(number, teacher=None):
        seeds = training_seeds(distiller.seed, "prior episode", number * 6 * episodes, 6 * episodes)
        parts = (seeds[:episodes], 1.0), (seeds[episodes:], 0.1)  # whole ones; beginnings
        found = [play(student, task, reflex, own, workers, "the priors play", environment,
                      OWN_NOISE, teacher, share) for own, share in parts]
        return [np.concatenate([of[k][np.isfinite(of[0]).all(2)].T for of in found], -1)
                for k in (0, -1)]

    def policy_at(obs):
        return distiller.in_parts(student.read, obs), distiller.in_parts(
            lambda part: policy_plan(distiller.expert, part, L, student.config), obs)

    known = distiller.replay.sequences(distiller.train_starts, 1)[0]
    played = distiller.played[:, :distiller.replay.dim_obs].T.astype(F32)
    data = [policy_at(np.concatenate([known, played], 1))]
    for number in range(PRIOR_ROUNDS):
        if number and episodes:
            data.append(policy_at(own_states(number)[0]))
        learn_priors(distiller, data, number)
    taught = {"policy": prior_weights(student)}
    if episodes and planning.iterations:
        obs, plans = own_states(0, planning)
        plans = plans.reshape(student.config.num_agents, L, -1, obs.shape[1])
        learn_priors(distiller, [(distiller.in_parts(student.read, obs), plans)], PRIOR_ROUNDS)
        taught["plans"] = prior_weights(student)
    return taught


def prior_weights(student):
    """A copy of a student's priors' weights."""
    return {k: v.copy() for k, v in student.params.items() if k.startswith("_prior")}


def learn_priors(distiller, data, number):
    """A round of `prior_loss`: a quarter of Algorithm 1's steps. data: pairs of x (1, F, M) and
    targets (N, L, d, M)."""
    student, rng = distiller.student, stream(distiller.seed, "priors", number)
    x, targets = (np.concatenate(arrays, -1) for arrays in zip(*data))
    config = dataclasses.replace(distiller.config, lr=PRIOR_LR,
                                 steps=-(-distiller.config.steps // 4))
    adam = Adam(prior_weights(student))
    student.params.update(adam.params)  # views of its vector
    halves = Halves(adam, distiller._threads)

    def loss(part, grads):
        rows = chosen[part]
        return prior_loss(student, x[..., rows], targets[..., rows], config.lam, grads)

    with one_thread(), progress("teaching priors", config.steps, "step") as bar:
        for t in range(config.steps):
            chosen = rng.integers(x.shape[-1], size=PRIOR_BATCH)
            found = halves.learn(PRIOR_BATCH, loss)
            adam.step(learning_rate(config, t), config.grad_clip)
            bar.update()
    check_finite("priors' loss is", found, config.steps, config.lr)


def choose_by_playing(distiller, task, taught, plannings, workers=None, environment=None):
    """Which priors of `teach_priors` a student keeps, and which of the plannings, cheapest first,
    it searches around them by: all play the same episodes, a sixth as many as the expert's policy
    played; first the priors alone, then each search around the better ones. The best mean is kept,
    or what is cheaper and within a hundredth of it. Returns the planning and what was played, a
    list of dicts."""
    played, student = [], distiller.student
    seeds = training_seeds(distiller.seed, "choice", 0, -(-distiller.config.expert_episodes // 6))

    def returns(name, planning):
        student.params.update({k: v.copy() for k, v in taught[name].items()})
        found = play(student, task, planning, seeds, workers, "choosing", environment)[2].sum(1)
        played.append({"taught": name, **{key: getattr(planning, key) for key in CHOSEN},
                       "returns": found.tolist()})
        return found

    reflex = dataclasses.replace(plannings[-1], **ALONE)
    alone = {name: returns(name, reflex) for name in taught if seeds}
    best = max(alone, key=lambda name: alone[name].mean(), default=[*taught][-1])
    student.params.update(taught[best])
    if not seeds or len(plannings) == 1:
        return plannings[-1], played
    means = [(alone[best] if planning.iterations == 0 else returns(best, planning)).mean()
             for planning in plannings]
    least = max(means) - abs(max(means)) / 100
    return plannings[[mean >= least for mean in means].index(True)], played


CURVE = ("step", "seconds", "loss", "kl_reward", "kl_value", "lr", "rank_correlation_h0",
         "rank_correlation_last", "rank_correlation_return")


def train_student(distiller, out, settings, planning, workers):
    """Algorithm 1 to its end, with a learning curve and checkpoints in the folder `out`, from which
    a run that was cut off goes on to the same end (UserError: one is another run's).
    workers: that play the expert's episodes [D8]. Returns curve rows, seconds, those before."""
    checkpoint, config, curve, before = out / "checkpoint.npz", distiller.config, [], 0.0
    if checkpoint.exists():
        header, arrays = read_npz(checkpoint, ("checkpoint",))
        same_settings(header["settings"], settings, checkpoint)
        distiller.load(arrays)
        curve, before = header["curve"], header["seconds"]
        write_curve(out / "curve.csv", CURVE, curve)  # a kill may have come before it
    elif not (out / "student.npz").exists():
        need_none(out, "config.json", "result.json", "curve.csv", "curve.png")
    began, saved = time.monotonic(), -np.inf
    if not distiller.t and config.expert_episodes:
        distiller.add(*expert_episodes(distiller, settings["task"], planning, workers))
    every, losses = max(1, min(500, config.steps // 8)), []
    with progress("distilling", config.steps, "step", distiller.t) as bar:
        for found in distiller.run():
            losses.append(found)
            bar.update()
            if distiller.t % every and distiller.t < config.steps:
                continue
            means, losses = np.mean(losses, 0).tolist(), []
            q, g = (x.tolist() for x in distiller.ranks(64, planning.discount))
            check_finite("weights are", distiller.optimizer.vector, distiller.t, config.lr)
            check_finite("student's predictions are", q, distiller.t, config.lr)
            seconds = before + time.monotonic() - began
            curve.append([distiller.t, round(seconds, 2), *means,
                          learning_rate(config, distiller.t - 1), q[0], q[-1], g[-1]])
            bar.set_postfix_str("loss {:.4f} KL reward {:.4f} value {:.4f} rank {:.3f}".format(
                *means, g[-1]), False)
            if time.monotonic() - saved > 30 or distiller.t == config.steps:
                write_npz(checkpoint, {"kind": "checkpoint", "settings": settings, "curve": curve,
                                       "seconds": seconds}, distiller.state())
                saved = time.monotonic()
            write_curve(out / "curve.csv", CURVE, curve)  # which a checkpoint shows to be its
    return curve, before + time.monotonic() - began, before


def same_settings(found, expected, where, group=""):
    """UserError if a file is of a run with other settings (dicts, whose values may be dicts)."""
    for key in {**found, **expected}:
        theirs, ours = found.get(key), expected.get(key)
        if isinstance(theirs, dict) and isinstance(ours, dict):
            same_settings(theirs, ours, where, f"{key}: ")
        else:
            need(theirs == ours, f"{where}: a run with other settings ({group}{key}: expected "
                 f"{ours}, found {theirs}); choose another folder (--out), or empty it")


def need_none(folder, *names):
    """UserError for the first of these files in a folder: a run that isn't its would replace it."""
    for path in filter(Path.exists, (Path(folder, name) for name in names)):
        raise UserError(f"{path}: not this run's, which would replace it; choose another --out")


def write_curve(path, columns, rows):
    """A learning curve as CSV."""
    with atomic_file(path, "w", newline="") as file:
        csv.writer(file).writerows([f"{v:.6g}" if isinstance(v, float) else v for v in row]
                                   for row in (columns, *rows))


def write_json(path, found):
    """A dict or list as a JSON file."""
    with atomic_file(path, "w") as file:
        json.dump(found, file, indent=1)


@contextlib.contextmanager
def optional(library, extra):
    """Around an import: UserError that names what to install where the library is missing."""
    try:
        yield
    except ImportError as error:
        raise UserError(f"this needs {library}: pip install 'fac-tdmpc-ref[{extra}]' ({error})"
                        ) from None


def draw_curve(path, curve, title):
    """The learning curve's picture; whether it could be made: what goes wrong costs no result."""
    columns = dict(zip(CURVE, np.array(curve).T))
    try:
        with optional("matplotlib", "plots"):
            from matplotlib import figure, rcParams
        rcParams["text.usetex"] = False
        picture = figure.Figure(figsize=(10, 3.6), layout="constrained")
        for ax, keys, label, scale in zip(picture.subplots(1, 2), (CURVE[3:5], CURVE[6:]), (
                "KL divergence", "rank correlation, held-out states"), ("log", "linear")):
            lines = ax.plot(columns["step"], np.transpose([columns[key] for key in keys]))
            ax.legend(lines, keys)
            ax.set(xlabel="gradient step", ylabel=label, title=title, yscale=scale)
        with atomic_file(path) as file:
            picture.savefig(file, dpi=110, format="png")
    except Exception as error:
        print(f"{path}: no picture: {' '.join(str(error).split())[:300]}", file=sys.stderr)
        return False
    return True


def read_records(path):
    """{`record_key`: (returns, the `software` they are of)} of the .json beside a model's file."""
    path = Path(path).with_suffix(".json")
    try:  # a name that is too long for a file is no file's
        records = json.loads(path.read_text(encoding="utf-8")) if os.path.exists(path) else {}
        return {key: ([float(r) for r in about["returns"]], dict(about["versions"]))
                for key, about in records.items()}
    except Exception as error:  # a user's own file can raise nearly anything
        raise UserError(f"{path}: not what evaluate --record writes ({error}); rename it") from None


def record_key(model, config, seed):
    """What recorded returns depend on: weights, planner and the episodes' seed."""
    more = "".join(f", {f.name.replace('_', ' ')} {value}" for f in dataclasses.fields(config)
                   if not f.repr and (value := getattr(config, f.name)) != f.default)
    return f"weights {checksum(model.params.values())}, evaluation seed {seed}, {config}{more}"


def software():
    """The versions of what returns depend on beside weights and settings (not Gymnasium's)."""
    return {"fac-tdmpc-ref": __version__, "numpy": np.__version__,
            "mujoco": importlib.metadata.version("mujoco")}


def recorded_returns(path, model, task, config, seed):
    """(returns, the `software` they are of) that `record_returns` kept; ([], {}): none, or the
    task's robot is a user's own, gym:MODULE:ID, and may have changed."""
    records = {} if task.count(":") > 1 else read_records(path)
    return records.get(record_key(model, config, seed), ([], {}))


def record_returns(path, model, config, seed, returns):
    """Keep `evaluate`'s returns beside the model's file, unless it has more of these versions."""
    with locked(path, folder=False, wait=True):  # jobs of an array record at the same time
        records, key = read_records(path), record_key(model, config, seed)
        before, of = records.get(key, ([], {}))
        if len(returns) >= len(before) or of != software():
            records[key] = returns, software()
            write_json(Path(path).with_suffix(".json"), {
                key: {"returns": values, "versions": of} for key, (values, of) in records.items()})


def command_distill(args):
    """distill: expert and replay in, student, learning curve, table and JSON out."""
    began = time.monotonic()
    named = "plain" if args.plain and args.preset == "default" else args.preset
    config = from_args(DistillConfig, args, **{
        **preset_values(DistillConfig, named), **({"reuse": 1} if args.plain else {})})
    expert, header, replay, path = load_data(args)
    theirs = {**preset_values(PlannerConfig, named), **made_for(header, path)}
    own = PlannerConfig(**theirs)  # the expert's
    search = student_planning(config) if getattr(args, "PlannerConfig.prior") != "last" else {}
    planning = from_args(PlannerConfig, args, **{
        **theirs, **(search and {"elites": 0, "min_std": PlannerConfig.min_std}), **search,
        "horizon": config.horizon, **({"speed": "plain"} if args.plain else {})})
    out = Path(args.out or f"runs/{args.task}-{args.seed}")
    read_records(path)  # what is damaged is missed now
    sizes = {"mlp_dim": args.mlp_dim} if args.mlp_dim else {}
    with contextlib.closing((PlainDistiller if args.plain else Distiller)(
            expert, replay, config, args.num_agents, args.seed, **sizes)) as distiller, \
            locked(out), players(args.workers, max(args.episodes, config.expert_episodes)) as pool:
        args.workers = pool  # all that plays from here on
        result, planning = distil_and_save(distiller, args, planning, header, out)
        found, rows = compare(compared((expert, own), (distiller.student, planning)), path, args)
        result.update(found)
        result.update(seconds_total=round(result["seconds_total"] + time.monotonic() - began, 1))
        write_json(out / "result.json", result)
    print("\n{task}, N = {num_agents}, {episodes} episodes, evaluation seed {eval_seed}, horizon "
          "{expert_horizon} and {student_horizon}\n".format_map(result))
    print_table(rows)
    if played := result["played"]:
        print(f"\nits search was chosen by playing {len(played[0]['returns'])} episodes of the "
              "run's own seeds:\n")
        print_table([("priors taught", "MPPI", "first deviation", "return"), *(
            (of["taught"], budget(of), f"{of['max_std']}" if of["iterations"] else "-",
             f"{np.mean(of['returns']):.0f}") for of in played)])
    kept = "-" if result["kept"] is None else f"{result['kept']:.2f}"
    print(f"\nreturn kept {kept}, rank correlation of the return "
          f"{result['rank_correlation_returns'][-1]:.3f}; Algorithm 1 distilled in "
          "{seconds:.0f} s, {seconds_total:.0f} s in all, {out}/".format_map(result))
    return result


def load_data(args):
    """(expert, its header, replay, the expert's path) that distill's arguments name."""
    lookup_task(args.task)
    path = Path(args.expert or data_file(args.task, "expert.npz"))
    if path.is_dir():  # as train_expert.py and data/experts/TASK hold them
        path /= "expert.npz"
    expert, header = load_model(path, ["expert"])
    need(header.get("task") == args.task, f"{path}: header: task: expected {args.task!r}, found "
         f"{header.get('task')!r}")
    check_task(expert.config, args.task)
    if not is_gym(args.task):  # whose sizes were a robot's
        make_robot(args.task)  # what is missing is missed now, not after the last step
    replay = Replay(args.replay or path.with_name("replay.npz"),
                    made_for(header, path).get("action_repeat", ACTION_REPEAT))
    return expert, header, replay, path


def distil_and_save(distiller, args, planning, header, out):
    """Algorithm 1 to its end, then priors and, where no flag says otherwise, a search's choice;
    writes student, curve and configuration. Returns result's part, and the student's planning."""
    student, config, played = distiller.student, distiller.config, []
    plannings = [*dict.fromkeys(from_args(PlannerConfig, args, **{**vars(planning), **search})
                                for search in SEARCHES if planning.prior == "own")]
    settings = {"task": args.task, "seed": args.seed,
                "num_agents": student.config.groups or student.config.num_agents,
                "mlp_dim": student.config.mlp_dim, "distill": vars(config),
                "action_repeat": planning.action_repeat,
                "data": data_checksums(distiller.expert, distiller.replay)}
    if finished := (path := out / "student.npz").exists():
        model, about = load_model(path, ["student"])
        about["mlp_dim"] = model.config.mlp_dim
        same_settings({key: about.get(key) for key in settings}, settings, path)
        student.params.update(prior_weights(model))
        planning = planning_of(about, path, args, speed=planning.speed)
        played = about.get("played", [])
    need(finished or not config.priors or planning.prior == "own", "--plan-prior last: expected "
         "--no-priors, or a run whose search is chosen: give the command without it first")
    Planner(student, planning)  # what it lacks is missed now
    print(f"{args.task}: {student.config.num_agents} agents, {len(distiller.optimizer.vector):,} "
          f"weights; results in {out}\nto come: {config.expert_episodes} episodes of the expert's "
          f"policy; {config.steps:,} steps of {config.batch_size} x {config.noise_samples}"
          f"{f'; {PRIOR_ROUNDS + 1} rounds of priors; a search chosen' * config.priors}; "
          f"{args.episodes} episodes to evaluate each", file=sys.stderr)
    curve, seconds, before = train_student(distiller, out, settings, planning, args.workers)
    q, g = (ranks.tolist() for ranks in distiller.ranks(256, planning.discount))
    if not finished:
        if config.priors:
            taught = teach_priors(distiller, args.task, planning, args.workers)
            if config.expert_episodes:
                planning, played = choose_by_playing(distiller, args.task, taught, plannings,
                                                     args.workers)
        save_model(path, student, {
            "kind": "student", **settings, "training": header.get("training", {}),
            "planner": {name: getattr(planning, name) for name in SEARCH}, "played": played})
    write_json(out / "config.json", {**settings, "planner": vars(planning)})
    return {"task": args.task, "seed": args.seed, "num_agents": student.config.num_agents,
            "steps": config.steps, "seconds": round(seconds, 1), "seconds_total": before,
            "kl_reward": curve[-1][3], "kl_value": curve[-1][4], "rank_correlation": q[0],
            "rank_correlation_by_step": q, "rank_correlation_returns": g, "played": played,
            **{name: getattr(planning, name) for name in CHOSEN}, "out": str(out),
            "picture": draw_curve(out / "curve.png", curve, f"{args.task}, seed {args.seed}")
            }, planning


def planning_of(header, where, args, **more):
    """How a model's file says that it plans, under flags; what it says of a search around priors
    is left out with --prior last."""
    own = made_for(header, where)
    if getattr(args, "PlannerConfig.prior") == "last" and own.get("prior") == "own":
        own = {name: value for name, value in own.items() if name not in SEARCH}
    return from_args(PlannerConfig, args, **own, **more)


COMPARED = {"expert": "the expert", "policy": "its policy alone",
            "reflex": "the student's priors alone", "student": "the student"}


def compared(expert, student):
    """What distill compares, (model, planning) by COMPARED's keys: these two; the expert's policy
    alone; and, if the student searches, its priors alone."""
    (model, own), (learner, planning) = expert, student
    found = {"expert": expert}
    if model.has_policy:
        found["policy"] = model, dataclasses.replace(own, **ALONE)
    if planning.prior == "own" and planning.iterations:
        found["reflex"] = learner, dataclasses.replace(planning, **ALONE)
    return {**found, "student": student}


def compare(each, path, args):
    """Of all that is `compared` the returns, from the record beside the expert's file `path` or
    measured, and the milliseconds of a decision in this process: result's part, a table's rows."""
    found = {"episodes": args.episodes, "eval_seed": args.eval_seed}
    obs = np.zeros(each["expert"][0].config.dim_obs, F32)
    calls = [functools.partial(Planner(*planned).act, obs) for planned in each.values()]
    timed = 1e3 * np.median(interleaved_seconds(calls, 20, "timing"), 0)
    rows = [("", "MPPI", "return", "ms a decision", "speed-up")]
    for (name, (model, planning)), ms in zip(each.items(), timed.tolist()):
        returns, versions = recorded_returns(path, model, args.task, planning, args.eval_seed)
        source = " (recorded)" if versions == software() else " (recorded with other versions)"
        recorded = len(returns) >= args.episodes and not args.evaluate_expert
        if not recorded:
            source, versions, returns = "", software(), evaluate(
                model, args.task, planning, args.episodes, args.eval_seed, args.workers,
                f"evaluating {COMPARED[name]}")["returns"]
        mean, std = (float(of(returns[:args.episodes])) for of in (np.mean, np.std))
        about = {"returns": returns[:args.episodes], "return_mean": mean, "return_std": std,
                 "horizon": planning.horizon, "recorded": recorded, "versions": versions}
        found.update({f"{name}_{key}": value for key, value in about.items()})
        found[f"plan_ms_{name}"], found["speedup"] = ms, float(timed[0]) / ms
        rows.append((COMPARED[name] + source, budget(vars(planning)), f"{mean:.0f} ± {std:.0f}",
                     f"{ms:.1f}", f"{found['speedup']:.1f}"))
    return {**found, "kept": return_kept(mean, found["expert_return_mean"])}, rows


def budget(search):
    """S x I of a search's settings, a dict; 0: none."""
    return "{samples} x {iterations}".format_map(search) if search["iterations"] else "0"


def return_kept(student, expert):
    """The share of the expert's return that a student keeps; None if there is nothing to keep."""
    return float(student / expert) if expert > 0 else None


def print_table(rows):
    """Columns as wide as they need to be; the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    for row in rows:
        print("  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]))


def command_evaluate(args):
    """evaluate: a model's returns on a task."""
    model, header = load_model(args.model)
    task = args.task or header.get("task")
    planning = planning_of({**header, "task": task}, args.model, args)
    flags = {name for name in SEARCH if getattr(args, f"PlannerConfig.{name}") is not None}
    need(planning.iterations or flags <= {"prior", "iterations"}, f"{args.model}: acts by its "
         "priors, without a search; flags of one need --iterations (such as 3), too")
    need(task, f"{args.model}: header: no task; pass --task")
    need(task == header.get("task") or not args.record, f"{args.model}: header: task: expected "
         f"{task!r} to record its returns, found {header.get('task')!r}")
    if args.record:
        read_records(args.model)  # which it adds to: what is damaged is missed now
        check_writable(Path(args.model).with_suffix(".json"))
    found = evaluate(model, task, planning, args.episodes, args.seed, args.workers)
    returns, ms = found["returns"], found["plan_ms_median"]
    mean, std = float(np.mean(returns)), float(np.std(returns))
    print_table([("task", "episodes", "return", "min", "max", "ms a decision"),
                 (task, str(args.episodes), f"{mean:.0f} ± {std:.0f}", f"{min(returns):.0f}",
                  f"{max(returns):.0f}", f"{ms:.1f}")])
    if args.record:  # now that they are told
        record_returns(args.model, model, planning, args.seed, returns)
    return {"return_mean": mean, "return_std": std, **found, "episodes": args.episodes,
            "task": task, "seed": args.seed}


def add_config(parser, config_class, title=None, prefix="", skip=(), **defaults):
    """A flag for every field of a config but `skip`; `--help` shows default and paper value."""
    group = parser.add_argument_group(title or config_class.__doc__.split(".")[0])
    for f in dataclasses.fields(config_class):
        if f.name in skip:
            continue
        default, paper = defaults.get(f.name, f.default), f.metadata.get("paper", f.default)
        shown = f"{default}" if paper == default else f"{default}; paper: {paper}"
        choices = f.metadata.get("choices")
        kind = {"action": argparse.BooleanOptionalAction} if isinstance(default, bool) else {
            "type": type(default), "choices": choices,
            "metavar": None if choices else type(default).__name__.upper()}
        group.add_argument(f"--{prefix}{f.name}".replace("_", "-"), default=None,
                           dest=f"{config_class.__name__}.{f.name}",
                           help=f"{f.metadata['help']} [{shown}]", **kind)


def from_args(config_class, args, **defaults):
    """The config that the flags of `add_config` give, on top of `defaults`."""
    given = {f.name: getattr(args, f"{config_class.__name__}.{f.name}", None)
             for f in dataclasses.fields(config_class)}
    return config_class(**{**defaults, **{k: v for k, v in given.items() if v is not None}})


def preset_values(config, preset):
    """What a preset takes instead of the default of a config's fields."""
    return {f.name: f.metadata[preset] for f in dataclasses.fields(config) if preset in f.metadata}


def natural(text, least=0):
    """argparse type: a whole number, 0 (or `least`) or more, of at most nine digits."""
    if not (text.isdecimal() and least <= int(text) < 10 ** 9):
        raise argparse.ArgumentTypeError(f"expected at least {least}, below 10^9, found {text!r}")
    return int(text)


def add_command(commands, name, run, help, **extra):
    """A sub-command with --json, which every one has."""
    sub = commands.add_parser(name, help=help, description=help, allow_abbrev=False, **extra)
    sub.set_defaults(run=run)
    sub.add_argument("--json", action="store_true", help="print JSON as the last line of stdout")
    return sub


class Parser(argparse.ArgumentParser):
    def error(self, message):
        self.exit(2, f"{self.prog}: error: {message} (try --help)\n")


def make_parser():
    """The command line, generated from the configs."""
    parser = Parser(prog="fac_tdmpc_ref.py", description="Fac-TDMPC in NumPy: distil a TD-MPC "
                    "expert into one small world model for each joint, and plan with them.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add_episodes(add):
        add("--episodes", type=functools.partial(natural, least=1), default=20,
            help="evaluation episodes [20]")
        add("--workers", type=natural, help="processes that play episodes; 0: this one [cores]")

    sub = add_command(commands, "distill", command_distill, "Distil a task's expert into a "
                      "factored student (Algorithm 1), then evaluate and time both with MPPI.",
                      epilog="Given again, a cut-off run goes on; a finished one is evaluated. A "
                      "student's search is chosen by playing, unless flags tell.")
    add = sub.add_argument
    add("--task", default="reacher-hard", help="one of: " + TASK_NAMES)
    add("--seed", type=natural, default=0, help="of distillation [0]")
    agents = sub.add_mutually_exclusive_group().add_argument
    agents("--num-agents", type=int, help="N, a divisor of dim(A) [dim(A)]")
    agents("--agents", dest="num_agents", help="action dimensions of each, equally many: 0,2/1,3")
    add("--mlp-dim", type=functools.partial(natural, least=1),
        help="hidden width of an agent's networks [its expert's // N, at least 50]")
    add("--preset", choices=("default", "plain", "paper"), default="default", help="paper: its "
        "value of every setting that names one below (days); plain: the paper's method at this "
        "project's budget, without what it adds [D8] [D9]")
    add("--plain", action="store_true", help="Part I of the module alone, with the plain preset or "
        "the paper's; slower")
    add("--expert", help="expert file, or folder with expert.npz, replay.npz [data/experts/TASK]")
    add("--replay", help="replay file [replay.npz beside the expert]")
    add("--out", help="folder for the results [runs/TASK-SEED]")
    add("--eval-seed", type=natural, default=0, help="of the evaluation episodes [0]")
    add("--evaluate-expert", action="store_true", help="measure the expert, in spite of a record")
    add_episodes(add)
    add_config(sub, DistillConfig)
    for flag, name in (("--own-episodes", "expert_episodes"), ("--own-share", "played_share")):
        add(flag, dest=f"DistillConfig.{name}", type=int, choices=[0],  # of earlier scripts
            help=argparse.SUPPRESS)
    add_config(sub, PlannerConfig, "How the student plans; the expert does with its own defaults",
               "plan-", ("horizon", "action_repeat"), **STUDENT_PLANNING)

    sub = add_command(commands, "evaluate", command_evaluate, "Plan with a model (expert or "
                      "student) through whole episodes.")
    add = sub.add_argument
    add("--model", required=True, help="an expert.npz or student.npz")
    add("--task", help="one of: " + TASK_NAMES + " [the model's own]")
    add("--seed", type=natural, default=0, help="of the episodes [0]")
    add("--record", action="store_true", help="keep them in a .json beside the model, for distill")
    add_episodes(add)
    add_config(sub, PlannerConfig, "MPPI; a student's file has its own", skip=("action_repeat",))
    return parser


def run_command(parser, argv=None):
    """Run a command line; returns the exit status: 2, with one line, for what the user can mend."""
    sys.stdin, sys.stdout, sys.stderr = (stream or open(os.devnull, "r+") for stream in (
        sys.stdin, sys.stdout, sys.stderr))  # a closed one's number is not for the next file
    args = parser.parse_args(argv)
    warnings.simplefilter("ignore", RuntimeWarning)  # what isn't finite is refused in one line
    if hasattr(sys.stdout, "reconfigure"):  # a terminal that has no ±
        sys.stdout.reconfigure(errors="replace")
    try:
        with contextlib.ExitStack() as stack:
            if args.json and argv is None and sys.stdout is sys.__stdout__:
                own = os.fdopen(os.dup(1), "w", encoding=sys.stdout.encoding, errors="replace")
                stack.enter_context(contextlib.redirect_stdout(stack.enter_context(own)))
                os.dup2(2, 1)  # for what a robot prints in C, or ending: JSON is the last line
            result = args.run(args)
            print(f"\n{json.dumps(result)}\n" if args.json else "", end="", flush=True)
    except (UserError, MemoryError, OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "start new thread" not in str(error):
            raise  # a mistake of ours; that one is a limit's
        if isinstance(error, OSError) and error.filename:
            error = f"{error.filename}: can't be read or written: {error.strerror}"
        elif isinstance(error, OSError):  # a full stdout's, which would fail again at the end
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        print(f"{parser.prog}: error: {str(error) or 'not enough memory'}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{parser.prog}: interrupted; the same command goes on from its last checkpoint, "
              "where it keeps one", file=sys.stderr)
        return 130
    return 1 if result and result.get("failed") else 0  # an experiment's runs


def main(argv=None):
    """Run the command line of this module; returns the exit status."""
    return run_command(make_parser(), argv)


if __name__ == "__main__":
    sys.exit(main())
