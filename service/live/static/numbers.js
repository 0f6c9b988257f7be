// The numbers above the map, and the sentence that a screen reader gets now and then.

import { at, make, say, shown } from "./dom.js";
import { latency, measured } from "./model.js";
import { ADVISERS, percent, SOURCES } from "./words.js";

const SAID_EVERY_MS = 10_000;
const LATELY = 30;

const cells = new Map();
let said = 0;

/** Show a mission's numbers. */
export function showNumbers(mission) {
  const { now, scenario, totals, sources, about } = mission;
  const lately = mission.newest(LATELY);
  const times = lately.map(latency).sort((a, b) => a - b);
  const typical = times.length ? times[Math.floor(times.length / 2)] : null;
  const roundTrip = lately.length > 0 && lately.every((d) => measured(d) !== null || d.outcome === null) && lately.some((d) => measured(d) !== null);
  const full = now.queue.filter((packets, id) => now.heard[id] >= 0 && packets >= scenario.queue_capacity - 0.5).length;
  const unknown = now.heard.filter((step) => step < 0).length;
  cell("Step", String(now.step), `of ${scenario.steps}, from 0; ${scenario.step_s} s each`);
  cell("Overflows", `≈ ${shown(now.overflows, 0)}`, `believed, since the edge started; a sensor counts once a step. ${full} full now${unknown ? `; unknown of ${unknown} never heard` : ""}`);
  cell("Failed", String(totals.failed), totals.told ? `of ${totals.told} reported transmissions${totals.seen < now.made ? " that this page knows" : ""}; cost ${shown(totals.cost, 1)}, with losses in reach only` : "no transmission reported yet");
  cell(roundTrip ? "Round trip" : "Edge's time", typical === null ? "–" : `${shown(typical)} ms`,
    typical === null ? "no decision yet" : `median of the newest ${times.length}; slowest ${shown(times.at(-1))} ms`, "time");
  cell("Decisions", shown(now.made, 0), `${totals.seen < now.made ? `of ${shown(totals.seen, 0)}: ` : ""}${[...sources].sort((a, b) => b[1] - a[1]).map(([source, n]) => `${n} ${SOURCES[source] ?? source}`).join(", ") || "none yet"}`, "Decisions", "deciders-numbers");
  if (about.asks && totals.seen) {
    cell("Tokens saved", totals.uncompressed ? `${shown((100 * totals.saved) / totals.uncompressed, 0)}%` : "–",
      `${shown(totals.saved / totals.seen, 0)} of ${shown(totals.uncompressed / totals.seen, 0)} a decision`, "tokens", "deciders-numbers");
  }
  say(at("about"), described(mission, lately));
  tell(mission, typical, roundTrip);
}

/** Forget the numbers of the mission before. */
export function clearNumbers() {
  cells.clear();
  said = 0;
  at("numbers").replaceChildren();
  at("deciders-numbers").replaceChildren();
}

/** The mission's mode, LLM and planner, and the weight of each adviser. */
function described({ about, scenario, now }, lately) {
  const model = lately.find((d) => d.answer.model)?.answer.model;
  const trust = lately.find((d) => d.answer.guided)?.answer.guided.trust;
  const parts = [`Scenario ${scenario.name}`, `mode ${about.mode}`, `planner ${about.planner ? "on" : "off"}`];
  if (about.asks) parts.push(model ? `LLM ${model}` : "LLM not heard yet");
  if (trust) parts.push(`weights: ${Object.entries(trust).sort((a, b) => b[1] - a[1]).map(([name, w]) => `${ADVISERS[name] ?? name} ${percent(w)}`).join(", ")}`);
  if (now.learner_updates) parts.push(`${shown(now.learner_updates, 0)} learner updates`);
  return parts.join(" · ");
}

function cell(name, value, detail, key = name, list = "numbers") {
  if (!cells.has(key)) {
    const parts = [make("dt"), make("dd", { class: "value" }), make("dd", { class: "detail" })];
    at(list).append(make("div", {}, ...parts));
    cells.set(key, parts);
  }
  [name, value, detail].forEach((text, i) => say(cells.get(key)[i], text));
}

function tell(mission, typical, roundTrip) {
  if (performance.now() - said < SAID_EVERY_MS && said) return;
  said = performance.now();
  const { now, totals } = mission;
  const urgent = now.urgency.indexOf(now.urgency.reduce((most, one) => Math.max(most, one), 0));
  const time = typical === null ? "" : ` ${roundTrip ? "Round trip" : "Edge's time"} ${shown(typical)} milliseconds.`;
  say(at("summary"), `Mission ${mission.id}, step ${now.step}: ${now.made} decisions, about ${shown(now.overflows, 0)} overflows, ${totals.failed} failed transmissions.${time} Most urgent: ${mission.names?.sensors[urgent] ?? `sensor ${urgent}`}, ${shown(now.queue[urgent], 0)} packets.`);
}
