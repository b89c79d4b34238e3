#!/usr/bin/env bash
# Plays docs/two-machines.md through on one machine: two network namespaces, each with an address of its own, joined by
# a pair of virtual interfaces. The coordinator and two learners live in the first, two learners and the evaluator in the
# second, all with keys. Ends with 0 if task7 was solved and every check held. Leaves nothing behind.
#
# Usage: deploy/test-two-machines.sh      (as root)
#   BIN=...     folder with t4nmtd, t4nmtd-coordinator and t4nmtd-worker; default .venv/bin
#   SEED=...    of the training; default 1
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bin=$(realpath "${BIN:-.venv/bin}")
here=t4nmtd-here-$$ there=t4nmtd-there-$$
here_address=10.233.7.1 there_address=10.233.7.2
folder=$(mktemp -d)
run=$folder/run
deadline=${DEADLINE_S:-900}
started=()

say() { printf 'test-two-machines: %s\n' "$*"; }
fail() { say "FAILED: $*"; tail -n 5 "$folder"/*.log; exit 1; }

clean_up() {
  for process in "${started[@]}"; do kill "$process" 2>/dev/null || true; done
  wait
  ip netns delete "$here" 2>/dev/null || true
  ip netns delete "$there" 2>/dev/null || true
  rm -rf "$folder"
}
trap clean_up EXIT

[ "$(id -u)" = 0 ] || { say "needs root, to make network namespaces"; exit 2; }
ip netns add "$here"
ip netns add "$there"
ip link add veth-here netns "$here" type veth peer name veth-there netns "$there"
ip -n "$here" address add "$here_address/24" dev veth-here
ip -n "$there" address add "$there_address/24" dev veth-there
for end in "$here veth-here" "$there veth-there"; do
  ip -n "${end% *}" link set lo up
  ip -n "${end% *}" link set "${end#* }" up
done

# Runs a command in a namespace: in_ns NAME LOG COMMAND...
in_ns() {
  ip netns exec "$1" "${@:3}" >"$folder/$2.log" 2>&1 &
  started+=($!)
}
doctor() { ip netns exec "$there" "$bin/t4nmtd" doctor --connect "$here_address" --wait 2 "$@" 2>&1 || true; }
# Checks that the doctor, called with the arguments after the first, says what is expected.
diagnosed() {
  local found
  found=$(doctor "${@:2}")
  case $found in *"$1"*) say "doctor: $(grep -m 1 -F "$1" <<<"$found")" ;; *) fail "expected '$1' of the doctor: $found" ;; esac
}

"$bin/t4nmtd" keys new "$folder/keys" --clients 1 >"$folder/keys.log"
mv "$folder/keys/clients/client1" "$folder/carried"
keys_here=(--keys "$folder/keys") keys_there=(--keys "$folder/carried")

diagnosed "nothing listens at $here_address:5570" "${keys_there[@]}"
"$bin/t4nmtd-coordinator" --task task7 --run-dir "$folder/open" --bind "tcp://$here_address:5570" >"$folder/open.log" 2>&1 &&
  fail "a coordinator that others can reach started without keys"
say "without keys: $(tail -n 1 "$folder/open.log")"

in_ns "$here" coordinator "$bin/t4nmtd-coordinator" --task task7 --seed "${SEED:-1}" --run-dir "$run" --no-dashboard \
  --bind "tcp://$here_address:5570" --publish "tcp://$here_address:5571" "${keys_here[@]}"
coordinator=$!
until [ -e "$run/endpoints.json" ]; do kill -0 "$coordinator" || fail "no coordinator"; sleep 0.2; done

diagnosed "takes only clients with keys"
ip -n "$here" route add blackhole "$there_address/32"
diagnosed "a firewall on the way drops packets" "${keys_there[@]}"
ip -n "$here" route delete blackhole "$there_address/32"
diagnosed "the key of client1 is accepted" "${keys_there[@]}"

worker=("$bin/t4nmtd-worker" --connect "tcp://$here_address:5570")
SECONDS=0
in_ns "$here" p1 "${worker[@]}" --pid p1 "${keys_here[@]}"
in_ns "$here" p2 "${worker[@]}" --pid p2 "${keys_here[@]}"
in_ns "$there" p3 "${worker[@]}" --pid p3 "${keys_there[@]}"
in_ns "$there" g "${worker[@]}" --pid g "${keys_there[@]}"
in_ns "$there" evaluator "${worker[@]}" --evaluate "${keys_there[@]}"

until [ "$(doctor "${keys_there[@]}" | grep -c '^peer: *ok')" = 4 ]; do
  [ "$SECONDS" -lt "$deadline" ] || fail "not all learners can be reached"
  sleep 1
done
doctor "${keys_there[@]}" | grep '^peer:' | sed 's/^/test-two-machines:   /'

while kill -0 "$coordinator" 2>/dev/null; do
  [ "$SECONDS" -lt "$deadline" ] || fail "not solved within $deadline s"
  sleep 1
done
code=0
wait "$coordinator" || code=$?
say "the coordinator ended with code $code after $SECONDS s: $(tail -n 1 "$folder/coordinator.log")"
[ "$code" = 0 ] || fail "not solved"
"$bin/t4nmtd" evaluate "$run" --episodes 100
python3 - "$run/summary.json" <<'PYTHON'
import json, sys

counts = json.load(open(sys.argv[1]))["intervention"]
print(f"test-two-machines: of {counts['asked']} values asked of peers {counts['answered']} were answered in time")
sys.exit(0 if counts["answered"] > counts["asked"] / 2 else "FAILED: most peers did not answer")
PYTHON
say "ok"
