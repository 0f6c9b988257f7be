// What a pilot seeks first: the clock, and of each UAV its battery, height, link, and next waypoint with its time.

import { at, make, say, set, shown } from "./dom.js";
import { measured } from "./model.js";

const LOW_PERCENT = 25;
const LOST_STEPS = 3;
// A fleet that flies its steps in less than this share of their time is simulated: wall clocks say nothing of it.
const REAL_PACE = 0.5;
const COLUMNS = ["UAV", "Battery", "Height", "Link", "Next waypoint", "Collects from"];

const rows = new Map();
let of = null;

/** Show the fleet as it is now; called every second, too, since links age. */
export function showFleet(mission) {
  if (of !== mission) {
    of = mission;
    rows.clear();
    at("fleet-rows").replaceChildren();
  }
  const ids = [...Array(mission.scenario.uavs).keys()];
  const newest = new Map();
  for (const decision of mission.decisions.values()) newest.set(decision.answer.uav_id, decision);
  const lines = ids.map((id) => [id, described(mission, id, newest.get(id))]);
  for (const [id, cells] of lines) show(id, mission, cells);
  at("fleet-none").hidden = Object.keys(mission.now.uavs).length > 0;
}

/** The time of day, and the mission's. */
export function showClock(mission) {
  const day = clock(new Date(), { timeZoneName: "short" });
  say(at("clock"), mission ? `${day} · mission ${missionTime(mission, mission.now.step)}` : day);
}

function described(mission, id, decision) {
  const known = mission.now.uavs[id];
  if (!known) return { link: ["no report yet", "quiet"] };
  const { now, scenario } = mission;
  const age = known.heard_s === null ? null : known.heard_s + mission.age;
  const lost = now.step - known.step > LOST_STEPS || (mission.isSilent && !mission.ended);
  const trip = decision ? measured(decision) : null;
  const link = age === null ? `step ${known.step}` : `${seconds(age)} ago${trip === null ? "" : `, ${shown(trip, 0)} ms`}`;
  const answer = decision?.answer;
  return {
    battery: known.battery === null ? ["not reported", "quiet"] : [`${shown(known.battery, 0)}%`, known.battery < LOW_PERCENT ? "bad" : ""],
    height: known.height_m === null ? ["not reported", "quiet"] : [`${shown(known.height_m, 0)} m`, ""],
    link: mission.ended ? ["mission ended", "quiet"] : [lost ? `lost: ${link}` : link, lost ? "bad" : ""],
    next: mission.ended || lost ? ["–", ""] : [next(), ""],
    does: [answer ? `${mission.sensor(answer.sensor_id)} at ${answer.velocity} m/s` : "nothing yet", ""],
  };

  function next() {
    const step = known.step + 1;
    const way = known.next ? Math.hypot(known.next[0] - known.position[0], known.next[1] - known.position[1]) : null;
    const real = age !== null && (now.step_took_s === null || now.step_took_s > REAL_PACE * scenario.step_s);
    const time = real ? clock(new Date(Date.now() + 1000 * (scenario.step_s - age))) : `mission ${missionTime(mission, step)}`;
    return `${step} at ${time}${way === null ? "" : `, ${shown(way, 0)} m`}`;
  }
}

function show(id, mission, cells) {
  if (!rows.has(id)) {
    const name = make("button", { type: "button", class: "plain" }, mission.uav(id, "UAV "));
    name.addEventListener("click", () => at(`uav-${id}`)?.focus());
    const made = COLUMNS.map((column, i) => make(i ? "td" : "th", i ? { "data-label": column } : { scope: "row" }));
    made[0].append(name);
    rows.set(id, made);
    at("fleet-rows").append(make("tr", {}, ...made));
  }
  ["battery", "height", "link", "next", "does"].forEach((key, i) => {
    const [text, state] = cells[key] ?? ["–", ""];
    const cell = rows.get(id)[i + 1];
    say(cell, text);
    set(cell, { class: state || null });
  });
}

// Without "2-digit", a browser that adds the time zone writes 0:04:47 for 00:04:47.
const DIGITS = { hour: "2-digit", minute: "2-digit", second: "2-digit" };
export const clock = (date, more) => date.toLocaleTimeString("en-GB", { ...DIGITS, ...more });
const seconds = (s) => (s < 120 ? `${shown(s, 0)} s` : `${shown(s / 60, 0)} min`);

function missionTime(mission, step) {
  const s = Math.round(step * mission.scenario.step_s);
  const two = (n) => String(n).padStart(2, "0");
  return s < 3600 ? `${two(Math.floor(s / 60))}:${two(s % 60)}` : `${Math.floor(s / 3600)}:${two(Math.floor(s / 60) % 60)}:${two(s % 60)}`;
}
