#!/usr/bin/env python3
"""Train a TD-MPC expert (Equation 1) and, with --student fac, a student that follows it (C.1).

    python data/train_expert.py --task reacher-easy
    python data/train_expert.py --task reacher-easy --student fac
    python data/train_expert.py --task walker-run --backend torch --mlp-dim 512 --batch-size 512

One loop for two learners: numpy_learner.py's, and PyTorch's (--backend torch), which can use a
GPU or bfloat16. While the learner learns, actors play episodes beside it in processes of their
own, planning with fac.Planner on weights that are newer in every part of an episode.

The folder --out then holds expert.npz and replay.npz, which `fac_tdmpc_ref.py distill --expert`
takes, student.npz, curve.csv and curve.png. A run that was cut off, by --minutes or a kill, goes
on from its checkpoint when the same command is given again, to the same result; one that is over
goes on with more --steps.
"""
import contextlib
import dataclasses
import functools
import sys
import time
from pathlib import Path

import numpy as np

sys.path[:0] = map(str, Path(__file__).resolve().parents[:2])
import fac_tdmpc_ref as fac  # noqa: E402
import plots  # noqa: E402
from numpy_learner import ExpertConfig, Learner, named, unnamed  # noqa: E402
from tables import draw_lines  # noqa: E402

# for a few cores; hidden layers of 512, as in Table 2, make an update three times as dear
TRAINING_DEFAULTS = {"mlp_dim": 256, "batch_size": 128}  # [D6]
# settings of distill that say nothing where an expert still learns
NOT_ONLINE = ("steps", "reuse", "expert_episodes", "held_out")
FOLLOWING_DEFAULTS = {"expert_episodes": 0}  # the student's own instead, each round
TORCH_ONLY = {"device": None, "precision": "float32", "threads": 1}  # and their defaults
DECISIONS = 30_000  # in all, or the next number of whole rounds
REACHERS = "reacher-easy", "reacher-hard"
FINGER_RADIUS, REACHER_LINK = 0.01, 0.09  # of data/reacher.xml, metres
LOSSES = ("consistency", "reward", "value", "kl_reward", "kl_value")
CURVE = ("decisions", "updates", "seconds", "exploration_std", "horizon", "return_mean",
         "return_min", "return_max", *LOSSES, "eval_expert", "eval_student")


# --------------------------------------------------------------------------------- acting

def task_steps(task, config):
    """T: decisions in an episode of a task, at most, with the action repeat of a PlannerConfig."""
    return episode_length(task, config.action_repeat)


@functools.cache
def episode_length(task, repeat):
    """The same, of an action repeat."""
    if not fac.is_gym(task):
        return fac.episode_steps(repeat)
    with contextlib.closing(fac.make_robot(task, repeat)) as robot:
        return robot.episode_steps


class Episode:
    """An episode that is played in parts, so that each can plan with newer weights.

    `observation` (T + 1, O), `action` (T, A) and `reward` (T,) grow as lists. They depend on the
    seed and on the planners that `player`, a name, stood for. exploration_std: None in a test.
    hold: ExpertConfig's `random_hold`.
    """

    def __init__(self, environment, seed, player=None, exploration_std=None, hold=0):
        self.environment, self.seed, self.player = environment, seed, player
        self.exploration_std, self.rng = exploration_std, fac.stream(seed, "exploration")
        self.hold = hold
        self.observation = [fac.checked(environment.reset(seed), (environment.dim_obs,),
                                        "reset: observation")]
        self.action, self.reward, self.over, self.terminated = [], [], False, False
        self._warm_start = None

    def play(self, planner, decisions):
        """Go on with a planner, whose actions get exploration noise, or with None: at random.
        Returns how many of the decisions were left when the episode was over."""
        if planner and self._warm_start:
            planner.own.mean, planner.own.rngs = self._warm_start
        elif planner:
            planner.reset(self.seed)
        while decisions and not self.over:
            action, decisions = self._explore(planner), decisions - 1
            obs, reward, self.over, self.terminated = fac.robot_step(
                self.environment, action, self.environment, len(self.reward))
            if obs is not None:
                self.observation.append(obs)
                self.action.append(action)
                self.reward.append(reward)
        own = planner and planner.own
        self._warm_start = own and (own.mean, own.rngs)
        return decisions

    def next(self):
        """The one that begins after it, unless it is a test."""
        seed = int(fac.stream(self.seed, "next episode").integers(2 ** 31))
        return Episode(self.environment, seed, self.player, self.exploration_std, self.hold)

    def _explore(self, planner):
        if planner is None:
            if self.hold and len(self.action) % self.hold:
                return self.action[-1]
            action = self.rng.uniform(-1, 1, self.environment.dim_action).astype(np.float32)
            return np.sign(action) if self.hold else action
        action = planner.act(self.observation[-1])
        deviation = self.exploration_std or 0.0  # in TD-MPC's code: MPPI's last one, at least this
        noise = deviation * self.rng.standard_normal(action.shape, np.float32)
        return np.clip(action + noise, -1, 1)

    def arrays(self):
        """Observations, actions, rewards and end so far, as ReplayBuffer.add takes them."""
        return (np.stack(self.observation), np.stack(self.action),
                np.array(self.reward, np.float32), self.terminated)


def play_on(episodes, planner, decisions):
    """Go on with the last of a robot's episodes, and, once it is over, with others, for so many
    decisions in all; a test is a single one."""
    while (decisions := episodes[-1].play(planner, decisions)) and (
            episodes[-1].exploration_std is not None):
        episodes.append(episodes[-1].next())


def _acting_worker(connection):
    """Plays its share of the episodes that `Actors` begin; players without a planner: at random."""
    robot, environments = connection.recv(), []
    with contextlib.ExitStack() as stack:
        while True:
            command, *values = connection.recv()
            if command == "begin":
                begun, planners = *values, {}
                for _ in begun[len(environments):]:
                    environments.append(fac.make_robot(*robot))
                    stack.callback(environments[-1].close)
                played = [[Episode(e, *about)] for e, about in zip(environments, begun)]
            elif command == "play":
                decisions, newer = values
                planners.update({name: fac.Planner(*planning) for name, planning in newer.items()})
                for episodes in played:
                    play_on(episodes, planners.get(episodes[-1].player), decisions)
                connection.send("played")
            else:
                connection.send([[e.arrays() for e in episodes] for episodes in played])


class Actors(fac.Workers):
    """Processes that play episodes, part by part, while this one learns."""

    def __init__(self, task, workers, action_repeat=None):
        fac.lookup_task(task)
        super().__init__(_acting_worker, workers, "acting worker")
        self._count = workers
        self.send_all([(task, action_repeat)] * workers)

    def begin(self, episodes):
        """Start episodes: an Episode's values after its environment of each."""
        self._begun = len(episodes)
        self.send_all(("begin", episodes[i::self._count]) for i in range(self._count))

    def play(self, decisions, planners):
        """Let all go on, players with newer planners {player: (model, planner config)}."""
        self.send_all([("play", decisions, planners)] * self._count)

    def episodes(self):
        """For each that was begun a list: of it and of those that followed it so far, what
        `ReplayBuffer.add` takes."""
        self.send_all([("give",)] * self._count)
        played = self.receive_all()
        return [played[i % self._count][i // self._count] for i in range(self._begun)]


# ------------------------------------------------------------------------------- learning

class ReplayBuffer:
    """Episodes in fixed memory, to learn from; the oldest go when it is full.

    Rows, observation (M, O), action (M, A), reward (M,): an episode's decisions, and one row more
    for what the last led to. Of the episodes held, oldest first: the row that each `begins` with,
    its decisions, `lengths`, and whether its last state `terminated` it. capacity in transitions,
    steps: of the longest episode; `count` episodes have been added so far.
    """

    def __init__(self, dim_obs, dim_action, capacity, dtype=np.float32, steps=fac.EPISODE_STEPS):
        rows, self.count, self.end = max(1, capacity // steps) * (steps + 1), 0, 0
        self.observation = np.zeros((rows, dim_obs), dtype)
        self.action = np.zeros((rows, dim_action), dtype)
        self.reward = np.zeros(rows, np.float32)
        self.begins, self.lengths = np.zeros((2, 0), np.int64)
        self.terminated = np.zeros(0, bool)

    def __len__(self):
        """Episodes held."""
        return len(self.lengths)

    def add(self, observation, action, reward, terminated=False):
        """Add an episode: (T + 1, O), (T, A), (T,), and whether its last state ended it."""
        before, n = self.end, len(reward)
        begin = before if before + n < len(self.reward) else 0
        self.end, self.count = begin + n + 1, self.count + 1
        held = (self.begins + self.lengths < begin) | (self.begins >= self.end)
        if begin < before:  # what is behind the newest is older than what comes first
            held &= self.begins < before
        self.begins, self.lengths, self.terminated = (
            np.append(values[held], value) for values, value in (
                (self.begins, begin), (self.lengths, n), (self.terminated, bool(terminated))))
        self.observation[begin:self.end] = observation
        self.action[begin:self.end - 1], self.action[self.end - 1] = action, 0
        self.reward[begin:self.end - 1], self.reward[self.end - 1] = reward, 0

    def state(self):
        """What it holds, as arrays; `load` takes them back."""
        rows = max(self.begins + self.lengths + 1, default=0)
        found = {key: np.asarray(getattr(self, key)) for key in (
            "begins", "lengths", "terminated", "end", "count")}
        return {**found, **{key: getattr(self, key)[:rows] for key in (
            "observation", "action", "reward")}}

    def load(self, state):
        """Hold what a `state` holds."""
        for key in ("observation", "action", "reward"):
            getattr(self, key)[:len(state[key])] = state[key]
        self.begins, self.lengths = state["begins"], state["lengths"]
        self.terminated, self.end = state["terminated"], int(state["end"])
        self.count = int(state["count"])

    def sample(self, rng, batch, steps):
        """Segments drawn evenly, float32: observations (H + 1, O, B), actions (H, A, B), rewards
        (H, B), and where they begin: episodes and steps, (B,) each."""
        ends = np.cumsum(np.maximum(self.lengths - steps + 1, 0))  # of each episode's starts
        fac.need(len(ends) and ends[-1], f"no episode has the {steps} decisions to learn from; "
                 "lower the horizon")
        drawn = rng.integers(ends[-1], size=batch)
        episode = np.searchsorted(ends, drawn, "right")
        start = drawn - ends[episode] + self.lengths[episode] - steps + 1
        rows = self.begins[episode] + start + np.arange(steps + 1)[:, None]
        obs = self.observation[rows].astype(np.float32)
        action = self.action[rows[:-1]].astype(np.float32)
        return obs.swapaxes(1, 2), action.swapaxes(1, 2), self.reward[rows[:-1]], (episode, start)

    def continues(self, where, steps):
        """Of segments that begin there, (H, B), float32: 0 where a decision's next state ended the
        episode, so that nothing is worth anything beyond it, else 1, also where the time did."""
        episode, start = where
        last = start + np.arange(1, steps + 1)[:, None] == self.lengths[episode]
        return np.float32(~(last & self.terminated[episode]))

    def write(self, path, header, episodes=0):
        """A file for `Replay` with `episodes` (0: all that are held), oldest first, spread evenly
        over training: the newest alone don't show a student what to do once it has fallen. An
        episode's last row has no action. header names the task, for `spread_targets`."""
        count = min(episodes or len(self), len(self))
        order = np.arange(len(self))[::-1][np.arange(count) * len(self) // count][::-1]
        lengths = self.lengths[order] + 1
        rows = np.concatenate([begin + np.arange(n)
                               for begin, n in zip(self.begins[order], lengths)])
        continues = np.ones(len(rows), bool)
        continues[np.cumsum(lengths) - 1] = False
        observation = self.observation[rows]
        spread_targets(header["task"], observation, fac.stream(0, "replay targets"))
        fac.write_npz(path, {"kind": "replay", **header}, {
            "observation": fac.compact(observation), "continues": continues,
            "action": fac.compact(self.action[rows])}, compress=True)


def make_learner(args, sizes, config):
    """NumPy's learner or PyTorch's, both from the same fresh weights.

    Either has `update(obs, actions, reward, rng, continues)`, the number of `updates` made, its
    `model` as fac.WorldModel, `state()` and `load(arrays)`, and `about`, for the expert's file.
    """
    rng = fac.stream(args.seed, "expert")
    if args.backend == "numpy":
        return Learner(sizes, config, rng)
    with fac.optional("PyTorch", "torch"):
        import torch
    from torch_learner import TorchLearner
    torch.set_num_threads(args.threads)
    model = fac.WorldModel.create(sizes, rng, policy=True)
    try:
        return TorchLearner(model, config, args.device, args.precision)
    except (AssertionError, RuntimeError, ImportError) as error:  # no such device, or none here
        raise fac.UserError(f"--device {args.device}: {str(error).splitlines()[0]}") from None


class OnlineStudent:
    """Appendix C.1: Algorithm 1 with an expert that goes on learning, on states of its batches.

    own: a ReplayBuffer of episodes that it played; once there are any, a share of its states is
    from them [D8].
    """

    def __init__(self, expert, num_agents, config, seed, own):
        self.config, self.seed, self.own = config, seed, own
        sizes = fac.student_config(expert.config, num_agents, config.encoder_input,
                                   (config.horizon + 1) * config.priors)
        self.optimizer, self.model = fac.new_student(expert, sizes, seed)
        self.optimizers, self.priors = {"student": self.optimizer}, None
        if config.priors:
            self.priors = self.optimizers["priors"] = fac.Adam(fac.prior_weights(self.model))
            self.model.params.update(self.priors.params)  # views of its vector

    def update(self, expert, obs, actions):
        """One step of Algorithm 1 on the first `batch_size` of observations (O, B) and actions
        (H, A, B); its divergences."""
        config, t, L = self.config, self.optimizer.t, self.config.horizon + 1
        rng, obs = fac.stream(self.seed, "perturbations", t), obs[:, :config.batch_size]
        actions = actions[:L, :, :config.batch_size].copy()
        if len(self.own):
            mine = slice(int(config.played_share * obs.shape[1]))
            found, played, *_ = self.own.sample(rng, mine.stop, L)
            obs[:, mine], actions[:, :, mine] = found[0], played
        actions = fac.around_policy(expert, obs, actions, config.policy_share, rng)
        batch = fac.taught_batch(expert, self.model, obs, actions[..., None], config, rng)
        _, *divergences = fac.distill_loss(self.model, *batch, config, self.optimizer.grads)
        self.optimizer.step(rate := fac.learning_rate(config, t), config.grad_clip)
        if self.priors:
            plans = fac.policy_plan(expert, obs, L, self.model.config)
            fac.prior_loss(self.model, batch[0], plans, config.lam, self.priors.grads)
            self.priors.step(rate, config.grad_clip)
        return divergences


def move_target(obs, reward, back, chosen, task, action_repeat=fac.ACTION_REPEAT):
    """Move the target of reacher segments back by `back` (B, 2) where chosen (B,), in place.

    The observation is (3 joints, 2 finger-to-target, 3 velocities) and the dynamics don't know
    the target, so this gives a true segment of an episode with another target; `back` = a later
    step's finger-to-target puts it where the finger is then. obs (H+1, B, 8), reward (H, B): the
    new one is that of the decision's end for all its repeated actions.
    """
    radius = fac.REACHER_TARGET[task.removeprefix("reacher-")] + FINGER_RADIUS
    obs[:, chosen, 3:5] -= back[chosen]
    distance = np.linalg.norm(obs[1:, chosen, 3:5], axis=-1)
    reward[:, chosen] = action_repeat * (distance <= radius)


def draw_targets(obs, rng):
    """Finger-to-target (2, B) of reacher states (8, B) for targets drawn as the task draws them."""
    heading = np.cumsum(obs[:3], 0)
    finger = REACHER_LINK * np.stack([np.cos(heading).sum(0), np.sin(heading).sum(0)])
    angle, radius = rng.uniform(0, 2 * np.pi, obs.shape[1]), rng.uniform(0.05, 0.2, obs.shape[1])
    return radius * np.stack([np.cos(angle), np.sin(angle)]) - finger


def hindsight(task, buffer, where, obs, reward, rng, action_repeat=fac.ACTION_REPEAT):
    """Give three quarters of reacher's segments another target, in place [D6].

    Two thirds of these: where the finger is at a later step of the same episode; one third: drawn
    as the task draws it. where, obs, reward: as ReplayBuffer.sample gives them. Of other tasks
    nothing changes.
    """
    if task not in REACHERS:
        return
    episode, start = where
    row = buffer.begins[episode] + rng.integers(start + 1, buffer.lengths[episode] + 1)
    moved, fresh = rng.random((2, len(start))) < [[3 / 4], [1 / 3]]
    back = np.where(fresh, obs[0, 3:5] - draw_targets(obs[0], rng),
                    buffer.observation[row, 3:5].T).T
    move_target(obs.swapaxes(1, 2), reward, back.astype(np.float32), moved, task, action_repeat)


def spread_targets(task, observation, rng):
    """Give half of the states (M, O) of reacher's replay a target drawn anew, in place [D6].

    Else a student would see one target an episode. The expert saw more by `hindsight`, from which
    this differs: a student reads a sequence's first state, and the actions that followed.
    """
    if task in REACHERS:
        moved = rng.random(len(observation)) < 0.5
        observation[moved, 3:5] = draw_targets(observation[moved].T.astype(np.float32), rng).T


class Training:
    """An expert that learns, the student that may follow it, and their replay.

    Rounds: while the actors play `envs` episodes, with new weights every `refresh` decisions, the
    learner makes the updates that the decisions so far allow. Everything depends on the seed, not
    on the number of workers, and all of it is in `save`.
    """

    def __init__(self, args, config, planning, distilling):
        dim_obs, dim_action = fac.lookup_task(args.task)
        self.args, self.config, self.planning = args, config, planning
        sizes = fac.ModelConfig(dim_obs, dim_action, 1, config.latent_dim, config.enc_dim,
                                config.mlp_dim)
        self.learner = make_learner(args, sizes, config)
        self.steps = task_steps(args.task, planning)
        new_buffer = functools.partial(ReplayBuffer, dim_obs, dim_action, config.buffer_size,
                                       np.dtype(config.buffer_dtype), self.steps)
        self.buffer = new_buffer()
        self.student = distilling and OnlineStudent(self.learner.model, args.num_agents,
                                                    distilling, args.seed, new_buffer())
        self.decisions, self.allowed, self.seconds, self.curve = 0, 0.0, 0.0, []
        self.settings = {key: getattr(args, key) for key in (
            "task", "seed", "backend", "envs", "refresh", "evaluate_every", "num_agents")}
        self.settings["config"] = dataclasses.asdict(config)
        self.settings["distill"] = dataclasses.asdict(distilling) if distilling else {}
        self.settings["action_repeat"] = planning.action_repeat
        # these, like the planner, may change between two stretches of a run
        self.settings["config"].pop("updates_per_step")
        self.settings["distill"].pop("steps", None)
        self.planners()  # what they refuse is missed now, not after the random episodes

    @property
    def models(self):
        """What is learned, by name."""
        student = {"student": self.student.model} if self.student else {}
        return {"expert": self.learner.model, **student}

    @property
    def warming(self):
        """Whether actions are still random."""
        return self.decisions < self.config.seed_decisions

    def scheduled(self):
        """What changes over the first decisions (TD-MPC): while exploring, the planner's floor
        min_std, which is the noise's deviation too, falls, and its horizon grows."""
        over = [0, self.config.std_steps]
        std = np.interp(self.decisions, over, [self.config.std_start, self.planning.min_std])
        horizon = np.interp(self.decisions, over, [1, self.planning.horizon])
        return {"exploration_std": float(std), "horizon": int(horizon)}

    def explorers(self):
        """The planners of a round's episodes, with the weights of now, as `Actors.play` takes them.
        """
        if self.warming:
            return {}
        planners = self.planners()
        model, planning = planners["expert"]
        planning = dataclasses.replace(planning, min_std=self.scheduled()["exploration_std"])
        own = {"own": planners["student"]} if self.student else {}
        return {"explorer": (model, planning), **own}

    def explorations(self):
        """A round's training episodes, then as many of the student's own, as `Actors.begin` takes
        them."""
        first, std = self.decisions // self.steps, self.scheduled()["exploration_std"]
        follows = self.student and self.student.config.played_share and not self.warming
        hold = self.config.random_hold
        return [(seed, player, deviation, hold) for use, player, deviation, count in (
            ("training episode", "explorer", std, self.args.envs),
            ("own episode", "own", 0.0, self.args.envs if follows else 0))
            for seed in fac.training_seeds(self.args.seed, use, first, count)]

    def planners(self):
        """An evaluation's planners, as `Actors.play` takes them: the budget and horizon of now."""
        planning = dataclasses.replace(self.planning, horizon=self.scheduled()["horizon"])
        planners = {"expert": (self.learner.model, planning)}
        if self.student:
            config, around = self.student.config, fac.student_planning(self.student.config)
            few = planning.elites <= around.get("samples", planning.samples)
            planners["student"] = self.student.model, dataclasses.replace(
                planning, horizon=min(planning.horizon, config.horizon),
                elites=planning.elites if few else 0, **around)
        return planners

    def tests(self):
        """An evaluation's episodes."""
        seeds = fac.episode_seeds(self.args.seed + 1, self.args.evaluate_episodes)
        return [(seed, name) for name in self.models for seed in seeds]

    def learn(self):
        """One update of the expert and, on its batch, one of the student; their LOSSES."""
        config, updates, H = self.config, self.learner.updates, self.config.horizon
        rng = fac.stream(self.args.seed, "update", updates)
        steps = max(H, self.student.config.horizon + 1) if self.student else H
        obs, actions, reward, where = self.buffer.sample(rng, config.batch_size, steps)
        hindsight(self.args.task, self.buffer, where, obs, reward, rng, self.planning.action_repeat)
        losses = self.learner.update(obs[:H + 1], actions[:H], reward[:H], rng,
                                     self.buffer.continues(where, H))
        losses += self.student.update(self.learner.model, obs[0], actions) if self.student else [
            0.0, 0.0]
        fac.check_finite("losses are", losses, updates + 1, config.lr)
        return losses

    def learn_until(self, updates, bar):
        """Updates until there were so many; returns their losses."""
        losses = []
        while self.learner.updates < updates:
            losses.append(self.learn())
            bar.update()
        return losses

    def round(self, actors, bar):
        """Episodes and the updates they allow, side by side; adds a row to the curve.

        Evaluations are of the weights at the round's start: they belong to the row before.
        """
        envs, quota, began = self.args.envs, self.args.envs * self.steps, time.monotonic()
        warming, row = self.warming, {**dict.fromkeys(CURVE), **self.scheduled()}
        tested = self.curve and not warming and self.decisions % self.args.evaluate_every < quota
        tests, planners = (self.tests(), self.planners()) if tested else ([], {})
        playing = self.explorations()
        actors.begin(playing + tests)
        losses, start = [], self.learner.updates
        due = 0 if warming else int(self.allowed) - start
        for played in range(0, self.steps, self.args.refresh):
            end = min(played + self.args.refresh, self.steps)
            actors.play(end - played, {**planners, **self.explorers()})
            losses += self.learn_until(start + due * end // self.steps, bar)
            actors.receive_all()
            planners = {}
        episodes = actors.episodes()
        for (_, player, *_), played in zip(playing, episodes):
            for episode in played:
                (self.student.own if player == "own" else self.buffer).add(*episode)
        self.decisions += quota
        if warming and not self.warming:  # one round's behind, as later
            losses = self.learn_until(int(self.allowed), bar)
        self.allowed += self.config.updates_per_step * quota
        self.seconds += time.monotonic() - began
        self.note(tests, episodes[len(playing):])
        returns = [float(reward.sum()) for played in episodes[:envs]  # the last one was cut off
                   for *_, reward, _ in played[:-1] or played]
        row.update(decisions=self.decisions, updates=self.learner.updates,
                   seconds=round(self.seconds, 1), return_mean=float(np.mean(returns)),
                   return_min=min(returns), return_max=max(returns))
        row.update(zip(LOSSES, np.mean(losses, 0).tolist() if losses else ()))
        self.curve.append(row)
        bar.set_postfix_str(f"{self.decisions:,} decisions, return {np.mean(returns):.0f}", False)

    def note(self, tests, episodes):
        """Put an evaluation's mean returns, if there was one, into the last row."""
        for name in dict.fromkeys(name for _, name in tests):
            returns = [reward.sum() for (_, player), ((*_, reward, _),) in zip(tests, episodes)
                       if player == name]
            self.curve[-1][f"eval_{name}"] = float(np.mean(returns))

    def finish(self, actors, bar):
        """The updates that are left, and an evaluation of what came out."""
        began = time.monotonic()
        self.learn_until(int(self.allowed), bar)
        self.curve[-1]["updates"] = self.learner.updates
        actors.begin(tests := self.tests())
        for played in range(0, self.steps, 25):  # actors notice soon if this process ends
            actors.play(25, {} if played else self.planners())
            actors.receive_all()
        self.note(tests, actors.episodes())
        self.seconds += time.monotonic() - began

    def save(self, out):
        """Write the checkpoint and then, for it holds their rows, the curve."""
        learned = self.learner.state()
        if self.student:
            learned.update(named("own", self.student.own.state()))
            for name, optimizer in self.student.optimizers.items():
                learned.update(named(name, fac.optimizer_state(optimizer)))
        for key, value in learned.items():
            fac.check_finite(f"weights ({key}) are", value, self.learner.updates, self.config.lr)
        header = {key: getattr(self, key) for key in ("settings", "decisions", "allowed", "seconds",
                                                      "curve")}
        fac.write_npz(out / "checkpoint.npz", {"kind": "checkpoint", **header,
                                               "updates": self.learner.updates},
                      {**learned, **self.buffer.state()})
        fac.write_curve(out / "curve.csv", CURVE, [[row[key] for key in CURVE]
                                                   for row in self.curve])

    def load(self, path):
        """Go on from what `save` wrote; UserError if it is another run's."""
        header, arrays = fac.read_npz(path, ("checkpoint",))
        try:
            fac.same_settings(header["settings"], self.settings, path)
            self.learner.load(arrays)
            if self.student:
                for name, optimizer in self.student.optimizers.items():
                    fac.load_optimizer(optimizer, unnamed(name, fac.optimizer_state(optimizer),
                                                          arrays))
                own = self.student.own
                own.load(unnamed("own", own.state(), arrays))
            self.buffer.load(arrays)
            for key in ("decisions", "allowed", "seconds", "curve"):
                setattr(self, key, header[key])
            if min(self.decisions, self.allowed, abs(self.seconds)) < 0 or any(
                    row.keys() != {*CURVE} for row in self.curve):
                raise ValueError("curve")
        except (LookupError, TypeError, ValueError, AttributeError,
                RuntimeError) as error:  # the last is PyTorch's
            raise fac.UserError(f"{path}: damaged ({error!r}); choose another --out, or empty it"
                                ) from None


def lag(curve, fraction):
    """Decisions from the expert's reaching a fraction of its last evaluation to the student's.

    None where the student never got there.
    """
    tests = [row for row in curve if row["eval_student"] is not None]
    if not tests or not tests[-1]["eval_expert"] > 0:
        return None
    goal = fraction * tests[-1]["eval_expert"]
    expert, student = (next((row["decisions"] for row in tests if row[key] >= goal), None)
                       for key in ("eval_expert", "eval_student"))
    return None if expert is None or student is None else student - expert


# --------------------------------------------------------------------------- command line

def read_settings(args):
    """(training, planning, distillation or None) of a command line; UserError if they don't fit."""
    config = fac.from_args(ExpertConfig, args, **TRAINING_DEFAULTS)
    planning = fac.from_args(fac.PlannerConfig, args, horizon=config.horizon,
                             discount=config.discount,
                             **fac.made_for({"task": args.task}, "--task"))
    distilling = fac.from_args(fac.DistillConfig, args, **FOLLOWING_DEFAULTS)
    fac.need(0 <= args.minutes < np.inf, f"--minutes: expected 0 or more, found {args.minutes}")
    if not planning.min_std <= config.std_start <= planning.max_std:
        raise fac.UserError(f"training: std_start must lie between the planner's min_std and "
                            f"max_std ({planning.min_std}, {planning.max_std}), not "
                            f"{config.std_start}")
    quota = args.envs * task_steps(args.task, planning)
    if args.steps is None:
        args.steps = -(-DECISIONS // quota) * quota
    fac.need(args.steps and args.steps % quota == 0, f"--envs {args.envs} needs --steps of whole "
             f"rounds of {quota}, not {args.steps}")
    fac.need(args.student or args.num_agents is None, "--num-agents needs --student")
    fac.need(distilling.encoder_input == "latent" or not distilling.policy_share,
             "--distill-encoder-input observation needs --distill-policy-share 0")
    for name, default in TORCH_ONLY.items():
        fac.need(args.backend == "torch" or getattr(args, name) == default,
                 f"--{name} needs --backend torch")
    _, dim_action = fac.lookup_task(args.task)
    if not args.student:
        return config, planning, None
    fac.need(distilling.batch_size <= config.batch_size, f"--distill-batch-size "
             f"{distilling.batch_size}: at most --batch-size ({config.batch_size}), the expert's")
    args.num_agents = dim_action if args.num_agents is None else args.num_agents
    updates = max(1, int(config.updates_per_step * args.steps))
    return config, planning, dataclasses.replace(distilling, steps=updates)


def train(args):
    """Train, or go on, until --steps or --minutes; returns the result."""
    settings, out = read_settings(args), Path(args.out or f"runs/train-{args.task}-{args.seed}")
    with fac.locked(out):
        return train_in(out, args, *settings)


def train_in(out, args, config, planning, distilling):
    """`train` in a folder that is its own."""
    training, checkpoint = Training(args, config, planning, distilling), out / "checkpoint.npz"
    if checkpoint.exists():
        training.load(checkpoint)
    else:
        fac.need(not args.resume, f"{checkpoint}: no such file; there is nothing to resume")
        fac.need_none(out, *(f"{name}.{end}" for name in ("expert", "student") for end in (
            "npz", "json")), "replay.npz", "curve.csv", "curve.png")
    left = config.updates_per_step * max(0, args.steps - training.decisions)
    began, done = time.monotonic(), False
    with Actors(args.task, min(args.workers, args.envs), planning.action_repeat) as actors, \
            fac.one_thread(), fac.progress("training", int(training.allowed + left), "update",
                                           training.learner.updates) as bar:
        while not done and not (args.minutes and time.monotonic() - began > 60 * args.minutes):
            if training.decisions < args.steps:
                training.round(actors, bar)
            else:
                training.finish(actors, bar)
                done = True
            training.save(out)
        if not training.curve:
            training.save(out)
    result = {"task": args.task, "seed": args.seed, "steps": training.decisions,
              "updates": training.learner.updates, "seconds": round(training.seconds, 1),
              "done": done, "out": str(out)}
    if done:
        return export(training, out, result)
    print(f"stopped after {training.decisions:,} decisions; the same command goes on from "
          f"{checkpoint}", file=sys.stderr)
    return result


def export(training, out, result):
    """Write replay and models with their returns, and the picture; print a table; the result."""
    args, config = training.args, training.config
    about = {"task": args.task, "seed": args.seed, "decisions": training.decisions,
             "updates": result["updates"], "action_repeat": training.planning.action_repeat,
             **training.learner.about,
             "training": dataclasses.asdict(config),
             "training_planner": dataclasses.asdict(training.planning)}
    training.buffer.write(out / "replay.npz", about,
                          max(1, int(args.replay / training.buffer.lengths.mean())))
    rows = [("", "return", "ms a decision")]
    for kind, model in training.models.items():
        header, prefix = {"kind": kind, **about}, "" if kind == "expert" else "student_"
        if kind == "student":
            settings = dataclasses.asdict(training.student.config)
            header["distill"] = {k: v for k, v in settings.items() if k not in NOT_ONLINE}
            header["planner"] = fac.student_planning(training.student.config)
        fac.save_model(out / f"{kind}.npz", model, header)
        if args.episodes:
            planner = fac.PlannerConfig(**fac.made_for(header, out))
            found = fac.evaluate(model, args.task, planner, args.episodes, 0, args.workers,
                                 f"evaluating the {kind}")
            returns = found["returns"]
            fac.record_returns(out / f"{kind}.npz", model, planner, 0, returns)
            mean, std = float(np.mean(returns)), float(np.std(returns))
            result.update({f"{prefix}return_mean": mean, f"{prefix}return_std": std,
                           f"{prefix}returns": returns})
            rows.append((f"{kind}, H = {planner.horizon}", f"{mean:.0f} ± {std:.0f}",
                         f"{found['plan_ms_median']:.1f}"))
    if training.student:
        result["lag"] = {str(p): lag(training.curve, p / 100) for p in (50, 75, 90)}
        if args.episodes:
            result["ratio"] = fac.return_kept(result["student_return_mean"], result["return_mean"])
    lines = {}
    for key, label in (("return_mean", "training episodes"), ("eval_expert", "expert"),
                       ("eval_student", "student")):
        points = {row["decisions"]: [row[key]] for row in training.curve if row[key] is not None}
        lines.update({label: points} if points else {})
    plots.drawn(draw_lines, out / "curve.png", {f"{args.task}, seed {args.seed}": (lines, None)},
              "decisions")
    print(f"\n{args.task}: {training.decisions:,} decisions, {result['updates']:,} updates, "
          f"{training.seconds / 60:.1f} minutes; {args.episodes} evaluation episodes\n")
    fac.print_table(rows)
    print(f"\n{out}/")
    return result


def make_parser():
    """The command line, generated from the configs of fac_tdmpc_ref."""
    parser = fac.Parser(
        prog="train_expert.py", description="Train a TD-MPC expert (Equation 1); with --student "
        "fac, distil it on the way (appendix C.1).", epilog="A run that was cut off goes on when "
        "the same command is given again. Its folder is what distill takes as --expert.")
    add, natural = parser.add_argument, fac.natural
    positive = functools.partial(natural, least=1)
    add("--task", default="reacher-easy", help="one of: " + fac.TASK_NAMES)
    add("--steps", type=natural, help="decisions in all; a run that is over goes on with more "
        "[30000, or what makes whole rounds]")
    add("--seed", type=natural, default=0, help="[0]")
    add("--student", choices=("fac",), help="fac: after each update of the expert, one of a "
        "factored student on states of its batch")
    add("--num-agents", type=int, help="the student's N [dim(A)]")
    add("--backend", choices=("numpy", "torch"), default="numpy", help="what learns [numpy]")
    add("--device", help="torch: cpu or cuda [cuda where there is one]")
    add("--precision", choices=("float32", "bfloat16"), default="float32", help="torch: of hidden "
        "layers' products; weights and outputs stay float32 [float32]")
    add("--threads", type=positive, default=1, help="torch: of the updates [1]")
    add("--envs", type=positive, default=4, help="episodes in a round [4]")
    add("--refresh", type=positive, default=25, help="decisions that an episode goes on with the "
        "same weights [D6] [25]")
    add("--workers", type=positive, default=max(1, fac.cores() - 1), help="processes that play "
        "them while this one learns [cores - 1, at least 1]")
    add("--minutes", type=float, default=0, help="stop after the round under way by then; 0: "
        "never [0]")
    add("--resume", action="store_true", help="insist on a checkpoint in --out")
    add("--out", help="folder for the results [runs/train-TASK-SEED]")
    add("--episodes", type=natural, default=20, help="evaluation episodes at the end, with MPPI's "
        "default budget; 0: none [20]")
    add("--replay", type=natural, default=100_000, help="transitions in replay.npz, of "
        "episodes spread evenly over training [100000]")
    add("--evaluate-every", type=positive, default=4_000, help="decisions between two evaluations "
        "on the way [4000]")
    add("--evaluate-episodes", type=positive, default=10, help="episodes in one [10]")
    add("--json", action="store_true", help="print one JSON object as the last line of stdout")
    fac.add_config(parser, ExpertConfig, **TRAINING_DEFAULTS)
    fac.add_config(parser, fac.PlannerConfig, "MPPI while training", "plan-",
                   skip=("discount",))
    fac.add_config(parser, fac.DistillConfig, "The student (Algorithm 1), on the expert's batches "
                   "and steps", "distill-", skip=NOT_ONLINE, **FOLLOWING_DEFAULTS)
    parser.set_defaults(run=train)
    return parser


def main(argv=None):
    """Run the command line; returns the exit status."""
    return fac.run_command(make_parser(), argv)


if __name__ == "__main__":
    sys.exit(main())
