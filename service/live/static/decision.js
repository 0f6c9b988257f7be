// One decision in full: candidates with scores and probabilities, trust, times, tokens, and its prompt.

import { at, make, say, shown } from "./dom.js";
import { ask, Refused } from "./edge.js";
import { measured } from "./model.js";
import { ADVISERS, decider, percent, why } from "./words.js";

let opened = null;

at("decision-close").addEventListener("click", () => at("decision").close());

/** Show a mission's decision; its prompt is asked for. */
export function open(decision, mission) {
  const { asks } = mission.about;
  const { answer } = decision;
  opened = answer.decision_id;
  say(at("decision-title"), `Step ${answer.step}: ${mission.uav(answer.uav_id)} to ${mission.sensor(answer.sensor_id)} at ${answer.velocity} m/s`);
  const prompt = make("section", {}, make("h3", {}, "Prompt"), make("p", {}, "Asking the edge for it…"));
  const said = why(answer);
  at("decision-body").replaceChildren(
    make("p", {}, make("span", { class: "who", "data-source": answer.source }, decider(answer)), said ? ` ${said}` : ""),
    candidates(answer, mission), ...trust(answer), times(decision), ...(asks ? [tokens(answer)] : []), prompt);
  if (!at("decision").open) at("decision").showModal();
  at("decision-title").focus();
  showPrompt(answer, prompt);
}

function candidates(answer, mission) {
  const chosen = (row) => row.sensor_id === answer.sensor_id && (row.velocity ?? answer.velocity) === answer.velocity;
  const guided = answer.guided?.candidates;
  const columns = guided
    ? [["Sensor", (c) => mission.sensor(c.sensor_id)], ["m/s", (c) => c.velocity], ["LLM", (c) => (c.llm === null ? "silent" : c.llm.toFixed(3))],
       ["Advisers", (c) => c.mixture.toFixed(3)], ["Expected loss", (c) => c.regret.toFixed(2)], ["Score", (c) => c.score.toFixed(2)]]
    : [["Sensor", (c) => mission.sensor(c.sensor_id)], ["Attention score", (c) => c.score.toFixed(3)],
       ...(answer.top_k.some((c) => c.llm !== undefined) ? [["LLM", (c) => (c.llm ?? 0).toFixed(3)]] : [])];
  const rows = (guided ?? answer.top_k).map((row) =>
    make("tr", chosen(row) ? { class: "chosen" } : {}, ...columns.map(([, cell]) => make("td", {}, String(cell(row)))), make("td", {}, chosen(row) ? "flown" : "")));
  const head = make("tr", {}, ...columns.map(([name]) => make("th", { scope: "col" }, name)), make("td", {}));
  const note = guided ? "Best first. Expected loss: packets lost above the best candidate, by simulation. Score: advice less expected loss; the highest flies." : "The sensors that attention kept, best first.";
  return make("section", {}, make("h3", {}, "Candidates"), make("p", { class: "hint" }, rows.length ? note : "No sensor was offered."),
    make("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Candidates" }, make("table", {}, make("thead", {}, head), make("tbody", {}, ...rows))));
}

function trust(answer) {
  if (!answer.guided) return [];
  const bars = Object.entries(answer.guided.trust).sort((a, b) => b[1] - a[1]).map(([name, weight]) =>
    make("li", {}, make("span", {}, ADVISERS[name] ?? name), make("meter", { min: 0, max: 1, value: weight, "aria-label": `trust in ${ADVISERS[name] ?? name}` }), make("span", {}, percent(weight))));
  return [make("section", {}, make("h3", {}, "Trust before this decision"), make("ul", { class: "bars" }, ...bars))];
}

function times(decision) {
  const { latency_ms: stages, deadline_ms: deadline } = decision.answer;
  const roundTrip = measured(decision);
  const rows = Object.entries(stages).filter(([name]) => name !== "total").map(([name, ms]) => [name, `${shown(ms, 2)} ms`]);
  rows.push(["at the edge, total", `${shown(stages.total, 2)} ms of ${shown(deadline, 0)} ms`]);
  rows.push(["round trip, by the UAV", roundTrip === null ? "not reported" : `${shown(roundTrip, 2)} ms`]);
  return make("section", {}, make("h3", {}, "Time"), pairs(rows));
}

function tokens(answer) {
  const t = answer.tokens;
  const rows = [["prompt", `${t.prompt}: ${t.static} static, ${t.experiences} experiences, ${t.state} state`],
    ["with full rows of every sensor", String(t.uncompressed)], ["saved", String(t.saved)], ["counted with", t.tokenizer]];
  if (t.server_prompt !== null) rows.push(["by the LLM's own count", `${t.server_prompt}, of which ${t.cached ?? 0} cached; ${t.completion ?? 0} answered`]);
  if (t.cost_usd) rows.push(["price", `$${t.cost_usd.toPrecision(3)}`]);
  return make("section", {}, make("h3", {}, "Tokens"), pairs(rows));
}

const pairs = (rows) => make("dl", { class: "pairs" }, ...rows.flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)]));

async function showPrompt(answer, section) {
  const path = `missions/${encodeURIComponent(answer.mission_id)}/decisions/${answer.decision_id}/prompt`;
  let parts;
  try {
    const told = await ask(path);
    const block = (name, text) => [make("h4", {}, name), make("pre", { tabindex: 0, role: "region", "aria-label": name }, text || "(empty)")];
    parts = [make("p", { class: "hint" }, told.asked ? "As the LLM received it." : "No LLM was asked. The prompt only serves to count its tokens."),
      ...block("Static block, the same for the whole mission", told.static), ...block("Experiences", told.experiences), ...block("Current task", told.state),
      ...(told.in_words.length ? block("Current task in words", told.in_words.join("\n")) : [])];
  } catch (error) {
    const gone = error instanceof Refused && error.status === 404;
    parts = [make("p", {}, gone ? "The edge keeps the prompts of its newest decisions only; this one is gone." : `The edge did not say: ${error.message}`)];
  }
  if (opened === answer.decision_id) section.replaceChildren(make("h3", {}, "Prompt"), ...parts);
}
