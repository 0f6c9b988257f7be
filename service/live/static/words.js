// What the wire's words mean, for people.

import { shown } from "./dom.js";

export const SOURCES = {
  guided: "guided",
  llm: "LLM",
  value: "learned values",
  policy: "LLM-free policy",
};

const REASONS = {
  mode_value: "as its mode says",
  mode_policy: "as its mode says",
  no_candidate: "no sensor was both heard and free",
  llm_loading: "the LLM was still loading",
  llm_unavailable: "no LLM was available",
  llm_timeout: "the LLM was too late",
  llm_status: "the LLM's server refused",
  llm_error: "the LLM's server failed",
  llm_busy: "too many queries waited for the LLM",
  answer_format: "the LLM's answer had the wrong form",
  answer_sensor: "the LLM named a sensor that was not offered",
  answer_velocity: "the LLM named a velocity that is not allowed",
  answer_reserved: "another UAV had taken the sensor meanwhile",
  critic_timeout: "the candidates could not be weighed",
  rule_reach: "the LLM's sensor would have been out of reach",
  rule_battery: "the LLM's sensor has a flat battery",
};

export const ADVISERS = { llm: "LLM", planner: "planner", value: "learned values", policy: "look-ahead" };

/** A share as a percentage; what is neither 0 nor 1 is not rounded to them. */
export function percent(share) {
  if (share > 0 && share < 0.005) return "<1%";
  if (share < 1 && share >= 0.995) return ">99%";
  return `${shown(100 * share, 0)}%`;
}

/** Who decided; in mode guided the adviser that weighed most. */
export function decider(answer) {
  const name = SOURCES[answer.source] ?? answer.source;
  if (answer.source !== "guided" || !answer.guided) return name;
  const [leading, weight] = Object.entries(answer.guided.trust).sort((a, b) => b[1] - a[1])[0];
  return `${name} (${ADVISERS[leading] ?? leading} ${percent(weight)})`;
}

/** Why the decision is not the LLM's; empty where it has a part in it. */
export const why = (answer) => (answer.reason ? (REASONS[answer.reason] ?? answer.reason) : "");

/** The state of the operator's note. */
export const GUIDANCE = {
  none: "No note.",
  compiling: "The LLM is reading the note.",
  proposed: "The note was read. Its orders wait for your confirmation:",
  confirmed: "Confirmed.",
  rejected: "Rejected: the note is not obeyed.",
  failed: "The note was not understood, and is not obeyed:",
};
