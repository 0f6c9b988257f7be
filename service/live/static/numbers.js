// The numbers above the map, and the sentence that a screen reader is told now and then.

import { at, make, say, shown } from "./dom.js";
import { latency, measured } from "./model.js";
import { ADVISERS, SOURCES } from "./words.js";

const TOLD_EVERY_MS = 10_000;
const LATELY = 30;

const cells = new Map();
let told = 0;

/** Show a mission's numbers. */
export function showNumbers(mission) {
  const { now, scenario, totals, sources } = mission;
  const lately = mission.newest(LATELY);
  const times = lately.map(latency).sort((a, b) => a - b);
  const typical = times.length ? times[Math.floor(times.length / 2)] : null;
  const roundTrip = lately.length > 0 && lately.every((d) => measured(d) !== null || d.outcome === null) && lately.some((d) => measured(d) !== null);
  const by = [...sources].sort((a, b) => b[1] - a[1]).map(([source, n]) => `${n} ${SOURCES[source] ?? source}`).join(", ");
  cell("Step", String(now.step), `mission of ${scenario.steps}, from 0, ${scenario.step_s} s each`);
  cell("Decisions", shown(now.made, 0), by || `mode ${mission.about.mode}`);
  cell(roundTrip ? "Round trip" : "Edge's time", typical === null ? "–" : `${shown(typical)} ms`,
    typical === null ? "no decision yet" : `median of the newest ${times.length}; slowest ${shown(times.at(-1))} ms`, "time");
  cell("Tokens saved", totals.uncompressed ? `${shown((100 * totals.saved) / totals.uncompressed, 0)}%` : "–",
    totals.seen ? `${shown(totals.saved / totals.seen, 0)} of ${shown(totals.uncompressed / totals.seen, 0)} a decision` : "by attention and masks");
  cell("Failed", String(totals.failed), `of ${totals.told} transmissions told`);
  cell("Cost", shown(totals.cost, 1), totals.told ? `${shown(totals.cost / totals.told, 3)} a decision; 0 is best` : "as the UAVs tell it; 0 is best");
  cell("Learner", shown(now.learner_updates, 0), now.learner_loss === null ? "updates; no loss yet" : `updates; last loss ${now.learner_loss.toPrecision(2)}`);
  const trust = lately.find((d) => d.answer.guided)?.answer.guided.trust;
  if (trust) cell("Trust in the LLM", `${shown(100 * (trust.llm ?? 0), 0)}%`, Object.entries(trust).filter(([name]) => name !== "llm").map(([name, w]) => `${ADVISERS[name] ?? name} ${shown(100 * w, 0)}%`).join(", "));
  tell(mission, typical, roundTrip);
}

/** Forget the numbers of the mission before. */
export function clearNumbers() {
  cells.clear();
  told = 0;
  at("numbers").replaceChildren();
}

function cell(name, value, detail, key = name) {
  if (!cells.has(key)) {
    const parts = [make("dt"), make("dd", { class: "value" }), make("dd", { class: "detail" })];
    at("numbers").append(make("div", {}, ...parts));
    cells.set(key, parts);
  }
  [name, value, detail].forEach((text, i) => say(cells.get(key)[i], text));
}

function tell(mission, typical, roundTrip) {
  if (performance.now() - told < TOLD_EVERY_MS && told) return;
  told = performance.now();
  const { now, totals } = mission;
  const urgent = now.urgency.indexOf(now.urgency.reduce((most, one) => Math.max(most, one), 0));
  const time = typical === null ? "" : ` ${roundTrip ? "Round trip" : "Edge's time"} ${shown(typical)} milliseconds.`;
  say(at("summary"), `Mission ${mission.id}, step ${now.step}: ${now.made} decisions, ${totals.failed} failed transmissions.${time} Most urgent: sensor ${urgent}, ${shown(now.queue[urgent], 0)} packets.`);
}
