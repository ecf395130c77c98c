"""Tests of manipulator_demo.py: kinematics, planning, appendix A.1, and the command.

The authors' solver and the imagined return are compared with plain loops over single samples that
are written here from the equations. MPPI is the module's: tests/test_planning.py.
"""

import json
import math
import os
import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest

import fac_tdmpc_ref as fac
import manipulator_demo as demo
from toys import ROOT

COLUMN_LOW, COLUMN_SPAN = demo.LOW[:, None], demo.SPAN[:, None]


def random_poses(count, seed=0):
    low, high = COLUMN_LOW, COLUMN_LOW + COLUMN_SPAN
    return np.random.default_rng(seed).uniform(low, high, (3, count))


def reachable_points(count, seed=0):
    """Points spread evenly over the ring that the links reach, 5 to 35 from the base: (2, S)."""
    rng = np.random.default_rng(seed)
    radius, angle = np.sqrt(rng.uniform(5**2, 35**2, count)), rng.uniform(0, 2 * np.pi, count)
    radius[:2] = 5, 35
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)])


def lever_array(theta):
    """(2, 3, S): x and y of the levers."""
    return np.stack(demo.levers(theta))


# kinematics ---------------------------------------------------------------------------


@pytest.mark.parametrize("theta, tip", [
    ((0, 0, 0), (35, 0)),
    ((np.pi / 2, 0, 0), (0, 35)),
    ((0, np.pi / 2, np.pi / 2), (5, 20)),
    ((np.pi, -np.pi / 2, np.pi), (-10, 15)),
])
def test_forward_kinematics(theta, tip):
    result = demo.forward_kinematics(np.array(theta, float)[:, None])
    np.testing.assert_allclose(result[:, 0], tip, atol=1e-12)


def test_levers_are_the_jacobian():
    theta, step = random_poses(50), 1e-6
    lever = lever_array(theta)
    np.testing.assert_allclose(lever[:, 0], demo.forward_kinematics(theta))
    for joint, shift in enumerate(step * np.eye(3)[:, :, None]):
        ahead, behind = (demo.forward_kinematics(theta + s) for s in (shift, -shift))
        column = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(column, [-lever[1, joint], lever[0, joint]], atol=1e-7)


def test_round_trips_over_the_disc():
    xy = reachable_points(2000)
    distance = np.hypot(*(demo.forward_kinematics(demo.inverse_kinematics(xy)) - xy))
    missed = distance > demo.IK_TOLERANCE
    assert 0.02 < missed.mean() < 0.15  # the authors' solver does not reach everywhere
    assert distance[~missed].max() <= demo.IK_TOLERANCE < distance.max()
    closed = demo.closed_form_kinematics(xy)
    np.testing.assert_allclose(demo.forward_kinematics(closed), xy, atol=1e-9)


def test_agents_are_solved_as_if_alone():
    xy = reachable_points(60).reshape(2, 3, 20).swapaxes(0, 1)  # (N, 2, S)
    for solver in (demo.inverse_kinematics, demo.closed_form_kinematics):
        together = solver(xy)
        assert together.shape == (3, 3, 20)
        for agent in range(3):
            np.testing.assert_allclose(together[agent], solver(xy[agent]), rtol=0, atol=1e-12)


def authors_solver_in_a_loop(x, y):
    """The Jacobian-transpose iteration for one point, from the description."""
    t1, t2, t3 = math.pi, math.pi / 2, math.pi / 2
    for step in range(501):
        a, b, c = t1, t1 + t2, t1 + t2 + t3
        px = 10 * math.cos(a) + 20 * math.cos(b) + 5 * math.cos(c)
        py = 10 * math.sin(a) + 20 * math.sin(b) + 5 * math.sin(c)
        ex, ey = x - px, y - py
        if math.hypot(ex, ey) <= 0.01 or step == 500:
            return t1 % (2 * math.pi), t2, t3
        j3 = (-5 * math.sin(c), 5 * math.cos(c))
        j2 = (j3[0] - 20 * math.sin(b), j3[1] + 20 * math.cos(b))
        j1 = (-py, px)
        t1 += 0.001 * (j1[0] * ex + j1[1] * ey)
        t2 += 0.001 * (j2[0] * ex + j2[1] * ey)
        t3 += 0.001 * (j3[0] * ex + j3[1] * ey)


def test_authors_solver_against_a_loop():
    xy = reachable_points(60, seed=3)
    theta = demo.inverse_kinematics(xy)
    missed = np.hypot(*(demo.forward_kinematics(theta) - xy)) > demo.IK_TOLERANCE
    assert 0 < missed.sum() < 15
    alone = np.array([authors_solver_in_a_loop(*point) for point in xy.T]).T
    np.testing.assert_allclose(theta[:, ~missed], alone[:, ~missed], atol=1e-9)
    x, y = demo.forward_kinematics(alone)[:, missed]
    assert (np.hypot(x - xy[0, missed], y - xy[1, missed]) > demo.IK_TOLERANCE).all()


def test_start_and_goal_angles_of_the_authors():
    np.testing.assert_allclose(demo.GOAL_ANGLES, [4.0768, 1.2142, 0.9524], atol=1e-3)
    np.testing.assert_allclose(demo.START_ANGLES, [3.0594, 1.4091, 1.5301], atol=1e-3)


def test_actuator_limits():
    theta = random_poses(500)
    action = np.random.default_rng(1).uniform(-1, 1, (3, 500))
    command = COLUMN_LOW + (action + 1) / 2 * COLUMN_SPAN
    moved = demo.actuate(theta, action, COLUMN_LOW, COLUMN_SPAN)
    assert np.abs(moved - theta).max() <= 0.01 + 1e-15
    assert (moved >= COLUMN_LOW).all() and (moved <= COLUMN_LOW + COLUMN_SPAN).all()
    far = np.abs(command - theta) > 0.01
    np.testing.assert_allclose(np.abs(moved - theta)[far], 0.01)
    assert (np.sign(moved - theta) == np.sign(command - theta))[far].all()
    near = demo.actuate(command + 0.004, action, COLUMN_LOW, COLUMN_SPAN)
    np.testing.assert_allclose(near, command)


# the two models -----------------------------------------------------------------------


def test_the_models_agree_where_the_solver_knows_the_joints():
    theta = demo.closed_form_kinematics(reachable_points(200))
    action = np.random.default_rng(2).uniform(-1, 1, (3, 200))
    central = demo.CentralizedModel(demo.closed_form_kinematics)
    stepped = central.step(demo.forward_kinematics(theta)[None], action[None])
    for agents in (1, 3):
        joints, shape = demo.JointModel(agents), (agents, 3 // agents, 200)
        moved = joints.step(theta.reshape(shape), action.reshape(shape)).reshape(3, 200)
        np.testing.assert_allclose(stepped[0], demo.forward_kinematics(moved), atol=1e-9)


def test_rewards_are_the_squared_ones():
    central = demo.CentralizedModel()
    assert central.reward(np.array([[[13.0], [-21.0]]])).tolist() == [[-25.0]]
    errors = np.array([0.5, -0.25, 2.0])
    theta = (demo.GOAL_ANGLES + errors)[:, None]
    joints, one = demo.JointModel(), demo.JointModel(agents=1)
    np.testing.assert_allclose(joints.reward(theta[:, None]), -errors[:, None] ** 2)
    np.testing.assert_allclose(one.reward(theta[None]), [[-(errors**2).sum()]])


# planning -----------------------------------------------------------------------------


def test_table_1():
    config = demo.TABLE_1
    assert (config.iterations, config.samples, config.elites, config.horizon) == (6, 50, 5, 4)
    assert (config.min_std, config.max_std, config.inverse_temperature) == (0.05, 2.0, 0.5)
    for flags, expected in (([], config), (["--samples", "3"], replace(config, samples=3,
                                                                       elites=3))):
        assert demo.planner_config(demo.make_parser().parse_args(flags)) == expected


@pytest.mark.parametrize("discount", [0.0, 0.7, 1.0])
def test_return_is_the_discounted_sum_of_reached_rewards(discount):
    model = demo.JointModel()
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 4, 1, 6))
    returns = demo.imagined_return(model, demo.START_ANGLES[:, None], actions, discount)
    for joint in range(3):
        for sample in range(6):
            angle, expected = demo.START_ANGLES[joint], 0.0
            for h in range(4):
                action = actions[joint, h, 0, sample]
                command = demo.LOW[joint] + (action + 1) / 2 * demo.SPAN[joint]
                angle += min(max(command - angle, -0.01), 0.01)
                expected -= discount**h * (angle - demo.GOAL_ANGLES[joint]) ** 2
            assert returns[joint, sample] == pytest.approx(expected, rel=1e-12)


def test_what_is_planned_with_and_what_is_kept(monkeypatch):
    """The module's MPPI gets this model's return of this state; the next plan starts a step on."""
    calls, mppi = [], fac.mppi

    def spy(returns, mean, config, rngs):
        found = mppi(returns, mean, config, rngs)
        calls.append((returns, mean, config, rngs, *found))
        return found

    monkeypatch.setattr(fac, "mppi", spy)
    config = replace(demo.TABLE_1, discount=0.7)
    run = demo.Run("", demo.JointModel(), config, seed=0)
    states = [demo.START_ANGLES[:, None], demo.GOAL_ANGLES[:, None]]
    done = [run.act(state) for state in states]
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 4, 1, 6))
    start = np.zeros((3, 4, 1))
    for state, action, (returns, mean, used, rngs, new, elites, scores) in zip(states, done, calls):
        np.testing.assert_array_equal(
            returns(actions), demo.imagined_return(run.model, state, actions, 0.7))
        np.testing.assert_array_equal(mean, start)
        assert used == config and rngs is run.rngs
        start = np.concatenate([new[:, 1:], np.zeros((3, 1, 1))], axis=1)
        assert action.shape == (3, 1) and elites.shape == (3, 4, 1, 5)
        assert (action[:, :, None] == elites[:, 0]).any(axis=2).all()  # the first of an elite
        np.testing.assert_allclose(scores.sum(axis=1), 1, rtol=1e-6)
        average = (scores[:, None, None] * elites).sum(axis=3)  # as the paper's text says
        np.testing.assert_allclose(new, average, atol=1e-6)
    assert len(calls) == 2 and start.any()


def test_agents_do_not_disturb_each_other():
    """Another stream or state of agent 3 leaves the plans of 1 and 2 as they are."""
    def actions(other, angle):
        run = demo.Run("", demo.JointModel(), demo.TABLE_1, seed=5)
        run.rngs[2] = np.random.default_rng(other)
        states = [demo.START_ANGLES + part * np.array([1, 1, angle]) for part in (0.1, 0.2, 0.3)]
        return np.stack([run.act(state[:, None]) for state in states])

    one, other = actions(1, 1), actions(2, 3)
    np.testing.assert_array_equal(one[:, :2], other[:, :2])
    assert (one[:, 2] != other[:, 2]).any()
    assert np.abs(one).max() <= 1


def test_no_two_agents_draw_the_same_numbers():
    run = demo.Run("", demo.JointModel(), demo.TABLE_1, seed=5)
    drawn = np.array([rng.standard_normal(1000) for rng in run.rngs])
    assert drawn.shape == (3, 1000) and np.abs(np.corrcoef(drawn) - np.eye(3)).max() < 0.15


def test_executed_action_is_drawn_by_score(monkeypatch):
    elites = np.arange(3.0)[None, None, None].repeat(4, axis=1)  # (1, H, 1, E): actions 0, 1, 2
    scores = np.array([[0.2, 0.5, 0.3]])
    monkeypatch.setattr(fac, "mppi", lambda *args: (np.zeros((1, 4, 1)), elites, scores))
    run = demo.Run("", demo.JointModel(), demo.TABLE_1, seed=0)
    run.rngs = run.rngs[:1]
    drawn = [int(run.act(np.zeros((1, 1)))[0, 0]) for _ in range(4000)]
    np.testing.assert_allclose(np.bincount(drawn, minlength=3) / 4000, scores[0], atol=0.03)


# whole runs ---------------------------------------------------------------------------


def run_once(model, seed, steps=100, discount=1.0):
    run = demo.Run("", model, replace(demo.TABLE_1, discount=discount), seed)
    for _ in range(steps):
        run.step()
    return np.stack(run.theta, axis=1), np.array(run.actions)


def run_side_by_side(solver, discount, seeds, steps):
    """Centralized runs of many seeds as one planner of many agents, each with an arm of its own:
    the solver's iterations are shared. (3, seeds, steps + 1)"""
    model = demo.CentralizedModel(solver)
    model.agents = len(seeds)
    run = demo.Run("", model, replace(demo.TABLE_1, discount=discount), seed=0)
    run.rngs = [np.random.default_rng(seed).spawn(1)[0] for seed in seeds]
    theta = [np.repeat(demo.START_ANGLES[:, None], len(seeds), axis=1)]
    for _ in range(steps):
        tip = demo.forward_kinematics(theta[-1])
        theta.append(demo.actuate(theta[-1], run.act(tip.T).T, COLUMN_LOW, COLUMN_SPAN))
    return np.stack(theta, axis=-1)


def final_distance(theta):
    """theta (3, S) -> (S,)."""
    return np.sqrt(demo.cost(theta, demo.GOAL[:, None]))


@pytest.mark.parametrize("discount", [1.0, 0.0])
def test_factored_ends_near_the_goal_for_20_seeds(discount):
    ends = [run_once(demo.JointModel(), seed, discount=discount)[0][:, -1] for seed in range(20)]
    assert final_distance(np.stack(ends, axis=1)).max() < 1.0


@pytest.mark.parametrize("solver, discount, seeds", [
    (demo.inverse_kinematics, 1.0, 8), (demo.closed_form_kinematics, 1.0, 20),
    (demo.closed_form_kinematics, 0.0, 20)])
def test_centralized_ends_near_the_goal(solver, discount, seeds):
    paths = run_side_by_side(solver, discount, range(seeds), steps=100)
    assert final_distance(paths[:, :, -1]).max() < 1.0
    assert final_distance(paths[:, :, 0]).min() > 20  # it was not there before
    alone, _ = run_once(demo.CentralizedModel(solver), 7, steps=3, discount=discount)
    np.testing.assert_allclose(paths[:, 7, :4], alone, atol=1e-9)  # side by side changes nothing


@pytest.mark.parametrize("kind, steps", [(demo.CentralizedModel, 8), (demo.JointModel, 60)])
def test_same_seed_same_path(kind, steps):
    path, actions = run_once(kind(), 3, steps)
    again, same_actions = run_once(kind(), 3, steps)
    np.testing.assert_array_equal(path, again)
    np.testing.assert_array_equal(actions, same_actions)
    other = run_once(kind(), 4, steps)[1]
    assert (other != actions).any(axis=(1, 2)).all()  # another seed, other actions each step


def test_measures_of_a_known_path():
    run = demo.Run("", demo.JointModel(), demo.TABLE_1, seed=0)
    run.theta = [np.array([shoulder, 0, 0]) for shoulder in (0.0, 0.01, 0.02, 0.01)]
    run.seconds = [0.001, 0.002, 0.004]
    result = demo.measure(run)
    assert result["plan_ms_median"] == pytest.approx(2.0)
    assert result["plan_ms_p10"] == pytest.approx(1.2)  # of 1, 2 and 4
    assert result["plan_ms_p90"] == pytest.approx(3.6)
    assert result["joint_travel"] == pytest.approx(0.03)
    assert result["joint_net"] == pytest.approx([0.01, 0, 0])
    chord = 2 * 35 * math.sin(0.005)  # of a straight arm of 35 turned by 0.01
    assert result["path_length"] == pytest.approx(3 * chord)
    expected = (chord * 2 * math.sin(0.005) + 2 * chord) / 2  # one bend of 0.01, one turn back
    assert result["bend_step"] == pytest.approx(expected)
    assert result["bend_second"] is None  # shorter than two seconds
    longer = demo.Run("", demo.JointModel(), demo.TABLE_1, seed=0)
    longer.theta = [np.array([0.001 * step**2, 0, 0]) for step in range(31)]
    longer.seconds, tip = [0.001], demo.forward_kinematics(np.stack(longer.theta, axis=1))
    assert demo.measure(longer)["bend_second"] == demo.bend(tip, 10) != demo.bend(tip, 5)
    assert result["final_distance"] == pytest.approx(
        math.hypot(35 * math.cos(0.01) - 10, 35 * math.sin(0.01) + 25))


def test_the_gap_between_arm_and_model():
    solver = demo.closed_form_kinematics
    run = demo.Run("", demo.CentralizedModel(solver), demo.TABLE_1, seed=0)
    believed = solver(np.array([[20.0], [-0.01]]))[:, 0]  # theta_1 near its seam
    run.theta, run.seconds = [believed - [2 * np.pi, 0, 0], believed], [0.001]
    assert demo.measure(run)["ik_angle_gap"] == pytest.approx(0, abs=1e-6)
    run.theta = [np.array([1.0, 0.3, 0.4])]
    gap = np.abs(solver(demo.forward_kinematics(run.theta[0][:, None]))[:, 0] - run.theta[0])
    assert demo.measure(run)["ik_angle_gap"] == pytest.approx(gap.max()) and gap.max() > 0.1


def test_bends_of_known_paths():
    steps = np.arange(31.0)
    assert demo.bend(np.stack([3 * steps, -steps]), 1) == pytest.approx(0, abs=1e-12)
    assert demo.bend(np.stack([steps**2, 0 * steps]), 1) == pytest.approx(2)
    assert demo.bend(np.stack([steps**2, 0 * steps]), 10) == pytest.approx(200)
    rocking = np.stack([(-1) ** steps, 0 * steps])
    assert demo.bend(rocking, 1) == pytest.approx(4)
    assert demo.bend(rocking, 10) == pytest.approx(0)


def test_dividing_the_search_saves_samples():
    one, three = ([demo.step_share(demo.TABLE_1, 0, agents, samples) for samples in (10, 25, 400)]
                  for agents in (1, 3))
    assert three[0] > one[0] + 0.05
    assert one[0] < one[1] <= 1 + 1e-9 and three[0] < three[1] <= 1 + 1e-9
    assert min(one[2], three[2]) > 0.99  # the best gain is what they near


# appendix A.1 -------------------------------------------------------------------------


def test_the_search_space_names_who_searched():
    args = demo.make_parser().parse_args(["--steps", "1", "--ik", "closed-form"])
    _, result = demo.run_demo(args, demo.planner_config(args))
    assert all(row["three_agents"] > row["one_agent"] for row in result["search_space"][:3])


@pytest.mark.parametrize("ik, parts", [
    ("jacobian-transpose", {"solver": 6, "kinematics": 5, "agents": 2}),
    ("closed-form", {"kinematics": 5, "agents": 2})])
def test_the_speed_up_s_parts_name_what_the_next_run_does_without(ik, parts, monkeypatch):
    ms = {"centralized, authors' IK": 60, "centralized, closed form": 10,
          "joint angles, one agent": 2, "factored, three agents": 1}
    monkeypatch.setattr(demo.Run, "step", lambda run: None)
    monkeypatch.setattr(demo, "measure", lambda run: {"plan_ms_median": ms[run.label]})
    monkeypatch.setattr(demo, "step_share", lambda *_: 1.0)
    args = demo.make_parser().parse_args(["--steps", "1", "--ik", ik])
    _, result = demo.run_demo(args, demo.TABLE_1)
    assert result["speedup_parts"] == parts and result["speedup"] == math.prod(parts.values())


def test_equations_14_to_18_are_the_derivatives():
    errors = demo.check_derivatives(np.random.default_rng(0))
    assert set(errors) == {"14", "15", "16-17", "18"}
    assert max(errors.values()) < 1e-8


@pytest.mark.parametrize("row, name", [(2, "14"), (1, "15"), (0, "16-17")])
def test_the_derivative_check_notices_a_wrong_equation(row, name, monkeypatch):
    right, factor = demo.cost_gradient, np.ones((3, 1))
    factor[row] = 1.001
    monkeypatch.setattr(demo, "cost_gradient", lambda *args: right(*args) * factor)
    errors = demo.check_derivatives(np.random.default_rng(0))
    assert errors.pop(name) > 1e-4 > max(errors.values())


def test_equations_19_to_23_and_their_misprint():
    checks = demo.check_signs(np.random.default_rng(0))
    for name in ("19", "22 corrected", "23"):
        assert checks[name]["error"] < 1e-10
    assert checks["22 as printed"]["error"] > 0.5
    assert checks["19"]["positive"] == 1
    # theta_3 is uniform over [0, pi]: cos(theta_3) > -1/4 has this probability
    assert checks["22 corrected"]["positive"] == pytest.approx(math.acos(-0.25) / math.pi, abs=0.05)
    assert 0.4 < checks["23"]["positive"] < 0.6


def exact_share(theta):
    """Per joint, for small errors e: e_i (J'J e)_i > 0 holds for 1/2 + atan(M_ii / |rest|) / pi."""
    lever = lever_array(theta[:, None])[:, :, 0]
    quadratic = lever.T @ lever
    own = np.diag(quadratic)
    rest = np.sqrt((quadratic**2).sum(axis=1) - own**2)
    return 0.5 + np.arctan(own / rest) / np.pi, quadratic


def test_monotonic_share_against_its_closed_form():
    poses = random_poses(12).T
    error, up = demo.rises(poses, np.random.default_rng(1), 20_000)
    np.testing.assert_allclose(np.linalg.norm(error, axis=0), 1e-3)
    assert up.shape == (12, 3, 20_000)
    for theta, share in zip(poses, up.mean(axis=-1)):
        np.testing.assert_allclose(share, exact_share(theta)[0], atol=0.02)


def test_monotonicity_at_the_papers_goal():
    result = demo.monotonicity(np.random.default_rng(0))
    share, sign = result["monotonic_share"], result["monotonic_by_sign"]
    np.testing.assert_allclose(share["three"], [0.78, 0.74, 0.58], atol=0.02)
    assert share["all"] == pytest.approx(0.28, abs=0.02)
    quadratic = exact_share(demo.GOAL_ANGLES)[1]
    assert (quadratic > 0).all()  # so that errors of one sign all add up
    assert sign["+++"] == 1
    assert max(v for k, v in sign.items() if k != "+++") < 0.2
    assert len(sign) == 4
    assert np.mean(list(sign.values())) == pytest.approx(share["all"], abs=0.02)
    null = np.array(result["null_direction"])
    assert np.linalg.norm(null) == pytest.approx(1)
    np.testing.assert_allclose(quadratic @ null, 0, atol=1e-9)


def test_the_signs_are_counted_right():
    rng = np.random.default_rng(0)
    found = demo.monotonicity(np.random.default_rng(0))["monotonic_by_sign"]
    error, up = demo.rises(demo.GOAL_ANGLES, rng, 20_000)
    for name, share in found.items():
        pattern = np.array([1 if sign == "+" else -1 for sign in name])
        alike = np.abs((np.sign(error) * pattern[:, None]).sum(axis=0)) == 3  # it or its opposite
        assert share == pytest.approx(up.all(axis=0)[alike].mean())


def test_goal_map():
    share = demo.goal_map(np.random.default_rng(0))
    x, y = np.meshgrid(np.linspace(-35, 35, 60), np.linspace(-35, 35, 60))
    assert np.isnan(share[np.hypot(x, y) > 35.1]).all() and np.isfinite(share).mean() > 0.5
    some = np.s_[::7, ::3]  # where the authors' solver gets, and only there
    goals = np.stack([x[some].ravel(), y[some].ravel()])
    missed = np.hypot(*(demo.forward_kinematics(demo.inverse_kinematics(goals)) - goals)) > 0.01
    np.testing.assert_array_equal(np.isnan(share[some]).ravel(), missed)
    assert 0 < np.nanmin(share) and np.nanmax(share) < 1
    row, column = np.unravel_index(np.argmin(np.hypot(x - 10, y + 25)), x.shape)
    assert share[row, column] == pytest.approx(0.28, abs=0.1)  # the paper's goal: y first, then x


# the command --------------------------------------------------------------------------


def command(*args, blocked=(), timeout=120, cwd=None):
    """Run the file as a user would; blocked modules can't be imported."""
    if not blocked:
        line = [sys.executable, str(ROOT / "manipulator_demo.py"), *args]
    else:
        code = (f"import sys, runpy\nfor name in {list(blocked)!r}: sys.modules[name] = None\n"
                f"sys.argv = ['manipulator_demo.py', *{list(args)!r}]\n"
                f"runpy.run_path({str(ROOT / 'manipulator_demo.py')!r}, run_name='__main__')")
        line = [sys.executable, "-c", code]
    return subprocess.run(line, capture_output=True, text=True, timeout=timeout, cwd=cwd)


def check_default_report(done):
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert set(result) == {
        "centralized", "centralized_closed_form", "joints_one_agent", "factored", "speedup",
        "speedup_parts", "search_space", "derivatives", "signs", "monotonic_share",
        "monotonic_by_sign", "null_direction", "seconds_total", "settings", "cores"}
    keys = {"plan_ms_median", "plan_ms_p10", "plan_ms_p90", "final_distance", "path_length",
            "joint_travel", "joint_net", "bend_step", "bend_second"}
    for key in ("centralized", "factored"):
        assert keys <= set(result[key])
        assert result[key]["final_distance"] < 1.0
        assert 23 < result[key]["path_length"] < 40  # 20.6 is the straight line
    assert result["speedup"] == pytest.approx(
        result["centralized"]["plan_ms_median"] / result["factored"]["plan_ms_median"])
    assert set(result["speedup_parts"]) == {"solver", "kinematics", "agents"}
    assert result["speedup"] == pytest.approx(math.prod(result["speedup_parts"].values()))
    assert result["speedup"] > 15  # 60 to 100 measured; the paper has 30
    assert [row["samples"] for row in result["search_space"]] == [10, 15, 25, 50, 100]
    for words in ("speed-up of the factored model", "22 as printed", "null space", "all three"):
        assert words in done.stdout
    assert done.stdout.count("\n{") == 1  # one JSON object, the last line


def test_default_command_with_figure(tmp_path):
    pytest.importorskip("matplotlib")
    done = command("--json", "--figure", "arm.png", cwd=tmp_path)
    check_default_report(done)
    assert os.listdir(tmp_path) == ["arm.png"]  # and nothing temporary
    picture = (tmp_path / "arm.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and 20_000 < len(picture) < 300_000


def test_nothing_but_numpy_is_needed():
    done = command("--json", "--ik", "closed-form", blocked=(
        "matplotlib", "PIL", "tqdm", "scipy", "mujoco", "dm_control", "threadpoolctl"))
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert set(result["speedup_parts"]) == {"kinematics", "agents"}
    assert "centralized_closed_form" not in result
    assert result["centralized"]["final_distance"] < 1.0


def test_figure_without_matplotlib_says_what_to_install(tmp_path):
    done = command("--figure", str(tmp_path / "arm.png"), blocked=("matplotlib",))
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "pip install 'fac-tdmpc-ref[plots]'" in done.stderr


def test_import_and_help_are_light():
    code = ("import sys, manipulator_demo as demo\n"
            "try: demo.main(['--help'])\n"
            "except SystemExit as stop: assert stop.code == 0\n"
            "assert not {'matplotlib', 'scipy', 'tqdm', 'torch'} & set(sys.modules)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    for word in ("--seed", "--steps", "--samples", "--horizon", "--discount", "--figure", "--json",
                 "--ik", "0**0", "500 times"):
        assert word in done.stdout


@pytest.mark.parametrize("args, words", [
    (["--horizon", "0"], "--horizon must be in 1 to"),
    (["--steps", "0"], "--steps must be in 1 to"),
    (["--samples", "0"], "--samples must be in 1 to"),
    (["--samples", "1000000000000"], "--samples must be in 1 to"),
    (["--discount", "1.5"], "discount must be at "),
    (["--discount", "nan"], "discount must be at "),
    (["--seed", "-1"], "--seed must be in 0 to"),
    (["--steps", "many"], "invalid int value"),
    (["--ik", "guess"], "invalid choice"),
    (["--figure", "arm.jpg"], "expected the name of a .png file"),
    (["--colour", "red"], "unrecognized arguments"),
    (["--horizon", "100000000", "--steps", "1"], "horizon must be at most 499"),
])
def test_bad_input_is_one_line(args, words, capsys):
    try:
        status = demo.main(args)
    except SystemExit as stop:
        status = stop.code
    captured = capsys.readouterr()
    assert status == 2 and captured.out == ""
    assert captured.err.count("\n") == 1 and words in captured.err


def test_a_figure_that_cannot_be_written_is_one_line_before_the_work(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    (tmp_path / "file").write_text("old")
    path = str(tmp_path / "file" / "arm.png")
    assert demo.main(["--steps", "1", "--ik", "closed-form", "--figure", path, "--json"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "can't be written" in captured.err
    assert captured.out == ""


@pytest.mark.parametrize("args", [
    ["--steps", "1", "--samples", "1", "--horizon", "1", "--discount", "0"],  # nothing to choose
    ["--steps", "2", "--samples", "7", "--ik", "closed-form", "--seed", "20261122"],
])
def test_odd_settings_still_run(args, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert demo.main([*args, "--json"]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
