// Asking the edge: with a key where it wants one, and its event streams, which EventSource could not ask for with a key.

const KEY = "aicvds-key";
// The edge says something every 5 s; after this a connection that looks open is dead.
const SILENCE_MS = 15_000;

/** The edge answered, and the answer was no. */
export class Refused extends Error {
  constructor(status, detail, retryS) {
    super(detail);
    this.status = status;
    this.retryS = retryS;
  }
}

/** Keep a key for this tab. */
export const useKey = (key) => sessionStorage.setItem(KEY, key);

/** Whether a key is kept. */
export const hasKey = () => sessionStorage.getItem(KEY) !== null;

/** A JSON answer; throws `Refused`, or a TypeError where the edge is out of reach. */
export async function ask(path, signal) {
  return (await get(path, signal)).json();
}

/** Sends JSON; throws as `ask`. */
export async function post(path, body) {
  return (await get(path, undefined, { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } })).json();
}

/** A stream's events as `{name, data}`, comments as `{name: null}`. Ends where the edge ends it. */
export async function* events(path, signal) {
  const stop = new AbortController();
  const answer = await get(path, AbortSignal.any([signal, stop.signal]));
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  try {
    for (;;) {
      const watch = setTimeout(() => stop.abort(), SILENCE_MS);
      const { done, value } = await reader.read().finally(() => clearTimeout(watch));
      if (done) return;
      const blocks = (rest + value).split("\n\n");
      rest = blocks.pop();
      for (const block of blocks) yield parsed(block);
    }
  } finally {
    stop.abort();
  }
}

async function get(path, signal, sent = {}) {
  const key = sessionStorage.getItem(KEY);
  const headers = { ...sent.headers, ...(key ? { Authorization: `Bearer ${key}` } : {}) };
  const answer = await fetch(path, { ...sent, headers, signal, cache: "no-store" });
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({}));
  throw new Refused(answer.status, problem.detail ?? answer.statusText, Number(answer.headers.get("Retry-After")) || 0);
}

function parsed(block) {
  let name = null;
  let data = null;
  for (const line of block.split("\n")) {
    if (line.startsWith("event: ")) name = line.slice(7);
    else if (line.startsWith("data: ")) data = JSON.parse(line.slice(6));
  }
  return { name, data };
}
