"""The results of an evaluation, as `metrics.json` and `seeds.json` hold them. Shares are in [0, 1]; intervals cover 95 %."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from eval.config import RenderingConfig
from eval.walks.ladder import Knows
from train.results.records import named

_Pair = Float[np.ndarray, "2"]
_Steps = Float[np.ndarray, " steps"]
_StepIntervals = Float[np.ndarray, "steps 2"]
_Grid = Float[np.ndarray, "limits thresholds"]
_GridIntervals = Float[np.ndarray, "limits thresholds 2"]


@dataclass(frozen=True)
class Summary:
    """One policy: by limit on views and threshold, and after each number of views (`after_views`)."""

    accuracy: _Grid
    interval: _GridIntervals
    class_accuracy: _Grid
    views_used: _Grid
    after_views: _Steps
    after_views_interval: _StepIntervals
    travelled: _Steps
    area: float
    area_interval: _Pair


@dataclass(frozen=True)
class PolicySummary(Summary):
    """One policy, with its answers in the cell of the grid that the thesis shows first."""

    headline_interval: _Pair
    headline_confusion: Float[np.ndarray, "classes classes"]


@dataclass(frozen=True)
class Difference:
    """One policy minus another on the same objects and start views."""

    difference: _Grid
    interval: _GridIntervals
    after_views_difference: _Steps
    after_views_interval: _StepIntervals
    views_used_difference: _Grid
    area_difference: float
    area_interval: _Pair


@dataclass(frozen=True)
class Reach:
    """Numbers of views that policies need for an accuracy; None where it is never reached."""

    accuracy: float
    views: dict[str, float | None]
    interval: dict[str, tuple[float | None, float | None]]


@dataclass(frozen=True)
class Share:
    """An accuracy."""

    accuracy: float
    interval: _Pair


@dataclass(frozen=True)
class SingleViews(Share):
    """Accuracy on single views, and on the sum of all reachable views."""

    class_accuracy: float
    by_view: Float[np.ndarray, " views"]
    all_views: float
    all_views_interval: _Pair


@dataclass(frozen=True)
class EntropyErrors:
    """Squared error of the predicted entropies, and of two predictors that receive no view."""

    pointnet2: float
    pointnet2_interval: _Pair
    mean_map: float
    mean_map_interval: _Pair
    class_mean_map: float
    class_mean_map_interval: _Pair
    better_than_mean_map: _Pair
    by_class: dict[str, float | None]
    explained_variance: float | None


@dataclass(frozen=True)
class Listed:
    """A policy in the order of the tables; `own` names the source of a user's, and is None for the others."""

    policy: str
    title: str
    knows: Knows
    own: dict[str, str] | None = named(omitted=True)

    @property
    def plain_title(self) -> str:
        """The title without the dash that indents it in tables."""
        return self.title.lstrip("— ")


@dataclass(frozen=True)
class FixedOrder:
    """The best fixed order of views, by what it was fitted."""

    fitted_by: str


@dataclass(frozen=True)
class Headline:
    """A cell of the grid."""

    threshold: float
    max_views: int


@dataclass(frozen=True)
class Stop:
    """Walks that stop at a risk: `sure` of them do, with this `error`; `excess` is above zero where it exceeds the risk."""

    risk: float
    sure: float
    error: float | None
    excess: _Pair
    accuracy: float
    views: float


@dataclass(frozen=True)
class Reading:
    """The confidence of one policy's walks, read in one way: its calibration after each number of views."""

    accuracy: _Steps
    ece: _Steps
    nll: _Steps
    validation_ece: _Steps
    temperatures: _Steps | None = named(omitted=True)
    reliability: Float[np.ndarray, "3 steps bins"] | None = named(omitted=True)
    stopping: tuple[Stop, ...] | None = named(omitted=True)


@dataclass(frozen=True)
class Confidence:
    """The confidence of one policy's walks, by how it is read."""

    readings: dict[str, Reading]

    @property
    def temperatures(self) -> _Steps:
        """The temperature of the sum of logits after each number of views."""
        fitted = self.readings["temperature"].temperatures
        assert fitted is not None
        return fitted


@dataclass(frozen=True)
class Moved:
    """Accuracy and distance (radians) after each number of views, with a cost of movement."""

    cost: float
    after_views: _Steps
    travelled: _Steps


@dataclass(frozen=True)
class CodeGain:
    """Gain over random in the grid with one switch of the published code; only the title if it was not evaluated."""

    title: str
    difference: _Grid | None = None
    interval: _GridIntervals | None = named(omitted=True)
    mean: float | None = named(omitted=True)
    mean_interval: _Pair | None = named(omitted=True)
    above_zero: int | None = named(omitted=True)
    cells: int | None = named(omitted=True)


@dataclass(frozen=True)
class ThesisGain:
    """The mean of the thesis's gain over random in its 56 cells, and the number of cells above zero, in one of its tables."""

    table: int
    mean: float
    above_zero: int


@dataclass(frozen=True)
class Compatibility:
    """Differences between the thesis's text and its published code; accuracy on single views by classifier and split."""

    rows: dict[str, CodeGain]
    thesis: ThesisGain | None
    single_view_accuracy: dict[str, dict[str, float]] | None


@dataclass(frozen=True)
class Ascents:
    """The policies by differentiable rendering beside some others; `against` holds differences by baseline."""

    objects: int
    views_without_surface: int
    views: int
    settings: RenderingConfig
    ladder: tuple[Listed, ...]
    policies: dict[str, Summary]
    against: dict[str, dict[str, Difference]]


@dataclass(frozen=True)
class Metrics:
    """All that `metrics.json` holds but its identity."""

    objects: int
    validation_objects: int
    left_out: dict[str, dict[str, str]]
    views: int
    starts: int
    reachable: Bool[np.ndarray, " views"]
    random_draws_per_start: int
    random_exact_up_to: int
    thresholds: Float[np.ndarray, " thresholds"]
    max_views: Int[np.ndarray, " limits"]
    headline: Headline
    single_view: SingleViews
    entropy: EntropyErrors
    ladder: tuple[Listed, ...]
    policies: dict[str, PolicySummary]
    against_random: dict[str, Difference]
    fixed_order: FixedOrder
    views_to_reach: dict[int, Reach]
    best_pair: Share
    confidence: dict[str, Confidence]
    movement: dict[str, tuple[Moved, ...]]
    compatibility: Compatibility
    ascents: Ascents | None = named("climbing", omitted=True)

    @property
    def titles(self) -> dict[str, str]:
        """Titles of the policies by name, as sentences use them."""
        return {listed.policy: listed.plain_title for listed in self.ladder}

    @property
    def own(self) -> tuple[Listed, ...]:
        """The policies of the user."""
        return tuple(listed for listed in self.ladder if listed.own is not None)

    @property
    def most_views(self) -> int:
        """Length of the walks."""
        return len(self.policies["random"].after_views)


@dataclass(frozen=True)
class TrainingsRow:
    """One policy after one number of views, over several trainings; `each` and `difference_each` are by training."""

    policy: str
    title: str
    knows: Knows
    views: int
    accuracy: float
    over_objects: _Pair
    over_both: _Pair
    difference: float
    difference_over_objects: _Pair
    difference_over_both: _Pair
    each: Float[np.ndarray, " trainings"]
    difference_each: Float[np.ndarray, " trainings"]


@dataclass(frozen=True)
class OverTrainings:
    """All that `seeds.json` holds but its identity."""

    seeds: int
    objects: int
    single_view: Float[np.ndarray, " trainings"]
    rows: tuple[TrainingsRow, ...]
