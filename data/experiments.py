#!/usr/bin/env python3
"""The paper's tables and figures, each by one command.

    python data/experiments.py table3                   # figure6: the same, and its picture
    python data/experiments.py figure4 --tasks walker-run --seeds 0 1 2
    python data/experiments.py report

Figures 4, 5, 7, 8, 12, 13, departures, `students`, `capacity` and `sweep` are lists of runs
(runs.py), whose rows go to a CSV under data/results. `report` draws all but sweeps, from CSVs.
Table 3 is in speed.py, section 5.6 in look.py, what is distilled in other ways in baselines.py,
statistics and drawing in tables.py.
"""
import contextlib
import csv
import dataclasses
import functools
import itertools
import json
import os
import re
import sys
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

sys.path[:0] = map(str, Path(__file__).resolve().parents[:2])
import fac_tdmpc_ref as fac  # noqa: E402
import look  # noqa: E402
import plots  # noqa: E402
import speed  # noqa: E402
import students  # noqa: E402
from baselines import AuthorsPlanner, DecodingEnvironment, distiller_of  # noqa: E402
from runs import (  # noqa: E402
    append_rows, finished, key_of, lock, make_all, make_run, read_rows, unique, versions,
    write_rows)
from tables import (  # noqa: E402
    budget_cells, budgets_of, cell, difference_cell, draw_bars, draw_dots, draw_lines, kept_of,
    last, markdown, of_returns)

RESULTS = fac.DATA / "results"
CSVS = {"students": "alone", **dict.fromkeys(  # of commands, where not called like these
    ("figure4", "figure5", "figure13", "departures"), "variants")}


def csv_path(args):
    """Where a command's rows go: of those that change one thing of a student, into one CSV."""
    return Path(args.out or RESULTS / f"{CSVS.get(args.command, args.command)}.csv")


def run_all(args, function, runs):
    """`make_all` for a command, whose runs have to belong in one figure."""
    for task in args.tasks:
        fac.lookup_task(task)
    path = csv_path(args)
    keys = [key for key in finished(read_rows(path)) if key[0] in args.tasks]
    if CSVS.get(args.command, args.command) in REPORTS:
        one_figure(path, [*keys, *map(key_of, runs)], VARIED.get(args.command, ()))
    return make_all(path, functools.partial(of_same_data, function), runs, args.jobs,
                    getattr(args, "scheduler", None))


def planning_for(header, about):
    """A model's own planning but for what a run's settings say of it."""
    own = {k: about[k] for k in ("horizon", *fac.STUDENT_PLANNING) if k in about}
    return fac.PlannerConfig(**{**fac.made_for(header, "model"), **own})


def measure(model, task, planning, count, evaluation_seed, environment=None):
    """A row's columns of the returns of `count` episodes, played in this process."""
    return of_returns(fac.play(model, task, planning, fac.episode_seeds(evaluation_seed, count), 0,
                               "evaluating", environment)[2].sum(1), evaluation_seed)


# ------------------------------------------------- Figures 4, 5, 13 and sweeps: distillation

def distil(task, seed, case, settings):
    """Distil a student and, but for TAP and [D9], teach it priors; a row for each evaluation seed:
    returns of its search, `samples` and `iterations` around priors that know its plans (none is
    chosen by playing here), beside those of its priors alone and of the expert's policy. settings:
    of DistillConfig, and `num_agents`, `episodes`, `evaluation_seeds`."""
    num_agents, count = settings.pop("num_agents", None), settings.pop("episodes", 10)
    evaluation_seeds = settings.pop("evaluation_seeds", students.EVALUATION_SEEDS)
    about = {k: settings.pop(k) for k in ("samples", "iterations") if k in settings}
    config = fac.from_dict(fac.DistillConfig, settings, f"{task}, {case}")
    expert, header = fac.load_model(fac.data_file(task, "expert.npz"))
    distiller = distiller_of(case)(expert, fac.Replay(fac.data_file(task, "replay.npz")), config,
                                   num_agents, seed)
    planning = planning_for(header, {**fac.student_planning(config), **about,
                                     "horizon": config.horizon})
    student, environment, row = distiller.student, None, {"step": config.steps}
    if case == "TAP":  # whose actions are others, which the expert's policy doesn't know
        environment = DecodingEnvironment(task, expert, distiller.vae, planning.action_repeat)
        planning = dataclasses.replace(planning, prior="last", max_std=2.0)
    with contextlib.closing(distiller):
        if config.expert_episodes:
            distiller.add(*fac.expert_episodes(distiller, task, planning, 0))
        for _ in distiller.run():
            pass
        if planning.prior == "own":
            fac.teach_priors(distiller, task, planning, 0)
        if not environment:  # others' ranks are of the robot's actions
            q, g = distiller.ranks(256, planning.discount)
            row.update(rank_q=float(q[0]), rank_return=float(g[-1]))
    reflex, policy = (dataclasses.replace(of, **fac.ALONE)
                      for of in (planning, planning_for(header, {})))
    for of in evaluation_seeds:
        row.update(measure(student, task, planning, count, of, environment))
        if expert.has_policy:
            row["policy_returns"] = measure(expert, task, policy, count, of)["returns"]
        if planning.prior == "own":
            found = measure(student, task, reflex, count, of)["returns"]
            row["ranks"] = {"reflex_returns": found}
        yield {**row}


FIGURE4 = {"default": {}, "N = 1": {"num_agents": 1}, "10% TD-MPC": {}, "TAP": {}}
FIGURE5 = {"default": {}, "joint targets": {"targets": "joint"}, "MSE": {"targets": "joint"},
           **{f"noise {x}": {"noise_std": x} for x in (0.1, 1.0, 2.0)},
           **{f"T_s {x}": {"temperature_student": x} for x in (0.1, 2.0)},
           "consistency": {}, "consistency 0.03": {}}


def distil_all(args, cases):
    """A student of each of `distil_runs`."""
    return run_all(args, distil, distil_runs(args, cases))


def distil_runs(args, cases):
    """A run for each seed and task, and each (case, settings) of cases(task)."""
    budget = {k: getattr(args, k, None) for k in ("steps", "episodes", "samples", "iterations")}
    data = {task: data_checksums(task) for task in args.tasks}
    return [make_run(task, seed, case, data=data[task], **{**budget, **settings})
            for seed, task in itertools.product(args.seeds, args.tasks)
            for case, settings in cases(task)]


def data_checksums(task):
    """Of a task's expert and replay, as a student's file names them; of the defaults, but for
    STUDENT_PLANNING."""
    expert, _ = fac.load_model(fac.data_file(task, "expert.npz"))
    return [*fac.data_checksums(expert, fac.Replay(fac.data_file(task, "replay.npz"))),
            crc(fac.DistillConfig(), fac.PlannerConfig())]


def crc(*settings):
    """A number that tells settings apart."""
    return fac.zlib.crc32(repr(settings).encode())


def of_same_data(function, task, seed, case, settings):
    """A run's rows by `function`; UserError unless the `data` of its settings, which are taken out,
    are today's."""
    fac.need(settings.get("data") == made_from(task, settings),
             f"data/experts/{task} or a default has changed; give the command again")
    settings.pop("data", None)
    return function(task, seed, case, settings)


def made_from(task, settings):
    """What the `data` of a run's settings would be now; None if they name none."""
    if settings.get("data") is None:
        return None
    if settings.get("decisions"):
        return online(task, 0, settings["decisions"], settings["episodes"])[1]
    return data_checksums(task)


def distil_and_time(args, cases):
    """As `distil_all`; then milliseconds of one seed's students, as others take as long, and not of
    TAP's, which decode actions."""
    runs = distil_runs(args, cases)
    return time_all(args, run_all(args, distil, runs), [
        run for run in runs if run["seed"] == runs[0]["seed"] and run["case"] != "TAP"],
        fresh_student)


def fresh_student(run, preset="default"):
    """The student of a run before it learned anything, which takes as long to plan with; header."""
    expert, header = fac.load_model(fac.data_file(run["task"], "expert.npz"))
    config = fac.DistillConfig(**fac.preset_values(fac.DistillConfig, preset))
    with contextlib.closing(distiller_of(run["case"])(
            expert, fac.Replay(fac.data_file(run["task"], "replay.npz")), config,
            json.loads(run["settings"]).get("num_agents"), int(run["seed"]))) as distiller:
        return distiller.student, {**header, "planner": fac.student_planning(config)}


def command_departures(args):
    """departures: the README's differences in distillation one at a time, from ours towards the
    paper's value, as the fields' metadata name them; but for the budget [D1]."""
    cases = {"default": {}}
    for field in dataclasses.fields(fac.DistillConfig):
        tag = re.search(r"D\d+", field.metadata["help"])
        if "paper" in field.metadata and tag[0] != "D1":
            cases.setdefault(tag[0], {})[field.name] = field.metadata["paper"]
    return distil_all(args, lambda task: cases.items())


def command_students(args):
    """students: what `distill` makes by default, for the README's main table; returns first, then
    all milliseconds anew, nothing else running."""
    config = fac.DistillConfig(**fac.preset_values(fac.DistillConfig, args.preset))
    args.steps = args.steps or config.steps
    result = run_all(args, functools.partial(students.distil_student, students=args.students),
                     distil_runs(args, lambda task: [(args.preset, students.each(task))]))
    time_students(Path(result["out"]), args.tasks)
    return result


def command_capacity(args):
    """capacity: one model for all joints, taught like a student, beside a model for each."""
    result = run_all(args, functools.partial(students.distil_student, students=args.students),
                     distil_runs(args, lambda task: [(case, students.MODELS[case](task))
                                                     for case in args.cases]))
    students.time_models(Path(result["out"]))
    return result


def command_experts(args):
    """experts: students of several experts of a task, early ones among them; a model for each
    joint, and one for all. What they keep, with an error over experts."""
    runs = []
    for task, seed, stage in itertools.product(args.tasks, args.seeds, args.stages):
        path = Path(args.experts, f"{task}-{seed}-{stage}", "expert.npz")
        expert, _ = fac.load_model(path, ["expert"])
        about = {"preset": "default", "expert": str(path), "episodes": args.episodes,
                 "weights": fac.checksum(expert.params.values())}
        runs += [make_run(task, seed, f"{stage}: {case}", **about, **sizes) for case, sizes in (
            ("a model for each joint", students.each(task)),
            ("one model", students.one(task, path)))]
    return run_all(args, functools.partial(students.distil_student, students=args.students), runs)


PRINTED = {"60 episodes": {}, "1,000 more": {"expert_episodes": 1000, "played_share": 0.94}}
NO_POLICY = {"the expert's search, 128 x 4": (128, 4), "the expert's search, 512 x 6": (512, 6)}


def printed(task, seed, case, settings, folder):
    """Part I's method (`--preset plain`): a student of more data, or states; or, one of NO_POLICY,
    the expert itself where nothing proposes actions: its search, by perfect predictions."""
    if case not in NO_POLICY:
        yield from students.distil_student(task, seed, case, settings, folder)
        return
    expert, header = fac.load_model(fac.data_file(task, "expert.npz"))
    samples, iterations = NO_POLICY[case]
    planning = fac.PlannerConfig(**{**fac.made_for(header, "expert"), "pi_trajs": 0,
                                    "samples": samples, "iterations": iterations})
    for evaluation_seed in students.EVALUATION_SEEDS:
        yield measure(expert, task, planning, settings["episodes"], evaluation_seed)


def command_printed(args):
    """printed: what the method lacks as it is printed: data, states, or a policy."""
    def cases(task):
        models = {"": {}, ", one model": students.one(task)}
        for batch, data, (name, sizes) in itertools.product(args.batches, args.data,
                                                            models.items()):
            yield f"{data}, {args.steps} x {batch}{name}", {
                "preset": "plain", "batch_size": batch, "reuse": 1, **PRINTED[data], **sizes}

    bounds = [make_run(task, 0, case, data=data_checksums(task), episodes=args.episodes)
              for task, case in itertools.product(args.tasks, args.bounds)]
    return run_all(args, functools.partial(printed, folder=args.students),
                   bounds + distil_runs(args, cases))


def time_students(path, tasks):
    """Measure milliseconds of tasks' decisions anew where some of a CSV's rows have only those of
    `distill`, which were longer beside other runs."""
    with lock(path):
        groups = defaultdict(list)  # of seeds, which take as long
        for row in (rows := read_rows(path)):
            if row["task"] in tasks and row["ranks"]:
                found = json.loads(row["ranks"])
                groups[row["task"], row["case"], row["settings"], found["samples"],
                       found["iterations"]].append((row, found))
        if all(row["ms"] for own in groups.values() for row, _ in own):
            return
        for (task, preset, _, samples, iterations), own in groups.items():
            expert, header = fac.load_model(fac.data_file(task, "expert.npz"))
            student, about = fresh_student(own[0][0], preset)
            theirs = planning_for(header, fac.preset_values(fac.PlannerConfig, preset))
            planning = planning_for(about, {"samples": samples, "iterations": iterations})
            obs = np.random.default_rng(0).standard_normal(student.config.dim_obs, fac.F32)
            ms = students.time_both((expert, theirs), (student, planning), obs)
            for row, found in own:
                row["ranks"] = json.dumps({**found, **{
                    key: ms[key] for key in ms if key.startswith(students.MEASURED)}})
                row["ms"] = f"{ms['plan_ms_student_in_process']:.6g}"
                row["ms_workers"] = f"{ms['plan_ms_student']:.6g}"
        write_rows(path, rows)


def command_sweep(args):
    """sweep: a grid of distill's settings."""
    known, grid = {f.name: f for f in dataclasses.fields(fac.DistillConfig)}, []
    for text in args.set:
        name, equals, values = text.partition("=")
        name = name.replace("-", "_")
        fac.need(equals and (name in known or name == "num_agents"), f"--set {text}: expected "
                 f"SETTING=VALUE[,VALUE ...] with one of num_agents, {', '.join(known)}")
        kind = type(known[name].default) if name in known else int
        read = {bool: lambda x: {"true": True, "false": False}[x.lower()]}.get(kind, kind)
        fac.need(name not in dict(chain[0] for chain in grid), f"--set: {name} is there twice")
        try:
            grid.append([(name, read(value)) for value in values.split(",")])
        except (ValueError, KeyError):
            raise fac.UserError(f"--set {text}: expected {kind.__name__}s") from None
    for settings in (points := [dict(point) for point in itertools.product(*grid)]):
        fac.DistillConfig(**{k: v for k, v in settings.items() if k != "num_agents"})
        for task in args.tasks:
            fac.ModelConfig(*fac.lookup_task(task), settings.get("num_agents", 1))
    return distil_all(args, lambda task: [  # what it chooses isn't reported on its own episodes
        ("sweep", {**settings, "evaluation_seeds": [0]}) for settings in points])


# ------------------------------------------------------------ Figures 7 and 8: planning

BUDGETS = [(s, i) for s in (512, 256, 128, 64, 32, 16) for i in (6, 4, 2, 1)]


def load(task, seed, case, folder):
    """A task's expert (model, header), or the student, of a case or preset, in its folder."""
    if case in ("expert", "policy"):
        return fac.load_model(fac.data_file(task, "expert.npz"))
    case = "default" if case == "student" else case
    path = students.folder(folder, task, seed, case) / "student.npz"
    fac.need(path.exists(), f"{path}: no such file; make it with 'python fac_tdmpc_ref.py distill "
             f"--task {task} --seed {seed} --preset {case} --out {path.parent}', or name the folder"
             " above with --students")
    return fac.load_model(path, ["student"])


def planning_runs(args, variants, experts):
    """A run for each variant (a dict) of planning with each model of each task; experts: how the
    expert plans, "expert" or "policy", its policy alone."""
    runs = []
    for task, (case, seed) in itertools.product(args.tasks, [
            *((case, 0) for case in experts), *(("student", seed) for seed in args.seeds)]):
        model, header = load(task, seed, case, args.students)
        if case != "student":
            expert = fac.checksum(model.params.values())  # as its students' files name it
        data = header.get("data", [expert])
        fac.need(isinstance(data, list) and data[:1] == [expert], f"{args.students}/{task}-"
                 f"{seed}/student.npz: another expert's student than data/{task}/expert.npz; copy "
                 "its own there")
        runs += [make_run(task, seed, case, episodes=args.episodes, **identity(model, header),
                          **variant) for variant in variants(task)]
    return runs


def identity(model, header):
    """What a run's settings say of its model: its weights; how it was made, as seeds share it."""
    planning = planning_for(header, {})
    return {"weights": fac.record_key(model, planning, 0), "made": crc(
        header.get("distill"), header.get("data"), model.config.num_agents, planning)}


def load_same(task, seed, case, settings, folder):
    """`load`; UserError unless a run's settings are of this model."""
    model, header = load(task, seed, case, folder)
    fac.need(identity(model, header).items() <= settings.items(), f"{case} of {task}, seed {seed}, "
             f"in data/ or {folder}/, has changed; give the command again")
    return model, header


def plan_with(task, seed, case, settings, folder):
    """The returns of a model: with its file's planning but for `samples` and `iterations`, on a
    robot that `joint` and `kind` disturb."""
    model, header = load_same(task, seed, case, settings, folder)
    planning = planning_for(header, settings)
    if case == "policy":
        planning = dataclasses.replace(planning, **fac.ALONE)
    environment = (DisturbedEnvironment(task, settings["joint"], settings["kind"],
                                        planning.action_repeat) if settings.get("kind") else None)
    for evaluation_seed in students.EVALUATION_SEEDS:
        yield measure(model, task, planning, settings["episodes"], evaluation_seed, environment)


KINDS = ("noise", "0.5", "1.5")  # an action is noise; its motor's strength


class DisturbedEnvironment(fac.Environment):
    """A task whose robot isn't the planner's: one action is noise, or its motor another."""

    def __init__(self, task, joint, kind, action_repeat=fac.ACTION_REPEAT):
        super().__init__(task, action_repeat)
        self._joint = joint if kind == "noise" else None
        self._rng = fac.stream(joint, "disturbance")
        if self._joint is None:  # what the motor gives for a control, of a servo's stiffness, too
            self.env.physics.model.actuator_gainprm[joint] *= float(kind)
            self.env.physics.model.actuator_biasprm[joint] *= float(kind)

    def step(self, action):
        if self._joint is not None:
            action = np.array(action)
            action[self._joint] = np.clip(self._rng.standard_normal(), -1, 1)
        return super().step(action)


def command_figure7(args):
    """figure7: samples and iterations; returns first, then milliseconds, nothing else running."""
    runs = planning_runs(args, lambda task: [{"samples": s, "iterations": i} for s, i in BUDGETS],
                         ["expert"])
    result = run_all(args, functools.partial(plan_with, folder=args.students), runs)
    return time_all(args, result, runs, lambda run: load(run["task"], run["seed"], run["case"],
                                                         args.students))


def time_all(args, result, runs, opened):
    """Add rows with milliseconds of the runs that have none. opened(run): (model, header)."""
    path, groups = Path(result["out"]), {}  # of one budget, which take turns
    with lock(path):
        timed = {key_of(row) for row in read_rows(path) if row["ms"]}
        for run in unique(runs):
            if key_of(run) not in timed:
                about = json.loads(run["settings"])
                groups.setdefault((run["task"], about.get("samples"), about.get("iterations")),
                                  []).append(run)
        for todo in groups.values():
            append_rows(path, time_runs(todo, opened, args.rounds))
    return result


def time_runs(runs, opened, rounds):
    """Rows with milliseconds of the decisions of runs, which take turns: in one process, and
    students' with a process on each core."""
    calls = []
    with contextlib.ExitStack() as stack:
        for run in runs:
            model, header = opened(run)
            planning = planning_for(header, json.loads(run["settings"]))
            obs = np.random.default_rng(0).standard_normal(model.config.dim_obs, fac.F32)
            for count in {0, speed.useful_workers(model.config.num_agents)}:
                with contextlib.suppress(fac.UserError if count else ()):  # none can be started
                    act = stack.enter_context(fac.Planner(model, planning, workers=count)).act
                    calls.append((run["case"], run["seed"], count > 0, functools.partial(act, obs)))
        found = fac.interleaved_seconds([call[-1] for call in calls], rounds, "timing")
    ms = {call[:3]: 1e3 * float(x) for call, x in zip(calls, np.median(found, 0))}
    return [{**run, "ms": alone, "ms_workers": ms.get((run["case"], run["seed"], True), alone)}
            for run in runs for alone in [ms[run["case"], run["seed"], False]]]


def command_figure8(args):
    """figure8: every action dimension in turn disturbed, which the planner doesn't know."""
    def variants(task):
        joints = range(fac.lookup_task(task)[1])
        return [{}, *({"joint": j, "kind": kind} for j in joints for kind in KINDS)]
    return run_all(args, functools.partial(plan_with, folder=args.students),
                   planning_runs(args, variants, ["expert", "policy"]))


# ------------------------------------------------- as the authors' program plans, and no page says

SEEN = fac.PlannerConfig.pi_trajs
WAYS = {  # how many proposals, whether G_i is multiplied by N, what is executed
    "as printed": (0, False, "sampled"), "proposals": (SEEN, False, "sampled"),
    "sharp scores": (0, True, "sampled"), "both": (SEEN, True, "sampled"),
    "both, the mean": (SEEN, True, "mean")}


def plan_like_authors(task, seed, case, settings, folder):
    """Returns of a student, made by a preset, that searches from its last plan, as printed or in
    the other ways of WAYS; its expert's policy alone beside it."""
    expert, theirs = fac.load_model(fac.data_file(task, "expert.npz"))
    preset, way = case.split(": ")
    student, header = load_same(task, seed, preset, settings, folder)
    own = {key: value for key, value in fac.made_for(header, "student").items()
           if key in ("horizon", "discount", "action_repeat")}
    proposals, sharp, output = WAYS[way]
    times = student.config.num_agents if sharp else 1  # heads are summed here, averaged there
    planning = fac.PlannerConfig(**own, pi_trajs=proposals, output=output, inverse_temperature=(
        times * fac.PlannerConfig.inverse_temperature))
    policy = fac.PlannerConfig(**{**fac.made_for(theirs, "expert"), **fac.ALONE})
    for evaluation_seed in students.EVALUATION_SEEDS:
        found = measure(expert, task, policy, settings["episodes"], evaluation_seed)
        with AuthorsPlanner(student, expert, planning) as planner:
            played = returns_by(planner, task, settings["episodes"], evaluation_seed)
        yield {**of_returns(played, evaluation_seed),
               "policy_returns": found["returns"]}


def returns_by(planner, task, episodes, evaluation_seed):
    """Episodes' returns where a planner acts, as by `fac.evaluate`."""
    found = []
    with contextlib.closing(fac.make_robot(task, planner.config.action_repeat)) as robot:
        for seed in fac.episode_seeds(evaluation_seed, episodes):
            planner.reset(seed)
            obs, rewards = robot.reset(seed), []
            for _ in range(robot.episode_steps):
                obs, reward = robot.step(planner.act(obs))
                rewards.append(reward)
            found.append(sum(rewards))
    return found


def command_authors(args):
    """authors: students that plan as the authors' program does, and the paper doesn't say."""
    runs = [make_run(task, seed, f"{preset}: {way}", episodes=args.episodes,
                     **identity(*load(task, seed, preset, args.students)))
            for task, seed, preset, way in itertools.product(
                args.tasks, args.seeds, args.presets, args.ways)]
    return run_all(args, functools.partial(plan_like_authors, folder=args.students), runs)


def report_authors(_, path, figures):
    """As the authors' program plans: mean returns, ± `students.difference`'s error of that from
    the policy's in the same episodes."""
    table = {}
    for line, found in students.by_line(settled_rows(path)).items():
        (line, way), own = line.split(": "), sum(found.values(), [])
        policy = f"{students.overall(own, 'policy_returns'):.0f}"
        cells = table.setdefault(line, [line, len({row["seed"] for row in own}), policy,
                                        *["-"] * len(WAYS)])
        cells[3 + [*WAYS].index(way)] = (f"{students.overall(own, 'returns'):.0f} ± "
                                         f"{students.difference(found)[1]:.0f}")
    return [*table.values()], markdown(["", "students", "policy alone", *WAYS], table.values())


# ---------------------------------------------------------- Figure 12: distilling on the way

DECISIONS = {"walker-walk": 48_000}  # whose expert has risen late


def online(task, seed, decisions, episodes):
    """train_expert.py's arguments for a run of Figure 12; a number for all that they set."""
    import train_expert
    args = train_expert.make_parser().parse_args([
        "--task", task, "--seed", str(seed), "--student", "fac", "--steps", str(decisions),
        "--workers", "1", "--episodes", "0", "--evaluate-episodes", str(episodes)])
    data = crc(train_expert.read_settings(args), args.envs, args.refresh, args.evaluate_every)
    args.out = f"runs/online-{task}-{seed}-{decisions}-{episodes}-{data}"
    return args, data


def follow(task, seed, case, settings):
    """train_expert.py --student fac: rows of the student's and the expert's returns."""
    args, _ = online(task, seed, **settings)
    args.run(args)
    with open(Path(args.out) / "curve.csv", newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["eval_student"]]
    for row in rows:
        over = {"minutes": float(row["seconds"]) / 60} if row is rows[-1] else {}
        yield {"step": row["decisions"], "return_mean": float(row["eval_student"]),
               "expert_mean": float(row["eval_expert"]), **over}


def command_figure12(args):
    """figure12: online distillation (C.1)."""
    fac.need(not any(map(fac.is_gym, args.tasks)), "--tasks: expected dm_control's")
    fac.need(not args.decisions or args.decisions % 2000 == 0,
             f"--decisions: a multiple of 2000, not {args.decisions}")
    about = {task: {"decisions": args.decisions or DECISIONS.get(task, 30_000),
                    "episodes": args.episodes} for task in args.tasks}
    return run_all(args, follow, [
        make_run(task, seed, "online", data=online(task, seed, **about[task])[1], **about[task])
        for seed, task in itertools.product(args.seeds, args.tasks)])


# ------------------------------------------------------------------ report: tables, pictures

# returns in the authors' logs, mean of 3 seeds, at 500k: Fac-TDMPC, TD-MPC, 10% TD-MPC, TAP
AUTHORS = {
    "reacher-easy": (978, 943, 980, 977), "reacher-hard": (746, 841, 836, 874),
    "hopper-hop": (349, 341, 309, 336), "fish-swim": (529, 618, 668, 169),
    "cheetah-run": (917, 915, 916, 909), "walker-walk": (967, 980, 972, 845),
    "walker-run": (809, 836, 697, 560), "quadruped-walk": (942, 954, 860, 464),
    "quadruped-run": (857, 863, 916, 825), "humanoid-stand": (735, 823, 453, 468),
    "humanoid-walk": (789, 724, 458, 227)}
BUDGET = ("data", "steps", "episodes", "samples", "iterations", "decisions")
VARIED = {"figure7": ("samples", "iterations"), "figure8": ("joint", "kind"),
          "students": ("samples", "iterations"), "experts": ("expert",), "printed": ("steps",)}


def one_figure(path, keys, varied):
    """UserError if runs don't belong in one figure: a seed's were made with other students, a
    case's with other settings than `varied`, a task's with another budget. Budgets by task."""
    seen = {}
    for task, seed, case, settings in keys:
        about = {k: v for k, v in json.loads(settings).items() if k not in varied}
        weights, budget = about.pop("weights", None), {k: about.get(k) for k in BUDGET}
        for key, found in (((seed, case), {"weights": weights}), ((case,), about), ((), budget)):
            other, of, at = seen.setdefault((task, *key), (found, case, seed))
            odd = [k for k in {**other, **found} if other.get(k) != found.get(k)]
            fac.need(not odd, f"{path}: {of} of {task}, seed {at}, was made with "
                     f"{ {k: other.get(k) for k in odd} }, {case}, seed {seed}, with "
                     f"{ {k: found.get(k) for k in odd} }; give one --out for each, or delete rows")
    return {task: found for (task, *rest), (found, *_) in seen.items() if not rest}


def settled(path, varied=(), whole=True):
    """A CSV's finished runs, of one figure; `whole`: without seeds that lack some of what is
    varied."""
    rows = finished(read_rows(path))
    old = {row["versions"] for own in rows.values() for row in own if row["return_mean"]}
    if old - {versions()}:
        others = " and ".join(sorted(of or "versions that it doesn't name" for of in old))
        print(f"{path}: returns of {others}; now {versions()}", file=sys.stderr)
    for task, budget in one_figure(path, rows, varied).items():
        with contextlib.suppress(fac.UserError):  # its data may not be here
            if budget["data"] != made_from(task, budget):
                print(f"{path}: {task} is of other data or defaults than now", file=sys.stderr)
    have = Counter(key[:3] for key in rows)
    parts = [(task, seed, case) for (task, seed, case), count in have.items() if whole and count <
             max(other for (t, _, c), other in have.items() if (t, c) == (task, case))]
    for task, seed, case in parts:
        print(f"{path}: {case} of {task}, seed {seed}, isn't whole: left out", file=sys.stderr)
    return {key: [*{(row["evaluation_seed"], row["step"], row["ms"]): row  # of a torn run the last
                    for row in own if not row["error"]}.values()]
            for key, own in rows.items() if key[:3] not in parts}


def settled_rows(path, varied=()):
    """All rows of `settled` runs, also of seeds that lack some of what is varied."""
    return [row for own in settled(path, varied, whole=False).values() for row in own]


def curves(rows, column="return_mean"):
    """{task: {case: {step: [value of each seed]}}} of finished runs."""
    found = {}
    for (task, _, case, _), own in rows.items():
        curve = found.setdefault(task, {}).setdefault(case, {})
        for step, row in {float(r["step"]): r for r in own if r["step"] and r[column]}.items():
            curve.setdefault(step, []).append(float(row[column]))
    return found


def report_variants(_, path, figures):
    """Figures 4, 5 and 13, and departures: students of which one thing is changed."""
    rows = settled_rows(path)
    ms = {(row["task"], row["case"]): float(row["ms"]) for row in rows if row["ms"]}  # of one seed
    result, text, panels = students.variants_table(students.by_line(
        [row for row in rows if row["return_mean"]]), ms)
    draw_dots(figures / "variants.png", panels, "return - the policy's")
    return result, text


def report_figure12(_, path, figures):
    """Figure 12: a student that follows an expert which learns."""
    rows, table, result = settled(path), [], {}
    found, theirs = curves(rows), curves(rows, "expert_mean")
    draw_lines(figures / "figure12.png", {
        task: ({"student": own["online"], "expert": theirs[task]["online"]}, None)
        for task, own in found.items()}, "decisions")
    for task, own in found.items():
        ratio, lags = follow_up(rows, task)
        both = {"student": last(own["online"], {}), "expert": last(theirs[task]["online"], {})}
        result[task] = {**both, "ratio": ratio, "lag": lags}
        table.append([task, *map(cell, both.values()), "-" if ratio is None else f"{ratio:.2f}",
                      "; ".join(" / ".join("never" if lag is None else str(lag) for lag in seed)
                                for seed in lags)])
    return result, markdown(["", "student", "expert", "ratio",
                             "lag to 50 / 75 / 90%, decisions, each seed"], table)


def follow_up(rows, task):
    """Figure 12 in numbers: the mean final return of students over that of experts; lags to 50, 75
    and 90% of each seed."""
    from train_expert import lag
    runs = [[{"decisions": int(r["step"]), "eval_student": float(r["return_mean"]),
              "eval_expert": float(r["expert_mean"])} for r in own if r["step"]]
            for (t, *_), own in rows.items() if t == task]
    ends = [np.mean([run[-1][key] for run in runs]) for key in ("eval_student", "eval_expert")]
    return fac.return_kept(*ends), [[lag(run, p) for p in (0.5, 0.75, 0.9)] for run in runs]


def report_figure7(_, path, figures):
    """Figure 7: the cheapest budgets that keep 0.95 of what each model gets with the full one, and,
    at equal return, of the lower of both; chosen by every other episode, reported on the rest."""
    cells = {}
    for (task, _, case, settings), own in settled(path, VARIED["figure7"]).items():
        about = json.loads(settings)
        into = cells.setdefault(task, {}).setdefault(case, {}).setdefault(
            (about["samples"], about["iterations"]),
            {"chosen_by": [], "return": [], "all": [], "ms": [], "ms_workers": []})
        played = [x for row in own if row["returns"] for x in json.loads(row["returns"])]
        for key, found in (("chosen_by", played[::2]), ("return", played[1::2]), ("all", played)):
            into[key].append(np.mean(found))
        for key in ("ms", "ms_workers"):
            into[key] += [float(row[key]) for row in own if row[key]]
    panels, result, table = {}, [], []
    for task, cases in cells.items():
        for axis, other, name in ((0, 6, "samples x 6"), (1, 512, "512 x iterations")):
            panels[f"{task}: {name}"] = ({
                case: {budget[axis]: about["all"] for budget, about in budgets.items()
                       if budget[1 - axis] == other} for case, budgets in cases.items()}, None)
        row = budgets_of(task, cases)
        if row:
            result.append(row)
            table.append(budget_cells(row))
    draw_lines(figures / "figure7.png", panels, "samples or iterations", xscale="log")
    return result, markdown(
        ("", *(f"{at}: {of}" for at in ("equal return", "0.95 of its own") for of in (
            "expert", "student, one process", "with workers", "speed-up, one process / best")),
         "kept, 512 x 6 / 128 x 4", "128 x 4: speed-up, one process / best"), table)


def report_figure8(_, path, figures):
    """Figure 8: what is kept of the undisturbed return, mean over action dimensions, and what the
    student keeps less the expert's and its policy's, with an interval; bars by dimension."""
    measured = {}  # {task: {case: {(kind, joint): returns (students, episodes)}}}
    for (task, _, case, settings), own in settled(path, VARIED["figure8"]).items():
        about, played = json.loads(settings), sum((json.loads(row["returns"]) for row in own), [])
        measured.setdefault(task, {}).setdefault(case, {}).setdefault(
            (about.get("kind", "none"), about.get("joint", 0)), []).append(played)
    draw_bars(figures / "figure8.png", measured, KINDS)
    result, table = {}, []
    for task, cases in measured.items():
        both = set.intersection(*map(set, cases.values()))  # measured for all
        joints = {kind: sorted(j for k, j in both if k == kind) for kind in ("none", *KINDS)}
        if not all(joints.values()):
            continue
        kept = {case: {kind: kept_of(values, kind, joints[kind]) for kind in KINDS}
                for case, values in cases.items()}
        result[task] = {case: {kind: found[0] for kind, found in own.items()}
                        for case, own in kept.items()}
        table += [(task, case, f"{np.mean(cases[case]['none', 0]):.0f}",
                   *(f"{x:.2f}" for x in own.values())) for case, own in result[task].items()]
        table += [(task, f"student - {case}", "", *(
            difference_cell(kept["student"][kind], kept[case][kind]) for kind in KINDS))
            for case in kept if case != "student" and "student" in kept]
    return result, markdown(("", "", "undisturbed", *KINDS), table)


def report_alone(_, path, figures):
    """Students whose joints have priors of their own."""
    rows = settled_rows(path, VARIED["students"])
    short, table = students.alone_tables(students.by_line(rows), AUTHORS)
    return {"runs": len(rows)}, f"{short}\n{table}"


def report_capacity(_, path, figures):
    """One model for all joints beside a model for each; the figure: what each search wins
    against milliseconds, in the episodes of the choice."""
    rows = settled_rows(path)
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    rows.sort(key=lambda row: (tasks.index(row["task"]), row["case"] != "default"))
    text, panels = students.capacity_table(students.by_line(rows))
    draw_lines(figures / "capacity.png", panels, "milliseconds of a decision",
               "return - the priors' alone")
    return {"tasks": tasks}, text


def report_experts(_, path, figures):
    """Students of several experts of a task."""
    rows = settled_rows(path, VARIED["experts"])
    return {"runs": len(rows)}, students.experts_table(rows)


def report_printed(_, path, figures):
    """The method as it is printed; the figure: its students beside the expert in the best of its
    searches that its policy doesn't help, against the transitions that they learned from."""
    rows = settled_rows(path, VARIED["printed"])
    text, panels = students.printed_table(students.by_line(rows))
    draw_lines(figures / "printed.png", panels, "transitions learned from (the paper: 10^6)",
               "return (expert: without its policy)", xscale="log", xlim=(1e4, 1.2e6))
    return {"runs": len(rows)}, text


REPORT_HEAD = """# The paper's figures, here

Written by `python data/experiments.py report` from the CSVs beside it; README.md says what they
show. Returns are means over students and episodes, but for figure 7 of evaluation seeds 101 and
102, ± standard error over both (figure 12: deviation over seeds). TAP and [D9] search from the last
plan, what else is changed around priors that know its plans. G's rank correlation is of 256
held-out states; every run's settings are in its CSV. Figure 7's budgets are chosen by every other
episode, returns are of the others; figure 8's intervals are of 95% of a bootstrap over episodes and
joints, bold without 0 in them; figure 12's ratio is one of means. '10% TD-MPC' has hidden layers of
66 (B.2), which with Table 2's latents of 50 is 3% of the weights behind the encoder; six agents
have 26%. One agent's layers are as wide as its expert's, N agents' an Nth of that; latents are of
50 an agent. Minutes are of a core while others distil beside it.

"""
REPORTS = {"alone": report_alone, "capacity": report_capacity, "experts": report_experts,
           "printed": report_printed, "authors": report_authors, "variants": report_variants,
           "figure7": report_figure7, "figure8": report_figure8, "figure12": report_figure12}


def command_report(args):
    """report: every figure that has runs."""
    results, figures, result, text = Path(args.results), Path(args.figures), {}, []
    figures_from = os.path.relpath(figures, results)
    plots.pyplot()
    for name, make in REPORTS.items():
        if finished(read_rows(results / f"{name}.csv")):
            try:
                result[name], table = make(name, results / f"{name}.csv", figures)
            except (LookupError, ValueError, TypeError, StopIteration) as odd:
                raise fac.UserError(f"{results / name}.csv: not {name}'s rows ({odd!r})") from None
            title = name.replace("figure", "Figure ").capitalize()
            drawn = (figures / f"{name}.png").exists()  # not every report draws
            picture = f"![]({figures_from}/{name}.png)\n" if drawn else ""
            text.append(f"## {title}\n\n{table}\n{picture}")
    fac.need(result, f"{results}: no runs there; make some, e.g. with 'experiments.py figure4'")
    with fac.atomic_file(results / "report.md", "w", encoding="utf-8") as file:
        file.write(REPORT_HEAD + "\n".join(text))
    print("\n".join(text) + f"\n{results / 'report.md'}, {figures}/")
    return result


# ------------------------------------------------------------------------------ command line

def make_parser():
    """The command line: a sub-command for each table or figure."""
    parser = fac.Parser(prog="experiments.py", description="The paper's tables and figures, each "
                        "by one command.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="EXPERIMENT")
    positive = functools.partial(fac.natural, least=1)
    speed.add_commands(commands)

    def add_runs(name, run, help, tasks, **defaults):
        sub = fac.add_command(commands, name, run, help, epilog="The same command again makes "
                              "the runs that are missing in the CSV, and only these.")
        sub.add_argument("--tasks", nargs="+", default=tasks, metavar="TASK",
                         help="[" + " ".join(tasks) + "]")
        sub.add_argument("--seeds", nargs="+", type=fac.natural, default=[0, 1, 2],
                         metavar="SEED", help="[0 1 2]")
        sub.add_argument("--jobs", type=positive, default=fac.cores(),
                         help="runs at a time [one for each core]")
        sub.add_argument("--out", help=f"the CSV [data/results/{CSVS.get(name, name)}.csv]")
        sub.add_argument("--episodes", type=positive, default=defaults["episodes"],
                         help="of each evaluation [%(default)s]")
        if "steps" in defaults:
            sub.add_argument("--steps", type=positive, default=defaults["steps"],
                             help="gradient steps [%(default)s; paper: 100000]")
            for name in ("samples", "iterations"):
                sub.add_argument(f"--{name}", type=positive, help="MPPI's, in evaluations "
                                 f"[{fac.STUDENT_PLANNING[name]}]")
        return sub

    def add_cases(name, run, cases, help, tasks):
        sub = add_runs(name, lambda args: run(args, lambda _: [
            (case, cases[case]) for case in args.cases]), help, tasks, **budget)
        sub.add_argument("--cases", nargs="+", default=[*cases], choices=[*cases], metavar="CASE",
                         help=f"any of: {', '.join(cases).replace('%', '%%')} [all]")

    walkers = ["walker-walk", "walker-run"]
    budget = {"steps": fac.DistillConfig.steps, "episodes": 10}
    shipped = [task for task in sorted(fac.TASKS) if (fac.EXPERTS / task / "expert.npz").exists()]
    add_cases("figure4", distil_and_time, FIGURE4, "Section 5.2: Fac-TDMPC, TD-MPC in Table 2's "
              "size and the small one of B.2, and TAP: returns of searches, of priors alone and of "
              "the policy, then milliseconds (keep the machine quiet for these).", shipped)
    add_cases("figure5", distil_all, FIGURE5, "Section 5.3: KL against MSE (and without "
              "credit), the perturbations' deviation (clipped), the student's temperature, a "
              "consistency loss.", walkers)
    add_runs("departures", command_departures, "The differences in distillation one at a time, "
             "towards the paper's values.", ["reacher-hard", "walker-walk"],
             **budget)
    for name, run, help, episodes in (
            ("figure7", command_figure7, "Section 5.4: samples and iterations, expert and student: "
             "returns, then milliseconds (keep the machine quiet for these).", 4),
            ("figure8", command_figure8, "Section 5.5: one action dimension is noise, or its motor "
             "half or one and a half times as strong.", 5)):
        sub = add_runs(name, run, help, walkers, episodes=episodes)
        sub.add_argument("--students", default="runs", help="where distill left TASK-SEED/ [runs]")
    sub = add_runs("students", command_students, "Students as distill makes them by default, for "
                   "the README's main table: evaluation seeds 101 and 102, and the expert's "
                   "policy alone; then, where any is new, milliseconds of all these tasks' (keep "
                   "the machine quiet for these).", shipped, episodes=20)
    sub.add_argument("--students", default="runs", help="leave them in TASK-SEED/ there [runs]")
    sub.add_argument("--preset", choices=("default", "plain", "paper"), default="default",
                     help="distill's: a column of the table for each [default]")
    for name in ("steps", "samples", "iterations"):
        sub.add_argument(f"--{name}", type=positive, help="distill's [the preset's]")
    sub = add_runs("capacity", command_capacity, "Is it the factoring? One model for all joints, "
                   "taught like a student, beside a model for each (default): returns, then "
                   "milliseconds (keep the machine quiet for these).", [
                       "walker-run", "quadruped-walk", "quadruped-run", "humanoid-stand",
                       "humanoid-walk"], episodes=5)
    cases = [*students.MODELS]
    sub.add_argument("--cases", nargs="+", default=cases, metavar="CASE", choices=cases,
                     help=f"any of: {'; '.join(cases)} [all]")
    sub = add_runs("experts", command_experts, "Is it the expert? Students of several experts of "
                   "a task, of EXPERTS/TASK-SEED-STAGE/ (expert.npz, replay.npz).",
                   ["finger-spin"], episodes=5)
    sub.add_argument("--experts", required=True, help="where they are")
    sub.add_argument("--stages", nargs="+", required=True, metavar="STAGE",
                     help="what TASK-SEED-STAGE ends in, such as decisions of training")
    sub = add_runs("printed", command_printed, "What does the printed method lack? Part I's "
                   "(--preset plain), of more data and states, a model for each joint and one of "
                   "equal weights; and the expert's search without its policy.",
                   ["walker-run", "quadruped-walk"], episodes=5)
    for flag, known, help in (("data", PRINTED, "the replay alone, or episodes of the expert's "
                               "policy with noise, too"),
                              ("bounds", NO_POLICY, "the expert's searches")):
        sub.add_argument(f"--{flag}", nargs="*", default=[*known], choices=[*known], metavar="CASE",
                         help=f"{help}, any of: {'; '.join(known)} [all]")
    sub.add_argument("--batches", nargs="+", type=positive, default=[32, 512], metavar="STATES",
                     help="states of a step, each predicted once [32 512]")
    sub.add_argument("--steps", type=positive, default=14000, help="[14000; paper: 100000]")
    sub = add_runs("authors", command_authors, "Students that search as the paper prints it, from "
                   "their last plan, and as the authors' program does: the expert's noisy rollouts "
                   "among each agent's candidates, scores by exp(0.5 N G).",
                   ["walker-run", "quadruped-walk"], episodes=5)
    sub.add_argument("--ways", nargs="+", default=[*WAYS], choices=[*WAYS], metavar="WAY",
                     help=f"any of: {'; '.join(WAYS)} [all]")
    sub.add_argument("--presets", nargs="+", default=["default", "plain"], metavar="PRESET",
                     choices=("default", "plain", "paper"), help="students' [default plain]")
    sub.add_argument("--students", default="runs", help="where distill left TASK-SEED/ and, of "
                     "another preset, TASK-SEED-PRESET/ [runs]")
    sub = add_runs("figure12", command_figure12, "Appendix C.1: an expert that learns and a "
                   "student that follows it.", ["reacher-easy", "walker-walk", "cheetah-run"],
                   episodes=10)
    sub.add_argument("--decisions", type=positive,
                     help="of training, a multiple of 2000 [30000; walker-walk: 48000]")
    add_runs("figure13", lambda args: distil_and_time(args, lambda task: [
        (f"N = {n}", {"num_agents": n}) for n in range(1, fac.lookup_task(task)[1])
        if fac.lookup_task(task)[1] % n == 0] + [("default", {})]),
             "Appendix C.2: the number of agents; returns, then milliseconds (keep the machine "
             "quiet for these).", walkers, **budget)
    for sub in map(commands.choices.get, ("capacity", "experts", "printed")):
        sub.add_argument("--students", default="runs", help="leave them in TASK-SEED-CASE/ [runs]")
    for sub in map(commands.choices.get, ("figure4", "figure7", "figure13")):
        sub.add_argument("--rounds", type=positive, default=20, help="timings of each [20]")
    sub = add_runs("sweep", command_sweep, "A grid over Algorithm 1's settings and num-agents.",
                   ["reacher-hard"], **budget)
    sub.add_argument("--set", nargs="+", action="extend", required=True, metavar="NAME=VALUE,...",
                     help="e.g. lr=1e-3,3e-4 batch-size=16,32; Algorithm 1's in distill --help")
    sub.add_argument("--scheduler", metavar="tcp://HOST:PORT", help="a dask cluster's, which makes "
                     "the runs; it and its workers (--nthreads 1) have this repository and its "
                     "data/ on their PYTHONPATH [none: processes of this machine]")
    sub = fac.add_command(commands, "report", command_report, "Tables and figures from the CSVs: "
                          "data/results/report.md, data/figures/figure*.png.")
    sub.add_argument("--results", default=RESULTS, help="where the CSVs are [data/results]")
    sub.add_argument("--figures", default=fac.DATA / "figures", help="[data/figures]")
    look.add_commands(commands)
    return parser


def main(argv=None):
    """Run the command line; returns the exit status."""
    return fac.run_command(make_parser(), argv)


if __name__ == "__main__":
    sys.exit(main())
