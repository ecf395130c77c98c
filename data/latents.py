"""Figure 10, middle and right: agents' latents by joint, task and robot, {task: (N, m, B)} in B
states of each; `multitask.py latents` and `figure10` are the commands."""

import numpy as np

import fac_tdmpc_ref as fac
import look
import plots

WITHIN, BETWEEN = "walker, task by task", "walker and hopper"


def comparisons(tasks):
    """Whose latents are compared, {name: tasks}, as far as these are there."""
    walkers, hoppers = ([task for task in tasks if task.startswith(robot + "-")]
                        for robot in ("walker", "hopper"))
    return {**({WITHIN: walkers[:3]} if len(walkers) > 1 else {}),
            **({BETWEEN: [walkers[0], hoppers[0]]} if walkers and hoppers else {})}


def stacked(latents):
    """Latents {task: (N, m, B)} as points (n, m), their joints (n,) and tasks (n,)."""
    x, joints = map(np.concatenate, zip(*map(look.points_of, latents.values())))
    return x, joints, np.repeat([*latents], [z.shape[0] * z.shape[2] for z in latents.values()])


def silhouettes(latents, rng):
    """Of latents {task: (N, m, B)} by joint, by shuffled joints, by task, and by task among the
    latents of one joint (mean over the joints that all have)."""
    from sklearn.metrics import silhouette_score
    x, joints, tasks = stacked(latents)
    common = range(min(map(len, latents.values())))
    labels = {"joint": joints, "joints shuffled": rng.permutation(joints), "task": tasks}
    return {**{name: float(silhouette_score(x, of)) for name, of in labels.items()},
            "task within a joint": float(np.mean([silhouette_score(
                x[joints == i], tasks[joints == i]) for i in common]))}


def recognition(walker, hopper):
    """Accuracies of a classifier of hip, knee and ankle that learned from one leg's latents
    (N, m, B): in other states, on another leg, and on the agents of the other robot that have its
    own slots, whatever they move there. A guess is right in a third, but three clusters that lie by
    chance may be in none or all: an untrained student's say what is learned."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler
    found, half = {}, walker.shape[2] // 2
    right, left = (walker, [0, 1, 2]), (walker, [3, 4, 5])  # hip, knee, ankle
    leg = (hopper, [1, 2, 3])  # 0 is the waist
    for name, (z, own), (other, theirs) in (
            ("walker's right leg, then hopper", right, leg),
            ("hopper, then walker's right leg", leg, right),
            ("walker's right leg, then its left", right, left)):
        classifier = make_pipeline(StandardScaler(), LogisticRegression(max_iter=1000))
        classifier.fit(*look.points_of(z[own, :, :half]))
        tried = {"itself": z[own, :, half:], "other leg": other[theirs]}
        if other is not z:
            tried["same slots there"] = other[own]
        found[name] = {of: float(classifier.score(*look.points_of(points)))
                       for of, points in tried.items()}
    return found


def draw_latents(path, panels):
    """A panel for each {name: (points (n, 2), joints (n,), tasks (n,))}: colours for joints,
    markers for tasks."""
    figure, axes = plots.pyplot().subplots(1, len(panels), figsize=(5.5 * len(panels), 4.8),
                                         layout="constrained", squeeze=False)
    for ax, (name, (points, joints, tasks)) in zip(axes[0], panels.items()):
        for k, task in enumerate(dict.fromkeys(tasks)):
            for j in np.unique(joints[tasks == task]):
                ax.scatter(*points[(tasks == task) & (joints == j)].T, s=9, alpha=0.7,
                           color=f"C{j}", marker="o^sD"[k % 4], label=f"{task}, joint {j}")
        ax.set(title=f"{name}: latents by t-SNE", xticks=[], yticks=[])
        ax.legend(fontsize=6, ncols=len(set(tasks)), loc="upper center", bbox_to_anchor=(0.5, 0))
    plots.drawn(plots.save_figure, path, figure)


def compare(latents_of, tasks, points, seed, picture=None):
    """Silhouettes in the `comparisons` of some tasks, of walker and hopper by hip, knee and ankle,
    and `recognition`; a picture by t-SNE, if there is a path for it. latents_of(task, states):
    (N, m, B) in so many states, of which silhouettes and picture take `points`."""
    found, panels = {}, {}
    for name, chosen in comparisons(tasks).items():
        latents = {task: latents_of(task, points) for task in chosen}
        if picture:
            x, *labels = stacked(latents)
            panels[name] = (look.t_sne(x), *labels)
        if name == BETWEEN:
            walker, hopper = chosen
            latents = {walker: latents[walker][:3], hopper: latents[hopper][1:]}
            found["recognition"] = recognition(*(latents_of(task, 1000) for task in chosen))
        found[name] = silhouettes(latents, fac.stream(seed, "shuffled joints"))
    if panels:
        draw_latents(picture, panels)
    return found


def print_tables(found):
    """Tables of what `compare` found, of students {name: it}."""
    for title, of in (("silhouette by", lambda x: {k: v for k, v in x.items() if k in (
            WITHIN, BETWEEN)}), ("accuracy", lambda x: x.get("recognition", {}))):
        rows = [(f"{name}, {student}", about) for student, x in found.items()
                for name, about in of(x).items()]
        if rows:
            heads = [*rows[0][1]]
            fac.print_table([(title, *heads), *(
                (name, *(f"{about[head]:.2f}" if head in about else "-" for head in heads))
                for name, about in rows)])
