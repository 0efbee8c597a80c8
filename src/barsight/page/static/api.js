// The server: documents by name, kept until a newer revision is told; changes carry the session's token.
export const session = { name: "", role: "", token: null, rights: [], isKnown: false };
const kept = new Map();

export class Refused extends Error {
  constructor(status, problem) { super(problem); this.status = status; }
}

async function call(method, path, body) {
  const headers = {};
  if (body !== undefined) headers["Content-Type"] = "application/json";
  if (method !== "GET" && session.token) headers["X-Barsight-Token"] = session.token;
  const answer = await fetch(path, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  const content = await answer.json().catch(() => ({}));
  if (!answer.ok) {
    if (answer.status === 401) session.isKnown = false;
    throw new Refused(answer.status, content.problem || content.detail || answer.statusText);
  }
  return content;
}

export async function enter() {
  Object.assign(session, await call("GET", "/api/session"), { isKnown: true });
}

export async function logIn(name, password) {
  Object.assign(session, await call("POST", "/api/session", { name, password }), { isKnown: true });
}

export async function logOut() {
  await call("DELETE", "/api/session");
  session.isKnown = false;
}

export const get = (path) => call("GET", path);

// Change something. A server that was started anew has a new token: it is fetched once.
export async function change(method, path, body = {}) {
  try {
    return await call(method, path, body);
  } catch (error) {
    if (error.status !== 403) throw error;
    const before = session.token;
    await enter();
    if (session.token === before) throw error;
    return call(method, path, body);
  }
}

export function forget() { kept.clear(); }

export function read(name) {
  if (!kept.has(name)) {
    const promise = call("GET", `/api/${name}`);
    kept.set(name, promise);
    promise.catch(() => kept.delete(name));
  }
  return kept.get(name);
}

export const may = (right) => session.rights.includes(right);

// Where crane and magnet of a live run are, and how it stands; null where none is watched.
export const live = { crane: null };

// Call `onRevision` at each new revision, `onCrane` when the crane moved, `onState` with whether the server is there.
export function listen(onRevision, onState, onCrane) {
  const source = new EventSource("/api/events");
  source.addEventListener("revision", (event) => { onState(true); onRevision(Number(event.data)); });
  source.addEventListener("crane", (event) => { live.crane = JSON.parse(event.data); onCrane(); });
  source.onopen = () => onState(true);
  source.onerror = () => { live.crane = null; onState(false); if (source.readyState === EventSource.CLOSED) setTimeout(() => listen(onRevision, onState, onCrane), 1000); };
}
