#!/usr/bin/env bash
# Debian packages that the rest builds on. Needs root only if something is missing.
set -euo pipefail

missing=()
# Software OpenGL for headless rendering.
for package in libegl1 libgl1-mesa-dri libopengl0; do
  dpkg-query --show --showformat='${Status}' "$package" 2>/dev/null | grep -q 'install ok installed' || missing+=("$package")
done
command -v c++ >/dev/null || missing+=(g++)                           # torch-sys compiles C++
python3 -c 'import ensurepip, venv' 2>/dev/null || missing+=(python3-venv) # Debian splits it off
((${#missing[@]})) || exit 0

sudo=()
((EUID == 0)) || sudo=(sudo)
echo "installing ${missing[*]}"
"${sudo[@]}" apt-get update -qq
"${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}"
