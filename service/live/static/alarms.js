// What may need the operator, since when, and what to do: the store, the LLM, the deadline, UAVs, visits, and sensors.

import { at, make, say, shown } from "./dom.js";

const SOON_STEPS = 2;
const UNHEARD_STEPS = 10;
const BATTERY = 0.15;
const UAV_BATTERY = 25;
const MOST_NAMED = 12;
const LATELY = 30;
const LLM_FAULTS = ["degraded", "unavailable"];

/** Show a mission's alarms, or nothing where there are none; `ready`: the edge's answer to `/readyz`. */
export function showAlarms(mission, ready) {
  const found = [...ofTheEdge(mission, ready), ...alarms(mission)];
  if (showAlarms.mission !== mission) [showAlarms.mission, showAlarms.since] = [mission, new Map()];
  // An alarm that knows no step has been there since this page saw it first.
  showAlarms.since = new Map(found.map(({ name, since }) => [name, since ?? showAlarms.since.get(name) ?? mission.now.step]));
  const lines = found.map(({ name, who, todo }) => [name, named(who), `Since step ${showAlarms.since.get(name)}. ${todo}`]);
  const key = JSON.stringify(lines);
  if (showAlarms.key === key) return;
  showAlarms.key = key;
  const names = found.map(({ name }) => name);
  const come = names.filter((name) => !showAlarms.names?.includes(name));
  showAlarms.names = names;
  if (come.length) say(at("alarm-news"), `New alarm: ${come.join(", ")}.`);
  at("alarms").hidden = found.length === 0;
  at("alarm-list").replaceChildren(...lines.map(([name, who, rest]) => make("li", {}, make("b", {}, `${name}: `), `${who}. `, make("small", {}, rest))));
}

/** Alarms of the edge itself, as the newest decisions and `/readyz` have them. */
function ofTheEdge(mission, ready) {
  const answers = mission.newest(LATELY).map(({ answer }) => answer);
  const late = answers.filter((answer) => answer.latency_ms.total > answer.deadline_ms);
  const unstored = run(answers, (answer) => !answer.stored);
  const unasked = run(answers, (answer) => /^(llm|answer)_/.test(answer.reason ?? ""));
  const reason = ready?.detail ?? "the edge's log has the reason";
  // A store that was slow has written them since, if it works now and no decision followed.
  const storeFails = ready?.ready === false || (unstored.length > 0 && !mission.isSilent);
  return [
    alarm("Store fails", storeFails ? [ready?.ready === false ? reason : "decisions are not on disk"] : [], "Decisions go on, but a restart forgets them: the edge's log has the reason.", unstored),
    alarm(`LLM ${ready?.llm}`, mission.about.asks && LLM_FAULTS.includes(ready?.llm) ? [reason] : [], "Others decide for it: ask it by aicvds doctor --llm-url.", unasked),
    alarm("Deadline missed", late.length ? [`${late.length} of the newest ${answers.length} decisions`] : [], "UAVs may decide on board: the machine or its disk is too slow for this deadline.", late),
  ].filter(({ who }) => who.length > 0);
}

/** The alarms of UAVs and sensors; the most urgent first. */
export function alarms(mission) {
  const { now } = mission;
  const capacity = mission.scenario.queue_capacity;
  const sensor = (id) => mission.sensor(id);
  const craft = (id) => mission.uav(id, "UAV ");
  const ids = [...now.queue.keys()];
  const heard = ids.filter((id) => now.heard[id] >= 0);
  const full = heard.filter((id) => now.queue[id] >= capacity - 0.5);
  const soon = heard.filter((id) => !full.includes(id) && now.full_in[id] <= SOON_STEPS).sort((a, b) => now.full_in[a] - now.full_in[b]);
  const unheard = ids.filter((id) => now.step - now.heard[id] > UNHEARD_STEPS).sort((a, b) => now.heard[a] - now.heard[b]);
  const worse = Object.keys(now.excess_db).sort((a, b) => now.excess_db[b] - now.excess_db[a]);
  const { uav_lost: known, uav_off_path: off, uav_battery: flat, visit_late: late, sensor_battery: battery } = now.alarms;
  const everyone = Object.fromEntries(Object.entries(now.uavs).map(([id, { step }]) => [id, step]));
  const lost = mission.isSilent && !mission.ended ? everyone : known;
  const low = Object.keys(battery).sort((a, b) => now.battery[a] - now.battery[b]);
  const steps = (since) => Object.values(since).map((step) => ({ step }));
  return [
    alarm("UAV lost", Object.keys(lost).map((id) => `${craft(id)} (step ${lost[id]})`), "Look for it at its last place on the map; the others' plans leave it out.", steps(lost)),
    alarm("UAV off its path", Object.keys(off).map(craft), "Look at its autopilot: wind, another mission, or a pilot moves it."),
    alarm(`UAV battery below ${UAV_BATTERY}%`, Object.keys(flat).map((id) => `${craft(id)} (${shown(now.uavs[id]?.battery, 0)}%)`), "Bring it home while it still flies by your command."),
    alarm("Visit late", Object.keys(late).map((id) => `${sensor(id)} (due at step ${late[id]})`), "Give it a weight, or withdraw other orders.", steps(late)),
    alarm("Believed full", full.map(sensor), "It loses packets: order a visit."),
    alarm(`Full within ${SOON_STEPS} steps`, soon.map((id) => `${sensor(id)} (${shown(now.full_in[id])})`), "It will lose packets: order a visit."),
    alarm("In radio range but not heard", Object.keys(now.silent).map((id) => `${sensor(id)} (step ${now.silent[id]})`), "Look at its radio and battery."),
    alarm(`Not heard for more than ${UNHEARD_STEPS} steps`, unheard.map((id) => `${sensor(id)} (${now.heard[id] < 0 ? "never" : `step ${now.heard[id]}`})`), "Whether its queue overflows is unknown: order a visit."),
    alarm("Radio probably dead", now.failed_radios.map(sensor), "No visit brings its packets: repair it."),
    alarm("Links worse than modelled", worse.map((id) => `${sensor(id)} (${shown(now.excess_db[id], 0)} dB)`), "Fly slower past it, or free its line of sight."),
    alarm(`Battery below ${100 * BATTERY}%`, low.map((id) => `${sensor(id)} (${shown(100 * now.battery[id], 0)}%)`), "Change its battery."),
  ].filter(({ who }) => who.length > 0);
}

/** The newest answers that are all of a kind. */
function run(answers, of) {
  const end = answers.findIndex((answer) => !of(answer));
  return end < 0 ? answers : answers.slice(0, end);
}

/** `from`: what has the steps of the alarm; without any the page's first sight counts. */
function alarm(name, who, todo, from = []) {
  return { name, who, todo, since: from.length ? Math.min(...from.map(({ step }) => step)) : null };
}

function named(sensors) {
  const rest = sensors.length - MOST_NAMED;
  return sensors.slice(0, MOST_NAMED).join(", ") + (rest > 0 ? ` and ${rest} more` : "");
}
