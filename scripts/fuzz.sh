#!/usr/bin/env bash
# Fuzzes each decoder for FUZZ_SECONDS, 600 by default. An input that breaks one is kept in fuzz/artifacts.
set -euo pipefail
cd "$(dirname "$0")/../fuzz"

broken=()
for fuzzer in messages checkpoint recording openpi signature; do
    echo "== $fuzzer"
    mkdir -p "artifacts/$fuzzer"
    cargo run --quiet --release --locked --bin "$fuzzer" -- "corpus/$fuzzer" -artifact_prefix="artifacts/$fuzzer/" \
        -max_total_time="${FUZZ_SECONDS:-600}" -timeout=10 -rss_limit_mb=1024 -print_final_stats=1 || broken+=("$fuzzer")
done
[[ ${#broken[@]} -eq 0 ]] || { echo "broken: ${broken[*]}" >&2; exit 1; }
