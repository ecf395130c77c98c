"""Your own robot: an arm of NumPy alone, its expert trained, its student distilled, both played in
two minutes. A robot has its sizes, `reset(seed)`, which returns an observation, and `step(action)`,
which returns the next one and a reward; actions are in [-1, 1]."""
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import fac_tdmpc_ref as fac  # noqa: E402
from numpy_learner import ExpertConfig, Learner  # noqa: E402
from train_expert import ReplayBuffer  # noqa: E402


class Arm:
    """Two joints, moved by torques, whose tip should reach a target: 8 features, 2 actions."""
    dim_obs, dim_action = 8, 2

    def reset(self, seed):
        rng = np.random.default_rng(seed)
        self.angle, self.target, self.speed = *rng.uniform(-1, 1, (2, 2)), np.zeros(2)
        return self.observe()

    def step(self, action):
        self.speed = 0.9 * self.speed + 0.1 * np.asarray(action)
        self.angle = self.angle + 0.2 * self.speed
        obs = self.observe()
        return obs, np.exp(-2 * obs[-2:] @ obs[-2:])

    def observe(self):
        tip = np.array([f(np.cumsum(self.angle)).sum() for f in (np.cos, np.sin)])
        return np.r_[np.cos(self.angle), np.sin(self.angle), self.speed, self.target - tip]


def main(episodes=24, updates=400, steps=3000, out=Path("runs/own-robot")):
    """Train for so many episodes, with so many updates after each; distil for so many steps."""
    robot, rng, planning = Arm(), np.random.default_rng(0), fac.PlannerConfig(samples=64)
    sizes = fac.ModelConfig(robot.dim_obs, robot.dim_action, latent_dim=16, enc_dim=32, mlp_dim=64)
    learner = Learner(sizes, ExpertConfig(), rng)
    expert, buffer = learner.model, ReplayBuffer(robot.dim_obs, robot.dim_action, 10 ** 6)
    for i in range(episodes):  # less and less exploration
        found = fac.play(expert, None, planning, [i], environment=robot, noise=1 - i / episodes)
        buffer.add(found[0][0], found[1][0, :-1], found[2][0, :-1])
        for _ in range(updates):
            learner.update(*buffer.sample(rng, 64, 3)[:3], rng)
    buffer.write(out / "replay.npz", {"task": "arm"})
    distiller = fac.Distiller(expert, fac.Replay(out / "replay.npz"),
                              fac.DistillConfig(steps=steps, expert_episodes=16), mlp_dim=32)
    around = fac.PlannerConfig(**fac.STUDENT_PLANNING)
    distiller.add(*fac.expert_episodes(distiller, None, around, environment=robot))
    list(distiller.run())  # each step's losses
    taught = fac.teach_priors(distiller, None, around, environment=robot)
    around, _ = fac.choose_by_playing(distiller, None, taught, [
        fac.dataclasses.replace(around, **search) for search in fac.SEARCHES], environment=robot)
    distiller.close()
    for kind, model, plan in (("expert", expert, planning), ("student", distiller.student, around)):
        fac.save_model(out / f"{kind}.npz", model, {"kind": kind, "planner": vars(plan)})
        returns = fac.play(model, None, plan, range(90, 96), environment=robot)[2].sum(1)
        print(f"{kind}: {returns.mean():.0f}")


if __name__ == "__main__":
    main()
