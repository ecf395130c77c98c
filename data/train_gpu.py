#!/usr/bin/env python3
"""Train TD-MPC experts of many tasks at once on one GPU (Equation 1).

    python data/train_gpu.py --tasks cheetah-run walker-run humanoid-stand --minutes 9

A GPU has hardly begun when an update of one 512-wide model is over. So the models of all tasks are
one: parameters (T, out, in), batches (T, B, features), each product a batched one, T tasks;
observations and actions are padded with zeros to the widest. Updates and plans are CUDA graphs,
one launch each. Processes play --envs episodes of every task in step: the GPU plans for all of
them, and learns while they move. Losses and MPPI are train_expert.py's, whose folders this leaves,
one for each task: expert.npz and replay.npz for `fac_tdmpc_ref.py distill --expert`, and curve.csv.

Without a GPU (--device cpu) it does the same, slowly: for its tests.
"""
import dataclasses
import functools
import sys
import time
from pathlib import Path

import numpy as np

sys.path[:0] = map(str, Path(__file__).resolve().parents[:2])
import fac_tdmpc_ref as fac  # noqa: E402
from numpy_learner import ExpertConfig  # noqa: E402
from train_expert import ReplayBuffer  # noqa: E402

# of train_expert.py, what stands still in a CUDA graph or is done otherwise here
SKIPPED = ("updates_per_step", "seed_decisions", "random_hold", "buffer_dtype", "target_every")
DEFAULTS = {"std_steps": 100_000}
PLANNING = {"iterations": 3}
COOLING = 0.8  # of the time: from here on the learning rate falls to a tenth
CURVE = "seconds", "decisions", "updates", "return_mean", "return_min", "return_max"


def playing_worker(connection):
    """Plays an episode of each task: seeds or actions (T, A) in, observations (T, O) and rewards
    (T,) out, all padded with zeros to the widest task's sizes."""
    tasks, dim_obs = connection.recv()
    environments = [fac.Environment(task) for task in tasks]
    while True:
        message = connection.recv()
        obs, reward = np.zeros((len(tasks), dim_obs), np.float32), np.zeros(len(tasks), np.float32)
        for i, (environment, given) in enumerate(zip(environments, message)):
            if isinstance(message, list):
                found = environment.reset(given)
            else:
                found, reward[i] = environment.step(given[:environment.dim_action])
            obs[i, :environment.dim_obs] = found
        connection.send((obs, reward))


def padded(n):
    """The next multiple of 8, which tensor cores want."""
    return -(-n // 8) * 8


def parameters(sizes):
    """Of a model with a policy: {name: ((rows, columns), whether it stays in float32)}."""
    return {f"{name}.{i}.{part}": (shape[1:] if part == "weight" else (shape[1], 1),
                                   last or name == "_encoder")
            for name, i, _, shape, last in fac.layers(sizes, True) for part in ("weight", "bias")}


class Stack:
    """Parameters of T models as one matrix (T, P): those of `models` that `chosen` takes, by name.

    `views()` are their arrays (T, rows, columns), hidden layers in the `low` precision, the encoder
    and last ones in float32 (bfloat16 has eight bits, in which a Q of 100 would be a multiple of a
    half).
    """

    def __init__(self, models, chosen, config, sizes, low, device):
        import torch
        found = {n: x for n, x in parameters(sizes).items() if chosen(n)}
        self.names = sorted(found, key=lambda n: found[n][1])  # those of low precision first
        self.shapes = [found[n][0] for n in self.names]
        self.low, self._lengths = low, [a * b for a, b in self.shapes]
        self._hidden = sum(not fine for _, fine in found.values())
        rows = [np.concatenate([np.pad(own := model.params[n][0], [
            (0, wide - narrow) for wide, narrow in zip(shape, own.shape)]).ravel()
            for n, shape in zip(self.names, self.shapes)]) for model in models]
        self.vector = torch.tensor(np.stack(rows), device=device, requires_grad=True)
        self.optimizer = torch.optim.Adam([self.vector], torch.tensor(config.lr, device=device),
                                          fused=True, capturable=device != "cpu")
        self._clip = config.grad_clip

    def views(self, vector=None):
        """{name: (T, rows, columns)} of this vector, or another one such."""
        vector = self.vector if vector is None else vector
        cut, lengths = sum(self._lengths[:self._hidden]), self._lengths
        hidden, last = vector.split([cut, vector.shape[1] - cut], 1)
        parts = [*hidden.to(self.low).split(lengths[:self._hidden], 1),
                 *last.split(lengths[self._hidden:], 1)]
        return {n: part.unflatten(1, shape)
                for n, part, shape in zip(self.names, parts, self.shapes)}

    def step(self, loss):
        """One step of Adam down the sum of all tasks' losses, each task's gradient clipped."""
        import torch
        grad, = torch.autograd.grad(loss, [self.vector])
        norm = torch.linalg.vector_norm(grad, dim=1, keepdim=True)
        self.vector.grad = grad * (self._clip / (norm + 1e-6)).clamp(max=1)
        self.optimizer.step()

    def arrays(self, i, sizes):
        """Task i's arrays as fac.WorldModel names and shapes them, without the padding."""
        vector, shapes = self.vector[i].detach().cpu().numpy(), parameters(sizes)
        found, parts = {}, np.split(vector, np.cumsum(self._lengths)[:-1])
        for n, part, wide in zip(self.names, parts, self.shapes):
            rows, columns = shapes[n][0]
            found[n] = part.reshape(wide)[None, :rows, :columns].copy()
        return found


class Learner:
    """TD-MPC of T tasks: their models, moving averages, replay, and plans.

    actions and observations are as wide as the widest task's, padded; `mask` (T, 1, A) is 1 where
    a task has an action.
    """

    def __init__(self, models, config, planning, episodes, device, low):
        import torch
        import torch_learner
        self.torch, self.nets, self.config, self.planning = torch, torch_learner, config, planning
        self.tensor = functools.partial(torch.tensor, device=device)
        self.device, self.updates, self.models = device, 0, models
        T, m = len(models), config.latent_dim
        self.dim_obs = padded(max(model.config.dim_obs for model in models))
        self.dim_action = padded(m + max(model.config.dim_action for model in models)) - m
        sizes = dataclasses.replace(models[0].config, dim_obs=self.dim_obs,
                                    dim_action=self.dim_action)
        self.main, self.pi = (Stack(models, chosen, config, sizes, low, device) for chosen in (
            lambda name: name[:3] != "_pi", lambda name: name[:3] == "_pi"))
        self.target = self.main.vector.detach().clone()
        self.mask = self.tensor([[[float(j < model.config.dim_action) for j in
                                   range(self.dim_action)]] for model in models])
        shape, new = (T, episodes, fac.EPISODE_STEPS), functools.partial(torch.zeros, device=device)
        self.obs = new(T, episodes, fac.EPISODE_STEPS + 1, self.dim_obs)
        self.action, self.reward = new(*shape, self.dim_action), new(*shape)
        self.filled, self.std = self.tensor(0.0), new(T, 1, 1)
        self.losses = new(3)

    def encode(self, p, obs):
        return self.net(fac.ENCODER, p, "_encoder", obs)

    def net(self, kinds, p, name, x):
        return self.nets.network(kinds, p, name, x.to(p[f"{name}.0.weight"].dtype))

    def policy(self, pi, z, noise=0.0):
        """As torch_learner.policy; where a task has no action it is zero."""
        a = (self.torch.tanh(self.net(fac.MLP, pi, "_pi", z)) + noise) * self.mask
        return a - a.detach() + a.detach().clamp(-1, 1)

    def q(self, p, z, a):
        """Both Q (T, B)."""
        x = self.torch.cat([z, a], -1)
        return [self.net(fac.NETWORKS[name], p, name, x)[..., 0] for name in fac.HEADS[1:]]

    def policy_noise(self, *shape):
        noise = self.torch.randn(*shape, self.dim_action, device=self.device)
        return (noise * fac.POLICY_STD).clamp(-fac.POLICY_CUT, fac.POLICY_CUT)

    def sample(self):
        """Segments drawn evenly: observations (H+1, T, B, O), actions (H, T, B, A), rewards."""
        torch, B, H = self.torch, self.config.batch_size, self.config.horizon
        T, _, steps = self.reward.shape
        u = torch.rand(2, T, B, device=self.device)
        episode = (u[0] * self.filled).long()
        begin = (u[1] * (steps - H + 1)).long()
        task = torch.arange(T, device=self.device)[:, None]
        at = [(task, episode, begin + h) for h in range(H + 1)]
        return (torch.stack([self.obs[i] for i in at]),
                *(torch.stack([x[i] for i in at[:-1]]) for x in (self.action, self.reward)))

    def update(self, obs, action, reward, noise):
        """One step of Equation 1 and one of the policy for every task, as TorchLearner's.

        obs (H+1, T, B, O), action (H, T, B, A), reward (H, T, B), noise (T, (2H+1) B, A).
        """
        torch, config, (H, T, B, _) = self.torch, self.config, action.shape
        p, pi = self.main.views(), self.pi.views()
        with torch.no_grad():
            slow, after = self.main.views(self.target), obs[1:].swapaxes(0, 1).flatten(1, 2)
            s_next, z_next = self.encode(slow, after), self.encode(p, after)
            q = torch.minimum(*self.q(slow, z_next, self.policy(pi, z_next, noise[:, :H * B])))
            td = reward.swapaxes(0, 1).flatten(1) + config.discount * q  # (T, H B)
        latents = [self.encode(p, obs[0])]
        for a in action:
            x = torch.cat([latents[-1], a], -1)
            latents.append(self.net(fac.MLP, p, "_dynamics", x))
        rollout = torch.cat(latents, 1)
        x, actions = rollout[:, :-B], action.swapaxes(0, 1).flatten(1, 2)
        r = self.net(fac.MLP, p, "_reward", torch.cat([x, actions], -1))[..., 0]
        errors = [(rollout[:, B:] - s_next).square().mean(-1),
                  (r - reward.swapaxes(0, 1).flatten(1)).square(),
                  sum((q - td).square() for q in self.q(p, x, actions))]
        lam = config.lam ** torch.arange(H + 1, device=self.device)
        terms = torch.stack([(lam[:H] * e.view(T, H, B).mean(-1)).sum(1) for e in errors])
        coefs = config.consistency_coef, config.reward_coef, config.value_coef
        self.main.step(sum(c * term.sum() for c, term in zip(coefs, terms)) / H)
        rollout, p = rollout.detach(), self.main.views(self.main.vector.detach())
        q = torch.minimum(*self.q(p, rollout, self.policy(pi, rollout, noise[:, H * B:])))
        self.pi.step(-(lam * q.view(T, H + 1, B).mean(-1)).sum())
        self.losses.copy_(terms.detach().mean(1))

    def learn(self):
        """Two updates, then a step of the moving averages."""
        config = self.config
        columns = (2 * config.horizon + 1) * config.batch_size
        for _ in range(2):
            self.update(*self.sample(), self.policy_noise(len(self.models), columns))
        self.target.lerp_(self.main.vector.detach(), config.tau)

    def returns(self, p, z, actions):
        """Equation 2 (T, C) of latents z (T, C, m), actions (L, T, C, A)."""
        gamma, G = self.planning.discount, 0.0
        for h, a in enumerate(actions[:-1]):
            x = self.torch.cat([z, a], -1)
            G = G + gamma ** h * self.net(fac.MLP, p, "_reward", x)[..., 0]
            z = self.net(fac.MLP, p, "_dynamics", x)
        return G + gamma ** (len(actions) - 1) * sum(self.q(p, z, actions[-1])) / 2

    def plan(self, obs, mean):
        """fac.mppi for every task and episode: obs (T, E, O), mean (L, T, E, A); returns actions
        (T, E, A) with exploration noise and the mean for the next decision."""
        torch, c, (L, T, E, A) = self.torch, self.planning, mean.shape
        p, pi = (part.views(part.vector.detach()) for part in (self.main, self.pi))
        z, S, P = self.encode(p, obs), c.samples, c.pi_trajs
        rolled, proposals = z.repeat_interleave(P, 1), []
        for h in range(L):
            proposals.append(self.policy(pi, rolled, self.policy_noise(T, E * P)))
            if h < L - 1:
                rolled = self.net(fac.MLP, p, "_dynamics",
                                  torch.cat([rolled, proposals[-1]], -1))
        proposals = torch.stack(proposals)
        G_proposals = self.returns(p, z.repeat_interleave(P, 1), proposals).view(T, E, P)
        mean, std = mean[:, :, :, None], torch.full_like(mean[:, :, :, None], c.max_std)
        least, mask = self.std[..., None].clamp(min=c.min_std), self.mask[:, :, None]
        starts = z.repeat_interleave(S, 1)
        for _ in range(c.iterations):
            noise = torch.randn(L, T, E, S, A, device=self.device)
            actions = (mean + std * noise).clamp(-1, 1) * mask
            G = self.returns(p, starts, actions.flatten(2, 3)).view(T, E, S)
            actions = torch.cat([actions, proposals.view(L, T, E, P, A)], 3)
            G, best = torch.cat([G, G_proposals], 2).topk(c.num_elites, -1)
            elites = actions.gather(3, best[None, ..., None].expand(L, -1, -1, -1, A))
            score = torch.softmax(c.inverse_temperature * G, -1)[..., None]
            new = (score * elites).sum(3, keepdim=True)
            std = (score * (elites - new).square()).sum(3, keepdim=True).sqrt()
            std = torch.maximum(std, least).clamp(max=c.max_std)
            mean = c.momentum * mean + (1 - c.momentum) * new
        gumbel = -torch.log(-torch.log(torch.rand_like(score).clamp(1e-9, 1 - 1e-6)))
        pick = (score.log() + gumbel).argmax(2)[None, :, :, None].expand(1, -1, -1, 1, A)
        action = elites[:1].gather(3, pick)[0, :, :, 0]
        action = (action + self.std * torch.randn_like(action)).clamp(-1, 1) * self.mask
        mean = mean[..., 0, :]
        return action, torch.cat([mean[1:], torch.zeros_like(mean[:1])])

    def sent(self, tensor):
        """Start to copy a tensor to the host; a function that waits for it and gives the array."""
        if self.device == "cpu":
            return tensor.numpy
        host = self.torch.empty(tensor.shape, pin_memory=True)
        host.copy_(tensor, non_blocking=True)
        event = self.torch.cuda.Event()
        event.record()

        def wait():
            event.synchronize()
            return host.numpy()
        return wait

    def graph(self, function):
        """A function of no arguments as one launch that repeats it; on a CPU the function."""
        if self.device == "cpu":
            return function
        torch, stream = self.torch, self.torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):
                function()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            function()
        return graph.replay

    def expert(self, i):
        """Task i's model as it is now."""
        sizes = self.models[i].config
        return fac.WorldModel(sizes, {**self.main.arrays(i, sizes), **self.pi.arrays(i, sizes)})


def started(path, task, sizes):
    """(model, what it has learned from) of an expert's file, to be trained further."""
    model, header = fac.load_model(path, ("expert",))
    found = header.get("task"), fac.made_for(header, path).get("action_repeat", fac.ACTION_REPEAT)
    expected = task, fac.ACTION_REPEAT
    fac.need(found == expected,
             f"{path}: header: task, action_repeat: expected {expected}, found {found}")
    fac.need(model.config == sizes and model.has_policy,
             f"{path}: expected an expert with a policy and {sizes}, found {model.config}")
    return model, {k: header[k] for k in ("decisions", "updates", "before") if k in header}


def train(args):
    """Learn for --minutes; returns the result."""
    config = fac.from_args(ExpertConfig, args, **DEFAULTS)
    planning = fac.from_args(fac.PlannerConfig, args, **PLANNING, horizon=config.horizon,
                             discount=config.discount)
    fac.need(0 < args.minutes < np.inf, f"--minutes: expected above 0, found {args.minutes}")
    fac.need(args.updates % 2 == 0, f"--updates: expected an even number, found {args.updates}")
    fac.need(planning.iterations, "--plan-iterations: expected at least 1, found 0")
    fac.need(len(args.start) <= len(args.tasks), f"--start: expected at most {len(args.tasks)} "
             f"files, one for each of --tasks, found {len(args.start)}")
    sizes = [fac.ModelConfig(*fac.lookup_task(task), 1, config.latent_dim, config.enc_dim,
                             config.mlp_dim) for task in args.tasks]
    with fac.optional("PyTorch", "torch"):
        import torch
    there = torch.cuda.is_available()
    device = args.device or ("cuda" if there else "cpu")
    fac.need(there or device == "cpu", "--device cuda: PyTorch finds no GPU here")
    torch.backends.cuda.matmul.allow_tf32 = True
    torch.manual_seed(args.seed)
    before = [started(*of) for of in zip(args.start, args.tasks, sizes)]
    for folder in (args.out, *Path(args.out).glob("*/")):
        fac.need_none(folder, "expert.npz", "replay.npz", "curve.csv")
    models = [before[i][0] if i < len(before) else fac.WorldModel.create(
        size, fac.stream(args.seed, "expert", i), policy=True) for i, size in enumerate(sizes)]
    episodes = max(1, config.buffer_size // fac.EPISODE_STEPS // args.envs) * args.envs
    try:
        learner = Learner(models, config, planning, episodes, device,
                          getattr(torch, args.precision))
    except RuntimeError as error:  # PyTorch's, of memory
        raise fac.UserError(f"--buffer-size {config.buffer_size}: {str(error).splitlines()[0]}"
                            ) from None
    with fac.locked(args.out), torch.no_grad(), \
            fac.Workers(playing_worker, args.envs, "playing worker") as workers:
        workers.send_all([(args.tasks, learner.dim_obs)] * args.envs)
        run = Run(args, config, learner, workers, [history for _, history in before])
        while not run.decisions or run.seconds < 60 * args.minutes:
            run.round()
        return {"tasks": args.tasks, "seed": args.seed, "decisions": run.decisions,
                "updates": learner.updates, "seconds": round(run.seconds, 1),
                "returns": [curve[-1][3] for curve in run.curves], "out": args.out,
                "failed": run.save(args.out)}


class Run:
    """Rounds of --envs episodes of every task, played and learned from."""

    def __init__(self, args, config, learner, workers, before):
        self.args, self.config, self.learner, self.workers = args, config, learner, workers
        self.before = before
        self.began, self.decisions = time.monotonic(), 0
        self.curves = [[] for _ in args.tasks]
        new, (T, E) = learner.torch.zeros, (len(args.tasks), args.envs)
        self.obs_now = new(T, E, learner.dim_obs, device=learner.device)
        self.mean = new(config.horizon + 1, T, E, learner.dim_action, device=learner.device)
        self.chosen, self.plan, self.learn = self.mean[0].clone(), None, None

    @property
    def seconds(self):
        """Since the start."""
        return time.monotonic() - self.began

    def schedule(self):
        """Exploration and learning rate of now."""
        config, learner = self.config, self.learner
        learner.std.fill_(np.interp(self.decisions, [0, config.std_steps],
                                    [config.std_start, learner.planning.min_std]))
        learner.std[:len(self.before)] = learner.planning.min_std  # these have explored
        done = self.seconds / (60 * self.args.minutes)
        for stack in (learner.main, learner.pi):
            stack.optimizer.param_groups[0]["lr"].fill_(
                config.lr * np.interp(done, [COOLING, 1], [1, 0.1]))

    def round(self):
        """An episode of each task in every process, in step; learns meanwhile. The first round:
        without learning, and with random actions unless some models were trained before."""
        learner, args, torch, steps = self.learner, self.args, self.learner.torch, fac.EPISODE_STEPS
        first, held = self.decisions // steps, learner.obs.shape[1]
        where = slice(first % held, first % held + args.envs)
        self.schedule()
        if first and self.learn is None:
            self.learn = learner.graph(torch.enable_grad()(learner.learn))
        if (first or self.before) and self.plan is None:
            self.plan = learner.graph(self.decide)
        self.mean.zero_()
        seeds = fac.training_seeds(args.seed, "training episode", first * len(args.tasks),
                                   args.envs * len(args.tasks))
        self.workers.send_all(seeds[i::args.envs] for i in range(args.envs))
        self.hear(where, 0)
        for t in range(steps):
            if self.plan:
                self.plan()
            else:
                self.chosen.uniform_(-1, 1).mul_(learner.mask)
            actions = learner.sent(self.chosen)
            if first:  # queued before this waits: the GPU learns while the processes play
                for _ in range(args.updates // 2):
                    self.learn()
                learner.updates += args.updates
            learner.action[:, where, t] = self.chosen
            self.workers.send_all(actions().swapaxes(0, 1))
            learner.reward[:, where, t] = self.hear(where, t + 1)
        self.decisions += args.envs * steps
        learner.filled.fill_(min(self.decisions // steps, held))
        self.note(learner.reward[:, where].sum(2).cpu().numpy())

    def note(self, returns):
        """A row for each task's curve, of returns (T, E), and a line on stderr."""
        learner = self.learner
        for curve, found in zip(self.curves, returns):
            curve.append([round(self.seconds, 1), self.decisions, learner.updates,
                          *map(float, (found.mean(), found.min(), found.max()))])
        losses = " ".join(f"{x:.3g}" for x in learner.losses.tolist())
        print(f"{self.seconds:.0f} s, {self.decisions:,} decisions, {learner.updates:,} updates, "
              f"losses {losses}; returns " + " ".join(f"{x:.0f}" for x in returns.mean(1)),
              file=sys.stderr, flush=True)

    def hear(self, where, t):
        """The observations of all, into replay and `obs_now`; their rewards (T, E)."""
        learner = self.learner
        obs, reward = (np.stack(x, 1) for x in zip(*self.workers.receive_all()))
        self.obs_now.copy_(learner.torch.from_numpy(obs))
        learner.obs[:, where, t] = self.obs_now
        return learner.tensor(reward)

    def decide(self):
        action, mean = self.learner.plan(self.obs_now, self.mean)
        self.chosen.copy_(action.nan_to_num(0))  # one task's failure is not the others'
        self.mean.copy_(mean)

    def save(self, out):
        """A folder for each task; returns how many models are not finite, and have none."""
        learner, args, held, failed = self.learner, self.args, int(self.learner.filled), 0
        count = min(args.replay, held)
        for i, (task, curve) in enumerate(zip(args.tasks, self.curves)):
            folder = Path(out) / (task if args.tasks.count(task) == 1 else f"{task}-{i}")
            model = learner.expert(i)
            about = {"task": task, "seed": args.seed, "decisions": self.decisions,
                     "updates": learner.updates, "action_repeat": fac.ACTION_REPEAT,
                     "backend": "torch", "torch": learner.torch.__version__,
                     "device": learner.device, "precision": args.precision, "envs": args.envs,
                     "training": {key: value for key, value in vars(self.config).items()
                                  if key not in SKIPPED},
                     "training_planner": dataclasses.asdict(learner.planning)}
            if i < len(self.before):
                about["before"] = self.before[i]
            try:
                # as float16: half of the room
                fac.save_model(folder / "expert.npz", model, {"kind": "expert", **about}, True)
                episodes = ReplayBuffer(model.config.dim_obs, model.config.dim_action,
                                        count * fac.EPISODE_STEPS)
                for j in np.arange(count) * held // count:
                    obs, action, reward = (x[i, j].cpu().numpy() for x in (
                        learner.obs, learner.action, learner.reward))
                    episodes.add(obs[:, :model.config.dim_obs],
                                 action[:, :model.config.dim_action], reward)
                episodes.write(folder / "replay.npz", about)
                fac.write_curve(folder / "curve.csv", CURVE, curve)
            except fac.UserError as error:  # one task's failure is not the others'
                print(error, file=sys.stderr)
                failed += 1
        return failed


def make_parser():
    """The command line, generated from the configs."""
    parser = fac.Parser(prog="train_gpu.py", description="Train TD-MPC experts of many tasks at "
                        "once on one GPU (Equation 1).", epilog="Each task's folder in --out is "
                        "what distill takes as --expert.")
    add, natural = parser.add_argument, fac.natural
    positive = functools.partial(natural, least=1)
    add("--tasks", nargs="+", default=list(fac.TASKS), metavar="TASK", help="of "
        "dm_control's suite; one may be named twice [the paper's]")
    add("--start", nargs="+", default=[], metavar="EXPERT.NPZ", help="experts to train further, of "
        "the first --tasks; the others begin anew [all anew]")
    add("--minutes", type=float, default=9, help="how long to learn [9]")
    add("--seed", type=natural, default=0, help="[0]")
    add("--envs", type=positive, default=16, help="processes, and episodes of a task at once [16]")
    add("--updates", type=positive, default=8, help="updates while each of them takes a decision, "
        "an even number [8]")
    add("--device", choices=("cpu", "cuda"), help="[cuda where there is one]")
    add("--precision", choices=("float32", "bfloat16"), default="bfloat16", help="of hidden "
        "layers' products but the encoder's [bfloat16]")
    add("--replay", type=positive, default=60, help="episodes in replay.npz, spread evenly over "
        "training [60]")
    add("--out", default="runs/gpu", help="folder for the results [runs/gpu]")
    add("--json", action="store_true", help="print one JSON object as the last line of stdout")
    fac.add_config(parser, ExpertConfig, skip=SKIPPED, **DEFAULTS)
    fac.add_config(parser, fac.PlannerConfig, "MPPI while training", "plan-",
                   skip=("discount", "action_repeat", "prior", "speed", "output", "horizon"),
                   **PLANNING)
    parser.set_defaults(run=train)
    return parser


def main(argv=None):
    """Run the command line; returns the exit status."""
    return fac.run_command(make_parser(), argv)


if __name__ == "__main__":
    sys.exit(main())
