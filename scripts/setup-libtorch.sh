#!/usr/bin/env bash
# Lays the link `.libtorch` that `.cargo/config.toml` builds against.
# With LIBTORCH set, it points there. Otherwise the CPU half of the PyPI torch wheel is unpacked, once per user, into
# the cache: 440 MB instead of the 5.2 GB of a full Python install.
set -euo pipefail
cd "$(dirname "$0")/.."

version=2.13.0 # what tch 0.26 binds
dir=${LIBTORCH:-${XDG_CACHE_HOME:-$HOME/.cache}/cpn/libtorch-$version}

if [[ -z ${LIBTORCH:-} && ! -e $dir/build-version ]]; then
  echo "fetching libtorch $version into $dir (540 MB, once)"
  work=$(mktemp -d)
  trap 'rm -rf "$work"' EXIT
  cat >"$work/requirements.txt" <<'EOF'
torch==2.13.0 --hash=sha256:60fcdcb2f3876e21146cb4524ef06397d727ca9ad5f020818547e25075fe3cb7
nvidia-cuda-cupti==13.0.85 --hash=sha256:4eb01c08e859bf924d222250d2e8f8b8ff6d3db4721288cf35d14252a4d933c8
nvidia-cuda-runtime==13.0.96 --hash=sha256:7f82250d7782aa23b6cfe765ecc7db554bd3c2870c43f3d1821f1d18aebf0548
EOF
  python3 -m pip download --quiet --no-deps --require-hashes --python-version 3.11 --only-binary :all: \
    --dest "$work" --requirement "$work/requirements.txt"
  python3 - "$work" <<'EOF'
import pathlib, sys, zipfile

work = pathlib.Path(sys.argv[1])
# libtorch_cpu.so of a CUDA build needs the profiler and runtime libraries, and no other part of CUDA.
wanted = ("torch/lib/libtorch_cpu.so", "torch/lib/libc10.so", "torch/lib/libgomp.so.1", "torch/include/",
          "nvidia/cu13/lib/libcupti.so.13", "nvidia/cu13/lib/libcudart.so.13")
for wheel in work.glob("*.whl"):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(work, [n for n in archive.namelist() if n.startswith(wanted)])
EOF
  mkdir -p "$(dirname "$dir")"
  mv "$work"/nvidia/cu13/lib/*.so.13 "$work/torch/lib/"
  echo 'INPUT(-ltorch_cpu -lc10)' >"$work/torch/lib/libtorch.so" # the wheel's own libtorch.so is a stub that loads CUDA
  rm -rf "$dir.partial" && mv "$work/torch" "$dir.partial"
  echo "$version" >"$dir.partial/build-version" # also the mark that the folder is whole
  rm -rf "$dir" && mv "$dir.partial" "$dir"
fi
ln -sfn "$dir" .libtorch
