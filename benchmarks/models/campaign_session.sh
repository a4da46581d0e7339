#!/usr/bin/env bash
# The campaign's jobs that are left, in one session of a machine with a GPU (one job: about 600 s with its data).
#
#   here:       ../shared/device/pack.sh msgspec h5netcdf manifold3d platformdirs
#               bash benchmarks/models/campaign_session.sh prepare      code into .campaign (ignored by git)
#   device, 1:  carry .gpu/a          mkdir -p /w /opt/w && date +%s >/w/t0 && cp .gpu/a/* /opt/w/
#   device, 2:  carry .gpu/b          cp .gpu/b/* /opt/w/
#   device, 3:  carry .gpu/c .campaign    bash .campaign/campaign_session.sh start; bash /w/session.sh look 540
#   device, 4…: bash /w/session.sh look 1100; …
#   here:       python -m benchmarks.models.campaign --install FOLDER, --score FOLDER
#
# A machine that waits 30 s for the next call goes back and takes everything with it (measured: 780 s of trainings): ask
# for the next call before reading the last. The tree that travels has to stay below 64 MiB with .gpu/a: make the calls
# from a commit without records and weights.
set -u
SOLVER=d1e1e8ec       # code whose sweeps have the hash of the trainings so far
LIMIT=1560            # s from the first call until trainings end

prepare() {
  local top out; top=$(git rev-parse --show-toplevel); out=$top/.campaign; rm -rf "$out"; mkdir -p "$out"
  grep -qx '/.campaign/' "$top/.git/info/exclude" || echo '/.campaign/' >>"$top/.git/info/exclude"
  local old; old=$(mktemp -d)
  git -C "$top" archive $SOLVER brainbench robotics_bridge benchmarks leaderboards/reproduction pyproject.toml | tar x -C "$old"
  rm -rf "$old"/brainbench/models/weights/*/ "$old"/leaderboards/reproduction/records "$old"/benchmarks/results
  cp "$top"/benchmarks/models/campaign{,_jobs}.py "$old/benchmarks/models/"
  cp "$top/leaderboards/reproduction/trainings.jsonl" "$old/leaderboards/reproduction/"
  tar cJf "$out/code.tar.xz" -C "$old" .
  cp "$0" "$out/campaign_session.sh"; rm -rf "$old"; ls -la "$out"
}

start() {
  bash .gpu/c/install.sh && . /opt/w/env
  mkdir -p /w/code && tar xJf .campaign/code.tar.xz -C /w/code && cp "$0" /w/session.sh
  export CUDA_MPS_PIPE_DIRECTORY=/tmp/mps CUDA_MPS_LOG_DIRECTORY=/tmp/mps-log
  mkdir -p /tmp/mps /tmp/mps-log && nvidia-cuda-mps-control -d && echo "several processes share a GPU"
  setsid bash /w/session.sh train >/tmp/train.log 2>&1 </dev/null &
}

campaign() { cd /w/code && PYTHONPATH=/opt/w:/w/code python3 -m benchmarks.models.campaign --work /tmp/campaign "$@"; }

train() { campaign --until $(($(cat /w/t0) + LIMIT)) --places 3; }

look() {
  while [ $(($(date +%s) - $(cat /w/t0))) -lt "$1" ]; do sleep 2; done
  tail -n 5 /tmp/train.log | cut -c1-240
  nvidia-smi --query-gpu=utilization.gpu,memory.used --format=csv,noheader
  campaign --pack 0 --out "$OUT" 2>&1 | grep -v 'too large'
}

"$@"
