"""Gymnasium's robots: a task gym:ID, such as gym:Pendulum-v1 or gym:Reacher-v5.

    python data/train_expert.py --task gym:Pendulum-v1 --steps 8000 --seed-decisions 800 \\
        --std-steps 4000 --latent-dim 16 --enc-dim 64 --mlp-dim 128
    python fac_tdmpc_ref.py distill --task gym:Pendulum-v1 --expert runs/train-gym:Pendulum-v1-0

gym:MODULE:ID imports MODULE, from your PYTHONPATH, which registers a robot of your own.
fac_tdmpc_ref.make_robot makes one of these, wherever a task is played; it needs `pip install
'fac-tdmpc-ref[gym]'`.
"""
import os
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np

MOST_STEPS = 1000  # of an episode that has no limit of its own


def flat(space, what):
    """A space, if it is a Box of rank 1; else ValueError."""
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1 or not space.shape[0]:
        found = " ".join(str(space).split())[:100]
        raise ValueError(f"{what}: expected a flat Box, found {found}; register a robot that has "
                         f"one, by gymnasium.wrappers, and pass gym:MODULE:ID")
    return space


class GymRobot:
    """A robot as `fac_tdmpc_ref.robot_step` takes one: actions (A,) in [-1, 1], which are scaled to
    its own bounds and applied `action_repeat` times, observations (O,), and at most `episode_steps`
    decisions an episode. ValueError: Gymnasium can't make it, or its spaces are others."""

    _folder = "."  # which a robot may change, to find its meshes

    def _ask(self, function, *values, **options):
        """What a robot's function returns, in its own folder: below ours are a user's files."""
        ours = os.getcwd()
        os.chdir(self._folder)
        try:
            return function(*values, **options)
        finally:
            self._folder = os.getcwd()
            os.chdir(ours)

    def __init__(self, name, action_repeat=1):
        file, here = f"{name.rpartition(':')[0]}.py", Path(__file__).resolve().parent
        ours = [path for path in (here / file, here / "data" / file) if path.exists()]
        for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep):
            for path in ours if Path(folder, file).exists() else ():
                if not path.samefile(Path(folder, file)):
                    raise ValueError(f"{path} may be imported instead; give your module another "
                                     "name")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that there is a newer version of the ID
            try:
                self.env = self._ask(gymnasium.make, name, disable_env_checker=True)
            except (Exception, SystemExit) as error:  # a constructor, or a script, can raise any
                raise ValueError(" ".join(str(error).split())[:300] or repr(error)) from None
        steps = self.env.spec.max_episode_steps
        if steps is None:
            steps = MOST_STEPS
            self.env = gymnasium.wrappers.TimeLimit(self.env, steps)
        self.action_repeat, self.episode_steps = action_repeat, -(-steps // action_repeat)
        self.dim_obs = flat(getattr(self.env, "observation_space", None), "observations").shape[0]
        self._space = flat(getattr(self.env, "action_space", None), "actions")
        if not (self._space.is_bounded() and self._space.dtype.kind == "f"):
            raise ValueError("actions: expected floats with finite bounds, to which [-1, 1] is "
                             "scaled; gymnasium.wrappers.RescaleAction gives some")
        self.dim_action = self._space.shape[0]
        self.bounds = self._space.low.astype(float), self._space.high.astype(float)
        try:  # an older Gym's robots have other signatures
            self.reset(0)
            self.step(np.zeros(self.dim_action))
        except Exception as error:
            raise ValueError(f"its first step: {' '.join(repr(error).split())[:300]}; expected "
                             "Gymnasium's reset(seed=..., options=...) -> (observation, info) and "
                             "step(action) -> five values, of which the reward is a number"
                             ) from None

    def reset(self, seed):
        """Start the episode that the integer `seed` stands for; returns (dim O,)."""
        obs, _ = self._ask(self.env.reset, seed=int(seed))
        return obs

    def step(self, action):
        """Apply action (dim A,); returns next observation, the sum of the rewards, whether the
        state ended the episode (terminated), and whether the time did (truncated)."""
        low, high = self.bounds
        control = np.clip(low + (high - low) * (np.asarray(action, float) + 1) / 2, low, high)
        total, terminated, truncated = 0.0, False, False
        for _ in range(self.action_repeat):
            obs, reward, terminated, truncated, _ = self._ask(
                self.env.step, control.astype(self._space.dtype))
            total += reward
            if terminated or truncated:
                break
        return obs, total, terminated, truncated

    def close(self):
        """Let go of what the robot holds; what that raises is said, and costs nothing else."""
        try:
            self._ask(self.env.close)
        except Exception as error:
            print(f"{self.env.spec.id}: close: {error!r}", file=sys.stderr)
