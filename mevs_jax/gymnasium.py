"""Active recognition for Gymnasium; see `mevs_jax.environment.gymnasium`."""

from mevs_jax.environment.gymnasium import NAME as NAME
from mevs_jax.environment.gymnasium import ActiveRecognitionEnv as ActiveRecognitionEnv
from mevs_jax.environment.gymnasium import ActiveRecognitionVectorEnv as ActiveRecognitionVectorEnv
