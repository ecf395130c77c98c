"""Section 5.6: look into a model: `experiments.py watch`, `figure9` and `agreement` are here."""
import copy
import functools
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import fac_tdmpc_ref as fac
import plots
from tables import record

PIXELS, BARS, TEXT = 240, 70, 34  # a picture's side, width of the bars beside, height of the text
RENDERERS = "from dm_control import suite; suite.load('reacher', 'easy').physics.render(8, 8)"


def choose_renderer():
    """Set MUJOCO_GL to what draws off-screen here; UserError if nothing does."""
    for backend in filter(None, (os.environ.get("MUJOCO_GL"), "egl", "osmesa")):
        environment = {**os.environ, "MUJOCO_GL": backend}
        if not subprocess.run([sys.executable, "-c", RENDERERS], env=environment,
                              capture_output=True).returncode:
            os.environ["MUJOCO_GL"] = backend
            return
    raise fac.UserError("MuJoCo can't draw off-screen here: install EGL (Debian: libegl1) or "
                        "OSMesa (libosmesa6)")


def narrowing(model, latents, config):
    """How each joint's plan, made anew, narrows: between which first actions the middle four fifths
    of an iteration's samples are, (I, A, 2), and the plan's, (A,), in the robot's order."""
    sizes, drawn = model.config, []

    def returns(actions):
        drawn.append(np.quantile(actions[:, 0], (0.1, 0.9), axis=2))
        return fac.h_step_return(model, latents[:, :sizes.latent_dim], actions, config)

    n, L, d = sizes.num_agents, config.horizon + 1, sizes.agent_actions
    first = (model.prior(latents, L)[..., 0] if config.prior == "own" else
             np.zeros((n, L, d), fac.F32))
    rngs = [np.random.default_rng(0) for _ in range(n)]
    plan = fac.mppi(returns, first, config, rngs)[0] if config.iterations else first
    order = np.argsort(np.arange(n * d)[fac.agent_order(sizes)])
    return np.reshape(drawn, (-1, 2, n * d)).swapaxes(1, 2)[:, order], plan[:, 0].ravel()[order]


def watch_episode(path, model, header, task, seed, decisions, every):
    """Frames of a model's episode: picture, `narrowing` and return so far of each; its name, the
    median milliseconds of a decision, and the return in the end."""
    config = fac.PlannerConfig(**fac.made_for(header, path))
    environment = fac.Environment(task, config.action_repeat)
    environment.episode_steps = decisions  # it ends there
    obs, actions, rewards, seconds = (x[0] for x in fac.play(
        model, task, config, [seed], label=f"playing {path}", environment=environment))
    pictures = frames_at(task, seed, actions, range(0, decisions, every), config.action_repeat)
    frames = [(picture, narrowing(model, model.latents(obs[t][:, None]), config),
               rewards[:t].sum()) for t, picture in pictures.items()]
    name = f"{header['kind']}, N = {model.config.num_agents}"
    return frames, name, 1e3 * float(np.median(seconds)), float(rewards.sum())


def draw_plan(draw, left, ranges, plan):
    """A row for each joint, from -1 below to 1 above: grey what an iteration drew, one beside the
    other, then blue the plan."""
    height, width = PIXELS / len(plan), BARS / (len(ranges) + 1)
    for j, planned in enumerate(plan):
        middle, bars = (j + 0.5) * height, [*ranges[:, j], (planned, planned)]
        draw.line((left, middle, left + BARS, middle), fill="#999999")
        for i, (low, high) in enumerate(bars):
            top, bottom = (middle - 0.4 * height * action for action in (high, low))
            is_plan = i == len(ranges)
            draw.rectangle((left + i * width + 1, top - 2 * is_plan, left + (i + 1) * width - 1,
                            bottom + 2 * is_plan), fill="#1f77b4" if is_plan else "#999999")
        draw.line((left, (j + 1) * height, left + BARS, (j + 1) * height), fill="black")


def draw_frames(episodes):
    """PIL images of episodes side by side, each with its joints' plans."""
    from PIL import Image, ImageDraw
    width, images = PIXELS + BARS, []
    for columns in zip(*(frames for frames, *_ in episodes)):
        image = Image.new("RGB", (width * len(episodes), PIXELS + TEXT), "white")
        draw = ImageDraw.Draw(image)
        for k, (picture, plan, total) in enumerate(columns):
            left, (_, name, ms, _) = k * width, episodes[k]
            image.paste(Image.fromarray(picture), (left, 0))
            draw_plan(draw, left + PIXELS, *plan)
            draw.text((left + 4, PIXELS + 4), f"{name}: {ms:.1f} ms a decision", fill="black")
            draw.text((left + 4, PIXELS + 18), f"return so far {total:.0f}", fill="black")
        images.append(image)
    return images


def command_watch(args):
    """watch: an episode as a moving picture."""
    kind = Path(args.out).suffix
    fac.need(kind in (".gif", ".mp4") and not Path(args.out).is_dir(),
             f"{args.out}: expected the name of a .gif or .mp4 file")
    fac.check_writable(args.out)
    plots.pyplot()  # brings Pillow
    if kind == ".mp4":
        with fac.optional("imageio for .mp4", "experiments"):
            import imageio_ffmpeg  # noqa: F401
    choose_renderer()  # before a task's sizes are looked up in dm_control
    model, header, task = open_model(args)
    models = [(args.model, model, header)]
    if args.beside:
        models.append((args.beside, *fac.load_model(args.beside)))
        fac.check_task(models[1][1].config, task, args.beside)
    configs = [fac.PlannerConfig(**fac.made_for(header, path)) for path, _, header in models]
    repeats = {config.action_repeat for config in configs}
    fac.need(len(repeats) == 1, f"{args.beside}: decides every {configs[-1].action_repeat} control "
             f"steps, {args.model} every {configs[0].action_repeat}: they can't be shown in step")
    steps = fac.episode_steps(configs[0].action_repeat)
    fac.need(args.decisions <= steps, f"--decisions: an episode has {steps}, not {args.decisions}")
    *_, seed = fac.episode_seeds(args.seed, args.episode + 1)
    episodes = [watch_episode(*found, task, seed, args.decisions, args.every)
                for found in models]
    images = draw_frames(episodes)
    step = repeats.pop() * fac.Environment(task).env.control_timestep()
    seconds = max(0.02, step * args.every)
    with fac.atomic_file(args.out) as file:
        if kind == ".mp4":
            import imageio
            imageio.mimwrite(file, [np.asarray(image) for image in images], format="mp4",
                             fps=1 / seconds, macro_block_size=2)
        else:
            few = images[0].quantize(24)  # one palette for all, or files are twice as large
            images = [image.quantize(palette=few, dither=0) for image in images]
            images[0].save(file, format="gif", save_all=True, append_images=images[1:], loop=0,
                           duration=int(1e3 * seconds))
    result = {"out": args.out, "frames": len(images), "bytes": Path(args.out).stat().st_size,
              "ms": [ms for _, _, ms, _ in episodes], "returns": [total for *_, total in episodes]}
    print(f"{args.out}: {result['frames']} frames, {result['bytes'] / 1e6:.1f} MB")
    return result


# ------------------------------------------------------------------- Figure 9 and agreement

def need_plots(path):
    """`plots.pyplot_for`; UserError, before the work, if scikit-learn is missing, too."""
    plt = plots.pyplot_for(path)
    with fac.optional("scikit-learn", "experiments"):
        import sklearn  # noqa: F401
    return plt


SMOOTH = 10  # decisions over which a change of the return counts


def t_sne(x):
    """Points (n, m) in two dimensions."""
    from sklearn.manifold import TSNE
    return TSNE(random_state=0, init="pca", perplexity=min(30, len(x) / 4)).fit_transform(x)


def points_of(z):
    """Latents (N, m, B) as points (n, m), and their joints (n,)."""
    return z.swapaxes(1, 2).reshape(-1, z.shape[1]), np.repeat(np.arange(len(z)), z.shape[2])


def untrained(student, seed):
    """A student whose encoder is as its distillation began: agents have a part each of any
    encoder's output, which may cluster before it learned anything."""
    fresh = fac.WorldModel.create(student.config, fac.stream(seed, "student")).params
    found = copy.copy(student)
    found.params = {**student.params, **{
        key: value for key, value in fresh.items() if key.startswith("_encoder.")}}
    return found


def clusters(z, before, rng):
    """Latents (N, m, B) as points: t-SNE and PCA, (n, 2) each, their joints (n,), and silhouettes
    by joint, by shuffled joints, and by joint of an untrained student's latents, `before`."""
    from sklearn.decomposition import PCA
    from sklearn.metrics import silhouette_score
    (x, joints), (fresh, _) = points_of(z), points_of(before)
    flat = t_sne(x), PCA(2).fit_transform(x)
    one = len(z) == 1  # no other joints to be apart from
    return *flat, joints, *(None if one else float(silhouette_score(points, labels)) for
                            points, labels in ((x, joints), (x, rng.permutation(joints)),
                                               (fresh, joints)))


def credit(model, obs, actions, config):
    """Each agent's return over the next H decisions of an episode, as it was played: (N, T - H).

    obs (T, O), actions (T, A): Equation 2 for the actions that were executed."""
    n, d = model.config.num_agents, model.config.agent_actions
    actions = actions[:, fac.agent_order(model.config)]
    z, H = model.encode(np.ascontiguousarray(obs.T)), config.horizon
    shares = [fac.h_step_return(model, z[:, :, t:t + 1],
                                actions[t:t + H + 1].reshape(H + 1, n, d).swapaxes(0, 1)[..., None],
                                config)[:, 0] for t in range(len(obs) - H)]
    return np.stack(shares, 1)


def turning_points(returns, count=2):
    """Decisions around which a return (T,) changes most, apart from each other, in order."""
    change = np.abs(returns[SMOOTH:] - returns[:-SMOOTH])
    found = []
    for _ in range(count):
        t = int(np.argmax(change))
        found.append(t + SMOOTH // 2)
        change[max(0, t - 3 * SMOOTH):t + 3 * SMOOTH] = -1
    return sorted(found)


def frames_at(task, seed, actions, moments, action_repeat):
    """Pictures of an episode, played again, before these decisions, after `choose_renderer`."""
    environment, found = fac.Environment(task, action_repeat), {}
    environment.reset(seed)
    for t in range(max(moments) + 1):
        if t in moments:
            found[t] = environment.env.physics.render(PIXELS, PIXELS, camera_id=0)
        environment.step(actions[t])
    return found


def command_figure9(args):
    """figure9: latents by joint, and what each joint contributes in the best and worst episode."""
    undrawn = None
    try:
        choose_renderer()  # before a task's sizes are looked up in dm_control
    except fac.UserError as error:
        undrawn = error  # said below: what can't be used has one line
    model, header, task = open_model(args, kinds=["student"])
    plt, began = need_plots(args.out), time.monotonic()
    config = fac.PlannerConfig(**fac.made_for(header, args.model))
    most = fac.episode_steps(config.action_repeat) - SMOOTH
    fac.need(model.config.latent_dim > 1 and config.horizon < most,
             f"{args.model}: expected latents of 2 or more and a horizon below {most}, found "
             f"{model.config.latent_dim}, {config.horizon}")
    seeds = fac.episode_seeds(args.seed, args.episodes)
    obs, actions, rewards, _ = fac.play(model, task, config, seeds)
    returns, rng = rewards.sum(1), np.random.default_rng(0)
    states = obs.reshape(-1, obs.shape[2])
    chosen = rng.choice(len(states), min(args.points, len(states)), replace=False)
    z, before = (of.encode(np.ascontiguousarray(states[chosen].T)) for of in (
        model, untrained(model, fac.count(header.get("seed", 0), f"{args.model}: header: seed"))))
    tsne, pca, joints, apart, shuffled, first = clusters(z, before, rng)
    figure, grid = plt.subplots(3, 3, figsize=(11, 9), layout="constrained")
    for ax, points, name in ((grid[0, 0], tsne, "t-SNE"), (grid[0, 1], pca, "PCA")):
        for i in range(len(z)):
            ax.scatter(*points[joints == i].T, s=7, marker="os^Dv<>p"[i % 8], label=f"agent {i}")
        ax.set(title=f"latents, {name}", xticks=[], yticks=[])
    grid[0, 2].axis("off")
    title = "black: the sum" if apart is None else (
        f"black: the sum\nsilhouette by agent {apart:.2f}\nagents shuffled {shuffled:.2f}\n"
        f"untrained {first:.2f}")
    grid[0, 2].legend(*grid[0, 1].get_legend_handles_labels(), loc="upper left",
                      ncols=1 + len(z) // 8, title=title)
    moments = {}
    if undrawn:
        print(undrawn, file=sys.stderr)
    for row, name, episode in zip(grid[1:], ("best", "worst"),
                                  (int(returns.argmax()), int(returns.argmin()))):
        shares = credit(model, obs[episode], actions[episode], config)
        moments[name] = turning_points(shares.sum(0))
        pictures = frames_at(task, seeds[episode], actions[episode], moments[name],
                             config.action_repeat) if not undrawn else {}
        for share in shares:
            row[0].plot(share - share.mean(), linewidth=1)
        row[0].plot(shares.sum(0) - shares.sum(0).mean(), "k-")
        row[0].set(title=f"{name} episode: {returns[episode]:.0f}", xlabel="decision",
                   ylabel=f"{config.horizon}-step return less its mean")
        for ax, t in zip(row[1:], moments[name]):
            row[0].axvline(t, color="black", linestyle="--", linewidth=0.8)
            ax.axis("off")
            if t in pictures:
                ax.imshow(pictures[t])
                ax.set_title(f"decision {t}")
    plots.drawn(plots.save_figure, args.out, figure)
    result = {"out": args.out, "task": task, "episodes": args.episodes, "silhouette": apart,
              "silhouette_shuffled": shuffled, "silhouette_untrained": first,
              "return_best": float(returns.max()), "return_worst": float(returns.min()),
              "moments": moments, "seconds": round(time.monotonic() - began, 1)}
    if apart is not None:
        print(f"silhouette by agent {apart:.2f}, shuffled {shuffled:.2f}, untrained {first:.2f}")
        keep(args.record, task, header, {"silhouette": apart, "shuffled": shuffled,
                                         "untrained": first})
    print(args.out)
    return result


NOISE = fac.DistillConfig.noise_std  # around what is done, for the additive ceiling


def additive_ceiling(expert, obs, actions, noise, discount, rng, copies=1024):
    """How well a sum over action dimensions can know the expert's G at all, around actions
    (L, A, B) of states obs (O, B), for each H: rank correlation, and share of G's variance: two
    (L, B). noise: deviation of the perturbations.

    In each state a quadratic of each dimension's own actions, up to H, is fitted to three quarters
    of the copies, and measured on the others."""
    config = fac.DistillConfig(noise_samples=copies, noise_std=noise)
    found, cut = np.zeros((2, len(actions), obs.shape[1])), copies * 3 // 4
    for b in range(obs.shape[1]):
        perturbed = fac.perturbed_actions(actions[..., b:b + 1, None], config, rng)
        predicted = fac.predict(expert, expert.encode(obs[:, b:b + 1]), perturbed)
        way = (perturbed[:, :, 0] - actions[..., b, None]).swapaxes(0, 1).astype(float)  # (A, L, K)
        for H, G in enumerate(fac.horizon_returns(*predicted, discount)[:, 0].astype(float)):
            i, j = np.triu_indices(H + 1)
            x = np.concatenate([way[:, :H + 1], way[:, i] * way[:, j]], 1).reshape(-1, copies).T
            x = np.concatenate([x, np.ones_like(x[:, :1])], 1)
            weights, *_ = np.linalg.lstsq(x[:cut], G[:cut], rcond=None)
            known, G = x[cut:] @ weights, G[cut:]
            found[:, H, b] = fac.spearman(known, G), 1 - np.var(G - known) / np.var(G)
    return found


def agreement(student, expert, obs, actions, rng, values=32):
    """Spearman's correlation of an agent's share of Q with the expert's Q when one action
    dimension takes other values: (A, B) of states obs (O, B), around actions (A, B)."""
    z, z_expert, dim_action = student.encode(obs), expert.encode(obs), len(actions)
    n, d, batch = student.config.num_agents, student.config.agent_actions, obs.shape[1]
    order = np.arange(dim_action)[fac.agent_order(student.config)]
    owners, found = np.argsort(order) // d, []
    for j in range(dim_action):
        a = np.repeat(actions, values, 1)
        a[j] = rng.uniform(-1, 1, batch * values)
        own = sum(student.q(np.repeat(z, values, 2), a[order].reshape(n, d, -1)))[owners[j]]
        theirs = sum(expert.q(np.repeat(z_expert, values, 2), a[None]))[0]
        found.append(fac.spearman(*(q.reshape(batch, values) for q in (own, theirs))))
    return np.stack(found)


def command_agreement(args):
    """agreement: which joint's share ranks its actions as the expert's Q does, and when."""
    student, header, args.task = open_model(args, kinds=["student"])
    (expert, _, replay, _), task = fac.load_data(args), args.task
    expected = fac.data_checksums(expert, replay)
    data, weight = header.get("data", expected), expert.params["_encoder.0.weight"]
    frozen = student.params.get("_expert_encoder.0.weight", weight)  # a student's copy
    fac.need(data == expected and np.array_equal(frozen, weight),
             f"{args.model}: was distilled from another expert or replay; name them with --expert "
             "and --replay")
    fac.check_task(replay, task, f"{replay.path} (--replay)")
    plt, rng = plots.pyplot_for(args.out), np.random.default_rng(args.seed)
    config = fac.PlannerConfig(**fac.made_for(header, args.model))
    about = {k: v for k, v in (header.get("distill") or {}).items() if k == "held_out"}
    share = fac.from_dict(fac.DistillConfig, about, args.model).held_out
    L, seed = config.horizon + 1, fac.count(header.get("seed", 0), f"{args.model}: seed")
    _, held_out = replay.starts(L, share, seed)
    obs, actions = replay.sequences(rng.choice(held_out, args.states), L)
    known = agreement(student, expert, obs, actions[0], rng)
    with fac.one_thread():
        ceiling, explained = additive_ceiling(expert, obs[:, :24], actions[..., :24], NOISE,
                                              config.discount, rng).mean(-1).tolist()
    played, done, rewards, _ = fac.play(student, task, config,
                                        fac.episode_seeds(args.seed, args.episodes))
    worst = int(rewards.sum(1).argmin())
    own = agreement(student, expert, np.ascontiguousarray(played[worst].T),
                    np.ascontiguousarray(done[worst].T), rng)
    when = np.stack([part.mean(1) for part in np.array_split(own, min(20, own.shape[1]), 1)], 1)
    width = own.shape[1] / when.shape[1]
    figure, ax = plt.subplots(figsize=(8, 3.6), layout="constrained")
    for j, line in enumerate(when):
        ax.plot(np.arange(len(line)) * width + width / 2, line, marker="os^Dv<>p"[j % 8],
                label=f"joint {j}")
    ax.set(xlabel="decision", ylabel="rank correlation with the expert's Q", ylim=(None, 1),
           title=f"{task}, the worst of {args.episodes} episodes: {rewards[worst].sum():.0f}")
    ax.legend(ncols=1 + len(own) // 8)
    plots.drawn(plots.save_figure, args.out, figure)
    result = {"out": args.out, "task": task, "held_out": known.mean(1).tolist(),
              "worst_episode": own.mean(1).tolist(), "when": when.tolist(),
              "return_worst": float(rewards[worst].sum()), "ceiling": ceiling,
              "ceiling_variance": explained}
    fac.print_table([("joint", *map(str, range(len(own)))), *(
        (name, *(f"{x:.2f}" for x in result[key]))
        for name, key in (("held-out states", "held_out"), ("worst episode", "worst_episode")))])
    print(f"a sum over action dimensions, fitted, ranks the expert's G at "
          f"{', '.join(f'{x:.2f}' for x in ceiling)} (H = 0, 1, ...; noise of {NOISE})")
    keep(args.record, task, header, {
        **{f"joint {j}, {name}": x for name, key in (("held-out states", "held_out"), (
            "worst episode", "worst_episode")) for j, x in enumerate(result[key])},
        **{f"best sum, H = {H}": x for H, x in enumerate(ceiling)},
        **{f"best sum's share of the variance, H = {H}": x for H, x in enumerate(explained)}})
    print(args.out)
    return result


def keep(path, task, header, found):
    """Numbers about a task's student into the CSV that --record names, if it does."""
    if path:
        record(path, ("task", "seed", "what", "number"), [
            (task, header.get("seed", ""), what, number) for what, number in found.items()])


def open_model(args, **kinds):
    """(model, header, task) that --model, of `load_model`'s kinds, and --task name."""
    model, header = fac.load_model(args.model, **kinds)
    fac.need(task := args.task or header.get("task"), f"{args.model}: header: no task; pass --task")
    fac.need(not fac.is_gym(task), f"{task}: expected a task of dm_control, whose "
             "episodes are equally long, and which draws; distill and evaluate play this one")
    fac.check_task(model.config, task, args.model)
    return model, header, task


def add_commands(commands):
    """The three sub-commands' arguments."""
    positive = functools.partial(fac.natural, least=1)
    sub = fac.add_command(
        commands, "watch", command_watch, "An episode as a moving picture: beside the robot "
        "a row for each joint, where its first action is between -1 and 1: grey what a plan made "
        "anew draws in each iteration (the middle four fifths), blue the plan; below, a "
        "decision's time.")
    sub.add_argument("--model", required=True, help="an expert.npz or student.npz")
    sub.add_argument("--beside", help="another one, on the same episode")
    sub.add_argument("--task", help="one of: " + fac.TASK_NAMES + " [the model's own]")
    sub.add_argument("--seed", type=fac.natural, default=0, help="of the evaluation [0]")
    sub.add_argument("--episode", type=fac.natural, default=0, help="of that evaluation [0]")
    sub.add_argument("--decisions", type=positive, default=150, help="[150]")
    sub.add_argument("--every", type=positive, default=2, help="decisions between two frames [2]")
    sub.add_argument("--out", required=True, help="a .gif or an .mp4 file")
    for name, run, help, episodes in (
            ("figure9", command_figure9, "Section 5.6: latents by joint (t-SNE, PCA), and each "
             "joint's return in the best and the worst episode.", 100),
            ("agreement", command_agreement, "Rank correlation of each joint's share with the "
             "expert's Q when that joint alone moves: in held-out states, and through the "
             "student's worst episode.", 20)):
        sub = fac.add_command(commands, name, run, help)
        sub.add_argument("--model", required=True, help="a student.npz")
        sub.add_argument("--task", help="one of: " + fac.TASK_NAMES + " [the model's own]")
        sub.add_argument("--seed", type=fac.natural, default=0, help="of the episodes [0]")
        sub.add_argument("--episodes", type=positive, default=episodes, help="[%(default)s]")
        sub.add_argument("--out", default=f"{name}.png", help="the picture [%(default)s]")
        sub.add_argument("--record", metavar="CSV", help="keep the numbers there, by task and "
                         "distillation seed, in place of earlier ones [none is kept]")
    sub.add_argument("--expert", help="the expert's file or folder [data/experts/TASK]")
    sub.add_argument("--replay", help="[replay.npz beside the expert]")
    sub.add_argument("--states", type=positive, default=256, help="held-out ones [%(default)s]")
    commands.choices["figure9"].add_argument(
        "--points", type=functools.partial(fac.natural, least=2), default=500,
        help="states that are drawn [%(default)s]")
