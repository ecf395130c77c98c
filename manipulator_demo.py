"""Why a factored model plans faster, on a three-link arm: section 4.1 and appendix A.

One arm, one task (move the tip to a goal), one planner (MPPI), two models of the same world:

    centralized  state (x, y) of the tip. Every imagined transition has to find the joint angles
                 behind (x, y) by inverse kinematics, move them, and come back. 1 agent, 3 actions.
    factored     state theta_i per agent. A transition is one clipped addition. 3 agents, 1 action.

Run `python manipulator_demo.py` for the comparison and for appendix A.1 checked by machine, with
`--help` for what can be changed. NumPy only; matplotlib draws, if it is asked to. The file stands
alone and is read from top to bottom:

    1 kinematics   2 the two models   3 the planner   4 agents in processes   5 the comparison
    6 appendix A.1   7 pictures   8 command line

Axes: N agents, d action dimensions per agent, s state features per agent, H horizon, E elites,
S samples (always last). Angles in radians, lengths in the links' unit, equation numbers as in the
paper. One step is 0.1 s (Table 1: freq 10).
"""

import argparse
import contextlib
import copy
import json
import multiprocessing
import os
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

STEP_SECONDS = 0.1  # Table 1: freq 10
MAX_TURN = 0.01  # radians a joint can turn in one step
LOW = np.array([0.0, 0.0, 0.0])  # the angle that action -1 commands, per joint
SPAN = np.array([2 * np.pi, np.pi, np.pi])  # how much further the one of action +1 is

IK_START = np.array([np.pi, np.pi / 2, np.pi / 2])  # where the authors' solver begins, always
IK_GAIN, IK_TOLERANCE, IK_STEPS = 0.001, 0.01, 500
WRIST = np.pi / 2  # theta_3 that the closed form prefers: the same as in IK_START
NEAR = 1e-3  # radians of joint error that count as 'near the goal'


class UserError(Exception):
    """Something the user can put right; shown as one line."""


# ======================================================================================
# 1. Kinematics
# ======================================================================================


def reach(links):
    """Smallest and largest distance from the base that the tip can have."""
    return max(0.0, 2 * links.max() - links.sum()), links.sum()


def forward_kinematics(theta, links):
    """Ends of all links: theta (3, S), links (3,) -> (2, 3, S); the tip is [:, -1].

    A.1's line for f_FK has only the x row; this is the pair that Equations 12 and 13 use.
    """
    ends = _link_vectors(theta, links, np.empty((2, *theta.shape)))
    ends[:, 1] += ends[:, 0]
    ends[:, 2] += ends[:, 1]
    return ends


def _link_vectors(theta, links, out):
    """Each link as a vector, (2, 3, S) into out."""
    heading = theta.copy()
    heading[1] += heading[0]  # np.cumsum is far slower along this axis
    heading[2] += heading[1]
    np.cos(heading, out=out[0])
    np.sin(heading, out=out[1])
    out *= links[:, None]
    return out


def levers(theta, links, out=None):
    """Vectors from each joint to the tip, (2, 3, S); [:, 0] is the tip itself.

    Turning joint k moves the tip at right angles to lever k, so that the Jacobian's column k is
    (-lever_y, lever_x): one function serves the solver, Equations 14 to 18 and the map of goals.
    """
    out = _link_vectors(theta, links, np.empty((2, *theta.shape)) if out is None else out)
    out[:, 1] += out[:, 2]
    out[:, 0] += out[:, 1]
    return out


def inverse_kinematics(xy, links):
    """The authors' Jacobian-transpose descent: xy (2, S) -> angles (3, S), missed (S,) bool.

    theta += gain J^T (xy - tip) from IK_START. A sample stops when its tip is within IK_TOLERANCE.
    One that is not there after IK_STEPS keeps the angles it has, as the authors' does, and is
    marked as missed: planning goes on with a pose that is off by the remaining distance.
    """
    theta = np.repeat(IK_START[:, None], xy.shape[1], axis=1)
    lever, turn = np.empty((2, *theta.shape)), np.empty((2, *theta.shape))
    for step in range(IK_STEPS + 1):
        levers(theta, links, out=lever)
        error = xy - lever[:, 0]
        missed = np.einsum("is,is->s", error, error) > IK_TOLERANCE**2
        if step == IK_STEPS or not missed.any():
            theta[0] %= 2 * np.pi
            return theta, missed
        error *= IK_GAIN * missed
        np.multiply(lever[0], error[1], out=turn[0])  # J^T error, row k: lever x error
        np.multiply(lever[1], error[0], out=turn[1])
        theta += turn[0]
        theta -= turn[1]


def closed_form_kinematics(xy, links, wrist=WRIST):
    """The same map without iterations: xy (2, S) -> angles (3, S), missed (S,) bool.

    Three joints reach a point in infinitely many ways; of these it takes the one whose theta_3 is
    nearest to wrist. Links 2 and 3 at that wrist are one straight link of length r, and a two-link
    arm has a textbook solution. r is clipped so that every reachable point is solved.
    """
    one, two, three = links
    x, y = xy
    distance = np.hypot(x, y)
    r = np.sqrt(two**2 + three**2 + 2 * two * three * np.cos(wrist))
    r = np.clip(r, np.maximum(abs(two - three), np.abs(distance - one)),
                np.minimum(two + three, distance + one))
    wrist = _angle_between(two, three, r)
    bend = _angle_between(one, r, distance)
    elbow = bend - np.arctan2(three * np.sin(wrist), two + three * np.cos(wrist))
    shoulder = np.arctan2(y, x) - np.arctan2(r * np.sin(bend), one + r * np.cos(bend))
    theta = np.stack([shoulder % (2 * np.pi), elbow, wrist])  # exact wherever the arm can be
    inner, outer = reach(links)
    return theta, (distance < inner - IK_TOLERANCE) | (distance > outer + IK_TOLERANCE)


def _angle_between(a, b, c):
    """Turn between links a and b whose ends are c apart (law of cosines)."""
    return np.arccos(np.clip((c**2 - a**2 - b**2) / (2 * a * b), -1, 1))


def actuate(theta, action, low, span):
    """The non-linear actuator f_a: action in [-1, 1] commands an angle in [low, low + span], and
    the joint turns towards it by MAX_TURN at most. Shapes broadcast."""
    turn = low + (action + 1) * (span / 2) - theta
    return theta + np.minimum(np.maximum(turn, -MAX_TURN), MAX_TURN)


SOLVERS = {"jacobian-transpose": inverse_kinematics, "closed-form": closed_form_kinematics}


# ======================================================================================
# 2. The two models
# ======================================================================================

# Both score the state that an action leads to, as the authors' code does. Read literally,
# f_R(x, y, a) = -||(x, y) - goal||^2 scores the state before it, and the first reward of a plan
# would depend on no action at all.


class CentralizedModel:
    """The MDP over tip positions: N = 1, s = 2, d = 3 (Figure 1b).

    Written for any N, each agent with an arm of its own, which plans for many seeds at once.
    """

    agents, action_dim = 1, 3

    def __init__(self, links, goal, solver=inverse_kinematics):
        self.links, self.goal, self.solver = links, np.reshape(goal, (1, 2, 1)), solver
        self.solved = self.missed = 0  # inverse kinematics: samples so far

    def observe(self, theta):
        """Angles of the real arm (3,) -> state (1, 2)."""
        return forward_kinematics(theta[:, None], self.links)[:, -1].T

    def step(self, state, action):
        """(x', y') = f_FK(f_a(f_IK(x, y), a)): state (N, 2, S), action (N, 3, S) -> (N, 2, S)."""
        agents, _, samples = state.shape
        theta, missed = self.solver(_side_by_side(state), self.links)
        self.solved += missed.size
        self.missed += int(missed.sum())
        theta = actuate(theta, _side_by_side(action), LOW[:, None], SPAN[:, None])
        tip = forward_kinematics(theta, self.links)[:, -1]
        return tip.reshape(2, agents, samples).swapaxes(0, 1)

    def reward(self, state):
        """f_R = -||(x, y) - goal||^2: (N, 2, S) -> (N, S)."""
        return -np.square(state - self.goal).sum(axis=1)


def _side_by_side(x):
    """(N, features, S) -> (features, N * S)."""
    return x.swapaxes(0, 1).reshape(x.shape[1], -1)


class JointModel:
    """The fDec-MDP over joint angles (Figure 1c): N agents of d = s = 3 / N joints.

    N = 3 is the paper's factored model. N = 1 is one agent with all joints: the same transitions
    and rewards, but one search through all of them, which tells dimensions from kinematics.
    """

    def __init__(self, goal_angles, agents=3):
        self.agents, self.action_dim = agents, 3 // agents
        shape = (agents, self.action_dim, 1)
        self.low, self.span = LOW.reshape(shape), SPAN.reshape(shape)
        self.goal = np.reshape(goal_angles, shape)

    def agent(self, i):
        """The part of agent i, a model with N = 1; nothing else is needed to plan for it."""
        part = copy.copy(self)
        part.agents = 1
        part.low, part.span, part.goal = (a[i:i + 1] for a in (self.low, self.span, self.goal))
        return part

    def observe(self, theta):
        """Angles of the real arm (3,) -> state (N, s)."""
        return theta.reshape(self.agents, self.action_dim)

    def step(self, state, action):
        """theta_i' = f_a(theta_i, a_i): (N, s, S), (N, d, S) -> (N, s, S)."""
        return actuate(state, action, self.low, self.span)

    def reward(self, state):
        """f_Ri = -(theta_i - goal_i)^2, summed over an agent's joints: (N, s, S) -> (N, S)."""
        return -np.square(state - self.goal).sum(axis=1)


# ======================================================================================
# 3. The planner: MPPI with Table 1
# ======================================================================================


@dataclass(frozen=True)
class PlannerConfig:
    iterations: int = 6
    samples: int = 50
    elites: int = 5
    horizon: int = 4
    min_std: float = 0.05
    max_std: float = 2.0
    temperature: float = 0.5
    discount: float = 1.0  # Table 1 says 0.0; see --help


def evaluate(model, state, actions, discount):
    """Discounted return of S action sequences: (N, s), (H, N, d, S) -> (N, S).

    0.0 ** 0 is 1: with discount 0 the first reward counts, and only that one.
    """
    returns, state = 0.0, np.repeat(state[..., None], actions.shape[-1], axis=-1)
    for h, action in enumerate(actions):
        state = model.step(state, action)
        returns = returns + discount**h * model.reward(state)
    return returns


def refine(model, state, mean, noise, config):
    """Refine a proposal by sampling: state (N, s), mean (H, N, d, 1), noise (I, H, N, d, S).

    Returns mean (H, N, d, 1), elites (H, N, d, E) and weights (N, E) of the last iteration. Every
    reduction runs within an agent: N agents planned together or apart get the same numbers.
    """
    std = np.full(mean.shape, config.max_std)
    for draw in noise:
        actions = np.clip(mean + std * draw, -1, 1)
        returns = evaluate(model, state, actions, config.discount)
        best = np.argpartition(returns, -config.elites, axis=-1)[:, -config.elites:]  # (N, E)
        value = np.take_along_axis(returns, best, axis=-1)
        weight = np.exp(config.temperature * (value - value.max(axis=-1, keepdims=True)))
        weight /= weight.sum(axis=-1, keepdims=True)
        elites = np.take_along_axis(actions, best[None, :, None, :], axis=-1)
        share = weight[None, :, None, :]
        mean = (share * elites).sum(axis=-1, keepdims=True)
        std = np.sqrt((share * (elites - mean) ** 2).sum(axis=-1, keepdims=True))
        std = np.clip(std, config.min_std, config.max_std)
    return mean, elites, weight


def draw_noise(rngs, action_dim, config):
    """Standard normal (I, H, N, d, S); agent n's part comes from its own generator."""
    shape = (config.iterations, config.horizon, action_dim, config.samples)
    return np.stack([rng.standard_normal(shape) for rng in rngs], axis=2)


class Planner:
    """MPPI for the N agents of a model, which never exchange anything.

    As in the authors' code the proposal starts from the last one, shifted by a step, and the
    action is the first of one elite sequence, drawn by weight.
    """

    def __init__(self, model, config, streams):
        """streams: N SeedSequences (or seeds), one for each agent."""
        self.model, self.config = model, config
        self.rngs = [np.random.default_rng(stream) for stream in streams]
        self.mean = np.zeros((config.horizon, len(streams), model.action_dim, 1))

    def act(self, state):
        """State (N, s) -> actions (N, d) in [-1, 1]."""
        noise = draw_noise(self.rngs, self.model.action_dim, self.config)
        mean, elites, weight = refine(self.model, state, self.mean, noise, self.config)
        self.mean = np.concatenate([mean[1:], np.zeros_like(mean[:1])])
        draw = np.array([[rng.random()] for rng in self.rngs])  # (N, 1)
        chosen = (np.cumsum(weight, axis=-1)[:, :-1] < draw).sum(axis=-1)  # (N,)
        return elites[0, np.arange(len(chosen)), :, chosen]


def spawn_streams(seed, agents):
    """The agents' independent random streams."""
    return np.random.SeedSequence(seed).spawn(agents)


# ======================================================================================
# 4. Agents in processes
# ======================================================================================


def _serve(pipe, model, config, stream):
    """A worker's life: plan for one agent whenever its state arrives."""
    planner = Planner(model, config, [stream])
    pipe.send("ready")
    while (state := pipe.recv()) is not None:
        begin = time.perf_counter()
        action = planner.act(state)
        pipe.send((action, time.perf_counter() - begin))


class ProcessPlanner:
    """Planner's act(), with every agent in a process of its own. Close it after use.

    busy: seconds that the slowest agent planned, one entry a step (the critical path).
    """

    def __init__(self, model, config, streams):
        context = multiprocessing.get_context("spawn")
        self.busy, self.pipes, self.workers = [], [], []
        for i, stream in enumerate(streams):
            ours, theirs = context.Pipe()
            worker = context.Process(
                target=_serve, args=(theirs, model.agent(i), config, stream), daemon=True)
            worker.start()
            theirs.close()  # so that a worker's death ends our recv()
            self.pipes.append(ours)
            self.workers.append(worker)
        self._ask(())

    def act(self, state):
        actions, seconds = zip(*self._ask(state))
        self.busy.append(max(seconds))
        return np.concatenate(actions)

    def _ask(self, state):
        """Everyone's answer to its part of the state; to none at first, when they say 'ready'."""
        try:
            for pipe, own in zip(self.pipes, state):
                pipe.send(own[None])
            return [pipe.recv() for pipe in self.pipes]
        except (EOFError, OSError) as error:
            raise UserError("an agent's process ended before it answered") from error

    def close(self):
        for pipe, worker in zip(self.pipes, self.workers):
            with contextlib.suppress(OSError):  # it may be gone already
                pipe.send(None)
            worker.join(timeout=5)
            pipe.close()


# ======================================================================================
# 5. The comparison
# ======================================================================================


@dataclass(frozen=True)
class Task:
    """The arm and what it has to do; angles are those of the authors' solver."""

    links: np.ndarray  # (3,)
    start: np.ndarray  # (2,)
    goal: np.ndarray  # (2,)
    start_angles: np.ndarray  # (3,)
    goal_angles: np.ndarray  # (3,)


def make_task(links=(10, 20, 5), start=(-10, -20), goal=(10, -25), note=lambda line: None):
    """Solve and check the two poses. Raises UserError for a point that the arm can't take."""
    links = np.array(links, float)
    if not ((links > 1e-6) & (links < 1e6)).all():
        raise UserError("links must be three lengths between 1e-6 and 1e6")
    poses = [_solve_pose(np.array(p, float), links, name, note)
             for p, name in ((start, "start"), (goal, "goal"))]
    return Task(links, np.array(start, float), np.array(goal, float), *poses)


def _solve_pose(point, links, name, note):
    (inner, outer), distance = reach(links), np.hypot(*point)
    place = f"{name} ({point[0]:g}, {point[1]:g})"
    if not inner <= distance <= outer:  # also catches nan
        raise UserError(f"{place} is unreachable: it is {distance:g} from the base, the links "
                        f"{', '.join(f'{link:g}' for link in links)} reach {inner:g} to {outer:g}")
    wrists = np.linspace(0, np.pi, 181)
    wrists = wrists[np.argsort(np.abs(wrists - WRIST), kind="stable")]
    points = np.repeat(point[:, None], len(wrists), axis=1)
    for solver, (theta, missed) in (
            ("authors' solver", inverse_kinematics(point[:, None], links)),
            ("closed form", closed_form_kinematics(points, links, wrists))):
        fits = ~missed & ((theta >= LOW[:, None]) & (theta <= (LOW + SPAN)[:, None])).all(axis=0)
        if fits.any():
            return theta[:, fits.argmax()]
        note(f"the {solver} finds no pose within the joints' ranges for {place}")
    raise UserError(f"{place} needs a joint outside its range (0 to 2 pi for the first, 0 to pi "
                    f"for the others)")


@dataclass
class Run:
    """One planner on its way: the arm's angles (steps + 1 of (3,)), actions and planning time."""

    label: str
    planner: object
    model: object
    theta: list
    seconds: list = field(default_factory=list)
    actions: list = field(default_factory=list)

    def step(self):
        """Plan and move. The arm itself is the joints and the actuator, whatever the model."""
        theta = self.theta[-1]
        state = self.model.observe(theta)
        begin = time.perf_counter()
        action = self.planner.act(state)
        self.seconds.append(time.perf_counter() - begin)
        self.actions.append(action)
        self.theta.append(actuate(theta, action.reshape(3), LOW, SPAN))

    def angles(self):
        """(3, steps + 1)."""
        return np.stack(self.theta, axis=1)


def start_runs(task, config, seed, ik="jacobian-transpose", processes=False):
    """The runs to compare, by key: first kinematics is taken away, then the search divided."""
    def run(label, model, kind=Planner):
        planner = kind(model, config, spawn_streams(seed, model.agents))
        return Run(label, planner, model, [task.start_angles])

    closed = CentralizedModel(task.links, task.goal, closed_form_kinematics)
    factored = JointModel(task.goal_angles)
    runs = {}
    if ik == "jacobian-transpose":
        runs["centralized"] = run("centralized, authors' solver",
                                  CentralizedModel(task.links, task.goal))
    runs["centralized_closed_form" if runs else "centralized"] = run(
        "centralized, closed form", closed)
    runs["joints_one_agent"] = run("joint angles, one agent", JointModel(task.goal_angles, 1))
    runs["factored"] = run("factored, three agents", factored)
    if processes:
        runs["factored_processes"] = run("factored, three processes", factored, ProcessPlanner)
    return runs


def compare(runs, steps):
    """Let the runs take turns, step by step, so that a busy machine slows them all alike."""
    for _ in range(steps):
        for run in runs.values():
            run.step()


def measure(run, task):
    """What a run cost and where it went, as plain numbers."""
    theta = run.angles()
    tip = forward_kinematics(theta, task.links)[:, -1]
    low, median, high = np.percentile(run.seconds, [10, 50, 90]) * 1e3
    result = {
        "plan_ms_median": median, "plan_ms_p10": low, "plan_ms_p90": high,
        "final_distance": np.hypot(*(tip[:, -1] - task.goal)),
        "path_length": np.hypot(*np.diff(tip)).sum(),
        "joint_travel": np.abs(np.diff(theta)).sum(),
    }
    if isinstance(run.model, CentralizedModel):
        believed, _ = run.model.solver(tip, task.links)
        result["ik_missed_share"] = run.model.missed / run.model.solved
        result["ik_angle_gap"] = np.abs((believed - theta + np.pi) % (2 * np.pi) - np.pi).max()
    return {**{key: float(value) for key, value in result.items()},
            "joint_net": (theta[:, -1] - theta[:, 0]).tolist(),
            "bend_step": bend(tip, 1), "bend_second": bend(tip, round(1 / STEP_SECONDS))}


def bend(tip, lag):
    """Mean length of the path's second difference over lag steps, 0 for steady motion along a
    line: tip (2, T) -> float, or None for a path that is too short."""
    change = tip[:, 2 * lag:] - 2 * tip[:, lag:-lag] + tip[:, :-2 * lag]
    return float(np.hypot(*change).mean()) if change.size else None


def speedup_parts(result):
    """The speed-up as a product, one factor for each thing taken away on the way down."""
    ms = [result[key]["plan_ms_median"] for key in
          ("centralized", "centralized_closed_form", "joints_one_agent", "factored")
          if key in result]
    parts = ("solver", "kinematics", "agents")[4 - len(ms):]
    return {part: ms[i] / ms[i + 1] for i, part in enumerate(parts)}


def handover(runs):
    """What three processes cost, medians in milliseconds, and whether they plan the same.

    The actions are compared too: the actuator clips them so hard that different ones often lead
    the same way.
    """
    processes, together = runs["factored_processes"], runs["factored"]
    wall, busy = 1e3 * np.array(processes.seconds), 1e3 * np.array(processes.planner.busy)
    return {"wall_ms_median": float(np.median(wall)),
            "slowest_agent_ms_median": float(np.median(busy)),
            "handover_ms_median": float(np.median(wall - busy)),
            "same_path": (np.array_equal(processes.angles(), together.angles())
                          and np.array_equal(processes.actions, together.actions))}


def search_space(task, config, seed, sizes=(10, 15, 25, 50, 100), plans=50):
    """How well S samples plan when one agent searches all joints, and when each searches its own.

    Mean share of the best possible gain in return, over poses between start and goal; transitions
    and rewards are the same, so that only the number of dimensions searched at once differs.
    """
    poses = task.start_angles + np.linspace(0, 0.9, plans)[:, None] * (
        task.goal_angles - task.start_angles)
    rows = []
    for size in sizes:
        size_config = replace(config, samples=size, elites=min(config.elites, size))
        row = {"samples": size}
        for key, agents in (("one_agent", 1), ("three_agents", 3)):
            model = JointModel(task.goal_angles, agents)
            row[key] = float(np.mean([
                _planned_share(model, pose, size_config, spawn_streams([seed, i], agents))
                for i, pose in enumerate(poses)]))
        rows.append(row)
    return rows


def _planned_share(model, theta, config, stream):
    """(G(plan) - G(stay)) / (G(best) - G(stay)); the best is to command the goal throughout."""
    state = model.observe(theta)
    noise = draw_noise(map(np.random.default_rng, stream), model.action_dim, config)
    mean, _, _ = refine(model, state, np.zeros_like(noise[0, ..., :1]), noise, config)
    hold, best = ((2 * (angle - model.low) / model.span - 1)[None].repeat(config.horizon, axis=0)
                  for angle in (state[..., None], model.goal))
    stay, best, planned = (evaluate(model, state, a, config.discount).sum()
                           for a in (hold, best, mean))
    return (planned - stay) / (best - stay) if best > stay else 1.0


# ======================================================================================
# 6. Appendix A.1, checked by machine
# ======================================================================================


def cost(theta, goal, links):
    """c_e = ||f_FK(theta) - goal||^2, Equations 11 to 13: theta (3, S), goal (2, S) -> (S,)."""
    return np.square(forward_kinematics(theta, links)[:, -1] - goal).sum(axis=0)


def cost_gradient(theta, goal, links):
    """Equations 14 to 17, rows d c_e / d c_1 to c_3: (3, S)."""
    lever = levers(theta, links)
    x, y = lever[:, 0] - goal
    return 2 * (y * lever[0] - x * lever[1])


def check_derivatives(links, rng, poses=1000, step=1e-5):
    """Equations 14 to 18 against central differences at random poses and goals.

    Returns {equation: largest difference over the largest derivative}.
    """
    theta = rng.uniform(0, 2 * np.pi, (3, poses))
    goal = rng.uniform(-1, 1, (2, poses)) * links.sum()
    exact = np.stack([(cost(theta + shift, goal, links) - cost(theta - shift, goal, links))
                      / (2 * step) for shift in step * np.eye(3)[:, :, None]])
    printed = cost_gradient(theta, goal, links)
    x, y = forward_kinematics(theta, links)[:, -1]
    eq18 = 2 * (y * goal[0] - x * goal[1])
    pairs = {"14": (printed[2], exact[2]), "15": (printed[1], exact[1]),
             "16-17": (printed[0], exact[0]), "18": (eq18, exact[0])}
    return {name: _difference(*pair) for name, pair in pairs.items()}


def _difference(form, exact):
    """Largest difference over the largest exact value."""
    return float(np.abs(form - exact).max() / np.abs(exact).max())


def check_signs(links, rng, poses=1000):
    """Equations 19 to 23 under the paper's assumption, at random poses.

    The assumption puts the goal beside the last link: x - gx = -sqrt(c_e) sin(c1 + c2 + c3),
    y - gy = sqrt(c_e) cos(c1 + c2 + c3). Returns the largest relative difference from the exact
    derivative, as printed and as corrected, and the share of poses where the claimed '> 0' holds.
    """
    theta = rng.uniform(LOW[:, None], (LOW + SPAN)[:, None], (3, poses))
    root = rng.uniform(0.1, 1, poses)  # sqrt(c_e)
    heading = theta.sum(axis=0)
    x, y = forward_kinematics(theta, links)[:, -1]
    goal = np.stack([x + root * np.sin(heading), y - root * np.cos(heading)])
    exact = cost_gradient(theta, goal, links)
    _, two, three = links
    forms = {
        "19": (2, 2 * three * root),
        "22 as printed": (1, 2 * (three * root + two * three * np.cos(theta[2]))),
        "22 corrected": (1, 2 * root * (three + two * np.cos(theta[2]))),
        "23": (0, 2 * (y * goal[0] - x * goal[1])),
    }
    return {name: {"error": _difference(form, exact[row]),
                   "positive": float((exact[row] > 0).mean())}
            for name, (row, form) in forms.items()}


def rises(theta, error, links):
    """Where c_e rises with |error_i|: theta (3, G), error (3, D) -> bool (3, G, D).

    The goal is where theta (3, G) puts the tip, the pose is theta + error, and the derivatives
    are Equations 14 to 17 times the sign of the error.
    """
    goal = forward_kinematics(theta, links)[:, -1]
    pose = (theta[:, :, None] + error[:, None, :]).reshape(3, -1)
    slope = cost_gradient(pose, goal.repeat(error.shape[1], axis=1), links)
    return slope.reshape(3, theta.shape[1], -1) * np.sign(error)[:, None] > 0


def directions(rng, count):
    """Random joint errors of length NEAR, evenly over all directions: (3, count)."""
    error = rng.standard_normal((3, count))
    return NEAR * error / np.linalg.norm(error, axis=0)


def monotonic_share(theta, links, error):
    """Shares of the errors (3, D) for which c_e rises with each |error_i|, (3, G), and with all
    three at once, (G,), for goals at theta (3, G)."""
    up = rises(theta, error, links)
    return up.mean(axis=-1), up.all(axis=0).mean(axis=-1)


def sign_patterns(theta, links, error):
    """The same for all three at once, by the signs of the error; theta (3,). -e is like +e."""
    up = rises(theta[:, None], error, links)[:, 0].all(axis=0)
    signs = np.sign(error * np.sign(error[:1]))
    return {"+" + two + three: float(up[(signs[1] == float(two + "1"))
                                        & (signs[2] == float(three + "1"))].mean())
            for two in "+-" for three in "+-"}


def goal_map(links, rng, cells=60, count=400):
    """Monotonic share (all three) over the plane: (cells, cells), nan where the authors' solver
    does not get. Rows are y, columns x, both from -sum(links) to sum(links)."""
    axis = np.linspace(-links.sum(), links.sum(), cells)
    theta, missed = inverse_kinematics(np.stack(np.meshgrid(axis, axis)).reshape(2, -1), links)
    share = np.full(cells * cells, np.nan)
    share[~missed] = monotonic_share(theta[:, ~missed], links, directions(rng, count))[1]
    return share.reshape(cells, cells)


def shares_by_distance(task, error, count=7):
    """Monotonic shares for goals on the ray through the task's goal, at several distances."""
    links, ray = task.links, np.arctan2(task.goal[1], task.goal[0])
    distance = np.linspace(*reach(links), count + 2)[1:-1]
    goals = distance * np.array([[np.cos(ray)], [np.sin(ray)]])
    theta, missed = inverse_kinematics(goals, links)
    three, together = monotonic_share(theta, links, error)
    return [{"distance": float(distance[g]), "three": three[:, g].tolist(),
             "all": float(together[g])} for g in np.flatnonzero(~missed)]


def appendix(task, rng):
    """All of section 6 at the task's goal, as plain numbers."""
    error = directions(rng, 20_000)
    three, together = monotonic_share(task.goal_angles[:, None], task.links, error)
    null = np.linalg.svd(levers(task.goal_angles[:, None], task.links)[:, :, 0])[2][-1]
    return {"derivatives": check_derivatives(task.links, rng),
            "signs": check_signs(task.links, rng),
            "monotonic_share": {"three": three[:, 0].tolist(), "all": float(together[0])},
            "monotonic_by_sign": sign_patterns(task.goal_angles, task.links, error),
            "monotonic_by_distance": shares_by_distance(task, error),
            "null_direction": (null * np.copysign(1, null[0])).tolist()}


# ======================================================================================
# 7. Pictures
# ======================================================================================

INK = {"centralized": "#b3541e", "factored": "#1f5fa8"}
LINES = ("#222222", "#c0392b", "#2a7f62")


def require_plots():
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise UserError("pictures need matplotlib: pip install \"fac-tdmpc-ref[plots]\"") from error


def check_output(path, suffix):
    """A path to write to, or UserError now rather than after the run."""
    path = Path(path)
    if path.suffix.lower() != suffix:
        raise UserError(f"{path} should end in {suffix}")
    if path.is_dir() or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise UserError(f"can't write {path}: its folder is missing or not writable, or it is one")
    return path


def write_file(path, write):
    """write(temporary path), then move into place: no half a file under the real name."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        write(temporary)
        os.replace(temporary, path)
    except OSError as error:
        raise UserError(f"can't write {path}: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _draw_arm(axes, theta, links, **style):
    ends = forward_kinematics(theta[:, None], links)[:, :, 0]
    axes.plot([0, *ends[0]], [0, *ends[1]], "o-", solid_capstyle="round", **style)


def _arm_axes(axes, task, paths):
    """Axes that hold every link of every pose of paths, and the goal."""
    ends = [forward_kinematics(theta, task.links).reshape(2, -1) for theta in paths]
    points = np.concatenate([*ends, task.goal[:, None], np.zeros((2, 1))], axis=1)
    low, high = points.min(axis=1) - 2, points.max(axis=1) + 2
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.plot(*task.goal, "*", color="#e0a800", markersize=16, markeredgecolor="black", zorder=5)
    axes.grid(alpha=0.3)


def figure(path, task, runs, share):
    """Figure 11 for both planners, their rewards, and the map of goals; share from goal_map."""
    from matplotlib.figure import Figure
    fig = Figure(figsize=(14, 7.4), layout="constrained")
    panels = fig.subplots(2, 4, width_ratios=(1.1, 1, 1, 1.15))
    paths = [run.angles() for run in runs.values()]
    for row, theta, (key, run) in zip(panels, paths, runs.items()):
        tip = forward_kinematics(theta, task.links)[:, -1]
        seconds = STEP_SECONDS * np.arange(theta.shape[1])
        _arm_axes(row[0], task, paths)
        for part, alpha in ((0.0, 0.25), (0.33, 0.4), (0.67, 0.6), (1.0, 1.0)):
            pose = theta[:, round(part * (theta.shape[1] - 1))]
            _draw_arm(row[0], pose, task.links, color=INK[key], alpha=alpha, lw=4, markersize=6)
        row[0].plot(*tip, color="black", lw=1.2)
        row[0].set_title(f"{run.label}\n{1e3 * np.median(run.seconds):.3g} ms a step", fontsize=11)
        _draw_lines(row[1], seconds, tip, task.goal, "xy")
        row[1].set_title("tip position\n(dashed: goal)", fontsize=11)
        _draw_lines(row[2], seconds, theta, task.goal_angles,
                    [rf"$\theta_{i + 1}$" for i in range(3)])
        row[2].set_title("joint angles, rad\n(dashed: IK of the goal)", fontsize=11)
        panels[0, 3].plot(seconds, -cost(theta, task.goal[:, None], task.links), color=INK[key],
                          label=key)
    panels[0, 3].set_title(r"reward $-\|(x, y) - goal\|^2$", fontsize=11)
    panels[0, 3].set_xlabel("seconds")
    panels[0, 3].legend(loc="lower right")
    _draw_map(fig, panels[1, 3], task, share)
    write_file(path, lambda temporary: fig.savefig(temporary, dpi=80))


def _draw_lines(axes, seconds, values, goals, names):
    for value, goal, name, color in zip(values, goals, names, LINES):
        axes.plot(seconds, value, color=color, label=name)
        axes.axhline(goal, color=color, ls="--", lw=1)
    axes.set_xlabel("seconds")
    axes.legend(loc="center right", framealpha=0.8)


def _draw_map(fig, axes, task, share):
    outer = task.links.sum()
    image = axes.imshow(share, origin="lower", extent=(-outer, outer, -outer, outer), vmin=0)
    axes.plot(*task.goal, "*", color="#e0a800", markersize=16, markeredgecolor="black")
    axes.set_title("share of joint-error directions in which the\n"
                   "reward is monotonic, by goal (white: no IK)", fontsize=11)
    fig.colorbar(image, ax=axes, shrink=0.8)


def animate(path, task, runs):
    """Both arms side by side as a GIF, in real time (10 steps a second)."""
    from matplotlib.animation import PillowWriter
    from matplotlib.figure import Figure
    fig = Figure(figsize=(8, 4.2))
    panels = fig.subplots(1, 2)
    paths = [run.angles() for run in runs.values()]
    ends = [forward_kinematics(theta, task.links) for theta in paths]
    for axes, theta, (key, run) in zip(panels, paths, runs.items()):
        _arm_axes(axes, task, paths)
        _draw_arm(axes, theta[:, 0], task.links, color=INK[key], lw=5, markersize=7)
        axes.plot([], [], color="black", lw=1)
        axes.set_title(run.label, fontsize=10)

    def frames(temporary):
        writer = PillowWriter(fps=round(1 / STEP_SECONDS))
        with writer.saving(fig, temporary, dpi=70):
            for t in range(paths[0].shape[1]):
                for axes, end in zip(panels, ends):
                    arm, trace = axes.lines[-2:]
                    arm.set_data(*np.hstack([np.zeros((2, 1)), end[:, :, t]]))
                    trace.set_data(*end[:, -1, :t + 1])
                    axes.set_xlabel(f"{t * STEP_SECONDS:.1f} s")
                writer.grab_frame()
    write_file(path, frames)


# ======================================================================================
# 8. Command line
# ======================================================================================

DESCRIPTION = """\
The motivating example of Fac-TDMPC (section 4.1, appendix A): a three-link arm moves its tip to a
goal, planned by the same MPPI with a centralized and with a factored model. Prints how long each
plans and why, then checks appendix A.1 by machine."""

EPILOG = """\
what to look at
  The centralized model's state is the tip (x, y). Each of its samples x horizon x iterations
  imagined transitions needs inverse kinematics. --ik chooses how: 'jacobian-transpose' is the
  authors' iteration (gain 0.001, from (pi, pi/2, pi/2) each time, until the tip is within 0.01,
  500 times at most; what has not converged then is used as it is, and counted). 'closed-form'
  solves a two-link arm whose wrist is kept as near pi/2 as the point allows. Both are functions of
  (x, y) alone, and three joints reach a point in many ways: the arm's true angles differ from the
  model's idea of them, and the report says by how much. The arm that moves is always the real one.

  The factored model's state is a joint angle per agent, its reward -(theta_i - goal_i)^2 with
  goal_i from the authors' solver. It aims at one posture; the centralized one at a point.

about --discount
  Table 1 says 0.0. As 0**0 = 1, the first of the horizon's rewards then counts and the others do
  not: horizon 4 plans like horizon 1 and pays for 4. The authors' code has no discount, which is
  1.0, the default here. Both work on this task, where the greedy step is right; see for yourself.

examples
  python manipulator_demo.py
  python manipulator_demo.py --ik closed-form --discount 0
  python manipulator_demo.py --agents processes --json
  python manipulator_demo.py --figure arm.png --animate arm.gif
"""


MISPRINTS = """\
misprints: f_FK lacks its y row; Eq. 20 to 22 lost sqrt(c_e) in the L2 term: it should be
  2 sqrt(c_e) (L3 + L2 cos c3), positive only while cos c3 > -L3/L2. Eq. 23 is right, but it is
  positive only while L3 + L2 cos c3 + L1 cos(c2 + c3) > 0"""


class Parser(argparse.ArgumentParser):
    def error(self, message):
        self.exit(2, f"{self.prog}: error: {message}\n")


def build_parser():
    default = PlannerConfig()
    parser = Parser(prog="manipulator_demo.py", description=DESCRIPTION, epilog=EPILOG,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--seed", type=int, default=1, help="of all random numbers (default 1)")
    add("--steps", type=int, default=100, help="decisions of 0.1 s (default 100, Table 1)")
    for name, point, what in (("--goal", (10, -25), "where the tip should go"),
                              ("--start", (-10, -20), "where it begins")):
        add(name, type=float, nargs=2, default=point, metavar=("X", "Y"),
            help=f"{what} (default {point[0]} {point[1]})")
    add("--links", type=float, nargs=3, default=(10, 20, 5), metavar=("L1", "L2", "L3"),
        help="lengths of the links (default 10 20 5)")
    for name, what in (("samples", "action sequences an iteration"),
                       ("elites", "sequences that refine the proposal"),
                       ("iterations", "refinements a decision"), ("horizon", "imagined steps")):
        add("--" + name, type=int, default=getattr(default, name),
            help=f"{what} (default {getattr(default, name)}, Table 1)")
    add("--discount", type=float, default=default.discount,
        help="weight of each later reward (default 1.0; Table 1 says 0.0, see below)")
    add("--ik", choices=SOLVERS, default="jacobian-transpose",
        help="inverse kinematics of the centralized model (default jacobian-transpose)")
    add("--agents", choices=("one-process", "processes"), default="one-process",
        help="the factored agents as one array, or in three processes (default one-process)")
    add("--figure", metavar="PATH.png", help="draw Figure 11 (needs matplotlib)")
    add("--animate", metavar="PATH.gif", help="draw the moving arms (needs matplotlib)")
    add("--json", action="store_true", help="print the numbers as the last line, in JSON")
    return parser


def read_options(args):
    """Checked options: (task, config, figure path, animation path)."""
    for name in ("steps", "samples", "elites", "iterations", "horizon"):
        if not 1 <= getattr(args, name) <= 100_000:
            raise UserError(f"--{name} must be in 1 to 100000, not {getattr(args, name)}")
    if args.elites > args.samples:
        raise UserError(f"--elites {args.elites} is more than --samples {args.samples}")
    if not 0 <= args.discount <= 1:
        raise UserError(f"--discount must be in 0 to 1, not {args.discount:g}")
    if args.seed < 0:
        raise UserError(f"--seed must not be negative, but is {args.seed}")
    task = make_task(args.links, args.start, args.goal,
                     lambda line: print(f"note: {line}", file=sys.stderr))
    config = PlannerConfig(iterations=args.iterations, samples=args.samples, elites=args.elites,
                           horizon=args.horizon, discount=args.discount)
    paths = [check_output(path, suffix) if path else None
             for path, suffix in ((args.figure, ".png"), (args.animate, ".gif"))]
    if any(paths):
        require_plots()
    return task, config, *paths


def print_comparison(args, task, runs, result):
    """The table, and the speed-up taken apart."""
    start, goal = (f"({p[0]:g}, {p[1]:g})" for p in (task.start, task.goal))
    print(f"{args.steps} steps from {start} to {goal}, seed {args.seed}, {os.cpu_count()} cores\n")
    form = "{:28}{:>8}{:>12}{:>7}{:>6}{:>8}{:>7}{:>7}{:>7}{:>7}{:>6}".format
    print(form("", "plan ms", "10% to", "final", "tip", "joint", "net", "net", "net", "bends",
               "bends"))
    print(form("", "median", "90%", "dist.", "path", "travel", "1", "2", "3", "0.1 s", "1 s"))
    for key, run in runs.items():
        m = result[key]
        bends = ("-" if m[k] is None else f"{m[k]:.2f}" for k in ("bend_step", "bend_second"))
        print(form(run.label, f"{m['plan_ms_median']:.2f}",
                   f"{m['plan_ms_p10']:.3g}-{m['plan_ms_p90']:.3g}", f"{m['final_distance']:.2f}",
                   f"{m['path_length']:.1f}", f"{m['joint_travel']:.2f}",
                   *(f"{net:+.2f}" for net in m["joint_net"]), *bends))
    print("joints in radians, net is end less start; bends: mean second difference of the tip's "
          "path\nover 0.1 s and over 1 s, smaller is smoother\n")

    names = {"solver": "by the closed form instead of the authors' solver",
             "kinematics": "by no kinematics at all",
             "agents": "by three agents instead of one (in one process; they save samples, below)"}
    print(f"speed-up of the factored model: x{result['speedup']:.1f} (the paper: x30)")
    for part, value in result["speedup_parts"].items():
        print(f"  x{value:<6.3g} {names[part]}")
    if "handover" in result:
        h = result["handover"]
        print(f"three processes: {h['wall_ms_median']:.2f} ms a step; the slowest agent plans for "
              f"{h['slowest_agent_ms_median']:.2f}, handing over\n  takes "
              f"{h['handover_ms_median']:.2f}; same actions and path as in one process, bit for "
              f"bit: {'yes' if h['same_path'] else 'NO'}")


def print_notes(args, task, result):
    """What the table does not say."""
    central, factored = result["centralized"], result["factored"]
    missed, gap = central["ik_missed_share"], central["ik_angle_gap"]
    print(f"centralized: {missed:.2%} of the inverse kinematics missed the tolerance; as (x, y) "
          f"does not tell,\n  it took the joints to be up to {gap:.2f} rad from where they were")
    need = np.abs(task.goal_angles - task.start_angles)
    print(f"factored: joint {need.argmax() + 1} has {need.max():.3f} rad to go and can turn "
          f"{MAX_TURN * args.steps:.2f} in {args.steps} steps")
    for key, scale in (("bend_step", "from step to step"), ("bend_second", "over a second")):
        if central[key] is not None:
            verdict = "is" if factored[key] < central[key] else "is not"
            print(f"the paper calls the factored path the smoother one: {scale} it {verdict}")
    print("\nsearch: share of the best possible gain in return that a plan gets, joint angles only")
    for label, key, form in (("samples an iteration", "samples", "d"),
                             ("one agent, 3 joints", "one_agent", ".3f"),
                             ("three agents, 1 joint", "three_agents", ".3f")):
        print(f"  {label:22}" + "".join(f"{row[key]:8{form}}" for row in result["search_space"]))


def print_appendix(task, result):
    """Section 6 in words."""
    print("\nappendix A.1: d c_e / d c_i against central differences, largest relative error")
    print("  " + "   ".join(f"Eq. {k}: {v:.0e}" for k, v in result["derivatives"].items()))
    print("under the paper's assumption on the goal, against Eq. 14 to 17 at random poses")
    for name, check in result["signs"].items():
        print(f"  Eq. {name:14} relative error {check['error']:<6.1g}"
              f" derivative positive in {check['positive']:.0%}")
    print(MISPRINTS)
    print("\n'monotonic near the goal': share of joint-error directions e in which c_e rises with")
    print(f"  {'goal at distance':22}{'|e1|':>7}{'|e2|':>7}{'|e3|':>7}{'all three':>11}")
    rows = [{"distance": np.hypot(*task.goal), **result["monotonic_share"]}]
    for row in rows + result["monotonic_by_distance"]:
        place = f"{row['distance']:5.1f}" + (" (the task's)" if row is rows[0] else "")
        print(f"  {place:22}" + "".join(f"{v:7.2f}" for v in row["three"]) + f"{row['all']:11.2f}")
    print("  all three, by the signs of e at the task's goal: "
          + ", ".join(f"{k} {v:.2f}" for k, v in result["monotonic_by_sign"].items()))
    null = ", ".join(f"{v:.2f}" for v in result["null_direction"])
    print(f"why: near the goal c_e = e'J'J e, and three joints for two coordinates give J'J a null "
          f"space, here\n  ({null}), along which every |e_i| grows and the tip rests, and "
          f"cross terms by which\n  one joint undoes another's error")


def run_demo(args, task, config):
    """Everything that is measured: (runs, result)."""
    runs = start_runs(task, config, args.seed, args.ik, args.agents == "processes")
    try:
        compare(runs, args.steps)
    finally:
        for run in runs.values():
            if isinstance(run.planner, ProcessPlanner):
                run.planner.close()
    result = {key: measure(run, task) for key, run in runs.items()}
    result["speedup"] = (result["centralized"]["plan_ms_median"]
                         / result["factored"]["plan_ms_median"])
    result["speedup_parts"] = speedup_parts(result)
    if "factored_processes" in runs:
        result["handover"] = handover(runs)
    result["search_space"] = search_space(task, config, args.seed)
    result.update(appendix(task, np.random.default_rng([args.seed, 1])))
    return runs, result


def main(argv=None):
    begin = time.perf_counter()
    args = build_parser().parse_args(argv)
    try:
        task, config, figure_path, animation_path = read_options(args)
        runs, result = run_demo(args, task, config)
        result["seconds_total"] = time.perf_counter() - begin
        print_comparison(args, task, runs, result)
        print_notes(args, task, result)
        print_appendix(task, result)
        print(f"\ntotal {result['seconds_total']:.1f} s")
        shown = {key: runs[key] for key in ("centralized", "factored")}
        if figure_path:
            share = goal_map(task.links, np.random.default_rng([args.seed, 2]))
            figure(figure_path, task, shown, share)
        if animation_path:
            animate(animation_path, task, shown)
    except (UserError, MemoryError) as error:
        print(f"manipulator_demo.py: error: {error}", file=sys.stderr)
        return 2
    if args.json:
        settings = {key: value for key, value in vars(args).items() if key != "json"}
        print(json.dumps({**result, "settings": settings, "cores": os.cpu_count()}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
