// Loss, latency and tokens by step, with uPlot; beside each chart a sentence says what it shows now.

import uPlot from "./vendor/uPlot.esm.js";
import { named, onTheme } from "./colours.js";
import { at, say, shown } from "./dom.js";

const HEIGHT = 220;
const REDRAWN_EVERY_MS = 500;

const CHARTS = {
  loss: {
    unit: "sum",
    series: [["overflows, believed", "--c3", [2, 3]], ["failed", "--c2", [6, 4]], ["cost", "--c1", []]],
    rows: (steps) => {
      const sum = { full: 0, failed: 0, cost: 0 };
      const sums = steps.map(([, s]) => ["full", "failed", "cost"].map((name) => (sum[name] += s[name])));
      return [0, 1, 2].map((column) => sums.map((row) => row[column]));
    },
    text: ([full, failed, cost], steps) => `Since step ${steps[0][0]}: about ${shown(full.at(-1), 0)} overflows, as the fleet believes (a sensor counts once a step), ${failed.at(-1)} failed transmissions. Cost that the UAVs reported: ${shown(cost.at(-1), 2)}, with the packets lost in their own reach only.`,
  },
  latency: {
    unit: "ms",
    series: [["round trip, mean", "--c1", []], ["edge, mean", "--c2", [6, 4]], ["edge, slowest", "--c3", [2, 3]]],
    log: true,
    rows: (steps) => [
      steps.map(([, s]) => (s.measured ? s.roundTrip / s.measured : null)),
      steps.map(([, s]) => s.edge / s.count),
      steps.map(([, s]) => s.slowest),
    ],
    text: ([roundTrip, edge, slowest]) => {
      const told = roundTrip.findLast((v) => v !== null);
      return `In the last step the edge took ${shown(edge.at(-1))} ms on average, ${shown(slowest.at(-1))} ms at most; ${told === undefined ? "the UAVs do not report their round trip" : `the last reported round trips were ${shown(told)} ms on average`}.`;
    },
  },
  tokens: {
    unit: "tokens",
    series: [["every sensor", "--c2", [6, 4]], ["prompt", "--c1", []]],
    rows: (steps) => [steps.map(([, s]) => s.uncompressed / s.count), steps.map(([, s]) => s.prompt / s.count)],
    text: ([full, prompt]) => `Tokens a decision: ${shown(prompt.at(-1), 0)} in the last step's prompts, ${shown(full.at(-1), 0)} with full rows of every sensor.`,
  },
};

export class Charts {
  constructor() {
    this.plots = {};
    this.later = null;
    onTheme(() => this.begin());
    const resized = new ResizeObserver(() => this.#resize());
    for (const name of Object.keys(CHARTS)) resized.observe(at(name));
  }

  /** Begin anew: another mission, or other colours. */
  begin() {
    for (const plot of Object.values(this.plots)) plot.destroy();
    this.plots = {};
    if (this.mission) this.#draw();
  }

  /** Draw a mission as it is now, and then no more for a moment. */
  update(mission) {
    this.mission = mission;
    this.stale = this.later !== null;
    if (this.stale) return;
    this.#draw();
    this.later = setTimeout(() => {
      this.later = null;
      if (this.stale && this.mission) this.update(this.mission);
    }, REDRAWN_EVERY_MS);
  }

  #draw() {
    const steps = [...this.mission.steps].filter(([, s]) => s.count > 0).sort((a, b) => a[0] - b[0]);
    at("loss").closest("section").hidden = steps.length === 0;
    if (!steps.length) return;
    for (const [name, chart] of Object.entries(CHARTS)) {
      // A prompt that no LLM reads costs and saves nothing.
      const hidden = name === "tokens" && !this.mission.about.asks;
      at(name).closest("figure").hidden = hidden;
      if (hidden) continue;
      const rows = chart.rows(steps);
      say(at(`${name}-text`), chart.text(rows, steps));
      // It is drawn once its details are opened.
      if (!at(name).clientWidth) continue;
      const data = [steps.map(([number]) => number), ...rows];
      if (this.plots[name]) this.plots[name].setData(data);
      else this.plots[name] = plotted(name, chart, data);
    }
  }

  #resize() {
    for (const [name, plot] of Object.entries(this.plots)) if (at(name).clientWidth) plot.setSize({ width: at(name).clientWidth, height: HEIGHT });
    if (this.mission && Object.keys(CHARTS).some((name) => !this.plots[name] && at(name).clientWidth)) this.#draw();
  }
}

function plotted(name, chart, data) {
  const axis = { stroke: named("--quiet"), grid: { stroke: named("--line"), width: 1 }, ticks: { stroke: named("--line"), width: 1 }, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif", labelSize: 20, labelGap: 2 };
  const series = chart.series.map(([label, colour, dash]) => ({
    label, stroke: named(colour), width: 2, dash, spanGaps: true, points: { show: data[0].length < 3 }, value: (_, value) => shown(value, 2),
  }));
  const y = chart.log
    ? { distr: 3, range: (_, low, high) => uPlot.rangeLog(Math.max(low, 0.1) * 0.8, high * 1.25, 10, false) }
    : { range: (_, low, high) => [0, Math.max(1, high * 1.1)] };
  const plot = new uPlot({
    width: at(name).clientWidth, height: HEIGHT, series: [{ label: "step", value: (_, value) => shown(value, 0) }, ...series],
    scales: { x: { time: false }, y },
    axes: [{ ...axis, label: "step", size: 34, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000] }, { ...axis, label: chart.unit, size: 48 }],
    cursor: { drag: { x: false, y: false } },
  }, data, at(name));
  // What it shows stands in words above it.
  plot.root.setAttribute("aria-hidden", "true");
  return plot;
}
