# Stand-in for rust:1.95-slim-bookworm: this machine's toolchain on Debian; make.sh lays out the context.
ARG DEBIAN_IMAGE=debian:bookworm-slim
FROM ${DEBIAN_IMAGE}

RUN apt-get update -qq \
 && apt-get install -y -qq --no-install-recommends ca-certificates gcc g++ libc6-dev make pkg-config \
 && rm -rf /var/lib/apt/lists/*
COPY cargo/ /usr/local/cargo/
COPY toolchain/ /usr/local/rustup/toolchains/1.95/
ENV CARGO_HOME=/usr/local/cargo \
    PATH=/usr/local/cargo/bin:/usr/local/rustup/toolchains/1.95/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
