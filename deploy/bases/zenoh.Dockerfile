# Stand-in for eclipse/zenoh: zenohd from crates.io, at the same path and behind the same entry point. The public image is
# Alpine's and has the router's plugins too.
ARG DEBIAN_IMAGE=debian:bookworm-slim
ARG RUST_IMAGE=rust:1.95-slim-bookworm
FROM ${RUST_IMAGE} AS build

ENV CARGO_PROFILE_RELEASE_STRIP=symbols
RUN cargo install zenohd --version 1.10.2 --locked --root /out

FROM ${DEBIAN_IMAGE}

COPY --from=build /out/bin/zenohd /zenohd
RUN printf '#!/bin/sh\necho " * Starting: /zenohd $*"\nexec /zenohd "$@"\n' >/entrypoint.sh && chmod +x /entrypoint.sh
EXPOSE 7446/udp 7447/tcp 8000/tcp
ENV RUST_LOG=info
ENTRYPOINT ["/entrypoint.sh"]
