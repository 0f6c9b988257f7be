// What the wire's words mean, for people.

export const SOURCES = {
  guided: "LLM among the advisers",
  llm: "LLM",
  value: "learned values",
  policy: "LLM-free policy",
};

const REASONS = {
  mode_value: "as its mode says",
  mode_policy: "as its mode says",
  no_candidate: "no sensor was both heard and free",
  llm_loading: "the LLM was still loading",
  llm_unavailable: "no LLM was to be had",
  llm_timeout: "the LLM was too late",
  llm_status: "the LLM's server refused",
  llm_error: "the LLM's server failed",
  llm_busy: "too many waited for the LLM",
  answer_format: "the LLM's answer had the wrong form",
  answer_sensor: "the LLM named a sensor that was not offered",
  answer_velocity: "the LLM named a velocity that is not allowed",
  answer_reserved: "another UAV had got the sensor meanwhile",
  critic_timeout: "there was no time to weigh the candidates",
  rule_reach: "the LLM's sensor would have been out of reach",
  rule_battery: "the LLM's sensor has a flat battery",
};

/** Who decided, and why it was not the LLM if it was not. */
export function why(answer) {
  if (answer.reason) return REASONS[answer.reason] ?? answer.reason;
  return answer.model ? `with ${answer.model}` : "";
}

export const ADVISERS = { llm: "LLM", planner: "planner", value: "learned values", policy: "look-ahead" };

export const GUIDANCE = {
  none: "",
  compiling: "is being read by the LLM",
  proposed: "was read; it waits for the operator's word",
  confirmed: "is confirmed and obeyed",
  rejected: "was rejected: it is not obeyed",
  failed: "was not understood: it is not obeyed",
};
