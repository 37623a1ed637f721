// The gateway, asked with its token. Events are read from a plain response, because EventSource sends no headers.

const KEY = "coma-token";

/** The gateway wants another token. */
export class TokenNeeded extends Error {}

// A token may come in the address, behind '#': what is there is never sent to a server.
const given = new URLSearchParams(location.hash.slice(1)).get("token");
if (given) {
  sessionStorage.setItem(KEY, given);
  history.replaceState(null, "", location.pathname + location.search);
}

export function setToken(token) {
  sessionStorage.setItem(KEY, token);
}

export async function ask(path, options = {}) {
  const token = sessionStorage.getItem(KEY);
  const headers = { ...options.headers, ...(token ? { authorization: `Bearer ${token}` } : {}) };
  const response = await fetch(path, { ...options, headers });
  if (response.ok) return response;
  const problem = await response.json().catch(() => null);
  const message = problem?.error ? [problem.error.field, problem.error.message].filter(Boolean).join(": ") : response.statusText;
  if (response.status === 401) throw new TokenNeeded(message);
  throw new Error(message);
}

export async function json(path) {
  return (await ask(path)).json();
}

/** Calls `on(event)` for every live event until the connection breaks. */
export async function listen(on, opened) {
  const response = await ask("api/v1/events");
  opened();
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text += value;
    for (let end = text.indexOf("\n\n"); end >= 0; end = text.indexOf("\n\n")) {
      const data = text.slice(0, end).split("\n").filter((line) => line.startsWith("data:"));
      text = text.slice(end + 2);
      if (data.length) on(JSON.parse(data.map((line) => line.slice(5)).join("\n")));
    }
  }
}

/** Saves an answer as a file. */
export async function save(path, name) {
  const url = URL.createObjectURL(await (await ask(path)).blob());
  const link = Object.assign(document.createElement("a"), { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}
