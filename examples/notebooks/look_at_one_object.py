# %% [markdown]
# # Look at one object
#
# A trained system looks at a piece of furniture that it has never seen. It chooses its views, and says after each what it
# believes. The system `furniture10` comes with the package. Nothing is trained here.

# %%
from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np

import mevs_jax
from data_pipeline.objects.furniture import furniture

system = mevs_jax.load("furniture10")
side = system.description.camera.resolution
print(f"{len(system.classes)} classes: {', '.join(system.classes)}")
print(f"{len(system.viewpoints)} candidate views, depth images of {side}×{side} pixels")

# %% [markdown]
# ## A walk
#
# `look` renders the mesh where the agent wants to see it. The agent stops as soon as its calibrated probability reaches
# `stop`. For a mesh of your own: `read_mesh("chair.obj")` from `data_pipeline.objects.recipes`.

# %%
table = furniture("table", 900)
walk = mevs_jax.look(system, table.vertices, table.faces, policy="information_gain", stop=0.95)
print(walk)

# %% [markdown]
# The depth image of each view (bright is near), and the probabilities of the classes after it.

# %%
figure, axes = plt.subplots(
    2, len(walk.views), figsize=(3.2 * len(walk.views), 4.6), layout="constrained", squeeze=False
)
likely = np.argsort(-np.max([belief.probabilities for belief in walk.beliefs], axis=0))[:4]
for column, (depth, belief) in enumerate(zip(walk.history.depths, walk.beliefs, strict=True)):
    axes[0, column].imshow(np.where(depth > 0, depth, np.nan), cmap="cividis_r")
    axes[0, column].set_axis_off()
    axes[0, column].set_title(f"view {walk.views[column]}")
    colours = ["#c1440e" if label == belief.label else "#c9d1da" for label in likely]
    axes[1, column].barh([system.classes[label] for label in likely], belief.probabilities[likely], color=colours)
    axes[1, column].invert_yaxis()
    axes[1, column].set(xlim=(0, 1), xlabel="probability")

# %% [markdown]
# ## What the agent expects of every view
#
# An agent is the same loop for a robot: `observe_view` takes an image, `decide` returns the next pose. After the first view,
# we ask it for each candidate view how much it would gain, in nats (*expected information gain*). The view that it has seen
# already cannot be chosen again, and has no gain (NaN).

# %%
agent = system.agent(policy="information_gain", stop=0.95)
agent.reset(center=(0, 0, 0), radius=1.0, yaw=0.0)
belief = agent.observe_view(walk.history.depths[0], walk.history.poses[0])
gains = np.array([agent.decide(reachable=[view]).expected_gain for view in range(len(system.viewpoints))])
print(f"after the first view: {belief.name}, {100 * belief.confidence:.0f} %")
print(f"expected gain: {np.nanmin(gains):.3f} to {np.nanmax(gains):.3f} nats; the best is view {np.nanargmax(gains)}")

# %%
figure = plt.figure(figsize=(6.4, 4.8), layout="constrained")
space = figure.add_subplot(projection="3d", computed_zorder=False)
corners = table.vertices - (table.vertices.min(axis=0) + table.vertices.max(axis=0)) / 2
corners = 0.6 * corners / np.linalg.norm(corners, axis=1).max()
space.plot_trisurf(*corners.T, triangles=table.faces, color="#e8ddcf", edgecolor="#8a7b66", linewidth=0.1)
points = space.scatter(*system.viewpoints.T, c=gains, cmap="Oranges", s=45, edgecolor="grey", depthshade=False)
for start, end in pairwise(system.viewpoints[list(walk.views)]):
    share = np.linspace(0, 1, 30)[:, None]
    way = (1 - share) * start + share * end
    space.plot(*(way / np.linalg.norm(way, axis=1, keepdims=True)).T, color="#c1440e")
space.scatter(*system.viewpoints[list(walk.views)].T, s=190, color="#c1440e", depthshade=False)
for number, view in enumerate(walk.views, 1):
    space.text(*system.viewpoints[view], f"{number}", color="white", weight="bold", ha="center", va="center")
space.set_box_aspect((1, 1, 1), zoom=1.45)
space.set_axis_off()
space.set_title("candidate cameras and the walk")
figure.colorbar(points, ax=space, shrink=0.6, label="expected gain after view 1, nats")

# %% [markdown]
# ## More objects
#
# One object proves nothing. Here are forty pieces of furniture, four of each class, with at most three views each. Choosing
# by expected information gain, by random draws, and by the thesis's predicted depth entropy.

# %%
pieces = [(name, furniture(name, seed)) for name in system.classes for seed in range(900, 904)]
for policy in ("random", "predicted_entropy", "information_gain"):
    right = np.zeros(3)
    for name, piece in pieces:
        beliefs = mevs_jax.look(system, piece.vertices, piece.faces, policy=policy, stop=2.0, max_views=3).beliefs
        right += [belief.name == name for belief in beliefs]
    print(
        f"{policy:18s} right after 1, 2, 3 views: " + ", ".join(f"{100 * share:.0f} %" for share in right / len(pieces))
    )

# %% [markdown]
# The first view is the same for all three policies. Forty objects are too few to compare policies: one object is 2.5 points.
# Measured comparisons with intervals are in [Policies: results](../../docs/results.md). The next notebook,
# [Write and evaluate a policy](write_a_policy.ipynb), evaluates a policy from every start view.
