"""The selection loop turned inside out, for a robot: observe → decide."""

from mevs_jax.agent.agent import Agent
from mevs_jax.agent.looking import Frames, Walk, look, look_at_frames, look_at_views, replay
from mevs_jax.agent.records import Belief, History, Step, load_history
from mevs_jax.agent.scene import SceneAgent

__all__ = [
    "Agent",
    "Belief",
    "Frames",
    "History",
    "SceneAgent",
    "Step",
    "Walk",
    "load_history",
    "look",
    "look_at_frames",
    "look_at_views",
    "replay",
]
