"""The selection loop turned inside out, for a robot: observe → decide."""

from mevs_jax.agent.agent import Agent
from mevs_jax.agent.records import Belief, History, Step, load_history, replay

__all__ = ["Agent", "Belief", "History", "Step", "load_history", "replay"]
