#!/usr/bin/env python3
"""Section 5.7: one factored student for many tasks and robots, and Figure 10.

    python data/multitask.py distill --tasks walker-walk hopper-hop
    python data/multitask.py evaluate --model runs/multitask-0/student.npz
    python data/multitask.py distill --teacher mt30-5M.pt --collect 20
    python data/multitask.py figure10

What the student is, and how it learns from several experts, is in multitask_model.py; how one model
of TD-MPC2's teaches in their place in tdmpc2.py.
"""
import argparse
import contextlib
import functools
import itertools
import sys
from pathlib import Path

import numpy as np

sys.path[:0] = map(str, Path(__file__).resolve().parents[:2])
import experiments  # noqa: E402
import fac_tdmpc_ref as fac  # noqa: E402
import import_expert  # noqa: E402
import latents  # noqa: E402
import look  # noqa: E402
from multitask_model import MultitaskDistiller, load, save  # noqa: E402
from runs import finished, key_of, make_run, read_rows  # noqa: E402
from tdmpc2 import Checkpoint  # noqa: E402

# ----------------------------------------------------------------------------------- distill

MOST_ACTIONS = 6  # of the paper's robots here
MARKS = (0.1, 0.3, 1.0)  # shares of the steps after which Figure 10's students play


def named(tasks):
    """The tasks that --tasks names, between spaces or commas; UserError: unknown, or twice."""
    found = [task for text in tasks for task in text.split(",")]
    for task in found:
        fac.lookup_task(task)
        fac.need(found.count(task) == 1, f"--tasks: {task} is there twice")
    return found


def small_tasks():
    """The tasks in data/ whose robots have at most MOST_ACTIONS action dimensions."""
    found = sorted(path.parent.name for path in fac.EXPERTS.glob("*/expert.npz"))
    fac.need(found, f"{fac.EXPERTS}: holds no experts; name --data and --tasks")
    return [task for task in found if fac.lookup_task(task)[1] <= MOST_ACTIONS]


def load_path(task, data, name):
    """The path of a task's file in data/, or in the folder `data`."""
    return Path(data) / task / name if data else fac.data_file(task, name)


def read_teacher(args):
    """The Checkpoint that --teacher names, or None."""
    fac.need(args.teacher or not (args.teacher_tasks or getattr(args, "collect", None)),
             "--teacher-tasks and --collect are for --teacher FILE; experts in data/ have replays")
    return Checkpoint(args.teacher, args.teacher_tasks) if args.teacher else None


def load_expert(task, data, checkpoint=None):
    """(expert, header, path) of a task, out of a Checkpoint if there is one."""
    if checkpoint:
        return checkpoint.teacher(task), {"task": task}, checkpoint.path
    path = load_path(task, data, "expert.npz")
    return *fac.load_model(path, ["expert"]), path


def load_data(task, args, checkpoint, seed, folder):
    """(expert, its PlannerConfig, replay) of a task. A Checkpoint's policy plays --collect episodes
    as replay, which are kept in `folder`."""
    if not checkpoint:
        expert, header, replay, path = fac.load_data(argparse.Namespace(
            task=task, expert=args.data and Path(args.data) / task, replay=None))
        return expert, fac.PlannerConfig(**fac.made_for(header, path)), replay
    expert, path = checkpoint.teacher(task), Path(args.data or fac.EXPERTS) / task / "replay.npz"
    if args.collect:
        path = collect(checkpoint, task, args.collect, seed, folder)
    fac.need(path.exists(), f"{path}: no such file; --collect 20 has the teacher play instead")
    return expert, fac.PlannerConfig(), fac.Replay(path, fac.ACTION_REPEAT)


def collect(checkpoint, task, episodes, seed, folder):
    """Path of the replay of episodes that a Checkpoint's policy plays, or has played, in a folder
    that --data takes."""
    about = {"teacher": fac.checksum([checkpoint.embedding, *checkpoint.params.values()]),
             "names": checkpoint.names, "seed": seed, "episodes": episodes,
             "versions": fac.software()}
    path = folder / f"collected-{experiments.crc(about):08x}" / task / "replay.npz"
    if not path.exists():
        planning = fac.PlannerConfig(**fac.ALONE)
        path.parent.mkdir(parents=True, exist_ok=True)
        import_expert.collect(checkpoint.teacher(task), planning, fac.make_robot(task), episodes,
                              seed)[0].write(path, {**about, "task": task})
    return path


def let_play(teacher, task, planning, workers, folder):
    """Let a teacher's policy play its episodes [D8]; what any run has played before is read from
    `folder`."""
    about = {"data": fac.data_checksums(teacher.expert, teacher.replay), "seed": teacher.seed,
             "episodes": teacher.config.expert_episodes, "planner": vars(planning),
             "versions": fac.software()}
    path = folder / f"{task}-{experiments.crc(about):08x}.npz"
    if not path.exists():
        found = fac.expert_episodes(teacher, task, planning, workers)
        fac.write_npz(path, {"kind": "played", **about}, dict(zip(("obs", "action"), found)))
    teacher.add(*fac.read_npz(path, ("played",))[1].values())


def distil(args, config, out, seed, centralized, checkpoint=None):
    """Distil a student of args.tasks into the folder `out`, or go on there; result. It's saved
    after each of `marked` steps, too, as step-N.npz. checkpoint: teaches in the experts' place."""
    teachers, plannings, out = {}, {}, Path(out)
    played = out.parent / "played"
    start = load(args.start)[0] if args.start else None
    settings = {"seed": seed, "centralized": centralized, "distill": vars(config),
                "start": start and fac.checksum(start.params.values()), "order": args.tasks}
    with contextlib.ExitStack() as stack:
        stack.enter_context(fac.locked(out))
        same_student(out / "student.npz", settings)  # before any episode is played
        for task in args.tasks:
            expert, plannings[task], replay = load_data(task, args, checkpoint, seed, played)
            fac.need(expert.has_policy or not (config.policy_share or config.expert_episodes),
                     f"{task}: the expert has no policy; pass --policy-share 0 --expert-episodes 0")
            teachers[task] = stack.enter_context(contextlib.closing(fac.Distiller(
                expert, replay, config, 1 if centralized else None, seed)))
        settings["of"] = {
            task: fac.data_checksums(of.expert, of.replay) for task, of in teachers.items()}
        distiller = stack.enter_context(contextlib.closing(MultitaskDistiller(
            teachers, config, centralized, seed,
            {step: out / f"step-{step}.npz" for step in marked(config.steps)}, settings, start)))
        same_student(out / "student.npz", settings)
        for task, teacher in teachers.items():
            if config.expert_episodes:
                let_play(teacher, task, plannings[task], args.workers, played)
        agents, count = distiller.student.config.num_agents, len(distiller.optimizer.vector)
        print(f"{len(teachers)} tasks, {agents} agents, {count:,} weights; {config.steps:,} steps "
              f"of {config.batch_size} x {config.noise_samples}; results in {out}", file=sys.stderr)
        curve, seconds, _ = fac.train_student(distiller, out, settings,
                                              plannings[args.tasks[0]], args.workers)
        save(out / "student.npz", distiller.student, settings)
        distiller.refresh()
        ranks = {task: of.ranks(64, plannings[task].discount)[1].tolist()
                 for task, of in teachers.items()}
    return {"tasks": args.tasks, "seed": seed, "centralized": centralized, "weights": count,
            "num_agents": agents, "steps": config.steps, "seconds": round(seconds, 1),
            "kl_reward": curve[-1][3], "kl_value": curve[-1][4], "rank_correlation_returns": ranks,
            "out": str(out)}


def same_student(path, settings):
    """UserError if there is a student of other settings."""
    if path.exists():
        _, before = load(path)
        fac.same_settings({key: before.get(key) for key in settings}, settings, path)


def marked(steps):
    """The steps after which students are saved: MARKS of all."""
    return [max(1, round(mark * steps)) for mark in MARKS]


def read_config(args):
    """The DistillConfig that the flags give; by default with a single student's steps a task."""
    return fac.from_args(fac.DistillConfig, args, encoder_input="observation", priors=False,
                         steps=fac.DistillConfig.steps * len(args.tasks))


def command_distill(args):
    """distill: one student of many tasks."""
    checkpoint = read_teacher(args)
    args.tasks = named(args.tasks) or (checkpoint.known if checkpoint else small_tasks())
    name = "multitask-centralized" if args.centralized else "multitask"
    result = distil(args, read_config(args), args.out or f"runs/{name}-{args.seed}", args.seed,
                    args.centralized, checkpoint)
    ranks = result["rank_correlation_returns"]
    fac.print_table([("rank correlation of G", *(f"H = {h}" for h in range(
        len(ranks[args.tasks[0]])))), *((task, *(f"{x:.2f}" for x in own))
                                        for task, own in ranks.items())])
    print(f"{result['out']}/student.npz, distilled in {result['seconds']:.0f} s")
    return result


# ---------------------------------------------------------------------------------- evaluate

def teacher_returns(expert, header, path, episodes, seed, workers=0, **planning):
    """The returns of an expert's episodes: those in its record, where it has one; else measured.
    planning: settings that aren't its own."""
    planning, found = fac.PlannerConfig(**{**fac.made_for(header, path), **planning}), []
    if "kind" in header:  # a Checkpoint's file isn't one task's
        found, _ = fac.recorded_returns(path, expert, header["task"], planning, seed)
    return found[:episodes] if len(found) >= episodes else fac.evaluate(
        expert, header["task"], planning, episodes, seed, workers,
        "evaluating the teacher")["returns"]


def command_evaluate(args):
    """evaluate: a multi-task student's returns in each of its tasks, beside its teachers'."""
    student, header = load(args.model)
    config = fac.from_dict(fac.DistillConfig, header.get("distill"), f"{args.model}: distill")
    around, found = getattr(args, "PlannerConfig.prior") != "last", {}
    checkpoint = read_teacher(args)
    for task in named(args.tasks) or student.dims:
        fac.need(task in student.dims, f"--tasks: {task}: {args.model} is of "
                 f"{', '.join(student.dims)}")
        expert, own, path = load_expert(task, args.data, checkpoint)
        fac.need(fac.checksum(expert.params.values()) in (header.get("of") or {}).get(task, ()),
                 f"{path}: another expert than {args.model} was distilled from; name its folder "
                 "with --data, or its file with --teacher")
        planning = fac.from_args(fac.PlannerConfig, args, **{
            **fac.made_for(own, path), "horizon": config.horizon,
            **(fac.STUDENT_PLANNING if around else {})})
        found[task] = fac.evaluate(student.of_task(task, expert), task, planning, args.episodes,
                                   args.seed, args.workers, task)
        found[task]["teacher_returns"] = teacher_returns(expert, own, path, args.episodes,
                                                         args.seed, args.workers)
        found[task]["policy_returns"] = teacher_returns(
            expert, own, path, args.episodes, args.seed, args.workers,
            **fac.ALONE) if expert.has_policy else []
        found[task]["kept"] = fac.return_kept(*(np.mean(found[task][key]) for key in (
            "returns", "teacher_returns")))
    rows = [[np.mean(of[key]) if of[key] else np.nan for key in (
        "returns", "teacher_returns", "policy_returns", "plan_ms_median")] for of in found.values()]
    student, teachers, policy, _ = means = np.mean(rows, 0).tolist()
    kept = [*(of["kept"] for of in found.values()), fac.return_kept(student, teachers)]
    spread = [*(f" ± {np.std(of['returns']):.0f}" for of in found.values()), ""]
    fac.print_table([("task", "student", "teacher", "its policy alone", "kept", "ms a decision"), *(
        (task, f"{row[0]:.0f}{std}", *(f"{x:.0f}" for x in row[1:3]),
         "-" if share is None else f"{share:.2f}", f"{row[3]:.1f}")
        for task, row, std, share in zip([*found, "mean"], [*rows, means], spread, kept))])
    return {"tasks": found, "episodes": args.episodes, "seed": args.seed, "return_mean": student,
            "teacher_mean": teachers, "kept": kept[-1],
            "policy_mean": None if np.isnan(policy) else policy}


# ----------------------------------------------------------------------------------- latents

def latents_of(student, header, data, task, states):
    """Latents (N, m, B) of a task's agents in states of its replay's held-out episodes."""
    path = load_path(task, data, "replay.npz")
    config = fac.from_dict(fac.DistillConfig, header.get("distill"), "header: distill")
    own = "name the folder of the student's with --data (--collect's: played/collected-*)"
    fac.need(path.exists(), f"{path}: no such file; {own}")
    replay = fac.Replay(path)
    fac.need(fac.checksum([replay.observation, replay.action, replay.ends]) in
             (header.get("of") or {}).get(task, ()), f"{path}: another replay; {own}")
    _, rows = replay.starts(1, config.held_out, header["seed"])
    rng = fac.stream(header["seed"], "latents of " + task)
    obs, _ = replay.sequences(rng.permutation(rows)[:states], 1)
    return student.of_task(task).encode(obs)


def compare_latents(student, header, data, points, picture):
    """`latents.compare` of a student, printed, and {"untrained": the same} before it learned."""
    seed = fac.count(header.get("seed"), "header: seed")
    found = {name: latents.compare(functools.partial(latents_of, of, header, data), of.dims, points,
                                   seed, drawn)
             for name, of, drawn in (("trained", student, picture),
                                     ("untrained", look.untrained(student, seed), None))}
    latents.print_tables(found)
    return {**found["trained"], "untrained": found["untrained"]}


def command_latents(args):
    """latents: do agents' latents cluster by joint, and meet across tasks and robots?"""
    student, header = load(args.model)
    look.need_plots(args.out)
    fac.need(latents.comparisons(student.dims) and student.config.num_agents > 1, f"{args.model}: "
             "expected a factored student of two walker tasks, or of one and one of hopper, found "
             f"{student.config.num_agents} agents, {', '.join(student.dims)}")
    found = compare_latents(student, header, args.data, args.points, args.out)
    print(args.out)
    return {**found, "out": args.out}


# --------------------------------------------------------------------------------- Figure 10

CASES = {"Fac-TDMPC": False, "TD-MPC": True}  # centralized?
AROUND = ", around the policy"
TEACHER, POLICY = "teacher", "its policy alone"


def play_marks(task, seed, case, settings, folder, data):
    """Rows of a task's returns: of a student after each of `marked` steps, planning alone (with the
    ranks of its predictions) or around its teacher's policy; or of the teacher; or of its policy
    alone."""
    expert, header, path = load_expert(task, data)
    episodes, steps = settings["episodes"], settings["steps"]
    own = fac.made_for(header, path)
    if case in (TEACHER, POLICY):
        returns = teacher_returns(expert, header, path, episodes, 0,
                                  **(fac.ALONE if case == POLICY else {}))
        yield {"step": steps, **experiments.of_returns(returns, 0)}
    else:
        planning = fac.PlannerConfig(**{**own, "horizon": settings["horizon"], **(
            fac.STUDENT_PLANNING if case.endswith(AROUND) else {})})
        for step in marked(steps):
            student, about = load(student_folder(folder, seed, case) / f"step-{step}.npz")
            student, ranks = student.of_task(task, expert), {}
            if case in CASES:
                q, g = ranks_of(student, load_path(task, data, "replay.npz"), about,
                                planning.discount)
                ranks = {"rank_q": float(q[0]), "rank_return": float(g[-1])}
            yield {"step": step, **ranks,
                   **experiments.measure(student, task, planning, episodes, 0)}


def ranks_of(student, replay, header, discount):
    """Distiller.ranks of one task's student in states that a multi-task run has held out."""
    config = fac.from_dict(fac.DistillConfig, header["distill"], "a student's header: distill")
    with contextlib.closing(fac.Distiller(student.teacher, fac.Replay(replay), config,
                                          seed=header["seed"])) as distiller:
        distiller.student = student
        return distiller.ranks(256, discount)


def student_folder(folder, seed, case):
    """Where figure10 leaves a student."""
    return Path(folder) / f"{seed}" / case.removesuffix(AROUND)


def over_tasks(rows, tasks, column="return_mean"):
    """`experiments.curves` of runs, and before them the mean over tasks, seed by seed."""
    found = experiments.curves(rows, column)
    mean = {case: {step: np.mean([found[task][case][step] for task in tasks], 0).tolist()
                   for step in points} for case, points in found[tasks[0]].items()}
    return {f"mean of {len(tasks)} tasks": mean, **{task: found[task] for task in tasks}}


def figure10_runs(args, config, made):
    """A run for each task, seed and case. made: a number that tells students apart."""
    cases = [(seed, case + prior) for seed in args.seeds for case in CASES
             for prior in ("", AROUND)]
    return [make_run(task, seed, case, made=made, steps=config.steps,
                                 horizon=config.horizon, episodes=args.episodes)
            for task in args.tasks for seed, case in (*cases, (0, TEACHER), (0, POLICY))]


def command_figure10(args):
    """figure10: returns against steps of both students, teachers' beside; latents."""
    args.tasks = named(args.tasks) or small_tasks()
    config = read_config(args)
    look.need_plots(args.picture)
    fac.check_writable(out := experiments.csv_path(args))
    read_rows(out)  # what is wrong with it is missed before hours of work
    for expert, _, path in (load_expert(task, args.data) for task in args.tasks):
        fac.need(expert.has_policy, f"{path}: has no policy for students to plan around; name "
                 "other --tasks")
    for seed, (case, centralized) in itertools.product(args.seeds, CASES.items()):
        distil(args, config, student_folder(args.students, seed, case), seed, centralized)
    students = {seed: load(student_folder(args.students, seed, "Fac-TDMPC") / "student.npz")
                for seed in args.seeds}
    made = experiments.crc(config, fac.PlannerConfig(), fac.STUDENT_PLANNING, MARKS,
                           students[args.seeds[0]][1]["of"])
    runs = figure10_runs(args, config, made)
    result = experiments.run_all(args, functools.partial(
        play_marks, folder=args.students, data=args.data), runs)
    fac.need(not result["failed"], f"{result['out']}: {result['failed']} runs failed")
    done = finished(read_rows(result["out"]))
    rows = {key: done[key] for key in map(key_of, runs)}
    found, ranks = over_tasks(rows, args.tasks), over_tasks(rows, args.tasks, "rank_return")
    experiments.draw_lines(args.picture, {
        title: ({case: cases[case] for case in cases if case != TEACHER},  # which is the level
                cases[TEACHER][config.steps][0]) for title, cases in found.items()},
        "gradient step")
    print_figure10(found, ranks, marked(config.steps))
    compared, picture = {}, Path(args.picture).with_name(f"{Path(args.picture).stem}-latents.png")
    for seed, (student, header) in students.items():
        print(f"latents, seed {seed}")
        compared[seed] = compare_latents(student, header, args.data, 100,
                                         None if compared else picture)
    return {**result, "returns": found, "ranks": ranks, "latents": compared,
            "picture": args.picture}


def print_figure10(found, ranks, steps):
    """A table for the mean and for each task: mean returns, over seeds, after these steps, and rank
    correlations of G."""
    def cell(title, case, step):
        own, rank = ({s: v for s, v in of[title][case].items() if s == step}
                     for of in (found, ranks))
        return experiments.cell(experiments.last(own, rank) if own else None)

    for title, cases in found.items():
        fac.print_table([(title, *(f"{step:,} steps" for step in steps)), *(
            (case, *(cell(title, case, step) for step in steps)) for case in cases)])
        print()


# ------------------------------------------------------------------------------ command line

def make_parser():
    """The command line."""
    parser = fac.Parser(prog="multitask.py", description="One factored student for many tasks and "
                        "robots (section 5.7), each task taught by its own expert.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    positive = functools.partial(fac.natural, least=1)

    def add(name, run, help, tasks="", model=False, **about):
        sub = fac.add_command(commands, name, run, help, **about)
        if tasks:
            sub.add_argument("--tasks", nargs="+", default=[], metavar="TASK", help="any of: "
                             f"{fac.TASK_NAMES} [{tasks}]")
            sub.add_argument("--workers", type=fac.natural,
                             help="processes that play episodes, but for --collect's; 0: this "
                             "one [cores]")
        if model:
            sub.add_argument("--model", required=True, help="distill's student.npz or step-N.npz")
        else:
            sub.add_argument("--steps", type=int, dest="DistillConfig.steps", metavar="INT", help=
                             f"gradient steps in all [{fac.DistillConfig.steps} for each task]")
            fac.add_config(sub, fac.DistillConfig, skip=(
                "steps", "targets", "encoder_input", "priors"))
        sub.add_argument("--data", help="folder with TASK/expert.npz and replay.npz [data/experts]")
        return sub.add_argument

    def add_teacher(option):
        option("--teacher", metavar="FILE", help="a TD-MPC2 checkpoint of many tasks, which "
               "teaches them instead of experts")
        option("--teacher-tasks", nargs="+", default=[], metavar="TASK", help="its tasks in its "
               "order, - for those of others [mt30's or mt80's]")

    small = f"experts in data/ of at most {MOST_ACTIONS} action dimensions"
    option = add("distill", command_distill, "Distil many tasks' experts into one student.", small,
                 epilog="Given again, a cut-off run goes on. What the policies play is kept "
                 "beside --out, in played/, for other runs of the same seed.")
    option("--seed", type=fac.natural, default=0, help="of distillation [0]")
    option("--centralized", action="store_true", help="one agent, with the same encoder, about as "
           "many weights, the same states")
    option("--start", help="a student of other tasks to begin from, e.g. of all but the --tasks "
           "here, to see what these learn from those")
    option("--out", help="folder for the results [runs/multitask-SEED, "
           "runs/multitask-centralized-SEED]")
    add_teacher(option)
    option("--collect", type=functools.partial(fac.natural, least=2), metavar="N", help="episodes "
           "of each task that --teacher's policy plays as replay [those in --data]")
    option = add("evaluate", command_evaluate, "Plan with a student in each of its tasks, by "
                 "default around its teacher's policy (defaults below are of that search); with "
                 "--prior last it plans alone.",
                 "the student's", True)
    option("--seed", type=fac.natural, default=0, help="of the episodes [0]")
    option("--episodes", type=positive, default=20, help="of each task [20]")
    add_teacher(option)
    fac.add_config(commands.choices["evaluate"], fac.PlannerConfig,
                   skip=("action_repeat", "horizon"), **fac.STUDENT_PLANNING)
    option = add("latents", command_latents, "Figure 10, middle and right: t-SNE of the walkers' "
                 "latents, and of walker's and hopper's, by joint; silhouettes; a classifier of "
                 "hip, knee and ankle that learned from one robot, tried on the other.", "", True)
    option("--points", type=functools.partial(fac.natural, least=20), default=100,
           help="states of each task [%(default)s]")
    option("--out", default="latents.png", help="the picture [%(default)s]")
    option = add("figure10", command_figure10, "Return against steps of the factored student and "
                 "of a centralized one, each planning alone and around its teachers' policies; "
                 "then latents.", small, epilog="The same command again makes what is missing.")
    commands.choices["figure10"].set_defaults(start=None)
    option("--seeds", nargs="+", type=fac.natural, default=[0, 1, 2], metavar="SEED",
           help="of distillation [0 1 2]")
    option("--episodes", type=positive, default=5, help="of each evaluation [5]")
    option("--jobs", type=positive, default=fac.cores(),
           help="tasks that are played at a time [one for each core]")
    option("--students", default="runs/figure10", help="leave them in SEED/ there; other tasks or "
           "settings need another folder [%(default)s]")
    option("--out", help="the CSV [data/results/figure10.csv]")
    option("--picture", default=str(fac.DATA / "figures" / "figure10.png"), help="beside it "
           "FIGURE-latents.png [data/figures/figure10.png]")
    return parser


def main(argv=None):
    """Run the command line; returns the exit status."""
    return fac.run_command(make_parser(), argv)


if __name__ == "__main__":
    sys.exit(main())
