"""What enrolled objects look like from all directions, and how well each of them explains a view, at every yaw.

A gallery holds, for each object, small depth images from a grid of directions around it. A *hypothesis* is an object at a yaw.
It predicts the image of any camera, by interpolation between the images of the grid. The difference between a view and its
prediction is reduced to a few numbers, which a `Matcher` learned from other objects: those in which shapes differ most beside the
errors of the sensor, of the object's believed sphere, and of the interpolation.

How strong the errors are differs from object to object and is not known, so the likelihood of a walk is a power of the mean
squared difference of its views (a Student t distribution). The power does not grow in proportion to the number of views, since
errors of one object are not independent across views: what a gallery does not know of an object is missing from each of them.

What a wrong sphere and yaw explain of the differences, in all views alike, does not count; see `mevs_jax.gallery.errors`.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from mevs_jax.arrays import AnyArray
from mevs_jax.gallery.colours import ColourEvidence, Colours, small_colours
from mevs_jax.gallery.errors import ERRORS, KEPT, details, gram_of, likeliest, parted, slopes, unexplained
from mevs_jax.gallery.grid import HEIGHTS, SIDE, STEPS, UNKNOWN, YAWS, foreseen, grid_rotations, interpolated, of_walks

PIXELS = 2 * SIDE**2
"""Numbers of an image: the depth of each pixel, and the share of it that shows the object."""
MOST_HYPOTHESES = 64
"""The likeliest hypotheses, which the expected gain of a view is computed from."""
WEIGHTS = np.repeat(np.array([1.0, 0.5], np.float32), SIDE**2)
"""Weights of the depth of a pixel, which is from 0 to 1, and of the share of it that shows the object."""
ALIKE = 0.25
"""Objects look alike if the squared white difference of their images is less than this on average."""
_IMPOSSIBLE = 1e6
"""Squared difference of hypotheses that are ruled out."""
_LEAST = 0.01
"""Smallest share of an image that counts as known."""


def comparisons(objects: int, colour: bool = False) -> int:
    """How many numbers are kept of a view: for each object, `KEPT` for each yaw and one for its size; and what the view shows.

    Where colours are compared, there is one more for each object at each yaw, and the share of the image that has them.
    """
    return objects * (YAWS * KEPT + 1) + 1 + colour * (objects * YAWS + 1)


def small_image(
    depth: Float[AnyArray, "side side"], distance: float
) -> tuple[Float[Array, " pixels"], Float[Array, " pixels"]]:
    """A view as galleries hold it, and which of its numbers are known (1 or 0).

    Args:
        depth: in radii along the optical axis, 0 where nothing is hit, NaN where unknown; its side is a multiple of `SIDE`.
        distance: of the camera from the object's centre, in radii.
    """
    depth = jnp.asarray(depth)
    block = len(depth) // SIDE
    blocks = depth.reshape(SIDE, block, SIDE, block).transpose(0, 2, 1, 3).reshape(SIDE**2, block**2)
    known, hit = ~jnp.isnan(blocks), blocks > 0
    number = jnp.maximum(jnp.sum(known, axis=1), 1)
    near = jnp.sum(jnp.where(hit, (distance + 1 - blocks) / 2, 0.0), axis=1) / number
    share = jnp.sum(hit, axis=1) / number
    seen = (2 * jnp.sum(known, axis=1) >= block**2).astype(jnp.float32)
    return jnp.concatenate([near, share]), jnp.concatenate([seen, seen])


def stored_image(depth: Float[AnyArray, "side side"], distance: float) -> UInt8[Array, " pixels"]:
    """`small_image` in steps of 1/254, and `UNKNOWN` where it is not known."""
    image, known = small_image(depth, distance)
    return jnp.where(known > 0, jnp.round(jnp.clip(image, 0, 1) * STEPS), UNKNOWN).astype(jnp.uint8)


@flax.struct.dataclass
class Matcher:
    """How a view is compared with predictions, learned once from objects of all kinds.

    Attributes:
        projection: (pixels, features) makes differences of images white: of unit covariance.
        floor: () squared difference below which hypotheses are about equally good.
        heat: (3,) coefficients of the logarithm of the power of a walk's likelihood, of 1, log views and log objects.
        stranger: (5,) coefficients of the log-odds that an object is none of those enrolled: of 1, log views, log objects, the
            logarithm of the best hypothesis' squared difference, and its object's `details`.
        unseen: () the squared difference that counts where a prediction is not known.
        size: () standard deviation of the logarithm of an object's measured radius.
    """

    projection: Float[Array, "pixels features"]
    floor: Float[Array, ""]
    heat: Float[Array, " 3"]
    stranger: Float[Array, " 5"]
    unseen: Float[Array, ""]
    size: Float[Array, ""]

    def power(self, count: Float[AnyArray, "*walks"], objects: int) -> Float[Array, "*walks"]:
        """Of the likelihood of a walk of `count` views, among so many objects."""
        return jnp.exp(self.heat @ of_walks(count, objects))

    def likelihood(
        self, apart: Float[AnyArray, "..."], count: Float[AnyArray, "*walks"], objects: int
    ) -> Float[Array, "..."]:
        """Logarithm of the likelihood of walks under hypotheses, which the last two axes of their squared differences are of."""
        return -self.power(count, objects)[..., None, None] * jnp.log(apart + self.floor)

    @staticmethod
    def strangeness(
        apart: Float[AnyArray, "*walks"],
        detail: Float[AnyArray, "*walks"],
        count: Float[AnyArray, "*walks"],
        objects: int,
    ) -> Float[Array, "..."]:
        """What the odds of an unknown object depend on, in the order of `stranger`, from the best hypothesis."""
        return jnp.stack([*of_walks(count, objects), jnp.log(jnp.asarray(apart) + 1e-6), jnp.asarray(detail)])


@flax.struct.dataclass
class Evidence:
    """What the views of a walk say of each hypothesis.

    Attributes:
        apart: (objects, yaws) mean squared white difference that no common error of the views explains.
        square, lean, gram: (objects, yaws, …) what this follows from, as means over views; see `mevs_jax.gallery.errors`.
        size: (objects,) squared deviation of the logarithm of the radius, in standard deviations; 1 where a size is not known.
        count: number of views, each by the share of its image that is known.
        colours: what their colours say; None if they are not compared.
    """

    apart: Float[Array, "objects yaws"]
    square: Float[Array, "objects yaws"]
    lean: Float[Array, "objects yaws errors"]
    gram: Float[Array, "objects yaws pairs"]
    size: Float[Array, " objects"]
    count: Float[Array, ""]
    colours: ColourEvidence | None = None


@flax.struct.dataclass
class Gallery:
    """Enrolled objects.

    Attributes:
        matcher: compares views.
        images: (objects, heights, yaws, pixels) from each direction of the grid, as `stored_image`.
        features: (objects, heights, yaws, features) the same, projected.
        slopes: (objects, heights, yaws, errors, features) how features change with a wrong sphere and yaw.
        details: (objects,) how fine those of each are, as `mevs_jax.gallery.errors.details`.
        radii: (objects,) in metres; 0 where the true size is not known.
        symmetries: (objects,) number of yaws at which each looks alike.
        colours: of the objects; None if they are not compared.
    """

    matcher: Matcher
    images: UInt8[Array, "objects heights yaws pixels"]
    features: Float[Array, "objects heights yaws features"]
    slopes: Float[Array, "objects heights yaws errors features"]
    details: Float[Array, " objects"]
    radii: Float[Array, " objects"]
    symmetries: Int[Array, " objects"]
    colours: Colours | None = None

    @classmethod
    def of(
        cls,
        matcher: Matcher,
        images: UInt8[AnyArray, "objects heights yaws pixels"],
        radii: AnyArray,
        colours: Colours | None = None,
    ) -> Gallery:
        """The gallery of some images."""
        project = jnp.asarray(WEIGHTS[:, None]) * matcher.projection
        features = jnp.zeros((0, HEIGHTS, YAWS, project.shape[1]))
        changes = jnp.zeros((0, HEIGHTS, YAWS, ERRORS, project.shape[1]))
        if len(images):
            filled = [_filled(one) for one in images]
            features = jnp.stack([one @ project for one in filled])
            changes = jnp.stack([slopes(one, grid_rotations()) @ project for one in filled])
        symmetries = jnp.array([symmetry_of(one) for one in np.asarray(features)], jnp.int32)
        sizes = jnp.asarray(radii, jnp.float32)
        return cls(
            matcher, jnp.asarray(images, jnp.uint8), features, changes, details(changes), sizes, symmetries, colours
        )

    def compared(
        self,
        depth: Float[Array, "side side"],
        direction: Float[Array, " 3"],
        distance: float,
        radius: Float[AnyArray, ""],
        colours: Float[Array, "side side 3"] | None = None,
    ) -> Float[Array, " comparisons"]:
        """What is kept of a view: for each object, its differences from the prediction at each yaw (square, lean and gram), and
        from its size; and, last, the share of the image that is known.

        Differences are white: a square is about 1 on average if the hypothesis is right. Pixels that are unknown in the view are
        left out, and the others count more in their place. Where only the prediction is unknown, `Matcher.unseen` counts.

        Args:
            depth: in radii, as of `small_image`.
            direction: unit vector from the object to the camera.
            distance: of the camera, in radii.
            radius: of the object in metres; NaN if it is unknown.
            colours: of the view, as of `small_colours`, if it has some.
        """
        shape = self.compared_image(*small_image(depth, distance), direction, radius)
        if self.colours is None:
            return shape
        seen = jnp.full((SIDE, SIDE, 3), jnp.nan) if colours is None else small_colours(colours)
        return jnp.concatenate([shape, self.colours.compared(seen, direction, len(self.radii))])

    def compared_image(
        self,
        image: Float[Array, " pixels"],
        known: Float[Array, " pixels"],
        direction: Float[Array, " 3"],
        radius: float | Float[AnyArray, ""] = np.nan,
    ) -> Float[Array, " comparisons"]:
        """`compared`, of a `small_image`."""
        predicted, unknown = interpolated(self.images, direction), interpolated(self.images == UNKNOWN, direction)
        both = known * (unknown == 0)
        white = (both * (predicted / STEPS - image)) @ (WEIGHTS[:, None] * self.matcher.projection)
        seen, share = jnp.mean(both, axis=-1), jnp.mean(known)
        slope = interpolated(self.slopes, direction)
        scale = jnp.maximum(seen, _LEAST)
        square = jnp.mean(jnp.square(white), axis=-1) / scale
        lean = jnp.einsum("oyf,oyef->oye", white, slope) / white.shape[-1] / jnp.sqrt(scale)[..., None]
        common = seen / jnp.maximum(share, _LEAST)
        square += (1 - common) * (self.matcher.unseen - square)
        apart = jnp.concatenate([square[..., None], common[..., None] * lean, gram_of(slope)], axis=-1)
        told = (self.radii > 0) & (jnp.asarray(radius) > 0)
        ratio = jnp.where(told, radius, 1.0) / jnp.where(told, self.radii, 1.0)
        size = jnp.where(told, jnp.square(jnp.log(ratio) / self.matcher.size), 1.0)
        return jnp.append(jnp.concatenate([apart.reshape(len(size), -1), size[:, None]], axis=1).reshape(-1), share)

    def evidence(
        self, compared: Float[Array, "views comparisons"], present: Bool[Array, " views"], posed: bool
    ) -> Evidence:
        """What some views, of which the first is present, say together; `posed` if the object's yaw is known to be 0.

        A view counts by what it shows.
        """
        objects = len(self.radii)
        own = comparisons(objects)
        shares = jnp.where(present, jnp.maximum(compared[:, own - 1], _LEAST), 0.0)
        count = jnp.maximum(jnp.sum(shares), _LEAST)
        values = compared[:, : own - 1].reshape(len(compared), objects, -1)
        kept = values[..., :-1].reshape(*values.shape[:2], YAWS, KEPT)
        square, lean, gram = parted(jnp.einsum("v,voyk->oyk", shares / count, kept))
        square += jnp.where(posed & (jnp.arange(YAWS) > 0), _IMPOSSIBLE, 0.0)
        colours = ColourEvidence.of(compared[:, own:], present) if self.colours else None
        return Evidence(unexplained(square, lean, gram, count), square, lean, gram, values[0, :, -1], count, colours)

    def likelihood(self, evidence: Evidence) -> Float[Array, "objects yaws"]:
        """Logarithm of the likelihood of objects at yaws, by all that is compared."""
        objects = len(self.radii)
        found = self.matcher.likelihood(evidence.apart, evidence.count, objects) - 0.5 * evidence.size[:, None]
        if self.colours and evidence.colours:
            found += self.colours.matcher.likelihood(evidence.colours.apart, evidence.colours.count, objects)
        return found

    def hypotheses(self, evidence: Evidence) -> Float[Array, "objects yaws"]:
        """Log-probabilities of objects and yaws, if the object is none unknown."""
        return jax.nn.log_softmax(self.likelihood(evidence), axis=(0, 1))

    def beliefs(self, evidence: Evidence) -> Float[Array, " classes"]:
        """Log-probabilities of the objects and, last, of an unknown object."""
        hypotheses, objects = self.hypotheses(evidence), len(self.radii)
        best = jnp.argmax(hypotheses)
        apart, detail = evidence.apart.reshape(-1)[best], self.details[best // YAWS]
        odds = self.matcher.stranger @ self.matcher.strangeness(apart, detail, evidence.count, objects)
        if self.colours and evidence.colours:
            odds = self.colours.strange_odds(evidence.colours, best, apart, odds, objects)
        odds += 0.5 * (evidence.size[best // YAWS] - 1)
        known = jax.scipy.special.logsumexp(hypotheses, axis=1) + jax.nn.log_sigmoid(-odds)
        return jnp.append(known, jax.nn.log_sigmoid(odds))

    def gains(
        self, evidence: Evidence, directions: Float[Array, "candidates 3"], target: int | None = None
    ) -> Float[Array, " candidates"]:
        """Expected decrease of the entropy over objects in nats by one more view, if the object is none unknown.

        Each of the likeliest hypotheses is taken to be true in turn: it says what a camera at a candidate would see, and so what
        the belief would become. As in Denzler and Brown (2002), over objects and yaws; exact but for the errors of the view, of
        which is assumed that they are as large as the best hypothesis' so far, and for those of the sphere, which are assumed
        to be the likeliest.

        Args:
            evidence: of the views so far.
            directions: unit vectors from the object to the candidates.
            target: the object that alone matters: what counts is whether it is this one.
        """
        objects, count = len(self.radii), evidence.count
        flat = self.hypotheses(evidence).reshape(-1)
        now, index = jax.lax.top_k(flat, min(MOST_HYPOTHESES, flat.size))
        now = jax.nn.log_softmax(now)
        square, lean, gram = (
            part.reshape(flat.size, -1)[index] * count for part in (evidence.square, evidence.lean, evidence.gram)
        )
        least = jnp.min(evidence.apart)
        features, slope = (
            foreseen(grid, directions, index // YAWS, index % YAWS) for grid in (self.features, self.slopes)
        )
        # What a view would show if a hypothesis were true, with the error of the sphere that its views so far speak for.
        off = likeliest(lean, gram, 1.0)
        image = features - jnp.einsum("me,cmef->cmf", off, slope)
        number = features.shape[-1]
        squares = [jnp.sum(jnp.square(one), axis=-1) / number for one in (image, features)]
        products = jnp.einsum("cmf,cnf->cmn", image, features) / number
        more_square = squares[0][:, :, None] + squares[1][:, None] - 2 * products + least
        own = jnp.einsum("cnf,cnef->cne", features, slope)[:, None]
        more_lean = (own - jnp.einsum("cmf,cnef->cmne", image, slope)) / number
        apart = unexplained(
            (square[:, 0] + more_square) / (count + 1),
            (lean + more_lean) / (count + 1),
            ((gram + gram_of(slope)) / (count + 1))[:, None],
            count + 1,
        )
        likelihood = self.matcher.likelihood(apart, count + 1, objects)
        if self.colours and evidence.colours:
            likelihood += self.colours.expected(evidence.colours, directions, index, objects)
        after = jax.nn.log_softmax(likelihood - 0.5 * evidence.size[index // YAWS], axis=-1)
        answer = index // YAWS if target is None else index // YAWS == target
        same = (answer[:, None] == answer).astype(jnp.float32)

        def entropy(logarithms: Float[Array, "*batch hypotheses"]) -> Float[Array, "*batch"]:
            weights = jnp.exp(logarithms)
            return -jnp.sum(weights * jnp.log(jnp.maximum(weights @ same, 1e-30)), axis=-1)

        return entropy(now) - entropy(after) @ jnp.exp(now)


def differences_by_turn(
    features: Float[np.ndarray, "objects heights yaws features"],
) -> Float[np.ndarray, "objects objects yaws"]:
    """Mean squared difference of each two objects' images if the second is turned by each yaw; without those from below."""
    seen = features[:, 1:]
    # The products for all turns at once, by the Fourier transform over yaws.
    spectra = np.fft.rfft(seen, axis=2)
    both = np.einsum("ahwf,bhwf->abw", spectra, np.conj(spectra), optimize=True)
    products, squares = np.fft.irfft(both, n=YAWS, axis=2), np.square(seen).sum(axis=(1, 2, 3))
    return np.maximum(squares[:, None, None] + squares[:, None] - 2 * products, 0) / max(seen[:1].size, 1)


def symmetry_of(features: Float[np.ndarray, "heights yaws features"]) -> int:
    """The largest number of equal turns at each of which an object looks alike: a divisor of `YAWS`."""
    alike = differences_by_turn(features[None])[0, 0] < ALIKE
    return max(turns for turns in range(1, YAWS + 1) if YAWS % turns == 0 and alike[:: YAWS // turns].all())


def _filled(images: UInt8[AnyArray, "heights yaws pixels"]) -> Float[Array, "heights yaws pixels"]:
    """The images of an object, with its mean over all directions where they are not known."""
    images = jnp.asarray(images)
    known = images != UNKNOWN
    values = jnp.where(known, images, 0) / STEPS
    mean = jnp.sum(values, axis=(0, 1)) / jnp.maximum(jnp.sum(known, axis=(0, 1)), 1)
    return jnp.where(known, values, mean)
