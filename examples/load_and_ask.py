"""A trained system, asked about a mesh: `python examples/load_and_ask.py [MESH] [SYSTEM]`.

MESH is a file (default: a piece of the built-in furniture). SYSTEM is the folder of a run or of an exported system, or a name
(default: furniture10, which comes with the package).
"""

from __future__ import annotations

import sys

import mevs_jax
from data_pipeline.objects.furniture import furniture

piece = furniture("desk", 900)  # which no system was trained on
mesh = mevs_jax.read_mesh(sys.argv[1]) if len(sys.argv) > 1 else (piece.vertices, piece.faces)

system = mevs_jax.load(sys.argv[2] if len(sys.argv) > 2 else "furniture10")
walk = mevs_jax.look(system, *mesh, stop=0.95)
print(walk)  # the class and its probability after each view, and why it ended
