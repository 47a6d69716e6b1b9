# %% [markdown]
# # Write and evaluate a policy
#
# A policy is a function that scores the candidate views. This notebook writes one, and compares it with others on furniture
# that no network was trained on, from every start view. It uses the system `furniture10`, which comes with the package.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mevs_jax
from data_pipeline.objects.furniture import furniture
from mevs_jax.agent.looking import unit_triangles
from mevs_jax.rendering.depth import pad_triangles, render_depth

system = mevs_jax.load("furniture10")
camera, poses = system.description.camera, jnp.asarray(system.poses)

# %% [markdown]
# ## View tables
#
# The networks see every view of every object once. Their outputs are a *view table*; after that, no network is needed.
# Fifty objects, five of each class, and forty views of each.


# %%
@jax.jit
def observe_all(triangles):
    """Depth of an object from every candidate view, and what the networks say of it."""
    depth = jax.vmap(lambda pose: render_depth(triangles, camera.at(pose)).depth)(poses)
    depth = jnp.where(jnp.isfinite(depth), depth, 0.0)
    return depth, jax.vmap(system.observe)(depth, poses)


observed, classes = [], []
for label, name in enumerate(system.classes):
    for seed in range(900, 905):
        piece = furniture(name, seed)
        observed.append(observe_all(pad_triangles(unit_triangles(piece.vertices, piece.faces)))[1])
        classes.append(label)
observations = jax.tree.map(lambda *each: jnp.stack(each), *observed)
labels = jnp.array(classes)
print("logits:", observations.logits.shape, "(objects, views, classes)")

# %%
right = observations.logits.argmax(axis=-1) == labels[:, None]
print(f"single views recognised: {100 * right.mean():.1f} %")
figure, axis = plt.subplots(figsize=(6, 2.6), layout="constrained")
axis.bar(range(40), np.asarray(right.mean(axis=0)), color="#6b7785")
axis.set(xlabel="view", ylabel="share recognised", title="some views are more informative than others")

# %% [markdown]
# ## A policy
#
# Arguments are a PRNG key, the state of the walk and the scene. The result is a score for every view. The loop hides views
# that were seen, and takes the highest score.
#
# This policy asks: which view separates the two likeliest classes best? `scene.knowledge.expected_logits[y, j]` holds the mean
# logits of validation objects of class y at view j. `knows="others"` declares that the policy uses it.


# %%
@mevs_jax.register_policy("two_likeliest", title="separates the two likeliest classes", knows="others")
def two_likeliest(key, state, scene):
    first, second = jnp.argsort(-state.belief)[:2]
    expected = scene.knowledge.expected_logits
    margin = expected[:, :, first] - expected[:, :, second]  # of each class, at each view
    return margin[first] - margin[second]


# %% [markdown]
# ## Evaluation
#
# One walk is written for one object, one start view and one draw. `vmap` adds these axes. All policies share objects, start
# views and logits, so their differences are paired.


# %%
def walks_of(policy, draws=1, max_views=4):
    """Whether the prediction after 1, 2, … views is right: (objects, views), mean over start views and draws."""

    def walk(key, logits, entropies, label, start):
        table = mevs_jax.ViewTable(logits, entropies, None, label)
        scene = table.scene(system.graph, system.parts.knowledge)
        episode = mevs_jax.select_from_table(key, table, scene, policy, start, max_views=max_views)
        return episode.predictions == label

    over_starts = jax.vmap(walk, (None, None, None, None, 0))
    over_draws = jax.vmap(over_starts, (0, None, None, None, None))
    over_objects = jax.jit(jax.vmap(over_draws, (None, 0, 0, 0, None)))
    keys = jax.random.split(jax.random.key(0), draws)
    found = over_objects(keys, observations.logits, observations.predicted_entropy, labels, jnp.arange(40))
    return found.mean(axis=(1, 2))


names = ("random", "farthest", "predicted_entropy", "fixed_order", "information_gain", "two_likeliest")
results = {name: walks_of(mevs_jax.POLICIES[name], draws=16 if name == "random" else 1) for name in names}

# %% [markdown]
# Accuracy in %, and the difference from random in points with a 95 % bootstrap interval over objects:

# %%
print(f"{'policy':18s} {'1 view':>7s} {'2 views':>8s} {'3':>6s} {'4':>6s}   two views, less random")
for name, found in results.items():
    low, high = 100 * mevs_jax.bootstrap_interval(jax.random.key(1), (found - results["random"])[:, 1])
    difference = 100 * (found - results["random"])[:, 1].mean()
    cells = " ".join(f"{100 * share:6.1f}" for share in found.mean(axis=0))
    print(f"{name:18s} {cells}   {difference:+.1f} [{low:+.1f}, {high:+.1f}]")

# %%
figure, axis = plt.subplots(figsize=(6, 3.6), layout="constrained")
shades = ("#6b7785", "#9aa5b1", "#1b2a41", "#7a9e9f", "#e0a458", "#c1440e")
for (name, found), shade, line in zip(results.items(), shades, ("-", ":", "-.", "--", "--", "-"), strict=True):
    width = 3 if name == "two_likeliest" else 1.6
    axis.plot(range(1, 5), 100 * found.mean(axis=0), marker="o", ls=line, lw=width, color=shade, label=name)
axis.set(xlabel="views", ylabel="accuracy, %", xticks=range(1, 5), title="50 objects, every start view")
axis.grid(axis="y", alpha=0.3)
axis.legend(fontsize=8)

# %% [markdown]
# ## Next steps
#
# * On a run of your own, `mevs eval --policy FILE.py:two_likeliest --out RUN` adds the policy to its metrics and its report, with
#   intervals at every number of views. From Python: `eval.numbers.policies.evaluate_policies`.
# * [Own policy, encoder, viewpoints](../../docs/own.md) has the rules: what scores mean, and what a policy may use.
# * [Policies](../../docs/policies.md) describes those that exist.
