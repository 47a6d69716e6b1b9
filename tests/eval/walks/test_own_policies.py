"""Policies of users: what they are given, how many walks they take, and which of them are refused."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipeline.errors import DataError
from eval.walks.knowledge import learn
from eval.walks.ladder import KNOWS, ladder
from eval.walks.own_policies import check_scores, checked, load_policies, named_apart, own_identity
from mevs_jax import POLICIES, ViewGraph, fibonacci_sphere, select_from_table
from mevs_jax.policies import PolicyRecord
from mevs_jax.selection.walks import state_after
from tests.reference.evaluation import CLASSES, VIEWS, some_tables


@pytest.fixture(scope="module")
def graph() -> ViewGraph:
    return ViewGraph.from_points(fibonacci_sphere(VIEWS))


def own(policy, knows="networks", name="mine") -> PolicyRecord:
    return PolicyRecord(name, policy, "my own", knows, called="--policy mine.py:mine")


def opposite(key, state, scene):
    del key
    return -scene.graph.points @ scene.graph.points[state.view]


def at_random(key, state, scene):
    return jax.random.uniform(key, state.attempted.shape)


def test_a_policy_is_walked_once_unless_it_draws(graph):
    mine = checked([own(opposite, "nothing"), own(at_random)], graph, CLASSES)
    assert [(policy.title, policy.knows, policy.draws(7)) for policy in mine] == [
        ("my own", "nothing", 1),
        ("my own", "networks", 7),
    ]
    together = ladder(mine)
    assert together[0].name == "random"
    order = [[*KNOWS].index(policy.knows) for policy in together]
    assert order == sorted(order)
    assert [policy for policy in together if policy not in mine] == list(ladder())


@pytest.mark.parametrize(
    ("field", "allowed"),
    [
        ("label", ("truth",)),
        ("entropy", ("truth",)),
        ("logits", ("truth",)),
        ("knowledge", ("others", "learned", "truth")),
        ("graph", tuple(KNOWS)),
    ],
)
def test_a_policy_is_given_what_it_declares_to_know(field, allowed, graph):
    def uses(key, state, scene):
        used = jnp.sum(jax.tree.leaves(getattr(scene, field))[0] * 1.0) if getattr(scene, field) is not None else None
        return jnp.zeros(VIEWS) + used

    for knows in KNOWS:
        if knows in allowed:
            assert len(checked([own(uses, knows)], graph, CLASSES)) == 1
        else:
            with pytest.raises(DataError, match=f"cannot be used: .*knows '{knows}' has no other fields"):
                checked([own(uses, knows)], graph, CLASSES)


@pytest.mark.parametrize(
    ("policy", "said"),
    [
        (lambda key, state: jnp.zeros(VIEWS), r"takes \(key, state\), and a policy takes \(key, state, scene\)"),
        (lambda key, state, scene: jnp.zeros(3), r"returns float32\[3\], and a policy returns .* \[10\]"),
        (lambda key, state, scene: jnp.zeros(VIEWS, int), r"returns int32\[10\]"),
        (lambda key, state, scene: (jnp.zeros(VIEWS),) * 2, r"returns float32\[10\], float32\[10\]"),
        (lambda key, state, scene: None, "returns nothing"),
        (lambda key, state, scene: float(state.count), "cannot be used: ConcretizationTypeError"),
        (lambda key, state, scene: 1 / 0, "cannot be used: ZeroDivisionError: division by zero; repair it"),
    ],
)
def test_what_is_no_policy_is_one_sentence(policy, said, graph):
    with pytest.raises(DataError, match=f"^--policy mine.py:mine {said}") as error:
        checked([own(policy)], graph, CLASSES)
    assert "\n" not in str(error.value)


def test_names_are_told_apart():
    for name in ("random", "diff_mesh", "scrambled_entropy"):
        with pytest.raises(DataError, match=f"the name '{name}' is taken"):
            named_apart([own(opposite, name=name)])
    with pytest.raises(DataError, match="the name 'mine' is taken"):
        named_apart([own(opposite), own(at_random)])


def test_a_registered_function_keeps_its_title(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "from mevs_jax import register_policy\n"
        "@register_policy('registered_in_a_test', title='my title', knows='others')\n"
        "def mine(key, state, scene):\n    return scene.knowledge.order\n"
        "def plain_one(key, state, scene):\n    return scene.graph.points[:, 2]\n"
    )
    try:
        first, second = load_policies([f"{path}:mine", f"{path}:plain_one"])
        assert (first.name, first.title, first.knows) == (
            "registered_in_a_test",
            "my title",
            "others",
        )
        assert (second.name, second.title, second.knows) == ("plain_one", "plain one", "networks")
        assert own_identity(first) == {
            "policy": "registered_in_a_test",
            "title": "my title",
            "knows": "others",
            "module": "mine.py",
            "name": "mine",
            "source": second.code["source"],
        }
        path.write_text(path.read_text().replace("my title", "another title"))
        (again,) = load_policies([f"{path}:mine"])  # an edited file replaces what it registered
        assert again.title == "another title"
    finally:
        POLICIES.pop("registered_in_a_test", None)


def test_the_state_of_a_walk_is_that_of_the_loop(graph):
    """A policy that returns a fingerprint of its state gives the same scores in the loop and afterwards."""
    table = jax.tree.map(lambda leaf: leaf[3], some_tables().stacked())

    def fingerprint(key, state, scene):
        weights = jnp.arange(1, VIEWS + 1, dtype=jnp.float32)
        parts = [jnp.sum(leaf * 1.0) * (i + 1) for i, leaf in enumerate(jax.tree.leaves(state))]
        return jnp.sin(weights * sum(parts)) + jax.random.uniform(key, (VIEWS,))

    key, scene = jax.random.key(5), table.scene(graph)
    walk = np.asarray(select_from_table(key, table, scene, fingerprint, 4, max_views=6).views)
    for count in range(1, 6):
        state = state_after(table, jnp.asarray(walk), jnp.int32(count))
        scores = fingerprint(jax.random.fold_in(key, count), state, scene)
        assert int(jnp.argmax(jnp.where(state.attempted, -jnp.inf, scores))) == walk[count]


@pytest.mark.parametrize(
    ("value", "said"),
    [(jnp.nan, "scores that are NaN"), (jnp.inf, "infinite score"), (-jnp.inf, "infinite score"), (1.0, "")],
)
def test_scores_that_mean_nothing_are_found(value, said, graph):
    """From the third view on, every view but those seen gets this score."""
    tables = some_tables()
    stacked, knowledge = tables.stacked(), learn(jnp.asarray(tables.logits), jnp.asarray(tables.labels))

    def policy(key, state, scene):
        return jnp.where((state.count > 2) & ~state.attempted, value, scene.graph.points[:, 2])

    walks = np.tile(np.array([0, 1, 2, 3, -1], np.int8), (len(tables.labels), VIEWS, 1))
    arguments = jax.random.key(0), stacked, walks, graph, knowledge, None
    mine = own(policy)
    if not said:
        return check_scores(mine, *arguments)
    with pytest.raises(DataError, match=f"gives .*{said}.* test object 0 from start view 0"):
        check_scores(mine, *arguments)
    walks[..., 3] = -1  # scores that no choice was made by
    return check_scores(mine, *arguments)
