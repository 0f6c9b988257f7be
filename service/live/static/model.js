// What the page knows of one mission: the newest picture of it, its decisions, and sums by step for the charts.

const MOST_DECISIONS = 1000;
const MOST_STEPS = 1000;
// In the last step a UAV that has not asked for so long will not ask.
const ASKING_S = 5;

export class Mission {
  constructor(snapshot) {
    this.decisions = new Map();
    this.steps = new Map();
    this.sources = new Map();
    this.totals = { seen: 0, saved: 0, uncompressed: 0, told: 0, cost: 0, failed: 0, measured: 0 };
    this.begin(snapshot);
  }

  /** Whether a snapshot goes on where this left off: the same mission, not one made anew, and the same edge. */
  goesOn(snapshot) {
    return snapshot.mission.mission_id === this.id && snapshot.edge === this.edge && snapshot.made >= this.now.made;
  }

  /** Take a snapshot; decisions that are known stay as they are. */
  begin(snapshot) {
    this.id = snapshot.mission.mission_id;
    this.edge = snapshot.edge;
    this.about = snapshot.mission;
    this.scenario = snapshot.scenario;
    this.pipeline = snapshot.pipeline;
    this.trajectories = snapshot.trajectories;
    this.places = snapshot.places;
    this.names = snapshot.names;
    this.map = snapshot.map;
    this.apply(snapshot);
  }

  /** Take what changed. */
  apply(update) {
    this.now = update;
    for (const told of update.decisions) this.#decided(told);
    for (const outcome of update.outcomes) this.#settled(outcome);
    for (const [step, count] of update.full_by_step) this.#step(step).full = count;
    this.heardAt = performance.now();
  }

  /** A sensor for people: its name, or else its ID. */
  sensor(id) {
    return this.names?.sensors[id] ?? `S${id}`;
  }

  /** A UAV for people. */
  uav(id, kind = "U") {
    return this.names?.uavs[id] ?? `${kind}${id}`;
  }

  /** Seconds since the newest update. */
  get age() {
    return (performance.now() - this.heardAt) / 1000;
  }

  /** Seconds since the edge's last decision; null before the first. */
  get idleS() {
    return this.now.idle_s === null ? null : this.now.idle_s + this.age;
  }

  /** Whether no UAV has asked for so long that the whole fleet may be lost; it is the limit of the alert `uav_lost`. */
  get isSilent() {
    return this.idleS > Math.max(30, 3 * this.scenario.step_s);
  }

  /** Whether every UAV has its decision of the mission's last step, or those that have none no longer ask. */
  get ended() {
    const { uavs, steps } = this.scenario;
    if (this.now.step < steps - 1) return false;
    // A fleet may fly on past its scenario's last step.
    if (this.now.step >= steps) return this.isSilent;
    return this.decidedIn(steps - 1) >= uavs || this.idleS > ASKING_S;
  }

  /** The number of UAVs that have a decision in this step. */
  decidedIn(step) {
    return new Set([...this.decisions.values()].filter(({ answer }) => answer.step === step).map(({ answer }) => answer.uav_id)).size;
  }

  /** Decisions, the newest first. */
  newest(most) {
    return [...this.decisions.values()].slice(-most).reverse();
  }

  #decided(told) {
    const { answer } = told;
    if (!this.decisions.has(answer.decision_id)) {
      this.decisions.set(answer.decision_id, { ...told, outcome: null });
      if (this.decisions.size > MOST_DECISIONS) this.decisions.delete(this.decisions.keys().next().value);
      const { tokens } = answer;
      const step = this.#step(answer.step);
      step.count += 1;
      step.edge += answer.latency_ms.total;
      step.slowest = Math.max(step.slowest, answer.latency_ms.total);
      step.prompt += tokens.prompt;
      step.uncompressed += tokens.uncompressed;
      this.totals.seen += 1;
      this.totals.saved += tokens.saved;
      this.totals.uncompressed += tokens.uncompressed;
      this.sources.set(answer.source, (this.sources.get(answer.source) ?? 0) + 1);
    }
    if (told.outcome) this.#settled(told.outcome);
  }

  #settled(outcome) {
    const decision = this.decisions.get(outcome.decision_id);
    if (!decision || decision.outcome) return;
    decision.outcome = outcome;
    const step = this.#step(decision.answer.step);
    step.told += 1;
    step.cost += outcome.cost;
    step.failed += outcome.failed ? 1 : 0;
    this.totals.told += 1;
    this.totals.cost += outcome.cost;
    this.totals.failed += outcome.failed ? 1 : 0;
    if (measured(decision) !== null) {
      step.measured += 1;
      step.roundTrip += measured(decision);
      this.totals.measured += 1;
    }
  }

  #step(number) {
    if (!this.steps.has(number)) {
      const none = { count: 0, edge: 0, slowest: 0, prompt: 0, uncompressed: 0, told: 0, cost: 0, failed: 0, full: 0 };
      this.steps.set(number, { ...none, measured: 0, roundTrip: 0 });
      if (this.steps.size > MOST_STEPS) this.steps.delete(this.steps.keys().next().value);
    }
    return this.steps.get(number);
  }
}

/** A decision's round trip as its UAV measured it, ms; null while it has not told. */
export const measured = (decision) => decision.outcome?.round_trip_ms ?? null;

/** The round trip, or the edge's own time. */
export const latency = (decision) => measured(decision) ?? decision.answer.latency_ms.total;
