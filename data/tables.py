"""What `experiments.py report` says and draws: statistics, Markdown, lines.

Here ± is the sample deviation over seeds (n - 1); students.py's is a standard error. A ratio is one
of means, never a mean of ratios.
"""
import csv
from pathlib import Path

import numpy as np

import fac_tdmpc_ref as fac
import plots


def deviation(values):
    """Sample deviation (n - 1), over seeds; of one: 0."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def of_returns(returns, evaluation_seed):
    """A row's columns of episodes' returns; the deviation is of these (n), not a sample's."""
    return {"return_mean": float(np.mean(returns)), "return_std": float(np.std(returns)),
            "return_min": float(np.min(returns)), "evaluation_seed": evaluation_seed,
            "returns": np.round(returns, 3).tolist()}


def last(curve, ranks):
    """Mean and sample deviation over seeds, and their number, where a curve ends; the rank
    correlation of G there, if it was measured."""
    values = curve[max(curve)]
    found = {"mean": float(np.mean(values)), "std": deviation(values), "seeds": len(values)}
    return {**found, "rank_return": float(np.mean(ranks[max(ranks)]))} if ranks else found


def record(path, heads, found):
    """Keep rows, each a number behind what it is of, in a CSV, in place of earlier ones of the
    same."""
    rows, mine = [], {tuple(map(str, of)): f"{number:.2f}" for *of, number in found}
    if Path(path).exists():
        with open(path, newline="", encoding="utf-8") as file:
            rows = [row for row in list(csv.reader(file))[1:] if tuple(row[:-1]) not in mine]
    with fac.atomic_file(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([heads, *rows, *(
            (*of, number) for of, number in mine.items())])


def markdown(heads, rows):
    """A Markdown table."""
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in (
        heads, ["---"] * len(heads), *rows)) + "\n"


def cell(found):
    """mean ± deviation over seeds, if there are several (their number), rank correlation of G."""
    if not found:
        return "-"
    rank = f", {found['rank_return']:.2f}" if "rank_return" in found else ""
    spread = f" ± {found['std']:.0f} ({found['seeds']})" if found["seeds"] > 1 else ""
    return f"{found['mean']:.0f}{spread}{rank}"


def draw_lines(path, panels, xlabel, ylabel="episode return", **axes):
    """A panel each {title: ({label: {x: [values]}}, level or None)}: mean and band (± sample
    deviation) over seeds; the level, an expert's, is a line across."""
    labels = list(dict.fromkeys(label for lines, _ in panels.values() for label in lines))
    cycle = list(plots.pyplot().rcParams["axes.prop_cycle"])
    with plots.panels(path, len(panels), 4, 3.6, 3.8) as grid:
        for ax, (title, (lines, level)) in zip(grid, panels.items()):
            for label, points in lines.items():
                style = cycle[labels.index(label) % len(cycle)]  # the same in all panels
                x = sorted(points)
                mean, std = (np.array([f(points[v]) for v in x]) for f in (np.mean, deviation))
                ax.plot(x, mean, marker=".", label=label, **style)
                ax.fill_between(x, mean - std, mean + std, color=style["color"], alpha=0.15)
            if level is not None:
                ax.axhline(level, color="black", linewidth=0.8, linestyle=(0, (1, 3)),
                           label="expert")
            low = min([0, *(np.mean(y) for points in lines.values() for y in points.values())])
            ax.set(title=title, xlabel=xlabel, ylabel=ylabel,
                   ylim=(1.05 * low, 1.05 * max(0, ax.get_ylim()[1])), **axes)
            if axes:  # logarithmic: a tick for each point
                ax.set_xticks(x := sorted(set().union(*lines.values())), [f"{v:.0f}" for v in x])
                ax.minorticks_off()
            else:
                ax.locator_params("x", nbins=5)


def draw_dots(path, panels, xlabel):
    """A panel each {title: {case: {label: (mean, error)}}}: a line for a case, a dot a label."""
    height = 1.5 + 0.28 * max(map(len, panels.values()))
    with plots.panels(path, len(panels), 3, 5.5, height) as grid:
        for ax, (title, cases) in zip(grid, panels.items()):
            labels = list(dict.fromkeys(label for found in cases.values() for label in found))
            for i, label in enumerate(labels):
                at = [y for y, found in enumerate(cases.values()) if label in found]
                means, errors = zip(*(found[label] for found in cases.values() if label in found))
                ax.errorbar(means, np.array(at) + 0.2 * (i - (len(labels) - 1) / 2), xerr=errors,
                            fmt="os^"[i], color=f"C{i}", label=label)
            ax.axvline(0, color="black", linewidth=0.8)
            ax.set(title=title, xlabel=xlabel, yticks=range(len(cases)), yticklabels=cases)
            ax.invert_yaxis()


# -------------------------------------------------------------------- Figure 7: equal return

KEEPS = 0.95  # of a return: what is still as good


def cheapest(budgets, level, key):
    """Of {(samples, iterations): {"chosen_by", "return", "ms", ...: [one for each seed]}} the
    budget with the fewest mean milliseconds `key` that reaches a level, as {"samples",
    "iterations", "ms", "return"}; None if none does, or one that does isn't timed."""
    good = {budget: found for budget, found in budgets.items()
            if np.mean(found["chosen_by"]) >= level}
    if not good or not all(found[key] for found in good.values()):
        return None
    best = min(good, key=lambda budget: np.mean(good[budget][key]))
    return {"samples": best[0], "iterations": best[1], "ms": float(np.mean(good[best][key])),
            "return": float(np.mean(good[best]["return"]))}


def compare_budgets(cases, levels):
    """The cheapest budgets of the expert and of the student, alone and with workers, that reach
    {case: level}, and the expert's milliseconds by the student's; None if one is missing."""
    expert, alone, workers = (cheapest(cases[case], levels[case], key) for case, key in (
        ("expert", "ms"), ("student", "ms"), ("student", "ms_workers")))
    if None in (expert, alone, workers):
        return None
    best = min(alone, workers, key=lambda found: found["ms"])
    return {"expert": expert, "student": best, "student_in_process": alone,
            "student_workers": workers, "ratio": expert["ms"] / best["ms"],
            "ratio_in_process": expert["ms"] / alone["ms"]}


def budgets_of(task, cases):
    """Figure 7 of a task: `compare_budgets` at 0.95 of each model's own full return and, under
    `equal_return`, of the lower one; by budget what is kept and the speed-up. None: not timed."""
    full = {case: np.mean(budgets.get((512, 6), {"chosen_by": [np.nan]})["chosen_by"])
            for case, budgets in cases.items()}
    if set(full) != {"expert", "student"}:
        return None
    own, equal = (compare_budgets(cases, levels) for levels in (
        {case: KEEPS * value for case, value in full.items()},
        dict.fromkeys(full, KEEPS * min(full.values()))))
    if not (own and equal):
        return None
    row = {"task": task, **own, "equal_return": equal, "kept": {}, "speedup": {}}
    for budget in [(512, 6), (128, 4)]:
        expert, student = (cases[case].get(budget) for case in ("expert", "student"))
        if expert and student:
            name, ms = "{} x {}".format(*budget), np.mean(expert["ms"])
            row["kept"][name] = fac.return_kept(np.mean(student["all"]), np.mean(expert["all"]))
            row["speedup"][name] = [float(ms / x) for x in (np.mean(student["ms"]), min(
                np.mean(student["ms"]), np.mean(student["ms_workers"])))]
    return row


def budget_cells(row):
    """A line of Figure 7's table."""
    def models(found):
        return [*("{samples} x {iterations}: {return:.0f}, {ms:.1f} ms".format_map(found[key])
                  for key in ("expert", "student_in_process", "student_workers")),
                "{ratio_in_process:.1f} / {ratio:.1f}".format_map(found)]
    return [row["task"], *models(row["equal_return"]), *models(row),
            " / ".join("-" if x is None else f"{x:.2f}" for x in row["kept"].values()),
            " / ".join(f"{x:.2f}" for x in row["speedup"].get("128 x 4", [])) or "-"]


# --------------------------------------------------------- Figure 8: differences, intervals

DRAWS = 4000  # of the bootstrap


def kept_of(values, kind, joints):
    """What is kept of the undisturbed return, a mean over joints, and DRAWS of a bootstrap over
    episodes and joints. values: {(kind, joint): returns (students, episodes)}."""
    rng = np.random.default_rng(0)  # the same draws for all that played the same
    whole, *parts = (np.mean(values[key], 0) for key in (("none", 0), *((kind, j) for j in joints)))
    episodes = rng.integers(len(whole), size=(DRAWS, len(whole)))
    drawn = rng.integers(len(joints), size=(DRAWS, len(joints)))
    means = np.mean(np.array(parts)[drawn[..., None], episodes[:, None]], (1, 2))
    with np.errstate(all="ignore"):  # nothing to keep
        return np.mean(parts) / whole.mean(), means / whole[episodes].mean(1)


def difference_cell(one, other):
    """What one keeps less what another does and where 95% of draws lie (low to high); bold if that
    leaves out 0. Both: `kept_of`'s, of as many episodes."""
    if not np.isfinite([*one[1], *other[1]]).all():
        return "-"
    low, high = np.percentile(one[1] - other[1], (2.5, 97.5))
    mean, low, high = (round(float(x), 2) + 0.0 for x in (one[0] - other[0], low, high))  # no -0.00
    text = f"{mean:+.2f} ({low:+.2f} to {high:+.2f})"
    return f"**{text}**" if low > 0 or high < 0 else text


def draw_bars(path, cells, kinds):
    """Bars of the return with each action dimension disturbed, {task: {case: {(kind, joint):
    returns}}}; lines across: undisturbed, ("none", 0)."""
    panels = [(task, kind) for task in cells for kind in kinds]
    with plots.panels(path, len(panels), len(kinds), 3.7, 2.8, sharey="row") as grid:
        for ax, (task, kind) in zip(grid, panels):
            actions = fac.lookup_task(task)[1]
            for i, (case, values) in enumerate(sorted(cells[task].items())):
                joints = sorted(j for k, j in values if k == kind)
                ax.bar(np.array(joints) + 0.27 * (i - 1),
                       [np.mean(values[kind, j]) for j in joints], 0.25, label=case,
                       color=f"C{i}", hatch=("", "//", "..")[i], edgecolor="black")
                if ("none", 0) in values:
                    ax.axhline(np.mean(values["none", 0]), color=f"C{i}",
                               linestyle=("-", "--", ":")[i])
            what = "one action is noise" if kind == "noise" else f"one motor x {kind}"
            ax.set(title=f"{task}: {what}", xlabel="action dimension", ylabel="episode return",
                   xticks=range(0, actions, 1 + actions // 20))
