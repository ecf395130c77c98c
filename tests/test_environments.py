"""Environments: the paper's 11 tasks as MuJoCo really runs them, one's own robots, hindsight."""
import functools
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import fac_tdmpc_ref as fac
import look
import train_expert
from toys import ROOT, random_model

FIGURE_3 = {  # task: (dim O, dim A), copied from the paper and not from the code
    "reacher-easy": (8, 3), "reacher-hard": (8, 3), "hopper-hop": (15, 4), "fish-swim": (24, 5),
    "cheetah-run": (17, 6), "walker-walk": (24, 6), "walker-run": (24, 6),
    "quadruped-walk": (78, 12), "quadruped-run": (78, 12), "humanoid-stand": (67, 21),
    "humanoid-walk": (67, 21)}
ROBOTS = ("reacher-hard", "hopper-hop", "fish-swim", "cheetah-run", "walker-walk",
          "quadruped-walk", "humanoid-walk")
LINK = 0.09  # metres


environment = functools.cache(fac.Environment)  # making one parses XML: once for each task


def actions_for(task, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, FIGURE_3[task][1]))


def play(task, seed, steps=4, env=None):
    """All observations (steps + 1, O) and rewards (steps,) of an episode's beginning."""
    env = env or environment(task)
    obs, rewards = [env.reset(seed)], []
    for action in actions_for(task, steps):
        after, reward = env.step(action)
        obs.append(after)
        rewards.append(reward)
    return np.array(obs), np.array(rewards)


def python(code, **env):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT,
                          env={**os.environ, **env}, timeout=60)


# all tasks ----------------------------------------------------------------------------


def test_tasks_are_the_eleven_of_the_paper():
    assert fac.TASKS == FIGURE_3


@pytest.mark.parametrize("task", FIGURE_3)
def test_sizes_in_mujoco_are_those_of_figure_3(task):
    dim_obs, dim_action = FIGURE_3[task]
    env = environment(task)
    assert (env.dim_obs, env.dim_action) == (dim_obs, dim_action)
    obs = env.reset(0)
    assert obs.shape == (dim_obs,) and obs.dtype == np.float32
    obs, reward = env.step(np.zeros(dim_action))
    assert obs.shape == (dim_obs,) and obs.dtype == np.float32
    assert 0 <= reward <= 2
    assert env.env.action_spec().shape == (dim_action,)  # MuJoCo's own count of the actuators


@pytest.mark.parametrize("task", FIGURE_3)
def test_an_episode_depends_on_its_seed_alone(task):
    first_obs, first_rewards = play(task, seed=11)
    other_obs, _ = play(task, seed=12)
    again_obs, again_rewards = play(task, seed=11)  # the episode between must leave no trace
    assert np.array_equal(first_obs, again_obs)
    assert np.array_equal(first_rewards, again_rewards)
    assert not np.array_equal(first_obs[0], other_obs[0])


@pytest.mark.parametrize("task", ["walker-walk", "fish-swim"])
def test_a_decision_is_two_control_steps_whose_rewards_are_added(task):
    from dm_control import suite
    seed = 4_000_000_007  # the evaluation's seeds have 32 bits
    direct = suite.load(*task.split("-"), task_kwargs={"random": seed})

    def flat(timestep):
        return np.concatenate([np.ravel(v) for v in timestep.observation.values()])

    obs, rewards = play(task, seed, steps=6)
    expected, sums = [flat(direct.reset())], []
    for action in actions_for(task, 6):
        first, second = direct.step(action), direct.step(action)
        expected.append(flat(second))
        sums.append(first.reward + second.reward)
    np.testing.assert_array_equal(obs, np.array(expected, np.float32))
    np.testing.assert_array_equal(rewards, sums)
    assert min(sums) > 0  # else the sum would not be tested


@pytest.mark.parametrize("task", ROBOTS)
def test_500_decisions_end_where_the_episode_of_dm_control_ends(task, monkeypatch):
    env, last = environment(task), []
    step = env.env.step

    def recorded(control):
        timestep = step(control)
        last.append(timestep.last())
        return timestep

    monkeypatch.setattr(env.env, "step", recorded)
    env.reset(0)
    for _ in range(500):
        env.step(np.zeros(env.dim_action))
    assert fac.EPISODE_STEPS == 500
    assert last == [False] * 999 + [True]


@pytest.mark.parametrize("repeat", [1, 4, 8])
def test_an_action_is_repeated_as_often_as_asked(repeat):
    """Four times is twice two times: same states, and the rewards added up."""
    action, seen = np.float32([0.3, -0.5, 0.8, 0.1]), {}
    for n in (1, repeat):
        env = fac.Environment("hopper-hop", n)
        env.reset(3)
        steps = [env.step(action) for _ in range(16 // n)]
        seen[n] = steps[-1][0], sum(reward for _, reward in steps)
    np.testing.assert_allclose(seen[1][0], seen[repeat][0], rtol=1e-6)
    assert seen[1][1] == pytest.approx(seen[repeat][1])
    config = fac.PlannerConfig(samples=2, iterations=1, horizon=0, action_repeat=repeat)
    assert fac.episode_steps(config.action_repeat) == 1000 // repeat


@pytest.mark.parametrize("workers", [0, 1])
def test_an_episode_is_1000_control_steps_whatever_the_action_repeat(workers):
    model = fac.WorldModel.create(fac.ModelConfig(8, 3, 3, 2, 4, 4), np.random.default_rng(0))
    config = fac.PlannerConfig(samples=2, iterations=1, horizon=0, action_repeat=8)
    obs, actions, rewards, _ = fac.play(model, "reacher-easy", config, [0], workers)
    env = fac.Environment("reacher-easy", 1)
    expected = [env.reset(0)]
    for action in actions[0]:
        expected.append([env.step(action)[0] for _ in range(8)][-1])
    assert rewards.shape == (1, 125) and env.env._step_count == 1000
    np.testing.assert_allclose(obs[0], expected[:-1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("repeat", [0, 3, -2, 2000, 2.5, "2"])
def test_an_action_repeat_that_does_not_divide_an_episode_is_refused(repeat):
    for refuse in (lambda: fac.Environment("reacher-easy", repeat),
                   lambda: fac.PlannerConfig(action_repeat=repeat)):
        with pytest.raises(fac.UserError, match="action_repeat"):
            refuse()
    with pytest.raises(fac.UserError, match="horizon must be below 8, an episode's decisions"):
        fac.PlannerConfig(action_repeat=125, horizon=8)


def test_noise_of_played_episodes_has_another_deviation_in_each(monkeypatch):
    monkeypatch.setattr(fac, "CONTROL_STEPS", 100)
    expert = random_model(1, policy=True)
    for key in ("_pi.4.weight", "_pi.4.bias"):
        expert.params[key][:] = 0  # so that what is done is the noise
    robot = SimpleNamespace(reset=lambda seed: np.zeros(8), step=lambda action: (np.zeros(8), 0.0))
    config, seeds = fac.PlannerConfig(prior="own", iterations=0), list(range(40))
    done, again, other, still = (fac.play(expert, None, config, of, 0, "", robot, noise)[1]
                                 for of, noise in ((seeds, 0.3), (seeds[::-1], 0.3), (seeds, 0.6),
                                                   (seeds[:2], 0.0)))
    deviations = done.std((1, 2))
    assert np.array_equal(done, again[::-1]) and not still.any()
    assert 0 <= deviations.min() < 0.05 and 0.25 < deviations.max() < 0.35
    assert len(set(deviations.tolist())) == 40 and np.abs(other).max() == 1
    assert abs(deviations.mean() - 0.15) < 0.05 and np.abs(done.mean((1, 2))).max() < 0.1


def test_an_environment_of_one_s_own_is_played_here_whatever_its_truth_value():
    class Own(list):
        def reset(self, seed):
            return np.full(3, seed, np.float32)

        def step(self, action):
            return np.zeros(3, np.float32), float(action.shape == (2,))

    model = fac.WorldModel.create(fac.ModelConfig(3, 2, 2, 2, 4, 4), np.random.default_rng(0))
    obs, _, rewards, _ = fac.play(model, "a robot", fac.PlannerConfig(samples=2, iterations=1,
                                                                     horizon=0), [5, 7],
                                  environment=Own())
    assert obs[:, 0, 0].tolist() == [5, 7] and rewards.sum(1).tolist() == [500, 500]


# robots of one's own ------------------------------------------------------------------

SMALL = fac.PlannerConfig(samples=2, iterations=1, horizon=0)


class Robot:
    """Counts its decisions in feature 0; `answer(t)` is what step gives beside the observation.

    It returns the array that it keeps its state in, and scales the action that it is given."""

    dim_obs, dim_action = 3, 2

    def __init__(self, answer=lambda t: (1.0,)):
        self.state, self.answer = np.zeros(3), answer

    def reset(self, seed):
        self.state[:] = 0, seed, 0
        return self.state

    def step(self, action):
        self.state[0] += 1
        self.state[2] = action[0]
        action *= 40
        return self.state, *self.answer(int(self.state[0]))


def play_robot(robot, seeds=(5, 7), config=SMALL, **options):
    model = fac.WorldModel.create(fac.ModelConfig(3, 2, 2, 2, 4, 4), np.random.default_rng(0))
    return fac.play(model, None, config, list(seeds), environment=robot, **options)


def test_what_a_robot_does_to_its_arrays_reaches_no_record():
    obs, actions, *_ = play_robot(Robot())
    assert (obs[..., 0] == np.arange(500)).all() and (obs[..., 1] == [[5], [7]]).all()
    assert np.abs(actions).max() <= 1 and np.array_equal(obs[:, 1:, 2], actions[:, :-1, 0])
    episode = train_expert.Episode(Robot(), 3)
    episode.play(None, 6)
    obs, actions, reward, _ = episode.arrays()
    assert obs[:, 0].tolist() == [*range(7)] and np.abs(actions).max() <= 1
    assert np.array_equal(obs[1:, 2], actions[:, 0]) and reward.tolist() == [1] * 6


def test_an_environment_changes_no_action_and_returns_its_own_arrays():
    from baselines import DecodingEnvironment
    from experiments import DisturbedEnvironment
    for env in (environment("reacher-easy"), DisturbedEnvironment("reacher-easy", 1, "noise"),
                DecodingEnvironment("reacher-easy", SimpleNamespace(encode=lambda obs: obs[None]),
                                    SimpleNamespace(decode=lambda s, a: a))):
        first, action = env.reset(0), np.float32([0.5, -0.5, 0.25])
        seen = [first, *(env.step(action)[0] for _ in range(3))]
        assert action.tolist() == [0.5, -0.5, 0.25] and len({obs.tobytes() for obs in seen}) == 4


def test_an_episode_is_as_long_as_the_robot_says():
    """By a third value of its step; the shorter one ends in NaN and rewards of 0."""
    def lasting(decisions):
        robot = Robot(lambda t: (1.0, t == decisions[robot.state[1]]))
        return robot

    obs, actions, rewards, seconds = play_robot(lasting({5: 30, 7: 12}))
    assert obs.shape == (2, 30, 3) and actions.shape == (2, 30, 2) and seconds.shape == (2, 30)
    assert rewards.sum(1).tolist() == [30, 12] and not rewards[1, 12:].any()
    for values in (obs, actions):
        assert np.isfinite(values[0]).all() and np.isfinite(values[1, :12]).all()
        assert np.isnan(values[1, 12:]).all()
    both = play_robot(lasting({5: 12, 7: 12}))
    assert np.array_equal(both[0][1], obs[1, :12]) and both[0].shape == (2, 12, 3)
    longer = Robot()
    longer.episode_steps = 1201
    assert play_robot(longer)[2].sum(1).tolist() == [1201] * 2


def test_a_robot_that_begins_the_next_episode_by_itself_ends_the_one_before():
    """dm_control's reward there is None."""
    rewards = play_robot(Robot(lambda t: (None if t == 201 else 1.0,)))[2]
    assert rewards.sum(1).tolist() == [200, 200] and rewards.shape == (2, 200)


@pytest.mark.parametrize("answer, parts", [
    (lambda t: (np.nan if t == 9 else 1.0,), ["decision 8: reward", "not finite"]),
    (lambda t: (None,), ["decision 0: reward", "not finite"]),
    (lambda t: (np.ones(2),), ["decision 0: reward", "found (2,)"]),
    (lambda t: ("good",), ["decision 0: reward", "good"]),
    (lambda t: ({"r": 1},), ["decision 0: reward", "{'r': 1}"]),
    (lambda t: (1.0, False, False, {}), ["decision 0:", "(observation, reward)"]),
    (lambda t: (1.0, False, {"an older Gym's": 1}), ["decision 0:", "True or False", "older Gym"]),
    (lambda t: (1.0, np.nan), ["decision 0:", "True or False", "nan"])])
def test_what_a_robot_answers_is_refused_by_decision(answer, parts):
    with pytest.raises(fac.UserError) as caught:
        play_robot(Robot(answer))
    assert all(part in str(caught.value) for part in parts) and "\n" not in str(caught.value)


@pytest.mark.parametrize("end", [True, 1, 1.0, np.True_, np.array([True])])
def test_what_ends_an_episode_may_be_of_any_type_that_is_true_or_false(end):
    assert play_robot(Robot(lambda t: (1.0, end)))[2].sum(1).tolist() == [1, 1]


def test_what_answers_nothing_of_use_is_refused_at_reset():
    robot = Robot()
    for first, part in ((np.full(3, np.nan), "not finite"), ((np.zeros(3), {}), "(array(["),
                        (np.full(3, 1e300), "not finite")):
        robot.reset = lambda seed, first=first: first
        with np.errstate(all="raise"), pytest.raises(fac.UserError, match="reset: obs") as caught:
            play_robot(robot)
        assert part in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("obs, part", [(np.full(3, np.inf), "not finite"), (np.zeros(4), "(4,)"),
                                       ({"position": 0.0}, "NumPy makes no array")])
def test_an_observation_is_refused_by_decision(obs, part):
    robot, answers = Robot(), iter([np.zeros(3)] * 4 + [obs])
    robot.step = lambda action: (next(answers), 1.0)
    with pytest.raises(fac.UserError, match="decision 4: observation") as caught:
        play_robot(robot)
    assert part in str(caught.value)


@pytest.mark.parametrize("seed", [-1, 2 ** 32, 1.5])
def test_a_seed_that_is_none_is_refused(seed):
    with pytest.raises(fac.UserError, match="seed: expected a whole number"):
        environment("reacher-easy").reset(seed)


@pytest.mark.parametrize("repeat, begin", [(2, False), (8, True)])
def test_an_environment_says_that_its_episode_is_over(repeat, begin):
    env = fac.Environment("reacher-easy", repeat)
    if begin:
        env.reset(0)
        for _ in range(env.episode_steps):
            env.step(np.zeros(3))
    message = rf"is over \({1000 // repeat} decisions\).* call reset\(seed\)"
    with pytest.raises(fac.UserError, match=message):
        env.step(np.zeros(3))
    env.reset(0)
    env.step(np.zeros(3))


@pytest.mark.parametrize("action, part", [
    (0.5, "expected shape (6,), found ()"), (np.zeros(1), "found (1,)"), (np.zeros(5), "(5,)"),
    ([np.nan] * 6, "not finite"), (None, "found ()"), ("left", "found 'left', of which NumPy")])
def test_an_environment_refuses_what_is_no_action(action, part):
    env = environment("walker-walk")
    env.reset(0)
    with pytest.raises(fac.UserError, match="^action: ") as caught:
        env.step(action)
    assert part in str(caught.value)


def test_actions_are_scaled_to_the_action_spec(monkeypatch):
    from dm_control import suite
    low, high, received = np.array([-2.0, 0, 1, 5]), np.array([3.0, 10, 2, 7]), []
    spec = SimpleNamespace(minimum=low, maximum=high, shape=(4,))

    def step(control):
        received.append(control)
        return SimpleNamespace(observation={"position": np.zeros(15)}, reward=0.0)

    monkeypatch.setattr(suite, "load", lambda *_, **__: SimpleNamespace(
        action_spec=lambda: spec, step=step, close=None, reset=lambda: None, _step_limit=1000,
        observation_spec=lambda: {"position": SimpleNamespace(shape=(15,))}))
    env = fac.Environment("hopper-hop")
    for action, expected in ((-1, low), (1, high), (0, (low + high) / 2)):
        received.clear()
        env.step(np.full(4, action, np.float32))
        np.testing.assert_allclose(received, [expected] * fac.ACTION_REPEAT, rtol=1e-15)


@pytest.mark.parametrize("task", ROBOTS)
def test_extreme_actions_are_the_limits_of_the_robot(task, monkeypatch):
    env, received = environment(task), []
    step, spec = env.env.step, env.env.action_spec()
    monkeypatch.setattr(env.env, "step", lambda a: received.append(np.array(a)) or step(a))
    env.reset(0)
    for sign, limit in ((-1, spec.minimum), (1, spec.maximum)):
        env.step(np.full(env.dim_action, sign))
        np.testing.assert_array_equal(received[-1], limit)


@pytest.mark.parametrize("typed, meant", [
    ("reacher-hart", "reacher-hard"), ("walker_walk", "walker-walk"), ("cheetah", "cheetah-run"),
    ("Humanoid-Stand", "humanoid-stand"), ("quadruped-runs", "quadruped-run")])
def test_unknown_task_is_told_the_nearest_and_all_known_ones(typed, meant):
    for refuse in (fac.lookup_task, fac.Environment, lambda t: train_expert.Actors(t, 1)):
        with pytest.raises(fac.UserError) as caught:
            refuse(typed)
        message = str(caught.value)
        assert repr(typed) in message and f"did you mean {meant!r}" in message
        assert all(task in message.split("Known tasks:")[1] for task in FIGURE_3)
        assert "\n" not in message


def test_every_task_of_the_suite_works_or_says_why_not():
    """A reset and two decisions each; without a display quadruped-escape can't be loaded."""
    from dm_control import suite
    refused = {}
    for names in suite.ALL_TASKS:
        try:
            env = fac.Environment("-".join(names))
        except fac.UserError as error:
            refused["-".join(names)] = str(error)
            continue
        assert env.reset(0).shape == (env.dim_obs,)
        for _ in range(2):
            obs, reward = env.step(np.zeros(env.dim_action))
            assert obs.shape == (env.dim_obs,) and obs.dtype == np.float32
            assert np.isfinite(obs).all() and np.isfinite(reward)
    assert "control steps" in refused.pop("lqr-lqr_2_1") and "inf" in refused.pop("lqr-lqr_6_2")
    assert refused.keys() <= {"quadruped-escape"}


def test_evaluation_seeds_are_distinct_and_do_not_depend_on_how_many():
    seeds = fac.episode_seeds(0, 50)
    assert len(set(seeds)) == 50 and seeds[:7] == fac.episode_seeds(0, 7)
    assert all(0 <= s < 2 ** 32 for s in seeds)  # what dm_control's RandomState takes
    assert not set(seeds) & set(fac.episode_seeds(1, 50))


def test_training_seeds_are_apart_for_each_run_and_use():
    of_one = fac.training_seeds(0, "own episode", 0, 6)
    assert of_one[2:5] == fac.training_seeds(0, "own episode", 2, 3)
    others = [fac.training_seeds(seed, use, 0, 6) for seed, use in (
        (0, "training episode"), (1, "own episode"), (1, "training episode"))]
    assert len(set(sum(others, of_one))) == 4 * 6


# importing MuJoCo ---------------------------------------------------------------------


def test_mujoco_is_imported_when_an_environment_is_made_and_not_before():
    code = ("import sys, fac_tdmpc_ref as fac; heavy = ('mujoco', 'dm_control', 'torch', "
            "'matplotlib'); assert not [m for m in heavy if m in sys.modules], 'too early'; "
            "fac.lookup_task('reacher-hard'); assert 'mujoco' not in sys.modules; "
            "fac.Environment('reacher-hard'); assert 'mujoco' in sys.modules")
    done = python(code)
    assert done.returncode == 0, done.stderr


def test_a_mujoco_of_another_version_is_explained(monkeypatch):
    """It imports; its first model shows that it lacks a field."""
    sizes = fac.import_dm_control().reacher.Physics.from_xml_string.__globals__[
        "wrapper"].mjbindings.sizes.array_sizes["mjmodel"]
    monkeypatch.setitem(sizes, "of_another_version", ("nv",))
    for make in (lambda: fac.Environment("reacher-hard"), lambda: fac.Environment("walker-walk"),
                 lambda: fac.lookup_task.__wrapped__("cartpole-swingup")):
        with pytest.raises(fac.UserError, match="of_another_version.*mujoco==3.17.0 beside dm-con"):
            make()


def test_a_bad_rendering_setting_is_explained():
    done = python("import fac_tdmpc_ref as fac\ntry: fac.Environment('reacher-hard')\n"
                  "except fac.UserError as error: print(error)", MUJOCO_GL="nonsense")
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert "MUJOCO_GL" in done.stdout and "'nonsense'" in done.stdout
    assert done.stdout.count("\n") == 1


@pytest.mark.parametrize("before", [None, "egl"])
def test_making_an_environment_leaves_the_variables_as_they_were(before):
    """And MuJoCo's own renderer there, for a caller who draws in the same program."""
    code = (f"import os; before = {before!r}; os.environ.pop('MUJOCO_GL', None)\n"
            "if before: os.environ['MUJOCO_GL'] = before\n"
            "import fac_tdmpc_ref as fac\n"
            "try: fac.Environment('reacher-hard')\n"
            "except fac.UserError as error: print(error)\n"
            "import mujoco; assert os.environ.get('MUJOCO_GL') == before\n"
            "assert hasattr(mujoco, 'GLContext')")
    done = python(code)
    assert done.returncode == 0, done.stderr


def test_an_environment_that_can_draw(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "")  # put back in the end
    try:
        look.choose_renderer()
    except fac.UserError as error:
        pytest.skip(str(error))
    done = python("import fac_tdmpc_ref as fac\n"
                  "print(fac.Environment('reacher-hard')"
                  ".env.physics.render(8, 8).shape)")  # by what was chosen
    assert done.stdout == "(8, 8, 3)\n", done.stderr


# reacher ------------------------------------------------------------------------------


def finger_position(joints):
    """Forward kinematics of three equal links, joints (..., 3) -> (..., 2)."""
    angles = np.cumsum(np.asarray(joints, np.float64), -1)
    return LINK * np.stack([np.cos(angles).sum(-1), np.sin(angles).sum(-1)], -1)


def put_target(env, position):
    env.env.physics.named.model.geom_pos["target", ["x", "y"]] = position


@pytest.mark.parametrize("task", ["reacher-easy", "reacher-hard"])
def test_reacher_is_a_chain_of_three_links_of_9_cm(task):
    env = environment(task)
    obs = env.reset(4)
    target = env.env.physics.named.data.geom_xpos["target", :2].copy()
    assert 0.05 <= np.linalg.norm(target) <= 0.20
    for action in actions_for(task, 60):
        finger = finger_position(obs[:3])
        np.testing.assert_allclose(env.env.physics.named.data.geom_xpos["finger", :2], finger,
                                   atol=1e-6)
        np.testing.assert_allclose(obs[3:5], target - finger, atol=1e-6)
        before = obs
        obs, _ = env.step(action)
    assert np.abs(obs[:3] - before[:3]).max() > 1e-3  # it moved, so the chain was tested
    data = env.env.physics.data
    np.testing.assert_array_equal(obs[5:], data.qvel.astype(np.float32))


def test_reacher_inner_joints_stop_at_80_degrees():
    env = environment("reacher-hard")
    env.reset(0)
    model = env.env.physics.model
    assert model.jnt_limited.tolist() == [0, 1, 1]
    np.testing.assert_allclose(model.jnt_range[1:], np.radians([[-80, 80]] * 2))
    with env.env.physics.reset_context():
        env.env.physics.data.qpos[:] = np.radians([25, 80, 80])
    folded = np.linalg.norm(env.env.physics.named.data.geom_xpos["finger", :2])
    assert abs(folded - 0.121) < 5e-4
    env.reset(0)
    for _ in range(150):
        obs, _ = env.step([1, 1, 1])
    # MuJoCo's limits are soft: full torque pushes a little beyond them, the free joint turns on
    assert np.all(np.abs(np.degrees(obs[1:3])) > 79) and np.all(np.degrees(obs[1:3]) < 92)
    assert abs(obs[0]) > 2 * np.pi


@pytest.mark.parametrize("task, target_radius", [("reacher-easy", 0.05), ("reacher-hard", 0.015)])
def test_reacher_rewards_each_control_step_inside_target_and_finger(task, target_radius):
    env = environment(task)
    for seed, direction in ((0, 0.3), (1, 2.0), (2, -2.2)):
        obs = env.reset(seed)
        sizes = env.env.physics.named.model.geom_size
        assert sizes["target", 0] == target_radius and sizes["finger", 0] == 0.01
        unit = np.array([np.cos(direction), np.sin(direction)])
        for distance, expected in ((target_radius + 0.01 - 1e-4, 2.0), (0.0, 2.0),
                                   (target_radius + 0.01 + 1e-4, 0.0)):
            put_target(env, finger_position(obs[:3]) + distance * unit)
            after, reward = env.step(np.zeros(3))  # no torque, no gravity in the plane: at rest
            assert reward == expected
            np.testing.assert_allclose(after[:3], obs[:3], atol=1e-6)


# hindsight ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def segments():
    """Five true segments of reacher episodes, H = 3, and a later step of each."""
    rows = [play("reacher-hard", seed, steps=12) for seed in range(5)]
    obs = np.stack([o[2:6] for o, _ in rows], 1)        # (H + 1, B, 8)
    reward = np.stack([r[2:5] for _, r in rows], 1)     # (H, B)
    later = np.stack([o[k] for (o, _), k in zip(rows, (3, 5, 5, 9, 12))])
    return obs, reward, later


CHOSEN = np.array([True, False, True, True, False])


def test_hindsight_changes_nothing_else(segments):
    obs, reward, later = (a.copy() for a in segments)
    reward[:] = 7  # no true reward: shows where it is written
    train_expert.move_target(obs, reward, later[:, 3:5], CHOSEN, "reacher-hard")
    np.testing.assert_array_equal(obs[:, ~CHOSEN], segments[0][:, ~CHOSEN])
    np.testing.assert_array_equal(np.delete(obs, [3, 4], 2), np.delete(segments[0], [3, 4], 2))
    np.testing.assert_array_equal(later, segments[2])
    assert (reward[:, ~CHOSEN] == 7).all() and (reward[:, CHOSEN] != 7).all()


@pytest.mark.parametrize("task, radius", [("reacher-easy", 0.06), ("reacher-hard", 0.025)])
def test_hindsight_rewards_are_those_of_the_new_distance(task, radius):
    obs, later = np.zeros((4, 3, 8), np.float32), np.zeros((3, 8), np.float32)
    later[:, 3:5] = [0.1, -0.2]
    obs[:, :, 3:5] = [0.1, -0.2]
    obs[0, :, 3] += 5                  # the distance before the first decision earns nothing
    obs[1, :, 3] += radius - 1e-4
    obs[2, :, 4] += radius + 1e-4
    reward = np.full((3, 3), 9.0)
    train_expert.move_target(obs, reward, later[:, 3:5], np.array([True, True, False]), task)
    np.testing.assert_array_equal(reward, [[2, 2, 9], [0, 0, 9], [2, 2, 9]])


def test_hindsight_agrees_with_an_environment_that_has_that_target(segments):
    """The dynamics don't know the target: playing on with it moved gives the same segment."""
    obs, reward, later = (a.copy() for a in segments)
    train_expert.move_target(obs, reward, later[:, 3:5], np.ones(5, bool), "reacher-hard")
    env = environment("reacher-hard")
    for b in range(5):
        env.reset(b)
        put_target(env, finger_position(later[b, :3]))
        for t, action in enumerate(actions_for("reacher-hard", 5)):
            found, earned = env.step(action)
            if t >= 1:
                np.testing.assert_allclose(found, obs[t - 1, b], atol=1e-6)
            if t >= 2:  # ours counts the decision's end twice, so one control step may differ
                assert abs(earned - reward[t - 2, b]) <= 1


def test_new_targets_lie_where_the_task_draws_them():
    """Anywhere around the base, 0.05 to 0.2 away: seen from the finger, as observed."""
    rng = np.random.default_rng(0)
    obs = np.zeros((8, 4000), np.float32)
    obs[:3] = rng.uniform([[-3], [-1.4], [-1.4]], [[3], [1.4], [1.4]], (3, 4000))
    target = train_expert.draw_targets(obs, rng) + finger_position(obs[:3].T).T
    distance, angle = np.hypot(*target), np.arctan2(*target[::-1])
    assert 0.05 - 1e-6 <= distance.min() < 0.052 and 0.198 < distance.max() <= 0.2 + 1e-6
    for values, low, high in ((distance, 0.05, 0.2), (angle, -np.pi, np.pi)):
        counts, _ = np.histogram(values, 10, (low - 1e-6, high + 1e-6))
        assert counts.min() > 300 and counts.max() < 500  # even
    env, seen = environment("reacher-hard"), []
    for seed in range(200):
        env.reset(seed)
        seen.append(np.linalg.norm(env.env.physics.named.data.geom_xpos["target", :2]))
    assert 0.05 <= min(seen) < 0.06 and 0.19 < max(seen) <= 0.2
