"""Students as `distill` makes them, and the README's main table: `experiments.py students`."""
import json
import sys
from pathlib import Path

import numpy as np

sys.path[:0] = map(str, Path(__file__).resolve().parents[:2])
import fac_tdmpc_ref as fac  # noqa: E402
from tables import deviation, markdown, of_returns  # noqa: E402

EVALUATION_SEEDS = (0, 1)
MEASURED = ("rank_correlation", "plan_ms", "same_search_returns",  # of result.json, in a row
            "samples", "iterations")
HEADS = ("seeds", "MPPI", "student", "kept, evaluation seeds 0 / 1", "least kept",
         "planning wins, expert / student", "the same search with the expert: kept",
         "speed-up, one core: over expert / over that",
         "rank correlation of G, H = 0 / last", "minutes")
FLAGS = {"samples": "plan-samples", "iterations": "plan-iterations", "num_agents": "num-agents"}


def folder(students, task, seed, preset):
    """Where `distill` leaves a student: TASK-SEED, its own default, or TASK-SEED-PRESET."""
    return Path(students) / "-".join([task, str(seed), *[preset][:preset != "default"]])


def distil_student(task, seed, preset, settings, students):
    """Distil a student by `distill`, which leaves it in `students`, once; a row for each evaluation
    seed. settings: of FLAGS, `steps` and `episodes`."""
    flags = [f"--{FLAGS.get(name, name)}={value}" for name, value in settings.items()]
    for evaluation_seed in reversed(EVALUATION_SEEDS):  # the first's result.json stays
        args = fac.make_parser().parse_args([
            "distill", "--task", task, "--seed", str(seed), "--preset", preset, "--workers", "0",
            "--out", str(folder(students, task, seed, preset)), *flags,
            "--eval-seed", str(evaluation_seed)])
        found = args.run(args)
        yield {"step": found["steps"], **of_returns(found["student_returns"], evaluation_seed),
               "expert_mean": found["expert_return_mean"], "rank_q": found["rank_correlation"],
               "rank_return": found["rank_correlation_returns"][-1],
               "expert_returns": np.round(found["expert_returns"], 3).tolist(),
               "policy_returns": np.round(found.get("policy_returns", []), 3).tolist(),
               "minutes": found["seconds"] / 60,
               "ranks": {k: v for k, v in found.items() if k.startswith(MEASURED)}}


def mean_and_spread(values, spread):
    """'mean ± spread', or the mean of one."""
    values = np.array(values)
    return f"{values.mean():.0f}" + (f" ± {spread(values):.0f}" if len(values) > 1 else "")


def kept(rows, returns=lambda row: json.loads(row["returns"])):
    """The mean of `returns`, the student's, by the expert's, a ratio of means over rows; NaN:
    nothing."""
    found = fac.return_kept(*(np.mean([np.mean(of(row)) for row in rows]) for of in (
        returns, lambda row: json.loads(row["expert_returns"]))))
    return np.nan if found is None else found


def same_search(row):
    """A row's returns of the expert in its student's search; None where it wasn't made."""
    return json.loads(row["ranks"]).get("same_search_returns")


def planning_wins(rows, key):
    """What planning with a model, whose returns are `key`'s, wins over the expert's policy in the
    same episodes: its mean ± standard error over episodes. rows: {evaluation seed: rows by seed}"""
    found = np.concatenate([
        np.mean([np.subtract(json.loads(row[key]), json.loads(row["policy_returns"]))
                 for row in rows[seed]], 0) for seed in EVALUATION_SEEDS])
    return f"{found.mean():.0f} ± {found.std(ddof=1) / len(found) ** 0.5:.0f}"


def measured(rows, of):
    """The mean over seeds of what `of` makes of each row's MEASURED, a dict."""
    return np.mean([of(json.loads(row["ranks"])) for row in rows])


def cells(rows):
    """A line's HEADS, of {evaluation seed: rows by seed}."""
    if not all(rows[seed] for seed in EVALUATION_SEEDS):
        return ["-"] * len(HEADS)
    first, students = rows[0], sum(rows.values(), [])
    same = [row for row in students if same_search(row)]
    faster = (measured(of, lambda x, key=key: x[key] / x["plan_ms_student_in_process"])
              for key, of in (("plan_ms_expert", first), ("plan_ms_same_search", same)) if of)
    ranks = (measured(first, lambda x, h=h: x["rank_correlation_returns"][h]) for h in (0, -1))
    budget = "{samples} x {iterations}".format_map(json.loads(first[0]["ranks"]))
    returns = [float(row["return_mean"]) for row in first]
    return [len(first), budget, mean_and_spread(returns, deviation),
            " / ".join(f"{kept(rows[seed]):.2f}" for seed in EVALUATION_SEEDS),
            f"{min(kept([row]) for row in students):.2f}",
            "-" if "[]" in (row["policy_returns"] for row in students) else " / ".join(
                planning_wins(rows, key) for key in ("expert_returns", "returns")),
            f"{kept(same, same_search):.2f}" if same else "-",
            " / ".join(f"{x:.1f}" for x in faster),
            " / ".join(f"{x:.2f}" for x in ranks),
            f"{np.mean([float(row['minutes']) for row in first]):.0f}"]


def line_of(row):
    """What a row's line of the table is called: the task; its preset, unless that's the default;
    what flags chose of its planning."""
    about, preset = json.loads(row["settings"]), row["case"]
    return ", ".join([row["task"], *[preset][:preset != "default"], *(
        f"{name} {about[name]}" for name in ("samples", "iterations") if name in about)])


def table(rows, authors):
    """The README's main table, {line: {head: cell}}, and Markdown. authors: {task: text}."""
    runs, lines, result = {}, [], {}
    for row in rows:
        runs.setdefault(line_of(row), {seed: [] for seed in EVALUATION_SEEDS})[
            int(row["evaluation_seed"])].append(row)
    for line, found in runs.items():
        row = sum(found.values(), [])[0]
        policy = json.loads(row["policy_returns"])
        result[line] = dict(zip(HEADS, cells(found)))
        lines.append([line, json.loads(row["settings"])["num_agents"],
                      mean_and_spread(json.loads(row["expert_returns"]), np.std),
                      mean_and_spread(policy, np.std) if policy else "-",
                      *result[line].values(), authors.get(row["task"], "-")])
    return result, markdown(["task", "N", "expert", "its policy alone", *HEADS,
                             "authors' logs: 100% TD-MPC / Fac-TDMPC"], lines)
