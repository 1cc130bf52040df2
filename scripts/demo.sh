#!/usr/bin/env bash
# The closed loop on this machine alone: a planner and two simulator workers, peers on the loopback interface, and an
# evaluator that lets each method try each task. Everything stops with it, also on Ctrl-C.
set -euo pipefail
cd "$(dirname "$0")/.."

# Two tasks that no model has seen, one that it was trained on; see docs/decisions/0004-demonstration-tasks.md.
tasks=door-lock,drawer-close,plate-slide
out=runs/demo
export CPN_NAMESPACE=demo-$$
endpoint=tcp/127.0.0.1:$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')

rm -rf "$out" && mkdir -p "$out"
started=()
stop() {
  trap - EXIT INT TERM
  ((${#started[@]})) && kill "${started[@]}" 2>/dev/null || true
  wait
}
trap stop EXIT
trap 'stop; exit 130' INT TERM

target/release/cpn-planner --models-dir models --grpc-listen 127.0.0.1:0 --listen "$endpoint" 2>"$out/planner.log" &
started+=($!)
for worker in w0 w1; do
  "$CPN_SIM_WORKER" serve --worker "$worker" --connect "$endpoint" --namespace "$CPN_NAMESPACE" 2>"$out/$worker.log" &
  started+=($!)
done

target/release/cpn-eval run --workers 2 --models cpn,te-bc,random --tasks "$tasks" --trials 20 \
  --connect "$endpoint" --out "$out"
