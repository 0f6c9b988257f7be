// The operator's console: give a note, read what was understood, confirm or reject it, withdraw orders, and see which
// deadlines are met.

import { at, make, say } from "./dom.js";
import { post, Refused } from "./edge.js";
import { clock } from "./fleet.js";
import { GUIDANCE } from "./words.js";

const EXAMPLE = '{"sensors": [{"sensor_id": 4, "visit_every": 3}], "max_velocity": 10}';

export class Operator {
  constructor() {
    this.mission = null;
    this.busy = false;
    at("note-form").addEventListener("submit", (event) => this.#submit(event, () => ({ note: at("note-input").value.trim() }), at("note-input")));
    at("orders-form").addEventListener("submit", (event) =>
      this.#submit(event, () => ({ guidance: JSON.parse(at("orders-input").value), change: event.submitter?.value || "add" }), null),
    );
    // Refused where another operator was faster: what is answered is what the page shows, also while its view is frozen.
    const answers = { confirm: { answer: "confirm", change: "add" }, replace: { answer: "confirm", change: "replace" }, reject: { answer: "reject" } };
    for (const [id, answer] of Object.entries(answers)) at(id).addEventListener("click", () => this.#send({ ...answer, version: this.version }));
    at("withdraw").addEventListener("click", () => this.#send({ answer: "withdraw" }));
    at("edit").addEventListener("click", () => this.#edit());
    at("orders-input").placeholder = EXAMPLE;
  }

  /** Begin with another mission. */
  begin() {
    say(at("operator-error"), "");
    at("operator").open = false;
    this.seen = null;
  }

  /** Show a mission's guidance. */
  update(mission, mayCommand) {
    this.mission = mission;
    const { guidance, deadlines, step } = mission.now;
    const waits = guidance.status === "proposed";
    const inForce = Boolean(guidance.obeyed_in_words);
    this.version = guidance.version;
    say(at("operator-summary"), summary(guidance, waits));
    at("note").hidden = guidance.note === null && guidance.guidance === null;
    at("note-quote").hidden = guidance.note === null;
    say(at("note-text"), guidance.note ?? "");
    say(at("note-state"), guidance.note === null ? "Orders without a note." : GUIDANCE[guidance.status] ?? guidance.status);
    const orders = waits ? guidance.in_words : guidance.status === "failed" ? guidance.failure : "";
    say(at("note-words"), orders ?? "");
    at("note-words").hidden = !orders;
    say(at("note-doubts"), waits ? (guidance.doubts ?? []).join(" ") : "");
    at("note-doubts").hidden = !at("note-doubts").textContent;
    this.#changes(waits && inForce ? changes(guidance) : []);
    at("answer").hidden = !mayCommand || !(waits || inForce);
    at("confirm").hidden = at("reject").hidden = !waits;
    say(at("confirm"), waits && guidance.stays.length ? "Confirm, and keep the other orders" : "Confirm");
    at("replace").hidden = !waits || guidance.ends_if_replaced.length === guidance.ends.length;
    at("withdraw").hidden = !inForce;
    at("edit").hidden = guidance.guidance === null;
    at("command").hidden = !mayCommand;
    at("read-only").hidden = mayCommand;
    this.#orders(guidance, deadlines, step, mayCommand);
    // Once for each proposal: who closes the console wants it closed.
    if (waits && this.seen !== guidance.in_words) at("operator").open = true;
    this.seen = waits ? guidance.in_words : null;
  }

  #changes(parts) {
    at("note-changes").hidden = parts.length === 0;
    const rows = parts.map(([title, orders]) => make("li", {}, make("strong", {}, title), ` ${orders.join(" ")}`));
    this.#renew("note-changes", parts, rows);
  }

  // Only where it differs: a new button would lose the keyboard's focus.
  #renew(id, shown, rows) {
    const key = JSON.stringify(shown);
    if (at(id).dataset.shown === key) return;
    at(id).dataset.shown = key;
    at(id).replaceChildren(...rows);
  }

  #inForce(orders, mayCommand) {
    say(at("orders-words"), orders.length ? "" : "None.");
    at("orders-words").hidden = orders.length > 0;
    const rows = orders.map((order) => {
      const source = order.note === null ? "" : `, from the note “${order.note}”`;
      const since = `since step ${order.since_step}, ${clock(new Date(order.since))}${source}`;
      const row = make("li", {}, make("span", { class: "words" }, order.in_words), " ", make("span", { class: "hint" }, since), " ");
      if (mayCommand) {
        const end = make("button", { type: "button", "aria-label": `Withdraw: ${order.in_words}` }, "Withdraw");
        end.addEventListener("click", () => this.#send({ answer: "withdraw", orders: [order.name] }));
        row.append(end);
      }
      return row;
    });
    this.#renew("orders-list", [orders, mayCommand], rows);
  }

  #orders(guidance, deadlines, step, mayCommand) {
    this.#inForce(guidance.orders, mayCommand);
    say(at("orders-ended"), guidance.ended.length ? `Ended by the last change: ${guidance.ended.join(" ")}` : "");
    at("orders-ended").hidden = guidance.ended.length === 0;
    const { due } = guidance;
    at("deadlines").hidden = due.length + deadlines.met + deadlines.missed === 0;
    say(at("deadlines-met"), `Visit deadlines of the steps that are over: ${deadlines.met} met, ${deadlines.missed} missed.`);
    const rows = due.map((order) => {
      const late = order.due < step;
      const text = late ? `late: it was due by step ${order.due}` : `due by step ${order.due}`;
      return make("li", late ? { class: "late" } : {}, `${this.mission.sensor(order.sensor_id)}, every ${order.visit_every} steps: ${text}`);
    });
    at("deadlines-list").replaceChildren(...rows);
  }

  #edit() {
    const { guidance } = this.mission.now.guidance;
    at("orders-input").value = JSON.stringify(guidance ?? JSON.parse(EXAMPLE), null, 1);
    at("structure").open = true;
    at("orders-input").focus();
  }

  #submit(event, body, cleared) {
    event.preventDefault();
    let made;
    try {
      made = body();
    } catch (error) {
      say(at("operator-error"), `These orders are no JSON: ${error.message}`);
      return;
    }
    this.#send(made).then((done) => {
      if (done && cleared) cleared.value = "";
    });
  }

  async #send(body) {
    if (this.busy || !this.mission) return false;
    this.busy = true;
    say(at("operator-error"), "");
    try {
      await post(`missions/${encodeURIComponent(this.mission.id)}/guidance`, body);
      return true;
    } catch (error) {
      say(at("operator-error"), error instanceof Refused ? `The edge refused: ${error.message}` : "The edge does not answer.");
      return false;
    } finally {
      this.busy = false;
    }
  }
}

/** What a confirmation changes: titles, and the orders of each. */
function changes({ begins, stays, ends, ends_if_replaced }) {
  const also = ends_if_replaced.filter((order) => !ends.includes(order));
  const parts = [
    ["Begins when you confirm:", begins],
    ["Stays:", stays],
    ["Ends:", ends],
    ["Ends too if you replace all orders:", also],
  ].filter(([, orders]) => orders.length > 0);
  return begins.length + ends.length ? parts : [["These orders are in force already.", []], ...parts];
}

function summary(guidance, waits) {
  if (waits) return "orders wait for your confirmation";
  if (guidance.status === "compiling") return "the LLM is reading the note";
  if (guidance.obeyed_in_words) return guidance.obeyed_in_words;
  return guidance.status === "failed" ? "the note was not understood" : "no orders";
}
