"""Leaving out kinematics makes plans fast, factoring saves samples: section 4.1 on a 3-link arm.

One arm moves its tip to a goal. The planner is the one that moves the robots, `fac_tdmpc_ref.mppi`;
what differs is the model of the world that it imagines with. Milliseconds of a plan on two busy
cores (`python manipulator_demo.py` measures them anew):

                              plan ms   a transition in it
    centralized, authors' IK    42      tip (x, y): joint angles by their iteration, move, and back
    centralized, closed form     2.1    the same, angles by trigonometry
    joint angles, one agent      0.8    three clipped additions
    factored, three agents       0.9    one for each agent: 15 samples do what takes the other 50

Axes: N agents, H actions in a row (`mppi`'s L: no Q follows), d action dimensions and s state
features of an agent, S samples (always last); `...` is N, goals or nothing. Angles in radians,
lengths in the links' unit, equations as the paper numbers them. A step is 0.1 s (Table 1: freq 10).
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parent / folder) for folder in ("", "data")]
import fac_tdmpc_ref as fac  # noqa: E402

# the task of the authors' notebook
LINKS = np.array([10.0, 20.0, 5.0])
START, GOAL = np.array([-10.0, -20.0]), np.array([10.0, -25.0])
STEP_SECONDS, MAX_TURN = 0.1, 0.01  # a step, and the radians that a joint can turn in it
LOW = np.array([0.0, 0.0, 0.0])  # the angle that action -1 commands, for each joint
SPAN = np.array([2 * np.pi, np.pi, np.pi])  # action +1 commands LOW + SPAN

IK_START = np.array([np.pi, np.pi / 2, np.pi / 2])  # where the authors' solver begins, always
IK_GAIN, IK_TOLERANCE, IK_STEPS = 0.001, 0.01, 500


# 1. Kinematics ========================================================================

HEADING = np.tril(np.ones((3, 3)))  # heading_k = theta_1 + ... + theta_k
LEVER = np.triu(np.ones((3, 3))) * LINKS  # lever_k = links k to 3


def forward_kinematics(theta):
    """f_FK, Equations 12 and 13: angles (..., 3, S) -> tip (..., 2, S). A.1's own line lacks y."""
    heading = HEADING @ theta
    return np.stack([LINKS @ np.cos(heading), LINKS @ np.sin(heading)], axis=-2)


def levers(theta):
    """From each joint to the tip: angles (..., 3, S) -> x and y, (..., 3, S) each. Turning joint k
    moves the tip at right angles to lever k: column k of the Jacobian is (-y_k, x_k)."""
    heading = HEADING @ theta
    return LEVER @ np.cos(heading), LEVER @ np.sin(heading)


def inverse_kinematics(xy):
    """The authors' Jacobian-transpose descent: tip (..., 2, S) -> angles (..., 3, S).

    theta += gain J^T (xy - tip) from IK_START, until the tip is within IK_TOLERANCE. A sample that
    is not there after IK_STEPS keeps the angles it has, as the authors' does."""
    goal_x, goal_y = np.split(xy, 2, axis=-2)  # (..., 1, S)
    theta = IK_START[:, None] + np.zeros_like(goal_x)
    for _ in range(IK_STEPS):
        x, y = levers(theta)
        error_x, error_y = goal_x - x[..., :1, :], goal_y - y[..., :1, :]
        far = error_x**2 + error_y**2 > IK_TOLERANCE**2
        if not far.any():
            break
        gain = IK_GAIN * far
        theta += x * (gain * error_y) - y * (gain * error_x)
    theta[..., 0, :] %= 2 * np.pi
    return theta


START_ANGLES, GOAL_ANGLES = inverse_kinematics(np.stack([START, GOAL], axis=1)).T  # (3,) each


def closed_form_kinematics(xy):
    """The same map without iterations: tip (..., 2, S) -> angles (..., 3, S).

    Three joints reach a point in infinitely many ways; this is, of the two with theta_3 (the wrist)
    nearest to IK_START's, the one of positive bend (theta_2 itself may be negative). With that
    wrist links 2 and 3 are one straight link of length r, which makes the angle `bend` with link 1,
    and a two-link arm has a textbook solution. r is clipped: every reachable point is solved.
    """
    one, two, three = LINKS
    x, y = xy[..., 0, :], xy[..., 1, :]
    distance = np.hypot(x, y)
    r = np.sqrt(two**2 + three**2 + 2 * two * three * np.cos(IK_START[2]))
    r = np.clip(r, np.maximum(two - three, np.abs(distance - one)),
                np.minimum(two + three, distance + one))
    wrist, bend = _angle_between(two, three, r), _angle_between(one, r, distance)
    elbow = bend - np.arctan2(three * np.sin(wrist), two + three * np.cos(wrist))
    shoulder = np.arctan2(y, x) - np.arctan2(r * np.sin(bend), one + r * np.cos(bend))
    return np.stack([shoulder % (2 * np.pi), elbow, wrist], axis=-2)


def _angle_between(a, b, c):
    """Turn between links a and b whose ends are c apart (law of cosines)."""
    return np.arccos(np.clip((c**2 - a**2 - b**2) / (2 * a * b), -1, 1))


def actuate(theta, action, low, span):
    """f_a: an action in [-1, 1], in the paper a force, commands an angle in [low, low + span]; the
    joint turns towards it by MAX_TURN at most (authors' notebook). Shapes broadcast."""
    turn = low + (action + 1) * (span / 2) - theta
    return theta + np.minimum(np.maximum(turn, -MAX_TURN), MAX_TURN)


# 2. The two models ====================================================================

class CentralizedModel:
    """The MDP over tip positions: N = 1, s = 2, d = 3 (Figure 1b)."""

    def __init__(self, solver=inverse_kinematics):
        self.solver, self.agents, self.action_dim = solver, 1, 3

    def observe(self, theta):
        """Angles of the real arm (3,) -> state (1, 2)."""
        return forward_kinematics(theta[:, None]).T

    def step(self, state, action):
        """(x', y') = f_FK(f_a(f_IK(x, y), a)): state (N, 2, S), action (N, 3, S) -> (N, 2, S)."""
        theta = self.solver(state)
        return forward_kinematics(actuate(theta, action, LOW[:, None], SPAN[:, None]))

    def reward(self, state):
        """f_R = -||(x, y) - goal||^2: (N, 2, S) -> (N, S)."""
        return -np.square(state - GOAL[:, None]).sum(axis=1)


class JointModel:
    """The fDec-MDP over joint angles (Figure 1c): N agents with d = s = 3 / N joints each.

    N = 3 is the paper's factored model. N = 1 is the same world, but one search through all joints.
    """

    def __init__(self, agents=3):
        self.agents, self.action_dim = agents, 3 // agents
        self.low, self.span, self.goal = (x.reshape(agents, self.action_dim, 1)
                                          for x in (LOW, SPAN, GOAL_ANGLES))

    def observe(self, theta):
        """Angles of the real arm (3,) -> state (N, s)."""
        return theta.reshape(self.agents, self.action_dim)

    def step(self, state, action):
        """theta_i' = f_a(theta_i, a_i): (N, s, S), (N, d, S) -> (N, s, S)."""
        return actuate(state, action, self.low, self.span)

    def reward(self, state):
        """f_Ri = -(theta_i - goal_i)^2, summed over an agent's joints: (N, s, S) -> (N, S)."""
        return -np.square(state - self.goal).sum(axis=1)


# 3. Planning and moving ===============================================================

# Deviations and temperature are the planner's defaults. Momentum 0: the new mean is the weighted
# average of the elites. Table 1 prints a discount of 0.0: see --help.
TABLE_1 = fac.PlannerConfig(samples=50, iterations=6, elites=5, horizon=4, discount=1.0, momentum=0)


def imagined_return(model, state, actions, discount):
    """Discounted return of imagined rewards: state (N, s), actions (N, H, d, S) -> (N, S).

    Scored is the state that an action leads to, as in the authors' code; read literally, f_R scores
    the one before it, and the first reward would depend on no action at all. 0.0 ** 0 is 1.
    """
    total, state = 0.0, np.repeat(state[..., None], actions.shape[-1], axis=-1)
    for h in range(actions.shape[1]):
        state = model.step(state, actions[:, h])
        total = total + discount**h * model.reward(state)
    return total


class Run:
    """A planner that moves the arm: its angles (steps + 1 of (3,)), seconds a plan, actions."""

    def __init__(self, label, model, config, seed, theta=START_ANGLES):
        self.label, self.model, self.config = label, model, config
        self.rngs = np.random.default_rng(seed).spawn(model.agents)  # an agent owns its stream
        self.mean = np.zeros((model.agents, config.horizon, model.action_dim))
        self.theta, self.seconds, self.actions = [theta], [], []

    def act(self, state):
        """State (N, s) -> actions (N, d) in [-1, 1]: as in the authors' code the first of one
        elite, drawn by score. The next plan starts from this one's mean, shifted by a step."""
        def returns(actions):
            return imagined_return(self.model, state, actions, self.config.discount)
        mean, elites, scores = fac.mppi(returns, self.mean, self.config, self.rngs)
        self.mean = np.concatenate([mean[:, 1:], np.zeros_like(mean[:, :1])], axis=1)
        return fac.draw_elite(elites, scores, self.rngs)[:, 0]

    def step(self):
        """Plan and move. The arm itself is the joints and the actuator, whatever the model."""
        state = self.model.observe(self.theta[-1])
        begin = time.perf_counter()
        self.actions.append(self.act(state))
        self.seconds.append(time.perf_counter() - begin)
        self.theta.append(actuate(self.theta[-1], self.actions[-1].reshape(3), LOW, SPAN))


# 4. The comparison ====================================================================

def start_runs(config, seed, ik="jacobian-transpose"):
    """The runs to compare, by key: first kinematics is taken away, then the search divided."""
    models = [("centralized", "centralized, authors' IK", CentralizedModel()),
              ("centralized_closed_form", "centralized, closed form",
               CentralizedModel(closed_form_kinematics)),
              ("joints_one_agent", "joint angles, one agent", JointModel(1)),
              ("factored", "factored, three agents", JointModel(3))]
    if ik == "closed-form":
        models[:2] = [("centralized", *models[1][1:])]
    return {key: Run(label, model, config, seed) for key, label, model in models}


def measure(run):
    """What a run cost and where it went, as plain numbers."""
    theta = np.stack(run.theta, axis=1)
    tip = forward_kinematics(theta)  # (2, steps + 1)
    low, median, high = np.percentile(run.seconds, [10, 50, 90]) * 1e3
    result = {"plan_ms_median": median, "plan_ms_p10": low, "plan_ms_p90": high,
              "final_distance": np.hypot(*(tip[:, -1] - GOAL)),
              "path_length": np.hypot(*np.diff(tip)).sum(),
              "joint_travel": np.abs(np.diff(theta)).sum(),
              "joint_net": (theta[:, -1] - theta[:, 0]).tolist(),
              "bend_step": bend(tip, 1), "bend_second": bend(tip, round(1 / STEP_SECONDS))}
    if isinstance(run.model, CentralizedModel):  # its idea of the angles is not the arm's
        gap = np.abs(run.model.solver(tip) - theta)
        result["ik_angle_gap"] = np.minimum(gap, 2 * np.pi - gap).max()
    return result


def bend(tip, lag):
    """Mean length of the path's second difference over lag steps, 0 for steady motion along a
    line: tip (2, T) -> float, or None for a path that is too short."""
    change = tip[:, 2 * lag:] - 2 * tip[:, lag:-lag] + tip[:, :-2 * lag]
    return np.hypot(*change).mean() if change.size else None


def step_share(config, seed, agents, samples):
    """How well samples plan when 1 agent searches all joints, or when each of 3 searches its own:
    mean share of the best step's gain in reward, over 50 poses between start and goal."""
    config = dataclasses.replace(config, samples=samples, elites=TABLE_1.elites)
    poses = START_ANGLES + np.linspace(0, 0.9, 50)[:, None] * (GOAL_ANGLES - START_ANGLES)
    runs = [Run("", JointModel(agents), config, [seed, i], pose) for i, pose in enumerate(poses)]
    for run in runs:
        run.step()
    before, after = np.abs([run.theta for run in runs] - GOAL_ANGLES).swapaxes(0, 1)  # (50, 3)
    best = np.maximum(before - MAX_TURN, 0)  # every joint turns as near as it can
    gain, most = ((before**2 - error**2).sum(axis=1) for error in (after, best))
    return (gain / most).mean()


# 5. Figure and command line ===========================================================

def cost(theta, goal):
    """c_e = ||f_FK(theta) - goal||^2, Equations 11 to 13: (..., 3, S), (..., 2, S) -> (..., S)."""
    return np.square(forward_kinematics(theta) - goal).sum(axis=-2)


def draw_figure(path, runs, share):
    """Figure 11 for both planners, their rewards, and the map of goals; share from goal_map."""
    import plots
    figure, panels = plots.pyplot().subplots(2, 4, figsize=(14, 7.4), layout="constrained")
    (*_, rewards), (*_, plane) = panels
    for row, key, color in zip(panels, ("centralized", "factored"), ("#b3541e", "#1f5fa8")):
        theta = np.stack(runs[key].theta, axis=1)
        tip, seconds = forward_kinematics(theta), STEP_SECONDS * np.arange(theta.shape[1])
        for part, alpha in ((0, 0.25), (1, 0.4), (2, 0.6), (3, 1.0)):
            heading = HEADING @ theta[:, part * (len(seconds) - 1) // 3]
            x, y = np.cumsum(LINKS * [np.cos(heading), np.sin(heading)], axis=1)
            row[0].plot([0, *x], [0, *y], "o-", color=color, alpha=alpha, lw=4)
        row[0].set_aspect("equal", adjustable="datalim")
        row[0].plot(*tip, color="black", lw=1.2)
        row[0].set_title(runs[key].label)
        for axes, values, goals, names, title in (
                (row[1], tip, GOAL, "xy", "tip position"),
                (row[2], theta, GOAL_ANGLES, "123", "joint angles, rad")):
            for value, goal, name, ink in zip(values, goals, names, ("k", "tab:red", "tab:green")):
                axes.plot(seconds, value, color=ink, label=name)
                axes.axhline(goal, color=ink, ls="--", lw=1)
            axes.set(title=title + "\n(dashed: goal)", xlabel="seconds")
            axes.legend(loc="center right", framealpha=0.8)
        rewards.plot(seconds, -cost(theta, GOAL[:, None]), color=color, label=key)
    rewards.set(title=r"reward $-\|(x, y) - goal\|^2$", xlabel="seconds")
    rewards.legend(loc="lower right")
    image = plane.imshow(share, origin="lower", extent=(-35, 35, -35, 35), vmin=0)
    plane.set_title("goals: share of joint-error directions\nwith monotonic reward (white: no IK)")
    figure.colorbar(image, ax=plane, shrink=0.8)
    for axes in (panels[0, 0], panels[1, 0], plane):
        axes.plot(*GOAL, "*", color="#e0a800", markersize=16, markeredgecolor="black", zorder=5)
    plots.save_figure(path, figure)


def make_parser():
    """The command line."""
    parser = fac.Parser(prog="manipulator_demo.py", description=__doc__,
                        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.set_defaults(run=command_demo)
    add = parser.add_argument
    add("--seed", type=int, default=1, help="of all random numbers (default 1)")
    add("--steps", type=int, default=100, help="decisions of 0.1 s (default 100)")
    add("--samples", type=int, default=50, help="action sequences an iteration (default 50)")
    add("--horizon", type=int, default=4, help="imagined steps (default 4)")
    add("--discount", type=float, default=1.0, help="weight of each later reward (default 1.0, as "
        "in the authors' code, which has none). Table 1 says 0.0: as 0**0 = 1, the first reward "
        "then counts and the others do not, and horizon 4 plans like horizon 1 but pays for 4")
    add("--ik", choices=("jacobian-transpose", "closed-form"), default="jacobian-transpose",
        help="the centralized model's inverse kinematics: the authors' iteration, 500 times at "
        "most (default), or an exact form; both may be wrong about the joints, as the report says")
    add("--figure", metavar="PATH.png", help="draw Figure 11 (needs matplotlib)")
    add("--json", action="store_true", help="print the numbers as the last line, in JSON")
    return parser


def planner_config(args):
    """The planner's settings of a command line, which is checked."""
    for name, least in (("seed", 0), ("steps", 1), ("samples", 1), ("horizon", 1)):
        fac.need(least <= getattr(args, name) <= 10**8,
                 f"--{name} must be in {least} to 10**8, not {getattr(args, name)}")
    if args.figure:
        with fac.optional("a clone of the repository", "plots"):
            import plots
        plots.pyplot_for(args.figure)  # UserError now rather than after the run
    return dataclasses.replace(TABLE_1, samples=args.samples, elites=min(5, args.samples),
                               horizon=args.horizon, discount=args.discount)


def run_demo(args, config):
    """Everything that is measured: (runs, result)."""
    runs = start_runs(config, args.seed, args.ik)
    for _ in range(args.steps):  # in turns, so that a busy machine slows them all alike
        for run in runs.values():
            run.step()
    result = {key: measure(run) for key, run in runs.items()}
    ms = [result[key]["plan_ms_median"] for key in runs]
    parts = ("solver", "kinematics", "agents")[-len(ms) + 1:]  # what the next run does without
    result["speedup_parts"] = {part: slow / fast for part, slow, fast in zip(parts, ms, ms[1:])}
    result["speedup"] = ms[0] / ms[-1]
    result["search_space"] = [{"samples": samples,
                               "one_agent": step_share(config, args.seed, 1, samples),
                               "three_agents": step_share(config, args.seed, 3, samples)}
                              for samples in (10, 15, 25, 50, 100)]
    rng = np.random.default_rng([args.seed, 1])
    result.update(derivatives=check_derivatives(rng), signs=check_signs(rng), **monotonicity(rng))
    return runs, result


def print_comparison(args, runs, result):
    """What each run cost and where it went, and where the speed-up comes from."""
    print(f"{args.steps} steps, seed {args.seed}, {fac.cores()} cores, "
          f"{result['seconds_total']:.1f} s in all\n")
    rows = [("", "plan ms", "10% to", "final", "tip", "joint", *["net"] * 3, "bends", "bends"),
            ("", "median", "90%", "dist.", "path", "travel", "1", "2", "3", "0.1 s", "1 s")]
    for key, run in runs.items():
        m = result[key]
        bends = ("-" if b is None else f"{b:.2f}" for b in (m["bend_step"], m["bend_second"]))
        rows.append((run.label, f"{m['plan_ms_median']:.2f}",
                     f"{m['plan_ms_p10']:.3g}-{m['plan_ms_p90']:.3g}", f"{m['final_distance']:.2f}",
                     f"{m['path_length']:.1f}", f"{m['joint_travel']:.2f}",
                     *(f"{net:+.2f}" for net in m["joint_net"]), *bends))
    fac.print_table(rows)
    print(f"""\
joints in radians; net: end less start; bends: mean second difference of the tip's path over 0.1 s
and 1 s, smaller is smoother. Joint 1 has {GOAL_ANGLES[0] - START_ANGLES[0]:.3f} rad to go and can \
turn {MAX_TURN * args.steps:.2f}. The tip does not
tell the joints: inverse kinematics was up to {result['centralized']['ik_angle_gap']:.2f} off.

speed-up of the factored model: x{result['speedup']:.1f} (the paper: x30)""")
    names = {"solver": "by the closed form instead of the authors' iteration",
             "kinematics": "by no kinematics at all",
             "agents": "by three agents instead of one; what these save is samples:"}
    for part, value in result["speedup_parts"].items():
        print(f"  x{value:<6.3g} {names[part]}")
    space = result["search_space"]
    fac.print_table([(label, *(format(row[key], form) for row in space)) for label, key, form in (
        ("share of the best step's gain, by samples", "samples", "d"),
        ("  one agent, 3 joints", "one_agent", ".3f"),
        ("  three agents, 1 joint", "three_agents", ".3f"))])


def command_demo(args):
    """Everything: measure, print, draw."""
    begin, config = time.perf_counter(), planner_config(args)
    runs, result = run_demo(args, config)
    result["seconds_total"] = time.perf_counter() - begin
    print_comparison(args, runs, result)
    print_appendix(result)
    if args.figure:
        import plots
        plots.drawn(draw_figure, args.figure, runs, goal_map(np.random.default_rng([args.seed, 2])))
    settings = {k: v for k, v in vars(args).items() if k != "run"}
    return {**result, "settings": settings, "cores": fac.cores()}


# 6. Optional: appendix A.1, checked by machine ========================================

def cost_gradient(theta, goal):
    """Equations 14 to 17, rows d c_e / d c_1 to c_3: (..., 3, S), (..., 2, S) -> (..., 3, S)."""
    x, y = levers(theta)
    return 2 * ((y[..., :1, :] - goal[..., 1:, :]) * x - (x[..., :1, :] - goal[..., :1, :]) * y)


def check_derivatives(rng, poses=1000, step=1e-5):
    """Equations 14 to 18 against central differences at random poses and goals: {name: error}."""
    theta, goal = rng.uniform(0, 2 * np.pi, (3, poses)), rng.uniform(-35, 35, (2, poses))
    exact = [(cost(theta + shift, goal) - cost(theta - shift, goal)) / (2 * step)
             for shift in step * np.eye(3)[:, :, None]]
    printed, (x, y) = cost_gradient(theta, goal), forward_kinematics(theta)
    return {**dict(zip(("14", "15", "16-17"), map(_error, printed[::-1], exact[::-1]))),
            "18": _error(2 * (y * goal[0] - x * goal[1]), exact[0])}


def _error(form, exact):
    """Largest difference over the largest exact value."""
    return np.abs(form - exact).max() / np.abs(exact).max()


def check_signs(rng, poses=1000):
    """Equations 19, 22, 23 against 14 to 17, for random goals as the paper assumes them, beside the
    last link: (x, y) - goal = sqrt(c_e) (-sin, cos)(c1 + c2 + c3). {equation: largest relative
    error, and the share of random poses where the derivative itself is > 0}."""
    theta = rng.uniform(LOW[:, None], (LOW + SPAN)[:, None], (3, poses))
    root, heading = rng.uniform(0.1, 1, poses), theta.sum(axis=0)  # sqrt(c_e), c1 + c2 + c3
    x, y = forward_kinematics(theta)
    goal = np.stack([x + root * np.sin(heading), y - root * np.cos(heading)])
    exact, (_, two, three) = cost_gradient(theta, goal), LINKS
    forms = {"19": (2, 2 * three * root),
             "22 as printed": (1, 2 * (three * root + two * three * np.cos(theta[2]))),
             "22 corrected": (1, 2 * root * (three + two * np.cos(theta[2]))),
             "23": (0, 2 * (y * goal[0] - x * goal[1]))}
    return {name: {"error": _error(form, exact[row]), "positive": (exact[row] > 0).mean()}
            for name, (row, form) in forms.items()}


def rises(theta, rng, count):
    """Joint errors of 0.001 rad in all directions (3, count), and where c_e rises with |error_i|:
    bool (..., 3, count). The goal is where theta (..., 3) puts the tip, the pose is theta + error,
    the derivatives are Equations 14 to 17 times the error's sign."""
    error = rng.standard_normal((3, count))
    error *= 1e-3 / np.linalg.norm(error, axis=0)
    slope = cost_gradient(theta[..., None] + error, forward_kinematics(theta[..., None]))
    return error, slope * np.sign(error) > 0


def monotonicity(rng):
    """How often c_e rises with each |error_i| and with all three at the task's goal, the latter by
    the errors' signs (-e is like +e), and the unit vector that J maps to 0."""
    error, up = rises(GOAL_ANGLES, rng, 20_000)
    signs, together = np.sign(error * np.sign(error[0])), up.all(axis=0)
    null = np.linalg.svd(np.hstack(levers(GOAL_ANGLES[:, None])).T)[2][-1]
    return {"monotonic_share": {"three": up.mean(axis=1).tolist(), "all": together.mean()},
            "monotonic_by_sign": {
                name: together[(signs[1:].T == pair).all(axis=1)].mean() for name, pair in
                (("+++", (1, 1)), ("++-", (1, -1)), ("+-+", (-1, 1)), ("+--", (-1, -1)))},
            "null_direction": (null * np.sign(null[0])).tolist()}


def goal_map(rng):
    """Share of errors with all three up, for goals over the plane: (60, 60), nan where the
    authors' solver does not get. Rows are y, columns x, from -35 to 35: the links' length."""
    goals = np.mgrid[-35:35:60j, -35:35:60j][::-1].reshape(2, -1)
    theta = inverse_kinematics(goals)
    share = rises(theta.T, rng, 400)[1].all(axis=1).mean(axis=1)
    return np.where(cost(theta, goals) <= IK_TOLERANCE**2, share, np.nan).reshape(60, 60)


def print_appendix(result):
    """Appendix A.1, as checked, in words."""
    print("\nappendix A.1, at random poses: Eq. 14 to 18 against central differences, Eq. 19, 22 "
          "and 23\nagainst 14 to 17, where the paper assumes the goal to be")
    rows = [(key, f"{error:.0e}", "") for key, error in result["derivatives"].items()]
    rows += [(k, f"{m['error']:.0e}", f"{m['positive']:.0%}") for k, m in result["signs"].items()]
    fac.print_table([("Eq.", "relative error", "derivative > 0"), *rows])
    share, sign = result["monotonic_share"], result["monotonic_by_sign"]
    print(f"""\
misprints: f_FK lacks y; Eq. 20 to 22 print an L3 for sqrt(c_e): 22 is 2 sqrt(c_e) (L3 + L2 cos c3),
positive only while cos c3 > -L3/L2; 23 is, only while L3 + L2 cos c3 + L1 cos(c2 + c3) > 0

'monotonic near the goal': share of joint-error directions e in which c_e rises with
  {', '.join(f'|e{i + 1}| {v:.2f}' for i, v in enumerate(share['three']))}, all three \
{share['all']:.2f}
  all three, by the signs of e: {', '.join(f'{k} {v:.2f}' for k, v in sign.items())}
why: near the goal c_e = e'J'J e. Three joints for two coordinates give J'J a null space, here
  ({', '.join(f'{v:.2f}' for v in result['null_direction'])}), along which every |e_i| grows and \
the tip rests, and cross
  terms by which one joint undoes another's error""")


def main(argv=None):
    """Run the command line; returns the exit status."""
    return fac.run_command(make_parser(), argv)


if __name__ == "__main__":
    sys.exit(main())
