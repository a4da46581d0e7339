#!/usr/bin/env bash
# The rest of the campaign in one session of a machine with two GPUs (about 1,400 s of the 1,800).
#
#   here:       ../shared/device/pack.sh msgspec h5netcdf manifold3d platformdirs      (policies: gitpython pyvers too)
#               bash benchmarks/models/campaign_session.sh prepare      archives into .campaign (ignored by git)
#   device, 1:  mkdir -p /w /opt/w && date +%s >/w/t0 && cp .gpu/a/* /opt/w/ && cp .campaign/cache.tar.xz /w/
#   device, 2:  cp .gpu/b/* /opt/w/ && cp .campaign/*.xz /w/
#   device, 3:  bash .campaign/campaign_session.sh start; bash .campaign/campaign_session.sh look 560
#   device, 4…: bash .campaign/campaign_session.sh look 1130; … pack
#   here:       python -m benchmarks.models.campaign --install FOLDER, --score FOLDER; records.tgz into the records' folder
#
# A machine that waits 30 s for the next call goes back and takes everything with it (measured: 780 s of trainings): ask
# for the next call before reading the last, pack in every call, and leave nothing else to run beside. The tree that
# travels has to stay below 64 MiB with .gpu/a: make the calls from a commit without records and weights.
set -u
SOLVER=d1e1e8ec       # code whose sweeps have the hash of the trainings so far
LIMIT=1560            # s from the first call until trainings end
FULL='\+gpt\.supervised\.seed0$'

prepare() {
  local top out; top=$(git rev-parse --show-toplevel); out=$top/.campaign; mkdir -p "$out"
  grep -qx '/.campaign/' "$top/.git/info/exclude" || echo '/.campaign/' >>"$top/.git/info/exclude"
  local old; old=$(mktemp -d)
  git -C "$top" archive $SOLVER brainbench robotics_bridge benchmarks leaderboards/reproduction pyproject.toml | tar x -C "$old"
  rm -rf "$old"/brainbench/models/weights/*/ "$old"/leaderboards/reproduction/records "$old"/benchmarks/results
  cp "$top"/benchmarks/models/campaign{,_jobs}.py "$old/benchmarks/models/"
  cp "$top/leaderboards/reproduction/trainings.jsonl" "$old/leaderboards/reproduction/"
  tar cJf "$out/code.tar.xz" -C "$old" .
  # Networks too large to come back are scored there, with today's code and the recordings of this machine's cache.
  git -C "$top" archive HEAD brainbench benchmarks leaderboards pyproject.toml | (rm -rf "$old" && mkdir "$old" && tar x -C "$old")
  rm -rf "$old"/brainbench/models/weights/*/ "$old"/leaderboards/{results,policies,reproduction/records} "$old"/benchmarks/results
  tar cJf "$out/head.tar.xz" -C "$old" .
  for recordings in demo demo-rodgers; do
    BRAINBENCH_CACHE=$old/cache python -m brainbench score resnet18-small.supervised --recordings $recordings --out "$old/out" >/dev/null
  done
  rm -rf "$old/cache/scores" && tar cJf "$out/cache.tar.xz" -C "$old/cache" .
  cp "$0" "$out/campaign_session.sh"; rm -rf "$old"; ls -la "$out"
}

start() {
  bash .gpu/c/install.sh && . /opt/w/env
  for name in code head cache; do mkdir -p /w/$name && tar xJf /w/$name.tar.xz -C /w/$name; done
  cp "$0" /w/session.sh
  export CUDA_MPS_PIPE_DIRECTORY=/tmp/mps CUDA_MPS_LOG_DIRECTORY=/tmp/mps-log
  mkdir -p /tmp/mps /tmp/mps-log && nvidia-cuda-mps-control -d && echo "several processes share a GPU"
  setsid bash /w/session.sh chains >/tmp/chains.log 2>&1 </dev/null &
}

campaign() { python3 -m benchmarks.models.campaign --work /tmp/campaign --until $(($(cat /w/t0) + LIMIT)) "$@"; }

chains() {
  cd /w/code && export PYTHONPATH=/opt/w:/w/code
  campaign --data --places 3 >/tmp/data.log 2>&1
  mkdir -p /tmp/score && ln -sfn /tmp/campaign /tmp/score/unpacked
  (
    export CUDA_VISIBLE_DEVICES=0
    campaign --places 1 --only "$FULL" >/tmp/gpu0.log 2>&1
    campaign --places 3 --only rate >/tmp/gpu0-rate.log 2>&1
  ) &
  (
    export CUDA_VISIBLE_DEVICES=1
    campaign --places 3 --only simsiam >/tmp/gpu1.log 2>&1
    campaign --places 3 --only rate >/tmp/gpu1-rate.log 2>&1
  ) &
  for name in zhuang zhuang-intersection-ln; do score "$name+gpt" >"/tmp/score-$name.log" 2>&1 & done
  wait
}

score() {
  until [ -f "/tmp/campaign/jobs/$1.supervised.seed0/result.json" ]; do sleep 1; done
  cd /w/head && CUDA_VISIBLE_DEVICES= OMP_NUM_THREADS=8 BRAINBENCH_CACHE=/w/cache PYTHONPATH=/opt/w:/w/head \
    python3 -m benchmarks.models.campaign --score /tmp/score --only "^${1//+/\\+}\.supervised\.seed0\$"
}

look() {
  while [ $(($(date +%s) - $(cat /w/t0))) -lt "$1" ]; do sleep 2; done
  tail -n 3 /tmp/{data,gpu0,gpu0-rate,gpu1,gpu1-rate}.log /tmp/score-*.log 2>/dev/null | cut -c1-240
  nvidia-smi --query-gpu=utilization.gpu,memory.used --format=csv,noheader
  pack
}

pack() {
  cd /w/code && export PYTHONPATH=/opt/w:/w/code
  rm -rf /tmp/campaign/jobs/*rate*/best # of these the accuracy alone is asked for
  python3 -m benchmarks.models.campaign --work /tmp/campaign --pack 0 --out "$OUT" 2>&1 | grep -v 'too large'
  tar czf "$OUT/records.tgz" -C /w/head/leaderboards/reproduction records 2>/dev/null
}

"$@"
