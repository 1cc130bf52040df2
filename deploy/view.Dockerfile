# The live view.
#
#   docker build -f deploy/view.Dockerfile -t cpn-view .
ARG PYTHON_IMAGE=python:3.11-slim-bookworm

FROM ${PYTHON_IMAGE} AS build

COPY deploy/ca/ /usr/local/share/ca-certificates/
RUN update-ca-certificates >/dev/null
ENV PIP_CERT=/etc/ssl/certs/ca-certificates.crt PIP_NO_CACHE_DIR=1 SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt \
    UV_NO_CACHE=1 UV_LINK_MODE=copy UV_PYTHON_DOWNLOADS=never UV_COMPILE_BYTECODE=1 UV_PROJECT_ENVIRONMENT=/opt/cpn
RUN python3 -m venv /uv && /uv/bin/pip install --quiet uv==0.13.9
WORKDIR /src/python/view

# Dependencies first.
COPY python/messages/pyproject.toml /src/python/messages/
COPY python/view/pyproject.toml python/view/uv.lock python/view/README.md ./
RUN /uv/bin/uv sync --quiet --locked --no-dev --no-install-local

# The messages, generated when their package is built, and the view.
COPY proto /src/proto
COPY python/messages /src/python/messages
COPY python/view/src src
RUN /uv/bin/uv sync --quiet --locked --no-dev --no-editable

# Rerun's server sends no usage data.
RUN XDG_CONFIG_HOME=/config /opt/cpn/bin/rerun analytics disable && chmod -R a+rX /config

FROM ${PYTHON_IMAGE}

COPY --from=build /opt/cpn /opt/cpn
COPY --from=build /config /config
ENV PATH=/opt/cpn/bin:$PATH XDG_CONFIG_HOME=/config PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
USER 10001:10001
ENTRYPOINT ["cpn-view"]
CMD ["live"]
