"""The public names for type checkers; at run time `__init__.py` imports them when they are first used."""

from mevs_jax.beliefs import (
    CalibratedFusion as CalibratedFusion,
)
from mevs_jax.beliefs import (
    confidence as confidence,
)
from mevs_jax.beliefs import (
    discounted as discounted,
)
from mevs_jax.beliefs import (
    mean_of_probabilities as mean_of_probabilities,
)
from mevs_jax.calibration import (
    calibration_error_by_chance as calibration_error_by_chance,
)
from mevs_jax.calibration import (
    expected_calibration_error as expected_calibration_error,
)
from mevs_jax.calibration import (
    fit_exponent as fit_exponent,
)
from mevs_jax.calibration import (
    fit_temperature as fit_temperature,
)
from mevs_jax.calibration import (
    negative_log_likelihood as negative_log_likelihood,
)
from mevs_jax.calibration import (
    reliability as reliability,
)
from mevs_jax.cameras import (
    Camera as Camera,
)
from mevs_jax.cameras import (
    cameras_at as cameras_at,
)
from mevs_jax.cameras import (
    look_at_origin as look_at_origin,
)
from mevs_jax.cameras import (
    orbit as orbit,
)
from mevs_jax.cameras import (
    partial_cloud as partial_cloud,
)
from mevs_jax.cameras import (
    pixel_directions as pixel_directions,
)
from mevs_jax.cameras import (
    unproject as unproject,
)
from mevs_jax.decisions import (
    Decision as Decision,
)
from mevs_jax.decisions import (
    NextView as NextView,
)
from mevs_jax.entropy import (
    depth_entropy as depth_entropy,
)
from mevs_jax.entropy import (
    depth_levels as depth_levels,
)
from mevs_jax.entropy import (
    level_entropy as level_entropy,
)
from mevs_jax.entropy import (
    quantise_depth as quantise_depth,
)
from mevs_jax.entropy import (
    shannon_entropy as shannon_entropy,
)
from mevs_jax.environment import (
    ActiveRecognition as ActiveRecognition,
)
from mevs_jax.environment import (
    EnvironmentObservation as EnvironmentObservation,
)
from mevs_jax.environment import (
    EnvironmentState as EnvironmentState,
)
from mevs_jax.metrics import (
    accuracy as accuracy,
)
from mevs_jax.metrics import (
    bootstrap_interval as bootstrap_interval,
)
from mevs_jax.metrics import (
    bootstrap_means as bootstrap_means,
)
from mevs_jax.metrics import (
    class_accuracy as class_accuracy,
)
from mevs_jax.metrics import (
    confusion_matrix as confusion_matrix,
)
from mevs_jax.models import (
    Abstraction as Abstraction,
)
from mevs_jax.models import (
    PointNet2 as PointNet2,
)
from mevs_jax.models import (
    Recogniser as Recogniser,
)
from mevs_jax.models import (
    ResNet as ResNet,
)
from mevs_jax.models import (
    ViewPolicy as ViewPolicy,
)
from mevs_jax.models import (
    count_parameters as count_parameters,
)
from mevs_jax.models.pretrained import (
    pointnet2_from_torch as pointnet2_from_torch,
)
from mevs_jax.models.pretrained import (
    resnet_from_torch as resnet_from_torch,
)
from mevs_jax.models.set_fusion import (
    SetFusion as SetFusion,
)
from mevs_jax.points.ops import (
    ball_query as ball_query,
)
from mevs_jax.points.ops import (
    farthest_point_sample as farthest_point_sample,
)
from mevs_jax.policies.base import (
    Knowledge as Knowledge,
)
from mevs_jax.policies.base import (
    Observation as Observation,
)
from mevs_jax.policies.base import (
    Policy as Policy,
)
from mevs_jax.policies.base import (
    Scene as Scene,
)
from mevs_jax.policies.base import (
    SelectionState as SelectionState,
)
from mevs_jax.policies.base import (
    candidates as candidates,
)
from mevs_jax.policies.base import (
    maxima_first as maxima_first,
)
from mevs_jax.policies.base import (
    with_movement as with_movement,
)
from mevs_jax.policies.learned import (
    learned as learned,
)
from mevs_jax.policies.oracles import (
    fused_oracle as fused_oracle,
)
from mevs_jax.policies.registry import (
    POLICIES as POLICIES,
)
from mevs_jax.policies.registry import (
    policy_named as policy_named,
)
from mevs_jax.policies.registry import (
    register_policy as register_policy,
)
from mevs_jax.selection import (
    Episode as Episode,
)
from mevs_jax.selection import (
    ViewTable as ViewTable,
)
from mevs_jax.selection import (
    by_attention as by_attention,
)
from mevs_jax.selection import (
    select_from_table as select_from_table,
)
from mevs_jax.selection import (
    select_views as select_views,
)
from mevs_jax.selection import (
    sum_of_logits as sum_of_logits,
)
from mevs_jax.viewpoints import (
    ViewGraph as ViewGraph,
)
from mevs_jax.viewpoints import (
    fibonacci_sphere as fibonacci_sphere,
)
from mevs_jax.viewpoints import (
    local_maxima as local_maxima,
)
from mevs_jax.viewpoints import (
    nested_lattice as nested_lattice,
)
from mevs_jax.viewpoints import (
    platonic_solid as platonic_solid,
)
from mevs_jax.viewpoints import (
    ring_lattice as ring_lattice,
)
from mevs_jax.viewpoints import (
    viewpoint_lattice as viewpoint_lattice,
)

__version__: str
__all__: list[str]
from mevs_jax.cameras import (
    ViewCamera as ViewCamera,
)
from mevs_jax.canonical import (
    CanonicalView as CanonicalView,
)
from mevs_jax.canonical import (
    canonical_view as canonical_view,
)
from mevs_jax.sphere import (
    estimate_sphere as estimate_sphere,
)
