"""The recogniser: an encoder and a fusion; patches and convolutions."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from eval.settings import TINY
from mevs_jax.models import Recogniser, ResNet
from train.tasks.recogniser import RecogniserTask


@pytest.fixture(scope="module")
def recogniser() -> Recogniser:
    task = RecogniserTask.of(TINY.learned.recogniser, 10, TINY.dataset.capture)
    return nnx.jit(lambda: task.network(nnx.Rngs(0)))()


def test_views_alone_and_together_are_the_encoder_and_the_fusion(recogniser, random):
    images = random.uniform(0, 1, (2, 3, 32, 32, 4)).astype(np.float32)
    directions = random.normal(size=(2, 3, 3)).astype(np.float32)
    present = np.array([[True, True, False], [True, False, False]])

    @nnx.jit
    def both_ways(network: Recogniser):
        features = network.encoder.features(images)
        together = (network.fusion(features, directions, present, posed=posed) for posed in (True, False))
        by_hand = network.encoder.head(features), *together, network.pose(features, directions[..., 2])
        return network(images, directions, present), by_hand, network.see(images), features

    found, by_hand, kept, features = both_ways(recogniser)
    for one, other in zip(found, by_hand, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    assert np.abs(found[1] - found[2]).max() > 1e-4
    np.testing.assert_allclose(kept, np.concatenate([features, found[0]], axis=-1), atol=1e-5)


def test_patches_take_images_that_they_fill():
    network = ResNet(width=4, channels=1, stem="patches", rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="do not fill an image of 30×32"):
        network(np.zeros((30, 32, 1), np.float32))
    image = np.arange(64.0).reshape(1, 8, 8, 1).astype(np.float32)
    kernel = np.zeros((16, 4), np.float32)
    kernel[5, 0] = 1  # row 1, column 1 of a piece
    network.convolution.layer.kernel[...] = jnp.asarray(kernel)
    np.testing.assert_array_equal(network.convolution(jnp.asarray(image))[0, :, :, 0], image[0, 1::4, 1::4, 0])
