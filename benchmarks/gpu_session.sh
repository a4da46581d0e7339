#!/usr/bin/env bash
# What has to be seen on a GPU, on a machine that is lent for minutes and reaches no network: tests marked gpu, golden
# wrenches, and measurements. Prepared here, so that no minute there goes into finding out how.
#
#   here:       ../shared/device/pack.sh msgspec h5netcdf manifold3d platformdirs hypothesis pytest-timeout gitpython \
#                 gitdb smmap pyvers importlib_metadata orjson sortedcontainers gymnasium farama-notifications cloudpickle \
#                 jsonschema jsonschema-specifications referencing rpds-py attrs
#               bash benchmarks/gpu_session.sh prepare                code, weights and inputs into .session (ignored)
#               git checkout -b device && git rm -rqf . && git commit -qm device --allow-empty    a small tree travels
#   device, 1:  carry .gpu/a            mkdir -p /w /opt/w && date +%s >/w/t0 && cp .gpu/a/* /opt/w/
#   device, 2:  carry .gpu/b            cp .gpu/b/* /opt/w/
#   device, 3:  carry .gpu/c .session   bash .gpu/c/install.sh && bash .session/gpu_session.sh start && bash /w/gpu.sh run tests
#   device, 4…: bash /w/gpu.sh run PART …                             each at most as long as it says; all below 600 s
#   or, on a machine of several GPUs, parts in the background and a look at them:
#               bash /w/gpu.sh queue FILE 0a 0b 1a 1b …           two lanes a GPU, which take the next SEED:ARM[,ARM] of the
#               file when they are done; 38 students, of which seven learn their network, took four H100 27 minutes
#               bash /w/gpu.sh lane 0c tests                       a part in a lane of its own
#               TASK=screwdriver NAME=-a CONFIG=default JUDGED=careful WITH="--seed 1" bash /w/gpu.sh lane 2a teacher-of
#               JOB=NAME-0 MINUTES=25 bash /w/gpu.sh lane 1 teachers          a piece of a job, which another session goes on with
#               bash /w/gpu.sh look SECOND                         of the machine's life
#               (two teachers of 4,096 environments share a GPU well; `whiskers` trains networks whose …/best PRETRAINED may
#               name; policies/jobs.toml says what to compare; on a fresh machine 140 s go into compiling; kill what fails by
#               `pkill -f "run/NAME-[b]"`, not by its own name)
#   here:       git checkout -f main && git branch -D device; python -m benchmarks.report after copying results/*.json
#
# Calls follow one another within 30 s, or the machine goes back with all that is on it: on 2026-11-26 that happened twice,
# once for a call that broke off and once for thinking. So start all lanes in the third call, look every five minutes, and
# write the next call before the last one ends. A machine lives 30 minutes; one GPU counts half, four count as one that is
# not halved. What is timed has its GPU for itself.
#
# Open: training on several GPUs, few, then training with COUNTS=1,2,4 on cards that hold a batch of 1,024 (H200), all
# GPUs idle.
set -eu

# Part, its limit in seconds, its command.
parts() { cat <<'TABLE'
tests     420  python3 -m pytest -q -n 0 -m gpu ${TESTS:-tests} -p no:cacheprovider --continue-on-collection-errors
golden    300  python3 -m pytest -q -n 0 -p no:cacheprovider tests/stimuli/engines/test_golden_wrenches.py -k rod
sweeps-1  150  python3 -m benchmarks.whiskers.public_rate --objects procedural-24:2 $P --parts kernels --ahead :2,1:24,1:24
sweeps-2   90  python3 -m benchmarks.whiskers.public_rate --objects procedural-24:2 $P --parts stages
sweeps-3  240  for n in 16 32; do python3 -m benchmarks.whiskers.public_rate --objects procedural-24:8 $P --parts stages --side-by-side $n; done
sweeps-4  120  python3 -m benchmarks.whiskers.public_rate --objects procedural-24:2 $P --parts command --write
scaling   480  python3 -m benchmarks.whiskers.public_rate --objects procedural-24:32 $P --parts command --gpus ${COUNTS:-1,2,4}
slices    150  python3 -m benchmarks.whiskers.slices --objects procedural-24:2 --device cuda --write
free      150  python3 -m benchmarks.whiskers.throughput --only free --blocks 64,256,320 --bounds 0,64x6
touch     320  python3 -m benchmarks.tactile.throughput --device cuda --part sensors --input inputs/pyramid.npz --write
friction  150  python3 -m benchmarks.tactile.friction_cost --device cuda --write
gradients 500  python3 -m benchmarks.whiskers.gradient_cost --device cuda --each 1 --input inputs/gradients.npz --write
teachers 1700  python3 -m benchmarks.policies.jobs run $JOB --minutes ${MINUTES:-7.5}
students-for 1700  python3 -m benchmarks.policies.students --teacher ${TEACHER:-in_palm_rotate.teacher} --config careful --seed ${PLAN%%:*} --arms $(echo ${PLAN#*:} | tr , ' ') ${PRETRAINED:+--pretrained $PRETRAINED} ${AGENTS---no-agents} --evaluations 1 --device cuda --envs 4096 --iterations ${ITERATIONS:-110} --learning-rate 5e-4 --episodes 512 --together 1 --end $(($(cat /w/t0) + 1670)) --reserve 60 --out /tmp/run/students-${PLAN%%:*}-$LANE
teacher-of 1650 python3 -m brainbench policy train $TASK $WITH --config ${CONFIG:-default} --envs ${ENVS:-8192} --minutes $(python3 -c "print(max(0.05, ($(cat /w/t0) + ${UNTIL:-1500} - $(date +%s)) / 60))") --loggers csv --device cuda --out /tmp/run/$TASK${NAME:-} && python3 -m brainbench policy evaluate $TASK /tmp/run/$TASK${NAME:-} --config ${JUDGED:-${CONFIG:-default}} --envs 1024 --episodes 1024 --seeds 1 --device cuda --out /tmp/run/$TASK${NAME:-}/evaluated.json
whiskers 1650  python3 -m benchmarks.models.campaign --work /tmp/campaign --again --places 4 --only 'zhuang-intersection-ln-small\.(supervised|simclr)\.seed[12]$' --until $(($(cat /w/t0) + ${UNTIL:-1500}))
shipped   150  python3 -m brainbench policy evaluate in_palm_rotate in_palm_rotate.teacher in_palm_rotate.student --config careful --envs 1024 --episodes 1024 --seeds 1 --device cuda --out /w/out/shipped.json
few       240  python3 -m brainbench stimuli sweep thesis-low procedural:30 --split sweep --device cuda $P --out /tmp/few
training  300  python3 -m benchmarks.models.data_parallel /tmp/few --counts $COUNTS --networks zhuang-intersection-ln+gpt.supervised --out /w/out/data-parallel-$COUNTS.json
TABLE
}

prepare() {
  local top out tree; top=$(git rev-parse --show-toplevel); out=$top/.session; tree=$(mktemp -d); rm -rf "$out"; mkdir -p "$out"
  grep -qx '/.session/' "$top/.git/info/exclude" || echo '/.session/' >>"$top/.git/info/exclude"
  git -C "$top" archive HEAD brainbench robotics_bridge leaderboards benchmarks tests docs README.md pyproject.toml | tar x -C "$tree"
  rm -rf "$tree"/benchmarks/policies/records/*.tar.xz "$tree"/leaderboards/{reproduction/records,results}/*.json "$tree"/benchmarks/results/* "$tree"/docs/images
  mkdir "$tree/inputs"
  (cd "$top" && python -m benchmarks.tactile.throughput --device cpu --write-input "$tree/inputs/pyramid.npz" &&
    python -m benchmarks.whiskers.gradient_cost --each 1 --write-input "$tree/inputs/gradients.npz")
  tar cJf "$out/head.tar.xz" -C "$tree" . && cp "$0" "$out/gpu_session.sh"; rm -rf "$tree"; ls -la "$out"
}

start() { mkdir -p /w/head /w/out && tar xJf .session/head.tar.xz -C /w/head && cp "$0" /w/gpu.sh; }

run() {
  cd /w/head && export PYTHONPATH=/opt/w:/w/head PYTHONUNBUFFERED=1 BRAINBENCH_CACHE=/w/cache
  local P="--fidelity fast,links=12,time_step=1e-3,steps_per_period=none" name limit command
  for wanted in "$@"; do
    while read -r name limit command; do
      [ "$name" = "$wanted" ] || continue
      echo "== $name, $(($(date +%s) - $(cat /w/t0))) s"
      # A subshell of its own, for commands that change folder.
      timeout "$limit" bash -c "$(declare -p P); $command" </dev/null 2>&1 | tee "$OUT/$name${CUDA_VISIBLE_DEVICES:+-$CUDA_VISIBLE_DEVICES}.log" | tail -n 25 | cut -c1-200
    done < <(parts)
  done
  tar czf "$OUT/results.tar.gz" benchmarks/results; nvidia-smi --query-gpu=name,memory.used --format=csv,noheader
}

lane() {
  local name=$1; shift  # the number of the GPU, and a letter where several share it
  OUT=/w/out CUDA_VISIBLE_DEVICES=${name%%[a-z]*} setsid bash /w/gpu.sh run "$@" >>"/w/out/lane-$name.log" 2>&1 </dev/null &
}

# Students of a list, by lanes that each take the next one.
queue() {
  local list=$1 lane; shift
  for lane in "$@"; do
    setsid bash /w/gpu.sh take "$list" "$lane" >>"/w/out/lane-$lane.log" 2>&1 </dev/null &
  done
}

take() {
  local one; export OUT=/w/out CUDA_VISIBLE_DEVICES=${2%%[a-z]*} LANE=$2
  while one=$(flock "$1.lock" sh -c "head -n 1 '$1'; sed -i 1d '$1'") && [ -n "$one" ]; do
    PLAN=$one bash /w/gpu.sh run students-for || true
  done
}

look() {
  while [ $(($(date +%s) - $(cat /w/t0))) -lt "$1" ]; do sleep 1; done
  tail -n "${2:-15}" /w/out/lane-*.log
  nvidia-smi --query-gpu=utilization.gpu,memory.used --format=csv,noheader
  set +e  # files change while they are packed, and the rest shall come back all the same
  cd / && tar czf "$OUT/seen.tar.gz" w/out/*.log w/head/benchmarks/results $(find tmp/run -maxdepth 4 -name '*.json' -o -name '*.jsonl' -o -name log.csv 2>/dev/null)
  [ ! -d tmp/campaign/jobs ] || tar czf "$OUT/trainings.tar.gz" tmp/campaign/jobs
  # The last models of each teacher, or the policy of a run that has one; eight files may come back.
  local run
  for run in /tmp/run/*/; do
    if [ -d "$run"policy ]; then tar czf "$OUT/$(basename "$run").tar.gz" "$run"policy
    elif [ -e "$run"config.json ]; then tar czf "$OUT/$(basename "$run").tar.gz" "$run"config.json $(ls -v "$run"model_*.safetensors 2>/dev/null | tail -n "${MODELS:-6}"); fi
  done
  for run in /tmp/run/students-*/raw_rnn/seed*/; do
    [ ! -e "$run/evaluation.json" ] || tar cJf "$OUT/raw_rnn-$(basename "$run").tar.xz" -C "$run" model.safetensors config.json evaluation.json
  done; cp /w/out/*.json /w/out/*.tar.gz.[0-9]* "$OUT" 2>/dev/null || true
}

"$@"
