"""How well the colours of enrolled objects explain a view, beside their shape.

Colours are compared as logarithms, in which the light's strength, the exposure and the white balance of an image are one number
for each channel. For each hypothesis these numbers are the mean difference of the pixels that both show. What remains, and these
three numbers themselves, which are rather small if the hypothesis is right, are reduced to a few numbers by a `ColourMatcher`, as
differences of depth are by a `mevs_jax.gallery.matching.Matcher`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from mevs_jax.arrays import AnyArray
from mevs_jax.gallery.errors import details, gram_of, unexplained
from mevs_jax.gallery.grid import HEIGHTS, SIDE, STEPS, UNKNOWN, YAWS, foreseen, interpolated, of_walks

COLOURS = 3 * SIDE**2
"""Numbers of an image's colours."""
NUMBERS = COLOURS + 3
"""Numbers of a difference: of each pixel's, without the image's mean difference of each channel, and these three."""
_DARK = 0.08
"""Added to colours before their logarithm, since the noise of dark ones is not proportional to them."""
_RANGE = math.log(1 + 1 / _DARK)
LEAST = 0.02
"""Smallest share of an image in which colours are compared."""
_DEVIATIONS = np.array([0.3, 0.3, 0.03, 0.05, 0.05, 0.35, 0.15, 0.3, 0.3], np.float32)
"""Standard deviations of what may be wrong in an image: shifts in pixels of small images, to the right and down; the logarithm of
its size; yaw and elevation of the camera in radians; the logarithms of its exposure and of the exponent of its tone curve; and by
how much the logarithm of its exposure grows over half of the image, to the right and down, as light from one side makes it."""
_SHOWN = 0.3
"""Share of an image whose colours the next view will show, about."""


def small_colours(colours: Float[AnyArray, "*images side side 3"]) -> Float[Array, "*images small small 3"]:
    """Means of blocks of images' known colours, from 0 to 1; NaN where less than half of a block is known."""
    colours = jnp.asarray(colours)
    block = colours.shape[-2] // SIDE
    blocks = colours.reshape(*colours.shape[:-3], SIDE, block, SIDE, block, 3)
    known = ~jnp.isnan(blocks).any(axis=-1, keepdims=True)
    number = jnp.sum(known, axis=(-4, -2))
    mean = jnp.sum(jnp.where(known, blocks, 0.0), axis=(-4, -2)) / jnp.maximum(number, 1)
    return jnp.where(2 * number >= block**2, mean, jnp.nan)


@jax.jit
def stored_colours(colours: Float[AnyArray, "*images side side 3"]) -> UInt8[Array, "*images colours"]:
    """Logarithms of `small_colours` as a gallery holds them: in steps of 1/254 of the range, `UNKNOWN` where not known."""
    logs = logarithms(small_colours(colours)) / _RANGE
    stored = jnp.where(jnp.isnan(logs), UNKNOWN, jnp.round(jnp.clip(logs, 0, 1) * STEPS)).astype(jnp.uint8)
    return stored.reshape(*stored.shape[:-3], COLOURS)


def logarithms(colours: Float[Array, "*pixels 3"]) -> Float[Array, "*pixels 3"]:
    """Of colours from 0 to 1, with less weight of dark ones."""
    return jnp.log(jnp.clip(colours, 0, 1) / _DARK + 1)


@flax.struct.dataclass
class ColourMatcher:
    """How colours are compared, learned once from procedural objects in changing light.

    Attributes:
        projection: (numbers, features) makes differences white.
        floor: () squared difference below which hypotheses are about equally good.
        heat: (3,) coefficients of the logarithm of the power of a walk's likelihood, of 1, log views and log objects.
        stranger: (6,) coefficients of the log-odds that an object is none of those enrolled: of 1, log views, log objects, the
            logarithms of the best hypothesis' squared differences of depth and of colour, and its object's `details` in colour.
        unseen: () the squared difference that counts where a colour is not known.
    """

    projection: Float[Array, "numbers features"]
    floor: Float[Array, ""]
    heat: Float[Array, " 3"]
    stranger: Float[Array, " 6"]
    unseen: Float[Array, ""]

    def likelihood(
        self, apart: Float[AnyArray, "..."], count: Float[AnyArray, "*walks"], objects: int
    ) -> Float[Array, "..."]:
        """Logarithm of the likelihood of walks' colours under hypotheses, of which the last two axes are; 0 without colours."""
        power = jnp.where(count > 0, jnp.exp(self.heat @ of_walks(jnp.maximum(count, LEAST), objects)), 0.0)
        return -power[..., None, None] * jnp.log(apart + self.floor)

    @staticmethod
    def strangeness(
        apart: Float[AnyArray, "*walks"],
        colours_apart: Float[AnyArray, "*walks"],
        detail: Float[AnyArray, "*walks"],
        count: Float[AnyArray, "*walks"],
        objects: int,
    ) -> Float[Array, "..."]:
        """What the odds of an unknown object depend on, in the order of `stranger`, from the best hypothesis."""
        both = jnp.log(jnp.stack([jnp.asarray(apart), jnp.asarray(colours_apart)]) + 1e-6)
        return jnp.stack([*of_walks(jnp.maximum(count, LEAST), objects), *both, jnp.asarray(detail)])

    def blank(self) -> Colours:
        """No objects' colours yet."""
        return Colours.of(self, np.zeros((0, HEIGHTS, YAWS, COLOURS), np.uint8), np.zeros(0, np.int32))


@flax.struct.dataclass
class ColourEvidence:
    """What the colours of a walk say of each hypothesis.

    Attributes:
        apart: (objects, yaws) mean squared white difference.
        count: number of views, each by the share of its image whose colours are known.
    """

    apart: Float[Array, "objects yaws"]
    count: Float[Array, ""]

    @classmethod
    def of(cls, compared: Float[Array, "views comparisons"], present: Bool[Array, " views"]) -> ColourEvidence:
        """What the views that are present say together, from `Colours.compared` of each."""
        shares = jnp.where(present, compared[:, -1], 0.0)
        count = jnp.sum(shares)
        return cls((shares / jnp.maximum(count, 1e-6) @ compared[:, :-1]).reshape(-1, YAWS), count)


@flax.struct.dataclass
class Colours:
    """The colours of enrolled objects.

    Attributes:
        matcher: compares views.
        images: (coloured, heights, yaws, colours) of each object whose colours are known, as `stored_colours`.
        objects: (coloured,) which objects these are.
        features: (coloured, heights, yaws, features) the same, projected.
        slopes: (coloured, heights, yaws, errors, features) how features change with `_DEVIATIONS`.
        details: (coloured,) how fine those of each are, as `mevs_jax.gallery.errors.details`.
    """

    matcher: ColourMatcher
    images: UInt8[Array, "coloured heights yaws colours"]
    objects: Int[Array, " coloured"]
    features: Float[Array, "coloured heights yaws features"]
    slopes: Float[Array, "coloured heights yaws errors features"]
    details: Float[Array, " coloured"]

    @classmethod
    def of(
        cls, matcher: ColourMatcher, images: UInt8[AnyArray, "coloured heights yaws colours"], objects: AnyArray
    ) -> Colours:
        """The colours of some images."""
        stored = jnp.asarray(images, jnp.uint8)
        nothing = jnp.zeros((0, HEIGHTS, YAWS, matcher.projection.shape[1]))
        features, slopes = nothing, nothing[..., None, :].repeat(len(_DEVIATIONS), axis=-2)
        if len(stored):
            found = [_of_object(one, matcher.projection) for one in stored]
            features, slopes = (jnp.stack(part) for part in zip(*found, strict=True))
        return cls(matcher, stored, jnp.asarray(objects, jnp.int32), features, slopes, details(slopes))

    def with_more(self, images: Sequence[UInt8[AnyArray, "heights yaws colours"] | None], objects: int) -> Colours:
        """With more objects after those of before, some of them without colours."""
        new = [number for number, one in enumerate(images, objects) if one is not None]
        some = [np.asarray(one)[None] for one in images if one is not None]
        return Colours.of(
            self.matcher,
            np.concatenate([np.asarray(self.images), *some]),
            np.concatenate([np.asarray(self.objects), np.array(new, np.int32)]),
        )

    def only(self, kept: Int[np.ndarray, " kept"]) -> Colours:
        """Of some of the objects, in their order."""
        places = {number: place for place, number in enumerate(kept)}
        objects = [places.get(number, -1) for number in np.asarray(self.objects).tolist()]
        left = np.array(objects, np.int32)
        return Colours.of(self.matcher, np.asarray(self.images)[left >= 0], left[left >= 0])

    def compared(
        self, seen: Float[Array, "side side 3"], direction: Float[Array, " 3"], objects: int
    ) -> Float[Array, " comparisons"]:
        """Squared differences of a view's colours from those predicted for each object at each yaw; and last, the share of the
        image whose colours are known. Differences are white, and what `_DEVIATIONS` explain is taken away.

        Args:
            seen: `small_colours` of the view.
            direction: unit vector from the object to the camera.
            objects: number of objects; what is compared is about `ColourMatcher.unseen` for those without colours.
        """
        known, apart = jnp.mean(~jnp.isnan(seen[..., 0])), jnp.full((objects, YAWS), self.matcher.unseen)
        if len(self.images):
            numbers, share = differences(self.images, seen, direction)
            white = numbers @ self.matcher.projection
            slope = interpolated(self.slopes, direction)
            lean = jnp.einsum("oyf,oyef->oye", white, slope) / white.shape[-1]
            found = unexplained(jnp.mean(jnp.square(white), axis=-1), lean, gram_of(slope), 1.0)
            enough = jnp.clip(share / jnp.maximum(known, LEAST), 0, 1)
            apart = apart.at[self.objects].set(self.matcher.unseen + enough * (found - self.matcher.unseen))
        return jnp.append(apart.reshape(-1), known)

    def strange_odds(
        self,
        evidence: ColourEvidence,
        best: Int[Array, ""],
        apart: Float[Array, ""],
        by_shape: Float[Array, ""],
        objects: int,
    ) -> Float[Array, ""]:
        """Log-odds that an object is none of those enrolled, by shape or by colour.

        Args:
            evidence: of the views so far.
            best: the likeliest hypothesis.
            apart: its difference of depth.
            by_shape: the log-odds by shape alone, which count if no view or not this object has colours.
            objects: number of objects.
        """
        this = self.objects == best // YAWS
        inputs = evidence.apart.reshape(-1)[best], jnp.sum(jnp.where(this, self.details, 0.0)), evidence.count
        odds = self.matcher.stranger @ self.matcher.strangeness(apart, *inputs, objects)
        return jnp.where((evidence.count > 0) & jnp.any(this), odds, by_shape)

    def expected(
        self,
        evidence: ColourEvidence,
        directions: Float[Array, "candidates 3"],
        hypotheses: Int[Array, " hypotheses"],
        objects: int,
    ) -> Float[Array, "candidates hypotheses hypotheses"]:
        """`ColourMatcher.likelihood` after one more view of each candidate, if each hypothesis is true in turn; 0 if no view had
        colours.

        Args:
            evidence: of the views so far.
            directions: unit vectors from the object to the candidates.
            hypotheses: each an object's number times `YAWS`, and a yaw.
            objects: number of objects.
        """
        if not len(self.images):
            return jnp.zeros((len(directions), len(hypotheses), len(hypotheses)))
        same = self.objects == (hypotheses // YAWS)[:, None]
        at, coloured = jnp.argmax(same, axis=1), jnp.any(same, axis=1)
        before, count = evidence.apart.reshape(-1)[hypotheses], evidence.count
        seen, slope = (foreseen(grid, directions, at, hypotheses % YAWS) for grid in (self.features, self.slopes))
        products = jnp.einsum("cmf,cnf->cmn", seen, seen) / seen.shape[-1]
        leans = jnp.einsum("cmf,cnef->cmne", seen, slope) / seen.shape[-1]
        squares, own = jnp.diagonal(products, axis1=1, axis2=2), jnp.einsum("cnne->cne", leans)
        square = jnp.maximum(squares[:, :, None] + squares[:, None, :] - 2 * products, 0.0)
        apart = unexplained(square, leans - own[:, None], gram_of(slope)[:, None], 1.0) + jnp.min(before)
        apart = jnp.where(coloured[:, None] & coloured, apart, self.matcher.unseen)
        more = jnp.where(count > 0, _SHOWN, 0.0)
        apart = (count * before + more * apart) / jnp.maximum(count + more, LEAST)
        return self.matcher.likelihood(apart, count + more, objects)


def decoded(images: UInt8[Array, "*images colours"]) -> tuple[Float[Array, "*images pixels 3"], Bool[Array, "..."]]:
    """Logarithms of stored colours, and which pixels have one."""
    pixels = images.reshape(*images.shape[:-1], SIDE**2, 3)
    return pixels * (_RANGE / STEPS), pixels[..., 0] != UNKNOWN


@jax.jit
def _of_object(
    images: UInt8[Array, "heights yaws colours"], projection: Float[Array, "numbers features"]
) -> tuple[Float[Array, "heights yaws features"], Float[Array, "heights yaws errors features"]]:
    """`Colours.features` and `Colours.slopes` of an object."""
    logs, known = decoded(images)
    small = logs.reshape(*known.shape[:2], SIDE, SIDE, 3), known.reshape(*known.shape[:2], SIDE, SIDE)
    down, across = (_slope(*small, axis) for axis in (2, 3))
    turned, raised = _slope(*small, 1, wraps=True) * (YAWS / (2 * np.pi)), _slope(*small, 0) * ((HEIGHTS - 1) / np.pi)
    at = (jnp.arange(SIDE) - (SIDE - 1) / 2)[:, None]
    gained, colours = 1 - jnp.exp(-small[0]), jnp.maximum(_DARK * jnp.expm1(small[0]), 1e-3)
    tone, aside, below = gained * jnp.log(colours), gained * at * (2 / SIDE), gained * at[:, None] * (2 / SIDE)
    each = across, down, across * at + down * at[:, None], turned, raised, gained, tone, aside, below
    changes = jnp.stack(each, axis=2).reshape(*known.shape[:2], len(each), SIDE**2, 3) * _DEVIATIONS[:, None, None]
    slopes = parted(changes, jnp.broadcast_to(known[:, :, None], changes.shape[:-1]))[0]
    return parted(logs, known)[0] @ projection, slopes @ projection


def _slope(
    logs: Float[Array, "heights yaws small small 3"],
    known: Bool[Array, "heights yaws small small"],
    axis: int,
    wraps: bool = False,
) -> Float[Array, "heights yaws small small 3"]:
    """Derivative by steps along an axis: the mean of the differences from both neighbours, of those that are known."""
    total, number = jnp.zeros_like(logs), jnp.zeros_like(logs)
    places = jnp.arange(logs.shape[axis]).reshape(-1, *(1,) * (logs.ndim - axis - 1))
    for step in (-1, 1):
        inside = wraps | (places < logs.shape[axis] - 1 if step == 1 else places > 0)
        both = (known & jnp.roll(known, -step, axis))[..., None] & inside
        total += jnp.where(both, step * (jnp.roll(logs, -step, axis) - logs), 0.0)
        number += both
    return total / jnp.maximum(number, 1)


def parted(
    logs: Float[Array, "*images pixels 3"], known: Bool[Array, "*images pixels"]
) -> tuple[Float[Array, "*images numbers"], Float[Array, "*images"]]:
    """Logarithms of images, or differences between them, as numbers that a `ColourMatcher` projects, and the share that is known.

    Numbers are those of the pixels without the mean of each channel, as strong as if all were known, and the three means.
    """
    share = jnp.mean(known, axis=-1)
    there = known[..., None]
    mean = jnp.sum(jnp.where(there, logs, 0.0), axis=-2) / jnp.maximum(jnp.sum(there, axis=-2), 1)
    rest = jnp.where(there, logs - mean[..., None, :], 0.0).reshape(*share.shape, COLOURS)
    weight = jnp.sqrt(jnp.maximum(share, LEAST))[..., None]
    return jnp.concatenate([rest, jnp.sqrt(share)[..., None] * mean], axis=-1) / weight, share


def differences(
    images: UInt8[Array, "objects heights yaws colours"],
    seen: Float[Array, "side side 3"],
    direction: Float[Array, " 3"],
) -> tuple[Float[Array, "objects yaws numbers"], Float[Array, "objects yaws"]]:
    """`parted` differences between what hypotheses predict in a direction, and `small_colours` of a view."""
    told = interpolated(images != UNKNOWN, direction)
    total = interpolated(jnp.where(images != UNKNOWN, images, 0), direction)
    predicted = (total * (_RANGE / STEPS) / jnp.maximum(told, 1e-3)).reshape(*told.shape[:2], SIDE**2, 3)
    known = ~jnp.isnan(seen[..., 0]).reshape(-1)
    return parted(predicted - logarithms(seen).reshape(-1, 3), known & (told[..., ::3] >= 0.5))
