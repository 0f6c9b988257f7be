// The page: which mission is shown, the connection to it, and when it is drawn.

import { showAlarms } from "./alarms.js";
import { Charts } from "./charts.js";
import { open } from "./decision.js";
import { at, make, say, set } from "./dom.js";
import { ask, events, hasKey, Refused, useKey } from "./edge.js";
import { showClock, showFleet } from "./fleet.js";
import { Feed } from "./feed.js";
import { MissionMap } from "./map.js";
import { Mission } from "./model.js";
import { clearNumbers, showNumbers } from "./numbers.js";
import { Operator } from "./operator.js";

const LISTED_EVERY_MS = 3000;
// The most events that wait while the view is frozen; past these the page asks for a snapshot.
const MOST_WAITING = 2000;
const RETRY_MS = [1000, 2000, 4000, 8000];
const calm = matchMedia("(prefers-reduced-motion: reduce)");

let wanted = new URLSearchParams(location.search).get("mission");
let mission = null;
let following = null;
let stop = new AbortController();
let drawing = false;
let paused = false;
let waiting = [];
let remark = null;
let mayCommand = false;
let ready = null;

const feed = new Feed((id) => mission?.decisions.has(id) && open(mission.decisions.get(id), mission));
const map = new MissionMap((kind, id) => {
  const last = mission.newest(1000).find(({ answer }) => (kind === "uav" ? answer.uav_id : answer.sensor_id) === id);
  if (last) open(last, mission);
});
const charts = new Charts();
const operator = new Operator();

function connection(state, text) {
  set(at("connection"), { "data-state": state });
  say(at("connection").querySelector("b"), text);
}

/** What is wrong now, or else what is to be remarked. */
function trouble(text) {
  at("trouble").hidden = !(text ?? remark);
  say(at("trouble"), text ?? remark ?? "");
}

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** Which missions there are, again and again; follows the newest unless one was chosen. */
async function list() {
  for (;;) {
    try {
      const told = await ask("missions");
      offer(told);
      if (mayCommand !== told.may_command) {
        mayCommand = told.may_command;
        soon();
      }
      badge();
      const before = JSON.stringify(ready);
      // Its 503 has the same body, with the cause.
      ready = await fetch("readyz", { cache: "no-store" }).then((answer) => answer.json()).catch(() => null);
      if (mission && JSON.stringify(ready) !== before) soon();
      const next = wanted ?? (stays(told) ? following : null) ?? told.newest ?? told.missions.find((one) => one.mode)?.mission_id ?? null;
      if (next === null) nothing(told);
      else if (next !== following) follow(next);
    } catch (error) {
      await refused(error);
    }
    await pause(LISTED_EVERY_MS);
  }
}

/** Whether the page stays with its mission, although another may be newer: it flies, or an order is being written. */
function stays(told) {
  if (mission?.id !== following || !told.missions.some((one) => one.mission_id === following)) return false;
  const writes = paused || at("note-input").value || document.activeElement === at("orders-input");
  return writes || (!mission.ended && mission.idleS !== null && !mission.isSilent);
}

function offer(told) {
  const names = [["", told.newest ? `Newest: ${told.newest}` : "Newest"]];
  for (const { mission_id: id, mode } of told.missions) names.push([id, mode ? `${id} (${mode})` : `${id} (in the store)`]);
  if (wanted && !names.some(([id]) => id === wanted)) names.push([wanted, wanted]);
  if (told.more) names.push([null, `${told.more} more are not listed: put ?mission=ID into the address`]);
  const key = JSON.stringify(names);
  if (offer.key === key) return;
  offer.key = key;
  at("picker").replaceChildren(...names.map(([id, text]) => make("option", id === null ? { disabled: "" } : { value: id }, text)));
  at("picker").value = wanted ?? "";
}

function nothing(told) {
  mission = null;
  badge();
  showClock(null);
  document.title = "AIC-VDS mission";
  at("empty").hidden = false;
  at("mission").hidden = true;
  connection("waiting", "Waiting for a mission");
  const asleep = told.missions.length;
  say(at("empty-title"), asleep ? "No mission has flown since the edge started" : "No mission yet");
  say(at("empty-text"), asleep ? "Choose one of the store above, or fly one, and it appears here:" : "Fly one, and it appears here:");
  say(at("empty-command"), `aicvds simulate --edge ${location.origin} --out runs/mission`);
}

/** Show this mission, whatever happens on the way, until another is to be shown. */
async function follow(id) {
  stop.abort();
  stop = new AbortController();
  const { signal } = stop;
  following = id;
  let tries = 0;
  while (!signal.aborted) {
    try {
      for await (const event of events(`missions/${encodeURIComponent(id)}/events`, signal)) {
        if (signal.aborted) return;
        tries = 0;
        trouble(null);
        connection("live", "Connected");
        if (event.name === "gone") return gone(id);
        if (!paused) hear(event);
        else if (waiting.length < MOST_WAITING) waiting.push(event);
      }
    } catch (error) {
      if (signal.aborted) return;
      if (error instanceof Refused && error.status === 404) return gone(id);
      if (error instanceof Refused) await refused(error);
    }
    if (signal.aborted) return;
    const wait = RETRY_MS[Math.min(tries++, RETRY_MS.length - 1)];
    if (tries > 1 || wait > RETRY_MS[0]) lost();
    connection("lost", `Connection lost, trying again`);
    await pause(wait * (0.75 + Math.random() / 2));
  }
}

function lost() {
  const seen = mission ? ` What you see is from step ${mission.now.step}.` : "";
  if (!at("trouble").textContent.startsWith("The edge refused")) trouble(`The edge does not answer. The page goes on as soon as it does.${seen}`);
}

function gone(id) {
  if (following === id) following = null;
  if (wanted === id) {
    wanted = null;
    remark = `There is no mission ${id}, or no longer. The newest is shown instead.`;
    trouble(null);
    history.replaceState(null, "", location.pathname);
    offer.key = null;
  }
}

async function refused(error) {
  if (!(error instanceof Refused)) {
    connection("lost", "Connection lost, trying again");
    lost();
  } else if (error.status === 401) {
    connection("lost", "A key is needed");
    await askForKey();
  } else {
    connection("lost", "Refused");
    trouble(`The edge refused: ${error.message}`);
    await pause(1000 * error.retryS);
  }
}

let asking = null;

function askForKey() {
  asking ??= new Promise((resolve) => {
    say(at("key-text"), `${hasKey() ? "The key that was given is not known here, or no longer. " : ""}Any key of the edge may read. It is kept in this tab until you close it.`);
    at("key").showModal();
    at("key").addEventListener("close", () => {
      if (at("key-input").value) useKey(at("key-input").value.trim());
      at("key-input").value = "";
      asking = null;
      resolve();
    }, { once: true });
  });
  return asking;
}

function hear({ name, data }) {
  if (name === "snapshot") {
    if (mission?.goesOn(data)) mission.begin(data);
    else {
      mission = new Mission(data);
      feed.begin();
      clearNumbers();
      operator.begin();
      charts.mission = null;
      charts.begin();
    }
    at("empty").hidden = true;
    at("mission").hidden = false;
    map.begin(mission);
    draw();
  } else if (name === "update" && mission) {
    mission.apply(data);
    soon();
  }
}

/** Whether the mission flies, has ended or is silent, and whether the view is frozen. */
function badge() {
  const state = !mission ? null : paused ? "frozen" : mission.ended ? "ended" : mission.idleS === null ? "new" : mission.isSilent ? "silent" : "flying";
  at("badge").hidden = state === null;
  if (state === null) return;
  const minutes = Math.floor((mission.idleS ?? 0) / 60);
  const words = { frozen: "View frozen", ended: "Ended", new: "No decision since the edge started", flying: "Flying", silent: `No decision for ${minutes ? `${minutes} min` : `${Math.floor(mission.idleS)} s`}` }[state];
  set(at("badge"), { "data-state": state });
  say(at("badge"), mission.id.endsWith("-replay") ? `Replay: ${words.toLowerCase()}` : words);
}

function soon() {
  if (drawing || paused) return;
  drawing = true;
  // Once a second is calm enough to read.
  if (calm.matches) setTimeout(draw, 1000);
  else requestAnimationFrame(draw);
}

function draw() {
  drawing = false;
  if (paused || !mission) return;
  map.update(mission);
  feed.update(mission);
  charts.update(mission);
  showNumbers(mission);
  showAlarms(mission, ready);
  showFleet(mission);
  operator.update(mission, mayCommand);
  badge();
  document.title = `${mission.id} · AIC-VDS`;
  at("mission").dataset.made = mission.now.made;
}

at("picker").addEventListener("change", ({ target }) => {
  wanted = target.value || null;
  history.replaceState(null, "", wanted ? `?mission=${encodeURIComponent(wanted)}` : location.pathname);
  remark = null;
  trouble(null);
  freeze(false);
  if (wanted) follow(wanted);
});

at("pause").addEventListener("click", () => freeze(!paused));

/** Freeze the view, or show what came since. */
function freeze(frozen) {
  paused = frozen;
  set(at("pause"), { "aria-pressed": paused });
  badge();
  if (paused) return;
  const came = waiting;
  waiting = [];
  if (came.length < MOST_WAITING) came.forEach(hear);
  else if (following) follow(following);
  draw();
}

setInterval(() => {
  showClock(mission);
  if (!mission || paused) return;
  showFleet(mission);
  // A fleet that falls silent brings no update.
  showAlarms(mission, ready);
}, 1000);
showClock(null);
list();
