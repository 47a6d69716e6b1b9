# %% [markdown]
# # The thesis's main table
#
# The thesis asks how much accuracy is gained by choosing views of high predicted depth entropy, compared with random views. Its
# Tables 7 and 12 give this gain for every *confidence threshold* (CT, when a walk stops) and every *limit on views* (MV).
#
# This notebook computes the same table in seconds, for the system `furniture10` that comes with the package and for a few
# pieces of furniture that no network was trained on. The table for ModelNet10 takes `mevs study thesis` forty minutes; its
# results are in [The thesis](../../docs/thesis.md).

# %%
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import eval.thesis
import mevs_jax
from data_pipeline.objects.furniture import furniture
from eval.walks.grid import THRESHOLDS, run_grid
from mevs_jax.agent.looking import unit_triangles
from mevs_jax.policies import policy_record
from mevs_jax.rendering.depth import pad_triangles, render_depth

system = mevs_jax.load("furniture10")
camera, poses = system.description.camera, jnp.asarray(system.poses)

# %% [markdown]
# ## View tables of sixty objects
#
# What the classifier and PointNet++ say of every view, and the true depth entropies.


# %%
@jax.jit
def observe_all(triangles):
    """What the networks say of every view of an object, and its true depth entropies."""
    depth = jax.vmap(lambda pose: render_depth(triangles, camera.at(pose)).depth)(poses)
    depth = jnp.where(jnp.isfinite(depth), depth, 0.0)
    return jax.vmap(system.observe)(depth, poses), jax.vmap(mevs_jax.depth_entropy)(depth)


found, labels = [], []
for label, name in enumerate(system.classes):
    for seed in range(900, 906):
        piece = furniture(name, seed)
        found.append(observe_all(pad_triangles(unit_triangles(piece.vertices, piece.faces))))
        labels.append(label)
observations, entropy = jax.tree.map(lambda *each: jnp.stack(each), *found)

# %% [markdown]
# ## Can entropies be predicted from one view?
#
# Each row of PointNet++'s output predicts the entropies of all forty views from the cloud of one. The correlation with the true
# entropies, over the views of an object:

# %%
predicted = np.asarray(observations.predicted_entropy)  # (objects, seen view, predicted view)
correlation = [
    np.corrcoef(row, truth)[0, 1] for rows, truth in zip(predicted, np.asarray(entropy), strict=True) for row in rows
]
print(f"median correlation {np.median(correlation):.2f}, 5th percentile {np.percentile(correlation, 5):.2f}")
figure, axis = plt.subplots(figsize=(6, 2.6), layout="constrained")
axis.plot(entropy[0], color="#1b2a41", label="true")
axis.plot(
    predicted[0, 0] / predicted[0, 0].mean() * float(entropy[0].mean()),
    color="#c1440e",
    label="predicted from view 0, scaled",
)
axis.set(xlabel="view", ylabel="depth entropy, bits", title=f"one object: {system.classes[labels[0]]}")
axis.legend(fontsize=8)

# %% [markdown]
# ## The grid
#
# `run_grid` walks every object from every start view, once for each policy. The views that a walk visits depend on neither CT
# nor MV. So the whole grid is read from these walks, and all cells are paired.

# %%
tables = mevs_jax.ViewTable(observations.logits[:, None], observations.predicted_entropy, entropy, jnp.array(labels))
policies = [policy_record(name) for name in ("random", "predicted_entropy", "information_gain", "oracle_entropy")]
knowledge = jax.tree.map(lambda array: array[None], system.parts.knowledge)
results = run_grid(jax.random.key(0), tables, system.graph, knowledge, policies, max_views=9, draws=32)
right = {name: 100 * np.asarray(result.right[0]) for name, result in results.items()}  # (objects, MV, CT)


# %%
def gain(name):
    """Accuracy of a policy less that of random views, in points, by MV and CT."""
    return (right[name] - right["random"]).mean(axis=0)


print("Gain of predicted entropy over random views, points")
print("        " + "".join(f"CT {threshold:<6}" for threshold in THRESHOLDS))
for views, row in enumerate(gain("predicted_entropy"), 2):
    print(f"MV {views}   " + "".join(f"{value:+8.2f} " for value in row))

# %% [markdown]
# The mean over all 56 cells, with a 95 % bootstrap interval over objects:

# %%
for name in ("predicted_entropy", "oracle_entropy", "information_gain"):
    by_object = (right[name] - right["random"]).mean(axis=(1, 2))
    low, high = mevs_jax.bootstrap_interval(jax.random.key(1), by_object)
    print(
        f"{name:18s} {by_object.mean():+.2f} [{low:+.2f}, {high:+.2f}], {int((gain(name) > 0).sum())} of 56 cells above zero"
    )

# %% [markdown]
# ## Beside the thesis's own numbers
#
# Left, the thesis's Table 12 (ModelNet10, 40 views). In the middle and on the right, the same grid for the furniture here.

# %%
stored = json.loads((Path(eval.thesis.__file__).parent / "numbers.json").read_text())
thesis = np.array([stored["table_12"][str(views)] for views in range(2, 10)])
figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained", sharey=True)
panels = (("the thesis: predicted entropy", thesis), ("here: predicted entropy", gain("predicted_entropy")))
for axis, (title, values) in zip(axes, (*panels, ("here: information gain", gain("information_gain"))), strict=True):
    image = axis.imshow(values, cmap="RdBu", vmin=-4, vmax=4, aspect="auto")
    axis.set(
        title=title, xlabel="CT", xticks=range(7), xticklabels=THRESHOLDS, yticks=range(8), yticklabels=range(2, 10)
    )
axes[0].set_ylabel("MV")
figure.colorbar(image, ax=axes, label="points above random")

# %% [markdown]
# Sixty procedural objects say little about other objects. On ModelNet10, with 901 test objects, the mean gain of predicted
# entropy is −0.62 points [−1.04, −0.17] with 40 views and −0.17 [−0.50, +0.17] with 10: **choosing views by depth entropy does
# not help recognition** ([The thesis](../../docs/thesis.md)). Expected information gain does
# ([Policies: results](../../docs/results.md)).
