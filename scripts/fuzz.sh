#!/usr/bin/env bash
# Fuzzes each decoder for FUZZ_SECONDS, 600 by default. An input that breaks one is kept in crates/fuzz/artifacts.
#
# Coverage instrumentation of this repository's code alone, by cargo's compiler wrapper for members of the workspace:
# dependencies are those of `make test`.
set -euo pipefail
cd "$(dirname "$0")/.."

fuzzers=(checkpoint kserve messages openpi recording signature)
RUSTC_WORKSPACE_WRAPPER="$PWD/scripts/rustc-with-coverage.sh" \
    cargo build --workspace --locked --features fuzz/fuzzers "${fuzzers[@]/#/--bin=}"

broken=()
for fuzzer in "${fuzzers[@]}"; do
    echo "== $fuzzer"
    corpus="crates/fuzz/corpus/$fuzzer" artifacts="crates/fuzz/artifacts/$fuzzer"
    mkdir -p "$corpus" "$artifacts"
    "target/debug/$fuzzer" "$corpus" -artifact_prefix="$artifacts/" -max_total_time="${FUZZ_SECONDS:-600}" \
        -timeout=10 -rss_limit_mb=1024 -verbosity=0 -print_final_stats=1 || broken+=("$fuzzer")
done
[[ ${#broken[@]} -eq 0 ]] || { echo "broken: ${broken[*]}" >&2; exit 1; }
