#!/usr/bin/env bash
# Builds the containers, flies the paper's mission in them, and checks what came of it. Needs a Docker engine, Compose
# (either one) and python3; fails without them. Prometheus, PostgreSQL and mosquitto are Debian's packages in images made
# here, unless PROMETHEUS_IMAGE, POSTGRES_IMAGE and MOSQUITTO_IMAGE name others. What needs other images (profiles grafana,
# llama, vllm, ollama) is only read.
#   compose.sh          all of it
#   compose.sh build    the images alone, which the engine then has for the whole run
set -euo pipefail
cd "$(dirname "$0")/../.."

# Two runs on one engine need two names.
readonly ONLY=${1:-} PROJECT=${COMPOSE_PROJECT_NAME:-aicvds-test} FLIGHT_S=300 LLM_S=120 STOP_S=10
WORK=$(mktemp -d)
OFFLINE=$PROJECT-offline

fail() {
  echo "FAIL: $*" >&2
  exit 1
}
say() { printf '%4ds  %s\n' "$SECONDS" "$*"; }

[[ $ONLY == @(|build) ]] || fail "compose.sh, or compose.sh build; not $*"
docker info >/dev/null 2>&1 || fail "no Docker engine answers"
if docker compose version >/dev/null 2>&1; then
  COMPOSE=(docker compose)
elif command -v docker-compose >/dev/null; then
  COMPOSE=(docker-compose)
else
  fail "there is neither 'docker compose' nor docker-compose"
fi
# Without the buildx plug-in there is only the classic builder.
docker buildx version >/dev/null 2>&1 || export DOCKER_BUILDKIT=0 COMPOSE_DOCKER_CLI_BUILD=0

# Neither this shell's settings nor a .env in the checkout take part, and ports are whatever is free.
build_network=${AICVDS_BUILD_NETWORK:-default}
unset "${!AICVDS_@}"
export AICVDS_BUILD_NETWORK=$build_network AICVDS_PORT=0 PROMETHEUS_PORT=0 MOSQUITTO_PORT=0
: >"$WORK/env"
COMPOSE+=(--project-name "$PROJECT" --env-file "$WORK/env")
compose() { "${COMPOSE[@]}" "$@"; }
quietly() { "$@" >"$WORK/log" 2>&1 || { tail -n 40 "$WORK/log" >&2; fail "$*"; }; }

clean_up() {
  local status=$?
  if ((status != 0)) && [[ $(compose ps -q 2>/dev/null) ]]; then
    compose logs --no-color --tail 40 >&2 || true
  fi
  docker rm --force "$OFFLINE" >/dev/null 2>&1 || true
  compose --profile postgres --profile mqtt down --volumes --remove-orphans >/dev/null 2>&1 || true
  rm -rf "$WORK"
  exit "$status"
}
trap clean_up EXIT
trap 'exit 130' INT TERM

published() { # service, port: where it is on this machine
  compose port "$1" "$2" | sed 's#^#http://#'
}
container() { # service: its container, running or not
  docker ps --all --quiet --filter "label=com.docker.compose.project=$PROJECT" \
    --filter "label=com.docker.compose.service=$1"
}
fetch() { # url
  python3 -c 'import sys, urllib.request as u
opener = u.build_opener(u.ProxyHandler({}))
sys.stdout.write(opener.open(sys.argv[1], timeout=5).read().decode())' "$1"
}
answered() { # how many decisions the edge has answered since it started
  fetch "$(published edge 8000)/metrics" | awk '/^aicvds_decisions_total[{ ]/ {n += $NF} END {print n + 0}'
}
llm_of() { # container: what its /readyz says of the LLM, asked from inside
  docker exec "$1" python -c 'import json, urllib.request as u
print(json.load(u.urlopen("http://127.0.0.1:8000/readyz", timeout=2))["llm"])' 2>/dev/null || true
}
now_ms() { python3 -c 'import time; print(time.monotonic_ns() // 1_000_000)'; }
stopped() { # container, command that stops it: see that it obeyed the SIGTERM
  local begin milliseconds code
  begin=$(now_ms)
  "${@:2}" >/dev/null 2>&1
  milliseconds=$(($(now_ms) - begin))
  code=$(docker inspect --format '{{.State.ExitCode}}' "$1")
  [[ $code == 0 || $code == 143 ]] || fail "$1 ended with exit code $code after SIGTERM"
  ((milliseconds < STOP_S * 1000)) || fail "$1 took $milliseconds ms to stop"
  echo "$milliseconds ms, exit code $code"
}

# --- build -----------------------------------------------------------------------------------------------------------
if [[ -z ${PROMETHEUS_IMAGE:-} ]]; then
  export PROMETHEUS_IMAGE=aicvds-test-prometheus
  quietly docker build --network "$AICVDS_BUILD_NETWORK" --tag "$PROMETHEUS_IMAGE" - <<'DOCKERFILE'
FROM python:3.11-slim-bookworm
RUN apt-get update -q && apt-get install -y -q --no-install-recommends prometheus && rm -rf /var/lib/apt/lists/* \
 && install --directory --owner=nobody --group=nogroup /prometheus
USER nobody
ENTRYPOINT ["/usr/bin/prometheus"]
DOCKERFILE
  say "Debian's Prometheus is built"
fi
if [[ -z ${POSTGRES_IMAGE:-} ]]; then
  # As far as docker-compose.yml goes, it does what the official image does.
  export POSTGRES_IMAGE=aicvds-test-postgres
  quietly docker build --network "$AICVDS_BUILD_NETWORK" --tag "$POSTGRES_IMAGE" - <<'DOCKERFILE'
FROM python:3.11-slim-bookworm
RUN apt-get update -q && apt-get install -y -q --no-install-recommends postgresql && rm -rf /var/lib/apt/lists/* \
 && install --directory --owner=postgres --group=postgres --mode=700 /var/lib/postgresql/data
ENV PATH=/usr/lib/postgresql/15/bin:$PATH PGDATA=/var/lib/postgresql/data
USER postgres
CMD ["bash", "-ec", "\
  if [[ ! -s $PGDATA/PG_VERSION ]]; then \
    initdb --username=$POSTGRES_USER --pwfile=<(echo $POSTGRES_PASSWORD) --auth=scram-sha-256; \
    echo host all all all scram-sha-256 >>$PGDATA/pg_hba.conf; \
    echo CREATE DATABASE $POSTGRES_DB | postgres --single postgres; \
  fi; \
  exec postgres -c listen_addresses=*"]
DOCKERFILE
  say "Debian's PostgreSQL is built"
fi
if [[ -z ${MOSQUITTO_IMAGE:-} ]]; then
  # The official image's programs, and its command without the script before it, which only root's container needs.
  export MOSQUITTO_IMAGE=aicvds-test-mosquitto
  quietly docker build --network "$AICVDS_BUILD_NETWORK" --tag "$MOSQUITTO_IMAGE" - <<'DOCKERFILE'
FROM python:3.11-slim-bookworm
RUN apt-get update -q && apt-get install -y -q --no-install-recommends mosquitto mosquitto-clients && rm -rf /var/lib/apt/lists/*
CMD ["/usr/sbin/mosquitto", "-c", "/mosquitto/config/mosquitto.conf"]
DOCKERFILE
  say "Debian's mosquitto is built"
fi
compose --profile postgres --profile mqtt down --volumes --remove-orphans >/dev/null 2>&1 || true
for profile in grafana llama vllm ollama postgres mqtt; do quietly compose --profile "$profile" config; done
say "Compose accepts the file with every profile"
# `uplinks` is the edge's image under another name.
quietly compose --profile mqtt build edge simulator uplinks
say "edge and simulator are built"
[[ $ONLY != build ]] || exit 0

# --- fly -------------------------------------------------------------------------------------------------------------
# Returns when the edge is healthy and the simulator has started.
quietly compose up --detach
edge=$(container edge) simulator=$(container simulator)
[[ $(docker inspect --format '{{.State.Health.Status}}' "$edge") == healthy ]] || fail "the edge is not healthy"
[[ $(llm_of "$edge") == ready ]] || fail "the edge is healthy without its LLM"
say "the edge is healthy, its LLM ready"

code=$(timeout "$FLIGHT_S" docker wait "$simulator") || fail "the simulator did not end within $FLIGHT_S s"
[[ $code == 0 ]] || fail "the simulator ended with exit code $code"
[[ $(docker inspect --format '{{.State.Status}}' "$edge") == running ]] || fail "the edge ended during the flight"
docker cp "$simulator:/runs/compose" "$WORK/run" >/dev/null
for file in decisions.jsonl report.html; do [[ -s $WORK/run/$file ]] || fail "the run has no $file"; done
python3 - "$WORK/run/summary.json" <<'PYTHON'
import json, sys

summary = json.load(open(sys.argv[1]))
by_source = summary["by_source"]
print("       ", {key: summary[key] for key in ("decisions", "by_source", "by_reason", "lost_packets", "rtt_ms")})
if (summary["decisions"], sum(by_source.values())) != (90, 90):
    sys.exit("FAIL: not 90 decisions")
if by_source["onboard"] or not by_source["guided"]:
    sys.exit("FAIL: the edge left decisions unanswered, or its LLM took none")
PYTHON
say "the simulator flew 90 decisions and ended with exit code 0"

# --- measured --------------------------------------------------------------------------------------------------------
counted=$(answered)
[[ $counted == 90 ]] || fail "/metrics counts $counted decisions"
prometheus=$(published prometheus 9090)
asked() { # PromQL: the values
  python3 -c 'import json, sys, urllib.parse, urllib.request as u
url = sys.argv[1] + "/api/v1/query?" + urllib.parse.urlencode({"query": sys.argv[2]})
answer = json.load(u.build_opener(u.ProxyHandler({})).open(url, timeout=5))
print(*(sample["value"][1] for sample in answer["data"]["result"]))' "$prometheus" "$1" 2>/dev/null || true
}
# The simulator has ended, but not before its last numbers were fetched.
for query in 'sum(aicvds_decisions_total)' 'sum(last_over_time(aicvds_flight_decisions_total[10m]))'; do
  for _ in {1..30}; do
    scraped=$(asked "$query")
    [[ $scraped == 90 ]] && break
    sleep 1
  done
  [[ $scraped == 90 ]] || fail "Prometheus answers '$scraped' to $query"
done
[[ $(asked 'aicvds:edge:up') == 1 ]] || fail "Prometheus has not read the rules"
say "/metrics counts 90 decisions, and Prometheus has scraped them from the edge and from the simulator"

# --- sensors' uplinks ------------------------------------------------------------------------------------------------
# As docs/guides/lorawan.md says it, with the example's file: its second device is sensor 1 of mission `patrol`.
quietly compose --profile mqtt up --detach --no-deps mosquitto uplinks
docker exec "$edge" python -c '
import json, urllib.request as u
def ask(method, path, body):
    u.urlopen(u.Request(f"http://127.0.0.1:8000{path}", json.dumps(body).encode(), {"Content-Type": "application/json"}, method=method))
spec = json.load(u.urlopen("http://127.0.0.1:8000/openapi.json"))
body = spec["paths"]["/decide"]["post"]["requestBody"]["content"]["application/json"]["examples"]["paper"]["value"]
ask("PUT", "/missions/patrol", {"mode": "policy"})
ask("POST", "/decide", body | {"mission_id": "patrol", "step": 1})'
uplinks=$(container uplinks)
for _ in {1..50}; do
  [[ $(docker logs "$uplinks" 2>&1) == *"subscribed at"* ]] && break
  sleep 0.2
done
application=ae5ba7f1-53a6-4f0e-9f3b-6f1f3a7c2b10 tenant=52f14cd4-c6f1-4fbd-8f87-4025e1d49242 device=0004a30b001c0531
docker exec "$(container mosquitto)" mosquitto_pub --qos 1 --topic "application/$application/device/$device/event/up" \
  --message '{"deduplicationId": "3ac7e3c4-4401-4b8d-9386-000000000001", "time": "'"$(date --utc +%Y-%m-%dT%H:%M:%S.%NZ)"'",
    "deviceInfo": {"tenantId": "'$tenant'", "applicationId": "'$application'", "devEui": "'$device'"},
    "fCnt": 1, "fPort": 1, "object": {"queue": 33}}' || fail "the broker refuses the uplink"
merged() { fetch "$(published edge 8000)/metrics" | awk '/^aicvds_readings_total{result="merged"}/ {print int($NF)}'; }
for _ in {1..50}; do
  [[ $(merged) == 1 ]] && break
  sleep 0.2
done
[[ $(merged) == 1 && $(fetch "$(published edge 8000)/missions/patrol") == *'"readings":1'* ]] ||
  { docker logs "$uplinks" >&2; fail "the uplink is not in the mission's belief"; }
result=$(stopped "$uplinks" compose --profile mqtt stop --timeout "$STOP_S" uplinks)
compose --profile mqtt stop --timeout "$STOP_S" mosquitto >/dev/null 2>&1
say "a sensor's uplink went through the broker into a mission's belief; its forwarder stopped: $result"

# --- killed in mid-mission -------------------------------------------------------------------------------------------
flown=$(answered)
export AICVDS_SEED=1
quietly compose up --detach --no-deps --force-recreate simulator
simulator=$(container simulator)
begin=$SECONDS
until (($(answered) > flown + 30)); do
  ((SECONDS - begin < FLIGHT_S)) || fail "the second mission does not begin"
  sleep 0.3
done
quietly compose kill -s KILL edge
quietly compose up --detach --no-recreate edge
code=$(timeout "$FLIGHT_S" docker wait "$simulator") || fail "the second simulator did not end within $FLIGHT_S s"
[[ $code == 0 ]] || fail "the second simulator ended with exit code $code"
rm -rf "$WORK/run"
docker cp "$simulator:/runs/compose" "$WORK/run" >/dev/null
mission=$(python3 -c 'import json, sys; print(json.load(open(sys.argv[1]))["mission_id"])' "$WORK/run/summary.json")
fetch "$(published edge 8000)/missions/$mission" >"$WORK/mission.json"
python3 - "$WORK/run/summary.json" "$WORK/mission.json" <<'PYTHON'
import json, sys

summary, mission = (json.load(open(path)) for path in sys.argv[1:])
told = summary["decisions"] - summary["by_source"]["onboard"]
print("       ", summary["by_source"], {key: mission[key] for key in ("decisions", "feedback", "learner_updates")})
if told < 60 or told == summary["decisions"]:
    sys.exit("FAIL: the edge was not killed in mid-mission, or hardly came back")
if mission["feedback"] != told or mission["decisions"] < told:
    sys.exit(f"FAIL: of {told} decisions told the edge knows {mission['decisions']}, and {mission['feedback']} outcomes")
PYTHON
edge=$(container edge)
say "the edge was killed in mid-mission and came back: every decision and outcome is there"

# --- what the images hold --------------------------------------------------------------------------------------------
edge_image=$(docker inspect --format '{{.Image}}' "$edge")
simulator_image=$(docker inspect --format '{{.Image}}' "$simulator")
lacks() { # image, modules it must do without
  docker run --rm --network none --entrypoint python "$1" -c '
import sys
from importlib.util import find_spec
from os import getuid
if found := [name for name in sys.argv[1:] if find_spec(name)]:
    sys.exit(f"FAIL: holds {found}")
if getuid() == 0:
    sys.exit("FAIL: runs as root")' "${@:2}"
}
lacks "$edge_image" simulator gymnasium matplotlib torch pip
lacks "$simulator_image" service torch scipy xllamacpp pip
settings=$(docker run --rm --network none --entrypoint python "$edge_image" -c '
from service.config.settings import Settings
own = ("cache_dir", "host", "port")
print(*(f"AICVDS_{name.upper()}" for name in Settings.model_fields if name not in own))')
for name in $settings; do
  grep -Eq "^      - $name(=.*)?$" docker-compose.yml || fail "docker-compose.yml does not pass $name on"
  grep -q "^#$name=" .env.example || fail ".env.example does not tell of $name"
done
say "both run as a plain user and hold only their own; every setting is passed on and told of"

# --- missions in PostgreSQL ------------------------------------------------------------------------------------------
export AICVDS_STORE=postgresql://aicvds:aicvds@postgres/aicvds
quietly compose up --detach --no-deps edge
edge=$(container edge)
begin=$SECONDS
until (($(docker inspect --format '{{.RestartCount}}' "$edge") > 0)); do
  ((SECONDS - begin < LLM_S)) || fail "without its store the edge is not started again"
  sleep 1
done
quietly compose --profile postgres up --detach --no-deps postgres
begin=$SECONDS
until [[ $(docker inspect --format '{{.State.Health.Status}}' "$edge") == healthy ]]; do
  ((SECONDS - begin < LLM_S)) || fail "the edge does not find PostgreSQL"
  sleep 1
done
export AICVDS_SEED=2
quietly compose up --detach --no-deps --force-recreate simulator
simulator=$(container simulator)
code=$(timeout "$FLIGHT_S" docker wait "$simulator") || fail "the third simulator did not end within $FLIGHT_S s"
[[ $code == 0 ]] || fail "the third simulator ended with exit code $code"
kept=$(docker exec --env PGPASSWORD=aicvds "$(container postgres)" \
  psql --host=localhost --username=aicvds --tuples-only --no-align --command='SELECT count(*) FROM missions' aicvds)
[[ $kept == 1 ]] || fail "PostgreSQL holds '$kept' missions"
say "an edge whose PostgreSQL came later found it, and its mission is there"

# --- SIGTERM ---------------------------------------------------------------------------------------------------------
result=$(stopped "$edge" compose stop --timeout "$STOP_S" edge)
say "the edge stopped: $result"
compose --profile postgres --profile mqtt down --volumes >/dev/null 2>&1

# --- without a network -----------------------------------------------------------------------------------------------
start_offline() { # as locked up as the compose file has it, and with no network at all
  docker rm --force "$OFFLINE" >/dev/null 2>&1 || true
  docker run --detach --name "$OFFLINE" --env AICVDS_ANONYMOUS=on --network none --read-only --tmpfs /tmp --cap-drop ALL \
    --security-opt no-new-privileges:true "$edge_image" >/dev/null
}
start_offline
begin=$SECONDS
until [[ $(llm_of "$OFFLINE") == ready ]]; do
  ((SECONDS - begin < LLM_S)) || { docker logs "$OFFLINE" >&2; fail "with no network the LLM is not ready in $LLM_S s"; }
  sleep 1
done
source=$(docker exec "$OFFLINE" python -c '
import json, urllib.request as u
spec = json.load(u.urlopen("http://127.0.0.1:8000/openapi.json"))
body = spec["paths"]["/decide"]["post"]["requestBody"]["content"]["application/json"]["examples"]["paper"]["value"]
# The subject is the LLM that needs no network, not the speed of the machine.
body["deadline_ms"] = 60_000
request = u.Request("http://127.0.0.1:8000/decide", json.dumps(body).encode(), {"Content-Type": "application/json"})
print(json.load(u.urlopen(request))["source"])')
[[ $source == guided ]] || fail "with no network the decision came from '$source'"
say "with no network the LLM was ready in $((SECONDS - begin)) s and took a decision"
start_offline
sleep 0.3
result=$(stopped "$OFFLINE" docker stop -t "$STOP_S" "$OFFLINE")
say "stopped while still starting: $result"

# --- sizes -----------------------------------------------------------------------------------------------------------
size() { docker image inspect --format '{{.Size}}' "$1"; }
readonly BASE=python:3.11-slim-bookworm EDGE_MB=650 SIMULATOR_MB=200
# BuildKit keeps the base image to itself.
size "$BASE" >/dev/null 2>&1 || quietly docker pull "$BASE"
base=$(size "$BASE")
beyond() { # name, image, most: see that it adds less than so many MB to the base image
  local added=$((($(size "$2") - base) / 1000000))
  ((added < $3)) || fail "the $1's image adds $added MB to the base image, and may add $3"
  say "the $1's image adds $added MB to the base image's $((base / 1000000)) MB"
}
beyond edge "$edge_image" "$EDGE_MB"
beyond simulator "$simulator_image" "$SIMULATOR_MB"
echo "PASS: the containers fly the paper's mission (${SECONDS} s)"
