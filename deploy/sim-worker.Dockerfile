# The simulator's worker.
#
#   docker build -f deploy/sim-worker.Dockerfile -t cpn-sim-worker .
ARG PYTHON_IMAGE=python:3.11-slim-bookworm

FROM ${PYTHON_IMAGE} AS python

# Software OpenGL, without a display.
RUN apt-get update -qq \
 && apt-get install -y -qq --no-install-recommends libegl1 libgl1-mesa-dri libopengl0 \
 && rm -rf /var/lib/apt/lists/*

FROM python AS build

COPY deploy/ca/ /usr/local/share/ca-certificates/
RUN update-ca-certificates >/dev/null
ENV PIP_CERT=/etc/ssl/certs/ca-certificates.crt PIP_NO_CACHE_DIR=1 SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt \
    UV_NO_CACHE=1 UV_LINK_MODE=copy UV_PYTHON_DOWNLOADS=never UV_COMPILE_BYTECODE=1 UV_PROJECT_ENVIRONMENT=/opt/cpn
RUN python3 -m venv /uv && /uv/bin/pip install --quiet uv==0.13.9
WORKDIR /src/sim-worker

# Dependencies first; `--build-arg EXTRAS="--extra jenga"` adds the Jenga scene's arm.
ARG EXTRAS=
COPY python/messages/pyproject.toml /src/python/messages/
COPY sim-worker/pyproject.toml sim-worker/uv.lock sim-worker/README.md ./
RUN /uv/bin/uv sync --quiet --locked --no-dev --no-install-local ${EXTRAS}

# The messages, generated when their package is built, and the worker.
COPY proto /src/proto
COPY python/messages /src/python/messages
COPY sim-worker/src src
RUN /uv/bin/uv sync --quiet --locked --no-dev --no-editable ${EXTRAS}

# Decimated meshes of every task, so that a worker finds them and writes nothing.
ENV XDG_CACHE_HOME=/cache MUJOCO_GL=egl PYTHONDONTWRITEBYTECODE=1
COPY deploy/sim-worker/warm_meshes.py /warm_meshes.py
RUN /opt/cpn/bin/python /warm_meshes.py && chmod -R a+rX /cache

FROM python

COPY --from=build /opt/cpn /opt/cpn
COPY --from=build /cache /cache
ENV PATH=/opt/cpn/bin:$PATH XDG_CACHE_HOME=/cache MUJOCO_GL=egl MESA_SHADER_CACHE_DISABLE=true PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1
USER 10001:10001
ENTRYPOINT ["cpn-sim-worker"]
CMD ["serve"]
