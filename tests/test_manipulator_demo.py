"""Tests of manipulator_demo.py: kinematics, planner, appendix A.1, and the command as users run it.

Forward kinematics, the authors' solver and the planner are compared with plain loops over single
samples that are written here from the equations.
"""

import json
import math
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import manipulator_demo as demo  # noqa: E402

LINKS = np.array([10.0, 20.0, 5.0])
COLUMN_LOW, COLUMN_SPAN = demo.LOW[:, None], demo.SPAN[:, None]


@pytest.fixture(scope="module")
def task():
    return demo.make_task()


def random_poses(count, seed=0):
    low, high = COLUMN_LOW, COLUMN_LOW + COLUMN_SPAN
    return np.random.default_rng(seed).uniform(low, high, (3, count))


def reachable_points(links, count, seed=0):
    """Points spread evenly over the ring that the links reach: (2, count)."""
    rng = np.random.default_rng(seed)
    inner = max(0.0, 2 * max(links) - sum(links))
    radius = np.sqrt(rng.uniform(inner**2, sum(links)**2, count))
    angle = rng.uniform(0, 2 * np.pi, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)])


# kinematics ---------------------------------------------------------------------------


@pytest.mark.parametrize("theta, ends", [
    ((0, 0, 0), [(10, 0), (30, 0), (35, 0)]),
    ((np.pi / 2, 0, 0), [(0, 10), (0, 30), (0, 35)]),
    ((0, np.pi / 2, np.pi / 2), [(10, 0), (10, 20), (5, 20)]),
    ((np.pi, -np.pi / 2, np.pi), [(-10, 0), (-10, 20), (-10, 15)]),
])
def test_forward_kinematics_of_all_links(theta, ends):
    result = demo.forward_kinematics(np.array(theta, float)[:, None], LINKS)
    np.testing.assert_allclose(result[:, :, 0].T, ends, atol=1e-12)


def test_levers_are_the_jacobian():
    theta, step = random_poses(50), 1e-6
    lever = demo.levers(theta, LINKS)
    np.testing.assert_allclose(lever[:, 0], demo.forward_kinematics(theta, LINKS)[:, -1])
    for joint, shift in enumerate(step * np.eye(3)[:, :, None]):
        ahead, behind = (demo.forward_kinematics(theta + s, LINKS)[:, -1] for s in (shift, -shift))
        column = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(column, [-lever[1, joint], lever[0, joint]], atol=1e-7)


@settings(max_examples=200, deadline=None)
@given(st.tuples(*[st.floats(0.5, 50)] * 3), st.floats(0, 1), st.floats(0, 2 * np.pi))
def test_closed_form_round_trip_for_any_arm(links, part, angle):
    links = np.array(links)
    inner = max(0.0, 2 * links.max() - links.sum())
    radius = inner + part * (links.sum() - inner)
    xy = radius * np.array([[np.cos(angle)], [np.sin(angle)]])
    theta, missed = demo.closed_form_kinematics(xy, links)
    assert not missed.any()
    np.testing.assert_allclose(demo.forward_kinematics(theta, links)[:, -1], xy,
                               atol=1e-6 * links.sum())


def test_authors_solver_round_trip_over_the_disc():
    xy = reachable_points(LINKS, 2000)
    theta, missed = demo.inverse_kinematics(xy, LINKS)
    distance = np.hypot(*(demo.forward_kinematics(theta, LINKS)[:, -1] - xy))
    np.testing.assert_array_equal(missed, distance > demo.IK_TOLERANCE)
    assert 0.02 < missed.mean() < 0.15  # it does not reach everywhere, and says so
    closed, missed = demo.closed_form_kinematics(xy, LINKS)
    assert not missed.any()
    np.testing.assert_allclose(demo.forward_kinematics(closed, LINKS)[:, -1], xy, atol=1e-9)


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
    xy = reachable_points(LINKS, 60, seed=3)
    theta, missed = demo.inverse_kinematics(xy, LINKS)
    alone = np.array([authors_solver_in_a_loop(*point) for point in xy.T]).T
    np.testing.assert_allclose(theta[:, ~missed], alone[:, ~missed], atol=1e-9)


def test_start_and_goal_angles_of_the_authors(task):
    np.testing.assert_allclose(task.goal_angles, [4.0768, 1.2142, 0.9524], atol=1e-3)
    np.testing.assert_allclose(task.start_angles, [3.0594, 1.4091, 1.5301], atol=1e-3)


def test_every_reachable_point_has_a_pose_within_the_ranges():
    for links in ((10, 20, 5), (30, 5, 5), (5, 20, 10)):
        for point in reachable_points(links, 60).T:
            task = demo.make_task(links, point, point)
            assert (task.goal_angles >= demo.LOW).all()
            assert (task.goal_angles <= demo.LOW + demo.SPAN).all()
            tip = demo.forward_kinematics(task.goal_angles[:, None], task.links)[:, -1, 0]
            assert np.hypot(*(tip - point)) <= demo.IK_TOLERANCE


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


def test_the_models_agree_where_the_solver_knows_the_joints(task):
    theta, missed = demo.closed_form_kinematics(reachable_points(LINKS, 200), LINKS)
    action = np.random.default_rng(2).uniform(-1, 1, (3, 200))
    central = demo.CentralizedModel(LINKS, task.goal, demo.closed_form_kinematics)
    tip = demo.forward_kinematics(theta, LINKS)[:, -1]
    stepped = central.step(tip[None], action[None])
    for agents in (1, 3):
        joints = demo.JointModel(task.goal_angles, agents)
        shape = (agents, 3 // agents, 200)
        moved = joints.step(theta.reshape(shape), action.reshape(shape)).reshape(3, 200)
        ends = demo.forward_kinematics(moved, LINKS)[:, -1]
        np.testing.assert_allclose(stepped[0], ends, atol=1e-9)
    assert central.solved == 200 and central.missed == 0


def test_rewards_are_the_squared_ones(task):
    central = demo.CentralizedModel(LINKS, task.goal)
    assert central.reward(np.array([[[13.0], [-21.0]]])).tolist() == [[-25.0]]
    errors = np.array([0.5, -0.25, 2.0])
    theta = (task.goal_angles + errors)[:, None]
    joints, one = demo.JointModel(task.goal_angles), demo.JointModel(task.goal_angles, 1)
    np.testing.assert_allclose(joints.reward(theta[:, None]), -errors[:, None] ** 2)
    np.testing.assert_allclose(one.reward(theta[None]), [[-(errors**2).sum()]])


def test_solver_misses_are_counted(task):
    central = demo.CentralizedModel(LINKS, task.goal)
    central.step(np.array([[[10.0, 0.0, -10.0], [-25.0, 36.0, -20.0]]]), np.zeros((1, 3, 3)))
    assert (central.solved, central.missed) == (3, 1)  # (0, 36) is beyond the arm


# the planner --------------------------------------------------------------------------


@pytest.mark.parametrize("discount", [0.0, 0.7, 1.0])
def test_return_is_the_discounted_sum_of_reached_rewards(task, discount):
    model = demo.JointModel(task.goal_angles)
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 3, 1, 6))
    returns = demo.evaluate(model, task.start_angles[:, None], actions, discount)
    for joint in range(3):
        for sample in range(6):
            angle, expected = task.start_angles[joint], 0.0
            for h in range(4):
                action = actions[h, joint, 0, sample]
                command = demo.LOW[joint] + (action + 1) / 2 * demo.SPAN[joint]
                angle += min(max(command - angle, -0.01), 0.01)
                expected -= discount**h * (angle - task.goal_angles[joint]) ** 2
            assert returns[joint, sample] == pytest.approx(expected, rel=1e-12)


def test_discount_zero_scores_the_first_action_only(task):
    model = demo.JointModel(task.goal_angles)
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 3, 1, 20))
    other = actions.copy()
    other[1:] *= -1
    state = task.start_angles[:, None]
    same = demo.evaluate(model, state, actions, 0.0)
    np.testing.assert_array_equal(same, demo.evaluate(model, state, other, 0.0))
    assert np.ptp(same, axis=1).min() > 0  # and the first action does matter
    assert (demo.evaluate(model, state, actions, 1.0)
            != demo.evaluate(model, state, other, 1.0)).any()


def test_refinement_against_a_loop(task):
    """MPPI written out for one agent, one iteration after another."""
    config = demo.PlannerConfig(iterations=3, samples=20, elites=4)
    model = demo.JointModel(task.goal_angles, 1)
    noise = np.random.default_rng(0).standard_normal((3, 4, 1, 3, 20))
    state = task.start_angles[None]
    mean, elites, weight = demo.refine(model, state, np.zeros((4, 1, 3, 1)), noise, config)

    centre, std = np.zeros((4, 3)), np.full((4, 3), 2.0)
    for draw in noise[:, :, 0]:
        candidates = [np.clip(centre + std * draw[..., s], -1, 1) for s in range(20)]
        value = [demo.evaluate(model, state, c[:, None, :, None], 1.0)[0, 0] for c in candidates]
        best = sorted(range(20), key=lambda s: value[s])[-4:]
        score = np.array([math.exp(0.5 * (value[s] - value[best[-1]])) for s in best])
        score /= score.sum()
        centre = sum(w * candidates[s] for w, s in zip(score, best))
        std = np.sqrt(sum(w * (candidates[s] - centre) ** 2 for w, s in zip(score, best)))
        std = np.clip(std, 0.05, 2.0)
    np.testing.assert_allclose(mean[:, 0, :, 0], centre, rtol=1e-12)
    np.testing.assert_allclose(np.sort(weight[0]), np.sort(score), rtol=1e-12)
    assert weight.sum() == pytest.approx(1) and np.abs(elites).max() <= 1


def test_agents_planned_together_or_apart_choose_the_same(task):
    config = demo.PlannerConfig()
    model = demo.JointModel(task.goal_angles)
    together = demo.Planner(model, config, demo.spawn_streams(5, 3))
    apart = [demo.Planner(model.agent(i), config, [stream])
             for i, stream in enumerate(demo.spawn_streams(5, 3))]
    for part in (0.0, 0.3, 0.6):
        state = model.observe(task.start_angles + part * (task.goal_angles - task.start_angles))
        actions = np.concatenate([planner.act(own[None]) for planner, own in zip(apart, state)])
        np.testing.assert_array_equal(together.act(state), actions)
        assert np.abs(actions).max() <= 1


def test_executed_action_is_drawn_by_weight(task, monkeypatch):
    elites = np.arange(3.0)[None, None, None].repeat(4, axis=0)  # (H, 1, 1, E): actions 0, 1, 2
    weight = np.array([[0.2, 0.5, 0.3]])
    monkeypatch.setattr(demo, "refine", lambda *a: (np.zeros((4, 1, 1, 1)), elites, weight))
    planner = demo.Planner(demo.JointModel(task.goal_angles).agent(0), demo.PlannerConfig(),
                           demo.spawn_streams(0, 1))
    drawn = [int(planner.act(np.zeros((1, 1)))[0, 0]) for _ in range(4000)]
    np.testing.assert_allclose(np.bincount(drawn, minlength=3) / 4000, weight[0], atol=0.03)


def test_the_next_plan_starts_from_the_shifted_one(task, monkeypatch):
    mean = np.arange(4.0).reshape(4, 1, 1, 1) / 4
    started = []

    def refine(model, state, start, noise, config):
        started.append(start.ravel().tolist())
        return mean, mean.repeat(5, axis=-1), np.full((1, 5), 0.2)

    monkeypatch.setattr(demo, "refine", refine)
    planner = demo.Planner(demo.JointModel(task.goal_angles).agent(0), demo.PlannerConfig(),
                           demo.spawn_streams(0, 1))
    planner.act(np.zeros((1, 1)))
    planner.act(np.zeros((1, 1)))
    assert started == [[0, 0, 0, 0], [0.25, 0.5, 0.75, 0]]


# whole runs ---------------------------------------------------------------------------


def run_once(task, model, seed, steps=100, config=None):
    planner = demo.Planner(model, config or demo.PlannerConfig(),
                           demo.spawn_streams(seed, model.agents))
    run = demo.Run("", planner, model, [task.start_angles])
    demo.compare({"": run}, steps)
    return run.angles(), np.array(run.actions)


def run_side_by_side(task, solver, discount, seeds, steps):
    """Centralized runs of many seeds as one planner of many agents, each with an arm of its own:
    the solver's iterations are shared, and twenty seeds cost as much as five. (3, seeds, steps)"""
    model = demo.CentralizedModel(task.links, task.goal, solver)
    planner = demo.Planner(model, demo.PlannerConfig(discount=discount),
                           [demo.spawn_streams(seed, 1)[0] for seed in seeds])
    theta = [np.repeat(task.start_angles[:, None], len(seeds), axis=1)]
    for _ in range(steps):
        tip = demo.forward_kinematics(theta[-1], task.links)[:, -1]
        theta.append(demo.actuate(theta[-1], planner.act(tip.T).T, COLUMN_LOW, COLUMN_SPAN))
    return np.stack(theta, axis=-1)


def final_distance(task, theta):
    """theta (3, S) -> (S,)."""
    return np.hypot(*(demo.forward_kinematics(theta, task.links)[:, -1] - task.goal[:, None]))


@pytest.mark.parametrize("discount", [1.0, 0.0])
def test_factored_ends_near_the_goal_for_20_seeds(task, discount):
    config = demo.PlannerConfig(discount=discount)
    ends = [run_once(task, demo.JointModel(task.goal_angles), seed, config=config)[0][:, -1]
            for seed in range(20)]
    assert final_distance(task, np.stack(ends, axis=1)).max() < 1.0


@pytest.mark.parametrize("solver, discount", [
    (demo.inverse_kinematics, 1.0), (demo.closed_form_kinematics, 1.0),
    (demo.closed_form_kinematics, 0.0)])
def test_centralized_ends_near_the_goal_for_20_seeds(task, solver, discount):
    paths = run_side_by_side(task, solver, discount, range(20), steps=100)
    assert final_distance(task, paths[:, :, -1]).max() < 1.0
    assert final_distance(task, paths[:, :, 0]).min() > 20  # it was not there before
    model = demo.CentralizedModel(task.links, task.goal, solver)
    alone, _ = run_once(task, model, 7, steps=3, config=demo.PlannerConfig(discount=discount))
    np.testing.assert_array_equal(paths[:, 7, :4], alone)  # side by side changes nothing


@pytest.mark.parametrize("kind, steps", [("centralized", 8), ("factored", 60)])
def test_same_seed_same_path(task, kind, steps):
    def run(seed):
        model = {"centralized": demo.CentralizedModel(task.links, task.goal),
                 "factored": demo.JointModel(task.goal_angles)}[kind]
        return run_once(task, model, seed, steps)

    path, actions = run(3)
    again, same_actions = run(3)
    np.testing.assert_array_equal(path, again)
    np.testing.assert_array_equal(actions, same_actions)
    assert (run(4)[1] != actions).any(axis=(1, 2)).all()  # another seed, other actions each step


def test_processes_walk_the_same_path(task):
    runs = demo.start_runs(task, demo.PlannerConfig(), 1, "closed-form", processes=True)
    workers = runs["factored_processes"].planner.workers
    try:
        assert len({worker.pid for worker in workers} | {os.getpid()}) == 4
        demo.compare(runs, 30)
    finally:
        runs["factored_processes"].planner.close()
    one, three = runs["factored"], runs["factored_processes"]
    np.testing.assert_array_equal(one.angles(), three.angles())
    np.testing.assert_array_equal(one.actions, three.actions)
    cost = demo.handover(runs)
    assert cost["same_path"] and cost["handover_ms_median"] > 0
    assert cost["slowest_agent_ms_median"] < cost["wall_ms_median"]
    assert not any(worker.is_alive() for worker in workers)
    one.actions[-1] = one.actions[-1] + 1e-12
    assert not demo.handover(runs)["same_path"]  # it would be noticed


def test_a_lost_agent_is_one_line(task):
    planner = demo.ProcessPlanner(demo.JointModel(task.goal_angles), demo.PlannerConfig(),
                                  demo.spawn_streams(1, 3))
    try:
        planner.workers[1].terminate()
        planner.workers[1].join()
        with pytest.raises(demo.UserError, match="process ended"):
            planner.act(task.start_angles[:, None])
    finally:
        planner.close()
    assert not any(worker.is_alive() for worker in planner.workers)


def test_measures_of_a_known_path(task):
    model = demo.JointModel(task.goal_angles)
    shoulder = np.array([0.0, 0.01, 0.02, 0.01])
    theta = np.stack([shoulder, np.zeros(4), np.zeros(4)])
    run = demo.Run("", None, model, list(theta.T), [0.001, 0.002, 0.004])
    result = demo.measure(run, task)
    assert result["plan_ms_median"] == pytest.approx(2.0)
    assert result["joint_travel"] == pytest.approx(0.03)
    assert result["joint_net"] == pytest.approx([0.01, 0, 0])
    chord = 2 * 35 * math.sin(0.005)  # of a straight arm of 35 turned by 0.01
    assert result["path_length"] == pytest.approx(3 * chord)
    expected = (chord * 2 * math.sin(0.005) + 2 * chord) / 2  # one bend of 0.01, one turn back
    assert result["bend_step"] == pytest.approx(expected)
    assert result["bend_second"] is None  # shorter than two seconds
    assert result["final_distance"] == pytest.approx(
        math.hypot(35 * math.cos(0.01) - 10, 35 * math.sin(0.01) + 25))


def test_bends_of_known_paths():
    steps = np.arange(31.0)
    assert demo.bend(np.stack([3 * steps, -steps]), 1) == pytest.approx(0, abs=1e-12)
    assert demo.bend(np.stack([steps**2, 0 * steps]), 1) == pytest.approx(2)
    assert demo.bend(np.stack([steps**2, 0 * steps]), 10) == pytest.approx(200)
    rocking = np.stack([(-1) ** steps, 0 * steps])
    assert demo.bend(rocking, 1) == pytest.approx(4)
    assert demo.bend(rocking, 10) == pytest.approx(0)


def test_speedup_parts_multiply_to_the_speedup():
    result = {key: {"plan_ms_median": ms} for key, ms in (
        ("centralized", 60.0), ("centralized_closed_form", 3.0), ("joints_one_agent", 1.5),
        ("factored", 1.0))}
    assert demo.speedup_parts(result) == {"solver": 20.0, "kinematics": 2.0, "agents": 1.5}
    del result["centralized_closed_form"]
    assert demo.speedup_parts(result) == {"kinematics": 40.0, "agents": 1.5}


def test_dividing_the_search_saves_samples(task):
    rows = demo.search_space(task, demo.PlannerConfig(), seed=0, sizes=(10, 25, 400), plans=40)
    few, some, many = rows
    assert few["three_agents"] > few["one_agent"] + 0.05
    assert few["three_agents"] < some["three_agents"] <= 1 + 1e-9
    assert few["one_agent"] < some["one_agent"] <= 1 + 1e-9
    assert min(many["one_agent"], many["three_agents"]) > 0.99  # the best gain is what they near


# appendix A.1 -------------------------------------------------------------------------


def test_equations_14_to_18_are_the_derivatives():
    errors = demo.check_derivatives(LINKS, np.random.default_rng(0))
    assert set(errors) == {"14", "15", "16-17", "18"}
    assert max(errors.values()) < 1e-8


def test_the_derivative_check_notices_a_wrong_equation(monkeypatch):
    right = demo.cost_gradient
    monkeypatch.setattr(demo, "cost_gradient",
                        lambda theta, *rest: right(theta, *rest) * [[1.0], [1.0], [1.001]])
    errors = demo.check_derivatives(LINKS, np.random.default_rng(0))
    assert errors["14"] > 1e-4 > errors["15"]


def test_equations_19_to_23_and_their_misprint():
    checks = demo.check_signs(LINKS, np.random.default_rng(0))
    for name in ("19", "22 corrected", "23"):
        assert checks[name]["error"] < 1e-10
    assert checks["22 as printed"]["error"] > 0.5
    assert checks["19"]["positive"] == 1
    # theta_3 is uniform over [0, pi]: cos(theta_3) > -1/4 has this probability
    assert checks["22 corrected"]["positive"] == pytest.approx(math.acos(-0.25) / math.pi, abs=0.05)
    assert 0.4 < checks["23"]["positive"] < 0.6


def exact_share(theta):
    """Per joint, for small errors e: e_i (J'J e)_i > 0 holds for 1/2 + atan(M_ii / |rest|) / pi."""
    lever = demo.levers(theta[:, None], LINKS)[:, :, 0]
    quadratic = lever.T @ lever
    own = np.diag(quadratic)
    rest = np.sqrt((quadratic**2).sum(axis=1) - own**2)
    return 0.5 + np.arctan(own / rest) / np.pi, quadratic


def test_monotonic_share_at_the_papers_goal(task):
    error = demo.directions(np.random.default_rng(0), 20_000)
    three, together = demo.monotonic_share(task.goal_angles[:, None], LINKS, error)
    np.testing.assert_allclose(three[:, 0], [0.78, 0.74, 0.58], atol=0.02)
    assert together[0] == pytest.approx(0.28, abs=0.02)


def test_monotonic_share_against_its_closed_form():
    poses = random_poses(12)
    three, together = demo.monotonic_share(
        poses, LINKS, demo.directions(np.random.default_rng(1), 20_000))
    for g, theta in enumerate(poses.T):
        np.testing.assert_allclose(three[:, g], exact_share(theta)[0], atol=0.02)
    assert (together <= three.min(axis=0)).all()


def test_sign_patterns_and_null_direction(task):
    result = demo.appendix(task, np.random.default_rng(0))
    quadratic = exact_share(task.goal_angles)[1]
    assert (quadratic > 0).all()  # so that errors of one sign all add up
    assert result["monotonic_by_sign"]["+++"] == 1
    assert max(v for k, v in result["monotonic_by_sign"].items() if k != "+++") < 0.2
    assert np.mean(list(result["monotonic_by_sign"].values())) == pytest.approx(
        result["monotonic_share"]["all"], abs=0.02)
    null = np.array(result["null_direction"])
    assert np.linalg.norm(null) == pytest.approx(1)
    np.testing.assert_allclose(quadratic @ null, 0, atol=1e-9)


def test_goal_map_and_distances(task):
    share = demo.goal_map(LINKS, np.random.default_rng(0), cells=21, count=200)
    reach = np.linspace(-35, 35, 21)
    outside = np.hypot(*np.meshgrid(reach, reach)) > 35.1
    assert np.isnan(share[outside]).all() and np.isfinite(share).mean() > 0.5
    error = demo.directions(np.random.default_rng(0), 5000)
    rows = demo.shares_by_distance(task, error)
    assert len(rows) >= 5 and all(0 < row["all"] <= min(row["three"]) < 1 for row in rows)


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
    keys = {"plan_ms_median", "final_distance", "path_length", "joint_travel"}
    for key in ("centralized", "factored"):
        assert keys <= set(result[key])
        assert result[key]["final_distance"] < 1.0
        assert 23 < result[key]["path_length"] < 40  # 20.6 is the straight line
    assert set(result["monotonic_share"]) == {"three", "all"}
    assert len(result["monotonic_share"]["three"]) == 3
    assert result["speedup"] == pytest.approx(
        result["centralized"]["plan_ms_median"] / result["factored"]["plan_ms_median"])
    assert result["speedup"] > 15  # 60 to 70 measured beside a busy core; the paper has 30
    assert result["seconds_total"] < 60
    for words in ("speed-up of the factored model", "Eq. 22 as printed", "null space", "all three"):
        assert words in done.stdout
    assert done.stdout.count("\n{") == 1  # one JSON object, the last line


def test_default_command_with_figure(tmp_path):
    pytest.importorskip("matplotlib")
    done = command("--json", "--figure", "arm.png", cwd=tmp_path)
    check_default_report(done)
    assert os.listdir(tmp_path) == ["arm.png"]  # and nothing temporary
    picture = (tmp_path / "arm.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and 20_000 < len(picture) < 200_000


def test_default_command_with_nothing_but_numpy():
    check_default_report(command("--json", blocked=("matplotlib", "PIL", "tqdm", "scipy")))


@pytest.mark.parametrize("option, name", [("--figure", "arm.png"), ("--animate", "arm.gif")])
def test_pictures_without_matplotlib_say_what_to_install(option, name, tmp_path):
    done = command(option, str(tmp_path / name), blocked=("matplotlib",))
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert 'pip install "fac-tdmpc-ref[plots]"' in done.stderr


def test_import_and_help_are_light():
    code = ("import sys, multiprocessing, manipulator_demo as demo\n"
            "try: demo.main(['--help'])\n"
            "except SystemExit as stop: assert stop.code == 0\n"
            "assert not multiprocessing.active_children()\n"
            "assert not {'matplotlib', 'scipy', 'tqdm', 'torch'} & set(sys.modules)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    for word in ("--seed", "--steps", "--goal", "--start", "--links", "--samples", "--iterations",
                 "--horizon", "--discount", "--figure", "--animate", "--json", "--ik", "--agents",
                 "0**0", "500 times"):
        assert word in done.stdout


def test_processes_from_the_command_line():
    done = command("--json", "--steps", "5", "--agents", "processes", "--ik", "closed-form")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["handover"]["same_path"] is True
    assert result["handover"]["handover_ms_median"] > 0
    assert "bit for bit: yes" in done.stdout


@pytest.mark.parametrize("args, words", [
    (["--goal", "40", "0"], "unreachable"),
    (["--start", "1", "1"], "unreachable"),
    (["--goal", "nan", "0"], "unreachable"),
    (["--links", "10", "-20", "5"], "between 1e-6 and 1e6"),
    (["--links", "10", "inf", "5"], "between 1e-6 and 1e6"),
    (["--horizon", "0"], "--horizon must be in 1 to 100000"),
    (["--steps", "0"], "--steps must be in 1 to 100000"),
    (["--samples", "0"], "--samples must be in 1 to 100000"),
    (["--iterations", "-1"], "--iterations must be in 1 to 100000"),
    (["--samples", "1000000000000"], "--samples must be in 1 to 100000"),
    (["--elites", "51"], "--elites 51 is more than --samples 50"),
    (["--discount", "1.5"], "--discount must be in 0 to 1"),
    (["--discount", "nan"], "--discount must be in 0 to 1"),
    (["--seed", "-1"], "--seed must not be negative"),
    (["--steps", "many"], "invalid int value"),
    (["--goal", "1"], "expected 2 arguments"),
    (["--ik", "guess"], "invalid choice"),
    (["--figure", "arm.jpg"], "should end in .png"),
    (["--animate", "arm.png"], "should end in .gif"),
    (["--figure", "/nowhere/at/all/arm.png"], "can't write"),
    (["--colour", "red"], "unrecognized arguments"),
])
def test_bad_input_is_one_line(args, words, capsys):
    try:
        status = demo.main(args)
    except SystemExit as stop:
        status = stop.code
    captured = capsys.readouterr()
    assert status == 2 and captured.out == ""
    assert captured.err.count("\n") == 1 and words in captured.err


@pytest.mark.parametrize("args", [
    ["--steps", "1", "--samples", "1", "--elites", "1", "--iterations", "1", "--horizon", "1",
     "--discount", "0", "--goal", "-10", "-20"],  # no choice, and no way to go
    ["--steps", "2", "--goal", "35", "0"],  # a straight arm: all levers parallel
    ["--steps", "2", "--links", "10", "10", "10", "--goal", "0", "0"],  # the base itself
    ["--steps", "2", "--goal", "30", "-1", "--start", "30", "1"],  # across joint 1's seam
])
def test_odd_settings_still_run(args, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert demo.main([*args, "--json"]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


def test_an_arm_that_the_authors_gain_does_not_suit(capsys):
    assert demo.main(["--steps", "2", "--links", "1", "2", "0.5", "--start", "-1", "-2",
                      "--goal", "1", "-2.5", "--json"]) == 0
    captured = capsys.readouterr()
    assert "the authors' solver finds no pose" in captured.err
    result = json.loads(captured.out.splitlines()[-1])
    assert result["centralized"]["ik_missed_share"] > 0.5
    assert result["centralized_closed_form"]["ik_missed_share"] == 0.0


def test_animation_shows_every_step(tmp_path):
    pytest.importorskip("matplotlib")
    from PIL import Image
    path = tmp_path / "arm.gif"
    assert demo.main(["--steps", "4", "--ik", "closed-form", "--animate", str(path)]) == 0
    with Image.open(path) as image:
        assert image.n_frames == 5
    assert os.listdir(tmp_path) == ["arm.gif"]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "arm.png"
    path.write_text("old")

    def fail(temporary):
        temporary.write_text("half")
        raise OSError("disk full")

    with pytest.raises(demo.UserError, match="can't write .*disk full"):
        demo.write_file(path, fail)
    assert os.listdir(tmp_path) == ["arm.png"] and path.read_text() == "old"
