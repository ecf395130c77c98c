"""TD-MPC2's model of many tasks as teachers, without PyTorch: `multitask.py distill --teacher`.

The public code's checkpoints are read, in both layouts of their state dict: Q's ensemble as a flat
list (`_Qs.params.0` ... `_Qs.params.9`), or by layer (`_Qs.params.0.weight`, ...). A layer is
Linear, LayerNorm, Mish; a latent is a softmax in groups of 8 (SimNorm); reward and Q are softmaxes
over bins of symlog's values (two-hot); an embedding of the task joins what each network reads.

What is left for one task (`Checkpoint.teacher`), with the embedding in the biases and without what
its robot lacks, is an expert as fac.Distiller wants it: it has a policy, the tanh of its mean, and
gradients by actions, so `credit` works. Its two Q are the ensemble's first two. TD-MPC2 draws two
anew whenever it plans and takes their mean, as this project does [D4]: all are trained alike, so
any pair is one such draw, and one that stays gives the same plan and the same targets again.
"""
import dataclasses
import itertools
import math

import numpy as np

import fac_tdmpc_ref as fac
import import_expert
from fac_tdmpc_ref import need

# mt30's tasks in its order, by this project's names, also the first 30 of mt80. "-": this project
# lacks the task. Its reachers have three links, so they are mt30's reacher-three, 26 and 27.
MT30 = """walker-stand walker-walk walker-run cheetah-run - - acrobot-swingup pendulum-swingup
cartpole-balance cartpole-balance_sparse cartpole-swingup cartpole-swingup_sparse ball_in_cup-catch
finger-spin finger-turn_easy finger-turn_hard fish-swim hopper-stand hopper-hop - - - - - - -
reacher-easy reacher-hard - -""".split()
KNOWN = {30: MT30, 80: MT30 + 50 * ["-"]}
MAX_WEIGHTS = 1 << 26  # the public models but the largest, of 317 million
GROUP = 8  # features of a softmax in SimNorm
BINS = 10  # two-hot's bins are spread evenly over symlog's values from minus this to this
ELSEWHERE = "expected what TD-MPC2's public code saves of a model of many tasks, for state input"

# ------------------------------------------------------------------------------------ layers


def mish(x):
    """y = x tanh(log(1 + e^x)) = x n / (n + 2) with n = e^x (e^x + 2)."""
    e = np.exp(np.minimum(x, 20))  # where n / (n + 2) is 1
    n = e * (e + 2)
    return x * (n / (n + 2))


def mish_backward(dy, x):
    """dy/dx = n / (n + 2) + x 4 e^x (e^x + 1) / (n + 2)^2."""
    e = np.exp(np.minimum(x, 20))
    n = e * (e + 2)
    return dy * (n + x * (4 * e * (e + 1) / (n + 2))) / (n + 2)


def simnorm(x, group=GROUP):
    """Softmax in groups of features, (1, F, B) -> (1, F, B)."""
    from scipy.special import softmax
    return softmax(x.reshape(1, -1, group, x.shape[2]), 2).reshape(x.shape)


def simnorm_backward(dy, x, group=GROUP):
    """dx = y (dy - sum of y dy over the group)."""
    y, d = (a.reshape(len(a), -1, group, x.shape[2]) for a in (simnorm(x, group), dy))
    return (y * (d - (y * d).sum(2, keepdims=True))).reshape(dy.shape)


def bins(x):
    """Symlog's values (1, bins) that stand for logits (1, bins, B)."""
    return np.linspace(-BINS, BINS, x.shape[1], dtype=x.dtype)[None]


def two_hot(x):
    """symexp(v) = sign(v) (e^|v| - 1) of the bins' mean v: logits (1, bins, B) -> (1, 1, B)."""
    v = bins(x) @ simnorm(x, x.shape[1])
    return np.sign(v) * np.expm1(np.abs(v))


def two_hot_backward(dy, x):
    """d symexp/dv = e^|v|, dv/d(softmax) = bins."""
    v = bins(x) @ simnorm(x, x.shape[1])
    return simnorm_backward(bins(x).T * (dy * np.exp(np.abs(v))), x, x.shape[1])


MISH, SIMNORM, TWO_HOT = (mish, mish_backward), (simnorm, simnorm_backward), (
    two_hot, two_hot_backward)
LAST = {"_encoder": SIMNORM, "_dynamics": SIMNORM, "_reward": TWO_HOT, "_Q1": TWO_HOT,
        "_Q2": TWO_HOT, "_pi": (lambda x: x, lambda dy, x: dy)}  # after a network's last layer


class Teacher(fac.WorldModel):
    """One task's expert, whose networks are TD-MPC2's, frozen; `params` by its names."""

    def layers(self, name):
        """(layer, whether LayerNorm follows, activation and its backward) of a network."""
        p = self.params
        for k in itertools.takewhile(lambda k: f"{name}.{k}.weight" in p, itertools.count()):
            last = f"{name}.{k + 1}.weight" not in p
            yield f"{name}.{k}", f"{name}.{k}.ln.weight" in p, LAST[name] if last else MISH

    def forward(self, name, x, tape=None):
        """A tape keeps what each LayerNorm and each activation reads."""
        p = self.params
        for layer, normed, (activation, _) in self.layers(name):
            y = h = fac.linear(x, p[f"{layer}.weight"], p[f"{layer}.bias"])
            if normed:
                h = fac.norm(y, p[f"{layer}.ln.weight"], p[f"{layer}.ln.bias"])
            if tape is not None:
                tape += [y, h]
            x = activation(h)
        return x

    def backward(self, name, tape, dy, grads):
        """dx of a network; uses the tape up. grads: None."""
        for layer, normed, (_, activation_backward) in reversed([*self.layers(name)]):
            h, y = tape.pop(), tape.pop()
            dy = activation_backward(dy, h)
            if normed:
                dy, *_ = fac.norm_backward(dy, y, self.params[f"{layer}.ln.weight"])
            dy = self.params[f"{layer}.weight"].swapaxes(1, 2) @ dy
        return dy


# ------------------------------------------------------------------------------------- files

PARTS = ("weight", "bias", "ln.weight", "ln.bias")  # of a layer, in the flat layout's order
FIRST, EMBEDDING, MASKS = "_encoder.state.0.weight", "_task_emb.weight", "_action_masks"
BESIDE = ("_Qs.module.", "_detach_Qs", "_target_Qs", "log_std_")  # what teaching doesn't need


def by_layer(state):
    """A state dict whose Q are named by layer, whatever its layout."""
    def renamed(key):
        name, _, i = key.rpartition(".")
        flat = name == "_Qs.params" and i.isdecimal()
        return f"{name}.{int(i) // 4}.{PARTS[int(i) % 4]}" if flat else key

    return {renamed(key): value for key, value in state.items()}


def shape_of(state, key, rank):
    """The shape of one of a state dict's arrays; UserError: it isn't there, or of another rank."""
    value = state.get(key)
    need(import_expert.is_weight(value) and value.ndim == rank, f"{key}: expected floats of rank "
         f"{rank}, found {import_expert.described(value)}; {ELSEWHERE}")
    return value.shape


def layer_shapes(name, widths, ensemble=(), normed=False):
    """{key: shape} of a network whose last layer has a LayerNorm, or hasn't, as all others have."""
    found = {}
    for k, (before, after) in enumerate(zip(widths, widths[1:])):
        for part in PARTS if normed or k < len(widths) - 2 else PARTS[:2]:
            shape = (after, before) if part == "weight" else (after,)
            found[f"{name}.{k}.{part}"] = (*ensemble, *shape)
    return found


def expected_shapes(state):
    """(ModelConfig of the widest robot, {key: shape}), which a few of the shapes tell."""
    (tasks, E), (enc, wide), (_, joint), (m, hidden), (count, _), (ensemble, *_) = (
        shape_of(state, key, rank) for key, rank in (
            (EMBEDDING, 2), (FIRST, 2), ("_dynamics.0.weight", 2), ("_dynamics.2.weight", 2),
            ("_reward.2.weight", 2), ("_Qs.params.0.weight", 3)))
    need(m % GROUP == 0 and count > 1 and ensemble > 1, f"expected a latent in groups of {GROUP}, "
         f"two bins and two Q at least, found {m} features, {count} bins, {ensemble} Q")
    sizes = fac.ModelConfig(wide - E, joint - E - m, 1, m, enc, hidden)
    depth = sum(f"_encoder.state.{k}.weight" in state for k in range(len(state)))
    inside = (hidden, hidden)
    return sizes, {
        EMBEDDING: (tasks, E), **({MASKS: (tasks, sizes.dim_action)} if MASKS in state else {}),
        **layer_shapes("_encoder.state", (wide, *[enc] * (depth - 1), m), normed=True),
        **layer_shapes("_dynamics", (joint, *inside, m), normed=True),
        **layer_shapes("_reward", (joint, *inside, count)),
        **layer_shapes("_pi", (m + E, *inside, 2 * sizes.dim_action)),
        **layer_shapes("_Qs.params", (joint, *inside, count), (ensemble,))}


class Checkpoint:
    """A model of many tasks out of a file. names: its tasks in its order, by this project's names,
    "-" for others; by default mt30's or mt80's. UserError: what is wrong in it."""

    def __init__(self, path, names=()):
        with import_expert.reading(path) as found:
            state = by_layer(import_expert.state_dict(found, FIRST))
            self.path, (self.sizes, expected) = path, expected_shapes(state)
            tasks, self.task_dim = expected[EMBEDDING]
            self.names = [*names] or KNOWN.get(tasks, [])
            need(len(self.names) == tasks, f"{EMBEDDING}: of {tasks} tasks, for which there are "
                 f"{len(self.names)} names; give --teacher-tasks all, in its order, - for others")
            self.known = [name for name in self.names if name != "-"]
            need(self.known and len({*self.known}) == len(self.known), "--teacher-tasks: expected "
                 f"names, each once, - for others, found {' '.join(self.names)}")
            for key, value in state.items():
                need(key in expected or not import_expert.is_weight(value) or
                     key.startswith(BESIDE), f"{import_expert.short(key)}: unknown; {ELSEWHERE}")
            need((count := sum(map(math.prod, expected.values()))) <= MAX_WEIGHTS, f"expected at "
                 f"most {MAX_WEIGHTS} weights, found {count}")
            weights = {key: import_expert.as_float32(key, state.get(key), shape, ELSEWHERE)
                       for key, shape in expected.items()}
        self.embedding, self.masks = (weights.pop(key, None) for key in (EMBEDDING, MASKS))
        self.params = {}
        for key, value in weights.items():
            for i, name in enumerate(("_Q1", "_Q2") if key.startswith("_Qs.params") else ("",)):
                own = value[i] if name else value
                self.params[key.replace("_Qs.params", name).replace(".state", "")] = (
                    own[None] if own.ndim == 2 else own[None, :, None])

    def teacher(self, task):
        """An expert in one of the tasks, whose weights it shares but for those that read what is
        the task's, or its robot's: observations, actions, embedding. UserError: it can't be."""
        need(task in self.known, f"{self.path}: knows {', '.join(self.known)}, not {task}; "
             "name some of these with --tasks, or what it knows with --teacher-tasks")
        index, (dim_obs, dim_action) = self.names.index(task), fac.lookup_task(task)
        wide, widest, E = self.sizes.dim_obs, self.sizes.dim_action, self.task_dim
        acts = np.arange(widest) < dim_action  # the older layout has no masks
        mask = acts if self.masks is None else self.masks[index]
        need(dim_obs <= wide and dim_action <= widest and np.array_equal(mask, acts),
             f"{self.path}: task {index}: reads up to {wide} features and has {int(mask.sum())} of "
             f"{widest} actions; {task} has ({dim_obs}, {dim_action}); give --teacher-tasks in the "
             "model's order")
        embedding = self.embedding[index]
        if (length := np.linalg.norm(embedding)) > 1:  # as TD-MPC2 does where it looks one up
            embedding = embedding / (length + 1e-7)
        params = dict(self.params)
        for name in LAST:
            before, own = (wide, dim_obs) if name == "_encoder" else [self.sizes.latent_dim] * 2
            W, bias = (params[f"{name}.0.{part}"] for part in PARTS[:2])
            own = W[:, :, :own], W[:, :, before + E:before + E + dim_action]  # the latter of no pi
            params[f"{name}.0.weight"] = np.concatenate(own, 2)
            params[f"{name}.0.bias"] = bias + W[:, :, before:before + E] @ embedding[:, None]
        for part in PARTS[:2]:  # the policy's deviations aren't used
            params[f"_pi.2.{part}"] = params[f"_pi.2.{part}"][:, :dim_action]
        return Teacher(dataclasses.replace(
            self.sizes, dim_obs=dim_obs, dim_action=dim_action), params)
