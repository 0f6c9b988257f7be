// What may need the operator: an LLM that does not decide, full and nearly full queues, sensors that are not heard, radios, links and batteries.

import { at, make, shown } from "./dom.js";

const SOON_STEPS = 2;
const UNHEARD_STEPS = 10;
const BATTERY = 0.15;
const MOST_NAMED = 12;
const LLM_FAULTS = ["degraded", "unavailable"];

/** Show a mission's alarms, or nothing where there are none; `ready`: the edge's answer to `/readyz`. */
export function showAlarms(mission, ready) {
  const found = alarms(mission.now, mission.scenario.queue_capacity);
  if (mission.about.asks && LLM_FAULTS.includes(ready?.llm)) found.unshift([`LLM ${ready.llm}`, [ready.detail ?? "the edge's log has the reason"]]);
  const key = JSON.stringify(found);
  if (showAlarms.key === key) return;
  showAlarms.key = key;
  at("alarms").hidden = found.length === 0;
  at("alarm-list").replaceChildren(...found.map(([name, sensors]) => make("li", {}, make("b", {}, `${name}: `), named(sensors))));
}

/** Each alarm's name with its sensors, as text; the most urgent sensor first. */
export function alarms(now, capacity) {
  const ids = [...now.queue.keys()];
  const full = ids.filter((id) => now.queue[id] >= capacity - 0.5);
  const soon = ids.filter((id) => !full.includes(id) && now.full_in[id] <= SOON_STEPS).sort((a, b) => now.full_in[a] - now.full_in[b]);
  const unheard = ids.filter((id) => now.step - now.heard[id] > UNHEARD_STEPS).sort((a, b) => now.heard[a] - now.heard[b]);
  const low = ids.filter((id) => now.heard[id] >= 0 && now.battery[id] < BATTERY).sort((a, b) => now.battery[a] - now.battery[b]);
  const worse = Object.keys(now.excess_db).sort((a, b) => now.excess_db[b] - now.excess_db[a]);
  const silent = Object.keys(now.silent);
  return [
    ["Believed full", full.map((id) => `S${id}`)],
    [`Full within ${SOON_STEPS} steps`, soon.map((id) => `S${id} (${shown(now.full_in[id])})`)],
    ["In radio range but not heard", silent.map((id) => `S${id} (step ${now.silent[id]})`)],
    [`Not heard for more than ${UNHEARD_STEPS} steps`, unheard.map((id) => `S${id} (${now.heard[id] < 0 ? "never" : `step ${now.heard[id]}`})`)],
    ["Radio probably dead", now.failed_radios.map((id) => `S${id}`)],
    ["Links worse than modelled", worse.map((id) => `S${id} (${shown(now.excess_db[id], 0)} dB)`)],
    [`Battery below ${100 * BATTERY}%`, low.map((id) => `S${id} (${shown(100 * now.battery[id], 0)}%)`)],
  ].filter(([, sensors]) => sensors.length > 0);
}

function named(sensors) {
  const rest = sensors.length - MOST_NAMED;
  return sensors.slice(0, MOST_NAMED).join(", ") + (rest > 0 ? ` and ${rest} more` : "");
}
