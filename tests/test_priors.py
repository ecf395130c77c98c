"""Each agent's prior of its own [D9]: how it learns, and which search around it is chosen."""
import contextlib
import dataclasses

import numpy as np
import pytest

import fac_tdmpc_ref as fac
from toys import CONFIG, Joints, assert_close, distilled, numeric_gradient, random_model, student_of


class Toy(Joints):
    """`Joints` with three joints."""

    def step(self, action):
        self.state = 0.9 * self.state + 0.3 * np.r_[action, np.cumsum(action), action[:2]]
        return self.state, self.state[0] - self.state[5]


# prior_loss ---------------------------------------------------------------------------


def loss_case(n, d=2, steps=3, batch=4, seed=0):
    """A float64 student whose agents have d actions, what its encoders read, and targets."""
    rng = np.random.default_rng(seed)
    sizes = fac.ModelConfig(4, n * d, n, 3, 5, 6, expert_latent_dim=5, expert_enc_dim=4,
                            prior_steps=steps)
    student = fac.WorldModel.create(sizes, rng, dtype=np.float64)
    for value in student.params.values():
        value += 0.3 * rng.standard_normal(value.shape)
    return student, rng.standard_normal((1, 5, batch)), rng.uniform(-1, 1, (n, steps, d, batch))


@pytest.mark.parametrize("n, d, steps, batch", [(1, 2, 3, 4), (3, 2, 3, 4), (3, 1, 1, 1)])
def test_prior_loss_against_central_differences(n, d, steps, batch):
    student, x, targets = loss_case(n, d, steps, batch)
    grads = {k: np.zeros_like(v) for k, v in student.params.items()}
    found = fac.prior_loss(student, x, targets, 0.7, grads)
    assert found == fac.prior_loss(student, x, targets, 0.7)
    for key, value in student.params.items():
        expected = numeric_gradient(lambda: fac.prior_loss(student, x, targets, 0.7), value)
        assert_close(grads[key], expected, 1e-6)
        assert (np.abs(expected).max() > 1e-5) == key.startswith("_prior"), key


def test_prior_loss_adds_to_the_gradients_that_are_there():
    student, *case = loss_case(3)
    once, twice = ({k: np.zeros_like(v) for k, v in student.params.items()} for _ in range(2))
    for grads in (once, twice, twice):
        fac.prior_loss(student, *case, 0.7, grads)
    for key in once:
        np.testing.assert_allclose(twice[key], 2 * once[key])


def test_prior_loss_is_the_weighted_squared_error_of_what_agents_plan():
    student, x, targets = loss_case(3)
    e = student.encode_features(x, name="_prior_encoder")
    plans, expected = student.prior(e, 3), 0.0
    for b in range(4):
        for h in range(3):
            expected += 0.7 ** h * ((plans[:, h, :, b] - targets[:, h, :, b]) ** 2).sum() / 4
    assert np.isclose(fac.prior_loss(student, x, targets, 0.7), expected, rtol=1e-12)
    assert fac.prior_loss(student, x, plans, 0.7) == 0


@pytest.mark.parametrize("n, d", [(1, 2), (3, 2), (6, 1)])
def test_prior_loss_against_torch(n, d):
    torch = pytest.importorskip("torch")
    student, x, targets = loss_case(n, d)
    theirs = {k: torch.tensor(v, requires_grad=True) for k, v in student.params.items()
              if k.startswith("_prior")}

    def layer(name, x):
        return theirs[f"{name}.weight"] @ x + theirs[f"{name}.bias"]

    elu = torch.nn.functional.elu
    e = layer("_prior_encoder.2", elu(layer("_prior_encoder.0", torch.tensor(x))))
    y = e.reshape(n, 3, -1)
    for hidden in (0, 2):
        y = elu(layer(f"_prior.{hidden}", y))
    error = torch.tanh(layer("_prior.4", y)).reshape(targets.shape) - torch.tensor(targets)
    loss = (0.7 ** torch.arange(3.0, dtype=torch.float64)[:, None, None] * error ** 2).sum() / 4
    loss.backward()
    grads = {k: np.zeros_like(v) for k, v in student.params.items()}
    assert np.isclose(fac.prior_loss(student, x, targets, 0.7, grads), loss.item(), rtol=1e-12)
    for key, value in theirs.items():
        assert_close(grads[key], value.grad.numpy(), 1e-10)


def test_agents_learn_their_own_part_of_the_plan_alone():
    """Another agent's targets change no network of one's own but the encoder, which all share."""
    student, x, targets = loss_case(3)
    other = targets.copy()
    other[2] *= -1
    found = []
    for these in (targets, other):
        found.append({k: np.zeros_like(v) for k, v in student.params.items()})
        fac.prior_loss(student, x, these, 0.7, found[-1])
    for key, value in found[0].items():
        if key.startswith("_prior."):
            assert np.array_equal(value[:2], found[1][key][:2])
            assert not np.array_equal(value[2], found[1][key][2])


# learning -----------------------------------------------------------------------------


def test_algorithm_1_and_the_priors_leave_each_other_s_weights_alone(replay):
    """All of them learned by one student; the expert's are nobody's."""
    before, _ = distilled(replay, CONFIG, 0)
    distiller = fac.Distiller(before.expert, replay, CONFIG)
    for _ in range(30):
        distiller.step()
    start = {k: v.copy() for k, v in before.student.params.items()}
    first = {k: v.copy() for k, v in distiller.student.params.items()}
    state = {k: np.copy(v) for k, v in distiller.state().items()}
    with contextlib.closing(distiller):
        fac.teach_priors(distiller, None, fac.PlannerConfig(**fac.STUDENT_PLANNING))
    unchanged = {"_reward.4.bias", "_Q1.5.bias", "_Q2.5.bias"}  # a softmax sees no constant
    for key, value in distiller.student.params.items():
        prior, frozen = key.startswith("_prior"), key.startswith("_expert")
        assert np.array_equal(start[key], first[key]) == (prior or frozen) or key in unchanged, key
        assert np.array_equal(first[key], value) != prior, key
    for key, value in distiller.state().items():
        assert np.array_equal(value, state[key]), key
    distiller.student.params["_dynamics.0.weight"][:] = 7  # still its optimizer's
    assert (distiller.optimizer.params["_dynamics.0.weight"] == 7).all()


def test_a_student_without_priors_learns_by_algorithm_1_as_one_with(replay):
    both, losses = distilled(replay, CONFIG, 10)
    alone, same = distilled(replay, dataclasses.replace(CONFIG, priors=False), 10)
    assert np.array_equal(losses, same)
    assert not [key for key in alone.student.params if key.startswith("_prior")]
    for key, value in alone.student.params.items():
        assert np.array_equal(value, both.student.params[key])


@contextlib.contextmanager
def teachable(replay, agents=3, **settings):
    """A distiller whose expert has played two episodes of the toy robot, and its planning."""
    settings = {"steps": 1200, "batch_size": 16, "expert_episodes": 2, **settings}
    planning = fac.PlannerConfig(**{**fac.STUDENT_PLANNING, "samples": 8, "iterations": 1})
    config = dataclasses.replace(CONFIG, **settings)
    with contextlib.closing(fac.Distiller(random_model(1, policy=True), replay, config,
                                          agents)) as distiller:
        if config.expert_episodes:
            distiller.add(*fac.expert_episodes(distiller, None, planning, environment=Toy()))
        yield distiller, planning


def errors(distiller, obs):
    """Mean squared ones of the priors, and of doing nothing, against the policy's plans."""
    student = distiller.student
    plans = fac.policy_plan(distiller.expert, obs, 4, student.config)
    found = student.prior(student.latents(obs, False), 4)
    return ((found - plans) ** 2).mean(), (plans ** 2).mean()


@pytest.mark.parametrize("agents", [1, 3, "2/0/1"])
def test_taught_priors_do_what_the_policy_does(replay, agents):
    """In the states that they and the policy get into, and in the replay's; held-out ones, too."""
    with teachable(replay, agents) as (distiller, planning):
        known = distiller.replay.sequences(distiller.held_out_starts, 1)[0]
        before, nothing = errors(distiller, known)
        taught = fac.teach_priors(distiller, None, planning, environment=Toy())
        distiller.student.params.update(taught["policy"])
        obs = fac.play(distiller.student, None, dataclasses.replace(planning, iterations=0), [5, 6],
                       environment=Toy())[0].reshape(-1, 8).T
        for states, factor in ((known, 5), (obs, 10)):
            after, nothing = errors(distiller, states)
            assert after < min(before, nothing) / factor


def test_priors_learn_from_the_states_that_they_get_into_themselves(replay, monkeypatch):
    """Labelled by the expert's policy, more of them each round; then from their plans there."""
    rounds, played, play = [], [], fac.play

    def watched(model, task, planning, seeds, *arguments):
        found = play(model, task, planning, seeds, *arguments)
        played.append((planning, seeds, arguments[-3:], found))
        return found

    monkeypatch.setattr(fac, "play", watched)
    with teachable(replay, expert_episodes=5) as (distiller, planning):
        del played[:]  # the expert's
        monkeypatch.setattr(fac, "learn_priors", lambda _, data, number: rounds.append(
            (number, [*data])))
        fac.teach_priors(distiller, None, planning, environment=Toy())
        student, expert = distiller.student, distiller.expert
    assert [(number, len(data)) for number, data in rounds] == [(0, 1), (1, 2), (2, 3), (3, 1)]
    seeds = fac.training_seeds(0, "prior episode", 0, 18)  # a round: an eighth of five, five short
    assert [own for _, own, _, _ in played] == [
        of for i in (6, 12, 0) for of in (seeds[i:i + 1], seeds[i + 1:i + 6])]
    for reflex, _, (noise, *_), _ in played:
        assert (reflex.prior, reflex.iterations, noise) == ("own", 0, fac.OWN_NOISE)
    assert [about[1:] for *_, about, _ in played] == [
        (teacher, share) for teacher in (None, None, planning) for share in (1.0, 0.1)]
    assert [found[0].shape for *_, found in played] == [(1, 12, 8), (5, 1, 8)] * 3
    rows = [[np.concatenate([x.reshape(-1, x.shape[-1]) for x in arrays]).T for arrays in zip(
        *((found[0], found[-1].reshape(*found[0].shape[:2], -1)) for *_, found in played[i:i + 2]))]
            for i in (0, 2, 4)]
    whole = len(distiller.train_starts) + len(distiller.played)
    assert rounds[0][1][0][0].shape[-1] == whole
    for (x, plans), (obs, _) in zip(rounds[2][1][1:], rows):
        np.testing.assert_allclose(x, student.read(obs), atol=1e-5)
        np.testing.assert_allclose(plans, fac.policy_plan(expert, obs, 4, student.config),
                                   atol=1e-4)
    ((x, plans),), (obs, searched) = rounds[3][1], rows[2]
    np.testing.assert_allclose(x, student.read(obs), atol=1e-5)
    assert np.array_equal(plans.reshape(12, -1), searched)


def test_where_nobody_plays_priors_learn_from_the_replay_alone(replay, monkeypatch):
    monkeypatch.setattr(fac, "play", None)
    with teachable(replay, steps=40, expert_episodes=0) as (distiller, planning):
        taught = fac.teach_priors(distiller, None, planning)
        assert [*taught] == ["policy"]
        assert fac.choose_by_playing(distiller, None, taught, [
            dataclasses.replace(planning, iterations=0), planning]) == (planning, [])


@pytest.mark.parametrize("settings", [{"prior": "last"}, {"iterations": 0}, {"output": "sampled"}])
def test_priors_learn_behind_any_planning(replay, settings):
    with teachable(replay, steps=40) as (distiller, planning):
        planning = dataclasses.replace(planning, **settings)
        taught = fac.teach_priors(distiller, None, planning, environment=Toy())
    assert [*taught][0] == "policy"
    for weights in taught.values():
        assert np.isfinite(fac.flatten(weights)[0]).all()


def test_the_same_seed_teaches_the_same_priors(replay):
    found = []
    for seed in (0, 0, 1):
        with teachable(replay, steps=80) as (distiller, planning):
            distiller.seed = seed
            taught = fac.teach_priors(distiller, None, planning, environment=Toy())
            found.append([fac.flatten(weights)[0] for weights in taught.values()])
    assert np.array_equal(found[0], found[1]) and not np.array_equal(found[0], found[2])
    assert not np.array_equal(*found[0])  # what planning taught is something else


def test_a_round_is_a_quarter_of_algorithm_1_s_steps_at_its_own_rate(replay, monkeypatch):
    seen, step = [], fac.Adam.step
    monkeypatch.setattr(fac.Adam, "step", lambda self, lr, clip: (
        seen.append((lr, clip)), step(self, lr, clip))[1])
    with teachable(replay, steps=41, warmup=3, grad_clip=2.0, expert_episodes=0) as (distiller, _):
        x = np.zeros((1, 6, 9), np.float32)
        fac.learn_priors(distiller, [(x, np.zeros((3, 4, 1, 9), np.float32))], 0)
    config = dataclasses.replace(distiller.config, steps=11, lr=fac.PRIOR_LR)
    assert seen == [(fac.learning_rate(config, t), 2.0) for t in range(11)]


def test_priors_that_diverge_stop(replay):
    with teachable(replay, steps=40, expert_episodes=0) as (distiller, planning):
        distiller.student.params["_prior.0.weight"][:] = np.nan
        with pytest.raises(fac.UserError, match="after update 10 the priors' loss is no longer"):
            fac.teach_priors(distiller, None, planning)


# playing ------------------------------------------------------------------------------


@pytest.mark.parametrize("teacher", [
    {"samples": 16, "iterations": 2, "max_std": 0.5}, {"prior": "last", "samples": 8},
    {"iterations": 0}])
def test_a_teacher_s_plans_are_those_of_its_planner_in_each_state(teacher):
    """An episode's first from its seed; who acts doesn't see it."""
    student = student_of(random_model(1, policy=True))
    reflex = fac.PlannerConfig(prior="own", iterations=0)
    teacher = fac.PlannerConfig(**{"prior": "own", "output": "mean", **teacher})
    alone = fac.play(student, None, reflex, [3, 4], environment=Toy(), noise=0.3)
    *both, plans = fac.play(student, None, reflex, [3, 4], environment=Toy(), noise=0.3,
                            teacher=teacher)
    for one, other in zip(alone[:3], both):
        assert np.array_equal(one, other)
    assert len(alone) == 4 and plans.shape[:2] == (2, 12)
    with fac.Planner(student, teacher) as planner:
        for seed, obs, found in zip((3, 4), both[0], plans):
            planner.reset(seed)
            expected = np.stack([planner.plan(seen).ravel() for seen in obs])
            assert np.array_equal(found, expected)


def test_past_an_episode_s_end_a_teacher_has_no_plans():
    class Short(Toy):
        def step(self, action):
            return *super().step(action), abs(self.state[0]) > 1.5

    student = student_of(random_model(1, policy=True))
    reflex = fac.PlannerConfig(prior="own", iterations=0)
    search = fac.PlannerConfig(prior="own", samples=8, iterations=1)
    obs, *_, plans = fac.play(student, None, reflex, [*range(6)], environment=Short(),
                              teacher=search)
    over = np.isnan(obs).any(2)
    assert over.any() and not over.all(1).any()
    assert np.array_equal(np.isnan(plans).all(2), over) and np.array_equal(
        np.isnan(plans).any(2), over)


def test_progress_tells_returns_also_where_a_teacher_plans(capsys):
    """Not something else that a decision holds."""
    class Paid(Toy):
        def step(self, action):
            return super().step(action)[0], 5.0

    reflex = fac.PlannerConfig(prior="own", iterations=0)
    student = student_of(random_model(1, policy=True))
    search = dataclasses.replace(reflex, samples=8, iterations=1)
    for teacher in (None, search):
        fac.play(student, None, reflex, [1], environment=Paid(), teacher=teacher)
        assert "mean return 60" in capsys.readouterr().err


# choosing -----------------------------------------------------------------------------

NONE, SMALL, LARGE = (fac.PlannerConfig(**{**fac.STUDENT_PLANNING, **search}) for search in (
    {"iterations": 0}, {"iterations": 2}, {"samples": 32, "iterations": 3}))
STILL = {"taught": "policy", "max_std": 0.15, "samples": 32, "iterations": 0}


class Chooser:
    """What `choose_by_playing` needs of a distiller: a student of one weight."""

    def __init__(self, expert_episodes):
        self.seed, self.config = 3, dataclasses.replace(CONFIG, expert_episodes=expert_episodes)
        self.student = random_model()
        self.student.params["_prior.x"] = np.zeros(1)


def chosen(monkeypatch, returns, expert_episodes, plannings=(NONE, SMALL, LARGE)):
    """(the planning's index, whose priors, what was played) by returns {(whose, iterations): its
    episodes'}, each of them a return of two decisions."""
    taught = {whose: {"_prior.x": np.full(1, i + 1.0)} for i, whose in enumerate(
        dict.fromkeys(whose for whose, _ in returns))}
    names, seeds, chooser = [None, *taught], [], Chooser(expert_episodes)

    def play(student, task, planning, own, workers, label, environment):
        seeds.append(own)
        whose = names[int(student.params["_prior.x"][0])]
        rewards = np.array(returns[whose, planning.iterations])[:, None] / [[2, 2]]
        assert len(rewards) == len(own)
        return None, None, rewards, None

    monkeypatch.setattr(fac, "play", play)
    planning, played = fac.choose_by_playing(chooser, "x", taught, [*plannings])
    expected = fac.training_seeds(3, "choice", 0, -(-expert_episodes // 6))
    assert all(own == expected for own in seeds) and len(seeds) == len(played)
    kept = chooser.student.params["_prior.x"]
    assert not any(kept is weights["_prior.x"] for weights in taught.values()) or (
        kept == taught[names[int(kept[0])]]["_prior.x"])
    return [*plannings].index(planning), names[int(kept[0])], played


@pytest.mark.parametrize("returns, expected", [
    # the best mean: the largest search, far above what the others reach in every episode
    ({0: [10, 20, 30], 2: [50, 60, 70], 3: [90, 100, 111]}, 2),
    ({0: [10, 20, 30], 2: [90, 100, 111], 3: [50, 60, 70]}, 1),
    ({0: [90, 100, 111], 2: [10, 20, 30], 3: [50, 60, 70]}, 0),
    # a cheaper one within a hundredth, and not a little below
    ({0: [0, 0, 0], 2: [90, 110, 97.1], 3: [100, 100, 100]}, 1),
    ({0: [0, 0, 0], 2: [90, 110, 96.9], 3: [100, 100, 100]}, 2),
    # the cheapest of two that are
    ({0: [90, 110, 97.1], 2: [91, 110, 97.1], 3: [100, 100, 100]}, 0),
    # of what is lost where returns are negative
    ({0: [-9, -9], 2: [-101, -100.9], 3: [-100, -100]}, 0),
    ({0: [-101, -100.9], 2: [-200, 0], 3: [-90, -110]}, 0),
    ({0: [-101, -101.1], 2: [-200, -1], 3: [-90, -110]}, 1),
    ({0: [5], 2: [7], 3: [8]}, 2), ({0: [5], 2: [8], 3: [7]}, 1), ({0: [9], 2: [8], 3: [7]}, 0),
    # ties: the cheapest
    ({0: [5], 2: [8], 3: [8]}, 1), ({0: [8, 8], 2: [8, 8], 3: [8, 8]}, 0)])
def test_the_best_mean_is_kept_or_what_is_cheaper_and_hardly_less(
        monkeypatch, returns, expected):
    found, whose, played = chosen(monkeypatch, {("policy", k): v for k, v in returns.items()},
                                  6 * len(returns[0]))
    assert (found, whose) == (expected, "policy")
    assert [of["returns"] for of in played] == [returns[0], returns[2], returns[3]]
    assert played[0] == {**STILL, "returns": returns[0]}
    assert [of["iterations"] for of in played] == [0, 2, 3]
    assert [of["samples"] for of in played] == [32, 16, 32]


@pytest.mark.parametrize("policy, plans, whose", [
    ([10, 20], [11, 20], "plans"), ([11, 20], [10, 20], "policy"), ([10, 20], [20, 10], "policy"),
    ([10, 20], [0, 31], "plans")])
def test_searches_are_around_the_priors_that_are_better_alone(monkeypatch, policy, plans, whose):
    """Those of the policy where they are as good."""
    returns = {("policy", 0): policy, ("plans", 0): plans, (whose, 2): [30, 42], (whose, 3): [9, 9]}
    found, kept, played = chosen(monkeypatch, returns, 12)
    assert (found, kept) == (1, whose)
    assert [(of["taught"], of["iterations"]) for of in played] == [
        ("policy", 0), ("plans", 0), (whose, 2), (whose, 3)]


def test_a_single_planning_that_flags_leave_is_taken_and_priors_chosen(monkeypatch):
    returns = {("policy", 0): [1, 2], ("plans", 0): [3, 4]}
    found, whose, played = chosen(monkeypatch, returns, 7, [LARGE])
    assert (found, whose, len(played)) == (0, "plans", 2)
    found, whose, played = chosen(monkeypatch, returns, 7, [NONE])
    assert (found, whose, len(played)) == (0, "plans", 2)


def test_without_episodes_the_last_planning_and_teaching_are_taken(monkeypatch):
    assert chosen(monkeypatch, {("policy", 0): [], ("plans", 0): []}, 0) == (2, "plans", [])
    assert chosen(monkeypatch, {("policy", 0): []}, 0) == (2, "policy", [])


def test_two_searches_without_iterations_are_not_played_twice(monkeypatch):
    other = dataclasses.replace(NONE, samples=16)
    found, whose, played = chosen(monkeypatch, {("policy", 0): [1, 2], ("policy", 3): [9, 9]}, 12,
                                  [other, NONE, LARGE])
    assert (found, len(played)) == (2, 2)


def test_a_choice_is_by_real_episodes(replay):
    """Of a toy robot that pays for what the policy does: the priors keep their weights."""
    with teachable(replay, steps=400, expert_episodes=6) as (distiller, planning):
        taught = fac.teach_priors(distiller, None, planning, environment=Toy())
        plannings = [dataclasses.replace(planning, iterations=0), planning]
        found, played = fac.choose_by_playing(distiller, None, taught, plannings,
                                              environment=Toy())
        again = [fac.play(distiller.student, None, dataclasses.replace(
            found, iterations=of["iterations"]), fac.training_seeds(0, "choice", 0, 1),
            environment=Toy())[2].sum(1).tolist() for of in played[2:]]
    alone, best = {of["taught"]: of["returns"][0] for of in played[:2]}, played[2]["taught"]
    assert [of["taught"] for of in played] == ["policy", "plans", best]
    assert alone[best] == max(alone.values()) and again == [played[2]["returns"]]
    for key, value in taught[best].items():
        assert np.array_equal(distiller.student.params[key], value)
    assert found == plannings[int(played[2]["returns"][0] > alone[best])]
