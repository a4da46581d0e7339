#!/usr/bin/env bash
# What a release runs on a machine with one or more NVIDIA GPUs, in the root of a checkout with '.[dev,gpu]' installed:
#   bash benchmarks/gpu.sh            everything, one after the other
#   bash benchmarks/gpu.sh touch …    the named parts
# Each part prints its table; --write keeps it in benchmarks/results, from which RESULTS.md is made.
set -eu
cd "$(dirname "$0")/.."

parts() { cat <<'TABLE'
tests     pytest -n 0 -m gpu
golden    pytest -n 0 tests/stimuli/engines/test_golden_wrenches.py -k rod
free      python -m benchmarks.whiskers.throughput
sweeps    python -m benchmarks.whiskers.public_rate --objects procedural-24:32 --write
touch     python -m benchmarks.tactile.throughput --device cuda --part sensors --write
step      python -m benchmarks.tactile.throughput --device cuda --part step --write
tasks     python -m benchmarks.policies.tasks --device cuda --write
encoders  python -m benchmarks.policies.encoder_step --device cuda --write
training  python -m benchmarks.models.training_step --write
TABLE
}

chosen=${*:-$(parts | awk '{print $1}')}
for name in $chosen; do
  command=$(parts | awk -v name="$name" '$1 == name { $1 = ""; print substr($0, 2) }')
  [ -n "$command" ] || { echo "gpu.sh: unknown part '$name'; allowed: $(parts | awk '{print $1}' | xargs)" >&2; exit 2; }
  echo "== $name: $command"
  $command
done
