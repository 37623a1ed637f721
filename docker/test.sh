#!/usr/bin/env bash
# Builds the images, starts five agents and a gateway from compose.yaml, and checks that the gateway sees every
# agent, sees one go and come back under its own name, and that nothing runs as root.
# Ends with 0 (passed), 1 (failed) or 77 (skipped: no Docker daemon answers and none can be started).
#
#   docker/test.sh                 COMA_IMAGES_BUILT=1 docker/test.sh    (takes the images as they are)
set -euo pipefail
cd "$(dirname "$0")/.."

skip() { echo "docker/test.sh: SKIPPED: $*"; exit 77; }
fail() { echo "docker/test.sh: FAILED: $*" >&2; exit 1; }
say() { echo "docker/test.sh: $*"; }

if docker compose version > /dev/null 2>&1; then compose=(docker compose)
elif command -v docker-compose > /dev/null; then compose=(docker-compose)
else skip "neither 'docker compose' nor docker-compose is installed"; fi

project="coma-test-$$"
compose+=(--project-name "$project" --file docker/compose.yaml)
COMA_TOKEN="test-$$-$RANDOM"
COMA_GATEWAY_PORT="$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')"
export COMA_TOKEN COMA_GATEWAY_PORT
work="$(mktemp -d)"
daemon="" started="" bridged=0

cleanup() {
    status=$?
    if [ -n "$started" ]; then
        [ "$status" = 0 ] || "${compose[@]}" logs --tail 40 || true
        "${compose[@]}" down --volumes --timeout 5 > /dev/null 2>&1 || true
    fi
    if [ -n "$daemon" ]; then
        kill "$daemon" 2> /dev/null && wait "$daemon" 2> /dev/null || true
        # A daemon leaves its bridge and its packet rules behind: put back what was there before.
        ip link delete docker0 2> /dev/null || true
        iptables-restore < "$work/iptables" 2> /dev/null || true
        sysctl --quiet --write "net.bridge.bridge-nf-call-iptables=$bridged" 2> /dev/null || true
    fi
    rm -rf "$work"
}
trap cleanup EXIT

if ! docker info > /dev/null 2>&1; then
    [ "$(id -u)" = 0 ] && command -v dockerd > /dev/null || skip "no Docker daemon answers, and none can be started here"
    iptables-save > "$work/iptables" 2> /dev/null || true
    bridged="$(sysctl --values net.bridge.bridge-nf-call-iptables 2> /dev/null || echo 0)"
    dockerd > "$work/dockerd.log" 2>&1 &
    daemon=$!
    for _ in $(seq 60); do
        docker info > /dev/null 2>&1 && break
        kill -0 "$daemon" 2> /dev/null || break
        sleep 0.5
    done
    docker info > /dev/null 2>&1 || { tail -3 "$work/dockerd.log"; skip "dockerd does not start on this machine"; }
    say "started dockerd for this test"
fi

[ -n "${COMA_IMAGES_BUILT:-}" ] || cargo xtask image

# The ids of the agents that the gateway knows and reaches, one a line, sorted.
agents() {
    curl --silent --fail --max-time 5 --header "authorization: Bearer $COMA_TOKEN" \
        "http://127.0.0.1:$COMA_GATEWAY_PORT/api/v1/agents" 2> /dev/null | python3 -c '
import json, sys
answer = json.load(sys.stdin)
agents = answer["agents"] if isinstance(answer, dict) else answer
print("\n".join(sorted(a["id"] for a in agents if a.get("reachable", True))))' 2> /dev/null || true
}

# Waits until the gateway knows so many agents; leaves their ids in $seen.
wait_for() {
    for _ in $(seq 120); do
        seen="$(agents)"
        [ "$(printf '%s' "$seen" | grep -c .)" = "$1" ] && return 0
        sleep 0.5
    done
    fail "the gateway sees [$(echo $seen)], not $1 agents, after 60 s"
}

started=1
"${compose[@]}" up --detach --scale agent=5
wait_for 5
five="$seen"
[ "$(printf '%s\n' "$five" | uniq | wc -l)" = 5 ] || fail "ids are not unique: $five"
say "five agents, each with an id of its own:" $five

one="$("${compose[@]}" ps --quiet agent | head -1)"
docker stop --time 10 "$one" > /dev/null
wait_for 4
say "one left, and the gateway saw it go"

docker start "$one" > /dev/null
wait_for 5
[ "$seen" = "$five" ] || fail "the agent that came back has another id: [$(echo $five)] became [$(echo $seen)]"
say "it came back under its own id"

for container in $("${compose[@]}" ps --quiet); do
    user="$(docker inspect --format '{{.Config.User}}' "$container")"
    [ "$user" = 65532:65532 ] || fail "container $container runs as '$user'"
done
say "PASSED"
