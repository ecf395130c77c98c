"""Robots for test_gym.py, registered as a user's own are: gym:gym_toys:Walk-v0."""
import atexit
import ctypes
import os
import tempfile

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete


class Walk(gymnasium.Env):
    """Falls after 2 to 9 steps, by its seed; 12 are the time limit. It keeps what it was told."""

    observation_space = Box(-np.inf, np.inf, (3,), np.float64)
    action_space = Box(np.float32([-2, 0]), np.float32([2, 10]))

    def __init__(self, falls=True):
        self.falls, self.told = falls, []

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.left = self.np_random.integers(2, 10) if self.falls else 99
        self.state = np.array([0.0, self.left / 10, 0.0])
        return self.state, {}

    def step(self, action):
        self.told.append(action.copy())
        self.left -= 1
        self.state += [0.1, -0.1, 0]  # in place
        self.state[2] = action[0]
        action *= 0
        return self.state, 1.0, bool(self.left == 0), False, {}


class Told(Walk):
    """With spaces that an option names."""

    def __init__(self, **spaces):
        super().__init__()
        for name, space in spaces.items():
            setattr(self, f"{name}_space", space)


class Port(Walk):
    """One at a time holds what it needs."""

    taken = False

    def __init__(self):
        super().__init__()
        if Port.taken:
            raise OSError("port is in use")
        Port.taken = True

    def close(self):
        Port.taken = False


class Stuck(Walk):
    """Whose end raises."""

    def close(self):
        raise RuntimeError("motor off failed")


class Elsewhere(Walk):
    """Reads its meshes below a folder of its own, to which it goes, and is loud: in Python without
    a line's end, in C and as its process ends."""

    def __init__(self):
        super().__init__()
        self.home = tempfile.TemporaryDirectory()
        os.chdir(self.home.name)
        open("arm.obj", "w").close()
        self.folder = os.getcwd()
        atexit.register(print, "simulator closed")

    def reset(self, seed=None, options=None):
        os.stat("arm.obj")
        return super().reset(seed=seed)

    def step(self, action):
        ctypes.CDLL(None).printf(b"contact\n")
        print(".", end="")
        return super().step(action)


class Hot(Walk):
    """Raises in its third decision of an episode."""

    def step(self, action):
        if len(self.told) == 3:  # the first was asked as it was made
            raise RuntimeError("motor 3 overheated")
        return super().step(action)


class Older(Walk):
    """Of an older Gym's signatures, or without a reward, as an option says."""

    def __init__(self, odd):
        super().__init__()
        self.odd = odd

    def reset(self, *, options=None, **seed):
        if self.odd == "seed" and seed:
            raise TypeError("reset() got an unexpected keyword argument 'seed'")
        obs, info = super().reset(**seed)
        return obs if self.odd == "reset" else (obs, info)

    def step(self, action):
        obs, _, *ends = super().step(action)
        return (obs, 1.0, *ends[1:]) if self.odd == "step" else (obs, None, *ends)


SPACES = {
    "Discrete": {"action": Discrete(3)}, "Dict": {"observation": Dict({"a": Box(0, 1, (2,))})},
    "Image": {"observation": Box(0, 255, (8, 8, 3), np.uint8)},
    "Unbounded": {"action": Box(-np.inf, np.inf, (2,))}, "Whole": {"action": Box(0, 9, (2,), int)},
    "Empty": {"action": Box(-1, 1, (0,))}}

if "Walk-v0" not in gymnasium.registry:
    gymnasium.register("Walk-v0", Walk, max_episode_steps=12)
    gymnasium.register("Stroll-v0", Walk, max_episode_steps=12, kwargs={"falls": False})
    gymnasium.register("Endless-v0", Walk, kwargs={"falls": False})
    gymnasium.register("Port-v0", Port, max_episode_steps=12)
    gymnasium.register("Stuck-v0", Stuck, max_episode_steps=12)
    gymnasium.register("Elsewhere-v0", Elsewhere, max_episode_steps=12)
    gymnasium.register("Hot-v0", Hot, max_episode_steps=12, kwargs={"falls": False})
    for odd in ("seed", "reset", "step", "reward"):
        gymnasium.register(f"Older-{odd}-v0", Older, max_episode_steps=12, kwargs={"odd": odd})
    for name, spaces in SPACES.items():
        gymnasium.register(f"{name}-v0", Told, max_episode_steps=12, kwargs=spaces)
