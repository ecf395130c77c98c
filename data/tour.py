#!/usr/bin/env python3
"""The method in pictures: distil students of the 3-link arm, look into them, write data/tour.md.

Each picture is two functions: one computes its numbers, with the module's own functions, the other
draws them. The text is below; the numbers in it are those of the pictures.
"""
import dataclasses
import functools
import itertools
import sys
import textwrap
import time
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import fac_tdmpc_ref as fac  # noqa: E402
import plots  # noqa: E402
from speed import multiply_adds, processor  # noqa: E402

TASK, STATES = "reacher-hard", 192  # these states are held out: no student learns from them
CONFIG = fac.DistillConfig(steps=1200, lr=3e-3, warmup=50, targets="joint", expert_episodes=0,
                           played_share=0, priors=False)
SIZES = {"mlp_dim": 64, "latent_dim": 24}  # small enough for a minute
SEARCH = fac.PlannerConfig(samples=64, output="mean")  # of picture 5
JOINTS = ("#0072b2", ""), ("#e69f00", "///"), ("#b8e3d5", "...")  # dark to light; hatches
INK, GREY = "#333333", "#bbbbbb"


@dataclasses.dataclass
class Scene:
    """What the pictures are of: four models and B held-out trajectories, K copies of each."""
    expert: fac.WorldModel
    fresh: fac.WorldModel     # the student before its first step
    student: fac.WorldModel   # after its last: Equation 4 compares sums over its joints
    credited: fac.WorldModel  # a second one, each of whose joints was taught its own part
    config: fac.DistillConfig
    obs: np.ndarray           # (O, B)
    actions: np.ndarray       # (L, A, B, K): copy 0 is unperturbed
    shown: int                # the trajectory that is drawn
    seed: int

    def predict(self, model):
        """Each agent's reward and both Q for all copies: three (N, L, B, K)."""
        x = fac.unroll(model, model.encode(self.obs), self.actions)
        return fac.run_heads(model, x, self.actions)

    def latent(self, model, b):
        """The agents' latents in state b: (N, m, 1)."""
        return model.encode(self.obs[:, b:b + 1])


def distilled(expert, replay, config, seed):
    """A student before and after Algorithm 1."""
    distiller = fac.Distiller(expert, replay, config, seed=seed, **SIZES)
    sizes, params = distiller.student.config, distiller.student.params
    fresh = fac.WorldModel(sizes, {name: value.copy() for name, value in params.items()})
    with fac.progress(f"distilling, {config.targets}", config.steps, "step") as bar:
        for _ in distiller.run():
            bar.update()
    distiller.close()
    return fresh, distiller.student


def make_scene(expert, replay, config, seed, states):
    """Distil both students. Drawn is the most typical of the held-out trajectories: the one whose
    divergences, before and after learning, are nearest to their means over all."""
    fresh, student = distilled(expert, replay, config, seed)
    _, credited = distilled(expert, replay, dataclasses.replace(config, targets="credit"), seed)
    _, held_out = replay.starts(config.horizon + 1, config.held_out, seed)
    rng = fac.stream(seed, "tour")
    obs, actions = replay.sequences(rng.choice(held_out, states), config.horizon + 1)
    copies = fac.perturbed_actions(actions[..., None], config, rng)
    copies[..., 0] = actions
    scene = Scene(expert, fresh, student, credited, config, obs, copies, 0, seed)
    D = np.concatenate([divergence(scene, model) for model in (fresh, student)])
    means = D.mean(-1, keepdims=True)
    return dataclasses.replace(scene, shown=int(np.abs(D / means - 1).sum((0, 1)).argmin()))


def divergence(scene, model):
    """D of the reward, and the mean of both Q's, at each h of each trajectory: (2, L, B)."""
    T_s, T_e = scene.config.temperature_student, scene.config.temperature_expert
    D = [fac.soft_kl(shares.sum(0), theirs[0], T_s, T_e)[0]
         for shares, theirs in zip(scene.predict(model), scene.predict(scene.expert))]
    return np.stack([D[0], (D[1] + D[2]) / 2])


def softmax(values, temperature):
    """Equation 4's distribution, over the last axis."""
    return np.exp(fac.log_softmax(values / temperature))


# ---- The numbers.

def numbers_layers(scene):
    """f_T's first layer as one matrix for all joints, and how many weights each network has."""
    def matrix(W):  # (N, out, in) -> (N * out, N * in), zero where an agent has no weight
        whole = np.zeros((len(W), W.shape[1], len(W), W.shape[2]), W.dtype)
        whole[range(len(W)), :, range(len(W))] = W
        return whole.reshape(len(W) * W.shape[1], -1)

    found = {"agents": scene.student.config.num_agents}
    for key in ("expert", "student"):
        params, sizes = getattr(scene, key).params, Counter()
        for name, value in params.items():
            network = name.split(".")[0].removeprefix("_expert")  # [D3]: a student's reads that
            sizes["_Q" if "_Q" in network else network] += value.size
        found[key] = matrix(params["_dynamics.0.weight"])
        found[f"{key} weights"] = [sizes[x] for x in ("_encoder", "_dynamics", "_reward", "_Q")]
    return found


def numbers_copies(scene):
    """The shown trajectory's copies (L, A, K), the expert's Q for them and its softmax, (L, K)."""
    q = scene.predict(scene.expert)[1][0, :, scene.shown]
    return {"actions": scene.actions[:, :, scene.shown], "q": q,
            "p": softmax(q, scene.config.temperature_expert)}


def numbers_softmax(scene):
    """Softmax of Q for the shown trajectory (L, K); D of reward and Q by h, means over all."""
    found = {"expert": numbers_copies(scene)["p"]}
    for key in ("fresh", "student"):
        model = getattr(scene, key)
        found[key] = softmax(scene.predict(model)[1].sum(0)[:, scene.shown],
                             scene.config.temperature_student)
        D = divergence(scene, model)
        found[f"{key} D"], found[f"{key} error"] = D.mean(2), D.std(2, ddof=1) / D.shape[2] ** 0.5
    return found


def less_mean(values):
    """Values without their mean over the copies, which no softmax sees."""
    return values - values.mean(-1, keepdims=True)


def numbers_shares(scene):
    """Last reward and Q of Equation 2 for the shown copies: the joints' shares (N, K), their sum
    and the expert's (K,), each less its mean; correlation of the two over all trajectories."""
    found, H = {}, scene.config.horizon
    student, expert = (scene.predict(model) for model in (scene.student, scene.expert))
    for key, head, h in (("reward", 0, max(0, H - 1)), ("Q", 1, H)):
        shares, theirs = less_mean(student[head][:, h]), less_mean(expert[head][0, h])
        found[key] = {"h": h, "shares": shares[:, scene.shown], "expert": theirs[scene.shown],
                      "sum": shares.sum(0)[scene.shown],
                      "r": np.corrcoef(shares.sum(0).ravel(), theirs.ravel())[0, 1]}
    return found


def search(scene, b, agents, config):
    """MPPI in the student from state b by one agent, which has all joints' actions, or by as many
    as there are joints: after 1, 2, ... iterations what was drawn, its G, the elites, the mean, and
    what that is worth above doing nothing."""
    n, L, z, steps = scene.actions.shape[1], config.horizon + 1, scene.latent(scene.student, b), []

    def returns(actions):  # (agents, L, n / agents, S) -> each agent's G, the sum of its joints'
        own = actions.swapaxes(1, 2).reshape(n, 1, L, -1).swapaxes(1, 2)
        G = fac.h_step_return(scene.student, z, own, config).reshape(agents, n // agents, -1).sum(1)
        last.update(samples=actions, G=G)
        return G

    for iterations in range(1, config.iterations + 1):
        last, rngs = {}, [fac.stream(scene.seed, "tour's MPPI", i) for i in range(agents)]
        nothing = np.zeros((agents, L, n // agents), fac.F32)
        mean, elites, _ = fac.mppi(returns, nothing, dataclasses.replace(
            config, iterations=iterations), rngs)
        steps.append({**last, "elites": elites, "mean": mean})
        steps[-1]["gain"] = float(np.diff(returns(np.stack([nothing, mean], -1)).sum(0))[0])
    return steps


def numbers_mppi(scene, config=SEARCH, states=32):
    """`search` by one agent and by one for each joint, from the shown state, and the mean gain."""
    found = {}
    for agents in (1, scene.actions.shape[1]):
        gains = [[step["gain"] for step in search(scene, b, agents, config)] for b in range(states)]
        found[agents] = {"steps": search(scene, scene.shown, agents, config), "gains": gains}
    return found


def numbers_grid(scene):
    """G of every combination of the joints' sequences of -1 and +1, (P, P, P), in both models;
    the best combination and, in the student, the best of each joint's own G_i (N, P)."""
    L = scene.config.horizon + 1
    own = np.array([*itertools.product((-1, 1), repeat=L)], fac.F32)  # (P, L)
    n, P = scene.student.config.num_agents, len(own)
    combination = np.array([*itertools.product(range(P), repeat=n)]).T  # (N, P ** N)
    config = fac.PlannerConfig(horizon=scene.config.horizon)
    G_i = fac.h_step_return(scene.student, scene.latent(scene.student, scene.shown),
                            np.broadcast_to(own.T[None, :, None], (n, L, 1, P)), config)
    chosen = own[combination].transpose(2, 0, 1)[None]  # (1, L, N, P ** N)
    expert = fac.h_step_return(scene.expert, scene.latent(scene.expert, scene.shown), chosen,
                               config)[0]
    student = fac.h_step_return(scene.student, scene.latent(scene.student, scene.shown),
                                chosen[0].swapaxes(0, 1)[:, :, None], config).sum(0)
    found = {"G_i": G_i, "each": G_i.argmax(1), "sequences": own}
    for key, G in (("student", student), ("expert", expert)):
        best = combination[:, G.argmax()]
        found[key] = {"G": G.reshape((P,) * n), "best": best}
    return found


def numbers_credit(scene):
    """Each joint's part of what the noise does to the expert's Q_H, and the joints' shares of it
    in both students, less copy 0's, (N, K); their correlation with the parts over all (N,)."""
    H, expert = scene.config.horizon, scene.expert
    predicted = fac.predict(expert, expert.encode(scene.obs), scene.actions,
                            tapes := defaultdict(list))
    parts = fac.credit(expert, tapes, scene.actions, predicted, scene.student.config)[1][:, H]
    q = (predicted[1] + predicted[2])[H, scene.shown] / 2
    found = {"parts": parts[:, scene.shown], "Q": q - q[0]}
    for key in ("student", "credited"):
        _, q1, q2 = scene.predict(getattr(scene, key))
        shares = (q1 + q2)[:, H] / 2
        shares = shares - shares[..., :1]
        found[key] = shares[:, scene.shown]
        found[f"{key} r"] = np.array([np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in
                                      zip(shares[..., 1:], parts[..., 1:])])
    return found


class Timed(fac.WorldModel):
    """A world model that notes the seconds of its networks."""
    seconds = Counter()

    def forward(self, name, x, tape=None):
        begin = time.perf_counter()
        y = super().forward(name, x, tape)
        self.seconds[name.removeprefix("_expert")] += time.perf_counter() - begin
        return y


PARTS = {"$f_E$": ["_encoder"], "$f_T$": ["_dynamics"], "$f_R$": ["_reward"],
         "$f_Q$": ["_Q1", "_Q2"], "proposals' policy": ["_pi"]}


def numbers_cost(scene, rounds=15):
    """Median seconds of each part of a decision by Part I's planner, and multiply-adds of its
    networks: the expert, the student, and one of its joints, for which all are encoded."""
    n, same = scene.student.config.num_agents, fac.PlannerConfig()
    small = fac.PlannerConfig(samples=32, iterations=3)
    alone = fac.some_agents(scene.student, 0, 1)
    plans = {"expert": (scene.expert, scene.expert, same),
             "student": (scene.student, scene.student, same),
             "one joint": (scene.student, alone, same),
             "small search": (scene.student, scene.student, small)}
    found = {name: {"multiply-adds": multiply_adds(model.config, config), "seconds": [],
                    "search": f"{config.samples} x {config.iterations}"}
             for name, (_, model, config) in plans.items()}
    for _, (name, (whole, model, config)) in itertools.product(range(rounds), plans.items()):
        agents = slice(0, model.config.num_agents)
        planner = fac.AgentPlanner(Timed(model.config, model.params), config)
        planner.reset(np.random.SeedSequence(scene.seed).spawn(n)[agents])
        Timed.seconds, begin = Counter(), time.perf_counter()
        planner.plan(Timed(whole.config, whole.params).latents(scene.obs[:, :1])[agents])
        seconds = time.perf_counter() - begin
        networks = [sum(Timed.seconds[x] for x in names) for names in PARTS.values()]
        found[name]["seconds"].append([*networks, seconds - sum(networks)])
    for row in found.values():
        row["seconds"] = np.median(row["seconds"], 0)
    return found


# ---- The pictures.

def greys():
    """Few shades: they are told apart, and files stay small."""
    return plots.pyplot().get_cmap("Greys", 8)


def draw_layers(figure, found):
    """Both matrices in grey, and bars of weights, a student's cut into its agents'."""
    left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1.7, 1.8))
    n, (rows, columns) = found["agents"], np.array(found["student"].shape) / found["agents"]
    for ax, key in ((left, "expert"), (middle, "student")):
        W = np.abs(found[key])
        ax.imshow(W[::max(1, len(W) // 90)], cmap=greys(), vmax=np.quantile(W[W > 0], 0.97),
                  aspect="auto", extent=(0, W.shape[1], len(W), 0), interpolation="nearest")
        ax.grid(False)
        ax.set(title=f"{key}, N = {1 if key == 'expert' else n}: |W|", xlabel="inputs of $f_T$")
    left.set(ylabel="outputs of its first layer", xticks=[found["expert"].shape[1] / 2],
             xticklabels=["$s, a$"])
    for i, (color, _) in enumerate(JOINTS[:n]):
        middle.text((i + 0.5) * columns, (i + 0.5) * rows, f"joint {i}", ha="center", va="center",
                    bbox={"facecolor": "white", "edgecolor": color})
    middle.set(xticks=[(i + 0.5) * columns for i in range(n)], yticks=[],
               xticklabels=[f"$s^{i}, a^{i}$" for i in range(n)])
    places = np.arange(len(found["student weights"]))
    right.barh(places - 0.2, np.divide(found["expert weights"], 1e3), 0.36, color=GREY,
               edgecolor=INK, label="expert")
    each = np.array(found["student weights"])[1:] / n / 1e3
    right.barh(0.2, found["student weights"][0] / 1e3, 0.36, color="white", edgecolor=INK,
               label="student, shared")
    for i, (color, hatch) in enumerate(JOINTS[:n]):
        right.barh(places[1:] + 0.2, each, 0.36, left=i * each, color=color, hatch=hatch,
                   edgecolor=INK, label=f"student, joint {i}")
    right.set(yticks=places, yticklabels=["$f_E$", "$f_T$", "$f_R$", "both $f_Q$"],
              xlabel="thousands", title="weights of each network", xlim=(0, 720))
    right.invert_yaxis()
    right.legend(fontsize=8, loc="upper right")


def draw_copies(figure, found):
    """Each joint's perturbed actions, the expert's Q and its softmax, by h."""
    n, K, grid = *found["actions"].shape[1:], figure.add_gridspec(2, 6)
    axes = [figure.add_subplot(grid[0, 2 * i:2 * i + 2]) for i in range(n)]
    for i, ax in enumerate(axes):
        draw_lines(ax, found["actions"][:, i])
        ax.set(title=f"joint {i}", xlabel="h", ylabel="" if i else "$a_h + \\epsilon_h$",
               ylim=(-1.1, 1.1))
    left, right = figure.add_subplot(grid[1, :3]), figure.add_subplot(grid[1, 3:])
    draw_lines(left, less_mean(found["q"]))
    left.set(title="the expert's $Q_h$ less its mean over copies", xlabel="h")
    draw_bars(right, {f"copy {k}": found["p"][:, k] for k in range(K)},
              [(INK, ""), *(("white", hatch) for hatch in ("///", "...", "xx", "---"))])
    for k, bars in enumerate(right.containers):
        right.bar_label(bars, [k] * len(found["p"]), fontsize=7)
    right.set(title="its softmax over the copies, 0 to 4", xlabel="h")


def draw_lines(ax, values):
    """A line over h for each copy (L, K), the unperturbed one thick."""
    for k, line in enumerate(values.T):
        ax.plot(line, marker="os^Dv"[k % 5], linestyle=("-", "-", "--", "-.", ":")[k % 5],
                color="#666666" if k else "black", linewidth=1 if k else 2.5, markersize=5,
                label=f"copy {k}" + " (as done)" * (not k))
    ax.set_xticks(range(len(values)))


def draw_bars(ax, series, styles, errors=None):
    """Bars side by side: series {label: values}, styles (colour, hatch)."""
    width = 0.8 / len(series)
    for j, ((label, values), (color, hatch)) in enumerate(zip(series.items(), styles)):
        places = np.arange(len(values)) + (j - (len(series) - 1) / 2) * width
        ax.bar(places, values, width, color=color, hatch=hatch, edgecolor=INK, label=label,
               yerr=None if errors is None else errors[j])
    ax.set_xticks(range(len(values)))
    ax.grid(False, axis="x")


def draw_softmax(figure, found):
    """The softmax of expert and student at each h; below, the divergence by h."""
    L, grid = len(found["expert"]), figure.add_gridspec(2, 2 * len(found["expert"]))
    models = {"student before": "fresh", "student after": "student", "expert": "expert"}
    styles = [("white", ""), ("#56b4e9", "///"), (INK, "")]
    for h in range(L):
        ax = figure.add_subplot(grid[0, 2 * h:2 * h + 2])
        draw_bars(ax, {label: found[key][h] for label, key in models.items()}, styles)
        ax.set(title=f"$Q_{h}$", xlabel="copy", ylabel="" if h else "softmax",
               ylim=(0, 1.05 * max(found[key].max() for key in models.values())))
    for i, name in enumerate("RQ"):
        ax = figure.add_subplot(grid[1, L * i:L * i + L])
        draw_bars(ax, {label: found[f"{models[label]} D"][i] for label in [*models][:2]}, styles,
                  [found[f"{models[label]} error"][i] for label in [*models][:2]])
        ax.set(title=f"divergence of ${name}_h$, mean of {STATES}", xlabel="h")


def draw_shares(figure, found):
    """Shares as bars, their sum and the expert's as markers, a reward and a Q."""
    for ax, (name, row) in zip(figure.subplots(1, 2), found.items()):
        draw_bars(ax, {f"share of joint {i}": share for i, share in enumerate(row["shares"])},
                  JOINTS)
        draw_sums(ax, {"their sum": row["sum"], "expert": row["expert"]})
        ax.set(title=f"${name[0].upper()}_{row['h']}$ less its mean over copies", xlabel="copy")


def draw_sums(ax, series):
    """Markers over the bars: the first filled and small, the second open."""
    styles = ("o", 6, "black", 4), ("D", 9, "white", 3)
    for (label, values), (marker, size, face, order) in zip(series.items(), styles):
        ax.plot(np.arange(len(values)), values, marker, markersize=size, markerfacecolor=face,
                markeredgecolor="black", label=label, linestyle="none", zorder=order)
    ax.axhline(0, color=INK, linewidth=0.8)


def draw_mppi(figure, found):
    """Samples, elites and mean of joint 0's first action, by iteration; G on the right."""
    (*axes, right), rng = figure.subplots(1, 3), np.random.default_rng(0)
    for ax, (agents, row), style in zip(axes, found.items(), ("-o", "--s")):
        times = range(1, len(row["steps"]) + 1)
        for key, marker, color in (("samples", ".", GREY), ("elites", "^", INK)):
            first = np.stack([step[key][0, 0, 0] for step in row["steps"]])  # actions of joint 0
            ax.scatter(np.array(times)[:, None] + rng.uniform(-0.25, 0.25, first.shape), first, 20,
                       color=color, marker=marker, label=key)
        ax.plot(times, [step["mean"][0, 0, 0] for step in row["steps"]], "-D", color=JOINTS[0][0],
                markeredgecolor="black", label="mean")
        ax.set(title=f"N = {agents}", xlabel="iteration", ylim=(-1.1, 1.1))
        right.plot(times, np.mean(row["gains"], 0), style, label=f"N = {agents}",
                   color=JOINTS[0][0] if agents > 1 else INK)
    axes[0].set_ylabel("first action of joint 0")
    right.set(title="gain in G, mean", xlabel="iteration", xticks=times)
    right.legend()


def draw_grid(figure, found):
    """G over the sequences of joints 0 and 1; in each row a dot on its best column."""
    axes = figure.subplots(1, 3, width_ratios=(1, 1, 0.9))
    for ax, key in zip(axes, ("student", "expert")):
        best = found[key]["best"]
        G = found[key]["G"][(..., *best[2:])].T  # joint 1 down, joint 0 across
        ax.imshow(G, cmap=greys().reversed(), origin="lower")
        ax.plot(G.argmax(1), np.arange(len(G)), "o", color="#e69f00", markeredgecolor="black",
                label="best of its row")
        ax.plot(best[0], best[1], "*", color="white", markeredgecolor="black", markersize=19,
                label="best of all")
        ax.grid(False)
        ax.set(title=f"G of the {key}", xlabel="sequence of joint 0", ylabel="sequence of joint 1")
    for i, (own, (color, _)) in enumerate(zip(found["G_i"], JOINTS)):
        own = own - own.min()
        axes[2].plot(own, marker="os^"[i], color=INK, markerfacecolor=color, markersize=6,
                     linestyle=("-", "--", ":")[i], label=f"joint {i}")
        axes[2].plot(found["each"][i], own.max(), "*", color="white", markeredgecolor="black",
                     markersize=15)
    axes[2].set(title="$G_i$ less its least", xlabel="its own sequence")
    axes[2].legend(fontsize=8)


def draw_credit(figure, found):
    """The joints' parts, the shares of both students, and how alike these are."""
    *axes, right = figure.subplots(1, 4)
    titles = {"parts": "expert's parts", "student": "student of Eq. 4",
              "credited": "student of credit"}
    for ax, (key, title) in zip(axes, titles.items()):
        draw_bars(ax, {f"joint {i}": part for i, part in enumerate(found[key])}, JOINTS)
        draw_sums(ax, {"their sum": found[key].sum(0), "expert's $Q_H^k - Q_H^0$": found["Q"]})
        ax.set(title=title, xlabel="copy k")
        ax.sharey(axes[0])
    draw_bars(right, {"of Eq. 4": found["student r"], "of credit": found["credited r"]},
              [("white", ""), ("#56b4e9", "///")])
    right.set(title="correlation", xlabel="joint", ylim=(None, 1.25))
    right.legend(fontsize=8)


def draw_cost(figure, found):
    """A decision's time by part, in units of the expert's."""
    ax, unit, left = figure.subplots(), found["expert"]["seconds"].sum(), np.zeros(len(found))
    styles = (INK, ""), ("#777777", ""), ("white", "///"), (GREY, "..."), (INK, "xx"), ("white", "")
    for j, (name, (color, hatch)) in enumerate(zip([*PARTS, "sampling, elites, rest"], styles)):
        values = np.array([row["seconds"][j] for row in found.values()]) / unit
        ax.barh(range(len(found)), values, 0.6, left=left, color=color, hatch=hatch,
                edgecolor="black", label=name)
        left += values
    for place, end in enumerate(left):
        ax.text(end + 0.01, place, f"{end:.2f}", va="center")
    ax.set(yticks=range(len(found)), xlim=(0, 1.1), yticklabels=[
        f"{name}\n{row['search']}" for name, row in found.items()],
           xlabel=f"time of a decision, the expert's = 1; {processor()}, one thread")
    ax.invert_yaxis()
    ax.grid(False, axis="y")


PICTURES = {  # name: numbers, drawing, height in inches
    "layers": (numbers_layers, draw_layers, 3.6), "copies": (numbers_copies, draw_copies, 5),
    "softmax": (numbers_softmax, draw_softmax, 5), "shares": (numbers_shares, draw_shares, 3.4),
    "mppi": (numbers_mppi, draw_mppi, 3.4), "grid": (numbers_grid, draw_grid, 3.8),
    "credit": (numbers_credit, draw_credit, 3.4), "cost": (numbers_cost, draw_cost, 3)}


def draw(path, name, found):
    """One of PICTURES as a file of 128 colours."""
    _, picture, height = PICTURES[name]
    figure = plots.pyplot().figure(figsize=(8.2, height), layout="constrained")
    picture(figure, found)
    handles = figure.axes[0].get_legend_handles_labels()
    if handles[0]:
        figure.legend(*handles, loc="outside lower center", ncols=6)
    plots.save_figure(path, figure)
    from PIL import Image  # matplotlib's
    with Image.open(path) as image:
        small = image.convert("RGB").quantize(128)
    with fac.atomic_file(path) as file:
        small.save(file, format="png", optimize=True)


# ---- The text.

TEXT = """\
# The method in pictures

`python data/tour.py` made this page: it distils two small students of a 3-link arm (reacher-hard),
{steps} steps each, and shows how learning begins; the [README](../README.md) says how it ends. Read
it beside Part I of `fac_tdmpc_ref.py`. H = {H}, gamma = 0.99, lambda = 0.5, T = 0.5; joints and
copies count from 0; ± and error bars are standard errors.

## 1. Layers and the agent axis

![f_T's first layer: a full matrix, three blocks. Bars: numbers of
weights.](figures/tour-1-layers.png)

A layer's weights are one array (N, out, in); `linear` multiplies each agent's matrix with that
agent's input. The expert, N = 1, reads the whole latent s and all actions for every output. The
student, N = 3, has three blocks and nothing between them: the next s^i depends on s^i and a^i
alone. f_R^i and both f_Q^i are built alike, all narrower than the expert's. Only the encoder f_E
(`WorldModel.encode`) is shared, the expert's included; its output is cut into s^0, s^1, s^2.

## 2. One trajectory and its copies

![Three joints' actions in noisy copies; the expert's Q and its softmax.](figures/tour-2-copies.png)

Take a recorded observation and the {L} actions that followed. `perturbed_actions` makes {K} copies
with noise; here copy 0 stays as it was. `unroll` rolls the expert's latent out; `predict` gives
reward R_h^k and value Q_h^k of copy k at step h. A softmax makes them a distribution:

    p_h^k = exp(Q_h^k / T) / sum_j exp(Q_h^j / T)

It ignores what copies have in common (all Q_{H} are near {level}) and keeps order and gaps, all a
planner needs: copy {k_best}, the best, gets {p_best}, copy {k_worst}, the worst, {p_worst}. (Of
{states} held-out trajectories, the one nearest to the mean divergences is drawn.)

## 3. The student learns

![Softmax of Q, before and after learning. Below: the divergence.](figures/tour-3-softmax.png)

The student predicts the same copies; `soft_kl` compares its softmax p with the expert's p*. This is
Equation 4:

    D_h = sum_k p*_h^k log(p*_h^k / p_h^k)

D is 0 only where both agree. A fresh student's last layers are zero: all copies seem alike.
`distill_loss` adds up D of R_h and Q_h, weighted by lambda^h; `distill` follows its gradient. On
held-out trajectories D of Q_0 falls from {D0_before} to {D0_after}, of Q_{H} from {DH_before} to
{DH_after}. Rewards are hardly learned yet: most copies earn alike.

## 4. Sums of shares

![Bars: shares of a reward and a Q. Dots: sums. Diamonds: the expert's.](figures/tour-4-shares.png)

`run_heads` returns each joint's share; `predict` adds them up. Equation 4 sees differences between
copies alone, so the picture leaves the mean out. The sums are too small yet, some of the wrong
sign; over all trajectories they correlate with the expert's by {r_Q} for Q_{H}, {r_R} for R_{h_R}.

## 5. Each joint searches alone

![Samples, elites and mean of joint 0's first action, N = 1 and 3. Right: G
gained.](figures/tour-5-mppi.png)

`h_step_return` is Equation 2: G = R_0 + gamma R_1 + gamma^2 R_2 + gamma^3 Q_3. `mppi` makes it
large: an iteration draws {samples} sequences around a mean, keeps the best {elites} (elites), and
moves mean and width to theirs. Here N says who ranks, in the same student. One agent ranks
sequences of all joints by G: a poor action of joint 0 survives where its neighbours were lucky.
Three rank their own by G_i, and narrow faster. Over 32 states their plans gain {gain_all} of the
student's G above zero actions, one agent's {gap} less.

## 6. Proposition 1

![Maps of G over sequences of joints 0 and 1, each row's best marked. Right: each
G_i.](figures/tour-6-grid.png)

Let each joint choose among {P} sequences of -1 and +1 (binary numbers); try all {combinations}
combinations. (Light: large G; joint 2 at its best.) The student's best is ({best}): the best of
each joint's own G_i, found in {each} evaluations. For G is the sum of the G_i, and G_0 depends on
joint 0's actions alone; the others add a constant. So the dots form a line. That is Equation 3:
argmax G is (argmax G_0, argmax G_1, argmax G_2). The expert's dots visit {columns} columns: joint
0's best depends on joint 1. By the expert's G the student's best is number {rank}: Proposition 1
speaks of the student's own.

## 7. Credit: what each joint did

![Bars: each joint's part of a change in Q. Right: correlations.](figures/tour-7-credit.png)

Equation 4 says what shares add up to, not whose they are. `credit`, which this project adds, asks
the expert's gradients. From copy 0 to copy k, Q_{H} (here the mean of both Q networks) changes by
about gradient times change of action: a sum over joints, whose terms are their parts. `credit`
averages the gradients at both ends and gives each joint an equal part of the remainder. A second
student learned these: a softmax over copies for each joint's own part. Its shares correlate with
them by {r_credit}, the first student's by {r_joint}.

## 8. What a decision costs

![Bars: time of a decision, by network.](figures/tour-8-cost.png)

`AgentPlanner.plan` runs f_T, f_R and f_Q for every sample (128 x 4: sequences, iterations). In the
same search the student's take {part_student}% of the expert's multiply-adds, one joint's
{part_joint}%, but more of the time: small matrices are less efficient. With a processor each, a
search takes one joint's time.
"""


def facts(found, config):
    """What TEXT has braces for."""
    _, copies, softmax, shares, mppi, grid, credit, cost = found.values()
    p, before, after = copies["p"][-1], softmax["fresh D"][1], softmax["student D"][1]
    G, best = grid["expert"]["G"], grid["student"]["best"]
    rows = G[(..., *grid["expert"]["best"][2:])].T  # as drawn
    part = {name: f"{100 * row['multiply-adds'] / cost['expert']['multiply-adds']:.1f}"
            for name, row in cost.items()}
    one, each = (np.array(row["gains"])[:, -1] for row in mppi.values())
    return {
        "steps": f"{config.steps:,}", "states": STATES, "L": len(copies["p"]), "K": len(p),
        "H": config.horizon,
        "level": f"{copies['q'][-1].mean():.0f}", "k_best": p.argmax(), "k_worst": p.argmin(),
        "p_best": f"{p.max():.2f}", "p_worst": f"{p.min():.2f}",
        "D0_before": f"{before[0]:.2f}", "D0_after": f"{after[0]:.2f}",
        "DH_before": f"{before[-1]:.2f}", "DH_after": f"{after[-1]:.2f}",
        "r_Q": f"{shares['Q']['r']:.2f}", "r_R": f"{shares['reward']['r']:.2f}",
        "h_R": shares["reward"]["h"], "samples": SEARCH.samples, "elites": SEARCH.num_elites,
        "gain_all": f"{each.mean():.2f}",
        "gap": f"{(each - one).mean():.2f} ± {(each - one).std(ddof=1) / len(one) ** 0.5:.2f}",
        "P": len(G), "combinations": f"{G.size:,}", "each": grid["G_i"].size,
        "best": ", ".join(map(str, best)), "columns": len(set(rows.argmax(1))),
        "rank": f"{1 + (G > G[tuple(best)]).sum():,}",
        "r_joint": ", ".join(f"{r:.2f}" for r in credit["student r"]),
        "r_credit": ", ".join(f"{r:.2f}" for r in credit["credited r"]),
        "part_student": part["student"], "part_joint": part["one joint"]}


def filled(known):
    """TEXT with its numbers, its paragraphs wrapped anew; formulas are indented."""
    return "\n\n".join(part if part.startswith("    ") else
                       textwrap.fill(part, 100, break_on_hyphens=False)
                       for part in TEXT.format(**known).rstrip().split("\n\n")) + "\n"


def command_tour(args):
    """Distil, compute, draw, write."""
    begin, out = time.monotonic(), Path(args.out)
    fac.check_writable(out / "tour.md")
    plots.pyplot()
    expert, _ = fac.load_model(fac.data_file(TASK, "expert.npz"), ["expert"])
    replay = fac.Replay(fac.data_file(TASK, "replay.npz"))
    config = dataclasses.replace(CONFIG, steps=args.steps)
    with fac.one_thread():
        scene = make_scene(expert, replay, config, args.seed, STATES)
        found = {name: numbers(scene) for name, (numbers, *_) in PICTURES.items()}
    paths = {name: out / "figures" / f"tour-{i}-{name}.png" for i, name in enumerate(PICTURES, 1)}
    for name, path in paths.items():
        draw(path, name, found[name])
    known = facts(found, config)
    with fac.atomic_file(out / "tour.md", "w", encoding="utf-8") as file:
        file.write(filled(known))
    seconds = time.monotonic() - begin
    print(f"{out / 'tour.md'}: {len(paths)} pictures in {out / 'figures'}, {seconds:.0f} s")
    return {"out": str(out / "tour.md"), "bytes": {name: path.stat().st_size for name, path in
                                                   paths.items()},
            "seconds": seconds, "facts": {name: str(value) for name, value in known.items()}}


def make_parser():
    """The command line."""
    parser = fac.Parser(prog="tour.py", description="Distil two students of the 3-link arm, and "
                        "write a walk through the method with eight pictures of them.")
    parser.set_defaults(run=command_tour)
    add = parser.add_argument
    add("--out", default=str(fac.DATA), help="folder of tour.md and figures/ [data]")
    add("--seed", type=fac.natural, default=0, help="of students and pictures [0]")
    add("--steps", type=functools.partial(fac.natural, least=1), default=CONFIG.steps,
        help="gradient steps of each student [%(default)s]")
    add("--json", action="store_true", help="print JSON as the last line of stdout")
    return parser


if __name__ == "__main__":
    sys.exit(fac.run_command(make_parser()))
