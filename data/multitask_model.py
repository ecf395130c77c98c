"""One student of many tasks (section 5.7), and how it's distilled: `multitask.py` is its program.

An agent is an action slot: agent i moves joint i of every robot, in its own order. Robots of fewer
joints lack the last agents, whose parts count nothing (`present_kl`) and which aren't planned. The
encoder reads observations, padded with zeros to the widest, and an embedding of the task. Each
state is taught by its own task's expert, whose Distiller draws it; a batch mixes tasks. What is
left of the student for one task (`Multitask.of_task`) is a model like any other, which plans in the
same time as a student of that task alone.
"""
import dataclasses
import functools

import numpy as np

import fac_tdmpc_ref as fac
from baselines import of_equal_weights

# ------------------------------------------------------------------------------- the student

EMBEDDING = 96  # numbers that stand for a task (TD-MPC2)
TASKS = "_embedding.0.weight"  # (1, EMBEDDING, tasks), columns of norm 1 at most
SCALES = "_scale.0.weight"  # (1, O, tasks), not trained: what observations are multiplied by


class Multitask(fac.WorldModel):
    """A student of several tasks, `dims` {task: (O, A)}; config: of the widest O and EMBEDDING.

    It reads x (1, O + tasks, B): padded observations above one-hot tasks. Robots' features are of
    very different sizes, so each is divided by its deviation in the task's replay."""

    def __init__(self, config, params, dims):
        super().__init__(config, params)
        self.dims = dims

    def encode_features(self, x, tape=None, name="_encoder"):
        obs, task = np.split(x, [self.config.dim_obs - EMBEDDING], 1)
        x = np.concatenate([obs * (self.params[SCALES] @ task), self.params[TASKS] @ task], 1)
        z = super().encode_features(x, tape, name)
        if tape is not None:
            tape.append(task)
        return z

    def encode_backward(self, dz, tape, grads, name="_encoder"):
        task = tape.pop()
        dx = super().encode_backward(dz, tape, grads, name)
        grads[TASKS] += dx[:, -EMBEDDING:] @ task.swapaxes(1, 2)
        return dx

    def of_task(self, task, teacher=None):
        """A copy of what a task's robot needs of the weights, its scales and embedding in those of
        the first layer."""
        k, (dim_obs, dim_action) = [*self.dims].index(task), self.dims[task]
        n = min(self.config.num_agents, dim_action)
        sizes = dataclasses.replace(self.config, dim_obs=dim_obs, dim_action=dim_action,
                                    num_agents=n,
                                    prior_steps=int(bool(teacher and teacher.has_policy)))
        params = {key: value[:n] for key, value in self.params.items()}
        embedding, scale = (params.pop(key)[:, :, k] for key in (TASKS, SCALES))
        for name in ("_dynamics", "_reward", "_Q1", "_Q2"):  # no columns for actions it lacks
            own = params[f"{name}.0.weight"][:, :, :sizes.latent_dim + sizes.agent_actions]
            params[f"{name}.0.weight"] = own
        W = params["_encoder.0.weight"]
        embedded = W[:, :, -EMBEDDING:] @ embedding[..., None]
        params["_encoder.0.bias"] = params["_encoder.0.bias"] + embedded
        params["_encoder.0.weight"] = W[:, :, :dim_obs] * scale[:, None, :dim_obs]
        for key in ("_encoder.2.weight", "_encoder.2.bias"):
            params[key] = params[key][:, :n * sizes.latent_dim]
        student = OfTask(sizes, {key: v.copy() for key, v in params.items()})
        student.teacher = teacher
        return student


class OfTask(fac.WorldModel):
    """A student of one task, without priors of its own: plans may begin from what the policy of
    its `teacher` would do, whose latent stands below each agent's."""
    teacher = None

    def latents(self, obs, search=True):
        z = self.encode(obs)
        theirs = self.teacher.encode(obs) if self.teacher else z[:1, :0]
        return np.concatenate([z, np.repeat(theirs, len(z), 0)], 1)

    def prior(self, latents, steps):
        theirs = latents[:1, self.config.latent_dim:]
        actions = fac.policy_rollout(self.teacher, theirs, [fac.F32(0)] * steps)
        return actions.reshape(steps, len(latents), -1, latents.shape[2]).swapaxes(0, 1)


def weights(config):
    """How many a model of these sizes has."""
    return sum(shape[0] * shape[1] * (shape[2] + 1) for _, _, _, shape, _ in fac.layers(config))


def student_sizes(dims, centralized):
    """A ModelConfig: an agent for each of the most actions; centralized: one agent, with the same
    encoder, so as many latent features in all, and about as many weights."""
    dim_obs, dim_action = np.max([*dims.values()], 0).tolist()
    sizes = fac.student_config(fac.ModelConfig(dim_obs + EMBEDDING, dim_action), dim_action,
                               "observation")
    if not centralized:
        return sizes
    one = dataclasses.replace(sizes, num_agents=1, latent_dim=dim_action * sizes.latent_dim)
    return of_equal_weights(one, sizes, weights)


def save(path, student, header):
    """A multi-task student's file."""
    fac.write_npz(path, {**header, "kind": "multitask", "tasks": student.dims,
                         "model": vars(student.config)}, student.params)


def load(path):
    """(Multitask, header) of a file; UserError names what is wrong in it."""
    header, arrays = fac.read_npz(path, ("multitask",))
    config = fac.from_dict(fac.ModelConfig, header.get("model"), f"{path}: header: model")
    dims, there = header.get("tasks"), f"{path}: header: tasks"
    fac.need(isinstance(dims, dict) and dims, f"{there}: expected sizes by task, found {dims!r}")
    expected = {task: [*fac.lookup_task(task)] for task in dims}
    fac.need(dims == expected, f"{there}: expected {expected}, found {dims}")
    of = header.get("of", {})
    fac.need(isinstance(of, dict) and all(isinstance(sums, list) for sums in of.values()),
             f"{path}: header: of: expected checksums by task, found {fac.shown(of)}")
    shapes = {TASKS: (1, EMBEDDING, len(dims)),
              SCALES: (1, config.dim_obs - EMBEDDING, len(dims))}
    for name, i, _, shape, _ in fac.layers(config):
        shapes.update({f"{name}.{i}.weight": shape, f"{name}.{i}.bias": (*shape[:2], 1)})
    for key in {**shapes, **arrays}:
        value = arrays.get(key, np.zeros(0))
        fac.need(value.shape == shapes.get(key) and value.dtype == fac.F32 and
                 np.isfinite(value).all(), f"{path}: {key}: expected finite float32 "
                 f"{shapes.get(key, 'nothing')}, found {value.dtype} {value.shape}")
    return Multitask(config, arrays, dims), header


# ------------------------------------------------------------------------------ distillation

def present_kl(student, expert, *settings):
    """`soft_kl`, but exactly 0, like its gradient, where the expert's part is NaN: of an agent that
    the robot lacks."""
    lacks = np.isnan(expert)
    return fac.soft_kl(*(np.where(lacks, 0, shares) for shares in (student, expert)), *settings)


def padded(x, axis, length, value=0):
    """x with `value` at the end of an axis, up to a length."""
    widths = [(0, length - n if i == axis else 0) for i, n in enumerate(x.shape)]
    return np.pad(x, widths, constant_values=value)


class MultitaskDistiller(fac.Distiller):
    """Algorithm 1 with teachers {task: Distiller}, each of which draws its own task's states and
    has what its expert predicts there. saved: {step: path} of files written on the way, with a
    header. start: a Multitask of the same sizes, whose weights this one's student begins with."""

    loss = staticmethod(functools.partial(fac.distill_loss, divergence=present_kl))

    def __init__(self, teachers, config, centralized=False, seed=0, saved=(), header=(),
                 start=None):
        self.teachers, self.saved, self.header = teachers, dict(saved), dict(header)
        self.start, self.dims = start, {
            task: [of.replay.dim_obs, of.replay.dim_action] for task, of in teachers.items()}
        wide = [start.config.dim_obs - EMBEDDING, start.config.dim_action] if start else [1, 1]
        sizes = student_sizes({**self.dims, "the start": wide}, centralized)
        fac.need(not start or start.config == sizes, "--start: expected a student for robots as "
                 f"wide as these, and of as many agents ({sizes}), found {start and start.config}")
        widest = max(teachers.values(), key=lambda teacher: teacher.replay.dim_action)
        super().__init__(widest.expert, widest.replay, dataclasses.replace(
            config, expert_episodes=0), seed=seed, **vars(sizes))
        self.pool_size = max(self.pool_size, fac.PART * len(teachers))  # which holds all tasks

    def create(self, expert, sizes, seed):
        """(Adam, student): embeddings of norm 1, at right angles, beside fresh weights."""
        _, student = fac.new_student(expert, sizes, seed)
        embedding = fac.orthogonal(fac.stream(seed, "embedding"), 1, EMBEDDING, len(self.dims))
        if self.start:  # but for the embeddings of tasks that it doesn't know
            student.params.update({key: self.start.params[key] for key in student.params})
            for task in set(self.dims) & set(self.start.dims):
                embedding[..., [*self.dims].index(task)] = self.start.params[TASKS][
                    ..., [*self.start.dims].index(task)]
        optimizer = fac.Adam({**student.params, TASKS: embedding})
        scales = np.zeros((1, sizes.dim_obs - EMBEDDING, len(self.dims)), fac.F32)
        for k, teacher in enumerate(self.teachers.values()):
            deviation = teacher.replay.observation.std(0, dtype=float)
            scales[0, :len(deviation), k] = 1 / np.maximum(deviation, 0.01)
        return optimizer, Multitask(sizes, {**optimizer.params, SCALES: scales}, self.dims)

    def draw(self, number, part, size):
        """As Distiller's, of one task, padded; NaN: the parts of agents that it lacks."""
        task = [*self.dims][k := (number + part) % len(self.dims)]
        features, actions, targets = self.teachers[task].draw(number, part, size)
        sizes, one_hot = self.student.config, np.zeros((1, len(self.dims), size), fac.F32)
        one_hot[:, k] = 1
        x = np.concatenate([padded(features, 1, sizes.dim_obs - EMBEDDING), one_hot], 1)
        return x, padded(actions, 1, sizes.dim_action), [
            padded(target, 0, sizes.num_agents, np.nan) for target in targets]

    def step(self):
        """As Distiller's; then embeddings longer than 1 are shortened to 1, as TD-MPC2 does."""
        losses, embedding = super().step(), self.student.params[TASKS]
        embedding /= np.maximum(1, np.linalg.norm(embedding, axis=1, keepdims=True))
        return losses

    def run(self):
        for losses in super().run():
            if self.t in self.saved:
                fac.check_finite("weights are", self.optimizer.vector, self.t, self.config.lr)
                save(self.saved[self.t], self.student, self.header)
            yield losses

    def refresh(self):
        """Give the teachers their own parts of the student, as it is now."""
        for task, teacher in self.teachers.items():
            teacher.student = self.student.of_task(task)

    def ranks(self, states, discount):
        """Distiller.ranks' means over the tasks, which share the states."""
        self.refresh()
        each = -(-states // len(self.teachers))
        return np.mean([teacher.ranks(each, discount) for teacher in self.teachers.values()], 0)
