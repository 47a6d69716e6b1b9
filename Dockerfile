# An image for pods: the checkout with everything that studies need. Build it for the accelerator at hand:
#   docker build --build-arg EXTRA=cuda -t mevs_jax .      (cuda, tpu, or empty for CPUs)
#   docker run --gpus all -v $PWD/runs:/mevs_jax/runs mevs_jax run --preset thesis --data modelnet10
FROM python:3.12-slim-bookworm
ARG EXTRA=""
# What Open3D's renderer and Poisson reconstruction need of the system; all else is in the Python packages.
RUN apt-get update && apt-get install --yes --no-install-recommends git libgl1 libgomp1 libx11-6 libusb-1.0-0 \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /mevs_jax
COPY requirements.lock pyproject.toml README.md LICENSE ./
RUN python -m pip install --no-cache-dir -r requirements.lock
COPY . .
RUN python -m pip install --no-cache-dir --no-deps --editable . \
    && if [ -n "$EXTRA" ]; then python -m pip install --no-cache-dir --constraint requirements.lock --editable ".[$EXTRA]"; fi
ENTRYPOINT ["mevs"]
CMD ["--help"]
