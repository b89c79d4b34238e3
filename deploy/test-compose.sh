#!/usr/bin/env bash
# Tries docker-compose.yml for real: builds, trains a task with a worker for each sub-task, kills one of them on the way,
# and looks at what is left. Ends with the coordinator's exit code, or 1 where a check fails. Leaves nothing behind but the image.
#
# Usage: deploy/test-compose.sh          (as root, or as somebody who may use docker and sudo without a password)
#   COMPOSE=...   the command; by default `docker compose`, or docker-compose where that is what there is
#   T4NMTD=...    the command t4nmtd outside the containers; by default that of .venv, made if need be
#   TASK=...      what to train; default task8: others may be solved before the killed worker is missed
#   WORKERS=...   how many there are; default 5
#   PID=...       the sub-task whose worker is killed; default g1
#   SEED=...      of the training; default 1
#   MAX_INTERACTIONS=...   of the training. A small one ends it unsolved, and this script with 3, if there was time to kill
#                 on the way: MAX_INTERACTIONS=300000
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

export COMPOSE_PROJECT_NAME=t4nmtd-test-$$ TASK=${TASK:-task8} SEED=${SEED:-1} MAX_INTERACTIONS=${MAX_INTERACTIONS:-3000000}
deadline=${DEADLINE_S:-900} workers=${WORKERS:-5} pid=${PID:-g1}
folder=$(mktemp -d)
if [ -z "${COMPOSE:-}" ]; then
  COMPOSE="docker compose"
  docker compose version >/dev/null 2>&1 || COMPOSE=docker-compose
fi

say() { printf 'test-compose: %s\n' "$*"; }
fail() { say "FAILED: $*"; $COMPOSE logs --tail 20 || true; exit 1; }
as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi; }
containers() { docker ps --quiet --all --filter "label=com.docker.compose.project=$COMPOSE_PROJECT_NAME" "$@"; }
status() { $COMPOSE exec -T coordinator t4nmtd status --json --keys /keys </dev/null 2>/dev/null; }

# What a Python expression of the coordinator's status s comes to; empty while there is no answer.
ask() { status | python3 -c "import json, sys; s = json.load(sys.stdin); print($1)" 2>/dev/null || true; }

# Waits until an expression is true; the time it took is in $SECONDS.
until_true() {
  until [ "$(ask "$1")" = True ]; do
    [ "$(docker inspect --format '{{.State.Running}}' "$coordinator")" = true ] || fail "the coordinator ended before: $2"
    [ "$SECONDS" -lt "$deadline" ] || fail "not within $deadline s: $2"
    sleep 0.5
  done
}

clean_up() {
  $COMPOSE down --volumes --remove-orphans >"$folder/down.log" 2>&1 || cat "$folder/down.log"
  as_root rm -rf "$folder"
}
trap clean_up EXIT

# The user named in .env owns the runs; a test must not write over the .env of whoever runs it.
if [ -e .env ]; then
  owner=$(sed -n 's/^T4NMTD_UID=//p' .env)
else
  owner=12345
  sed "s/^T4NMTD_UID=.*/T4NMTD_UID=$owner/; s/^T4NMTD_GID=.*/T4NMTD_GID=$owner/; /^PIP_\|^BASE/d" .env.example >.env
  trap 'rm -f .env; clean_up' EXIT
fi
owner=${owner:-1000}

say "building"
$COMPOSE build >"$folder/build.log" 2>&1 || { tail -n 30 "$folder/build.log"; fail "the image cannot be built"; }
say "image: $(docker image inspect --format '{{.Size}}' t4nmtd-dist | awk '{printf "%.2f GB", $1 / 1e9}')"

SECONDS=0
$COMPOSE up -d --scale worker=$workers >"$folder/up.log" 2>&1 || { cat "$folder/up.log"; fail "up"; }
say "up after $SECONDS s, the coordinator healthy"
coordinator=$($COMPOSE ps -q coordinator)
until_true 'any(row["total"]["gradient_steps"] for row in s["learners"])' "a first learning step"
say "first learning step $SECONDS s after up began"

# As soon as it learns: its worker's container, and the number of its lease.
learner="next(row for row in s['learners'] if row['pid'] == '$pid')"
until_true "$learner['phase'] == 'training'" "$pid learns"
holder=$(ask "$learner['worker']")
as_root kill -KILL "$(docker inspect --format '{{.State.Pid}}' "${holder%%:*}")"
say "killed the process of $holder, which held $pid, after $SECONDS s"
until_true "$learner['epoch'] > 1" "$pid has a worker again"
say "workers: $(ask '", ".join(sorted(row["pid"] + " " + row["worker"] for row in s["learners"]))')"

code=$(timeout "$deadline" docker wait "$coordinator") || fail "not over within $deadline s"
say "the coordinator ended with code $code after $SECONDS s: $(docker logs "$coordinator" 2>&1 | tail -n 1)"
run=$(docker run --rm -v "${COMPOSE_PROJECT_NAME}_runs:/runs:ro" t4nmtd-dist readlink /runs/$TASK/latest)
docker cp -q "$coordinator:/data/runs/$TASK/$run" "$folder/run" 2>/dev/null ||
  docker cp "$coordinator:/data/runs/$TASK/$run" "$folder/run" >/dev/null
grep -o "\"[^\"]* takes $pid [^\"]*\"" "$folder/run/events.jsonl" | sed 's/^/test-compose:   /'
[ "$(grep -c "takes $pid " "$folder/run/events.jsonl")" -ge 2 ] || fail "nobody took $pid again"
find "$folder/run/tensorboard/$pid" -name 'events.out.tfevents.*' -size +0 | grep -q . || fail "no curves of $pid for TensorBoard"
owners=$(docker run --rm -v "${COMPOSE_PROJECT_NAME}_runs:/runs:ro" t4nmtd-dist \
  find "/runs/$TASK/$run" -printf '%U:%G\n' | sort -u)
[ "$owners" = "$owner:$owner" ] || fail "the run directory belongs to $owners, expected $owner:$owner"
say "the run directory belongs to $owners"

say "workers' exit codes: $(docker inspect --format '{{.State.ExitCode}}' $(containers --filter name=_worker_ --filter name=-worker-) | tr '\n' ' ')"
if [ "$code" = 0 ]; then
  if [ -z "${T4NMTD:-}" ]; then
    make --no-print-directory setup
    T4NMTD=.venv/bin/t4nmtd
  fi
  $T4NMTD evaluate "$folder/run" --episodes 100
  rate=$($T4NMTD evaluate "$folder/run" --episodes 100 --json | python3 -c 'import json, sys; print(json.load(sys.stdin)["success_rate"])')
  [ "$rate" = 1.0 ] || fail "the policy succeeds in $rate of the episodes"
fi

$COMPOSE down --volumes >"$folder/down.log" 2>&1 || { cat "$folder/down.log"; fail "down"; }
left="$(containers) $(docker volume ls -q | grep "^$COMPOSE_PROJECT_NAME" || true) $(docker network ls -q --filter name="$COMPOSE_PROJECT_NAME")"
[ -z "${left// /}" ] || fail "down leaves $left"
say "down leaves nothing"
exit "$code"
