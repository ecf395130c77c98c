"""Students as `distill` makes them, what argues about them, and their tables: `experiments.py
students`."""
import contextlib
import dataclasses
import functools
import json
import re
import shutil
from pathlib import Path

import numpy as np

import fac_tdmpc_ref as fac
from baselines import of_equal_weights
from runs import lock, read_rows, write_rows
from speed import useful_workers
from tables import deviation, markdown, of_returns

EVALUATION_SEEDS = (101, 102)  # which nothing was chosen by
MEASURED = ("rank_correlation", "plan_ms", "same_search_returns",  # of a result, in a row
            "reflex_returns", "played", *fac.CHOSEN)
FLAGS = {"samples": "plan-samples", "iterations": "plan-iterations"}


def folder(students, task, seed, case):
    """Where `distill` leaves a student: TASK-SEED, its own default, or TASK-SEED-CASE."""
    name = "" if case == "default" else "-" + re.sub("[^a-z0-9]+", "-", case)
    return Path(students) / f"{task}-{seed}{name}"


def sizes_of(task, num_agents=None, mlp_dim=None, path=None):
    """A student's sizes, as `distill` makes it, from the task's expert or another."""
    expert, _ = fac.load_model(path or fac.data_file(task, "expert.npz"))
    config = fac.DistillConfig()
    sizes = fac.student_config(expert.config, num_agents, config.encoder_input, config.horizon + 1)
    return dataclasses.replace(sizes, mlp_dim=mlp_dim or sizes.mlp_dim)


def weights(sizes):
    """How many there are, without biases, behind a model's encoders."""
    return sum(int(np.prod(shape)) for name, _, _, shape, _ in fac.layers(sizes)
               if not name.endswith("_encoder"))


def each(task):
    """`distill`'s sizes of a model for each joint."""
    return {"num_agents": fac.lookup_task(task)[1]}


def one(task, path=None):
    """`distill`'s sizes of one model for all joints, of as many weights as a model for each."""
    sizes = of_equal_weights(sizes_of(task, 1, path=path), sizes_of(task, path=path), weights)
    return {"num_agents": 1, "mlp_dim": sizes.mlp_dim}


MODELS = {"default": each, "one model, equal weights": one,
          "one model, 512 wide": lambda task: {"num_agents": 1, "mlp_dim": 512}}


def compared(expert, student):
    """`fac.compared` and, if the student searches, the expert searching around its policy like it
    around its priors: what the model alone saves [D9]."""
    found, (model, own), (_, planning) = fac.compared(expert, student), expert, student
    if planning.prior == "own" and planning.iterations:
        search = {name: getattr(planning, name) for name in fac.SEARCH}
        found["same_search"] = model, dataclasses.replace(own, **{**search, "pi_trajs": 0})
    return found


def time_both(expert, student, obs):
    """Milliseconds of a decision with all that is `compared`, in this process, and of the student
    with a process on each core; where that costs more than it saves, or can't be (in a pool's
    process, under a profiler), it counts as planning in one."""
    workers = useful_workers(student[0].config.num_agents)
    with contextlib.ExitStack() as stack:
        acts = {name: stack.enter_context(fac.Planner(*planned)).act
                for name, planned in compared(expert, student).items()}
        with contextlib.suppress(fac.UserError):
            if workers:
                acts["workers"] = stack.enter_context(fac.Planner(*student, workers=workers)).act
        seconds = fac.interleaved_seconds(
            [functools.partial(act, obs) for act in acts.values()], 20, "timing")
    ms = dict(zip(acts, (1e3 * np.median(seconds, 0)).tolist()))
    alone, beside = ms.pop("student"), ms.pop("workers", np.inf)
    return {**{f"plan_ms_{name}": value for name, value in ms.items()},
            "plan_ms_student_in_process": alone, "plan_ms_student": (best := min(alone, beside)),
            "speedup": ms["expert"] / best, "plan_workers": workers if best < alone else 0}


def argue(args, chosen):
    """What `distill` of these arguments doesn't say of its student, with the search `chosen`: the
    returns of the expert in the same search, and `time_both`, for its result."""
    expert, header = fac.load_model(path := args.expert or fac.data_file(args.task, "expert.npz"))
    student, about = fac.load_model(Path(args.out, "student.npz"), ["student"])
    own = {**fac.preset_values(fac.PlannerConfig, args.preset), **fac.made_for(header, path)}
    both = ((expert, fac.PlannerConfig(**own)),
            (student, fac.PlannerConfig(**{**fac.made_for(about, args.out), **chosen})))
    found = time_both(*both, np.zeros(student.config.dim_obs, fac.F32))
    if same := compared(*both).get("same_search"):
        model, planning = same
        found["same_search_returns"] = fac.evaluate(
            model, args.task, planning, args.episodes, args.eval_seed, args.workers,
            "evaluating the expert, searching like its student")["returns"]
    return found


def distil_student(task, seed, case, settings, students):
    """Distil a student by `distill`, which leaves it in `students`, once; a row for each evaluation
    seed. case: a preset, one of MODELS or, where settings name a preset, any; settings: of
    distill's flags or FLAGS, and, for a run to be known by, an own expert's `weights`."""
    preset = settings.pop("preset", "default" if case in MODELS else case)
    settings.pop("weights", None)
    flags = [f"--{FLAGS.get(name, name).replace('_', '-')}={value}"
             for name, value in settings.items()]
    out = default = folder(students, task, seed, case)
    if budget := [f"{k}-{settings[k]}" for k in ("samples", "iterations") if k in settings]:
        out = default.with_name("-".join([default.name, *budget]))  # whose search is another
        if default.exists() and not out.exists():
            shutil.copytree(default, part := out.with_name(f"{out.name}.tmp"), dirs_exist_ok=True)
            part.rename(out)  # whole, or not there
    for evaluation_seed in reversed(EVALUATION_SEEDS):  # the first's result.json stays
        args = fac.make_parser().parse_args([
            "distill", "--task", task, "--seed", str(seed), "--preset", preset, "--workers", "0",
            "--out", str(out), *flags, "--eval-seed", str(evaluation_seed)])
        found = args.run(args)
        found.update(argue(args, {name: found[name] for name in fac.CHOSEN}))
        yield {"step": found["steps"], **of_returns(found["student_returns"], evaluation_seed),
               "expert_mean": found["expert_return_mean"], "rank_q": found["rank_correlation"],
               "rank_return": found["rank_correlation_returns"][-1],
               "expert_returns": np.round(found["expert_returns"], 3).tolist(),
               "policy_returns": np.round(found.get("policy_returns", []), 3).tolist(),
               "minutes": found["seconds"] / 60,
               "ranks": {k: v for k, v in found.items() if k.startswith(MEASURED)}}


def mean_and_spread(values, spread, digits=0):
    """'mean ± spread', or the mean of one."""
    values = np.array(values)
    return " ± ".join(f"{x:.{digits}f}" for x in (
        values.mean(), *([spread(values)] if len(values) > 1 else [])))


def returns(row, key="returns"):
    """A row's returns: the student's, or what else `distill` compares; []: not there."""
    return (json.loads(row[key] or "[]") if key in row else
            json.loads(row["ranks"] or "{}").get(key, []))


def overall(rows, key):
    """The mean of these returns over episodes and rows."""
    return np.mean([np.mean(returns(row, key)) for row in rows])


def kept(rows, key="returns"):
    """The mean of these returns by the expert's, a ratio of means over rows; NaN: nothing."""
    found = fac.return_kept(overall(rows, key), overall(rows, "expert_returns"))
    return np.nan if found is None else found


def difference(rows, key="returns", over="policy_returns"):
    """What returns are above others in the same episodes: mean, and standard error over episodes
    and over students, as if these were apart. rows: {evaluation seed: rows by seed}"""
    return mean_and_error(by_episode(rows, lambda row: np.subtract(returns(row, key),
                                                                   returns(row, over))))


def by_episode(rows, of=returns):
    """What `of` makes of each row, (students, episodes), of {evaluation seed: rows by seed}."""
    return np.concatenate([[of(row) for row in rows[seed]] for seed in sorted(rows)], 1)


def mean_and_error(found):
    """Of values (students, episodes) the mean, and its error as in `difference`."""
    errors = [x.std(ddof=1) / len(x) ** 0.5 for x in (found.mean(0), found.mean(1)) if len(x) > 1]
    return found.mean(), np.hypot.reduce(errors)


def measured(rows, of):
    """The mean over seeds of what `of` makes of each row's MEASURED, a dict."""
    return np.mean([of(json.loads(row["ranks"])) for row in rows])


def ranks(rows):
    """The rank correlation of G of H = 0 and the last."""
    return " / ".join(f"{measured(rows, lambda x, h=h: x['rank_correlation_returns'][h]):.2f}"
                      for h in (0, -1))


def line_of(row):
    """What a row's line of the table is called: the task; its preset, unless that's the default;
    what flags chose of its planning."""
    about, preset = json.loads(row["settings"]), row["case"]
    return ", ".join([row["task"], *[preset][:preset != "default"], *(
        f"{name} {about[name]}" for name in ("samples", "iterations") if name in about)])


def by_line(rows):
    """{line: {evaluation seed, lowest first: rows by seed}}."""
    found = {}
    for row in sorted(rows, key=lambda row: (int(row["evaluation_seed"]), int(row["seed"]))):
        found.setdefault(line_of(row), {}).setdefault(int(row["evaluation_seed"]), []).append(row)
    return {line: found[line] for line in dict.fromkeys(map(line_of, rows))}


def alone_tables(lines, authors):
    """What each joint wins alone: the README's table, and all of it. Mean returns over students and
    episodes of all evaluation seeds: the expert, its policy alone, the student's priors alone, the
    student with the search that it chose by playing (it may be none), the expert in the same
    search; ± `difference`'s error of the student's from the expert's. authors: {task: returns
    in the authors' logs, of Fac-TDMPC and of TD-MPC first}."""
    short, whole = [], []
    for line, rows in lines.items():
        own = sum(rows.values(), [])
        about = [json.loads(row["ranks"]) for row in own]
        for row, of in zip(own, about):  # a student that doesn't search is its priors
            row["reflex_returns"] = json.dumps(of.get("reflex_returns", returns(row)))
            row["same_returns"] = json.dumps(of.get("same_search_returns",
                                                    returns(row, "policy_returns")))
        expert, policy, reflex, student, same = (f"{overall(own, key):.0f}" for key in (
            "expert_returns", "policy_returns", "reflex_returns", "returns", "same_returns"))
        _, error = difference(rows, over="expert_returns")
        search = " / ".join(dict.fromkeys(
            "{samples} x {iterations}, {max_std}".format_map(of) if of["iterations"] else "none"
            for of in about))
        ms = [np.mean([of[f"plan_ms_{who}"] for of in about])
              for who in ("expert", "student_in_process")]
        agents = json.loads(own[0]["settings"])["num_agents"]
        star = "\\*" * any(of["iterations"] for of in about)  # some search
        short.append([f"{line}, {agents}", expert, policy, f"{student} ± {error:.0f}{star}",
                      f"{ms[0] / ms[1]:.0f}"])
        whole.append([line, agents, len(about), expert, policy, reflex, student, same,
                      f"{kept(own):.2f} ± {error / overall(own, 'expert_returns'):.2f}", search,
                      *(f"{x:.1f}" for x in ms), ranks(own),
                      " / ".join(map(str, authors.get(line, "-")[1::-1]))])
    return (markdown(["task, N", "expert", "its policy", "student", "times as fast"], short),
            markdown(["task", "N", "rows", "expert", "its policy alone", "priors alone", "student",
                      "expert, same search", "kept", "its search", "ms: expert",
                      "ms: student", "rank of G, H = 0 / last",
                      "authors' logs: TD-MPC / Fac-TDMPC"], whole))


# ----------------------------------------------------------- one model for all joints beside N

def time_models(path):
    """Milliseconds of a decision, by the priors alone and by each search, of all models in a CSV
    that aren't timed, beside a model for each joint; nothing else should run."""
    with lock(path):
        rows, found = read_rows(path), {}
        for row in rows:
            width = json.loads(row["settings"]).get("mlp_dim")  # a model for each: beside these
            if width and row["ranks"] and "ms_by_search" not in (about := json.loads(row["ranks"])):
                if (key := (row["task"], width)) not in found:
                    found[key] = time_searches(*key)
                row["ranks"] = json.dumps({**about, "ms_by_search": found[key]})
        write_rows(path, rows)


def time_searches(task, width):
    """Milliseconds of a model for each joint, and of one model, this wide, by `fac.SEARCHES`."""
    calls, searches = [], [fac.PlannerConfig(**{**fac.STUDENT_PLANNING, **search})
                           for search in fac.SEARCHES]
    for sizes in sizes_of(task), sizes_of(task, 1, width):
        model = fac.WorldModel.create(sizes, np.random.default_rng(0))
        obs = np.zeros(sizes.dim_obs, fac.F32)
        calls += [functools.partial(fac.Planner(model, planning).act, obs)
                  for planning in searches]
    seconds = fac.interleaved_seconds(calls, 20, f"{task}, timing")
    return (1e3 * np.median(seconds, 0)).reshape(2, -1).tolist()


def played_by_search(row):
    """{search: returns (episodes,)}, cheapest first, of the priors that a student kept and of each
    search around them, in the episodes by which it chose."""
    played = json.loads(row["ranks"])["played"]
    return {"{samples} x {iterations}, {max_std}".format_map(of) if of["iterations"] else "priors":
            of["returns"] for of in played if of["taught"] == played[-1]["taught"]}


def capacity_table(lines):
    """One model for all joints beside a model for each, taught alike: what searching wins over the
    priors is of the episodes by which a student chose. lines: `by_line`'s, of every task some that
    `time_models` timed. Markdown, and panels of what each search wins against milliseconds."""
    timed, found, panels = {}, [], {}
    for row in (by_seed[min(by_seed)][0] for by_seed in lines.values()):
        if ms := json.loads(row["ranks"]).get("ms_by_search"):
            timed[row["task"], "default"], timed[row["task"], row["case"]] = ms
    for by_seed in lines.values():
        rows, first = sum(by_seed.values(), []), by_seed[min(by_seed)]
        task, case, settings = first[0]["task"], first[0]["case"], json.loads(first[0]["settings"])
        _, error = difference(by_seed, over="expert_returns")
        ms = timed.get((task, case), ())
        sizes = sizes_of(task, settings["num_agents"], settings.get("mlp_dim"))
        by_search = [*map(played_by_search, first)]  # of each student
        played = np.stack([[*of.values()] for of in by_search], 1)  # (searches, students, episodes)
        expert, student = (overall(rows, key) for key in ("expert_returns", "returns"))
        name = f"{sizes.num_agents} models" if case == "default" else case
        found.append([
            task, name, sizes.mlp_dim, f"{weights(sizes) / 1e3:.0f}k", len(first), f"{expert:.0f}",
            f"{student:.0f} ± {error:.0f}", f"{played[0].mean():.0f}",
            *("{:+.0f} ± {:.0f}".format(*mean_and_error(of - played[0])) for of in played[1:]),
            ranks(first), " / ".join(f"{x:.2f}" for x in ms) or "-",
            f"{min(float(row['minutes']) for row in first):.1f}"])
        label = "a model for each joint" if case == "default" else case
        panels.setdefault(task, ({}, None))[0][label] = {
            x: (of - played[0]).mean(1).tolist() for x, of in zip(ms, played)}
    names = [*by_search[0]]  # all lines' alike
    searched = [f"{name} - priors" for name in names[1:]]
    budgets = " / ".join(name.split(",")[0] for name in names)
    return markdown(["task", "models", "width", "weights", "students", "expert", "student",
                     "priors", *searched, "rank of G, H = 0 / last", f"ms: {budgets}",
                     "minutes, least"], found), panels


# ------------------------------------------------------ the expert as a factor; what is printed

def experts_table(rows):
    """Students of several experts of a task, a row's seed being its expert's: means over episodes
    of all evaluation seeds, each expert's; what is kept and what a student wins over its expert's
    policy, ± standard error over experts. Markdown."""
    found, own = [], {}
    for row in rows:
        own.setdefault((row["task"], *row["case"].split(": ")), {}).setdefault(
            row["seed"], []).append(row)
    for key, by_expert in sorted(own.items()):
        groups = [by_expert[seed] for seed in sorted(by_expert)]
        expert, policy, student = (np.array([overall(of, name) for of in groups]) for name in (
            "expert_returns", "policy_returns", "returns"))
        errors = (mean_and_spread(x, lambda x: deviation(x) / len(x) ** 0.5, digits)
                  for x, digits in ((student / expert, 2), (student - policy, 0)))
        searches = (fac.budget(json.loads(of[0]["ranks"])) for of in groups)
        found.append([*key, *(" / ".join(f"{x:.0f}" for x in of)
                              for of in (expert, policy, student)), " / ".join(searches), *errors])
    return markdown(["task", "decisions of training", "models", "experts", "their policies",
                     "students", "MPPI", "kept", "student - policy"], found)


def printed_table(lines):
    """The method as printed, of more data or states, beside the expert's search; ± standard error
    over episodes and over students, as if these were apart. lines: `by_line`'s. Markdown, and
    panels of each student's return against the transitions that it learned from."""
    found, levels, panels = [], {}, {}
    recorded = functools.cache(
        lambda task: fac.Replay(fac.data_file(task, "replay.npz")).transitions)
    for rows in lines.values():
        own = sum(rows.values(), [])
        if own[0]["expert_returns"]:
            levels[own[0]["task"]] = overall(own, "expert_returns"), overall(own, "policy_returns")
    for rows in lines.values():
        own = sum(rows.values(), [])
        task, case, level = own[0]["task"], own[0]["case"], overall(own, "returns")
        known = levels.get(task, ())  # a student's row names them
        _, error = mean_and_error(by_episode(rows))
        found.append([task, case, len({row["seed"] for row in own}),
                      *([f"{x:.0f}" for x in known] or "--"), f"{level:.0f} ± {error:.0f}",
                      f"{level / known[0]:.2f}" if known else "-",
                      ranks(own) if own[0]["ranks"] else "-"])
        curves, bound = panels.setdefault(task, ({}, None))
        if not own[0]["ranks"]:
            panels[task] = curves, max(level, bound or 0)
            continue
        about = json.loads(own[0]["settings"])
        transitions = recorded(task) + about.get("expert_episodes", 0) * fac.EPISODE_STEPS
        models = "one model" if about.get("num_agents") == 1 else "a model for each joint"
        models += ", {steps} x {batch_size}".format_map(about)
        curves.setdefault(models, {})[transitions] = by_episode(rows).mean(1).tolist()
    return markdown(["task", "what searches", "students", "expert", "its policy", "return", "kept",
                     "rank of G, H = 0 / last"], found), panels


# --------------------------------------------------------------------- one thing changed at a time

def variants_table(lines, ms):
    """Students of which one thing is changed, by their search (but for TAP and [D9] around priors
    that know its plans) and by their priors alone; the search's return less the default students'
    of the same seeds in the same episodes. lines: `by_line`'s; ms: {(task, case): milliseconds}.
    Result {task: {case: ...}}, Markdown, panels."""
    groups, result, found, panels = {}, {}, [], {}
    for rows in lines.values():
        first = rows[min(rows)]
        groups.setdefault(first[0]["task"], {})[first[0]["case"]] = rows

    def of_seeds(rows, seeds):
        return by_episode({at: [row for row in own if row["seed"] in seeds]
                           for at, own in rows.items()})

    for task, cases in groups.items():
        default = cases.get("default", {})
        known = {row["seed"] for own in default.values() for row in own}
        for case in sorted(cases, key=lambda case: (case != "default", case)):
            first = cases[case][min(cases[case])]
            search, policy, reflex = (
                by_episode(cases[case], lambda row, key=key: returns(row, key))
                for key in ("returns", "policy_returns", "reflex_returns"))
            about = {"students": len(first), "search": search.mean()}
            if shared := known & {row["seed"] for row in first}:
                about["above_default"] = mean_and_error(of_seeds(cases[case], shared) -
                                                        of_seeds(default, shared))
            dots = panels.setdefault(task, {}).setdefault(case, {})
            if reflex.size:
                about.update(priors=reflex.mean(), search_wins=mean_and_error(search - reflex))
            for name, of in (("its search", search), ("priors alone", reflex)):
                if of.size and policy.size:
                    dots[name] = mean_and_error(of - policy)
            h0, last = (np.mean([float(row[key] or "nan") for row in first])
                        for key in ("rank_q", "rank_return"))
            result.setdefault(task, {})[case] = about
            above, wins = ("{:+.0f} ± {:.0f}".format(*of) if (of := about.get(key)) else "-"
                           for key in ("above_default", "search_wins"))
            found.append([task, case, len(first), f"{policy.mean():.0f}" if policy.size else "-",
                          f"{search.mean():.0f}", above,
                          f"{reflex.mean():.0f}" if reflex.size else "-", wins,
                          f"{h0:.2f} / {last:.2f}" if np.isfinite(last) else "-",
                          f"{ms[task, case]:.1f}" if (task, case) in ms else "-"])
    return result, markdown(["task", "students", "number", "policy", "its search",
                             "less the default's", "priors alone", "search - priors",
                             "rank of G, H = 0 / last", "ms"], found), panels
