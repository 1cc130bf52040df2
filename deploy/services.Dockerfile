# The Rust services: one build, one image for each of the targets planner, trainer, evaluator and certs.
#
#   docker build -f deploy/services.Dockerfile --target planner -t cpn-planner .
#
# No BuildKit is needed. Dependencies are compiled from manifests alone (cargo-chef), so that a changed source recompiles this
# project only.
ARG DEBIAN_IMAGE=debian:bookworm-slim
ARG RUST_IMAGE=rust:1.95-slim-bookworm
ARG PYTHON_IMAGE=python:3.11-slim-bookworm

# libtorch, from the PyPI wheel.
FROM ${PYTHON_IMAGE} AS libtorch

ENV PIP_CERT=/etc/ssl/certs/ca-certificates.crt PIP_NO_CACHE_DIR=1 LIBTORCH= XDG_CACHE_HOME=/cache
COPY deploy/ca/ /usr/local/share/ca-certificates/
RUN update-ca-certificates >/dev/null
WORKDIR /src
COPY scripts/setup-libtorch.sh scripts/
RUN scripts/setup-libtorch.sh && mv "$(readlink -f .libtorch)" /libtorch

FROM ${RUST_IMAGE} AS rust

COPY deploy/ca/ /usr/local/share/ca-certificates/
RUN update-ca-certificates >/dev/null \
 && apt-get update -qq \
 && apt-get install -y -qq --no-install-recommends g++ \
 && rm -rf /var/lib/apt/lists/*
ENV SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt CARGO_HTTP_CAINFO=/etc/ssl/certs/ca-certificates.crt
RUN cargo install cargo-chef --version 0.1.78 --locked && rm -rf /usr/local/cargo/registry
WORKDIR /src

# Manifests and lock file, distilled: the same bytes as long as no dependency changes.
FROM rust AS recipe

COPY Cargo.toml Cargo.lock ./
COPY .cargo .cargo
COPY crates crates
COPY services services
RUN cargo chef prepare --recipe-path /recipe.json

FROM rust AS build

COPY --from=libtorch /libtorch .libtorch
COPY --from=recipe /recipe.json .
# The libraries lie where the final images have them; the variable replaces the paths of .cargo/config.toml.
ENV RUSTFLAGS="-C link-arg=-Wl,-rpath,/usr/local/lib/libtorch" CARGO_PROFILE_RELEASE_STRIP=symbols
RUN cargo chef cook --release --locked --recipe-path recipe.json
COPY Cargo.toml Cargo.lock ./
COPY .cargo .cargo
COPY proto proto
COPY crates crates
COPY services services
RUN cargo build --release --locked --workspace --bins

# Empty folders, owned by the services' user: a volume that is mounted there the first time takes the ownership over.
RUN mkdir -p /folders/data /folders/report \
 && for folder in authority router planner trainer worker evaluator viewer client operator; do \
      mkdir -p "/folders/certificates/$folder"; \
    done

FROM ${DEBIAN_IMAGE} AS base

USER 10001:10001
WORKDIR /
COPY --from=build /src/target/release/cpn-health /usr/local/bin/

FROM base AS torch

COPY --from=libtorch /libtorch/lib/libtorch_cpu.so /libtorch/lib/libc10.so /libtorch/lib/libgomp.so.1 \
     /libtorch/lib/libcupti.so.13 /libtorch/lib/libcudart.so.13 /usr/local/lib/libtorch/

FROM torch AS planner

COPY --chown=10001:10001 models/ /models/
COPY --from=build /src/target/release/cpn-planner /usr/local/bin/
ENTRYPOINT ["cpn-planner"]

FROM torch AS trainer

COPY --from=build --chown=10001:10001 /folders/data /data
COPY --from=build /src/target/release/cpn-trainer /usr/local/bin/
WORKDIR /data
ENTRYPOINT ["cpn-trainer"]
CMD ["serve"]

FROM base AS evaluator

COPY --from=build --chown=10001:10001 /folders/report /report
COPY --from=build /src/target/release/cpn-eval /usr/local/bin/
ENTRYPOINT ["cpn-eval"]

FROM base AS certs

COPY --from=build --chown=10001:10001 /folders/certificates /certificates
COPY --from=build /src/target/release/cpn-certs /usr/local/bin/
ENTRYPOINT ["cpn-certs"]
