#!/usr/bin/env bash
# The paper's Jenga experiment in the simulated arm: 21 demonstrations, a model of positions for each horizon and number of
# updates, the pair whose plans end nearest to the trained targets, then plans to trained and to offset targets, executed.
set -euo pipefail
cd "$(dirname "$0")/.."

grid=('8 2' '8 1' '5 2' '3 2' '5 1' '3 1' '1 2' '1 1')
seeds=(0 1 2)
out=runs/jenga
export dataset=data/jenga
export CPN_NAMESPACE=jenga-$$
endpoint=tcp/127.0.0.1:$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
python=sim-worker/.venv/bin/python

mkdir -p "$out"
started=()
stop() {
  trap - EXIT INT TERM
  ((${#started[@]})) && kill "${started[@]}" 2>/dev/null || true
  wait
}
trap stop EXIT
trap 'stop; exit 130' INT TERM

target/release/cpn-trainer serve --dataset "$dataset" --checkpoints "$out/none" --runs "$out/none" --grpc-listen 127.0.0.1:0 \
  --listen "$endpoint" --namespace "$CPN_NAMESPACE" 2>"$out/recorder.log" &
started+=($!)
"$CPN_SIM_WORKER" demonstrate --tasks jenga-poke --episodes 21 --connect "$endpoint" --namespace "$CPN_NAMESPACE"
target/release/cpn-trainer verify --dataset "$dataset" --episodes 21
episodes=$(printf 'jenga-poke-%d,' {0..20})
episodes=${episodes%,}

# train OUT H U SEED GOALS, unless it is done; an interrupted run goes on.
train() {
  [[ -e $1 ]] && return
  target/release/cpn-trainer train --preset jenga --dataset "$dataset" --out "$1" --seed "$4" --run-dir "${1%.safetensors}" \
    --set model.horizon="$2" --set model.updates="$3" --set training.goals="$5" 2>"${1%.safetensors}.log"
}
export -f train

# plans FOLDER: serves the models of a folder.
plans() {
  target/release/cpn-planner --models-dir "$1" --grpc-listen 127.0.0.1:0 --connect "$endpoint" \
    --namespace "$CPN_NAMESPACE" --name "$(basename "$1")" 2>"$out/planner.log" &
  started+=($!)
}

mkdir -p "$out/grid"
printf '%s\n' "${grid[@]}" | xargs -P 2 -I{} bash -c \
  'read -r h u <<<"{}"; train '"$out"'/grid/h$h-u$u.safetensors "$h" "$u" 0 final'
plans "$out/grid"
read -r horizon updates < <($python experiments/jenga/choose.py "$endpoint" grid "$out/grid.json" "$episodes" \
  $(basename -s .safetensors "$out"/grid/*.safetensors))
echo "chosen: H = $horizon, U = $updates"
chosen=$out/chosen-h$horizon-u$updates
mkdir -p "$chosen"

for seed in "${seeds[@]}"; do
  echo "$chosen/cpn-$seed.safetensors $horizon $updates $seed final"
  echo "$chosen/hindsight-$seed.safetensors $horizon $updates $seed hindsight"
done | xargs -P 2 -I{} bash -c 'train {}'
plans "$chosen"
for worker in w0 w1; do
  "$CPN_SIM_WORKER" serve --worker "$worker" --connect "$endpoint" --namespace "$CPN_NAMESPACE" 2>"$out/$worker.log" &
  started+=($!)
done
$python experiments/jenga/execute.py "$endpoint" "$(basename "$chosen")" "$chosen" "$episodes" w0,w1 \
  "$(basename -s .safetensors "$chosen"/*.safetensors | paste -sd,)"
$python experiments/jenga/report.py "$chosen"
