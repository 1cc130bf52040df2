#!/usr/bin/env bash
# Local stand-ins for the public base images, under the same names, for a machine that reaches Debian's packages,
# crates.io and PyPI but no image registry. An image that is there already is kept, whether pulled or made here.
#
# Sources of packages, additional certificate authorities and pip's indexes are this machine's own: they are read from its
# configuration and end up in the images. So images made from these bases are for this machine and its users.
set -euo pipefail
cd "$(dirname "$0")"

debian=${DEBIAN_IMAGE:-debian:bookworm-slim}
rust=${RUST_IMAGE:-rust:1.95-slim-bookworm}
python=${PYTHON_IMAGE:-python:3.11-slim-bookworm}
zenoh=${ZENOH_IMAGE:-eclipse/zenoh:1.10.2}
prometheus=${PROMETHEUS_IMAGE:-prom/prometheus:v3.5.0}
certificates=${SSL_CERT_FILE:-/etc/ssl/certs/ca-certificates.crt}

work=$(mktemp -d)
sudo=()
((EUID == 0)) || sudo=(sudo)
trap '"${sudo[@]}" rm -rf "$work"' EXIT

exists() { docker image inspect "$1" >/dev/null 2>&1 && echo "$1 is there already"; }

# Repositories of Debian bookworm that this machine installs from; Debian's own if it is another system.
apt_sources() {
  local sources
  sources=$(apt-get indextargets --format '$(REPO_URI) $(RELEASE) $(COMPONENT)' 'Created-By: Packages' 2>/dev/null |
    grep -E ' bookworm(-updates|-security)? main$' | sort -u | sed 's/^/deb /' || true)
  if ! grep -q ' bookworm main$' <<<"$sources"; then
    sources='deb http://deb.debian.org/debian bookworm main
deb http://deb.debian.org/debian bookworm-updates main
deb http://deb.debian.org/debian-security bookworm-security main'
  fi
  echo "$sources"
}

# Certificates of the second bundle that the first one lacks, as one file each.
additional_certificates() {
  awk -v folder="$3" '
    /BEGIN CERTIFICATE/ { body = "" }
    { body = body $0 "\n" }
    /END CERTIFICATE/ {
      if (FNR == NR) known[body] = 1
      else if (!(body in known)) printf "%s", body > (folder "/machine-" ++count ".crt")
    }' "$1" "$2"
}

# pip's settings that mean the same in a container.
pip_configuration() {
  echo '[global]'
  echo 'cert = /etc/ssl/certs/ca-certificates.crt'
  python3 -m pip config list 2>/dev/null |
    sed -nE "s/^global\.((extra-)?index-url|trusted-host)='(.*)'$/\1 = \3/p"
}

make_debian() {
  if ! command -v debootstrap >/dev/null; then
    "${sudo[@]}" apt-get update -qq
    "${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends debootstrap
  fi
  local root=$work/debian sources
  sources=$(apt_sources)
  "${sudo[@]}" debootstrap --variant=minbase --include=ca-certificates bookworm "$root" \
    "$(awk '$3 == "bookworm" { print $2; exit }' <<<"$sources")" >"$work/debootstrap.log" ||
    { tail -n 20 "$work/debootstrap.log" >&2; exit 1; }

  mkdir "$work/certificates"
  additional_certificates "$root/etc/ssl/certs/ca-certificates.crt" "$certificates" "$work/certificates"
  find "$work/certificates" -name '*.crt' -exec "${sudo[@]}" cp {} "$root/usr/local/share/ca-certificates/" \;
  "${sudo[@]}" chroot "$root" update-ca-certificates >/dev/null 2>&1
  "${sudo[@]}" tee "$root/etc/apt/sources.list" <<<"$sources" >/dev/null
  pip_configuration | "${sudo[@]}" tee "$root/etc/pip.conf" >/dev/null

  # What the public slim image leaves out, too.
  "${sudo[@]}" tee "$root/etc/dpkg/dpkg.cfg.d/slim" >/dev/null <<'CFG'
path-exclude /usr/share/doc/*
path-include /usr/share/doc/*/copyright
path-exclude /usr/share/man/*
path-exclude /usr/share/info/*
path-exclude /usr/share/locale/*
CFG
  "${sudo[@]}" tee "$root/etc/apt/apt.conf.d/slim" >/dev/null <<'CFG'
DPkg::Post-Invoke { "rm -f /var/cache/apt/archives/*.deb"; };
Dir::Cache::pkgcache "";
Dir::Cache::srcpkgcache "";
Acquire::Languages "none";
CFG
  "${sudo[@]}" find "$root/usr/share/doc" -type f ! -name copyright -delete
  "${sudo[@]}" rm -rf "$root"/usr/share/{man,info,locale}/* "$root"/var/lib/apt/lists/* "$root"/var/cache/apt/* \
    "$root"/var/log/*.log "$root/debootstrap"
  "${sudo[@]}" tar -C "$root" --numeric-owner -c . | docker import --change 'CMD ["bash"]' - "$debian" >/dev/null
}

make_rust() {
  local context=$work/rust sysroot
  sysroot=$(rustc --print sysroot)
  [[ $(rustc --version) == "rustc 1.95."* ]] || { echo "expected Rust 1.95, got $(rustc --version)" >&2; exit 1; }
  mkdir -p "$context/toolchain/bin" "$context/cargo"
  cp "$sysroot"/bin/{cargo,rustc,rustdoc} "$context/toolchain/bin/"
  cp -r "$sysroot/lib" "$context/toolchain/"
  # A mirror of crates.io, if this machine uses one.
  cp "${CARGO_HOME:-$HOME/.cargo}"/config.toml "$context/cargo/" 2>/dev/null || true
  docker build --build-arg DEBIAN_IMAGE="$debian" -t "$rust" -f rust.Dockerfile "$context"
}

# The other bases are Debian's packages, or made from crates.io: no file of this machine is in them.
make_from() { docker build --build-arg DEBIAN_IMAGE="$debian" --build-arg RUST_IMAGE="$rust" -t "$2" - <"$1.Dockerfile"; }

exists "$debian" || make_debian
exists "$rust" || make_rust
exists "$python" || make_from python "$python"
exists "$prometheus" || make_from prometheus "$prometheus"
exists "$zenoh" || make_from zenoh "$zenoh"
