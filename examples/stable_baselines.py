"""PPO of Stable-Baselines3 learns to choose views: `python examples/stable_baselines.py [RUN [STEPS]]`.

It needs `pip install stable-baselines3`. RUN is a folder in which `mevs run` has been run (default: runs/demo). The policy learns
on the validation objects of the run, which its networks were not trained on, and is compared with random views on test objects.
"""

from __future__ import annotations

import sys

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from mevs_jax import ActiveRecognition
from mevs_jax.gymnasium import ViewSelectionEnv

STARTS = 4

run = sys.argv[1] if len(sys.argv) > 1 else "runs/demo"
steps = int(sys.argv[2]) if len(sys.argv) > 2 else 100_000
learning, tested = (ActiveRecognition.from_run(run, split) for split in ("val", "test"))
envs = make_vec_env(lambda: ViewSelectionEnv(learning), n_envs=8, seed=0)
agent = PPO("MultiInputPolicy", envs, n_steps=250, batch_size=500, gamma=0.9, seed=0, device="cpu").learn(steps)

env, random = ViewSelectionEnv(tested), np.random.default_rng(0)
for name in ("random", "PPO"):
    right = np.zeros(tested.max_views)
    for walk in range(tested.objects * STARTS):
        options = {"object_index": walk // STARTS, "start": walk % STARTS * tested.views // STARTS}
        seen = env.reset(options=options)[0]
        for step in range(tested.max_views):
            unseen = np.flatnonzero(seen["attempted"] == 0)
            view = random.choice(unseen) if name == "random" else int(agent.predict(seen, deterministic=True)[0])
            seen, *_, info = env.step(view)
            right[step] += info["right"]
    print(f"{name:8}", *(f"{share:.1%}" for share in right / (tested.objects * STARTS)))
