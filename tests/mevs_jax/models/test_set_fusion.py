"""Fusion of the features of a set of views, against a plain formula."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mevs_jax.models.set_fusion import SetFusion, SumFusion, relative_to_first

VIEWS, FEATURES, CLASSES = 5, 12, 3


@pytest.fixture(scope="module")
def network() -> SetFusion:
    made = SetFusion(FEATURES, CLASSES, width=16, heads=4, blocks=2, dropout=0.5, rngs=nnx.Rngs(0))
    # Biases and scales begin as zeros and ones, which would hide mistakes.
    state = nnx.state(made, nnx.Param)
    leaves, tree = jax.tree.flatten(state)
    keys = jax.random.split(jax.random.key(5), len(leaves))
    moved = [leaf + 0.3 * jax.random.normal(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)]
    nnx.update(made, jax.tree.unflatten(tree, moved))
    return made


@pytest.fixture(scope="module")
def seen() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    directions = random.normal(size=(VIEWS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    present = np.array([True, False, True, True, False])
    return random.normal(size=(VIEWS, FEATURES)).astype(np.float32), directions.astype(np.float32), present


def plain(network: SetFusion, features: np.ndarray, directions: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Token by token, head by head."""
    value = lambda parameter: np.asarray(parameter[...], np.float64)  # noqa: E731

    def norm(layer, x):
        return (x - x.mean()) / np.sqrt(x.var() + 1e-6) * value(layer.scale) + value(layer.bias)

    def linear(layer, x):
        return x @ value(layer.kernel) + value(layer.bias)

    tokens = [value(network.object)]
    for view in np.flatnonzero(present):
        known = norm(network.norm, features[view].astype(np.float64))
        tokens.append(linear(network.view, known) + linear(network.direction, directions[view]))
    for block in network.blocks:
        normed = [norm(block.norm1, token) for token in tokens]
        attention, after = block.attention, []
        for at, token in enumerate(tokens):
            out = value(attention.out.bias).copy()
            for head in range(attention.num_heads):
                query, key, content = (
                    [one @ value(part.kernel)[:, head] + value(part.bias)[head] for one in normed]
                    for part in (attention.query, attention.key, attention.value)
                )
                scores = np.array([query[at] @ other for other in key]) / np.sqrt(len(query[at]))
                weights = np.exp(scores - scores.max())
                mixed = sum(w * c for w, c in zip(weights / weights.sum(), content, strict=True))
                out += mixed @ value(attention.out.kernel)[head]
            after.append(token + out)
        tokens = []
        for token in after:
            hidden = linear(block.layer1, norm(block.norm2, token))
            smooth = 0.5 * hidden * (1 + np.tanh(np.sqrt(2 / np.pi) * (hidden + 0.044715 * hidden**3)))
            tokens.append(token + linear(block.layer2, smooth))
    return linear(network.head, norm(network.last_norm, tokens[0]))


@nnx.jit
def fused(network: SetFusion, *arguments: np.ndarray) -> jax.Array:
    return network(*arguments)


def test_it_is_the_plain_formula(network, seen):
    np.testing.assert_allclose(fused(network, *seen), plain(network, *seen), atol=2e-5)


def test_order_and_padding_do_not_matter_and_no_view_is_a_belief_too(network, seen):
    features, directions, present = seen
    belief = fused(network, features, directions, present)
    order = np.array([3, 1, 4, 0, 2])
    np.testing.assert_allclose(fused(network, features[order], directions[order], present[order]), belief, atol=1e-5)
    junk = np.where(present[:, None], features, np.nan).astype(np.float32)
    nowhere = np.where(present[:, None], directions, np.nan).astype(np.float32)
    np.testing.assert_allclose(fused(network, junk, nowhere, present), belief, atol=1e-6)
    some = np.flatnonzero(present)
    alone = fused(network, features[some], directions[some], present[some])
    np.testing.assert_allclose(alone, belief, atol=1e-5)
    nothing = np.zeros(VIEWS, bool)
    assert np.isfinite(fused(network, features, directions, nothing)).all()
    both = fused(network, *(np.stack([array, array]) for array in (features, directions)), np.stack([present, nothing]))
    np.testing.assert_allclose(both[0], belief, atol=1e-5)


def test_directions_are_told_from_the_first_view_on():
    directions = np.array([[0, 0, 1], [0, 0.6, 0.8], [0.8, 0, -0.6], [-1, 0, 0]], np.float32)
    found, turn = relative_to_first(directions, np.array([False, True, False, True]))
    np.testing.assert_allclose(found, [[0, 0, 1], [0.6, 0, 0.8], [0, -0.8, -0.6], [0, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(directions @ np.asarray(turn).T, found, atol=1e-6)
    for present in (
        np.array([True, False, False, False]),
        np.zeros(4, bool),
    ):  # from straight above there is no azimuth
        np.testing.assert_allclose(relative_to_first(directions, present)[0], directions, atol=1e-6)


def test_without_a_pose_objects_may_face_any_way(network, seen):
    features, directions, present = seen
    blind = nnx.jit(partial(SetFusion.__call__, posed=False))
    belief = blind(network, features, directions, present)
    nowhere = np.where(present[:, None], directions, np.nan).astype(np.float32)
    np.testing.assert_allclose(blind(network, features, nowhere, present), belief, atol=1e-6)
    angle = 2.1
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]], np.float32)
    np.testing.assert_allclose(blind(network, features, directions @ turn.T, present), belief, atol=1e-5)
    assert np.abs(fused(network, features, directions @ turn.T, present) - fused(network, *seen)).max() > 1e-3
    order = np.array([0, 3, 4, 2, 1])  # the first stays the first
    np.testing.assert_allclose(blind(network, features[order], directions[order], present[order]), belief, atol=1e-5)
    relative = np.asarray(relative_to_first(directions, present)[0])
    like = nnx.clone(network)
    like.object[...] = network.unposed[...]
    np.testing.assert_allclose(belief, plain(like, features, relative, present), atol=2e-5)


def test_the_sum_in_its_place_adds_logits_and_counts_the_prior_once(seen):
    features, directions, present = seen
    head, prior = nnx.Linear(FEATURES, CLASSES, rngs=nnx.Rngs(2)), jnp.asarray([-0.5, -1.5, -1.7])
    logits = np.asarray(head(features)) - np.asarray(prior)
    padded = np.where(present[:, None], features, np.nan)
    found = SumFusion(head, prior)(padded, directions, present, posed=False)
    np.testing.assert_allclose(found, logits[present].sum(axis=0) + prior, atol=1e-5)


def test_a_vertical_first_view_does_not_tell_which_way_an_object_faces():
    """The first view with an azimuth does, also if vertical views come before it."""
    directions = np.array([[0, 0, 1], [0, 0, -1], [0, 0.6, 0.8], [0.8, 0, -0.6]], np.float32)
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]], np.float32)
    for present in ([True, True, True, True], [True, False, False, True], [False, True, True, False]):
        present = np.array(present)
        found, rotation = relative_to_first(directions, present)
        turned, _ = relative_to_first(directions @ turn.T, present)
        np.testing.assert_allclose(found, turned, atol=1e-6)
        first = np.flatnonzero(present & np.array([False, False, True, True]))[0]
        assert abs(float(found[first, 1])) < 1e-6 < float(found[first, 0])
        np.testing.assert_allclose(directions @ np.asarray(rotation).T, found, atol=1e-6)
