"""The view policy: what it may depend on, labels of exact value, the loop with a learned fusion, and that learning pays."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from eval.learned.stopping import Signal, beside
from eval.learned.study import fixed_order_scores, novel_classes, seeds_together, study
from eval.learned.walks import Learner, OnLattice
from eval.numbers.confidence import stops_at
from mevs_jax import ViewGraph, ViewTable, fibonacci_sphere
from mevs_jax.beliefs import CalibratedFusion
from mevs_jax.models import ViewPolicy
from mevs_jax.models.set_fusion import SetFusion
from mevs_jax.models.view_policy import direction_features, expected_gain, utility_of
from mevs_jax.policies.base import Knowledge
from mevs_jax.policies.learned import learned, looking_ahead
from mevs_jax.policies.oracles import fused_oracle
from mevs_jax.policies.registry import POLICIES
from mevs_jax.policies.uninformed import random_view
from mevs_jax.selection import by_attention, select_from_table
from train.choosing.features import Features
from train.choosing.policy import (
    Choices,
    PolicyConfig,
    choices_along,
    graph_of,
    policy_loss,
    train_policy,
    unseen,
    walk,
)
from train.choosing.q_learning import QLearningConfig, temporal_difference, train_by_q_learning, transitions_along
from train.kept import trained_once

VIEWS, CLASSES, SEEN = 6, 4, 3


def moved(network, scale: float = 0.3):
    """Weights that begin as zeros or ones would hide mistakes."""
    leaves, tree = jax.tree.flatten(nnx.state(network, nnx.Param))
    keys = jax.random.split(jax.random.key(3), len(leaves))
    nnx.update(
        network,
        jax.tree.unflatten(
            tree, [leaf + scale * jax.random.normal(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)]
        ),
    )
    return network


def fusion_of(features: int, classes: int) -> CalibratedFusion:
    network = moved(SetFusion(features, classes, width=8, heads=2, blocks=1, dropout=0.0, rngs=nnx.Rngs(0)))
    structure, weights = nnx.split(network)
    return CalibratedFusion(
        structure, weights, jnp.linspace(-1, 0, classes), jnp.array([1.5, 1.2, 0.9]), jnp.float32(1.3)
    )


@pytest.fixture(scope="module")
def fusion() -> CalibratedFusion:
    return fusion_of(5, CLASSES)


@pytest.fixture(scope="module")
def policy() -> ViewPolicy:
    return moved(ViewPolicy(CLASSES, width=16, heads=2, blocks=2, rngs=nnx.Rngs(1)), 0.1)


def some_features(objects: int, seed: int = 0) -> Features:
    random = np.random.default_rng(seed)
    directions = np.stack([fibonacci_sphere(VIEWS)] * objects)
    return Features(
        jnp.asarray(random.normal(size=(objects, VIEWS, 5)), jnp.float32),
        jnp.asarray(random.normal(size=(objects, VIEWS, CLASSES)), jnp.float32),
        jnp.asarray(random.integers(0, CLASSES, objects), jnp.int32),
        jnp.asarray(directions, jnp.float32),
    )


@nnx.jit
def asked(policy: ViewPolicy, *arguments):
    return policy(*arguments)


def test_worth_depends_on_what_was_seen_not_on_its_order_nor_on_other_candidates(policy, random):
    belief = jax.nn.log_softmax(random.normal(size=CLASSES)).astype(np.float32)
    views = jax.nn.log_softmax(random.normal(size=(SEEN, CLASSES)), axis=-1)
    points = fibonacci_sphere(VIEWS).astype(np.float32)
    present = np.array([True, True, False])
    gain, gain_if = asked(policy, belief, views, points[:SEEN], present, points)
    assert gain.shape == (VIEWS,)
    assert gain_if.shape == (VIEWS, CLASSES)
    turned = asked(policy, belief, views[jnp.array([1, 0, 2])], points[[1, 0, 2]], present, points)
    np.testing.assert_allclose(turned[0], gain, atol=1e-5)
    junk = np.where(present[:, None], np.asarray(views), np.nan).astype(np.float32)
    np.testing.assert_allclose(asked(policy, belief, junk, points[:SEEN], present, points)[0], gain, atol=1e-5)
    alone = asked(policy, belief, views, points[:SEEN], present, points[[4, 2]])
    np.testing.assert_allclose(alone[0], gain[jnp.array([4, 2])], atol=1e-5)
    np.testing.assert_allclose(alone[1], gain_if[jnp.array([4, 2])], atol=1e-5)


def test_without_a_pose_worth_is_the_same_whichever_way_an_object_faces(random):
    policy = moved(ViewPolicy(CLASSES, width=16, heads=2, blocks=2, posed=False, rngs=nnx.Rngs(1)), 0.1)
    belief = jax.nn.log_softmax(random.normal(size=CLASSES)).astype(np.float32)
    views = jax.nn.log_softmax(random.normal(size=(SEEN, CLASSES)), axis=-1)
    points, present = fibonacci_sphere(VIEWS).astype(np.float32), np.array([True, True, False])
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]], np.float32)
    found = [asked(policy, belief, views, there[1 : 1 + SEEN], present, there) for there in (points, points @ turn.T)]
    np.testing.assert_allclose(*(gain for gain, _ in found), atol=1e-5)
    np.testing.assert_allclose(*(gain_if for _, gain_if in found), atol=1e-5)


def test_clouds_are_told_beside_their_views(random):
    policy = moved(ViewPolicy(CLASSES, width=16, heads=2, blocks=1, cloud=7, rngs=nnx.Rngs(1)), 0.1)
    belief = jax.nn.log_softmax(random.normal(size=CLASSES)).astype(np.float32)
    views = jax.nn.log_softmax(random.normal(size=(SEEN, CLASSES)), axis=-1)
    points, present = fibonacci_sphere(VIEWS).astype(np.float32), np.array([True, True, False])
    clouds = random.normal(size=(SEEN, 7)).astype(np.float32)
    known = policy, belief, views, points[:SEEN], present, points
    gain, _ = asked(*known, clouds)
    assert np.abs(gain - asked(*known, clouds[[1, 0, 2]])[0]).max() > 1e-4
    np.testing.assert_allclose(asked(*known, np.where(present[:, None], clouds, np.nan))[0], gain, atol=1e-6)
    with pytest.raises(ValueError, match="needs the embeddings of partial clouds"):
        asked(*known)
    data = replace(some_features(12), clouds=jnp.asarray(random.normal(size=(12, VIEWS, 7)), jnp.float32))
    config = PolicyConfig(width=16, heads=2, blocks=1, most_seen=2, rounds=1, epochs=1, batch_size=8)
    trained, _ = train_policy(config, [(fusion_of(5, CLASSES), data)], (fusion_of(5, CLASSES), data))
    assert trained.cloud is not None


@pytest.mark.parametrize("utility", ["probability", "log"])
def test_what_is_expected_for_a_class_leaves_its_probability_a_probability(random, utility):
    make = partial(ViewPolicy, CLASSES, width=16, heads=2, blocks=1, utility=utility, floor=0.01, rngs=nnx.Rngs(1))
    belief = np.log(np.array([1 - 2e-7, 1e-7, 1e-7, 0.0]) + 1e-30).astype(np.float32)
    views = jax.nn.log_softmax(random.normal(size=(SEEN, CLASSES)), axis=-1)
    points, present = fibonacci_sphere(VIEWS).astype(np.float32), np.array([True, True, False])
    known = views, points[:SEEN], present, points
    for gain in asked(make(), belief, *known):
        np.testing.assert_allclose(gain, 0, atol=1e-6)  # untrained, it expects nothing
    sure = moved(make(), 3.0)
    for held in (belief, np.log(np.array([0.4, 0.3, 0.2, 0.1], np.float32))):
        _, gain_if = asked(sure, held, *known)
        before = utility_of(np.clip(held, -12, -1e-5), utility)
        low, high = (0.0, 1.0) if utility == "probability" else (np.log(0.01), np.log(1.01))
        after = np.asarray(before + gain_if)
        assert (after >= low - 1e-5).all()
        assert (after <= high + 1e-5).all()
    assert after.max() - after.min() > 0.5


def test_the_loss_compares_candidates_with_each_other(policy, random):
    states, candidates = 7, 5
    belief = np.asarray(jax.nn.log_softmax(random.normal(size=(states, CLASSES)), axis=-1), np.float32)
    views = np.asarray(jax.nn.log_softmax(random.normal(size=(states, SEEN, CLASSES)), axis=-1), np.float32)
    points = random.normal(size=(states, SEEN + candidates, 3)).astype(np.float32)
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    gain, weight = random.normal(size=(states, candidates)).astype(np.float32), random.uniform(0.5, 2, states)
    label = random.integers(0, CLASSES, states)
    some = Choices(
        belief,
        views,
        points[:, :SEEN],
        np.ones((states, SEEN), bool),
        points[:, SEEN:],
        gain,
        label,
        weight.astype(np.float32),
    )
    found = nnx.jit(policy_loss, static_argnames="differences")(policy, some, differences=3.0)
    expected = {"gain": 0.0, "gain_if": 0.0, "differences": 0.0}
    for state in range(states):
        one = jax.tree.map(lambda leaf, state=state: leaf[state], some)
        as_it_is, gain_if = asked(policy, one.belief, one.views, one.directions, one.present, one.candidates)
        own, by_belief = np.asarray(gain_if)[:, label[state]], np.asarray(gain_if) @ np.exp(belief[state])
        share = weight[state] / weight.sum() / candidates
        for candidate in range(candidates):
            expected["gain"] += share * (as_it_is[candidate] - gain[state, candidate]) ** 2
            expected["gain_if"] += share * (own[candidate] - gain[state, candidate]) ** 2
            true = gain[state, candidate] - gain[state].mean()
            for said in (own, by_belief):
                expected["differences"] += 3 * share * (said[candidate] - said.mean() - true) ** 2
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert float(found[name]) == pytest.approx(float(value), rel=1e-4)


def test_a_policy_learned_otherwise_takes_the_place_of_the_one_before(tmp_path):
    def made(seed: int) -> ViewPolicy:
        return ViewPolicy(CLASSES, width=4, heads=1, blocks=1, rngs=nnx.Rngs(seed))

    def asked_for(seed: int, forget: bool = False) -> ViewPolicy:
        def train():
            trained.append(seed)
            if forget:
                raise KeyboardInterrupt
            return made(seed), {"rounds": []}

        return trained_once(tmp_path, {"seed": seed}, nnx.eval_shape(lambda: made(0)), train)

    trained: list[int] = []
    for seed in (1, 1, 2, 2, 1):
        found, expected = (nnx.state(one, nnx.Param) for one in (asked_for(seed), made(seed)))
        jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert trained == [1, 2, 1]
    with pytest.raises(KeyboardInterrupt):
        asked_for(3, forget=True)
    jax.tree.map(np.testing.assert_array_equal, *(nnx.state(one, nnx.Param) for one in (asked_for(1), made(1))))
    assert trained == [1, 2, 1, 3]


def test_directions_become_all_their_monomials():
    x, y, z = 0.5, -2.0, 3.0
    found = np.asarray(direction_features(np.array([x, y, z])))
    assert len(found) == 3 + 6 + 10
    for expected in (x, y * z, z * z, x * y * z, y**3, x * x * z):
        assert np.isclose(found, expected).any()


def test_the_expected_gain_in_log_probability_is_the_expected_information(random):
    prior, shows = (
        random.dirichlet(np.ones(CLASSES)),
        random.dirichlet(np.ones(5), size=CLASSES),
    )  # p(what is seen | class)
    joint = prior[:, None] * shows
    after = joint / joint.sum(axis=0)
    gain_if = np.sum(shows * np.log(after / prior[:, None]), axis=1)
    entropy = lambda p: -np.sum(p * np.log(p), axis=0)  # noqa: E731
    expected = entropy(prior) - np.sum(joint.sum(axis=0) * entropy(after))
    found = expected_gain(np.log(prior).astype(np.float32), gain_if[None].astype(np.float32))
    np.testing.assert_allclose(found, [expected], rtol=1e-4)


def test_labels_are_what_each_candidate_does_to_the_cross_entropy(fusion):
    data, floor = some_features(2), 0.02
    walks = np.array([[[0, 3, 5], [2, 1, 4]], [[5, 4, 3], [1, 0, 2]]], np.int32)
    asked = unseen(walks, VIEWS, 2, seed=0)
    assert asked.shape == (2, 2, 3, 2)
    found = choices_along(fusion, data, walks, asked, PolicyConfig(utility="log", floor=floor))
    assert found.gain.shape == (2 * 2 * 3, 2)
    fuse = jax.jit(lambda features, directions: fusion(features, directions, jnp.ones(len(features), bool)))
    row = 0
    for index in range(2):
        label = int(data.labels[index])
        for order, asked_of_walk in zip(walks[index], asked[index], strict=True):
            for count in range(1, 4):
                seen, candidates = order[:count], asked_of_walk[count - 1]
                assert len(set(candidates) | set(seen)) == count + 2
                belief = fuse(data.features[index, seen], data.directions[index, seen])
                np.testing.assert_allclose(found.belief[row], belief, atol=1e-4)
                np.testing.assert_array_equal(found.present[row], np.arange(3) < count)
                single = jax.nn.log_softmax(data.logits[index, seen] / 1.3, axis=-1)
                np.testing.assert_allclose(found.views[row, :count], single, atol=1e-5)
                np.testing.assert_array_equal(found.candidates[row], data.directions[index, candidates])
                for at, candidate in enumerate(candidates):
                    with_it = np.append(seen, candidate)
                    after = fuse(data.features[index, with_it], data.directions[index, with_it])
                    drop = np.log(np.exp(after[label]) + floor) - np.log(np.exp(belief[label]) + floor)
                    assert found.gain[row, at] == pytest.approx(drop, abs=1e-4)
                row += 1


@jax.jit
def fused(fusion, features, directions):
    return fusion(features, directions, jnp.ones(len(features), bool))


def plain_walk(fusion, data, index, scores, start, steps):
    """Look, fuse, score, go: in Python."""
    seen, beliefs = [start], []
    for _ in range(steps):
        order = np.array(seen)
        belief = fused(fusion, data.features[index, order], data.directions[index, order])
        beliefs.append(np.asarray(belief))
        found = np.array(scores(order, belief), np.float64)
        found[order] = -np.inf
        seen.append(int(found.argmax()))
    return seen[:steps], beliefs


@pytest.mark.parametrize("by", ["belief", "state", "table"])
def test_the_loop_with_a_learned_fusion_and_policy_is_a_plain_one(fusion, policy, by):
    data, index = some_features(3, seed=4), 1
    graph = graph_of(data.directions[index])
    table = ViewTable(data.logits[index], None, None, data.labels[index], features=data.features[index])
    shown = np.random.default_rng(9).normal(0, 2, (CLASSES, VIEWS, CLASSES))
    scene = table.scene(graph, Knowledge(jnp.zeros(VIEWS), jnp.asarray(shown, jnp.float32)))

    @jax.jit
    def looped(start):
        choose = learned(policy, fusion.single, by=by)
        return select_from_table(jax.random.key(0), table, scene, choose, start, max_views=4, fuse=by_attention(fusion))

    def rise(belief, label, view):
        """Of the logarithm of a class's probability and 0.01, where a view shows half of what it shows of others."""
        after = belief + shown[label, view] / 2
        return np.log(np.exp(after[label]) / np.exp(after).sum() + 0.01) - np.log(np.exp(belief[label]) + 0.01)

    def scores(order, belief):
        views = jax.nn.log_softmax(data.logits[index, order] / fusion.single, axis=-1)
        points = data.directions[index]
        gain, gain_if = asked(policy, belief, views, points[order], np.ones(len(order), bool), points)
        if by == "state":
            return gain
        belief = np.asarray(belief, np.float64)
        by_table = [sum(np.exp(belief[y]) * rise(belief, y, view) for y in range(CLASSES)) for view in range(VIEWS)]
        return expected_gain(belief, gain_if) + (np.array(by_table) if by == "table" else 0)

    for start in (0, 5):
        views, beliefs = plain_walk(fusion, data, index, scores, start, 4)
        episode = looped(start)
        assert episode.views.tolist() == views
        np.testing.assert_allclose(episode.confidences, [np.exp(belief.max()) for belief in beliefs], atol=1e-4)


def test_looking_ahead_is_a_plain_loop_over_views_classes_and_views(fusion, policy):
    data, index = some_features(3, seed=5), 2
    points, graph = data.directions[index], graph_of(data.directions[index])
    table = ViewTable(data.logits[index], None, None, data.labels[index], features=data.features[index])
    expected = jnp.asarray(np.random.default_rng(8).normal(0, 2, (CLASSES, VIEWS, CLASSES)), jnp.float32)
    scene = table.scene(graph, Knowledge(jnp.zeros(VIEWS), expected))

    @jax.jit
    def looped(start):
        choose = looking_ahead(policy, fusion.single, shortlist=3, classes=2)
        return select_from_table(jax.random.key(0), table, scene, choose, start, max_views=4, fuse=by_attention(fusion))

    def gains(belief, views, order):
        gain_if = asked(policy, belief, views, points[order], np.ones(len(order), bool), points)[1]
        found = np.array(expected_gain(belief, gain_if), np.float64)
        found[order] = -np.inf
        return found

    def scores(order, belief):
        views = jax.nn.log_softmax(data.logits[index, np.array(order)] / fusion.single, axis=-1)
        now = gains(belief, views, np.array(order))
        found = np.full(VIEWS, -np.inf)
        likeliest = np.argsort(-np.asarray(belief))[:2]
        chance = np.exp(np.asarray(belief, np.float64)[likeliest])
        for view in np.argsort(-now)[:3]:
            then = []
            for label in likeliest:
                shown = jax.nn.log_softmax(expected[label, view])
                after = jax.nn.log_softmax(belief + shown)
                then.append(gains(after, jnp.concatenate([views, shown[None]]), np.array([*order, view])).max())
            found[view] = now[view] + np.dot(chance / chance.sum(), then)
        return found

    for start in (1, 4):
        assert looped(start).views.tolist() == plain_walk(fusion, data, index, scores, start, 4)[0]


@pytest.mark.parametrize("by", ["belief", "label"])
def test_oracles_of_the_fused_belief_try_every_view(fusion, by):
    data, index = some_features(2, seed=6), 0
    graph = graph_of(data.directions[index])
    table = ViewTable(data.logits[index], None, None, data.labels[index], features=data.features[index])
    episode = select_from_table(
        jax.random.key(0),
        table,
        table.scene(graph),
        fused_oracle(fusion, by=by),
        3,
        max_views=3,
        fuse=by_attention(fusion),
    )

    def scores(order, belief):
        found = []
        every = fused(fusion, data.features[index], data.directions[index])
        for view in range(VIEWS):
            more = np.append(order, view)
            after = fused(fusion, data.features[index, more], data.directions[index, more])
            found.append(after[data.labels[index]] if by == "label" else jnp.exp(every) @ after)
        return found

    assert episode.views.tolist() == plain_walk(fusion, data, index, scores, 3, 3)[0]


def test_a_learned_fusion_says_what_it_lacks(fusion):
    data = some_features(1)
    table = ViewTable(data.logits[0], None, None, data.labels[0])
    scene = table.scene(graph_of(data.directions[0]))
    with pytest.raises(ValueError, match="needs the features of every look"):
        select_from_table(jax.random.key(0), table, scene, random_view, 0, max_views=2, fuse=by_attention(fusion))
    with pytest.raises(ValueError, match=r"needs Scene\.features"):
        select_from_table(jax.random.key(0), table, scene, fused_oracle(fusion), 0, max_views=2)
    with pytest.raises(ValueError, match=r"needs Observation\.predicted_entropy"):
        select_from_table(jax.random.key(0), table, scene, POLICIES["predicted_entropy"], 0, max_views=2)


def telling(objects: int, seed: int) -> Features:
    """Each class is told apart by one view: at view 0 classes pair up, and which view settles the pair depends on the pair."""
    random = np.random.default_rng(seed)
    labels = random.integers(0, 4, objects)
    logits = random.normal(0, 0.3, (objects, VIEWS, 4))
    pair = labels // 2
    for index, label in enumerate(labels):
        logits[index, 0, 2 * pair[index] : 2 * pair[index] + 2] += 4
        logits[index, 2 + pair[index], label] += 4
    directions = np.stack([fibonacci_sphere(VIEWS)] * objects)
    return Features(
        *(jnp.asarray(logits, jnp.float32),) * 2, jnp.asarray(labels, jnp.int32), jnp.asarray(directions, jnp.float32)
    )


class _Sum(nnx.Module):
    """The sum of what was seen, in the place of a fusion that is learned."""

    def __call__(self, features, directions, present, *, posed=True):
        del directions, posed
        return jnp.sum(jnp.where(present[..., None], features, 0.0), axis=-2)


@pytest.fixture(scope="module")
def adding() -> CalibratedFusion:
    structure, weights = nnx.split(_Sum())
    return CalibratedFusion(structure, weights, jnp.zeros(4), jnp.ones(1), jnp.float32(1))


def test_what_looking_was_worth_is_learned_and_the_study_says_so(adding):
    parts = [(adding, telling(160, seed)) for seed in (0, 1)]
    validation, test = telling(120, 2), telling(120, 3)
    config = PolicyConfig(
        width=16, heads=2, blocks=1, most_seen=3, walks=2, rounds=2, epochs=12, batch_size=64, learning_rate=5e-3
    )
    policy, histories = train_policy(config, parts, (adding, validation))
    assert len(histories) == 2
    assert histories[-1][-1]["gain"] < 0.7 * histories[0][0]["gain"]
    found, each = study(
        adding,
        [
            Learner("learned", "view policy", policy),
            Learner("as_it_is", "without belief", policy, "state"),
            Learner("look_ahead", "two ahead", policy, "ahead"),
            Learner("learned_and_table", "with a table", policy, "table"),
            Learner("unsure", "another fusion", policy, fusion=replace(adding, temperatures=jnp.full(1, 50.0))),
        ],
        OnLattice(validation),
        OnLattice(test),
        max_views=3,
        draws=2,
        oracle_views=3,
        costs=True,
    )
    after = {name: result["after_views"] for name, result in found["policies"].items()}
    same = seeds_together([found, found], [each, each], "learned")
    close = partial(np.testing.assert_allclose, atol=1e-6)
    jax.tree.map(close, same["against"], found["against"])  # the mean of two that are alike
    jax.tree.map(close, same["gap_closed"], found["gap_closed"])
    for key in ("interval", "calibration_error"):
        close(same["policies"]["learned"][key], found["policies"]["learned"][key])
    better = {
        name: replace(policy, likelihood=policy.likelihood + (name == "learned")) for name, policy in each.items()
    }
    both = seeds_together([found, found], [each, better], "learned")
    gain = both["against"]["random"]["learned"]["likelihood"]["difference"]
    np.testing.assert_allclose(
        gain, 0.5 + np.array(found["against"]["random"]["learned"]["likelihood"]["difference"]), atol=1e-5
    )
    # From view 0 the telling view can be known; random finds it in one case of five.
    assert after["learned"][1] > after["random"][1] + 0.05
    assert after["learned"][2] > after["random"][2] + 0.1
    assert found["against"]["random"]["learned"]["interval"][2][0] > 0
    assert found["gap_closed"]["learned"][1] > 0.4
    assert found["trying_starts"] == 6  # all of them, where there are so few
    assert after["label_oracle"][1] >= after["learned"][1]
    assert after["look_ahead"][2] > after["random"][2] + 0.1
    assert after["learned_and_table"][2] > after["random"][2] + 0.1
    first = found["policies"]["unsure"]["temperatures"][0] / found["policies"]["learned"]["temperatures"][0]
    assert first == pytest.approx(1 / 50, rel=1e-3)  # of a fusion of its own
    costs = found["costs"]
    assert costs["thesis_walks"] == "random"
    ways = [row["way"] for row in costs["moving"]]
    assert ways[0][0] == 0
    assert ways[-1][1] <= ways[0][1]
    np.testing.assert_allclose(
        costs["moving"][0]["after_views"], after["learned"], atol=1e-6
    )  # nothing paid: as it was
    paying = [row["views"] for row in costs["not_paying"]]
    assert paying == sorted(paying)  # the cheaper a view, the more
    assert paying[0] < paying[-1]
    assert set(found["policies"]) >= {"farthest", "fixed_order", "information_gain", "belief_oracle"}
    assert [row["views"] for row in found["random_sets"]] == [1, 2, 3, 4, 5, 6]
    without = novel_classes(adding, [((0, 2), policy), ((1, 3), policy)], policy, test, max_views=3, draws=2)
    assert without["objects"] == 120
    gain = np.array(after["learned"]) - after["random"]
    for found_without in without["gain"].values():  # the same policy: what is found on all objects
        np.testing.assert_allclose(found_without["difference"], gain, atol=0.02)
    chosen = walk(
        jax.random.key(0), adding, test, partial(_learned, structure=nnx.graphdef(policy)), nnx.state(policy), 3, 4
    )
    assert chosen.shape == (120, 4, 3)
    assert all(len(set(order)) == 3 for order in chosen.reshape(-1, 3).tolist())


def test_rules_are_compared_where_they_are_as_accurate():
    """A walk is right from its second view on; one rule knows that, the other is as sure of the first view."""
    objects, right = 40, np.array([False, True, True])
    knows = Signal(np.tile([0.2, 0.9, 0.95], (objects, 2, 1)), np.tile(right, (objects, 2, 1)), np.ones(objects))
    sure_late = replace(knows, value=np.tile([0.2, 0.3, 0.9], (objects, 2, 1)))
    assert stops_at(knows.value >= 0.9).tolist() == [[1, 1]] * objects
    assert stops_at(knows.value >= 0.99).tolist() == [[2, 2]] * objects  # never: to the end
    assert [share.mean() for share in knows.stopped(0.1)] == [0, 1]
    (row,) = beside([sure_late] * 2, [knows] * 2, [0.8])
    assert (row["accuracy"], row["views"]) == (1, 3)
    assert (row["ours"]["accuracy"], row["ours"]["views"]) == (1, 2)
    assert row["ours"]["views_difference"] == {"difference": -1, "interval": [-1, -1]}
    never = replace(knows, right=np.zeros_like(knows.right))
    assert beside([sure_late] * 2, [never] * 2, [0.8])[0]["ours"] is None
    half = replace(knows, right=knows.right & (np.arange(objects) % 2 == 0)[:, None, None])
    weighed = replace(half, weight=np.where(np.arange(objects) % 2 == 0, 2.0, 0.0))
    assert (half.accuracy(0.5), weighed.accuracy(0.5)) == (0.5, 1)


def _learned(weights, structure):
    return learned(nnx.merge(structure, weights), 1.0, by="state")


def test_temporal_differences_are_those_of_a_plain_loop(fusion, policy, random):
    data, config = some_features(2, seed=8), QLearningConfig(utility="log", floor=0.02)
    walks = np.array([[[0, 3, 5], [2, 1, 4]], [[5, 4, 3], [1, 0, 2]]], np.int32)
    some = transitions_along(fusion, data, walks, config)
    target = moved(ViewPolicy(CLASSES, width=16, heads=2, blocks=2, rngs=nnx.Rngs(7)), 0.1)
    found = nnx.jit(partial(temporal_difference, discount=0.9))(policy, target, some)
    assert found.shape == (4, 2)

    def belief_after(index, seen):
        return fused(fusion, data.features[index, seen], data.directions[index, seen])

    def value(network, index, seen):
        views = jax.nn.log_softmax(data.logits[index, seen] / fusion.single, axis=-1)
        points = data.directions[index]
        belief = belief_after(index, seen)
        return np.asarray(asked(network, belief, views, points[seen], np.ones(len(seen), bool), points)[0])

    for row, (index, number) in enumerate(np.ndindex(2, 2)):
        order = walks[index, number]
        label = data.labels[index]
        for step in range(2):
            seen, more = order[: step + 1], order[: step + 2]
            worth = [np.log(np.exp(belief_after(index, one)[label]) + 0.02) for one in (seen, more)]
            ahead = np.delete(value(target, index, more), more).max() if step == 0 else 0.0
            expected = value(policy, index, seen)[order[step + 1]] - (worth[1] - worth[0] + 0.9 * ahead)
            assert found[row, step] == pytest.approx(expected, abs=1e-4)


def test_q_learning_finds_the_telling_view_too(adding):
    config = QLearningConfig(width=16, heads=2, blocks=1, most_seen=2, walks=4, rounds=2, epochs=6, learning_rate=5e-3)
    network, histories = train_by_q_learning(config, [(adding, telling(160, 0))], (adding, telling(80, 1)))
    assert len(histories) == 2
    data, key = telling(120, 2), jax.random.key(0)
    chosen = walk(key, adding, data, partial(_learned, structure=nnx.graphdef(network)), nnx.state(network), 2, 4)
    told = 2 + np.asarray(data.labels)[:, None] // 2
    from_the_first = chosen[..., 0] == 0  # where the pair is known, and so which view settles it
    assert (chosen[..., 1] == told)[from_the_first].mean() > 0.8


def test_the_fixed_order_begins_with_the_views_that_tell_most(adding):
    scores = fixed_order_scores(adding, telling(200, 5), 3)
    assert sorted(np.argsort(-scores)[:3].tolist()) == [0, 2, 3]
    assert sorted(scores.tolist()) == list(range(1, VIEWS + 1))


def test_neighbours_are_not_asked_for():
    graph, real = graph_of(jnp.asarray(fibonacci_sphere(10), jnp.float32)), ViewGraph.from_points(fibonacci_sphere(10))
    np.testing.assert_allclose(graph.distances, real.distances, atol=1e-3)
