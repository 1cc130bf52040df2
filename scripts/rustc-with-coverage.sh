#!/usr/bin/env bash
# Wrapper of rustc that adds the coverage which libFuzzer follows. Build scripts run without a fuzzer, and go without.
set -euo pipefail

coverage=(
    -C passes=sancov-module
    -C "llvm-args=-sanitizer-coverage-level=4 -sanitizer-coverage-inline-8bit-counters -sanitizer-coverage-pc-table -sanitizer-coverage-trace-compares"
)
[[ " $* " != *" --crate-name build_script_"* ]] || coverage=()
exec "$@" "${coverage[@]}"
