#!/usr/bin/env bash
# Records the demonstrations of all 24 tasks: workers stream expert episodes to the trainer's service, which keeps each as
# an MCAP file. An interrupted run is simply run again. Everything is read and checked at the end.
set -euo pipefail
cd "$(dirname "$0")/.."

episodes=${EPISODES:-100}
dataset=data/demonstrations
log=runs/recorder.log
endpoint=tcp/127.0.0.1:$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')

mkdir -p runs
trap 'kill $(jobs -p) 2>/dev/null || true; wait' EXIT
target/release/cpn-trainer serve --dataset "$dataset" --listen "$endpoint" 2>"$log" &
recorder=$!
"$CPN_SIM_WORKER" demonstrate --episodes "$episodes" --connect "$endpoint" &

# Whichever ends first: without a recorder the workers would go on asking for it for minutes.
status=0
wait -n -p ended || status=$?
if ((status != 0 || ended == recorder)); then
    echo "recording failed; the end of $log:" >&2
    tail -n 20 "$log" >&2
    exit 1
fi
target/release/cpn-trainer verify --dataset "$dataset" --tasks 24 --episodes "$episodes"
