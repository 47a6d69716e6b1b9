"""A user's network, trained as the classifier."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import jax
import numpy as np
import pytest
from flax import nnx

from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from eval.settings import TINY
from train.loop import fit, load_best
from train.results.outputs import network_outputs
from train.tasks.classifier import ClassifierTask

ENCODER = """
import jax, jax.numpy as jnp
from flax import nnx

class Net(nnx.Module):
    def __init__(self, classes, channels, resolution, rngs):
        self.conv = nnx.Conv(channels, 8, (3, 3), strides=4, rngs=rngs)
        self.norm = nnx.BatchNorm(8, rngs=rngs)
        self.dropout = nnx.Dropout(0.3, rngs=rngs)
        self.head = nnx.Linear(8, classes, rngs=rngs)

    def __call__(self, images, train=False):
        x = jax.nn.relu(self.norm(self.conv(images), use_running_average=not train))
        return self.head(self.dropout(jnp.mean(x, axis=(1, 2)), deterministic=not train))

def net(classes, channels, resolution, rngs):
    return Net(classes, channels, resolution, rngs)
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "nets.py"
    path.write_text(ENCODER)
    return path


def task_of(file, name="net", epochs=1, **changes):
    config = replace(TINY.classifier, encoder=f"{file}:{name}")
    config = replace(config, optimiser=replace(config.optimiser, epochs=epochs, epoch_views=2, **changes))
    return ClassifierTask.of(config, 10, TINY.dataset.capture)


def test_it_is_trained_and_named_by_its_source(data, file, tmp_path):
    statistics = load_statistics(data)
    task = task_of(file)
    assert hash(task) == hash(task_of(file))
    summary = fit(task, data, statistics, tmp_path / "net")
    config = json.loads((tmp_path / "net" / "config.json").read_text())["task"]["network_config"]
    assert config == summary["encoder"] == asdict(task)["network_config"]
    assert (config["module"], config["name"], config["channels"]) == ("nets.py", "net", 1)
    assert "depth" not in config
    network = load_best(task, tmp_path / "net")
    assert int(nnx.state(network, nnx.RngCount)["dropout"]["rngs"]["count"][...]) > 0  # each step draws anew
    logits = network_outputs(data, "test", task, network)
    assert logits.shape == (10, 6, 10)
    np.testing.assert_array_equal(logits, network_outputs(data, "test", task, network))  # no dropout in evaluation
    # Continued as it is, refused once it is edited.
    assert fit(task, data, statistics, tmp_path / "net") == summary
    file.write_text(ENCODER.replace("0.3", "0.2"))
    edited = task_of(file)
    with pytest.raises(DataError, match=r"nets.py:net as it was before it was edited; restore that file"):
        fit(edited, data, statistics, tmp_path / "net")
    with pytest.raises(DataError, match=r"other layers than the settings describe \(source \w+, not \w+\)"):
        load_best(edited, tmp_path / "net")


def test_an_interrupted_training_ends_with_the_same_weights(data, file, tmp_path):
    """Also the state of its dropout is restored."""
    statistics = load_statistics(data)
    whole = task_of(file, epochs=2, schedule="constant")
    fit(whole, data, statistics, tmp_path / "whole")
    fit(replace(whole, optimiser=replace(whole.optimiser, epochs=1)), data, statistics, tmp_path / "parts")
    for name in ("summary.json", "config.json", "checks.json"):
        (tmp_path / "parts" / name).unlink()
    (tmp_path / "parts" / "config.json").write_text((tmp_path / "whole" / "config.json").read_text())
    fit(whole, data, statistics, tmp_path / "parts")
    weights = [jax.tree.leaves(nnx.state(load_best(whole, tmp_path / name), nnx.Param)) for name in ("whole", "parts")]
    for mine, theirs in zip(*weights, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("def net(classes, channels): ...", "cannot be used: TypeError: .*unexpected keyword argument"),
        ("def net(**rest): return 3", "returns int, not a Flax nnx.Module"),
        ("def net(**rest): return nnx.List([])", "has no weights"),
        (
            "net = lambda **r: Net(3, r['channels'], 0, r['rngs'])",
            r"returns float32\[2, 3\] for 2 images, not .* \[2, 10\]",
        ),
        ("net = lambda **r: Net(10, 3, 0, r['rngs'])", "cannot be used: "),
        (
            "Net.__call__ = lambda self, images: self.head(images[:, 0, :8, 0])",
            "cannot be used: .*unexpected keyword argument 'train'",
        ),
        ("Net.__call__ = lambda self, images, train=False: None", "returns nothing for 2 images"),
    ],
)
def test_what_is_no_encoder_is_one_sentence(code, said, file):
    file.write_text(f"{ENCODER}\n{code}\n")
    with pytest.raises(DataError, match=f"^--encoder .*nets.py:net {said}") as error:
        task_of(file)
    assert "\n" not in str(error.value)


def test_settings_that_it_does_not_have_are_refused(file):
    with pytest.raises(DataError, match=r"--classifier.optimiser.compute bfloat16 is for this project's own networks"):
        task_of(file, compute="bfloat16")
    with pytest.raises(DataError, match="has no function 'other'"):
        task_of(file, "other")
