// Latency as a colour: viridis, which the colour-blind read too, on a logarithmic scale.

const VIRIDIS = [
  "#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151", "#bddf26", "#fde725",
].map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)));

const dark = matchMedia("(prefers-color-scheme: dark)");

/** Calls `then` when the system turns dark or light. */
export const onTheme = (then) => dark.addEventListener("change", then);

/** viridis at 0..1, without the end that cannot be told from the background. */
export function viridis(share) {
  const [low, high] = dark.matches ? [0.22, 1] : [0, 0.88];
  const place = (low + (high - low) * Math.min(1, Math.max(0, share))) * (VIRIDIS.length - 1);
  const from = Math.min(VIRIDIS.length - 2, Math.floor(place));
  const mixed = VIRIDIS[from].map((c, i) => Math.round(c + (VIRIDIS[from + 1][i] - c) * (place - from)));
  return `rgb(${mixed.join(",")})`;
}

/** A scale over what there is to show, between round numbers of milliseconds. */
export function latencyScale(values) {
  const positive = values.filter((v) => v > 0);
  const low = roundDown(positive.length ? Math.min(...positive) : 1);
  const high = roundUp(positive.length ? Math.max(...positive) : 1000);
  const [from, to] = [Math.log(low), Math.log(high > low ? high : low * 10)];
  return { low, high: Math.exp(to), share: (ms) => (Math.log(Math.max(ms, low)) - from) / (to - from) };
}

/** A colour that the style sheet names. */
export const named = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

const STEPS = [1, 2, 5, 10];

function roundDown(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * STEPS.findLast((s) => s * power <= value * (1 + 1e-9));
}

function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * STEPS.find((s) => s * power >= value * (1 - 1e-9));
}
