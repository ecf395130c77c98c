"""data/multitask.py: one student for robots of 3 to 6 joints, on small experts made here."""
import contextlib
import csv
import functools
import io
import json
import os
import shutil
import signal
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import fac_tdmpc_ref as fac
import latents
import look
import multitask
import runs
import toys
from multitask_model import SCALES, TASKS, Multitask, MultitaskDistiller, load
from toys import (ONE_THREAD, ROBOTS, ROOT, assert_close, last_json, launch, numeric_gradient,
                  succeeded, write_expert, write_replay)

SCRIPT = ROOT / "data" / "multitask.py"
CONFIG = fac.DistillConfig(steps=40, batch_size=12, warmup=4, expert_episodes=0, held_out=0.34,
                           horizon=2, encoder_input="observation")
TINY = ["--batch-size", "12", "--horizon", "1", "--held-out", "0.34", "--warmup", "2",
        "--expert-episodes", "0"]
refused = functools.partial(toys.refused, program="multitask.py")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with an expert and a replay of each robot."""
    folder = tmp_path_factory.mktemp("data")
    for task, dims in ROBOTS.items():
        write_expert(folder / task / "expert.npz", task, dims)
        write_replay(folder / task / "replay.npz", dims)
    return folder


@contextlib.contextmanager
def distiller_of(data, tasks=tuple(ROBOTS), config=CONFIG, centralized=False, seed=0):
    with contextlib.ExitStack() as stack:
        teachers = {task: stack.enter_context(contextlib.closing(fac.Distiller(
            fac.load_model(data / task / "expert.npz")[0], fac.Replay(data / task / "replay.npz"),
            config, 1 if centralized else None, seed))) for task in tasks}
        yield stack.enter_context(contextlib.closing(MultitaskDistiller(
            teachers, config, centralized, seed)))


def in_float64(student):
    """A copy in double precision, whose last layers aren't zero."""
    rng = np.random.default_rng(3)
    params = {key: value + 0.1 * rng.standard_normal(value.shape) * (key != SCALES)
              for key, value in student.params.items()}
    return Multitask(student.config, params, student.dims)


def loss_of(student, batch, grads=None, loss=MultitaskDistiller.loss):
    features, actions, targets = (
        [x.astype(float) for x in part] if isinstance(part, list) else part.astype(float)
        for part in batch)
    return loss(student, features, actions, targets, CONFIG, grads)[0]


def gradients(student, batch):
    grads = {key: np.zeros_like(value) for key, value in student.params.items()
             if key != SCALES}
    loss_of(student, batch, grads)
    return grads


@pytest.mark.parametrize("centralized", [False, True])
def test_gradients_through_embedding_and_mask(data, centralized):
    """Of a batch of all robots, by the first rows of what each network has, against differences."""
    with distiller_of(data, centralized=centralized) as distiller:
        student, batch = in_float64(distiller.student), distiller.batch(0)
    assert set(np.argmax(batch[0][0, -3:], 0)) == {0, 1, 2}, "a batch mixes tasks"
    assert np.isnan(batch[2][0]).any() != centralized
    grads = gradients(student, batch)
    for key in (TASKS, "_encoder.0.bias", "_dynamics.4.bias", "_Q1.1.weight"):
        part = student.params[key][:, :8]  # a view, which differences change
        numeric = numeric_gradient(lambda: loss_of(student, batch), part)
        assert np.abs(numeric).max() > 1e-6
        assert_close(grads[key][:, :8], numeric, 1e-5)


@pytest.mark.parametrize("task", ROBOTS)
def test_agents_that_a_robot_lacks_change_nothing(data, task):
    """Bit for bit: neither the loss, nor any gradient, nor what is left for the task."""
    with distiller_of(data) as distiller:
        number = [*ROBOTS].index(task)
        batch = distiller.draw(0, number, 16)
        student, n = in_float64(distiller.student), ROBOTS[task][1]
    grads, loss = gradients(student, batch), loss_of(student, batch)
    own = student.of_task(task)
    m = student.config.latent_dim
    for key, value in student.params.items():  # what only absent agents, other tasks have
        if key == SCALES:
            continue
        if key == TASKS:
            value[..., [k for k in range(3) if k != number]] += 1
            assert not np.delete(grads[key], number, 2).any() and grads[key][..., number].any()
        elif key.startswith("_encoder.2"):
            value[:, n * m:] += 1
            assert not grads[key][:, n * m:].any() and grads[key][:, :n * m].any()
        elif not key.startswith("_encoder"):
            value[n:] += 1
            assert not grads[key][n:].any()
    assert loss_of(student, batch) == loss
    after = gradients(student, batch)
    assert all(np.array_equal(after[key], grads[key]) for key in grads)
    again = student.of_task(task)
    assert all(np.array_equal(again.params[key], own.params[key]) for key in own.params)


@pytest.mark.parametrize("centralized", [False, True])
def test_a_task_s_student_may_begin_where_its_teacher_s_policy_does(data, centralized):
    """Without a teacher it has nothing to begin from."""
    with distiller_of(data, centralized=centralized) as distiller:
        teacher, student = distiller.teachers["walker-walk"].expert, distiller.student
    own, alone = student.of_task("walker-walk", teacher), student.of_task("walker-walk")
    obs = np.random.default_rng(0).standard_normal((3, 24)).astype(np.float32)
    reflex = fac.PlannerConfig(prior="own", iterations=0)
    search = fac.PlannerConfig(prior="own", samples=8, iterations=1, horizon=2)
    for seen in obs:
        rollout = fac.policy_rollout(teacher, teacher.encode(seen[:, None]), [np.float32(0)] * 3)
        found = own.prior(own.latents(seen[:, None]), 3)[..., 0]
        assert np.array_equal(found, rollout.reshape(3, len(found), -1).swapaxes(0, 1))
        assert np.array_equal(fac.Planner(own, reflex).act(seen), rollout[0, 0, :, 0])
    last = fac.dataclasses.replace(search, prior="last")
    assert np.array_equal(fac.Planner(own, last).act(obs[0]), fac.Planner(alone, last).act(obs[0]))
    with pytest.raises(fac.UserError, match="no prior for plans"):
        fac.Planner(alone, search)


@pytest.mark.parametrize("task", ROBOTS)
@pytest.mark.parametrize("centralized", [False, True])
def test_a_task_s_student_is_what_the_mask_leaves(data, task, centralized):
    """Its loss by the module's own `distill_loss`, its agents' latents, rewards and Q."""
    with distiller_of(data, centralized=centralized) as distiller:
        k, (dim_obs, dim_action) = [*ROBOTS].index(task), ROBOTS[task]
        padded = distiller.draw(0, k, 16)
        batch = distiller.teachers[task].draw(0, k, 16)
        student = in_float64(distiller.student)
    own = student.of_task(task)
    n = own.config.num_agents
    assert (own.config.dim_obs, own.config.dim_action) == (dim_obs, dim_action)
    assert n == (1 if centralized else dim_action)
    assert np.array_equal(batch[0], padded[0][:, :dim_obs])
    assert np.array_equal(batch[1], padded[1][:, :dim_action])
    assert not padded[1][:, dim_action:].any() and not padded[0][:, dim_obs:24].any()
    assert_close(own.encode(batch[0][0]), student.encode_features(padded[0])[:n], 1e-12)
    assert_close(loss_of(own, batch, None, fac.distill_loss), loss_of(student, padded), 1e-12)


def test_the_centralized_student_has_the_same_encoder_and_as_many_weights(data):
    with distiller_of(data) as factored, distiller_of(data, centralized=True) as centralized:
        one, many = centralized.student.params, factored.student.params
        assert [x.student.config.num_agents for x in (factored, centralized)] == [6, 1]
        assert {k: v.shape for k, v in one.items() if k[1:3] in ("en", "em")} == {
            k: v.shape for k, v in many.items() if k[1:3] in ("en", "em")}
        counts = [len(x.optimizer.vector) for x in (factored, centralized)]
        assert abs(counts[0] / counts[1] - 1) < 0.01
        for a, b in zip(factored.batch(0)[:2], centralized.batch(0)[:2]):
            assert np.array_equal(a, b), "the same states and actions"


def trained(data, steps, **about):
    with distiller_of(data, **about) as distiller:
        losses = [distiller.step() for _ in range(steps)]
        return distiller.optimizer.vector.copy(), np.array(losses), distiller.state()


def test_distilling_learns_repeats_and_goes_on_from_a_state(data):
    vector, losses, _ = trained(data, 40)
    assert losses[-8:, 0].mean() < losses[:8, 0].mean()
    assert np.array_equal(trained(data, 40)[0], vector)
    assert not np.array_equal(trained(data, 40, seed=1)[0], vector)
    _, _, state = trained(data, 17)
    with distiller_of(data) as distiller:
        distiller.load(state)
        for _ in range(23):
            distiller.step()
        assert np.array_equal(distiller.optimizer.vector, vector)


def test_embeddings_stay_within_norm_1(data):
    with distiller_of(data) as distiller:
        embedding = distiller.student.params[TASKS]
        assert_close(np.linalg.norm(embedding, axis=1), np.ones((1, 3)), 1e-6)
        before = embedding.copy()
        for _ in range(20):
            distiller.step()
        assert (np.linalg.norm(embedding, axis=1) <= 1 + 1e-6).all()
        assert np.abs(embedding - before).max() > 1e-3, "they learn"
        distiller.student.params[TASKS][..., 1] *= 9
        distiller.step()
        assert (np.linalg.norm(embedding, axis=1) <= 1 + 1e-6).all()


def test_a_student_may_begin_from_one_of_other_tasks(data):
    """With all its weights, and the embeddings of tasks that both know."""
    with distiller_of(data, ["walker-walk", "reacher-hard"]) as distiller:
        start = distiller.student
        teachers = distiller.teachers
        for _ in range(3):
            distiller.step()
        other = {"hopper-hop": teachers["walker-walk"], "reacher-hard": teachers["reacher-hard"]}
        with contextlib.closing(MultitaskDistiller(other, CONFIG, start=start)) as begun:
            new, old = begun.student.params, start.params
            for key in old:
                if key not in (TASKS, SCALES):
                    assert np.array_equal(new[key], old[key])
            assert np.array_equal(new[TASKS][..., 1], old[TASKS][..., 1])
            assert not np.array_equal(new[TASKS][..., 0], old[TASKS][..., 0])
            begun.step()
            assert not np.array_equal(new["_encoder.0.weight"], old["_encoder.0.weight"])
        with pytest.raises(fac.UserError, match="--start: expected a student .* as many agents"):
            MultitaskDistiller(teachers, CONFIG, centralized=True, start=start)
    with distiller_of(data, ["reacher-hard"]) as narrow:
        with pytest.raises(fac.UserError, match="--start: expected a student for robots as wide"):
            MultitaskDistiller(teachers, CONFIG, start=narrow.student)
        for _ in range(2):  # of a wider start, then of one that had a wider start
            with contextlib.closing(MultitaskDistiller(narrow.teachers, CONFIG,
                                                       start=start)) as begun:
                assert begun.student.config == start.config and [*begun.dims] == ["reacher-hard"]
                assert np.isfinite(begun.step()[0])
                start = begun.student


# the program --------------------------------------------------------------------------


def run(*arguments, cwd, env=ONE_THREAD):
    return launch([SCRIPT, *arguments], cwd, env)


def said(*arguments):
    """What a command, run in this process, prints as its last line."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert multitask.main([*map(str, arguments), "--json"]) == 0
    return json.loads(out.getvalue().splitlines()[-1])


def refused_here(capsys, arguments, *parts):
    """As `refused`, of a command that is run in this process."""
    try:
        code = multitask.main([*map(str, arguments)])
    except SystemExit as end:  # argparse's
        code = end.code
    refused(SimpleNamespace(returncode=code, **dict(zip(("stdout", "stderr"),
                                                        capsys.readouterr()))), *parts)


@pytest.fixture(scope="module")
def student(data, tmp_path_factory):
    """A run of two tasks, and what distill said of it."""
    folder = tmp_path_factory.mktemp("run")
    return folder, said("distill", "--tasks", "reacher-hard,walker-walk", "--data", data,
                        "--steps", "24", "--out", folder / "two", *TINY)


def test_two_robots_end_to_end(data, student):
    folder, found = student
    assert found["tasks"] == ["reacher-hard", "walker-walk"] and found["num_agents"] == 6
    assert {k: len(v) for k, v in found["rank_correlation_returns"].items()} == {
        "reacher-hard": 2, "walker-walk": 2}
    model, header = load(folder / "two" / "student.npz")
    assert header["distill"]["steps"] == 24 and model.dims == {
        "reacher-hard": [8, 3], "walker-walk": [24, 6]}
    scales = model.params.pop(SCALES)
    assert sum(v.size for v in model.params.values()) == found["weights"]
    for k, task in enumerate(model.dims):
        rows = fac.Replay(data / task / "replay.npz").observation
        assert_close(scales[0, :rows.shape[1], k], 1 / rows.std(0, dtype=float), 1e-6)
    with open(folder / "two" / "curve.csv", newline="") as file:
        assert [row["step"] for row in csv.DictReader(file)][-1] == "24"
    done = run("evaluate", "--model", "two/student.npz", "--samples", "16", "--iterations", "1",
               "--episodes", "1", "--data", data, "--tasks", "walker-walk", "--workers", "1",
               "--json", cwd=folder)  # the student goes to another process
    found = last_json(done)["tasks"]
    assert set(found) == {"walker-walk"} and len(found["walker-walk"]["returns"]) == 1
    assert "walker-walk" in done.stdout and "mean" in done.stdout


@pytest.fixture
def short_episodes(monkeypatch):
    """Of 10 decisions; an experiment's runs are made in this process."""
    def in_this_process(function, own, _):
        for run in own:
            yield runs.attempt(function, run)

    monkeypatch.setattr(fac, "CONTROL_STEPS", 20)
    monkeypatch.setattr(runs, "in_processes", in_this_process)


def test_evaluate(data, student, short_episodes):
    evaluated = functools.partial(said, "evaluate", "--model", student[0] / "two" / "student.npz",
                                  "--episodes", "2", "--data", data, "--workers", "0")
    around, alone = evaluated(), evaluated("--prior", "last", "--tasks", "walker-walk")
    assert set(around["tasks"]) == {"reacher-hard", "walker-walk"}
    assert set(alone["tasks"]) == {"walker-walk"}
    found = around["tasks"]["walker-walk"]
    assert alone["tasks"]["walker-walk"]["returns"] != found["returns"]
    assert alone["tasks"]["walker-walk"]["teacher_returns"] == found["teacher_returns"]
    for name, key in (("return_mean", "returns"), ("teacher_mean", "teacher_returns"),
                      ("policy_mean", "policy_returns")):
        assert np.isclose(around[name], np.mean([of[key] for of in around["tasks"].values()]))
    model, _ = load(student[0] / "two" / "student.npz")
    expert, header, path = multitask.load_expert("walker-walk", data)
    assert found["policy_returns"] == fac.evaluate(expert, "walker-walk", fac.PlannerConfig(
        prior="own", iterations=0), 2, 0, 0)["returns"]
    assert found["kept"] == fac.return_kept(np.mean(found["returns"]),
                                            np.mean(found["teacher_returns"]))
    for search, returns in ((fac.STUDENT_PLANNING, found), ({}, alone["tasks"]["walker-walk"])):
        planning = fac.PlannerConfig(horizon=1, **search)
        played = fac.evaluate(model.of_task("walker-walk", expert), "walker-walk", planning, 2, 0,
                              0)["returns"]
        assert played == returns["returns"]


def test_help_is_quick(tmp_path):
    watched = toys.WATCHED.replace(
        f"sys.path.insert(0, {str(ROOT)!r})", f"sys.path.insert(0, {str(ROOT / 'data')!r})"
    ).replace("import fac_tdmpc_ref as fac", "import multitask as fac")
    for command in ([], ["distill"], ["evaluate"]):
        done = succeeded(launch(["-c", watched, *command, "--help"], tmp_path))
        assert "Traceback" not in done.stderr and "multitask.py" in done.stdout
    assert os.listdir(tmp_path) == []


KILLED = """
import os, signal, sys
sys.path.insert(0, {root!r})
import multitask

write = multitask.fac.write_npz
def killing(path, header, arrays, *more):
    write(path, header, arrays, *more)
    if header["kind"] == "checkpoint":
        os.kill(os.getpid(), signal.SIGKILL)
multitask.fac.write_npz = killing
multitask.fac.time.monotonic = iter(range(0, 10 ** 6, 40)).__next__  # a checkpoint at every turn
multitask.main(sys.argv[1:])
"""


def test_a_killed_run_goes_on_to_the_same_end(data, student, tmp_path, monkeypatch, capsys):
    flags = ["distill", "--tasks", "reacher-hard", "walker-walk", "--data", str(data), "--steps",
             "24", "--out", "two", *TINY]
    code = KILLED.format(root=str(ROOT / "data"))
    done = subprocess.run([sys.executable, "-c", code, *flags], cwd=tmp_path, capture_output=True,
                          text=True, env={**os.environ, **ONE_THREAD})
    assert done.returncode == -signal.SIGKILL, done.stderr
    _, arrays = fac.read_npz(tmp_path / "two" / "checkpoint.npz", ("checkpoint",))
    assert 0 < arrays["step"] < 24
    succeeded(run(*flags, cwd=tmp_path))
    ours, theirs = (load(folder / "two" / "student.npz")[0].params
                    for folder in (tmp_path, student[0]))
    assert all(np.array_equal(ours[key], theirs[key]) for key in theirs)
    succeeded(run(*flags, cwd=tmp_path))  # a finished one stays
    monkeypatch.chdir(tmp_path)
    for more in (["--expert-episodes", "1"], ["--tasks", "walker-walk", "reacher-hard"]):
        refused_here(capsys, [*flags, *more], "student.npz", "other settings", "--out")


@pytest.mark.parametrize("flags, parts", [
    (["distill", "--tasks", "walker-wolk"], ["did you mean 'walker-walk'"]),
    (["distill", "--tasks", "walker-walk,walker-walk"], ["--tasks", "walker-walk", "twice"]),
    (["distill", "--tasks", "cheetah-run", "--data", "{data}"], ["cheetah-run", "no such file"]),
    (["distill", "--steps", "0"], ["steps", "at least 1"]),
    (["distill", "--targets", "joint"], ["--targets"]),
    (["distill", "--start", "{data}/walker-walk/expert.npz"], ["kind", "'multitask'"]),
    (["latents", "--model", "{model}"], ["student.npz", "one of hopper", "reacher-hard"]),
    (["latents", "--model", "{model}", "--out", "x.gif"], ["x.gif", ".png"]),
    (["evaluate", "--model", "none.npz"], ["none.npz", "no such file"]),
    (["evaluate", "--model", "{data}/walker-walk/expert.npz"], ["kind", "'multitask'"]),
    (["evaluate", "--model", "{model}", "--tasks", "hopper-hop"],
     ["hopper-hop", "is of reacher-hard, walker-walk"]),
    (["evaluate", "--model", "{model}", "--data", "none"], ["none", "expert.npz", "no such file"]),
    (["evaluate", "--model", "{model}", "--episodes", "0"], ["episodes", "at least 1"])])
def test_bad_input_is_one_line(capsys, data, student, flags, parts):
    if flags[0] == "latents":
        pytest.importorskip("matplotlib")
    values = {"data": data, "model": student[0] / "two" / "student.npz"}
    refused_here(capsys, [flag.format(**values) for flag in flags], *parts)


def test_figure_10_refuses_before_it_distils(capsys, data, tmp_path):
    pytest.importorskip("sklearn")
    pytest.importorskip("matplotlib")
    flags = ["figure10", "--tasks", "walker-walk", "--data", data, "--students", tmp_path / "own",
             "--picture", tmp_path / "x.png", "--out"]
    (tmp_path / "rows.csv").write_text("task,other\n")
    refused_here(capsys, [*flags, tmp_path / "rows.csv"], "rows.csv", "expected the columns")
    refused_here(capsys, [*flags, tmp_path / "rows.csv" / "x.csv"], "can't be written")
    folder = tmp_path / "data" / "walker-walk"
    expert, header = fac.load_model(data / "walker-walk" / "expert.npz")
    for key in [key for key in expert.params if key.startswith("_pi")]:
        expert.params.pop(key)
    folder.mkdir(parents=True)
    fac.save_model(folder / "expert.npz", expert, header)
    flags[flags.index(data)] = tmp_path / "data"
    refused_here(capsys, [*flags, tmp_path / "new.csv"], "expert.npz", "no policy", "--tasks")
    assert not (tmp_path / "own").exists()
    shutil.copy(data / "walker-walk" / "replay.npz", folder)
    refused_here(capsys, ["distill", "--tasks", "walker-walk", "--data", tmp_path / "data", "--out",
                          tmp_path / "own"], "walker-walk: the expert has no policy; pass --policy")


def test_another_expert_than_the_student_s_is_refused(capsys, tmp_path, student):
    write_expert(tmp_path / "walker-walk" / "expert.npz", "walker-walk", (24, 6), seed=5)
    refused_here(capsys, ["evaluate", "--model", student[0] / "two" / "student.npz", "--data",
                          tmp_path, "--tasks", "walker-walk"], "another expert", "--data")


@pytest.mark.parametrize("change, parts", [
    (lambda h, a: a.pop("_dynamics.0.weight"), ["_dynamics.0.weight", "(6, 85, 51)"]),
    (lambda h, a: a.update(x=np.zeros(1, np.float32)), ["x: expected", "nothing"]),
    (lambda h, a: a[TASKS].fill(np.nan), [TASKS, "finite"]),
    (lambda h, a: h.update(tasks={"walker-walk": [24, 5]}), ["walker-walk", "[24, 6]", "[24, 5]"]),
    (lambda h, a: h.update(tasks=["walker-walk"]), ["tasks", "sizes by task"]),
    (lambda h, a: h.update(of={"walker-walk": 5}), ["of: expected checksums by task"]),
    (lambda h, a: h["model"].update(enc_dim=0), ["model", "enc_dim", "at least 1"])])
def test_a_damaged_file_is_named(student, tmp_path, change, parts):
    header, arrays = fac.read_npz(student[0] / "two" / "student.npz", ("multitask",))
    change(header, arrays)
    fac.write_npz(tmp_path / "odd.npz", json.loads(json.dumps(header)), arrays)
    with pytest.raises(fac.UserError) as error:
        load(tmp_path / "odd.npz")
    assert all(part in str(error.value) for part in [*parts, "odd.npz"])


def synthetic(parts, rng, spread=0.1):
    """Latents (N, 8, 200) of agents around a place of their own for each of `parts`."""
    places = np.random.default_rng(0).standard_normal((9, 8, 1))
    return np.stack([places[part] + spread * rng.standard_normal((8, 200)) for part in parts])


def test_latents_are_of_the_student_s_own_replays(capsys, data, tmp_path):
    pytest.importorskip("sklearn")
    pytest.importorskip("matplotlib")
    flags = ["distill", "--tasks", "walker-walk,hopper-hop", "--data", data, "--steps", "4", *TINY]
    assert multitask.main([*map(str, flags), "--out", str(tmp_path / "run")]) == 0
    latents_in = ["latents", "--model", tmp_path / "run" / "student.npz", "--out",
                  tmp_path / "x.png", "--points", "20", "--data"]
    found = said(*latents_in, data)
    shown = found["untrained"][latents.BETWEEN]
    assert set(shown) == set(found[latents.BETWEEN]) and shown != found[latents.BETWEEN]
    assert set(found["untrained"]["recognition"]) == set(found["recognition"])
    write_replay(tmp_path / "other" / "walker-walk" / "replay.npz", (24, 6), 7)
    capsys.readouterr()
    refused_here(capsys, [*latents_in, tmp_path / "other"], "walker-walk", "another replay")
    refused_here(capsys, [*latents_in, tmp_path], "walker-walk", "no such file", "--data")


@pytest.mark.parametrize("hopper, joint", [((6, 0, 1, 2), 1), ((0, 1, 2, 6), 0)])
def test_between_robots_it_is_joints_and_not_slots_that_are_compared(hopper, joint):
    """Latents of hip, knee and ankle alike, or of the agents with the same numbers."""
    pytest.importorskip("sklearn")
    of = {"walker-walk": (0, 1, 2, 0, 1, 2), "hopper-hop": hopper}

    def latents_of(task, states):
        return synthetic(of[task], np.random.default_rng(len(task)))[:, :, :states]

    found = latents.compare(latents_of, of, 50, 0)[latents.BETWEEN]
    assert (found["joint"] > 0.8) == joint and (found["task within a joint"] > 0.8) != joint


def test_silhouettes_tell_joints_from_tasks():
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(1)
    alike = {task: synthetic(range(4), rng) for task in ("a", "b", "c")}
    found = latents.silhouettes(alike, rng)
    assert found["joint"] > 0.8 and abs(found["task"]) < 0.1
    assert abs(found["joints shuffled"]) < 0.1 > abs(found["task within a joint"])
    apart = {"a": synthetic([0] * 4, rng), "b": synthetic([1] * 4, rng)}
    found = latents.silhouettes(apart, rng)
    assert found["task"] > 0.8 < found["task within a joint"] and found["joint"] < 0.1


@pytest.mark.parametrize("hopper, other, slots", [
    ((6, 0, 1, 2), 1, 1 / 3), ((0, 1, 2, 6), 1 / 3, 1), ((6, 7, 8, 7), None, None)])
def test_recognition_tells_anatomy_from_slots(hopper, other, slots):
    """Latents of the hopper's waist, hip, knee, ankle like the walker's hip, knee, ankle (0, 1, 2);
    like those of the same slots; like neither."""
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(2)
    walker, hopper = synthetic((0, 1, 2, 0, 1, 2), rng), synthetic(hopper, rng)
    found = latents.recognition(walker, hopper)
    assert found["walker's right leg, then its left"]["other leg"] == 1
    for name in ("walker's right leg, then hopper", "hopper, then walker's right leg"):
        assert found[name]["itself"] > 0.99 or other is None
    got = found["walker's right leg, then hopper"]
    if other == 1:
        assert got["other leg"] > 0.99 and got["same slots there"] <= 1 / 3 + 0.34
    elif slots == 1:
        assert got["same slots there"] > 0.99 and got["other leg"] <= 1 / 3


def figure10(capsys, data, *more):
    flags = ["--tasks", "walker-walk", "hopper-hop", "--data", str(data), "--steps", "40",
             "--episodes", "2", "--out", "rows.csv", "--picture", "figure10.png", "--students",
             "students", "--seeds", "0", "1", *TINY, "--json"]
    assert multitask.main(["figure10", *flags, *more]) == 0, capsys.readouterr().err
    out = capsys.readouterr().out
    return json.loads(out.splitlines()[-1]), out


def test_figure_10(data, tmp_path, monkeypatch, capsys, short_episodes):
    pytest.importorskip("sklearn")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(look, "t_sne", lambda x: x[:, :2])  # half of the time, and figure9's
    found, out = figure10(capsys, data)
    assert (found["runs"], found["now"], found["failed"]) == (20, 20, 0)  # 2 x (2 x 2 x 2 + 2)
    cases = {f"{case}{prior}" for case in ("Fac-TDMPC", "TD-MPC") for prior in (
        "", ", around the policy")}
    returns = found["returns"]
    assert list(returns) == ["mean of 2 tasks", "walker-walk", "hopper-hop"]
    for title, of in returns.items():
        assert set(of) == {*cases, "teacher", "its policy alone"} and title in out
        assert all({k: len(v) for k, v in of[case].items()} == {
            "4.0": 2, "12.0": 2, "40.0": 2} for case in cases)
        assert [*of["teacher"]] == [*of["its policy alone"]] == ["40.0"]
    for case in cases:
        assert np.allclose(returns["mean of 2 tasks"][case]["12.0"], np.mean([
            returns[task][case]["12.0"] for task in ("walker-walk", "hopper-hop")], 0))
    model, _ = load("students/1/TD-MPC/step-12.npz")
    expert, header, path = multitask.load_expert("walker-walk", data)
    planning = fac.PlannerConfig(**fac.STUDENT_PLANNING, **{**fac.made_for(header, path),
                                                            "horizon": 1})
    played = fac.play(model.of_task("walker-walk", expert), "walker-walk", planning,
                      fac.episode_seeds(0, 2), 0)[2].sum(1).mean()
    assert np.isclose(returns["walker-walk"]["TD-MPC, around the policy"]["12.0"][1], played)
    with distiller_of(data, ["walker-walk", "hopper-hop"], fac.DistillConfig(
            horizon=1, held_out=0.34, expert_episodes=0), seed=1) as distiller:
        distiller.student, _ = load("students/1/Fac-TDMPC/step-12.npz")
        distiller.refresh()
        expected = distiller.teachers["hopper-hop"].ranks(256)[1][-1]
    assert np.isclose(found["ranks"]["hopper-hop"]["Fac-TDMPC"]["12.0"][1], expected)
    assert set(found["latents"]) == {"0", "1"}
    for name in ("figure10.png", "figure10-latents.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"
    monkeypatch.setattr(latents, "compare", lambda *_: {})
    again, _ = figure10(capsys, data)
    assert again["now"] == 0 and again["returns"] == returns
    more, _ = figure10(capsys, data, "--lr", "2e-3", "--students", "others", "--seeds", "0")
    assert more["now"] == 12, "what other students got isn't theirs"
